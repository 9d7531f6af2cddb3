"""Bounded least squares with a trust region that shrinks when a simulation fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from fmuid.core.immutable import FloatArray


class SettledError(Exception):
    """Raised by a residual function when trial points no longer differ by a relevant amount."""


class BlockedError(Exception):
    """Raised by a residual function when trial points keep failing."""


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
    """Minimise the sum of squares of residuals, and return SciPy's status.

    The caller records the points at which `residuals` is called. NaN residuals mark a failed point, and the region
    shrinks.

    Parameters
    ----------
    residuals, jacobian
        Functions of an (n,) point with results (m,) and (m, n).
    method
        ``trf`` (Branch, Coleman and Li, 1999), ``dogbox`` (Voglis and Lagaris, 2004), which takes fewer steps to a
        minimum at a bound, or ``lm`` (MINPACK; without bounds).
    cost_tolerance, step_tolerance
        Relative changes at which the search ends.
    """
    from scipy.optimize import least_squares

    bounds: tuple[Any, Any] = (-np.inf, np.inf) if method == "lm" else (lower, upper)
    if method == "trf":  # an interior method needs a start slightly off the bounds
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
