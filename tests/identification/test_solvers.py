import threading
from functools import partial
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from fmuid import (
    CriterionSpec,
    ParameterSpec,
    Problem,
    Status,
    StopRules,
    Task,
    identify,
    measured_case,
    read_history,
)
from fmuid.core.errors import ProblemError
from fmuid.core.formulas import parse
from fmuid.identification.problem import estimation_problem
from fmuid.identification.problem.combination import Combination, Constraint
from fmuid.identification.problem.criteria import register
from fmuid.identification.problem.search_space import expanded
from fmuid.identification.solvers import choose
from fmuid.simulation.runners import in_process

LOCAL = ["trf", "dfols", "nelder_mead", "sbplx", "cobyla", "bobyqa", "newuoa_bound", "praxis", "slsqp"]
LOCAL += ["pattern_search", "lbfgs"]
GLOBAL = ["crs2", "isres", "direct", "direct_l", "esch", "mlsl", "ags"]


def curve(analytic, function, names, y, *, kind="least_squares", criteria=None, specs=None, **options):
    """A problem that fits `function` to the samples `y` over time 0..1, with sigma 1."""
    time = np.linspace(0.0, 1.0, len(y))
    task = Task(time, {}, ("y",))
    criteria = criteria or [CriterionSpec("y", kind)]
    model = analytic(function, names)
    case = measured_case("curve", model, task, {"y": np.asarray(y, float)}, sigma={"y": 1.0}, criteria=criteria)
    return Problem([case], specs or [ParameterSpec(n, 1.0, -10.0, 10.0) for n in names], **options)


def rugged(time, inputs, p):
    """Rastrigin's function as one residual vector: a local minimum next to every integer."""
    return {"y": np.sqrt([10.0 + p["a"] ** 2 - 10.0 * np.cos(2 * np.pi * p["a"])] * len(time))}


@pytest.mark.parametrize("solver", ["cobyla", "slsqp", "sbplx", "praxis", "nelder_mead", "bobyqa", "isres"])
def test_a_constraint_that_cannot_be_kept_ends_the_search(analytic, solver):
    constraint = Constraint.from_mapping({"expression": "a + cos(20*a)", "min": 12.0})
    level = lambda time, inputs, p: {"y": p["a"]}  # noqa: E731
    problem = curve(analytic, level, ["a"], np.zeros(5), constraints=[constraint])
    stage = identify(problem, solver=solver, with_uncertainty=False).stages[0]
    assert stage.evaluations <= 1100
    assert "no candidate satisfies every constraint" in stage.warnings


@pytest.mark.parametrize("solver", LOCAL)
def test_local_solvers_find_the_truth_again(solver, msd, msd_truth):
    result = identify(msd(noise=0.0), solver=solver, with_uncertainty=False)
    assert result.status is Status.CONVERGED
    assert {n: result.parameters[n] for n in msd_truth} == pytest.approx(msd_truth, rel=2e-3)


@pytest.mark.parametrize("solver", GLOBAL)
def test_global_solvers_leave_a_local_minimum(solver, analytic):
    specs = [ParameterSpec("a", 3.0, -4.7, 5.3)]
    problem = curve(analytic, rugged, ["a"], np.zeros(5), specs=specs)
    assert abs(identify(problem, solver="bobyqa", options={"initial_step": 0.01}).parameters["a"]) > 0.9
    assert abs(identify(problem, solver=solver, with_uncertainty=False).parameters["a"]) < 0.2


def test_a_chain_polishes_what_a_global_search_found(analytic):
    problem = curve(analytic, rugged, ["a"], np.zeros(5), specs=[ParameterSpec("a", 3.0, -4.7, 5.3)])
    options = {"crs2": {"evaluations": 300}}
    result = identify(problem, solver="crs2 > bobyqa", options=options, with_uncertainty=False)
    assert result.parameters["a"] == pytest.approx(0.0, abs=1e-6)


