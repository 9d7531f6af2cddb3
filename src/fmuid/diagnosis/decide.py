"""From refitted candidates to a verdict: which effects are supported, indistinguishable or insufficient.

Tolerances. A model need not be exact to the noise. The user states how large the error of each signal may be
(RMS). The error is that of the refitted nominal model on data that it was not fitted to, without what noise alone
would leave. It varies from fold to fold, which gives the probability that it is within the tolerance.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import chain

import numpy as np
from scipy.special import chdtrc, stdtr

from fmu_build.suggest import suggestion
from fmuid.core.errors import CampaignError, SimulationError, UnitError
from fmuid.core.immutable import FloatArray
from fmuid.core.units import conversion
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.diagnosis.candidates import Fitted, says_the_same
from fmuid.diagnosis.cross_validation import HeldOut, advantage, closure
from fmuid.diagnosis.free_functions import Decoy
from fmuid.diagnosis.observed import Observed, gap, orthonormal, project_off
from fmuid.diagnosis.refit import Refit, about
from fmuid.diagnosis.scores import stack
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.verdict import NONE, UNKNOWN, Closure, Kind, Tolerated
from fmuid.effects.effect import Effect, Unknown
from fmuid.identification.problem.cases import Case, Channel

# Calibrated on the virtual rig (`make blind`), never on data whose answer is to be found.
SIGNIFICANCE = 0.01  # one false alarm in a hundred
SCORE_MARGIN = 2.0  # the largest score must exceed this many times the 99 % quantile under noise alone
CLOSURE_THAT_NAMES = 0.5  # a named effect must close at least half of the gap on experiments left out
MOST_CALIBRATED = 2  # effects in the simulated plants that probabilities were calibrated on
CLOSURE_THAT_FINISHES = 1 / 3  # or this much of a weak gap, if the rest is no more than noise
CLOSURE_OF_ITS_KIND = 2 / 3  # below it, an effect whose rest is at its own place may only resemble the cause
GAIN_OF_A_SECOND = 0.25  # a further effect must close a quarter of the rest; a provisional one, of the gap
ABOUT_AS_WELL = 1.5  # ratio of remaining gaps: a free function is one linear step, effects are refitted to the end
CLOSURE_BEYOND_DOUBT = 0.85  # an effect that closes this much is not unknown, though its law may differ in shape
SAME = 4.0  # standard deviations by which the data must contradict an answer, or a run must separate two
SURE = 0.9  # probability of what is named without repeats: the level of all intervals
OPEN = SURE / (1.0 - SURE)  # odds against an answer beyond which it is not left open
_LIKELIER_THAN_NOT = 0.5  # probability from which a model counts as exact to within the user's tolerance
_EQUAL = 0.25  # standard deviations between answers: if one is true, odds stay below 2 in 99 of 100 recordings
_IDENTICAL = 1e-3  # of what effects do to the predictions: less than any coupling but a rigid one leaves
_INTERVAL = 1.645  # standard errors: the 90 % interval of what is gained excludes zero
_NEVER = 1e-3  # weight of what a verdict rules out: no probability is zero
_HIDDEN = 0.15  # weight of an effect whose gap would just matter, where no gap was seen
_POSSIBLE = 0.5  # odds of something unknown against slow noise, for each floor of a gap that no model predicts
_UNKNOWN = 0.95  # weight of the verdict *unknown*; the rest goes to what comes closest
_DOUBT = 0.02  # least weight of something unknown in addition to what was named
_NEAR = 0.01  # of a parameter's step: so near a bound, it is at the bound
_BLOCK = 20.0  # this many samples of model error carry as much information as one of noise


def separation(a: Fitted, b: Fitted, observed: Observed, *, without: int | None = None) -> float:
    """Return by how many standard deviations the data prefer `a` to `b` (negative: `b` to `a`).

    If the predictions of the two models differ by D sigma and one of them is true, the difference of their costs
    is D^2 with a standard deviation of 2 D. With `without`, that experiment is excluded.
    """
    difference, apart, wider = _compared(a, b, observed, without)
    return difference / (2.0 * apart * wider) if apart else 0.0


def log_odds(a: Fitted, b: Fitted, observed: Observed) -> float:
    """Return the logarithm of the posterior odds of `a` against `b`.

    That is half the difference of their costs, plus ln(N) / 2 for each parameter that `b` has more (Schwarz
    1978), plus their prior odds. If `a` is true, the difference is D^2 on average. If it is less, neither may be
    true, and it counts for as much less.
    """
    difference, apart, wider = _compared(a, b, observed, None)
    evidence = difference / (2.0 * wider**2) * min(1.0, abs(difference) / apart**2) if apart else 0.0
    return evidence + _price(b) - _price(a) + a.log_prior - b.log_prior


def log_evidence(nominal: Fitted, fitted: Fitted) -> float:
    """Return the logarithm of the marginal likelihood of `fitted` over that of `nominal` (Schwarz 1978)."""
    return 0.5 * (nominal.fit.cost - fitted.fit.cost) - _price(fitted) + _price(nominal)


def starts_matter(started: Refit, base: Fitted, observed: Observed) -> bool:
    """Return whether the runs contradict the start states of `base`: a likelihood-ratio test against `started`.

    What is left counts as noise that is not white. `observed` has the states of each run as nuisances.
    """
    left = float(np.mean(observed.repeats)) * gap(started.residuals, observed) ** 2
    gained = max(0.0, base.fit.cost - started.cost) / spread(left) ** 2
    return float(chdtrc(_start_states(observed), gained)) < SIGNIFICANCE


def odds_of_starts(
    started: Refit, nominal: Fitted, explained: Fitted, observed: Observed, states: int | None = None
) -> float:
    """Return the logarithm of the odds of the nominal model `started` elsewhere, against an effect.

    As in `log_odds`; each of so many `states` is a parameter. By default, they are those of each run, which
    `observed` has as nuisances. The nominal model may be the explanation itself.
    """
    states = _start_states(observed) if states is None else states
    left = float(np.mean(observed.repeats)) * min(gap(started.residuals, observed), explained.gap) ** 2
    gained = (explained.fit.cost - started.cost) / (2.0 * spread(left) ** 2)
    price = 0.5 * states * float(np.log(nominal.held_out.size.sum()))
    return gained - price + _price(explained) - _price(nominal)


def _start_states(observed: Observed) -> int:
    """Return the number of start states that are fitted to the runs."""
    return sum(int(basis.shape[1]) for basis in observed.nuisances)


def _price(fitted: Fitted) -> float:
    """Return the penalty of a model's parameters in its evidence."""
    return 0.5 * len(fitted.fit.unknowns) * float(np.log(fitted.held_out.size.sum()))


