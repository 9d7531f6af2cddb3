"""Plants that run away open loop: recovered from segments whose initial states are projected out."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runaway import PENDULUM, TROLLEY, balanced, campaign, driven, pendulum_specs, trolley_specs

import fmu_build
import fmuid
from fmuid.core.errors import ProblemError, SimulationError
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.segments import segmented
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.segmented import Segmented
from fmuid.simulation.simulator import Simulator, Task
from tests.conftest import as_a_user_builds

MODELS = Path(__file__).parent / "models"


@pytest.fixture(scope="module")
def pendulum_fmu(tmp_path_factory):
    with as_a_user_builds():
        return fmu_build.build(MODELS / "InvertedPendulum.mo", "InvertedPendulum", tmp_path_factory.mktemp("x"))


@pytest.fixture(scope="module")
def trolley_fmu(tmp_path_factory):
    return fmu_build.build(MODELS / "Trolley.mo", "Trolley", tmp_path_factory.mktemp("trolley"))


@pytest.fixture(scope="module")
def pendulum_runs():
    return {f"run_{k}": balanced(k, duration=4.0) for k in range(2)}


@pytest.fixture(scope="module")
def trolley_runs():
    return {f"run_{k}": driven(k, drift=0.005) for k in range(3)}


def of_pendulum(fmu, runs, **stage):
    return campaign(fmu.parent, fmu, runs, ("tau", "N.m"), ("phi", "rad"), pendulum_specs(), 1e-3, **stage)


def of_trolley(fmu, runs, **stage):
    return campaign(fmu.parent, fmu, runs, ("f", "N"), ("s", "m"), trolley_specs(), 1e-3, **stage)


class Plain(Simulator):
    """An FMU without derivatives, as other tools' are."""

    variables = states = unsettable = None

    def __init__(self, fmu):
        self.fmu, self.variables, self.states, self.unsettable = fmu, fmu.variables, fmu.states, fmu.unsettable

    def simulate(self, task, parameters):
        assert not task.along
        return self.fmu.simulate(task, parameters)


def test_a_balanced_pendulum_is_recovered_from_segments_and_not_from_whole_runs(pendulum_fmu, pendulum_runs):
    whole = fmuid.identify(of_pendulum(pendulum_fmu, pendulum_runs), with_uncertainty=False)
    assert abs(whole["J"].value / PENDULUM["J"] - 1) > 0.2
    cut = of_pendulum(pendulum_fmu, pendulum_runs, segments=0.5)
    result = fmuid.identify(cut)
    for name, truth in PENDULUM.items():
        assert abs(result[name].value - truth) < 4 * result[name].standard_error
        assert abs(result[name].value / truth - 1) < 0.02
    score = fmuid.validate(result, cut)["run_1", "phi"]
    assert score.rmse == pytest.approx(1e-3, rel=0.1)


def test_drift_that_the_model_lacks_stays_within_its_segment(trolley_fmu, trolley_runs):
    whole = fmuid.identify(of_trolley(trolley_fmu, trolley_runs), with_uncertainty=False)
    cut = fmuid.identify(of_trolley(trolley_fmu, trolley_runs, segments="auto"))
    assert abs(whole["m"].value / TROLLEY["m"] - 1) > 0.1
    assert cut["m"].value == pytest.approx(TROLLEY["m"], rel=0.02)
    assert cut["d"].value == pytest.approx(TROLLEY["d"], rel=0.1)


def test_finite_differences_find_the_same(pendulum_fmu, pendulum_runs):
    cut = of_pendulum(pendulum_fmu, pendulum_runs, segments=0.4)
    exact = fmuid.identify(cut)
    differences = fmuid.identify(cut, simulators={"plant": Plain(load_fmu(pendulum_fmu))})
    for name in PENDULUM:
        assert differences[name].value == pytest.approx(exact[name].value, abs=0.05 * exact[name].standard_error)
        assert differences[name].standard_error == pytest.approx(exact[name].standard_error, rel=0.05)


def test_the_jacobian_is_that_of_refitted_states(pendulum_fmu, pendulum_runs):
    cut = of_pendulum(pendulum_fmu, pendulum_runs, segments=0.5)
    problem = Problem.of_stage(cut, cut.stages["all"], {"plant": load_fmu(pendulum_fmu)})
    x = problem.space.to_search(PENDULUM)
    jacobian = problem.exact.jacobian(problem.evaluate(x))
    for i in range(len(x)):
        ends = [problem.evaluate(x + sign * 1e-5 * np.eye(len(x))[i]).residuals for sign in (1, -1)]
        column = (ends[0] - ends[1]) / 2e-5
        # Kaufman's form leaves out what the residuals add: it vanishes with the noise.
        assert np.linalg.norm(jacobian[:, i] - column) < 1e-3 * np.linalg.norm(column)