def test_every_link_of_a_chain_reports_its_cost_and_its_evaluations(msd):
    options = {"bobyqa": {"evaluations": 40}}
    stage = identify(msd(), solver="bobyqa > trf", options=options, with_uncertainty=False).stages[0]
    first, second = stage.links
    assert (first.solver, second.solver) == ("bobyqa", "trf")
    assert first.evaluations in (39, 40)  # the start is known
    assert first.cost > second.cost == stage.cost
    assert (
        f"bobyqa: {first.cost:.6g} after {first.evaluations}; trf: {second.cost:.6g} after {second.evaluations}"
        in stage.summary
    )


@pytest.mark.parametrize("budget", [StopRules(evaluations=300), StopRules(seconds=0.4)])
def test_a_budget_leaves_every_link_of_a_chain_its_share(analytic, budget, monkeypatch):
    """ESCH never ends by itself."""
    ticks = SimpleNamespace(perf_counter=partial(next, count(step=1e-3)))  # an evaluation takes a millisecond
    monkeypatch.setattr(estimation_problem, "clock", ticks)
    problem = curve(analytic, rugged, ["a"], np.zeros(5), specs=[ParameterSpec("a", 3.0, -4.7, 5.3)])
    stage = identify(problem, solver="esch > bobyqa", stop=budget, with_uncertainty=False).stages[0]
    assert stage["a"].value == pytest.approx(0.0, abs=1e-6)
    assert budget.evaluations is None or stage.evaluations <= budget.evaluations


def test_a_pattern_search_keeps_to_an_inequality(analytic):
    level = lambda time, inputs, p: {"y": p["a"] + 2.0 * p["b"]}  # noqa: E731
    limit = Constraint.from_mapping({"expression": "a + b", "min": 1.0})
    problem = curve(analytic, level, ["a", "b"], np.full(5, 0.5), constraints=[limit])
    result = identify(problem, solver="pattern_search", with_uncertainty=False)
    assert result.parameters["a"] + result.parameters["b"] >= 1.0 - 1e-6
    assert result.parameters["a"] + 2 * result.parameters["b"] == pytest.approx(0.5, abs=1e-3)


def test_multistart_is_the_same_for_the_same_seed_and_keeps_the_waterfall(analytic):
    specs = [ParameterSpec("a", 3.0, -4.7, 5.3)]
    runs = [
        identify(
            curve(analytic, rugged, ["a"], np.zeros(5), specs=specs),
            solver="bobyqa",
            options={"starts": 12, "initial_step": 0.02},
            seed=seed,
            with_uncertainty=False,
        ).stages[0]
        for seed in (3, 3, 4)
    ]
    assert runs[0].starts == runs[1].starts != runs[2].starts
    assert len(runs[0].starts) == 12
    assert len({round(s.cost, 3) for s in runs[0].starts}) > 3  # different minima were met
    assert runs[0].cost == pytest.approx(min(s.cost for s in runs[0].starts))


def test_min_max_gives_the_midrange_and_least_squares_the_mean(analytic):
    y = [0.0, 0.0, 0.0, 4.0]
    level = lambda time, inputs, p: {"y": p["a"]}  # noqa: E731
    least_squares = curve(analytic, level, ["a"], y)
    worst = curve(analytic, level, ["a"], y, kind="maximum", combination=Combination("min_max"))
    assert identify(least_squares).parameters["a"] == pytest.approx(1.0)
    assert identify(worst, with_uncertainty=False).parameters["a"] == pytest.approx(2.0, abs=1e-4)


@pytest.mark.parametrize("solver", ["cobyla", "slsqp", "isres"])
def test_min_max_balances_criteria_that_compete(analytic, solver):
    # |a - 1| and |a + 3| / 3: equal at a = 0.
    criteria = [
        CriterionSpec("y", "error_vector", stop_time=0.5),
        CriterionSpec("y", "error_vector", start_time=0.6, demand=3.0),
    ]
    level = lambda time, inputs, p: {"y": p["a"]}  # noqa: E731
    problem = curve(
        analytic, level, ["a"], [1.0, 1.0, -3.0, -3.0], criteria=criteria, combination=Combination("min_max")
    )
    result = identify(problem, solver=solver, with_uncertainty=False)
    assert result.parameters["a"] == pytest.approx(0.0, abs=0.02)


