"""Estimates of earlier stages and their errors, for a stage that fixes parameters at them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fmuid.core.campaign import ParameterSpec, without_owner
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.uncertainty.confidence import Uncertainty
from fmuid.identification.uncertainty.inherited import Held

_STEP = 1e-3  # step of the differences of ties, in standard errors


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Errors of the estimates of the stages so far.

    Parameters
    ----------
    rows
        Estimated or tied parameter -> (k,) its error in model space, as a sum of k independent sources of unit
        variance.
    degrees
        (k,) degrees of freedom of each source.
    unsure
        Parameters that were estimated, but have no standard error.
    """

    rows: Mapping[str, FloatArray] = field(default_factory=dict)
    degrees: FloatArray = field(default_factory=lambda: np.zeros(0))
    unsure: frozenset[str] = frozenset()

    def held_in(self, problem: Problem, specs: Mapping[str, ParameterSpec]) -> Held | None:
        """Return the part that `problem` fixes and that affects its models; None if there is none."""
        space = problem.space
        names = [n for n in self.rows if n in space.fixed and problem.sees(n)]
        if not names:
            return None
        free = []
        for name in names:  # a tied parameter may be outside its own bounds
            spec, value = specs[without_owner(name)], space.fixed[name]
            low, high = min(spec.lower, value), max(spec.upper, value)
            free.append(replace(spec, name=name, start=value, lower=low, upper=high, scale="linear", prior=None))
        fixed = {n: v for n, v in space.fixed.items() if n not in names}
        joint = problem.over(replace(space, free=(*space.free, *free), fixed=fixed))
        slope = joint.space.slope(joint.space.start)[len(space) :]
        return Held(joint, np.array([self.rows[n] for n in names]) / slope[:, None], self.degrees)

    def after(self, problem: Problem, uncertainty: Uncertainty | None, values: Mapping[str, float]) -> Known:
        """Return the knowledge after the stage `problem`, given its uncertainty and its final `values`."""
        space = problem.space
        sources = np.zeros((0, 0))
        if uncertainty is not None:
            slope = space.slope(np.array(uncertainty.point))
            scatter, axes = np.linalg.eigh(
                np.array(uncertainty.covariance) - np.array(uncertainty.inherited or 0.0)
            )
            sources = slope[:, None] * axes * np.sqrt(np.maximum(scatter, 0.0))
        rows = {n: np.append(row, np.zeros(len(sources))) for n, row in self.rows.items() if n not in space.ties}
        errors = [] if uncertainty is None else uncertainty.standard_errors
        sure = {n for n, error in zip(space.names, errors, strict=False) if error is not None}
        moved = {}
        for k, name in enumerate(space.names):
            rows.pop(name, None)
            if uncertainty is not None and name in sure:
                inherited = sum(
                    (s * self.rows[h] for h, s in zip(uncertainty.held, uncertainty.held_slopes[k], strict=True)),
                    np.zeros(len(self.degrees)),
                )
                moved[name] = np.append(inherited, sources[k])
        rows |= moved
        rows |= _tied(problem, rows, values, len(self.degrees) + len(sources))
        freedom = 1.0 if uncertainty is None else uncertainty.degrees_of_freedom
        degrees = np.append(self.degrees, np.full(len(sources), np.inf if freedom is None else freedom))
        unsure = (self.unsure | set(space.names)) - sure - space.ties.keys()
        return Known(rows, degrees, unsure)


def _tied(
    problem: Problem, rows: Mapping[str, FloatArray], values: Mapping[str, float], sources: int
) -> dict[str, FloatArray]:
    """Return the rows of parameters that are tied to those in `rows`, by differences."""
    ties = problem.space.ties
    rows_of = {name: np.zeros(sources) for name in ties}
    for k in range(sources):
        above, below = (
            problem.space.followed(dict(values) | {n: values[n] + step * row[k] for n, row in rows.items()})
            for step in (_STEP, -_STEP)
        )
        for name, row in rows_of.items():
            row[k] = (above[name] - below[name]) / (2.0 * _STEP)
    return {name: row for name, row in rows_of.items() if row.any()}
