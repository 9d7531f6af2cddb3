"""Parameter sets of SSP 1.0 (``.ssv``), with the units that the FMUs define."""

from __future__ import annotations

import functools
import zipfile
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from fmuid.simulation.coupled.coupled_model import CoupledModel
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_copy import DESCRIPTION, as_bytes, as_text

_SSV = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
_SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"
_BASE_UNIT = ("kg", "m", "s", "A", "K", "mol", "cd", "rad", "factor", "offset")
_TAGS = {"Boolean": "Boolean", "Enumeration": "Enumeration"} | dict.fromkeys(
    ("Real", "Float64", "Float32"), "Real"
)


def parameter_set(
    name: str, values: Mapping[str, Mapping[str, float]], models: Mapping[str, Fmu | CoupledModel]
) -> bytes:
    """Return a parameter set as XML.

    Parameters
    ----------
    name
        Name of the set.
    values
        Values by setup and variable; a variable with different values between setups is listed as
        ``setup.variable``.
    models
        Models by setup.
    """
    ElementTree.register_namespace("ssv", _SSV)
    ElementTree.register_namespace("ssc", _SSC)
    root = ElementTree.Element(f"{{{_SSV}}}ParameterSet", {"version": "1.0", "name": name})
    parameters = ElementTree.SubElement(root, f"{{{_SSV}}}Parameters")
    units: dict[str, dict[str, str]] = {}
    listed: set[str] = set()
    for setup, of_setup in values.items():
        for variable, value in of_setup.items():
            alike = all(other.get(variable, value) == value for other in values.values())
            model = models[setup]
            fmu, inside, name_inside = _home(model, variable)
            shown = name_inside if alike else f"{setup}.{name_inside}"
            if shown in listed:
                continue
            listed.add(shown)
            described = fmu.variables[inside]
            text = as_text(described, value)
            if described.type == "Enumeration":
                text = next((name for name, v in fmu.literals(inside).items() if v == int(value)), text)
            tag = _TAGS.get(described.type, "Integer")
            parameter = ElementTree.SubElement(parameters, f"{{{_SSV}}}Parameter", {"name": shown})
            entry = ElementTree.SubElement(parameter, f"{{{_SSV}}}{tag}", {"value": text})
            unit, defined = model.variables[variable].unit, _units(fmu.path)
            if tag == "Real" and unit is not None and unit in defined:
                entry.set("unit", unit)
                units[unit] = defined[unit]
    if units:
        parent = ElementTree.SubElement(root, f"{{{_SSV}}}Units")
        for unit, exponents in sorted(units.items()):
            element = ElementTree.SubElement(parent, f"{{{_SSC}}}Unit", {"name": unit})
            ElementTree.SubElement(element, f"{{{_SSC}}}BaseUnit", exponents)
    ElementTree.indent(root)
    return as_bytes(root)


def _home(model: Fmu | CoupledModel, variable: str) -> tuple[Fmu, str, str]:
    """Return the FMU that a variable belongs to, its name there, and its name in a parameter set."""
    if isinstance(model, Fmu):
        return model, variable, variable
    place = model.home(variable)
    ports = {port.name for port in model.ports}
    return model.components[place.component], place.variable, variable if variable in ports else str(place)


@functools.lru_cache(maxsize=16)
def _units(path: Path) -> dict[str, dict[str, str]]:
    with zipfile.ZipFile(path) as archive:
        description = ElementTree.fromstring(archive.read(DESCRIPTION))
    return {
        unit.get("name", ""): {k: v for k, v in base.attrib.items() if k in _BASE_UNIT}
        for unit in description.iterfind("UnitDefinitions/Unit")
        if (base := unit.find("BaseUnit")) is not None
    }
