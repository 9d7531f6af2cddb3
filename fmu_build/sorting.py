"""Matching and sorting into blocks, and the solution of each block."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca

from fmu_build.equations import Equation
from fmu_build.graph import SX, Graph, Substitution, if_else, is_number, key
from fmu_build.index_reduction import Reduced
from fmu_build.loops import Loop, signs
from fmu_build.matching import augment, components
from fmu_build.point import Point
from fmu_build.scope import ModelScope
from fmu_build.syntax import Place

_MOST_CRAMER = 3
MOST_SYMBOLIC = 8  # larger linear remainders are left to the numeric solver, which pivots


@dataclass
class Solution:
    """Unknowns as expressions of t, x, u, p, d, z, pz, m and the iteration variables y.

    Attributes
    ----------
    expression
        Rewrites any expression so that only those are left.
    loops
        Loops left to Newton's method.
    """

    expression: Substitution
    loops: list[Loop] = field(default_factory=list)

    @property
    def iterates(self) -> list[SX]:
        """Iteration variables y of all loops."""
        return [y for loop in self.loops for y in loop.iterates]

    @property
    def residuals(self) -> list[SX]:
        """Residuals that determine them."""
        return [r for loop in self.loops for r in loop.residuals]


def solve(
    scope: ModelScope,
    reduced: Reduced,
    start: Callable[[SX], SX | None],
    point: Point,
    substitute: Callable[[SX], SX],
) -> Solution:
    """Sort the equations and solve them block by block, symbolically where they are linear.

    Parameters
    ----------
    start
        Returns the start value of an unknown if the model gives one. If events choose between several solutions of
        a loop, the initialisation begins with it.
    substitute
        Rewrites expressions to the variables that represent the unknowns.
    """
    graph = scope.graph
    column = {key(s): i for i, s in enumerate(reduced.unknowns)}
    rows = [sorted(column[k] for k in graph.symbols(e.residual) if k in column) for e in reduced.equations]
    row_of: dict[int, int] = {}
    for row, equation in enumerate(reduced.equations):
        if not augment(row, rows.__getitem__, row_of, set()):
            raise scope.flat.error("structurally singular after index reduction", equation.at)
    successors = [[row_of[c] for c in cs if row_of[c] != r] for r, cs in enumerate(rows)]
    column_of = {r: c for c, r in row_of.items()}
    watched = {
        key(r.symbol): [row_of[column[k]] for k in graph.symbols(substitute(r.difference)) if k in column]
        for r in scope.relations
    }
    relays = _relays(scope, reduced, watched, successors)
    solution = Solution(Substitution())
    for block in components(successors):
        equations, unknowns = (
            [reduced.equations[r] for r in block],
            [reduced.unknowns[column_of[r]] for r in block],
        )
        given = _chosen(scope, equations, unknowns, start, point)
        if not given and any(r in relays for r in block):
            given = _given(unknowns, start)
        _solve_block(scope, solution, equations, unknowns, given)
    return solution


def _relays(
    scope: ModelScope,
    reduced: Reduced,
    watched: Mapping[int, Sequence[int]],
    successors: Sequence[Sequence[int]],
) -> set[int]:
    """Equations of a cycle that is closed by relations: the result decides its own mode, as in a relay.

    Parameters
    ----------
    watched
        Equations that determine what a relation depends on, by the relation's symbol.
    """
    switched = [
        {row for k in scope.graph.symbols(e.residual) & watched.keys() for row in watched[k]}
        for e in reduced.equations
    ]
    whole = [sorted({*plain, *more}) for plain, more in zip(successors, switched, strict=True)]
    circles = components(whole) if any(switched) else []
    return {row for circle in circles for row in circle if switched[row] & set(circle)}


def _given(unknowns: list[SX], start: Callable[[SX], SX | None]) -> dict[int, SX]:
    return {key(s): value for s in unknowns if (value := start(s)) is not None}


def _chosen(
    scope: ModelScope,
    equations: list[Equation],
    unknowns: list[SX],
    start: Callable[[SX], SX | None],
    point: Point,
) -> dict[int, SX]:
    """Return the start values that choose between several solutions of a block."""
    residuals = [e.residual for e in equations]
    symbols = frozenset().union(*map(scope.graph.symbols, residuals))
    switches = [r.symbol for r in scope.relations if key(r.symbol) in symbols]
    if len(signs(scope.graph, residuals, unknowns, switches, point) - {0.0}) < 2:
        return {}
    if scope.is_starting(symbols):  # homotopy determines where the initialisation begins
        return {}
    given = _given(unknowns, start)
    if not given:
        names = ", ".join(s.name() for s in unknowns)
        scope.parameters.warnings.append(
            f"{equations[0].at}: the loop of {names} may have several solutions; a start value selects the first"
        )
    return given


def _solve_block(
    scope: ModelScope, solution: Solution, equations: list[Equation], unknowns: list[SX], given: Mapping[int, SX]
) -> None:
    """Solve a block; at the start its unknowns have the given values."""
    graph = scope.graph
    left = {key(s): s for s in unknowns}
    rows = [_Row(graph, e.residual, e.at, left) for e in equations]
    order: list[tuple[SX, SX]] = []
    while True:
        pivot = _pivot(rows)
        if pivot is None:
            break
        row, k = pivot
        symbol, slope = left.pop(k), row.numbers[k]
        rest = Substitution({k: SX(0.0)})(row.residual)
        value = -rest / slope if float(slope) != -1.0 else rest
        order.append((symbol, value))
        replace = Substitution({k: value})
        rows = [
            _Row(graph, replace(r.residual), r.at, left) if k in r.unknowns else r for r in rows if r is not row
        ]
    if left:
        residuals, places = [r.residual for r in rows], [r.at for r in rows]
        for symbol, value in _solve_rest(scope, solution, residuals, list(left.values()), places):
            solution.expression.define(symbol, _started(scope, given, symbol, value))
    for symbol, value in reversed(order):
        solution.expression.define(symbol, _started(scope, given, symbol, solution.expression(value)))


def _started(scope: ModelScope, given: Mapping[int, SX], symbol: SX, value: SX) -> SX:
    return if_else(scope.starting(), given[key(symbol)], value) if key(symbol) in given else value


class _Row:
    """An equation of a block and the unknowns in it."""

    def __init__(self, graph: Graph, residual: SX, at: Place, unknowns: Mapping[int, SX]) -> None:
        self._graph = graph
        self.residual = residual
        self.at = at
        symbols = graph.symbols(residual)
        self.unknowns = [k for k in unknowns if k in symbols]

    @cached_property
    def numbers(self) -> dict[int, SX]:
        """Coefficients of unknowns that are numbers."""
        gradient, stepped = self._graph.gradient(self.residual), self._graph.stepped(self.residual)
        return {
            k: gradient[k] for k in self.unknowns if k in gradient and is_number(gradient[k]) and k not in stepped
        }


def _pivot(rows: Sequence[_Row]) -> tuple[_Row, int] | None:
    """Cheapest equation and unknown whose coefficient is a number: with the fewest other terms (Markowitz)."""
    meets = Counter(k for row in rows for k in row.unknowns)
    best: tuple[_Row, int] | None = None
    least = math.inf
    for row in rows:
        for k in row.unknowns:
            cost = (len(row.unknowns) - 1) * (meets[k] - 1)
            if cost < least and k in row.numbers:
                best, least = (row, k), cost
    return best


def _solve_rest(
    scope: ModelScope, solution: Solution, residuals: list[SX], left: list[SX], places: list[Place]
) -> list[tuple[SX, SX]]:
    """Return the rest of a block, solved; nothing if it is left to Newton's method."""
    graph = scope.graph
    keys = [key(s) for s in left]
    zero = Substitution(dict.fromkeys(keys, SX(0.0)))
    gradients = [graph.gradient(r) for r in residuals]
    linear = not any(graph.stepped(r) & set(keys) for r in residuals) and all(
        not graph.symbols(g[k]) & set(keys) for g in gradients for k in keys if k in g
    )
    if not linear or len(left) > MOST_SYMBOLIC:
        solution.loops.append(Loop(left, [solution.expression(r) for r in residuals], places[0]))
        return []
    a = [[solution.expression(g[k]) if k in g else SX(0.0) for k in keys] for g in gradients]
    b = [-solution.expression(zero(r)) for r in residuals]
    determinant, values = _linear(a, b, refined=any(scope.is_switched(entry) for row in a for entry in row))
    if determinant is not None and is_number(determinant) and float(determinant) == 0.0:
        raise scope.flat.error(
            f"singular: the equations do not determine {', '.join(s.name() for s in left)}", places[0]
        )
    return list(zip(left, values, strict=True))


