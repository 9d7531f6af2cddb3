"""The equations of a flat class as scalar residuals, discrete definitions, when-clauses and assertions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from fmu_build import algebra
from fmu_build.algebra import Scalar, Value
from fmu_build.expressions import span_of
from fmu_build.frontend import Flat, Node
from fmu_build.graph import SX, key
from fmu_build.scope import ModelScope


@dataclass(frozen=True)
class Equation:
    """``residual = 0``; `sides` are kept for equations between discrete variables.

    An if-equation whose branches are of different form has the residual of each in `branches`, and in `choice`
    what equations of one if-equation share.
    """

    residual: SX
    span: Any
    sides: tuple[SX, SX] | None = None
    branches: tuple[SX, ...] = ()
    choice: tuple[int, ...] = ()


@dataclass(frozen=True)
class Branch:
    """One branch of a when-clause: its conditions (any may fire) and what it does."""

    conditions: tuple[SX, ...]
    assign: tuple[tuple[SX, SX], ...]  # discrete variable, value
    reinit: tuple[tuple[SX, SX], ...]  # state, value
    terminate: bool
    asserts: tuple[Assertion, ...]
    span: Any


@dataclass(frozen=True)
class Assertion:
    """``assert(condition, message)``; a warning goes on."""

    condition: SX
    message: str
    warning: bool
    span: Any


@dataclass
class Equations:
    """All equations of a model, scalar by scalar."""

    continuous: list[Equation] = field(default_factory=list)
    discrete: list[Equation] = field(default_factory=list)
    initial: list[Equation] = field(default_factory=list)
    whens: list[list[Branch]] = field(default_factory=list)
    asserts: list[Assertion] = field(default_factory=list)

    def add(self, scope: ModelScope, equations: list[Equation]) -> None:
        """Add equations; one with a discrete variable alone on a side defines a discrete variable."""
        for equation in equations:
            discrete = equation.sides is not None and any(can_define(scope, s) for s in equation.sides)
            (self.discrete if discrete else self.continuous).append(equation)


def when_targets(flat: Flat) -> set[str]:
    """Names of the variables that when-clauses assign (array names for elements)."""
    found: set[str] = set()

    def visit(node: Any) -> None:
        if isinstance(node, dict):
            if isinstance(node.get("target"), str):
                found.add(node["target"])
                found.add(node["target"].partition("[")[0])
            for child in node.values():
                visit(child)
        elif isinstance(node, list):
            for child in node:
                visit(child)

    visit(flat["when_chains"])
    return found


def collect(scope: ModelScope) -> Equations:
    """Evaluate every equation of the flat class.

    Raises
    ------
    ModelicaError
        For whatever cannot be translated, with its source line.
    """
    flat, out = scope.flat, Equations()
    for name in flat.parts["variables"]:
        if name in scope.declarations.values:
            scope.lookup(name)
    for name, node in flat.parts["variables"].items():
        _binding(scope, out, name, node)
    for residual, span in _instances(scope, flat["equations"], flat["structured_equations"]):
        out.add(scope, _scalar_equations(scope, residual, span))
    for residual, span in _instances(scope, flat["initial_equations"], flat["initial_structured_equations"]):
        out.initial += _scalar_equations(scope, residual, span)
    for node in [*flat["assert_equations"], *flat["initial_assert_equations"]]:
        out.asserts.append(_assertion(scope, node))
    for chain in flat["when_chains"]:
        out.whens.append([_branch(scope, b) for b in [chain["first"], *chain["else_when"]]])
    return out


def _binding(scope: ModelScope, out: Equations, name: str, node: Node) -> None:
    values = scope.declarations.values.get(name)
    if values is None or node["binding"] is None or not algebra.scalars(values):
        return
    first = algebra.scalars(values)[0]
    declared = scope.declared(first) if isinstance(first, SX) else None
    if declared is None or declared.kind not in ("continuous", "discrete"):
        return
    bound = scope.evaluate(node["binding"])
    difference = algebra.elementwise(lambda a, b: algebra.sx(a) - algebra.sx(b), values, bound)
    for symbol, item, residual in zip(
        algebra.scalars(values), _spread(bound, values), algebra.scalars(difference), strict=True
    ):
        equation = Equation(algebra.sx(residual), node["source_span"], (algebra.sx(symbol), algebra.sx(item)))
        (out.continuous if declared.kind == "continuous" else out.discrete).append(equation)


def _spread(value: Value, like: Value) -> tuple[Scalar, ...]:
    items = algebra.scalars(value)
    return items if len(items) == len(algebra.scalars(like)) else items * len(algebra.scalars(like))


def _instances(scope: ModelScope, equations: list[Node], structured: list[Node]) -> Iterator[tuple[Node, Any]]:
    """Yield residual trees; a loop that rumoca kept as a template is unrolled here, with its iterators bound.

    rumoca leaves placeholders (not the equations) inside the range of a template whose interior it has not
    materialised, so those entries must not be read.
    """
    replaced: dict[int, Node] = {}
    for loop in structured:
        if not loop["interiors_materialized"]:
            replaced[loop["first_equation_index"]] = loop
    index = 0
    while index < len(equations):
        loop = replaced.get(index, {})
        if not loop:
            yield equations[index]["residual"], equations[index]["span"]
            index += 1
            continue
        binders = loop["domain"]["binders"]
        ranges = [range(b["lower"], b["upper"] + 1, b["step"]) for b in binders]
        points = list(product(*ranges))
        for point in points:
            yield from _at(scope, binders, point, loop["template"]["body"], equations[index]["span"])
        index += len(points) * loop["equations_per_point"]


def _at(
    scope: ModelScope, binders: list[Node], point: tuple[int, ...], body: list[Node], span: Any
) -> Iterator[tuple[Node, Any]]:
    if not binders:
        for residual in body:
            yield residual, span
        return
    with scope.evaluate.iterator(binders[0]["display_name"], point[0]):
        yield from _at(scope, binders[1:], point[1:], body, span)


def can_define(scope: ModelScope, side: SX) -> bool:
    """Whether an equation with this side defines it: a discrete variable that no when-clause assigns."""
    declared = scope.declared(side) if side.is_symbolic() else None
    if declared is None or declared.kind != "discrete":
        return False
    return not {declared.name, declared.node["name"]} & scope.assigned


def _scalar_equations(scope: ModelScope, node: Node, span: Any) -> list[Equation]:
    ((tag, content),) = node.items()
    if tag == "Binary" and content["op"] == "Sub":
        # Keep the sides: a discrete variable is defined by an equation that has it alone on one side.
        left, right = scope.evaluate(content["lhs"]), scope.evaluate(content["rhs"])
        if isinstance(left, tuple) and not isinstance(right, tuple):
            right = (right,)
        if isinstance(left, tuple) and isinstance(right, tuple):
            pairs = [
                pair
                for a, b in zip(left, right, strict=False)
                if a is not None
                for pair in _pairs(scope, a, b, span)
            ]
        else:
            pairs = _pairs(scope, left, right, span)
        return [Equation(algebra.sx(a) - algebra.sx(b), span, (algebra.sx(a), algebra.sx(b))) for a, b in pairs]
    residuals = algebra.scalars(scope.evaluate(node))
    conditions, leaves = _leaves(scope, node) if tag == "If" else ((), [])
    branches = [algebra.scalars(scope.evaluate(leaf)) for leaf in leaves]
    return [
        Equation(algebra.sx(r), span, branches=tuple(algebra.sx(b[i]) for b in branches), choice=conditions)
        for i, r in enumerate(residuals)
    ]


def _leaves(scope: ModelScope, node: Node) -> tuple[tuple[int, ...], list[Node]]:
    """Conditions and residuals of an if-equation, nested ones included, without what is never chosen."""
    ((tag, content),) = node.items()
    if tag != "If":
        return (), [node]
    conditions: list[int] = []
    leaves: list[Node] = []
    for condition, branch in [*content["branches"], ({"Literal": None}, content["else_branch"])]:
        truth = True if branch is content["else_branch"] else scope.evaluate.scalar(condition)
        if isinstance(truth, SX):
            conditions.append(scope.graph.same(truth))
        elif not truth:
            continue
        inner = _leaves(scope, branch)
        conditions += inner[0]
        leaves += inner[1]
        if not isinstance(truth, SX):
            break
    return tuple(conditions), leaves


def _pairs(scope: ModelScope, left: Value, right: Value, span: Any) -> list[tuple[Scalar, Scalar]]:
    if isinstance(left, dict) and isinstance(right, dict):
        return [pair for name in left for pair in _pairs(scope, left[name], right[name], span)]
    a, b = algebra.scalars(left), algebra.scalars(right)
    if len(a) != len(b):
        if len(b) == 1:
            b = b * len(a)
        elif len(a) == 1:
            a = a * len(b)
        else:
            raise scope.flat.error(f"the sides have {len(a)} and {len(b)} elements", span)
    return list(zip(a, b, strict=True))


def _assertion(scope: ModelScope, node: Node) -> Assertion:
    with scope.evaluate.no_event():
        condition = algebra.sx(scope.evaluate.scalar(node["condition"]))
        level = int(scope.evaluate.scalar(node["level"])) if node.get("level") else 2
    span = node.get("span") or span_of(node["condition"])
    return Assertion(condition, _text(scope, node["message"]), level == 1, span)


def _text(scope: ModelScope, node: Node) -> str:
    """Message text; a value that is only known at run time shows as its name."""
    ((tag, content),) = node.items()
    if tag == "Binary" and content["op"] == "Add":
        return _text(scope, content["lhs"]) + _text(scope, content["rhs"])
    if tag == "StringConversion":
        inner = content["value"]
        ((tag, content),) = inner.items()
        value = scope.evaluate(inner)
        if isinstance(value, SX):
            return str(content["name"]["name"]) if tag == "VarRef" else "(expression)"
        return f"{value:g}" if isinstance(value, float) else str(value)
    return str(scope.evaluate(node))


def _branch(scope: ModelScope, node: Node) -> Branch:
    conditions = tuple(algebra.sx(c) for c in algebra.scalars(scope.evaluate(node["condition"])))
    assign: list[tuple[SX, SX]] = []
    reinit: list[tuple[SX, SX]] = []
    asserts: list[Assertion] = []
    terminate = False
    for statement in node["equations"]:
        ((tag, content),) = statement.items()
        span = content.get("span") if isinstance(content, dict) else node["span"]
        if tag == "Assign":
            assign += _assignments(scope, content)
        elif tag == "Reinit":
            state = _target(scope, content["state"], span)
            reinit.append((state, algebra.sx(scope.evaluate.scalar(content["value"]))))
        elif tag == "Assert":
            asserts.append(_assertion(scope, content))
        elif tag == "Terminate":
            terminate = True
        else:
            raise scope.flat.error(f"{tag} in a when-clause is not supported", span)
    span = node.get("span")
    return Branch(conditions, tuple(assign), tuple(reinit), terminate, tuple(asserts), span)


def _assignments(scope: ModelScope, content: Node) -> list[tuple[SX, SX]]:
    value = scope.evaluate(content["value"])
    name = content["target"]
    whole = scope.declarations.values.get(name)
    if whole is not None:
        return [
            (algebra.sx(t), algebra.sx(v))
            for t, v in zip(algebra.scalars(whole), _spread(value, whole), strict=True)
        ]
    return [(_target(scope, name, content.get("span")), algebra.sx(algebra.scalars(value)[0]))]


def _target(scope: ModelScope, name: Any, span: Any) -> SX:
    declared = scope.declarations.scalars.get(str(name).replace(" ", ""))
    if declared is None or not isinstance(declared.symbol, SX):
        raise scope.flat.error(f"'{name}' cannot be assigned in a when-clause", span)
    return declared.symbol


def keys(symbols: list[SX]) -> set[int]:
    """Keys of several symbols."""
    return {key(s) for s in symbols}
