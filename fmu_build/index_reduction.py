"""Index reduction: Pantelides' algorithm and dummy derivatives with static state selection.

C. Pantelides, SIAM J. Sci. Stat. Comput. 9 (1988) 213-231: which equations to differentiate.
S. E. Mattsson, G. Söderlind, SIAM J. Sci. Comput. 14 (1993) 677-692: which derivatives become algebraic.
U. M. Ascher, H. Chin, S. Reich, Numer. Math. 67 (1994) 131-149: constraints that remain as invariants.

If no choice of states suits all positions (a pendulum in Cartesian coordinates), all variables that a constraint
ties together remain states. The constraint is then an invariant of their motion, and attracts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from fmu_build import algebra
from fmu_build.aliases import Aliases, preference
from fmu_build.equations import Equation
from fmu_build.errors import counted
from fmu_build.graph import SX, key
from fmu_build.matching import augment
from fmu_build.point import Point
from fmu_build.scope import ModelScope

_UNNAMED = (2, False, False)  # preference of a derivative without a name in the model
_DEFAULT, _ALWAYS = 3, 5
_MOST = 8  # differentiations of one equation; more means that the system is singular


@dataclass(frozen=True)
class State:
    """A state, the symbol of its derivative, and the declared variable and order from which it comes."""

    symbol: SX
    derivative: SX
    base: SX
    order: int


@dataclass(frozen=True)
class Reduced:
    """A system that can be solved for its unknowns, given the states.

    Attributes
    ----------
    invariants
        Equations between states that hold at the start and remain true because their derivatives do.
    """

    equations: list[Equation]
    unknowns: list[SX]
    states: list[State]
    invariants: list[Equation]


class _System:
    def __init__(self, scope: ModelScope, aliases: Aliases, point: Point) -> None:
        self.scope = scope
        self._point = point
        self.graph = scope.graph
        self.equations = list(aliases.equations)
        self.origin = list(range(len(self.equations)))  # equation -> its undifferentiated equation
        self.next: dict[int, int] = {}  # equation -> its derivative
        self.chains: list[list[SX]] = []  # each variable and its derivatives in use
        self.place: dict[int, tuple[int, int]] = {}  # symbol -> (variable, order)
        for group in aliases.groups.values():
            if group.representative.kind == "continuous":
                self._add(len(self.chains), algebra.sx(group.representative.symbol))
        for equation in self.equations:
            self._meet(equation.residual)

    def _add(self, variable: int, symbol: SX) -> None:
        if variable == len(self.chains):
            self.chains.append([])
        self.place[key(symbol)] = (variable, len(self.chains[variable]))
        self.chains[variable].append(symbol)

    def extend(self, variable: int, order: int) -> None:
        """Make sure that a variable's derivative of an order exists."""
        while len(self.chains[variable]) <= order:
            self._add(variable, self.scope.derivative_symbol(self.chains[variable][-1]))

    def _meet(self, residual: SX) -> None:
        for k in self.graph.symbols(residual):
            order, symbol = 0, k
            while symbol in self.scope.integral:
                order, symbol = order + 1, key(self.scope.integral[symbol])
            if symbol in self.place:
                self.extend(self.place[symbol][0], order)

    def highest(self, equation: int) -> list[int]:
        """Return the variables whose highest derivative is in an equation, in a fixed order."""
        places = []
        for k in self.graph.symbols(self.equations[equation].residual):
            place = self.place.get(k)
            if place is not None and place[1] == len(self.chains[place[0]]) - 1:
                places.append(place[0])
        return sorted(places)

    def differentiate(self, equation: int) -> int:
        """Append the time derivative of an equation."""
        old = self.equations[equation]
        residual = algebra.sx(self.scope.derivative(old.residual))
        self._meet(residual)
        branches = tuple(algebra.sx(self.scope.derivative(b)) for b in old.branches)
        self.equations.append(Equation(residual, old.at, branches=branches, choice=old.choice))
        self.origin.append(self.origin[equation])
        self.next[equation] = len(self.equations) - 1
        return self.next[equation]

    def leaf(self, equation: int) -> int:
        while equation in self.next:
            equation = self.next[equation]
        return equation

    def depth(self, equation: int) -> int:
        count = 0
        while equation in self.next:
            equation, count = self.next[equation], count + 1
        return count

    def numbers(self, expressions: list[SX]) -> np.ndarray[Any, Any]:
        """Return values at a point near the start, at which the constraints hold if they matter."""
        moves = any(k in self.place for e in expressions for k in self.graph.symbols(e))
        return self._point.generic(expressions, self._consistent if moves else {})

    @cached_property
    def _consistent(self) -> dict[int, float]:
        constraints = [self.equations[e].residual for e in set(self.origin) if e in self.next]
        used = {k for r in constraints for k in self.graph.symbols(r)}
        symbols = [s for chain in self.chains for s in chain if key(s) in used]
        symbols.sort(key=self.preference, reverse=True)
        return self._point.consistent(constraints, symbols)

    def preference(self, symbol: SX) -> tuple[int, bool, bool]:
        """Preference of a symbol as a state."""
        declared = self.scope.declared(symbol)
        return _UNNAMED if declared is None else preference(declared)