def linear_solution(a: list[list[SX]], b: list[SX]) -> list[SX]:
    """Solve a small linear system."""
    return _linear(a, b)[1]


def _linear(a: list[list[SX]], b: list[SX], *, refined: bool = False) -> tuple[SX | None, list[SX]]:
    """Solve a small linear system without choosing pivots: coefficients may vanish in some modes of a model.

    Parameters
    ----------
    refined
        Solve again for the remaining error of the right-hand side: in some modes coefficients differ by ten
        orders of magnitude (ideal diodes), and no scaling suits all modes.
    """
    n = len(b)
    if n > _MOST_CRAMER:
        whole, right = ca.vertcat(*[ca.horzcat(*row) for row in a]), ca.vertcat(*b)
        solved = ca.solve(whole, right)
        if refined:
            solved += ca.solve(whole, right - whole @ solved)
        return None, [solved[i] for i in range(n)]
    whole = _determinant(a)
    values = []
    for column in range(n):
        swapped = [[b[i] if j == column else a[i][j] for j in range(n)] for i in range(n)]
        values.append(_determinant(swapped) / whole)
    return whole, values


def _determinant(a: list[list[SX]]) -> SX:
    if len(a) == 1:
        return a[0][0]
    total = SX(0.0)
    for j, entry in enumerate(a[0]):
        minor = [[row[k] for k in range(len(a)) if k != j] for row in a[1:]]
        total = total + (-1) ** j * entry * _determinant(minor)
    return total
