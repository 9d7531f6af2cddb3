"""The exact Jacobian of a problem whose models differentiate their own runs (forward sensitivities).

One run of each case gives its outputs and their derivatives with respect to everything that the free parameters
set on the model. The steps around the simulation are either linear (scales, units, most criteria) or cheap (ties,
sensors, other criteria), and the latter are differentiated by central differences.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.cases import Case, Channel
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.problem.search_space import Move, SearchSpace
from fmuid.simulation.runners import Job, Runner
from fmuid.simulation.simulator import Task

_KEPT = 4_000_000  # numbers in cached Jacobians, 32 MB


class Posed(Protocol):
    """The parts of a `Problem` on which its derivatives depend."""

    cases: tuple[Case, ...]
    space: SearchSpace
    runner: Runner
    root_weights: FloatArray

    @property
    def slices(self) -> tuple[slice, ...]:
        """Slice of each criterion in the residual vector."""


class ExactDerivatives:
    """Jacobians of a problem's residuals by forward sensitivities; the latest ones are cached."""

    def __init__(self, problem: Posed) -> None:
        self._problem = problem
        self._slopes: list[Mapping[str, float]] = []  # the slopes that the tasks are for
        self._tasks: list[Task] | None = None
        self._found: OrderedDict[tuple[bytes, int], FloatArray | None] = OrderedDict()  # None: refused

    def jacobian(self, here: Evaluation, first: int = 0) -> FloatArray | None:
        """Return d residuals / d search point, (m, n), at `here`; None if a model has no derivatives.

        Only the coordinates from `first` on are included.
        """
        key = here.x.tobytes(), first
        if key not in self._found:
            self.simulate([(here.x, here.parameters)], first)
        return self._found.get(key)

    def simulate(
        self, points: Sequence[tuple[FloatArray, Mapping[str, float]]], first: int = 0
    ) -> dict[tuple[int, tuple[float, ...]], FloatArray]:
        """Simulate (n,) search points with all parameters' values, and cache their Jacobians; see `jacobian`.

        Nothing is simulated if a model has no derivatives, or beyond the number of cached Jacobians.

        Returns
        -------
        dict
            Predictions by case number and start values of the model.
        """
        problem, jobs = self._problem, list[Job]()
        if len(points) > 1 and len(points) * problem.slices[-1].stop * len(problem.space) > _KEPT:
            return {}
        predictions: dict[tuple[int, tuple[float, ...]], FloatArray] = {}
        try:
            moves = [problem.space.moves(x, values)[first:] for x, values in points]
        except ProblemError:  # a tie has no derivative at one of the points
            return {}
        for (_, values), there in zip(points, moves, strict=True):
            tasks = self._differentiated([move.slopes for move in there], tuple(values))
            if tasks is None:
                return {}
            jobs += [(c.simulator, t, c.start_values(values)) for c, t in zip(problem.cases, tasks, strict=True)]
        outcomes = problem.runner(jobs)
        for (x, values), there in zip(points, moves, strict=True):
            at_point, jobs = jobs[: len(problem.cases)], jobs[len(problem.cases) :]
            runs, outcomes = outcomes[: len(at_point)], outcomes[len(at_point) :]
            known = list[tuple[Case, Task, FloatArray]]()
            for k, (case, (_, task, starts), run) in enumerate(zip(problem.cases, at_point, runs, strict=True)):
                if isinstance(run, SimulationError):
                    break
                predictions[k, tuple(starts.values())] = run[: len(task.outputs)].copy()
                known.append((case, task, np.asarray(run)))
            self._keep((x.tobytes(), first), self._assembled(x, first, known, there, values))
        return predictions

    def _assembled(
        self,
        x: FloatArray,
        first: int,
        runs: Sequence[tuple[Case, Task, FloatArray]],
        moves: Sequence[Move],
        values: Mapping[str, float],
    ) -> FloatArray | None:
        """Return the Jacobian from the runs of all cases, rows of priors last; None if a case has none."""
        problem = self._problem
        if len(runs) < len(problem.cases):
            return None
        try:
            blocks = [block for case, task, run in runs for block in _blocks(case, task, run, moves, values)]
        except (ProblemError, SimulationError):  # a sensor or a user's criterion has no value nearby
            return None
        slope = problem.space.slope(x)[first:, None]
        count = problem.slices[-1].stop
        jacobian = np.zeros((count + len(problem.space.priors), len(slope)))
        for row, (i, prior) in enumerate(problem.space.priors, count):
            if i >= first:
                jacobian[row, i - first] = slope[i - first, 0] / prior.sd
        for rows, weight, block in zip(problem.slices, problem.root_weights, blocks, strict=True):
            jacobian[rows] = (weight * slope * block).T
        return jacobian

    def _differentiated(self, slopes: list[Mapping[str, float]], names: tuple[str, ...]) -> list[Task] | None:
        """Return every case's task with its directions, the same objects each time; None if a case has none."""
        if slopes != self._slopes:
            self._slopes, self._tasks = slopes, []
            for case in self._problem.cases:
                along = [_direction(case, s, names) for s in slopes]
                moved = {name for direction in along for name in direction}
                if moved and not case.simulator.differentiates(moved):
                    self._tasks = None
                    break
                self._tasks.append(replace(case.task, along=tuple(filter(None, along))))
        return self._tasks

    def _keep(self, key: tuple[bytes, int], jacobian: FloatArray | None) -> None:
        self._found[key] = jacobian
        while len(self._found) > 1 and sum(j.size for j in self._found.values() if j is not None) > _KEPT:
            self._found.popitem(last=False)


