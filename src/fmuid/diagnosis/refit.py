"""Least squares in units of noise: Levenberg-Marquardt within bounds, finite steps well above solver noise.

A trial point whose simulation fails is not given a number: the step is shortened instead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.observed import Observed

Predict = Callable[[Sequence[Mapping[str, float]]], Sequence[Sequence[FloatArray] | SimulationError]]
"""Points in parameter space -> predictions (C, N) of every experiment, or why there are none."""


Tangents = Callable[[Mapping[str, float], Sequence[str]], Mapping[str, Sequence[FloatArray]]]
"""A point, names of parameters -> d prediction / d parameter of every experiment, by name, where it is known."""

_WORTH = 4  # exact columns cost three runs and a third of one each, differences one each


@dataclass(frozen=True, slots=True)
class Unknown:
    """A parameter that is searched: bounds, and the step that is small but well above solver noise."""

    name: str
    start: float
    lower: float
    upper: float
    step: float


@dataclass(frozen=True, slots=True, eq=False)
class Refit:
    """Where a refit ended.

    Attributes
    ----------
    values
        Parameter -> estimate.
    residuals
        Whitened residual of the mean run, (M_e,) an experiment.
    jacobian
        d residual / d parameter, (M_e, P) an experiment, at the estimate, by finite steps.
    cost
        Sum over runs of squared whitened residuals of the mean run.
    evaluations
        Simulations of the whole campaign that it took.
    converged
        Whether it ended by its own tolerance, not by its budget.
    """

    unknowns: tuple[Unknown, ...]
    values: Mapping[str, float]
    residuals: tuple[FloatArray, ...]
    jacobian: tuple[FloatArray, ...]
    cost: float
    evaluations: int
    converged: bool


def refit(
    predict: Predict,
    observed: Observed,
    unknowns: Sequence[Unknown],
    *,
    start: Mapping[str, float] | None = None,
    known: Refit | None = None,
    tangents: Tangents | None = None,
    max_iterations: int = 12,
    tolerance: float = 1e-3,
) -> Refit:
    """Minimise the whitened squared residual of the mean runs.

    Parameters
    ----------
    predict
        Simulates the campaign at several points.
    observed
        The measurements and their noise.
    unknowns
        What is searched.
    start
        Start values, where not those of `unknowns`.
    known
        A refit of some of the `unknowns`: its Jacobian serves for them and is not simulated again. The result
        is then as good as that Jacobian still holds; refit once more from it without `known` to be exact.
    tangents
        Gives exact derivatives. Without, where it knows none and within a step of a bound (there an effect may
        just begin) columns are finite differences.
    max_iterations
        Jacobians at the most.
    tolerance
        Ends when an iteration lowers the cost by less than this share of it, or by less than 0.5.

    Raises
    ------
    SimulationError
        The start itself cannot be simulated.
    """
    steps = np.array([u.step for u in unknowns])
    lower = np.array([u.lower for u in unknowns])
    upper = np.array([u.upper for u in unknowns])
    names = [u.name for u in unknowns]
    x = np.array([(start or {}).get(u.name, u.start) for u in unknowns])
    x = np.clip(x, lower, upper)
    weight = np.sqrt(observed.repeats)
    evaluations = 0

    def evaluate(points: Sequence[FloatArray]) -> list[tuple[FloatArray, ...]]:
        nonlocal evaluations
        evaluations += len(points)
        wanted = [{n: float(v) for n, v in zip(names, p, strict=True)} for p in points]
        results = []
        for outcome in predict(wanted):
            if isinstance(outcome, SimulationError):
                raise outcome
            results.append(observed.residuals(outcome))
        return results

    def stack(parts: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate([w * p for w, p in zip(weight, parts, strict=True)])

    stale = {} if known is None else {u.name: k for k, u in enumerate(known.unknowns)}

    def exactly(point: FloatArray, wanted: Sequence[int]) -> dict[int, tuple[FloatArray, ...]]:
        nonlocal evaluations
        inside = [k for k in wanted if lower[k] + steps[k] < point[k] < upper[k] - steps[k]]
        if tangents is None or len(inside) < _WORTH:
            return {}
        values = {n: float(v) for n, v in zip(names, point, strict=True)}
        found = tangents(values, [names[k] for k in inside])
        evaluations += 1
        columns = {k: observed.whiten(found[names[k]]) for k in inside if names[k] in found}
        # What moves nothing at all may still do so after a step, as a backlash that is not reached.
        return {k: parts for k, parts in columns.items() if any(np.any(p) for p in parts)}

    def differentiate(
        point: FloatArray, base: Sequence[FloatArray], *, last: bool = False
    ) -> tuple[FloatArray, ...]:
        signs = np.where(point + steps > upper, -1.0, 1.0)
        fresh = [k for k, name in enumerate(names) if name not in stale]
        exact = {} if last else exactly(point, fresh)
        fresh = [k for k in fresh if k not in exact]
        moved = evaluate([point + signs[k] * steps[k] * np.eye(len(point))[k] for k in fresh])
        parts = dict(zip(fresh, moved, strict=True))
        jacobian = []
        for e, b in enumerate(base):
            matrix = np.empty((b.size, len(point)))
            for k, name in enumerate(names):
                if k in exact:
                    matrix[:, k] = exact[k][e]
                elif k in parts:
                    matrix[:, k] = signs[k] * (parts[k][e] - b) / steps[k]
                elif known is not None:
                    matrix[:, k] = known.jacobian[e][:, stale[name]]
            jacobian.append(matrix)
        return tuple(jacobian)

    (residuals,) = evaluate([x])
    cost = float(np.sum(stack(residuals) ** 2))
    damping, converged = 1e-3, len(x) == 0
    for _ in range(max_iterations):
        if converged:
            break
        jacobian = differentiate(x, residuals)
        j = np.concatenate([w * p for w, p in zip(weight, jacobian, strict=True)]) * steps
        r = stack(residuals)
        gradient, normal = j.T @ r, j.T @ j
        free = ~(((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0)))
        if not free.any():
            converged = True
            break
        improved = False
        while damping < 1e8:
            a = normal[np.ix_(free, free)]
            scale = np.diag(a) + 1e-12 * (np.trace(normal) + 1e-300)
            move = np.zeros_like(x)
            move[free] = np.linalg.solve(a + damping * np.diag(scale), -gradient[free])
            trial = np.clip(x + move * steps, lower, upper)
            if np.all(np.abs(trial - x) <= 1e-6 * steps):
                break
            try:
                (trial_residuals,) = evaluate([trial])
            except SimulationError:
                damping *= 10.0
                continue
            trial_cost = float(np.sum(stack(trial_residuals) ** 2))
            if trial_cost < cost:
                improved = True
                break
            damping *= 5.0
        if not improved:
            converged = True
            break
        gained = cost - trial_cost
        x, residuals, cost = trial, trial_residuals, trial_cost
        damping = max(damping / 10.0, 1e-9)
        converged = gained < max(0.5, tolerance * cost)
    # The search follows the exact slope. What is predicted from the result is as far away as a plausible step,
    # where the slope of an effect that begins somewhere (a backlash) is another one.
    jacobian = differentiate(x, residuals, last=True)
    values = {n: float(v) for n, v in zip(names, x, strict=True)}
    return Refit(tuple(unknowns), values, residuals, jacobian, cost, evaluations, converged)
