"""Alias elimination: variables that equal another one or its negative."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, field, replace

from fmu_build import algebra
from fmu_build.equations import Equation
from fmu_build.graph import SX, Graph, Substitution, is_number, key
from fmu_build.scope import ModelScope
from fmu_build.variables import Declared

_SELECT = {"never": 0, "avoid": 1, "default": 3, "prefer": 4, "always": 5}


def preference(declared: Declared) -> tuple[int, bool, bool]:
    """Preference of a variable as a state: StateSelect, then fixed, then an explicit start value."""
    return (_SELECT[declared.variable.state_select], bool(declared.fixed), declared.has_start)


@dataclass
class Group:
    """Variables that are equal except for sign: value of a member = sign * value of the representative."""

    representative: Declared
    members: list[tuple[Declared, int]] = field(default_factory=list)


@dataclass
class Aliases:
    """Result of the elimination.

    Attributes
    ----------
    groups
        Groups by the representative's symbol key, for every continuous variable and input.
    of
        Member name -> (representative, sign).
    substitute
        Rewrites expressions to representatives (and their derivatives).
    equations
        The remaining equations, rewritten.
    """

    groups: dict[int, Group]
    of: dict[str, tuple[Declared, int]]
    substitute: Substitution
    equations: list[Equation]


@dataclass(frozen=True)
class Start:
    """Start value of a symbol: an expression of parameters, whether it is fixed or given at all, and by what."""

    value: SX
    fixed: bool
    given: bool
    source: Declared | None = None


def start_of(scope: ModelScope, aliases: Aliases, symbol: SX) -> Start:
    """Start value of a continuous symbol: of its aliases, the fixed one's, or the one written highest up."""
    group = aliases.groups.get(key(symbol))
    if group is None:
        return Start(SX(0.0), False, False)
    declared, sign = min(
        group.members, key=lambda m: (not m[0].fixed, m[0].start_rank, m[0] is not group.representative)
    )
    return Start(sign * scope.start_of(declared), bool(declared.fixed), declared.has_start, declared)


def eliminate(scope: ModelScope, equations: list[Equation]) -> Aliases:
    """Find and remove the equations ``a = b`` and ``a = -b`` between continuous variables and inputs.

    Variables that equal the same derivative (speeds of rigidly coupled parts) are also aliases.
    """
    candidates = {
        key(d.symbol): d
        for d in scope.declarations.scalars.values()
        if d.kind == "continuous" or (d.kind == "input" and d.type == "Real")
        if isinstance(d.symbol, SX)
    }
    union = _Union(candidates)
    while True:
        before = len(equations)
        equations = _merge(scope, equations, candidates, union)
        substitute = _substitution(scope, candidates, union)
        equations = [
            replace(e, residual=substitute(e.residual), branches=tuple(map(substitute, e.branches)))
            for e in equations
        ]
        if len(equations) == before:
            break
    groups: dict[int, Group] = {}
    of: dict[str, tuple[Declared, int]] = {}
    for k, declared in candidates.items():
        root, sign = union.find(k)
        groups.setdefault(root, Group(candidates[root])).members.append((declared, sign))
        of[declared.name] = (candidates[root], sign)
    return Aliases(groups, of, substitute, equations)


class _Union:
    """Disjoint sets of variables with signs."""

    def __init__(self, candidates: dict[int, Declared]) -> None:
        self._candidates = candidates
        self._parent: dict[int, tuple[int, int]] = {k: (k, 1) for k in candidates}
        self._order = {k: -i for i, k in enumerate(candidates)}

    def find(self, k: int) -> tuple[int, int]:
        """Root and sign: value of k = sign * value of the root."""
        sign = 1
        while self._parent[k][0] != k:
            k, s = self._parent[k]
            sign *= s
        return k, sign

    def join(self, a: int, b: int, sign: int) -> bool:
        """Record that a = sign * b; False if that is known already or joins two inputs."""
        (root_a, sign_a), (root_b, sign_b) = self.find(a), self.find(b)
        if root_a == root_b or self._candidates[root_a].kind == self._candidates[root_b].kind == "input":
            return False
        if self._rank(root_b) > self._rank(root_a):
            root_a, root_b = root_b, root_a
        self._parent[root_b] = (root_a, sign_a * sign * sign_b)
        return True

    def _rank(self, k: int) -> tuple[object, ...]:
        """Return the criterion for which of two remains; among equals, the first declared."""
        declared = self._candidates[k]
        return (declared.kind == "input", *preference(declared), -declared.name.count("."), self._order[k])


def _merge(
    scope: ModelScope, equations: list[Equation], candidates: dict[int, Declared], union: _Union
) -> list[Equation]:
    """One pass: joins the aliases it finds and returns the remaining equations."""
    rest = []
    variable_of: dict[int, tuple[int, int]] = {}  # derivative -> (variable, sign) equal to it
    both = candidates.keys() | scope.integral.keys()
    for equation in equations:
        pair = _alias(scope.graph, equation.residual, both)
        if pair is not None:
            a, b, sign = pair
            if a in candidates and b in candidates:
                if union.join(a, b, sign):
                    continue
            elif a in candidates or b in candidates:
                variable, derivative = (a, b) if a in candidates else (b, a)
                if derivative in variable_of:
                    other, other_sign = variable_of[derivative]
                    if union.join(variable, other, sign * other_sign):
                        continue
                else:
                    variable_of[derivative] = (variable, sign)
        # a redundant equation over- or underdetermines the model, which the matching finds and reports
        rest.append(equation)
    return rest


def _substitution(scope: ModelScope, candidates: dict[int, Declared], union: _Union) -> Substitution:
    substitute = Substitution()
    for k, declared in candidates.items():
        root, sign = union.find(k)
        if root != k:
            _define(scope, substitute, algebra.sx(declared.symbol), algebra.sx(candidates[root].symbol), sign)
    return substitute


def _alias(graph: Graph, residual: SX, candidates: Set[int]) -> tuple[int, int, int] | None:
    """Return (a, b, sign) if the residual says a = sign * b."""
    symbols = graph.symbols(residual)
    if len(symbols) != 2 or not symbols <= candidates or graph.stepped(residual):
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
    substitute.define(member, root if sign == 1 else -root)
    while scope.has_derivative(member):
        if scope.has_input_derivative(root):
            scope.derivative(root)  # raises: derivative of an input
        member, root = scope.derivative_symbol(member), scope.derivative_symbol(root)
        substitute.define(member, root if sign == 1 else -root)
