"""Starts at 0, parameters without effect, and estimates that are close to a bound in units of their errors."""

import itertools

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Status, Task, identify, measured_case
from fmuid.core.errors import ProblemError
from fmuid.identification.result import at_bound
from tests.identification.test_held import LEVEL, campaign, line

TIME = np.linspace(0.0, 1.0, 101)
NOISE = 1e-3 * np.random.default_rng(0).standard_normal(101)


def fitted(analytic, function, y, *specs, **options):
    model = analytic(function, [s.name for s in specs])
    case = measured_case("run", model, Task(TIME, {}, ("y",)), {"y": y + NOISE}, sigma={"y": 1e-3})
    return identify(Problem([case], list(specs)), **options).stages[0]


def decay(time, inputs, p):
    return {"y": np.exp(-1e6 * p["a"] * time) + p["b"]}


@pytest.mark.parametrize("solver", ["auto", "bobyqa"])
@pytest.mark.parametrize("bounds", [(), (0.0, 1e3)])
def test_a_start_of_zero_finds_a_value_of_a_millionth_with_its_interval(analytic, solver, bounds):
    y = np.exp(-0.3 * TIME) + 0.1
    stage = fitted(analytic, decay, y, ParameterSpec("a", 0.0, *bounds), ParameterSpec("b", 0.0), solver=solver)
    assert stage.status is Status.CONVERGED
    for name, truth in (("a", 3e-7), ("b", 0.1)):
        low, high = stage[name].interval
        assert low < truth < high
        assert high - low < 0.02 * truth


@pytest.mark.parametrize("solver", ["auto", "trf", "dfols", "bobyqa", "sbplx", "cobyla"])
def test_parameters_without_effect_are_reported_as_such(analytic, solver):
    constant = lambda time, inputs, p: {"y": 1.0 + 0.0 * (p["a"] + p["b"]) * time}  # noqa: E731
    stage = fitted(analytic, constant, 0.5, ParameterSpec("a", 1.0), ParameterSpec("b", 1.0), solver=solver)
    assert stage.status is Status.STALLED
    assert stage.message == "no free parameter changes a prediction"
    assert stage.parameters == {"a": 1.0, "b": 1.0}
    assert "a, b: no effect on any measured output" in stage.warnings


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_an_estimate_far_from_its_bounds_in_standard_errors_keeps_its_interval(analytic, scale):
    level = lambda time, inputs, p: {"y": p["a"] + 0.0 * time}  # noqa: E731
    stage = fitted(analytic, level, 0.788, ParameterSpec("a", 1.0, 1e-6, 1e4, scale=scale))
    low, high = stage["a"].interval
    assert stage["a"].at_bound is None
    assert low < 0.788 < high


def test_an_estimate_at_its_bound_has_none(analytic):
    level = lambda time, inputs, p: {"y": p["a"] + 0.0 * time}  # noqa: E731
    for solver in ("trf", "bobyqa", "nelder_mead"):
        stage = fitted(analytic, level, 0.788, ParameterSpec("a", 1.0, 0.9, 1e4, scale="log"), solver=solver)
        assert (stage["a"].at_bound, stage["a"].interval) == ("lower", None)


@pytest.mark.parametrize(
    ("value", "options", "side"),
    [
        (0.0501, {"error": 1e-3}, "lower"),  # a tenth of an error
        (0.0503, {"error": 1e-3}, None),
        (0.06, {"error": 1.0}, "lower"),  # of a thousandth of the range, however large the error
        (0.08, {"error": 1.0}, None),
        (0.05 * (1 + 1e-3), {"error": 1e-3, "log": True}, "lower"),
        (0.05 * (1 + 1e-2), {"error": 1e-3, "log": True}, None),
        (20.0, {}, "upper"),
        (19.99, {}, None),
    ],
)
def test_a_bound_is_judged_against_the_standard_error(value, options, side):
    assert at_bound(value, 0.05, 20.0, **options) == side


@pytest.mark.parametrize("noise", [0.5, 1e-6])
def test_a_model_that_draws_random_numbers_is_refused(analytic, noise):
    """Unless they are far below the noise of the measurements."""
    runs = itertools.count()

    def random(time, inputs, p):
        drawn = np.random.default_rng(next(runs)).standard_normal(time.size)
        return {"y": line(time, inputs, p)["y"] + noise * drawn}

    bench = {"bench": analytic(random, ["a", "b", "c", "load"])}
    if noise == 0.5:
        with pytest.raises(ProblemError, match=r"two equal simulations differ in y by up to .*random numbers"):
            identify(campaign(LEVEL), simulators=bench)
        posed = Problem.of_stage(campaign(LEVEL), campaign(LEVEL).stages["level"], bench, settled=False)
        with pytest.raises(ProblemError, match=r"two equal simulations differ in y by up to .*random numbers"):
            identify(posed)
    else:
        assert identify(campaign(LEVEL), simulators=bench)["a"].value == pytest.approx(2.0, abs=0.1)