def test_cobyla_goes_on_where_it_stops_short_in_a_narrow_valley(analytic):
    def valley(time, inputs, p):
        across, along = 50 * (p["b"] - p["a"] ** 2), 1 + (p["a"] - 2) ** 2
        return {"y": np.where(time < 0.55, along + across, along - across)}

    criteria = [
        CriterionSpec("y", "error_vector", stop_time=0.5),
        CriterionSpec("y", "error_vector", start_time=0.6),
    ]
    specs = [ParameterSpec("a", np.float64(5.2), -10, 10), ParameterSpec("b", np.float64(-1.7), -10, 10)]
    problem = curve(
        analytic,
        valley,
        "ab",
        np.zeros(10),
        criteria=criteria,
        specs=specs,
        combination=Combination("min_max"),
    )
    assert identify(problem, with_uncertainty=False).stages[0].cost == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("solver", ["cobyla", "slsqp", "bobyqa"])
def test_constraints_on_parameters_are_kept(analytic, solver):
    # Nearest point of a + b = 1 to (2, 1) is (1, 0).
    line = lambda time, inputs, p: {"y": np.where(time < 0.5, p["a"], p["b"])}  # noqa: E731
    constraint = Constraint.from_mapping({"expression": "a + b", "max": 1.0})
    problem = curve(analytic, line, ["a", "b"], [2.0, 1.0], constraints=[constraint])
    result = identify(problem, solver=solver, with_uncertainty=False)
    assert (result.parameters["a"], result.parameters["b"]) == pytest.approx((1.0, 0.0), abs=2e-3)


def test_a_criterion_can_be_a_constraint(analytic):
    criteria = [
        CriterionSpec("y", "least_squares"),
        CriterionSpec("y", "maximum", options={"name": "worst"}, weight=0.0),
    ]
    level = lambda time, inputs, p: {"y": p["a"]}  # noqa: E731
    constraint = Constraint.from_mapping({"criterion": "worst", "max": 2.5})
    problem = curve(analytic, level, ["a"], [0.0, 0.0, 0.0, 4.0], criteria=criteria, constraints=[constraint])
    # The mean, 1, leaves 3 at the worst sample; 1.5 is the nearest that keeps 2.5.
    assert identify(problem, with_uncertainty=False).parameters["a"] == pytest.approx(1.5, abs=1e-3)


def test_lexicographic_order_spends_only_what_the_first_leaves_free(analytic):
    criteria = [
        CriterionSpec("y", "error_vector", stop_time=0.4, options={"priority": 1}),
        CriterionSpec("y", "error_vector", start_time=0.6, options={"priority": 2}),
    ]
    # The first half sees only a + b, the second wants a = 3 but must not spoil the first.
    both = lambda time, inputs, p: {"y": np.where(time < 0.5, 100 * (p["a"] + p["b"]), p["a"])}  # noqa: E731
    problem = curve(
        analytic, both, ["a", "b"], [200.0, 3.0], criteria=criteria, combination=Combination("lexicographic")
    )
    parameters = identify(problem, with_uncertainty=False).parameters
    assert parameters["a"] == pytest.approx(3.0, abs=0.05)
    assert parameters["a"] + parameters["b"] == pytest.approx(2.0, abs=0.02)


def test_p_norm_lies_between_the_sum_and_the_maximum(analytic):
    y = [0.0, 0.0, 0.0, 4.0]
    level = lambda time, inputs, p: {"y": p["a"]}  # noqa: E731
    spread = [CriterionSpec("y", "maximum", start_time=t - 0.1, stop_time=t + 0.1) for t in (0, 1 / 3, 2 / 3, 1)]
    estimates = []
    for p in (2.0, 6.0, 60.0):
        problem = curve(analytic, level, ["a"], y, criteria=spread, combination=Combination("p_norm", p))
        estimates.append(identify(problem, solver="sbplx", with_uncertainty=False).parameters["a"])
    assert estimates[0] == pytest.approx(1.0, abs=1e-3)
    assert estimates[0] < estimates[1] < estimates[2] < 2.0


