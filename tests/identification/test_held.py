"""Stages that hold what earlier ones found inherit its errors."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fmuid import (
    AnalysisSpec,
    Campaign,
    CriterionSpec,
    Experiment,
    Measurements,
    ParameterSpec,
    Signal,
    StageSpec,
    identify,
)
from fmuid.core.campaign import ModelSpec
from fmuid.identification.uncertainty.earlier_stages import Known
from fmuid.identification.uncertainty.inherited import effective_degrees

A, B, SIGMA = 2.0, 0.5, 0.1
IDLE, LOADED = np.linspace(0.0, 10.0, 50), np.linspace(0.0, 10.0, 400)
LEVEL = StageSpec("level", ("idle",), ("a",))
SLOPE = StageSpec("slope", ("loaded",), ("b",))


def line(time, inputs, p):
    """A level; under load it rises from what sticks to the level. `c` does nothing under load."""
    return {"y": p["a"] + p["b"] * p["load"] * time + 0.0 * inputs.get("u", 0.0) + p["c"] * (1 - p["load"])}


def campaign(*stages, seed=2, **specs):
    generator = np.random.default_rng(seed)
    runs = {}
    for id, time, load in (("idle", IDLE, 0.0), ("loaded", LOADED, 1.0)):
        y = A + B * load * time + SIGMA * generator.standard_normal(time.size)
        runs[id] = Experiment(id, "bench", time, {"y": Signal("y", y, "1", "output", SIGMA)}, {"load": load})
    parameters = {n: ParameterSpec(n, s) for n, s in {"a": 1.0, "b": 1.0, "c": 0.0}.items()} | specs
    return Campaign(
        "two_steps",
        "",
        Path(),
        Measurements(runs),
        {"bench": ModelSpec("bench", Path("line.fmu"))},
        parameters,
        {},
        {stage.name: stage for stage in stages},
        ("idle", "loaded"),
        (),
    )


@pytest.fixture
def bench(analytic):
    return {"bench": analytic(line, ["a", "b", "c", "load"])}


def test_degrees_of_freedom_of_a_sum_of_variances():
    """Welch and Satterthwaite: (sum of variances)^2 over the sum of variance^2 / degrees."""
    parts = np.array([[1.0, 3.0], [2.0, 2.0], [4.0, 0.0], [0.0, 4.0], [0.0, 0.0]])
    assert effective_degrees(parts, np.array([5.0, np.inf])) == pytest.approx([80.0, 20.0, 5.0, np.inf, np.inf])
    assert effective_degrees(parts[:3], np.array([5.0, 9.0])) == pytest.approx(
        [16 / 1.2, 16 / (4 / 5 + 4 / 9), 5.0]
    )


def test_errors_of_two_correlated_parameters_and_of_what_they_inherit_add_up():
    """In model space: the stage's own covariance, slopes times errors of what it holds, and differences of ties."""
    slope, covariance = np.array([2.0, 0.5]), np.array([[1.0, 0.6], [0.6, 4.0]])
    slopes, held = np.array([[0.4], [-0.2]]), np.array([3.0, 0.0])
    inherited = np.outer(slopes / slope[:, None], slopes / slope[:, None]) * (held @ held)
    space = SimpleNamespace(
        names=("a", "b"),
        ties={"t": "a - 3*b"},
        slope=lambda x: slope,
        followed=lambda p: {**p, "t": p["a"] - 3.0 * p["b"]},
    )
    uncertainty = SimpleNamespace(
        point=(1.0, 1.0),
        covariance=covariance + inherited,
        inherited=inherited.tolist(),
        standard_errors=(1.0, 1.0),
        held=("h",),
        held_slopes=slopes,
        degrees_of_freedom=11.0,
    )
    before = Known({"h": held, "t": np.array([9.0, 9.0]), "b": np.array([9.0, 9.0])}, np.array([5.0, 7.0]))
    after = before.after(SimpleNamespace(space=space), uncertainty, {"h": 1.0, "a": 1.0, "b": 2.0, "t": -5.0})
    assert list(after.degrees) == [5.0, 7.0, 11.0, 11.0]
    assert after.rows.keys() == {"h", "a", "b", "t"}
    rows = np.array([after.rows["a"], after.rows["b"]])
    np.testing.assert_allclose(rows[:, :2], slopes @ held[None, :])
    np.testing.assert_allclose(rows[:, 2:] @ rows[:, 2:].T, covariance * np.outer(slope, slope))
    np.testing.assert_allclose(after.rows["t"], rows[0] - 3.0 * rows[1], atol=1e-9)
    np.testing.assert_allclose(after.rows["h"], [3.0, 0.0, 0.0, 0.0])
    unknown = before.after(SimpleNamespace(space=space), None, {"h": 1.0, "a": 1.0, "b": 2.0, "t": -5.0})
    assert {name: list(row) for name, row in unknown.rows.items()} == {"h": [3.0, 0.0]}
    assert list(unknown.degrees) == [5.0, 7.0]
    assert unknown.unsure == {"a", "b"}


