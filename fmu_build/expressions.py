"""Flat expressions (rumoca's tree) to values: numbers where known, SX otherwise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from typing import Any, Protocol

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, UnknownSizeError, Value, whole
from fmu_build.builtin_functions import BUILTIN, as_matrix, cat
from fmu_build.errors import ModelicaError
from fmu_build.frontend import Flat, Node
from fmu_build.graph import SX

_ELEMENTWISE: dict[str, Callable[..., Scalar]] = {
    "Add": algebra.add,
    "Sub": lambda a, b: a - b,
    "AddElem": algebra.add,
    "SubElem": lambda a, b: a - b,
    "MulElem": lambda a, b: a * b,
    "DivElem": algebra.divide,
    "ExpElem": algebra.power,
}
_RELATIONS = {"Lt", "Le", "Gt", "Ge", "Eq", "Neq"}
_STEPS = {"Floor", "Integer", "Ceil", "Div", "Mod", "Rem"}


class Scope(Protocol):
    """Where names and the operators on model variables get their meaning."""

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

    def initial(self) -> SX:
        """Truth of ``initial()``."""


class Evaluator:
    """Evaluates expression trees in a scope.

    Parameters
    ----------
    flat
        The flat class (for messages and enumeration literals).
    scope
        Meaning of names.
    call
        Evaluates a function by its name with positional arguments (``functions.Functions``).
    """

    def __init__(self, flat: Flat, scope: Scope, call: Callable[[Node, list[Value]], Value]) -> None:
        self.flat = flat
        self.scope = scope
        self._call = call
        self._no_event = 0
        self._iterators: dict[str, Scalar] = {}
        self._last: list[tuple[Array, int]] = []  # what ``end`` means
        self._handlers: dict[str, Callable[[Any], Value]] = {
            "Literal": self._literal,
            "VarRef": self._reference,
            "Unary": self._unary,
            "Binary": self._binary,
            "If": self._if,
            "Array": self._array,
            "Tuple": lambda n: tuple(self(e) for e in n["elements"]),
            "Range": self._range,
            "Index": lambda n: self._subscripted(self(n["base"]), n["subscripts"]),
            "FieldAccess": self._field,
            "ArrayComprehension": self._comprehension,
            "BuiltinCall": self._builtin,
            "FunctionCall": self._function,
        }

    def __call__(self, node: Node) -> Value:
        """Evaluate an expression tree.

        Raises
        ------
        ModelicaError
            With the source line, for a construct outside the subset or values that do not fit.
        """
        ((tag, content),) = node.items()
        handler = self._handlers.get(tag)
        span = content.get("span") if isinstance(content, Mapping) else None
        if handler is None:
            raise self.flat.error(f"{tag} expressions are not supported", span)
        try:
            return handler(content)
        except ModelicaError:
            raise
        except UnknownSizeError as error:
            error.span = error.span or span
            raise
        except (TypeError, ValueError, IndexError, KeyError, ArithmeticError) as error:
            what = error.args[0] if error.args else error
            raise self.flat.error(str(what), span) from None

    def scalar(self, node: Node) -> Scalar:
        """Evaluate an expression that must be a scalar number."""
        value = self(node)
        if isinstance(value, Array) and len(value.items) == 1:
            return value.items[0]
        if not isinstance(value, bool | int | float | SX):
            raise self.flat.error(f"a scalar is needed here, not {algebra.kind(value)}", span_of(node))
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

    def _array(self, node: Node) -> Value:
        elements = [self(e) for e in node["elements"]]
        if node["kind"] == "Array":
            return Array.stack(elements)
        matrices = [as_matrix(e) for e in elements]  # [a, b; c, d]
        return cat(self, 2 if node["kind"] == "Horizontal" else 1, *matrices)

    def _literal(self, node: Node) -> Value:
        ((tag, value),) = node["value"].items()
        if tag not in ("Real", "Integer", "Boolean", "String"):
            raise ValueError(f"{tag} literals are not supported")
        return value  # type: ignore[no-any-return]

    def _reference(self, node: Node) -> Value:
        name = node["name"]["name"]
        if name in self._iterators:
            return self._iterators[name]
        try:
            value = self.scope.lookup(name)
        except KeyError:
            ordinals = self.flat["enum_literal_ordinals"]
            if name not in ordinals:
                raise KeyError(f"unknown name '{name}'") from None
            return int(ordinals[name])
        return self._subscripted(value, node["subscripts"]) if node["subscripts"] else value

    def subscripts(self, value: Array, nodes: list[Node]) -> list[list[int] | int | SX]:
        """Zero-based subscripts: a position, several positions (slice), or an expression."""
        out: list[list[int] | int | SX] = []
        for dimension, node in enumerate(nodes):
            ((tag, content),) = node.items()
            size = value.shape[dimension]
            if tag == "Index":
                out.append(int(content["value"]) - 1)
            elif tag == "Colon":
                out.append(list(range(size)))
            elif tag == "Expr":
                self._last.append((value, dimension))
                index = self(content["expr"])
                self._last.pop()
                if isinstance(index, SX):
                    out.append(index - 1)
                elif isinstance(index, Array):
                    out.append([int(i) - 1 for i in index.items])
                else:
                    out.append(int(algebra.scalars(index)[0]) - 1)
            else:
                raise ValueError(f"{tag} subscripts are not supported")
        out += [list(range(n)) for n in value.shape[len(out) :]]
        return out

    def _subscripted(self, value: Value, nodes: list[Node]) -> Value:
        if not isinstance(value, Array):
            raise TypeError(f"subscripts on {algebra.kind(value)}")
        return select(value, self.subscripts(value, nodes))

    def _unary(self, node: Node) -> Value:
        operand = self(node["rhs"])
        match node["op"]:
            case "Minus" | "DotMinus":
                return algebra.elementwise(lambda a: -a, operand)
            case "Plus" | "DotPlus":
                return operand
            case "Not":
                return algebra.elementwise(algebra.NOT, operand)
        raise ValueError(f"operator {node['op']} is not supported")

    def _binary(self, node: Node) -> Value:
        op = node["op"]
        if op in ("And", "Or"):
            return self._logical(op == "And", node)
        a, b = self(node["lhs"]), self(node["rhs"])
        if op in ("Eq", "Neq") and isinstance(a, str) and isinstance(b, str):
            return bool((a == b) == (op == "Eq"))
        if op in _RELATIONS:
            return algebra.elementwise(lambda x, y: self._relation(op, x, y), a, b)
        if isinstance(a, tuple) and isinstance(b, tuple) and op == "Sub":
            # (a, b, ...) = f(...): outputs that are left out on the left are not needed
            return tuple(algebra.elementwise(_ELEMENTWISE[op], x, y) for x, y in zip(a, b, strict=False))
        if isinstance(a, dict) and isinstance(b, dict) and op == "Sub":
            return {name: algebra.elementwise(_ELEMENTWISE[op], a[name], b[name]) for name in a}
        if op == "Add" and (isinstance(a, str) or isinstance(b, str)):
            return f"{a}{b}"
        if op in _ELEMENTWISE:
            return algebra.elementwise(_ELEMENTWISE[op], a, b)
        if op == "Mul":
            if isinstance(a, Array) and isinstance(b, Array):
                return algebra.matrix_product(a, b)
            return algebra.elementwise(lambda x, y: x * y, a, b)
        if op == "Div" and not isinstance(b, Array):
            return algebra.elementwise(algebra.divide, a, b)
        if op == "Exp" and not isinstance(a, Array):
            return algebra.elementwise(algebra.power, a, b)
        raise ValueError(f"operator {op} on {algebra.kind(a)} and {algebra.kind(b)} is not supported")

    def _logical(self, both: bool, node: Node) -> Value:
        """``and`` (`both`) or ``or``; what is decided by one side alone does not look at the other."""
        a = self(node["lhs"])
        if isinstance(a, bool | int | float) and bool(a) != both:
            return not both
        b = self(node["rhs"])
        if isinstance(b, bool | int | float) and not isinstance(a, Array):
            return a if bool(b) == both else not both
        return algebra.elementwise(algebra.AND if both else algebra.OR, a, b)

    def _relation(self, op: str, a: Scalar, b: Scalar) -> Scalar:
        if op in ("Eq", "Neq"):
            equal = algebra.EQUAL(a, b)
            return equal if op == "Eq" else algebra.NOT(equal)
        if not isinstance(a, SX) and not isinstance(b, SX):
            return {"Lt": a < b, "Le": a <= b, "Gt": a > b, "Ge": a >= b}[op]
        low, high = (a, b) if op in ("Lt", "Le") else (b, a)
        if self._no_event:
            return (algebra.LESS if op in ("Lt", "Gt") else algebra.LESS_EQUAL)(low, high)
        return algebra.fold(self.scope.relation(algebra.sx(high) - algebra.sx(low), op in ("Le", "Ge")))

    def _if(self, node: Node) -> Value:
        branches = list(node["branches"])
        conditions: list[Scalar] = []
        chosen: list[Value] = []
        for condition, expression in branches:
            truth = self.scalar(condition)
            if not isinstance(truth, SX):
                if truth:
                    last = self(expression)
                    break
                continue
            conditions.append(truth)
            chosen.append(self(expression))
        else:
            last = self(node["else_branch"])
        for truth, value in zip(reversed(conditions), reversed(chosen), strict=True):
            last = algebra.choose(truth, value, last)
        return last

    def _range(self, node: Node) -> Value:
        start, end = self.scalar(node["start"]), self.scalar(node["end"])
        step = self.scalar(node["step"]) if node["step"] else 1
        if isinstance(start, SX) or isinstance(end, SX) or isinstance(step, SX):
            raise UnknownSizeError(next(b for b in (start, end, step) if isinstance(b, SX)))
        if all(isinstance(v, int) for v in (start, end, step)):
            items: tuple[Scalar, ...] = tuple(range(int(start), int(end) + (1 if step > 0 else -1), int(step)))
        else:
            n = math.floor((end - start) / step * (1 + 1e-15)) + 1
            items = tuple(start + i * step for i in range(n))
        return Array((len(items),), items)

    def _field(self, node: Node) -> Value:
        base = self(node["base"])
        if not isinstance(base, dict) or node["field"] not in base:
            raise ValueError(f"no field '{node['field']}' in {algebra.kind(base)}")
        return base[node["field"]]

    def _comprehension(self, node: Node) -> Value:
        if node.get("filter"):
            raise ValueError("array comprehension with a filter")
        indices = [(i["name"] if "name" in i else i["ident"], i["range"]) for i in node["indices"]]

        def build(level: int) -> Value:
            if level == len(indices):
                return self(node["expr"])
            name, bounds = indices[level]
            parts = []
            for i in algebra.scalars(self(bounds)):
                with self.iterator(name, int(i)):
                    parts.append(build(level + 1))
            return Array.stack(parts)

        return build(0)

    def _function(self, node: Node) -> Value:
        return self._call(node, [self(a) for a in node["args"]])

    def _builtin(self, node: Node) -> Value:
        name, nodes = node["function"], node["args"]
        if name in ("NoEvent", "Smooth"):
            with self.no_event():
                return self(nodes[-1])
        if name == "Homotopy":
            return self(nodes[0])
        if name == "Size":
            array = self(nodes[0])
            shape = array.shape if isinstance(array, Array) else ()
            if len(nodes) == 1:
                return Array((len(shape),), shape)
            return shape[whole(self(nodes[1])) - 1]
        arguments = [self(n) for n in nodes]
        if name in algebra.FUNCTIONS:
            return algebra.elementwise(algebra.FUNCTIONS[name], *arguments)
        if name in _STEPS:
            return algebra.elementwise(lambda *a: self._step(name, *a), *arguments)
        special = BUILTIN.get(name)
        if special is None:
            raise ValueError(f"{name[0].lower()}{name[1:]}() is not supported")
        return special(self, *arguments)

    def _step(self, name: str, *arguments: Scalar) -> Scalar:
        def floor(x: Scalar) -> Scalar:
            if isinstance(x, SX) and not self._no_event:
                return self.scope.step(x)
            return algebra.FLOOR(x)

        x, *rest = arguments
        if name in ("Floor", "Integer"):
            return floor(x)
        if name == "Ceil":
            return -floor(-x)
        y = rest[0]
        quotient = algebra.divide(x, y) if isinstance(x, SX) or isinstance(y, SX) or x % y else x // y
        if name == "Mod":
            return x - floor(quotient) * y
        # div and rem round towards zero
        toward_zero = algebra.FUNCTIONS["Sign"](quotient) * floor(algebra.FUNCTIONS["Abs"](quotient))
        return toward_zero if name == "Div" else x - toward_zero * y


def span_of(node: Node) -> Any:
    """Return the span of an expression node."""
    ((_, content),) = node.items()
    return content.get("span") if isinstance(content, Mapping) else None


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