@pytest.mark.parametrize("solver", ["trf", "dfols", "bobyqa", "nelder_mead", "cobyla", "slsqp", "crs2", "direct"])
def test_candidates_that_fail_do_not_stop_the_search(analytic, msd, msd_truth, solver):
    from_conftest = msd(noise=0.0).cases[0].simulator.function

    def fragile(time, inputs, p):
        return None if p["k"] > 30.4 or p["d"] > 1.1 else from_conftest(time, inputs, p)

    model = analytic(fragile, msd_truth)
    result = identify(msd(noise=0.0, model=model), solver=solver, with_uncertainty=False)
    if solver in ("trf", "dfols", "bobyqa", "nelder_mead"):
        assert {n: result.parameters[n] for n in msd_truth} == pytest.approx(msd_truth, rel=5e-3)
    else:  # what cannot be simulated hides the way to the truth; what is reached is better, and valid
        stage = result.stages[0]
        assert stage.failures > 0
        assert stage.cost < 0.3 * stage.start_cost
        assert stage["k"].value <= 30.4


def test_a_start_that_fails_is_said(analytic):
    problem = curve(analytic, lambda time, inputs, p: None, ["a"], np.zeros(3))
    result = identify(problem)
    assert result.status is Status.FAILED
    assert "the integrator gave up" in result.stages[0].message
    assert result.stages[0].cost is None


@pytest.mark.parametrize("solver", ["isres", "crs2", "direct"])
def test_a_budget_leaves_the_local_solver_that_ends_a_global_search_its_share(analytic, solver):
    problem = curve(analytic, lambda time, inputs, p: {"y": p["a"]}, ["a"], [1.2, 1.2])
    stage = identify(problem, solver=solver, stop=StopRules(evaluations=200), with_uncertainty=False).stages[0]
    assert stage.status is Status.BUDGET
    assert stage["a"].value == pytest.approx(1.2, abs=1e-5)
    assert 100 < stage.evaluations <= 200
    assert "evaluations, then" in stage.message


def test_budgets_are_kept(msd):
    result = identify(msd(), solver="nelder_mead", stop=StopRules(evaluations=20), with_uncertainty=False)
    assert result.status is Status.BUDGET
    assert result.stages[0].evaluations == 20
    good_enough = identify(msd(), solver="nelder_mead", stop=StopRules(cost=1e6), with_uncertainty=False)
    assert good_enough.stages[0].cost <= 1e6


def test_the_default_follows_the_structure(analytic, msd):
    level = lambda time, inputs, p: {"y": p["a"]}  # noqa: E731
    assert choose(msd())[0] == "trf"
    assert choose(msd(combination=Combination("min_max")))[0] == "cobyla"
    assert choose(msd(combination=Combination("p_norm")))[0] == "bobyqa"
    kinks = curve(analytic, level, ["a"], np.zeros(3), kind="maximum")
    name, why = choose(kinks)
    assert name == "sbplx"
    assert "non-smooth" in why


@pytest.mark.parametrize(
    ("solver", "options", "message"),
    [
        ("bobyka", {}, "did you mean 'bobyqa'"),
        ("bobyqa", {"tolerence": 1}, "no option 'tolerence'"),
        ("lm", {}, "takes no bounds"),
        ("crs2 > bobyqa", {"evaluations": 3}, "unknown solver option"),
    ],
)
def test_solvers_that_cannot_be_are_refused(msd, solver, options, message):
    with pytest.raises(ProblemError, match=message):
        identify(msd(), solver=solver, options=options)


def test_global_solvers_name_the_open_bounds(analytic):
    level = lambda time, inputs, p: {"y": p["a"]}  # noqa: E731
    problem = curve(analytic, level, ["a"], np.zeros(3), specs=[ParameterSpec("a", 1.0, lower=0.0)])
    with pytest.raises(ProblemError, match="give lower and upper of a"):
        identify(problem, solver="crs2")