def _compared(a: Fitted, b: Fitted, observed: Observed, without: int | None) -> tuple[float, float, float]:
    """Return by how much the cost of `b` exceeds that of `a`, how far apart they are, and the `spread` of that.

    The part that even the better model leaves unexplained counts as noise too, but it is far from white: `_BLOCK`
    of its samples count as one, and the difference scatters at least as it does from experiment to experiment
    (Vuong 1989).
    """
    ra, rb = (_stacked(f, observed, without) for f in (a, b))
    apart = float(np.linalg.norm(ra - rb))
    costs = float(ra @ ra), float(rb @ rb)
    left = float(np.mean(observed.repeats)) * min(a.gap, b.gap) ** 2
    wider = spread(left)
    if observed.bounded and apart:  # the rest may be noise as well, and is unevenly distributed
        better = ra if costs[0] <= costs[1] else rb
        wider = max(wider, float(np.sqrt(float((ra - rb) ** 2 @ better**2) / apart**2)))
    if apart:
        among = left / (1.0 + left) * _scatter(a, b, observed, without) / (2.0 * apart)
        wider = max(wider, among)
    return costs[1] - costs[0], apart, wider


def _scatter(a: Fitted, b: Fitted, observed: Observed, without: int | None) -> float:
    """Return the standard error of the difference of two models' costs, from its differences among experiments.

    Where one model has all effects of the other, an experiment may show the further ones more than another does:
    the difference is then in proportion to how far apart their predictions are, and what differs from that counts.
    """
    each: dict[int, list[float]] = {}
    for (e, rows), group in zip(observed.folds, observed.groups, strict=True):
        if e != without:
            ra, rb = (f.fit.residuals[e][rows] for f in (a, b))
            parts = float(rb @ rb) - float(ra @ ra), float((ra - rb) @ (ra - rb))
            so_far = each.get(group, [0.0, 0.0])
            each[group] = [t + float(observed.repeats[e]) * part for t, part in zip(so_far, parts, strict=True)]
    n = len(each)
    if n < 2:
        return 0.0
    gained, apart = np.transpose([*each.values()])
    nested = {*a.effects} < {*b.effects} or {*b.effects} < {*a.effects}
    expected = apart * gained.sum() / apart.sum() if nested and apart.any() else gained.mean()
    return float(np.sqrt(n / (n - 1) * np.sum((gained - expected) ** 2)))


