"""Start method of worker processes: a fork server, whose socket needs a short path, or spawn."""

from __future__ import annotations

import functools
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import util
from pathlib import Path

from fmuid.core.scratch import Scratch

_LONGEST = 103 if sys.platform == "darwin" else 107  # bytes in the path of a socket
_PREFIX = "fmuid-sockets-"
_BELOW = len(f"/{_PREFIX}12345678/pymp-12345678/listener-12345678")  # the last two are multiprocessing's


@functools.cache
def start_method() -> str:
    """Return "forkserver", or "spawn" where there is no fork server or no folder for its socket.

    `multiprocessing` puts its socket into the folder for temporary files. Here it uses a folder that is removed
    even if this process is killed, in another place if the path would be too long.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return "spawn"
    for parent in _folders():
        if len(os.fsencode(parent)) + _BELOW <= _LONGEST:
            with suppress(OSError):
                return "forkserver" if _sockets_below(parent) else "spawn"
    return "spawn"


def _folders() -> Iterator[str]:
    """Yield possible folders for temporary files, the user's choice first."""
    yield tempfile.gettempdir()
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        yield runtime
    yield from ("/tmp", "/var/tmp", "/dev/shm")


def _sockets_below(parent: str) -> bool:
    """Make `multiprocessing` put its sockets below `parent`; False if it already has a folder that is too long."""
    scratch = Scratch(_PREFIX, parent)
    usual = tempfile.tempdir
    tempfile.tempdir = str(scratch.path)
    try:
        folder = util.get_temp_dir()
    finally:
        tempfile.tempdir = usual
    if Path(folder).parent == scratch.path:
        util.Finalize(None, scratch.remove, exitpriority=-101)  # after its contents
    else:
        scratch.remove()
    return len(os.fsencode(folder)) + len("/listener-12345678") <= _LONGEST
