"""Sizes of parameters that start at 0, where neither start nor bounds show their order of magnitude."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation

_SMALLER = 1e-2  # factor from trial to trial
_TRIALS = 7
_ALIKE = 3.0  # factor between the changes of two steps and the ratio of the steps


def sized(problem: Problem) -> Problem:
    """Return the problem with search coordinates of parameters that start at 0 scaled by their effect.

    Within one unit from 0 the residuals change about in proportion. Parameters for which that holds from
    the default unit on, or nowhere, keep it, and so do all of them if the start cannot be simulated.
    """
    space = problem.space
    zeros = [k for k, s in enumerate(space.free) if s.start == 0.0 and s.scale == "linear"]
    here = problem.evaluate(space.start) if zeros else None
    if here is None or not here.ok:
        return problem
    sizes = dict.fromkeys(zeros, 1.0)
    pending, before = list(zeros), dict(zip(zeros, _changes(problem, here, sizes), strict=True))
    for _ in range(_TRIALS):
        after = dict(zip(pending, _changes(problem, here, {k: _SMALLER * sizes[k] for k in pending}), strict=True))
        pending = [k for k in pending if not _proportional(after[k], before[k])]
        if not pending:
            break
        sizes |= {k: _SMALLER * sizes[k] for k in pending}
        before |= after
    units = space.slope(space.start)
    small = {space.names[k]: float(units[k] * s) for k, s in sizes.items() if s < 1.0 and k not in pending}
    if not small:
        return problem
    scaled = problem.over(replace(space, sizes=small))
    scaled.findings = problem.findings
    return scaled


def _changes(problem: Problem, here: Evaluation, steps: Mapping[int, float]) -> list[float]:
    """Return how much each step of one parameter, into the bounds, changes the residuals; NaN where it fails."""
    points = []
    for k, step in steps.items():
        x = here.x.copy()
        x[k] += step if step <= problem.space.upper[k] else -step
        points.append(x)
    moved = problem.evaluate_many(points)
    return [float(np.linalg.norm(e.residuals - here.residuals)) if e.ok else float("nan") for e in moved]


def _proportional(change: float, before: float) -> bool:
    """Return whether a step of a hundredth changes a hundredth; no change counts as linear."""
    if before == 0.0:
        return True
    return _SMALLER / _ALIKE <= change / before <= _SMALLER * _ALIKE