def spread(left: float) -> float:
    """Return the factor by which a separation scatters more than under noise alone.

    `left` is the unexplained energy of a model, relative to that of the noise.
    """
    return float(np.sqrt(1.0 + _BLOCK * left))


def _apart(a: Fitted, b: Fitted, observed: Observed) -> float:
    """Return how far apart the predictions of two models are, in standard deviations."""
    return float(np.linalg.norm(_stacked(a, observed, None) - _stacked(b, observed, None)))


def _stacked(fitted: Fitted, observed: Observed, without: int | None) -> FloatArray:
    return stack([r * (e != without) for e, r in enumerate(fitted.fit.residuals)], observed)


def best_of(candidates: Sequence[Fitted], observed: Observed) -> Fitted:
    """Return the candidate with the least held-out loss among the likeliest ones, and those that fit as well."""
    likeliest, *others = sorted(candidates, key=lambda c: c.fit.cost)
    for c in others:
        likeliest = c if log_odds(c, likeliest, observed) > 0.0 else likeliest
    close = [c for c in candidates if c.fit.cost <= about(likeliest.fit.cost)]
    open_ = (c for c in close if log_odds(likeliest, c, observed) < np.log(OPEN))
    return min(open_, key=lambda c: c.held_out.mean)


def survivors(best: Fitted, candidates: Sequence[Fitted], observed: Observed) -> tuple[Fitted, ...]:
    """Return the answers that the data leave open, `best` first: equally large sets that fit equally well.

    The odds of `best` against them are short, and they leave about as much of the gap. A set that closes far less
    is not an answer, however uninformative the data are.
    """
    sets: dict[frozenset[str], Fitted] = {}
    for c in (best, *sorted(candidates, key=lambda c: c.fit.cost)):
        if comparable(best, c):
            sets.setdefault(frozenset(c.effects), c)
    for c in sets.values():  # `best` predicts left-out experiments best, but the data may speak against it
        best = c if log_odds(c, best, observed) >= np.log(OPEN) else best
    others = (c for c in sets.values() if c is not best and log_odds(best, c, observed) < np.log(OPEN))
    return best, *others


def merge_equivalent(
    candidates: Sequence[Fitted], nominal: Fitted, effects: Mapping[str, Effect], observed: Observed
) -> tuple[tuple[Fitted, ...], ...]:
    """Group models whose predictions are identical.

    Models at different places are one if their predictions differ by less than a thousandth of what their effects
    do, and by little next to what they leave: rigidly coupled shafts are one place, and the limit of a heater is
    its gain. Friction that differs between the directions is plain friction where a shaft never reverses: laws of
    one place need only be equal within the noise. A law of a branch or an input and a coefficient that varies with
    its variable say the same: the nearest such law and the coefficient are one unless the measurements contradict
    one of them. The most usual and simplest of a group comes first, and stands for it; a law of the library leads.
    """

    def preference(fitted: Fitted) -> list[tuple[bool, tuple[bool, int, bool]]]:
        return sorted((bool(effects[name].over), effects[name].preference) for name in fitted.effects)

    @cache
    def moved(fitted: Fitted) -> float:
        return _apart(nominal, fitted, observed)

    def alike(a: Fitted, b: Fitted) -> bool:
        if len(a.effects) != len(b.effects) or set(a.effects) == set(b.effects):
            return False
        only = [effects[name] for x, y in ((a, b), (b, a)) for name in x.effects if name not in y.effects]
        if len(only) == 2 and (says_the_same(*only) or says_the_same(*reversed(only))):
            return comparable(a, b) and abs(separation(a, b, observed)) < SAME
        apart = _apart(a, b, observed)
        if apart <= _IDENTICAL * moved(a):
            return apart <= _EQUAL * _compared(a, b, observed, None)[2]
        here, others = (sorted((effects[name] for name in x.effects), key=_component) for x in (a, b))
        return apart <= _EQUAL and all(map(_at_one_place, here, others))

    classes: list[list[Fitted]] = []
    for fitted in sorted(candidates, key=preference):
        groups = [c for c in classes if alike(c[0], fitted)]
        if groups:
            min(groups, key=lambda c: _apart(c[0], fitted, observed)).append(fitted)
        else:
            classes.append([fitted])
    return tuple(map(tuple, classes))


