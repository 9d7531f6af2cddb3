"""Meaning of names and operators in a model's equations: variables, derivatives, pre-values, events."""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from fmu_build import algebra
from fmu_build.algebra import Scalar, Value
from fmu_build.errors import InputDerivativeError, ModelicaError
from fmu_build.expressions import Evaluator
from fmu_build.flat_model import FlatModel
from fmu_build.functions import Functions
from fmu_build.graph import SX, Graph, Substitution, if_else, key, plus, times
from fmu_build.model import derivative_name
from fmu_build.syntax import Assign, AssignMany, Place, WhenStatement, walk
from fmu_build.variables import Declarations, Declared, Parameters


@dataclass(frozen=True)
class Relation:
    """A relation outside noEvent: true iff ``difference > 0`` (``>= 0`` if inclusive)."""

    symbol: SX
    difference: SX
    inclusive: bool


@dataclass(frozen=True)
class Held:
    """An internal discrete variable: its new value at an event, and its start value."""

    symbol: SX
    previous: SX
    value: SX
    start: SX


@dataclass(frozen=True)
class Delayed:
    """``symbol`` is the value that an expression had a while ago."""

    symbol: SX
    value: SX
    time: SX


@dataclass(frozen=True)
class Outlet:
    """One end of a transport: what the runtime gives between events, so that values and derivatives are right.

    Attributes
    ----------
    value, slope, place
        What leaves while the medium is at `place`, and its derivative by the place.
    jump
        The place at which the next jump leaves.
    """

    value: SX
    slope: SX
    place: SX
    jump: SX


@dataclass(frozen=True)
class Transport:
    """A ``spatialDistribution()``: what enters at both ends, how far it has moved, and both outlets.

    ``points`` and ``profile`` are where and what it contains at the start.
    """

    inlets: tuple[SX, SX]
    moved: SX
    outlets: tuple[Outlet, Outlet]
    points: tuple[float, ...]
    profile: tuple[SX, ...]


def without_value(flat: FlatModel, name: str, at: Place) -> ModelicaError:
    """Return the error of a parameter with fixed = false to which nothing gives a value."""
    what = f"nothing gives '{name}' (fixed = false) a value"
    fix = "give it an initial equation that has it alone on one side"
    return flat.error(what, at, fix)