def test_standard_errors_count_the_states(trolley_fmu):
    """Where noise is all there is, estimates scatter as their standard errors say."""
    scores = []
    for seed in range(6):
        runs = {f"run_{k}": driven(10 * seed + k, duration=6.0, drift=0.0) for k in range(1)}
        result = fmuid.identify(of_trolley(trolley_fmu, runs, segments=0.2))
        scores.append((result["m"].value - TROLLEY["m"]) / result["m"].standard_error)
        degrees = result.stages[0].uncertainty.degrees_of_freedom
        assert degrees is None or degrees < 300 - 60  # None: sigma was given
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.7


class Humped(Simulator):
    """Its output is highest where its state begins, so that a full step from there goes far beyond."""

    states, variables = ("x",), {}

    def simulate(self, task, parameters):
        x = parameters.get("x", 1.0 - 1e-5)
        values = {"x": x, "y": x / (1.0 + x**2)}
        return np.array([np.full(len(task.time), values[name]) for name in task.outputs])


def test_the_states_of_a_segment_are_found_from_where_they_hardly_show():
    time = np.arange(10.0)
    task, target = Task(time, {}, ("y",)), np.full((1, 10), 0.3)
    cut = Segmented(Humped(), task, np.inf, target, np.ones((1, 10)), at={})
    (x,) = cut.initial_states({})[0]
    assert x / (1.0 + x**2) == pytest.approx(0.3, abs=1e-4)


class Flattened(Simulator):
    """Its output depends the less on the state, the farther the state is from zero."""

    states, variables = ("x",), {}

    def simulate(self, task, parameters):
        x = parameters.get("x", 1.0) + 0.1 * task.time
        y = parameters["size"] * np.sqrt(np.abs(x))
        return np.array([{"x": x, "y": y}[name] for name in task.outputs])


def test_a_start_state_that_runs_away_is_a_failed_simulation():
    task = Task(np.arange(10.0), {}, ("y",))
    cut = Segmented(Flattened(), task, np.inf, np.full((1, 10), 2.0), np.ones((1, 10)), at={"size": 2.0})
    assert np.abs(cut.simulate(task, {"size": 2.0}) - 2.0).max() < 0.6
    with pytest.raises(SimulationError, match="'x' runs away"):
        cut.simulate(task, {"size": 2e-8})


class Fading(Simulator):
    """It forgets where it began at a rate; `simulated` counts samples."""

    states, variables = ("x",), {}
    simulated = 0

    def simulate(self, task, parameters):
        self.simulated += len(task.time)
        x = parameters.get("x", 0.0) * np.exp(-parameters.get("rate", 1.0) * task.time)
        return np.tile(x, (len(task.outputs), 1))


@pytest.mark.parametrize(("rate", "share"), [(1.0, 0.2), (0.9, 0.2), (0.1, 1.0)])
def test_states_are_fitted_to_the_samples_that_depend_on_them(rate, share):
    time, rng = np.arange(0.0, 100.0, 0.1), np.random.default_rng(0)
    truth = 2.0 * np.exp(-rate * time) + 0.1 * rng.standard_normal(len(time))
    model, task = Fading(), Task(time, {}, ("y",))
    cut = Segmented(model, task, np.inf, truth[None], np.ones((1, len(time))), at={})
    assert cut.segments == 1
    model.simulated = 0
    (x,) = cut.initial_states({"rate": rate})[0]
    response = np.exp(-rate * time)
    assert x == pytest.approx(response @ truth / (response @ response), abs=1e-3)  # 0.05 is its standard error
    assert (model.simulated < 3 * share * len(time)) == (share < 1.0)


def test_residuals_of_segments_count_at_least_one_by_one(trolley_fmu):
    """However coloured a segment's residuals are, another segment does not share them."""
    slow = {f"run_{k}": driven(k, drift=0.5) for k in range(3)}
    result = fmuid.identify(of_trolley(trolley_fmu, slow, segments=1.0))
    (stage,) = result.stages
    assert stage.uncertainty.degrees_of_freedom >= 3 * 4 - 2


def test_runs_near_a_point_begin_there_and_differ_by_what_the_states_follow(trolley_fmu, trolley_runs):
    cut = of_trolley(trolley_fmu, trolley_runs, segments=1.0)
    case = Problem.of_stage(cut, cut.stages["all"], {"plant": load_fmu(trolley_fmu)}).cases[0]
    segments, task = case.simulator, case.task
    nearby = {**TROLLEY, "m": 1.001 * TROLLEY["m"]}
    near = segments.from_states_at(segments, task, TROLLEY)
    here = segments.simulate(task, TROLLEY)
    np.testing.assert_array_equal(near.simulate(task, TROLLEY), here)
    followed, moved = segments.simulate(task, nearby) - here, near.simulate(task, nearby) - here
    by_states = segments.state_tangents(TROLLEY)[:, 0].T
    left = np.linalg.lstsq(by_states, (followed - moved)[0], rcond=None)[1]
    assert np.linalg.norm(moved - followed) > 0.1 * np.linalg.norm(moved)
    assert np.sqrt(left.sum()) < 1e-2 * np.linalg.norm(followed)
    assert near.token != segments.token


