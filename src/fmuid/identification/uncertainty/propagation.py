"""Propagation of parameter uncertainty to predictions and criteria: Monte Carlo and worst case."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import Differences, EvaluateMany, NoiseFloor, noise_floor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers.nlopt_solver import minimised
from fmuid.identification.uncertainty.confidence import LEVEL, Uncertainty

_SEARCHED = 20  # evaluations per parameter of a search for the worst case of a criterion


@dataclass(frozen=True, slots=True, eq=False)
class Propagated:
    """Distribution of predictions and criteria under parameter uncertainty, by Monte Carlo.

    Parameters
    ----------
    lower, upper
        (channels, N) bounds for the requested level, one pair per case.
    criteria
        (draws, n_criteria) values divided by their demands, for draws that could be simulated.
    failed
        Number of the other draws.
    """

    lower: tuple[FloatArray, ...]
    upper: tuple[FloatArray, ...]
    criteria: FloatArray
    failed: int

    @property
    def worst(self) -> FloatArray:
        """(n_criteria,) largest values of the draws."""
        return np.asarray(np.max(self.criteria, axis=0))


@dataclass(frozen=True, slots=True)
class CriterionSpread:
    """Distribution of one criterion, divided by its demand: satisfied if at most 1.

    Parameters
    ----------
    value
        Value at the estimate.
    median, high
        Median and 95 % quantile of the draws.
    worst
        The largest value found by optimisation within the joint 95 % region of the parameters, and by the draws.
    satisfied
        Share of the draws that satisfy the criterion.
    """

    label: str
    value: float
    median: float
    high: float
    worst: float
    satisfied: float


def propagate(
    problem: Problem,
    estimate: Uncertainty,
    *,
    draws: int = 200,
    level: float = LEVEL,
    seed: int = 0,
    evaluate: EvaluateMany | None = None,
) -> Propagated:
    """Simulate parameters drawn from the estimate's distribution (normal in search space, cut at the bounds).

    Parameters
    ----------
    problem, estimate
        The problem, and the uncertainty of its estimate (`uncertainty_of`).
    draws
        Number of draws.
    level
        Share of the draws within the bands, such as 0.95.
    seed
        Seed of the draws.
    evaluate
        Replacement for the problem's `evaluate_many`, for example to run evaluations in parallel.

    Returns
    -------
    Propagated
        Bands of the predictions and of the criteria.

    Raises
    ------
    SimulationError
        No draw can be simulated.
    """
    good = _drawn(problem, estimate, draws, seed, evaluate or problem.evaluate_many)
    tails = (0.5 - 0.5 * level, 0.5 + 0.5 * level)
    bands = [np.quantile(np.array(p), tails, axis=0) for p in zip(*(e.predictions for e in good), strict=True)]
    return Propagated(
        tuple(b[0] for b in bands),
        tuple(b[1] for b in bands),
        np.array([e.criteria for e in good]),
        draws - len(good),
    )


def _drawn(
    problem: Problem, estimate: Uncertainty, draws: int, seed: int, evaluate: EvaluateMany
) -> list[Evaluation]:
    generator = np.random.default_rng(seed)
    points = generator.multivariate_normal(np.array(estimate.point), np.array(estimate.covariance), draws)
    points = np.clip(points, problem.space.lower, problem.space.upper)
    good = [e for e in evaluate(list(points)) if e.ok]
    if not good:
        raise SimulationError("no draw can be simulated", fix="narrow the bounds")
    return good


def worst_points(
    problem: Problem,
    estimate: Uncertainty,
    *,
    level: float = LEVEL,
    evaluate: EvaluateMany | None = None,
    floor: NoiseFloor | None = None,
) -> FloatArray:
    """Return, for each criterion, the point of the joint confidence region where it is expected to be largest.

    With residuals r + J d a criterion's square is a quadratic function of the displacement d; its largest value
    on the ellipsoid of the covariance is that of a trust-region problem (Moré and Sorensen, 1983).

    Returns
    -------
    array
        (n_criteria, n) search points.

    Raises
    ------
    SimulationError
        The neighbourhood of the estimate cannot be simulated.
    """
    from scipy.special import chdtri

    evaluate = evaluate or problem.evaluate_many
    x = np.array(estimate.point)
    (best,) = evaluate([x])
    differences = Differences(problem, floor or noise_floor(problem, x, evaluate=evaluate), central=True)
    j = differences.jacobian(evaluate, best)
    values, vectors = np.linalg.eigh(np.array(estimate.covariance))
    root = vectors * np.sqrt(np.maximum(values, 0.0))  # d = root u with |u| at most the radius
    radius = float(np.sqrt(chdtri(len(x), 1.0 - level)))
    points = [x + root @ _farthest(j[rows] @ root, best.residuals[rows], radius) for rows in problem.slices]
    return np.asarray(np.clip(points, problem.space.lower, problem.space.upper))


def criteria_spread(
    problem: Problem,
    estimate: Uncertainty,
    *,
    draws: int = 200,
    seed: int = 0,
    evaluate: EvaluateMany | None = None,
    floor: NoiseFloor | None = None,
) -> tuple[CriterionSpread, ...]:
    """Return the distribution of every criterion; see `propagate` and `worst_points`.

    Raises
    ------
    ProblemError
        The experiments do not determine every parameter, so there is no distribution to draw from.
    SimulationError
        No draw can be simulated, or the neighbourhood of the estimate cannot.
    """
    if not estimate.identifiability.complete:
        raise ProblemError(str(estimate.identifiability), fix="fix one of them")
    evaluate = evaluate or problem.evaluate_many
    drawn = np.array([e.criteria for e in _drawn(problem, estimate, draws, seed, evaluate)])
    corners = evaluate(list(worst_points(problem, estimate, evaluate=evaluate, floor=floor)))
    (best,) = evaluate([np.array(estimate.point)])
    worst = np.max([*drawn, *(e.criteria for e in corners if e.ok)], axis=0)
    worst = np.maximum(worst, _searched(problem, estimate, corners, evaluate))
    return tuple(
        CriterionSpread(
            label,
            float(best.criteria[k]),
            float(np.median(drawn[:, k])),
            float(np.quantile(drawn[:, k], LEVEL)),
            float(worst[k]),
            float(np.mean(drawn[:, k] <= 1.0)),
        )
        for k, label in enumerate(problem.labels)
    )


def _searched(
    problem: Problem, estimate: Uncertainty, corners: Sequence[Evaluation], evaluate: EvaluateMany
) -> FloatArray:
    """Return (n_criteria,) the largest values that direct searches find in the joint confidence region.

    They begin where the linearised model expects the largest value, which a curved model may have elsewhere.
    """
    from scipy.special import chdtri

    x, n = np.array(estimate.point), len(estimate.point)
    values, vectors = np.linalg.eigh(np.array(estimate.covariance))
    root = vectors * np.sqrt(np.maximum(values, 0.0)) * float(np.sqrt(chdtri(n, 1.0 - LEVEL)))
    largest = np.zeros(len(problem.criteria))

    def at(place: FloatArray) -> FloatArray:
        u = 2.0 * place - 1.0  # a unit cube around the ball
        moved = x + root @ (u / max(1.0, float(np.linalg.norm(u))))
        return np.asarray(np.clip(moved, problem.space.lower, problem.space.upper))

    for k, corner in enumerate(corners):

        def cost(place: FloatArray, k: int = k) -> float:
            (there,) = evaluate([at(place)])
            if not there.ok:
                return 0.0
            largest[:] = np.maximum(largest, there.criteria)
            return -float(there.criteria[k])

        start = 0.5 + 0.5 * np.linalg.pinv(root) @ (corner.x - x)
        minimised(cost, np.clip(start, 0.0, 1.0), step=0.2, evaluations=_SEARCHED * (n + 1))
    return largest


def _farthest(m: FloatArray, r: FloatArray, radius: float) -> FloatArray:
    """Return the u, with norm `radius`, where the norm of r + m u is largest."""
    from scipy.optimize import brentq

    curvature, axes = np.linalg.eigh(m.T @ m)
    slope = axes.T @ (m.T @ r)
    top, size = float(curvature[-1]), float(np.linalg.norm(slope))
    if size == 0.0:
        return np.asarray(radius * axes[:, -1])

    def excess(shift: float) -> float:
        return float(np.linalg.norm(slope / (top + shift - curvature)) - radius)

    low, high = 1e-12 * (top + size / radius), 2.0 * size / radius
    if excess(low) <= 0.0:  # the slope has no part along the steepest axis, so the remainder goes there
        u = np.where(curvature < top, slope / np.where(curvature < top, top + low - curvature, 1.0), 0.0)
        u[-1] = np.sqrt(max(radius**2 - float(u @ u), 0.0))
    else:
        u = slope / (top + brentq(excess, low, high) - curvature)
    return np.asarray(axes @ u)
