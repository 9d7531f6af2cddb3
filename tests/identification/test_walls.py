"""Searches among candidates that cannot be simulated: along the wall, and never *converged* against it."""

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Status, StopRules, Task, identify, measured_case

TIME = np.linspace(0.0, 2.0, 201)
SIGMA = 0.01
BEYOND = {
    "straight": lambda p: p["k"] > 2.6,
    "oblique": lambda p: p["k"] + p["T"] > 2.9,
    "close": lambda p: p["k"] - p["T"] > 2.25,
    "curved": lambda p: p["k"] > 2.9 or (p["k"] > 1.5 and p["k"] * p["T"] < 0.74),
}
HIDING = {
    "straight": lambda p: p["k"] > 2.4,
    "oblique": lambda p: p["k"] - 5.0 * p["T"] > 0.9,
    "curved": lambda p: p["k"] / p["T"] > 8.0,
}


@pytest.fixture
def lag(analytic):
    """A first-order lag, k = 2.5 and T = 0.3, that cannot be simulated beyond a wall."""

    def of(beyond):
        def response(time, inputs, p):
            return None if beyond(p) else {"y": p["k"] * (1.0 - np.exp(-time / p["T"]))}

        noise = SIGMA * np.random.default_rng(0).standard_normal(TIME.size)
        y = 2.5 * (1.0 - np.exp(-TIME / 0.3)) + noise
        case = measured_case(
            "step", analytic(response, ["k", "T"]), Task(TIME, {}, ("y",)), {"y": y}, sigma={"y": SIGMA}
        )
        return Problem([case], [ParameterSpec("k", 1.0, 0.1, 10.0), ParameterSpec("T", 1.0, 0.01, 10.0)])

    return of


@pytest.mark.parametrize("solver", ["trf", "dfols", "bobyqa", "sbplx", "nelder_mead", "cobyla"])
@pytest.mark.parametrize("wall", BEYOND)
def test_a_search_moves_along_a_wall_to_the_truth(lag, wall, solver):
    stage = identify(lag(BEYOND[wall]), solver=solver, with_uncertainty=False).stages[0]
    assert stage.status is Status.CONVERGED
    assert (stage["k"].value, stage["T"].value) == pytest.approx((2.5, 0.3), rel=0.01)


@pytest.mark.parametrize(
    "solver", ["trf", "bobyqa", "sbplx", "nelder_mead", "cobyla", "pattern_search", "crs2 > trf"]
)
@pytest.mark.parametrize(("wall", "best"), [("straight", 9656.0), ("oblique", 2005.0), ("curved", 836.6)])
def test_against_a_wall_no_search_has_converged(lag, wall, best, solver):
    stage = identify(lag(HIDING[wall]), solver=solver).stages[0]
    assert stage.status is Status.STALLED
    assert stage.cost == pytest.approx(best, rel=0.01)  # along the wall to its best point
    assert "at the edge of what can be simulated" in stage.message
    assert "the integrator gave up" in stage.message
    warnings = "\n".join(stage.warnings)
    assert "the estimate lies at the edge of what can be simulated" in warnings
    assert "candidates could not be simulated: step: the integrator gave up" in warnings
    assert all(e.interval is None for e in stage.estimates)


@pytest.mark.parametrize("solver", ["bobyqa", "sbplx"])
def test_a_search_whose_budget_ends_at_a_wall_says_so(lag, solver):
    for wall, beside in (("straight", True), ("curved", False)):
        problem = lag(HIDING[wall] if beside else BEYOND[wall])
        stage = identify(problem, solver=solver, stop=StopRules(evaluations=90), with_uncertainty=False).stages[0]
        assert stage.status is Status.BUDGET
        assert stage.failures > 0
        assert any("at the edge of what can be simulated" in w for w in stage.warnings) == beside