def test_noise_of_a_simulator_does_not_stop_the_gradient(analytic, msd, msd_truth):
    exact = msd(noise=0.0).cases[0].simulator.function

    def noisy(time, inputs, p):
        # As an adaptive integrator: a relative error that jumps with the parameters.
        jump = np.random.default_rng(abs(hash(tuple(p.values())))).standard_normal(time.size)
        return {"y": exact(time, inputs, p)["y"] * (1 + 1e-6 * jump)}

    result = identify(msd(noise=0.0, model=analytic(noisy, msd_truth)), solver="trf")
    assert {n: result.parameters[n] for n in msd_truth} == pytest.approx(msd_truth, rel=1e-3)
    floor = result.stages[0].uncertainty.noise_floor
    size = 1 / 30.0 / 1e-4 * np.sqrt(3)
    assert floor == pytest.approx(1e-6 * size, rel=0.5)


def test_uncertainty_of_a_failing_neighbourhood_is_a_warning_not_an_end(analytic):
    only = lambda time, inputs, p: {"y": p["a"]} if p["a"] == 1.0 else None  # noqa: E731
    problem = curve(analytic, only, ["a"], np.ones(3))
    result = identify(problem, solver="nelder_mead")
    assert result.parameters["a"] == 1.0
    assert any("no uncertainty" in w for w in result.stages[0].warnings)


@pytest.mark.parametrize("solver", ["cobyla", "slsqp", "bobyqa"])
def test_an_equality_is_met(analytic, solver):
    # The point of a * b = 2 that is nearest to (2, 0.5).
    line = lambda time, inputs, p: {"y": np.where(time < 0.5, p["a"], p["b"])}  # noqa: E731
    constraint = Constraint.from_mapping({"expression": "a * b", "equal": 2.0})
    specs = [ParameterSpec("a", 1.5, 0.5, 4.0), ParameterSpec("b", 1.5, 0.5, 4.0)]
    problem = curve(analytic, line, ["a", "b"], [2.0, 0.5], constraints=[constraint], specs=specs)
    parameters = identify(problem, solver=solver, with_uncertainty=False).parameters
    grid = np.linspace(0.5, 4.0, 100_001)
    nearest = grid[np.argmin((grid - 2.0) ** 2 + (2.0 / grid - 0.5) ** 2)]
    assert parameters["a"] * parameters["b"] == pytest.approx(2.0, abs=1e-4)
    assert parameters["a"] == pytest.approx(nearest, abs=1e-2)


@pytest.mark.parametrize(
    "solver", ["bobyqa", "trf", pytest.param("dfols", marks=pytest.mark.slow), "sbplx > praxis", "mlsl"]
)
def test_multistart_does_not_depend_on_where_and_by_how_many_it_is_simulated(msd, solver):
    from concurrent.futures import ThreadPoolExecutor

    def run(executor=None):
        stage = identify(
            msd(),
            solver=solver,
            options={"starts": 4},
            stop=StopRules(400) if solver == "mlsl" else None,
            executor=executor,
            seed=5,
            with_uncertainty=False,
        ).stages[0]
        return stage.starts, stage.parameters, stage.message

    here = run()
    for workers in (1, 3):
        with ThreadPoolExecutor(workers) as executor:
            assert run(executor) == here


def test_starts_are_simulated_side_by_side(analytic):
    batches = []

    def runner(jobs):
        batches.append(len(jobs))
        return in_process(jobs)

    problem = curve(analytic, rugged, ["a"], np.zeros(5), specs=[ParameterSpec("a", 3.0, -4.7, 5.3)])
    problem.runner = runner
    stage = identify(problem, solver="bobyqa", options={"starts": 8}, with_uncertainty=False).stages[0]
    assert max(batches) == 8
    assert sum(batches) == stage.evaluations + 2  # that show that the model repeats itself
    assert stage.evaluations >= sum(s.evaluations for s in stage.starts)  # and the check of the best
    assert np.mean(batches) > 3


def test_random_searches_side_by_side_draw_different_numbers(analytic):
    problem = curve(analytic, rugged, ["a"], np.zeros(5), specs=[ParameterSpec("a", 3.0, -4.7, 5.3)])
    options = {"starts": 3, "evaluations": 30}
    stage = identify(problem, solver="crs2", options=options, with_uncertainty=False).stages[0]
    assert len({s.end for s in stage.starts}) == 3