def _component(effect: Effect) -> str:
    """Return the component that has the port of an effect; a node without one stands for itself."""
    return effect.port.rpartition(".")[0] or effect.port


def _at_one_place(a: Effect, b: Effect) -> bool:
    """Return whether two effects have one port, or one is a value of the component at which the other acts."""
    if a.port == b.port:
        return True
    return (a.law == "value") != (b.law == "value") and _component(a) == _component(b)


def comparable(best: Fitted, other: Fitted) -> bool:
    """Return whether another model has as many effects and leaves about as much of the gap."""
    return len(other.effects) == len(best.effects) and other.gap <= ABOUT_AS_WELL * best.gap + GAP_THAT_MATTERS


def stable(surviving: Sequence[Fitted], rivals: Sequence[Fitted], observed: Observed) -> bool | None:
    """Return whether the data prefer no rival to the surviving answers when any single experiment is left out.

    Losing the evidence together with an experiment is not a contradiction. None for fewer than three experiments.
    """
    if len(observed.runs) < 3:
        return None
    named = {frozenset(s.effects) for s in surviving}
    others = [
        r for r in rivals if frozenset(r.effects) not in named and len(r.effects) <= len(surviving[0].effects)
    ]
    return all(
        separation(surviving[0], rival, observed, without=e) > -SAME
        for e in range(len(observed.runs))
        for rival in others
    )


def worth_adding(before: Fitted, after: Fitted, least: float = GAIN_OF_A_SECOND) -> bool:
    """Return whether another effect closes enough of the remaining gap, also on held-out experiments."""
    if closure(before, after) < least:
        return False
    for worse, better in _losses(before, after):
        gained, error = advantage(better, worse)
        if gained > error and closure(worse, better) > 0.0:
            return True
    return False


def needed(before: Fitted, after: Fitted, observed: Observed) -> bool:
    """Return whether another effect is worth adding and probable, however many there are to choose from."""
    return worth_adding(before, after) and log_odds(after, before, observed) > 0.0


def _losses(before: Fitted, after: Fitted) -> list[tuple[HeldOut, HeldOut]]:
    """Return the losses of two models on held-out experiments, also beyond the errors of their parameters.

    If the other experiments leave parameters uncertain, what a model predicts is no evidence against it within
    their errors; but it is if the effects at least double the gap of what they predict.
    """
    losses = [(before.held_out, after.held_out)]
    refuted = closure(before.held_out, after.held_out) <= -1.0
    return losses if refuted else [*losses, (before.judged, after.judged)]


def closed_by(nominal: Fitted, best: Fitted) -> float:
    """Return the closure on held-out experiments that a model is named by (see `_losses`)."""
    return max(closure(worse, better) for worse, better in _losses(nominal, best))


def validated(nominal: Fitted, best: Fitted, *, excused: bool = False) -> float:
    """Return the closure on held-out experiments, no more than that where the models are fitted.

    Beyond that, the nominal model is merely predicted badly. If `excused`, errors of parameters are no evidence
    against a model (see `closed_by`).
    """
    held_out = closed_by(nominal, best) if excused else closure(nominal.held_out, best.held_out)
    return min(held_out, closure(nominal, best))


def names(nominal: Fitted, best: Fitted, *, finished: bool, bounded: bool = False) -> bool:
    """Return whether `best` closes enough of the gap for its effects to be named.

    A weak gap is largely chance, and if only one experiment shows it, little can be learnt without that
    experiment. It then suffices that one effect completes the model, unless *unknown* is more likely; several can
    complete nearly any model. If the noise is only `bounded`, the effects must also close as much where the models
    are fitted.
    """
    closed = closed_by(nominal, best)
    likely = len(best.effects) == 1 and closed >= _doubt(closed)
    enough = validated(nominal, best, excused=True) if bounded else closed
    return enough >= CLOSURE_THAT_NAMES or (
        likely and finished and closure(nominal, best) >= CLOSURE_THAT_FINISHES
    )


