"""Runs in data frames of pandas, polars or pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import narwhals as nw
import numpy as np

from fmu_build.suggest import known_names
from fmuid.core.errors import MeasurementsError
from fmuid.core.frames import columns_of
from fmuid.core.immutable import FloatArray
from fmuid.data.crosscheck_csv import TIMES, name_and_unit
from fmuid.data.recordings.recording import Recording, Vector, by_time_base, in_seconds, left_out


def from_frame(frame: Any, run: str) -> Recording:
    """Return the recording in a data frame whose column names state units, as in ``tau [N.m]``.

    Time is a column or a named pandas index with numbers or dates; the first date becomes 0 s. Null marks a
    missing sample.

    Raises
    ------
    MeasurementsError
        There is no time, or no other column.
    """
    where, columns = Path(run), columns_of(frame)
    header = next((h for h in columns if name_and_unit(h)[0].casefold() in TIMES), None)
    if header is None:
        fix = f"give one column this name, with times in s; {known_names(columns)}"
        raise MeasurementsError("has no column 'time' or 't'", where=run, fix=fix)
    column = columns.pop(header)
    values = _numbers(column)
    if values is None:
        raise MeasurementsError(f"column '{header}' does not contain times", where=run, fix="write it in s")
    dates = column.dtype.is_temporal()
    time = values if dates else in_seconds(values, name_and_unit(header)[1], where)
    numbers = {header: _numbers(column) for header, column in columns.items()}
    vectors = [
        Vector(name_and_unit(h)[0], time, v, name_and_unit(h)[1]) for h, v in numbers.items() if v is not None
    ]
    notes = left_out([h for h, v in numbers.items() if v is None], "not numeric")
    return by_time_base(vectors, where, (*notes, *(["time starts at the first date"] if dates else [])))


def _numbers(column: nw.Series[Any]) -> FloatArray | None:
    """Return a column as float64 (N,), dates and durations in s from the first; None if it has another type."""
    if column.dtype.is_temporal():
        since = (column - column[0]).dt.total_nanoseconds()
        return np.asarray(since.cast(nw.Float64).to_numpy(), dtype=np.float64) * 1e-9
    if not (column.dtype.is_numeric() or column.dtype == nw.Boolean):
        return None
    return np.asarray(column.cast(nw.Float64).to_numpy(), dtype=np.float64)
