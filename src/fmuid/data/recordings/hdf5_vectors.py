"""HDF5 files of any layout: in every group with a `time` or `t`, the vectors of the same length."""

from __future__ import annotations

from pathlib import Path

from fmuid.core.errors import MeasurementsError
from fmuid.data import hdf5
from fmuid.data.crosscheck_csv import TIMES, in_seconds
from fmuid.data.measurements import FORMAT
from fmuid.data.recordings.recording import Column, Recording, Vector, by_time_base, from_columns, left_out
from fmuid.data.table_layout import TableLayout


def read(path: Path, layout: TableLayout) -> Recording:
    """Read an HDF5 file; see `fmuid.data.recordings.read_recording`.

    A vector belongs to the time axis of its group or of the nearest group above. Its unit is the attribute `unit`
    or `units`; its name is its path below the group of the time axis, with dots.
    """
    kind, stored, others = hdf5.vectors(path)
    if kind == FORMAT:
        raise MeasurementsError("is already a measurement file", where=path, fix="name it in campaign.toml")
    if layout != TableLayout():
        columns = {".".join(place): Column(v.values, v.unit) for place, v in stored.items()}
        return from_columns(columns, layout, path, notes=left_out(others, "not vectors"))
    times = {p: v for p, v in stored.items() if p[-1].casefold() in TIMES}
    axes = {p[:-1]: in_seconds(v.values, v.unit, path) for p, v in times.items()}
    vectors = []
    for place, vector in stored.items():
        above = next((place[:k] for k in range(len(place) - 1, -1, -1) if place[:k] in axes), None)
        if place in times:
            continue
        if above is None or axes[above].size != vector.values.size:
            others.append(".".join(place))
            continue
        name = ".".join(place if len(axes) > 1 else place[len(above) :])
        vectors.append(Vector(name, axes[above], vector.values, vector.unit))
    return by_time_base(vectors, path, left_out(others, "not vectors as long as a time axis"))
