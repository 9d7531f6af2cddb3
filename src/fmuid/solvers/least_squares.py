"""Least-squares solvers: trust region and Levenberg-Marquardt (SciPy), and derivative-free DFO-LS."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from fmuid.campaign import FloatArray, frozen_mapping
from fmuid.derivatives import NoiseFloor, jacobian, noise_floor
from fmuid.errors import ProblemError, SimulationError
from fmuid.problem import Evaluation
from fmuid.solvers.search import Outcome, Search, Status

_SMALLEST_RADIUS = 1e-8  # of DFO-LS: search coordinates are of order one
_RETRIES = 5


@dataclass(frozen=True, slots=True)
class TrustRegion:
    """Trust-region reflective or Levenberg-Marquardt least squares with noise-aware differences.

    One-sided differences lead to the neighbourhood of the minimum, central ones finish. A candidate that
    cannot be simulated shrinks the trust region.

    Parameters
    ----------
    name
        ``trf`` (bounds) or ``lm`` (MINPACK; only without bounds).
    tolerance
        Relative change of cost and point to stop at.
    """

    name: str = "trf"
    tolerance: float = 1e-10
    needs_residuals: bool = field(default=True, init=False)

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        from scipy.optimize import least_squares

        _require_smooth(search, self.name)
        bounds: tuple[Any, Any] = (search.lower, search.upper)
        if self.name == "lm":
            if np.any(np.isfinite(search.lower)) or np.any(np.isfinite(search.upper)):
                raise ProblemError("solver 'lm' takes no bounds", fix="use 'trf', or remove the bounds")
            bounds = (-np.inf, np.inf)
        first = _start(search, start)
        derivative = partial(search.evaluate_many, purpose="derivative")
        floor = noise_floor(search.problem, first.x, evaluate=derivative)
        x, message = first.x, ""
        # A change of the cost below the noise is no change.
        tolerance = max(self.tolerance, 1e-3 * floor.relative)
        for central in (False, True):
            result = least_squares(
                partial(_residuals, search, len(first.residuals)),
                _strictly_inside(x, search.lower, search.upper),
                jac=partial(_jacobian, search, floor, central),
                bounds=bounds,
                method=self.name,
                x_scale=1.0,
                ftol=tolerance if central else max(tolerance, 1e-6),
                xtol=tolerance if central else max(tolerance, 1e-6),
                gtol=None if self.name == "trf" else 1e-15,
                max_nfev=10_000,
            )
            assert search.reached is not None  # `first` was simulated
            x, message = search.reached.x, result.message.strip("`.").replace("`", "")
            if result.status == 0:
                return Outcome(Status.BUDGET, message)
        return Outcome(Status.CONVERGED, message)


@dataclass(frozen=True, slots=True)
class DfoLs:
    """DFO-LS (Cartis and others, 2019): least squares by interpolation, at ease with noisy simulations."""

    options: Mapping[str, Any] = field(default_factory=dict)
    name: str = field(default="dfols", init=False)
    needs_residuals: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "options", frozen_mapping(self.options))

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        try:
            import dfols
        except ImportError:
            raise ProblemError("solver 'dfols' is not installed", fix="pip install DFO-LS") from None
        _require_smooth(search, self.name)
        first = _start(search, start)
        widths = search.upper - search.lower
        radius = float(min(self.options.get("initial_step", 0.1), 0.45 * np.min(widths)))
        smallest = max(float(self.options.get("tolerance", _SMALLEST_RADIUS)), 0.0)
        lower, upper = np.maximum(search.lower, -1e20), np.minimum(search.upper, 1e20)
        x = first.x

        def residuals(point: FloatArray) -> FloatArray:
            evaluation = search.evaluate(point)
            if not evaluation.ok:
                raise _FailedError
            return evaluation.residuals

        for _ in range(_RETRIES):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    np.random.seed(search.seed)  # noqa: NPY002 - DFO-LS draws from the global generator
                    result = dfols.solve(
                        residuals,
                        x,
                        bounds=(lower, upper),
                        rhobeg=radius,
                        rhoend=min(smallest, 0.1 * radius),
                        maxfun=search.stop.evaluations or 1000 * (len(x) + 1),
                        do_logging=False,
                    )
            except _FailedError:
                assert search.reached is not None  # `first` was simulated
                x, radius = search.reached.x, 0.25 * radius
                continue
            good = result.flag in (result.EXIT_SUCCESS, result.EXIT_SLOW_WARNING)
            return Outcome(Status.CONVERGED if good else Status.FAILED, result.msg)
        return Outcome(Status.FAILED, "simulations keep failing around the best point")


class _FailedError(Exception):
    """A candidate cannot be simulated; DFO-LS has to start again, closer."""


def _require_smooth(search: Search, name: str) -> None:
    if search.problem.combination.kind != "weighted_sum" or search.problem.constraints:
        raise ProblemError(
            f"solver '{name}' minimises sums of squares without constraints",
            fix='use combine = "weighted_sum" without constraints, or another solver such as cobyla',
        )


def _start(search: Search, start: FloatArray) -> Evaluation:
    first = search.evaluate(start)
    if first.failure is not None:
        raise SimulationError(f"the start point fails ({first.failure})", fix="choose other start values")
    return first


def _residuals(search: Search, m: int, x: FloatArray) -> FloatArray:
    evaluation = search.evaluate(x)
    return evaluation.residuals if evaluation.ok else np.full(m, np.nan)


def _jacobian(search: Search, floor: NoiseFloor, central: bool, x: FloatArray) -> FloatArray:
    derivative = partial(search.evaluate_many, purpose="derivative")
    here = search.evaluate(x)
    return jacobian(derivative, here, search.lower, search.upper, floor, central=central)


def _strictly_inside(x: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return `x` moved off the bounds by next to nothing, as SciPy's interior method wants it."""
    return np.clip(x, np.nextafter(lower, np.inf), np.nextafter(upper, -np.inf))
