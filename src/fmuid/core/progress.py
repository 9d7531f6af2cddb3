"""Progress of long work."""

from __future__ import annotations

import re
from collections.abc import Callable

Say = Callable[[str, float], None]
"""Called with the current task and the share of the work that is done (0 to 1)."""

PROGRESS_VARIABLE, AS_LINES = "FMUID_PROGRESS", "lines"
"""With this environment variable, commands write their progress to standard error as lines for a program."""

_LINE = re.compile(r"progress (\d\.\d{4}) (.*)")


def quiet(_task: str, _done: float) -> None:
    """Tell nobody."""


def progress_line(done: float, task: str) -> str:
    """Return progress as a line; see `read_progress`."""
    return f"progress {min(max(done, 0.0), 1.0):.4f} {task}"


def read_progress(line: str) -> tuple[float, str] | None:
    """Return the share of the work that is done and the task in a line, or None if it is another line."""
    match = _LINE.fullmatch(line.strip())
    return None if match is None else (float(match[1]), match[2])
