"""Consistency of the units of a flat class: dimensional analysis of its equations, bindings and attributes.

A variable without a unit, ``time`` (in ``sin(10*time)`` the literal has the unit), what is made of literals alone,
and the result of a function fit everything. A factor made of whole literals is a pure number, and so is an angle
in rad.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from itertools import product
from math import isclose
from typing import Any

from fmu_build.flat_model import FlatModel
from fmu_build.model import BASE_UNITS
from fmu_build.syntax import (
    ArrayOf,
    Assign,
    Binary,
    Call,
    Comprehension,
    Field,
    If,
    Literal,
    Place,
    Reference,
    Reinit,
    Subscripted,
    Unary,
)
from fmu_build.unit_strings import parse_unit

_SAME = {"abs", "noEvent", "pre", "previous", "sum", "min", "max", "homotopy", "transpose", "scalar", "vector",
         "floor", "ceil", "integer", "mod", "rem", "cat", "fill", "diagonal", "symmetric", "matrix"}  # fmt: skip
_PURE = {"sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "log10"}
_ALIKE = {"min", "max", "mod", "rem", "atan2"}
_SUMS = {"+", "-", ".+", ".-"}
_PRODUCTS = {"*": 1, ".*": 1, "/": -1, "./": -1}
_RELATIONS = {"<", "<=", ">", ">=", "==", "<>"}


@dataclass(frozen=True)
class Dimension:
    """Exponents of the base units, the factor to them, and the name."""

    exponents: tuple[Fraction, ...]
    factor: float
    name: str

    def fits(self, other: Dimension) -> bool:
        """Whether the two are the same unit."""
        return self.exponents == other.exponents and isclose(self.factor, other.factor, rel_tol=1e-9)


_NUMBER = Dimension((Fraction(0),) * len(BASE_UNITS), 1.0, "1")
_SECOND = Dimension(tuple(Fraction(b == "s") for b in BASE_UNITS), 1.0, "s")


def check(flat: FlatModel) -> list[str]:
    """Return one line for each place where two known but different units meet."""
    return list(dict.fromkeys(_Checker(flat).run()))


def dimension(flat: FlatModel, expression: Any) -> Dimension | None:
    """Return the unit of an expression of a flat model; None if it is unknown."""
    return _Checker(flat)._unit(expression)


class _Checker:
    def __init__(self, flat: FlatModel) -> None:
        self._flat = flat
        self._found: list[tuple[Place, str, str]] = []

    def run(self) -> Iterator[str]:
        for variable in self._flat.variables.values():
            dimension = dimension_of_unit(variable.unit)
            for value in (variable.binding, variable.start, variable.min, variable.max, variable.nominal):
                if value is not None and not isinstance(value, Literal):
                    self._alike(dimension, self._unit(value), variable.at)
            yield from self._report()
        for equation in (*self._flat.equations, *self._flat.initial_equations):
            for left, right in product(*(list(self._apart(side)) for side in (equation.left, equation.right))):
                self._alike(left, right, equation.at)
            yield from self._report()
        for node in self._flat.asserts:
            self._unit(node.condition)
        for condition, statements in (branch for when in self._flat.whens for branch in when.branches):
            self._unit(condition)
            for statement in statements:
                if isinstance(statement, Assign | Reinit):
                    target = statement.target if isinstance(statement, Assign) else statement.state
                    self._alike(self._unit(target), self._unit(statement.value), statement.at)
        yield from self._report()

    def _report(self) -> Iterator[str]:
        for at, a, b in self._found:
            yield f"{at}: the units differ: {a} and {b}"
        self._found.clear()

    def _alike(self, a: Dimension | None, b: Dimension | None, at: Place) -> Dimension | None:
        if a is not None and b is not None and not a.fits(b):
            self._found.append((at, a.name, b.name))
        return a or b

    def _unit(self, node: Any) -> Dimension | None:
        """Return the unit of an expression tree, None if unknown; records inconsistencies inside it."""
        if isinstance(node, Literal):
            return dimension_of_unit(node.unit)
        return None if _literals(node) else self._unit_of_names(node)

    def _unit_of_names(self, node: Any) -> Dimension | None:
        match node:
            case Reference():
                variable = self._flat.variables.get(node.name)
                return dimension_of_unit(variable.unit) if variable else None
            case Subscripted() | Field():
                return self._unit(node.base) if isinstance(node, Subscripted) else None
            case Unary():
                return self._unit(node.operand)
            case ArrayOf():
                units = [self._unit(e) for e in node.items]
                first = units[0] if units else None
                return first if all(u is not None and first is not None and u.fits(first) for u in units) else None
            case Comprehension():
                return self._unit(node.element)
            case If():
                units = [self._unit(value) for value in (*(branch for _, branch in node.branches), node.otherwise)]
                for condition, _ in node.branches:
                    self._unit(condition)
                return None if node.apart else reduce(lambda a, b: self._alike(a, b, node.at), units)
            case Binary():
                return self._binary(node)
            case Call():
                return self._call(node)
        return None

    def _apart(self, side: Any) -> Iterator[Dimension | None]:
        """Yield the units of a side of an equation: of an if-equation, of that side in each branch."""
        if isinstance(side, If) and side.apart:
            for condition, value in side.branches:
                self._unit(condition)
                yield from self._apart(value)
            yield from self._apart(side.otherwise)
        else:
            yield self._unit(side)

    def _factor(self, node: Any) -> Dimension | None:
        """Return the unit of a factor, where whole literals make a pure number."""
        literals = _literals(node)
        return _NUMBER if literals and all(value.is_integer() for value in literals) else self._unit(node)

    def _binary(self, node: Binary) -> Dimension | None:
        op, at = node.operator, node.at
        if op in _PRODUCTS:
            return _product(self._factor(node.left), self._factor(node.right), _PRODUCTS[op])
        a, b = self._unit(node.left), self._unit(node.right)
        if op in _SUMS:
            return self._alike(a, b, at)
        if op in _RELATIONS:
            self._alike(a, b, at)
        if op in ("^", ".^") and a is not None:
            exponent = _literal(node.right)
            return _NUMBER if a.fits(_NUMBER) else None if exponent is None else _power(a, Fraction(exponent))
        return None

    def _call(self, node: Call) -> Dimension | None:
        name = node.function
        units = [self._unit(a) for a in node.arguments]
        first = units[0] if units else None
        if name == "smooth":
            return units[-1]
        if name in _ALIKE and len(units) == 2:
            first = self._alike(units[0], units[1], node.at)
        if name in _PURE:
            self._alike(_NUMBER, first, node.at)
        if name in _PURE or name in ("sign", "atan2"):
            return _NUMBER
        if name == "der" and first is not None:
            return _product(first, _SECOND, -1)
        if name == "sqrt" and first is not None:
            return _power(first, Fraction(1, 2))
        return first if name in _SAME else None


def _literal(node: Any) -> float | None:
    if isinstance(node, Unary) and node.operator == "-":
        value = _literal(node.operand)
        return None if value is None else -value
    if not isinstance(node, Literal) or isinstance(node.value, bool | str):
        return None
    return float(node.value)


def _literals(node: Any) -> list[float]:
    """Return the numbers of an expression that is made of them alone; of any other, none."""
    parts: tuple[Any, ...]
    match node:
        case Literal(unit=None):
            value = _literal(node)
            return [] if value is None else [value]
        case Unary():
            parts = (node.operand,)
        case Binary():
            parts = (node.right, node.left)  # in a long sum, the right one has no further parts
        case Call():
            parts = node.arguments
        case _:
            return []
    literals: list[float] = []
    for part in parts:
        values = _literals(part)
        if not values:
            return []
        literals += values
    return literals


def dimension_of_unit(text: str | None) -> Dimension | None:
    """Return the dimension of a unit string; None if it is not one."""
    parsed = parse_unit(text) if text else None
    if parsed is None:
        return None
    factor, _, exponents = parsed
    plain = (Fraction(0 if base == "rad" else e) for base, e in zip(BASE_UNITS, exponents, strict=True))
    return Dimension(tuple(plain), factor, text or "")


def _product(a: Dimension | None, b: Dimension | None, sign: int) -> Dimension | None:
    if a is None or b is None:
        return None
    if b.fits(_NUMBER):
        return a
    exponents = tuple(x + sign * y for x, y in zip(a.exponents, b.exponents, strict=True))
    factor = a.factor * b.factor**sign
    return Dimension(exponents, factor, _name(exponents, factor))


def _power(a: Dimension, exponent: Fraction) -> Dimension:
    exponents = tuple(e * exponent for e in a.exponents)
    factor = a.factor ** float(exponent)
    return Dimension(exponents, factor, _name(exponents, factor))


def _name(exponents: tuple[Fraction, ...], factor: float) -> str:
    """Name a product of units, with its scale if that is not 1."""
    named = list(zip(BASE_UNITS, exponents, strict=True))
    top = ".".join(f"{b}{e if e != 1 else ''}" for b, e in named if e > 0) or "1"
    bottom = [f"{b}{-e if e != -1 else ''}" for b, e in named if e < 0]
    name = top if not bottom else f"{top}/{bottom[0] if len(bottom) == 1 else '(' + '.'.join(bottom) + ')'}"
    return name if isclose(factor, 1.0, rel_tol=1e-9) else f"{factor:.6g} {name}"