def test_the_error_of_a_tie_is_that_of_its_slope_at_the_estimate():
    space = SimpleNamespace(
        names=("a",), ties={"t": "a**3"}, slope=np.ones_like, followed=lambda p: {**p, "t": p["a"] ** 3}
    )
    uncertainty = SimpleNamespace(
        point=(2.0,),
        covariance=[[0.25]],
        inherited=(),
        standard_errors=(0.5,),
        held=(),
        held_slopes=((),),
        degrees_of_freedom=None,
    )
    after = Known().after(SimpleNamespace(space=space), uncertainty, {"a": 2.0, "t": 8.0})
    assert np.abs(after.rows["a"]) == pytest.approx([0.5])
    assert after.rows["t"] == pytest.approx(3.0 * 2.0**2 * after.rows["a"], rel=1e-6)
    assert list(after.degrees) == [np.inf]


def test_a_direction_whose_variance_came_out_below_zero_has_no_error():
    space = SimpleNamespace(names=("a", "b"), ties={}, slope=np.ones_like, followed=dict)
    uncertainty = SimpleNamespace(
        point=(0.0, 0.0),
        covariance=[[4.0, 0.0], [0.0, -1e-9]],
        inherited=(),
        standard_errors=(2.0, 0.0),
        held=(),
        held_slopes=((), ()),
        degrees_of_freedom=3.0,
    )
    rows = Known().after(SimpleNamespace(space=space), uncertainty, {"a": 0.0, "b": 0.0}).rows
    assert sorted(np.abs(rows["a"])) == [0.0, 2.0]
    assert list(np.abs(rows["b"])) == [0.0, 0.0]


def textbook():
    """Standard error of b alone, and with a at the mean of the idle run."""
    alone = SIGMA / np.sqrt(np.sum(LOADED**2))
    slope = -np.sum(LOADED) / np.sum(LOADED**2)
    return alone, slope, np.hypot(alone, slope * SIGMA / np.sqrt(IDLE.size))


def test_the_error_of_what_is_held_is_inherited(bench):
    stage = identify(campaign(LEVEL, SLOPE), simulators=bench).stage("slope")
    alone, slope, both = textbook()
    assert stage["b"].standard_error == pytest.approx(both, rel=1e-4)
    assert stage["b"].inherited == pytest.approx(1 - (alone / both) ** 2, rel=1e-4)
    uncertainty = stage.uncertainty
    assert uncertainty.held == ("a",)
    assert uncertainty.held_slopes[0][0] == pytest.approx(slope, rel=1e-6)
    assert uncertainty.degrees == (None,)  # sigma is given
    assert "inherited" in str(stage)
    assert "86 %" in str(stage)


def test_a_stage_alone_inherits_nothing(bench):
    stage = identify(campaign(LEVEL, SLOPE), simulators=bench, stages=["slope"]).stages[0]
    assert stage["b"].inherited == 0.0
    assert "inherited" not in str(stage)


def test_what_is_identified_again_is_forgotten(bench):
    again = StageSpec("again", ("loaded",), ("a", "b"))
    result = identify(campaign(LEVEL, SLOPE, again), simulators=bench)
    alone = identify(campaign(again), simulators=bench)
    assert result.stage("again").uncertainty.held == ()
    assert result["b"].standard_error == pytest.approx(alone["b"].standard_error, rel=1e-3)


def test_errors_go_through_ties_and_on_to_the_stage_after_next(bench):
    # c = 3 a is held where a is held: both move together. Then b is held, and its errors include those of a.
    tied = replace(LEVEL, tie={"c": "0.5*a"}, start={"a": 1.0})
    last = StageSpec("last", ("idle",), ("c",))
    result = identify(campaign(tied, SLOPE, last), simulators=bench)
    uncertainty = result.stage("last").uncertainty
    assert uncertainty.held == ("a", "b")  # c is free again
    assert uncertainty.held_slopes[0] == pytest.approx((-1.0, 0.0), abs=1e-6)
    # y = a + c, and a = y / 1.5: c has all of a's error in addition to the noise of the run.
    error = SIGMA / np.sqrt(IDLE.size)
    assert result["c"].standard_error == pytest.approx(np.hypot(error, error / 1.5), rel=1e-4)


