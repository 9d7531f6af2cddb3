"""Runs that end otherwise than well, in processes of their own: how they are ended, and the line that says so."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

CAMPAIGN, MEASUREMENTS = Path("bench/campaign.toml"), Path("bench/measurements.h5")
FMUID = [sys.executable, "-c", "from fmuid.cli import main; main()"]
IDENTIFY = "identify bench --no-report"


@dataclass(frozen=True)
class Ending:
    """What happens to a command (or to a script), and the exit code; `make` prepares the campaign."""

    what: str
    command: str
    code: int
    line: str  # a pattern: which of all lines it is
    make: Callable[[], object] = lambda: None
    end: Callable[[list[str]], subprocess.CompletedProcess[str]] | None = None
    program: str = "fmuid"


def replaced(old: str, new: str) -> Callable[[], object]:
    return lambda: CAMPAIGN.write_text(CAMPAIGN.read_text().replace(old, new))


def stage(line: str) -> Callable[[], object]:
    return replaced("[stages.all]\n", f"[stages.all]\n{line}\n")


def scaled(factor: float) -> Callable[[], object]:
    def change() -> None:
        with h5py.File(MEASUREMENTS, "r+") as file:
            for run in file["experiments"].values():
                run["signals/position"][...] *= factor

    return change


def endless() -> None:
    stage('solver = "isres"')()
    replaced("evaluations = 100", "seconds = 3600")()


def run(command: list[str], **how: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False, **how)


def signalled(journal: str, *names: str) -> Callable[[list[str]], subprocess.CompletedProcess[str]]:
    """Send signals to a command once it has recorded something."""

    def end(command: list[str]) -> subprocess.CompletedProcess[str]:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while process.poll() is None and not (Path(journal).exists() and Path(journal).stat().st_size > 2000):
            time.sleep(0.01)
        for name in names:
            process.send_signal(getattr(signal, name))
            time.sleep(0.001)
        out, err = process.communicate(timeout=600)
        return subprocess.CompletedProcess(command, process.returncode, out, err)

    return end


def hurried(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Press Ctrl-C again and again; once in a while the first one is through before the second."""
    for _ in range(9):
        shutil.rmtree("runs", ignore_errors=True)
        done = signalled(JOURNAL, *["SIGINT"] * 50)(command)
        if "stopped at once" in done.stderr:
            break
    return done


def without_room(command: list[str]) -> subprocess.CompletedProcess[str]:
    """No file may get larger than 400 kB, as on a disk that is full."""
    return run(command, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000)))


def script() -> None:
    Path("study.py").write_text('import fmuid\nfmuid.identify("bench", workers=2)\n')


def as_a_script(_: list[str]) -> subprocess.CompletedProcess[str]:
    return run([sys.executable, "study.py"])


def while_loading(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Press Ctrl-C when the first library is loaded."""
    process = subprocess.Popen(
        [command[0], "-X", "importtime", *command[1:]], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    for line in process.stderr:
        if "typer" in line:
            break
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=600)
    err = "".join(line for line in err.splitlines(keepends=True) if not line.startswith("import time:"))
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def into_a_full_disk(command: list[str]) -> subprocess.CompletedProcess[str]:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=600, check=False)
    return subprocess.CompletedProcess(command, done.returncode, "", done.stderr)


def trusted(command: list[str]) -> subprocess.CompletedProcess[str]:
    Path("own.py").write_text('def judge(*_, **__):\n    raise RuntimeError("no value")\n')
    return run(command, env={**os.environ, "PYTHONPATH": "."})


def shown(line: str) -> str:
    """Return a line without what is different every time."""
    line = re.sub(r"\d+ of \d+ (candidates.*) \(\d+\)$", r"n of m \1", line)
    return re.sub(r" by \w+, \d+ eval.*", "", line)


JOURNAL, DIAGNOSIS = "runs/bench/history.journal", "runs/bench-diagnosis/diagnosis.journal"
USER = '{ signal = "position", kind = "user", options = { function = "own:judge" } }'
ENDINGS = [
    Ending("SIGTERM, from a batch system", IDENTIFY, 130, "continue with", endless, signalled(JOURNAL, "SIGTERM")),
    Ending("SIGHUP, from a terminal that is closed", IDENTIFY, 130, "continue with", endless, signalled(JOURNAL, "SIGHUP")),
    Ending("SIGTERM while it diagnoses", "diagnose bench", 130, "continue with", end=signalled(DIAGNOSIS, "SIGTERM")),
    Ending("Ctrl-C while libraries are loaded", IDENTIFY, 130, "interrupted", end=while_loading),
    Ending("a second Ctrl-C while the first is handled", IDENTIFY, 130, "stopped at once", endless, hurried),
    Ending("a full disk for records", IDENTIFY, 2, "cannot be written", endless, without_room),
    Ending("a script whose work is not under a main guard", "study.py", 1, "worker pool", script, as_a_script, "python"),
    Ending("a full disk for printed output", "check bench", 2, "the output", end=into_a_full_disk),
    Ending("a `tie` without a value at the start", IDENTIFY, 1, "the start point fails", stage('free = ["m"]\ntie = { d = "(m - 9)**0.5" }')),
    Ending("a `tie` without a value at some points", IDENTIFY, 0, "candidates", stage('free = ["m"]\ntie = { d = "(1.1 - m)**0.5" }\nsolver = "bobyqa"')),
    Ending("a user's criterion that raises", f"{IDENTIFY} --trust", 1, "the start point fails", stage(f"criteria = [{USER}]"), trusted),
    Ending("a sensor with the wrong sign", IDENTIFY, 0, "with the opposite sign", scaled(-1.0)),
    Ending("degrees for radians", IDENTIFY, 0, "check its unit", scaled(57.29578)),
    Ending("a model that misses something", IDENTIFY, 0, "times its noise", replaced("c = 90", "c = 80")),
]  # fmt: skip
