"""The keys of ``[models.<setup>]`` in campaign.toml that couple FMUs."""

# ruff: noqa: RUF012 - msgspec copies the empty containers that are defaults

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from fmu_build.suggest import suggestion
from fmuid.core.coupling import Coupling, Linear, Master
from fmuid.core.errors import CampaignError
from fmuid.core.toml_tables import Table, convert, finite

_MASTER = ("step", "algorithm", "extrapolation", "loops", "loop_tolerance", "loop_iterations")
_EXTRAPOLATIONS = ("constant", "linear")


class CoupledTable(Table):
    """Coupling keys of a model's table; omitted keys have the defaults of `Master`."""

    fmu: str = ""
    fmus: dict[str, str] = {}
    connections: dict[str, Any] = {}
    step: float | None = None
    algorithm: Literal["jacobi", "gauss_seidel"] | None = None
    extrapolation: str | dict[str, str] | None = None
    loops: Literal["refuse", "delay", "iterate"] | None = None
    loop_tolerance: float | None = None
    loop_iterations: int | None = None
    main: str = ""


class _ConnectionTable(Table):
    from_: str = msgspec.field(name="from")
    factor: float = 1.0
    offset: float = 0.0


def coupling_of(table: CoupledTable, folder: Path, where: str) -> Coupling | None:
    """Return the coupling in a model's table, None if it names one FMU.

    Raises
    ------
    CampaignError
        Keys contradict each other, or a connection or value is malformed.
    """
    if bool(table.fmu) == bool(table.fmus):
        what = "names both 'fmu' and 'fmus'" if table.fmu else "has no 'fmu'"
        raise CampaignError(
            what, where=where, fix='write fmu = "file", source = "file.mo", or fmus = { name = "file", ... }'
        )
    options = _options(table)
    if table.connections and not table.fmus:
        raise CampaignError("has connections but only one FMU", where=where, fix="name several FMUs in 'fmus'")
    if not table.fmus and Path(table.fmu).suffix != ".ssp":
        if options or table.main:
            raise CampaignError(
                f"'{next(iter(options), 'main')}' applies to coupled FMUs only",
                where=where,
                fix="leave it out for one FMU",
            )
        return None
    for name in table.fmus:
        if not name or "." in name:
            raise CampaignError(f"fmus: '{name}' is not a valid name", where=where, fix="use a name without dots")
    connections = dict(_connections(table.connections, "", f"{where} connections"))
    files = {name: folder / file for name, file in table.fmus.items()}
    return Coupling(_master(options, where), files, connections, table.main)


def master_of(texts: Sequence[str], where: str) -> Master:
    """Return a master from texts such as ``step=1e-3`` and ``algorithm=jacobi``, with the keys of the table.

    Raises
    ------
    CampaignError
        A key or a value is unknown.
    """
    words: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in _MASTER:
            raise CampaignError(f"unknown key '{name}'", where=where, fix=suggestion(name, _MASTER))
        try:
            words[name] = json.loads(value)
        except ValueError:
            words[name] = value
    return _master(_options(convert(words, CoupledTable, where)), where)


def _options(table: CoupledTable) -> dict[str, Any]:
    return {name: getattr(table, name) for name in _MASTER if getattr(table, name) is not None}


def _master(options: Mapping[str, Any], where: str) -> Master:
    for name in ("step", "loop_tolerance", "loop_iterations"):
        if name in options and not finite(name, options[name], where) > 0:
            raise CampaignError(f"'{name}' is {options[name]:g}", where=where, fix="write a positive number")
    chosen = options.get("extrapolation", "constant")
    for choice in [chosen] if isinstance(chosen, str) else chosen.values():
        if choice not in _EXTRAPOLATIONS:
            raise CampaignError(
                f"'extrapolation' is '{choice}'", where=where, fix=suggestion(choice, _EXTRAPOLATIONS)
            )
    return Master(**options)


def _connections(table: Mapping[str, Any], prefix: str, where: str) -> Iterator[tuple[str, tuple[str, Linear]]]:
    """Yield input -> (output, transformation); ``plant.i = "..."`` without quotes is the input ``plant.i``."""
    for key, value in table.items():
        name = f"{prefix}{key}"
        if isinstance(value, str):
            yield name, (value, Linear())
        elif isinstance(value, dict) and isinstance(value.get("from"), str):
            entry = convert(value, _ConnectionTable, f"{where} '{name}'")
            numbers = (finite(n, getattr(entry, n), f"{where} '{name}'") for n in ("factor", "offset"))
            yield name, (entry.from_, Linear(*numbers))
        elif isinstance(value, dict):
            yield from _connections(value, f"{name}.", where)
        else:
            raise CampaignError(f"'{name}' is not an output", where=where, fix='write "component.output"')
