"""Flat expressions to values: numbers where known, SX otherwise."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import product
from typing import Any, Protocol
from typing import Literal as Literals

import casadi as ca

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, UnknownSizeError, Value, whole
from fmu_build.builtin_functions import BUILTIN, STEPS, as_matrix, cat
from fmu_build.errors import IndexOutsideError, ModelicaError
from fmu_build.graph import SX
from fmu_build.syntax import (
    All,
    ArrayOf,
    Binary,
    Call,
    Comprehension,
    End,
    Expression,
    Field,
    If,
    Literal,
    Matrix,
    Node,
    Place,
    Range,
    Reference,
    Subscripted,
    TupleOf,
    Unary,
)

_ELEMENTWISE: dict[str, Callable[..., Scalar]] = {
    "+": algebra.add,
    "-": lambda a, b: a - b,
    ".+": algebra.add,
    ".-": lambda a, b: a - b,
    ".*": lambda a, b: a * b,
    "./": algebra.divide,
    ".^": algebra.power,
}
_RELATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "<>": operator.ne,
}  # fmt: skip


def _arithmetic(op: str, a: Value, b: Value) -> Value:
    if op == "+" and (isinstance(a, str) or isinstance(b, str)):
        return f"{a}{b}"
    if op == "*" and isinstance(a, Array) and isinstance(b, Array):
        return algebra.matrix_product(a, b)
    if op == "^" and isinstance(a, Array):
        return algebra.matrix_power(a, b)
    scalar = {"/": algebra.divide, "^": algebra.power, "*": lambda x, y: x * y} | _ELEMENTWISE
    if (op == "/" and isinstance(b, Array)) or (op == "^" and isinstance(b, Array)) or op not in scalar:
        raise ValueError(f"operator {op} on {algebra.kind(a)} and {algebra.kind(b)} is not supported")
    return algebra.elementwise(scalar[op], a, b)


class Context(Protocol):
    """The part of the model that an evaluator needs: how to make an error."""

    def error(self, what: str, at: Place | None, fix: str | None = None) -> ModelicaError:
        """Make the error for a construct at a place."""


class Scope(Protocol):
    """Source of the meaning of names and of the operators on model variables."""

    def lookup(self, name: str) -> Value:
        """Return the value of a variable; KeyError if there is none."""

    def derivative(self, value: Scalar) -> Scalar:
        """Return ``der(value)``."""

    def previous(self, value: Scalar) -> Scalar:
        """Return ``pre(value)``."""

    def relation(self, difference: SX, inclusive: bool) -> SX:
        """Truth of ``difference > 0`` (``>= 0`` if inclusive), an event where it changes if it is continuous."""

    def step(self, argument: SX) -> SX:
        """``floor(argument)``, an event where it changes if the argument is continuous."""

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

    def starting(self) -> SX:
        """Truth of: the simplified model applies, before the initialisation."""


class Evaluator:
    """Evaluates expression trees in a scope.

    Parameters
    ----------
    context
        Makes the errors.
    scope
        Gives names their meaning.
    call
        Evaluates a function by its name with positional arguments (``functions.Functions``).

    Attributes
    ----------
    events_in_smooth
        Which relations in ``smooth(0, ...)``, which has kinks but no jumps, are events: none, those outside
        noEvent ("some") or all.
    smoothed
        Whether there was such a call.
    """

    def __init__(self, context: Context, scope: Scope, call: Callable[[str, list[Value]], Value]) -> None:
        self.events_in_smooth: Literals["", "some", "all"] = ""
        self.smoothed = self._inside_smooth = False
        self.context = context
        self.scope = scope
        self._call = call
        self._guards: list[SX] = getattr(call, "guards", [])
        self._no_event = 0
        self._iterators: dict[str, Scalar] = {}
        self._last: list[tuple[Array, int]] = []  # the meaning of ``end``
        self._handlers: dict[type, Callable[[Any], Value]] = {
            Literal: lambda n: n.value,
            Reference: self._reference,
            Unary: self._unary,
            Binary: self._binary,
            If: self._if,
            ArrayOf: self._array,
            Matrix: self._matrix,
            TupleOf: lambda n: tuple(None if e is None else self(e) for e in n.items),
            Range: self._range,
            Subscripted: lambda n: self._subscripted(self(n.base), n.subscripts),
            Field: self._field,
            Comprehension: self._comprehension,
            Call: self._function,
            End: self._end,
        }

    def __call__(self, node: Expression) -> Value:
        """Evaluate an expression tree.

        Raises
        ------
        ModelicaError
            A construct is outside the subset, or values do not fit; the message names the source line.
        """
        handler = self._handlers.get(type(node))
        if handler is None:
            raise self.context.error(f"{type(node).__name__} expressions are not supported", node.at)
        try:
            return handler(node)
        except ModelicaError:
            raise
        except UnknownSizeError as error:
            error.span = error.span or node.at
            raise
        except (TypeError, ValueError, IndexError, KeyError, ArithmeticError) as error:
            what = error.args[0] if error.args else error
            if isinstance(error, TypeError):
                what = f"{what} ({_shown(node)})"
            if isinstance(error, KeyError):
                what = f"there is no variable '{what}'"
            if isinstance(error, IndexError):
                raise IndexOutsideError(str(what), where=node.at) from None
            raise self.context.error(str(what), node.at) from None

    def scalar(self, node: Expression) -> Scalar:
        """Evaluate an expression that must be a scalar number."""
        value = self(node)
        if isinstance(value, Array) and len(value.items) == 1:
            return value.items[0]
        if not isinstance(value, bool | int | float | SX):
            raise self.context.error(f"a scalar is needed here, not {algebra.kind(value)}", node.at)
        return value

    @contextmanager
    def no_event(self) -> Iterator[None]:
        """Evaluate relations literally inside."""
        self._no_event += 1
        try:
            yield
        finally:
            self._no_event -= 1

    @contextmanager
    def iterator(self, name: str, value: Scalar) -> Iterator[None]:
        """Bind a loop variable inside."""
        before = self._iterators.get(name)
        self._iterators[name] = value
        try:
            yield
        finally:
            if before is None:
                del self._iterators[name]
            else:
                self._iterators[name] = before

    @contextmanager
    def guard(self, condition: Scalar) -> Iterator[None]:
        """Evaluate an expression that matters only where a condition holds."""
        if not isinstance(condition, SX):
            yield
            return
        self._guards.append(condition)
        try:
            yield
        finally:
            self._guards.pop()

    def _reference(self, node: Reference) -> Value:
        first, *rest = node.parts
        value: Value = (
            self._iterators[first.name] if first.name in self._iterators else self.scope.lookup(first.name)
        )
        if first.subscripts:
            value = self._subscripted(value, first.subscripts)
        for part in rest:
            if not isinstance(value, Mapping) or part.name not in value:
                raise ValueError(f"no field '{part.name}' in {algebra.kind(value)}")
            value = value[part.name]
            if part.subscripts:
                value = self._subscripted(value, part.subscripts)
        return value

    def _array(self, node: ArrayOf) -> Value:
        parts = [self(e) for e in node.items]
        if parts and all(isinstance(p, str) for p in parts):
            return Array((len(parts),), tuple(parts))
        return algebra.stacked(parts)

    def _matrix(self, node: Matrix) -> Value:
        values = [[self(e) for e in row] for row in node.rows]
        rank = max([2, *(len(v.shape) for row in values for v in row if isinstance(v, Array))])
        if rank > 2:
            raise ValueError("[] of arrays with more than two dimensions")
        rows = [cat(self, 2, *(as_matrix(v) for v in row)) for row in values]
        return cat(self, 1, *rows)

    def _end(self, _: End) -> int:
        if not self._last:
            raise ValueError("'end' outside subscripts")
        array, dimension = self._last[-1]
        return array.shape[dimension]

    def subscripts(self, value: Array, nodes: tuple[Expression, ...]) -> list[list[int] | int | SX]:
        """Zero-based indices that subscripts select in an array."""
        out: list[list[int] | int | SX] = []
        if len(nodes) > len(value.shape):
            raise ValueError(f"{len(nodes)} subscripts on {algebra.kind(value)}")
        for dimension, node in enumerate(nodes):
            size = value.shape[dimension]
            if isinstance(node, All):
                out.append(list(range(size)))
                continue
            self._last.append((value, dimension))
            index = self(node)
            self._last.pop()
            if isinstance(index, SX):
                out.append(index - 1)
            elif isinstance(index, Array):
                out.append([whole(i) - 1 for i in index.items])
            elif isinstance(index, bool):
                out.append(int(index))
            else:
                out.append(whole(index) - 1)
        out += [list(range(n)) for n in value.shape[len(out) :]]
        return out

    def _subscripted(self, value: Value, nodes: tuple[Expression, ...]) -> Value:
        if isinstance(value, dict):  # an array of records
            return {name: self._subscripted(part, nodes) for name, part in value.items()}
        if not isinstance(value, Array):
            raise TypeError(f"subscripts on {algebra.kind(value)}")
        return select(value, self.subscripts(value, nodes))

    def _unary(self, node: Unary) -> Value:
        operand = self(node.operand)
        if node.operator == "not":
            return algebra.elementwise(algebra.NOT, operand)
        return algebra.elementwise(lambda a: -a, operand) if "-" in node.operator else operand

    def _binary(self, node: Binary) -> Value:
        op = node.operator
        if op in ("and", "or"):
            return self._logical(op == "and", node)
        a, b = self(node.left), self(node.right)
        if op in _RELATIONS:
            if isinstance(a, str) and isinstance(b, str):
                return bool(_RELATIONS[op](a, b))
            return algebra.elementwise(lambda x, y: self._relation(op, x, y), a, b)
        if isinstance(a, dict) and isinstance(b, dict) and op == "-":
            return {name: algebra.elementwise(_ELEMENTWISE[op], a[name], b[name]) for name in a}
        return _arithmetic(op, a, b)

    def _logical(self, both: bool, node: Binary) -> Value:
        """``and`` (`both`) or ``or``; if one side decides, the other is not evaluated."""
        a = self(node.left)
        if isinstance(a, bool | int | float) and bool(a) != both:
            return not both
        b = self(node.right)
        if isinstance(b, bool | int | float) and not isinstance(a, Array):
            return a if bool(b) == both else not both
        return algebra.elementwise(algebra.AND if both else algebra.OR, a, b)

    def _relation(self, op: str, a: Scalar, b: Scalar) -> Scalar:
        if op in ("==", "<>"):
            equal = algebra.EQUAL(a, b)
            return equal if op == "==" else algebra.NOT(equal)
        if not isinstance(a, SX) and not isinstance(b, SX):
            return bool(_RELATIONS[op](a, b))
        low, high = (a, b) if op in ("<", "<=") else (b, a)
        if self._no_event:
            return (algebra.LESS if op in ("<", ">") else algebra.LESS_EQUAL)(low, high)
        return algebra.fold(self.scope.relation(algebra.sx(high) - algebra.sx(low), op in ("<=", ">=")))

    def _if(self, node: If) -> Value:
        conditions: list[Scalar] = []
        chosen: list[Value] = []
        depth = 0
        try:
            for condition, expression in node.branches:
                truth = self.scalar(condition)
                if not isinstance(truth, SX):
                    if truth:
                        last = self(expression)
                        break
                    continue
                conditions.append(truth)
                with self.guard(truth):
                    chosen.append(self(expression))
                self._guards.append(ca.logic_not(truth))
                depth += 1
            else:
                last = self(node.otherwise)
        finally:
            for _ in range(depth):
                self._guards.pop()
        for truth, value in zip(reversed(conditions), reversed(chosen), strict=True):
            last = algebra.choose(truth, value, last)
        return last

    def _range(self, node: Range) -> Value:
        start, end = self.scalar(node.start), self.scalar(node.stop)
        step = self.scalar(node.step) if node.step else 1
        if isinstance(start, SX) or isinstance(end, SX) or isinstance(step, SX):
            raise UnknownSizeError(next(b for b in (start, end, step) if isinstance(b, SX)))
        if isinstance(start, bool) and isinstance(end, bool) and node.step is None:
            items: tuple[Scalar, ...] = tuple(b for b in (False, True) if start <= b <= end)
            return Array((len(items),), items)
        if step == 0:
            raise ValueError("a range with step 0")
        if all(isinstance(v, int) for v in (start, end, step)):
            items = tuple(range(int(start), int(end) + (1 if step > 0 else -1), int(step)))
        else:
            n = max(math.floor((end - start) / step * (1 + 1e-15)) + 1, 0)
            items = tuple(start + i * step for i in range(n))
        return Array((len(items),), items)

    def _field(self, node: Field) -> Value:
        base = self(node.base)
        if not isinstance(base, dict) or node.name not in base:
            raise ValueError(f"no field '{node.name}' in {algebra.kind(base)}")
        return base[node.name]

    def _comprehension(self, node: Comprehension) -> Value:
        def build(level: int) -> Value:
            if level < 0:
                return self(node.element)
            name, bounds = node.iterators[level]
            assert bounds is not None
            parts = []
            for i in algebra.scalars(self(bounds)):
                with self.iterator(name, i):
                    parts.append(build(level - 1))
            return algebra.stacked(parts)

        return build(len(node.iterators) - 1)

    def _function(self, node: Call) -> Value:
        name, nodes = node.function, node.arguments
        if name in BUILTIN or name in STEPS or name in algebra.FUNCTIONS or name in _SPECIAL:
            return self._builtin(name, nodes)
        return self._call(name, [None if a is None else self._argument(a) for a in nodes])

    def _argument(self, node: Expression) -> Value:
        """Evaluate an argument of a function. A variable may lack a value if the function ignores it."""
        try:
            return self._reference(node) if isinstance(node, Reference) else self(node)
        except algebra.UnsetError:
            return algebra.UNSET

    def _builtin(self, name: str, nodes: tuple[Expression | None, ...]) -> Value:
        given = [n for n in nodes if n is not None]
        if name in _SPECIAL:
            return self._special(name, given)
        arguments = [self(n) for n in given]
        if name in ("fill", "transpose") and isinstance(arguments[0], dict):
            return {field: BUILTIN[name](self, part, *arguments[1:]) for field, part in arguments[0].items()}
        if name in algebra.FUNCTIONS:
            return algebra.elementwise(algebra.FUNCTIONS[name], *arguments)
        if name in STEPS:
            return algebra.elementwise(lambda *a: self._step(name, *a), *arguments)
        return BUILTIN[name](self, *arguments)

    def _special(self, name: str, given: list[Expression]) -> Value:
        """Evaluate functions that depend on more than the values of their arguments."""
        if name in ("pre", "edge", "change"):
            return self._with_previous(name, given[0])
        if name == "size":
            return self._size(given)
        if name == "homotopy":
            actual = self(given[0])
            if not self.events_in_smooth:
                return actual
            return algebra.choose(self.scope.starting(), self(given[1]), actual)
        if name == "smooth" and not self._no_event and self(given[0]) == 0:
            return self._smooth(given[1])
        if name == "noEvent" and self._inside_smooth and self.events_in_smooth == "all":
            return self(given[0])
        with self.no_event():
            return self(given[-1])

    def _size(self, given: list[Expression]) -> Value:
        array = self(given[0])
        while isinstance(array, dict) and array:  # an array of records is a record of arrays
            array = next(iter(array.values()))
        shape = array.shape if isinstance(array, Array) else ()
        if len(given) == 1:
            return Array((len(shape),), shape)
        return shape[whole(self(given[1])) - 1]

    def _smooth(self, node: Expression) -> Value:
        self.smoothed = True
        if not self.events_in_smooth:
            with self.no_event():
                return self(node)
        before, self._inside_smooth = self._inside_smooth, True
        try:
            return self(node)
        finally:
            self._inside_smooth = before

    def _with_previous(self, name: str, node: Expression) -> Value:
        """``pre``, ``edge`` and ``change``: an algorithm's own variable has its value outside the algorithm."""
        outside = getattr(self.scope, "outside", None)
        if outside is None:
            declared = self(node)
        else:
            with outside():
                declared = self(node)
        before = algebra.elementwise(self.scope.previous, declared)
        if name == "pre":
            return before
        now = self(node)
        if name == "edge":
            return algebra.elementwise(lambda a, b: algebra.AND(a, algebra.NOT(b)), now, before)
        return algebra.elementwise(lambda a, b: algebra.NOT(algebra.EQUAL(a, b)), now, before)

    def _step(self, name: str, *arguments: Scalar) -> Scalar:
        def floor(x: Scalar) -> Scalar:
            if isinstance(x, SX) and not self._no_event:
                return self.scope.step(x)
            return algebra.FLOOR(x)

        x, *rest = arguments
        if name in ("floor", "integer"):
            return floor(x)
        if name == "ceil":
            return -floor(-x)
        y = rest[0]
        quotient = algebra.divide(x, y) if isinstance(x, SX) or isinstance(y, SX) or x % y else x // y
        if name == "mod":
            return x - floor(quotient) * y
        # div and rem round towards zero
        toward_zero = algebra.FUNCTIONS["sign"](quotient) * floor(algebra.FUNCTIONS["abs"](quotient))
        return toward_zero if name == "div" else x - toward_zero * y


