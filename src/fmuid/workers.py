"""Worker processes that are watched over, so that no FMU can stop a search.

Use a pool as the runner of a problem (``runner=pool.run``), or as any `concurrent.futures.Executor`::

    with WorkerPool(2, time_limit=30.0) as pool:
        outcomes = pool.run([(fmu, task, {"c": 100.0}), (fmu, task, {"c": 200.0})])

Each worker extracts and instantiates an FMU once and receives a task's data once. An evaluation that crashes
its worker, exceeds the time limit or the memory limit becomes a `SimulationError`; the worker is replaced.
"""

from __future__ import annotations

import copyreg
import io
import itertools
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import connection as mp_connection
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, ParamSpec, TypeVar

from fmuid import worker_process
from fmuid.campaign import frozen_mapping
from fmuid.errors import FmuidError, SimulationError
from fmuid.runners import Job, Outcome, simulate
from fmuid.worker_process import resident_memory

P = ParamSpec("P")
T = TypeVar("T")

_START_LIMIT = 60.0  # s for a worker to come up
_MEMORY_INTERVAL = 0.1  # s between looks at the memory of busy workers
_AHEAD = 2  # evaluations a worker has at hand, so that it never waits for the next
_SMALL = 16_384  # bytes that can be sent to a busy worker without waiting for it
_MAX_FAILED_STARTS = 3


@dataclass(eq=False, slots=True)
class _Call:
    """One evaluation: its message, what has to be held by the worker first, and its future."""

    message: bytes
    holds: tuple[int, ...]
    future: Future[Any]
    label: str
    retried: bool = False


@dataclass(eq=False, slots=True)
class _Worker:
    process: Any
    connection: mp_connection.Connection
    folder: Path
    started: float = field(default_factory=time.monotonic)
    ready: bool = False
    begun: float = 0.0  # when the evaluation at the head was taken up
    calls: deque[_Call] = field(default_factory=deque)
    held: set[int] = field(default_factory=set)
    done: int = 0
    first_memory: int = 0
    retiring: bool = False
    killed: str | None = None  # why, if the pool did it


