"""From refitted candidates to a verdict: what is supported, what cannot be told apart, what none explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.catalogue import Effect
from fmuid.diagnosis.cross_validation import advantage, closure
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.ports import OWN_PAST, Decoy
from fmuid.diagnosis.refit import Unknown
from fmuid.diagnosis.scores import stack

# Calibrated on the virtual rig (`make blind`), never on data whose answer is to be found.
GAP_THAT_MATTERS = 0.25  # floors: smaller gaps are within what sampling and discretisation of a rig leave
SIGNIFICANCE = 0.01
SCORE_MARGIN = 2.0  # the largest score must be this many times what noise reaches in one diagnosis of a hundred
CLOSURE_THAT_PLACES = 0.1  # free functions at a port must close at least this much for the port to be named
CLOSURE_THAT_NAMES = 0.5  # a named effect must close at least half of the gap on experiments left out
CLOSURE_THAT_FINISHES = 1 / 3  # or this much of a weak gap, if then nothing is left that noise would not leave
GAIN_OF_A_SECOND = 0.25  # a further effect must close at least a quarter of what is left
DECOY_MARGIN = 0.65  # a decoy must leave less than this share of the gap of the best named effect
ABOUT_AS_WELL = 1.5  # ratio of gaps left: a free function is one linear step, effects are refitted to the end
CLOSURE_BEYOND_DECOYS = 0.85  # an effect that closes this much is not unknown: its law has another shape
SAME = 4.0  # models whose predictions differ by fewer standard deviations cannot be told apart
_BLOCK = 20.0  # samples of model error that carry as much as one of noise


def separation(a: Fitted, b: Fitted, observed: Observed) -> float:
    """Return by how many standard deviations the data prefer `a` to `b` (negative: `b` to `a`).

    The predictions of the two models differ by D sigma; if one of them is true the difference of their costs is
    D^2 with a standard deviation of 2 D. What even the better of the two leaves unexplained counts as noise as
    well, and is far from white: `_BLOCK` of its samples count as one.
    """
    ra, rb = stack(a.fit.residuals, observed), stack(b.fit.residuals, observed)
    difference = float(np.linalg.norm(ra - rb))
    if difference == 0.0:
        return 0.0
    left = float(np.mean(observed.repeats)) * min(a.gap, b.gap) ** 2
    spread = 1.0 + _BLOCK * left
    if observed.bounded:  # what is left may be noise as well, and is not even
        better = ra if a.fit.cost <= b.fit.cost else rb
        spread *= max(1.0, float((ra - rb) ** 2 @ better**2) / difference**2)
    return (b.fit.cost - a.fit.cost) / (2.0 * difference * float(np.sqrt(spread)))


def best_of(candidates: Sequence[Fitted]) -> Fitted:
    """Return the candidate with the least loss on experiments left out, among those that fit about as well."""
    least = min(c.fit.cost for c in candidates)
    close = [c for c in candidates if c.fit.cost <= 1.05 * least + 20.0]
    return min(close, key=lambda c: float(np.average(c.held_out.loss, weights=c.held_out.size)))


def indistinguishable(best: Fitted, candidates: Sequence[Fitted], observed: Observed) -> tuple[Fitted, ...]:
    """Return the candidates of the same number of effects that the data do not prefer `best` to, itself first."""
    others = [
        c
        for c in candidates
        if set(c.names) != set(best.names)
        and len(c.names) == len(best.names)
        and separation(best, c, observed) < SAME
    ]
    return (best, *sorted(others, key=lambda c: c.fit.cost))


def worth_adding(before: Fitted, after: Fitted) -> bool:
    """Return whether a further effect closes enough of what was left, on held-out experiments too."""
    gained, error = advantage(after.held_out, before.held_out)
    left = 1.0 - after.gap / before.gap if before.gap > 0 else 0.0
    return gained > error and left >= GAIN_OF_A_SECOND and closure(before.held_out, after.held_out) > 0.0


def names(nominal: Fitted, best: Fitted, *, finished: bool) -> bool:
    """Return whether `best` closes enough of the gap for its effects to be named.

    Of a weak gap much is chance, and where one experiment alone shows it, leaving that out leaves little to
    learn from: there it is enough that with the effects the model is complete, unless *unknown* is likelier.
    """
    trained = 1.0 - best.gap / nominal.gap if nominal.gap > 0.0 else 0.0
    held_out = closure(nominal.held_out, best.held_out)
    likely = held_out * len(best.names) >= _doubt(held_out)
    return held_out >= CLOSURE_THAT_NAMES or (likely and finished and trained >= CLOSURE_THAT_FINISHES)


def beyond_doubt(nominal: Fitted, best: Fitted, *, finished: bool) -> bool:
    """Return whether no free function could show that the gap is none of the effects of `best`."""
    closed = closure(nominal.held_out, best.held_out)
    return closed >= CLOSURE_BEYOND_DECOYS or (finished and names(nominal, best, finished=True))


def strained(fitted: Fitted, effects: Sequence[Effect]) -> bool:
    """Return whether a named effect's sizes and shapes ended at bounds that neither its start nor a trial has.

    Bounds count together: what two trials have one by one is no law that anybody thought plausible. The law is
    then used for something else than what its effect is.
    """
    for effect in (e for e in effects if e.id in fitted.names):
        near = {u.name: 0.01 * u.step for u in effect.unknowns}
        at = {
            u.name: bound
            for u in effect.unknowns
            for bound in _limits(effect, u)
            if abs(fitted.fit.values[u.name] - bound) <= near[u.name]
        }
        plausible = [{**effect.neutral, **trial} for trial in ({}, *effect.trials)]
        if at and not any(all(p[name] == bound for name, bound in at.items()) for p in plausible):
            return True
    return False


def _limits(effect: Effect, unknown: Unknown) -> set[float]:
    """Return the bounds of a shape, or of a size: where an effect may be no larger. It may be off."""
    bounds, neutral = {unknown.lower, unknown.upper}, effect.neutral[unknown.name]
    if unknown.name in effect.shapes or effect.two_sided:
        return bounds
    return bounds - {neutral} if neutral in bounds else set()


def unexplained(nominal: Fitted, best: Fitted, decoys: Sequence[Decoy], ports: Sequence[str]) -> Decoy | None:
    """Return the decoy that shows the gap to be none of the named effects, if one does.

    That is: it leaves much less of the gap on experiments left out than the best named effect does, and that
    effect does not close nearly all of it. Where an effect at one of `ports` is named, what a sensor there makes
    of its own past is no evidence: any lag is that, of whatever order.
    """
    lumped = len(best.names) > 1 and len(set(ports)) == 1
    decoys = [d for d in decoys if (d.port in ports if lumped else d.over != OWN_PAST or d.port not in ports)]
    if not decoys or (closure(nominal.held_out, best.held_out) >= CLOSURE_BEYOND_DECOYS and not lumped):
        return None
    decoy = min(decoys, key=lambda d: float(np.average(d.held_out.loss, weights=d.held_out.size)))
    if lumped:  # one law of one variable that nobody has named, in place of two that have been
        return decoy if decoy.held_out.gap <= ABOUT_AS_WELL * best.held_out.gap else None
    gained, error = advantage(decoy.held_out, best.held_out)
    if gained > error and decoy.held_out.gap < DECOY_MARGIN * best.held_out.gap:
        return decoy
    return None


def probabilities(
    nominal: Fitted,
    candidates: Sequence[Fitted],
    best: Fitted | None,
    observed: Observed,
    *,
    present: bool,
    unknown: bool,
    effect_ids: Sequence[str],
) -> Mapping[str, float]:
    """Return the probability of every effect, of ``none`` and of ``unknown``; they sum to 1.

    Weights fall with the square of the separation from the best candidate; ``unknown`` weighs as much as its
    closure leaves open.
    """
    weight = dict.fromkeys((*effect_ids, "none", "unknown"), 1e-3)
    if not present:
        weight["none"] = 1.0
        shift = max(0.0, nominal.gap / GAP_THAT_MATTERS) ** 2
        if best is not None:
            for name in best.names:
                weight[name] = max(weight[name], 0.15 * shift)
    elif best is not None:
        closed = float(np.clip(closure(nominal.held_out, best.held_out), 0.0, 1.0))
        weight["unknown"] = 0.95 if unknown else max(0.02, _doubt(closed))
        share = max(1e-3, 0.05 if unknown else closed)
        for candidate in candidates:
            if len(candidate.names) != len(best.names):
                continue
            same = set(candidate.names) == set(best.names)
            z = 0.0 if same else max(0.0, separation(best, candidate, observed))
            for name in candidate.names:
                weight[name] = max(weight[name], share * float(np.exp(-0.5 * z**2)))
    else:
        weight["unknown"] = 1.0
    total = sum(weight.values())
    return {name: w / total for name, w in weight.items()}


def _doubt(closed: float) -> float:
    """Return what *unknown* weighs beside effects that close so much of the held-out gap, and weigh as much."""
    return (1.0 - closed) ** 2
