"""MATLAB files: vectors, and columns of matrices, as long as the time. Only result files of tools state units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.errors import MeasurementsError
from fmuid.data.recordings import trajectory
from fmuid.data.recordings.recording import Column, Recording, from_columns, is_numeric, left_out
from fmuid.data.table_layout import TableLayout


def read(path: Path, layout: TableLayout) -> Recording:
    """Read a ``.mat`` file of any version; see `fmuid.data.recordings.read_recording`.

    The columns of a matrix ``data`` are ``data[1]``, ``data[2]`` and so on. In result files of Modelica tools,
    variables have their own names.
    """
    variables = _variables(path)
    if variables is None:  # version 7.3 is HDF5
        from fmuid.data.recordings import hdf5_vectors

        return hdf5_vectors.read(path, layout)
    if trajectory.is_trajectory(variables):
        return trajectory.read(variables, layout, path)
    columns: dict[str, Column] = {}
    others = []
    for name, content in variables.items():
        value = np.atleast_1d(content) if isinstance(content, int | float | np.number) else content
        if not is_numeric(value) or value.ndim > 2:
            others.append(name)
        elif value.ndim < 2:
            columns[name] = Column(value.reshape(-1).astype(np.float64))
        else:
            columns |= {f"{name}[{k + 1}]": Column(c.astype(np.float64)) for k, c in enumerate(value.T)}
    return from_columns(columns, layout, path, notes=left_out(others, "not numeric"))


def _variables(path: Path) -> dict[str, Any] | None:
    from scipy.io import loadmat, whosmat

    try:
        of_tool = trajectory.is_trajectory({name for name, _, _ in whosmat(path)})
        content = loadmat(path, squeeze_me=not of_tool, chars_as_strings=not of_tool)
    except NotImplementedError:
        return None
    except Exception:  # the parser may raise anything on damaged files
        raise MeasurementsError(
            "is not a readable MATLAB file", where=path, fix="save it with: save -v7"
        ) from None
    return {name: value for name, value in content.items() if not name.startswith("__")}
