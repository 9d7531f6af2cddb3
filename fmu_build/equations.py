"""The equations of a flat model as scalar residuals, discrete definitions, when-clauses and assertions."""

from __future__ import annotations

from dataclasses import dataclass, field

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value
from fmu_build.flat_model import Equation as Flat
from fmu_build.flat_model import Variable
from fmu_build.graph import SX, key, minus
from fmu_build.messages import Message, message
from fmu_build.scope import ModelScope
from fmu_build.syntax import (
    Assert,
    Assign,
    AssignMany,
    Binary,
    Expression,
    If,
    Literal,
    Place,
    Reference,
    Reinit,
    Statement,
    Terminate,
)


@dataclass(frozen=True)
class Equation:
    """``residual = 0``; `sides` are kept for equations between discrete variables.

    An if-equation whose branches have different forms has the residuals of its branches in `branches`; `choice` is
    the same for all equations of one if-equation. `target` is the variable that an algorithm assigns.
    """

    residual: SX
    at: Place
    sides: tuple[SX, SX] | None = None
    branches: tuple[SX, ...] = ()
    choice: tuple[int, ...] = ()
    target: SX | None = None


@dataclass(frozen=True)
class Branch:
    """One branch of a when-clause: its conditions (any may fire) and its actions."""

    conditions: tuple[SX, ...]
    assign: tuple[tuple[SX, SX], ...]  # discrete variable, value
    reinit: tuple[tuple[SX, SX], ...]  # state, value
    terminate: bool
    asserts: tuple[Assertion, ...]
    at: Place


@dataclass(frozen=True)
class Assertion:
    """``assert(condition, message)``; after a warning the simulation continues."""

    condition: SX
    message: Message
    warning: bool
    at: Place


@dataclass
class Equations:
    """All equations of a model, scalar by scalar."""

    continuous: list[Equation] = field(default_factory=list)
    discrete: list[Equation] = field(default_factory=list)
    initial: list[Equation] = field(default_factory=list)
    whens: list[list[Branch]] = field(default_factory=list)
    asserts: list[Assertion] = field(default_factory=list)

    def add(self, scope: ModelScope, equations: list[Equation]) -> None:
        """Add equations; one with a discrete variable alone on a side defines that variable."""
        for equation in equations:
            (self.discrete if definable(scope, equation) else self.continuous).append(equation)


def collect(scope: ModelScope) -> Equations:
    """Evaluate every equation of the flat model.

    Raises
    ------
    ModelicaError
        A construct cannot be translated; the message names its source line.
    """
    flat, out = scope.flat, Equations()
    for name in flat.variables:
        if name in scope.declarations.values:
            scope.lookup(name)
    for variable in flat.variables.values():
        _binding(scope, out, variable)
    for equation in flat.equations:
        out.add(scope, _scalar_equations(scope, equation))
    for equation in flat.initial_equations:
        out.initial += _scalar_equations(scope, equation)
    for node in flat.asserts:
        out.asserts.append(_assertion(scope, node))
    for when in flat.whens:
        out.whens.append([_branch(scope, c, s, when.at) for c, s in when.branches])
    return out


def _binding(scope: ModelScope, out: Equations, variable: Variable) -> None:
    values = scope.declarations.values.get(variable.name)
    if values is None or variable.binding is None or not algebra.scalars(values):
        return
    first = algebra.scalars(values)[0]
    declared = scope.declared(first) if isinstance(first, SX) else None
    if declared is None or declared.kind not in ("continuous", "discrete"):
        return
    bound = scope.evaluate(variable.binding)
    if isinstance(bound, tuple) and bound:
        bound = bound[0]  # a function with several outputs stands for its first
    if isinstance(bound, Array) and (not isinstance(values, Array) or bound.shape != values.shape):
        what = f"'{variable.name}' has size {list(variable.shape)}, its value has size {list(bound.shape)}"
        raise scope.flat.error(what, variable.at)
    for symbol, item in zip(algebra.scalars(values), _spread(bound, values), strict=True):
        sides = (algebra.sx(symbol), algebra.sx(item))
        equation = Equation(sides[0] - sides[1], variable.at, sides)
        (out.continuous if declared.kind == "continuous" else out.discrete).append(equation)


def _spread(value: Value, like: Value) -> tuple[Scalar, ...]:
    items = algebra.scalars(value)
    return items if len(items) == len(algebra.scalars(like)) else items * len(algebra.scalars(like))


def definable(scope: ModelScope, equation: Equation) -> list[SX]:
    """Discrete variables that an equation may define: sides that no when-clause or algorithm assigns."""
    sides = []
    for side in equation.sides or ():
        declared = scope.declared(side) if side.is_symbolic() else None
        if declared is None or declared.kind != "discrete":
            continue
        is_target = equation.target is not None and key(side) == key(equation.target)
        if is_target or not {declared.name, declared.variable.name} & (scope.assigned | scope.in_algorithms):
            sides.append(side)
    return sides