_SPECIAL = {"noEvent", "smooth", "homotopy", "size", "pre", "edge", "change"}


def _shown(node: Expression) -> str:
    """Say which part of the source an error is about."""
    if isinstance(node, Call):
        return f"an argument of {node.function}()"
    if isinstance(node, Binary | Unary):
        return f"an operand of '{node.operator}'"
    return f"'{node.name}'" if isinstance(node, Reference) else type(node).__name__.lower()


def place_of(node: Any) -> Place | None:
    """Place of a node."""
    return node.at if isinstance(node, Node) else None


def select(value: Array, index: list[list[int] | int | SX]) -> Value:
    """Index an array; a subscript that is an expression becomes a chain of conditions."""
    for dimension, i in enumerate(index):
        if isinstance(i, SX):
            out: Value = None
            for k in reversed(range(value.shape[dimension])):
                part = select(value, [*index[:dimension], k, *index[dimension + 1 :]])
                out = part if out is None else algebra.choose(algebra.EQUAL(i, k), part, out)
            return out
    shape = tuple(len(i) for i in index if isinstance(i, list))
    lists = [i if isinstance(i, list) else [i] for i in index if not isinstance(i, SX)]
    items = tuple(value[at] for at in product(*lists))
    return Array(shape, items) if shape else items[0]
