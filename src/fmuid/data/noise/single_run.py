"""A model-free upper bound of the noise of a run that was not repeated.

A motion is smooth from sample to sample and noise is not. Normalised differences of increasing order remove more
and more of the motion but keep the level of white noise; the smallest of them bounds this level. The bound does
not cover slow coloured noise and drift, which cannot be distinguished from a slow effect without repeating the
run.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np

from fmuid.core.immutable import FloatArray

_ORDERS = range(2, 8)
_MAD = 1.4826  # factor from a normal's median absolute value to its standard deviation
_EFFICIENCY = 0.18  # efficiency of the median (0.37), reduced as neighbouring differences share samples
_ONE_SIDED = 1.645  # standard deviations of a normal's 95 % quantile
_FINEST = 1e-6  # share of a signal's spread: 120 dB or 20 bits, finer than any sensor


def single_run_variance(runs: Sequence[FloatArray], step: float, repeating: float = 0.0) -> float:
    """Return an upper bound (95 %) of the variance of a signal's noise, from its differences in time.

    Parameters
    ----------
    runs
        (R, N) evenly spaced samples of every experiment, NaN where missing.
    step
        Quantisation step of the signal, 0 if it is not quantised; the noise is at least its rounding error.
    repeating
        Variance of the slow part of the rounding error, which is not included.
    """
    spread = float(np.mean([np.nanstd(values) for values in runs]))
    return max(fast_variance(runs, step), step**2 / 12.0 - repeating, (_FINEST * spread) ** 2)


def fast_variance(runs: Sequence[FloatArray], step: float = 0.0) -> float:
    """Return the variance of the fast noise, and of the fast part of rounding errors, from differences in time.

    Values on a lattice have a median on a lattice, so quantised samples are spread over their steps first.
    """
    rng, variances = np.random.default_rng(0), []
    spread = [values + step * (rng.random(np.shape(values)) - 0.5) if step else values for values in runs]
    for order in _ORDERS:
        differences = np.concatenate([np.diff(values, order).ravel() for values in spread])
        differences = differences[np.isfinite(differences)]
        if differences.size > 1:
            variance = (_MAD * float(np.median(np.abs(differences)))) ** 2 / comb(2 * order, order)
            variance -= step**2 / 12.0
            variances.append(variance * (1.0 + _ONE_SIDED * np.sqrt(2.0 / (_EFFICIENCY * differences.size))))
    return max(min(variances, default=0.0), 0.0)