def beyond_doubt(nominal: Fitted, best: Fitted, *, finished: bool, bounded: bool) -> bool:
    """Return whether nothing unknown could disprove that the gap is due to the effects of `best`.

    They have to close most of it on held-out experiments, which the nominal model may predict worse than it fits
    them, and also where both are fitted; unless the noise is only `bounded`, since what is left may be noise then.
    """
    closed = closure(nominal.held_out, best.held_out) if bounded else validated(nominal, best)
    return closed >= CLOSURE_BEYOND_DOUBT or (finished and names(nominal, best, finished=True, bounded=bounded))


def strained(fitted: Fitted, effects: Sequence[Effect]) -> bool:
    """Return whether a named effect's parameters ended at bounds that are neither its start nor a trial.

    A combination of bounds counts as plausible only if a single trial, or the neutral values, has all of it. At
    other bounds, the law imitates something other than its effect. Natural bounds, where the law itself ends, do
    not count.
    """
    for effect in (e for e in effects if e.id in fitted.effects):
        at = {
            u.name: bound
            for u in effect.unknowns
            if u.name not in effect.natural
            for bound in _limits(effect, u)
            if abs(fitted.fit.values[u.name] - bound) <= _NEAR * u.step
        }
        plausible = [{**effect.neutral, **trial} for trial in ({}, *effect.trials)]
        if at and not any(all(p[name] == bound for name, bound in at.items()) for p in plausible):
            return True
    return False


def held_back(fitted: Fitted, nominal: Sequence[Unknown], observed: Observed) -> tuple[str, ...]:
    """Return the parameters of the plain model that bounds hold back, although the runs contradict the bounds.

    Without its bound, such a parameter would move by at least `SAME` of its standard errors. What was fitted then
    stands in for something else, as it has to make up for the bound.
    """
    fit, plain = fitted.fit, {u.name for u in nominal}
    at = [k for k, u in enumerate(fit.unknowns) if at_bound(fit.values[u.name], u)]
    if not at:
        return ()
    residual, slopes = (stack(parts, observed) for parts in (fit.residuals, fit.jacobian))
    free = orthonormal(np.delete(slopes, at, axis=1))
    names = []
    for k in at:
        unknown = fit.unknowns[k]
        alone = project_off(slopes[:, k], free)
        length, down = float(np.linalg.norm(alone)), -float(alone @ residual)
        beyond = 1.0 if fit.values[unknown.name] > 0.5 * (unknown.lower + unknown.upper) else -1.0
        if unknown.name in plain and down * beyond > SAME * length > 0.0:
            names.append(unknown.name)
    return tuple(names)


def at_bound(value: float, unknown: Unknown) -> bool:
    """Return whether a parameter's value is at one of its bounds."""
    return min(value - unknown.lower, unknown.upper - value) <= _NEAR * unknown.step


def _limits(effect: Effect, unknown: Unknown) -> set[float]:
    """Return the bounds that limit an effect, without the one at which a one-sided effect is off."""
    bounds, neutral = {unknown.lower, unknown.upper}, effect.neutral[unknown.name]
    if unknown.name in effect.shapes or effect.two_sided:
        return bounds
    return bounds - {neutral} if neutral in bounds else set()


def lumped(best: Fitted, decoys: Sequence[Decoy]) -> bool:
    """Return whether a free function of one variable does about as well as the two or more laws of `best`."""
    least = min((d.held_out.gap for d in decoys), default=np.inf)
    return bool(least <= ABOUT_AS_WELL * best.held_out.gap)


