"""Bounded least squares with a trust region that shrinks when a simulation fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from fmuid.core.immutable import FloatArray

_DAMPED = 1e-4  # share of a slope: far below those of parameters that measurements tell apart


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
        minimum at a bound, or ``lm`` (MINPACK; without bounds). As ``dogbox`` needs a Jacobian of full rank, its
        steps are damped where several parameters do the same.
    cost_tolerance, step_tolerance
        Relative changes at which the search ends.
    """
    from scipy.optimize import least_squares

    bounds: tuple[Any, Any] = (-np.inf, np.inf) if method == "lm" else (lower, upper)
    if method == "trf":  # an interior method needs a start slightly off the bounds
        start = np.clip(start, np.nextafter(lower, np.inf), np.nextafter(upper, -np.inf))
    if method == "dogbox":
        residuals, jacobian = _damped(residuals, jacobian, len(start))
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


def _damped(
    residuals: Callable[[FloatArray], FloatArray], jacobian: Callable[[FloatArray], FloatArray], count: int
) -> tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]:
    """Return the functions with a row for each of the parameters, with a share of its slope and no residual."""

    def with_rows(x: FloatArray) -> FloatArray:
        slopes = jacobian(x)
        return np.vstack([slopes, np.diag(_DAMPED * np.linalg.norm(slopes, axis=0))])

    return lambda x: np.append(residuals(x), np.zeros(count)), with_rows
