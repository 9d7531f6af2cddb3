"""Conversion between the units of measurements and of FMUs; only this module imports pint.

Units are written as in Modelica and FMI (``N.m``, ``kg.m2``, ``N.m.s/rad``, ``1``, ``degC``); ``^``, ``*`` and a
few everyday spellings (``Nm``, ``Ohm``, ``%``) are also accepted. Angles are dimensionless, as in SI and FMI, so
``N.m.s`` is ``N.m.s/rad``; hertz and rad/s are distinct.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from fmuid.core.errors import UnitError
from fmuid.core.immutable import FloatArray

_TOKEN = re.compile(r"\s*(?:([^\W\d]+|[%°]\w*)(?:\^|\*\*)?([+-]?\d+)?|(1(?![\d.]))|([./*·()])|(\s))")
_SPELLINGS = {
    "%": "percent",
    "°": "deg",
    "°C": "degC",
    "°F": "degF",
    "h": "hour",
    "rev": "revolution",
    "U": "revolution",
}
_TORQUE = re.compile(r"([mkMµu]?N)m")  # pint reads Nm as a textile unit
_ANGLES = {"rad", "deg", "revolution", "rpm", "degree", "radian", "turn"}
_RESISTANCE = re.compile(r"([mkMµu]?)(?:Ohm|Ω)")
_CYCLES = re.compile(r"[mkMG]?Hz")
_PER_MINUTE = {(("min", -1),), (("minute", -1),)}  # written by loggers for rpm
_OFFSET_UNITS = {"degC": "delta_degC", "degF": "delta_degF"}

# A unit as (symbol, exponent) pairs.
_Factors = tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True)
class Conversion:
    """``target = factor * source + offset``; differences and standard deviations use the factor only."""

    factor: float = 1.0
    offset: float = 0.0

    @property
    def is_identity(self) -> bool:
        """Whether the conversion leaves values unchanged."""
        return self.factor == 1.0 and self.offset == 0.0

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return `values` (any shape) in the target unit."""
        return values if self.is_identity else self.factor * values + self.offset


@lru_cache(maxsize=1024)
def conversion(source: str, target: str | None) -> Conversion:
    """Return the conversion from unit `source` to unit `target`.

    Parameters
    ----------
    source, target
        Units; an empty unit is ``1``. With a `target` of None (an FMU variable without a unit), values are not
        converted.

    Raises
    ------
    UnitError
        A unit is unknown, or the two measure different quantities.
    """
    if target is None or source == target:
        return Conversion()
    source_factors, target_factors = _factors(source), _factors(target)
    if _plain(source_factors) == _plain(target_factors):
        return Conversion()
    if _counts_cycles(source_factors, target_factors) or _counts_cycles(target_factors, source_factors):
        raise UnitError(
            f"'{source}' cannot be converted to '{target}'",
            fix="convert the values by 2 pi and write the unit",
        )
    for unit, factors, other in (
        (source, source_factors, target_factors),
        (target, target_factors, source_factors),
    ):
        if factors in _PER_MINUTE and any(symbol in _ANGLES for symbol, _ in other):
            raise UnitError(
                f"'{unit}' may count turns or radians: '{source}' is not converted to '{target}'",
                fix="write rpm, or rad/min",
            )
    given, wanted = _pint_unit(source, source_factors), _pint_unit(target, target_factors)
    if given.dimensionality != wanted.dimensionality:
        raise UnitError(
            f"'{source}' cannot be converted to '{target}'",
            fix=f"they measure different things ({given.dimensionality} and {wanted.dimensionality})",
        )
    quantity = _registry().Quantity
    offset = float(quantity(0.0, given).to(wanted).magnitude)
    if offset:
        given, wanted = (
            _pint_unit(u, f, difference=True) for u, f in ((source, source_factors), (target, target_factors))
        )
    return Conversion(float(quantity(1.0, given).to(wanted).magnitude), offset)


def convertible(unit: str, other: str) -> bool:
    """Return whether two units measure the same quantity."""
    try:
        conversion(unit, other)
    except UnitError:
        return False
    return True


