"""Simulations on other executors, such as the standard library's process pool or a Dask cluster.

Jobs are sent in batches that take about a fifth of a second each. A job refers to model and task by their hashes.
New models and tasks are sent to all workers of a Dask cluster at once, or with the jobs on other executors; a
worker that lacks one says so and receives it again. So large data is sent once to each worker, whoever distributes
the jobs. Each worker simulates in its own supervised processes (`workers`), so an FMU that crashes, hangs or
allocates without limit costs one evaluation but no worker of the cluster.
"""

from __future__ import annotations

import asyncio
import importlib
import logging
import math
import multiprocessing
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from multiprocessing.util import Finalize
from typing import Any

import numpy as np

from fmuid.core.errors import FmuidError
from fmuid.simulation.pool.parcels import Parcel, packed
from fmuid.simulation.pool.workers import WorkerPool, available_processors, memory_share, outcomes_of
from fmuid.simulation.runners import Job, Outcome, Runner, on_threads

_CONNECT_LIMIT = 15  # s
_REACH_LIMIT = 2.0  # s for the workers to answer this machine
_TASK = 0.2  # target duration of a task of several jobs, s
_ROUNDS = 5  # attempts of a worker to get what it needs
_MOST_HELD = 512 * 2**20  # bytes that a worker of the executor keeps before it starts afresh


@dataclass(frozen=True, slots=True)
class Raised:
    """An error that is not a failed simulation but a mistake, such as an unknown name."""

    error: Exception


@dataclass(frozen=True, slots=True)
class Simulated:
    """Outcomes of a batch (None where a worker lacks the model or task), and the seconds that the others took."""

    outcomes: list[Outcome | None]
    seconds: float

    @property
    def simulated(self) -> int:
        """Number of jobs that were done."""
        return sum(outcome is not None for outcome in self.outcomes)


Answer = Simulated | Raised
Named = tuple[str, str, Mapping[str, float]]
"""A job: digests of model and task, parameters."""
Limits = tuple[float | None, int | None]
"""Limits of time and memory, as for a `WorkerPool`."""


def on_executor(
    executor: Executor, *, time_limit: float | None = WorkerPool.TIME_LIMIT, memory_limit: int | None = None
) -> Runner:
    """Return a runner on any `concurrent.futures` executor; results do not depend on the executor.

    Parameters
    ----------
    executor
        A `WorkerPool` has its own limits; the threads of a ThreadPoolExecutor simulate in this process, without
        supervision.
    time_limit, memory_limit
        As for a `WorkerPool`; they apply to the supervised processes in the executor's workers.

    Raises
    ------
    FmuidError
        Raised by the runner if the executor has lost its workers or a model cannot be sent to them.
    """
    if isinstance(executor, WorkerPool):
        return executor.run
    if isinstance(executor, ThreadPoolExecutor):
        return on_threads(executor)
    return _Batches(executor, (time_limit, memory_limit)).run


