"""Alias elimination: variables that equal another one or its negative."""

from __future__ import annotations

from dataclasses import dataclass, field

from fmu_build import algebra
from fmu_build.equations import Equation
from fmu_build.graph import SX, Graph, Substitution, is_number, key
from fmu_build.scope import ModelScope
from fmu_build.variables import Declared

_SELECT = {"Never": 0, "Avoid": 1, "Default": 3, "Prefer": 4, "Always": 5}


def preference(declared: Declared) -> tuple[int, bool, bool]:
    """How much a variable wants to be a state: StateSelect, then fixed, then an explicit start value."""
    return (_SELECT[declared.node["state_select"]], bool(declared.fixed), declared.has_start)


@dataclass
class Group:
    """Variables that are one: value of a member = sign * value of the representative."""

    representative: Declared
    members: list[tuple[Declared, int]] = field(default_factory=list)


@dataclass
class Aliases:
    """Result of the elimination.

    Attributes
    ----------
    groups
        By the representative's symbol key, for every continuous variable and input.
    of
        Member name -> (representative, sign).
    substitute
        Rewrites expressions to representatives (and their derivatives).
    equations
        What is left, rewritten.
    """

    groups: dict[int, Group]
    of: dict[str, tuple[Declared, int]]
    substitute: Substitution
    equations: list[Equation]


def eliminate(scope: ModelScope, equations: list[Equation]) -> Aliases:
    """Find and use up the equations ``a = b`` and ``a = -b`` between continuous variables and inputs."""
    candidates = {
        key(d.symbol): d
        for d in scope.declarations.scalars.values()
        if d.kind == "continuous" or (d.kind == "input" and d.type == "Real")
        if isinstance(d.symbol, SX)
    }
    parent: dict[int, tuple[int, int]] = {k: (k, 1) for k in candidates}

    def find(k: int) -> tuple[int, int]:
        sign = 1
        while parent[k][0] != k:
            k, s = parent[k]
            sign *= s
        return k, sign

    rest: list[Equation] = []
    for equation in equations:
        pair = _alias(scope.graph, equation.residual, candidates)
        if pair is None:
            rest.append(equation)
            continue
        a, b, sign = pair
        (root_a, sign_a), (root_b, sign_b) = find(a), find(b)
        both_inputs = candidates[root_a].kind == candidates[root_b].kind == "input"
        if root_a == root_b or both_inputs:
            rest.append(equation)  # over- or underdetermined: found and reported by the matching
            continue
        parent[root_b] = (root_a, sign_a * sign * sign_b)
        if _rank(candidates[root_b]) > _rank(candidates[root_a]):
            parent[root_a], parent[root_b] = (root_b, parent[root_b][1]), (root_b, 1)

    groups: dict[int, Group] = {}
    of: dict[str, tuple[Declared, int]] = {}
    substitute = Substitution()
    for k, declared in candidates.items():
        root, sign = find(k)
        representative = candidates[root]
        groups.setdefault(root, Group(representative)).members.append((declared, sign))
        of[declared.name] = (representative, sign)
        if root != k:
            _define(scope, substitute, algebra.sx(declared.symbol), algebra.sx(representative.symbol), sign)
    left = [Equation(substitute(e.residual), e.span) for e in rest]
    return Aliases(groups, of, substitute, left)


def _rank(declared: Declared) -> tuple[object, ...]:
    return (declared.kind == "input", *preference(declared), -declared.name.count("."))


def _alias(graph: Graph, residual: SX, candidates: dict[int, Declared]) -> tuple[int, int, int] | None:
    """Return (a, b, sign) if the residual says a = sign * b."""
    symbols = graph.symbols(residual)
    if len(symbols) != 2 or not symbols <= candidates.keys():
        return None
    gradient = graph.gradient(residual)
    if len(gradient) != 2 or not all(is_number(g) for g in gradient.values()):
        return None
    a, b = gradient
    slope_a, slope_b = float(gradient[a]), float(gradient[b])
    if abs(slope_a) != abs(slope_b):
        return None
    constant = Substitution({a: SX(0.0), b: SX(0.0)})(residual)
    if float(constant) != 0.0:
        return None
    return a, b, 1 if slope_a == -slope_b else -1


def _define(scope: ModelScope, substitute: Substitution, member: SX, root: SX, sign: int) -> None:
    substitute.define(member, sign * root)
    while scope.has_derivative(member):
        if scope.has_input_derivative(root):
            scope.derivative(root)  # raises: derivative of an input
        member, root = scope.derivative_symbol(member), scope.derivative_symbol(root)
        substitute.define(member, sign * root)
