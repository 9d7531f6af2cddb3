"""Writing SSP files: a coupled model with start values."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from fmuid.core.coupling import Linear
from fmuid.core.files import write_atomically
from fmuid.simulation.coupled.coupled_model import CoupledModel
from fmuid.simulation.coupled.ssp import DESCRIPTION
from fmuid.simulation.coupled.ssp_archive import SSC, SSD, SSM, SSV
from fmuid.simulation.fmu_copy import as_bytes

_TYPES = {"Boolean": "Boolean", "Enumeration": "Integer", "Real": "Real", "Float64": "Real", "Float32": "Real"}
_BEFORE_BINDINGS = ("Connectors", "ElementGeometry")


def write_system(model: CoupledModel, parameters: bytes, target: Path) -> None:
    """Write a coupled model as an SSP file with a parameter set that takes precedence over all others.

    An SSP file is copied with the set added; FMUs from a campaign table are packed unchanged. The same model and
    parameters give the same bytes.

    Raises
    ------
    FmuidError
        The file cannot be written.
    """
    for short, namespace in (("ssd", SSD), ("ssc", SSC), ("ssv", SSV), ("ssm", SSM)):
        ElementTree.register_namespace(short, namespace.strip("{}"))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        if model.path.suffix == ".ssp":
            with zipfile.ZipFile(model.path) as source:
                root = ElementTree.fromstring(source.read(DESCRIPTION))
                for member in source.infolist():
                    if member.filename != DESCRIPTION:
                        archive.writestr(member, source.read(member))
        else:
            root = _described(model)
            for name, fmu in model.components.items():
                archive.writestr(_member(f"resources/{name}.fmu"), fmu.path.read_bytes())
        _bind(root, ElementTree.fromstring(parameters))
        ElementTree.indent(root)
        archive.writestr(_member(DESCRIPTION), as_bytes(root))
    write_atomically(target, buffer.getvalue())


def _member(name: str) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    member.external_attr = 0o644 << 16
    member.compress_type = zipfile.ZIP_DEFLATED
    return member


def _described(model: CoupledModel) -> Element:
    root = Element(f"{SSD}SystemStructureDescription", {"version": "1.0", "name": model.name})
    system = SubElement(root, f"{SSD}System", {"name": "root"})
    elements, connections = (SubElement(system, f"{SSD}{tag}") for tag in ("Elements", "Connections"))
    for name, fmu in model.components.items():
        component = SubElement(elements, f"{SSD}Component", {"name": name, "source": f"resources/{name}.fmu"})
        connectors = SubElement(component, f"{SSD}Connectors")
        places = [place for k in model.connections for place in (k.source, k.target)]
        for variable in dict.fromkeys(place.variable for place in places if place.component == name):
            described = fmu.variables[variable]
            connector = SubElement(connectors, f"{SSD}Connector", {"name": variable, "kind": described.causality})
            SubElement(connector, f"{SSC}{_TYPES.get(described.type, 'Integer')}")
    for k in model.connections:
        ends = {"startElement": k.source.component, "startConnector": k.source.variable}
        ends |= {"endElement": k.target.component, "endConnector": k.target.variable}
        connection = SubElement(connections, f"{SSD}Connection", ends)
        if k.linear != Linear():  # it already includes the unit conversion
            connection.set("suppressUnitConversion", "true")
            attributes = {name: repr(float(value)) for name, value in k.linear._asdict().items()}
            SubElement(connection, f"{SSC}LinearTransformation", attributes)
    return root


def _bind(root: Element, parameters: Element) -> None:
    system = root.find(f"{SSD}System")
    assert system is not None
    bindings = system.find(f"{SSD}ParameterBindings")
    if bindings is None:
        bindings = Element(f"{SSD}ParameterBindings")
        place = sum(child.tag.removeprefix(SSD) in _BEFORE_BINDINGS for child in system)
        system.insert(place, bindings)
    binding = SubElement(bindings, f"{SSD}ParameterBinding")
    SubElement(binding, f"{SSD}ParameterValues").append(parameters)