class ModelScope:
    """Scope of equations; collects what the expressions need (derivatives, relations, held values)."""

    def __init__(
        self, flat: FlatModel, graph: Graph, structural: set[str], open_parameters: Set[str] = frozenset()
    ) -> None:
        self.flat = flat
        self.open_parameters = open_parameters  # with fixed = false, as variables that a fixed start may determine
        self.graph = graph
        self.assigned = when_targets(flat.whens)  # variables that when-equations assign
        self.in_algorithms = targets(s for a in flat.algorithms for s in a.statements)
        self.in_whens = self.assigned | when_targets(s for a in flat.algorithms for s in a.statements)
        self.declarations = Declarations(flat, self.in_whens, structural)
        self.parameters = Parameters(self.declarations)
        self.functions = Functions(flat)
        self.evaluate = Evaluator(flat, self, self.functions)
        self.time = SX.sym("time")
        self.init = SX.sym("initial()")
        self.relations: list[Relation] = []
        self.held: list[Held] = []
        self.time_events: list[SX] = []
        self.delays: dict[tuple[int, int], Delayed] = {}
        self.transports: list[Transport] = []
        self._transport_of: dict[tuple[float, ...], Transport] = {}
        self.left_limits: dict[int, SX] = {}  # continuous variables that pre() is applied to
        self._relation_of: dict[tuple[int, bool], SX] = {}
        self._step_of: dict[int, SX] = {}
        self._starting: SX | None = None
        self._sampled: set[int] = set()  # counters of sample(), which is a function of them and of time
        self._derivative: dict[int, SX] = {}
        self.integral: dict[int, SX] = {}  # derivative symbol -> the symbol it is the derivative of
        self._previous: dict[int, SX] = {}
        self._current: dict[int, SX] = {}
        self._discrete: set[int] = {key(self.init)}

    # ---- names

    def lookup(self, name: str) -> Value:
        """Return the value of a variable or parameter."""
        if name == "time":
            return self.time
        if name not in self.flat.variables:
            return self._record(name)
        if name not in self.declarations.values:
            return self.parameters.lookup(name, self._evaluate_binding)  # a String
        first = next(iter(algebra.scalars(self.declarations.values[name])), None)
        declared = self.declarations.by_symbol[key(first)] if isinstance(first, SX) else None
        if declared is not None and declared.kind in ("parameter", "constant"):
            value = self.parameters.lookup(name, self._evaluate_binding)
            self._discrete |= {key(s) for s in algebra.scalars(value) if isinstance(s, SX) and s.is_symbolic()}
            return value
        value = self.declarations.values[name]
        if declared is not None and (declared.kind == "discrete" or declared.type != "Real"):
            self._discrete |= {key(s) for s in algebra.scalars(value) if isinstance(s, SX)}
        return value

    def _evaluate_binding(self, node: Any) -> Value:
        with self.evaluate.no_event():
            return self.evaluate(node)

    def _record(self, name: str) -> Value:
        prefix = f"{name}."
        members = [n for n in self.flat.variables if n.startswith(prefix)]
        if not members:
            raise KeyError(name)
        out: dict[str, Value] = {}
        for member in members:
            field = member.removeprefix(prefix).partition(".")[0]
            if field not in out:
                out[field] = self.lookup(prefix + field)
        return out

    # ---- derivatives

    def derivative_symbol(self, symbol: SX) -> SX:
        """Symbol of the time derivative of a continuous variable (or of a derivative)."""
        derivative = self._derivative.get(key(symbol))
        if derivative is None:
            derivative = SX.sym(derivative_name(symbol.name()))
            self._derivative[key(symbol)] = derivative
            self.integral[key(derivative)] = symbol
        return derivative

    def has_derivative(self, symbol: SX) -> bool:
        """Whether the derivative of a symbol has been used."""
        return key(symbol) in self._derivative

    def has_input_derivative(self, symbol: SX) -> bool:
        """Whether a symbol is an input, whose derivative is unknown."""
        declared = self.declared(symbol)
        return declared is not None and declared.kind == "input"

    def derivative(self, value: Scalar) -> Scalar:
        """Total time derivative by the chain rule."""
        if not isinstance(value, SX):
            return 0.0
        out = SX(0.0)
        for k, partial in self.graph.gradient(value).items():
            rate = self._rate(k)
            if rate is not None:
                out = plus(out, times(partial, rate))
        return algebra.fold(out)

    def _rate(self, k: int) -> SX | None:
        if k == key(self.time):
            return SX(1.0)
        if k in self._discrete:
            return None
        declared = self.declarations.by_symbol.get(k)
        if declared is not None:
            if declared.kind == "input":
                raise InputDerivativeError(declared.name, where=declared.at)
            if declared.kind != "continuous":
                return None
            return self.derivative_symbol(SX(declared.symbol))
        if k in self.integral:
            return self.derivative_symbol(self._derivative[key(self.integral[k])])
        if self.is_delayed({k}):
            raise self.flat.error(
                "the derivative of delay() or spatialDistribution() is needed",
                None,
                "put a filter between it and its differentiation",
            )
        return None

    # ---- discrete-time operators

    def previous_symbol(self, symbol: SX) -> SX:
        """Symbol of the pre-value of a discrete variable."""
        previous = self._previous.get(key(symbol))
        if previous is None:
            previous = SX.sym(f"pre({symbol.name()})")
            self._previous[key(symbol)] = previous
            self._current[key(previous)] = symbol
            self._discrete.add(key(previous))
        return previous

    def previous(self, value: Scalar) -> Scalar:
        """``pre(value)``."""
        if not isinstance(value, SX):
            return value
        if not value.is_symbolic():
            raise ValueError("pre() of an expression")
        declared = self.declarations.by_symbol.get(key(value))
        if declared is None or declared.kind in ("parameter", "constant"):
            return value
        if declared.kind == "discrete":
            return self.previous_symbol(value)
        if declared.kind == "input" and declared.type != "Real":
            copy = SX.sym(f"copy({declared.name})")
            previous = self.previous_symbol(copy)
            self.held.append(Held(copy, previous, value, value))
            return previous
        self.left_limits[key(value)] = value
        return value

    def is_continuous(self, value: SX) -> bool:
        """Whether an expression can change between events."""
        return not self.graph.symbols(value) <= self._discrete

    def is_fixed(self, value: SX) -> bool:
        """Whether an expression depends on parameters alone."""
        return all(map(self.is_parameter, self.graph.symbols(value)))

    def changes_between_events(self, value: SX) -> bool:
        """Whether an expression changes between events, which ``sample()`` does not although it has the time."""
        symbols = self.graph.symbols(value)
        if symbols & self._sampled:
            symbols = symbols - {key(self.time)}
        return not symbols <= self._discrete

    def relation(self, difference: SX, inclusive: bool) -> SX:
        """Truth of ``difference > 0``, an event if it is continuous."""
        if not self.is_continuous(difference):
            return SX(algebra.LESS_EQUAL(0.0, difference) if inclusive else algebra.LESS(0.0, difference))
        same = (self.graph.same(difference), inclusive)
        if same not in self._relation_of:
            symbol = SX.sym(f"relation {len(self.relations) + 1}")
            self._discrete.add(key(symbol))
            self._relation_of[same] = symbol
            self.relations.append(Relation(symbol, difference, inclusive))
        return self._relation_of[same]

    def step(self, argument: SX) -> SX:
        """``floor(argument)``, held between events if the argument is continuous."""
        if not self.is_continuous(argument):
            return ca.floor(argument)
        same = self.graph.same(argument)
        if same not in self._step_of:
            symbol = SX.sym(f"step {len(self._step_of) + 1}")
            self._discrete.add(key(symbol))
            self._step_of[same] = symbol
            self.held.append(Held(symbol, self.previous_symbol(symbol), ca.floor(argument), SX(0.0)))
            self.relation(argument - symbol, True)
            self.relation(argument - symbol - 1, True)
        return self._step_of[same]

    def sample(self, start: Scalar, interval: Scalar) -> SX:
        """Truth of ``sample(start, interval)``: time has reached the next of its instants."""
        first, distance = algebra.sx(start), algebra.sx(interval)
        if self.is_continuous(first) or self.is_continuous(distance):
            raise ValueError("sample() with a start or an interval that varies")
        count = SX.sym(f"sample {len(self.time_events) + 1}")
        before = self.previous_symbol(count)
        self._sampled.add(key(before))
        self._discrete.add(key(count))
        due = SX.binary(ca.OP_LE, first + before * distance, self.time)
        # At initialisation, count the instants before the start of the simulation.
        passed = ca.fmax(0.0, ca.ceil((self.time - first) / distance - 1e-9))
        value = ca.if_else(self.init, passed, before + due)
        self.held.append(Held(count, before, value, SX(0.0)))
        self.time_events.append(first + count * distance)
        return ca.logic_and(due, ca.logic_not(self.init))

    def delay(self, value: Scalar, time: Scalar) -> Scalar:
        """``delay(value, time)``: a symbol, whose value the runtime remembers."""
        if not isinstance(value, SX) or (not isinstance(time, SX) and time == 0):
            return value
        if not isinstance(time, SX) and time < 0:
            raise ValueError(f"a delay of {time:g} s")
        by = algebra.sx(time)
        same = (self.graph.same(value), self.graph.same(by))
        if same not in self.delays:
            self.delays[same] = Delayed(SX.sym(f"delay {len(self.delays) + 1}"), value, by)
        return self.delays[same].symbol

    def is_delayed(self, symbols: Set[int]) -> bool:
        """Whether values of ``delay()`` or ``spatialDistribution()`` are among symbols."""
        remembered = [*(d.symbol for d in self.delays.values()), *(o.value for o in self.outlets())]
        return any(key(symbol) in symbols for symbol in remembered)

    def transport(
        self, inlets: tuple[SX, SX], moved: SX, points: Sequence[float], profile: Sequence[SX]
    ) -> tuple[SX, SX]:
        """Values that leave at both ends of a transport."""
        same = self.graph.same
        what = (*map(same, (*inlets, moved)), *points, *map(same, profile))
        if what in self._transport_of:
            left, right = self._transport_of[what].outlets
            return left.value, right.value
        number = len(self.transports) + 1
        left, right = (
            Outlet(*(SX.sym(f"{name} {number} {end}") for name in ("outlet", "slope", "place", "jump")))
            for end in ("left", "right")
        )
        made = Transport(inlets, moved, (left, right), tuple(points), tuple(profile))
        self._transport_of[what] = made
        self.transports.append(made)
        self.relation(left.jump - moved, False)  # an event where a jump leaves
        self.relation(moved - right.jump, False)
        return left.value, right.value

    def outlets(self) -> list[Outlet]:
        """Both ends of all transports."""
        return [outlet for transport in self.transports for outlet in transport.outlets]

    def fires(self, conditions: Iterable[SX]) -> SX:
        """Truth of a when-clause's firing: one of its conditions becomes true."""
        fires = SX(0.0)
        for whole in conditions:
            condition = whole
            if key(self.init) in self.graph.symbols(whole):  # contains initial(): may fire at initialisation
                fires = ca.logic_or(fires, ca.logic_and(self.init, whole))
                condition = Substitution({key(self.init): SX(0.0)})(whole)
                if condition.is_constant():
                    continue
            held = self.hold(f"condition {len(self.held) + 1}", whole, SX(0.0))
            edge = ca.logic_and(condition, ca.logic_not(held.previous))
            fires = ca.logic_or(fires, ca.logic_and(edge, ca.logic_not(self.init)))
        return fires

    def initial(self) -> SX:
        """Truth of ``initial()``."""
        return self.init

    def starting(self) -> SX:
        """Truth of: start values and simplified equations apply, with which the initialisation begins."""
        if self._starting is None:
            self._starting = self.hold("starting", SX(0.0), SX(1.0)).symbol
        return self._starting

    def is_switched(self, expression: SX) -> bool:
        """Whether an expression changes at events because it contains relations or discrete variables."""
        relations = {key(r.symbol) for r in self.relations}
        symbols = self.graph.symbols(expression)
        declared = (self.declarations.by_symbol.get(k) for k in symbols)
        return bool(relations & symbols) or any(d is not None and d.kind == "discrete" for d in declared)

    def is_starting(self, symbols: Set[int]) -> bool:
        """Whether simplified equations are among those with these symbols."""
        return self._starting is not None and key(self._starting) in symbols

    def hold(self, name: str, value: SX, start: SX) -> Held:
        """Make an internal discrete variable."""
        symbol = SX.sym(name)
        self._discrete.add(key(symbol))
        held = Held(symbol, self.previous_symbol(symbol), value, start)
        self.held.append(held)
        return held

    def held_since(self, fires: SX, condition: SX) -> SX:
        """Truth of: a condition held when a when-clause fired last."""
        held = self.hold(f"assertion {len(self.held) + 1}", SX(0.0), SX(0.0))
        self.held[-1] = replace(held, value=if_else(fires, ca.logic_not(condition), held.previous))
        return ca.logic_not(held.symbol)

    def start_of(self, declared: Declared) -> SX:
        """Start attribute of a variable as an expression of parameters (0 where not given)."""
        with self.evaluate.no_event():
            value = self.declarations.attribute(declared, "start", self.evaluate)
        return algebra.sx(0.0 if value is None else value)

    def declared(self, symbol: SX) -> Declared | None:
        """Return the declaration of a symbol."""
        return self.declarations.by_symbol.get(key(symbol))

    def is_event_symbol(self, k: int) -> bool:
        """Whether a symbol changes at events only (not a parameter)."""
        declared = self.declarations.by_symbol.get(k)
        return k in self._discrete and (declared is None or declared.kind not in ("parameter", "constant"))

    def is_parameter(self, k: int) -> bool:
        """Whether a symbol is a parameter."""
        declared = self.declarations.by_symbol.get(k)
        return declared is not None and declared.kind == "parameter"

    def is_previous(self, k: int) -> bool:
        """Whether the symbol of this key is a pre-value."""
        return k in self._current

    def current_of(self, symbol: SX) -> SX:
        """Return the variable of a pre-value symbol; other symbols as they are."""
        return self._current.get(key(symbol), symbol)


def targets(statements: Iterable[Any]) -> set[str]:
    """Names of the variables that statements assign."""
    names: set[str] = set()
    for node in walk(tuple(statements)):
        if isinstance(node, Assign):
            names.add(node.target.name)
        elif isinstance(node, AssignMany):
            names |= {t.name for t in node.targets if t is not None}
    return names


def when_targets(statements: Iterable[Any]) -> set[str]:
    """Names of the variables that the when-clauses among some statements assign."""
    names: set[str] = set()
    for when in walk(tuple(statements)):
        if isinstance(when, WhenStatement):
            names |= targets(when.branches)
    return names
