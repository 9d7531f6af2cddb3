"""How a process ended, in words."""

from __future__ import annotations

import signal
from contextlib import suppress

KILLED = -getattr(signal, "SIGKILL", 9)
"""Exit status of a process that was killed: by a user, or by a system that ran out of memory; never by itself."""


def in_words(status: int | None) -> str:
    """Return the name of the signal that ended a process, or its exit code."""
    if status is not None and status < 0:
        with suppress(ValueError):
            return signal.Signals(-status).name
    return f"exit code {status}"
