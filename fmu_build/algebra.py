"""Modelica values during translation: numbers, SX scalars, arrays, records, and the operations on them."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, TypeAlias

import casadi as ca

from fmu_build.graph import SX, if_else

Scalar: TypeAlias = bool | int | float | SX
Number = bool | int | float


@dataclass(frozen=True)
class Array:
    """An array of scalars in row-major order."""

    shape: tuple[int, ...]
    items: tuple[Scalar, ...]

    @staticmethod
    def fill(shape: Sequence[int], value: Scalar) -> Array:
        """Make an array of equal entries."""
        return Array(tuple(shape), (value,) * math.prod(shape))

    @staticmethod
    def stack(parts: Sequence[Value]) -> Array:
        """Make an array from its rows; they must have one shape."""
        shapes = {p.shape if isinstance(p, Array) else () for p in parts}
        if len(shapes) > 1:
            raise ValueError("array elements of different sizes")
        inner = shapes.pop() if shapes else ()
        items = tuple(i for p in parts for i in scalars(p))
        return Array((len(parts), *inner), items)

    def __getitem__(self, index: tuple[int, ...]) -> Scalar:
        return self.items[self.offset(index)]

    def offset(self, index: Sequence[int]) -> int:
        """Position of a zero-based multi-index in `items`."""
        position = 0
        for i, n in zip(index, self.shape, strict=True):
            if not 0 <= i < n:
                raise IndexError(f"subscript {i + 1} is outside 1..{n}")
            position = position * n + i
        return position

    def indices(self) -> Iterator[tuple[int, ...]]:
        """Every zero-based multi-index in order."""
        return product(*map(range, self.shape))


Record = dict[str, "Value"]
Value: TypeAlias = Scalar | str | Array | Record | tuple["Value", ...] | None


def sx(value: Value) -> SX:
    """Scalar as SX."""
    if isinstance(value, SX):
        return value
    if isinstance(value, bool | int | float):
        return SX(float(value))
    raise TypeError(f"a scalar is needed here, not {kind(value)}")


def fold(value: SX) -> Scalar:
    """Turn a constant SX back into a number."""
    return float(value) if value.is_constant() else value


def kind(value: Value) -> str:
    """Word or words for a value in messages."""
    if isinstance(value, Array):
        return f"an array of size {list(value.shape)}"
    names: dict[type, str] = {str: "a String", dict: "a record", tuple: "several results", type(None): "nothing"}
    return names.get(type(value), "a scalar")


def scalars(value: Value) -> tuple[Scalar, ...]:
    """All scalar entries of a value in row-major order."""
    if isinstance(value, Array):
        return value.items
    if isinstance(value, dict):
        return tuple(i for v in value.values() for i in scalars(v))
    if isinstance(value, tuple):
        return tuple(i for v in value for i in scalars(v))
    if isinstance(value, bool | int | float | SX):
        return (value,)
    raise TypeError(f"a number is needed here, not {kind(value)}")


def stacked(parts: Sequence[Value]) -> Array | Record:
    """Make an array from its rows; an array of records is a record of arrays."""
    first = parts[0] if parts else None
    if not isinstance(first, dict):
        return Array.stack(parts)
    return {name: stacked([p[name] for p in parts if isinstance(p, dict)]) for name in first}


UNSET: Record = {}  # stands for an argument without a value, which a function may ignore


class UnsetError(ValueError):
    """A variable of a function or an algorithm is used before it has a value."""

    def __init__(self, name: str) -> None:
        super().__init__(f"'{name}' is used before it has a value")


class UnknownSizeError(Exception):
    """A value that must be known at translation (a size, a range, which String) depends on symbols."""

    def __init__(
        self, value: SX, what: str = "a size, a range or a choice that is not known at translation"
    ) -> None:
        super().__init__(what)
        self.value = value
        self.span: Any = None  # its place, once known


def whole(value: Value) -> int:
    """Integer that determines a size, a range or a subscript at translation."""
    (number,) = scalars(value)
    if isinstance(number, SX):
        raise UnknownSizeError(number)
    return int(number)


def elementwise(function: Callable[..., Scalar], *values: Value) -> Value:
    """Apply a scalar function element by element; scalars are combined with every element."""
    shapes = {v.shape for v in values if isinstance(v, Array)}
    if not shapes:
        for v in values:
            scalars(v)
        return function(*values)
    if len(shapes) > 1:
        raise ValueError(f"arrays of different sizes: {' and '.join(str(list(s)) for s in sorted(shapes))}")
    shape = shapes.pop()
    rows = zip(*(v.items if isinstance(v, Array) else (v,) * math.prod(shape) for v in values), strict=True)
    return Array(shape, tuple(function(*row) for row in rows))


def add(a: Scalar, b: Scalar) -> Scalar:
    """Sum, leaving exact zeros out of the graph."""
    return a + b


def divide(a: Scalar, b: Scalar) -> Scalar:
    """Quotient; a constant zero divisor is an error of the model."""
    if isinstance(b, bool | int | float) and b == 0:
        raise ZeroDivisionError("division by zero")
    return a / b


def power(a: Scalar, b: Scalar) -> Scalar:
    """Return ``a ^ b`` (a Real in Modelica)."""
    if isinstance(a, SX) or isinstance(b, SX):
        return SX(sx(a) ** sx(b))
    return float(a**b)


def matrix_product(a: Array, b: Array) -> Value:
    """Modelica's ``*`` between arrays: scalar, matrix-vector, vector-matrix and matrix products."""
    if a.shape[-1] != b.shape[0] or len(a.shape) > 2 or len(b.shape) > 2:
        raise ValueError(f"product of arrays of sizes {list(a.shape)} and {list(b.shape)}")
    rows = [()] if len(a.shape) == 1 else [(i,) for i in range(a.shape[0])]
    columns = [()] if len(b.shape) == 1 else [(j,) for j in range(b.shape[1])]
    items: list[Scalar] = []
    for row, column in product(rows, columns):
        total: Scalar = 0
        for k in range(b.shape[0]):
            total = total + a[(*row, k)] * b[(k, *column)]
        items.append(total)
    shape = (*a.shape[:-1], *b.shape[1:])
    return Array(shape, tuple(items)) if shape else items[0]


