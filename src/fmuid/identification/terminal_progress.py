"""Progress of an identification on a terminal; only this module of the engine imports rich."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, ProgressColumn, Task, TextColumn
from rich.text import Text

from fmuid.core.status_line import MovingLine
from fmuid.identification.observer import Observer
from fmuid.identification.observer import Progress as Report
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.result import StageResult
from fmuid.identification.solvers.search import Status, StopRules


class TerminalProgress(MovingLine, Observer):
    """An updating line for the current stage, and a permanent line for each completed stage.

    Use it as a context manager; without a terminal, only the permanent lines are printed. The result shows
    warnings.
    """

    def __init__(self, console: Console | None = None) -> None:
        super().__init__(
            console,
            TextColumn("{task.description}"),
            BarColumn(bar_width=10),
            TextColumn("{task.fields[evaluations]} evaluations, cost {task.fields[cost]}"),
            _TimeLeft(),
        )
        self._task = None if self._bar.disable else self._bar.add_task("", visible=False, **_fields())

    def started(self, problem: Problem, solver: str, why: str, stop: StopRules) -> None:  # noqa: ARG002
        """See `Observer.started`."""
        if self._task is not None:
            self._bar.reset(self._task, description=escape(f"{problem.name}, {solver}"), **_fields())
            self._bar.update(self._task, visible=True, refresh=True)

    def evaluated(self, progress: Report) -> None:
        """See `Observer.evaluated`."""
        if self._task is None:
            return
        # The share of the budget that is closest to exhaustion.
        stop, shares = progress.stop, [0.0]
        if stop.evaluations:
            shares.append(progress.evaluations / stop.evaluations)
        if stop.seconds:
            shares.append(progress.seconds / stop.seconds)
        cost = "none yet" if progress.cost is None else f"{progress.cost:.4g}"
        self._bar.update(
            self._task,
            total=1.0 if max(shares) > 0.0 else None,
            completed=min(max(shares), 1.0),
            evaluations=progress.evaluations,
            cost=cost,
            seconds=progress.seconds,
        )

    def finished(self, result: StageResult) -> None:
        """See `Observer.finished`."""
        if self._task is not None:
            self._bar.update(self._task, visible=False)
        good = result.status in (Status.CONVERGED, Status.STALLED, Status.BUDGET)
        style = "green" if result.sound else "yellow" if good else "red"
        self.console.print(Text(result.summary, style=style), soft_wrap=True)


class _TimeLeft(ProgressColumn):
    """Elapsed time, and the most that the budget leaves; a stage that converges ends earlier."""

    def render(self, task: Task) -> Text:
        """Return the column."""
        spent = float(task.fields["seconds"])
        share = task.completed / task.total if task.total else 0.0
        left = f", < {spent * (1.0 - share) / share:.0f} s left" if share > 0.0 else ""
        return Text(f"{spent:.0f} s{left}", no_wrap=True)


def _fields() -> dict[str, Any]:
    return {"evaluations": 0, "cost": "none yet", "seconds": 0.0, "total": None}
