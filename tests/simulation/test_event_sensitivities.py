"""Identification of models with events: exact Jacobians, and finite differences where there are none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from fmu_build import build as build_modelica
from fmuid.core.campaign import CriterionSpec, ParameterSpec
from fmuid.core.errors import SimulationError
from fmuid.identification.problem.cases import measured_case
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.search_space import expanded
from fmuid.identification.solvers.least_squares import TrustRegion
from fmuid.identification.solvers.search import Search, Status
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.runners import Job, Outcome, in_process
from fmuid.simulation.simulator import Task

JUMPS = Path(__file__).parents[1] / "fmu_runtime" / "models" / "Jumps.mo"


def _search(
    path: Path, time: np.ndarray, output: str, truth: Mapping[str, float], start: Mapping[str, float]
) -> tuple[Search, list[tuple[Job, Outcome]]]:
    """A search for the parameters of a noisy run, and what it simulates."""
    fmu, task = Fmu(path), Task(time, {}, (output,), tolerance=1e-8)
    noise = np.random.default_rng(2).normal(0.0, 0.02, time.size)
    measured = {output: fmu.simulate(task, truth)[0] + noise}
    case = measured_case("run", fmu, task, measured, sigma={output: 0.02}, criteria=(CriterionSpec(output),))
    specs = [ParameterSpec(name, value, 0.5 * value, 2.0 * value) for name, value in start.items()]
    problem, simulated = Problem([case], expanded(specs, list(start), {}, {}, ["run"])), []

    def run(jobs: Sequence[Job]) -> list[Outcome]:
        outcomes = in_process(jobs)
        simulated.extend(zip(jobs, outcomes, strict=True))
        return outcomes

    problem.runner = run
    return Search(problem), simulated


def test_an_identification_takes_exact_jacobians_across_events(tmp_path, monkeypatch):
    """A temperature over three switchings of its heating."""
    path, ends = build_modelica(JUMPS, "Jumps.Thermostat", tmp_path), []
    truth = {"low": 18.3, "high": 21.6, "tau": 1.8, "power": 13.0}
    start = {"low": 18.0, "high": 22.0, "tau": 2.0, "power": 12.5}
    for exact in (True, False):
        if not exact:
            monkeypatch.setattr(Fmu, "differentiates", lambda *_: False)
        search, simulated = _search(path, np.linspace(0.0, 4.0, 401), "T", truth, start)
        assert TrustRegion().solve(search, search.problem.space.start).status is Status.CONVERGED
        ends.append(search.best)
        assert any(task.along for (_, task, _), _ in simulated) is exact
    best, other = ends
    assert best.parameters == pytest.approx({**best.parameters, **truth}, rel=3e-3)
    assert best.cost <= other.cost
    assert best.cost == pytest.approx(401, rel=0.1)


def test_differences_stand_in_where_a_derivative_is_not_defined(tmp_path):
    """At the start two events coincide whose times depend on different parameters."""
    path = build_modelica(JUMPS, "Jumps.Crossing", tmp_path)
    truth, start = {"T": 0.43, "level": 0.58}, {"T": 0.5, "level": 0.5}
    search, simulated = _search(path, np.linspace(0.0, 1.0, 401), "s", truth, start)
    assert TrustRegion().solve(search, search.problem.space.start).status is Status.CONVERGED
    refused = [isinstance(outcome, SimulationError) for (_, task, _), outcome in simulated if task.along]
    assert refused[0]
    assert not refused[-1]
    assert search.best.parameters == pytest.approx({**search.best.parameters, **truth}, rel=5e-2)