def test_what_was_tied_has_its_share_of_the_error(bench):
    tied, again = replace(LEVEL, tie={"b": "0.25*a"}), replace(SLOPE, free=("a",))
    result = identify(campaign(tied, again), simulators=bench)
    assert result.stage("slope").uncertainty.held == ("b",)
    # a = mean(y - b t): the error of b, a quarter of the level's, counts with the mean time.
    alone, level = SIGMA / np.sqrt(LOADED.size), SIGMA / np.sqrt(IDLE.size)
    assert result["a"].standard_error == pytest.approx(np.hypot(alone, LOADED.mean() * level / 4), rel=1e-4)


def test_a_value_of_one_experiment_is_inherited_where_that_experiment_is_used_again(bench):
    again = StageSpec("again", ("idle",), ("c",))
    result = identify(campaign(LEVEL, again, a=ParameterSpec("a", 1.0, per="experiment")), simulators=bench)
    assert result.stage("again").uncertainty.held == ("a@idle",)
    # y = a + c, and both have the error of the mean.
    assert result["c"].standard_error == pytest.approx(SIGMA * np.sqrt(2 / IDLE.size), rel=1e-4)


def test_profiles_and_draws_contain_what_is_inherited(bench):
    asked = AnalysisSpec(profiles=True, monte_carlo=400)
    steady = CriterionSpec("y", "steady_state", demand=SIGMA, weight=0.0)
    judged = replace(SLOPE, criteria=(CriterionSpec("y"), steady))
    result = identify(campaign(LEVEL, judged), simulators=bench, analyses=asked)
    stage = result.stage("slope")
    assert stage.profiles[0].interval == pytest.approx(stage["b"].interval, rel=1e-3)
    # At the end of the run a + 10 b: a's error and what it does to b nearly cancel half of each other.
    alone, slope, _ = textbook()
    level = SIGMA / np.sqrt(IDLE.size)
    spread = np.hypot(10 * alone, (1 + 9.75 * slope) * level) / SIGMA
    drawn = stage.spread[1]
    assert drawn.high - drawn.median == pytest.approx(1.3 * spread, rel=0.5)


def test_what_has_no_standard_error_is_named(bench):
    spec = ParameterSpec("a", 1.0, 0.0, 1.5)
    stage = identify(campaign(LEVEL, SLOPE, a=spec), simulators=bench).stage("slope")
    assert stage["b"].inherited == 0.0
    assert any(w.endswith("because they have no standard error: a") for w in stage.warnings), stage.warnings


def test_a_resumed_run_inherits_the_same(bench, tmp_path):
    model = bench["bench"]
    asked = AnalysisSpec(monte_carlo=20)
    unbroken = identify(campaign(LEVEL, SLOPE), simulators=bench, out=tmp_path / "whole", analyses=asked)
    simulate, total = model.simulate, model.count
    for after in (total // 2, total - 30, total - 5):
        model.count = 0

        def killed(task, parameters, after=after):
            if model.count >= after:
                raise KeyboardInterrupt
            return simulate(task, parameters)

        model.simulate = killed
        identify(campaign(LEVEL, SLOPE), simulators=bench, out=tmp_path / "run", analyses=asked)
        model.simulate, before = simulate, model.count
        resumed = identify(
            campaign(LEVEL, SLOPE), simulators=bench, out=tmp_path / "run", analyses=asked, resume=True
        )
        assert model.count - before <= total - after + 5
        for a, b in zip(unbroken.stages, resumed.stages, strict=True):
            assert (a.estimates, a.uncertainty, a.spread) == (b.estimates, b.uncertainty, b.spread)


@pytest.mark.slow
def test_intervals_of_a_second_stage_hold_the_truth(bench):
    hits, draws = np.zeros(2), 400
    for seed in range(draws):
        stage = identify(campaign(LEVEL, SLOPE, seed=seed), simulators=bench).stage("slope")
        low, high = stage["b"].interval
        alone = stage["b"].standard_error * np.sqrt(1 - stage["b"].inherited)
        hits += low < B < high, abs(stage["b"].value - B) < 1.96 * alone
    inherited, plain = hits / draws
    assert 0.90 <= inherited <= 0.98
    assert plain < 0.7
