"""Losses on experiments left out, closures and advantages, on values worked out by hand."""

from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from fmuid.data.noise.runs import RepeatedRuns
from fmuid.diagnosis import cross_validation
from fmuid.diagnosis.cross_validation import (
    HeldOut,
    Null,
    advantage,
    closure,
    closure_interval,
    in_sample,
    leave_each_out,
)
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Refit, refit
from fmuid.effects.effect import Unknown
from fmuid.identification.problem.cases import measured_case
from fmuid.simulation.simulator import Simulator, Task, Variable

TIME = np.linspace(0.0, 1.0, 501)


def linear(slopes, keep=(0, 1, 2, 3)):
    """Measurements of y = slope t, one slope an experiment, and the model y = k t fitted to those of `keep`."""
    rng = np.random.default_rng(0)
    noise = 0.1 * rng.standard_normal((len(slopes), 5, 1, len(TIME)))
    runs = [RepeatedRuns(f"e{k}", "bench", TIME, ("y",), s * TIME + noise[k]) for k, s in enumerate(slopes)]
    observed = Observed.from_runs(runs).select([f"e{k}" for k in keep])

    def predict(points, near=None):
        return [[(p["k"] * TIME)[None] for _ in keep] for p in points]

    return observed, refit(predict, observed, [Unknown("k", 1.0, -100.0, 100.0, 0.01)])


def test_held_out_losses_are_those_of_fits_to_the_other_experiments():
    slopes = [2.0, 2.0, 2.0, 5.0]
    observed, fit = linear(slopes)
    held = leave_each_out(fit, observed)
    for left_out in range(4):
        others = [k for k in range(4) if k != left_out]
        _, alone = linear(slopes, keep=others)
        whiten = observed.whiteners[left_out]
        residual = whiten((alone.values["k"] * TIME)[None] - observed.runs[left_out].mean).ravel()
        residual = residual[observed.in_band[left_out]]
        assert held.loss[left_out] == pytest.approx(np.mean(residual**2) - 1 / 5, rel=1e-3, abs=1e-3)
    assert held.loss[3] > 3 * held.loss[0] > 0


def recorded(*deviations, bands=None, groups=None):
    """Experiments with the given (R, N) deviations of their runs from the mean."""
    runs = [SimpleNamespace(n_repeats=len(d), deviations=np.array(d, dtype=float)[:, None]) for d in deviations]
    whole = [np.ones(r.deviations.shape[2], bool) for r in runs]
    return SimpleNamespace(
        runs=runs,
        scatter=[r.deviations[:, 0] for r in runs],
        in_band=[np.array(b, bool) for b in bands] if bands else whole,
        repeats=np.array([float(r.n_repeats) for r in runs]),
        folds=tuple((e, slice(None)) for e in range(len(runs))),
        groups=groups or tuple(range(len(runs))),
        taken=[np.zeros(w.size) for w in whole],
    )


def constant(estimate, *measured, slopes=None, bounds=(-np.inf, np.inf), step=1.0):
    """The fit of y = k to one sample an experiment, or of y = slope k."""
    slopes = slopes or [1.0] * len(measured)
    residuals = tuple(np.array([s * estimate - y]) for s, y in zip(slopes, measured, strict=True))
    jacobian = tuple(np.array([[s]]) for s in slopes)
    unknown = Unknown("k", estimate, *bounds, step)
    return Refit((unknown,), {"k": estimate}, residuals, jacobian, 0.0, 0, True)


def test_an_experiment_is_predicted_by_the_mean_of_the_others_each_weighted_by_its_runs():
    once, twice, thrice = ([[0.0]] * n for n in (1, 2, 3))
    observed = recorded(once, twice, thrice)
    held = leave_each_out(constant(4.0, 1.0, 4.0, 6.0), observed)
    others = np.array([(2 * 4 + 3 * 6) / 5, (1 + 3 * 6) / 4, (1 + 2 * 4) / 3])
    assert held.loss == pytest.approx((others - [1, 4, 6]) ** 2 - [1, 1 / 2, 1 / 3], rel=1e-5)
    assert list(held.size) == [1.0, 1.0, 1.0]
    # Any other estimate leads there as well: the model is linear.
    elsewhere = leave_each_out(constant(-7.0, 1.0, 4.0, 6.0, step=10.0), observed)
    assert elsewhere.loss == pytest.approx(held.loss, rel=1e-4)


