"""Parquet files; only this module imports pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.suggest import known_names
from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import TIMES, name_and_unit
from fmuid.data.recordings.recording import Recording, Vector, by_time_base, in_seconds, left_out

try:
    from pyarrow import parquet
except ImportError:
    parquet = None
else:
    import pyarrow as pa
    import pyarrow.compute as pc


def read(path: Path) -> Recording:
    """Read a Parquet file; see `fmuid.data.recordings.read_recording`.

    Units are in the columns' names, as in ``tau [N.m]``, or in their metadata, as ``unit``. The time axis contains
    numbers or dates; the first date becomes 0 s. Null marks a missing sample.
    """
    if parquet is None:
        raise MeasurementsError("needs pyarrow", where=path, fix="pip install 'fmuid[parquet]'")
    try:
        with path.open("rb") as file:
            table = parquet.read_table(file)
        columns = {n: _numbers(table.column(i)) for i, n in enumerate(table.column_names)}
    except (pa.ArrowException, OSError, ValueError) as error:
        words = str(error).splitlines()[0].rpartition("'<Buffer>': ")[2]
        raise MeasurementsError(f"cannot be read as Parquet ({words})", where=path, fix="write it again") from None
    named = {header: name_and_unit(header) for header in columns}
    time_header = next((h for h, (n, _) in named.items() if n.casefold() in TIMES), None)
    if time_header is None:
        raise MeasurementsError(
            "has no column 'time' or 't'", where=path, fix=f"write a time column in s; {known_names(columns)}"
        )
    values = columns.pop(time_header)
    kind = table.schema.field(time_header).type
    if values is None:
        raise MeasurementsError(f"column '{time_header}' does not contain times", where=path, fix="write it in s")
    dates = pa.types.is_temporal(kind)
    time = values if dates else in_seconds(values, named[time_header][1], path)
    vectors = []
    for header, column in columns.items():
        if column is not None:
            name, unit = named[header]
            metadata = table.schema.field(header).metadata or {}
            stated = metadata.get(b"unit", metadata.get(b"units"))
            vectors.append(Vector(name, time, column, unit if stated is None else stated.decode(errors="replace")))
    notes = left_out([h for h, c in columns.items() if c is None], "not numeric")
    return by_time_base(vectors, path, (*notes, *(["time starts at the first date"] if dates else [])))


def _numbers(column: Any) -> Any:
    """Return a column as float64 (N,), dates and durations in s from the first; None if it has another type."""
    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
        ticks = column.cast(pa.int64())
        per_second = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[kind.unit]
        first = ticks[0].as_py() if len(ticks) else None
        # Subtracted as integers, because nanoseconds since 1970 do not fit into a double.
        return None if first is None else _array(pc.subtract(ticks, first)) / per_second
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
        return None
    return _array(column)


def _array(column: Any) -> Any:
    return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)
