"""The directions in which an estimate can vary under active constraints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import EvaluateMany
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation

_NEAR = 0.01  # relative to the distance by which the estimate would exceed a constraint


@dataclass(frozen=True, slots=True, eq=False)
class Active:
    """Constraints that are active at an estimate.

    Attributes
    ----------
    texts
        Their expressions or criteria.
    gradients
        (k, n) derivatives of the constraints in search space.
    """

    texts: tuple[str, ...]
    gradients: FloatArray


def active_constraints(
    problem: Problem, here: Evaluation, evaluate: EvaluateMany, step: float, descent: FloatArray
) -> Active:
    """Return the constraints that are active at the estimate.

    Equalities always are. An inequality is active if the estimate is at its limit and the (n,) step `descent`, to
    the minimum of the cost without constraints, violates it.

    Parameters
    ----------
    step
        Step of the central differences, in search units.

    Raises
    ------
    SimulationError
        A constraint depends on a criterion, and the neighbourhood of the estimate cannot be simulated.
    """
    n, constraints = len(here.x), problem.constraints
    if not constraints:
        return Active((), np.zeros((0, n)))
    ends = [
        np.clip(here.x + sign * step * np.eye(n)[i], problem.space.lower, problem.space.upper)
        for i in range(n)
        for sign in (1.0, -1.0)
    ]
    values = _violations(problem, here, evaluate, [here.x, *ends])
    widths = np.array(
        [above[i] - below[i] for i, (above, below) in enumerate(zip(ends[::2], ends[1::2], strict=True))]
    )
    gradients = (values[1::2] - values[2::2]).T / widths
    beyond = gradients @ descent
    held = [
        k
        for k, constraint in enumerate(constraints)
        if constraint.is_equality or (beyond[k] > 0.0 and values[0, k] > -_NEAR * beyond[k])
    ]
    return Active(tuple(constraints[k].text for k in held), gradients[held])


def tangent_space(gradients: FloatArray) -> FloatArray:
    """Return an orthonormal basis, (n, n - rank), of the directions orthogonal to (k, n) gradients."""
    sizes = np.linalg.norm(gradients, axis=1, keepdims=True)
    unit = gradients[sizes[:, 0] > 0.0] / sizes[sizes[:, 0] > 0.0]
    if not len(unit):
        return np.eye(gradients.shape[1])
    _, s, axes = np.linalg.svd(unit)
    return np.asarray(axes[int(np.sum(s > 1e-9 * s[0])) :].T)


def _violations(
    problem: Problem, here: Evaluation, evaluate: EvaluateMany, points: list[FloatArray]
) -> FloatArray:
    if all(constraint.expression is not None for constraint in problem.constraints):  # nothing to simulate
        values = [problem.space.to_model(x) for x in points]
        return np.array(
            [[c.violation(problem.labels, here.criteria, v) for c in problem.constraints] for v in values]
        )
    evaluations = evaluate(points)
    for evaluation in evaluations:
        if evaluation.failure is not None:
            raise SimulationError(evaluation.failure, fix="narrow the bounds")
    return np.array([evaluation.constraints for evaluation in evaluations])
