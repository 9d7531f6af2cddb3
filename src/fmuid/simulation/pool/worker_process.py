"""Code that runs inside a worker process of `fmuid.simulation.pool.workers.WorkerPool`."""

from __future__ import annotations

import mmap
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from fmuid.core.errors import FmuidError
from fmuid.simulation import resets
from fmuid.simulation.fmu_library import ProcessSpentError
from fmuid.simulation.pool.channel import Channel
from fmuid.simulation.pool.parcels import unpacked
from fmuid.simulation.runners import simulate

_WEIGH_INTERVAL = 0.02  # s between checks of the memory
_TOGETHER = 0.004  # s for which answers are collected, if there is more to do
HOLD, JOB, CALL = range(3)
"""Kinds of message: keep an object under a number, simulate with kept objects, call a function."""


def resident_memory(pid: int) -> int:
    """Return the resident memory of a process in bytes, 0 where that is unknown."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_bytes().split()[1])
    except (OSError, IndexError):  # not Linux, or the process has ended
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def main(connection: Channel, folder: str) -> None:
    """Answer messages until the other end closes; temporary files go to `folder`."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # the parent handles these
        with suppress(AttributeError, ValueError):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # FMUs may crash a thousand times
    tempfile.tempdir = folder
    resets.keep_notes(Path(folder))
    threading.Thread(target=_leave_with_parent, args=(folder,), daemon=True).start()
    with suppress(EOFError, OSError):  # the pool has dismissed this worker, or has ended
        _serve(connection, Path(folder))
    if sys.stdout is not None:  # it may be closed
        sys.stdout.flush()
    parent = multiprocessing.parent_process()
    if parent is None or not parent.is_alive():  # otherwise the parent cleans up
        _clear(folder)
    os._exit(0)  # exit handlers of FMUs have crashed more than one process


def _serve(connection: Channel, folder: Path) -> None:
    kept: dict[int, Any] = {}
    answers: list[tuple[bool, Any]] = []  # not sent yet
    memory, weighed = resident_memory(os.getpid()), time.monotonic()
    sent = weighed
    begun = Begun(folder, new=True)
    _send(connection, [(True, None)], memory)
    while True:
        # Answers of short evaluations are sent together, because every message interrupts the other end.
        if answers and (time.monotonic() - sent > _TOGETHER or not connection.waits()):
            _send(connection, answers, memory)
            answers, sent = [], time.monotonic()
        message, _ = connection.receive()
        begun.add()
        try:
            kind, *content = pickle.loads(message)
            if kind == HOLD:
                number, held = content
                kept[number] = unpacked(held, kept)
                begun.add(-1)
                continue
            if kind == JOB:
                simulator, task, parameters = content
                result: Any = simulate((kept[simulator], kept[task], parameters))
                if isinstance(result, ProcessSpentError):
                    if answers:
                        _send(connection, answers, memory)
                    os._exit(1)  # the pool tries again in a new worker
            else:
                function, arguments, keywords = content
                result = function(*arguments, **keywords)
            fine = True
        except BaseException as error:
            fine, result = False, error
        answers.append((fine, result))
        if time.monotonic() - weighed > _WEIGH_INTERVAL:
            memory, weighed = resident_memory(os.getpid()), time.monotonic()


class Begun:
    """Number of evaluations that a worker process has begun, which outlives it."""

    def __init__(self, folder: Path, *, new: bool = False) -> None:
        file = folder / "begun"
        if new:
            file.write_bytes(bytes(8))
        with file.open("r+b") as opened:
            self._memory = mmap.mmap(opened.fileno(), 8)
        self._count = int.from_bytes(self._memory[:8], "little")

    @property
    def count(self) -> int:
        """The number."""
        return self._count

    def add(self, more: int = 1) -> None:
        """Note another one."""
        self._count += more
        self._memory[:8] = self._count.to_bytes(8, "little")


def _send(connection: Channel, answers: Sequence[tuple[bool, Any]], memory: int) -> None:
    buffers: list[pickle.PickleBuffer] = []
    sure = [(True, content) if fine else _sendable(fine, content) for fine, content in answers]
    try:
        message = pickle.dumps((sure, memory), pickle.HIGHEST_PROTOCOL, buffer_callback=buffers.append)
    except Exception:
        message, buffers = pickle.dumps(([_sendable(*a) for a in sure], memory), pickle.HIGHEST_PROTOCOL), []
    connection.send(message, buffers)


def _sendable(fine: bool, content: Any) -> tuple[bool, Any]:
    """Return an answer, or the error that it cannot be sent: some exceptions can be packed but not unpacked."""
    try:
        pickle.loads(pickle.dumps(content))
    except Exception:
        what = f"a worker's answer cannot be sent: {content!r:.200}"
        return False, FmuidError(what, fix="return values that can be pickled")
    return fine, content


def _leave_with_parent(folder: str) -> None:
    """End this process when its parent has ended, even in an endless loop of an FMU."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        _clear(folder)
        os._exit(1)


def _clear(folder: str) -> None:
    """Remove this worker's folder, and the pool's folder with the last of them."""
    shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):
        Path(folder).parent.rmdir()
