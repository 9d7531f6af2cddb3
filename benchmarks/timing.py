"""How the benchmarks take times: tools in turn, so that a machine whose speed drifts treats them alike."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Times:
    """Seconds of the repeats of one thing."""

    all: tuple[float, ...]

    @property
    def least(self) -> float:
        return min(self.all)

    @property
    def median(self) -> float:
        return float(np.median(self.all))

    @property
    def noise(self) -> float:
        """Median over least: 1 on a quiet machine."""
        return self.median / self.least


def in_turn(
    runs: Mapping[str, Callable[[], object]], repeats: int, clock: Callable[[], float] = time.process_time
) -> dict[str, Times]:
    """Run A B C A B C ...; one round before that is not counted.

    The clock is that of this process, which other processes hardly disturb; for anything that waits for another
    process it must be `time.perf_counter`.
    """
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for k in range(repeats + 1):
        for name, run in runs.items():
            begun = clock()
            run()
            if k:
                seconds[name].append(clock() - begun)
    return {name: Times(tuple(times)) for name, times in seconds.items()}


def machine() -> str:
    """Return a description of the machine in one sentence."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    compiler = subprocess.run(["cc", "--version"], capture_output=True, text=True, check=False).stdout.split("\n")[
        0
    ]
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    return (
        f"{model}, {len(os.sched_getaffinity(0))} processors, load before the start {load}; {platform.system()}, "
        f"Python {platform.python_version()}, {compiler or 'no C compiler'}"
    )


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def say(text: str) -> None:
    """Tell what is being measured."""
    sys.stderr.write(f"{text}\n")
