"""Untrusted files, read in a separate process: a damaged file can hang or crash the library that reads it.

One process reads all files for its parent, and is replaced when it dies.
"""

from __future__ import annotations

import atexit
import math
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from fmuid.core.errors import MeasurementsError
from fmuid.core.exit_status import KILLED

_T = TypeVar("_T")
TIME_LIMIT = 60.0  # s of processor time, plus a second for every 5 MB
_WAITING = 30.0  # times that limit, on a busy machine
_BYTES_PER_SECOND = 5e6


class _Reader:
    """The process and the connection to it."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        # -P: the current folder may contain a module of any name.
        command = [
            sys.executable,
            "-P",
            "-c",
            "from fmuid.data.isolated_reader import serve; serve()",
            str(theirs.fileno()),
        ]
        self.process = subprocess.Popen(
            command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        theirs.close()
        self.connection = Connection(ours.detach())
        self.parent = os.getpid()

    def end(self) -> None:
        with suppress(OSError):
            self.connection.close()
        if self.parent == os.getpid():
            self.process.kill()
            self.process.wait()


_lock = threading.Lock()
_reader: _Reader | None = None


def read_isolated(read: Callable[[Path], _T], path: Path, *, limit: float | None = None) -> _T:
    """Return ``read(path)``, computed in another process; `read` must be a module-level function.

    Raises
    ------
    MeasurementsError
        Reading takes more than `limit` seconds of processor time (by default a minute, more for a large file), or
        crashes. Errors of `read` are raised again here.
    """
    global _reader
    size = path.stat().st_size if path.is_file() else 0
    limit = TIME_LIMIT + size / _BYTES_PER_SECOND if limit is None else limit
    with _lock:
        if _reader is None or _reader.parent != os.getpid() or _reader.process.poll() is not None:
            _reader = _Reader()
        try:
            _reader.connection.send((read, path, Path.cwd(), limit))
            if not _reader.connection.poll(_WAITING * limit if hasattr(signal, "SIGXCPU") else limit):
                _end()
                raise _too_slow(path, limit)
            fine, result = pickle.loads(_reader.connection.recv_bytes())
        except (EOFError, OSError):
            ended = _reader.process.wait()  # its end of the connection is closed, so it has exited
            _end()
            if ended == -getattr(signal, "SIGXCPU", 0):
                raise _too_slow(path, limit) from None
            if ended == KILLED:
                raise MeasurementsError(
                    "the process that reads it was killed (SIGKILL)", where=path, fix="free memory, then try again"
                ) from None
            raise MeasurementsError(
                "crashes the library that reads it", where=path, fix="write it again: it may be damaged"
            ) from None
        except BaseException:  # Ctrl-C: an unread answer must not be taken for the next one
            _end()
            raise
    if not fine:
        raise result
    content: _T = result
    return content


def _too_slow(path: Path, limit: float) -> MeasurementsError:
    return MeasurementsError(
        f"cannot be read in {limit:.0f} s", where=path, fix="write it again: it may be damaged"
    )


def _end() -> None:
    global _reader
    if _reader is not None:
        _reader.end()
        _reader = None


atexit.register(_end)


def serve() -> None:
    """Answer requests until the other end closes."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # the parent handles these
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    connection = Connection(int(sys.argv[1]))
    while True:
        try:
            read, path, folder, limit = connection.recv()
        except (EOFError, OSError):
            return
        try:
            os.chdir(folder)  # the path is relative to this folder
            _limit_processor_time(limit)
            answer: tuple[bool, Any] = (True, read(path))
        except Exception as error:
            # The cause of an error is not sent: libraries raise errors that no other process can rebuild.
            error.__cause__ = error.__context__ = None
            answer = (False, error)
        connection.send_bytes(pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL))


def _limit_processor_time(seconds: float) -> None:
    """Make the system end this process after this much further processor time."""
    with suppress(ImportError):  # Windows
        import resource

        usage = resource.getrusage(resource.RUSAGE_SELF)
        spent = usage.ru_utime + usage.ru_stime
        _, hard = resource.getrlimit(resource.RLIMIT_CPU)
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(spent + seconds), hard))
