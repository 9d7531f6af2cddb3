"""Profile-likelihood intervals."""

from __future__ import annotations

import numpy as np

from fmuid.campaign import FloatArray
from fmuid.derivatives import Differences, noise_floor
from fmuid.errors import SimulationError
from fmuid.problem import Evaluation, Problem
from fmuid.uncertainty import LEVEL, Uncertainty


def profile_interval(
    problem: Problem, estimate: Uncertainty, name: str, *, level: float = LEVEL
) -> tuple[float, float]:
    """Return the profile-likelihood interval of one parameter, in model space.

    The others are fitted again while this one moves outwards, until the cost has grown by what `level` allows
    (scaled as the sandwich covariance is, so coloured residuals count). An end that is never reached is the
    bound, or infinite.

    Raises
    ------
    SimulationError
        A refit fails.
    """
    from scipy.optimize import brentq
    from scipy.special import stdtrit

    i = estimate.names.index(name)
    x = np.array(estimate.point)
    best = problem.evaluate(x)
    spread = float(np.sqrt(estimate.covariance[i][i]))
    floor = noise_floor(problem, x)
    j = Differences(problem, floor, central=True).jacobian(problem.evaluate_many, best)
    plain = np.linalg.pinv(j.T @ j, hermitian=True)[i, i]
    t = float(stdtrit(estimate.degrees_of_freedom, 0.5 + 0.5 * level))
    allowed = t**2 * spread**2 / plain
    ends = []
    for sign, bound in ((-1.0, problem.space.lower[i]), (1.0, problem.space.upper[i])):
        refit = _Refit(problem, i, x)

        def excess(distance: float, sign: float = sign, refit: _Refit = refit) -> float:
            return float(refit.cost(x[i] + sign * distance) - best.cost - allowed)

        far, limit = t * spread, abs(bound - x[i])
        while excess(min(far, limit)) < 0.0 and far < min(limit, 64.0 * t * spread):
            far *= 2.0
        far = min(far, limit)
        reached = excess(far) >= 0.0
        distance = brentq(excess, 0.0, far, xtol=1e-3 * far, rtol=1e-3) if reached else limit
        point = x.copy()
        point[i] = x[i] + sign * distance
        ends.append(problem.space.to_model(point)[name] if np.isfinite(distance) else sign * np.inf)
    return float(ends[0]), float(ends[1])


class _Refit:
    """Fits all parameters but one, each time from the last fit."""

    def __init__(self, problem: Problem, i: int, x: FloatArray) -> None:
        self.problem, self.i = problem, i
        self.others = np.arange(len(x)) != i
        self.x = x.copy()

    def cost(self, value: float) -> float:
        """Return the least cost with parameter i at `value` of search space."""
        from scipy.optimize import least_squares

        if not np.any(self.others):
            return self._evaluate(np.zeros(0), value).cost
        lower, upper = self.problem.space.lower[self.others], self.problem.space.upper[self.others]
        start = np.clip(self.x[self.others], np.nextafter(lower, np.inf), np.nextafter(upper, -np.inf))
        step = 1e-4
        result = least_squares(
            lambda others: self._evaluate(others, value).residuals,
            start,
            bounds=(lower, upper),
            diff_step=step,
            ftol=1e-9,
            xtol=1e-8,
        )
        self.x[self.others] = result.x
        return float(2.0 * result.cost)

    def _evaluate(self, others: FloatArray, value: float) -> Evaluation:
        point = self.x.copy()
        point[self.others], point[self.i] = others, value
        evaluation = self.problem.evaluate(point)
        if evaluation.failure is not None:
            raise SimulationError(f"the profile meets a failing point ({evaluation.failure})")
        return evaluation