def reduce(scope: ModelScope, aliases: Aliases, point: Point) -> Reduced:
    """Differentiate constraints until the system can be solved, and select states.

    Raises
    ------
    ModelicaError
        The model is structurally singular, or needs derivatives of inputs.
    """
    system = _System(scope, aliases, point)
    _check_structure(system)
    n = len(aliases.equations)
    equation_of: dict[int, int] = {}  # variable -> equation matched with its highest derivative
    for original in range(n):
        _match(system, original, equation_of)
    states, held = _select(system, n)
    state_keys = {key(s.symbol) for s in states}
    unknowns = [s for chain in system.chains for s in chain if key(s) not in state_keys]
    equations = [e for i, e in enumerate(system.equations) if i not in held]
    if len(unknowns) != len(equations):
        raise AssertionError("index reduction lost the balance of equations and unknowns")
    _check_branches(system, equations, unknowns)
    return Reduced(equations, unknowns, states, [system.equations[i] for i in sorted(held)])


def _match(system: _System, original: int, equation_of: dict[int, int]) -> None:
    """Match one equation with a highest derivative, differentiating the minimal set if that is impossible."""
    row = system.leaf(original)
    while True:
        seen: set[int] = set()
        if augment(row, system.highest, equation_of, seen):
            return
        coloured = sorted({row, *(equation_of[c] for c in seen)})
        if any(_times(system, e) >= _MOST for e in coloured):
            _singular(system, coloured, [system.chains[c][0] for c in sorted(seen)])
        for variable in sorted(seen):
            system.extend(variable, len(system.chains[variable]))
        successor = {e: system.differentiate(e) for e in coloured}
        for variable in seen:
            equation_of[variable] = successor[equation_of[variable]]
        row = successor[row]


def _times(system: _System, equation: int) -> int:
    return system.depth(system.origin[equation])


def _check_structure(system: _System) -> None:
    """Check that every variable has an equation, whatever the order of its derivatives."""
    rows = [
        sorted({system.place[k][0] for k in system.graph.symbols(e.residual) if k in system.place})
        for e in system.equations
    ]
    matched: dict[int, int] = {}
    for row in range(len(rows)):
        seen: set[int] = set()
        if not augment(row, rows.__getitem__, matched, seen):
            involved = sorted({row, *(matched[c] for c in seen)})
            _singular(system, involved, [system.chains[c][0] for c in sorted(seen)])
    missing = [system.chains[c][0].name() for c in range(len(system.chains)) if c not in matched]
    if missing:
        equations, unknowns = counted(len(rows), "equation"), counted(len(system.chains), "unknown")
        raise system.scope.flat.error(f"{equations} for {unknowns}: nothing determines {_some(missing)}", None)


def _singular(system: _System, equations: list[int], unknowns: list[SX]) -> NoReturn:
    where = [str(system.equations[e].at) for e in equations]
    raise system.scope.flat.error(
        f"structurally singular: the equations at {_some(list(dict.fromkeys(where)))} "
        f"overdetermine {_some([u.name() for u in unknowns]) or 'known values'}",
        system.equations[equations[0]].at,
    )


