"""Least squares within bounds by a trust region that shrinks where a simulation fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from fmuid.core.immutable import FloatArray


class SettledError(Exception):
    """Raised by a residual function: the trial points no longer differ by more than matters."""


def trust_region(
    residuals: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    *,
    method: Literal["trf", "dogbox", "lm"] = "trf",
    cost_tolerance: float,
    step_tolerance: float,
) -> int:
    """Minimise the sum of squares of residuals; SciPy's status of how it ended.

    The caller keeps the points: those that `residuals` is asked for. Residuals that are NaN say that a point has
    none, and the region shrinks.

    Parameters
    ----------
    residuals, jacobian
        Of (n,) points: (m,) and (m, n).
    method
        ``trf`` (Branch, Coleman and Li, 1999), ``dogbox`` (Voglis and Lagaris, 2004), which takes fewer steps to a
        minimum at a bound, or ``lm`` (MINPACK; without bounds).
    cost_tolerance, step_tolerance
        Relative changes to end at.
    """
    from scipy.optimize import least_squares

    bounds: tuple[Any, Any] = (-np.inf, np.inf) if method == "lm" else (lower, upper)
    if method == "trf":  # an interior method: it wants a start off the bounds, by next to nothing
        start = np.clip(start, np.nextafter(lower, np.inf), np.nextafter(upper, -np.inf))
    with np.errstate(all="ignore"):  # SciPy divides by zero where a parameter has no effect
        result = least_squares(
            residuals,
            start,
            jac=jacobian,
            bounds=bounds,
            method=method,
            x_scale=1.0,
            ftol=cost_tolerance,
            xtol=step_tolerance,
            gtol=None if method != "lm" else 1e-15,
            max_nfev=10_000,
        )
    return int(result.status)
