"""Result files of Modelica tools (``.mat`` by Dymola, OpenModelica and others): trajectories by variable."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.errors import MeasurementsError, UnitError
from fmuid.core.immutable import FloatArray
from fmuid.core.units import check_unit
from fmuid.data.recordings.recording import Column, Recording, from_columns, left_out
from fmuid.data.table_layout import TableLayout

_CONSTANTS = 1  # number of the matrix of constants, which has two samples
_UNIT = re.compile(r"\[(?P<unit>[^\[\]|:#]+)(?:[|:#][^\[\]]*)?\]\s*\Z")  # "[rad/s]", "[rad|deg]"; not "[:#(...)]"


def is_trajectory(names: Collection[str]) -> bool:
    """Return whether a MATLAB file with these variables is such a result file."""
    return {"Aclass", "name", "dataInfo"} <= set(names)


def read(content: Mapping[str, Any], layout: TableLayout, path: Path) -> Recording:
    """Return the trajectories in a result file, with the units that descriptions end with.

    Variables that are constant in the run are left out unless `layout` chooses them.

    Parameters
    ----------
    content
        The file's matrices, with text as arrays of characters.
    layout, path
        As for `fmuid.data.recordings.read_recording`.

    Raises
    ------
    MeasurementsError
        The matrices do not fit together.
    """
    try:
        columns, constants = _columns(content)
    except (KeyError, IndexError, ValueError, TypeError, AttributeError):
        what = "is a damaged result file of a Modelica tool"
        raise MeasurementsError(what, where=path, fix="write it again") from None
    if layout.chosen:
        return from_columns(columns | constants, layout, path)
    return from_columns(columns, layout, path, notes=left_out(constants, "constant in this run"))


def _columns(content: Mapping[str, Any]) -> tuple[dict[str, Column], dict[str, Column]]:
    """Return the variables that change, the time first, and those that do not."""
    transposed = "".join(content["Aclass"].reshape(4, -1)[3]).strip("\0 ") != "binNormal"

    def rows(matrix: str) -> Any:
        return content[matrix].T if transposed else content[matrix]

    names = _texts(rows("name"))
    units = (
        [_unit(text) for text in _texts(rows("description"))] if "description" in content else [None] * len(names)
    )
    info = np.asarray(rows("dataInfo"), dtype=np.int64)
    matrices = {int(m): np.asarray(rows(f"data_{m}"), dtype=np.float64) for m in {*info[:, 0].tolist()} - {0}}
    time = next(m for m in sorted(matrices) if m != _CONSTANTS)
    changing, constant = dict[str, Column](), dict[str, Column]()
    for name, unit, (matrix, place) in zip(names, units, info[:, :2].tolist(), strict=True):
        values: FloatArray = matrices[matrix or time][:, abs(place) - 1] * (-1.0 if place < 0 else 1.0)
        if matrix == _CONSTANTS:
            constant[name] = Column(np.full(len(matrices[time]), values[0]), unit)
        else:
            changing[name] = Column(values, unit)
    first = [name for name, (_, place) in zip(names, info[:, :2].tolist(), strict=True) if place == 1][:1]
    return {name: changing[name] for name in (*first, *(n for n in changing if n not in first))}, constant


def _texts(characters: Any) -> list[str]:
    texts = ("".join(row).rstrip("\0 ") for row in characters)
    return [_decoded(text) for text in texts]


def _decoded(text: str) -> str:
    """Return text whose bytes are UTF-8, or otherwise Latin-1, as which the file was read."""
    try:
        return text.encode("latin-1").decode("utf-8")
    except UnicodeError:
        return text


def _unit(description: str) -> str | None:
    match = _UNIT.search(description)
    if match is None:
        return None
    try:
        check_unit(match["unit"].strip())
    except UnitError:
        return None
    return match["unit"].strip()
