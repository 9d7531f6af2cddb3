"""Prior odds of effects: what the number of candidates does to the evidence for one of them.

Every kind of law (``coulomb``, ``varies``, ``value``, ``gain`` ...) is as likely as every other before the
measurements are seen, and so is, within a kind, every place where such a law was tried; a place where it is
physically unusual counts half. The best of many candidates therefore needs more evidence than the best of a few:
it pays the logarithm of their number. Candidates that were compared with the same measurements and dropped before
a model with them was built count, too (`Effect.among`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

from fmuid.effects.effect import Effect

_UNUSUAL = 0.5  # weight of a place where the law is physically unusual


def kind_of(effect: Effect) -> str:
    """Return the kind of law of an effect: what its id has before the place."""
    return effect.id.partition("@")[0]


def log_prior(names: Sequence[str], candidates: Collection[Effect]) -> float:
    """Return the logarithm of the prior weight of a set of effects, relative to a model without effects.

    Parameters
    ----------
    names
        Ids of the effects in the set.
    candidates
        All effects that were considered, those in the set among them.

    Returns
    -------
    float
        0 for no effects; the sum over the effects of the logarithm of each one's share of the weight of its kind.
        The order of the effects does not matter, so a set of n pays the logarithm of n! less.

    Raises
    ------
    KeyError
        An effect is not among the candidates.
    """
    by_id = {e.id: e for e in candidates}
    total: dict[str, float] = {}
    most: dict[str, int] = {}
    for effect in candidates:
        kind = kind_of(effect)
        total[kind] = total.get(kind, 0.0) + _weight(effect)
        most[kind] = max(most.get(kind, 1), effect.among)
    shares = [_weight(by_id[n]) / max(total[kind_of(by_id[n])], float(most[kind_of(by_id[n])])) for n in names]
    return sum(math.log(share / len(total)) for share in shares) + math.lgamma(len(names) + 1.0)


def _weight(effect: Effect) -> float:
    return 1.0 if effect.usual else _UNUSUAL
