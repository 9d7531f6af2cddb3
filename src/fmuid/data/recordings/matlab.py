"""MATLAB files: vectors as long as `time` or `t`. These files state no units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.suggest import known_names
from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import TIMES
from fmuid.data.recordings.recording import Recording, Vector, by_time_base, is_numeric, left_out


def read(path: Path) -> Recording:
    """Read a ``.mat`` file of any version; see `fmuid.data.recordings.read_recording`."""
    variables = _variables(path)
    if variables is None:  # version 7.3 is HDF5
        from fmuid.data.recordings import hdf5_vectors

        return hdf5_vectors.read(path)
    name = next((n for n in variables if n.casefold() in TIMES), None)
    if name is None:
        raise MeasurementsError(
            "has no vector 'time' or 't'", where=path, fix=f"save one, in s; {known_names(variables)}"
        )
    time = variables[name]
    if not _is_vector(time) or time.size < 2:
        raise MeasurementsError(f"'{name}' is not a vector of times", where=path, fix="save it N by 1, in s")
    fitting = {n: v for n, v in variables.items() if n != name and _is_vector(v) and v.size == time.size}
    if not fitting:
        raise MeasurementsError(
            f"has no vector as long as '{name}' ({time.size})", where=path, fix="save the signals, N by 1"
        )
    others = [n for n in variables if n != name and n not in fitting]
    vectors = (Vector(n, time.astype(np.float64), v.astype(np.float64)) for n, v in fitting.items())
    return by_time_base(vectors, path, left_out(others, f"not vectors as long as '{name}'"))


def _variables(path: Path) -> dict[str, Any] | None:
    from scipy.io import loadmat

    try:
        found = loadmat(path, squeeze_me=True)
    except NotImplementedError:
        return None
    except Exception:  # the parser may raise anything on damaged files
        raise MeasurementsError(
            "is not a readable MATLAB file", where=path, fix="save it with: save -v7"
        ) from None
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _is_vector(value: Any) -> bool:
    return is_numeric(value) and value.ndim == 1
