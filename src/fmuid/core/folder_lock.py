"""One writer at a time in a folder of results."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from fmuid.core.errors import FmuidError
from fmuid.core.files import make_folder, remove_unfinished

NAME = ".lock"
_claimed: ContextVar[frozenset[Path]] = ContextVar("_claimed", default=frozenset())


class LockedError(FmuidError):
    """Another process is writing to the folder."""


@contextmanager
def claim(folder: Path) -> Iterator[None]:
    """Lock `folder` for writing while the context is active; nested calls may lock it again.

    The folder is made if it is missing, and removed again if nothing is written to it. Partly written files that a
    killed process left there are removed. The kernel holds the lock and releases it when the process ends for any
    reason.

    Raises
    ------
    LockedError
        Another process or thread holds the lock; the message says which.
    FmuidError
        The folder cannot be made or written to.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder)
    place = folder.resolve()
    claimed = _claimed.get()
    if place in claimed or sys.platform == "win32":
        yield
        return
    descriptor = _locked(folder)
    token = _claimed.set(claimed | {place})
    try:
        remove_unfinished(folder, but_below=NAME)
        yield
    finally:
        _claimed.reset(token)
        with suppress(OSError):
            (folder / NAME).unlink()
        os.close(descriptor)
        with suppress(OSError):
            for path in missing:
                path.rmdir()


def _locked(folder: Path) -> int:
    """Return a descriptor that holds the lock."""
    import fcntl

    path = folder / NAME
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            what = f"cannot be written ({error.strerror})"
            raise FmuidError(what, where=folder, fix="choose a folder that can be written") from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(descriptor), path.stat()):
                break
        except BlockingIOError:
            holder = os.pread(descriptor, 500, 0).decode(errors="replace").strip()
            os.close(descriptor)
            what = f"{holder or 'another process'} is writing to this folder"
            raise LockedError(what, where=folder, fix="wait until it ends, or choose another folder") from None
        except FileNotFoundError:
            pass  # its holder has just removed it
        except OSError:  # a file system without locks
            break
        os.close(descriptor)
    with suppress(OSError):  # on a full disk the holder is not recorded
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, _holder().encode(), 0)
    return descriptor


def _holder() -> str:
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:2]])
    return f"'{command}' (process {os.getpid()} on {platform.node()}, since {time.strftime('%Y-%m-%d %H:%M:%S')})"
