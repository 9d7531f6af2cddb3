"""Identification to an equal cost: fmuid and its peers on the same FMU and data, wall time and simulations.

Three parameters from one run: of the stiff actuator, under a PRBS of 0.5 s at 1 kHz, and of a pendulum with
friction, under torque steps over 4 s at 500 Hz. Everybody starts at the same point with the same bounds and stops
at a root mean square error within 1 % of the least. Setting up (extracting, instantiating) counts, imports do not.
Everybody runs in a new process, peers in environments of their own, made from ``benchmarks/peers/*.txt``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from integrator import prbs
from timing import say, table

from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task

HERE = Path(__file__).parent
ROOT = HERE.parent
SHORT = 5.0  # s; what takes longer is run once
ENVIRONMENTS = ROOT / "build" / "peers"
FMUID = ("fmuid", None, "with_fmuid.py", ())
PEERS = (  # name shown, environment (None: this one), script, arguments
    ("AixCaliBuHA 1.2.0, Nelder-Mead", "aixcalibuha", "with_aixcalibuha.py", ("Nelder-Mead",)),
    (
        "AixCaliBuHA 1.2.0, differential evolution",
        "aixcalibuha",
        "with_aixcalibuha.py",
        ("differential_evolution",),
    ),
    ("ModestPy 0.1.1, genetic algorithm + pattern search", "modestpy", "with_modestpy.py", ("GA_LEGACY+PS",)),
    ("pyPESTO 0.7.0, SciPy's least squares", "pypesto", "with_pypesto.py", ()),
    ("FMPy 0.3.32 and SciPy's least squares by hand", None, "with_fmpy.py", ()),
)


@dataclass(frozen=True)
class Subject:
    """An FMU, its run, and the parameters to find: true value; start, lower and upper bound."""

    fmu: str
    time: np.ndarray
    inputs: Mapping[str, np.ndarray]
    output: str
    noise: float
    parameters: Mapping[str, tuple[float, tuple[float, float, float]]]


def stiff() -> Subject:
    """Return the actuator with its shaft fixed: most of the time goes into the steps inside the FMU."""
    parameters = {
        "d_S": (3.0, (2.0, 0.1, 20.0)),
        "J_S": (3.5e-3, (3e-3, 1e-3, 1e-2)),
        "d_G": (80.0, (50.0, 5.0, 300.0)),
    }
    return Subject("FixedShaft", 1e-3 * np.arange(501), {"i_cmd": prbs(501, 0.8)}, "tau_sensor", 0.1, parameters)


def light() -> Subject:
    """Return the pendulum, whose simulation costs little compared with a loop over its samples in Python."""
    time = 2e-3 * np.arange(2001)
    torque = np.repeat([0.14, -0.09, 0.16, -0.14, 0.05, -0.15, 0.1, 0.0], 251)[: len(time)]
    parameters = {
        "m": (1.2, (0.9, 0.3, 3.0)),
        "friction.K_v": (0.08, (0.15, 0.01, 1.0)),
        "friction.K_c": (0.15, (0.25, 0.01, 1.0)),
    }
    return Subject("TorqueDriven", time, {"tau_ref": torque}, "q", 0.01, parameters)


@dataclass(frozen=True)
class Finish:
    """How it went: wall time in s, simulations, cost; or why not."""

    name: str
    seconds: float = np.nan
    simulations: int = 0
    cost: float = np.nan
    reached: bool = False
    missing: str = ""


def race(subject: Subject, limit: float, file: Path) -> None:
    """Write the job: the least cost is found first, by running fmuid to its end."""
    path = ROOT / "build" / "fmus" / f"{subject.fmu}.fmu"
    task = Task(subject.time, subject.inputs, (subject.output,))
    with Fmu(path) as fmu:
        true = fmu.simulate(task, {name: value for name, (value, _) in subject.parameters.items()})[0]
    measured = true + np.random.default_rng(0).normal(0.0, subject.noise, len(true))
    inputs = {name: u.tolist() for name, u in subject.inputs.items()}
    job = {
        "fmu": str(path), "time": subject.time.tolist(), "inputs": inputs, "output": subject.output,
        "measured": measured.tolist(), "limit": limit, "target": 0.0,
        "parameters": {name: bounds for name, (_, bounds) in subject.parameters.items()},
    }  # fmt: skip
    file.write_text(json.dumps(job))
    file.write_text(json.dumps({**job, "target": 1.01 * with_peer(FMUID, file, limit).cost}))


def with_peer(peer: tuple[str, str | None, str, tuple[str, ...]], file: Path, limit: float) -> Finish:
    """Run one peer in its environment."""
    name, environment, script, arguments = peer
    python = sys.executable if environment is None else str(ENVIRONMENTS / environment / "bin" / "python")
    if not Path(python).is_file():
        return Finish(name, missing=f"no environment in {ENVIRONMENTS.relative_to(ROOT)}/{environment}")
    try:
        done = subprocess.run(
            [python, str(HERE / "peers" / script), str(file), *arguments],
            capture_output=True,
            text=True,
            check=False,
            timeout=limit + 60.0,
        )
    except subprocess.TimeoutExpired:
        return Finish(name, missing="did not stop")
    try:
        return Finish(name, **json.loads(done.stdout.splitlines()[-1]))
    except (IndexError, ValueError, TypeError):
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        return Finish(name, missing=f"failed: {last.replace(f'{ROOT}/', '')[:200]}")


def measure(folder: Path, *, limit: float = 40.0, repeats: int = 5) -> dict[str, list[Finish]]:
    """Run everybody on both subjects, in turn; the median counts of those who are done within `SHORT` seconds."""
    subjects = {"the actuator": stiff(), "the pendulum": light()}
    return {what: _all_on(subject, folder / "race.json", limit, repeats) for what, subject in subjects.items()}


def _all_on(subject: Subject, file: Path, limit: float, repeats: int) -> list[Finish]:
    race(subject, limit, file)
    runs: dict[str, list[Finish]] = {}
    for _ in range(repeats):
        for peer in (FMUID, *PEERS):
            finishes = runs.setdefault(peer[0], [])
            if not finishes or finishes[0].seconds < SHORT:
                say(f"  {peer[0]}")
                finishes.append(with_peer(peer, file, limit))
    return [sorted(finishes, key=lambda f: f.seconds)[len(finishes) // 2] for finishes in runs.values()]


def page(races: Mapping[str, Sequence[Finish]]) -> str:
    """Return the table, from what ran to who took part; fmuid is the first of each."""
    rows = []
    for what, finishes in races.items():
        for f in finishes:
            if f.missing:
                rows.append([what, f.name, "missing", "", f.missing, ""])
                continue
            note, reached = ("", "") if f.reached else (" (stopped there)", "at least ")
            times = f"{reached}{f.seconds / finishes[0].seconds:.3g}"
            rows.append([what, f.name, f"{f.seconds:.3g}{note}", str(f.simulations), f"{f.cost:.4f}", times])
    return table(["run of", "tool", "wall time (s)", "simulations", "error reached", "times fmuid's"], rows)