def test_a_model_without_states_is_refused(msd, analytic):
    with pytest.raises(ProblemError, match="no continuous states"):
        segmented(msd().cases[0], 0.5, {})


def test_the_check_says_why_a_run_cannot_be_simulated_open_loop(pendulum_fmu, pendulum_runs, trolley_fmu):
    from fmuid.identification.check import check_effects

    model = {"plant": load_fmu(pendulum_fmu)}
    findings, _ = check_effects(of_pendulum(pendulum_fmu, pendulum_runs), model)
    (finding,) = [f for f in findings if "open loop" in f.what]
    assert finding.level == "warning"
    assert "'phi'" in finding.what
    assert 'segments = "auto"' in finding.fix
    findings, _ = check_effects(of_pendulum(pendulum_fmu, pendulum_runs, segments=0.5), model)
    assert not [f for f in findings if "open loop" in f.what]
    quiet = {"run_0": driven(0, duration=4.0, drift=0.0)}
    findings, _ = check_effects(of_trolley(trolley_fmu, quiet), {"plant": load_fmu(trolley_fmu)})
    assert not [f for f in findings if "open loop" in f.what]


def test_segments_of_missing_samples_and_in_other_processes(pendulum_fmu, pendulum_runs):
    (time, torque, angle), *_ = pendulum_runs.values()
    angle = angle.copy()
    angle[300:500] = np.nan  # longer than a segment
    cut = of_pendulum(pendulum_fmu, {"run_0": (time, torque, angle)}, segments=0.25)
    problem = Problem.of_stage(cut, cut.stages["all"], {"plant": load_fmu(pendulum_fmu)})
    case = problem.cases[0]
    assert case.simulator.segments < 24
    values = case.start_values(problem.space.to_model(problem.space.start))
    here = case.simulator.simulate(case.task, values)
    there = pickle.loads(pickle.dumps(case.simulator)).simulate(case.task, values)
    np.testing.assert_array_equal(here, there)
    assert np.isfinite(here).all()
    states = case.simulator.initial_states(values)
    assert states.shape == (case.simulator.segments, 2)
    again = case.simulator.simulator.simulate(
        Task(time[:5], {"tau": torque[:5]}, ("phi",)), values | dict(zip(("phi", "w"), states[0], strict=True))
    )
    np.testing.assert_allclose(again[0], here[0, :5], rtol=1e-6)


def test_a_free_parameter_that_is_an_initial_state_is_refused(pendulum_fmu, pendulum_runs):
    cut = of_pendulum(pendulum_fmu, pendulum_runs, segments=0.5)
    spec = fmuid.ParameterSpec("phi", 0.1, -1.0, 1.0)
    stage = replace(cut.stages["all"], free=("phi",))
    cut = replace(cut, parameters={**cut.parameters, "phi": spec}, stages={"all": stage})
    with pytest.raises(ProblemError, match="initial state"):
        fmuid.identify(cut)


def test_an_observer_keeps_the_pendulum_at_its_measurement(pendulum_fmu, pendulum_runs):
    watched = of_pendulum(pendulum_fmu, pendulum_runs, observer=True)
    result = fmuid.identify(watched)
    for name, truth in PENDULUM.items():
        if name != "d":
            assert result[name].value == pytest.approx(truth, rel=0.03)
    assert {"observer[phi,phi]", "observer[w,phi]"} <= set(result.parameters)
    assert fmuid.validate(result, watched)["run_1", "phi"].rmse < 3e-3  # the start, which no sample corrects, too
    gain = {"phi": {"phi": 0.4}, "w": {"phi": 20.0}}
    given = fmuid.identify(of_pendulum(pendulum_fmu, pendulum_runs, observer=gain))
    assert given["J"].value == pytest.approx(PENDULUM["J"], rel=0.05)
    assert "observer[w,phi]" not in {e.name for e in given.estimates}


def test_an_observer_needs_outputs_that_the_model_has(pendulum_fmu, pendulum_runs):
    with pytest.raises(ProblemError, match="no gain from 'tau' to 'w'"):
        fmuid.identify(of_pendulum(pendulum_fmu, pendulum_runs, observer={"w": {"tau": 1.0}}))
