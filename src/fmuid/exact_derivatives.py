"""The exact Jacobian of a problem, where its models differentiate their own runs (forward sensitivities).

One run of each case gives the derivatives of its outputs by everything that the free parameters set on the model.
What lies around the simulation (scales, ties, units, sensors, criteria) costs next to nothing and is
differentiated by central differences of its own, with the simulation in them replaced by its tangent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fmuid.campaign import FloatArray
from fmuid.cases import Case
from fmuid.errors import SimulationError
from fmuid.problem import Evaluation, Problem
from fmuid.simulation import Task, differentiates

_STEP = 1e-6  # of the differences around the simulation, in search units
_End = tuple[float, Mapping[str, float]]
"""A point close to another: how far it is along one search coordinate, and every parameter there."""
Direction = tuple[dict[str, float], float]
"""How a model's variables move with one search coordinate: their proportions, and their size."""


def direction(above: Mapping[str, float], below: Mapping[str, float], width: float) -> Direction:
    """Return how a model's variables move from one point to another that is `width` away along one coordinate."""
    slopes = {name: (above[name] - below[name]) / width for name in above if above[name] != below[name]}
    size = max(map(abs, slopes.values()), default=0.0)
    return {name: round(slope / size, 9) for name, slope in slopes.items()}, size


def _of_ends(case: Case, above: _End, below: _End) -> Direction:
    return direction(case.start_values(above[1]), case.start_values(below[1]), above[0] - below[0])


class ExactDerivatives:
    """Jacobians of a problem's residuals by forward sensitivities; remembers what it asks the models for."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._tasks: dict[tuple[int, tuple[tuple[tuple[str, float], ...], ...]], Task] = {}

    def jacobian(self, here: Evaluation) -> FloatArray | None:
        """Return d residuals / d search point, (m, n), at `here`; None where a model cannot tell."""
        problem = self._problem
        ends = self._ends(here.x)
        jobs, directions = [], []
        for k, case in enumerate(problem.cases):
            own = [_of_ends(case, *pair) for pair in ends]
            names = {name for along, _ in own for name in along}
            if names and not differentiates(case.simulator, names):
                return None
            jobs.append((case.simulator, self._task(k, case, own), case.start_values(here.parameters)))
            directions.append(own)
        outcomes = problem.runner(jobs)
        blocks = []
        for case, outcome, own in zip(problem.cases, outcomes, directions, strict=True):
            if isinstance(outcome, SimulationError):
                return None
            blocks.append(self._block(case, np.asarray(outcome), own, ends))
        lengths = [s.stop - s.start for s in problem.slices]
        return np.asarray(np.concatenate(blocks) * np.repeat(problem.root_weights, lengths)[:, None])

    def _ends(self, x: FloatArray) -> list[tuple[_End, _End]]:
        """Return for every free parameter two points close to `x`, inside the bounds."""
        space, ends = self._problem.space, []
        for i in range(len(x)):
            pair: list[_End] = []
            for step in (_STEP, -_STEP):
                point = x.copy()
                point[i] = np.clip(x[i] + step, space.lower[i], space.upper[i])
                pair.append((float(point[i] - x[i]), space.to_model(point)))
            ends.append((pair[0], pair[1]))
        return ends

    def _task(self, index: int, case: Case, own: list[Direction]) -> Task:
        """Return the case's task with its directions: the same object for the same directions."""
        along = tuple(direction for direction, _ in own if direction)
        key = (index, tuple(tuple(direction.items()) for direction in along))
        if key not in self._tasks:
            self._tasks[key] = replace(case.task, along=along)
        return self._tasks[key]

    @staticmethod
    def _block(
        case: Case,
        outcome: FloatArray,
        own: list[Direction],
        ends: list[tuple[_End, _End]],
    ) -> FloatArray:
        """Return the rows of the Jacobian that belong to one case, before the criteria's weights."""
        n = len(case.task.outputs)
        base, slopes = outcome[:n], iter(outcome[n:].reshape(-1, n, outcome.shape[1]))
        columns = []
        for (direction, size), pair in zip(own, ends, strict=True):
            slope = size * next(slopes) if direction else np.zeros_like(base)
            (above, more), (below, less) = (
                (step, np.concatenate(case.residuals(case.sensed(base + step * slope, values))))
                for step, values in pair
            )
            columns.append((more - less) / (above - below))
        return np.column_stack(columns)
