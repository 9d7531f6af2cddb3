"""Progress of a diagnosis on a terminal."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.text import Text


class DiagnosisProgress:
    """One line that moves: what is being done, how much is behind, the time left. Use it as a context manager."""

    def __init__(self, console: Console | None = None) -> None:
        console = console or Console(stderr=True)
        self._bar = Progress(
            SpinnerColumn(),
            BarColumn(bar_width=20),
            _TimeLeft(),
            TextColumn("{task.description}", markup=False),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=1.0)

    def __enter__(self) -> DiagnosisProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def __call__(self, what: str, share: float) -> None:
        """Show what is being done now and the share of the work that is behind."""
        self._bar.update(self._task, description=what, completed=share)


class _TimeLeft(ProgressColumn):
    """Time spent, and what the share that is behind lets expect of the rest."""

    def render(self, task: Task) -> Text:
        """Return the column."""
        spent, share = task.elapsed or 0.0, task.completed
        left = f", about {spent * (1.0 - share) / share:.0f} s left" if share > 0.05 else ""
        return Text(f"{spent:.0f} s{left}")