def test_a_prediction_may_miss_by_as_much_as_the_other_experiments_leave_it_uncertain():
    once, twice, thrice = ([[0.0]] * n for n in (1, 2, 3))
    observed = recorded(once, twice, thrice)
    held = leave_each_out(constant(4.0, 1.0, 4.0, 6.0), observed, within_errors=True)
    n = np.array([1.0, 2.0, 3.0])
    others = np.array([(2 * 4 + 3 * 6) / 5, (1 + 3 * 6) / 4, (1 + 2 * 4) / 3])
    # The mean of m runs has variance 1 / m: that of the difference is 1 / n + 1 / m, of the loss's own part 1 / n.
    assert held.loss == pytest.approx((others - [1, 4, 6]) ** 2 / (1 + n / (6 - n)) - 1 / n, rel=1e-5)


def test_what_only_one_experiment_shows_is_no_evidence_against_the_model_but_a_contradiction_is():
    observed = recorded([[0.0, 0.0]], [[0.0, 0.0]])
    unknowns = tuple(Unknown(n, 1.0, -np.inf, np.inf, 1.0) for n in "ab")
    # Experiment 0 sees both, experiment 1 their sum alone.
    jacobian = (np.eye(2), np.array([[1.0, 1.0], [0.0, 0.0]]))

    def loss(*residuals):
        fit = Refit(unknowns, {"a": 1.0, "b": 1.0}, tuple(map(np.array, residuals)), jacobian, 0.0, 0, True)
        return leave_each_out(fit, observed, within_errors=True).loss[0] + 1.0

    apart = np.array([5.0, -5.0]) / np.sqrt(2.0)  # a and b differ by what their sum does not tell
    together = np.array([5.0, 5.0]) / np.sqrt(2.0)
    assert loss(apart, [0.0, 0.0]) == pytest.approx(0.0, abs=1e-3)
    assert loss(together, [0.0, 0.0]) == pytest.approx(25.0 / (1.0 + 0.5) / 2.0, rel=1e-3)


def test_experiments_with_the_same_input_are_left_out_together():
    observed = recorded([[0.0]], [[0.0]], [[0.0]], groups=(0, 0, 2))
    held = leave_each_out(constant(3.0, 1.0, 2.0, 6.0), observed)
    assert held.loss == pytest.approx([25.0 - 1.0, 16.0 - 1.0, 4.5**2 - 1.0], rel=1e-5)


def test_what_the_others_hardly_see_is_held_by_a_prior_of_a_thousand_steps():
    step = 0.5
    observed = recorded([[0.0]], [[0.0]])
    fit = constant(0.0, 0.0, -1.0, slopes=[1.0, 1e-3 / step], step=step)
    # Of the second experiment alone: 1e-3 a step, as sure as the prior. Without that k would be -1 / (1e-3 / step).
    assert leave_each_out(fit, observed).loss[0] == pytest.approx((0.5 / (1e-3 / step)) ** 2 - 1.0, rel=1e-9)
    unseen = constant(5.0, 0.0, 0.0, slopes=[1.0, 0.0])
    assert leave_each_out(unseen, observed).loss[0] == pytest.approx(25.0 - 1.0)


def test_a_parameter_that_a_run_has_its_own_of_is_fitted_to_that_run():
    observed = recorded([[0.0, 0.0, 0.0]], [[0.0]])
    residuals = np.array([1.0, 2.0, 6.0]), np.array([0.0])
    # However little it moves the run.
    for name, column, loss, size in (
        ("k@e0", 1.0, 14.0 / 2.0, 2.0),
        ("k@e0", 0.1, 14.0 / 2.0, 2.0),
        ("k", 1.0, 41.0 / 3.0, 3.0),
    ):
        unknown = Unknown(name, 0.0, -9.0, 9.0, 1.0)
        slopes = np.full((3, 1), column), np.zeros((1, 1))
        fit = Refit((unknown,), {name: 0.0}, residuals, slopes, 0.0, 0, True)
        held = leave_each_out(fit, observed)
        assert held.loss == pytest.approx([loss - 1.0, -1.0])
        assert held.size == pytest.approx([size, 1.0])


