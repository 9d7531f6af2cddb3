"""Scores: how much of the residual each effect could explain that refitting the nominal parameters cannot.

One finite-step simulation per trial magnitude gives an effect's signature. The part that the nominal parameters
can imitate is projected off it, in units of noise; the rest is compared with the residual. Finite steps matter:
the gradients of backlash and saturation at their neutral values are zero. (A score test, Rao 1948, with finite
steps.)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.observed import Observed, orthonormal
from fmuid.diagnosis.refit import Predict, Refit
from fmuid.diagnosis.verdict import Hidden
from fmuid.effects.effect import Effect

_NEARLY = 0.98  # correlation of signatures above which effects are compared again at matched sizes
_COMPARED = 3  # number of the most similar ones compared
SEEN = 5.0  # standard deviations: smaller effects would not be named
_OVERSHOOT = 2.0  # response over the residual from which a trial is scaled down: laws and plants are not linear
_PRIOR = 4.0  # runs that the noise floor counts for where scatter from run to run is estimated
_SCALED = 4  # times
_AT_ONCE = 64  # trials simulated together: their predictions are in memory, each as long as all runs


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """The part of the residual that one effect could explain.

    Attributes
    ----------
    trial
        The plausible values that did best.
    trials
        All of them, at sizes that move the predictions at most about as much as the gap.
    drop
        By how much the cost would fall if the signature were scaled to fit.
    scale
        That factor, applied to the trial's signature.
    per_run
        Drop divided by its own run-to-run standard error: how many of these the mean over runs is above zero.
    signature
        The trial's projected signature, of unit length; None if it does not move any signal.
    moved, length
        By how many sigmas the trial moves the predictions, and by how many beyond what the fitted parameters can
        do.
    within
        What it does within that, in the basis of `nominal_basis`.
    same
        Scores of effects that the data cannot distinguish from this one, which stands for them.
    largest
        Score of the trial that does most, at the size that is plausible.
    """

    effect: str
    trial: Mapping[str, float]
    drop: float
    scale: float
    per_run: float
    signature: FloatArray | None
    moved: float = 0.0
    length: float = 0.0
    within: FloatArray | None = None
    trials: tuple[Mapping[str, float], ...] = ()
    same: tuple[Score, ...] = ()
    largest: Score | None = None


def stack(parts: Sequence[FloatArray], observed: Observed) -> FloatArray:
    """Join whitened vectors (or matrices) of all experiments, each weighted by the root of its repeats."""
    return np.asarray(np.concatenate([np.sqrt(n) * p for n, p in zip(observed.repeats, parts, strict=True)]))


def nominal_basis(base: Refit, observed: Observed) -> FloatArray:
    """Return an orthonormal basis of the responses of the predictions to the refitted parameters."""
    return orthonormal(stack(base.jacobian, observed))


def score_effects(
    predict: Predict, observed: Observed, base: Refit, effects: Sequence[Effect]
) -> tuple[Score, ...]:
    """Score every effect at the refitted model `base`, best first, without trials that fail to simulate."""
    trials = [(effect, trial) for effect in effects for trial in effect.trials]
    plain = list(score_trials(predict, observed, base, trials))
    scored = _matched(predict, observed, base, trials, plain)
    of_effect = {e.id: [s for s in scored if s is not None and s.effect == e.id] for e in effects}
    largest = {s.effect: s for s in sorted((s for s in plain if s is not None), key=lambda s: s.length)}
    best = [
        replace(max(scores, key=lambda s: s.drop), trials=tuple(s.trial for s in scores), largest=largest[name])
        if scores
        else Score(name, {}, 0.0, 0.0, 0.0, None)
        for name, scores in of_effect.items()
    ]
    return tuple(sorted(best, key=lambda s: -s.drop))


def _matched(
    predict: Predict,
    observed: Observed,
    base: Refit,
    trials: Sequence[tuple[Effect, Mapping[str, float]]],
    plain: Sequence[Score | None],
) -> list[Score | None]:
    """Return scores of trials from their `plain` ones: trials that do more than about the gap are scaled down.

    What a far larger effect does says little about one of the size of the gap: a plant without control drifts away
    from where its response is linear in the effect.
    """
    target = float(np.linalg.norm(stack(base.residuals, observed)))
    matched = list(plain)
    for _ in range(_SCALED):
        large = {k: s for k, s in enumerate(matched) if s is not None and s.length > _OVERSHOOT * target}
        if not large:
            break
        smaller = [(trials[k][0], trials[k][0].scaled(s.trial, target / s.length)) for k, s in large.items()]
        for k, score in zip(large, score_trials(predict, observed, base, smaller), strict=True):
            matched[k] = score
    return matched


def score_trials(
    predict: Predict, observed: Observed, base: Refit, trials: Sequence[tuple[Effect, Mapping[str, float]]]
) -> Iterator[Score | None]:
    """Yield the score of each trial, None for those that fail to simulate."""
    basis = nominal_basis(base, observed)
    residual = stack(base.residuals, observed)
    outcomes = (
        outcome
        for begin in range(0, len(trials), _AT_ONCE)
        for outcome in predict(
            [{**base.values, **e.neutral, **trial} for e, trial in trials[begin : begin + _AT_ONCE]],
            near=base.values,
        )
    )
    for (effect, trial), outcome in zip(trials, outcomes, strict=True):
        if isinstance(outcome, SimulationError):
            yield None
            continue
        difference = stack(observed.residuals(outcome), observed) - residual
        within = basis.T @ difference
        signature = difference - basis @ within
        moved, length = (float(np.linalg.norm(v)) for v in (difference, signature))
        if length <= 1e-6 * max(1.0, moved):
            yield Score(effect.id, trial, 0.0, 0.0, 0.0, None, moved, length)
            continue
        signature /= length
        amount = -float(signature @ residual)
        drop = amount**2 if amount > 0 or effect.two_sided else 0.0
        per_run = _per_run(signature, amount, observed)
        yield Score(effect.id, trial, drop, amount / length, per_run, signature, moved, length, within)


def without_aliases(
    predict: Predict, observed: Observed, base: Refit, effects: Sequence[Effect], scores: Sequence[Score]
) -> tuple[Score, ...]:
    """Return the scores without indistinguishable effects, which move to `same` of the effect that remains.

    Two effects are the same if the data would prefer one to the other by less than a standard deviation: the sine
    of the angle between their signatures, times what the better-scored of them explains (at least `SEEN` standard
    deviations). Trials differ in size, and laws are seldom linear, so effects that are nearly alike are compared
    again at sizes that move the predictions equally. Among equals, the more usual effect remains, then the one
    with fewer parameters, then a deviating parameter value, then the first.
    """
    by_id = {s.effect: s for s in scores}
    order = sorted(effects, key=lambda e: e.preference)
    shown = [(e, s) for e in order if (s := by_id.get(e.id)) is not None and s.signature is not None]
    signatures = np.array([s.signature for _, s in shown])
    cosines = signatures @ signatures.T
    near: dict[tuple[int, int], float] = {}
    for i, (effect, _) in enumerate(shown):
        for k in np.argsort(-np.abs(cosines[i, :i]), kind="stable")[:_COMPARED]:
            if abs(cosines[i, k]) > _NEARLY and (effect.two_sided or cosines[i, k] > 0.0):
                near[i, int(k)] = float(cosines[i, k])
    sizes = []
    for (i, k), cosine in near.items():
        effect, score = shown[i]
        sizes.append((effect, effect.scaled(score.trial, np.copysign(shown[k][1].length / score.length, cosine))))
    for (i, k), matched in zip(near, score_trials(predict, observed, base, sizes), strict=True):
        if matched is not None and matched.signature is not None:
            again = abs(float(signatures[k] @ matched.signature))
            cosines[i, k] = max(abs(cosines[i, k]), again)
    kept: dict[int, Score] = {}
    for i, (_, score) in enumerate(shown):
        same = next((k for k, one in kept.items() if _equal(one, score, float(cosines[i, k]))), None)
        if same is None:
            kept[i] = score
        else:
            kept[same] = replace(kept[same], same=(*kept[same].same, score))
    left = {score.effect: score for score in kept.values()}
    return tuple(left.get(s.effect, s) for s in scores if s.effect in left or s.signature is None)


def _equal(a: Score, b: Score, cosine: float) -> bool:
    explained = max(np.sqrt(a.drop), np.sqrt(b.drop), SEEN)
    return bool(explained * np.sqrt(max(0.0, 1.0 - cosine**2)) < 1.0)


def _per_run(signature: FloatArray, amount: float, observed: Observed) -> float:
    """Return amount over its standard error from run to run, moderated towards that of the noise floor (1)."""
    total, dof, begin = 0.0, 0.0, 0
    for run, scatter in zip(observed.runs, observed.scatter, strict=True):
        part = signature[begin : begin + scatter.shape[1]]
        begin += scatter.shape[1]
        if run.n_repeats < 2:
            continue
        each = scatter @ part
        total += float(each @ each)
        dof += run.n_repeats - 1
        # Each run's projection has variance |part|^2 under the floor; they sum to (R - 1) over the experiments.
    n = len(observed.runs)
    variance = (total * n / max(dof, 1.0) * dof / n + _PRIOR) / (dof / n + _PRIOR) if dof else 1.0
    return amount / float(np.sqrt(max(variance, 1e-12)))


def similarity(a: FloatArray, b: FloatArray) -> float:
    """Return the canonical correlation of two signatures of unit length."""
    return float(abs(a @ b))


def alias_classes(signatures: Mapping[str, FloatArray], *, threshold: float) -> tuple[tuple[str, ...], ...]:
    """Group effects whose projected signatures these sensors and experiments cannot tell apart.

    Effects are joined when their canonical correlation exceeds `threshold`; classes of one are left out.
    """
    names = list(signatures)
    group = {name: {name} for name in names}
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            if similarity(signatures[a], signatures[b]) > threshold:
                joined = group[a] | group[b]
                for name in joined:
                    group[name] = joined
    classes = {tuple(sorted(g)) for g in group.values() if len(g) > 1}
    return tuple(sorted(classes))


_PLAUSIBLE = 3.0  # largest plausible size, in trials: a refit starts from no farther away
_ENOUGH = 1.1  # times the smallest size, or the signature wanted: as close as a statement about sizes needs
_ROUNDS = 8  # of simulations at most


def smallest_seen(
    predict: Predict,
    observed: Observed,
    base: Refit,
    scores: Sequence[Score],
    effects: Sequence[Effect],
    *,
    threshold: float,
    simulated: bool,
) -> dict[str, dict[str, float]]:
    """Return by effect the parameter values at which its score would reach `threshold`.

    Sizes are scaled from the trial that does most, whose shapes they have. They are `simulated`, because laws are
    not linear, or taken to act in proportion. An effect that would need more than three times the trial, or a size
    beyond its bounds, is left out.
    """
    wanted, by_id = float(np.sqrt(threshold)), {e.id: e for e in effects}
    largest = {s.effect: s.largest for s in _every(scores) if s.largest is not None}
    most = {name: _most(by_id[name], score.trial) for name, score in largest.items()}
    known = {name: {0.0: 0.0, 1.0: score.length} for name, score in largest.items()}  # size in trials -> signature

    def values(name: str, size: float) -> dict[str, float]:
        return by_id[name].scaled(largest[name].trial, size, clipped=False)

    for _ in range(_ROUNDS if simulated else 0):
        sizes = {name: _next(sizes_of, wanted, most[name]) for name, sizes_of in known.items()}
        tried = [(name, size) for name, size in sizes.items() if size is not None]
        if not tried:
            break
        trials = [(by_id[name], values(name, size)) for name, size in tried]
        for (name, size), score in zip(tried, score_trials(predict, observed, base, trials), strict=True):
            known[name][size] = np.inf if score is None else score.length  # a failure does not go unnoticed
    if simulated:
        smallest = {name: _bracket(sizes_of, wanted)[1] for name, sizes_of in known.items()}
    else:
        smallest = {name: wanted / max(score.length, 1e-300) for name, score in largest.items()}
    return {
        name: {parameter: values(name, size)[parameter] for parameter in largest[name].trial}
        for name, size in smallest.items()
        if size <= most[name]
    }


def hidden(scores: Sequence[Score]) -> Hidden:
    """Return the effects that move the predictions by less than a standard deviation at any plausible size.

    They do so by themselves, or once the fitted parameters have made up for what they do.
    """
    largest = [(s.effect, s.largest) for s in _every(scores) if s.largest is not None]
    unseen = tuple(name for name, score in largest if _PLAUSIBLE * score.moved < 1.0)
    lost = (name for name, score in largest if _PLAUSIBLE * score.length < 1.0)
    return Hidden(unseen, tuple(name for name in lost if name not in unseen))


def largest_drop(scores: Sequence[Score], effects: Mapping[str, Effect]) -> float:
    """Return the largest score, comparable with that of one effect under noise.

    The best of n laws, chosen with these measurements, exceeds noise by 2 ln n more (Bonferroni).
    """
    return max((s.drop - 2.0 * float(np.log(effects[s.effect].among)) for s in scores), default=0.0)


def _every(scores: Sequence[Score]) -> Iterator[Score]:
    """Yield the scores, each followed by those of the effects that it stands for."""
    return (every for first in scores for every in (first, *first.same))


def _most(effect: Effect, trial: Mapping[str, float]) -> float:
    """Return the largest plausible size, in trials, within the effect's bounds."""
    most = _PLAUSIBLE
    for u in effect.unknowns:
        away = trial.get(u.name, effect.neutral[u.name]) - effect.neutral[u.name]
        if away and u.name not in effect.shapes:
            most = min(most, ((u.upper if away > 0.0 else u.lower) - effect.neutral[u.name]) / away)
    return most


def _bracket(known: Mapping[float, float], wanted: float) -> tuple[float, float]:
    """Return the largest size below the smallest one that would be seen, and that one, which may be infinite."""
    seen = min((size for size, length in known.items() if length >= wanted), default=np.inf)
    return max(size for size in known if size < seen), seen


def _next(known: Mapping[float, float], wanted: float, most: float) -> float | None:
    """Return the size to try next: where a power law leads from known sizes, or half-way, in turn.

    Laws with a threshold do nothing below it. None if the smallest size that would be seen is known, or that none
    would be.
    """
    low, high = _bracket(known, wanted)
    if high == np.inf:
        ahead = 1.02 * low * wanted / known[low] if known[low] > 0.0 else np.inf
        return min(ahead, most) if low < most else None
    if known[high] <= _ENOUGH * wanted or high <= _ENOUGH * low:
        return None
    if low == 0.0:
        return high * max(1.02 * wanted / known[high], 1e-3)
    if known[low] > 0.0 and known[high] < np.inf and len(known) % 2 == 0:
        steep = np.log(known[high] / known[low]) / np.log(high / low)
        return float(low * (1.02 * wanted / known[low]) ** (1.0 / steep))
    return float(np.sqrt(low * high))
