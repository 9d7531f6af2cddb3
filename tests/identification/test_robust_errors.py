"""Intervals where the model is not complete, and what a stage reports then."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fmuid import ParameterSpec, Problem, Status, StopRules, Task, identify, measured_case
from tests.identification.test_held import LEVEL, SLOPE, campaign, line

TIME = np.arange(300) * 0.02
TRUTH = {"k": 2.0, "T": 0.5, "b": 0.1}
SIGMA = 0.05


def lag(time, inputs, p):
    decay = np.exp(-0.02 / p["T"])
    return {"y": p["k"] * lfilter([0.0, 1.0 - decay], [1.0, -decay], inputs["u"]) + p["b"]}


def runs(analytic, kind, seed, count=6, scatter=0.03, stated=None):
    """Runs of a first-order lag that differ from the model, or whose noise does; `stated` is sigma of inputs."""
    random, fixed, cases = np.random.default_rng(seed), np.random.default_rng(99), []
    for k in range(count):
        steps = np.repeat(fixed.uniform(-1.0, 1.0, 16), 20)[:300]
        u = steps if k % 2 else np.sin(2.0 * np.pi * (0.3 + 0.3 * k) * TIME) * fixed.uniform(0.5, 2.0)
        gain = 1.0 + scatter * random.standard_normal() * (kind == "gain")
        y = lag(TIME, {"u": u}, TRUTH | {"k": gain * TRUTH["k"]})["y"]
        if kind == "friction":
            y = y - 0.3 * np.tanh(20.0 * np.gradient(y))
        if kind == "saturation":
            y = np.clip(y, -1.5 * np.std(y), 1.5 * np.std(y))
        level = 0.01 + 0.1 * np.abs(y) if kind == "signal" else SIGMA
        measured = y + level * random.standard_normal(300)
        recorded = u + 0.1 * random.standard_normal(300) * (kind == "inputs")
        task = Task(TIME, {"u": recorded}, ("y",), {}, "hold")
        sigma = {"y": SIGMA} if stated is None else {"y": SIGMA, "u": stated}
        cases.append(measured_case(f"run{k}", analytic(lag, list(TRUTH)), task, {"y": measured}, sigma=sigma))
    specs = [
        ParameterSpec("k", 1.5, 0.1, 10.0),
        ParameterSpec("T", 0.4, 0.05, 5.0, scale="log"),
        ParameterSpec("b", 0.05),
    ]
    return Problem(cases, specs)


@pytest.mark.parametrize("kind", ["white", "gain", "inputs", "signal"])
def test_intervals_hold_the_truth_in_nineteen_of_twenty_campaigns(analytic, kind):
    inside = []
    for seed in range(40):
        stage = identify(runs(analytic, kind, seed)).stages[0]
        inside += [stage[n].interval[0] < value < stage[n].interval[1] for n, value in TRUTH.items()]
    assert 0.9 <= np.mean(inside) <= 0.99


def test_known_noise_of_inputs_is_not_a_scatter_between_runs(analytic):
    silent, stated = (
        [identify(runs(analytic, "inputs", seed, stated=sigma)).stages[0].uncertainty.robust for seed in range(30)]
        for sigma in (None, 0.1)
    )
    assert np.mean([len(names) for names in silent]) > 1.5
    assert np.mean([len(names) for names in stated]) < 1.7  # of three


def test_robust_errors_are_marked_and_explained(analytic):
    stage = identify(runs(analytic, "gain", 3, scatter=0.1)).stages[0]
    assert "k" in stage.uncertainty.robust
    assert stage["k"].note == "robust"
    assert "robust" in str(stage).splitlines()[2]
    assert any("k, T, b: robust standard errors, from the scatter between 6 runs" in w for w in stage.warnings)
    plain = identify(runs(analytic, "white", 1)).stages[0]
    assert plain.uncertainty.robust == ()
    assert "note" not in str(plain).splitlines()[1]


def test_equal_experiments_have_one_degree_of_freedom_less_than_their_number(analytic):
    """One that dominates leaves fewer: the scatter of the others is that of estimates that hardly count."""
    wide = lambda time, inputs, p: {"y": p["a"] * np.sin(time) * inputs["u"]}  # noqa: E731

    def degrees(sizes):
        random, model = np.random.default_rng(0), analytic(wide, ["a"])
        cases = []
        for k, size in enumerate(sizes):
            y = size * np.sin(TIME) * (1.0 + 0.3 * random.standard_normal()) + SIGMA * random.standard_normal(300)
            task = Task(TIME, {"u": np.full(300, size)}, ("y",))
            cases.append(measured_case(f"run{k}", model, task, {"y": y}, sigma={"y": SIGMA}))
        uncertainty = identify(Problem(cases, [ParameterSpec("a", 0.5)])).stages[0].uncertainty
        assert uncertainty.robust == ("a",)
        return uncertainty.degrees[0]

    assert degrees([1.0] * 5) == pytest.approx(4.0)
    assert 1.0 <= degrees([10.0, 1.0, 1.0, 1.0, 1.0]) < 2.0


def test_a_parameter_that_differs_between_repeats_has_the_error_of_their_scatter(analytic):
    random, u = np.random.default_rng(2), np.sin(2.0 * np.pi * 0.6 * TIME)
    task, inside = Task(TIME, {"u": u}, ("y",), {}, "hold"), []
    specs = [ParameterSpec("k", 1.5, 0.1, 10.0), ParameterSpec("T", 0.4, 0.05, 5.0), ParameterSpec("b", 0.0)]
    for _ in range(20):
        gains = TRUTH["k"] * (1.0 + 0.1 * random.standard_normal(5))
        y = np.array([lag(TIME, {"u": u}, TRUTH | {"k": k})["y"] for k in gains])
        y += SIGMA * random.standard_normal(y.shape)
        case = measured_case("run", analytic(lag, list(TRUTH)), task, {"y": y}, sigma={"y": SIGMA})
        stage = identify(Problem([case], specs)).stages[0]
        assert stage["k"].standard_error == pytest.approx(np.std(gains, ddof=1) / np.sqrt(5), rel=0.3)
        assert any("k" in w and "the scatter between 5 runs" in w for w in stage.warnings)
        inside.append(stage["k"].interval[0] < TRUTH["k"] < stage["k"].interval[1])
    assert np.mean(inside) >= 0.85


@pytest.mark.parametrize(("kind", "count"), [("friction", 1), ("friction", 2), ("white", 2), ("friction", 6)])
def test_too_few_experiments_are_named_where_the_model_does_not_follow_them(analytic, kind, count):
    stage = identify(runs(analytic, kind, 1, count=count)).stages[0]
    doubts = [w for w in stage.warnings if "intervals may be too narrow" in w]
    assert len(doubts) == (kind == "friction" and count <= 2)
    if doubts:
        assert f"{count} run{'s do' if count > 1 else ' does'} not show" in doubts[0]


def test_a_residual_that_is_not_white_is_in_the_headline(analytic):
    wrong = identify(runs(analytic, "friction", 1)).stages[0]
    assert wrong.status is Status.CONVERGED
    assert not wrong.sound  # so it is not shown in green
    assert "% of y unexplained, not white" in wrong.summary
    right = identify(runs(analytic, "white", 1)).stages[0]
    assert right.sound
    assert "unexplained" not in right.summary


def test_residuals_at_large_signals_are_not_mistaken_for_noise_that_grows(analytic):
    """They are near zero elsewhere, so a plant that saturates looks like a complete model with such noise."""
    for seed in range(10):
        stage = identify(runs(analytic, "saturation", seed)).stages[0]
        assert "% of y unexplained, not white" in stage.summary
        variances = [w.variance for w in stage.uncertainty.whiteness]
        assert np.mean(variances) == pytest.approx(stage.cost / (6 * 300), rel=1e-6)


def test_white_noise_that_grows_with_the_signal_is_white(analytic):
    chances = []
    for seed in range(40):
        stage = identify(runs(analytic, "signal", seed)).stages[0]
        assert "not white" not in stage.summary
        chances += [w.p_value for w in stage.uncertainty.whiteness]
    assert np.mean(np.array(chances) < 0.01) < 0.02
    assert 0.02 < np.mean(np.array(chances) < 0.05) < 0.08


def test_new_runs_are_expected_as_far_off_as_those_that_were_left_out(analytic):
    stage = identify(runs(analytic, "friction", 1)).stages[0]
    (expected,) = stage.uncertainty.new_runs
    assert expected.runs == 6
    assert 2.0 * expected.rmse < 2.0 * expected.half_width < 6.0 * expected.rmse
    assert f"y within ±{expected.half_width:.3g} of its prediction (6 runs, each predicted" in str(stage)
    complete = identify(runs(analytic, "white", 1)).stages[0]
    assert complete.uncertainty.new_runs[0].rmse == pytest.approx(SIGMA, rel=0.05)
    assert "new runs" not in str(complete)
    assert identify(runs(analytic, "friction", 1, count=1)).stages[0].uncertainty.new_runs == ()


def test_a_small_coloured_residual_above_the_noise_is_in_the_headline(analytic):
    def offset(time, inputs, p):
        return {"y": p["a"] * time}

    def stage(missed):
        time = np.linspace(0.0, 10.0, 2000)
        y = 100.0 * time + missed * np.sin(3.0 * time) + 0.1 * np.random.default_rng(0).standard_normal(2000)
        case = measured_case("run", analytic(offset, "a"), Task(time, {}, ("y",)), {"y": y}, sigma={"y": 0.1})
        return identify(Problem([case], [ParameterSpec("a", 90.0)])).stages[0]

    assert "% of y unexplained, not white" in stage(0.15).summary
    assert stage(0.15).sound
    assert "unexplained" not in stage(0.0).summary


def orbit(slopes, start):
    """A model that integrates its state by fixed steps of the classical Runge-Kutta method."""

    def simulate(time, inputs, p):
        x, h, seen = np.array(start), (time[1] - time[0]) / 4, [start[0]]
        for _ in time[1:]:
            for _ in range(4):
                a = slopes(x, p)
                b = slopes(x + h / 2 * a, p)
                c = slopes(x + h / 2 * b, p)
                x = x + h / 6 * (a + 2 * b + 2 * c + slopes(x + h * c, p))
            seen.append(x[0])
        return {"x": np.array(seen)}

    return simulate


VAN_DER_POL = orbit(lambda x, p: np.array([x[1], p["mu"] * (1 - x[0] ** 2) * x[1] - x[0]]), [2.0, 0.0])
LORENZ = orbit(
    lambda x, p: np.array([p["s"] * (x[1] - x[0]), x[0] * (p["r"] - x[2]) - x[1], x[0] * x[1] - p["b"] * x[2]]),
    [1.0, 1.0, 1.0],
)


@pytest.mark.parametrize("sigma", [0.02, None])
@pytest.mark.parametrize(
    ("model", "step", "truth", "starts"),
    [
        (VAN_DER_POL, 0.1, {"mu": 3.0}, [{"mu": 0.5}, {"mu": 6.0}]),
        (LORENZ, 0.04, {"s": 10.0, "r": 28.0, "b": 8 / 3}, [{"s": 6.0, "r": 40.0, "b": 2.0}]),
    ],
)
def test_a_fit_of_the_wrong_regime_is_not_sound(analytic, model, step, truth, starts, sigma):
    time = step * np.arange(250)
    y = model(time, {}, truth)["x"] + 0.02 * np.random.default_rng(0).standard_normal(250)
    for start in starts:
        specs = [ParameterSpec(name, value, 0.05, 100.0) for name, value in start.items()]
        known = None if sigma is None else {"x": sigma}
        case = measured_case("run", analytic(model, truth, ["x"]), Task(time, {}, ("x",)), {"x": y}, sigma=known)
        stage = identify(Problem([case], specs), stop=StopRules(evaluations=100)).stages[0]
        assert not stage.sound
        assert "of x unexplained, not white" in stage.summary
        assert any('segments = "auto"' in w for w in stage.warnings)


def test_segments_are_advised_where_sensitivities_explode(analytic):
    """A logistic map in its chaotic regime, started a little aside."""

    def chaos(time, inputs, p):
        x = [p["x"]]
        for _ in time[1:]:
            x.append(p["r"] * x[-1] * (1.0 - x[-1]))
        return {"y": np.array(x)}

    time = np.arange(60.0)
    y = chaos(time, {}, {"x": 0.3, "r": 3.9})["y"]
    case = measured_case("run", analytic(chaos, ["x", "r"]), Task(time, {}, ("y",)), {"y": y}, sigma={"y": 1e-3})
    problem = Problem([case], [ParameterSpec("x", 0.3, free=False), ParameterSpec("r", 3.97, 3.93, 4.0)])
    stage = identify(problem).stages[0]
    assert not stage.sound
    assert any("as in chaos" in w and 'segments = "auto"' in w for w in stage.warnings)


def test_segments_are_advised_where_sensitivities_grow_without_bound(analytic):
    growing = lambda time, inputs, p: {"y": 1e-3 * np.exp(p["a"] * time)}  # noqa: E731
    y = 5.0 + np.sin(TIME)
    case = measured_case("run", analytic(growing, ["a"]), Task(TIME, {}, ("y",)), {"y": y}, sigma={"y": SIGMA})
    stage = identify(Problem([case], [ParameterSpec("a", 1.0)])).stages[0]
    assert any("sensitivities grow by a factor of" in w and 'segments = "auto"' in w for w in stage.warnings)


def test_estimates_are_conditional_on_what_only_a_later_stage_identifies(analytic):
    bench = {"bench": analytic(line, ["a", "b", "c", "load"])}
    held = replace(SLOPE, name="first")  # holds the level at its start
    result = identify(campaign(held, LEVEL, SLOPE), simulators=bench)
    first, _, last = result.stages
    assert first["b"].note.split(", ")[-1] == "conditional"
    assert "conditional on values that only later stages identify: a" in first.warnings
    assert last["b"].note == "one run"
    assert not any("conditional" in w for w in last.warnings)


@pytest.mark.parametrize(("count", "mark"), [(1, "one run"), (2, "few runs"), (6, "")])
def test_intervals_from_few_runs_say_that_they_hold_for_these(analytic, count, mark):
    stage = identify(runs(analytic, "white", 1, count=count)).stages[0]
    assert {e.note for e in stage.estimates} - {"robust"} == {mark}
    assert ("differs from run to run; record at least four" in str(stage)) == bool(mark)


def test_a_value_of_a_single_run_is_not_conditional_on_it(analytic):
    problem = runs(analytic, "white", 1)
    specs = [replace(spec, per="experiment") if spec.name == "b" else spec for spec in problem.space.free]
    stage = identify(Problem(problem.cases, specs)).stages[0]
    assert {stage[f"b@run{k}"].note for k in range(6)} == {""}
