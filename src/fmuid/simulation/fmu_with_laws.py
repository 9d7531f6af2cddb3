"""FMUs that contain a Model Exchange FMU and add laws to the derivatives of its states.

The new FMU (FMI 2.0, co-simulation) has fmuid's integrator and the other FMU, so it runs in any tool. It has the
other one's variables, and the laws' parameters and inputs. No compiler is needed: the library comes with fmuid,
and expressions are code for its stack machine (`law_code`).
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib.util import find_spec
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from fmu_build.instrument import Added, State
from fmuid.core.errors import FmuError
from fmuid.core.files import write_atomically
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_copy import as_bytes
from fmuid.simulation.fmu_description import DescribedVariable, library_name
from fmuid.simulation.fmu_plan import UNKNOWN_TOLERANCE
from fmuid.simulation.fmu_variables import Slot, elements_of
from fmuid.simulation.law_code import Operand, bits, code_of
from fmuid.simulation.simulator import Variable

CONTAINED = "resources/contained"
_TYPES = {"Boolean": "Boolean", "Real": "Real", "Float64": "Real", "Float32": "Real"}


@dataclass(frozen=True)
class CoefficientLaw:
    """A law of a parameter, which varies during a run: derivatives are those for another value of it.

    The derivatives have to be quotients of lines in the parameter, ``(a + b*p)/(1 + c*p)``, as in a stiffness, a
    conductance or an inertia, and outputs must not depend on it directly.

    Attributes
    ----------
    parameter
        Name of the parameter; its value must not be zero.
    value
        Expression of its value, as in `StateLaw.flow`; ``p`` is the value that is set.
    off, states, where
        As in `StateLaw`.
    """

    parameter: str
    value: str
    off: Mapping[str, float] = field(default_factory=dict)
    states: tuple[State, ...] = ()
    where: str = ""


@dataclass(frozen=True)
class StateLaw:
    """A law at a state: ``der(state)`` is reduced by `flow`, a Modelica expression.

    Attributes
    ----------
    state
        Name of the state.
    flow
        Expression of the FMU's states, their derivatives as the FMU calculates them (``der(w)``), its inputs,
        parameters and inputs of laws, `states`, and ``time``.
    off
        Values of parameters at which the law is off. Without any, it is always on.
    states
        States of the law.
    where
        Place for error messages.
    """

    state: str
    flow: str
    off: Mapping[str, float] = field(default_factory=dict)
    states: tuple[State, ...] = ()
    where: str = ""


def write_fmu_with_laws(
    fmu: Fmu, laws: Sequence[StateLaw | CoefficientLaw], added: Sequence[Added], target: Path
) -> None:
    """Write an FMU that contains `fmu` and adds laws to its derivatives.

    The same FMU and laws give the same bytes.

    Parameters
    ----------
    fmu
        An FMU that offers model exchange.
    laws
        The laws.
    added
        Parameters and inputs that they use.
    target
        Path of the new FMU.

    Raises
    ------
    FmuError
        The FMU has no library for this machine, or does not offer model exchange.
    ModelicaError
        An expression is wrong.
    """
    described = fmu.description
    if described.model_exchange is None:
        raise FmuError("does not offer model exchange", where=fmu.path, fix="export it for model exchange")
    carrier = _library()
    contents = _Contents(fmu, laws, added)
    text = contents.laws_text()
    token = hashlib.sha256(text.encode() + fmu.path.read_bytes() + carrier.read_bytes()).hexdigest()
    identifier = described.model_exchange.identifier
    buffer = io.BytesIO()
    with zipfile.ZipFile(fmu.path) as source, zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        library = f"binaries/{library_name(fmu.version, identifier).as_posix()}"
        if library not in source.namelist():
            raise FmuError("has no library for this machine", where=fmu.path, fix="export it for this machine")
        _add(archive, "modelDescription.xml", contents.description(f"{{{token[:32]}}}", identifier))
        _add(archive, f"binaries/{library_name(2, identifier).as_posix()}", carrier.read_bytes())
        _add(archive, "resources/laws.txt", text.encode())
        for name in source.namelist():
            if name.startswith((library.rpartition("/")[0] + "/", "resources/")) and not name.endswith("/"):
                _add(archive, f"{CONTAINED}/{name}", source.read(name))
        _add(archive, f"{CONTAINED}/modelDescription.xml", source.read("modelDescription.xml"))
    write_atomically(target, buffer.getvalue())


def _library() -> Path:
    spec = find_spec("fmuid.simulation._fmu_with_laws")
    if spec is None or spec.origin is None:
        raise FmuError("the library of FMUs with laws is missing", where="fmuid", fix="install fmuid again")
    return Path(spec.origin)


@cache
def carrier_version() -> str:
    """Return a digest of what makes FMUs with laws, which tells those of other versions apart."""
    return hashlib.sha256(b"".join(f.read_bytes() for f in (_library(), Path(__file__)))).hexdigest()


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    member = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    member.external_attr, member.compress_type = 0o644 << 16, zipfile.ZIP_DEFLATED
    archive.writestr(member, content)


@dataclass(frozen=True)
class _Contents:
    """The files of an FMU with laws."""

    fmu: Fmu
    laws: Sequence[StateLaw | CoefficientLaw]
    added: Sequence[Added]

    @cached_property
    def _scalars(self) -> list[tuple[Variable, Slot]]:
        """Numeric variables of the contained FMU; their places are the value references of the new one."""
        slots = self.fmu.slots
        elements = [(v, slots[n]) for n, v in self.fmu.variables.items() if slots[n].suffix]
        return [(v, slot) for v, slot in elements if v.causality != "independent"]

    @cached_property
    def _inputs(self) -> list[str]:
        return [v.name for v, slot in self._scalars if v.causality == "input" and slot.size == 1]

    @cached_property
    def _parameters(self) -> list[Added]:
        return [one for one in self.added if not one.input]

    @cached_property
    def _coefficients(self) -> dict[str, int]:
        """The parameters that vary, with their numbers among the scalars."""
        places = {v.name: i for i, (v, _) in enumerate(self._scalars)}
        wanted = dict.fromkeys(law.parameter for law in self.laws if isinstance(law, CoefficientLaw))
        return {name: places[name] for name in wanted}

    @cached_property
    def _law_inputs(self) -> list[Added]:
        return [one for one in self.added if one.input]

    def laws_text(self) -> str:
        """Return ``laws.txt``; laws.c and fmu_with_laws.c read it."""
        fmu, described = self.fmu, self.fmu.description
        exchange = described.model_exchange
        assert exchange is not None
        tolerance = described.default_experiment.get("tolerance", UNKNOWN_TOLERANCE)
        numbers = (
            fmu.version, int(exchange.needs_completed_step), described.n_states, described.n_indicators,
            len(self._scalars), len(self._inputs), len(self._law_inputs), bits(tolerance),
        )  # fmt: skip
        references = fmu.directional_references
        columns = {name: i for i, name in enumerate(self._inputs)}
        scalars = [
            f"{s.suffix} {s.storage} {s.reference} {s.size} {s.element} {columns.get(v.name, -1)} {_start(s)}"
            for v, s in self._scalars
        ]
        return "\n".join(
            [
                "fmuid-laws 5",
                f"library binaries/{library_name(fmu.version, exchange.identifier).as_posix()}",
                f"name {described.name}",
                f"token {described.token}",
                " ".join(map(str, numbers)),
                " ".join(map(str, (0 if references is None else 1, *(() if references is None else references)))),
                *scalars,
                f"{len(self._parameters)} {sum(len(law.states) for law in self.laws)} {len(self.laws)}",
                " ".join(map(str, (len(self._coefficients), *self._coefficients.values()))),
                *self._law_lines(),
                *(bits(one.value) for one in self._parameters),
                *(bits(fmu.variables[name].start or 0.0) for name in self._inputs),
                "",
            ]
        )

    def _law_lines(self) -> Iterator[str]:
        states = {name: i for i, name in enumerate(self.fmu.states)}
        numbers = {one.name: i for i, one in enumerate(self._parameters)}
        names = {name: Operand("STATE", i) for name, i in states.items()}
        names |= {f"der({name})": Operand("DERIVATIVE", i) for name, i in states.items()}
        inputs = [*self._inputs, *(one.name for one in self._law_inputs)]
        names |= {name: Operand("INPUT", i) for i, name in enumerate(inputs)}
        names |= {name: Operand("PARAMETER", i) for name, i in numbers.items()}
        coefficients = {name: i for i, name in enumerate(self._coefficients)}
        inner = 0
        for law in self.laws:
            here = {s.name: Operand("ADDED_STATE", inner + i) for i, s in enumerate(law.states)}
            inner += len(law.states)
            meant = {**names, **here}
            sizes = " ".join(f"{numbers[name]} {bits(value)}" for name, value in law.off.items())
            if isinstance(law, CoefficientLaw):
                size = coefficients[law.parameter]
                yield f"{len(law.off)} 1 {len(law.states)} {size + 1} {sizes}"
                yield f"0 {code_of(law.value, {**meant, 'p': Operand('OWN', size)}, law.where)}"
            else:
                yield f"{len(law.off)} 1 {len(law.states)} 0 {sizes}"
                yield f"{states[law.state]} {code_of(law.flow, meant, law.where)}"
            for state in law.states:
                yield code_of(state.derivative, meant, law.where)
                yield code_of(state.start, meant, law.where)

    def description(self, token: str, identifier: str) -> bytes:
        """Return ``modelDescription.xml``."""
        described = self.fmu.description
        attributes = {"fmiVersion": "2.0", "modelName": described.name, "guid": token, "generationTool": "fmuid"}
        attributes |= {"variableNamingConvention": "flat", "numberOfEventIndicators": "0"}
        attributes["description"] = f"contains an FMU of {self.fmu.tool}, with laws added to its derivatives"
        root = Element("fmiModelDescription", attributes)
        exchange = described.model_exchange
        assert exchange is not None
        offered = {
            "modelIdentifier": identifier,
            "canHandleVariableCommunicationStepSize": "true",
            "canInterpolateInputs": "true",
            "canBeInstantiatedOnlyOncePerProcess": str(exchange.once).lower(),
            "needsExecutionTool": str(exchange.needs_tool).lower(),
        }
        SubElement(root, "CoSimulation", offered)
        units = [v.unit for v, _ in self._scalars] + [one.unit for one in self.added]
        if any(units):
            definitions = SubElement(root, "UnitDefinitions")
            for unit in dict.fromkeys(filter(None, units)):
                SubElement(definitions, "Unit", name=unit)
        kinds = {name: v for v in described.variables for name in elements_of(v)}
        self._define_types(root, kinds)
        experiment = {"start": "startTime", "stop": "stopTime", "step": "stepSize", "tolerance": "tolerance"}
        given = {experiment[n]: repr(v) for n, v in described.default_experiment.items()}
        if given:
            SubElement(root, "DefaultExperiment", given)
        variables = SubElement(root, "ModelVariables")
        indices_of = self._declared(variables, kinds)
        structure = SubElement(root, "ModelStructure")
        for what, indices in indices_of.items():
            listed = SubElement(structure, what) if indices else structure
            for index in indices:
                SubElement(listed, "Unknown", index=str(index))
        return as_bytes(root)

    def _declared(self, variables: Element, kinds: Mapping[str, DescribedVariable]) -> dict[str, list[int]]:
        """Declare all variables, and return the indices of those that the structure lists."""
        places = {v.name: i for i, (v, _) in enumerate(self._scalars, start=1)}
        state_of = {d: places[s] for s, d in self.fmu.derivatives.items() if s in places and d in places}
        structure: dict[str, list[int]] = {"Outputs": [], "Derivatives": [], "InitialUnknowns": []}
        structure["Derivatives"] = [places[d] for d in state_of]
        of_states = {*state_of.values(), *structure["Derivatives"]}
        for index, (variable, slot) in enumerate(self._scalars, start=1):
            initial = _declare(variables, index - 1, variable, slot, kinds.get(variable.name))
            if variable.name in state_of:
                variables[-1][0].set("derivative", str(state_of[variable.name]))
            if variable.causality == "output":
                structure["Outputs"].append(index)
            unknown = variable.causality in ("output", "calculatedParameter") or index in of_states
            if initial in ("approx", "calculated") and unknown:
                structure["InitialUnknowns"].append(index)
        for reference, one in enumerate([*self._parameters, *self._law_inputs], start=len(self._scalars)):
            attributes = {"name": one.name, "valueReference": str(reference), "description": one.description}
            attributes["causality"] = "input" if one.input else "parameter"
            attributes["variability"] = "continuous" if one.input else "fixed"
            element = SubElement(variables, "ScalarVariable", attributes)
            SubElement(element, "Real", {"start": repr(one.value)} | ({"unit": one.unit} if one.unit else {}))
        return structure

    def _define_types(self, root: Element, kinds: Mapping[str, DescribedVariable]) -> None:
        """Define the enumerations, whose items have names."""
        every = (kinds[v.name] for v, _ in self._scalars if v.name in kinds)
        enumerations = {v.name: v for v in every if v.literals}
        if not enumerations:
            return
        definitions = SubElement(root, "TypeDefinitions")
        for variable in enumerations.values():
            simple = SubElement(definitions, "SimpleType", name=_type_of(variable))
            items = SubElement(simple, "Enumeration")
            for name, value in variable.literals.items():
                SubElement(items, "Item", name=name, value=str(value))


def _start(slot: Slot) -> str:
    value = slot.starts[slot.element]
    return bits(0.0 if math.isnan(value) else value)


def _type_of(variable: DescribedVariable) -> str:
    return f"type of {variable.name}"


def _declare(
    variables: Element, reference: int, variable: Variable, slot: Slot, described: DescribedVariable | None
) -> str:
    """Declare a variable of the contained FMU, and return its `initial`; arrays of inputs can only be read."""
    causality, variability = variable.causality, variable.variability
    initial = "" if described is None else described.initial
    if slot.size > 1 and causality == "input":
        causality, variability, initial = "local", "discrete", "calculated"
    if causality == "structuralParameter":
        causality, variability, initial = "parameter", "fixed", "exact"
    attributes = {"name": variable.name, "valueReference": str(reference), "description": variable.description}
    attributes |= {"causality": causality, "variability": variability}
    needed = causality in ("input", "parameter") or initial in ("exact", "approx") or variability == "constant"
    if causality not in ("input", "calculatedParameter") and initial:
        attributes["initial"] = initial
    element = SubElement(variables, "ScalarVariable", attributes)
    kind = _TYPES.get(variable.type, "Integer")
    value = variable.start if variable.start is not None else 0.0
    inside: dict[str, str] = {}
    if described is not None and described.literals:
        kind, inside = "Enumeration", {"declaredType": _type_of(described)}
    if kind == "Real" and variable.unit:
        inside["unit"] = variable.unit
    for bound, limit in (("min", variable.min), ("max", variable.max)):
        if limit is not None and kind != "Boolean" and math.isfinite(limit):
            inside[bound] = repr(limit) if kind == "Real" else str(int(limit))
    if needed:
        start = repr(value) if kind == "Real" else str(int(value))
        inside["start"] = {"0": "false", "1": "true"}.get(start, start) if kind == "Boolean" else start
    SubElement(element, kind, inside)
    return initial
