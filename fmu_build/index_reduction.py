"""Index reduction: Pantelides' algorithm and dummy derivatives with static state selection.

C. Pantelides, SIAM J. Sci. Stat. Comput. 9 (1988) 213-231: which equations to differentiate.
S. E. Mattsson, G. Söderlind, SIAM J. Sci. Comput. 14 (1993) 677-692: which derivatives become algebraic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu_build import algebra
from fmu_build.aliases import Aliases, preference
from fmu_build.equations import Equation
from fmu_build.graph import SX, key
from fmu_build.matching import augment
from fmu_build.scope import ModelScope

_UNNAMED = (2, False, False)  # preference of a derivative that the model has no name for
_DEFAULT, _ALWAYS = 3, 5
_MOST = 8  # differentiations of one equation; more means that the system is singular


@dataclass(frozen=True)
class State:
    """A state, the symbol of its derivative, and the symbols of declared variable and order it comes from."""

    symbol: SX
    derivative: SX
    base: SX
    order: int


@dataclass(frozen=True)
class Reduced:
    """A system that can be solved for its unknowns, given the states."""

    equations: list[Equation]
    unknowns: list[SX]
    states: list[State]


class _System:
    def __init__(self, scope: ModelScope, aliases: Aliases) -> None:
        self.scope = scope
        self.graph = scope.graph
        self.equations = list(aliases.equations)
        self.origin = list(range(len(self.equations)))  # leaf -> its undifferentiated equation
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
        """Return the variables whose highest derivative is in an equation, fixed order."""
        found = []
        for k in self.graph.symbols(self.equations[equation].residual):
            place = self.place.get(k)
            if place is not None and place[1] == len(self.chains[place[0]]) - 1:
                found.append(place[0])
        return sorted(found)

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


def reduce(scope: ModelScope, aliases: Aliases, point: Callable[[list[SX]], np.ndarray[Any, Any]]) -> Reduced:
    """Differentiate constraints until the system can be solved, and select states.

    Parameters
    ----------
    point
        Evaluates expressions at a generic point near the start values (for the rank of the constraints).

    Raises
    ------
    ModelicaError
        If the model is structurally singular, needs derivatives of inputs, or needs dynamic state selection.
    """
    system = _System(scope, aliases)
    _check_structure(system)
    n = len(aliases.equations)
    equation_of: dict[int, int] = {}  # variable -> equation matched with its highest derivative
    for original in range(n):
        _match(system, original, equation_of)
    states = _select(system, n, point)
    state_keys = {key(s.symbol) for s in states}
    unknowns = [s for chain in system.chains for s in chain if key(s) not in state_keys]
    if len(unknowns) != len(system.equations):
        raise AssertionError("index reduction lost the balance of equations and unknowns")
    _check_branches(system, unknowns)
    return Reduced(system.equations, unknowns, states)


def _match(system: _System, original: int, equation_of: dict[int, int]) -> None:
    """Match one equation with a highest derivative, differentiating the minimal set where that is impossible."""
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
    """Every variable needs an equation of its own, whatever the order of its derivatives."""
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
        raise system.scope.flat.error(
            f"{len(rows)} equations for {len(system.chains)} unknowns: nothing determines {_some(missing)}", None
        )


def _singular(system: _System, equations: list[int], unknowns: list[SX]) -> None:
    where = [str(system.equations[e].at) for e in equations]
    raise system.scope.flat.error(
        f"structurally singular: the equations at {_some(list(dict.fromkeys(where)))} "
        f"overdetermine {_some([u.name() for u in unknowns]) or 'known values'}",
        system.equations[equations[0]].at,
    )


def _some(names: list[str], most: int = 6) -> str:
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def _check_branches(system: _System, unknowns: list[SX]) -> None:
    """Refuse an if-equation with a branch that leaves an unknown without an equation: its index is another one."""
    column = {key(s): i for i, s in enumerate(unknowns)}

    def incidence(residual: SX) -> list[int]:
        return sorted(column[k] for k in system.graph.symbols(residual) if k in column)

    choices = {e.choice: e for e in system.equations if len(e.branches) > 1}
    for choice, equation in choices.items():
        for branch in range(len(equation.branches)):
            rows = [incidence(e.branches[branch] if e.choice == choice else e.residual) for e in system.equations]
            matched: dict[int, int] = {}
            if not all(augment(row, rows.__getitem__, matched, set()) for row in range(len(rows))):
                raise system.scope.flat.error(
                    "the branches of this if-equation do not determine the same unknowns (their index differs)",
                    equation.at,
                    "let one variable follow a curve in a path parameter, as Drives.Signals.StickSlip does",
                )


def _select(system: _System, n: int, point: Callable[[list[SX]], np.ndarray[Any, Any]]) -> list[State]:
    chains = system.chains
    depth = [system.depth(e) for e in range(n)]
    leaves = [system.leaf(e) for e in range(n)]
    lowered = dict.fromkeys(range(len(chains)), 0)  # variable -> number of its dummy derivatives
    columns = [v for v, chain in enumerate(chains) if len(chain) > 1]
    for level in range(1, max(depth, default=0) + 1):
        rows = [e for e in range(n) if depth[e] >= level]
        columns = [v for v in columns if len(chains[v]) > level and lowered[v] == level - 1]
        columns.sort(key=lambda v: (_preference(system, v, level), -v))
        chosen = _independent(system, [leaves[e] for e in rows], columns, point)
        if len(chosen) < len(rows):
            _singular(system, [leaves[e] for e in rows], [chains[v][0] for v in columns])
        for variable in chosen:
            lowered[variable] += 1
            name = chains[variable][len(chains[variable]) - 1 - level]
            if _preference(system, variable, level)[0] == _ALWAYS:
                declared = system.scope.declared(name)
                raise system.scope.flat.error(
                    f"'{name.name()}' has stateSelect = always, but constraints leave too few states",
                    declared.at if declared else None,
                )
        columns = chosen
    states = []
    for variable, chain in enumerate(chains):
        for order in range(len(chain) - 1 - lowered[variable]):
            states.append(State(chain[order], chain[order + 1], chain[0], order))
    return states


def _preference(system: _System, variable: int, level: int) -> tuple[int, bool, bool]:
    """Preference as a state of the symbol that a dummy derivative at this level would take away."""
    symbol = system.chains[variable][len(system.chains[variable]) - 1 - level]
    declared = system.scope.declared(symbol)
    return _UNNAMED if declared is None else preference(declared)


def _independent(
    system: _System, leaves: list[int], columns: list[int], point: Callable[[list[SX]], np.ndarray[Any, Any]]
) -> list[int]:
    """Greedy choice of columns with full rank: the first in the list that add to the rank.

    By Griewank's lemma the constraints' Jacobian is that of the differentiated equations by the highest
    derivatives.
    """
    if not leaves:
        return []
    highest = [key(system.chains[v][-1]) for v in columns]
    gradients = [system.graph.gradient(system.equations[e].residual) for e in leaves]
    entries = [(i, j, g[h]) for i, g in enumerate(gradients) for j, h in enumerate(highest) if h in g]
    matrix = np.zeros((len(leaves), len(columns)))
    for (i, j, _), value in zip(entries, point([e for _, _, e in entries]), strict=True):
        matrix[i, j] = value
    chosen: list[int] = []
    basis = np.zeros((len(leaves), 0))
    for j in range(len(columns)):
        column = matrix[:, j]
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)
        if np.linalg.norm(rest) > 1e-9 * max(float(np.linalg.norm(column)), 1e-300):
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
            chosen.append(j)
    _check_static(system, entries, set(chosen), columns, leaves)
    return [columns[j] for j in chosen]


def _check_static(
    system: _System, entries: list[tuple[int, int, SX]], chosen: set[int], columns: list[int], leaves: list[int]
) -> None:
    """Refuse a choice that may become singular while the model moves, unless the modeller made it.

    Pivots that cannot vary are eliminated; what is left decides whether the chosen columns stay independent.
    """
    matrix: dict[int, dict[int, SX]] = {}
    for i, j, entry in entries:
        if j in chosen:
            matrix.setdefault(i, {})[j] = entry
    while True:
        pivot = next(
            (
                (i, j)
                for i, row in matrix.items()
                for j, entry in sorted(row.items(), key=lambda e: not e[1].is_constant())
                if not _varies(system, entry)
            ),
            None,
        )
        if pivot is None:
            break
        i, j = pivot
        row = matrix.pop(i)
        for other in matrix.values():
            if j in other:
                factor = other.pop(j) / row[j]
                for k, entry in row.items():
                    if k != j:
                        other[k] = other.get(k, SX(0.0)) - factor * entry
    rows = {i for i, row in matrix.items() if row}
    inside = sorted({columns[j] for i, j, _ in entries if i in rows})
    kept = [columns[j] for i, j, _ in entries if i in rows and j not in chosen]
    if not rows or (kept and all(_wanted(system, v) for v in kept)):
        return
    raise system.scope.flat.error(
        f"the constraint between {_some([system.chains[v][0].name() for v in inside])} needs dynamic state "
        "selection, which is not supported",
        system.equations[leaves[min(rows)]].at,
        "give stateSelect = StateSelect.always (or prefer) to the variables that can stay states",
    )


def _wanted(system: _System, variable: int) -> bool:
    declared = system.scope.declared(system.chains[variable][0])
    return declared is not None and preference(declared)[0] > _DEFAULT


def _varies(system: _System, entry: SX) -> bool:
    known = system.scope
    symbols = system.graph.symbols(entry)
    return any(k in system.place or k == key(known.time) or known.is_event_symbol(k) for k in symbols)
