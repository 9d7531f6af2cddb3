"""Modelica unit strings ("N.m/rad", "kg.m2", "rad/s2") as SI base exponents and a factor."""

from __future__ import annotations

import math
import re

from fmu_build.model import BASE_UNITS, DisplayUnit, Unit

# Symbol: (factor, offset, exponents in BASE_UNITS without trailing zeros).
_SYMBOLS: dict[str, tuple[float, float, dict[str, int]]] = {
    "1": (1.0, 0.0, {}),
    **{base: (1.0, 0.0, {base: 1}) for base in BASE_UNITS},
    "g": (1e-3, 0.0, {"kg": 1}),
    "t": (1e3, 0.0, {"kg": 1}),
    "N": (1.0, 0.0, {"kg": 1, "m": 1, "s": -2}),
    "J": (1.0, 0.0, {"kg": 1, "m": 2, "s": -2}),
    "W": (1.0, 0.0, {"kg": 1, "m": 2, "s": -3}),
    "Pa": (1.0, 0.0, {"kg": 1, "m": -1, "s": -2}),
    "bar": (1e5, 0.0, {"kg": 1, "m": -1, "s": -2}),
    "Hz": (1.0, 0.0, {"s": -1}),
    "C": (1.0, 0.0, {"A": 1, "s": 1}),
    "V": (1.0, 0.0, {"kg": 1, "m": 2, "s": -3, "A": -1}),
    "Ohm": (1.0, 0.0, {"kg": 1, "m": 2, "s": -3, "A": -2}),
    "S": (1.0, 0.0, {"kg": -1, "m": -2, "s": 3, "A": 2}),
    "F": (1.0, 0.0, {"kg": -1, "m": -2, "s": 4, "A": 2}),
    "H": (1.0, 0.0, {"kg": 1, "m": 2, "s": -2, "A": -2}),
    "Wb": (1.0, 0.0, {"kg": 1, "m": 2, "s": -2, "A": -1}),
    "T": (1.0, 0.0, {"kg": 1, "s": -2, "A": -1}),
    "deg": (math.pi / 180, 0.0, {"rad": 1}),
    "rev": (2 * math.pi, 0.0, {"rad": 1}),
    "rpm": (math.pi / 30, 0.0, {"rad": 1, "s": -1}),
    "min": (60.0, 0.0, {"s": 1}),
    "h": (3600.0, 0.0, {"s": 1}),
    "d": (86400.0, 0.0, {"s": 1}),
    "l": (1e-3, 0.0, {"m": 3}),
    "degC": (1.0, 273.15, {"K": 1}),
    "degF": (5 / 9, 459.67 * 5 / 9, {"K": 1}),
    "degRk": (5 / 9, 0.0, {"K": 1}),
    "Wh": (3600.0, 0.0, {"kg": 1, "m": 2, "s": -2}),
    "Ah": (3600.0, 0.0, {"A": 1, "s": 1}),
    "lm": (1.0, 0.0, {"cd": 1}),
    "%": (1e-2, 0.0, {}),
}
_PREFIXES = {
    "da": 1e1, "h": 1e2, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12, "d": 1e-1, "c": 1e-2, "m": 1e-3, "u": 1e-6,
    "n": 1e-9, "p": 1e-12,
}  # fmt: skip
_FACTOR = re.compile(r"([A-Za-z%]+|1)(-?\d+)?$")


def parse_unit(text: str) -> tuple[float, float, tuple[int, ...]] | None:
    """Factor, offset and base exponents of a Modelica unit string; None if it is not one.

    The syntax is that of the Modelica specification, chapter 19: ``.`` multiplies, one ``/`` divides by all that
    follows (parentheses allowed), exponents follow the symbol.
    """
    numerator, _, denominator = text.replace(" ", "").partition("/")
    denominator = denominator.strip("()")
    if "/" in denominator or "(" in numerator.strip("()"):
        return None
    factor, offset = 1.0, 0.0
    exponents = dict.fromkeys(BASE_UNITS, 0)
    terms = [(t, 1) for t in numerator.strip("()").split(".")]
    terms += [(t, -1) for t in denominator.split(".")] if denominator else []
    for term, sign in terms:
        match = _FACTOR.match(term)
        symbol = _symbol(match.group(1)) if match else None
        if match is None or symbol is None:
            return None
        power = sign * int(match.group(2) or 1)
        factor *= symbol[0] ** power
        offset = symbol[1] if len(terms) == 1 and power == 1 else 0.0
        for base, exponent in symbol[2].items():
            exponents[base] += power * exponent
    return factor, offset, tuple(exponents[base] for base in BASE_UNITS)


def _symbol(name: str) -> tuple[float, float, dict[str, int]] | None:
    if name in _SYMBOLS:
        return _SYMBOLS[name]
    for prefix, scale in _PREFIXES.items():
        rest = name[len(prefix) :]
        if name.startswith(prefix) and rest in _SYMBOLS and rest != "1":
            factor, _, exponents = _SYMBOLS[rest]
            return scale * factor, 0.0, exponents
    return None


def make_unit(name: str, display_names: set[str]) -> Unit:
    """Build the unit definition of `name` with the display units that are convertible to it."""
    parsed = parse_unit(name)
    if parsed is None:
        return Unit(name, None)
    factor, offset, exponents = parsed
    shown = []
    for display in sorted(display_names - {name}):
        other = parse_unit(display)
        if other is not None and other[2] == exponents:
            # value in base = factor*value + offset = other_factor*shown + other_offset
            shown.append(DisplayUnit(display, factor / other[0], (offset - other[1]) / other[0]))
    return Unit(name, exponents, factor, offset, tuple(shown))