@pytest.mark.parametrize(("steps_away", "moves"), [(0.5e-6, False), (2e-6, True)])
@pytest.mark.parametrize("bound", ["lower", "upper"])
def test_a_parameter_within_a_millionth_of_a_step_of_its_bound_is_at_it(bound, steps_away, moves):
    step = 8.0
    bounds = {"lower": (-steps_away * step, 9.0), "upper": (-9.0, steps_away * step)}[bound]
    held = leave_each_out(constant(0.0, 1.0, 3.0, bounds=bounds, step=step), recorded([[0.0]], [[0.0]]))
    assert held.loss == pytest.approx([4.0 - 1.0, 4.0 - 1.0] if moves else [1.0 - 1.0, 9.0 - 1.0])


def test_a_loss_is_beyond_what_noise_leaves_in_the_mean_and_counts_what_is_in_the_band():
    observed = recorded([[1.0, 9.0, -2.0], [-1.0, -9.0, 2.0]], [[0.0, 0.0, 0.0]], bands=[[1, 0, 1], [1, 1, 1]])
    held = cross_validation.losses([np.array([3.0, 99.0, 1.0]), np.array([1.0, 2.0, 2.0])], observed)
    assert held.loss == pytest.approx([(9 + 1) / 2 - 1 / 2, 9 / 3 - 1.0])
    assert held.per_run[0] == pytest.approx([(2**2 + 3**2) / 2 - 1.0, (4**2 + 1**2) / 2 - 1.0])
    assert held.per_run[1] == pytest.approx([2.0])
    assert list(held.size) == [2.0, 3.0]
    assert held.mean == pytest.approx((2 * 4.5 + 3 * 2.0) / 5)
    assert held.gap == pytest.approx(np.sqrt(3.0))


def test_parameters_that_no_experiment_tells_apart_can_be_held_out():
    observed, fit = linear([2.0, 2.0, 2.0, 5.0])
    alone = leave_each_out(fit, observed).loss
    twin = replace(fit.unknowns[0], name="twin")
    # So large that a ridge is lost in rounding.
    columns = tuple(1e9 * np.repeat(j, 2, axis=1) for j in fit.jacobian)
    both = replace(fit, unknowns=(*fit.unknowns, twin), values={**fit.values, "twin": 1.0}, jacobian=columns)
    assert leave_each_out(both, observed).loss == pytest.approx(alone, rel=1e-3)


def test_the_sizes_of_parameters_do_not_matter():
    observed = recorded(*[[[0.0, 0.0]]] * 3)
    residuals = tuple(np.array(r) for r in ([-1.0, -5.0], [-3.0, -7.0], [-8.0, -9.0]))
    unknowns = tuple(Unknown(n, 0.0, -np.inf, np.inf, 1.0) for n in "ab")
    losses = [
        leave_each_out(
            Refit(unknowns, {"a": 0.0, "b": 0.0}, residuals, (np.diag([1.0, size]),) * 3, 0.0, 0, True), observed
        ).loss
        for size in (1.0, 1e8)
    ]
    assert losses[0][0] == pytest.approx(((5.5 - 1.0) ** 2 + (8.0 - 5.0) ** 2) / 2 - 1.0, rel=1e-4)
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)


def test_every_run_has_a_loss_of_its_own():
    observed, fit = linear([2.0, 2.0, 2.0, 3.0])
    held = in_sample(fit, observed)
    for e, run in enumerate(observed.runs):
        for k, values in enumerate(run.values):
            residual = observed.whiteners[e]((fit.values["k"] * TIME)[None] - values).ravel()[observed.in_band[e]]
            assert held.per_run[e][k] == pytest.approx(np.mean(residual**2) - 1.0)


@pytest.mark.parametrize(("bound", "moves"), [("lower", False), ("upper", False), (None, True)])
def test_a_parameter_at_its_bound_stays_there_when_an_experiment_is_left_out(bound, moves):
    observed, fit = linear([2.0, 2.0, 2.0, 5.0])
    at = {"lower": (fit.values["k"], 100.0), "upper": (-100.0, fit.values["k"]), None: (-100.0, 100.0)}[bound]
    fit = replace(fit, unknowns=(Unknown("k", 1.0, *at, 0.01),))
    same = leave_each_out(fit, observed).loss == pytest.approx(in_sample(fit, observed).loss, rel=1e-9)
    assert same is not moves


def test_runs_of_a_complete_model_lose_nothing_when_left_out():
    observed, fit = linear([2.0, 2.0, 2.0, 2.0])
    held = leave_each_out(fit, observed)
    assert np.abs(held.loss).max() < 0.15
    assert held.gap < 0.3
    for losses in held.per_run:
        assert np.abs(losses).max() < 0.8  # three times what 33 components scatter by