class WorkerPool(Executor):
    """A pool of supervised worker processes.

    Parameters
    ----------
    workers
        Number of processes; None takes the number of processors this process may use.
    time_limit
        Seconds one evaluation may take; None for no limit.
    memory_limit
        Resident bytes a worker may reach; None takes half of the machine's memory shared by the workers. Only
        Linux tells; elsewhere there is no limit.
    recycle_after
        Evaluations after which a worker is replaced; None for never.
    recycle_growth
        Bytes a worker may grow after its first evaluation before it is replaced between two evaluations, for
        FMUs that leak.

    Notes
    -----
    An evaluation that crashes a worker which had done others before is tried again in a fresh one: whether
    it fails then depends on its parameters alone, and results are the same for any number of workers. What
    exceeds the time limit is not tried again.

    Workers start by ``forkserver`` where there is one, else by ``spawn``: a script must start its work under
    ``if __name__ == "__main__":``.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        time_limit: float | None = 300.0,
        memory_limit: int | None = None,
        recycle_after: int | None = None,
        recycle_growth: int = 256 * 2**20,
    ) -> None:
        self.workers = workers if workers is not None else available_processors()
        if self.workers < 1:
            raise FmuidError(f"{workers} workers", where="worker pool", fix="ask for one or more")
        self.time_limit = time_limit
        self.memory_limit = memory_limit if memory_limit is not None else _memory_share(self.workers)
        self._recycle_after, self._recycle_growth = recycle_after, recycle_growth
        methods = multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:  # imported once, not by every worker
            self._context.set_forkserver_preload(["__main__", "fmuid.fmu", "fmuid.worker_process"])
        self._folder = Path(tempfile.mkdtemp(prefix="fmuid-workers-"))
        self._lock = threading.Lock()
        self._pending: deque[_Call] = deque()
        self._objects: dict[int, tuple[int, Any]] = {}  # id -> number, object (keeps the id its own)
        self._messages: dict[int, bytes] = {}  # number -> what makes a worker hold the object
        self._numbers = itertools.count()
        self._team: list[_Worker] = []
        self._failed_starts = 0
        self._weighed = 0.0  # when the memory of the workers was looked at
        self._closing = self._abandoning = False
        self._wake_reader, self._wake_writer = self._context.Pipe(duplex=False)
        self._thread: threading.Thread | None = None

    def run(self, jobs: Sequence[Job]) -> list[Outcome]:
        """Simulate `jobs` in the workers; outcomes in the jobs' order, a failed one as its `SimulationError`.

        Raises
        ------
        FmuidError
            A job is wrong whatever its parameters' values (an unknown name), or workers cannot be started.
        """
        futures = self._enqueue([self._job(job) for job in jobs])
        try:
            return [_outcome(future) for future in futures]
        except BaseException:
            for future in futures:
                future.cancel()
            raise

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call ``fn(*args, **kwargs)`` in a worker; see `concurrent.futures.Executor.submit`.

        The future raises `SimulationError` if the call crashes the worker or exceeds a limit.
        """
        if fn is simulate and len(args) == 1 and not kwargs:
            call = self._job(args[0])  # type: ignore[arg-type]
        else:
            message = _dumps((worker_process.CALL, fn, args, kwargs))
            call = _Call(message, (), Future(), getattr(fn, "__name__", "call"))
        return self._enqueue([call])[0]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; see `concurrent.futures.Executor.shutdown`.

        With `cancel_futures` evaluations that have begun are abandoned too.
        """
        with self._lock:
            self._closing = True
            self._abandoning |= cancel_futures
            thread = self._thread
        if thread is None:
            shutil.rmtree(self._folder, ignore_errors=True)
            return
        self._wake()
        if wait and thread is not threading.current_thread():
            thread.join()

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.shutdown(cancel_futures=exc_type is not None)

    # ---- in the caller's thread -------------------------------------------------------------------------

    def _job(self, job: Job) -> _Call:
        simulator, task, parameters = job
        numbers = self._hold(simulator), self._hold(task)
        message = _dumps((worker_process.JOB, *numbers, dict(parameters)))
        given = ", ".join(f"{k} = {v:.9g}" for k, v in parameters.items())
        name = getattr(getattr(simulator, "path", None), "name", type(simulator).__name__)
        return _Call(message, numbers, Future(), f"{name}|{given}")

    def _hold(self, thing: Any) -> int:
        """Give `thing` a number; workers receive it once."""
        with self._lock:
            if id(thing) in self._objects:
                return self._objects[id(thing)][0]
        content = _dumps(thing)
        with self._lock:
            number = next(self._numbers)
            self._messages[number] = _dumps((worker_process.HOLD, number, content))
            self._objects[id(thing)] = number, thing
        return number

    def _enqueue(self, calls: list[_Call]) -> list[Future[Any]]:
        with self._lock:
            if self._closing:
                raise FmuidError("it has been shut down", where="worker pool", fix="open a new one")
            self._pending.extend(calls)
            if self._thread is None:
                self._thread = threading.Thread(target=self._supervise, name="fmuid workers", daemon=True)
                self._thread.start()
        self._wake()
        return [call.future for call in calls]

    def _wake(self) -> None:
        with suppress(OSError):
            self._wake_writer.send_bytes(b"")

    # ---- in the supervising thread ----------------------------------------------------------------------

    def _supervise(self) -> None:
        try:
            while self._turn():
                pass
        except BaseException as error:  # never leave anyone waiting
            self._fail_all(FmuidError(f"its supervision failed ({error!r})", where="worker pool"))
        finally:
            with self._lock:
                self._closing = True
            self._fail_all(FmuidError("it has been shut down", where="worker pool"))
            for worker in list(self._team):
                self._dismiss(worker)
            shutil.rmtree(self._folder, ignore_errors=True)

    def _turn(self) -> bool:
        """Hand out work, wait for something to happen, and deal with it; False when all is over."""
        with self._lock:
            abandoning, over = self._abandoning, self._closing and not self._pending
        if abandoning or (over and not any(w.calls for w in self._team)):
            return False
        self._hand_out()
        sources = [self._wake_reader, *(w.connection for w in self._team)]
        for source in mp_connection.wait(sources, self._patience()):
            if source is self._wake_reader:
                self._wake_reader.recv_bytes()
                continue
            worker = next((w for w in self._team if w.connection is source), None)
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
            if idle is not None:  # it makes room for the fresh worker that is wanted
                self._dismiss(idle)
        busy = sum(bool(w.calls) for w in self._team)
        while len(self._team) < min(self.workers, busy + waiting):
            if not self._recruit():
                return
        for depth in range(_AHEAD):  # everyone gets a first before anyone gets a second
            for worker in list(self._team):
                if worker.ready and not worker.retiring and len(worker.calls) == depth:
                    call = self._next(worker, depth)
                    if call is not None:
                        self._give(worker, call)

    def _next(self, worker: _Worker, depth: int) -> _Call | None:
        with self._lock:
            while self._pending:
                call = self._pending[0]
                if call.retried and (worker.done or depth):  # wants a fresh worker
                    return None
                # A busy worker does not read: only what fits into the pipe may be sent to it.
                if depth and (len(call.message) > _SMALL or not worker.held.issuperset(call.holds)):
                    return None
                self._pending.popleft()
                if call.future.running() or call.future.set_running_or_notify_cancel():
                    return call
        return None

    def _give(self, worker: _Worker, call: _Call) -> None:
        if not worker.calls:
            worker.begun = time.monotonic()
        worker.calls.append(call)
        try:
            for number in call.holds:
                if number not in worker.held:
                    worker.connection.send_bytes(self._messages[number])
                    worker.held.add(number)
            worker.connection.send_bytes(call.message)
        except OSError:
            pass  # it is dead; its connection says so in a moment

    def _receive(self, worker: _Worker) -> None:
        try:
            fine, content, memory = pickle.loads(worker.connection.recv_bytes())
        except (EOFError, OSError):
            self._bury(worker)
            return
        if not worker.ready:
            worker.ready, self._failed_starts = True, 0
            return
        call = worker.calls.popleft()
        worker.begun = time.monotonic()
        worker.done += 1
        worker.first_memory = worker.first_memory or memory
        if fine:
            call.future.set_result(content)
        else:
            call.future.set_exception(content)
        grown = memory - worker.first_memory > self._recycle_growth
        if grown or (self._recycle_after is not None and worker.done >= self._recycle_after):
            worker.retiring = True
            self._take_back(worker)
        if worker.retiring and not worker.calls:
            self._dismiss(worker)

    def _take_back(self, worker: _Worker) -> None:
        """Replace `worker`; what it has not begun goes back to the head of the queue."""
        with self._lock:
            self._pending.extendleft(reversed(worker.calls))
        worker.calls.clear()

    def _bury(self, worker: _Worker) -> None:
        """Settle what a dead worker leaves: its evaluation failed or is tried again, the rest goes elsewhere."""
        worker.process.join(5.0)
        code = worker.process.exitcode
        if not worker.ready:
            self._failed_starts += 1
        head = worker.calls.popleft() if worker.calls else None
        self._take_back(worker)
        self._dismiss(worker)
        if head is None:
            if self._failed_starts >= _MAX_FAILED_STARTS:
                raise FmuidError(
                    "worker processes do not start",
                    where="worker pool",
                    fix='put the script\'s work under `if __name__ == "__main__":`',
                )
            return
        if worker.done and not head.retried and worker.killed != "time":
            head.retried = True
            with self._lock:
                self._pending.appendleft(head)
            return
        head.future.set_exception(self._verdict(worker, head, code))

    def _verdict(self, worker: _Worker, call: _Call, code: int | None) -> SimulationError:
        if worker.killed == "time":
            what = f"took longer than the time limit of {self.time_limit:g} s"
        elif worker.killed == "memory":
            what = f"took more memory than the limit of {self.memory_limit / 2**20:.0f} MB"
        else:
            what = f"crashed ({_cause(code)})"
        name, _, given = call.label.partition("|")
        return SimulationError(what + (f" (with {given})" if given else ""), where=name)

    def _patience(self) -> float | None:
        """Seconds until somebody has to be looked after, None if nobody has."""
        now = time.monotonic()
        waits: list[float] = []
        for w in self._team:
            if not w.ready:
                waits.append(w.started + _START_LIMIT - now)
            elif w.calls:
                if self.time_limit is not None:
                    waits.append(w.begun + self.time_limit - now)
                if self.memory_limit and sys.platform == "linux":
                    waits.append(_MEMORY_INTERVAL)
        return max(0.0, min(waits)) if waits else None

    def _enforce_limits(self) -> None:
        now = time.monotonic()
        weigh = bool(self.memory_limit) and now - self._weighed >= _MEMORY_INTERVAL
        if weigh:
            self._weighed = now
        for worker in list(self._team):
            late = now - worker.begun > self.time_limit if self.time_limit is not None else False
            if not worker.ready:
                if now - worker.started > _START_LIMIT:
                    worker.process.kill()
            elif worker.killed is None and worker.calls:
                if late:
                    worker.killed = "time"
                elif weigh and resident_memory(worker.process.pid) > self.memory_limit:
                    worker.killed = "memory"
                if worker.killed is not None:
                    worker.process.kill()

    def _recruit(self) -> bool:
        ours, theirs = self._context.Pipe()
        folder = Path(tempfile.mkdtemp(dir=self._folder))
        process = self._context.Process(
            target=worker_process.main, args=(theirs, str(folder)), name="fmuid worker", daemon=True
        )
        try:
            process.start()
        except (OSError, EOFError, RuntimeError) as error:
            self._fail_all(
                FmuidError(
                    f"worker processes cannot be started ({error})",
                    where="worker pool",
                    fix='put the script\'s work under `if __name__ == "__main__":`',
                )
            )
            return False
        finally:
            theirs.close()
        self._team.append(_Worker(process, ours, folder))
        return True

    def _dismiss(self, worker: _Worker) -> None:
        """End a worker: kindly if it is idle, else at once."""
        if worker in self._team:
            self._team.remove(worker)
        if worker.calls or not worker.ready:
            worker.process.kill()
        worker.connection.close()  # it leaves when it sees this
        worker.process.join(1.0)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
        worker.process.close()
        shutil.rmtree(worker.folder, ignore_errors=True)

    def _fail_all(self, error: FmuidError) -> None:
        with self._lock:
            calls = [*self._pending, *(c for w in self._team for c in w.calls)]
            self._pending.clear()
        for call in calls:
            if not call.future.cancel() and not call.future.done():
                call.future.set_exception(error)


def available_processors() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _memory_share(workers: int) -> int:
    try:
        return int(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2 // workers)
    except (AttributeError, OSError, ValueError):
        return 0


def _outcome(future: Future[Any]) -> Outcome:
    try:
        outcome: Outcome = future.result()
    except SimulationError as error:
        return error
    return outcome


def _cause(code: int | None) -> str:
    if code is not None and code < 0:
        with suppress(ValueError):
            return signal.Signals(-code).name
    return f"exit code {code}"


class _Pickler(pickle.Pickler):
    # Experiments and tasks hold read-only mappings, which pickle does not know.
    dispatch_table = {  # noqa: RUF012
        **copyreg.dispatch_table,
        MappingProxyType: lambda m: (frozen_mapping, (dict(m),)),
    }


def _dumps(thing: Any) -> bytes:
    buffer = io.BytesIO()
    try:
        _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(thing)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise FmuidError(
            f"cannot be sent to a worker process ({error})",
            where=type(thing).__name__,
            fix="define it in a module, or run in this process",
        ) from None
    return buffer.getvalue()
