"""A friction law fitted as servo projects do it and as fmuid does it, to an equal mean absolute error.

Rollouts of a servo pendulum under its position controller (as of a Unitree Go1 joint): four references, two
payloads. Their way: CMA-ES on the mean absolute error of the position, over whole closed-loop rollouts, each
parameter scaled to its bounds (BAM, "Better Actuator Models", with 100 000 rollouts a law). Ours: least squares on
the same rollouts. Both simulate with fmuid, so what is compared is the search. Data are simulated, with terms of
the law that the fit has too, and noise.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import cma
import numpy as np
from identification_speed import ROOT
from timing import table

from fmuid.core.campaign import ParameterSpec
from fmuid.identification.problem.cases import measured_case
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.solvers import make
from fmuid.identification.solvers.search import Search
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.runners import Job, Outcome, in_process
from fmuid.simulation.simulator import Task

TRUTH = {"K_v": 0.12, "K_c": 0.25, "K_cs": 0.12, "w_s": 0.35, "K_m": 0.11, "K_e": 0.06}
BOUNDS = {
    "K_v": (0.1, 1e-3, 1.0),
    "K_c": (0.2, 1e-3, 1.0),
    "K_cs": (0.05, 0.0, 1.0),
    "w_s": (0.2, 0.02, 3.0),
    "K_m": (0.05, 0.0, 0.5),
    "K_e": (0.05, 0.0, 0.5),
}
NOISE = 1e-3  # rad, of the encoder
INTERVAL = 0.016  # s
EQUAL = 1.01  # times the best error counts as equal


@dataclass(frozen=True)
class Fit:
    """A search: what it is called, wall time in s and rollouts until the error was as good, the error."""

    name: str
    seconds: float
    rollouts: int
    error: float
    reached: bool


def references(t: np.ndarray) -> list[np.ndarray]:
    """Return (N,) reference angles in rad, alike to those of the public logs."""
    lift = np.interp(t, [0.0, 2.0, 4.0, 6.0], [0.0, 1.5, 0.0, -1.0])
    up_and_down = np.interp(t, [0.0, 1.0, 2.0, 3.5, 4.5, 6.0], [0.0, 0.8, 0.4, 1.6, 0.2, 0.0])
    return [1.0 * np.sin(2.0 * t) + 0.4 * np.sin(5.0 * t), lift, up_and_down, 1.2 * np.sin(0.6 * t**2)]


def measure(*, limit: float = 60.0, logs: int = 4) -> list[Fit]:
    """Run both searches; CMA-ES stops at the error of the least squares or at the time limit."""
    fmu = load_fmu(ROOT / "build" / "fmus" / "PositionDriven.fmu")
    t = INTERVAL * np.arange(376)
    rng = np.random.default_rng(0)
    setting = {name: f"friction.{name}" for name in TRUTH}
    true = {setting[n]: v for n, v in TRUTH.items()}
    cases, rollouts = [], 0
    for k, q in enumerate(references(t)[:logs]):
        for mass in (1.0, 3.0):
            task = Task(t, {"q_ref": q, "enable": np.ones(len(t))}, ("q",), {"m": mass}, tolerance=1e-5)
            y = fmu.simulate(task, true) + rng.normal(0.0, NOISE, (1, len(t)))
            cases.append(
                measured_case(f"{k}_{mass:g}", fmu, task, {"q": y[0]}, sigma={"q": NOISE}, parameters=setting)
            )

    def count(jobs: Sequence[Job]) -> list[Outcome]:
        nonlocal rollouts
        rollouts += len(jobs)
        return in_process(jobs)

    specs = [ParameterSpec(name, *values) for name, values in BOUNDS.items()]
    problem = Problem(cases, specs, runner=count)

    def error_at(x: np.ndarray) -> float:
        evaluation = problem.evaluate(x)
        return NOISE * float(np.mean(np.abs(evaluation.residuals))) if evaluation.ok else np.inf

    begun = time.perf_counter()
    search = Search(problem)
    make("auto", {}, problem)[0].solve(search, problem.space.start)
    assert search.best is not None
    fits = [Fit("fmuid, least squares", time.perf_counter() - begun, rollouts, error_at(search.best.x), True)]

    lower, upper = problem.space.lower, problem.space.upper
    target, rollouts, begun, best = EQUAL * fits[0].error, 0, time.perf_counter(), np.inf
    start = (problem.space.start - lower) / (upper - lower)
    strategy = cma.CMAEvolutionStrategy(start, 0.2, {"bounds": [0.0, 1.0], "seed": 1, "verbose": -9})
    while best > target and time.perf_counter() - begun < limit:
        points = strategy.ask()
        errors = [error_at(lower + np.asarray(p) * (upper - lower)) for p in points]
        strategy.tell(points, errors)
        best = min(best, *errors)
    seconds = time.perf_counter() - begun
    return [*fits, Fit("CMA-ES on the mean absolute error", seconds, rollouts, best, best <= target)]


def page(fits: Sequence[Fit]) -> str:
    """Return the table."""
    rows = []
    for f in fits:
        note, least = ("", "") if f.reached else (" (stopped there)", "at least ")
        times = f"{least}{f.seconds / fits[0].seconds:.3g}"
        rows.append([f.name, f"{f.seconds:.3g}{note}", str(f.rollouts), f"{1e3 * f.error:.4f}", times])
    return table(["search", "wall time (s)", "rollouts", "mean absolute error (mrad)", "times fmuid's"], rows)
