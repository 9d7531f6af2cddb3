"""Runs in data frames of pandas, polars or pyarrow."""

from __future__ import annotations

from datetime import date, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    columns: dict[str, Column] = {}
    others, dates = [], False
    for header, column in columns_of(frame).items():
        name, unit = name_and_unit(header)
        values, temporal = _numbers(column)
        is_time = name.casefold() in TIMES
        if values is None:
            if is_time:
                raise MeasurementsError(
                    f"column '{header}' does not contain times", where=run, fix="write it in s"
                )
            elements = _elements(np.asarray(column))
            columns |= {f"{name}[{k + 1}]": Column(v, unit) for k, v in enumerate(elements)}
            others += [] if len(elements) else [header]
            continue
        dates |= temporal and is_time
        columns[name] = Column(values, "s" if temporal else unit)
    notes = left_out(others, "not numeric")
    return from_columns(
        columns, layout, Path(run), notes=(*notes, *(["time starts at the first date"] if dates else []))
    )


def _elements(cells: NDArray[Any]) -> FloatArray:
    """Return the (k, N) elements of a column of lists of one length; none if it has another type."""
    try:
        rows = [np.asarray(cell, dtype=np.float64) for cell in cells]
        return np.stack(rows).T if rows and rows[0].ndim == 1 else np.empty((0, 0))
    except (TypeError, ValueError):
        return np.empty((0, 0))


def _numbers(column: Any) -> tuple[FloatArray | None, bool]:
    """Return a column as float64 (N,), None if it has another type, and whether it contains dates or durations.

    These become s from the first.
    """
    values = np.asarray(column)
    if values.dtype.kind in "mM":
        since = values - values[:1]
        return np.where(np.isnat(since), np.nan, since / np.timedelta64(1, "s")), True
    if values.dtype != object:
        return (values.astype(np.float64) if values.dtype.kind in "biuf" and values.ndim == 1 else None), False
    # Python objects: pandas gives them for time zones, all libraries for Booleans with nulls.
    null = column.isna() if hasattr(column, "isna") else [value is None for value in values]
    there = ~np.asarray(null, dtype=bool)
    present, numbers = values[there], np.full(values.size, np.nan)
    temporal = present.size > 0 and all(isinstance(value, date | timedelta) for value in present)
    if temporal:
        numbers[there] = [(value - present[0]) / timedelta(seconds=1) for value in present]
    elif present.size > 0 and all(isinstance(value, int | float | np.number | np.bool_) for value in present):
        numbers[there] = present
    else:
        return None, False
    return numbers, temporal
