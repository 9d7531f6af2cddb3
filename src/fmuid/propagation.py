"""What the uncertainty of the parameters means for predictions and criteria."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmuid.campaign import FloatArray
from fmuid.errors import SimulationError
from fmuid.problem import Problem
from fmuid.uncertainty import LEVEL, Uncertainty


@dataclass(frozen=True, slots=True, eq=False)
class Propagated:
    """Predictions over the uncertainty of the parameters, by Monte Carlo.

    `lower` and `upper` are the (channels, N) bounds of the level asked for, one pair a case; `worst` the largest
    value of each criterion met.
    """

    lower: tuple[FloatArray, ...]
    upper: tuple[FloatArray, ...]
    worst: FloatArray
    failed: int


def propagate(
    problem: Problem, estimate: Uncertainty, *, draws: int = 200, level: float = LEVEL, seed: int = 0
) -> Propagated:
    """Simulate parameters drawn from the estimate's distribution.

    Raises
    ------
    SimulationError
        No draw can be simulated.
    """
    generator = np.random.default_rng(seed)
    points = generator.multivariate_normal(np.array(estimate.point), np.array(estimate.covariance), draws)
    points = np.clip(points, problem.space.lower, problem.space.upper)
    evaluations = problem.evaluate_many(list(points))
    good = [e for e in evaluations if e.ok]
    if not good:
        raise SimulationError("no draw can be simulated", fix="narrow the bounds")
    tails = (0.5 - 0.5 * level, 0.5 + 0.5 * level)
    bands = [np.quantile(np.array(p), tails, axis=0) for p in zip(*(e.predictions for e in good), strict=True)]
    return Propagated(
        tuple(b[0] for b in bands),
        tuple(b[1] for b in bands),
        np.max([e.criteria for e in good], axis=0),
        draws - len(good),
    )