def solve(a: Array, b: Array) -> Array:
    """Solution x of the linear equations a x = b, one or several right-hand sides."""
    matrix = SX.zeros(*a.shape)
    given = SX.zeros(b.shape[0], math.prod(b.shape[1:]))
    for k, item in enumerate(a.items):
        matrix[divmod(k, a.shape[1])] = item
    for k, item in enumerate(b.items):
        given[divmod(k, given.shape[1])] = item
    x = ca.solve(matrix, given)
    return Array(b.shape, tuple(fold(x[i, j]) for i in range(given.shape[0]) for j in range(given.shape[1])))


def matrix_power(a: Array, exponent: Value) -> Value:
    """Modelica's ``^`` of a square matrix and a whole number."""
    if len(a.shape) != 2 or a.shape[0] != a.shape[1]:
        raise ValueError(f"^ on {kind(a)}, which is no square matrix")
    if not isinstance(exponent, int) or isinstance(exponent, bool) or exponent < 0:
        raise ValueError("a matrix needs a whole exponent that is not negative and known at translation")
    n = a.shape[0]
    out: Value = Array((n, n), tuple(int(i == j) for i in range(n) for j in range(n)))
    for _ in range(exponent):
        assert isinstance(out, Array)
        out = matrix_product(out, a)
    return out


def choose(condition: Scalar, then: Value, otherwise: Value) -> Value:
    """``if condition then .. else ..`` on whole values; an entry missing on one side is taken from the other."""
    if not isinstance(condition, SX):
        return then if condition else otherwise
    if then is None or otherwise is None:
        return otherwise if then is None else then
    if isinstance(then, dict) and isinstance(otherwise, dict):
        return {name: choose(condition, then[name], otherwise[name]) for name in then}
    if isinstance(then, tuple) and isinstance(otherwise, tuple):
        return tuple(choose(condition, a, b) for a, b in zip(then, otherwise, strict=True))
    if isinstance(then, str) or isinstance(otherwise, str):
        raise UnknownSizeError(condition)  # there are no Strings at run time

    def pick(a: Scalar, b: Scalar) -> Scalar:
        if not isinstance(a, SX) and not isinstance(b, SX) and a == b:
            return a
        return if_else(condition, sx(a), sx(b))

    return elementwise(pick, then, otherwise)


def numeric_or_symbolic(on_numbers: Callable[..., Number], on_sx: Callable[..., SX]) -> Callable[..., Scalar]:
    """Scalar function that evaluates numbers directly and builds SX otherwise."""

    def function(*arguments: Scalar) -> Scalar:
        if any(isinstance(a, SX) for a in arguments):
            return on_sx(*map(sx, arguments))
        return on_numbers(*arguments)

    return function


def _log10(x: SX) -> SX:
    return SX(ca.log(x) / math.log(10.0))


def _sign(x: float) -> int:
    return (x > 0) - (x < 0)


def _mod(x: Number, y: Number) -> Number:
    return x - math.floor(x / y) * y


# Scalar built-in functions without events.
FUNCTIONS: dict[str, Callable[..., Scalar]] = {
    "abs": numeric_or_symbolic(abs, ca.fabs),
    "sign": numeric_or_symbolic(_sign, ca.sign),
    "sqrt": numeric_or_symbolic(math.sqrt, ca.sqrt),
    "exp": numeric_or_symbolic(math.exp, ca.exp),
    "log": numeric_or_symbolic(math.log, ca.log),
    "log10": numeric_or_symbolic(math.log10, _log10),
    "sin": numeric_or_symbolic(math.sin, ca.sin),
    "cos": numeric_or_symbolic(math.cos, ca.cos),
    "tan": numeric_or_symbolic(math.tan, ca.tan),
    "asin": numeric_or_symbolic(math.asin, ca.asin),
    "acos": numeric_or_symbolic(math.acos, ca.acos),
    "atan": numeric_or_symbolic(math.atan, ca.atan),
    "atan2": numeric_or_symbolic(math.atan2, ca.atan2),
    "sinh": numeric_or_symbolic(math.sinh, ca.sinh),
    "cosh": numeric_or_symbolic(math.cosh, ca.cosh),
    "tanh": numeric_or_symbolic(math.tanh, ca.tanh),
}
MIN = numeric_or_symbolic(min, ca.fmin)
MAX = numeric_or_symbolic(max, ca.fmax)
# Step functions, as the floor of an argument; outside noEvent the evaluator makes them events.
FLOOR = numeric_or_symbolic(math.floor, ca.floor)
CEIL = numeric_or_symbolic(math.ceil, ca.ceil)
NOT = numeric_or_symbolic(operator.not_, ca.logic_not)
AND = numeric_or_symbolic(lambda a, b: bool(a and b), ca.logic_and)
OR = numeric_or_symbolic(lambda a, b: bool(a or b), ca.logic_or)
EQUAL = numeric_or_symbolic(operator.eq, ca.eq)
LESS = numeric_or_symbolic(operator.lt, ca.lt)
LESS_EQUAL = numeric_or_symbolic(operator.le, ca.le)
