"""Numbers that characterise a response: step features and frequency response."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from fmuid.core.immutable import FloatArray

_TAIL = 0.1  # share of the record, at its end, that counts as steady


def steady_state(time: FloatArray, y: FloatArray) -> float:
    """Return the mean of the last tenth of the record."""
    return float(np.mean(y[time >= time[-1] - _TAIL * (time[-1] - time[0])]))


def peak(_time: FloatArray, y: FloatArray) -> float:
    """Return the sample that is farthest from the first."""
    return float(y[np.argmax(np.abs(y - y[0]))])


def overshoot(time: FloatArray, y: FloatArray) -> float:
    """Return the overshoot beyond the final value in % of the change (0 if there is none)."""
    change = steady_state(time, y) - y[0]
    if change == 0.0:
        return 0.0
    return float(max(0.0, 100.0 * (np.max((y - y[0]) / change) - 1.0)))


def rise_time(time: FloatArray, y: FloatArray) -> float:
    """Return the time from 10 % to 90 % of the change, in s; NaN without a change."""
    change = steady_state(time, y) - y[0]
    if change == 0.0:
        return float("nan")
    progress = (y - y[0]) / change
    return _crossing(time, progress, 0.9) - _crossing(time, progress, 0.1)


def settling_time(time: FloatArray, y: FloatArray, band: float = 0.05) -> float:
    """Return the time (s) after which the response stays within `band` of its change around its end."""
    end = steady_state(time, y)
    outside = np.flatnonzero(np.abs(y - end) > band * abs(end - y[0]))
    return float(time[min(outside[-1] + 1, len(time) - 1)] - time[0]) if len(outside) else 0.0


FEATURES: Mapping[str, Callable[[FloatArray, FloatArray], float]] = {
    "rise_time": rise_time,
    "overshoot": overshoot,
    "settling_time": settling_time,
    "steady_state": steady_state,
    "peak": peak,
}


def frequency_response(
    time: FloatArray, u: FloatArray, y: FloatArray, frequencies: FloatArray
) -> NDArray[np.complex128]:
    """Return Y/U at `frequencies` (Hz), shape (len(frequencies),), by Hann-windowed Fourier integrals.

    Sampling need not be uniform; means are removed first. The same integrals are taken of measurement and
    prediction, so leakage cancels in their comparison to first order.
    """
    weight = np.gradient(time) * (0.5 - 0.5 * np.cos(2.0 * np.pi * (time - time[0]) / (time[-1] - time[0])))
    kernel = weight * np.exp(-2j * np.pi * np.outer(frequencies, time - time[0]))
    response: NDArray[np.complex128] = (kernel @ (y - np.mean(y))) / (kernel @ (u - np.mean(u)))
    return response


def excited_frequencies(time: FloatArray, u: FloatArray, count: int = 10) -> FloatArray:
    """Return the up to `count` frequencies (Hz), sorted, where the periodogram of `u` is largest."""
    n = len(time)
    uniform = np.interp(np.linspace(time[0], time[-1], n), time, u)
    power = np.abs(np.fft.rfft((uniform - uniform.mean()) * np.hanning(n))) ** 2
    frequencies = np.fft.rfftfreq(n, (time[-1] - time[0]) / (n - 1))
    strong = np.flatnonzero((power > 0.01 * power.max()) & (frequencies > 0.0))
    chosen = strong[np.argsort(power[strong])[::-1][:count]]
    return np.sort(frequencies[chosen])


def _crossing(time: FloatArray, progress: FloatArray, level: float) -> float:
    """Return the time when `progress`, which goes from 0 to 1, first reaches `level`."""
    k = int(np.argmax(progress >= level))
    share = (level - progress[k - 1]) / (progress[k] - progress[k - 1])
    return float(time[k - 1] + share * (time[k] - time[k - 1]))