class _Batches:
    """A runner on an executor: jobs are grouped into tasks long enough to make the overhead small."""

    def __init__(self, executor: Executor, limits: Limits) -> None:
        self._executor, self._limits = executor, limits
        self._client: Any = getattr(executor, "_client", None)  # Dask's
        # By the id of an object, which is kept so that its id is not reused.
        self._parcels: dict[int, tuple[Parcel, Any]] = {}
        self._sent: set[str] = set()  # digests
        self._seconds = math.inf  # duration of the last job
        self._places = 1  # tasks that the executor runs at once

    def run(self, jobs: Sequence[Job]) -> list[Outcome]:
        """Simulate `jobs`; see `fmuid.simulation.runners.Runner`."""
        parcels = [tuple(self._parcel(thing) for thing in job[:2]) for job in jobs]
        content = {p.digest: p for both in parcels for p in both}
        named = [(a.digest, b.digest, dict(job[2])) for (a, b), job in zip(parcels, jobs, strict=True)]
        outcomes: dict[int, Outcome] = {}
        lacking = content.keys() - self._sent
        for _ in range(_ROUNDS):
            batches = self._batches([k for k in range(len(jobs)) if k not in outcomes])
            answers = self._ask([[named[k] for k in batch] for batch in batches], {d: content[d] for d in lacking})
            self._sent |= lacking
            for batch, answer in zip(batches, answers, strict=True):
                if isinstance(answer, Raised):
                    raise answer.error
                answered = zip(batch, answer.outcomes, strict=True)
                outcomes |= {k: outcome for k, outcome in answered if outcome is not None}
            if len(outcomes) == len(jobs):
                return [outcomes[k] for k in range(len(jobs))]
            lacking = {digest for k, job in enumerate(named) if k not in outcomes for digest in job[:2]}
        raise FmuidError(
            "workers do not keep the models sent to them",
            where=type(self._executor).__name__,
            fix="check their memory and logs",
        )

    def _batches(self, due: Sequence[int]) -> list[Sequence[int]]:
        share = -(-len(due) // self._places)
        number = -(-len(due) // max(1, min(share, int(_TASK / max(self._seconds, 1e-6)))))
        return [due[i::number] for i in range(number)]  # neighbours take similar time, so each batch gets a mix

    def _ask(self, batches: Sequence[Sequence[Named]], enclosed: Mapping[str, Parcel]) -> list[Answer]:
        futures: list[Future[Answer]] = []
        try:
            if self._client is not None and enclosed:
                self._client.run(hold, enclosed, on_error="return")  # workers that failed answer so
                enclosed = {}
            for batch in batches:
                needed = {d: enclosed[d] for job in batch for d in job[:2] if d in enclosed}
                futures.append(self._executor.submit(simulate_supervised, batch, needed, self._limits))
            self._places = max(1, _places(self._executor) or sum(map(len, batches)))  # asked while they work
            answers = [future.result() for future in futures]
        except Exception as error:  # answers raise nothing, so the executor failed
            raise FmuidError(
                f"has lost its workers ({f'{type(error).__name__}: {error}'.removesuffix(': ')})",
                where="Dask" if self._client is not None else type(self._executor).__name__,
                fix="check their logs; --resume continues without repeating a simulation",
            ) from error
        finally:
            for future in futures:
                future.cancel()
        times = [a.seconds / n for a in answers if isinstance(a, Simulated) and (n := a.simulated)]
        self._seconds = float(np.median(times)) if times else self._seconds
        return answers

    def _parcel(self, thing: Any) -> Parcel:
        if id(thing) not in self._parcels:
            self._parcels[id(thing)] = packed(thing), thing
        return self._parcels[id(thing)][0]


def _places(executor: Executor) -> int:
    """Return how many tasks the executor runs at once, 0 if unknown."""
    client = getattr(executor, "_client", None)
    if client is not None:  # Dask's
        return sum(client.nthreads().values())
    return int(getattr(executor, "_max_workers", 0))


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Connect to the Dask scheduler at `address`, such as ``tcp://10.0.0.1:8786``, and yield its executor.

    Raises
    ------
    FmuidError
        Dask is not installed, no scheduler answers, there are no workers, or they have another version of fmuid.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise FmuidError("Dask is not installed", where="--dask", fix="pip install 'fmuid[dask]'") from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # our own errors report it, in one line
    try:
        client = distributed.Client(address, timeout=_CONNECT_LIMIT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise FmuidError(
            f"no Dask scheduler answers ({error})", where=address, fix="start one with: dask scheduler"
        ) from None
    try:
        yield _of_client(client, address)
    finally:
        client.close()


def _of_client(client: Any, address: str) -> Executor:
    versions = client.run(version, "fmuid", on_error="return")
    if not versions:
        raise FmuidError("the cluster has no workers", where=address, fix="start some with: dask worker ADDRESS")
    for worker, its in versions.items():
        if its != version("fmuid"):
            raise FmuidError(
                f"worker {worker} has {'fmuid ' + its if isinstance(its, str) else 'no fmuid'}",
                where=address,
                fix=f"install fmuid {version('fmuid')} there",
            )
    client.direct_to_workers = client.sync(_reaches, client, list(versions))
    executor: Executor = client.get_executor(pure=False)
    return executor


async def _reaches(client: Any, workers: Sequence[str]) -> bool:
    """Return whether every worker answers; results then come directly from workers, else through the scheduler."""
    asked = asyncio.gather(*(client.rpc(worker).identity() for worker in workers))
    try:
        await asyncio.wait_for(asked, _REACH_LIMIT)
    except (OSError, TimeoutError):
        return False
    return True


# ---- in the executor's workers --------------------------------------------------------------------------------


@dataclass(slots=True)
class _Held:
    """Objects kept by one worker of the executor."""

    parcels: dict[str, Parcel] = field(default_factory=dict)
    pools: dict[Limits, WorkerPool] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def clear(self, *, at_exit: bool = False) -> None:
        """Release everything; running work is finished, except at the process's exit."""
        self.parcels.clear()
        for pool in self.pools.values():
            pool.shutdown(wait=at_exit, cancel_futures=at_exit)
        self.pools.clear()

    def pool(self, limits: Limits) -> WorkerPool:
        """Return the pool with these limits."""
        if limits not in self.pools:
            # Dask's workers are daemons, which may not have children in multiprocessing; ours exit with them.
            multiprocessing.current_process().daemon = False
            Finalize(None, self.clear, kwargs={"at_exit": True}, exitpriority=10)  # before its own clearing up
            memory = limits[1] if limits[1] is not None else memory_share(available_processors())
            self.pools[limits] = WorkerPool(_threads(), time_limit=limits[0], memory_limit=memory)
        return self.pools[limits]


_held = _Held()


def _threads() -> int:
    """Return how many tasks this worker of the executor runs at once; only Dask's run more than one."""
    distributed: Any = sys.modules.get("distributed")
    try:
        return int(distributed.get_worker().state.nthreads) if distributed else 1
    except ValueError:  # not one of Dask's
        return 1


def hold(parcels: Mapping[str, Parcel]) -> None:
    """Keep models and tasks that jobs need in this worker."""
    with _held.lock:
        if sum(len(p.content) for p in _held.parcels.values()) > _MOST_HELD:
            _held.clear()
        _held.parcels |= parcels


def simulate_supervised(jobs: Sequence[Named], enclosed: Mapping[str, Parcel], limits: Limits) -> Answer:
    """Simulate jobs in supervised processes of this worker."""
    if enclosed:
        hold(enclosed)
    begun = time.perf_counter()
    try:
        with _held.lock:
            there = {
                k: (_held.parcels[model], _held.parcels[task], parameters)
                for k, (model, task, parameters) in enumerate(jobs)
                if {model, task} <= _held.parcels.keys()
            }
            futures = _held.pool(limits).submit_packed(list(there.values()))
        outcomes = dict(zip(there, outcomes_of(futures), strict=True))
    except Exception as error:
        return Raised(error)
    return Simulated([outcomes.get(k) for k in range(len(jobs))], time.perf_counter() - begun)
