"""Progress of long work."""

from __future__ import annotations

from collections.abc import Callable

Say = Callable[[str, float], None]
"""Called with the current task and the share of the work that is done (0 to 1)."""


def quiet(_task: str, _done: float) -> None:
    """Tell nobody."""
