"""One updating status line on a terminal during long work."""

from __future__ import annotations

import os
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.text import Text


class MovingLine:
    """An updating status line, removed at the end; shown on a terminal only. Use it as a context manager."""

    def __init__(self, console: Console | None, *columns: ProgressColumn) -> None:
        # Under NO_COLOR, rich would still use bold and dim text; without a colour system there is neither.
        plain = bool(os.environ.get("NO_COLOR"))
        self.console = console or Console(stderr=True, color_system=None if plain else "auto")
        self._bar = Progress(
            SpinnerColumn(),
            *columns,
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()


class Waiting(MovingLine):
    """Shows the current task, the fraction done and the time left. Call it with fractions from 0 to 1."""

    def __init__(self, what: str = "", console: Console | None = None) -> None:
        super().__init__(
            console, BarColumn(bar_width=20), _TimeLeft(), TextColumn("{task.description}", markup=False)
        )
        self._task = self._bar.add_task(what, total=None)

    def __call__(self, share: float, what: str | None = None) -> None:
        """Show the share of the work that is done, and the current task."""
        self._bar.update(self._task, description=what, completed=share, total=1.0)


class _TimeLeft(ProgressColumn):
    """Elapsed time, and the estimated time left."""

    def render(self, task: Task) -> Text:
        """Return the column."""
        spent, share = task.elapsed or 0.0, task.completed
        left = f", about {spent * (1.0 - share) / share:.0f} s left" if share > 0.05 else ""
        return Text(f"{spent:.0f} s{left}")
