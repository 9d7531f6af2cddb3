"""ASAM MDF files (``.mf4``, ``.mdf``); only this module imports asammdf."""

from __future__ import annotations

import gc
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.errors import MeasurementsError
from fmuid.data.recordings.recording import Recording, Vector, by_time_base, is_numeric, left_out

asammdf: Any
try:
    import asammdf
except ImportError:
    asammdf = None


def read(path: Path) -> Recording:
    """Read an MDF file; see `fmuid.data.recordings.read_recording`.

    Each channel group has its own time base. A name that occurs in several groups gets the group's number as a
    suffix, as in ``speed#2``. Samples that the file marks as invalid are missing.
    """
    if asammdf is None:
        raise MeasurementsError("needs asammdf", where=path, fix="pip install 'fmuid[mf4]'")
    with path.open("rb") as file:
        if file.read(3) != b"MDF":
            raise MeasurementsError("is not an MDF file", where=path, fix="check the file")
    others: list[str] = []
    with _quiet_ends():
        vectors, trouble = _parsed(path, others)
    if trouble:
        raise MeasurementsError(f"cannot be read as MDF ({trouble})", where=path, fix="write it again")
    return by_time_base(vectors, path, left_out(others, "not numeric"))


def _parsed(path: Path, others: list[str]) -> tuple[list[Vector], str]:
    """Return the vectors, or what is wrong."""
    try:
        with asammdf.MDF(path) as file:
            return list(_vectors(file, others)), ""
    except Exception as error:  # the parser may raise anything on damaged files
        return [], (str(error).splitlines() or [""])[0] or type(error).__name__


@contextmanager
def _quiet_ends() -> Iterator[None]:
    """Suppress messages about objects that asammdf leaves half-made, and that fail again when they are deleted."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
        gc.collect()
    finally:
        sys.unraisablehook = hook


def _vectors(file: Any, others: list[str]) -> Iterator[Vector]:
    places = [
        (g, c, channel.name)
        for g, group in enumerate(file.groups)
        for c, channel in enumerate(group.channels)
        if c != file.masters_db.get(g)
    ]
    times = Counter(name for _, _, name in places)
    for g, c, channel_name in places:
        name = channel_name if times[channel_name] == 1 else f"{channel_name}#{g}"
        signal = file.get(group=g, index=c, ignore_invalidation_bits=True)
        if not is_numeric(signal.samples):  # texts of a conversion: use the numbers behind them
            signal = file.get(group=g, index=c, ignore_invalidation_bits=True, raw=True)
        if not is_numeric(signal.samples) or signal.samples.ndim != 1:
            others.append(name)
            continue
        values = signal.samples.astype(np.float64)
        if signal.invalidation_bits is not None:
            values[np.asarray(signal.invalidation_bits, dtype=bool)] = np.nan
        yield Vector(name.replace("/", "."), signal.timestamps.astype(np.float64), values, signal.unit or None)
