"""What the peers' scripts share: the job they are given, and the clock that stops them at an equal cost.

Runs in every peer's own environment, so it needs nothing but NumPy.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

with contextlib.suppress(ImportError):
    import lxml.etree  # noqa: F401  FMPy does so when it first reads; imports do not count


class OverError(BaseException):
    """The cost is reached, or the time is up; nothing that a tool catches."""


class Race:
    """A job from the file named on the command line, and the best cost so far.

    The clock starts when the job is read: what a tool does to set itself up counts, its imports do not.
    """

    def __init__(self) -> None:
        self.job: dict[str, Any] = json.loads(Path(sys.argv[1]).read_text())
        self.time = np.array(self.job["time"])
        self.measured = np.array(self.job["measured"])
        self.parameters: dict[str, list[float]] = self.job["parameters"]  # start, lower, upper
        self.best, self.simulations = np.inf, 0
        self.begun = time.perf_counter()

    def take(self, predicted: Any) -> None:
        """Count a simulation, by its (N,) prediction of the measured output."""
        self.simulations += 1
        self.judge(np.asarray(predicted, dtype=float) - self.measured)

    def judge(self, residuals: np.ndarray) -> None:
        """Take the (N,) residuals of a simulation that is counted elsewhere."""
        self.best = min(self.best, float(np.sqrt(np.mean(residuals**2))))
        if self.best <= self.job["target"] or self.seconds > self.job["limit"]:
            raise OverError

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.begun

    def run(self, tool: Callable[[], object]) -> None:
        """Run the tool to its end or the race's, and print the result as the last line."""
        with contextlib.suppress(OverError):
            tool()
        result = {"seconds": self.seconds, "simulations": self.simulations, "cost": self.best}
        print("\n" + json.dumps({**result, "reached": self.best <= self.job["target"]}))
