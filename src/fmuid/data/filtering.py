"""Zero-phase low-pass filters and derivatives of recorded signals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from fmuid.core.errors import MeasurementsError
from fmuid.core.immutable import FloatArray

ORDER = 4  # order of the Butterworth filter, which runs forward and backward
_UNEVEN = 0.2  # share of the median step


@dataclass(frozen=True, slots=True)
class LowPass:
    """A fourth-order Butterworth low-pass filter that runs forward and backward, so it has zero phase.

    Parameters
    ----------
    cutoff
        Frequency in Hz at which amplitudes are halved.
    """

    cutoff: float

    def __call__(self, time: FloatArray, values: FloatArray) -> FloatArray:
        """Return `values`, (..., N), filtered along their last axis; missing samples stay missing.

        Parameters
        ----------
        time
            (N,) s, even except for jitter.
        values
            (..., N); for filtering the other samples, missing ones are interpolated linearly.

        Raises
        ------
        MeasurementsError
            The times are uneven, or too coarse for the frequency.
        """
        from scipy.signal import sosfiltfilt

        sections = self._sections(time)
        known = np.isfinite(values)
        if known.all():
            return np.asarray(sosfiltfilt(sections, values, padlen=_padding(len(time))))
        if values.ndim > 1:
            return np.array([self(time, row) for row in values])
        if not known.any():
            return values
        bridged = np.interp(time, time[known], values[known])
        filtered = sosfiltfilt(sections, bridged, padlen=_padding(len(time)))
        return np.asarray(np.where(known, filtered, np.nan))

    def noise_gain(self, time: FloatArray) -> float:
        """Return the factor by which the filter reduces the standard deviation of white noise."""
        from scipy.signal import sosfreqz

        power = np.abs(sosfreqz(self._sections(time), 4096)[1]) ** 4  # forward and backward
        return float(np.sqrt(np.mean(power)))

    def _sections(self, time: FloatArray) -> Any:
        steps = np.diff(time)
        usual = float(np.median(steps))
        if np.max(np.abs(steps - usual)) > _UNEVEN * usual:
            raise MeasurementsError(
                f"steps of {steps.min():.3g} to {steps.max():.3g} s cannot be filtered",
                fix="resample the run at even times (fmuid import --resample RATE)",
            )
        if not 0.0 < self.cutoff < 0.5 / usual:
            raise MeasurementsError(
                f"a filter at {self.cutoff:g} Hz does not fit samples every {usual:.3g} s",
                fix=f"write a frequency below {0.5 / usual:.3g} Hz",
            )
        return _butterworth(self.cutoff, round(1.0 / usual, 9))


def first_order(values: FloatArray, keep: float, before: float = 0.0) -> FloatArray:
    """Return y, (N, ...), with ``y[k] = keep * y[k-1] + values[k]``, where y[-1] is `before`."""
    from scipy.linalg.blas import dtbsv  # scipy.signal has such filters, but takes a second to import

    y = np.array(values, dtype=np.float64, order="C")
    y[0] += keep * before
    columns, band = y.reshape(len(y), -1), np.full((2, len(y)), -keep)
    for k, column in enumerate(columns.T):
        columns[:, k] = dtbsv(1, band, column, lower=1, diag=1)
    return y


def derivative(time: FloatArray, values: FloatArray, order: int = 1) -> FloatArray:
    """Return the central-difference derivative of (N,) samples; it is missing where a neighbour is missing."""
    for _ in range(order):
        values = np.asarray(np.gradient(values, time))
    return values


@lru_cache(maxsize=32)
def _butterworth(cutoff: float, rate: float) -> Any:
    from scipy.signal import butter

    # Forward and backward filtering squares the amplitude at the design frequency to 1/2.
    return butter(ORDER, cutoff, fs=rate, output="sos")


def _padding(samples: int) -> int:
    return min(samples - 1, 3 * (2 * ORDER + 1))
