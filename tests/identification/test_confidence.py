"""Covariances, their degrees of freedom and where they are widened, on problems worked out by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2
from scipy.stats import t as student

from fmuid import CriterionSpec, ParameterSpec, Problem, Task, measured_case, uncertainty_of
from fmuid.identification.problem.derivatives import NoiseFloor
from fmuid.identification.uncertainty import confidence
from fmuid.identification.uncertainty.confidence import with_held, without_intervals
from fmuid.identification.uncertainty.inherited import Held


def level(time, inputs, p):
    return {"y": p["a"] + 0.0 * time}


def line(time, inputs, p):
    return {"y": p["a"] + p["b"] * time}


@pytest.fixture
def uncertainty(analytic):
    """The uncertainty of an estimate; samples are one second apart, in each of several like cases."""

    def of(function, y, estimate, *, sigma=None, criteria=(), cases=1, starts=None):
        y = np.reshape(y, (cases, -1))
        task = Task(np.arange(float(y.shape[1])), {}, ("y",))
        model = analytic(function, list(estimate))
        given = {"y": sigma} if sigma else None
        measured = [
            measured_case(f"run{k}", model, task, {"y": row}, sigma=given, criteria=criteria)
            for k, row in enumerate(y)
        ]
        problem = Problem(measured, [ParameterSpec(n, (starts or {}).get(n, 1.0)) for n in estimate])
        return uncertainty_of(problem, problem.evaluate(problem.space.to_search(estimate)))

    return of


ONES = {"a": 1.0, "b": 1.0}
WHITE = np.array([1.0, 1.0, -1.0, -1.0, 0.0])  # autocorrelations within scatter


def test_five_white_samples_of_a_level_have_four_degrees_of_freedom(uncertainty):
    got = uncertainty(level, 2.0 + 0.1 * WHITE, {"a": 2.0})
    error = 0.1 * np.std(WHITE, ddof=1) / np.sqrt(5)
    assert got.standard_errors == pytest.approx([error], rel=1e-6)
    assert got.naive_errors == pytest.approx([error], rel=1e-6)
    assert (got.degrees_of_freedom, *got.degrees) == pytest.approx((4.0, 4.0))
    reach = student(4).ppf(0.975) * error
    assert got.intervals[0] == pytest.approx((2.0 - reach, 2.0 + reach), rel=1e-6)
    assert got.inherited_shares == (0.0,)
    assert (got.held, got.inherited, got.held_slopes, got.notes) == ((), (), ((),), ())


def test_what_is_estimated_on_the_side_takes_a_degree_of_freedom(uncertainty, monkeypatch):
    """For example the state that a segment begins with."""
    monkeypatch.setattr(Problem, "nuisances", 1)
    got = uncertainty(level, 2.0 + 0.1 * WHITE, {"a": 2.0})
    assert got.degrees_of_freedom == pytest.approx(3.0)
    assert got.standard_errors == pytest.approx([0.1 * np.sqrt(4 / 3) / np.sqrt(5)], rel=1e-6)


def test_three_samples_of_a_line_have_one_degree_of_freedom(uncertainty):
    got = uncertainty(line, [2.0 + 0.1, 4.0 - 0.2, 6.0 + 0.1], {"a": 2.0, "b": 2.0})
    assert got.degrees_of_freedom == 1.0
    assert got.notes == ()
    assert got.naive_errors == pytest.approx(np.sqrt([0.06 * 5 / 6, 0.06 / 2]), rel=1e-6)
    (low, high), error = got.intervals[1], got.standard_errors[1]
    assert high - low == pytest.approx(2.0 * student(1).ppf(0.975) * error, rel=1e-6)


def test_three_samples_that_scatter_more_than_the_parameters_are_large_determine_none_in_practice(uncertainty):
    got = uncertainty(line, [2.0 + 10.0, 4.0 - 20.0, 6.0 + 10.0], {"a": 2.0, "b": 2.0})
    assert got.identifiability.undetermined == ("a", "b")
    assert got.intervals == (None, None)


def test_two_samples_of_a_line_say_how_its_errors_go_together_and_not_how_large_they_are(uncertainty):
    got = uncertainty(line, [1.0, 1.5], {"a": 1.0, "b": 0.5})
    assert (got.standard_errors, got.intervals, got.naive_errors) == ((None, None),) * 3
    assert (got.degrees_of_freedom, got.degrees) == (0.0, (0.0, 0.0))
    assert got.identifiability.complete
    assert np.array(got.correlation) == pytest.approx(np.array([[1.0, -np.sqrt(0.5)], [-np.sqrt(0.5), 1.0]]))
    (note,) = got.notes
    assert note.startswith("no standard errors: 2 residuals for 2 parameters say nothing")
    nearly_alike = uncertainty(
        lambda time, inputs, p: {"y": p["a"] + p["b"] * (1.0 + 1e-4 * time)}, [2.0, 2.0001], ONES
    )
    assert nearly_alike.identifiability.complete  # of noise that is unknown


def test_a_slow_residual_has_at_least_one_degree_of_freedom(uncertainty):
    got = uncertainty(level, 2.0 + np.linspace(-0.1, 0.1, 30), {"a": 2.0})
    assert got.whiteness[0].effective < 2.0
    assert got.degrees_of_freedom == 1.0


def test_segments_are_so_many_independent_samples(uncertainty, monkeypatch):
    """Twenty of them, each with half a state of its own, and one parameter."""
    monkeypatch.setattr(Problem, "segments", 20)
    monkeypatch.setattr(Problem, "nuisances", 10)
    got = uncertainty(level, 2.0 + np.linspace(-0.1, 0.1, 30), {"a": 2.0})
    assert got.degrees_of_freedom == 19.0


def test_residuals_that_are_slow_but_small_do_not_make_a_given_sigma_smaller(uncertainty):
    slow = np.sin(2 * np.pi * np.arange(60) / 60)
    got = uncertainty(level, 2.0 + 0.01 * slow, {"a": 2.0}, sigma=0.1)
    assert got.degrees_of_freedom is not None  # their colour contradicts it
    assert got.standard_errors == pytest.approx([0.1 / np.sqrt(60)], rel=1e-6)


def test_two_samples_of_a_line_whose_noise_one_repeat_told_have_errors(uncertainty, monkeypatch):
    monkeypatch.setattr(confidence, "_noise", lambda _: (np.full(2, 0.1), 1.0))
    got = uncertainty(line, [1.0, 1.5], {"a": 1.0, "b": 0.5})
    assert got.degrees_of_freedom == 1.0
    size = 0.1 * 0.25  # residuals are in units of the samples' standard deviation
    assert got.standard_errors == pytest.approx([size, size * np.sqrt(2.0)], rel=1e-5)


@pytest.mark.parametrize("forgotten", [{"predictions": ()}, {"residuals": np.zeros(0)}])
def test_an_estimate_of_which_a_resumed_run_remembers_a_part_is_evaluated_again(analytic, forgotten):
    case = measured_case("run", analytic(level, ["a"]), Task(np.arange(5.0), {}, ("y",)), {"y": 2.0 + 0.1 * WHITE})
    problem = Problem([case], [ParameterSpec("a", 1.0)])
    best = problem.evaluate(np.array([2.0]))
    again = uncertainty_of(problem, replace(best, **forgotten))
    assert again.standard_errors == uncertainty_of(problem, best).standard_errors


def test_a_direction_that_counts_a_ten_thousandth_is_still_determined(uncertainty):
    def alike(time, inputs, p):
        return {"y": p["a"] + p["b"] * (1.0 + 1e-4 * time)}

    sigma = 1e-7
    y = 1.0 + (1.0 + 1e-4 * np.arange(5.0)) + sigma * np.array([1.0, -0.5, -1.0, -0.5, 1.0])
    got = uncertainty(alike, y, {"a": 1.0, "b": 1.0}, sigma=sigma)
    assert got.identifiability.complete
    assert got.standard_errors[1] == pytest.approx(sigma / (1e-4 * np.sqrt(10.0)), rel=1e-3)


def test_a_curved_model_of_a_simulator_that_scatters_has_the_slope_at_its_estimate(analytic):
    """Steps are a tenth then: a difference to one side would be off by some percent."""
    model = analytic(lambda time, inputs, p: {"y": p["a"] ** 2 + 0.0 * time}, ["a"])
    case = measured_case(
        "run", model, Task(np.arange(5.0), {}, ("y",)), {"y": 1.0 + 0.1 * WHITE}, sigma={"y": 0.1}
    )
    problem = Problem([case], [ParameterSpec("a", 1.0)])
    best = problem.evaluate(np.array([1.0]))
    got = uncertainty_of(problem, best, floor=NoiseFloor(0.01, 10.0, ()))
    assert got.standard_errors == pytest.approx([0.1 / np.sqrt(5) / 2.0], rel=1e-9)
    assert got.noise_floor == 0.01


@pytest.mark.parametrize(("p_value", "believed"), [(0.0051, True), (0.0049, False)])
def test_a_sigma_is_believed_unless_one_of_two_tests_contradicts_it_at_half_a_percent(
    uncertainty, p_value, believed
):
    """Residuals may be too large, or coloured: at 1 % together."""
    size = 0.1 * np.sqrt(chi2(4).isf(p_value) / 4.0)  # four of the five samples are off by that
    got = uncertainty(
        level, 2.0 + size * WHITE, {"a": 2.0}, sigma=0.1, criteria=[CriterionSpec("y", weight=4.0, demand=2.0)]
    )
    by_sigma, by_scatter = 0.1 / np.sqrt(5), size / np.sqrt(5)
    assert got.standard_errors == pytest.approx([by_sigma if believed else by_scatter], rel=1e-6)
    assert got.degrees_of_freedom == (None if believed else pytest.approx(4.0))


def test_what_is_only_judged_says_nothing_of_the_noise(uncertainty):
    criteria = [CriterionSpec("y"), CriterionSpec("y", "steady_state", weight=0.0)]
    got = uncertainty(level, 2.0 + 0.1 * WHITE, {"a": 2.0}, sigma=0.1, criteria=criteria)
    assert got.degrees_of_freedom is None
    assert got.standard_errors == pytest.approx([0.1 / np.sqrt(5)], rel=1e-6)


def test_features_count_one_by_one(uncertainty):
    ends = np.array([1.0, 2.0, 6.0, 7.0])
    got = uncertainty(
        level, np.repeat(ends, 5), {"a": 4.0}, criteria=[CriterionSpec("y", "steady_state")], cases=len(ends)
    )
    assert got.degrees_of_freedom == 3.0
    assert got.standard_errors == pytest.approx([np.std(ends, ddof=1) / 2.0], rel=1e-6)


def test_a_parameter_of_which_less_is_known_than_its_size_is_undetermined_in_practice(uncertainty):
    for sigma, undetermined in ((1.0, ()), (30.0, ("a",))):
        got = uncertainty(level, 3.0 + sigma * WHITE, {"a": 3.0}, sigma=sigma, starts={"a": 2.0})
        assert got.identifiability.undetermined == undetermined
        assert (got.intervals[0] is None) == bool(undetermined)


def test_errors_of_unlike_size_are_both_told(uncertainty):
    """One parameter is known a million times as well as the other, in units of their starts."""

    def both(time, inputs, p):
        return {"y": np.where(time < 3.0, 1e6 * p["a"], p["b"])}

    y = np.array([1e6] * 3 + [1.0] * 3) + 0.1 * np.array([1, -1, 0, 0, 1, -1])
    got = uncertainty(both, y, {"a": 1.0, "b": 1.0}, sigma=0.1)
    assert got.standard_errors == pytest.approx([1e-7 / np.sqrt(3), 0.1 / np.sqrt(3)], rel=1e-5)
    assert got.identifiability.complete


def test_what_affects_nothing_is_not_said_to_be_at_a_constraint(uncertainty):
    def spare(time, inputs, p):
        return {"y": p["a"] + 0.0 * p["d"] * time}

    got = uncertainty(spare, 2.0 + 0.1 * WHITE, {"a": 2.0, "d": 1.0}, sigma=0.1)
    assert got.identifiability.undetermined == ("d",)
    assert got.standard_errors == (pytest.approx(0.1 / np.sqrt(5)), None)
    assert got.notes == ()


def test_errors_that_are_held_add_to_the_own_ones_and_so_do_degrees_of_freedom(analytic):
    """The level of a line through five samples is held at an estimate with an error of 0.3 and 7 degrees."""
    time, noise = np.arange(5.0), 0.1 * np.array([0.0, 2.0, -1.0, 0.0, 0.0])
    model, task = analytic(line, ["a", "b"]), Task(time, {}, ("y",))
    noise -= time * (time @ noise) / (time @ time)  # so that the slope is 0.5
    case = measured_case("run", model, task, {"y": 2.0 + 0.5 * time + noise})
    specs = {n: ParameterSpec(n, start) for n, start in (("a", 2.0), ("b", 0.25))}
    problem = Problem([case], [replace(specs["a"], free=False), specs["b"]])
    joint = problem.over(replace(problem.space, free=(specs["b"], specs["a"]), fixed={}))
    held = Held(joint, np.array([[0.3]]) / joint.space.slope(joint.space.start)[1:, None], np.array([7.0]))
    alone, got = (
        uncertainty_of(problem, problem.evaluate(problem.space.to_search({"b": 0.5})), held=h)
        for h in (None, held)
    )
    unaided, moved = alone.standard_errors[0], -np.sum(time) / np.sum(time**2)
    assert unaided == pytest.approx(np.sqrt(noise @ noise / 4 / (time @ time)), rel=0.2)
    assert got.held == ("a",)
    assert got.held_slopes[0] == pytest.approx((moved,), rel=1e-6)
    inherited = moved * 0.3
    assert got.standard_errors == pytest.approx([np.hypot(unaided, inherited)], rel=1e-6)
    assert got.inherited_shares == pytest.approx([inherited**2 / (unaided**2 + inherited**2)], rel=1e-6)
    assert got.degrees_of_freedom == alone.degrees_of_freedom
    degrees = (unaided**2 + inherited**2) ** 2 / (unaided**4 / alone.degrees_of_freedom + inherited**4 / 7.0)
    assert got.degrees == pytest.approx([degrees], rel=1e-6)
    assert list(got.freedom) == list(got.degrees)
    reach = student(degrees).ppf(0.975) * got.standard_errors[0]
    assert got.intervals[0] == pytest.approx((0.5 - reach, 0.5 + reach), rel=1e-6)
    # Drawn together: b with all of its error, a with its own, and -moved of one in the other.
    both = with_held(got, held)
    unit = joint.space.slope(joint.space.start)
    covariance = np.array(both.covariance) * np.outer(unit, unit)
    assert both.names == ("b", "a")
    assert covariance == pytest.approx(
        np.array([[unaided**2 + inherited**2, inherited * 0.3], [inherited * 0.3, 0.3**2]]), rel=1e-5
    )
    assert joint.space.to_model(np.array(both.point)) == pytest.approx({"b": 0.5, "a": 2.0})


def test_intervals_are_hidden_by_name(uncertainty):
    got = uncertainty(line, [2.1, 3.8, 6.1, 8.0], {"a": 2.0, "b": 2.0}, sigma=0.1)
    hidden = without_intervals(got, ["b"])
    assert hidden.standard_errors == (got.standard_errors[0], None)
    assert hidden.intervals == (got.intervals[0], None)


def test_what_has_no_variance_has_inherited_no_share_of_it(uncertainty):
    got = uncertainty(level, 2.0 + 0.1 * WHITE, {"a": 2.0}, sigma=0.1)
    assert replace(got, covariance=((0.0,),), inherited=((0.0,),)).inherited_shares == (0.0,)
    assert replace(got, covariance=((4.0,),), inherited=((1.0,),)).inherited_shares == (0.25,)


def test_a_variance_that_came_out_below_zero_is_none(uncertainty, monkeypatch):
    scatter = confidence._Scatter(np.diag([-1e-10, 1e-8]), 5.0, (), 9, 2)
    monkeypatch.setattr(confidence, "_scatter", lambda *_, **__: scatter)
    monkeypatch.setattr(confidence, "_widened", lambda problem, evaluate, best, j, covariance: covariance)
    got = uncertainty(line, [2.1, 3.8, 6.1], {"a": 2.0, "b": 2.0})
    assert got.standard_errors == (None, pytest.approx(1e-4))


def test_a_covariance_is_raised_to_the_least_variances_with_its_correlations():
    covariance, least = np.array([[1.0, 0.5], [0.5, 4.0]]), np.diag([4.0, 1.0])
    assert confidence._not_below(covariance, least) == pytest.approx(np.array([[4.0, 1.0], [1.0, 4.0]]))
    none = np.array([[0.0, 0.0], [0.0, 2.0]])
    assert confidence._not_below(none, np.diag([4.0, 8.0])) == pytest.approx(np.diag([0.0, 8.0]))


SLIGHT = 0.02
"""How much less the difference of two parameters counts than their sum, by the Jacobian."""


def jacobian(slight=SLIGHT):
    return np.array([[1.0, 1.0], [slight, -slight]])


def widened(share, *, noise=1.0, slight=SLIGHT, below=-np.inf, above=np.inf, fails=np.inf, base=0.0, count=None):
    """The covariance after widening; really the difference counts `share` of what the Jacobian says.

    Returned with the way of one standard error in the weak direction, the sum staying as it is.
    """
    j = jacobian(slight)
    up, down = share if isinstance(share, tuple) else (share, share)

    def evaluate(points):
        evaluations = []
        for x in points:
            apart = x[0] - x[1]
            r = np.array([x[0] + x[1], slight * apart * (up if apart > 0.0 else down)])
            evaluations.append(
                SimpleNamespace(x=x, residuals=r, cost=float(r @ r), ok=bool(np.all(np.abs(x) < fails)))
            )
        if count is not None:
            count.extend(points)
        return evaluations

    covariance = noise**2 * np.linalg.inv(j.T @ j)
    problem = SimpleNamespace(space=SimpleNamespace(lower=np.full(2, below), upper=np.full(2, above)))
    best = SimpleNamespace(x=np.zeros(2), cost=base)
    got = confidence._widened(problem, evaluate, best, j, covariance)
    return got, covariance


SIGMA = np.sqrt(np.linalg.inv(jacobian().T @ jacobian())[0, 0])


@pytest.mark.parametrize("noise", [1.0, 3.0])
@pytest.mark.parametrize(
    ("share", "times"),
    [(1.0, 1), (0.51, 1), (0.49, 2), (0.26, 2), (0.24, 4), (0.1, 8), ((0.1, 0.4), 8), ((0.4, 0.1), 8), (0.0, 128)],
)
def test_where_parameters_compensate_each_other_better_than_a_jacobian_says_their_spread_grows(
    share, times, noise
):
    """The cost should have grown by one at one standard error; the distance is doubled until it does, seven times."""
    got, before = widened(share, noise=noise)
    way = noise * SIGMA * np.array([1.0, -1.0])
    assert got == pytest.approx(before + (times**2 - 1) * np.outer(way, way), rel=2e-3)
    assert np.sqrt(np.diag(got)) == pytest.approx(times * np.sqrt(np.diag(before)), rel=1e-3)


@pytest.mark.parametrize("slight", [SLIGHT, 0.2])
def test_a_walk_does_not_depend_on_units_nor_on_where_the_estimate_is(slight):
    """Parameters in units of a hundredth and of ten, at 3 and -7: the covariance is that in plain units."""
    unit, shift, j = np.array([100.0, 0.1]), np.array([3.0, -7.0]), jacobian(slight)

    def evaluate(points):
        plain = [(x - shift) / unit for x in points]
        residuals = [np.array([z[0] + z[1], slight * 0.1 * (z[0] - z[1])]) for z in plain]
        return [
            SimpleNamespace(x=x, residuals=r, cost=float(r @ r), ok=True)
            for x, r in zip(points, residuals, strict=True)
        ]

    problem = SimpleNamespace(space=SimpleNamespace(lower=np.full(2, -np.inf), upper=np.full(2, np.inf)))
    best = SimpleNamespace(x=shift, cost=0.0)
    covariance = np.linalg.inv(j.T @ j) * np.outer(unit, unit)
    got = confidence._widened(problem, evaluate, best, j / unit, covariance)
    plain, _ = widened(0.1, slight=slight)
    assert got / np.outer(unit, unit) == pytest.approx(plain, rel=1e-6)


def test_the_leading_parameter_stays_where_it_was_moved_and_the_others_follow():
    """On a curve: what follows is elsewhere than on the straight line that the Jacobian sees."""

    def evaluate(points):
        evaluations = []
        for x in points:
            r = np.array([x[0] + x[1] + 1e-4 * x[0] ** 2, 1e-3 * (x[0] - x[1])])
            evaluations.append(
                SimpleNamespace(x=x, residuals=r, cost=float(r @ r), ok=bool(abs(x[0]) < 10.0 * SIGMA))
            )
        return evaluations

    j = jacobian()
    problem = SimpleNamespace(space=SimpleNamespace(lower=np.full(2, -np.inf), upper=np.full(2, np.inf)))
    covariance = np.linalg.inv(j.T @ j)
    got = confidence._widened(problem, evaluate, SimpleNamespace(x=np.zeros(2), cost=0.0), j, covariance)
    way = np.array([2.0 * SIGMA, -2.0 * SIGMA - 1e-4 * (8.0 * SIGMA) ** 2 / 4.0]) / 2.0
    assert got - covariance == pytest.approx((8.0**2 - 1.0) * np.outer(way, way), rel=0.02)


def test_only_directions_in_which_a_thousand_times_less_is_known_are_walked():
    for ratio, times in ((999.5, 1), (1000.9, 8)):
        got, before = widened(0.1, slight=1.0 / np.sqrt(ratio))
        assert got[0, 0] == pytest.approx(times**2 * before[0, 0], rel=0.01)


def test_a_walk_ends_where_bounds_or_the_model_do():
    for limits in ({"below": -10.0 * SIGMA}, {"above": 10.0 * SIGMA}, {"fails": 10.0 * SIGMA}):
        got, before = widened(0.0, **limits)
        assert got[0, 0] == pytest.approx(64.0 * before[0, 0], rel=0.01)


def test_the_others_follow_in_three_steps_and_in_none_where_the_cost_is_no_larger():
    asked = []
    widened(0.1, count=asked)
    assert len(asked) == 2 * 4 * 4  # both ways, at 2, 4, 8 and 16 standard errors
    asked.clear()
    got, before = widened(0.0, base=1e9, count=asked)
    assert len(asked) == 2 * 7
    assert got[0, 0] == pytest.approx(128.0**2 * before[0, 0], rel=0.01)


def test_only_what_has_standard_errors_is_walked(uncertainty, monkeypatch):
    walked = []

    def noted(problem, evaluate, best, j, covariance):
        walked.append(len(covariance))
        return covariance

    monkeypatch.setattr(confidence, "_widened", noted)
    uncertainty(line, [2.1, 3.8, 6.1], {"a": 2.0, "b": 2.0})  # of one degree of freedom
    assert walked == [2]
    uncertainty(line, [2.0, 4.0], {"a": 2.0, "b": 2.0})  # as many samples as parameters
    uncertainty(level, 2.0 + 0.1 * WHITE, {"a": 2.0})
    uncertainty(lambda time, inputs, p: {"y": (p["a"] + p["b"]) * time}, [0.0, 4.0, 8.1], {"a": 2.0, "b": 2.0})
    assert walked == [2]


def test_every_weak_direction_is_walked():
    slight = (0.02, 0.01)
    j = np.zeros((4, 4))
    for k, s in enumerate(slight):
        j[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = jacobian(s)

    def evaluate(points):
        evaluations = []
        for x in points:
            r = j @ x
            r[1::2] *= 0.1
            evaluations.append(SimpleNamespace(x=x, residuals=r, cost=float(r @ r), ok=True))
        return evaluations

    space = SimpleNamespace(lower=np.full(4, -np.inf), upper=np.full(4, np.inf))
    before = np.linalg.inv(j.T @ j)
    best = SimpleNamespace(x=np.zeros(4), cost=0.0)
    got = confidence._widened(SimpleNamespace(space=space), evaluate, best, j, before)
    assert np.diag(got) == pytest.approx(64.0 * np.diag(before), rel=0.01)
