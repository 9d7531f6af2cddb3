"""Start, progress and end of a long command, as a part of the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nicegui import ui

from fmuid.page.command_process import CommandProcess
from fmuid.page.elements import button, element, enable, errors_shown, set_text, text


@dataclass(frozen=True, slots=True)
class Command:
    """A command that can be started.

    Parameters
    ----------
    words
        Returns the command and its arguments; raises an error if it cannot be started now.
    result
        The file that it writes at its end.
    journal
        The file from which it continues after an interruption, if it can.
    """

    words: Callable[[], Sequence[object]]
    result: Path
    journal: Path | None = None

    @property
    def interrupted(self) -> bool:
        """Whether it can be continued."""
        return self.journal is not None and self.journal.is_file()


class CommandControl:
    """Buttons that start and stop a command and show its result, with its progress.

    Parameters
    ----------
    title
        Title of the part.
    start
        Words of the button that starts the command.
    command
        Returns the command as it would be started now.
    look
        Words of the button that shows the result.
    finished
        Called when this button is pressed.
    purpose
        One or two sentences for the user.
    stop
        Words of the button that stops it.
    options
        Makes what the user can choose before the start.
    """

    def __init__(
        self,
        title: str,
        start: str,
        command: Callable[[], Command],
        *,
        look: str,
        finished: Callable[[], object],
        purpose: str,
        stop: str = "Pause",
        options: Callable[[], object] = lambda: None,
    ) -> None:
        self._make = command
        self._command = command()
        self._process = CommandProcess()
        with element("section", "command", aria_label=title):
            text("h2", title)
            text("p", purpose, "soft")
            options()
            with element("div", "buttons"):
                self._start = button(start, self._started)
                self._stop = button(stop, lambda: self._process.stop())
                self._look = button(look, finished)
            self._bar = element("progress", max="1", aria_label=f"{title}: fraction done")
            self._status = text("p", "", "", role="status")
            self._complaint = text("p", "", "note error", role="alert")
        self._show()
        ui.timer(0.5, self._show)

    def _started(self) -> None:
        with errors_shown():
            self._command = self._make()
            self._process = CommandProcess(*self._command.words())
            self._process.start(resume=self._command.interrupted)
        self._show()

    def _show(self) -> None:
        process = self._process
        running = process.running  # before its files are looked at: those of a process that has ended are complete
        if not running:
            self._command = self._make()
        done = not running and self._command.result.is_file() and not self._command.interrupted
        words, share = "", 0.0
        if running:
            share, task = process.progress or (0.0, "starting")
            words = f"{100 * share:.0f} %: {task}"
        elif self._command.interrupted:
            words = "Paused; start it to continue"
        elif done and not process.complaint:
            words = f"Done: {self._command.result.parent}"
        set_text(self._status, words)
        set_text(self._complaint, process.complaint)
        self._complaint.set_visibility(bool(process.complaint))
        self._bar.set_visibility(running)
        if self._bar.props.get("value") != f"{share:.3f}":
            self._bar.props["value"] = f"{share:.3f}"
            self._bar.update()
        enable(self._start, not running)
        enable(self._stop, running)
        enable(self._look, done)
