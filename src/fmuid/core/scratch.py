"""Temporary folders; those left by killed processes are removed by the next process."""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

_YOUNG = 600.0  # s for which a new folder may not yet be locked


class Scratch:
    """A new folder, locked by this process until `remove` or exit; the kernel releases the lock after a kill.

    Parameters
    ----------
    prefix
        Prefix of its name. Folders with the same prefix are removed if their owner has ended.
    where
        Parent folder; the system's folder for temporary files by default.
    """

    def __init__(self, prefix: str, where: str | None = None) -> None:
        for folder in Path(where or tempfile.gettempdir()).glob(f"{prefix}*"):
            _remove_if_abandoned(folder)
        self.path = Path(tempfile.mkdtemp(prefix=prefix, dir=where))
        self._lock = _locked(self.path)

    def remove(self) -> None:
        """Remove the folder and its content."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def of_process() -> Path:
    """Return this process's folder for unpacked files."""
    return _of_process(os.getpid(), tempfile.gettempdir()).path


@functools.cache
def _of_process(process: int, where: str) -> Scratch:
    """Make the folder once per process and folder for temporary files."""
    scratch = Scratch("fmuid-unpacked-", where)
    atexit.register(lambda: scratch.remove() if os.getpid() == process else None)  # not in a fork
    return scratch


def _locked(folder: Path) -> int | None:
    """Return an open descriptor that holds the folder's lock; None if another has it, or that is unknown."""
    if sys.platform == "win32":
        return None
    import fcntl

    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            return None
        return descriptor
    return None


def _remove_if_abandoned(folder: Path) -> None:
    with suppress(OSError):
        if time.time() - folder.stat().st_mtime < _YOUNG:
            return
        lock = _locked(folder)
        if lock is not None:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(lock)
