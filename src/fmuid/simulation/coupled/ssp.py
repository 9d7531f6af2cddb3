"""Reading SSP files (System Structure and Parameterization 1.0): components, connections, ports, parameters.

Nested systems are flattened: a component's name is the path to it, as in ``drive.motor``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

from fmu_build.suggest import suggestion
from fmuid.core.campaign import Interface
from fmuid.core.coupling import Connection, Linear, Place, Port
from fmuid.core.errors import FmuError
from fmuid.simulation.coupled.connection_checks import unit_conversion, variable_at
from fmuid.simulation.coupled.ssp_archive import SSC, SSD, inside, number, parse
from fmuid.simulation.coupled.ssp_parameters import Value, bindings, linear_of
from fmuid.simulation.fmu import Fmu

DESCRIPTION = "SystemStructure.ssd"
VERSIONS = ("1.0", "2.0")
_FMU_TYPE = "application/x-fmu-sharedlibrary"
_INTERFACES: Mapping[str, Interface | None] = {
    "any": None,
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
}
_MAX_DEPTH = 50  # largest depth of nested systems
_FROM_SYSTEM = ("input", "parameter")  # kinds that a system hands down to its elements
_FROM_ELEMENT = ("output", "calculatedParameter")


@dataclass(frozen=True, slots=True)
class SystemDescription:
    """The content of an SSP file."""

    components: Mapping[str, Fmu]
    connections: tuple[Connection, ...]
    ports: tuple[Port, ...]
    starts: Mapping[str, Mapping[str, float]]
    experiment: Mapping[str, float]


def read_system(path: Path, folder: Path) -> SystemDescription:
    """Return the default system of the SSP file `path`, which is extracted in `folder`.

    Raises
    ------
    FmuError
        The description is missing, malformed or uses an unsupported feature.
    """
    root = parse(path, folder / DESCRIPTION, DESCRIPTION)
    version = root.get("version", "")
    if root.tag != f"{SSD}SystemStructureDescription" or version not in VERSIONS:
        raise FmuError(
            f"{DESCRIPTION} has version '{version}', not SSP {' or '.join(VERSIONS)}",
            where=path,
            fix="export it as SSP 1.0",
        )
    system = root.find(f"{SSD}System")
    if system is None:
        raise FmuError(f"{DESCRIPTION} has no System", where=path, fix="export it again")
    reader = _Reader(path, folder)
    reader.system(system, "", 0)
    if not reader.components:
        raise FmuError("has no component", where=path, fix="export it with its FMUs")
    experiment = root.find(f"{SSD}DefaultExperiment")
    times = {"start": "startTime", "stop": "stopTime"}
    return SystemDescription(
        reader.components,
        tuple(reader.connections()),
        tuple(reader.ports()),
        reader.starts(),
        {k: number(experiment, a, path) for k, a in times.items() if experiment is not None and experiment.get(a)},
    )


@dataclass(frozen=True, slots=True)
class _Node:
    """A connector of a component (by its name) or of a system (by the prefix of its elements)."""

    owner: str
    name: str
    is_system: bool

    def __str__(self) -> str:
        prefix = self.owner if self.is_system else f"{self.owner}."
        return f"{prefix}{self.name}"


@dataclass(slots=True)
class _Reader:
    path: Path
    folder: Path
    components: dict[str, Fmu] = field(default_factory=dict)
    kinds: dict[_Node, tuple[str, str | None]] = field(default_factory=dict)  # kind and unit of each connector
    inbound: dict[_Node, tuple[_Node, Linear]] = field(default_factory=dict)
    bound: list[tuple[str, bool, dict[str, Value]]] = field(default_factory=list)  # lowest priority first

    def system(self, element: Element, prefix: str, depth: int) -> None:
        """Add a system and its contents; `prefix` precedes the names of its elements."""
        if depth > _MAX_DEPTH:
            raise self._refused(f"systems are nested more than {_MAX_DEPTH} deep", "flatten them")
        for connector in element.iterfind(f"{SSD}Connectors/{SSD}Connector"):
            node = _Node(prefix, self._attribute(connector, "name"), True)
            self.kinds[node] = self._attribute(connector, "kind"), _unit(connector)
        for child in element.iterfind(f"{SSD}Elements/*"):
            kind = child.tag.removeprefix(SSD)
            if kind not in ("Component", "System"):
                raise self._refused(f"a {kind} is not supported", "connect its signals directly")
            name = f"{prefix}{self._attribute(child, 'name')}"
            if name in self.components or any(n.is_system and n.owner == f"{name}." for n in self.kinds):
                raise self._refused(f"two elements are named '{name}'", "rename one")
            if kind == "System":
                self.system(child, f"{name}.", depth + 1)
            else:
                self._component(child, name)
        for connection in element.iterfind(f"{SSD}Connections/{SSD}Connection"):
            self._connection(connection, prefix)
        for values in bindings(element, self.path, self.folder):
            self.bound.append((prefix, True, values))

    def _component(self, element: Element, name: str) -> None:
        kind = element.get("type") or _FMU_TYPE
        if kind != _FMU_TYPE:
            raise self._refused(f"component '{name}' is of type {kind}, not an FMU", "export it as an FMU")
        implementation = element.get("implementation", "any")
        if implementation not in _INTERFACES:
            raise self._refused(
                f"component '{name}' asks for {implementation}", "use CoSimulation or ModelExchange"
            )
        file = inside(self.path, self.folder, element.get("source"), f"component '{name}'")
        self.components[name] = Fmu(file, _INTERFACES[implementation])
        for connector in element.iterfind(f"{SSD}Connectors/{SSD}Connector"):
            place = Place(name, self._attribute(connector, "name"))
            variable = variable_at(self.path, self.components, place)
            kind = self._attribute(connector, "kind")
            if kind != variable.causality:
                raise self._refused(
                    f"connector '{place}' is of kind {kind}, but its variable has causality {variable.causality}",
                    "export the system again",
                )
            self.kinds[_Node(name, place.variable, False)] = kind, variable.unit or _unit(connector)
        for values in bindings(element, self.path, self.folder):
            self.bound.append((name, False, values))

    def _connection(self, element: Element, prefix: str) -> None:
        for indices in ("startIndices", "endIndices"):
            if element.get(indices):
                raise self._refused(
                    "connections of array elements by index are not supported", "connect them by name"
                )
        ends = [self._end(element, prefix, side) for side in ("start", "end")]
        gives = [
            self.kinds[n][0] in (_FROM_SYSTEM if n.owner == prefix and n.is_system else _FROM_ELEMENT)
            for n in ends
        ]
        if gives[0] == gives[1]:
            what = "give a value" if gives[0] else "take a value"
            raise self._refused(
                f"'{ends[0]}' and '{ends[1]}' are connected but both {what} "
                f"({self.kinds[ends[0]][0]}, {self.kinds[ends[1]][0]})",
                "connect an output to an input",
            )
        source, target = ends if gives[0] else ends[::-1]
        linear = linear_of(element, self.path, f"connection {source} -> {target}")
        if element.get("suppressUnitConversion") not in ("true", "1"):
            units = self.kinds[source][1], self.kinds[target][1]
            linear = unit_conversion(self.path, str(source), units[0], str(target), units[1]).then(linear)
        if target in self.inbound:
            raise self._refused(
                f"'{target}' follows both '{self.inbound[target][0]}' and '{source}'",
                "remove one of the connections",
            )
        self.inbound[target] = source, linear

    def _end(self, element: Element, prefix: str, side: Literal["start", "end"]) -> _Node:
        owner, name = element.get(f"{side}Element") or None, self._attribute(element, f"{side}Connector")
        if owner is None:
            node = _Node(prefix, name, True)
        elif f"{prefix}{owner}" in self.components:
            node = _Node(f"{prefix}{owner}", name, False)
            if node not in self.kinds:  # connectors of components need not be listed
                variable = variable_at(self.path, self.components, Place(node.owner, name))
                self.kinds[node] = variable.causality, variable.unit
        else:
            node = _Node(f"{prefix}{owner}.", name, True)
            if not any(n.is_system and n.owner == node.owner for n in self.kinds):
                known = [n.removeprefix(prefix) for n in self.components if n.startswith(prefix)]
                raise self._refused(
                    f"connection to '{owner}.{name}': no element '{owner}'", suggestion(owner, known)
                )
        if node not in self.kinds:
            known = [n.name for n in self.kinds if n.owner == node.owner and n.is_system]
            raise self._refused(f"connection to '{node}': no such connector", suggestion(name, known))
        return node

    def connections(self) -> Iterator[Connection]:
        """Yield the connections between components."""
        for target in self.inbound:
            if not target.is_system:
                source, linear = self._traced(target)
                if not source.is_system:
                    yield Connection(Place(source.owner, source.name), Place(target.owner, target.name), linear)

    def ports(self) -> Iterator[Port]:
        """Yield the connectors of the root system that lead to components."""
        for node, (kind, unit) in self.kinds.items():
            if not node.is_system or node.owner:
                continue
            if kind in _FROM_SYSTEM:
                ends = self._ends(node)
                causality: Literal["input", "parameter"] = "input" if kind == "input" else "parameter"
                if ends:
                    yield Port(node.name, causality, unit or self._unit_of(ends[0]), ends)
            elif node in self.inbound:
                source, linear = self._traced(node)
                if source.is_system:
                    raise self._refused(f"'{node}' passes '{source}' on", "leave it out")
                place = Place(source.owner, source.name)
                yield Port(node.name, "output", unit or self._unit_of((place, linear)), ((place, linear),))

    def starts(self) -> dict[str, dict[str, float]]:
        """Return the start values that parameter bindings give, by component and variable."""
        starts: dict[str, dict[str, float]] = {name: {} for name in self.components}
        for owner, is_system, values in self.bound:
            fitting = 0
            for name, value in values.items():
                fitting += any(node.is_system and str(node) == f"{owner}{name}" for node in self.kinds)
                for place, linear, unit in self._bound_to(owner, is_system, name):
                    fmu = self.components[place.component]
                    number = value.number(place, fmu, unit, self.path)
                    starts[place.component][place.variable] = linear(number)
                    fitting += 1
            if values and not fitting:
                first = next(iter(values))
                known = [
                    f"{c}.{v}".removeprefix(owner) for c in self.components for v in self.components[c].variables
                ]
                raise self._refused(
                    f"none of the parameters bound to '{owner or 'the system'}' exists", suggestion(first, known)
                )
        return {name: of_component for name, of_component in starts.items() if of_component}

    def _bound_to(self, owner: str, is_system: bool, name: str) -> Iterator[tuple[Place, Linear, str | None]]:
        if not is_system:
            if name in self.components[owner].variables:
                yield Place(owner, name), Linear(), self.components[owner].variables[name].unit
            return
        for node, (kind, unit) in self.kinds.items():
            if node.is_system and str(node) == f"{owner}{name}" and kind in _FROM_SYSTEM:
                for place, linear in self._ends(node):
                    yield place, linear, unit
        for component, fmu in self.components.items():
            variable = f"{owner}{name}".removeprefix(f"{component}.")
            if f"{component}.{variable}" == f"{owner}{name}" and variable in fmu.variables:
                yield Place(component, variable), Linear(), fmu.variables[variable].unit

    def _traced(self, target: _Node) -> tuple[_Node, Linear]:
        """Return the original source of a value, and the transformation along the way."""
        source, linear = self.inbound[target]
        while source.is_system and source in self.inbound:
            source, before = self.inbound[source]
            linear = before.then(linear)
        return source, linear

    def _ends(self, origin: _Node) -> tuple[tuple[Place, Linear], ...]:
        """Return the variables of components that follow a system's connector."""
        ends = []
        for target in self.inbound:
            node, linear = target, Linear()
            while node in self.inbound and not target.is_system and node != origin:
                node, before = self.inbound[node]
                linear = before.then(linear)
            if node == origin and not target.is_system:
                ends.append((Place(target.owner, target.name), linear))
        return tuple(ends)

    def _unit_of(self, end: tuple[Place, Linear]) -> str | None:
        place, linear = end
        return variable_at(self.path, self.components, place).unit if linear == Linear() else None

    def _attribute(self, element: Element, name: str) -> str:
        value = element.get(name)
        if not value:
            kind = element.tag.rpartition("}")[2]
            raise self._refused(f"a {kind} has no '{name}'", "export the system again")
        return value

    def _refused(self, what: str, fix: str) -> FmuError:
        return FmuError(what, where=self.path, fix=fix)


def _unit(connector: Element) -> str | None:
    kinds = [child for child in connector if child.tag.startswith(SSC)]
    return kinds[0].get("unit") if kinds else None
