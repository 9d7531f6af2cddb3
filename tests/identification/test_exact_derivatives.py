"""Exact Jacobians of problems whose model differentiates its runs, through all that lies around a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Task, measured_case
from fmuid.core.campaign import CriterionSpec
from fmuid.core.errors import SimulationError
from fmuid.core.formulas import parse
from fmuid.core.units import Conversion
from fmuid.identification.problem.search_space import expanded
from fmuid.identification.solvers.least_squares import TrustRegion
from fmuid.identification.solvers.search import Search, Status
from fmuid.identification.uncertainty.confidence import uncertainty_of
from fmuid.simulation.runners import in_process

TIME = np.linspace(0.0, 2.0, 201)
DRIVE = np.sin(2 * np.pi * 1.5 * TIME) + 0.5 * np.sin(2 * np.pi * 4.0 * TIME)
PARAMETERS = ("gain", "lag", "level")


def lagged(time, inputs, p):
    """A drive behind a lag, and its level: smooth in all three parameters."""
    y = p["gain"] * (inputs["u"] * np.exp(-p["lag"] * time) + np.cos(p["lag"] * time)) + p["level"]
    return {"y": y, "z": y**2}


@pytest.fixture
def differentiating(analytic):
    class Differentiating(analytic):
        """Tells the derivatives of its runs as well, in the same run."""

        def differentiates(self, names):
            return set(names) <= set(PARAMETERS)

        def simulate(self, task, parameters):
            base = super().simulate(task, parameters)
            ends = [
                [
                    self.function(task.time, task.inputs, {**at, **{n: at[n] + h * w for n, w in along.items()}})
                    for h in (1e-5, -1e-5)
                ]
                for at in [dict(task.start_values) | dict(parameters)]
                for along in task.along
            ]
            return np.vstack([base, *([(a[n] - b[n]) / 2e-5 for n in task.outputs] for a, b in ends)])

    return Differentiating(lagged, PARAMETERS, ("y", "z"))


def posed(model):
    """Two runs; units, a nonlinear tie, a parameter of each run, sensors, and criteria of every kind."""
    truth = {"gain": 1.2, "lag": 0.6, "level": 0.4}
    cases = []
    for name, drive in (("one", DRIVE), ("two", DRIVE[::-1])):
        task = Task(TIME, {"u": drive}, ("y", "z"))
        measured = dict(zip(task.outputs, model.simulate(task, truth) + 0.01 * np.sin(40.0 * TIME), strict=True))
        measured["z"][::7] = np.nan
        case = measured_case(
            name,
            model,
            task,
            measured,
            sigma={"y": 0.1, "z": 0.2},
            criteria=[
                CriterionSpec("y"),
                CriterionSpec("y", "magnitude", weight=0.3, options={"frequencies": [1.5, 4.0]}),
                CriterionSpec("z", "error_vector", demand=0.5),
                CriterionSpec("z", "integral_squared", start_time=0.5),
                CriterionSpec("y", "maximum"),
            ],
        )
        sensors = ({"gain": "scale", "delay": "late / 10", "offset": "zero * scale"}, {"offset": "0.1"})
        channels = [
            replace(c, sensor={key: parse(text) for key, text in sensor.items()}, differentiated=differentiated)
            for c, sensor, differentiated in zip(case.channels, sensors, (False, True), strict=True)
        ]
        setting = {**case.setting, "lag": ("lag", Conversion(2.0, 0.1))}
        del setting["gain"]
        setting["strength"] = ("gain", Conversion())
        cases.append(replace(case, channels=tuple(channels), setting=setting))
    specs = [
        ParameterSpec("lag", 0.3, 0.01, 5.0, scale="log"),
        ParameterSpec("level", 0.5, 0.0, 5.0, per="experiment"),
        ParameterSpec("strength", 1.0, 0.0, 5.0),
        ParameterSpec("scale", 1.1, 0.5, 2.0),
        ParameterSpec("late", 0.237, 0.0, 1.0),
        ParameterSpec("zero", 0.0, -1.0, 1.0),
    ]
    free = ["lag", "level", "scale", "late", "zero"]
    return Problem(cases, expanded(specs, free, {}, {"strength": "sqrt(lag) + scale ** 2"}, ["one", "two"]))


def test_the_jacobian_goes_through_ties_units_sensors_and_criteria(differentiating):
    problem = posed(differentiating)
    here = problem.evaluate(problem.space.start)
    differentiating.count = 0
    exact = problem.exact.jacobian(here)
    assert differentiating.count == 2
    assert exact.shape == (len(here.residuals), 6)
    steps = 1e-5 * np.eye(6)
    ends = [problem.evaluate_many(list(here.x + sign * steps)) for sign in (1.0, -1.0)]
    finite = np.column_stack([(a.residuals - b.residuals) / 2e-5 for a, b in zip(*ends, strict=True)])
    assert np.all(np.linalg.norm(finite, axis=0) > 1.0)
    assert exact == pytest.approx(finite, rel=1e-5, abs=1e-5)


def test_a_differentiated_evaluation_is_one_run_with_the_same_prediction(differentiating):
    problem, other = posed(differentiating), posed(differentiating)
    x = problem.space.start + 0.01
    expected = other.evaluate(x)
    differentiating.count = 0
    here, plain = problem.evaluate_many([x, x + 0.01], differentiated=[True, False])
    jacobian = problem.exact.jacobian(here)
    assert differentiating.count == 4
    assert np.array_equal(here.residuals, expected.residuals)
    assert np.array_equal(jacobian, other.exact.jacobian(expected))
    assert plain.cost != here.cost


def test_trials_bring_their_jacobians_and_noise_is_measured_when_the_cost_stops_falling(differentiating):
    task, truth = Task(TIME, {"u": DRIVE}, ("y",)), {"gain": 1.2, "lag": 0.6, "level": 0.4}
    measured = differentiating.simulate(task, truth)[0] + np.random.default_rng(0).normal(0.0, 0.05, TIME.size)
    specs = [
        ParameterSpec(name, start, 0.01, 5.0) for name, start in zip(PARAMETERS, (0.8, 0.3, 0.1), strict=True)
    ]
    jobs, purposes = [], []
    problem = Problem([measured_case("run", differentiating, task, {"y": measured}, sigma={"y": 0.05})], specs)
    problem.runner = lambda asked: jobs.extend(asked) or in_process(asked)
    search = Search(problem, record=lambda _, purpose, __: purposes.append(purpose))
    search.evaluate(problem.space.start, differentiated=True)
    assert TrustRegion().solve(search, problem.space.start).status is Status.CONVERGED
    assert search.best.parameters == pytest.approx(truth, rel=0.05)
    falling = purposes.index("derivative")
    assert falling >= 4
    assert all(task.along for _, task, _ in jobs[:falling])  # these trials tell their Jacobians as well
    assert purposes.count("derivative") == 6
    assert len(jobs) <= search.evaluations + 2  # the last two ask for them only where they are needed
    simulated = len(jobs)
    uncertainty = uncertainty_of(problem, search.best, floor=search.noise_floor)
    assert len(jobs) == simulated
    for name, error in zip(uncertainty.names, uncertainty.standard_errors, strict=True):
        assert abs(search.best.parameters[name] - truth[name]) < 4.0 * error


def test_a_refused_jacobian_is_asked_for_once(differentiating, monkeypatch):
    problem, simulate = posed(differentiating), differentiating.simulate
    here, asked = problem.evaluate(problem.space.start), []

    def refusing(self, task, parameters):
        if task.along:
            asked.append(task)
            raise SimulationError("the sensitivities are not defined")
        return simulate(task, parameters)

    monkeypatch.setattr(type(differentiating), "simulate", refusing)
    assert problem.exact.jacobian(here) is None
    refused = len(asked)
    assert refused > 0
    assert problem.exact.jacobian(here) is None
    assert len(asked) == refused
