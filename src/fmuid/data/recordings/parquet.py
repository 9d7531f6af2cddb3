"""Parquet files; only this module imports pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import TIMES, name_and_unit
from fmuid.data.recordings.recording import Column, Recording, from_columns, left_out
from fmuid.data.table_layout import TableLayout

try:
    from pyarrow import parquet
except ImportError:
    parquet = None
else:
    import pyarrow as pa
    import pyarrow.compute as pc


def read(path: Path, layout: TableLayout) -> Recording:
    """Read a Parquet file; see `fmuid.data.recordings.read_recording`.

    Units are in the columns' names, as in ``tau [N.m]``, or in their metadata, as ``unit``. The time axis contains
    numbers or dates; the first date becomes 0 s. Null marks a missing sample.
    """
    if parquet is None:
        raise MeasurementsError("needs pyarrow", where=path, fix="pip install 'fmuid[parquet]'")
    try:
        with path.open("rb") as file:
            table = parquet.read_table(file)
        arrays = {n: _numbers(table.column(i)) for i, n in enumerate(table.column_names)}
    except (pa.ArrowException, OSError, ValueError) as error:
        words = str(error).splitlines()[0].rpartition("'<Buffer>': ")[2]
        raise MeasurementsError(f"cannot be read as Parquet ({words})", where=path, fix="write it again") from None
    columns: dict[str, Column] = {}
    dates = False
    for header, values in arrays.items():
        field = table.schema.field(header)
        if values is not None:
            name, unit = name_and_unit(header)
            metadata = field.metadata or {}
            stated = metadata.get(b"unit", metadata.get(b"units"))
            temporal = pa.types.is_temporal(field.type)
            dates |= temporal and name.casefold() in TIMES
            columns[name] = Column(
                values, "s" if temporal else unit if stated is None else stated.decode(errors="replace")
            )
        elif name_and_unit(header)[0].casefold() in TIMES:
            raise MeasurementsError(f"column '{header}' does not contain times", where=path, fix="write it in s")
    notes = left_out([h for h, c in arrays.items() if c is None], "not numeric")
    return from_columns(
        columns, layout, path, notes=(*notes, *(["time starts at the first date"] if dates else []))
    )


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
