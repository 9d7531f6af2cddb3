# ruff: noqa: ARG001, ARG005  (built-in functions of one table share a signature)
"""Modelica's built-in functions on arrays, and the operators that need the scope."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import prod
from typing import Any, Protocol

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, UnknownSizeError, Value, whole
from fmu_build.graph import SX


class History(Protocol):
    """Meaning of the operators on model variables."""

    def derivative(self, value: Scalar) -> Scalar:
        """Return ``der(value)``."""

    def previous(self, value: Scalar) -> Scalar:
        """Return ``pre(value)``."""

    def sample(self, start: Scalar, interval: Scalar) -> SX:
        """Truth of ``sample(start, interval)``."""

    def delay(self, value: Scalar, time: Scalar) -> Scalar:
        """Return ``delay(value, time)``."""

    def transport(
        self, inlets: tuple[SX, SX], moved: SX, points: Sequence[float], profile: Sequence[SX]
    ) -> tuple[SX, SX]:
        """Return the values at both ends of a ``spatialDistribution()``."""

    def is_fixed(self, value: SX) -> bool:
        """Whether an expression depends on parameters alone."""

    def initial(self) -> SX:
        """Truth of ``initial()``."""


class Operators(Protocol):
    """The part of the evaluator that built-in functions see."""

    @property
    def scope(self) -> History:
        """Meaning of der, pre, sample and initial."""


def _total(e: Operators, a: Value) -> Value:
    out: Scalar = 0
    for item in algebra.scalars(a):
        out = out + item
    return out


def _product(e: Operators, a: Value) -> Value:
    out: Scalar = 1
    for item in algebra.scalars(a):
        out = out * item
    return out


def _extreme(function: Callable[..., Scalar]) -> Callable[..., Value]:
    def evaluate(e: Operators, *arguments: Value) -> Value:
        items = [i for a in arguments for i in algebra.scalars(a)]
        out = items[0]
        for item in items[1:]:
            out = function(out, item)
        return out

    return evaluate


def _fill(value: Value, *shape: Value) -> Value:
    sizes = tuple(whole(n) for n in shape)
    if isinstance(value, Array):
        return Array((*sizes, *value.shape), value.items * math.prod(sizes))
    item: Any = value if isinstance(value, str) else algebra.scalars(value)[0]
    return Array.fill(sizes, item)


def _identity(e: Operators, n: Value) -> Value:
    size = whole(n)
    return Array((size, size), tuple(int(i == j) for i in range(size) for j in range(size)))


def _linspace(e: Operators, a: Value, b: Value, n: Value) -> Value:
    (low,), (high,), count = algebra.scalars(a), algebra.scalars(b), whole(n)
    return Array((count,), tuple(low + (high - low) * i / (count - 1) for i in range(count)))


def as_matrix(value: Value) -> Array:
    """Promote a scalar or vector to a matrix of one column."""
    if not isinstance(value, Array):
        return Array((1, 1), algebra.scalars(value))
    return Array((*value.shape, 1), value.items) if len(value.shape) == 1 else value


def _transpose(e: Operators, a: Value) -> Value:
    if not isinstance(a, Array) or len(a.shape) != 2:
        raise ValueError(f"transpose of {algebra.kind(a)}")
    rows, columns = a.shape
    return Array((columns, rows), tuple(a[(i, j)] for j in range(columns) for i in range(rows)))


def _cross(e: Operators, a: Value, b: Value) -> Value:
    x, y = algebra.scalars(a), algebra.scalars(b)
    return Array((3,), tuple(x[i - 2] * y[i - 1] - x[i - 1] * y[i - 2] for i in range(3)))


def _outer_product(e: Operators, a: Value, b: Value) -> Value:
    x, y = algebra.scalars(a), algebra.scalars(b)
    return Array((len(x), len(y)), tuple(i * j for i in x for j in y))


def _diagonal(e: Operators, a: Value) -> Value:
    x = algebra.scalars(a)
    return Array((len(x), len(x)), tuple(v if i == j else 0 for i, v in enumerate(x) for j in range(len(x))))


def _skew(e: Operators, a: Value) -> Value:
    x, y, z = algebra.scalars(a)
    return Array((3, 3), (0, -z, y, z, 0, -x, -y, x, 0))


def cat(e: Operators, dimension: Value, *parts: Value) -> Value:
    """Return ``cat(dimension, parts...)`` of arrays."""
    arrays = [p for p in parts if isinstance(p, Array)]
    axis = whole(dimension) - 1
    shapes = {(*a.shape[:axis], *a.shape[axis + 1 :]) for a in arrays}
    if len(arrays) != len(parts) or len(shapes) > 1 or not all(0 <= axis < len(a.shape) for a in arrays):
        raise ValueError(f"cat({axis + 1}, ...) of {' and '.join(map(algebra.kind, parts))}")
    shape = list(arrays[0].shape)
    shape[axis] = sum(a.shape[axis] for a in arrays)
    items: list[Scalar] = []
    for row in range(prod(shape[:axis])):
        for a in arrays:
            n = prod(a.shape[axis:])
            items += a.items[row * n : (row + 1) * n]
    return Array(tuple(shape), tuple(items))


def _semi_linear(e: Operators, x: Value, positive: Value, negative: Value) -> Value:
    def scalar(a: Scalar, p: Scalar, n: Scalar) -> Scalar:
        return algebra.choose(algebra.LESS_EQUAL(0, a), p * a, n * a)

    return algebra.elementwise(scalar, x, positive, negative)


def _string(e: Operators, value: Value, *rest: Value) -> Value:
    if isinstance(value, SX):
        raise UnknownSizeError(value)
    given: list[Any] = [6, 0, True, ""]  # significantDigits, minimumLength, leftJustified, format
    if rest and isinstance(rest[0], str):
        given[3] = rest[0]
    else:
        first = 0 if isinstance(value, float) or len(rest) == len(given) else 1
        given[first : first + len(rest)] = rest
    digits, least, left, form = given
    if form:
        text = f"%{form.removeprefix('%')}" % value
    elif isinstance(value, float):
        text = f"{value:.{whole(digits)}g}"
    else:
        text = str(value).lower() if isinstance(value, bool) else str(value)
    return text.ljust(whole(least)) if left else text.rjust(whole(least))


def _matrix(e: Operators, a: Value) -> Value:
    if isinstance(a, Array) and len(a.shape) > 2:
        if any(n != 1 for n in a.shape[2:]):
            raise ValueError(f"matrix of {algebra.kind(a)}")
        return Array(a.shape[:2], a.items)
    return as_matrix(a)


def _symmetric(e: Operators, a: Value) -> Value:
    if not isinstance(a, Array) or len(a.shape) != 2:
        raise ValueError(f"symmetric of {algebra.kind(a)}")
    n, m = a.shape
    return Array((n, m), tuple(a[(min(i, j), max(i, j))] for i in range(n) for j in range(m)))


def _delay(e: Operators, value: Value, time: Value, most: Value = None) -> Value:
    if any(isinstance(item, SX) and not e.scope.is_fixed(item) for item in algebra.scalars(time)):
        raise ValueError("a delay time that varies is not supported")
    for number, limit in zip(
        algebra.scalars(time), algebra.scalars(most) if most is not None else (), strict=False
    ):
        if not isinstance(number, SX) and not isinstance(limit, SX) and number > limit:
            raise ValueError(f"a delay of {number:g} s, with a maximum of {limit:g} s")
    return algebra.elementwise(e.scope.delay, value, time)


_EMPTY = Array((2,), (0.0, 1.0)), Array((2,), (0.0, 0.0))  # initial points and values


def _spatial_distribution(
    e: Operators, in0: Value, in1: Value, x: Value, forward: Value, *contents: Value
) -> Value:
    """Give what leaves at both ends of a pipe of length 1: at the end where it flows in, what enters there."""
    given: tuple[Value, ...] = (*contents, *_EMPTY[len(contents) :])
    points, values = given
    if any(isinstance(v, Array) for v in (in0, in1, x, forward)):
        raise ValueError("spatialDistribution() of arrays is not supported")
    at, profile = algebra.scalars(points), algebra.scalars(values)
    for point in at:
        if isinstance(point, SX):
            raise UnknownSizeError(point)
    if len(at) != len(profile):
        raise ValueError(f"{len(at)} initialPoints and {len(profile)} initialValues")
    if len(at) < 2 or at[0] != 0 or at[-1] != 1 or any(a > b for a, b in pairwise(at)):
        raise ValueError("initialPoints must rise from 0 to 1")
    if any(isinstance(value, SX) and not e.scope.is_fixed(value) for value in profile):
        raise ValueError("initialValues that vary are not supported")
    inlets = algebra.sx(in0), algebra.sx(in1)
    left, right = e.scope.transport(inlets, algebra.sx(x), list(map(float, at)), list(map(algebra.sx, profile)))
    (truth,) = algebra.scalars(forward)
    return algebra.choose(truth, inlets[0], left), algebra.choose(truth, right, inlets[1])


BUILTIN: dict[str, Callable[..., Value]] = {
    "der": lambda e, a: algebra.elementwise(e.scope.derivative, a),
    "sample": lambda e, start, interval: e.scope.sample(algebra.scalars(start)[0], algebra.scalars(interval)[0]),
    "initial": lambda e: e.scope.initial(),
    "delay": _delay,
    "spatialDistribution": _spatial_distribution,
    "min": _extreme(algebra.MIN),
    "max": _extreme(algebra.MAX),
    "sum": _total,
    "product": _product,
    "zeros": lambda e, *n: _fill(0, *n),
    "ones": lambda e, *n: _fill(1, *n),
    "fill": lambda e, v, *n: _fill(v, *n),
    "identity": _identity,
    "linspace": _linspace,
    "transpose": _transpose,
    "cross": _cross,
    "outerProduct": _outer_product,
    "diagonal": _diagonal,
    "skew": _skew,
    "cat": cat,
    "ndims": lambda e, a: len(a.shape) if isinstance(a, Array) else 0,
    "scalar": lambda e, a: algebra.scalars(a)[0],
    "vector": lambda e, a: Array((len(algebra.scalars(a)),), algebra.scalars(a)),
    "matrix": _matrix,
    "symmetric": _symmetric,
    "semiLinear": _semi_linear,
    "String": _string,
    "Integer": lambda e, a: a,
}
STEPS = frozenset(("floor", "integer", "ceil", "div", "mod", "rem"))
SUPPORTED = frozenset(
    (*BUILTIN, *STEPS, *algebra.FUNCTIONS, "noEvent", "smooth", "homotopy", "size", "pre", "edge", "change")
) | {"array"}
CLOCKED = frozenset(
    ("Clock", "previous", "hold", "backSample", "subSample", "superSample", "shiftSample", "noClock", "interval",
     "firstTick")
)  # fmt: skip
UNSUPPORTED = CLOCKED | frozenset(
    ("inStream", "actualStream", "rooted", "loadResource", "transition", "initialState",
     "activeState", "ticksInState", "timeInState")
)  # fmt: skip
CLOCKS = "clocks are not supported"
NO_CLOCKS = "use sample() in a when-equation"
# Names of the arguments of built-in functions that may be called with named arguments.
NAMED: dict[str, list[str]] = {
    "homotopy": ["actual", "simplified"],
    "smooth": ["p", "expr"],
    "sample": ["start", "interval"],
    "delay": ["expr", "delayTime", "delayMax"],
    "spatialDistribution": ["in0", "in1", "x", "positiveVelocity", "initialPoints", "initialValues"],
    "String": ["value", "significantDigits", "minimumLength", "leftJustified", "format"],
    "semiLinear": ["x", "positiveSlope", "negativeSlope"],
    "fill": ["s"],
    "linspace": ["x1", "x2", "n"],
    "atan2": ["u1", "u2"],
}
