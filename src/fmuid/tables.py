"""Tables over time from the files that people have: CSV and MATLAB."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fmuid.crosscheck_csv import Table, read_csv
from fmuid.errors import MeasurementsError
from fmuid.suggest import known_names

_TIMES = ("time", "t", "Time", "T")


def read_table(path: str | Path, *, delimiter: str = ",") -> tuple[Table, tuple[str, ...]]:
    """Read a ``.csv`` or ``.mat`` file (MATLAB version 7.2 or older).

    Returns
    -------
    Table
        The vectors as long as `time` (or `t`), by name. MATLAB files state no units.
    tuple of str
        Names of what the file has besides: scalars, texts, vectors of another length.

    Raises
    ------
    MeasurementsError
        The file is missing, damaged, or has no time.
    """
    path = Path(path)
    if path.suffix.casefold() != ".mat":
        return read_csv(path, delimiter=delimiter), ()
    variables = _read_mat(path)
    time_name = next((n for n in _TIMES if n in variables), None)
    if time_name is None:
        raise MeasurementsError(
            "has no vector 'time' or 't'", where=path, fix=f"save one, in s; {known_names(variables)}"
        )
    vectors = {n: v for n, v in variables.items() if _is_vector(v)}
    time = vectors.pop(time_name, np.zeros(0))
    columns = {n: v for n, v in vectors.items() if v.size == time.size}
    if time.size < 2 or not columns:
        raise MeasurementsError(
            f"has no vector as long as '{time_name}' ({time.size})", where=path, fix="save the signals, N by 1"
        )
    ignored = tuple(n for n in variables if n != time_name and n not in columns)
    return Table(time.astype(np.float64), {n: v.astype(np.float64) for n, v in columns.items()}, {}), ignored


def _read_mat(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    if not path.is_file():
        raise MeasurementsError("no such file", where=path, fix="check the path")
    try:
        found = loadmat(path, squeeze_me=True)
    except NotImplementedError:
        raise MeasurementsError("is a MATLAB 7.3 file", where=path, fix="save it with: save -v7") from None
    except Exception:  # damaged files make its parser raise anything
        raise MeasurementsError("is no readable MATLAB file", where=path, fix="save it with: save -v7") from None
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _is_vector(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiub"
