"""Copies of FMUs with new start values."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.errors import FmuError, SimulationError
from fmuid.core.files import write_atomically
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_variables import Slot
from fmuid.simulation.runners import Runner, in_process, simulated
from fmuid.simulation.simulator import Task, Variable

DESCRIPTION = "modelDescription.xml"
_COMPILED_STARTS = "resources/start_values.txt"  # read by FMUs that fmuid built (runtime/starts.c)


def copy_with_starts(fmu: Fmu, values: Mapping[str, float], target: Path) -> None:
    """Write a copy of an FMU with the start values `values`, by variable name, in the variables' units.

    The same FMU and values give the same bytes. An FMU built by fmuid uses the new values by itself. For other
    FMUs, the standard leaves it to the importer to set the values in the description; see `takes_effect`.

    Raises
    ------
    FmuError
        A variable is unknown, has no start value that can be set, or its type does not hold the value.
    FmuidError
        The copy cannot be written.
    """
    for name, value in values.items():
        if name not in fmu.slots:
            raise FmuError(f"has no variable '{name}'", where=fmu.path, fix=suggestion(name, fmu.slots))
        slot = fmu.slots[name]
        if slot.refusal is not None:
            raise FmuError(f"'{name}' {slot.refusal}", where=fmu.path, fix="set what it depends on")
        slot.check(name, value, fmu.path)
    buffer = io.BytesIO()
    with zipfile.ZipFile(fmu.path) as source, zipfile.ZipFile(buffer, "w") as copy:
        for member in source.infolist():
            content = source.read(member)
            if member.filename == DESCRIPTION:
                content = _described(content, fmu, values)
            if member.filename != _COMPILED_STARTS:
                copy.writestr(member, content)
        if fmu.tool == "fmuid":
            known = _compiled_starts(source) | {
                fmu.slots[n].reference: _line(fmu, n, v) for n, v in values.items()
            }
            member = zipfile.ZipInfo(_COMPILED_STARTS, date_time=(1980, 1, 1, 0, 0, 0))
            member.external_attr = 0o644 << 16
            copy.writestr(member, "".join(known[reference] for reference in sorted(known)))
    write_atomically(target, buffer.getvalue())


def takes_effect(fmu: Fmu, values: Mapping[str, float], copy: Path, runner: Runner = in_process) -> bool:
    """Return whether the copy, without any set values, starts like the original with `values` set."""
    step = fmu.default_experiment.get("step", 1e-3)
    begin = fmu.default_experiment.get("start", 0.0)
    outputs = [n for n, v in fmu.variables.items() if v.causality == "output" and fmu.slots[n].suffix]
    task = Task(np.array([begin, begin + step]), {}, (*values, *outputs))
    try:
        with Fmu(copy) as other:
            expected = simulated(runner, fmu, task, values)
            return bool(np.array_equal(simulated(runner, other, task, {}), expected))
    except (FmuError, SimulationError):
        return False


def as_text(variable: Variable, value: float) -> str:
    """Return a value as it is written in XML."""
    if variable.type == "Boolean":
        return "true" if value else "false"
    return repr(float(value)) if variable.type in ("Real", "Float64", "Float32") else str(int(value))


def as_bytes(root: ElementTree.Element) -> bytes:
    """Return an XML document as bytes for a file."""
    content: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def _described(xml: bytes, fmu: Fmu, values: Mapping[str, float]) -> bytes:
    builder = ElementTree.TreeBuilder(insert_comments=True)
    root = ElementTree.fromstring(xml, ElementTree.XMLParser(target=builder))
    declared = {v.get("name"): v for v in root.iterfind("ModelVariables/*")}
    for name, value in values.items():
        slot, text = fmu.slots[name], as_text(fmu.variables[name], value)
        element = declared.get(name)
        if element is None:  # an element of an array
            element = declared[name[: name.rindex("[")]]
            element.set("start", _element_replaced(element.get("start", ""), slot, text, name, fmu))
            continue
        place = element if fmu.version == 3 else next(c for c in element if isinstance(c.tag, str))
        place.set("start", text)
    return as_bytes(root)


def _element_replaced(starts: str, slot: Slot, text: str, name: str, fmu: Fmu) -> str:
    entries = starts.split()
    if len(entries) == 1:
        entries *= slot.size
    if len(entries) != slot.size:
        raise FmuError(
            f"does not give the start values of '{name}'", where=fmu.path, fix="export it with start values"
        )
    entries[slot.element] = text
    return " ".join(entries)


def _line(fmu: Fmu, name: str, value: float) -> str:
    kind = fmu.variables[name].type
    code = 0 if kind in ("Real", "Float64") else 2 if kind == "Boolean" else 1
    bits = struct.pack(">d", value).hex()
    return f"{fmu.slots[name].reference} {code} {bits} {name} = {value!r}\n"


def _compiled_starts(source: zipfile.ZipFile) -> dict[int, str]:
    """Return the lines written by an earlier copy, by value reference."""
    if _COMPILED_STARTS not in source.namelist():
        return {}
    lines = source.read(_COMPILED_STARTS).decode().splitlines(keepends=True)
    return {int(line.split()[0]): line for line in lines}
