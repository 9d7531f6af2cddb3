"""Parquet files; only this module imports pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import name_and_unit
from fmuid.data.recordings.dataframe import from_frame
from fmuid.data.recordings.recording import Recording
from fmuid.data.table_layout import TableLayout

try:
    from pyarrow import ArrowException, parquet
except ImportError:
    parquet = None


def read(path: Path, layout: TableLayout) -> Recording:
    """Read a Parquet file as a data frame; see `fmuid.data.recordings.read_recording`.

    Units are in the columns' names, as in ``tau [N.m]``, or in their metadata, as ``unit``.
    """
    if parquet is None:
        raise MeasurementsError("needs pyarrow", where=path, fix="pip install 'fmuid[parquet]'")
    try:
        with path.open("rb") as file:
            table = parquet.read_table(file)
        return from_frame(table.rename_columns([_header(field) for field in table.schema]), str(path), layout)
    except (ArrowException, OSError, ValueError) as error:
        words = str(error).splitlines()[0].rpartition("'<Buffer>': ")[2]
        raise MeasurementsError(f"cannot be read as Parquet ({words})", where=path, fix="write it again") from None


def _header(field: Any) -> str:
    """Return the name of a column with its unit; one in the metadata wins."""
    metadata = field.metadata or {}
    unit = metadata.get(b"unit", metadata.get(b"units"))
    return field.name if unit is None else f"{name_and_unit(field.name)[0]} [{unit.decode(errors='replace')}]"
