"""FMU resets that crash their process: after one worker has died, the others avoid that reset."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_NOTE = "resetting"
_own: Path | None = None  # the folder of this worker process, inside that of its pool


def keep_notes(folder: Path) -> None:
    """Let this worker process record in its folder which FMUs it resets for the first time."""
    global _own
    _own = folder


def deadly(token: str) -> bool:
    """Return whether the first reset of the FMU with this token has ended a worker of this pool."""
    return _own is not None and (_own.parent / _name(token)).exists()


@contextmanager
def first(*tokens: str) -> Iterator[None]:
    """Leave a note that remains if the first reset of one of these FMUs ends the process."""
    if _own is None:
        yield
        return
    note = _own / _NOTE
    note.write_text("\n".join(map(_name, tokens)))
    try:
        yield
    finally:
        note.unlink(missing_ok=True)


def ended(folder: Path) -> bool:
    """Return whether a dead worker ended in a first reset, and if so inform the other workers of its pool."""
    note = folder / _NOTE
    if not note.exists():
        return False
    for name in note.read_text().split():
        (folder.parent / name).touch()
    return True


def _name(token: str) -> str:
    return f"reset-{hashlib.sha256(token.encode()).hexdigest()[:16]}"
