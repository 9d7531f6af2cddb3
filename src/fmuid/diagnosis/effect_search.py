"""The search: the best-scored effects are refitted one by one, then combined as long as that pays off."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.core.progress import Say, quiet
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.diagnosis import decide
from fmuid.diagnosis.candidates import (
    Fitted,
    add_effect,
    approach_effect,
    leaving_out,
    led_out,
    moved,
    promising,
    score_at_start,
    score_early,
    score_further,
    score_there,
    unfitted,
    without,
    worth_care,
)
from fmuid.diagnosis.cross_validation import NoiseDraws
from fmuid.diagnosis.observed import excess, gap, orthonormal, project_off
from fmuid.diagnosis.refit import Refit, about
from fmuid.diagnosis.scores import (
    SEEN,
    Score,
    alias_classes,
    largest_drop,
    nominal_basis,
    score_effects,
    similarity,
    stack,
)
from fmuid.diagnosis.subject import Subject, responses_to_states
from fmuid.effects.effect import Unknown

_SINGLES = 7  # effects refitted on their own
_EARLY = 3  # of these, chosen by what early parts of the runs say
_EARLY_BESIDE = 2  # the same of further effects
_SHARE = 0.05  # least score for a refit, as a share of the best score
_EXTENDED = 2  # of the effects refitted together, those whose refits are extended to escape local minima
_PAIRS = 4  # further effects tried in addition to the best
_SCORED = 8  # effects that are scored again when another is added
_CLOSE = 0.5  # least score for being tried in place of another effect, as a share of the best score
_MOST = 3  # largest number of effects together
_GAIN = 0.1  # share of the remaining gap that a further effect closes before others are tried with it
_SHAPE = 0.1  # share of the gap (a hundredth of its energy) that the plant's shape of a law may leave of ours
_SAME_PLACE = 0.95  # correlation of one law's signatures at two ports above which the ports count as one
_LATE = ("lag", "delay")  # shapes of one law: how a signal comes late
_OF_TIME = (*_LATE, "drift")  # laws of a signal over time, which are not shapes of a law of its value
_ALIKE = 0.9  # correlation of signatures above which a law may stand in for another one

_Rest = Callable[[Fitted, str], Fitted | None]
"""A model and one of its effects -> the refit without it."""


def search(
    subject: Subject,
    nominal: Fitted,
    scores: Sequence[Score],
    noise: NoiseDraws,
    say: Say,
    *,
    present: bool,
    again: bool = False,
) -> tuple[list[Fitted], Fitted | None]:
    """Return every model that was refitted, and the best one.

    Sets of effects grow as long as a further effect predicts left-out experiments better. In each round, effects
    are added, replaced by others, and moved to other ports, alone and in pairs. Finally, effects that the others
    make unnecessary are dropped: each that remains closes enough of the gap beside all others, even if it closes
    little alone.

    Parameters
    ----------
    scores
        Scores of all effects with the nominal model.
    noise
        Null distribution: no effect is added to a model whose residual is within the noise.
    present
        Whether there is a gap; without one, only the two best effects are refitted.
    again
        Whether another search follows unless the best explanation of this one holds beyond doubt. A pair that
        does not is then left as it is.
    """
    singles, early, at_start, elsewhere = _promising(scores)[:2], list[str](), list[str](), _Elsewhere()
    if present:
        elsewhere = _elsewhere(subject, nominal, _Elsewhere(scores, scores))
        singles, early, at_start = _chosen(elsewhere, _promising(scores), _SINGLES, _EARLY)

    def tell(task: str, done: float) -> None:
        say(task, 0.15 + 0.35 * done)

    candidates = _added(subject, nominal, singles, early, at_start, say=tell)
    if not candidates:
        return [], None
    best = decide.best_of(candidates, subject.observed)
    if present:  # the same law at another port may have ended in a local minimum
        candidates += _moved(subject, best, candidates, scores)
        best = decide.best_of(candidates, subject.observed)
        candidates += _instead(subject, nominal, best, candidates, scores)
        best = decide.best_of(candidates, subject.observed)
    signatures = _signatures(subject, nominal, candidates, scores)[0]

    @cache
    def without_one(fitted: Fitted, name: str) -> Fitted | None:  # to the end where others are tried instead
        return without(subject, fitted, name, compared=len(fitted.effects) > decide.MOST_CALIBRATED)

    while present and len(best.effects) < _MOST and not exact_enough(subject, nominal, best):
        say(f"looking for effects in addition to {best.id}", 0.5 + 0.1 * len(best.effects))
        shape = best.gap < _SHAPE * nominal.gap  # a law there may only correct the shape of one that is known
        company = [
            c
            for c in _company(subject, best, scores, elsewhere, noise)
            if not (shape and _same_place(subject, c, signatures))
        ]
        better = decide.best_of(company, subject.observed) if company else None
        # No others are tried with a third effect, so one that would be dropped at the end is not added.
        least = _GAIN if len(best.effects) < decide.MOST_CALIBRATED else decide.GAIN_OF_A_SECOND
        if better is None or not decide.worth_adding(best, better, least):
            break
        candidates += company
        best = better
        if len(best.effects) <= decide.MOST_CALIBRATED:  # a set of three is provisional, whichever it is
            best = _exchanged(subject, best, candidates, scores, without_one)
        if again and not holds(subject, nominal, best):
            break
    return candidates, _pruned(subject, nominal, best, candidates, without_one)


def aliases(
    subject: Subject, nominal: Fitted, candidates: Sequence[Fitted], scores: Sequence[Score], *, seen: float
) -> tuple[tuple[str, ...], ...]:
    """Return the classes of effects that could not be distinguished if one of them caused the gap.

    When they explain a gap of this size, or one that would just be `seen` (as a drop of the cost), their
    predictions differ by fewer standard deviations than a preference requires. What the best of all models leaves
    counts as noise, as it does in odds. The comparison uses the signatures of refitted effects if available,
    otherwise those of trials.
    """
    base = stack(nominal.fit.residuals, subject.observed)
    left = float(np.mean(subject.observed.repeats)) * min(c.gap for c in (nominal, *candidates)) ** 2
    energy = max((float(base @ base) - base.size) / decide.spread(left) ** 2, seen)
    tried, refitted = _signatures(subject, nominal, candidates, scores)
    for score in scores:  # indistinguishable effects were scored once
        tried |= {
            name: refitted.get(score.effect, tried[score.effect]) for name in (twin.effect for twin in score.same)
        }
    alike = max(0.0, 1.0 - decide.SAME**2 / energy) ** 0.5 if energy > 0.0 else 0.0
    return alias_classes({**tried, **refitted}, threshold=alike)


@dataclass(frozen=True, slots=True, eq=False)
class _Elsewhere:
    """Scores in early parts of the runs, and at the start values.

    Where a model has drifted away from the plant, scores of whole runs say little; those of early parts say more.
    Without the effect that is missing, the estimate may be far away; the start values are not.
    """

    early: Sequence[Score] = ()
    at_start: Sequence[Score] = ()


def _elsewhere(subject: Subject, fitted: Fitted, before: _Elsewhere, most: int | None = None) -> _Elsewhere:
    """Score further effects in early parts of the runs and at the start values.

    Of effects that scores `before` do not distinguish, one is scored; if a number is given, the `most` promising.
    """
    return _Elsewhere(
        score_early(subject, fitted, likely=before.early, most=most),
        score_at_start(subject, fitted, likely=before.at_start, most=most),
    )


def _chosen(
    elsewhere: _Elsewhere, whole: Sequence[Score], most: int, first: int
) -> tuple[list[Score], list[str], list[str]]:
    """Return the effects to add: those that promise most early, at the start values, and at the estimate.

    The `first` effects of each are in addition to those at the estimate, which are tried first: they are known to
    gain. The first ones early and at the start values are also returned by name.
    """
    early, begin = (
        {s.effect: s for s in _promising(scores) if s.drop > SEEN**2}
        for scores in (elsewhere.early, elsewhere.at_start)
    )
    by_name = {**begin, **early, **{s.effect: s for s in whole}}
    firsts = [*early][:first], [*begin][:first]
    order = dict.fromkeys([*firsts[0], *firsts[1], *(s.effect for s in whole)])
    chosen, at_estimate = [by_name[name] for name in order][: most + first], {s.effect for s in whole}
    return sorted(chosen, key=lambda s: s.effect not in at_estimate), *firsts


def _signatures(
    subject: Subject, nominal: Fitted, candidates: Sequence[Fitted], scores: Sequence[Score]
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return signatures of unit length by effect: of the trials, and of the effects refitted on their own."""
    basis = nominal_basis(nominal.fit, subject.observed)
    base = stack(nominal.fit.residuals, subject.observed)
    refitted = {}
    for fitted in candidates:
        if len(fitted.effects) == 1:
            moved = project_off(stack(fitted.fit.residuals, subject.observed) - base, basis)
            length = float(np.linalg.norm(moved))
            if length > 1.0:
                refitted[fitted.effects[0]] = moved / length
    return {s.effect: s.signature for s in scores if s.signature is not None}, refitted


