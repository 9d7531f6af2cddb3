"""``modelDescription.xml`` of FMI 2.0 and 3.0: the parts that a simulation needs.

Defaults are those of the standard (FMI 2.0.4, section 2.2.7; FMI 3.0.1, section 2.4.7).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from platform import machine
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from zipfile import ZipFile

from fmu_build.model_description import STARTS_SETTABLE

_TYPES = ("Real", "Integer", "Boolean", "String", "Enumeration")  # of FMI 2.0, inside ScalarVariable
_ACTUAL = {"structuralParameter": "exact", "parameter": "exact", "calculatedParameter": "calculated"}
_SIGNALS = {"input": "exact", "output": "calculated", "local": "calculated"}
_INITIAL = {
    "constant": {"output": "exact", "local": "exact"},
    "fixed": {**_ACTUAL, "local": "calculated"},
    "tunable": {**_ACTUAL, "local": "calculated"},
    "discrete": _SIGNALS,
    "continuous": {**_SIGNALS, "independent": ""},
}
"""Default of `initial`, by variability and causality."""


@dataclass(frozen=True, slots=True)
class DescribedVariable:
    """A variable as in the description; `start`, `minimum` and `maximum` are the literal texts.

    `initial` is ``exact``, ``approx``, ``calculated`` or empty. `shape` is the shape of an FMI 3.0 array, and
    `literals` are the values of an enumeration by name. `derivative` refers to the variable of which this one is
    the derivative.
    """

    name: str
    reference: int
    type: str
    causality: str
    variability: str
    initial: str
    description: str
    unit: str | None
    start: str | None
    minimum: str | None
    maximum: str | None
    shape: tuple[int, ...]
    literals: Mapping[str, int]
    derivative: str | None


@dataclass(frozen=True, slots=True)
class DescribedInterface:
    """Co-simulation or model exchange as offered by an FMU; `identifier` is the name of its library.

    `needs_tool` says that the tool that exported it must be installed, `once` that a process can only
    instantiate it once, and `directional` that it offers directional derivatives. If it cannot
    take steps of `any_step` size, `fixed_step` is the size that it declares (s), if any.
    """

    identifier: str
    saves_state: bool
    any_step: bool
    interpolates_inputs: bool
    needs_completed_step: bool
    needs_tool: bool = False
    once: bool = False
    directional: bool = False
    fixed_step: float | None = None


@dataclass(frozen=True, slots=True)
class FmuDescription:
    """A model description; see `read_description`.

    `outputs` maps each output to the inputs on which it depends without delay, None if not stated. `states` are
    the names of the continuous states, if stated, and `derivatives` those of their derivatives; `n_states` is the
    number of states including all elements. If `starts_settable`, even start
    values of states that follow from parameters can be set. `default_experiment` contains those of ``start``,
    ``stop``, ``step`` and ``tolerance`` that are given.
    """

    version: str
    name: str
    token: str
    tool: str | None
    default_experiment: Mapping[str, float]
    co_simulation: DescribedInterface | None
    model_exchange: DescribedInterface | None
    variables: tuple[DescribedVariable, ...]
    outputs: Mapping[str, tuple[str, ...] | None]
    states: tuple[str, ...]
    derivatives: tuple[str, ...]
    n_states: int
    n_indicators: int
    starts_settable: bool = False


def read_description(path: Path) -> FmuDescription:
    """Read the model description of an FMU.

    Raises
    ------
    ValueError
        The description is not XML or violates the standard.
    """
    with ZipFile(path) as archive:
        try:
            root = ElementTree.fromstring(archive.read("modelDescription.xml"))
        except (ElementTree.ParseError, ValueError, LookupError) as error:  # LookupError: unknown encoding
            raise ValueError(f"modelDescription.xml: {error}") from None
    version = root.get("fmiVersion", "")
    fmi = 2 if version.startswith("2") else 3
    types = _declared_types(root, fmi)
    elements = root.findall("ModelVariables/*")
    variables = [_variable(e, fmi, types) for e in elements]
    by_reference = {v.reference: v for v in variables}
    if fmi == 3:
        variables = [replace(v, shape=_shape(e, by_reference)) for e, v in zip(elements, variables, strict=True)]
        by_reference = {v.reference: v for v in variables}
        variables += [
            replace(v, name=alias.get("name", ""), description=alias.get("description") or v.description)
            for e, v in zip(elements, variables, strict=True)
            for alias in e.findall("Alias")
        ]
    structure = root.find("ModelStructure")
    structure = Element("ModelStructure") if structure is None else structure
    known = by_reference if fmi == 3 else dict(enumerate(variables, start=1))
    key = "valueReference" if fmi == 3 else "index"
    listed = {
        what: [(_known(known, unknown.get(key)), unknown) for unknown in structure.findall(place)]
        for what, place in _STRUCTURE[fmi].items()
    }
    experiment = root.find("DefaultExperiment")
    given = {} if experiment is None else experiment.attrib
    names = {"start": "startTime", "stop": "stopTime", "step": "stepSize", "tolerance": "tolerance"}
    return FmuDescription(
        version=version,
        name=root.get("modelName", ""),
        token=root.get("guid" if fmi == 2 else "instantiationToken", ""),
        tool=root.get("generationTool"),
        default_experiment={ours: float(given[theirs]) for ours, theirs in names.items() if theirs in given},
        co_simulation=_interface(root.find("CoSimulation"), fmi, given.get("stepSize")),
        model_exchange=_interface(root.find("ModelExchange"), fmi),
        variables=tuple(variables),
        outputs={
            v.name: None
            if (d := u.get("dependencies")) is None
            else tuple(_known(known, k).name for k in d.split())
            for v, u in listed["outputs"]
        },
        starts_settable=any(
            e.get(key) == STARTS_SETTABLE
            for place, key in (("VendorAnnotations/Tool", "name"), ("Annotations/Annotation", "type"))
            for e in root.findall(place)
        ),
        states=tuple(_known(known, v.derivative).name for v, _ in listed["derivatives"] if v.derivative),
        derivatives=tuple(v.name for v, _ in listed["derivatives"] if v.derivative),
        n_states=sum(math.prod(v.shape) for v, _ in listed["derivatives"]),
        n_indicators=(
            int(root.get("numberOfEventIndicators", 0))
            if fmi == 2
            else sum(math.prod(v.shape) for v, _ in listed["indicators"])
        ),
    )


_STRUCTURE = {
    2: {"outputs": "Outputs/Unknown", "derivatives": "Derivatives/Unknown"},
    3: {"outputs": "Output", "derivatives": "ContinuousStateDerivative", "indicators": "EventIndicator"},
}


def library_name(version: int, identifier: str) -> Path:
    """Return the path of the library for this machine, below ``binaries``.

    Raises
    ------
    ValueError
        FMI has no name for this machine.
    """
    systems = {"win32": ("win", "windows", ".dll"), "linux": ("linux", "linux", ".so")}
    short, system, suffix = systems.get(sys.platform, ("darwin", "darwin", ".dylib"))
    processor = machine().lower()
    if processor in {"aarch64", "arm64"}:
        architecture = "aarch64"
    elif processor in {"amd64", "x86_64"} or (processor.startswith("i") and processor.endswith("86")):
        architecture = "x86_64" if sys.maxsize > 2**32 else "x86"
    else:
        raise ValueError(f"FMI has no name for the processor {processor}")
    bits = "64" if sys.maxsize > 2**32 else "32"
    return Path(f"{short}{bits}" if version == 2 else f"{architecture}-{system}") / f"{identifier}{suffix}"


def _known(variables: Mapping[int, DescribedVariable], key: str | None) -> DescribedVariable:
    if key is None or not key.isdecimal() or int(key) not in variables:
        raise ValueError(f"modelDescription.xml refers to the variable {key}, which does not exist")
    return variables[int(key)]


def _true(element: Element, attribute: str) -> bool:
    return element.get(attribute) in {"true", "1"}


def _interface(element: Element | None, fmi: int, step: str | None = None) -> DescribedInterface | None:
    if element is None:
        return None
    any_step = element.tag == "ModelExchange" or _true(element, "canHandleVariableCommunicationStepSize")
    step = element.get("fixedInternalStepSize", step)
    return DescribedInterface(
        identifier=element.get("modelIdentifier", ""),
        saves_state=_true(element, "canGetAndSetFMUstate" if fmi == 2 else "canGetAndSetFMUState"),
        any_step=any_step,
        interpolates_inputs=_true(element, "canInterpolateInputs"),
        needs_completed_step=(
            not _true(element, "completedIntegratorStepNotNeeded")
            if fmi == 2
            else _true(element, "needsCompletedIntegratorStep")
        ),
        needs_tool=_true(element, "needsExecutionTool"),
        once=_true(element, "canBeInstantiatedOnlyOncePerProcess"),
        directional=_true(element, "providesDirectionalDerivative" + ("s" if fmi == 3 else "")),
        fixed_step=None if any_step or step is None or not float(step) > 0 else float(step),
    )


def _declared_types(root: Element, fmi: int) -> dict[str, Element]:
    """Return the elements that define declared types, by their names."""
    if fmi == 2:
        return {t.get("name", ""): t[0] for t in root.findall("TypeDefinitions/SimpleType")}
    return {t.get("name", ""): t for t in root.findall("TypeDefinitions/*")}


def _variable(element: Element, fmi: int, types: Mapping[str, Element]) -> DescribedVariable:
    name = element.get("name", "")
    value = element if fmi == 3 else next((child for child in element if child.tag in _TYPES), None)
    if value is None:
        raise ValueError(f"variable '{name}' has no type")
    declared = value.get("declaredType")
    if declared is not None and declared not in types:
        raise ValueError(f"variable '{name}' has the type '{declared}', which is not defined")
    kind = types[declared] if declared is not None else Element("")
    causality = element.get("causality", "local")
    variability = element.get("variability") or _variability(causality, value.tag, fmi)
    if causality not in _INITIAL.get(variability, {}):
        raise ValueError(f"variable '{name}' cannot be a {causality} and {variability}")
    return DescribedVariable(
        name=name,
        reference=int(element.get("valueReference", "")),
        type=value.tag,
        causality=causality,
        variability=variability,
        initial=element.get("initial") or _INITIAL[variability][causality],
        description=element.get("description", ""),
        unit=value.get("unit") or kind.get("unit"),
        start=value.get("start"),
        minimum=value.get("min") or kind.get("min"),
        maximum=value.get("max") or kind.get("max"),
        shape=(),
        literals={item.get("name", ""): int(item.get("value", "")) for item in kind.findall("Item")},
        derivative=value.get("derivative"),
    )


def _variability(causality: str, tag: str, fmi: int) -> str:
    """Return the default variability."""
    if fmi == 3 and causality.lower().endswith("parameter"):
        return "fixed"
    return "continuous" if fmi == 2 or tag in {"Float64", "Float32"} else "discrete"


def _shape(element: Element, variables: Mapping[int, DescribedVariable]) -> tuple[int, ...]:
    """Return the dimensions of an array, which may be start values of structural parameters."""
    lengths = (
        d.get("start") or _known(variables, d.get("valueReference")).start for d in element.findall("Dimension")
    )
    return tuple(int(length or "") for length in lengths)
