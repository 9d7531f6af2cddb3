"""Jacobians: exact if the models differentiate their runs, else noise-aware finite differences.

A co-simulation's output is only piecewise smooth in its parameters (adaptive steps, events), so textbook
steps of 1e-8 measure noise. The noise is estimated from a sixth difference (Hamming; More and Wild, 2011)
and the step balances it against truncation; a step that moves the residuals by less than a hundred times
the noise is enlarged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation

EvaluateMany = Callable[[Sequence[FloatArray]], list[Evaluation]]

_SPACING = 1e-4  # spacing of the points for the noise estimate, in search units
_WEIGHTS = np.array([1.0, -6.0, 15.0, -20.0, 15.0, -6.0, 1.0])  # sixth difference
_GAIN = math.sqrt(math.factorial(6) ** 2 / math.factorial(12))  # factor from its root mean square to the noise
_MARGIN = 100.0  # a difference must be this many times the noise
_LARGEST_STEP = 0.1
_SMALLEST_STEP = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFloor:
    """Scatter of predictions under tiny changes of the parameters.

    Parameters
    ----------
    residual
        Root mean square scatter of a residual (in sigmas).
    size
        Root mean square of the predictions in the same unit, for comparison.
    outputs
        (channels,) root mean square scatter for each case, in the outputs' units.
    """

    residual: float
    size: float
    outputs: tuple[FloatArray, ...]

    @property
    def relative(self) -> float:
        """Relative scatter, at least the rounding error."""
        return max(self.residual / self.size if self.size > 0.0 else 0.0, 4.0 * np.finfo(float).eps)

    @property
    def forward_step(self) -> float:
        """Best step of a one-sided difference, in search units."""
        return float(np.clip(2.0 * math.sqrt(self.relative), _SMALLEST_STEP, _LARGEST_STEP))

    @property
    def central_step(self) -> float:
        """Best step of a central difference, in search units."""
        return float(np.clip((3.0 * self.relative) ** (1.0 / 3.0), _SMALLEST_STEP, _LARGEST_STEP))


def noise_floor(problem: Problem, x: FloatArray, *, evaluate: EvaluateMany | None = None) -> NoiseFloor:
    """Estimate the simulator's noise around the (n,) search point `x` from seven evaluations.

    Raises
    ------
    SimulationError
        A point next to `x` cannot be simulated.
    """
    evaluate = evaluate or problem.evaluate_many
    lower, upper = problem.space.lower, problem.space.upper
    # Every parameter moves, with alternating sign, and towards the inside of its bounds.
    signs = np.where(np.arange(len(x)) % 2 == 0, 1.0, -1.0)
    reach = 6.0 * _SPACING
    signs = np.where(x + reach * signs > upper, -1.0, np.where(x + reach * signs < lower, 1.0, signs))
    # Uneven digits, so that no parameter takes the same rounded value twice.
    points = evaluate([x + k * _SPACING * signs * 1.0123456789 for k in range(7)])
    for point in points:
        if point.failure is not None:
            raise SimulationError(point.failure)
    residuals = np.array([point.residuals for point in points])
    difference = _WEIGHTS @ (residuals - residuals[0])
    change = np.sqrt(np.mean(difference**2))
    outputs: tuple[FloatArray, ...] = ()
    if all(point.predictions for point in points):  # a resumed run remembers residuals only
        outputs = tuple(
            _GAIN * np.sqrt(np.mean(np.tensordot(_WEIGHTS, np.array(p) - p[0], 1) ** 2, axis=1))
            for p in zip(*(point.predictions for point in points), strict=True)
        )
    return NoiseFloor(_GAIN * float(change), _size(problem, points[0]), outputs)


class Differences:
    """Jacobians of a problem's residuals: exact if every model supports it, else finite differences.

    Remembers the step each parameter needs.

    Parameters
    ----------
    problem
        The problem.
    floor
        The simulator's noise floor, which determines the steps.
    central
        Use two points per parameter instead of one, for covariances. A minimisation does not need them: the bias
        of the one-sided gradient is the step times the curvature, a few thousandths of a standard error.
    """

    def __init__(self, problem: Problem, floor: NoiseFloor, *, central: bool) -> None:
        self.floor, self.central = floor, central
        self.exact = False  # whether the last Jacobian was exact
        self._exact = problem.exact
        self._lower, self._upper = problem.space.lower, problem.space.upper
        self.steps = [floor.central_step if central else floor.forward_step] * len(problem.space)

    @property
    def tolerance(self) -> float:
        """Relative accuracy of a column of a Jacobian."""
        return max(1e-6, 5.0 * self.floor.central_step**2)

    def column_scale(self, jacobian: FloatArray) -> FloatArray:
        """Return divisors, (n,), after which each column of an (m, n) Jacobian has an error of `tolerance`.

        The singular values of the scaled Jacobian show what is determined, independent of the units and values of
        the parameters (Stewart, SIAM Review 26:567, 1984). A column within the simulator's scatter at the largest
        step stays small.
        """
        norms = np.linalg.norm(jacobian, axis=0)
        scatter = 0.0 if self.exact else self.floor.residual / _LARGEST_STEP * math.sqrt(len(jacobian))
        least = np.maximum(scatter, np.finfo(float).eps * np.max(norms, initial=1e-100))
        return np.asarray(np.maximum(norms, least / self.tolerance))

    def adopt(self, floor: NoiseFloor) -> None:
        """Use a noise floor measured elsewhere; steps only increase."""
        self.floor = floor
        step = floor.central_step if self.central else floor.forward_step
        self.steps = [max(step, old) for old in self.steps]

    def jacobian(self, evaluate: EvaluateMany, here: Evaluation, first: int = 0) -> FloatArray:
        """Return d residuals / d search point, (m, n), at `here`, for the coordinates from `first` on.

        Near a bound, or if one side cannot be simulated, only the other side is used.

        Raises
        ------
        SimulationError
            Neither side of a parameter can be simulated.
        """
        exact = self._exact.jacobian(here, first)
        self.exact = exact is not None
        if exact is not None:
            return exact
        columns: dict[int, FloatArray] = {}
        due = list(range(first, len(here.x)))
        while due:
            points = [(i, p) for i in due for p in self._moved(here.x, i, self.steps[i], self.central)]
            evaluated = evaluate([p for _, p in points])
            again: list[int] = []
            for i in due:
                sides = [e for (j, _), e in zip(points, evaluated, strict=True) if j == i and e.ok]
                if not sides:
                    sides = [e for e in evaluate(self._moved(here.x, i, -self.steps[i], False)) if e.ok]
                if not sides:
                    raise SimulationError(
                        f"no simulation close to {dict(here.parameters)} succeeds", fix="narrow the bounds"
                    )
                a, b = (sides[0], sides[1]) if len(sides) == 2 else (sides[0], here)
                change = a.residuals - b.residuals
                columns[i] = change / (a.x[i] - b.x[i])
                larger = min(10.0 * self.steps[i], _LARGEST_STEP)
                too_small = np.sqrt(np.mean(change**2)) < _MARGIN * self.floor.residual
                if too_small and larger > self.steps[i]:
                    self.steps[i] = larger
                    again.append(i)
            due = again
        return np.column_stack([columns[i] for i in range(first, len(here.x))])

    def _moved(self, x: FloatArray, i: int, step: float, both: bool) -> list[FloatArray]:
        """Return the points to evaluate for parameter `i`, all within the bounds."""
        lower, upper = self._lower[i], self._upper[i]
        inside = [end for end in (x[i] + step, x[i] - step) if lower <= end <= upper]
        if not inside:  # bounds closer than the step
            inside = [max((lower, upper), key=lambda bound: abs(bound - x[i]))]
        points = []
        for end in inside if both else inside[:1]:
            point = x.copy()
            point[i] = end
            points.append(point)
        return points


def _size(problem: Problem, evaluation: Evaluation) -> float:
    """Return the root mean square of the predictions in the residuals' unit (sigmas)."""
    moved = []
    if not evaluation.predictions:
        evaluation = problem.evaluate(evaluation.x)
    for case, prediction in zip(problem.cases, evaluation.predictions, strict=True):
        rows = {c.signal: y for c, y in zip(case.channels, prediction, strict=True)}
        for criterion in case.criteria:
            if criterion.rows is not None:
                y = rows[criterion.signal]
                moved.append(criterion.residuals(y) - criterion.residuals(np.zeros_like(y)))
    if not moved:
        return float(np.sqrt(np.mean(evaluation.residuals**2)))
    return float(np.sqrt(np.mean(np.concatenate(moved) ** 2)))
