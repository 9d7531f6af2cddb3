"""The Pareto front on problems whose front is known."""

import numpy as np
import pytest

from fmuid import (
    AnalysisSpec,
    CriterionSpec,
    ParameterSpec,
    ParetoSpec,
    Problem,
    Result,
    Status,
    StopRules,
    Task,
    identify,
    measured_case,
)
from fmuid.core.errors import ProblemError
from fmuid.identification.problem.combination import Combination, Constraint


def problem(analytic, function, names, signals, **options):
    """Objectives of parameters: each signal of `function` is one, to be brought to 0."""
    task = Task(np.arange(2.0), {}, signals)
    zeros = {s: np.zeros(2) for s in signals}
    criteria = [CriterionSpec(s, "error_vector") for s in signals]
    case = measured_case("front", analytic(function, names, signals), task, zeros, criteria=criteria)
    specs = [ParameterSpec(n, 0.3, -4.0, 4.0) for n in names]
    return Problem([case], specs, combination=Combination("min_max"), **options)


def fonseca(time, inputs, p):
    """Fonseca and Fleming (1995): a concave front, which no weighted sum finds."""
    x = np.array([p["a"], p["b"]])
    return {"f": 1 - np.exp(-np.sum((x - 0.5**0.5) ** 2)), "g": 1 - np.exp(-np.sum((x + 0.5**0.5) ** 2))}


def on_fonsecas_front(f):
    return 1 - np.exp(-((2 - np.sqrt(-np.log(1 - f))) ** 2))


FRONT = AnalysisSpec(pareto=ParetoSpec(points=9))


def test_a_concave_front_is_found_evenly(analytic, tmp_path):
    result = identify(problem(analytic, fonseca, "ab", ("f", "g")), analyses=FRONT, out=tmp_path)
    stage = Result.from_json(tmp_path).stages[0]
    assert stage == result.stages[0]
    front = stage.front
    assert front.objectives == ("f error_vector", "g error_vector")
    assert front.message.startswith("complete, 9 points")
    f, g = np.array([p.values for p in front.points]).T
    np.testing.assert_allclose(g, on_fonsecas_front(f), atol=2e-3)
    assert f[0] < 0.01
    assert f[-1] > 0.97
    assert np.max(np.diff(f)) < 0.25
    a, b = np.array([(p.parameters["a"], p.parameters["b"]) for p in front.points]).T
    np.testing.assert_allclose(a, b, atol=0.03)
    # The estimate is the stage's own: the least of the worst objective, also on the front.
    assert front.chosen[0] == pytest.approx(1 - np.exp(-1), abs=1e-3)
    assert front.chosen[1] == pytest.approx(on_fonsecas_front(front.chosen[0]), abs=1e-3)
    assert "Pareto front: complete" in str(stage)


def test_three_objectives_fill_the_triangle_between_their_optima(analytic):
    corners = {"f": (0.0, 0.0), "g": (2.0, 0.0), "h": (1.0, 3**0.5)}
    distances = lambda t, u, p: {n: np.hypot(p["a"] - x, p["b"] - y) for n, (x, y) in corners.items()}  # noqa: E731
    spec = AnalysisSpec(pareto=ParetoSpec(points=4))
    front = identify(problem(analytic, distances, "ab", ("f", "g", "h")), analyses=spec).stages[0].front
    points = np.array([(1.0, p.parameters["a"], p.parameters["b"]) for p in front.points])
    shares = np.linalg.solve(np.vstack([np.ones(3), np.array(list(corners.values())).T]), points.T)
    assert len(points) == 10
    assert np.min(shares) > -0.02
    assert np.all(np.max(shares, axis=1) > 0.97)  # every corner
    assert np.any(np.min(shares, axis=0) > 0.15)  # and inside


def test_constraints_hold_on_the_front(analytic):
    limit = Constraint.from_mapping({"expression": "a", "max": 0.2})
    front = (
        identify(problem(analytic, fonseca, "ab", ("f", "g"), constraints=[limit]), analyses=FRONT).stages[0].front
    )
    assert max(p.parameters["a"] for p in front.points) == pytest.approx(0.2, abs=1e-3)


def test_objectives_that_agree_have_one_best_point(analytic):
    same = lambda t, u, p: {"f": p["a"] - 1, "g": 3 * (p["a"] - 1)}  # noqa: E731
    front = identify(problem(analytic, same, "a", ("f", "g")), analyses=FRONT).stages[0].front
    assert all(p.parameters["a"] == pytest.approx(1.0, abs=1e-3) for p in front.points)
    assert len(front.points) <= 2


def test_a_budget_leaves_a_part_of_the_front_and_says_so(analytic):
    asked = problem(analytic, fonseca, "ab", ("f", "g"))
    stage = identify(asked, analyses=FRONT, stop=StopRules(evaluations=400)).stages[0]
    assert stage.front.message.startswith("incomplete (400 evaluations)")
    assert 2 <= len(stage.front.points) < 9


def test_a_front_that_beats_the_estimate_is_a_warning(analytic):
    aside = lambda time, inputs, p: fonseca(time, inputs, {"a": p["a"], "b": p["b"] + 1})  # noqa: E731
    asked = problem(analytic, aside, "ab", ("f", "g"))
    stage = identify(asked, solver="sbplx", options={"evaluations": 3}, analyses=FRONT).stages[0]
    assert any(w.startswith("a point of the front is better than the estimate") for w in stage.warnings)
    whole = identify(problem(analytic, fonseca, "ab", ("f", "g")), analyses=FRONT).stages[0]
    assert not any("beats" in w for w in whole.warnings)


def test_an_interrupted_front_goes_on_exactly(analytic, tmp_path):
    whole = identify(problem(analytic, fonseca, "ab", ("f", "g")), analyses=FRONT).stages[0]

    calls = 0

    def pressed(time, inputs, p):
        nonlocal calls
        calls += 1
        if calls == whole.evaluations + 200:
            raise KeyboardInterrupt
        return fonseca(time, inputs, p)

    stopped = identify(problem(analytic, pressed, "ab", ("f", "g")), analyses=FRONT, out=tmp_path)
    assert stopped.status is Status.INTERRUPTED
    again = problem(analytic, fonseca, "ab", ("f", "g"))
    resumed = identify(again, analyses=FRONT, out=tmp_path, resume=True).stages[0]
    assert resumed.front == whole.front
    assert again.cases[0].simulator.count < whole.front.evaluations - 150


@pytest.mark.parametrize(
    ("objectives", "message"),
    [
        (("f*",), "needs at least two objectives"),
        (("f*", "h*"), r"no criterion matches the objective 'h\*'; there are: front: f"),
    ],
)
def test_objectives_that_cannot_be_are_refused_before_the_search(analytic, objectives, message):
    asked = problem(analytic, fonseca, "ab", ("f", "g"))
    with pytest.raises(ProblemError, match=message):
        identify(asked, analyses=AnalysisSpec(pareto=ParetoSpec(objectives)))
    assert asked.cases[0].simulator.count == 0
