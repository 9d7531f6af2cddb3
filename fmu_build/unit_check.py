"""Are the units of a flat class consistent? Dimensional analysis of its equations, bindings and attributes.

A variable without a unit, ``time`` (in ``sin(10*time)`` the literal has the unit), a literal that is no whole
number, and what a function returns fit everything; a whole number counts as a pure number in products and fits
everything in sums. An angle in rad is a pure number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from math import isclose
from typing import Any

from fmu_build.frontend import Flat, Node
from fmu_build.model import BASE_UNITS
from fmu_build.unit_strings import parse_unit

_SAME = {"Abs", "NoEvent", "Pre", "Previous", "Sum", "Min", "Max", "Homotopy", "Transpose", "Scalar", "Vector",
         "Floor", "Ceil", "Integer", "Mod", "Rem", "Cat", "Fill", "Diagonal", "Symmetric", "Matrix"}  # fmt: skip
_PURE = {"Sin", "Cos", "Tan", "Asin", "Acos", "Atan", "Sinh", "Cosh", "Tanh", "Exp", "Log", "Log10"}
_ALIKE = {"Min", "Max", "Mod", "Rem", "Atan2"}
_SUMS = {"Add", "Sub", "AddElem", "SubElem"}
_PRODUCTS = {"Mul": 1, "MulElem": 1, "Div": -1, "DivElem": -1}
_RELATIONS = {"Lt", "Le", "Gt", "Ge", "Eq", "Neq"}


@dataclass(frozen=True)
class Dimension:
    """Exponents of the base units, the factor to them, and how to name it."""

    exponents: tuple[Fraction, ...]
    factor: float
    name: str

    def fits(self, other: Dimension) -> bool:
        """Whether the two are one unit."""
        return self.exponents == other.exponents and isclose(self.factor, other.factor, rel_tol=1e-9)


_NUMBER = Dimension((Fraction(0),) * len(BASE_UNITS), 1.0, "1")
_SECOND = Dimension(tuple(Fraction(b == "s") for b in BASE_UNITS), 1.0, "s")


def check(flat: Flat) -> list[str]:
    """Return one line for each place where two known units meet that differ."""
    return list(dict.fromkeys(_Checker(flat).run()))


class _Checker:
    def __init__(self, flat: Flat) -> None:
        self._flat = flat
        self._variables = flat.parts["variables"]
        self._found: list[tuple[Any, str, str]] = []

    def run(self) -> Iterator[str]:
        for node in self._variables.values():
            own = _of_unit(node["unit"])
            for attribute in ("binding", "start", "min", "max", "nominal"):
                if node[attribute] is not None:
                    self._alike(own, self._unit(node[attribute]), node["source_span"])
            yield from self._report(node["source_span"])
        for part in ("equations", "initial_equations"):
            for equation in self._flat[part]:
                self._unit(equation["residual"])
                yield from self._report(equation["span"])
        for part in ("structured_equations", "initial_structured_equations"):
            for loop in self._flat[part]:
                for residual in (loop.get("template") or {}).get("body") or []:
                    self._unit(residual)
        for node in [*self._flat["assert_equations"], *self._flat["initial_assert_equations"]]:
            self._unit(node["condition"])
        for chain in self._flat["when_chains"]:
            for branch in [chain["first"], *chain["else_when"]]:
                self._when(branch)
        yield from self._report(None)

    def _when(self, branch: Node) -> None:
        self._unit(branch["condition"])
        for statement in branch["equations"]:
            ((tag, content),) = statement.items()
            target = content.get("target" if tag == "Assign" else "state") if isinstance(content, dict) else None
            if tag in ("Assign", "Reinit") and isinstance(target, str):
                value = self._unit(content["value"])
                self._alike(self._named(target), value, content.get("span") or branch.get("span"))

    def _report(self, span: Any) -> Iterator[str]:
        for own, a, b in self._found:
            place = self._flat.where(own) or self._flat.where(span) or self._flat.class_name
            yield f"{place}: the units differ: {a} and {b}"
        self._found.clear()

    def _alike(self, a: Dimension | None, b: Dimension | None, span: Any) -> Dimension | None:
        if a is not None and b is not None and not a.fits(b):
            self._found.append((span, a.name, b.name))
        return a or b

    def _unit(self, node: Any) -> Dimension | None:
        """Return the unit of an expression tree, None if unknown; notes what does not fit inside it."""
        ((tag, content),) = node.items()
        rule: Callable[[Any], Dimension | None] | None = getattr(self, f"_of_{tag.lower()}", None)
        return rule(content) if rule else None

    def _number(self, node: Any) -> Dimension | None:
        """Return the unit of a factor, where a whole number is a pure number."""
        value = _literal(node)
        return self._unit(node) if value is None else _NUMBER if value == int(value) else None

    def _named(self, name: str) -> Dimension | None:
        variable = self._variables.get(name) or self._variables.get(name.partition("[")[0])
        return _of_unit(variable["unit"]) if variable else None

    def _of_varref(self, node: Node) -> Dimension | None:
        return self._named(node["name"]["name"])

    def _of_index(self, node: Node) -> Dimension | None:
        return self._unit(node["base"])

    def _of_unary(self, node: Node) -> Dimension | None:
        return self._unit(node["rhs"])

    def _of_array(self, node: Node) -> Dimension | None:
        units = [self._unit(e) for e in node["elements"]]
        return units[0] if units and all(u is not None and units[0] and u.fits(units[0]) for u in units) else None

    def _of_arraycomprehension(self, node: Node) -> Dimension | None:
        return self._unit(node["expr"])

    def _of_if(self, node: Node) -> Dimension | None:
        unit: Dimension | None = None
        for condition, branch in node["branches"]:
            self._unit(condition)
            unit = self._alike(unit, self._unit(branch), node.get("span"))
        return self._alike(unit, self._unit(node["else_branch"]), node.get("span"))

    def _of_binary(self, node: Node) -> Dimension | None:
        op, span = node["op"], node.get("span")
        if op in _PRODUCTS:
            return _product(self._number(node["lhs"]), self._number(node["rhs"]), _PRODUCTS[op])
        a, b = self._unit(node["lhs"]), self._unit(node["rhs"])
        if op in _SUMS:
            return self._alike(a, b, span)
        if op in _RELATIONS:
            self._alike(a, b, span)
        if op in ("Exp", "ExpElem") and a is not None:
            exponent = _literal(node["rhs"])
            return _NUMBER if a.fits(_NUMBER) else None if exponent is None else _power(a, Fraction(exponent))
        return None

    def _of_builtincall(self, node: Node) -> Dimension | None:
        name, span = node["function"], node.get("span")
        units = [self._unit(a) for a in node["args"]]
        first = units[0] if units else None
        if name == "Smooth":
            return units[-1]
        if name in _ALIKE and len(units) == 2:
            first = self._alike(units[0], units[1], span)
        if name in _PURE:
            self._alike(_NUMBER, first, span)
        if name in _PURE or name in ("Sign", "Atan2"):
            return _NUMBER
        if name == "Der" and first is not None:
            return _product(first, _SECOND, -1)
        if name == "Sqrt" and first is not None:
            return _power(first, Fraction(1, 2))
        return first if name in _SAME else None

    def _of_functioncall(self, node: Node) -> None:
        for argument in node["args"]:
            self._unit(argument)


def _literal(node: Any) -> float | None:
    ((tag, content),) = node.items()
    if tag == "Unary" and content["op"] == "Minus":
        value = _literal(content["rhs"])
        return None if value is None else -value
    if tag != "Literal":
        return None
    ((kind, value),) = content["value"].items()
    return float(value) if kind in ("Real", "Integer") else None


def _of_unit(text: str | None) -> Dimension | None:
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
    return Dimension(exponents, a.factor * b.factor**sign, _name(exponents))


def _power(a: Dimension, exponent: Fraction) -> Dimension:
    exponents = tuple(e * exponent for e in a.exponents)
    return Dimension(exponents, a.factor ** float(exponent), _name(exponents))


def _name(exponents: tuple[Fraction, ...]) -> str:
    named = list(zip(BASE_UNITS, exponents, strict=True))
    top = ".".join(f"{b}{e if e != 1 else ''}" for b, e in named if e > 0) or "1"
    bottom = [f"{b}{-e if e != -1 else ''}" for b, e in named if e < 0]
    return top if not bottom else f"{top}/{bottom[0] if len(bottom) == 1 else '(' + '.'.join(bottom) + ')'}"