def weigh(
    nominal: Fitted,
    surviving: Sequence[Fitted],
    observed: Observed,
    kind: Kind,
    rivals: Sequence[Fitted] = (),
    *,
    seen: bool = True,
    provisional: bool = False,
) -> dict[tuple[str, ...], float]:
    """Return the probability of every surviving answer, of `NONE` and of `UNKNOWN`, before calibration.

    Weights decrease with the odds against the best answer. The weight of `UNKNOWN` is the part that the closure
    leaves open, and that of as large sets of effects among the `rivals` that have not survived. Where the data are
    insufficient, the odds against `NONE` grow with the gap: they are half of it, in floors, for `UNKNOWN`, and a
    sixth for effects, as found in single runs of rigs other than actuators. If no gap was `seen`, there may still
    be one of a floor. For a `provisional` verdict, *unknown* has all that the closure leaves open; without
    repeats, `NONE` has what the prediction of left-out data leaves (`by_chance`).
    """
    closed = 0.0
    if surviving:
        best = surviving[0]
        share = validated(nominal, best, excused=True) if provisional else closed_by(nominal, best)
        closed = float(np.clip(share, 0.0, 1.0))
    match kind:
        case "complete":
            none, unknown, named = 1.0, _NEVER, _HIDDEN * max(0.0, nominal.gap / GAP_THAT_MATTERS) ** 2
        case "insufficient":
            possible = nominal.gap if seen else max(1.0, nominal.gap)
            none, unknown, named = 1.0, _POSSIBLE * possible, possible / 6 / max(1, len(surviving))
        case "unknown":
            none, unknown, named = _NEVER, _UNKNOWN, 1.0 - _UNKNOWN
        case _:
            doubt = 1.0 - closed if provisional else _doubt(closed)
            none, unknown, named = _NEVER, max(_DOUBT, doubt), max(_NEVER, closed)
            if provisional and surviving and observed.bounded:
                none = max(_NEVER, by_chance(nominal, surviving[0], max(1, len(rivals))))
            unknown += named * _of_rivals(surviving, rivals, observed)
    weights: dict[tuple[str, ...], float] = {NONE: none, UNKNOWN: unknown}
    odds = [log_odds(s, surviving[0], observed) for s in surviving]  # the first one need not be the likeliest
    for s, of_answer in zip(surviving, odds, strict=True):
        weights[s.effects] = max(1e-6, named * float(np.exp(of_answer - max(odds))))
    total = sum(weights.values())
    return {effects: w / total for effects, w in weights.items()}


def with_none(weights: Mapping[tuple[str, ...], float], sure: float) -> dict[tuple[str, ...], float]:
    """Return the weights with that of `NONE` at `sure`, and the others in proportion."""
    others = max(1.0 - weights[NONE], 1e-12)
    return {n: sure if n == NONE else w * (1.0 - sure) / others for n, w in weights.items()}


def _of_rivals(surviving: Sequence[Fitted], rivals: Sequence[Fitted], observed: Observed) -> float:
    """Return the weight, relative to the best answer, of as large sets of effects that have not survived."""
    if not surviving:
        return 0.0
    named = {frozenset(s.effects) for s in surviving}
    others = {
        frozenset(r.effects): r for r in sorted(rivals, key=lambda r: -r.fit.cost) if comparable(surviving[0], r)
    }
    odds = [log_odds(surviving[0], r, observed) for names, r in others.items() if names not in named]
    return float(sum(min(1.0 / OPEN, np.exp(-max(0.0, o))) for o in odds))


def by_chance(nominal: Fitted, fitted: Fitted, among: int) -> float:
    """Return the odds of slow noise against a gap, where a model predicts left-out data of runs without repeats.

    Without a prediction they are two over the gap in floors, as found in single runs of rigs other than
    actuators. They fall by the p-value of the gain on left-out data (Student's t over the folds), times the number
    of models from which the best was chosen (Bonferroni).
    """
    gained, error = advantage(fitted.held_out, nominal.held_out, elsewhere=True)
    folds = len(fitted.held_out.loss)
    chance = float(stdtr(float(folds - 1), -gained / error)) if folds > 1 and error > 0.0 else float(gained <= 0.0)
    return min(1.0, among * chance) / _POSSIBLE / max(nominal.gap, 1e-6)


def closes_something(nominal: Fitted, fitted: Fitted, closed: Closure) -> bool:
    """Return whether a model closes a share of the gap on left-out data beyond chance."""
    gained, error = advantage(fitted.held_out, nominal.held_out)
    return closed.validated > 0.0 and (closed.interval[0] > 0.0 or gained > _INTERVAL * error)


def _doubt(closed: float) -> float:
    """Return the weight of *unknown* relative to that of effects which close this share of the held-out gap."""
    return (1.0 - closed) ** 2


_VALUE = re.compile(r"^\s*(?P<number>[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?)\s*(?P<unit>.*?)\s*$")


def tolerances(stated: Mapping[str, float | str], cases: Sequence[Case]) -> dict[str, float]:
    """Return the largest errors (RMS) by signal, in the unit of the model's variable.

    Parameters
    ----------
    stated
        By signal, a number in the log's unit, or a text with a unit such as ``0.2 mm``, or ``5%`` of the signal's
        range in the runs.

    Raises
    ------
    CampaignError
        A signal is not an output of the runs, or a value is not a positive number with a suitable unit.
    """
    channels: dict[str, list[Channel]] = {}
    for channel in chain.from_iterable(case.channels for case in cases):
        channels.setdefault(channel.signal, []).append(channel)
    return {name: _tolerance(name, value, channels) for name, value in stated.items()}


