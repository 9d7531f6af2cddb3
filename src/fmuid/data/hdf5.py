"""Untrusted HDF5 files; only this module imports h5py.

The reader follows hard links only and refuses data stored in other files, so a file cannot expose anything else.
Every failure of the library becomes a one-line error.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from fmuid.core.errors import FmuidError, MeasurementsError
from fmuid.core.files import write_atomically
from fmuid.core.immutable import FloatArray

Group = h5py.Group
File = h5py.File
Error = type[FmuidError]

MAX_DEPTH = 8  # largest depth of groups: a hard link can lead back up
MAX_SAMPLES = 50_000_000  # samples in one dataset: 400 MB; a damaged or hostile header can claim any size

# Exceptions of h5py on damaged files, known from experience and fuzzing.
_H5PY_ERRORS = (
    OSError,
    RuntimeError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,
    MemoryError,
)


@contextmanager
def reading(path: Path, error: Error = MeasurementsError, *, fix: str | None = None) -> Iterator[Any]:
    """Open `path` for reading as an `h5py.File`; failures are raised as `error`, with `fix` if it is missing."""
    if not path.is_file():
        what = "is a folder, not a file" if path.is_dir() else "no such file"
        raise error(what, where=path, fix=fix or "check the path")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except FmuidError:
        raise
    except _H5PY_ERRORS as cause:
        raise error(f"cannot be read as HDF5 ({_first_line(cause)})", where=path, fix="write it again") from None


def write_file(path: Path, fill: Callable[[Any], None]) -> None:
    """Write an HDF5 file atomically: `fill` receives an empty `h5py.File`; `path` changes once it is complete."""
    memory = io.BytesIO()
    # The format of 2008: earlier, the names of some thousand runs exceed the size of an attribute.
    with h5py.File(memory, "w", libver="v108") as file:
        fill(file)
    write_atomically(path, memory.getvalue())


def member(group: Any, name: str, kind: Literal["group", "dataset"], error: Error, where: str) -> Any:
    """Return the group or dataset `name` of `group`; it must be a hard link to data in the same file."""
    link = group.get(name, getlink=True) if name in group.keys() else None  # noqa: SIM118 - `in group` follows links
    if link is None:
        raise error(f"has no {kind} '{name}'", where=where, fix=f"write the {kind}")
    if not isinstance(link, h5py.HardLink):
        raise error(
            f"'{name}' is a link to another place or file",
            where=where,
            fix="copy the data into this file itself",
        )
    element = group[name]
    if not isinstance(element, h5py.Group if kind == "group" else h5py.Dataset):
        raise error(f"'{name}' is not a {kind}", where=where, fix=f"write it as a {kind}")
    if kind == "dataset" and (element.is_virtual or element.external):
        raise error(
            f"'{name}' stores its data in other files", where=where, fix="copy the data into this file itself"
        )
    return element


def samples(dataset: Any, error: Error, where: str) -> FloatArray:
    """Return a one-dimensional float64 dataset."""
    dtype = dataset.dtype
    if not (dtype.kind == "f" and dtype.itemsize == 8):
        raise error(f"has type {dtype}, not float64", where=where, fix="write it as float64")
    if dataset.ndim != 1:
        raise error(f"has shape {dataset.shape}, not (N,)", where=where, fix="write one value per sample")
    return _read(dataset, error, where)


def _read(dataset: Any, error: Error, where: object, name: str = "") -> FloatArray:
    if dataset.size > MAX_SAMPLES:
        what = f"{name}has {dataset.size} samples, more than {MAX_SAMPLES}"
        raise error(what, where=where, fix="split the run or sample slower")
    return np.asarray(dataset[()], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class StoredVector:
    """An (N,) vector of numbers from a file of any layout, and its attribute `unit` or `units`."""

    values: FloatArray
    unit: str | None


def vectors(path: Path) -> tuple[str | None, dict[tuple[str, ...], StoredVector], list[str]]:
    """Return the vectors in an HDF5 file of any layout.

    Returns
    -------
    str or None
        The root attribute `format`.
    dict
        Place in the file -> vector; (N, 1) and (1, N) count as vectors.
    list of str
        Places of other datasets and of links.
    """
    stored: dict[tuple[str, ...], StoredVector] = {}
    others: list[str] = []
    with reading(path) as file:
        for place, dataset in _datasets(file, ()):
            if (
                dataset is not None
                and dataset.dtype.kind in "fiub"
                and max(dataset.shape, default=0) == dataset.size
            ):
                values = _read(dataset, MeasurementsError, path, f"'{'/'.join(place)}' ").reshape(-1)
                unit = next(
                    (_text_attribute(dataset, n, path) for n in ("unit", "units") if n in dataset.attrs), None
                )
                stored[place] = StoredVector(values, unit)
            else:
                others.append(".".join(place))
        kind = _text_attribute(file, "format", path) if "format" in file.attrs else None
    return kind, stored, others


def _text_attribute(holder: Any, name: str, path: Path) -> str:
    return text(holder, name, MeasurementsError, f"{path}: '{holder.name}'")


def _datasets(group: Any, place: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield place and dataset below `group`, reached by hard links and kept in the file; None for others."""
    for name in group.keys():  # noqa: SIM118
        here = (*place, name)
        link = group.get(name, getlink=True)
        item = group[name] if isinstance(link, h5py.HardLink) else None
        if isinstance(item, h5py.Group):
            if len(here) < MAX_DEPTH and not name.startswith("#"):  # MATLAB keeps its cells in #refs#
                yield from _datasets(item, here)
        elif isinstance(item, h5py.Dataset) and not (item.is_virtual or item.external):
            yield here, item
        else:
            yield here, None


def text(holder: Any, name: str, error: Error, where: str, *, default: str | None = None) -> str:
    """Return the string attribute `name`, or `default` if it is missing; without a default it is required."""
    value = _attribute(holder, name, error, where)
    if value is None:
        if default is None:
            raise error(f"has no attribute '{name}'", where=where, fix=f"write the string attribute '{name}'")
        return default
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str):
        raise error(f"attribute '{name}' is not a string", where=where, fix="write it as a string")
    if not value.replace("\n", " ").isprintable():
        raise error(f"attribute '{name}' has unprintable characters", where=where, fix="write it as plain text")
    return value


def number(holder: Any, name: str, error: Error, where: str) -> float | None:
    """Return the numeric scalar attribute `name`, or None if it is missing."""
    value = _attribute(holder, name, error, where)
    if value is None:
        return None
    if not isinstance(value, (bool, int, float, np.bool_, np.integer, np.floating)):
        raise error(f"attribute '{name}' is not a number", where=where, fix="write it as one number")
    return float(value)


def _attribute(holder: Any, name: str, error: Error, where: str) -> Any:
    if name not in holder.attrs:
        return None
    try:
        value = holder.attrs[name]
    except _H5PY_ERRORS as cause:
        raise error(
            f"attribute '{name}' cannot be read ({_first_line(cause)})", where=where, fix="write it again"
        ) from None
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]  # MATLAB writes scalars as arrays of one
    return value


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0].strip("'\" ") or type(error).__name__
