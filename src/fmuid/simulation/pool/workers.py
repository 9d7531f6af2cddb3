"""Supervised worker processes, so that no FMU can stop a search.

Use a pool as the runner of a problem (``runner=pool.run``), or as any `concurrent.futures.Executor`::

    with WorkerPool(2, time_limit=30.0) as pool:
        outcomes = pool.run([(fmu, task, {"c": 100.0}), (fmu, task, {"c": 200.0})])

Each worker extracts and instantiates an FMU once and receives a task's data once. An evaluation that crashes its
worker or exceeds the time or memory limit becomes a `SimulationError`; the worker is replaced.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Executor, Future, as_completed, wait
from dataclasses import dataclass
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from fmuid.core.errors import FmuidError
from fmuid.simulation.pool import worker_process
from fmuid.simulation.pool.parcels import Parcel, name_of, pickled, referring
from fmuid.simulation.pool.worker_supervision import Call, Limits, Supervisor, leave_if_starting
from fmuid.simulation.runners import Heard, Job, Outcome, outcome_of
from fmuid.simulation.simulator import Simulator, Task

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """An object that workers keep under a number, after those that it `needs`; kept: its id is not reused."""

    number: int
    needs: tuple[int, ...]
    thing: Any


def _numbers(objects: Iterable[_Held]) -> tuple[int, ...]:
    """Return the numbers of objects, each after those of what it needs."""
    return tuple(dict.fromkeys(number for held in objects for number in (*held.needs, held.number)))


class WorkerPool(Executor):
    """A pool of supervised worker processes.

    Parameters
    ----------
    workers
        Number of processes; None takes the number of processors this process may use.
    time_limit
        Seconds one evaluation may take; None for no limit.
    memory_limit
        Resident bytes a worker may reach; None takes half of the machine's memory shared by the workers. This
        works on Linux only; elsewhere there is no limit.
    recycle_after
        Evaluations after which a worker is replaced; None for never.
    recycle_growth
        Bytes a worker may grow after its first evaluation before it is replaced between two evaluations, for
        FMUs that leak.

    Notes
    -----
    An evaluation that crashes a worker with earlier evaluations is repeated in a new worker: whether it fails then
    depends on its parameters alone, and results are the same for any number of workers. An evaluation that exceeds
    the time limit is not repeated.

    Workers are started with ``forkserver`` if available, else with ``spawn``, so a script must start its work
    under ``if __name__ == "__main__":``.
    """

    TIME_LIMIT = 300.0

    def __init__(
        self,
        workers: int | None = None,
        *,
        time_limit: float | None = TIME_LIMIT,
        memory_limit: int | None = None,
        recycle_after: int | None = None,
        recycle_growth: int = 256 * 2**20,
    ) -> None:
        leave_if_starting()
        self.workers = workers if workers is not None else available_processors()
        if self.workers < 1:
            raise FmuidError(f"{workers} workers", where="worker pool", fix="use one or more")
        limits = Limits(
            time_limit,
            memory_limit if memory_limit is not None else memory_share(self.workers),
            recycle_after,
            recycle_growth,
        )
        self._supervisor = Supervisor(self.workers, limits)
        self._lock = threading.Lock()
        self._held: dict[int, _Held] = {}  # by id of the object
        self._count = itertools.count()

    def run(self, jobs: Sequence[Job], heard: Heard | None = None) -> list[Outcome]:
        """Simulate `jobs` in the workers; return outcomes in order, a `SimulationError` for a failed job.

        `heard` is called for each job when it ends, in the order in which they end.

        Raises
        ------
        FmuidError
            A job is invalid for any parameter values (for example an unknown name), or workers cannot be started.
        """
        futures = self._enqueue([self._call(*job) for job in jobs])
        if heard is None:
            return outcomes_of(futures)
        of = dict(zip(futures, jobs, strict=True))
        return outcomes_of(futures, lambda future: heard(of[future], outcome_of(future)))

    def submit_packed(self, jobs: Sequence[tuple[Parcel, Parcel, Mapping[str, float]]]) -> list[Future[Any]]:
        """Start simulating jobs packed by another process; `outcomes_of` waits for them."""
        return self._enqueue([self._call(*job) for job in jobs])

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call ``fn(*args, **kwargs)`` in a worker; see `concurrent.futures.Executor.submit`.

        The future raises `SimulationError` if the call crashes the worker or exceeds a limit.
        """
        message = pickled((worker_process.CALL, fn, args, kwargs))
        return self._enqueue([Call(message, (), Future(), getattr(fn, "__name__", "call"), {})])[0]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Stop the workers; see `concurrent.futures.Executor.shutdown`.

        With `cancel_futures`, running evaluations are also abandoned.
        """
        self._supervisor.shutdown(wait, abandon=cancel_futures)

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.shutdown(cancel_futures=exc_type is not None)

    def _call(self, simulator: Simulator | Parcel, task: Task | Parcel, parameters: Mapping[str, float]) -> Call:
        both = self._hold(simulator), self._hold(task)
        message = pickled((worker_process.JOB, *(held.number for held in both), dict(parameters)))
        affinity = simulator.affinity if isinstance(simulator, Simulator) else None
        return Call(message, _numbers(both), Future(), name_of(simulator), parameters, affinity)

    def _hold(self, thing: Any) -> _Held:
        """Give `thing` a number; workers receive it once."""
        with self._lock:
            if id(thing) in self._held:
                return self._held[id(thing)]
        inside: list[_Held] = []

        def hold(part: Any) -> int:
            inside.append(self._hold(part))
            return inside[-1].number

        content = thing.content if isinstance(thing, Parcel) else referring(thing, hold)
        with self._lock:
            held = _Held(next(self._count), _numbers(inside), thing)
            self._supervisor.messages[held.number] = pickled((worker_process.HOLD, held.number, content))
            self._held[id(thing)] = held
        return held

    def _enqueue(self, calls: list[Call]) -> list[Future[Any]]:
        self._supervisor.enqueue(calls)
        return [call.future for call in calls]


def outcomes_of(
    futures: Sequence[Future[Any]], heard: Callable[[Future[Any]], None] | None = None
) -> list[Outcome]:
    """Wait for simulations; the rest are cancelled if one raises an error other than a failed simulation."""
    try:
        if heard is None:
            wait(futures, return_when=FIRST_EXCEPTION)  # wakes up once, not with every evaluation
        else:
            for future in as_completed(futures):
                heard(future)
        return [outcome_of(future) for future in futures]
    except BaseException:
        for future in futures:
            future.cancel()
        raise


def available_processors() -> int:
    """Return the number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_share(workers: int) -> int:
    """Return the memory limit in bytes for each of `workers`, 0 (no limit) if the machine's memory is unknown."""
    try:
        return int(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2 // workers)
    except (AttributeError, OSError, ValueError):
        return 0