def _same_place(subject: Subject, after: Fitted, signatures: Mapping[str, FloatArray]) -> bool:
    """Return whether the newest effect in `after` acts where an earlier one does, or nearly does the same.

    Where it acts is its own port, or one that no law present at both ports distinguishes from it. The value of a
    held parameter acts wherever its component does. A drift of a signal, and its being late, are separate effects.
    """
    *others, newest = (subject.by_id[id] for id in after.effects)
    if newest.law in _OF_TIME:
        return newest.law in _LATE and any(e.law in _LATE and e.port == newest.port for e in others)
    before = {e.port for e in others}
    if newest.port in before or newest.law == "value":
        return True
    if any(
        similarity(signatures[newest.id], signatures[e.id]) > _ALIKE
        for e in others
        if {newest.id, e.id} <= signatures.keys()
    ):
        return True
    at = {(e.law, e.port): signatures[e.id] for e in subject.effects if e.id in signatures}
    return any(
        similarity(signature, at[law, old]) > _SAME_PLACE
        for (law, port), signature in at.items()
        for old in before
        if port == newest.port and (law, old) in at
    )


def singles_of(scores: Sequence[Score]) -> list[Score]:
    """Return the scores of the effects that are first refitted on their own."""
    return _promising(scores)[:_SINGLES]


