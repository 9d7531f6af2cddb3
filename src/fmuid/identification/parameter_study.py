"""A plain parameter study: every criterion of a stage on a grid of parameter values."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmuid.core.campaign import Campaign, ParameterSpec
from fmuid.core.errors import ProblemError
from fmuid.core.formatting import text_table
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator

_BATCH = 64  # points between two reports of progress
_MOST = 100_000  # points of a grid
_SHOWN = 40  # rows of the table on a terminal


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The criteria of a stage over a grid; prints as a table, best points first.

    Parameters
    ----------
    stage
        Name of the stage.
    over
        Values of each varied parameter, in model space; the last one varies fastest.
    labels
        Criteria, each divided by its demand.
    points
        (n_points, n_parameters) values.
    criteria, cost
        (n_points, n_criteria) and (n_points,); NaN where a point cannot be simulated.
    failures
        Reason for each point that cannot be simulated, by its number.
    """

    stage: str
    over: Mapping[str, FloatArray]
    labels: tuple[str, ...]
    points: FloatArray
    criteria: FloatArray
    cost: FloatArray
    failures: Mapping[int, str]

    @property
    def best(self) -> int | None:
        """Number of the point with the smallest cost; None if none could be simulated."""
        return None if np.isnan(self.cost).all() else int(np.nanargmin(self.cost))

    @property
    def header(self) -> list[str]:
        """Titles of the columns of the table."""
        return [*self.over, "cost", *self.labels]

    def row(self, k: int) -> list[float]:
        """Return the numbers of the point `k`, in the order of `header`."""
        return [*self.points[k].tolist(), float(self.cost[k]), *self.criteria[k].tolist()]

    def __str__(self) -> str:
        """Return the best points as a table."""
        order = np.argsort(np.where(np.isnan(self.cost), np.inf, self.cost), kind="stable")[:_SHOWN]
        rows = [["failed" if math.isnan(v) else f"{v:.5g}" for v in self.row(int(k))] for k in order]
        head = f"{self.stage}: {len(self.points)} points"
        if self.failures:
            why = next(iter(self.failures.values()))
            head += f", {len(self.failures)} of them failed (the first: {why})"
        more = f"\n... and {len(self.points) - _SHOWN} more" if len(self.points) > _SHOWN else ""
        return f"{head}\n{text_table([self.header, *rows])}{more}"


def grid_values(text: str) -> tuple[str, FloatArray]:
    """Return name and values of ``k=1..3:7`` (seven values), ``k=1..100:5:log`` or ``k=0.5,1,2``.

    Raises
    ------
    ProblemError
        The text is not of one of these forms.
    """
    fix = "write NAME=LOW..HIGH:COUNT, such as k=1..3:7, k=1..100:5:log, or a list, k=0.5,1,2"
    name, equals, values = text.partition("=")
    number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
    span = re.fullmatch(rf"({number})\.\.({number}):(\d+)(:log)?", values.strip())
    try:
        if not (name.strip() and equals):
            raise ValueError
        if span is None:
            grid = np.array([float(v) for v in values.split(",")])
        else:
            low, high, count = float(span[1]), float(span[2]), int(span[3])
            if count < 2 or (span[4] and low <= 0.0):
                raise ValueError
            grid = np.geomspace(low, high, count) if span[4] else np.linspace(low, high, count)
        if not np.isfinite(grid).all():
            raise ValueError
    except ValueError:
        raise ProblemError(f"'{text}' is not understood", where="--over", fix=fix) from None
    return name.strip(), grid


def parameter_study(
    campaign: Campaign,
    over: Mapping[str, Sequence[float] | FloatArray],
    *,
    stage: str | None = None,
    simulators: Mapping[str, Simulator],
    runner: Runner = in_process,
    progress: Callable[[float], None] = lambda _: None,
) -> Study:
    """Evaluate a stage on the grid of the values in `over`; other parameters keep their start values.

    Parameters
    ----------
    campaign, stage
        The campaign, and the name of its stage; the first one by default.
    over
        Values by parameter.
    simulators, runner
        Models by setup, and what simulates them.
    progress
        Called with the fraction done (0 to 1).

    Raises
    ------
    FmuidError
        The stage or a parameter does not exist, or the grid has too many points.
    """
    if not campaign.stages:
        raise ProblemError(f"campaign '{campaign.name}' has no stages", fix="write [stages.<name>]")
    name = stage or next(iter(campaign.stages))
    if name not in campaign.stages:
        raise ProblemError(f"no stage '{name}'", fix=f"the campaign has: {', '.join(campaign.stages)}")
    problem = Problem.of_stage(campaign, campaign.stages[name], simulators, runner=runner)
    space = problem.space
    base = {**space.fixed, **{spec.name: spec.start for spec in space.free}}
    for varied in over:
        if varied not in base:
            raise ProblemError(
                f"no parameter '{varied}' in stage '{name}'", where="--over", fix=f"there are: {', '.join(base)}"
            )
    grid = {varied: np.asarray(values, dtype=np.float64) for varied, values in over.items()}
    if math.prod(map(len, grid.values())) > _MOST:
        raise ProblemError(f"more than {_MOST} points", where="--over", fix="use fewer values")
    points = np.array(list(itertools.product(*grid.values()))).reshape(-1, len(grid))
    free = tuple(ParameterSpec(varied, base.pop(varied)) for varied in grid)
    posed = problem.over(replace(space, free=free, fixed=base, least={}, sizes={}))
    failures: dict[int, str] = {}
    criteria, cost = np.full((len(points), len(problem.labels)), np.nan), np.full(len(points), np.nan)
    for begin in range(0, len(points), _BATCH):
        batch = points[begin : begin + _BATCH]
        searched = [posed.space.to_search(dict(zip(grid, row, strict=True))) for row in batch.tolist()]
        for k, evaluation in enumerate(posed.evaluate_many(searched), begin):
            criteria[k], cost[k] = evaluation.criteria, evaluation.cost
            if evaluation.failure is not None:
                failures[k] = evaluation.failure
        progress(min(begin + _BATCH, len(points)) / len(points))
    return Study(name, grid, problem.labels, points, criteria, cost, failures)
