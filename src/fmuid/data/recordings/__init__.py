"""Runs in the files that people have, read into tables over time.

One module a format: CSV, MATLAB, HDF5, and with extras Parquet, MF4, ROS bags and MCAP. Nothing is resampled here:
signals with different time bases stay apart until the user says how to bring them together (`resampling`).
"""

from __future__ import annotations

import importlib
from collections.abc import Collection, Sequence
from pathlib import Path

from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import read_csv
from fmuid.data.isolated_reader import read_apart
from fmuid.data.recordings.recording import Recording

__all__ = ["Recording", "read_recording"]

_MODULES = {
    ".mat": "matlab",
    ".h5": "hdf5_vectors",
    ".hdf5": "hdf5_vectors",
    ".parquet": "parquet",
    ".mf4": "mdf",
    ".mdf": "mdf",
    ".bag": "rosbag",
    ".db3": "rosbag",
    ".mcap": "rosbag",
}


def read_recording(path: str | Path, names: Collection[str] = (), columns: Sequence[str] = ()) -> Recording:
    """Read one recorded run.

    Parameters
    ----------
    path
        ``.mat``, ``.h5``, ``.hdf5``, ``.parquet``, ``.mf4``, ``.mdf``, ``.bag``, ``.db3`` or ``.mcap``; any other
        name is read as CSV.
    names
        Signals to read; all by default.
    columns
        Headers of a CSV file that has none.

    Returns
    -------
    Recording
        A table for each time base, times in s; units where the file states them.

    Raises
    ------
    MeasurementsError
        The file is missing, damaged or has no time; a name is not in it; the library for it is not installed.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder, not a file" if path.is_dir() else "no such file"
        raise MeasurementsError(what, where=path, fix="check the path")
    module = _MODULES.get(path.suffix.casefold())
    if module is None:
        table = read_csv(path, columns)
        found = Recording((table,), notes=table.notes)
    else:
        found = read_apart(importlib.import_module(f"fmuid.data.recordings.{module}").read, path)
    return found.only(names, path)
