"""Coupled models and SSP files for the tests."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fmuid.core.coupling import Master
from fmuid.simulation.coupled.coupled_model import CoupledModel
from fmuid.simulation.coupled.loading import couple

ROOT = Path(__file__).parents[2]
BUILT = ROOT / "build" / "fmus"
DRIVES = ROOT / "modelica" / "Drives"
NAMESPACES = " ".join(
    f'xmlns:{short}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for short, name in {
        "ssc": "Common", "ssd": "Description", "ssv": "ParameterValues", "ssm": "ParameterMapping",
    }.items()
)  # fmt: skip


def coupled(components: Mapping[str, Path], connections: Mapping[str, Any], **master: Any) -> CoupledModel:
    """Couple FMUs by input -> output, or by input -> (output, factor, offset)."""
    return couple(components, connections, Master(**master))


def split(drive: Mapping[str, Path], **master: Any) -> CoupledModel:
    """Couple the actuator's plant with its controller."""
    components = {name: drive[name] for name in ("plant", "controller")}
    return coupled(components, {"plant.i": "controller.i", "controller.w": "plant.w_motor"}, **master)


def write_ssp(
    path: Path, system: str, files: Mapping[str, Path | str], *, version: str = "1.0", rest: str = ""
) -> Path:
    """Write an SSP file: the content of its root system, and files by their name in resources/."""
    description = (
        f'<?xml version="1.0" encoding="UTF-8"?><ssd:SystemStructureDescription {NAMESPACES} version="{version}" '
        f'name="test"><ssd:System name="root">{system}</ssd:System>{rest}</ssd:SystemStructureDescription>'
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("SystemStructure.ssd", description)
        for name, content in files.items():
            if isinstance(content, Path):
                archive.write(content, f"resources/{name}")
            else:
                archive.writestr(f"resources/{name}", content)
    return path


def component(name: str, file: str, more: str = "", **attributes: str) -> str:
    """Return a Component."""
    given = {"name": name, "source": f"resources/{file}", **attributes}
    return f"<ssd:Component {_attributes(given)}>{more}</ssd:Component>"


def connector(name: str, kind: str, unit: str = "") -> str:
    """Return a Connector of a real variable."""
    stated = f' unit="{unit}"' if unit else ""
    return f'<ssd:Connector name="{name}" kind="{kind}"><ssc:Real{stated}/></ssd:Connector>'


def connection(start: str, end: str, more: str = "", **attributes: str) -> str:
    """Return a Connection from ``element.connector`` or, of the system, ``connector``."""
    ends = {}
    for side, place in (("start", start), ("end", end)):
        element, dot, name = place.rpartition(".")
        ends |= {f"{side}Element": element} if dot else {}
        ends[f"{side}Connector"] = name
    return f"<ssd:Connection {_attributes(ends | attributes)}>{more}</ssd:Connection>"


def elements(*items: str) -> str:
    return f"<ssd:Elements>{''.join(items)}</ssd:Elements>"


def connections(*items: str) -> str:
    return f"<ssd:Connections>{''.join(items)}</ssd:Connections>"


def connectors(*items: str) -> str:
    return f"<ssd:Connectors>{''.join(items)}</ssd:Connectors>"


def parameter_set(values: Mapping[str, str], namespaces: str = "") -> str:
    """Return a ParameterSet of name -> typed element, such as ``<ssv:Real value="1"/>``."""
    inside = "".join(f'<ssv:Parameter name="{n}">{v}</ssv:Parameter>' for n, v in values.items())
    return f'<ssv:ParameterSet {namespaces} version="1.0" name="set"><ssv:Parameters>{inside}</ssv:Parameters></ssv:ParameterSet>'


def bindings(*items: str) -> str:
    return f"<ssd:ParameterBindings>{''.join(items)}</ssd:ParameterBindings>"


def inline(values: Mapping[str, str], more: str = "", **attributes: str) -> str:
    """Return a ParameterBinding with its values in it."""
    content = f"<ssd:ParameterValues>{parameter_set(values)}</ssd:ParameterValues>{more}"
    return f"<ssd:ParameterBinding {_attributes(attributes)}>{content}</ssd:ParameterBinding>"


def _attributes(values: Mapping[str, str]) -> str:
    return " ".join(f'{name}="{value}"' for name, value in values.items())
