"""Modelica expressions and statements as immutable trees, before and after flattening.

In source, a `Reference` has its parts as written (``a[2].b.c``). In a flat model it has one part, whose name is
that of a flat variable (``a[2].b.c``) and whose subscripts select inside that variable; inside a function it keeps
its parts. Function names are source names before flattening, and afterwards keys of `FlatModel.functions` or names
of built-in functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple


class Place(NamedTuple):
    """Place in the source."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass(frozen=True, slots=True)
class Node:
    """A node of a tree, with its place."""

    at: Place


@dataclass(frozen=True, slots=True)
class Literal(Node):
    """A number, a truth value or a string; an enumeration's literal is its ordinal, with all literals' names.

    The value of a declared constant has the unit of its declaration, which is empty where that has none.
    """

    value: bool | int | float | str
    name: str = ""
    literals: tuple[str, ...] = ()
    unit: str | None = None


class Part(NamedTuple):
    """One part of a dotted name."""

    name: str
    subscripts: tuple[Expression, ...] = ()


@dataclass(frozen=True, slots=True)
class Reference(Node):
    """A component reference."""

    parts: tuple[Part, ...]
    rooted: bool = False  # written with a leading dot

    @property
    def name(self) -> str:
        """The dotted name without subscripts."""
        return ".".join([p.name for p in self.parts])

    @property
    def subscripts(self) -> tuple[Expression, ...]:
        """Subscripts of the last part."""
        return self.parts[-1].subscripts


@dataclass(frozen=True, slots=True)
class Call(Node):
    """A function call; in a flat model, an omitted argument is None, and there are no named ones."""

    function: str
    arguments: tuple[Expression | None, ...]
    named: tuple[tuple[str, Expression], ...] = ()
    rooted: bool = False


@dataclass(frozen=True, slots=True)
class Unary(Node):
    """``-``, ``+``, ``.-``, ``.+`` or ``not`` before an operand."""

    operator: str
    operand: Expression


@dataclass(frozen=True, slots=True)
class Binary(Node):
    """An operator between two operands, as written."""

    operator: str
    left: Expression
    right: Expression


@dataclass(frozen=True, slots=True)
class If(Node):
    """``if c1 then e1 elseif c2 then e2 else e3``."""

    branches: tuple[tuple[Expression, Expression], ...]
    otherwise: Expression
    apart: bool = False  # the branches are sides of separate equations


@dataclass(frozen=True, slots=True)
class ArrayOf(Node):
    """``{e1, e2, ...}``."""

    items: tuple[Expression, ...]


@dataclass(frozen=True, slots=True)
class Matrix(Node):
    """``[a, b; c, d]``: concatenation along both dimensions."""

    rows: tuple[tuple[Expression, ...], ...]


@dataclass(frozen=True, slots=True)
class Range(Node):
    """``start : step : stop``."""

    start: Expression
    step: Expression | None
    stop: Expression


@dataclass(frozen=True, slots=True)
class TupleOf(Node):
    """``(a, , b)``: several results; None for an omitted one."""

    items: tuple[Expression | None, ...]


@dataclass(frozen=True, slots=True)
class Comprehension(Node):
    """``e for i in r, j in s``; an omitted range is None."""

    element: Expression
    iterators: tuple[tuple[str, Expression | None], ...]


@dataclass(frozen=True, slots=True)
class Subscripted(Node):
    """Subscripts on an expression."""

    base: Expression
    subscripts: tuple[Expression, ...]


@dataclass(frozen=True, slots=True)
class Field(Node):
    """A field of an expression that is a record."""

    base: Expression
    name: str


@dataclass(frozen=True, slots=True)
class End(Node):
    """``end`` in a subscript."""


@dataclass(frozen=True, slots=True)
class All(Node):
    """``:`` as a subscript."""


@dataclass(frozen=True, slots=True)
class PartialCall(Node):
    """``function f(a = 1)`` as an argument."""

    call: Call