def _direction(case: Case, slopes: Mapping[str, float], names: tuple[str, ...]) -> dict[str, float]:
    """Return how the case's model moves with the parameters `names`, by variable; empty if it does not."""
    return {variable: unit.factor * slopes[n] for variable, n, unit in case.reached(names) if slopes.get(n)}


def _blocks(
    case: Case, task: Task, run: FloatArray, moves: Sequence[Move], values: Mapping[str, float]
) -> Iterator[FloatArray]:
    """Return for every criterion of a case the (n, m) derivatives of its residuals by the free parameters."""
    time, n = case.time, len(task.outputs)
    base, tangents = run[:n, case.lead :], run[n:, case.lead :].reshape(-1, n, len(time))
    if len(tangents) < len(moves):  # some parameters do not affect this model
        rows = [k for k, move in enumerate(moves) if _direction(case, move.slopes, tuple(values))]
        tangents, previous = np.zeros((len(moves), n, len(time))), tangents
        tangents[rows] = previous
    shown: dict[str, tuple[FloatArray, FloatArray]] = {}
    for k, channel in enumerate(case.channels):
        y, slopes = base[k], tangents[:, k]
        if not channel.plain:
            sensed = partial(_sensed, case, channel, y)
            y, slopes = sensed(values), channel.scaled(time, slopes, case.values(values))
            names = {name for expression in channel.sensor.values() for name in expression.names}
            for row, move in zip(slopes, moves, strict=True):
                if not names.isdisjoint(case.values(move.slopes)):
                    row += move.derivative(sensed, values)
        shown[channel.signal] = y, slopes
    for criterion in case.criteria:
        y, slopes = shown[criterion.signal]
        if criterion.affine:
            yield criterion.residuals(slopes) - criterion.residuals(np.zeros_like(y))
        else:
            columns = []
            for slope, (up, down) in zip(slopes, (move.ends for move in moves), strict=True):
                above, below = criterion.residuals(y + up * slope), criterion.residuals(y + down * slope)
                columns.append((above - below) / (up - down))
            yield np.array(columns)


def _sensed(case: Case, channel: Channel, y: FloatArray, values: Mapping[str, float]) -> FloatArray:
    return channel.sensed(case.time, y, case.values(values))
