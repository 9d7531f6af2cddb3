"""The variables of a reduced model as FMI sees them: location, causality, variability, start, unit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from fmu_build import algebra
from fmu_build.aliases import Start, start_of
from fmu_build.events import Events
from fmu_build.flat_model import Variable as Declaration
from fmu_build.graph import SX, is_number, key
from fmu_build.model import Causality, DependencyKind, Initial, Location, Unit, Variable, derivative_name
from fmu_build.start import InitialConditions
from fmu_build.system import System
from fmu_build.unit_strings import make_unit
from fmu_build.variables import Declared


@dataclass(frozen=True)
class Interface:
    """Variables and the vectors they need.

    Attributes
    ----------
    inputs
        Symbols of u: inputs, then the values of ``delay()`` and what belongs to ``spatialDistribution()``.
    evaluated
        Expressions of v.
    iterate_starts
        Start values of y.
    """

    variables: tuple[Variable, ...]
    units: tuple[Unit, ...]
    inputs: list[SX]
    evaluated: list[SX]
    iterate_starts: list[Start]
    x_nominal: list[float]
    y_nominal: list[float]


def describe(
    system: System, happenings: Events, conditions: InitialConditions, transported: list[SX]
) -> Interface:
    """List every declared scalar and every state derivative with its place in the vectors."""
    return _Describer(system, happenings, conditions, transported).run()


class _Describer:
    def __init__(
        self, system: System, happenings: Events, conditions: InitialConditions, transported: list[SX]
    ) -> None:
        self.scope = scope = system.scope
        self.aliases = system.aliases
        self.states = system.reduced.states
        self.solution = solution = system.solution
        self.conditions = conditions
        self.point = system.point
        declared = scope.declarations.scalars.values()
        self.inputs = [algebra.sx(d.symbol) for d in declared if d.kind == "input"]
        delayed = [d.symbol for d in scope.delays.values()]
        self.place: dict[int, Location] = {}
        parameters = scope.parameters
        for vector, symbols in (
            ("x", [s.symbol for s in self.states]),
            ("u", [*self.inputs, *delayed]),
            ("p", [algebra.sx(d.symbol) for d, _ in parameters.independent]),
            ("d", [algebra.sx(d.symbol) for d, _ in parameters.dependent]),
            ("z", [d.symbol for d in happenings.discrete]),
            ("y", solution.iterates),
        ):
            for i, symbol in enumerate(symbols):
                self.place[key(symbol)] = Location(vector, i)  # type: ignore[arg-type]
        states_and_inputs = (*(s.symbol for s in self.states), *self.inputs)
        self.vector_u = [*self.inputs, *delayed, *transported]
        self.known = {key(s): (i, s.name()) for i, s in enumerate(states_and_inputs)}
        self.rates = [solution.expression(s.derivative) for s in self.states]
        self.evaluated: list[SX] = []
        for i, rate in enumerate(self.rates):
            if not rate.is_constant() and key(rate) not in self.place:
                self.place[key(rate)] = Location("dx", i)

    def run(self) -> Interface:
        variables = [self._variable(d) for d in self.scope.declarations.scalars.values()]
        names = [self._state_name(i, variables) for i in range(len(self.states))]
        taken = {v.derivative_of for v in variables}
        units = {v.name: v.unit for v in variables}
        variables += [self._derivative(i, name, units[name]) for i, name in enumerate(names) if name not in taken]
        return Interface(
            tuple(variables),
            self._units(variables),
            self.vector_u,
            self.evaluated,
            [start_of(self.scope, self.aliases, s) for s in self.solution.iterates],
            [self._nominal(s.symbol) for s in self.states],
            [self._nominal(s) for s in self.solution.iterates],
        )

    def _variable(self, declared: Declared) -> Variable:
        variable = declared.variable
        number = self._number
        common: dict[str, Any] = {
            "name": declared.name,
            "type": declared.type,
            "description": variable.description,
            "unit": variable.unit,
            "display_unit": self._display_unit(variable),
            "quantity": variable.quantity,
            "min": number(declared, "min"),
            "max": number(declared, "max"),
            "nominal": number(declared, "nominal"),
            "enumeration": declared.literals,
        }
        output = declared.variable.causality == "output"
        match declared.kind:
            case "constant":
                place: dict[str, Any] = {
                    "location": Location("constant"), "causality": "local", "variability": "constant",
                    "initial": "exact", "start": float(algebra.sx(self._constant(declared))),
                }  # fmt: skip
            case "parameter":
                place = self._parameter(declared)
            case "input":
                start = self.scope.start_of(declared)
                place = {
                    "location": self.place[key(algebra.sx(declared.symbol))], "causality": "input",
                    "variability": "continuous" if declared.type == "Real" else "discrete",
                    "start": self.point.number(start),
                }  # fmt: skip
            case "discrete":
                location = self.place[key(algebra.sx(declared.symbol))]
                place = {
                    "location": location, "causality": "output" if output else "local",
                    "variability": "discrete", "initial": "calculated",
                }  # fmt: skip
            case _:
                place = self._continuous(declared, "output" if output else "local")
        if output:
            place |= self._dependencies_of(declared)
        return Variable(**common, **place)

    def _display_unit(self, variable: Declaration) -> str | None:
        """Return the display unit if it is another unit of the same kind, as FMI requires."""
        unit, shown = variable.unit, variable.display_unit
        if not shown or shown == unit:
            return None
        if unit and any(d.name == shown for d in make_unit(unit, {shown}).display_units):
            return shown
        why = f"is no multiple of the unit '{unit}'" if unit else "belongs to no unit"
        self.scope.parameters.warnings.append(
            f"{variable.at}: the displayUnit '{shown}' of '{variable.name}' {why}; it is left out"
        )
        return None

    def _constant(self, declared: Declared) -> algebra.Scalar:
        value = self.scope.lookup(declared.variable.name)
        return algebra.scalars(value)[declared.position]

    def _number(self, declared: Declared, attribute: str) -> float | None:
        value = self.scope.declarations.attribute(declared, attribute, self.scope.evaluate)
        return None if value is None else self.point.number(algebra.sx(value))

    def _parameter(self, declared: Declared) -> dict[str, Any]:
        alias = self.scope.parameters.aliases.get(declared.name)
        location = self.place[key(algebra.sx(declared.symbol) if alias is None else alias)]
        if location.vector == "p" and alias is None:
            value = self.scope.parameters.independent[location.index][1]
            return {
                "location": location, "causality": "parameter", "variability": "fixed", "initial": "exact",
                "start": value,
            }  # fmt: skip
        return {
            "location": location, "causality": "calculatedParameter", "variability": "fixed",
            "initial": "calculated",
        }  # fmt: skip

    def _continuous(self, declared: Declared, causality: Causality) -> dict[str, Any]:
        representative, sign = self.aliases.of[declared.name]
        symbol = algebra.sx(representative.symbol)
        expression = self.solution.expression(symbol)
        stored = self.place.get(key(expression))
        if stored is None and not expression.is_symbolic():
            negative = -expression
            stored = self.place.get(key(negative)) if negative.is_symbolic() else None
            sign = -sign if stored is not None else sign
        if stored is None:
            stored = Location("v", len(self.evaluated))
            self.evaluated.append(expression)
            self.place[key(expression)] = stored
        location = Location(stored.vector, stored.index, 1 if sign * stored.sign > 0 else -1)
        place: dict[str, Any] = {
            "location": location, "causality": causality, "variability": "continuous", "initial": "calculated",
        }  # fmt: skip
        if stored.vector == "x" and declared.name == self.states[stored.index].symbol.name():
            initial, value = self._state_start(stored.index)
            place |= {"initial": initial, "start": value}
        return place

    def _state_start(self, index: int) -> tuple[Initial, float | None]:
        value = self.conditions.starts[index].value
        if self.conditions.free[index]:
            return "approx", self.point.number(value)
        if value.is_constant():
            return "exact", float(value)
        return "calculated", None

    def _state_name(self, i: int, variables: list[Variable]) -> str:
        """Name of a state. A derivative has the name of a variable equal to it, or else becomes a variable."""
        state, place = self.states[i], Location("x", i)
        if self.scope.declared(state.symbol) is not None:
            return str(state.symbol.name())
        initial, value = self._state_start(i)
        for k, variable in enumerate(variables):
            if variable.location == place:
                variables[k] = replace(variable, initial=initial, start=value)
                return variable.name
        base = self.scope.declared(state.base)
        unit, below = base.variable.unit if base else None, state.base.name()
        for order in range(state.order):
            unit = _per_second(unit)
            below = derivative_name(below) if order else below
        name = str(state.symbol.name())
        variables.append(
            Variable(name, "Real", place, "local", "continuous", initial, value, unit=unit, derivative_of=below)
        )
        return name

    def _derivative(self, index: int, name: str, unit: str | None) -> Variable:
        return Variable(
            derivative_name(name), "Real", Location("dx", index), "local", "continuous", "calculated",
            unit=_per_second(unit), derivative_of=name, **self._dependencies(self.rates[index]),
        )  # fmt: skip

    def _dependencies_of(self, declared: Declared) -> dict[str, Any]:
        if declared.kind != "continuous":
            return {}
        representative, _ = self.aliases.of[declared.name]
        return self._dependencies(self.solution.expression(algebra.sx(representative.symbol)))

    def _dependencies(self, expression: SX) -> dict[str, Any]:
        """States and inputs that an expression depends on, and how; nothing if events matter."""
        graph = self.scope.graph
        symbols, loops = graph.symbols(expression), False
        if symbols & {key(y) for y in self.solution.iterates}:
            loops = True
            for residual in self.solution.residuals:
                symbols |= graph.symbols(residual)
        if any(self.scope.is_event_symbol(k) for k in symbols) or self.scope.is_delayed(symbols):
            return {}
        stepped, gradient = graph.stepped(expression), graph.gradient(expression)

        def kind(k: int) -> DependencyKind:
            factor = gradient.get(k)
            if loops or k in stepped or factor is None:
                return "dependent"
            if is_number(factor):
                return "constant"
            return "fixed" if all(map(self.scope.is_parameter, graph.symbols(factor))) else "dependent"

        known = sorted(self.known[k] + (k,) for k in symbols if k in self.known)
        return {
            "depends_on": tuple(name for _, name, _ in known),
            "dependency_kinds": tuple(kind(k) for _, _, k in known),
        }

    def _nominal(self, symbol: SX) -> float:
        group = self.aliases.groups.get(key(symbol))
        for declared, _ in group.members if group else ():
            value = self._number(declared, "nominal")
            if value:
                return abs(value)
        return 1.0

    def _units(self, variables: list[Variable]) -> tuple[Unit, ...]:
        shown: dict[str, set[str]] = {}
        for variable in variables:
            if variable.unit:
                displays = shown.setdefault(variable.unit, set())
                if variable.display_unit:
                    displays.add(variable.display_unit)
        return tuple(make_unit(name, shown[name]) for name in sorted(shown))


def _per_second(unit: str | None) -> str | None:
    if not unit:
        return None
    numerator, slash, denominator = unit.partition("/")
    if not slash:
        return f"{unit}/s"
    if denominator == "s":
        return f"{numerator}/s2"
    if denominator[:1] == "s" and denominator[1:].isdigit():
        return f"{numerator}/s{int(denominator[1:]) + 1}"
    return f"{numerator}/({denominator.strip('()')}.s)"
