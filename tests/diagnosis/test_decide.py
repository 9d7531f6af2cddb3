"""From losses, gaps and residuals to a verdict: each rule on values worked out by hand."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from fmuid.diagnosis import candidates, decide, diagnose
from fmuid.diagnosis.candidates import Fitted, _log_prior
from fmuid.diagnosis.cross_validation import HeldOut
from fmuid.diagnosis.decide import (
    closed_by,
    lumped,
    names,
    stable,
    strained,
    survivors,
)
from fmuid.diagnosis.free_functions import Decoy
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.summary import _gap_text
from fmuid.diagnosis.verdict import NONE, UNKNOWN
from fmuid.effects.effect import Effect, Unknown


@dataclass(frozen=True)
class Recorded:
    """What the rules ask of measurements: how often each experiment was repeated, and whether its noise is a bound."""

    repeats: np.ndarray
    bounded: bool = False

    @property
    def runs(self):
        return tuple(SimpleNamespace(id=f"e{k}") for k in range(len(self.repeats)))

    @property
    def folds(self):
        return tuple((k, slice(None)) for k in range(len(self.repeats)))

    @property
    def groups(self):
        return tuple(range(len(self.repeats)))


@dataclass(frozen=True, eq=False)
class Tried:
    """The score of an effect, and those that stand for the same."""

    effect: str
    same: tuple["Tried", ...] = ()


def lost(*loss):
    return HeldOut(np.array(loss), tuple(np.full(5, x) for x in loss), np.full(len(loss), 100.0))


def fitted(effects, gap, *, held_out=None, residuals=((),), cost=0.0, parameters=0):
    """A model that leaves `gap` floors, on experiments left out `held_out` floors."""
    unknowns = tuple(Unknown(f"p{k}", 0.0, -1.0, 1.0, 0.1) for k in range(parameters))
    fit = Refit(unknowns, {}, tuple(np.array(r, dtype=float) for r in residuals), (), cost, 0, True)
    losses = lost((gap if held_out is None else held_out) ** 2)
    return Fitted(effects, fit, losses, losses, gap)


def free(left):
    """A free function that leaves so many floors on experiments left out."""
    return Decoy("speed", lost(left**2), ())


def scattered(*losses):
    """Losses of two runs an experiment."""
    per_run = tuple(np.array(x, dtype=float) for x in losses)
    return HeldOut(np.array([x.mean() for x in per_run]), per_run, np.full(len(losses), 100.0))


RECORDED = Recorded(np.array([4.0, 9.0]))
"""Whitened residuals of the second experiment count three times, those of the first one twice."""


def test_a_separation_is_the_difference_of_costs_over_twice_the_distance():
    a, b = (fitted((n,), 0.0, residuals=[[1.0, 0.0], [y]]) for n, y in (("a", 0.0), ("b", 2.0)))
    # Costs 4 and 4 + 36, a distance of 6.
    assert decide.separation(a, b, RECORDED) == pytest.approx(36.0 / 12.0)
    assert decide.separation(b, a, RECORDED) == pytest.approx(-36.0 / 12.0)
    assert decide.separation(a, a, RECORDED) == 0.0
    assert decide.separation(a, b, RECORDED, without=0) == pytest.approx(3.0)
    assert decide.separation(a, b, RECORDED, without=1) == 0.0


def test_what_the_better_model_leaves_widens_a_separation():
    a = fitted(("a",), 0.3, residuals=[[0.0], [1.0]])
    b = fitted(("b",), 0.8, residuals=[[0.0], [3.0]])
    # 6.5 runs an experiment on average, 20 samples of model error counting as one of noise.
    wider = np.sqrt(1.0 + 20.0 * 6.5 * 0.3**2)
    assert decide.separation(a, b, RECORDED) == pytest.approx(9.0 * 8.0 / (2.0 * 6.0) / wider)
    assert decide.separation(b, a, RECORDED) == pytest.approx(-9.0 * 8.0 / (2.0 * 6.0) / wider)
    assert decide.spread(0.0) == 1.0
    assert decide.spread(0.4) == pytest.approx(3.0)


def test_start_states_of_every_run_are_paid_for():
    """100 samples, an effect with one parameter, and two runs with three start states each."""
    taken = tuple(np.zeros((50, 3)) for _ in range(2))
    band = tuple(np.ones(50, dtype=bool) for _ in range(2))
    observed = SimpleNamespace(repeats=np.ones(2), nuisances=taken, in_band=band, taken=[np.zeros(50)] * 2)
    started = Refit((), {}, (np.ones(50), np.ones(50)), (), 100.0, 0, True)  # leaves nothing beyond noise
    nominal = fitted((), 2.0, cost=500.0)
    for cost in (120.0, 130.0):
        explained = fitted(("drag",), np.sqrt(cost / 100.0 - 1.0), cost=cost, parameters=1)
        expected = (cost - 100.0) / 2.0 - 0.5 * (6 - 1) * np.log(100.0)
        assert decide.odds_of_starts(started, nominal, explained, observed) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("cost", "left", "matter"),
    [(116.9, 0.0, True), (116.7, 0.0, False), (116.9, 0.5, False), (201.0, 0.5, True), (200.7, 0.5, False)],
)
def test_runs_contradict_start_states_beyond_what_chance_would_gain(cost, left, matter):
    """Two runs with three start states each: 99 % of chi-squared with six degrees of freedom are below 16.81."""
    taken = tuple(np.zeros((50, 3)) for _ in range(2))
    band = tuple(np.ones(50, dtype=bool) for _ in range(2))
    observed = SimpleNamespace(repeats=np.ones(2), nuisances=taken, in_band=band, taken=[np.zeros(50)] * 2)
    rest = tuple(np.full(50, np.sqrt(1.0 + left**2)) for _ in range(2))
    started = Refit((), {}, rest, (), 100.0, 0, True)
    assert decide.starts_matter(started, fitted((), 2.0, cost=cost), observed) is matter


def test_start_states_that_all_runs_share_are_paid_for_once():
    observed = SimpleNamespace(repeats=np.ones(2), in_band=[np.ones(50, dtype=bool)] * 2, taken=[np.zeros(50)] * 2)
    shared = Refit((), {}, (np.ones(50), np.ones(50)), (), 100.0, 0, True)
    drag = fitted(("drag",), 0.0, cost=108.0, parameters=1)
    odds = decide.odds_of_starts(shared, fitted((), 2.0, cost=500.0), drag, observed, 3)
    assert odds == pytest.approx(4.0 - 0.5 * (3 - 1) * np.log(100.0))


def test_a_further_effect_may_show_in_some_experiments_only():
    """What it gains in each is in proportion to what it does there; that of another effect alone is chance."""
    recorded = Recorded(np.array([1.0, 1.0]))
    both = fitted(("a", "b"), 1.0, residuals=[[1.0], [1.0]])
    one, other = (fitted((n,), 9.0, residuals=[[1.0], [101.0]]) for n in ("a", "c"))
    gained, apart = 101.0**2 - 1.0, 100.0
    assert decide.separation(both, one, recorded) == pytest.approx(gained / (2.0 * apart * np.sqrt(21.0)))
    chance = (
        0.5 * gained / (2.0 * apart)
    )  # half of the gain may be error of the models, and it differs by all of it
    assert decide.separation(both, other, recorded) == pytest.approx(gained / (2.0 * apart * chance))


def test_noise_that_is_a_bound_counts_as_large_as_what_is_left_where_models_differ():
    single = Recorded(np.array([1.0, 1.0]), bounded=True)
    a = fitted(("a",), 0.0, residuals=[[1.0, 0.0], [3.0]])
    b = fitted(("b",), 0.0, residuals=[[1.0, 0.0], [5.0]])
    # All of the difference, 2, lies where the better one leaves 3.
    for first, second, sign in ((a, b, 1.0), (b, a, -1.0)):
        assert decide.separation(first, second, single) == pytest.approx(sign * 16.0 / 4.0 / 3.0)
    quiet = fitted(("c",), 0.0, residuals=[[1.0, 2.0], [3.0]])  # where the better one leaves nothing: as by noise
    assert decide.separation(a, quiet, single) == pytest.approx(1.0)


def test_a_difference_scatters_as_much_as_from_experiment_to_experiment():
    """Both leave much. The one is better in one experiment, the other in the next: neither is preferred."""
    a = fitted(("a",), 2.0, residuals=[[20.0, 0.0], [30.0, 0.0]])
    b = fitted(("b",), 2.0, residuals=[[30.0, 1.0], [21.0, 1.0]])
    twice = Recorded(np.array([1.0, 1.0]))
    each = np.array([30.0**2 + 1.0 - 20.0**2, 21.0**2 + 1.0 - 30.0**2])
    scatter = 4.0 / 5.0 * np.sqrt(2.0) * each.std(ddof=1)
    assert decide.separation(a, b, twice) == pytest.approx(each.sum() / scatter)
    assert abs(decide.log_odds(a, b, twice)) < 0.1


def test_prior_odds_decide_between_models_that_fit_alike():
    usual, varying = (
        replace(fitted((n,), 0.0, residuals=[[1.0], [1.0]]), log_prior=p) for n, p in (("a", -2.0), ("b", -5.0))
    )
    assert decide.log_odds(usual, varying, RECORDED) == pytest.approx(3.0)
    assert decide.best_of([varying, usual], RECORDED) is usual


def test_every_law_and_every_place_of_a_law_is_equally_probable():
    """Two laws at four places, and nine laws by which 25 coefficients may vary."""
    of_catalogue = [SimpleNamespace(id=f"{k}", law=law, among=1) for k, law in enumerate(("loss", "gain") * 2)]
    varies = SimpleNamespace(id="varies", law="varies", among=225)
    subject = SimpleNamespace(by_id={e.id: e for e in (*of_catalogue, varies)})
    loss, gain = (_log_prior(subject, [e]) for e in of_catalogue[:2])
    assert loss == gain == pytest.approx(-np.log(11.0 * 2.0))
    assert _log_prior(subject, [varies]) == pytest.approx(-np.log(11.0 * 25.0))
    assert _log_prior(subject, [of_catalogue[0], varies]) == pytest.approx(loss - np.log(11.0 * 25.0))
    assert _log_prior(subject, []) == 0.0


def test_what_left_out_experiments_contradict_is_not_named_within_errors():
    """Uncertain parameters excuse predictions that are poor, but not ones that double the gap."""
    nominal = replace(
        fitted((), 1.0), held_out=scattered([1.0, 1.1], [1.0, 1.1]), judged=scattered([1.0, 1.1], [1.0, 1.1])
    )
    excused = scattered([0.0, 0.1], [0.0, 0.1])
    worse = replace(fitted(("a",), 0.1), held_out=scattered([4.0, 4.1], [5.0, 5.2]), judged=excused)
    similar = replace(worse, held_out=scattered([1.0, 1.1], [0.98, 1.14]))
    assert decide.closed_by(nominal, worse) < 0.0
    assert not decide.names(nominal, worse, finished=True)
    assert decide.closed_by(nominal, similar) > 0.6
    assert decide.names(nominal, similar, finished=True)


def test_the_best_answer_is_the_one_that_holds_up_on_other_data_among_those_that_fit_as_well():
    def of(name, cost, held_out):
        return fitted((name,), 1.0, held_out=held_out, cost=cost, residuals=[[0.0], [np.sqrt(cost / 9.0)]])

    well, near, far = of("well", 1000.0, 0.9), of("near", 1070.0, 0.5), of("far", 1070.1, 0.1)
    assert decide.best_of([well, near, far], RECORDED) is near
    assert decide.best_of([well, far], RECORDED) is well


def test_names_that_close_far_less_are_not_listed_beside_the_best():
    """With little noise to tell them apart by, answers that leave much more of the gap are still none."""
    best, near, far = (
        fitted((n,), g, residuals=[[0.0], [0.01 * k]], cost=k)
        for k, (n, g) in enumerate([("best", 1.0), ("near", 1.75), ("far", 1.76)])
    )
    pair = fitted(("near", "best"), 1.0, residuals=[[0.0], [0.0]])
    again = fitted(("near",), 1.2, residuals=[[0.0], [0.03]], cost=9.0)
    answers = survivors(best, [far, again, near, pair, best], RECORDED)
    assert [f.effects for f in answers] == [("best",), ("near",)]
    assert answers[1] is near


def test_the_likeliest_answer_weighs_most_whatever_predicts_experiments_left_out_best():
    best, likelier = (fitted((n,), 0.0, residuals=[[0.0], [y]]) for n, y in (("best", 0.6), ("likelier", 0.0)))
    weights = decide.weigh(fitted((), 1.0), [best, likelier], RECORDED, "ambiguous")
    odds = decide.log_odds(likelier, best, RECORDED)
    assert odds > 1.0
    assert weights["likelier",] / weights["best",] == pytest.approx(np.exp(odds))


def test_odds_follow_from_the_difference_of_costs_and_the_number_of_parameters():
    a, b = (fitted((n,), 0.0, residuals=[[0.0], [y]]) for n, y in (("a", 0.0), ("b", 0.5)))
    assert decide.log_odds(a, b, RECORDED) == pytest.approx(0.5 * 1.5**2)
    assert decide.log_odds(b, a, RECORDED) == pytest.approx(-0.5 * 1.5**2)
    assert decide.log_odds(a, a, RECORDED) == 0.0
    larger = fitted(("b",), 0.0, residuals=[[0.0], [0.5]], parameters=2)
    assert decide.log_odds(a, larger, RECORDED) == pytest.approx(0.5 * 1.5**2 + np.log(100.0))  # 100 components
    assert decide.log_odds(larger, a, RECORDED) == pytest.approx(-0.5 * 1.5**2 - np.log(100.0))


def test_odds_count_for_less_if_neither_answer_fits_as_it_would_if_it_were_true():
    a = fitted(("a",), 0.0, residuals=[[0.0, 4.0], [0.0]])  # costs 64 and 100, a distance of 16.8
    b = fitted(("b",), 0.0, residuals=[[5.0, 0.0], [2.0 / 3.0 * 0.0]])
    apart = 2.0 * np.hypot(5.0, 4.0)
    assert decide.log_odds(a, b, RECORDED) == pytest.approx(0.5 * 36.0 * 36.0 / apart**2)


@pytest.mark.parametrize(("odds", "open_"), [(8.9, True), (9.1, False)])
def test_an_answer_stays_open_unless_the_odds_against_it_are_long(odds, open_):
    best = fitted(("best",), 0.0, residuals=[[0.0], [0.0]])
    # Costs differ by the distance squared, as they do on average if the best one is true.
    other = fitted(("other",), 0.0, residuals=[[0.0], [np.sqrt(2.0 * np.log(odds)) / 3.0]])
    assert (other in survivors(best, [other], RECORDED)) is open_
    # One that predicts left-out experiments best is no answer either if the odds against it are long.
    assert (other in survivors(other, [best], RECORDED)) is open_


def test_an_answer_that_one_experiment_alone_speaks_for_is_not_stable():
    recorded = Recorded(np.full(5, 5.0))

    def of(name, *levels):
        return fitted((name,), 0.3, residuals=[level * np.ones(20) for level in levels])

    best, even, odd = of("best", 1, 1, 1, 1, 1), of("even", 2, 2, 2, 2, 2), of("odd", 9, 0.5, 0.5, 0.5, 0.5)
    assert stable((best,), [best, even], recorded) is True
    assert stable((best,), [best, odd], recorded) is False
    assert stable((best, odd), [best, odd], recorded) is True
    assert (
        stable((best, odd), [even], recorded) is True
    )  # which all prefer the first answer to, and not the second
    larger = fitted(("odd", "even"), 0.3, residuals=odd.fit.residuals)
    assert stable((best,), [best, larger], recorded) is True  # of more effects: no rival
    three = Recorded(np.full(3, 5.0))
    of_three = [fitted(f.effects, 0.0, residuals=f.fit.residuals[:3]) for f in (best, odd)]
    assert stable(of_three[:1], of_three, three) is False
    of_two = [fitted(f.effects, 0.0, residuals=f.fit.residuals[:2]) for f in (best, odd)]
    assert stable(of_two[:1], of_two, Recorded(np.full(2, 5.0))) is None


def test_a_contradiction_takes_four_deviations():
    recorded = Recorded(np.ones(3))
    best = fitted(("best",), 0.0, residuals=[[0.0], [0.0], [0.0]])

    def rival(apart):  # better by `apart` without the first experiment, and far worse with it
        worse = fitted(("best",), 0.0, residuals=[[0.0], [2.0 * apart], [0.0]])
        return worse, fitted(("rival",), 0.0, residuals=[[99.0], [0.0], [0.0]])

    for apart, holds in ((3.99, True), (4.0, False), (4.01, False)):
        first, second = rival(apart)
        assert stable((first,), [second], recorded) is holds
    assert stable((best,), [best], recorded) is True


@pytest.mark.parametrize(
    ("gap", "largest_of_one", "p_value", "present"),
    [
        (0.26, 0.0, 0.009, True),
        (0.26, 0.0, 0.01, False),  # as noise leaves it in one diagnosis of a hundred
        (0.26, 0.0, 0.5, False),
        (0.25, 0.0, 0.0, False),  # too small to matter
        (0.25, 0.74, 0.0, False),
        (0.25, 0.76, 0.0, True),  # three times as much in one experiment
    ],
)
def test_a_gap_is_present_if_it_matters_and_noise_hardly_ever_leaves_as_much(
    monkeypatch, gap, largest_of_one, p_value, present
):
    monkeypatch.setattr(diagnose, "nominal_basis", lambda *_: None)
    monkeypatch.setattr(
        diagnose, "excesses", lambda *_: (np.array([-0.1, largest_of_one**2]), np.array([30.0, 70.0]))
    )
    monkeypatch.setattr(diagnose, "excess", lambda *_: gap**2)
    monkeypatch.setattr(diagnose, "smallest_seen", lambda *_, threshold, simulated: threshold)
    asked = []

    def of(excess, score):
        asked.append((excess, score))
        return p_value

    null = SimpleNamespace(p_value=of, threshold=lambda: 9.0)
    noise = SimpleNamespace(null=lambda basis, signatures: null)
    by_id = {"law": SimpleNamespace(among=1), "best of three": SimpleNamespace(among=3)}
    subject = SimpleNamespace(observed=RECORDED, effects=(), model=SimpleNamespace(predict=None), by_id=by_id)
    drops = {"law": 8.0, "best of three": 9.0}  # noise leaves the best of three 2 ln 3 more
    scores = [SimpleNamespace(signature=None, effect=name, drop=drop) for name, drop in drops.items()]
    evidence = diagnose._evidence(subject, fitted((), gap), scores, noise)
    assert (evidence.present, evidence.p_value) == (present, p_value)
    assert asked == [(gap**2, 4.0)]  # a score counts from twice what noise reaches
    # What an effect must explain to be seen: that much, or the gap that matters over all the runs' samples.
    assert evidence.power == pytest.approx(max(2.0 * 9.0, 0.25**2 * (4.0 * 30.0 + 9.0 * 70.0)))
    words = "too small to matter" if p_value < 0.01 else "no gap beyond the noise"
    assert words in _gap_text({"present": False, "p_value": p_value})


@pytest.mark.parametrize(
    ("before", "after", "worth"),
    [
        (1.0, 0.74, True),
        (1.0, 0.75, True),  # a quarter
        (1.0, 0.76, False),
        (2.0, 1.49, True),
        (0.5, 0.3, True),
        (0.5, 0.38, False),
        (0.0, 0.0, False),
        (0.0, 0.5, False),  # nothing that could be closed
    ],
)
def test_a_further_effect_closes_a_quarter_of_what_is_left(before, after, worth):
    assert decide.worth_adding(fitted(("a",), before), fitted(("a", "b"), after)) is worth


@pytest.mark.parametrize(("log_prior", "needed"), [(0.0, True), (-4.0, True), (-40.0, False)])
def test_a_further_effect_has_to_be_probable_although_there_are_many(log_prior, needed):
    before = fitted(("a",), 1.0, residuals=[[6.0], [1.0]], parameters=1)
    after = replace(fitted(("a", "b"), 0.1, residuals=[[0.0], [1.0]], parameters=2), log_prior=log_prior)
    assert decide.worth_adding(before, after)
    assert decide.needed(before, after, RECORDED) is needed


def test_where_nothing_was_left_no_further_effect_is_added():
    before, after = fitted(("a",), 0.0, held_out=1.0), fitted(("a", "b"), 0.0, held_out=0.2)
    assert decide.worth_adding(before, after) is False


def test_a_further_effect_that_runs_do_not_agree_on_is_not_added():
    def of(gap, held_out):
        return Fitted((), Refit((), {}, (), (), 0.0, 0, True), held_out, held_out, gap)

    before = of(1.0, scattered([2.0, 4.0], [2.0, 4.0]))
    assert decide.worth_adding(before, of(0.5, scattered([1.0, 1.0], [1.0, 1.0]))) is True  # 2 +- 0.7
    assert decide.worth_adding(before, of(0.5, scattered([4.1, 0.9], [4.1, 0.9]))) is False  # 0.5 +- 1.8
    assert decide.worth_adding(before, of(0.5, scattered([3.0, 5.0], [3.0, 5.0]))) is False  # worse on other data
    assert decide.worth_adding(before, of(0.5, scattered([2.0, 2.0], [2.0, 4.0]))) is False  # 0.5 +- 0.5
    below = [scattered([x, x], [x, x]) for x in (-0.1, -0.5)]  # no gap on other data that could be closed
    assert decide.worth_adding(of(1.0, below[0]), of(0.5, below[1])) is False


@pytest.mark.parametrize(("held_out", "named"), [(0.25, False), (0.49, False), (0.5, True), (0.55, True)])
def test_an_effect_that_leaves_something_is_named_if_it_closes_half_of_the_gap(held_out, named):
    assert names(fitted((), 1.0), fitted(("e",), 1.0 - held_out), finished=False) is named


@pytest.mark.parametrize(
    ("number", "held_out", "trained", "named"),
    [
        (1, 0.1, 0.5, False),  # unknown is likelier: (1 - 0.1)^2 > 0.1
        (1, 0.45, 0.5, True),
        (1, 0.38, 0.5, False),
        (2, 0.45, 0.5, False),  # two effects can complete nearly any model
        (2, 0.50, 0.5, True),  # but not close half of the gap elsewhere
        (1, 0.45, 0.3, False),  # less than a third of the gap itself
        (1, 0.45, 0.34, True),
    ],
)
def test_what_finishes_a_weak_gap_is_named_unless_unknown_is_likelier(number, held_out, trained, named):
    nominal = fitted((), 0.6, held_out=1.0)
    best = fitted(("a", "b")[:number], 0.6 * (1.0 - trained), held_out=1.0 - held_out)
    assert names(nominal, best, finished=True) is named
    assert names(nominal, best, finished=False) is (held_out >= 0.5)
    assert decide.beyond_doubt(nominal, best, finished=True, bounded=False) is named
    assert decide.beyond_doubt(nominal, best, finished=False, bounded=False) is False


def test_no_gap_names_nothing():
    assert names(fitted((), 0.0), fitted(("e",), 0.0), finished=True) is False
    assert names(fitted((), 0.0, held_out=1.0), fitted(("e",), 0.0, held_out=0.55), finished=True) is False


@pytest.mark.parametrize(
    ("held_out", "trained", "bounded", "beyond"),
    [
        (0.84, 0.84, False, False),
        (0.85, 0.85, False, True),
        (0.85, 0.84, False, False),  # the nominal model predicts left-out runs worse than it fits them
        (0.84, 0.85, False, False),
        (0.85, 0.84, True, True),  # what is left where it is fitted may be noise
    ],
)
def test_no_free_function_casts_doubt_on_what_closes_nearly_all(held_out, trained, bounded, beyond):
    nominal, best = fitted((), 1.0), fitted(("e",), 1.0 - trained, held_out=1.0 - held_out)
    assert decide.beyond_doubt(nominal, best, finished=False, bounded=bounded) is beyond


UNKNOWNS = (
    Unknown("size", 0.0, 0.0, 1.0, 1e-3),
    Unknown("shape", 1.0, 0.1, 4.0, 1e-2),
    Unknown("onset", 1.0, 1.0, 9.0, 1e-2),
)


@pytest.mark.parametrize(
    ("values", "strain"),
    [
        ((0.5, 2.0, 5.0), False),
        ((0.5, 4.0, 5.0), True),  # a shape that nobody thought plausible
        ((0.5, 3.99991, 5.0), True),  # within a hundredth of a step
        ((0.5, 3.9998, 5.0), False),
        ((0.5, 0.1, 9.0), False),  # both as a trial has them
        ((0.5, 0.1, 1.0), True),  # one as a trial has it, the other as at the start
        ((1.0, 2.0, 5.0), True),  # as large as it may be
        ((0.0, 2.0, 5.0), False),  # off
    ],
)
def test_a_law_at_bounds_that_nobody_thought_plausible_is_strained(values, strain):
    neutral, trial = {"size": 0.0, "shape": 1.0, "onset": 1.0}, {"size": 0.1, "shape": 0.1, "onset": 9.0}
    effect = Effect("e", "", "p", UNKNOWNS, neutral, (trial,), shapes=frozenset({"shape", "onset"}))
    sizes = dict(zip(neutral, values, strict=True))
    best = Fitted(("e",), Refit(UNKNOWNS, sizes, (), (), 0.0, 0, True), lost(1.0), lost(1.0), 1.0)
    assert strained(best, [effect]) is strain
    assert strained(Fitted(("other",), best.fit, best.held_out, best.judged, 1.0), [effect]) is False
    ends = replace(effect, natural=frozenset({"shape", "onset"}))  # shares, say, which end at 0 and 1
    assert strained(best, [ends]) is (values[0] == 1.0)


def test_an_effect_of_one_sign_may_be_off_at_its_bound():
    """One of both signs that ends at a bound is strained, even at the one where another is off."""

    def at_its_lower_bound(*, two_sided):
        size = Unknown("size", 0.5, 0.0, 1.0, 1e-3)
        effect = Effect("e", "", "p", (size,), {"size": 0.0}, ({"size": 0.5},), two_sided=two_sided)
        best = Fitted(("e",), Refit((size,), {"size": 0.0}, (), (), 0.0, 0, True), lost(1.0), lost(1.0), 1.0)
        return decide._limits(effect, size), strained(best, [effect])

    assert at_its_lower_bound(two_sided=False) == ({1.0}, False)
    assert at_its_lower_bound(two_sided=True) == ({0.0, 1.0}, False)  # at neutral, which is plausible


@pytest.mark.parametrize(("left", "replaced"), [(0.149, True), (0.15, True), (0.151, False)])
def test_one_free_function_takes_the_place_of_two_effects_at_one_port(left, replaced):
    """Even where they close nearly all, and if it leaves a little more: one law of one variable is simpler."""
    assert lumped(fitted(("a", "b"), 0.1), [free(0.9), free(left)]) is replaced
    assert lumped(fitted(("a", "b"), 0.1), []) is False


def test_weights_fall_with_the_odds():
    best = fitted(("best",), 0.0, held_out=0.4, residuals=[[0.0], [0.0]])
    second = fitted(("second",), 0.0, residuals=[[0.0], [1.0]])  # a distance of 3
    far = fitted(("far",), 0.0, residuals=[[0.0], [200.0]])
    weights = decide.weigh(fitted((), 1.0), [best, second, far], RECORDED, "ambiguous")
    assert sum(weights.values()) == pytest.approx(1.0)
    w = {k: v / weights[("best",)] for k, v in weights.items()}
    assert w[("second",)] == pytest.approx(np.exp(-4.5))
    assert w[("far",)] == pytest.approx(1e-6 / 0.6)
    assert w[UNKNOWN] == pytest.approx(0.4**2 / 0.6)  # what closure leaves open
    assert w[NONE] == pytest.approx(1e-3 / 0.6)


def test_an_answer_that_has_just_been_ruled_out_leaves_a_doubt():
    best = fitted(("best",), 0.0, residuals=[[0.0], [0.0]])
    odds = {"near": 25.0, "far": 1e4}
    near, far = (fitted((n,), 0.0, residuals=[[0.0], [np.sqrt(2.0 * np.log(o)) / 3.0]]) for n, o in odds.items())
    gapless, larger = (
        fitted(("gapless",), 0.3, residuals=[[0.0], [0.01]]),
        fitted(("a", "b"), 0.0, residuals=[[0.0], [0.01]]),
    )

    def unknown(*rivals):
        weights = decide.weigh(fitted((), 1.0), [best], RECORDED, "effect", rivals)
        return weights[UNKNOWN] / weights[("best",)]

    assert unknown(best, gapless, larger) == unknown()
    assert unknown(near) - unknown() == pytest.approx(1.0 / 25.0)
    assert unknown(near, far, best) - unknown(near) == pytest.approx(1e-4)


def test_unknown_keeps_a_weight_and_what_closes_nothing_hardly_any():
    perfect, useless = (fitted(("e",), 0.0, held_out=g, residuals=[[0.0], [0.0]]) for g in (0.0, 2.0))
    weights = decide.weigh(fitted((), 1.0), [perfect], RECORDED, "effect")
    assert weights[UNKNOWN] / weights[("e",)] == pytest.approx(0.02)
    weights = decide.weigh(fitted((), 1.0), [useless], RECORDED, "effect")
    assert weights[UNKNOWN] / weights[("e",)] == pytest.approx(1e3)
    weights = decide.weigh(fitted((), 1.0), [], RECORDED, "effect")  # no answer leaves everything open
    assert weights == pytest.approx({NONE: 1e-3 / 1.001, UNKNOWN: 1.0 / 1.001})


@pytest.mark.parametrize(
    ("kind", "gap", "none", "unknown", "named"),
    [
        ("complete", 0.75, 1.0, 1e-3, 0.15 * 9.0),  # a gap of three times what matters
        ("complete", 0.05, 1.0, 1e-3, 0.15 * 0.04),
        ("insufficient", 0.5, 1.0, 0.5 / 2, 0.5 / 6),
        ("insufficient", 6.0, 1.0, 6.0 / 2, 6.0 / 6),
        ("unknown", 0.5, 1e-3, 0.95, 0.05),
    ],
)
def test_what_a_verdict_without_names_leaves_to_each_answer(kind, gap, none, unknown, named):
    best = fitted(("e",), 0.0, held_out=0.4, residuals=[[0.0], [0.0]])
    weights = decide.weigh(fitted((), gap), [best], RECORDED, kind)
    total = none + unknown + named
    expected = {NONE: none / total, UNKNOWN: unknown / total, ("e",): named / total}
    assert weights == pytest.approx(expected)
    assert decide.weigh(fitted((), gap), [], RECORDED, kind)[NONE] == pytest.approx(none / (none + unknown))


def test_a_gap_that_cannot_be_seen_may_be_there():
    weights = decide.weigh(fitted((), 0.0), [], RECORDED, "insufficient", seen=False)
    assert weights == pytest.approx({NONE: 2 / 3, UNKNOWN: 1 / 3})


def test_a_model_is_named_by_what_left_out_experiments_can_say():
    """Left out, one experiment is predicted badly, but within the errors that the others leave in the parameters."""
    nominal, best = fitted((), gap=2.0), fitted(("e",), gap=0.0, held_out=1.95)
    assert not names(nominal, best, finished=True)
    assert closed_by(nominal, best) == pytest.approx(0.025)
    uncertain = replace(best, judged=lost(0.04))
    assert closed_by(nominal, uncertain) == pytest.approx(0.9)
    assert names(nominal, uncertain, finished=True)
    assert closed_by(nominal, replace(best, judged=lost(9.0))) == pytest.approx(0.025)


@pytest.mark.parametrize(("left", "moved", "classes"), [(1.5, 1000.0, 1), (0.0, 1000.0, 2), (1.5, 100.0, 2)])
def test_the_same_at_two_places_is_one_answer_although_refits_end_a_little_apart(left, moved, classes):
    """By 0.9 standard deviations: little next to 1.5 floors that are left, and next to what the effects do."""
    effects = {n: Effect(n, n, port, (), {}, (), law="saturation") for n, port in (("a", "u"), ("b", "valve.u"))}
    nominal = fitted((), 9.0, residuals=([moved, 0.0],), cost=moved**2)
    answers = [fitted((n,), left, residuals=([0.0, d],), cost=d * d) for n, d in (("a", 0.0), ("b", 0.9))]
    merged = decide.merge_equivalent(answers, nominal, effects, Recorded(np.array([1.0])))
    assert len(merged) == classes


@pytest.mark.parametrize(("apart", "classes"), [(0.24, 1), (0.26, 2)])
def test_laws_of_one_place_are_one_answer_if_no_data_tell_them_apart(apart, classes):
    effects = {n: Effect(n, n, "joint", (), {}, (), law=n) for n in ("coulomb", "viscous")}
    nominal = fitted((), 2.0, residuals=([3.0, 0.0],), cost=9.0)
    answers = [
        fitted((n,), 0.0, residuals=([0.0, d],), cost=d * d) for n, d in (("coulomb", 0.0), ("viscous", apart))
    ]
    merged = decide.merge_equivalent(answers, nominal, effects, Recorded(np.array([1.0])))
    assert len(merged) == classes


SPRING = Effect("law", "", "spring", (), {}, (), law="hardening", expression="size*p^3")
BRUSHES = Effect("law", "", "spring", (), {}, (), law="voltage_drop", acts="potential", expression="size*through")
DRIVE = Effect("law", "", "spring", (), {}, (), law="saturation")
LATE = Effect("law", "", "spring", (), {}, (), law="lag")
JOINT = Effect("law", "", "spring", (), {}, (), law="elasticity", acts="cut", expression="p/size")


@pytest.mark.parametrize(
    ("law", "within", "apart", "one"),
    [
        (SPRING, "spring", 1.5, True),
        (BRUSHES, "spring", 1.5, True),
        (DRIVE, "spring", 1.5, True),
        (SPRING, "gear", 1.5, False),
        (LATE, "spring", 1.5, False),
        (JOINT, "spring", 1.5, False),
        (SPRING, "spring", 7.9, True),
        (SPRING, "spring", 8.1, False),
    ],
    ids=[
        "its own", "of its flow", "of its input", "of another component", "of time", "of a joint", "a little worse",
        "told apart",
    ],
)  # fmt: skip
def test_a_coefficient_that_varies_with_its_own_variable_is_the_law_of_that_unless_runs_tell_them_apart(
    law, within, apart, one
):
    varies = Effect("varies", "", "c", (), {}, (), acts="parameter", over="spring.phi_rel", within=(within,))
    nominal = fitted((), 9.0, residuals=([30.0, 0.0],), cost=900.0)
    answers = [fitted((n,), 0.0, residuals=([0.0, d],), cost=d * d) for n, d in (("varies", 0.0), ("law", apart))]
    merged = decide.merge_equivalent(answers, nominal, {"law": law, "varies": varies}, Recorded(np.array([1.0])))
    classes = [["law", "varies"]] if one else [["law"], ["varies"]]
    assert [[name for fit in group for name in fit.effects] for group in merged] == classes


@pytest.mark.parametrize(
    ("within", "effects", "refitted"),
    [
        ("spring", ("varies",), ["alike", "law"]),
        ("gear", ("varies",), ["alike"]),
        ("spring", ("varies", "law"), ["alike+law"]),
    ],
    ids=["at its place", "elsewhere", "with the law itself"],
)
def test_a_law_that_says_the_same_is_refitted_whatever_its_trials_say(monkeypatch, within, effects, refitted):
    """Trials of the law look like another coefficient that varies, not like the one that is open.

    A model that has the law besides gets no second one of it.
    """
    varies = Effect("varies", "", "k", (), {}, (), law="varies_linear", over="twist", within=(within,))
    alike, law, known = (Tried(n) for n in ("alike", "law", "known"))
    scores = Tried("varies", (alike, known)), Tried("other", (law,))
    monkeypatch.setattr(
        candidates, "add_effect", lambda _, rest, score: fitted((*rest.effects, score.effect), 0.0)
    )
    monkeypatch.setattr(candidates, "led_out", lambda _, fit, __: fit)
    monkeypatch.setattr(
        candidates, "without", lambda _, fit, name: fitted(tuple(e for e in fit.effects if e != name), 1.0)
    )
    every = {n: Effect(n, "", "k", (), {}, ()) for n in ("alike", "other", "known")}
    every |= {"law": SPRING, "varies": varies}
    subject = SimpleNamespace(by_id={name: replace(one, id=name) for name, one in every.items()})
    tried = {frozenset({"known"}), frozenset({"known", "law"})}
    others = candidates.twins(subject, fitted((), 3.0), fitted(effects, 0.5), scores, tried)
    assert ["+".join(sorted(f.effects)) for f in others] == refitted


@pytest.mark.parametrize(("closure", "sure"), [(0.65, False), (0.68, True)])
def test_an_effect_that_closes_two_thirds_is_sure_though_its_rest_enters_at_its_own_place(
    monkeypatch, closure, sure
):
    monkeypatch.setattr(diagnose, "where_it_enters", lambda *_: {})
    monkeypatch.setattr(diagnose, "places", lambda _: ("joint",))
    monkeypatch.setattr(diagnose, "without", lambda *_: None)
    subject = SimpleNamespace(effects=(Effect("coulomb@joint", "", "joint", (), {}, (), law="coulomb"),))
    nominal, best = fitted((), 2.0), fitted(("coulomb@joint",), 2.0 * (1.0 - closure))
    assert (diagnose._sure_part(subject, nominal, best, alike=True) is not None) == sure


def test_the_odds_of_slow_noise_fall_with_the_gain_on_left_out_runs():
    """Two over the gap without a prediction; the p-value of the gain, times the number of models, reduces them."""
    nominal = replace(fitted((), 4.0), held_out=lost(10.0, 12.0, 14.0))
    good = replace(fitted(("a",), 1.0), held_out=lost(2.0, 3.0, 4.0))  # gains of 8, 9 and 10 in three runs
    worse = replace(fitted(("b",), 4.0), held_out=lost(11.0, 13.0, 15.0))
    t = 9.0 / np.sqrt(1.0 / 3.0)
    chance = 0.5 * (1.0 - t / np.sqrt(2.0 + t**2))  # Student's t with two degrees of freedom
    assert decide.by_chance(nominal, good, 1) == pytest.approx(0.5 * chance)
    assert decide.by_chance(nominal, good, 6) == pytest.approx(0.5 * 6 * chance)
    assert decide.by_chance(nominal, worse, 6) == pytest.approx(0.5)


@pytest.mark.parametrize(("gap", "kept"), [(0.2, ("drag",)), (0.9, ("step",))])
def test_a_law_at_implausible_bounds_hides_no_plausible_one_that_closes_as_much(monkeypatch, gap, kept):
    """The law at its bounds fits better, by odds that would exclude the other one."""
    step = fitted(("step",), 0.0, residuals=[[0.0], [0.0]], cost=0.0)
    drag = fitted(("drag",), gap, residuals=[[9.0], [9.0]], cost=1053.0)
    monkeypatch.setattr(decide, "strained", lambda fit, _: "step" in fit.effects)
    searched = SimpleNamespace(
        nominal=fitted((), 3.0), best=step, candidates=[step, drag], evidence=SimpleNamespace(present=True)
    )
    subject = SimpleNamespace(observed=RECORDED, effects=())
    surviving, plausible = diagnose._surviving(subject, searched, None)
    assert [s.effects for s in surviving] == [kept]
    assert plausible is (kept == ("drag",))


def test_where_what_is_tolerated_is_most_of_the_gap_the_best_answer_that_closes_it_stands(monkeypatch):
    """The delay closes no more than is tolerated, so a search leaves it out; the offset alone closes nothing."""
    monkeypatch.setattr(decide, "strained", lambda *_: False)
    offset, both = (
        fitted(("offset",), 3.1, residuals=[[9.0], [9.0]]),
        fitted(("offset", "delay"), 0.2, residuals=[[0.0], [0.0]]),
    )
    searched = SimpleNamespace(
        nominal=fitted((), 3.0), best=offset, candidates=[both, offset], evidence=SimpleNamespace(present=True)
    )
    subject = SimpleNamespace(observed=RECORDED, effects=())
    surviving, _ = diagnose._surviving(subject, searched, None)
    assert [s.effects for s in surviving] == [both.effects]


@pytest.mark.parametrize(("sure", "open_"), [("ab", ["a", "b"]), ("b", ["a", "b"]), ("c", ["c"]), ("", [])])
def test_open_answers_are_compared_with_each_other_and_not_each_with_nothing(monkeypatch, sure, open_):
    """Of two that fit alike, one closes something beyond chance, as scatter has it; a third one leaves far more."""
    monkeypatch.setattr(decide, "strained", lambda *_: False)
    monkeypatch.setattr(decide, "closes_something", lambda _, fit, __: fit.id in sure)
    a, b = (fitted((n,), 0.5, residuals=[[x], [x]], cost=3.0 * x**2) for n, x in (("a", 0.0), ("b", 0.5)))
    c = fitted(("c",), 2.0, residuals=[[9.0], [9.0]], cost=243.0)
    evidence = SimpleNamespace(present=True)
    searched = SimpleNamespace(nominal=fitted((), 3.0), best=a, candidates=[a, b, c], evidence=evidence)
    subject = SimpleNamespace(observed=replace(RECORDED, bounded=True), effects=())
    surviving, _ = diagnose._surviving(subject, searched, lambda _: None)
    assert [s.id for s in surviving] == open_


@pytest.mark.parametrize(
    ("others", "bounded", "kind"),
    [((), True, "partial"), (("b",), True, "ambiguous"), (("b",), False, "partial")],
)
def test_what_leaves_a_rest_in_single_runs_hides_no_open_answer(monkeypatch, others, bounded, kind):
    best, *rest = answers = [fitted((n,), 0.8) for n in ("a", *others)]
    monkeypatch.setattr(diagnose, "_surviving", lambda *_: (tuple(answers), True))
    monkeypatch.setattr(diagnose, "_sure_part", lambda *_, **__: diagnose._Part(best, ("joint",)))
    for name, value in {"where_it_enters": {}, "where_left": "v", "finished": False, "likelier": False}.items():
        monkeypatch.setattr(diagnose, name, lambda *_, value=value: value)
    for name, value in {"names": True, "beyond_doubt": False, "stable": True, "held_back": ()}.items():
        monkeypatch.setattr(decide, name, lambda *_, value=value, **__: value)
    model = SimpleNamespace(cases=[SimpleNamespace(machine="one")])
    effects = tuple(Effect(a.id, "", "joint", (), {}, ()) for a in answers)
    subject = SimpleNamespace(
        observed=replace(RECORDED, bounded=bounded), effects=effects, model=model, nominal=()
    )
    evidence = SimpleNamespace(present=True, power=())
    searched = SimpleNamespace(
        nominal=fitted((), 3.0), candidates=answers, paths={}, scores=(), noise=None, evidence=evidence
    )
    judged = diagnose._judge(subject, searched, None, lambda *_: None)
    assert (judged.verdict.kind, judged.verdict.rest.gap) == (kind, 0.8)
    assert judged.surviving == (best, *(rest if kind == "ambiguous" else ()))


def test_a_search_beside_errors_of_the_model_knows_what_the_first_one_found(monkeypatch):
    """It ended elsewhere, while the answer of the first one also fits better with its weights."""
    first, second = fitted(("a",), 0.5, cost=5.0), fitted(("b",), 0.9, residuals=[[9.0], [9.0]], cost=243.0)
    beside = Recorded(np.array([4.0, 9.0]))
    observed = SimpleNamespace(beside_errors=lambda _: beside)
    nominal, evidence = fitted((), 3.0), SimpleNamespace(present=True)

    def searched(best):
        return diagnose._Searched(nominal, {}, None, (), None, evidence, [best], best)

    subject = diagnose.Subject(None, observed, (), None, ())
    again = replace(subject, observed=beside)
    better = replace(first, gap=0.2, fit=replace(first.fit, residuals=second.fit.residuals, cost=0.0))
    monkeypatch.setattr(diagnose, "_prediction", lambda *_: ())
    monkeypatch.setattr(diagnose, "with_states", lambda observed, *_: observed)
    monkeypatch.setattr(diagnose, "_search_settled", lambda *_, **__: (again, searched(second)))
    monkeypatch.setattr(diagnose, "refitted", lambda _, one: better if one is first else one)
    monkeypatch.setattr(decide, "survivors", lambda best, *_: (best,))
    monkeypatch.setattr(decide, "best_of", lambda fits, _: min(fits, key=lambda f: f.fit.cost))
    monkeypatch.setattr(decide, "validated", lambda _, fit: 1.0 - fit.gap)
    subject, chosen = diagnose._beside_errors(subject, searched(first), lambda *_: None, seed=0)
    assert subject is again
    assert chosen.best is better


@pytest.mark.parametrize(
    ("scatter", "strained", "best"),
    [
        (0.1, (), ("b", "c")),  # better in every run
        (4.0, (), ("a",)),  # no more than runs scatter
        (0.1, ("b",), ("b", "c")),  # better in every run, although at an implausible bound
        (4.0, ("a",), ("b", "c")),
    ],
)
def test_the_best_explanation_is_plausible_and_simple(monkeypatch, scatter, strained, best):
    """Two effects predict left-out runs better than one does, by 2 +- 0.1 or 2 +- 4."""
    one = replace(fitted(("a",), 2.0, parameters=1), held_out=lost(4.0, 4.0, 4.0))
    poor = replace(fitted(("d",), 2.9, parameters=1), held_out=lost(0.0, 24.0, 0.9))  # in one run only
    two = replace(
        fitted(("b", "c"), 1.0, parameters=2), held_out=lost(2.0 - scatter, 2.0 + 2.0 * scatter, 2.0 - scatter)
    )
    monkeypatch.setattr(decide, "strained", lambda fit, _: any(n in strained for n in fit.effects))
    monkeypatch.setattr(decide, "closes_something", lambda *_: True)
    diagnosis = SimpleNamespace(
        evidence=SimpleNamespace(present=True), candidates=[one, two, poor], nominal=fitted((), 3.0)
    )

    class Closing:
        subject = SimpleNamespace(effects=())

        def __call__(self, fit):
            return SimpleNamespace(validated=1.0 - fit.held_out.gap / 3.0)

    assert diagnose._explaining(diagnosis, Closing()).effects == best