def _promising(scores: Sequence[Score], share: float = _SHARE) -> list[Score]:
    least = share * max((s.drop for s in scores), default=0.0)
    return [s for s in scores if s.signature is not None and s.drop > 0.0 and s.drop >= least]


def _company(
    subject: Subject, best: Fitted, scores: Sequence[Score], before: _Elsewhere, noise: NoiseDraws
) -> list[Fitted]:
    """Refit `best` with further effects; none if its residual and their scores are within the noise.

    A third effect is provisional, so it is not looked for where only beginnings or the start values show it, and
    only the best fit escapes from local minima.
    """
    further, finished = _further(subject, best, scores, noise)
    if finished:
        return []
    distinct = _distinct(subject, further)
    if len(best.effects) >= decide.MOST_CALIBRATED:
        return _added(subject, best, distinct[:_PAIRS], extended=1)
    elsewhere = _elsewhere(subject, best, before, _SCORED)
    return _added(subject, best, *_chosen(elsewhere, distinct, _PAIRS, _EARLY_BESIDE))


def _distinct(subject: Subject, scores: Sequence[Score]) -> list[Score]:
    """Return the simplest of each group of effects that do nearly the same, those that score best first."""
    groups: list[list[tuple[Score, FloatArray]]] = []
    for score in scores:
        if (signature := score.signature) is None:
            continue
        group = next((g for g in groups if similarity(g[0][1], signature) > _ALIKE), None)
        if group is None:
            groups.append([(score, signature)])
        else:
            group.append((score, signature))
    return [
        min(
            (s for s, _ in group if s.drop >= _CLOSE * group[0][0].drop),
            key=lambda s: subject.by_id[s.effect].preference,
        )
        for group in groups
    ]


