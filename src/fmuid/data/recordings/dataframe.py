"""Runs in data frames of pandas, polars or pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import narwhals as nw
import numpy as np

from fmuid.core.errors import MeasurementsError
from fmuid.core.frames import columns_of
from fmuid.core.immutable import FloatArray
from fmuid.data.crosscheck_csv import TIMES, name_and_unit
from fmuid.data.recordings.recording import Column, Recording, from_columns, left_out
from fmuid.data.table_layout import TableLayout


def from_frame(frame: Any, run: str, layout: TableLayout) -> Recording:
    """Return the recording in a data frame whose column names state units, as in ``tau [N.m]``.

    Time is a column or a named pandas index with numbers or dates; the first date becomes 0 s. Null marks a
    missing sample. A column of lists becomes one column per element.

    Raises
    ------
    MeasurementsError
        There is no time, or no other column.
    """
    found: dict[str, Column] = {}
    others, dates = [], False
    for header, column in columns_of(frame).items():
        name, unit = name_and_unit(header)
        values, is_time = _numbers(column), name.casefold() in TIMES
        if values is None:
            if is_time:
                raise MeasurementsError(
                    f"column '{header}' does not contain times", where=run, fix="write it in s"
                )
            elements = _elements(column)
            found |= {f"{name}[{k + 1}]": Column(v, unit) for k, v in enumerate(elements)}
            others += [] if len(elements) else [header]
            continue
        temporal = column.dtype.is_temporal()
        dates |= temporal and is_time
        found[name] = Column(values, "s" if temporal else unit)
    notes = left_out(others, "not numeric")
    return from_columns(
        found, layout, Path(run), notes=(*notes, *(["time starts at the first date"] if dates else []))
    )


def _elements(column: nw.Series[Any]) -> FloatArray:
    """Return the (k, N) elements of a column of lists of one length; none if it has another type."""
    try:
        rows = [np.asarray(cell, dtype=np.float64) for cell in column.to_list()]
        return np.stack(rows).T if rows and rows[0].ndim == 1 else np.empty((0, 0))
    except (TypeError, ValueError):
        return np.empty((0, 0))


def _numbers(column: nw.Series[Any]) -> FloatArray | None:
    """Return a column as float64 (N,), dates and durations in s from the first; None if it has another type."""
    if column.dtype.is_temporal():
        since = (column - column[0]).dt.total_nanoseconds()
        return np.asarray(since.cast(nw.Float64).to_numpy(), dtype=np.float64) * 1e-9
    if not (column.dtype.is_numeric() or column.dtype == nw.Boolean):
        return None
    return np.asarray(column.cast(nw.Float64).to_numpy(), dtype=np.float64)
