"""Quantisation: the part of a quantised signal's error that repeats and so does not average out.

A counter rounds its measurement to multiples of a step q. A quiet signal is rounded in the same way in every
repeat, so the mean of many runs is as wrong as one of them. Noise in front of the counter (dither) makes rounding
errors differ from run to run; the stronger it is, the less of the error repeats. With noise of standard deviation
s in front of the counter, two runs share this part of the rounding error's variance q^2/12 (Widrow and Kollar,
2008):

    (6 / pi^2) sum_k exp(-(2 pi k s / q)^2) / k^2.
"""

from __future__ import annotations

import numpy as np

from fmuid.core.immutable import FloatArray, read_only

_DRAWS = 16
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-3, 3.0, 200)])  # s / q
_ORDERS = np.arange(1, 200)
_REPEATING = (
    6.0 / np.pi**2 * np.sum(np.exp(-((2.0 * np.pi * _ORDERS * _RATIOS[:, None]) ** 2)) / _ORDERS**2, axis=1)
) / 12.0
_REPEATING[0] = 1.0 / 12.0
# The differences between runs are the noise in front of the counter, and the rounding errors not shared.
_DIFFERING = _RATIOS**2 + 1.0 / 12.0 - _REPEATING


def quantum(values: FloatArray) -> float:
    """Return the step of which all `values` are multiples, as encoder counts are; 0 if there is none."""
    finite = values[np.isfinite(values)]
    levels = np.unique(finite)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * max(float(np.abs(levels).max(initial=0.0)), 1e-300)]
    # A few samples of a continuous signal may lie on a lattice by chance, unless values recur.
    if gaps.size == 0 or (gaps.size < 5 and 2 * levels.size > finite.size):
        return 0.0
    step = float(gaps.min())
    counts = gaps / step
    return step if np.all(np.abs(counts - np.round(counts)) < 0.02) else 0.0


def repeating_variance(differing: FloatArray | float, step: FloatArray | float) -> FloatArray:
    """Return the variance of the rounding error that all repeats share.

    Parameters
    ----------
    differing
        Variance of the differences between repeats.
    step
        Quantisation step; 0 for a signal that is not quantised.
    """
    q = np.asarray(step, dtype=np.float64)
    ratio = np.asarray(differing) / np.where(q > 0.0, q, 1.0) ** 2
    return np.asarray(np.where(q > 0.0, np.interp(ratio, _DIFFERING, _REPEATING), 0.0) * q**2)


def rounding_errors(values: FloatArray, step: float, *, draws: int = _DRAWS, seed: int = 0) -> FloatArray:
    """Return (draws, N) possible rounding errors of a quantised signal.

    While a signal crosses a level, its error is a ramp over one step; where it turns back, the error is a parabola
    whose height follows from the time spent at the neighbouring levels. Where it rests, half of the variance is
    taken as constant over the time at that level and half as independent from sample to sample.

    Parameters
    ----------
    values
        (N,) samples that are multiples of `step`.
    """
    rng = np.random.default_rng(seed)
    n = len(values)
    counts = np.round(np.nan_to_num(values) / step)
    first = np.flatnonzero(np.diff(counts, prepend=np.nan) != 0.0)  # start of every stretch at one level
    length = np.diff(np.append(first, n))
    entered = np.sign(np.diff(counts[first], prepend=counts[0]))
    left = np.append(entered[1:], 0.0)
    at = np.repeat(np.arange(len(first)), length)
    late = rng.random((draws, len(first) + 1))  # time from entering a level to its first sample, in samples
    span = length + late[:, :-1] - late[:, 1:]
    into = (np.arange(n) - first[at] + late[:, at]) / span[:, at]
    beside = 0.5 * (np.append(length[0], length[:-1]) + np.append(length[1:], length[-1]))
    height = np.minimum(1.0 / ((1.0 + 2.0 * beside / length) ** 2 - 1.0), 1.0)[at]
    passing = entered[at] * (0.5 - into)
    turning = entered[at] * (0.5 - height * (1.0 - (2.0 * into - 1.0) ** 2))
    resting = np.sqrt(0.5) * (rng.random((draws, len(first)))[:, at] - 0.5 + rng.random((draws, n)) - 0.5)
    moving = np.where((entered == left)[at], passing, turning)
    return read_only(step * np.where((entered * left != 0.0)[at], moving, resting))


def rounding_along(
    course: FloatArray, step: float, repeating: float, *, draws: int = _DRAWS, seed: int = 0
) -> FloatArray:
    """Return (draws, N) rounding errors, shared by all repeats, of a signal that follows a known course.

    Each draw shifts the course by a random part of a step: the slopes decide how errors follow each other, and
    where the levels lie relative to the signal is not known that well. Noise in front of the counter of standard
    deviation s damps the k-th harmonic of the sawtooth by exp(-2 (pi k s / q)^2) (Widrow and Kollar, 2008).

    Parameters
    ----------
    course
        (N,) samples of the signal before it is rounded.
    repeating
        Variance of the rounding error that repeats share, from `repeating_variance`.
    """
    rng = np.random.default_rng(seed)
    ratio = np.interp(-repeating / step**2, -_REPEATING, _RATIOS)
    orders = _ORDERS[:, None]
    within = np.linspace(0.0, 1.0, 1025)  # of a step
    sizes = np.where(orders % 2, -1.0, 1.0) / (np.pi * orders) * np.exp(-2.0 * (np.pi * orders * ratio) ** 2)
    sawtooth = np.sum(sizes * np.sin(2.0 * np.pi * orders * within), axis=0)
    return read_only(step * np.interp((course / step + rng.random((draws, 1))) % 1.0, within, sawtooth))