def _further(
    subject: Subject, best: Fitted, scores: Sequence[Score], noise: NoiseDraws
) -> tuple[list[Score], bool]:
    """Score further effects added to `best`; also return whether scores and residual are within the noise."""
    further = _promising(score_further(subject, best, likely=scores, most=_SCORED))
    null = noise.null(
        nominal_basis(best.fit, subject.observed), [s.signature for s in further if s.signature is not None]
    )
    left = null.p_value(excess(best.fit.residuals, subject.observed))
    largest = largest_drop(further, subject.by_id)
    return further, left >= decide.SIGNIFICANCE and largest <= decide.SCORE_MARGIN * null.threshold()


def holds(subject: Subject, nominal: Fitted, best: Fitted | None) -> bool:
    """Return whether an explanation holds beyond doubt on left-out experiments."""
    return best is not None and decide.beyond_doubt(
        nominal, best, finished=best.gap <= GAP_THAT_MATTERS, bounded=subject.observed.bounded
    )


def promise_more_than_starts(subject: Subject, fit: Refit, started: Subject, freed: Refit) -> bool:
    """Return whether effects promise to be likelier than start states that are estimated.

    The start states of each run were refitted, in `freed`. Those that all runs share, and up to two effects, are
    linear at `fit`, the refit of the plain model.
    """
    observed, basis = subject.observed, nominal_basis(fit, subject.observed)
    residual, nominal = stack(fit.residuals, observed), leaving_out(subject, (), fit, chords=0)
    ends = np.cumsum([len(part) for part in fit.residuals])[:-1]

    def leaving(left: FloatArray, more: Sequence[Unknown] = ()) -> Fitted:
        parts = [p / np.sqrt(n) for p, n in zip(np.split(left, ends), observed.repeats, strict=True)]
        cost = fit.cost - float(residual @ residual) + float(left @ left)
        linear = replace(fit, unknowns=(*fit.unknowns, *more), residuals=tuple(parts), cost=cost)
        return replace(nominal, fit=linear, gap=gap(parts, observed))

    responses = [*responses_to_states(observed, started.model, fit.values)]
    setups = [run.setup for run in observed.runs]
    shared = [
        stack([r if setup == one else 0.0 * r for r, setup in zip(responses, setups, strict=True)], observed)
        for one in dict.fromkeys(setups)
    ]
    together = orthonormal(project_off(np.hstack(shared), basis))
    equal = leaving(project_off(residual, together))
    scores = score_effects(subject.model.predict, observed, fit, subject.effects)
    signatures = {s.effect: s.signature for s in scores if s.signature is not None}
    chosen, left = list[str](), residual
    while signatures and len(chosen) < decide.MOST_CALIBRATED:
        chosen.append(max(signatures, key=lambda name: abs(float(signatures[name] @ left))))
        left = project_off(residual, orthonormal(np.stack([signatures[name] for name in chosen], axis=1)))
    effects = leaving(left, [u for name in chosen for u in subject.by_id[name].unknowns])
    return (
        decide.odds_of_starts(freed, nominal, effects, started.observed) < 0.0
        and decide.odds_of_starts(equal.fit, nominal, effects, observed, together.shape[1]) < 0.0
    )


def finished(subject: Subject, nominal: Fitted, best: Fitted, scores: Sequence[Score], noise: NoiseDraws) -> bool:
    """Return whether the remaining gap of `best` is irrelevant, within the tolerances or within the noise."""
    return exact_enough(subject, nominal, best) or _further(subject, best, scores, noise)[1]