Expression = (
    Literal | Reference | Call | Unary | Binary | If | ArrayOf | Matrix | Range | TupleOf | Comprehension
    | Subscripted | Field | End | All | PartialCall
)  # fmt: skip

# ---- statements


@dataclass(frozen=True, slots=True)
class Assign(Node):
    """``target := value``, in a flat when-clause also ``target = value``."""

    target: Reference
    value: Expression


@dataclass(frozen=True, slots=True)
class AssignMany(Node):
    """``(a, , b) := f(...)``; a call on its own has no targets."""

    targets: tuple[Reference | None, ...]
    call: Call


@dataclass(frozen=True, slots=True)
class IfStatement(Node):
    """``if`` with statements (or source equations); the last branch may have no condition (else)."""

    branches: tuple[tuple[Expression | None, tuple[Any, ...]], ...]


@dataclass(frozen=True, slots=True)
class ForStatement(Node):
    """``for`` with statements (or source equations)."""

    iterators: tuple[tuple[str, Expression | None], ...]
    body: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class WhileStatement(Node):
    """``while``."""

    condition: Expression
    body: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class WhenStatement(Node):
    """``when`` with its ``elsewhen`` branches."""

    branches: tuple[tuple[Expression, tuple[Any, ...]], ...]


@dataclass(frozen=True, slots=True)
class Return(Node):
    """``return``."""


@dataclass(frozen=True, slots=True)
class Break(Node):
    """``break``."""


@dataclass(frozen=True, slots=True)
class Reinit(Node):
    """``reinit(state, value)``."""

    state: Reference
    value: Expression


@dataclass(frozen=True, slots=True)
class Assert(Node):
    """``assert(condition, message, level)``."""

    condition: Expression
    message: Expression
    warning: bool


@dataclass(frozen=True, slots=True)
class Terminate(Node):
    """``terminate(message)``."""

    message: Expression


Statement = (
    Assign | AssignMany | IfStatement | ForStatement | WhileStatement | WhenStatement | Return | Break | Reinit
    | Assert | Terminate
)  # fmt: skip

# ---- equations of the source


@dataclass(frozen=True, slots=True)
class SourceEquation(Node):
    """``left = right``."""

    left: Expression
    right: Expression


@dataclass(frozen=True, slots=True)
class Connect(Node):
    """``connect(a, b)``."""

    a: Reference
    b: Reference


# ---- functions on trees


def _inner(node: Node) -> tuple[str, ...]:
    """Return the names of all fields of a node but its place, which is the first one."""
    names: tuple[str, ...] = node.__match_args__
    return names[1:]


def transform(tree: Any, change: Callable[[Any], Any]) -> Any:
    """Return the tree with `change` applied to each node from the leaves up."""
    if isinstance(tree, Node):
        new: dict[str, Any] = {}
        for name in _inner(tree):
            value = getattr(tree, name)
            if isinstance(value, Node | tuple):
                changed = transform(value, change)
                if changed is not value:
                    new[name] = changed
        return change(replace(tree, **new) if new else tree)
    if isinstance(tree, tuple):
        items = [transform(item, change) if isinstance(item, Node | tuple) else item for item in tree]
        if all(a is b for a, b in zip(items, tree, strict=True)):
            return tree
        return Part(*items) if isinstance(tree, Part) else tuple(items)
    return tree


def walk(tree: Any) -> Iterator[Node]:
    """Yield every node of a tree, parents first."""
    stack = [tree]
    while stack:
        item = stack.pop()
        if isinstance(item, Node):
            yield item
            stack.extend([getattr(item, name) for name in reversed(_inner(item))])
        elif isinstance(item, tuple):
            stack.extend(reversed(item))


def references(tree: Any) -> Iterator[Reference]:
    """Yield every reference in a tree."""
    return (node for node in walk(tree) if isinstance(node, Reference))
