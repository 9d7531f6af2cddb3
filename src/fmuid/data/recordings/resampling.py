"""Resampling of signals with different time bases to a common one.

Nothing is resampled by default: the user names the time base, and every signal records how it was resampled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from fmu_build.errors import counted
from fmu_build.suggest import suggestion
from fmuid.core.errors import MeasurementsError
from fmuid.core.immutable import FloatArray
from fmuid.data.crosscheck_csv import Table
from fmuid.data.recordings import Recording

Method = Literal["linear", "hold", "mean"]
_GAP = 10.0  # median sampling steps: only `hold` bridges a longer pause
_MAX_SAMPLES = 50_000_000


@dataclass(frozen=True, slots=True)
class TimeBase:
    """The common time base of signals, and the resampling methods.

    Parameters
    ----------
    rate
        Samples per second, from the latest start to the earliest end of the signals (signals with ``hold`` have no
        end).
    align
        Alternatively a signal whose times are used.
    method
        ``linear`` between samples; ``hold`` the last one (for signals written on change); ``mean`` of the samples
        nearest to each new time (for a lower rate, without aliasing).
    methods
        Methods of individual signals, by name.
    """

    rate: float | None = None
    align: str | None = None
    method: Method = "linear"
    methods: Mapping[str, Method] = field(default_factory=dict)


def one_time_base(recording: Recording, base: TimeBase | None, where: object) -> tuple[Table, Mapping[str, str]]:
    """Return the signals of a recording as one table, and how each resampled signal was resampled.

    A sample outside the signal's time range, or (except with ``hold``) in a gap longer than ten of its steps, is
    missing. Samples missing in the recording are not used.

    Raises
    ------
    MeasurementsError
        There are several time bases and `base` is None; `base` names an unknown signal; or the signals do not
        overlap.
    """
    if base is None:
        if len(recording.tables) == 1:
            return recording.tables[0], {}
        bases = "; ".join(f"{', '.join(t.columns)}: {_described(t.time)}" for t in recording.tables)
        raise MeasurementsError(
            f"has signals with {len(recording.tables)} time bases ({bases})",
            where=where,
            fix="choose signals with --signal, or a common time base with --resample RATE or --align SIGNAL",
        )
    for name in (*([base.align] if base.align else []), *base.methods):
        if name not in recording.columns:
            raise MeasurementsError(
                f"has no signal '{name}'", where=where, fix=suggestion(name, recording.columns)
            )
    time = _times(recording, base, where)
    columns: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    how: dict[str, str] = {}
    for table in recording.tables:
        for name, values in table.columns.items():
            units |= {name: table.units[name]} if name in table.units else {}
            known = np.isfinite(values)
            if np.array_equal(table.time, time):
                columns[name] = values
                continue
            if known.sum() < 2:
                raise MeasurementsError(
                    f"signal '{name}' has {known.sum()} samples", where=where, fix="leave it out"
                )
            method = base.methods.get(name, base.method)
            columns[name] = _METHODS[method](time, table.time[known], values[known])
            how[name] = f"{method} from {_described(table.time[known])}"
            lost = int(np.isnan(columns[name]).sum())
            how[name] += f", {lost} samples missing" if lost else ""
    order = {name: columns[name] for name in recording.columns}
    return Table(time, order, units, recording.notes), how


def aliased(table: Table, recording: Recording, base: TimeBase) -> tuple[str, ...]:
    """Return the signals whose sampling rate was more than halved without averaging."""
    step = float(np.median(np.diff(table.time)))
    return tuple(
        name
        for old in recording.tables
        for name in old.columns
        if base.methods.get(name, base.method) != "mean" and float(np.median(np.diff(old.time))) < 0.5 * step
    )


def _times(recording: Recording, base: TimeBase, where: object) -> FloatArray:
    if base.align is not None:
        return next(t.time for t in recording.tables if base.align in t.columns)
    begin = max(float(t.time[0]) for t in recording.tables)
    ends = [
        float(t.time[-1])
        for t in recording.tables
        if any(base.methods.get(n, base.method) != "hold" for n in t.columns)
    ]
    end = min(ends) if ends else max(float(t.time[-1]) for t in recording.tables)
    if not end > begin:
        raise MeasurementsError(
            f"signals do not overlap: one begins at {begin:g} s, another ends at {end:g} s",
            where=where,
            fix="choose other signals with --signal",
        )
    assert base.rate is not None
    # A rate that fits the duration except for rounding keeps its last sample.
    steps = int((end - begin) * base.rate * (1.0 + 1e-9))
    if not 1 <= steps < _MAX_SAMPLES:
        raise MeasurementsError(
            f"{end - begin:g} s at {base.rate:g} Hz yields {counted(steps + 1, 'sample')}",
            where=where,
            fix="give another rate",
        )
    return np.minimum(begin + np.arange(steps + 1) / base.rate, end)


def _linear(at: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    result = np.interp(at, time, values, left=np.nan, right=np.nan)
    before = np.clip(np.searchsorted(time, at, side="right") - 1, 0, time.size - 2)
    steps = np.diff(time)
    inside = (at > time[before]) & (at < time[before + 1])
    result[inside & (steps[before] > _GAP * np.median(steps))] = np.nan
    return result


def _hold(at: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    last = np.searchsorted(time, at, side="right") - 1
    return np.where(last >= 0, values[np.maximum(last, 0)], np.nan)


def _mean(at: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    middles = 0.5 * (at[1:] + at[:-1])
    edges = np.concatenate([[2 * at[0] - middles[0]], middles, [2 * at[-1] - middles[-1]]])
    cell = np.searchsorted(edges, time, side="right") - 1
    inside = (cell >= 0) & (cell < at.size)
    count = np.bincount(cell[inside], minlength=at.size)
    total = np.bincount(cell[inside], weights=values[inside], minlength=at.size)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


_METHODS: dict[Method, Callable[[FloatArray, FloatArray, FloatArray], FloatArray]] = {
    "linear": _linear,
    "hold": _hold,
    "mean": _mean,
}


def _described(time: FloatArray) -> str:
    """Return a time base in words: its rate if that is even, the number of samples, and begin and end."""
    steps = np.diff(time)
    step = float(np.median(steps))
    even = step > 0 and bool(np.all(np.abs(steps - step) < 0.01 * step))
    rate = f"{1 / step:.6g} Hz" if even else f"uneven steps of {steps.min():.3g} to {steps.max():.3g} s"
    return f"{rate}, {time.size} samples, {time[0]:.6g} to {time[-1]:.6g} s"
