"""SSP parameter bindings: parameter sets (SSV) and mappings (SSM), inline or in files of the archive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree.ElementTree import Element

from fmu_build.suggest import suggestion
from fmuid.core.coupling import Linear, Place
from fmuid.core.errors import FmuError
from fmuid.simulation.coupled.connection_checks import unit_conversion
from fmuid.simulation.coupled.ssp_archive import SSC, SSD, SSM, SSV, inside, number, parse
from fmuid.simulation.fmu import Fmu

_SET, _MAPPING = "application/x-ssp-parameter-set", "application/x-ssp-parameter-mapping"


@dataclass(frozen=True, slots=True)
class Value:
    """A value of a parameter set as written, and its transformation by a mapping."""

    name: str
    kind: str
    text: str
    unit: str | None
    linear: Linear = field(default_factory=Linear)
    convert_units: bool = True

    def number(self, place: Place, fmu: Fmu, unit: str | None, where: Path) -> float:
        """Return the value for the variable at `place`, in `unit`.

        Raises
        ------
        FmuError
            The value is neither a number nor a name of the enumeration.
        UnitError
            Its unit is incompatible with the variable's.
        """
        what = f"parameter '{self.name}' for '{place}'"
        if self.kind == "Boolean":
            return self.linear(float(self.text in ("true", "1")))
        if self.kind == "Enumeration":
            literals = fmu.literals(place.variable)
            if self.text not in literals:
                raise FmuError(f"{what} is '{self.text}'", where=where, fix=suggestion(self.text, literals))
            return float(literals[self.text])
        try:
            value = float(self.text)
        except ValueError:
            raise FmuError(
                f"{what} is the {self.kind} '{self.text}', not one number", where=where, fix="leave it out"
            ) from None
        if self.convert_units:
            value = unit_conversion(where, what, self.unit, str(place), unit)(value)
        return self.linear(value)


def bindings(element: Element, path: Path, folder: Path) -> Iterator[dict[str, Value]]:
    """Yield the parameter sets bound to a system or component, with mappings applied, in their order.

    Raises
    ------
    FmuError
        A set or mapping is missing, malformed or of another type.
    """
    for binding in element.iterfind(f"{SSD}ParameterBindings/{SSD}ParameterBinding"):
        what = f"a parameter binding of '{element.get('name')}'"
        values = _content(
            binding, f"{SSD}ParameterValues", f"{SSV}ParameterSet", kind=_SET, path=path, folder=folder, what=what
        )
        prefix = binding.get("prefix", "")
        bound = {}
        for parameter in values.iterfind(f"{SSV}Parameters/{SSV}Parameter"):
            name = f"{prefix}{parameter.get('name')}"
            typed = next(iter(parameter), None)
            if typed is None:
                raise FmuError(f"parameter '{name}' has no value", where=path, fix="export the system again")
            kind = typed.tag.removeprefix(SSV)
            unit = (typed.get("unit") or "").removeprefix("[").removesuffix("]")  # as SysML tools write it
            bound[name] = Value(name, kind, typed.get("value", ""), unit or None)
        mapping = binding.find(f"{SSD}ParameterMapping")
        if mapping is not None:
            what = f"a parameter mapping of '{element.get('name')}'"
            entries = _content(
                mapping, None, f"{SSM}ParameterMapping", kind=_MAPPING, path=path, folder=folder, what=what
            )
            bound = {
                entry.get("target", ""): _mapped(bound[entry.get("source", "")], entry, path)
                for entry in entries.iterfind(f"{SSM}MappingEntry")
                if entry.get("source") in bound
            }
        yield bound


def linear_of(element: Element, path: Path, what: str) -> Linear:
    """Return the linear transformation of a connection or mapping.

    Raises
    ------
    FmuError
        The transformation is of another kind.
    """
    for child in element:
        kind = child.tag.removeprefix(SSC)
        if kind == "LinearTransformation":
            return Linear(number(child, "factor", path, 1.0), number(child, "offset", path))
        if kind.endswith("Transformation"):
            raise FmuError(
                f"{what} has a {kind}, which is not supported", where=path, fix="use a LinearTransformation"
            )
    return Linear()


def _mapped(value: Value, entry: Element, path: Path) -> Value:
    linear = linear_of(entry, path, f"the mapping of parameter '{value.name}'")
    convert = entry.get("suppressUnitConversion") not in ("true", "1")
    return replace(value, linear=linear, convert_units=convert)


def _content(
    element: Element, holder: str | None, tag: str, *, kind: str, path: Path, folder: Path, what: str
) -> Element:
    """Return the root of the file that `element` names, or of its inline content."""
    if (element.get("type") or kind) != kind:
        raise FmuError(f"{what} is of type {element.get('type')}", where=path, fix=f"use {kind}")
    if element.get("sourceBase", "SSD") != "SSD":
        raise FmuError(f"{what} is inside a component", where=path, fix="move it into resources/")
    if element.get("source"):
        root: Element | None = parse(path, inside(path, folder, element.get("source"), what), what)
    else:
        inline = element if holder is None else element.find(holder)
        root = None if inline is None else inline.find(tag)
    if root is None or root.tag != tag:
        raise FmuError(f"{what} has no {tag.rpartition('}')[2]}", where=path, fix="export the system again")
    return root