def test_a_budget_ends_all_starts(analytic):
    problem = curve(analytic, rugged, ["a"], np.zeros(5), specs=[ParameterSpec("a", 3.0, -4.7, 5.3)])
    stage = identify(
        problem, solver="bobyqa", options={"starts": 8}, stop=StopRules(40), with_uncertainty=False
    ).stages[0]
    assert stage.status is Status.BUDGET
    assert 40 <= stage.evaluations < 48
    assert [s.status for s in stage.starts] == [Status.BUDGET] * 8
    assert stage.cost == min(s.cost for s in stage.starts)


def test_a_start_that_fails_costs_the_others_nothing(analytic):
    right = lambda time, inputs, p: rugged(time, inputs, p) if p["a"] < 3.0 else None  # noqa: E731
    problem = curve(analytic, right, ["a"], np.zeros(5), specs=[ParameterSpec("a", 2.0, -4.7, 5.3)])
    stage = identify(problem, solver="bobyqa", options={"starts": 8}, with_uncertainty=False).stages[0]
    assert 4 <= len(stage.starts) < 8
    assert all(s.status is Status.CONVERGED for s in stage.starts)


def test_a_mistake_in_one_of_many_starts_is_raised_and_leaves_no_thread(msd):
    threads = threading.active_count()
    with pytest.raises(ProblemError, match="takes no bounds"):
        identify(msd(), solver="lm", options={"starts": 4})
    assert threading.active_count() == threads


@pytest.mark.slow
def test_every_level_of_an_order_has_its_starts(analytic):
    criteria = [
        CriterionSpec("y", "error_vector", stop_time=0.4, options={"priority": 1}),
        CriterionSpec("y", "error_vector", start_time=0.6, options={"priority": 2}),
    ]
    # The first half has local minima and is best at integers a = 2 only; the second wants b = 1 and a = 0.
    wavy = lambda a: np.sqrt(0.1 * (a - 2) ** 2 + 2 - 2 * np.cos(2 * np.pi * a))  # noqa: E731
    both = lambda time, inputs, p: {"y": np.where(time < 0.5, 10 * wavy(p["a"]), p["b"] - 1 + p["a"])}  # noqa: E731
    problem = curve(
        analytic, both, ["a", "b"], np.zeros(20), criteria=criteria, combination=Combination("lexicographic")
    )
    options = {"starts": 16, "initial_step": 0.05}
    result = identify(problem, solver="cobyla", options=options, with_uncertainty=False)
    assert result.stages[0].solver == "lexicographic 16 x cobyla"
    # Satisfied is satisfied: what the first leaves within its demand, the second may have.
    assert 10 * wavy(result.parameters["a"]) <= 1.01
    assert result.parameters["a"] == pytest.approx(2.0, abs=0.1)
    assert result.parameters["a"] + result.parameters["b"] == pytest.approx(1.0, abs=1e-3)
    assert len(result.stages[0].starts) == 16


def test_time_is_a_stop_rule(analytic, monkeypatch):
    now = 0.0

    def slow(time, inputs, p):
        nonlocal now
        now += 0.25
        return rugged(time, inputs, p)

    monkeypatch.setattr("time.perf_counter", lambda: now)

    problem = curve(analytic, slow, ["a"], np.zeros(5), specs=[ParameterSpec("a", 3.0, -4.7, 5.3)])
    result = identify(problem, solver="crs2", stop=StopRules(seconds=2.5), with_uncertainty=False)
    assert result.status is Status.BUDGET
    assert "2.5 s" in result.stages[0].message
    assert result.stages[0].evaluations == 10


TIME = np.linspace(0.0, 4.0, 401)


