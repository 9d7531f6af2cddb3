"""Comparison of a result with a reference result, variable by variable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fmu_build.suggest import suggestion
from fmuid.core.errors import FmuidError
from fmuid.core.immutable import FloatArray
from fmuid.data.crosscheck_csv import Table


@dataclass(frozen=True, slots=True)
class Comparison:
    """Deviation of one variable of a result from its reference.

    Parameters
    ----------
    name
        The variable.
    nrmse
        Root mean square error over the reference's samples, divided by the reference's range (by its
        largest absolute value if it is constant, by one if it is zero). NaN if the result misses samples.
    max_error, max_error_time
        Largest absolute error in the variable's unit, and its time (s).
    outside
        Fraction of the result's samples that are outside the funnel; None without a funnel.
    spans
        Intervals (s) in which the result is outside the funnel. Without a funnel, and only if the result is out of
        tolerance, those in which it is further from the reference than three times the tolerance.
    within
        Whether the variable is within tolerance.
    """

    name: str
    nrmse: float
    max_error: float
    max_error_time: float
    outside: float | None
    within: bool
    spans: tuple[tuple[float, float], ...] = ()


def compare_tables(
    result: Table,
    reference: Table,
    *,
    tolerance: float = 1e-3,
    funnel: tuple[float, float] | None = None,
    names: Sequence[str] = (),
) -> tuple[Comparison, ...]:
    """Compare every variable of `reference` (or those in `names`) with `result`.

    Errors are taken at the reference's times, between the result's samples by linear interpolation; if a time
    occurs twice (an event), its last row counts.

    Parameters
    ----------
    result, reference
        Tables over time; the result covers the reference's times.
    tolerance
        Largest NRMSE that is within tolerance; not used with a funnel.
    funnel
        Half-widths in value (as a fraction of the reference's range) and in time (s). A result is within the
        funnel if each of its samples is within both of some point of the reference.
    names
        Variables to compare; all variables of the reference by default.

    Raises
    ------
    FmuidError
        The result lacks a variable or does not cover the reference's times.
    """
    for name in names:
        if name not in reference.columns:
            raise FmuidError(f"the reference has no variable '{name}'", fix=suggestion(name, reference.columns))
    names = list(names) or list(reference.columns)
    for name in names:
        if name not in result.columns:
            raise FmuidError(f"the result has no variable '{name}'", fix=suggestion(name, result.columns))
    slack = 1e-9 * (reference.time[-1] - reference.time[0])
    if result.time[0] > reference.time[0] + slack or result.time[-1] < reference.time[-1] - slack:
        raise FmuidError(
            f"the result covers {result.time[0]:g} to {result.time[-1]:g} s,"
            f" the reference {reference.time[0]:g} to {reference.time[-1]:g} s",
            fix="simulate as long as the reference",
        )
    return tuple(_compare(result, reference, name, tolerance, funnel) for name in names)


def _compare(
    result: Table, reference: Table, name: str, tolerance: float, funnel: tuple[float, float] | None
) -> Comparison:
    last = np.append(np.diff(reference.time) > 0, True)  # last row of each time
    known = last & np.isfinite(reference.columns[name])
    time, expected = reference.time[known], reference.columns[name][known]
    if not time.size:
        raise FmuidError(f"the reference of '{name}' has no samples", fix="remove the column")
    values = result.columns[name]
    error = np.interp(time, result.time, values) - expected
    scale = _scale(expected)
    nrmse = float(np.sqrt(np.mean(error**2))) / scale
    worst = int(np.argmax(np.abs(np.nan_to_num(error, nan=np.inf))))
    largest, at = float(np.abs(error[worst])), float(time[worst])
    if funnel is None:
        within = nrmse <= tolerance
        spans = () if within else _spans(time, ~(np.abs(error) <= 3.0 * tolerance * scale))
        return Comparison(name, nrmse, largest, at, None, within, spans)
    covered = (result.time >= time[0]) & (result.time <= time[-1])
    lower, upper = _funnel(result.time[covered], time, expected, funnel[0] * scale, funnel[1])
    left = ~((values[covered] >= lower) & (values[covered] <= upper))
    spans = _spans(result.time[covered], left)
    return Comparison(name, nrmse, largest, at, float(np.mean(left)), not left.any(), spans)


def funnel_around(reference: Table, name: str, funnel: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper edge of the funnel around a variable, at its samples that are not missing."""
    known = np.isfinite(reference.columns[name])
    time, values = reference.time[known], reference.columns[name][known]
    return _funnel(time, time, values, funnel[0] * _scale(values), funnel[1])


def _scale(values: FloatArray) -> float:
    return float(np.ptp(values)) or float(np.max(np.abs(values))) or 1.0


def _spans(time: FloatArray, outside: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """Return first and last time of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], outside, [False]]).astype(np.int8)))
    return tuple((float(time[a]), float(time[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True))


def _funnel(
    at: FloatArray, time: FloatArray, values: FloatArray, height: float, width: float
) -> tuple[FloatArray, FloatArray]:
    """Return the least and greatest reference within `width` of each time in `at`, widened by `height`.

    The reference is piecewise linear, so its extremes in a window are at its samples and the window's ends.
    """
    ends = np.interp(at - width, time, values), np.interp(at + width, time, values)
    first, stop = np.searchsorted(time, at - width), np.searchsorted(time, at + width, side="right")
    count = stop - first
    level = np.maximum(np.frexp(np.maximum(count, 1).astype(np.float64))[1] - 1, 0)  # floor(log2(count))
    bounds = []
    for pick in (np.minimum, np.maximum):
        end = pick(*ends)
        # Sparse table: row k holds the extremes of 2**k samples from each index on.
        table = [values]
        for k in range(int(level.max())):
            half = 1 << k
            shifted = np.concatenate([table[-1][half:], table[-1][-half:]])[: values.size]
            table.append(pick(table[-1], shifted))
        rows = np.array(table)
        left = rows[level, np.minimum(first, values.size - 1)]
        right = rows[level, np.clip(stop - (1 << level), 0, values.size - 1)]
        bounds.append(np.where(count > 0, pick(pick(left, right), end), end))
    return bounds[0] - height, bounds[1] + height
