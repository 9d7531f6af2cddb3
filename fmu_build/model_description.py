"""``modelDescription.xml`` of a compiled model, for FMI 2.0 and 3.0.

A variable's value reference is its position in ``CompiledModel.variables``, in both versions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal
from xml.etree import ElementTree

from fmu_build.errors import BuildError
from fmu_build.model import BASE_UNITS, CompiledModel, Unit, Variable

FmiVersion = Literal[2, 3]
STARTS_SETTABLE = "fmuid.starts-settable"
"""Annotation: the start value of every state can be set, also if it follows from parameters."""
GENERATION_TOOL = "fmuid"


def model_description(model: CompiledModel, guid: str, sources: Sequence[str], fmi: FmiVersion = 2) -> str:
    """Text of ``modelDescription.xml``.

    Parameters
    ----------
    model
        The compiled model.
    guid
        The GUID (FMI 2.0) or instantiation token (FMI 3.0) that the binary checks.
    sources
        Names of the C files in ``sources/``, in the order to compile them.
    fmi
        Major version of FMI.

    Returns
    -------
    str
        The XML document; the same text for the same arguments.
    """
    root = (_fmi2 if fmi == 2 else _fmi3)(model, guid, sources)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def states(model: CompiledModel) -> list[Variable]:
    """Return the variable that represents each continuous state, in the order of the state vector."""
    by_name = {v.name: v for v in model.variables}
    states = [by_name[v.derivative_of] for v in derivatives(model) if v.derivative_of]
    return sorted(states, key=lambda v: v.location.index)


def derivatives(model: CompiledModel) -> list[Variable]:
    """Return the variable that represents each state derivative, in the order of the state vector."""
    index = {v.name: v.location.index for v in model.variables if v.location.vector == "x"}
    by_index: dict[int, Variable] = {}
    for v in model.variables:
        if v.derivative_of in index:
            by_index.setdefault(index[v.derivative_of], v)
    if sorted(by_index) != list(range(model.n_x)):
        missing = sorted(set(range(model.n_x)) - set(by_index))
        raise BuildError(f"no variable is the derivative of state number {missing}", where=model.class_name)
    return [by_index[i] for i in range(model.n_x)]


def initial_unknowns(model: CompiledModel) -> list[Variable]:
    """Find the outputs, calculated parameters, states and derivatives whose initial values are computed."""
    of_state = {v.name for v in (*states(model), *derivatives(model))}
    return [
        v
        for v in model.variables
        if v.causality == "calculatedParameter"
        or ((v.causality == "output" or v.name in of_state) and v.initial in ("approx", "calculated"))
    ]


def _role(v: Variable, reference: int) -> dict[str, object]:
    """Return the name and role of a variable, as attributes of both versions of FMI."""
    return {
        "name": v.name,
        "valueReference": reference,
        "description": v.description,
        "causality": v.causality,
        "variability": v.variability,
        "initial": None if v.causality in ("input", "independent") else v.initial,
    }


def _values(v: Variable, types: Mapping[tuple[str, ...], str], places: Mapping[str, int]) -> dict[str, object]:
    """Return the possible values of a variable, as attributes of both versions of FMI."""
    real, number = v.type == "Real", v.type != "Boolean"
    return {
        "declaredType": types.get(v.enumeration),
        "quantity": v.quantity if number else None,
        "unit": v.unit if real else None,
        "displayUnit": v.display_unit if real else None,
        "min": v.min if number else None,
        "max": v.max if number else None,
        "nominal": v.nominal if real else None,
        "start": _start(v),
        "derivative": places[v.derivative_of] if v.derivative_of else None,
    }


def _number(value: float) -> str:
    return repr(int(value)) if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))


def _element(parent: ElementTree.Element, tag: str, **attributes: object) -> ElementTree.Element:
    """Child with the attributes that are not None; numbers and truth values as written in XML."""
    text: dict[str, str] = {}
    for key, value in attributes.items():
        if value is None or value == "":
            continue
        if isinstance(value, bool):
            text[key] = "true" if value else "false"
        elif isinstance(value, int | float):
            if not math.isfinite(value):
                continue
            text[key] = _number(value)
        else:
            text[key] = str(value)
    return ElementTree.SubElement(parent, tag, text)


def _units(root: ElementTree.Element, units: Sequence[Unit]) -> None:
    if not units:
        return
    parent = _element(root, "UnitDefinitions")
    for unit in units:
        element = _element(parent, "Unit", name=unit.name)
        if unit.exponents is not None:
            exponents = {b: e for b, e in zip(BASE_UNITS, unit.exponents, strict=True) if e}
            _element(
                element,
                "BaseUnit",
                **exponents,
                factor=None if unit.factor == 1.0 else unit.factor,
                offset=None if unit.offset == 0.0 else unit.offset,
            )
        for shown in unit.display_units:
            _element(element, "DisplayUnit", name=shown.name, factor=shown.factor, offset=shown.offset)


def _dependencies(element: ElementTree.Element, v: Variable, number: Mapping[str, int]) -> None:
    """Write what an unknown depends on, and how; without an entry it depends on everything."""
    if v.depends_on is None:
        return
    kinds = v.dependency_kinds or ("dependent",) * len(v.depends_on)
    known = sorted(zip((number[name] for name in v.depends_on), kinds, strict=True))
    element.set("dependencies", " ".join(str(n) for n, _ in known))
    element.set("dependenciesKind", " ".join(kind for _, kind in known))


def _type_names(model: CompiledModel) -> dict[tuple[str, ...], str]:
    kinds = dict.fromkeys(v.enumeration for v in model.variables if v.enumeration)
    return {literals: f"Enumeration{i}" for i, literals in enumerate(kinds, start=1)}


def _start(v: Variable) -> object:
    """Start attribute: only where FMI allows one."""
    if v.start is None or v.causality == "independent" or (v.initial == "calculated" and v.causality != "input"):
        return None
    if v.type == "Boolean":
        return bool(v.start)
    return int(v.start) if v.type == "Integer" else float(v.start)


def _experiment(root: ElementTree.Element, model: CompiledModel) -> None:
    e = model.experiment
    if (e.start, e.stop, e.tolerance, e.interval) != (None,) * 4:
        _element(
            root,
            "DefaultExperiment",
            startTime=e.start,
            stopTime=e.stop,
            tolerance=e.tolerance,
            stepSize=e.interval,
        )


def _log_categories(root: ElementTree.Element) -> None:
    parent = _element(root, "LogCategories")
    _element(parent, "Category", name="logStatusError", description="Why a call failed")
    _element(parent, "Category", name="logStatusWarning", description="What may be wrong though the run goes on")


def _types(root: ElementTree.Element, model: CompiledModel, fmi: FmiVersion) -> Mapping[tuple[str, ...], str]:
    """Write the enumerations; return their names."""
    types = _type_names(model)
    parent = _element(root, "TypeDefinitions") if types else root
    for literals, name in types.items():
        if fmi == 2:
            kind = _element(_element(parent, "SimpleType", name=name), "Enumeration")
        else:
            kind = _element(parent, "EnumerationType", name=name)
        for ordinal, literal in enumerate(literals, start=1):
            _element(kind, "Item", name=literal, value=ordinal)
    return types


def _fmi2(model: CompiledModel, guid: str, sources: Sequence[str]) -> ElementTree.Element:
    root = ElementTree.Element("fmiModelDescription", {"fmiVersion": "2.0"})
    attributes = {
        "modelName": model.class_name,
        "guid": guid,
        "description": model.description,
        "generationTool": GENERATION_TOOL,
        "variableNamingConvention": "structured",
        "numberOfEventIndicators": str(model.n_m),
    }
    root.attrib.update({k: v for k, v in attributes.items() if v})
    abilities = {
        "modelIdentifier": model.name,
        "canNotUseMemoryManagementFunctions": True,
        "canGetAndSetFMUstate": True,
        "canSerializeFMUstate": True,
        "providesDirectionalDerivative": True,
    }
    co_simulation = {"canHandleVariableCommunicationStepSize": True, "canInterpolateInputs": True}
    # Assertions are checked when an integrator's step is completed.
    exchange = {"completedIntegratorStepNotNeeded": not model.needs_completed_step}
    for tag, more in (("ModelExchange", exchange), ("CoSimulation", co_simulation)):
        files = _element(_element(root, tag, **abilities, **more), "SourceFiles")
        for name in sources:
            _element(files, "File", name=name)
    _units(root, model.units)
    types = _types(root, model, 2)
    _log_categories(root)
    _experiment(root, model)
    _element(_element(root, "VendorAnnotations"), "Tool", name=STARTS_SETTABLE)

    index = {v.name: i for i, v in enumerate(model.variables, start=1)}
    parent = _element(root, "ModelVariables")
    for reference, v in enumerate(model.variables):
        scalar = _element(parent, "ScalarVariable", **_role(v, reference))
        _element(scalar, "Enumeration" if v.enumeration else v.type, **_values(v, types, index))

    structure = _element(root, "ModelStructure")

    for tag, variables in _unknowns(model).items():
        group = _element(structure, f"{tag}s") if variables else structure
        for v in variables:
            element = _element(group, "Unknown", index=index[v.name])
            if tag != "InitialUnknown":
                _dependencies(element, v, index)
    return root


def _unknowns(model: CompiledModel) -> dict[str, list[Variable]]:
    """Variables of the model structure, by role."""
    return {
        "Output": [v for v in model.variables if v.causality == "output"],
        "Derivative": derivatives(model),
        "InitialUnknown": initial_unknowns(model),
    }


def _fmi3(model: CompiledModel, guid: str, sources: Sequence[str]) -> ElementTree.Element:
    del sources  # FMI 3.0 names them in sources/buildDescription.xml
    root = ElementTree.Element("fmiModelDescription", {"fmiVersion": "3.0"})
    attributes = {
        "modelName": model.class_name,
        "instantiationToken": guid,
        "description": model.description,
        "generationTool": GENERATION_TOOL,
        "variableNamingConvention": "structured",
    }
    root.attrib.update({k: v for k, v in attributes.items() if v})
    abilities = {
        "modelIdentifier": model.name,
        "canGetAndSetFMUState": True,
        "canSerializeFMUState": True,
        "providesDirectionalDerivatives": True,
    }
    _element(root, "ModelExchange", **abilities, needsCompletedIntegratorStep=model.needs_completed_step)
    _element(root, "CoSimulation", **abilities, canHandleVariableCommunicationStepSize=True)
    _units(root, model.units)
    types = _types(root, model, 3)
    _log_categories(root)
    _experiment(root, model)

    reference = {v.name: i for i, v in enumerate(model.variables)}
    parent = _element(root, "ModelVariables")
    for v in model.variables:
        tag = {"Real": "Float64", "Integer": "Int32", "Boolean": "Boolean"}[v.type]
        described = _role(v, reference[v.name]) | _values(v, types, reference)
        _element(parent, "Enumeration" if v.enumeration else tag, **described)
    indicators = range(len(model.variables), len(model.variables) + model.n_m)
    for i, indicator in enumerate(indicators, start=1):
        _element(
            parent,
            "Float64",
            name=f"'event indicator {i}'",
            valueReference=indicator,
            causality="local",
            variability="continuous",
            initial="calculated",
        )

    structure = _element(root, "ModelStructure")

    for tag, variables in _unknowns(model).items():
        for v in variables:
            shown = "ContinuousStateDerivative" if tag == "Derivative" else tag
            element = _element(structure, shown, valueReference=reference[v.name])
            if tag != "InitialUnknown":
                _dependencies(element, v, reference)
    for indicator in indicators:
        _element(structure, "EventIndicator", valueReference=indicator)
    _element(_element(root, "Annotations"), "Annotation", type=STARTS_SETTABLE)
    return root
