"""Resets that end their process: what one worker died of, the others of its pool know."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_NOTE = "resetting"
_own: Path | None = None  # the folder of this worker process, in that of its pool


def keep_notes(folder: Path) -> None:
    """Have this worker process note in its folder which FMUs it resets for the first time."""
    global _own
    _own = folder


def deadly(token: str) -> bool:
    """Return whether the first reset of the FMU with this token has ended a worker of this pool."""
    return _own is not None and (_own.parent / _name(token)).exists()


@contextmanager
def first(*tokens: str) -> Iterator[None]:
    """Leave a note behind should the first resets of these FMUs end the process."""
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
    """Return whether a worker that is gone ended in a first reset; the other workers of its pool then know."""
    note = folder / _NOTE
    if not note.exists():
        return False
    for name in note.read_text().split():
        (folder.parent / name).touch()
    return True


def _name(token: str) -> str:
    return f"reset-{hashlib.sha256(token.encode()).hexdigest()[:16]}"