class Constant(Simulator):
    """A model whose output is its parameter."""

    variables: ClassVar = {
        "k": Variable("k", "parameter", "fixed", start=1.0),
        "y": Variable("y", "output"),
    }

    def simulate(self, task, parameters):
        return np.full((1, len(task.time)), {"k": 1.0, **parameters}["k"])


def test_what_a_model_predicts_beyond_all_numbers_counts_as_a_failure():
    case = measured_case("run", Constant(), Task(TIME, {}, ("y",)), {"y": 1.0 + 0.1 * np.sin(40.0 * TIME)})
    model = CampaignModel((case,))
    observed = SimpleNamespace(residual=lambda _, y: y.ravel(), residuals=lambda ys: tuple(y.ravel() for y in ys))
    residuals, none = model.residuals_of([(0, {"k": 2.0}), (0, {"k": 1e200})], observed)
    assert residuals == pytest.approx(2.0)
    assert none is None
    assert model.residuals_at({"k": 1e200}, observed) is None


def lost(*loss):
    return HeldOut(np.array(loss), tuple(np.full(5, x) for x in loss), np.full(len(loss), 100.0))


def test_closure_is_the_share_of_the_gap_that_is_gone():
    before, after = lost(4.0, 4.0, 4.0), lost(1.0, 1.0, 1.0)
    assert closure(before, after) == pytest.approx(0.5)
    assert closure(before, lost(-0.1, 0.0, 0.1)) == pytest.approx(1.0)
    assert closure(lost(0.0, 0.0, 0.0), after) == 0.0
    assert closure(after, before) == pytest.approx(-1.0)
    assert closure(lost(0.01, 0.01, 0.01), before) == -1.0
    assert closure_interval(before, after) == pytest.approx((0.5, 0.5))
    # Also of a gap below one floor.
    assert closure_interval(lost(0.25, 0.25), lost(0.01, 0.01)) == pytest.approx((0.8, 0.8))
    low, high = closure_interval(before, lost(0.0, 1.0, 4.0))
    assert low <= closure(before, lost(0.0, 1.0, 4.0)) <= high
    # A single new experiment may be like any of those measured.
    silent = Null(np.zeros(9), np.zeros(9), experiments=3)
    assert closure_interval(before, lost(0.0, 1.0, 4.0), null=silent) == pytest.approx((0.0, 1.0))
    assert high - low < 0.8
    # Three pieces of one run are not three experiments.
    cut = replace(silent, experiments=1)
    assert closure_interval(before, lost(0.0, 1.0, 4.0), null=cut) == pytest.approx((low, high), abs=0.05)
    assert high - low > 0.3
    # New runs have noise of their own: a gap that is gone is measured as one within it.
    gone = lost(0.0, 0.0, 0.0)
    assert closure_interval(before, gone) == pytest.approx((1.0, 1.0))
    low, high = closure_interval(before, gone, null=Null(np.linspace(-0.2, 0.2, 401), np.zeros(1)))
    assert low == pytest.approx(1.0 - np.sqrt(0.16 / 4.16), abs=0.02)  # nine of ten are above it
    assert high == pytest.approx(1.0)
    # One draw in four is 1.5 above the mean, the others are 0.5 below it.
    skew = closure_interval(before, gone, null=Null(np.array([9.5, 11.5, 9.5, 9.5]), np.zeros(1)))
    assert skew == pytest.approx((1.0 - np.sqrt(1.5 / 5.5), 1.0))
    # Experiments without a gap have nothing to close.
    one_of_three = closure_interval(lost(0.0, 0.0, 4.0), lost(0.0, 0.0, 0.04), null=silent)
    assert one_of_three == pytest.approx((0.9, 0.9))
    assert lost(-0.5, 0.2).gap == 0.0
    assert closure_interval(gone, gone) == (0.0, 0.0)  # of no gap, nothing can be closed