def exact_enough(subject: Subject, nominal: Fitted, fitted: Fitted) -> bool:
    """Return whether nothing that matters is left: the gap is irrelevant, or within what the user tolerates.

    A model within the tolerance also has to close enough of the gap on left-out experiments for its effects to be
    named: another effect may be missing, without which they are wrong there.
    """
    if fitted.gap <= GAP_THAT_MATTERS:
        return True
    bounded = subject.observed.bounded
    return decide.within_tolerance(subject, fitted) and decide.names(
        nominal, fitted, finished=True, bounded=bounded
    )


def _added(
    subject: Subject,
    fitted: Fitted,
    scores: Sequence[Score],
    early: Sequence[str] = (),
    at_start: Sequence[str] = (),
    *,
    extended: int = _EXTENDED,
    rival: float = np.inf,
    say: Say = quiet,
) -> list[Fitted]:
    """Refit `fitted` with the scored effects; return the models that fit better than it does.

    Quick searches with each of them choose those that are refitted with care. The `extended` best fits, and
    `early` effects, which may be far from their best, escape from local minima. An early effect whose quick search
    gains less than its uncertainty promises no more than others do. Quick searches with effects that promise most
    `at_start` begin at the start values as well.
    """
    approached: list[tuple[float, Mapping[str, float], Score]] = []
    for k, score in enumerate(scores):
        say(f"trying {score.effect}", 0.4 * k / len(scores))
        least = min((cost for cost, *_ in approached), default=np.inf)
        most = np.inf if score.effect in early else worth_care(least, fitted.fit.cost)
        end = approach_effect(subject, fitted.fit, score, most, everywhere=score.effect in at_start)
        if end is not None:
            approached.append((*end, score))
    best = promising(approached, fitted.fit.cost)
    gaining = [one for one in approached if one[2].effect in early and about(one[0]) < fitted.fit.cost]
    chosen = [*best, *(one for one in gaining if one not in best)]
    refits: list[tuple[Fitted, Score]] = []
    for k, (cost, values, score) in enumerate(chosen):
        say(f"refitting with {score.effect}", 0.4 + 0.3 * k / len(chosen))
        neutral = {**fitted.fit.values, **subject.by_id[score.effect].neutral}
        begin = values if cost < fitted.fit.cost else neutral
        added = add_effect(subject, fitted, score, [begin], rival)
        if added is not None:
            refits.append((added, score))
            rival = min(rival, added.fit.cost)
    refits.sort(key=lambda pair: pair[0].fit.cost)
    likely = {score.effect for _, score in refits[:extended]}.union(score.effect for *_, score in gaining)
    for k, (added, score) in enumerate(refits):
        if score.effect in likely:
            say(f"refitting further with {score.effect}", 0.7 + 0.3 * k / len(refits))
            refits[k] = led_out(subject, added, score, rival), score
    return [added for added, _ in refits if added.fit.cost < fitted.fit.cost]


def _exchanged(
    subject: Subject, best: Fitted, candidates: list[Fitted], scores: Sequence[Score], without_one: _Rest
) -> Fitted:
    """Return the best set of as many effects, after each effect was tried to be replaced by others.

    The first effect was chosen while the others were missing, and may have stood in for them. What was refitted is
    added to the `candidates`: sets that fit equally well are open answers.
    """
    explored = {frozenset(best.effects[:-1])}  # others were tried in addition to these
    while True:
        around = {frozenset(best.effects) - {name}: name for name in best.effects}
        fresh = [(rest, name) for rest, name in around.items() if rest not in explored]
        if not fresh:
            return best
        candidates += _moved(subject, best, candidates, scores)
        candidates += _crossed(subject, best, candidates, scores)
        for rest, name in fresh:
            explored.add(rest)
            candidates += _replaced(subject, without_one(best, name), candidates, scores, best.fit.cost)
        best = decide.best_of([c for c in candidates if len(c.effects) == len(best.effects)], subject.observed)


