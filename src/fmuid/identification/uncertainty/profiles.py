"""Profile likelihood: the cost along one parameter while the others are refitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import Differences, EvaluateMany, NoiseFloor, noise_floor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.uncertainty.confidence import LEVEL, Uncertainty

_STRIDE = 0.5  # distance between points of a curve, in half-widths of the linear interval
_STRIDES = 8  # number of such strides; after them, each is twice the previous one
_FARTHEST = 64.0  # half-widths at most
_STILL = 0.02  # a smaller step (relative to the allowed rise) ends the others' refit
_REFITS = 12


@dataclass(frozen=True, slots=True)
class Profile:
    """The profile of one parameter.

    Parameters
    ----------
    name, level
        The parameter, and the confidence level of the interval.
    values
        (k,) in model space, ascending.
    rise
        (k,) increase of the cost over that of the estimate; 1 is the limit for `level`.
    interval
        Values where the rise is 1; if that is never reached, the parameter's bound, or None without a bound.
    """

    name: str
    values: tuple[float, ...]
    rise: tuple[float, ...]
    interval: tuple[float | None, float | None]
    level: float = LEVEL


def profile_of(
    problem: Problem,
    estimate: Uncertainty,
    name: str,
    *,
    level: float = LEVEL,
    evaluate: EvaluateMany | None = None,
    floor: NoiseFloor | None = None,
) -> Profile:
    """Return the profile of one parameter around the point of `estimate`.

    The others are refitted while this one moves outwards, until the cost has risen to the limit for `level`
    (scaled like the covariance, so coloured residuals and errors of fixed parameters are included).

    Parameters
    ----------
    problem, estimate
        The problem, and the uncertainty of its estimate (`uncertainty_of`).
    name
        The parameter.
    level
        Confidence of the interval, such as 0.95.
    evaluate
        Replacement for the problem's `evaluate_many`, for example to record evaluations or run them in parallel.
    floor
        The simulator's noise floor, if already known.

    Raises
    ------
    ProblemError
        The cost is not a sum of squares, or the experiments do not determine the parameter.
    SimulationError
        A refit fails.
    """
    from scipy.special import stdtrit

    if problem.combination.kind != "weighted_sum":
        raise ProblemError("a profile needs a sum of squares", where=name, fix='use combine = "weighted_sum"')
    i = estimate.names.index(name)
    if estimate.standard_errors[i] is None and name in estimate.identifiability.undetermined:
        raise ProblemError(str(estimate.identifiability), where=name, fix="fix one of them")
    evaluate = evaluate or problem.evaluate_many
    x = np.array(estimate.point)
    (best,) = evaluate([x])
    differences = Differences(problem, floor or noise_floor(problem, x, evaluate=evaluate), central=True)
    j = differences.jacobian(evaluate, best)
    spread = float(np.sqrt(estimate.covariance[i][i]))
    t = float(stdtrit(estimate.freedom[i], 0.5 + 0.5 * level))
    # The part that the others cannot follow is the parameter's own share of the residuals.
    allowed = float((t * spread) ** 2 / np.linalg.pinv(j.T @ j, hermitian=True)[i, i])
    costs = {float(x[i]): 0.0}
    ends: list[float | None] = []
    for sign, bound in ((-1.0, problem.space.lower[i]), (1.0, problem.space.upper[i])):
        walk = _Walk(problem, evaluate, j, best=best, i=i, allowed=allowed)
        distance = walk.crossing(sign, t * spread, abs(bound - x[i]))
        costs |= walk.found
        point = x.copy()
        point[i] = x[i] + sign * distance
        ends.append(problem.space.to_model(point)[name] if np.isfinite(distance) else None)
    order = sorted(costs)
    points = [np.where(np.arange(len(x)) == i, value, x) for value in order]
    values = tuple(problem.space.to_model(point)[name] for point in points)
    return Profile(name, values, tuple(costs[value] for value in order), (ends[0], ends[1]), level)


class _Walk:
    """Moves parameter `i` outwards; the others are refitted at every step, each time from the last fit."""

    def __init__(
        self, problem: Problem, evaluate: EvaluateMany, j: FloatArray, *, best: Evaluation, i: int, allowed: float
    ) -> None:
        self.problem, self.evaluate, self.best, self.i, self.allowed = problem, evaluate, best, i, allowed
        self.others = np.arange(len(best.x)) != i
        self.follow = np.linalg.pinv(j[:, self.others])
        self.x = best.x.copy()
        self.found: dict[float, float] = {}

    def crossing(self, sign: float, width: float, limit: float) -> float:
        """Return the distance at which the rise is 1, or `limit` where it stays below."""
        from scipy.optimize import brentq

        before, stride, steps = 0.0, _STRIDE * width, 0
        while before < min(limit, _FARTHEST * width):
            here = min(before + stride, limit)
            if self.rise(sign, here) >= 1.0:
                return float(
                    brentq(lambda d: np.sqrt(self.rise(sign, d)) - 1.0, before, here, xtol=2e-3 * width, rtol=1e-3)
                )
            before, steps = here, steps + 1
            stride *= 2.0 if steps >= _STRIDES else 1.0
        return limit

    def rise(self, sign: float, distance: float) -> float:
        """Return the rise of the cost at `distance`, relative to the allowed one, and record it."""
        value = float(self.best.x[self.i] + sign * distance)
        if distance == 0.0:
            return 0.0
        if value not in self.found:
            self.found[value] = max(self._refit(value) - self.best.cost, 0.0) / self.allowed
        return self.found[value]

    def _refit(self, value: float) -> float:
        """Return the least cost with the parameter at `value`, by Gauss-Newton steps that never raise the cost."""
        lower, upper = self.problem.space.lower, self.problem.space.upper
        x = self.x.copy()
        x[self.i] = value
        here = self._evaluated(x)
        length = 1.0
        for _ in range(_REFITS):
            step = np.zeros(len(x))
            step[self.others] = -length * (self.follow @ here.residuals)
            (moved,) = self.evaluate([np.clip(here.x + step, lower, upper)])
            gain = here.cost - moved.cost if moved.ok else -np.inf
            if gain > 0.0:
                here = moved
            else:
                length *= 0.5
            if abs(gain) < _STILL * self.allowed * _STILL:
                break
        self.x = here.x.copy()
        return float(here.cost)

    def _evaluated(self, x: FloatArray) -> Evaluation:
        (evaluation,) = self.evaluate([x])
        if evaluation.failure is not None:
            raise SimulationError(f"the profile reaches a failing point ({evaluation.failure})")
        return evaluation