def test_a_closure_counts_experiments_by_their_size_and_runs_as_they_come():
    def of(size, *losses):
        return HeldOut(np.array([np.mean(x) for x in losses]), tuple(map(np.array, losses)), np.array(size))

    # The small experiment is not closed at all, the large one wholly: 1 in 100 of the energy is left.
    before, after = of([99.0, 1.0], [1.0], [1.0]), of([99.0, 1.0], [0.0], [1.0])
    assert closure(before, after) == pytest.approx(0.9)
    assert closure_interval(before, after)[0] == pytest.approx(1.0 - np.sqrt(2 / 2), abs=1e-9)
    few = closure_interval(before, after, level=0.4)
    assert few[0] == pytest.approx(0.9)
    # Two runs of one experiment: half of the draws have both, a quarter each one twice.
    before, after = of([9.0], [4.0, 4.0]), of([9.0], [0.0, 2.0])
    both, mixed, none = 1.0 - np.sqrt(0.5), 0.5, 1.0
    assert closure_interval(before, after) == pytest.approx((both, none))
    assert closure_interval(before, after, level=0.7) == pytest.approx((both, mixed))  # the shorter one
    assert closure_interval(before, after, level=0.4) == pytest.approx((mixed, mixed))


def test_a_closure_interval_is_one_of_90_percent_and_the_same_each_time():
    rng = np.random.default_rng(0)
    before, after = (
        HeldOut(x.mean(axis=1), tuple(x), np.full(6, 100.0))
        for x in (rng.uniform(a, a + 1, (6, 5)) for a in (4, 1))
    )
    interval = closure_interval(before, after)
    assert interval == closure_interval(before, after, level=0.9, draws=2000, seed=0)
    for other in ({"level": 0.91}, {"draws": 1999}, {"draws": 2001}, {"seed": 1}):
        assert interval != closure_interval(before, after, **other)


def test_an_advantage_that_the_runs_do_not_agree_on_is_within_its_error():
    def scattered(*losses):
        per_run = tuple(np.array(x, dtype=float) for x in losses)
        return HeldOut(np.array([x.mean() for x in per_run]), per_run, np.full(len(losses), 100.0))

    gained, error = advantage(scattered([4, 4, 4], [4, 4, 4]), scattered([0, 9, 4], [4, 8, 1]))
    assert abs(gained) < error
    gained, error = advantage(scattered([0, 1, 0], [0, 0, 1]), scattered([8, 8, 7], [7, 8, 8]))
    assert gained == pytest.approx(22 / 3, abs=0.1)
    assert gained > 5 * error


def test_the_error_of_an_advantage_is_that_of_a_mean_over_the_runs():
    """With n - 1 in the denominator: of the runs, and where none is repeated of the pieces."""
    worse = HeldOut(np.array([2.0]), (np.array([1.0, 3.0]),), np.array([100.0]))
    better = HeldOut(np.zeros(1), (np.zeros(2),), np.array([100.0]))
    assert advantage(better, worse) == pytest.approx((2.0, 1.0))
    pieces = HeldOut(np.array([1.0, 3.0]), (np.array([1.0]), np.array([3.0])), np.array([100.0, 100.0]))
    none = HeldOut(np.zeros(2), (np.zeros(1), np.zeros(1)), np.array([100.0, 100.0]))
    assert advantage(none, pieces) == pytest.approx((2.0, 1.0))
    three = HeldOut(np.array([1.0, 3.0, 8.0]), (np.ones(1), np.ones(1), np.ones(1)), np.full(3, 100.0))
    nothing = HeldOut(np.zeros(3), (np.zeros(1), np.zeros(1), np.zeros(1)), np.full(3, 100.0))
    assert advantage(nothing, three) == pytest.approx((4.0, np.sqrt(3 / 2 * 26 / 9)))
    # One run alone has no scatter.
    one, zero = (HeldOut(np.array([x]), (np.ones(1),), np.array([100.0])) for x in (3.0, 0.0))
    assert advantage(zero, one) == (3.0, 0.0)
    # The scatter of runs without repeats is unknown: they add nothing.
    mixed = HeldOut(np.array([2.0, 5.0]), (np.array([1.0, 3.0]), np.array([5.0])), np.array([100.0, 100.0]))
    still = HeldOut(np.zeros(2), (np.zeros(2), np.zeros(1)), np.array([100.0, 100.0]))
    assert advantage(still, mixed) == pytest.approx((3.5, 0.5))
    # Three quarters of the samples in one experiment; runs that differ alike under both models say nothing.
    worse = HeldOut(np.array([2.0, 5.0]), (np.array([1.0, 3.0]), np.array([4.0, 6.0])), np.array([300.0, 100.0]))
    better = HeldOut(np.array([1.0, 1.0]), (np.array([0.0, 2.0]), np.array([2.0, 0.0])), np.array([300.0, 100.0]))
    assert advantage(better, worse) == pytest.approx((0.75 + 1.0, 0.25 * 2.0))
