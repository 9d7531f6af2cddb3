"""Ctrl-C, and the signals with which batch systems and closed terminals stop a program."""

from __future__ import annotations

import atexit
import math
import os
import select
import signal
import sys
import threading
import time
from contextlib import suppress
from types import FrameType
from typing import Any

INTERRUPTED = 130
_RUNNING = -1  # no exit code
_MOMENT = 0.01  # s
_ENDING = (signal.SIGINT, signal.SIGTERM)
_PATIENCE, _AT_ONCE = 5.0, 0.2  # s that a simulation in this process may take after a first and a second signal


class Interruption:
    """Turns the first signal into a `KeyboardInterrupt`, so that results are saved.

    A second Ctrl-C or SIGTERM ends the process at once: everything is on disk except a summary that can be made
    again. So does the first one in a simulation in this process that does not return within five seconds: a thread
    watches for signals, because Python handles them between its own instructions only. Signals that are ignored
    from the start (as with nohup) stay ignored. If an exception would leave locks of the import system held, or
    would be ignored as in finalizers, it is raised a moment later. An interrupted process ends without finalising
    Python, because half-loaded extension modules can crash then.
    """

    def __init__(self) -> None:
        self._stopping, self._code, self._heard = False, _RUNNING, threading.Event()
        atexit.register(self._leave)  # registered first, so called after everything else has been cleaned up
        if hasattr(signal, "setitimer"):  # Windows has none
            signal.signal(signal.SIGALRM, self._received)
            self._other_unraisable, sys.unraisablehook = sys.unraisablehook, self._unraisable
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._received)
        if os.name == "posix":
            received, sent = os.pipe()
            os.set_blocking(sent, False)
            signal.set_wakeup_fd(sent, warn_on_full_buffer=False)
            threading.Thread(target=self._watch, args=(received,), daemon=True).start()

    def end(self, code: int) -> None:
        """End the process at once with this code at any further Ctrl-C: nothing is left to save."""
        self._stopping, self._code = True, code
        self._heard.set()

    def _watch(self, received: int) -> None:
        """End the process if its main thread does not."""
        count, deadline = 0, math.inf
        while True:
            left = None if math.isinf(deadline) else max(deadline - time.monotonic(), 0.0)
            if not select.select([received], [], [], left)[0]:
                if not self._heard.is_set():
                    self._at_once(f"stopped in a simulation that did not return within {_PATIENCE:g} s")
                deadline = math.inf
            elif os.read(received, 1)[0] in _ENDING:
                count += 1
                deadline = time.monotonic() + _PATIENCE
                if count > 1:
                    time.sleep(_AT_ONCE)  # for the main thread, which may be about to end
                    self._at_once("stopped at once")

    def _leave(self) -> None:
        if self._code == INTERRUPTED:
            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError, ValueError):  # the reader is gone
                    stream.flush()
            os._exit(INTERRUPTED)
        if signal.getsignal(signal.SIGINT) == self._received:
            signal.signal(
                signal.SIGINT, signal.SIG_IGN
            )  # Python would have it end the process without its exit code

    def _received(self, number: int, frame: FrameType | None) -> None:
        if not self._stopping:
            importing = frame is not None and frame.f_code.co_filename.startswith("<frozen importlib")
            if importing and hasattr(signal, "setitimer"):
                signal.setitimer(signal.ITIMER_REAL, _MOMENT)
                return
            self._stopping = True
            self._heard.set()
            raise KeyboardInterrupt
        if number in _ENDING:
            self._at_once("stopped at once")

    def _at_once(self, message: str) -> None:
        if self._code not in (_RUNNING, INTERRUPTED):  # everything was done when the first one came
            os._exit(self._code)
        shown = "\x1b[?25h" if sys.stderr is not None and sys.stderr.isatty() else ""  # the cursor again
        os.write(2, f"{shown}\nfmuid: {message}\n".encode())
        os._exit(INTERRUPTED)

    def _unraisable(self, hook_arguments: Any) -> None:  # sys.UnraisableHookArgs, which exists in stubs alone
        if hook_arguments.exc_type is KeyboardInterrupt:
            self._stopping = False
            signal.setitimer(signal.ITIMER_REAL, _MOMENT)
        else:
            self._other_unraisable(hook_arguments)
