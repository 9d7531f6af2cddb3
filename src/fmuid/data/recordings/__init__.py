"""Readers of recorded runs in common file formats; each returns tables over time.

One module per format: CSV, MATLAB, HDF5, and with extras Parquet, MF4, ROS bags and MCAP. Nothing is resampled
here: signals with different time bases stay separate until the user says how to combine them (`resampling`).
"""

from __future__ import annotations

import importlib
from collections.abc import Collection
from functools import partial
from pathlib import Path

from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import read_csv
from fmuid.data.isolated_reader import read_isolated
from fmuid.data.recordings.recording import Recording
from fmuid.data.table_layout import TableLayout

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


_SELF_DESCRIBED = ("mdf", "rosbag")


def read_recording(path: str | Path, names: Collection[str] = (), layout: TableLayout | None = None) -> Recording:
    """Read one recorded run.

    Parameters
    ----------
    path
        ``.mat``, ``.h5``, ``.hdf5``, ``.parquet``, ``.mf4``, ``.mdf``, ``.bag``, ``.db3`` or ``.mcap``; any other
        name is read as CSV.
    names
        Signals to read; all by default.
    layout
        Names of columns, and the rate of a file without times.

    Returns
    -------
    Recording
        One table per time base, times in s; units if the file states them.

    Raises
    ------
    MeasurementsError
        The file is missing, damaged or has no time; it lacks a signal in `names`; or its library is not installed.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder, not a file" if path.is_dir() else "no such file"
        raise MeasurementsError(what, where=path, fix="check the path")
    module, layout = _MODULES.get(path.suffix.casefold()), layout or TableLayout()
    if module is None:
        table = read_csv(path, layout)
        recording = Recording((table,), notes=table.notes)
    else:
        read = importlib.import_module(f"fmuid.data.recordings.{module}").read
        if module not in _SELF_DESCRIBED:
            read = partial(read, layout=layout)
        elif layout != TableLayout():
            raise MeasurementsError(
                "has names and times for its signals",
                where=path,
                fix="leave out --columns and --rate, and choose signals with --signal",
            )
        recording = read_isolated(read, path)
    return recording.only(names, path)
