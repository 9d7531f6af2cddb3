"""Words for the quantities at a place, in its domain of physics."""

from __future__ import annotations

from collections.abc import Mapping

_WORDS = {
    "rotational": ("angle", "speed", "torque"),
    "translational": ("position", "speed", "force"),
    "electrical": ("voltage", "rate of voltage", "current"),
    "thermal": ("temperature", "rate of temperature", "heat flow"),
    "fluid": ("pressure", "rate of pressure", "flow"),
}
_OTHERS = ("potential", "rate", "flow")
_LEVEL = ("level", "rate of level", "flow")  # of a fluid, in m
_PLACES = {"p": 0, "rate": 1, "through": 2}


def quantity_words(domain: str, potential: str | None) -> Mapping[str, str]:
    """Return the words for a potential ``p`` with a unit, its ``rate`` and the flow ``through`` a place."""
    words = _LEVEL if (domain, potential) == ("fluid", "m") else _WORDS.get(domain, _OTHERS)
    return {quantity: words[k] for quantity, k in _PLACES.items()}


def words_of(quantity: str) -> tuple[str, ...]:
    """Return the words for ``p``, ``rate`` or ``through`` in every domain; none for another quantity."""
    if quantity not in _PLACES:
        return ()
    return tuple(dict.fromkeys(words[_PLACES[quantity]] for words in (*_WORDS.values(), _LEVEL, _OTHERS)))
