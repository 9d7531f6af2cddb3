"""Identified values as Modelica: a short class that modifies the model's class."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

_ELEMENT = re.compile(r"(?P<name>.+)\[(?P<index>\d+(?:,\s*\d+)*)\]")
_PART = re.compile(r"[A-Za-z_]\w*|'[^']+'")


def short_class(name: str, class_name: str, values: Mapping[str, float], starts: Mapping[str, float]) -> str:
    """Return ``model NAME = CLASS(modifiers)``, to place next to the model's source or to copy modifiers from.

    Parameters
    ----------
    name, class_name
        Names of the new class and of the model's class.
    values
        Values by variable, such as ``rotor.J`` and ``lossTable[1,2]``. An array is modified as a whole.
    starts
        The model's start values, for array elements that are not in `values`. Variables that Modelica cannot
        modify in this way are named in a comment.
    """
    tree: dict[str, Any] = {}
    skipped = []
    for variable, text in _scalars_and_arrays(values, starts).items():
        parts = variable.split(".")
        if text is None or not all(_PART.fullmatch(p) for p in parts):
            skipped.append(variable)
            continue
        inside = tree
        for part in parts[:-1]:
            inside = inside.setdefault(part, {})
        inside[parts[-1]] = text
    notes = [f"// Cannot be written as a modifier: {', '.join(skipped)}."] if skipped else []
    return "\n".join(
        ["// Parameters identified by fmuid.", *notes, f"model {name} = {class_name}{_modifiers(tree)};", ""]
    )


def _modifiers(tree: Mapping[str, Any], depth: int = 1) -> str:
    if not tree:
        return ""
    entries = [
        f"{name}{_modifiers(value, depth + 1)}" if isinstance(value, dict) else f"{name} = {value}"
        for name, value in tree.items()
    ]
    return f"({', '.join(entries)})" if depth > 1 else "(\n  " + ",\n  ".join(entries) + ")"


def _scalars_and_arrays(values: Mapping[str, float], starts: Mapping[str, float]) -> dict[str, str | None]:
    """Return the text of each value; None for an array whose elements are not all known."""
    modifiers: dict[str, str | None] = {}
    for variable, value in values.items():
        element = _ELEMENT.fullmatch(variable)
        if element is None:
            modifiers[variable] = repr(float(value))
        elif element["name"] not in modifiers:
            modifiers[element["name"]] = _array(element["name"], {**starts, **values})
    return modifiers


def _array(name: str, known: Mapping[str, float]) -> str | None:
    elements = {
        tuple(int(k) for k in match["index"].split(",")): value
        for variable, value in known.items()
        if (match := _ELEMENT.fullmatch(variable)) is not None and match["name"] == name
    }
    shape = [max(indices) for indices in zip(*elements, strict=True)]
    if set(elements) != set(product(*(range(1, n + 1) for n in shape))):
        return None
    return _nested(elements, shape, ())


def _nested(elements: Mapping[tuple[int, ...], float], shape: Sequence[int], at: tuple[int, ...]) -> str:
    if len(at) == len(shape):
        return repr(float(elements[at]))
    inside = (_nested(elements, shape, (*at, k)) for k in range(1, shape[len(at)] + 1))
    return "{" + ", ".join(inside) + "}"
