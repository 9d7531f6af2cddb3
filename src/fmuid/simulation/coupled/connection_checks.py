"""Checks that connections fit their components."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from fmu_build.suggest import suggestion
from fmuid.core.coupling import Connection, Linear, Place, Port
from fmuid.core.errors import FmuError, UnitError
from fmuid.core.units import conversion
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Variable

_REAL = ("Real", "Float64", "Float32")


def variable_at(where: object, components: Mapping[str, Fmu], place: Place) -> Variable:
    """Return the variable at a place.

    Raises
    ------
    FmuError
        The component or its variable does not exist.
    """
    if place.component not in components:
        raise FmuError(
            f"no component '{place.component}' for '{place}'",
            where=where,
            fix=suggestion(place.component, components),
        )
    variables = components[place.component].variables
    if place.variable not in variables:
        known = [n for n, v in variables.items() if v.causality in ("input", "output")]
        raise FmuError(
            f"component '{place.component}' has no variable '{place.variable}'",
            where=where,
            fix=suggestion(place.variable, known),
        )
    return variables[place.variable]


def unit_conversion(where: object, source: str, source_unit: str | None, target: str, unit: str | None) -> Linear:
    """Return the conversion between the units of connected variables; the identity if one of them has no unit.

    Raises
    ------
    UnitError
        The units measure different quantities.
    """
    if not source_unit or not unit:
        return Linear()
    try:
        convert = conversion(source_unit, unit)
    except UnitError as error:
        raise UnitError(f"{source} -> {target}: {error.what}", where=where, fix=error.fix) from None
    return Linear(convert.factor, convert.offset)


def check_connections(where: Path, components: Mapping[str, Fmu], connections: Sequence[Connection]) -> None:
    """Check that connections lead from outputs to inputs of the same type, at most one to each input.

    Raises
    ------
    FmuError
        Something does not fit; the message names it.
    """
    sources: dict[Place, Place] = {}
    for k in connections:
        source, target = (variable_at(where, components, p) for p in (k.source, k.target))
        for place, variable, wanted in ((k.source, source, "output"), (k.target, target, "input")):
            if variable.causality != wanted:
                variables = components[place.component].variables
                fitting = [n for n, v in variables.items() if v.causality == wanted]
                article = "an" if variable.causality[0] in "aeiou" else "a"
                raise FmuError(
                    f"{k.source} -> {k.target}: '{place}' is {article} {variable.causality}, not an {wanted}",
                    where=where,
                    fix=suggestion(place.variable, fitting),
                )
        if not _fits(source, target):
            raise FmuError(
                f"{k.source} -> {k.target}: {source.type} cannot drive {target.type}",
                where=where,
                fix="connect variables of one type",
            )
        if k.target in sources:
            raise FmuError(
                f"input '{k.target}' follows both '{sources[k.target]}' and '{k.source}'",
                where=where,
                fix="remove one of the connections",
            )
        sources[k.target] = k.source


def check_ports(
    where: Path, components: Mapping[str, Fmu], connections: Sequence[Connection], ports: Sequence[Port]
) -> None:
    """Check that ports lead to variables of matching causality that no other source drives.

    Raises
    ------
    FmuError
        Something does not fit; the message names it.
    """
    sources: dict[Place, object] = {k.target: k.source for k in connections}
    for port in ports:
        for place, _ in port.ends:
            variable = variable_at(where, components, place)
            fitting = {"input": ("input",), "output": ("output",), "parameter": ("parameter", "input")}
            if variable.causality not in fitting[port.causality]:
                raise FmuError(
                    f"{port.causality} '{port.name}' of the system cannot be connected to '{place}'"
                    f" ({variable.causality})",
                    where=where,
                    fix="connect variables of one causality",
                )
            if port.causality != "output":
                if place in sources:
                    raise FmuError(
                        f"'{place}' follows both '{sources[place]}' and '{port.name}'",
                        where=where,
                        fix="remove one of the connections",
                    )
                sources[place] = port.name


def _fits(source: Variable, target: Variable) -> bool:
    if target.type in _REAL:
        return source.type != "String" and source.type != "Binary"
    if target.type == "Boolean" or source.type == "Boolean":
        return source.type == target.type
    return source.type not in (*_REAL, "String", "Binary", "Clock")
