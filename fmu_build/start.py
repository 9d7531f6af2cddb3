"""Start values and initial conditions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu_build import algebra
from fmu_build.aliases import Start, start_of
from fmu_build.equations import Equation
from fmu_build.graph import SX, if_else, key
from fmu_build.scope import ModelScope, without_value
from fmu_build.syntax import Place
from fmu_build.system import System
from fmu_build.variables import Declared

_CONSISTENT = 1e-9
_NO_RANK = 2_000_000  # of the start value of a derivative without a name


@dataclass
class InitialConditions:
    """Start values of the states and the equations that must hold at the start.

    Attributes
    ----------
    starts
        Start value of each state.
    residuals
        One residual per state, in order; if the start value of a state is its initial condition, its residual is
        ``x - xs``.
    explicit
        Whether all residuals are of that form.
    """

    starts: list[Start]
    residuals: list[SX]
    explicit: bool
    free: list[bool]


def initial_conditions(system: System, equations: list[Equation], start_symbols: list[SX]) -> InitialConditions:
    """Determine the initial condition of each state.

    A fixed start value and every initial equation is a condition; states that no condition determines keep their
    start value (with a warning). Redundant conditions are checked and left out.

    Parameters
    ----------
    start_symbols
        Symbols of the start values ``xs``, for the residuals.
    """
    scope, aliases, states = system.scope, system.aliases, system.reduced.states
    flat, rewrite, evaluate = scope.flat, system.rewrite, system.point.at_start
    starts = [start_of(scope, aliases, s.symbol) for s in states]
    conditions = [(rewrite(e.residual), e.at) for e in equations]
    state_keys = {key(s.symbol) for s in states}
    for k, group in aliases.groups.items():
        fixed = [(d, s) for d, s in group.members if d.fixed and d.kind == "continuous"]
        for position, (declared, sign) in enumerate(fixed):
            if position == 0 and k in state_keys:
                continue
            value = rewrite(sign * algebra.sx(group.representative.symbol)) - scope.start_of(declared)
            conditions.append((value, declared.at))
    at_start = {key(s.symbol): start.value for s, start in zip(states, starts, strict=True)}
    columns = [i for i, start in enumerate(starts) if not start.fixed]
    columns.sort(key=lambda i: (starts[i].given, -states[i].order, i))
    free, used = _independent(system, [c for c, _ in conditions], columns, at_start)
    for row, (residual, span) in enumerate(conditions):
        if row in used:
            continue
        (value,) = evaluate([residual], at_start)
        if not free and not abs(value) <= _CONSISTENT * 10:
            raise flat.error("initial conditions contradict each other (a fixed start value is also one)", span)
        if free and not abs(value) <= 1e-6:
            raise flat.error("more initial conditions than states (a fixed start value is also one)", span)
    written = _Written(system, starts, at_start)
    needed = [conditions[row] for row in sorted(used)]
    conditions, free, used = written.chosen(needed, columns, free)
    scope.parameters.warnings += written.warnings(free)
    residuals = [s.symbol - xs for s, xs in zip(states, start_symbols, strict=True)]
    for column, row in zip(sorted(free), sorted(used), strict=True):
        residuals[column] = conditions[row][0]
    return InitialConditions(starts, residuals, not free, [i in free for i in range(len(states))])


class _Written:
    """Start values in the source that are not fixed, as conditions for states that no other condition determines.

    As section 8.6.3 of the specification recommends, a value that is written at a higher level of the model wins;
    at the same level, that of a state does.
    """

    def __init__(self, system: System, starts: list[Start], at_start: dict[int, SX]) -> None:
        self._system = system
        self._starts = starts
        self._at_start = at_start
        self._others = self._not_states()
        self._used: set[int] = set()  # positions in `_others`

    def _not_states(self) -> list[tuple[Declared, SX]]:
        """Return the written start values of explicit variables, and how far these are from them."""
        system, scope = self._system, self._system.scope
        states = {key(s.symbol) for s in system.reduced.states}
        iterates = {key(y) for y in system.solution.iterates}
        conditions = []
        for k, group in system.aliases.groups.items():
            start = start_of(scope, system.aliases, algebra.sx(group.representative.symbol))
            declared = start.source
            if k in states or k in iterates or declared is None or start.fixed or not declared.is_start_written:
                continue
            value = system.rewrite(algebra.sx(group.representative.symbol))
            symbols = scope.graph.symbols(value)
            if not symbols & iterates and not any(map(scope.is_event_symbol, symbols)):
                _, sign = system.aliases.of[declared.name]
                conditions.append((declared, sign * (value - start.value)))
        return conditions

    def chosen(
        self, conditions: list[tuple[SX, Place]], columns: list[int], free: set[int]
    ) -> tuple[list[tuple[SX, Place]], set[int], set[int]]:
        """Add the start values of other variables that precede those of states.

        Returns the conditions, the states that they determine, and the positions of the conditions to use.
        """
        states, starts = self._system.reduced.states, self._starts
        open_ = [i for i in columns if i not in free]
        worst = max((self._rank(i) for i in open_), default=-1)
        others = [n for n, (declared, _) in enumerate(self._others) if declared.start_rank < worst]
        if not others:
            return conditions, free, set(range(len(conditions)))
        ranked = sorted(
            [(self._rank(i), 0, position) for position, i in enumerate(open_)]
            + [(self._others[n][0].start_rank, 1, n) for n in others]
        )
        first = ranked
        for near in (False, True):  # what says nothing at the start is no condition: a flow through a shut valve
            ranked = [r for r in ranked if r in first] + [r for r in ranked if r not in first and not r[1]]
            rows = [c for c, _ in conditions]
            for _, other, n in ranked:
                rows.append(self._others[n][1] if other else states[open_[n]].symbol - starts[open_[n]].value)
            _, independent = _independent(self._system, rows, columns, self._at_start, near=near)
            taken = [ranked[row - len(conditions)] for row in sorted(independent) if row >= len(conditions)]
            first = [r for r in ranked if r in taken or (r[1] and r[0] == 0)]
        kept = {open_[n] for _, other, n in taken if not other}
        self._used = {n for _, other, n in taken if other}
        out = [*conditions, *((self._others[n][1], self._others[n][0].at) for n in sorted(self._used))]
        return out, set(columns) - kept, set(range(len(out)))

    def _rank(self, state: int) -> int:
        source = self._starts[state].source
        return _NO_RANK if source is None else source.start_rank

    def warnings(self, free: set[int]) -> Iterator[str]:
        """Yield a line on the start values taken as fixed, and one for each that contradicts them."""
        states = zip(self._system.reduced.states, self._starts, strict=True)
        open_ = [(s.symbol, start) for i, (s, start) in enumerate(states) if not start.fixed and i not in free]
        scope = self._system.scope
        for declared in filter(None, (scope.declared(symbol) for symbol, _ in open_)):
            if declared.variable.name in scope.open_parameters:
                raise without_value(scope.flat, declared.name, declared.at)
        taken = [self._shown(symbol.name(), start.source) for symbol, start in open_]
        taken += [self._others[n][0].name for n in sorted(self._used)]
        if taken:
            yield f"start values taken as fixed: {', '.join(taken)}"
        for i, (s, start) in enumerate(zip(self._system.reduced.states, self._starts, strict=True)):
            if start.source is not None and not start.fixed and i not in free:
                yield from self._contradictions(s.symbol, start)
        if free:
            return
        mine = [(declared, off) for declared, off in self._others if declared.start_rank == 0]
        far = self._system.point.at_start([off for _, off in mine], self._at_start)
        for (declared, _), distance in zip(mine, far, strict=True):
            if abs(distance) > _CONSISTENT * 10:
                written = self._system.point.number(self._system.scope.start_of(declared))
                yield (
                    f"{declared.at}: the start value {written:.6g} of '{declared.name}' is not used: "
                    f"{written + distance:.6g} follows from the states"
                )

    @staticmethod
    def _shown(name: str, source: Declared | None) -> str:
        return (
            name
            if source is None or source.name == name or not source.is_start_written
            else f"{name} (that of {source.name})"
        )

    def _contradictions(self, state: SX, start: Start) -> Iterator[str]:
        """Yield a line for each alias of a state with another start value of the same level."""
        scope, point, chosen = self._system.scope, self._system.point, start.source
        assert chosen is not None
        value = point.number(start.value)
        for declared, sign in self._system.aliases.groups[key(state)].members:
            if declared is chosen or declared.start_rank != chosen.start_rank or not declared.is_start_written:
                continue
            other = sign * point.number(scope.start_of(declared))
            if abs(other - value) > _CONSISTENT * max(1.0, abs(value)):
                yield (
                    f"{declared.at}: the start value of '{declared.name}' contradicts that of '{chosen.name}', "
                    "which is used"
                )


def _independent(
    system: System, conditions: list[SX], columns: list[int], at_start: dict[int, SX], *, near: bool = True
) -> tuple[set[int], set[int]]:
    """States that conditions determine, and the conditions that determine them, by the rank at the start."""
    if not conditions or not columns:
        return set(), set()
    solution, n, m = system.solution, len(conditions), len(columns)
    symbols = [*(system.reduced.states[c].symbol for c in columns), *solution.iterates]
    gradients = [system.scope.graph.gradient(e) for e in (*conditions, *solution.residuals)]
    wanted = [(i, j, g[key(s)]) for i, g in enumerate(gradients) for j, s in enumerate(symbols) if key(s) in g]
    # Slightly off the start, because a coefficient may vanish there by chance.
    off = 1e-5 if near else 0.0
    point = {k: v + off * math.sin(1.0 + i) for i, (k, v) in enumerate(at_start.items())}
    whole = np.zeros((len(gradients), len(symbols)))
    for (i, j, _), value in zip(wanted, system.point.at_start([e for _, _, e in wanted], point), strict=True):
        whole[i, j] = value
    if not np.isfinite(whole).all():
        whole = np.nan_to_num(whole, posinf=0.0, neginf=0.0)
    # the unknowns of loops follow the states
    matrix = whole[:n, :m] - whole[:n, m:] @ np.linalg.pinv(whole[n:, m:]) @ whole[n:, :m]
    scale = np.abs(matrix).max(axis=1)
    matrix = matrix / np.where(scale > 0.0, scale, 1.0)[:, None]
    rows = _greedy(matrix.T)
    chosen = _greedy(matrix[rows])
    return {columns[j] for j in chosen}, set(rows)


def _greedy(matrix: np.ndarray[Any, Any]) -> list[int]:
    """First columns of a matrix that are linearly independent."""
    basis = np.zeros((matrix.shape[0], 0))
    chosen = []
    for j in range(matrix.shape[1]):
        rest = matrix[:, j] - basis @ (basis.T @ matrix[:, j])
        rest -= basis @ (basis.T @ rest)
        if np.linalg.norm(rest) > 1e-9:
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
            chosen.append(j)
    return chosen


@dataclass
class Explicit:
    """Initial equations that give a value to a single variable, by that variable's symbol.

    Attributes
    ----------
    starts
        ``pre(v)`` of discrete variables (from parameters).
    previous
        ``pre(v)`` at initialisation where it depends on time or on other pre-values.
    values
        Discrete variables at initialisation.
    parameters
        Parameters with fixed=false.
    rest
        The other equations.
    """

    starts: dict[int, SX]
    previous: dict[int, SX]
    values: dict[int, SX]
    parameters: dict[int, SX]
    rest: list[Equation]


def split_initial(scope: ModelScope, equations: list[Equation]) -> Explicit:
    """Split initial equations: those of discrete variables and of parameters with fixed=false, and the rest."""
    out = Explicit({}, {}, {}, {}, [])
    for equation in equations:
        if not _explicit(scope, equation, out):
            out.rest.append(equation)
    return out


def _explicit(scope: ModelScope, equation: Equation, out: Explicit) -> bool:
    if equation.sides is None:
        return False
    for one, other in (equation.sides, equation.sides[::-1]):
        declared = scope.declared(scope.current_of(one)) if one.is_symbolic() else None
        unbound = declared is not None and any(declared is d for d in scope.parameters.from_initial)
        if declared is not None and (declared.kind == "discrete" or unbound):
            return _use(scope, out, _Given(declared, one, other, unbound), equation)
    return False


@dataclass(frozen=True)
class _Given:
    """A side of an initial equation that is a variable alone, or its pre-value, and the other side."""

    declared: Declared
    side: SX
    value: SX
    unbound: bool


def _use(scope: ModelScope, out: Explicit, given: _Given, equation: Equation) -> bool:
    """Record the value given by an initial equation; False if the other equations are to determine it."""
    one, other, symbol = given.side, given.value, scope.current_of(given.side)
    symbols = scope.graph.symbols(other)
    known = all(map(scope.is_parameter, symbols))
    if given.unbound:
        if known:
            out.parameters[key(symbol)] = other
        return known
    if key(symbol) == key(one):
        out.values[key(symbol)] = other
        if known:
            out.starts.setdefault(key(symbol), other)
    elif known:
        out.starts[key(symbol)] = other
    elif all(scope.is_parameter(k) or k == key(scope.time) or scope.is_previous(k) for k in symbols):
        out.previous[key(one)] = if_else(scope.init, other, one)
    else:
        raise scope.flat.error(
            f"the initial equation of '{given.declared.name}' depends on more than parameters", equation.at
        )
    return True
