"""Peak memory of large campaigns and of long histories: ``make memory`` prints a table.

Every row is a process of its own, and the peak is that of the largest process among those it started.

    python benchmarks/memory.py                        100, 1000 and 10,000 runs; 10^4, 10^5 and 10^6 evaluations
    python benchmarks/memory.py runs FOLDER COUNT      one campaign of so many runs, written, identified, reported
    python benchmarks/memory.py history FOLDER COUNT   one history of so many evaluations, written and read
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np

RUNS = (100, 1_000, 10_000)
EVALUATIONS = (10_000, 100_000, 1_000_000)
MODEL = """model Oscillator
  parameter Real m(unit = "kg") = 1; parameter Real d(unit = "N.s/m") = 0.5; parameter Real c(unit = "N/m") = 90;
  input Real u(unit = "N"); output Real x(unit = "m", start = 0, fixed = true);
  Real v(unit = "m/s", start = 0, fixed = true);
equation
  der(x) = v; m*der(v) = u - d*v - c*x;
end Oscillator;
"""
CAMPAIGN = """[campaign]
name = "many runs"
[models.bench]
fmu = "Oscillator.fmu"
[parameters]
m = { start = 1.0, lower = 0.1, upper = 10.0 }
d = { start = 0.5, lower = 0.0, upper = 10.0 }
[roles]
identification = ["r*"]
[stages.all]
free = ["m", "d"]
"""


def write_runs(folder: Path, count: int) -> None:
    """Write a campaign of `count` short runs of an oscillator whose mass and damping are to be found."""
    from fmu_build import build
    from fmuid.core.experiments import Experiment, Measurements, Signal
    from fmuid.data.measurements import write_measurements
    from fmuid.simulation.fmu import load_fmu
    from fmuid.simulation.simulator import Task

    (folder / "Oscillator.mo").write_text(MODEL, encoding="utf-8")
    (folder / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    fmu = load_fmu(build(folder / "Oscillator.mo", "Oscillator", folder))
    rng, time, runs = np.random.default_rng(0), np.linspace(0.0, 0.2, 21), {}
    for k in range(count):
        u = rng.uniform(1.0, 9.0) * np.sin(rng.uniform(5.0, 40.0) * time)
        (x,) = fmu.simulate(Task(time, {"u": u}, ("x",), {"m": 1.2, "d": 0.8}), {})
        measured = Signal("x", x + 1e-4 * rng.standard_normal(time.size), "m", "output", sigma=1e-4)
        runs[f"r{k}"] = Experiment(f"r{k}", "bench", time, {"u": Signal("u", u, "N", "input"), "x": measured})
    write_measurements(Measurements(runs), folder / "measurements.h5")


def write_history(folder: Path, count: int) -> None:
    """Record `count` evaluations of two parameters, as a search does."""
    from fmuid.identification.history import History
    from fmuid.identification.problem.evaluation import Evaluation

    rng, best = np.random.default_rng(0), np.inf
    space = SimpleNamespace(start=np.zeros(2), tried=lambda x: ({"a": 0.0, "b": 0.0}, x))
    problem = SimpleNamespace(name="all", space=space, labels=("fit",), cases=())
    with History(folder) as history:
        history.begin(problem, "", b"")  # type: ignore[arg-type]
        for x in rng.standard_normal((count, 2)):
            cost = float(x @ x)
            values = {"a": float(x[0]), "b": float(x[1])}
            evaluation = Evaluation(x, values, np.array([cost]), np.zeros(0), cost, np.zeros(0), None, 1e-3, ())
            history.record("all", evaluation, "search", cost < best, residuals=False)
            best = min(best, cost)
        history.conclude(b"{}")


def read_history(folder: Path) -> None:
    """Read what `write_history` left."""
    from fmuid.identification.history import read_history as read

    assert len(read(folder)["all"].rows) > 0


def peak(*command: str) -> tuple[float, float]:
    """Run a command; return the peak of the memory of its largest process in MB, and its processor time in s."""
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.execv(command[0], command)
    _, status, used = os.wait4(child, 0)
    if status:
        sys.exit(f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}")
    return used.ru_maxrss / 1024.0, used.ru_utime + used.ru_stime


def table() -> None:
    """Print the peaks of all sizes, row by row."""
    this_file, fmuid = (sys.executable, __file__), (str(Path(sys.executable).with_name("fmuid")),)
    print("| what | number | peak (MB) | processor time (s) | size (MB) |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        for count in RUNS:
            folder = Path(name, f"runs{count}")
            run = folder / "found"
            folder.mkdir()
            peak(*this_file, "runs", str(folder), str(count))
            to = ("--out", str(run), "--no-report", "--workers", "1", "--quiet")
            row("`fmuid identify`, runs", count, (*fmuid, "identify", str(folder), *to), run)
            row("`fmuid report`, runs", count, (*fmuid, "report", str(run), "--quiet"), run / "index.html")
        for count in EVALUATIONS:
            folder = Path(name, f"rows{count}")
            history = folder / "history.h5"
            row("history written, evaluations", count, (*this_file, "history", str(folder), str(count)), history)
            row("history read, evaluations", count, (*this_file, "read", str(folder), "0"), history)


def row(what: str, count: int, command: Sequence[str], product: Path) -> None:
    """Print one row: the peak and the time of a command, and the size of what it made."""
    memory, seconds = peak(*command)
    files = [product] if product.is_file() else [p for p in product.rglob("*") if p.is_file()]
    size = sum(p.stat().st_size for p in files) / 1e6
    print(f"| {what} | {count:,} | {memory:.0f} | {seconds:.0f} | {size:.1f} |", flush=True)


def main(arguments: Sequence[str]) -> int:
    """Run the command; return the exit code."""
    if not arguments:
        table()
        return 0
    what, folder, count = arguments
    {"runs": write_runs, "history": write_history, "read": lambda f, _: read_history(f)}[what](
        Path(folder), int(count)
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
