"""Discrete-time variables: definitions, when-clauses and the actions at an event, as expressions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import casadi as ca

from fmu_build import algebra
from fmu_build.equations import Branch, Equation, Equations, definable
from fmu_build.graph import SX, Substitution, if_else, key
from fmu_build.matching import augment, components
from fmu_build.scope import ModelScope
from fmu_build.start import Explicit
from fmu_build.system import System


@dataclass(frozen=True)
class Discrete:
    """One entry of z."""

    symbol: SX
    previous: SX
    value: SX
    start: SX


@dataclass(frozen=True)
class Events:
    """Actions at an event.

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


def collect(system: System, equations: Equations, explicit: Explicit) -> Events:
    """Turn discrete equations, when-clauses and held values into new values of z and x.

    Parameters
    ----------
    explicit
        Values that initial equations give to discrete variables.
    """
    scope = system.scope
    values = _definitions(scope, equations.discrete)
    clauses = _Clauses(system, equations)
    for chain in equations.whens:
        values |= clauses.chain(chain, values)
    starts = _with_equals(scope, values, explicit.starts)
    if explicit.previous:
        at_start = Substitution(explicit.previous)
        values = {k: at_start(value) for k, value in values.items()}
    for k, value in explicit.values.items():
        if k in values:
            values[k] = if_else(scope.init, value, values[k])
    discrete = _entries(scope, values, starts)
    ordered = _in_order(scope, discrete, system.rewrite)
    after = Substitution({key(d.symbol): d.value for d in ordered})
    next_event = SX(float("inf"))
    for instant in scope.time_events:
        next_event = ca.fmin(next_event, after(system.rewrite(instant)))
    return Events(
        ordered,
        [system.rewrite(clauses.states[key(s.symbol)]) for s in system.reduced.states],
        system.rewrite(clauses.reinit),
        system.rewrite(clauses.terminate),
        next_event,
    )


class _Clauses:
    """Effects on states and on the simulation of the when-clauses met so far."""

    def __init__(self, system: System, equations: Equations) -> None:
        self._system = system
        self._scope = system.scope
        self._asserts = equations.asserts
        invariants = (system.rewrite(e.residual) for e in system.reduced.invariants)
        self._tied = {k for value in invariants for k in system.scope.graph.symbols(value)}
        self.states = {key(s.symbol): s.symbol for s in system.reduced.states}
        self.terminate, self.reinit = SX(0.0), SX(0.0)

    def chain(self, branches: list[Branch], values: Mapping[int, SX]) -> dict[int, SX]:
        """Return the new values of the discrete variables that a when-clause assigns."""
        earlier = SX(0.0)
        assigned: list[tuple[SX, dict[int, SX]]] = []
        symbols: dict[int, SX] = {}
        for branch in branches:
            fires = ca.logic_and(self._scope.fires(branch.conditions), ca.logic_not(earlier))
            earlier = ca.logic_or(earlier, fires)
            self._act(branch, fires)
            assigned.append((fires, {key(target): value for target, value in branch.assign}))
            symbols |= {key(target): target for target, _ in branch.assign}
        out = {}
        for k, symbol in symbols.items():
            if k in values:
                declared = self._scope.declared(symbol)
                raise self._scope.flat.error(
                    f"'{symbol.name()}' is defined more than once", declared.at if declared else None
                )
            out[k] = self._scope.previous_symbol(symbol)
            for fires, pairs in reversed(assigned):
                if k in pairs:
                    out[k] = if_else(fires, pairs[k], out[k])
        return out

    def _act(self, branch: Branch, fires: SX) -> None:
        for one in branch.asserts:  # a violation at an event is known from then on
            self._asserts.append(replace(one, condition=self._scope.held_since(fires, one.condition)))
        if branch.terminate:
            self.terminate = ca.logic_or(self.terminate, fires)
        for variable, value in branch.reinit:
            symbol, sign = self._system.representative(variable)
            if key(symbol) not in self.states:
                fix = "give it stateSelect = StateSelect.always"
                raise self._scope.flat.error("reinit of a variable that is not a state", branch.at, fix)
            if key(symbol) in self._tied:
                raise self._scope.flat.error(
                    f"reinit of '{symbol.name()}', which a constraint ties to other states", branch.at,
                    "describe the position by coordinates that are free, an angle for example",
                )  # fmt: skip
            self.states[key(symbol)] = if_else(fires, sign * value, self.states[key(symbol)])
            self.reinit = ca.logic_or(self.reinit, fires)


def relation_groups(system: System, happenings: Events) -> list[int]:
    """Give each relation a number shared with those on which it depends and those that depend on it."""
    graph, relations = system.scope.graph, system.scope.relations
    nodes = [r.symbol for r in relations] + [d.symbol for d in happenings.discrete] + system.solution.iterates
    place = {key(symbol): i for i, symbol in enumerate(nodes)}
    residuals = (
        SX.zeros(1) if not system.solution.residuals else sum(map(ca.fabs, system.solution.residuals), SX(0.0))
    )
    values = [system.rewrite(r.difference) for r in relations] + [d.value for d in happenings.discrete]
    values += [residuals] * len(system.solution.iterates)
    needs = [sorted(place[k] for k in graph.symbols(value) if k in place) for value in values]
    number = {i: n for n, component in enumerate(components(needs)) for i in component}
    return [number[i] for i in range(len(relations))]


def _definitions(scope: ModelScope, equations: list[Equation]) -> dict[int, SX]:
    """Match each equation between discrete variables with the variable it defines."""
    sides = [definable(scope, equation) for equation in equations]
    column: dict[int, int] = {}
    for row in sides:
        for side in row:
            column.setdefault(key(side), len(column))
    incidence = [[column[key(s)] for s in row] for row in sides]
    row_of: dict[int, int] = {}
    for number, equation in enumerate(equations):
        if not augment(number, incidence.__getitem__, row_of, set()):
            raise scope.flat.error("no discrete variable is left for this equation to define", equation.at)
    out = {}
    for k, c in column.items():
        if c in row_of:
            left, right = equations[row_of[c]].sides or (SX(0.0), SX(0.0))
            out[k] = right if key(left) == k else left
    return out


def _with_equals(scope: ModelScope, values: Mapping[int, SX], starts: Mapping[int, SX]) -> dict[int, SX]:
    """Give what a variable equals, or the pre-value that it equals, also the start value of this variable."""
    out = dict(starts)
    for k, start in starts.items():
        value = values.get(k)
        while value is not None and value.is_symbolic() and key(scope.current_of(value)) not in out:
            other = key(scope.current_of(value))
            out[other] = start
            value = values.get(other)
    return out


def _entries(scope: ModelScope, values: dict[int, SX], starts: dict[int, SX]) -> list[Discrete]:
    out = []
    for declared in scope.declarations.scalars.values():
        if declared.kind != "discrete":
            continue
        symbol = algebra.sx(declared.symbol)
        if key(symbol) not in values:
            raise scope.flat.error(f"nothing determines '{declared.name}'", declared.at)
        start = starts.get(key(symbol), scope.start_of(declared))
        if declared.literals and not declared.has_start and key(symbol) not in starts:
            start = SX(1.0)
        out.append(Discrete(symbol, scope.previous_symbol(symbol), values[key(symbol)], start))
    return out + [Discrete(h.symbol, h.previous, h.value, h.start) for h in scope.held]


def _in_order(scope: ModelScope, discrete: list[Discrete], rewrite: Callable[[SX], SX]) -> list[Discrete]:
    """Let each new value use the new values it depends on; a cycle is left to the event iteration."""
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
