"""Power of a diagnosis: the smallest size of each effect that its data would have shown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmuid.diagnosis.catalogue import Effect
from fmuid.diagnosis.scores import Score

_PLAUSIBLE = 3.0  # largest plausible size, in trials: a refit starts from no farther away


def smallest_seen(
    scores: Sequence[Score], effects: Sequence[Effect], *, threshold: float
) -> dict[str, dict[str, float]]:
    """Return by effect the parameter values at which its score would reach `threshold`.

    Sizes are scaled linearly from the trial that did best; shapes are the trial's. An effect that would need more
    than three times the trial, or a size beyond its bounds, is left out.
    """
    by_id = {e.id: e for e in effects}
    found = {}
    for score in (every for first in scores for every in (first, *first.same)):
        if score.signature is None:
            continue
        factor = float(np.sqrt(threshold)) / score.length
        values = by_id[score.effect].scaled(score.trial, factor, clipped=False)
        own = [u for u in by_id[score.effect].unknowns if u.name in score.trial]
        if factor <= _PLAUSIBLE and all(u.lower <= values[u.name] <= u.upper for u in own):
            found[score.effect] = {name: values[name] for name in score.trial}
    return found
