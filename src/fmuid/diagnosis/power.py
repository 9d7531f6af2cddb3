"""Power of a diagnosis: the smallest size of each effect that its data would have shown, or why none would."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Predict, Refit
from fmuid.diagnosis.scores import Score, score_trials
from fmuid.diagnosis.verdict import Hidden
from fmuid.effects.effect import Effect

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
        sizes = {name: _next(own, wanted, most[name]) for name, own in known.items()}
        tried = [(name, size) for name, size in sizes.items() if size is not None]
        if not tried:
            break
        trials = [(by_id[name], values(name, size)) for name, size in tried]
        for (name, size), score in zip(tried, score_trials(predict, observed, base, trials), strict=True):
            known[name][size] = np.inf if score is None else score.length  # a failure does not go unnoticed
    if simulated:
        found = {name: _bracket(own, wanted)[1] for name, own in known.items()}
    else:
        found = {name: wanted / max(score.length, 1e-300) for name, score in largest.items()}
    return {
        name: {parameter: values(name, size)[parameter] for parameter in largest[name].trial}
        for name, size in found.items()
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