def _some(names: list[str], most: int = 6) -> str:
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def _check_branches(system: _System, equations: list[Equation], unknowns: list[SX]) -> None:
    """Refuse an if-equation with a branch that leaves an unknown without an equation: its index differs."""
    column = {key(s): i for i, s in enumerate(unknowns)}

    def incidence(residual: SX) -> list[int]:
        return sorted(column[k] for k in system.graph.symbols(residual) if k in column)

    choices = {e.choice: e for e in equations if len(e.branches) > 1}
    for choice, equation in choices.items():
        for branch in range(len(equation.branches)):
            rows = [incidence(e.branches[branch] if e.choice == choice else e.residual) for e in equations]
            matched: dict[int, int] = {}
            if not all(augment(row, rows.__getitem__, matched, set()) for row in range(len(rows))):
                raise system.scope.flat.error(
                    "the branches of this if-equation do not determine the same unknowns (their index differs)",
                    equation.at,
                    "let one variable follow a curve in a path parameter, as Drives.Signals.StickSlip does",
                )


def _select(system: _System, n: int) -> tuple[list[State], set[int]]:
    """Choose the states; also return the equations that become invariants."""
    chains = system.chains
    depth = [system.depth(e) for e in range(n)]
    leaves = [system.leaf(e) for e in range(n)]
    lowered = dict.fromkeys(range(len(chains)), 0)  # variable -> number of its dummy derivatives
    columns = [v for v, chain in enumerate(chains) if len(chain) > 1]
    names = _names(system)
    invariant: dict[int, int] = {}  # equation -> the level at which its constraint chose no dummy derivative
    for level in range(1, max(depth, default=0) + 1):
        rows = [e for e in range(n) if depth[e] >= level and e not in invariant]
        columns = [v for v in columns if len(chains[v]) > level and lowered[v] == level - 1]
        preferences = {v: _preference(system, names, v, level) for v in columns}
        columns.sort(key=lambda v: (preferences[v], -v))
        choice = _independent(system, [leaves[e] for e in rows], columns, preferences)
        if choice is None:
            _singular(system, [leaves[e] for e in rows], [chains[v][0] for v in columns])
        invariant |= dict.fromkeys((rows[i] for i in choice.open), level)
        for variable in choice.columns:
            lowered[variable] += 1
            name = chains[variable][len(chains[variable]) - 1 - level]
            if preferences[variable][0] == _ALWAYS:
                declared = system.scope.declared(name)
                raise system.scope.flat.error(
                    f"'{name.name()}' has stateSelect = always, but constraints leave too few states",
                    declared.at if declared else None,
                )
        columns = choice.columns
    states = []
    for variable, chain in enumerate(chains):
        for order in range(len(chain) - 1 - lowered[variable]):
            states.append(State(chain[order], chain[order + 1], chain[0], order))
    held = set()
    for equation, level in invariant.items():
        for _ in range(depth[equation] - level + 1):
            held.add(equation)
            equation = system.next[equation]
    return states, held


def _names(system: _System) -> dict[int, tuple[int, bool, bool]]:
    """Preference of variables that are not states, by the derivative they equal (``w = der(phi)``)."""
    names: dict[int, tuple[int, bool, bool]] = {}
    for equation in system.equations:
        pair = system.graph.symbols(equation.residual)
        derivatives = [k for k in pair if k in system.scope.integral]
        if len(pair) != 2 or len(derivatives) != 1 or system.graph.stepped(equation.residual):
            continue
        gradient = system.graph.gradient(equation.residual)
        if not all(k in gradient and gradient[k].is_constant() for k in pair):
            continue
        (derivative,) = derivatives
        name = next(k for k in pair if k != derivative)
        declared = system.scope.declarations.by_symbol.get(name)
        if declared is not None and name in system.place and len(system.chains[system.place[name][0]]) == 1:
            names[derivative] = max(preference(declared), names.get(derivative, _UNNAMED))
    return names


def _preference(
    system: _System, names: dict[int, tuple[int, bool, bool]], variable: int, level: int
) -> tuple[int, bool, bool]:
    """Preference as a state of the symbol that a dummy derivative at this level would replace."""
    symbol = system.chains[variable][len(system.chains[variable]) - 1 - level]
    return names.get(key(symbol), system.preference(symbol))


