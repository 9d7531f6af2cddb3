"""Discrete-time variables: definitions, when-clauses and what an event does, as expressions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import casadi as ca

from fmu_build import algebra
from fmu_build.equations import Branch, Equation, Equations, can_define
from fmu_build.graph import SX, Substitution, if_else, key
from fmu_build.index_reduction import State
from fmu_build.matching import augment, components
from fmu_build.scope import ModelScope
from fmu_build.start import Explicit, declared_start


@dataclass(frozen=True)
class Discrete:
    """One entry of z."""

    symbol: SX
    previous: SX
    value: SX
    start: SX


@dataclass(frozen=True)
class Events:
    """What happens at an event.

    Attributes
    ----------
    discrete
        The entries of z with their new values.
    states
        New values of the states (those without a reinit keep theirs).
    reinit, terminate, next_event
        Whether a reinit fired, whether the simulation ends, the next time event.
    """

    discrete: list[Discrete]
    states: list[SX]
    reinit: SX
    terminate: SX
    next_event: SX


def collect(
    scope: ModelScope,
    equations: Equations,
    explicit: Explicit,
    states: list[State],
    rewrite: Callable[[SX], SX],
    representative: Callable[[SX], SX],
) -> Events:
    """Turn discrete equations, when-clauses and held values into new values of z and x.

    Parameters
    ----------
    explicit
        What initial equations give to discrete variables.
    rewrite
        Rewrites expressions to what is known at an event.
    representative
        Maps a continuous variable to (the signed) variable that its alias group is kept as.
    """
    values = _definitions(scope, equations.discrete)
    terminate, reinit = SX(0.0), SX(0.0)
    new_state = {key(s.symbol): s.symbol for s in states}
    for chain in equations.whens:
        earlier = SX(0.0)
        assigned: list[tuple[SX, list[tuple[SX, SX]]]] = []
        for branch in chain:
            fires = ca.logic_and(scope.fires(branch.conditions), ca.logic_not(earlier))
            earlier = ca.logic_or(earlier, fires)
            for one in branch.asserts:  # what is violated at an event is known from then on
                held = scope.hold(f"assertion {len(scope.held) + 1}", SX(0.0), SX(0.0))
                violated = if_else(fires, ca.logic_not(one.condition), held.previous)
                scope.held[-1] = replace(held, value=violated)
                equations.asserts.append(replace(one, condition=ca.logic_not(held.symbol)))
            assigned.append((fires, list(branch.assign)))
            if branch.terminate:
                terminate = ca.logic_or(terminate, fires)
            for variable, value in branch.reinit:
                _reinit(scope, new_state, representative(variable), value, fires, branch)
                reinit = ca.logic_or(reinit, fires)
        for symbol in {key(s): s for _, pairs in assigned for s, _ in pairs}.values():
            if key(symbol) in values:
                declared = scope.declared(symbol)
                raise scope.flat.error(
                    f"'{symbol.name()}' is defined more than once", declared.at if declared else None
                )
            out = scope.previous_symbol(symbol)
            for fires, pairs in reversed(assigned):
                for target, value in pairs:
                    if key(target) == key(symbol):
                        out = if_else(fires, value, out)
            values[key(symbol)] = out
    for k, value in explicit.values.items():
        if k in values:
            values[k] = if_else(scope.init, value, values[k])
    discrete = _entries(scope, values, explicit.starts)
    ordered = _in_order(scope, discrete, rewrite)
    after = Substitution({key(d.symbol): d.value for d in ordered})
    next_event = SX(float("inf"))
    for instant in scope.time_events:
        next_event = ca.fmin(next_event, after(rewrite(instant)))
    return Events(
        ordered,
        [rewrite(new_state[key(s.symbol)]) for s in states],
        rewrite(reinit),
        rewrite(terminate),
        next_event,
    )


def _reinit(
    scope: ModelScope, new_state: dict[int, SX], variable: SX, value: SX, fires: SX, branch: Branch
) -> None:
    negative = not variable.is_symbolic()
    symbol = -variable if negative else variable
    if key(symbol) not in new_state:
        raise scope.flat.error(
            "reinit of a variable that is not a state",
            branch.at,
            "give it stateSelect = StateSelect.always",
        )
    new_state[key(symbol)] = if_else(fires, -value if negative else value, new_state[key(symbol)])


def _definitions(scope: ModelScope, equations: list[Equation]) -> dict[int, SX]:
    """Match each equation between discrete variables with the one it defines."""
    sides = [[s for s in equation.sides or () if can_define(scope, s)] for equation in equations]
    column: dict[int, int] = {}
    for row in sides:
        for side in row:
            column.setdefault(key(side), len(column))
    incidence = [[column[key(s)] for s in row] for row in sides]
    row_of: dict[int, int] = {}
    for number, equation in enumerate(equations):
        if not augment(number, incidence.__getitem__, row_of, set()):
            raise scope.flat.error("this equation defines no discrete variable that is still open", equation.at)
    out = {}
    for k, c in column.items():
        if c in row_of:
            left, right = equations[row_of[c]].sides or (SX(0.0), SX(0.0))
            out[k] = right if key(left) == k else left
    return out


def _entries(scope: ModelScope, values: dict[int, SX], starts: dict[int, SX]) -> list[Discrete]:
    out = []
    for declared in scope.declarations.scalars.values():
        if declared.kind != "discrete":
            continue
        symbol = algebra.sx(declared.symbol)
        if key(symbol) not in values:
            raise scope.flat.error(f"nothing determines '{declared.name}'", declared.at)
        start = starts.get(key(symbol), declared_start(scope, declared))
        if declared.literals and not declared.has_start and key(symbol) not in starts:
            start = SX(1.0)
        out.append(Discrete(symbol, scope.previous_symbol(symbol), values[key(symbol)], start))
    return out + [Discrete(h.symbol, h.previous, h.value, h.start) for h in scope.held]


def _in_order(scope: ModelScope, discrete: list[Discrete], rewrite: Callable[[SX], SX]) -> list[Discrete]:
    """Let each new value use the new values it depends on; a circle is left to the event iteration."""
    values = [rewrite(d.value) for d in discrete]
    place = {key(d.symbol): i for i, d in enumerate(discrete)}
    needs = [sorted(place[k] for k in scope.graph.symbols(v) if k in place) for v in values]
    done: dict[int, SX] = {}
    for component in components(needs):
        for i in component:
            known = {k: done[k] for k in scope.graph.symbols(values[i]) if k in done}
            values[i] = Substitution(known)(values[i])
        for i in component:
            done[key(discrete[i].symbol)] = values[i]
    return [Discrete(d.symbol, d.previous, v, d.start) for d, v in zip(discrete, values, strict=True)]
