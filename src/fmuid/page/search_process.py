"""The command `fmuid identify` as a process that the page starts, pauses and continues."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO

_COMMAND = "from fmuid.cli import main; main()"


class SearchProcess:
    """An identification in a process of its own, with its result and history in a run folder.

    Pausing ends the process as Ctrl-C does: everything is in the journal, and `resume` continues exactly there, be
    it after a restart of the machine.

    Parameters
    ----------
    campaign
        The campaign's folder or file.
    folder
        The run folder.
    trust
        Whether functions that the campaign names may be called.
    """

    def __init__(self, campaign: Path, folder: Path, *, trust: bool = False) -> None:
        self.folder = folder
        self._command = [sys.executable, "-c", _COMMAND, "identify", str(campaign), "--out", str(folder)]
        self._command += ["--no-report", *(["--trust"] if trust else [])]
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: IO[bytes] | None = None

    def start(self, *, resume: bool = False) -> None:
        """Start the identification, or continue the interrupted one."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - the process writes to it
        self._process = subprocess.Popen(
            [*self._command, *(["--resume"] if resume else [])],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            start_new_session=True,
        )

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.poll() is None

    def pause(self) -> None:
        """Stop the process as Ctrl-C does; it may take a moment to end."""
        if self._process is not None and self.running:
            self._process.send_signal(signal.SIGINT)

    def wait(self) -> None:
        """Wait until the process has ended."""
        if self._process is not None:
            self._process.wait()

    @property
    def complaint(self) -> str:
        """The error message of a process that could not do its work, or nothing."""
        if self._process is None or self._errors is None or self._process.poll() in (None, 0, 130):
            return ""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return (
            lines[-1].removeprefix("fmuid: ") if lines else f"the process ended with code {self._process.poll()}"
        )