@dataclass(frozen=True)
class _Choice:
    """Variables whose derivatives become algebraic, and the constraints (by position) that choose none."""

    columns: list[int]
    open: list[int]


Entries = dict[int, dict[int, SX]]


def _independent(
    system: _System,
    leaves: list[int],
    columns: list[int],
    preferences: Mapping[int, tuple[int, bool, bool]],
) -> _Choice | None:
    """Choose columns with full rank, in their order, that stay independent while the model moves.

    By Griewank's lemma the constraints' Jacobian is that of the differentiated equations by the highest
    derivatives. None if the rank is too small.
    """
    gradients = [system.graph.gradient(system.equations[e].residual) for e in leaves]
    entries: Entries = {
        i: {v: g[key(system.chains[v][-1])] for v in columns if key(system.chains[v][-1]) in g}
        for i, g in enumerate(gradients)
    }
    chosen = _ranked(system, entries, columns)
    if len(chosen) < len(leaves):
        return None
    fixed, rest = _eliminate(system, entries, chosen)
    kept = {v for row in rest.values() for v in row if v not in chosen}
    if not rest or (kept and all(preferences[v][0] > _DEFAULT for v in kept)):
        return _Choice(chosen, [])  # independent anyway, or chosen by the modeller
    fixed, rest = _eliminate(system, entries, [v for v in columns if preferences[v][0] < _ALWAYS])
    return _Choice(fixed, sorted(rest))


def _ranked(system: _System, entries: Entries, columns: list[int]) -> list[int]:
    """First columns that increase the rank."""
    place = {v: j for j, v in enumerate(columns)}
    cells = [(i, place[v], entry) for i, row in entries.items() for v, entry in row.items()]
    matrix = np.zeros((len(entries), len(columns)))
    for (i, j, _), value in zip(cells, system.numbers([e for _, _, e in cells]), strict=True):
        matrix[i, j] = value
    chosen: list[int] = []
    basis = np.zeros((len(entries), 0))
    for j, variable in enumerate(columns):
        column = matrix[:, j]
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)
        if np.linalg.norm(rest) > 1e-9 * max(float(np.linalg.norm(column)), 1e-300):
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
            chosen.append(variable)
    return chosen


def _eliminate(system: _System, entries: Entries, columns: list[int]) -> tuple[list[int], Entries]:
    """Eliminate with constant pivots in some columns; return these columns and the rest of the other rows."""
    rows = {i: dict(row) for i, row in entries.items()}
    holders: dict[int, set[int]] = {}
    for i, row in rows.items():
        for v in row:
            holders.setdefault(v, set()).add(i)
    used: dict[int, None] = {}

    def usable(entry: SX, numbers: bool) -> bool:
        return entry.is_constant() if numbers else not _varies(system, entry)

    for numbers in (True, False):  # numbers before parameters, which may become zero
        waiting, progress = columns, True
        while progress:
            progress, tried, waiting = False, waiting, []
            for v in tried:
                pivots = [i for i in holders.get(v, ()) if usable(rows[i][v], numbers)] if v not in used else []
                if not pivots:
                    waiting.append(v)
                    continue
                _use(rows, holders, min(pivots, key=lambda i: (len(rows[i]), i)), v)
                used[v] = None
                progress = True
    return list(used), {i: row for i, row in rows.items() if row}


def _use(rows: Entries, holders: dict[int, set[int]], i: int, v: int) -> None:
    """Eliminate column v by row i."""
    pivot = rows.pop(i)
    for k in pivot:
        holders[k].discard(i)
    for other in sorted(holders.pop(v)):
        row = rows[other]
        factor = row.pop(v) / pivot[v]
        for k in (k for k in pivot if k != v):
            row[k] = row.get(k, SX(0.0)) - factor * pivot[k]
            holders[k].add(other)
            if row[k].is_constant() and float(row[k]) == 0.0:
                del row[k]
                holders[k].discard(other)


def _varies(system: _System, entry: SX) -> bool:
    known = system.scope
    symbols = system.graph.symbols(entry)
    return any(k in system.place or k == key(known.time) or known.is_event_symbol(k) for k in symbols)
