"""Ctrl-C, and the signals by which batch systems and closed terminals stop a program."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130


class Interruption:
    """Turns the first signal into a `KeyboardInterrupt`, so that what was reached is saved.

    A second Ctrl-C ends the process at once: everything is on disk, but for a summary that can be made again.
    A signal that whoever started the process has it ignore (as nohup does) stays ignored.
    """

    def __init__(self) -> None:
        self._stopping = False
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._received)

    def end(self) -> None:
        """Have every further Ctrl-C end the process at once: there is nothing left to save."""
        self._stopping = True

    def _received(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - as signals are told
        if not self._stopping:
            self._stopping = True
            raise KeyboardInterrupt
        if number == signal.SIGINT:
            shown = b"\x1b[?25h" if sys.stderr is not None and sys.stderr.isatty() else b""  # the cursor again
            os.write(2, shown + b"\nfmuid: stopped at once\n")
            os._exit(INTERRUPTED)