def conversion_at(source: str | None, target: str | None, where: object) -> Conversion:
    """Return the conversion between units, the identity if `source` is unknown; errors name `where`."""
    if source is None:
        return Conversion()
    try:
        return conversion(source, target)
    except UnitError as error:
        raise UnitError(error.what, where=where, fix=error.fix) from None


def convert_factor(source: str, target: str | None, *, where: object = None) -> float:
    """Return the factor of `conversion`, for values that cannot have an offset.

    Raises
    ------
    UnitError
        As for `conversion`, with `where` in its message; or the two units differ by an offset, like degC and K.
    """
    convert = conversion_at(source, target, where)
    if convert.offset:
        what = f"'{source}' and '{target}' differ by an offset"
        raise UnitError(what, where=where, fix=f"write the values in '{target}'")
    return convert.factor


def check_unit(unit: str) -> None:
    """Raise UnitError if `unit` is unknown."""
    _pint_unit(unit, _factors(unit))


@lru_cache(maxsize=1)
def _registry() -> Any:
    import pint  # takes half a second, so only when two units really differ

    return pint.UnitRegistry()


def _factors(unit: str) -> _Factors:
    """Split a unit into symbols and exponents: ``N.m/(rad.s)`` is N 1, m 1, rad -1, s -1."""
    powers: dict[str, int] = {}
    signs, sign, position = [1], 1, 0
    text = unit.strip().removeprefix("-" if unit.strip() == "-" else "")  # loggers write - for 1
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise UnitError(f"unit '{unit}' is not understood", fix="write it as in 'N.m' or 'kg.m2/s'")
        position = match.end()
        symbol, exponent, _one, operator, _space = match.groups()
        if symbol:
            for part, power in _spelling(symbol):
                powers[part] = powers.get(part, 0) + signs[-1] * sign * power * int(exponent or 1)
            sign = 1
        elif operator == "/":
            sign = -1
        elif operator == "(":
            signs.append(signs[-1] * sign)
            sign = 1
        elif operator == ")":
            if len(signs) == 1:
                raise UnitError(f"unit '{unit}' has an extra ')'", fix="write it as in 'N.m/(rad.s)'")
            signs.pop()
            sign = 1
    if len(signs) > 1 or any(abs(p) > 20 for p in powers.values()):
        raise UnitError(f"unit '{unit}' is not understood", fix="write it as in 'N.m/(rad.s)'")
    return tuple(sorted((s, p) for s, p in powers.items() if p))


def _spelling(symbol: str) -> list[tuple[str, int]]:
    if resistance := _RESISTANCE.fullmatch(symbol):
        return [(f"{resistance[1]}ohm", 1)]
    torque = _TORQUE.fullmatch(symbol)
    return [(torque[1], 1), ("m", 1)] if torque else [(_SPELLINGS.get(symbol, symbol), 1)]


def _plain(factors: _Factors) -> _Factors:
    return tuple((s, p) for s, p in factors if s != "rad")


def _counts_cycles(cycles: _Factors, angle: _Factors) -> bool:
    """Return whether one unit has hertz and the other an angle in its place: pint would take 1 Hz for 1 rad/s."""
    return any(_CYCLES.fullmatch(s) for s, _ in cycles) and (
        any(s in _ANGLES for s, _ in angle) and not any(_CYCLES.fullmatch(s) for s, _ in angle)
    )


def _pint_unit(unit: str, factors: _Factors, *, difference: bool = False) -> Any:
    registry = _registry()
    absolute = len(factors) == 1 and factors[0][1] == 1 and not difference
    try:
        result = registry.Unit("")
        for symbol, power in factors:
            # In a product (W/degC) only the temperature difference makes sense.
            name = symbol if absolute else _OFFSET_UNITS.get(symbol, symbol)
            result = result * registry.Unit(name) ** power
    except Exception:  # pint's parser raises its own errors, tokenizer's and syntax errors alike
        raise UnitError(f"unit '{unit}' is unknown", fix="write it as in 'N.m' or 'kg.m2/s'") from None
    return result