@pytest.mark.parametrize(
    "criteria",
    [
        [("magnitude", {}), ("phase", {})],
        [("rise_time", {}), ("overshoot", {}), ("steady_state", {})],
        [("settling_time", {}), ("peak", {}), ("steady_state", {})],
        [("integral_absolute", {}), ("integral_time_absolute", {})],
        [("integral_squared", {})],
        [("quantile", {"q": 0.9}), ("maximum", {})],
        [("user", {"function": "numpy:subtract"})],  # of time and prediction: a user's own residual
    ],
    ids=lambda criteria: "-".join(kind for kind, _ in criteria),
)
def test_every_kind_of_criterion_can_be_minimised(analytic, msd, msd_truth, criteria):
    exact = msd().cases[0].simulator.function
    y, u = exact(TIME, {}, msd_truth)["y"], np.where(TIME < 4.0, 1.0, 0.0)
    measured = TIME + 0.0 if criteria[0][0] == "user" else y
    function = (lambda t, i, p: {"y": t + exact(t, i, p)["y"] - y}) if criteria[0][0] == "user" else exact
    case = measured_case(
        "step",
        analytic(function, msd_truth),
        Task(TIME, {"u": u + 0.3 * np.sin(9 * TIME)}, ("y",)),
        {"y": measured},
        criteria=[CriterionSpec("y", kind, demand=1e-2, options=options) for kind, options in criteria],
    )
    specs = [
        ParameterSpec("m", 1.1, 0.5, 3.0),
        ParameterSpec("d", 0.6, 0.2, 2.0),
        ParameterSpec("k", 28.0, 10.0, 60.0),
    ]
    stage = identify(
        Problem([case], specs), solver="sbplx", stop=StopRules(evaluations=1500), with_uncertainty=False
    ).stages[0]
    assert stage.cost < 0.02 * stage.start_cost
    if criteria[0][0].startswith(("integral", "quantile", "user")):  # they see the whole response
        assert stage.parameters["k"] == pytest.approx(30.0, rel=0.02)


def raising(time, prediction, measured):
    """A user's criterion with a mistake that shows where the response is small."""
    if np.max(prediction) < 0.055:
        raise ZeroDivisionError("division by zero")
    return prediction - measured


def ragged(time, prediction, measured):
    return (prediction - measured)[2 if np.max(prediction) < 0.055 else 0 :]


def nowhere(time, prediction, measured):
    """It has no value on the measurement itself."""
    error = np.sum((prediction - measured) ** 2)
    if error == 0.0:
        raise ValueError("nothing to compare")
    return [1e3 * np.sqrt(error)]


@pytest.mark.parametrize("solver", ["trf", "bobyqa", "sbplx"])
@pytest.mark.parametrize(
    ("posed", "message"),
    [
        ({"tie": {"d": "0.7 + 0*log(34 - k)"}}, "'0.7 + 0*log(34 - k)' has no value"),
        ({"constraints": [Constraint("c", parse("sqrt(34 - k)"), minimum=0.0)]}, "'sqrt(34 - k)' has no value"),
        ({"function": raising}, "its function raises ZeroDivisionError (division by zero)"),
        ({"function": ragged}, "299 residuals, but 301 on the measurement"),
        ({"function": nowhere}, None),
    ],
    ids=["tie", "constraint", "raising", "ragged", "nowhere"],
)
def test_a_point_without_a_value_has_failed_and_the_search_goes_on(
    msd, msd_truth, tmp_path, solver, posed, message
):
    if "constraints" in posed and solver == "trf":  # it takes none
        solver = "slsqp"
    exact = msd()
    criteria = []
    if "function" in posed:
        register("of_a_user", posed["function"])
        criteria = [CriterionSpec("y", "of_a_user")]
    case = measured_case(
        "step",
        exact.cases[0].simulator,
        exact.cases[0].task,
        {"y": exact.cases[0].channels[0].mean},
        criteria=criteria,
    )
    tie = posed.get("tie", {})
    specs = [ParameterSpec("d", 0.7), ParameterSpec("k", 32.0, 20.0, 40.0), ParameterSpec("m", 1.2)]
    space = expanded(specs, ["k"], {}, tie, ["step"])
    problem = Problem([case], space, constraints=posed.get("constraints", ()))
    stage = identify(problem, solver=solver, options={"starts": 3}, out=tmp_path).stages[0]
    assert stage.parameters["k"] == pytest.approx(30.0, rel=1e-3)
    failures = {row.failure for row in read_history(tmp_path)["identification"].rows if row.failure}
    assert bool(failures) is (message is not None)
    assert all(message in failure for failure in failures)