def _moved(
    subject: Subject, best: Fitted, candidates: Sequence[Fitted], scores: Sequence[Score]
) -> Iterator[Fitted]:
    """Yield refits of `best` with one of its laws at another port where it does much the same.

    A law may only resemble the plant's, so others that do much the same at its port are tried as well. Sets that
    are known to fit about as well are left out.
    """
    good = {frozenset(c.effects) for c in candidates if c.fit.cost <= about(best.fit.cost)}
    by_id = subject.by_id
    signatures = {s.effect: s.signature for s in scores if s.signature is not None}
    for name in best.effects:
        rest, before = frozenset(best.effects) - {name}, signatures.get(name)
        for score in (s for s in scores if s.effect not in best.effects):
            there = signatures.get(score.effect)
            one, other = by_id[name], by_id[score.effect]
            related = one.law == other.law != "value" or one.port == other.port
            alike = related and before is not None and there is not None and similarity(before, there) > _ALIKE
            if alike and rest | {score.effect} not in good:
                exchanged = moved(subject, best, {name: score})
                if exchanged is not None:
                    yield exchanged


def _crossed(
    subject: Subject, best: Fitted, candidates: Sequence[Fitted], scores: Sequence[Score]
) -> Iterator[Fitted]:
    """Yield refits of `best` with two of its laws at each other's ports, which no single exchange leads to."""
    known = {frozenset(c.effects) for c in candidates}
    by_id, at = subject.by_id, {(subject.by_id[s.effect].law, subject.by_id[s.effect].port): s for s in scores}
    for a, b in combinations(best.effects, 2):
        first, second = (at.get((by_id[x].law, by_id[y].port)) for x, y in ((a, b), (b, a)))
        if first is None or second is None or by_id[a].law == by_id[b].law:
            continue
        rest, crossed = frozenset(best.effects) - {a, b}, {first.effect, second.effect}
        if not rest & crossed and rest | crossed not in known:
            exchanged = moved(subject, best, {a: first, b: second})
            if exchanged is not None:
                yield exchanged


def _replaced(
    subject: Subject, rest: Fitted | None, candidates: Sequence[Fitted], scores: Sequence[Score], rival: float
) -> list[Fitted]:
    """Refit what is left of a model without one of its effects with the most promising others instead.

    The cost of that model is the `rival`.
    """
    if rest is None:
        return []
    tried = {frozenset(c.effects) for c in candidates}
    others = _promising(score_further(subject, rest, likely=scores, most=_SCORED), _CLOSE)[:_PAIRS]
    fresh = [s for s in others if frozenset((*rest.effects, s.effect)) not in tried]
    extended = 0 if len(rest.effects) >= decide.MOST_CALIBRATED else _EXTENDED  # as in `_company`
    return _added(subject, rest, fresh, extended=extended, rival=rival)


def _instead(
    subject: Subject, nominal: Fitted, best: Fitted, candidates: Sequence[Fitted], scores: Sequence[Score]
) -> list[Fitted]:
    """Refit with effects that promise to fit as well as `best` where its other parameters are.

    A refit without any effect may have moved them far away, where another effect no longer promises anything.
    """
    there = unfitted(subject, nominal, best.fit.values)
    if there is None:
        return []
    tried = {name for c in candidates for name in c.effects}
    promised = score_there(subject, there, about(best.fit.cost), likely=scores)
    fresh = [s for s in promised if s.effect not in tried][:_PAIRS]
    added = _added(subject, there, fresh, extended=0, rival=best.fit.cost)
    return [c for c in added if c.fit.cost < nominal.fit.cost]


def _pruned(
    subject: Subject, nominal: Fitted, best: Fitted, candidates: list[Fitted], without_one: _Rest
) -> Fitted:
    """Leave out of `best`, one by one, the effects without which nothing that matters is missing.

    The first effect added stands in for much that is missing; once the rest is there, it may explain nothing.
    """
    while len(best.effects) > 1:
        simpler = [without_one(best, name) for name in best.effects]
        enough = [
            s
            for s in simpler
            if s is not None
            and (exact_enough(subject, nominal, s) or not decide.needed(s, best, subject.observed))
        ]
        if not enough:
            break
        best = decide.best_of(enough, subject.observed)
        candidates.append(best)
    return best