def _scalar_equations(scope: ModelScope, equation: Flat) -> list[Equation]:
    at = equation.at
    if isinstance(equation.left, If) and _is_zero(equation.right):
        return _if_equations(scope, equation.left)
    # Keep the sides: a discrete variable is defined by an equation that has it alone on one side.
    left, right = _sides(scope, equation)
    if isinstance(left, tuple) and not isinstance(right, tuple):
        right = (right,)
    elif isinstance(right, tuple) and not isinstance(left, tuple):
        left = (left,)
    if isinstance(left, tuple) and isinstance(right, tuple):
        pairs = [
            pair for a, b in zip(left, right, strict=False) if a is not None for pair in _pairs(scope, a, b, at)
        ]
    else:
        pairs = _pairs(scope, left, right, at)
    sides = [(algebra.sx(a), algebra.sx(b)) for a, b in pairs]
    return [Equation(minus(a, b), at, (a, b)) for a, b in sides]


def _is_zero(node: Expression) -> bool:
    return isinstance(node, Literal) and node.value == 0


def _sides(scope: ModelScope, equation: Flat) -> tuple[Value, Value]:
    return scope.evaluate(equation.left), scope.evaluate(equation.right)


def _if_equations(scope: ModelScope, node: If) -> list[Equation]:
    residuals = algebra.scalars(scope.evaluate(node))
    conditions, leaves = _leaves(scope, node)
    branches = [algebra.scalars(scope.evaluate(leaf)) for leaf in leaves]
    return [
        Equation(algebra.sx(r), node.at, branches=tuple(algebra.sx(b[i]) for b in branches), choice=conditions)
        for i, r in enumerate(residuals)
    ]


def _leaves(scope: ModelScope, node: Expression) -> tuple[tuple[int, ...], list[Expression]]:
    """Conditions and residuals of an if-equation and those nested in it, without those never chosen."""
    if isinstance(node, Binary) and isinstance(node.left, If) and node.operator == "-":
        return _leaves(scope, node.left) if _is_zero(node.right) else ((), [node])
    if not isinstance(node, If):
        return (), [node]
    conditions: list[int] = []
    leaves: list[Expression] = []
    branches: list[tuple[Expression | None, Expression]] = [*node.branches, (None, node.otherwise)]
    for condition, branch in branches:
        truth = True if condition is None else scope.evaluate.scalar(condition)
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


def _pairs(scope: ModelScope, left: Value, right: Value, at: Place) -> list[tuple[Scalar, Scalar]]:
    if isinstance(left, dict) and isinstance(right, dict):
        return [pair for name in left for pair in _pairs(scope, left[name], right[name], at)]
    a, b = algebra.scalars(left), algebra.scalars(right)
    if len(a) != len(b):
        if len(b) == 1:
            b = b * len(a)
        elif len(a) == 1:
            a = a * len(b)
        else:
            raise scope.flat.error(f"the sides have {len(a)} and {len(b)} elements", at)
    return list(zip(a, b, strict=True))


def _assertion(scope: ModelScope, node: Assert) -> Assertion:
    with scope.evaluate.no_event():
        condition = algebra.sx(scope.evaluate.scalar(node.condition))
        text = message(scope.evaluate, node.message, scope.declarations)
    return Assertion(condition, text, node.warning, node.at)


def _branch(scope: ModelScope, test: Expression, statements: tuple[Statement, ...], at: Place) -> Branch:
    conditions = tuple(algebra.sx(c) for c in algebra.scalars(scope.evaluate(test)))
    assign: list[tuple[SX, SX]] = []
    reinit: list[tuple[SX, SX]] = []
    asserts: list[Assertion] = []
    terminate = False
    for statement in statements:
        match statement:
            case Assign():
                assign += _assignments(scope, statement.target, scope.evaluate(statement.value))
            case AssignMany():
                result = scope.evaluate(statement.call)
                results = result if isinstance(result, tuple) else (result,)
                for target, value in zip(statement.targets, results, strict=False):
                    if target is not None:
                        assign += _assignments(scope, target, value)
            case Reinit():
                ((state, value),) = _assignments(scope, statement.state, scope.evaluate(statement.value))
                reinit.append((state, value))
            case Assert():
                asserts.append(_assertion(scope, statement))
            case Terminate():
                terminate = True
            case _:
                raise scope.flat.error("this is not supported in a when-clause", statement.at)
    return Branch(conditions, tuple(assign), tuple(reinit), terminate, tuple(asserts), at)


def _assignments(scope: ModelScope, target: Reference, value: Value) -> list[tuple[SX, SX]]:
    whole = scope.evaluate(target)
    items = algebra.scalars(whole)
    if any(not isinstance(i, SX) or scope.declared(i) is None for i in items):
        raise scope.flat.error(f"'{target.name}' cannot be assigned in a when-clause", target.at)
    return [(algebra.sx(t), algebra.sx(v)) for t, v in zip(items, _spread(value, whole), strict=True)]


def keys(symbols: list[SX]) -> set[int]:
    """Keys of several symbols."""
    return {key(s) for s in symbols}
