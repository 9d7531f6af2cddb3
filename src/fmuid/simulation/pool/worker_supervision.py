"""Supervision of worker processes: sends them evaluations and replaces those that die; used by `workers`."""

from __future__ import annotations

import atexit
import math
import multiprocessing
import os
import pickle
import shutil
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Hashable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import connection as mp_connection
from pathlib import Path
from typing import Any

from fmuid.core import exit_status
from fmuid.core.errors import FmuidError, SimulationError
from fmuid.core.exit_status import KILLED
from fmuid.core.scratch import Scratch
from fmuid.simulation import resets
from fmuid.simulation.fmu_variables import in_words
from fmuid.simulation.pool import worker_process
from fmuid.simulation.pool.channel import Channel, channels
from fmuid.simulation.pool.start_method import start_method
from fmuid.simulation.pool.worker_process import Begun, resident_memory

_START_LIMIT = 60.0  # s for a worker to start
_MEMORY_INTERVAL = 0.1  # s between checks of the memory of busy workers
_AHEAD = (2, 64)  # evaluations queued at a worker, so that it never waits for the next: at least, at most
_AHEAD_FOR = 8e-3  # s that these take, as far as the worker's pace is known
_TICK = 1e-6  # s, where the clock is too coarse to see an evaluation
_SMALL = 16_384  # bytes that can be sent to a busy worker without waiting for it
_MAX_FAILED_STARTS = 3


