"""A command of fmuid as a process that the page starts, stops and continues."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import IO

from fmuid.core.progress import AS_LINES, PROGRESS_VARIABLE, read_progress

_COMMAND = "from fmuid.cli import main; main()"
_INTERRUPTED = 130


class CommandProcess:
    """A command in a process of its own, whose results are in a folder.

    Stopping ends the process as Ctrl-C does: everything is in the journal, and `resume` continues exactly there,
    even after a restart of the machine.

    Parameters
    ----------
    *words
        The command, such as ``identify``, and its arguments.
    """

    def __init__(self, *words: object) -> None:
        self._command = [sys.executable, "-c", _COMMAND, *map(str, words)]
        self._process: subprocess.Popen[bytes] | None = None
        self._written: IO[bytes] | None = None
        self._lines: list[str] = []
        self._position, self._rest = 0, b""

    def start(self, *, resume: bool = False) -> None:
        """Start the command, or continue the interrupted one."""
        self._written = tempfile.TemporaryFile()  # noqa: SIM115 - the process writes to it
        self._lines, self._position, self._rest = [], 0, b""
        self._process = subprocess.Popen(
            [*self._command, *(["--resume"] if resume else [])],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._written,
            start_new_session=True,
            env=os.environ | {PROGRESS_VARIABLE: AS_LINES},
        )

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    def stop(self) -> None:
        """Stop the process as Ctrl-C does; it may take a moment to end."""
        if self._process is not None and self.running:
            self._process.send_signal(signal.SIGINT)

    def wait(self) -> None:
        """Wait until the process has ended."""
        if self._process is not None:
            self._process.wait()

    @property
    def progress(self) -> tuple[float, str] | None:
        """The fraction done (0 to 1) and the current task, if the command has reported them."""
        reported = (read_progress(line) for line in reversed(self._read()))
        return next((progress for progress in reported if progress is not None), None)

    @property
    def complaint(self) -> str:
        """The error message of a process that could not do its work, or nothing."""
        if self._process is None or self._process.poll() in (None, 0, _INTERRUPTED):
            return ""
        lines = [line for line in self._read() if read_progress(line) is None]
        return (
            lines[-1].removeprefix("fmuid: ") if lines else f"the process ended with code {self._process.poll()}"
        )

    def _read(self) -> Sequence[str]:
        """Return the whole lines that the process has written so far."""
        if self._written is not None:
            new = os.pread(
                self._written.fileno(), 1 << 24, self._position
            )  # the process moves the file's own position
            self._position += len(new)
            *lines, self._rest = (self._rest + new).split(b"\n")
            self._lines += [text for line in lines if (text := line.decode(errors="replace").strip())]
        return self._lines