def _tolerance(name: str, value: float | str, channels: Mapping[str, Sequence[Channel]]) -> float:
    where = f"tolerance of '{name}'"
    if name not in channels:
        raise CampaignError(f"the runs have no output '{name}'", where=where, fix=suggestion(name, channels))
    of_signal = channels[name]
    match = _VALUE.match(str(value))
    size = float(match["number"]) if match else 0.0
    if match is None or not 0.0 < size < np.inf:
        raise CampaignError(
            f"'{value}' is not a positive number", where=where, fix="write it as in 0.2, '0.2 mm' or 5%"
        )
    if match["unit"] == "%":
        return 0.01 * size * max(float(np.nanmax(c.repeats) - np.nanmin(c.repeats)) for c in of_signal)
    if not match["unit"]:
        return abs(size / of_signal[0].to_shown.factor)
    try:
        return abs(size * conversion(match["unit"], of_signal[0].unit).factor)
    except UnitError as error:
        raise CampaignError(error.what, where=where, fix=error.fix) from None


def tolerated(subject: Subject, fitted: Fitted) -> tuple[Tolerated, ...]:
    """Return a refitted model's errors beyond the noise.

    A tolerance is about what the model lacks, so parameters are fitted to all runs: what the noise leaves in them
    is no error of the model. Each parameter takes up the noise of one sample. A signal without a tolerance is in
    the list if its error exceeds the noise. Nothing is returned without a tolerance.
    """
    model, observed, folds = subject.model, subject.observed, subject.observed.folds
    if not subject.tolerances:
        return ()
    (predictions,) = model.predict([fitted.fit.values])
    if isinstance(predictions, SimulationError):
        return ()
    samples = sum(float(np.count_nonzero(run.mask)) for run in observed.runs)
    left = max(1.0 - len(fitted.fit.unknowns) / samples, 0.0)
    excess: dict[str, list[float]] = {}  # of the mean square error over noise, by fold
    floors: dict[str, list[float]] = {}
    shown: dict[str, Channel] = {}
    for (e, _), (begin, end) in zip(folds, observed.fold_times, strict=True):
        run, predicted = observed.runs[e], predictions[e]
        floor = left * observed.noise[run.setup].of_mean(run.n_repeats) ** 2
        for c, channel in enumerate(model.cases[e].channels):
            there = run.mask[c, begin:end] > 0.0
            if not there.any():
                continue
            first = shown.setdefault(channel.signal, channel)
            factor = conversion(channel.unit, first.unit).factor if channel.unit else 1.0
            error = factor * (predicted[c] - run.mean[c])[begin:end][there]
            floors.setdefault(channel.signal, []).append(factor**2 * float(floor[c]))
            excess.setdefault(channel.signal, []).append(float(np.mean(error**2)) - floors[channel.signal][-1])
    judged = []
    for name, of_signal in excess.items():
        limit, mean = subject.tolerances.get(name), float(np.mean(of_signal))
        small = GAP_THAT_MATTERS**2 * float(np.mean(floors[name]))
        if limit is None and mean <= small:
            continue
        factor = abs(shown[name].to_shown.factor)
        most = small if limit is None else limit**2
        judged.append(
            Tolerated(
                name,
                shown[name].shown_unit,
                factor * float(np.sqrt(max(0.0, mean))),
                None if limit is None else factor * limit,
                _below(of_signal, most) if len(of_signal) > 1 else float(of_signal[0] <= most),
            )
        )
    return tuple(judged)


def within_tolerance(subject: Subject, fitted: Fitted) -> bool:
    """Return whether a model is more likely than not as exact as the user needs it to be."""
    return small_enough(tolerated(subject, fitted))


def small_enough(errors: Sequence[Tolerated]) -> bool:
    """Return whether errors are more likely than not within their tolerances; False without a tolerance."""
    return bool(errors) and min(e.probability for e in errors) >= _LIKELIER_THAN_NOT


def _below(values: Sequence[float], most: float) -> float:
    """Return the probability that the mean behind a few values is at most `most`."""
    error = float(np.std(values, ddof=1) / np.sqrt(len(values)))
    apart = most - float(np.mean(values))
    return float(stdtr(float(len(values) - 1), apart / error)) if error > 0.0 else float(apart >= 0.0)