_START_HINT = {
    "where": "worker pool",
    "fix": 'save the script in a file, with its work under `if __name__ == "__main__":`',
}
_LACKING_HINT = {"where": "worker pool", "fix": "free open files, processes or memory, or use fewer workers"}


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def leave_if_starting() -> None:
    """End this process if it is a starting worker, which imports the main script but must not run its work.

    Its script lacks ``if __name__ == "__main__":``, and the process that started the worker reports that.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        os._exit(1)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Make new processes do linear algebra in one thread, because the workers already share the processors."""
    ours = [name for name in _THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(ours, "1"))
    try:
        yield
    finally:
        for name in ours:
            os.environ.pop(name, None)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a worker: s and bytes for one evaluation, evaluations and bytes of growth before replacement."""

    time: float | None
    memory: int
    evaluations: int | None
    growth: int


@dataclass(eq=False, slots=True)
class Call:
    """One evaluation: its message, the objects that the worker needs first, its future, and its `affinity`.

    Calls of one affinity go to one worker, unless another one is idle.
    """

    message: bytes
    holds: tuple[int, ...]
    future: Future[Any]
    name: str
    parameters: Mapping[str, float]
    affinity: Hashable = None
    retried: bool = False


@dataclass(eq=False, slots=True)
class Worker:
    """A process and its current work."""

    process: Any
    connection: Channel
    folder: Path
    started: float = field(default_factory=time.monotonic)
    ready: bool = False
    begun: float = 0.0  # start time of the evaluation at the head
    pace: float = math.inf  # s that an evaluation has lately taken
    calls: deque[Call] = field(default_factory=deque)
    held: set[int] = field(default_factory=set)
    done: int = 0
    first_memory: int = 0
    retiring: bool = False
    killed: str | None = None  # the reason, if the pool killed it


class Supervisor:
    """A group of workers, their queue and the thread that serves them.

    `messages` maps numbers to the messages that make a worker keep an object; the caller adds one before it
    enqueues a call that needs the object.
    """

    def __init__(self, size: int, limits: Limits) -> None:
        self._size, self._limits = size, limits
        self._context: Any = multiprocessing.get_context(start_method())
        if start_method() == "forkserver":  # imported once, not by every worker
            self._context.set_forkserver_preload(
                ["__main__", "fmuid.simulation.fmu", "fmuid.simulation.pool.worker_process"]
            )
        self._scratch = Scratch("fmuid-workers-")
        self.messages: dict[int, bytes] = {}
        self._lock = threading.Lock()
        self._pending: deque[Call] = deque()
        self._team: list[Worker] = []
        self._homes: dict[Hashable, Worker] = {}  # by affinity
        self._failed_starts = 0
        self._weighed = 0.0  # time of the last check of the workers' memory
        self._closing = self._abandoning = False
        self._wake_reader, self._wake_writer = self._context.Pipe(duplex=False)
        self._thread: threading.Thread | None = None

    # ---- in the callers' threads ------------------------------------------------------------------------

    def enqueue(self, calls: list[Call]) -> None:
        """Queue `calls` for evaluation, in their order as far as possible."""
        with self._lock:
            if self._closing:
                raise FmuidError("it has been shut down", where="worker pool", fix="open a new one")
            self._pending.extend(calls)
            if self._thread is None:
                self._thread = threading.Thread(target=self._supervise, name="fmuid workers", daemon=True)
                self._thread.start()
                atexit.register(self.shutdown, wait=True, abandon=True)  # no thread outlives the interpreter
        self._wake()

    def shutdown(self, wait: bool, abandon: bool) -> None:
        """Stop the workers when all calls are done, or at once."""
        with self._lock:
            self._closing = True
            self._abandoning |= abandon
            thread = self._thread
        if thread is None:
            self._scratch.remove()
            return
        self._wake()
        if wait and thread is not threading.current_thread():
            thread.join()

    def _wake(self) -> None:
        with suppress(OSError):
            self._wake_writer.send_bytes(b"")

    # ---- in the supervising thread ----------------------------------------------------------------------

    def _supervise(self) -> None:
        try:
            while self._turn():
                pass
        except FmuidError as error:
            self._fail_all(error)
        except BaseException as error:  # no caller may be left waiting
            self._fail_all(FmuidError(f"its supervision failed ({error!r})", where="worker pool"))
        finally:
            with self._lock:
                self._closing = True
            self._fail_all(FmuidError("it has been shut down", where="worker pool"), cancel=True)
            for worker in list(self._team):
                self._dismiss(worker)
            self._scratch.remove()
            atexit.unregister(self.shutdown)

    def _turn(self) -> bool:
        """Hand out work, wait for an event and handle it; False when everything is finished."""
        if self._abandoning:
            return False
        self._hand_out()  # drops cancelled calls, which may be the last ones
        with self._lock:
            over = self._closing and not self._pending
        if over and not any(w.calls for w in self._team):
            return False
        sources = [self._wake_reader.fileno(), *(w.connection.fileno() for w in self._team)]
        for source in mp_connection.wait(sources, self._patience()):
            if source == self._wake_reader.fileno():
                self._wake_reader.recv_bytes()
                continue
            worker = next((w for w in self._team if w.connection.fileno() == source), None)
            if worker is not None:
                self._receive(worker)
        self._enforce_limits()
        return True

    def _hand_out(self) -> None:
        with self._lock:
            waiting = len(self._pending)
            fresh = bool(self._pending) and self._pending[0].retried
        if fresh and not any(w.done == 0 and not w.calls for w in self._team):
            idle = next((w for w in self._team if w.ready and not w.calls), None)
            if idle is not None:  # replaced by the new worker that is needed
                self._dismiss(idle)
        busy = sum(bool(w.calls) for w in self._team)
        while len(self._team) < min(self._size, busy + waiting):
            self._recruit()
        able = [w for w in self._team if w.ready and not w.retiring]
        given: dict[int, list[bytes]] = {}
        for depth in range(_AHEAD[1]):  # every worker gets a first call before any gets a second
            deeper = [w for w in able if len(w.calls) == depth < self._ahead(w)]
            for worker in deeper:
                call = self._next(worker, depth)
                if call is not None:
                    given.setdefault(id(worker), []).extend(self._taken(worker, call))
            if not deeper:
                break
        for worker in able:
            if id(worker) in given:
                with suppress(OSError):  # it is dead, as its connection will show in a moment
                    worker.connection.send_all(given[id(worker)])

    def _ahead(self, worker: Worker) -> float:
        """Return how many calls may wait at a worker."""
        most = math.inf if self._limits.evaluations is None else self._limits.evaluations - worker.done
        return min(max(_AHEAD[0], _AHEAD_FOR / worker.pace), max(most, 1))

    def _next(self, worker: Worker, depth: int) -> Call | None:
        with self._lock:
            while (place := self._choice(worker, depth)) is not None:
                call = self._pending[place]
                # A busy worker does not read, so only messages that fit into the pipe together may be sent to it.
                if depth * len(call.message) > _SMALL or (depth and not worker.held.issuperset(call.holds)):
                    return None
                del self._pending[place]
                if call.future.running() or call.future.set_running_or_notify_cancel():
                    if call.affinity is not None:
                        self._homes[call.affinity] = worker
                    return call
        return None

    def _choice(self, worker: Worker, depth: int) -> int | None:
        """Return the place of the pending call that a worker should have next; for an idle one, the last."""
        if not self._pending or (self._pending[0].retried and (worker.done or depth)):  # that needs a new worker
            return None
        for place, call in enumerate(self._pending):
            home = self._homes.get(call.affinity)
            if (home is worker or home not in self._team) and not (call.retried and place):
                return place
        return None if depth else len(self._pending) - 1

    def _taken(self, worker: Worker, call: Call) -> list[bytes]:
        """Give a worker a call; return the messages that it needs."""
        if not worker.calls:
            worker.begun = time.monotonic()
        worker.calls.append(call)
        new = [number for number in call.holds if number not in worker.held]
        worker.held.update(new)
        return [*(self.messages[number] for number in new), call.message]

    def _receive(self, worker: Worker) -> None:
        try:
            message, buffers = worker.connection.receive()
        except (EOFError, OSError):
            self._bury(worker)
            return
        answers, memory = pickle.loads(message, buffers=buffers)
        if not worker.ready:
            worker.ready, self._failed_starts = True, 0
            return
        now = time.monotonic()
        worker.pace = max(now - worker.begun, _TICK) / len(answers)
        worker.begun = now
        worker.first_memory = worker.first_memory or memory
        for fine, content in answers:
            call = worker.calls.popleft()
            worker.done += 1
            if fine:
                call.future.set_result(content)
            else:
                call.future.set_exception(content)
        grown = memory - worker.first_memory > self._limits.growth
        if grown or (self._limits.evaluations is not None and worker.done >= self._limits.evaluations):
            worker.retiring = True
            self._take_back(worker)
        if worker.retiring and not worker.calls:
            self._dismiss(worker)

    def _take_back(self, worker: Worker) -> None:
        """Replace `worker`; the evaluations that it has not begun return to the head of the queue."""
        with self._lock:
            self._pending.extendleft(reversed(worker.calls))
        worker.calls.clear()

    def _bury(self, worker: Worker) -> None:
        """Handle the calls of a dead worker: its evaluation fails or is repeated, the others go elsewhere."""
        worker.process.join(5.0)
        code = worker.process.exitcode
        if not worker.ready:
            self._failed_starts += 1
        finished = self._unanswered(worker)
        head = worker.calls[finished] if worker.calls else None
        if head is not None:
            del worker.calls[finished]
        self._take_back(worker)
        in_reset = resets.ended(worker.folder)
        self._dismiss(worker)
        if head is None:
            if self._failed_starts >= _MAX_FAILED_STARTS:
                if code is not None and code < 0:
                    raise FmuidError(f"starting workers end ({exit_status.in_words(code)})", **_LACKING_HINT)
                raise FmuidError("worker processes do not start", **_START_HINT)
            return
        by_others = code == KILLED and worker.killed is None
        if (worker.done or finished or in_reset or by_others) and not head.retried and worker.killed != "time":
            head.retried = True
            with self._lock:
                self._pending.appendleft(head)
            return
        head.future.set_exception(self._verdict(worker, head, code))

    def _unanswered(self, worker: Worker) -> int:
        """Return how many calls of a dead worker were done, though their answers were not sent."""
        if not worker.calls:
            return 0
        with suppress(OSError, ValueError):
            return min(max(Begun(worker.folder).count - 1 - worker.done, 0), len(worker.calls) - 1)
        return 0

    def _verdict(self, worker: Worker, call: Call, code: int | None) -> SimulationError:
        if worker.killed == "time":
            what = f"took longer than the time limit of {self._limits.time:g} s"
        elif worker.killed == "memory":
            what = f"took more memory than the limit of {self._limits.memory / 2**20:.0f} MB"
        else:
            what = f"{'was killed' if code == KILLED else 'crashed'} ({exit_status.in_words(code)})"
        given = in_words(call.parameters)
        return SimulationError(what + (f" (with {given})" if given else ""), where=call.name)

    def _patience(self) -> float | None:
        """Return the seconds until a worker has to be checked, None if there is none to check."""
        now = time.monotonic()
        waits: list[float] = []
        for w in self._team:
            if not w.ready:
                waits.append(w.started + _START_LIMIT - now)
            elif w.calls:
                if self._limits.time is not None:
                    waits.append(w.begun + self._limits.time - now)
                if self._limits.memory and sys.platform == "linux":
                    waits.append(_MEMORY_INTERVAL)
        return max(0.0, min(waits)) if waits else None

    def _enforce_limits(self) -> None:
        now = time.monotonic()
        weigh = bool(self._limits.memory) and now - self._weighed >= _MEMORY_INTERVAL
        if weigh:
            self._weighed = now
        for worker in list(self._team):
            late = now - worker.begun > self._limits.time if self._limits.time is not None else False
            if not worker.ready:
                if now - worker.started > _START_LIMIT:
                    worker.process.kill()
            elif worker.killed is None and worker.calls:
                if late:
                    worker.killed = "time"
                elif weigh and resident_memory(worker.process.pid) > self._limits.memory:
                    worker.killed = "memory"
                if worker.killed is not None:
                    worker.process.kill()

    def _recruit(self) -> None:
        ours, theirs = channels()
        folder = Path(tempfile.mkdtemp(dir=self._scratch.path))
        process = self._context.Process(
            target=worker_process.main, args=(theirs, str(folder)), name="fmuid worker", daemon=True
        )
        try:
            with _one_thread_each():
                try:
                    process.start()
                except (
                    EOFError,
                    ConnectionError,
                ):  # the process that forks workers was killed: there is a new one
                    process.start()
        except (OSError, EOFError, RuntimeError) as error:
            ours.close()
            lacking = isinstance(error, OSError) and not isinstance(error, ConnectionError)
            hint = _LACKING_HINT if lacking else _START_HINT
            reason = "" if isinstance(error, EOFError | ConnectionError) else f" ({error})"  # it has exited
            raise FmuidError(f"worker processes do not start{reason}", **hint) from None
        finally:
            theirs.close()
        self._team.append(Worker(process, ours, folder))

    def _dismiss(self, worker: Worker) -> None:
        """End a worker: gracefully if it is idle, otherwise at once."""
        if worker in self._team:
            self._team.remove(worker)
        if worker.calls or not worker.ready:
            worker.process.kill()
        worker.connection.close()  # it exits when it sees this
        worker.process.join(1.0)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        worker.process.close()
        shutil.rmtree(worker.folder, ignore_errors=True)

    def _fail_all(self, error: FmuidError, cancel: bool = False) -> None:
        with self._lock:
            calls = [*self._pending, *(c for w in self._team for c in w.calls)]
            self._pending.clear()
        for call in calls:
            if call.future.running() or (not cancel and call.future.set_running_or_notify_cancel()):
                call.future.set_exception(error)
            else:
                call.future.cancel()
