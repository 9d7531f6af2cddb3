"""Start values and initial conditions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu_build import algebra
from fmu_build.aliases import Start, start_of
from fmu_build.equations import Equation
from fmu_build.graph import SX, if_else, key
from fmu_build.scope import ModelScope
from fmu_build.system import System
from fmu_build.variables import Declared

_CONSISTENT = 1e-9


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
    own = {key(s.symbol) for s in states}
    for k, group in aliases.groups.items():
        fixed = [(d, s) for d, s in group.members if d.fixed and d.kind == "continuous"]
        for position, (declared, sign) in enumerate(fixed):
            if position == 0 and k in own:
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
            raise flat.error("initial conditions contradict each other (a fixed start value is one too)", span)
        if free and not abs(value) <= 1e-6:
            raise flat.error("more initial conditions than states (a fixed start value is one too)", span)
    unsure = [states[i].symbol.name() for i, s in enumerate(starts) if not s.fixed and i not in free]
    if unsure:
        scope.parameters.warnings.append(f"start values taken as fixed: {', '.join(unsure)}")
    residuals = [s.symbol - xs for s, xs in zip(states, start_symbols, strict=True)]
    for column, row in zip(sorted(free), sorted(used), strict=True):
        residuals[column] = conditions[row][0]
    return InitialConditions(starts, residuals, not free, [i in free for i in range(len(states))])


def _independent(
    system: System, conditions: list[SX], columns: list[int], at_start: dict[int, SX]
) -> tuple[set[int], set[int]]:
    """States that conditions determine, and the conditions that determine them, by the rank near the start."""
    if not conditions or not columns:
        return set(), set()
    solution, n, m = system.solution, len(conditions), len(columns)
    symbols = [*(system.reduced.states[c].symbol for c in columns), *solution.iterates]
    gradients = [system.scope.graph.gradient(e) for e in (*conditions, *solution.residuals)]
    wanted = [(i, j, g[key(s)]) for i, g in enumerate(gradients) for j, s in enumerate(symbols) if key(s) in g]
    # Slightly off the start, because a coefficient may vanish there by chance.
    near = {k: v + 1e-5 * math.sin(1.0 + i) for i, (k, v) in enumerate(at_start.items())}
    whole = np.zeros((len(gradients), len(symbols)))
    for (i, j, _), value in zip(wanted, system.point.at_start([e for _, _, e in wanted], near), strict=True):
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
        ``pre(v)`` at initialisation where it depends on time.
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
    elif all(scope.is_parameter(k) or k == key(scope.time) for k in symbols):
        out.previous[key(one)] = if_else(scope.init, other, one)
    else:
        raise scope.flat.error(
            f"the initial equation of '{given.declared.name}' depends on more than parameters", equation.at
        )
    return True
