"""Simulations on executors of other makes: a process pool of the standard library's, a Dask cluster.

A job names model and task by their hashes. A worker that does not hold one of them answers so, and gets it with
the job once more: what is large travels once to each worker, whoever distributes the jobs. In each of these
workers simulations run in supervised processes of its own (`fmuid.workers`), so an FMU that crashes, hangs or
allocates without end costs one evaluation and no worker of the cluster.
"""

from __future__ import annotations

import importlib
import multiprocessing
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from multiprocessing.util import Finalize
from typing import Any

from fmuid.errors import FmuidError
from fmuid.parcels import Parcel, packed
from fmuid.runners import Job, Outcome, Runner, on_threads
from fmuid.workers import WorkerPool

_CONNECT_LIMIT = 15  # s
_MOST_HELD = 512 * 2**20  # bytes that a worker of the executor holds before it begins anew


@dataclass(frozen=True, slots=True)
class Raised:
    """What a simulation raised that is no failure of it but a mistake, as an unknown name is."""

    error: Exception


Answer = Outcome | Raised | None
"""Of a worker of the executor; None if model or task is not there yet."""


def on_executor(
    executor: Executor, *, time_limit: float | None = WorkerPool.TIME_LIMIT, memory_limit: int | None = None
) -> Runner:
    """Return a runner on any `concurrent.futures` executor; results do not depend on which.

    Parameters
    ----------
    executor
        A `WorkerPool` has limits of its own; the threads of a ThreadPoolExecutor simulate in this process, where
        nothing can watch over them.
    time_limit, memory_limit
        As of a `WorkerPool`, for the supervised processes in the executor's workers.

    Raises
    ------
    FmuidError
        Of the runner: the executor has lost its workers, or a model cannot be sent to them.
    """
    if isinstance(executor, WorkerPool):
        return executor.run
    if isinstance(executor, ThreadPoolExecutor):
        return on_threads(executor)
    parcels: dict[int, tuple[Parcel, Any]] = {}  # by id of the thing, which is kept so that the id stays its own

    def parcel(thing: Any) -> Parcel:
        if id(thing) not in parcels:
            parcels[id(thing)] = packed(thing), thing
        return parcels[id(thing)][0]

    def submit(job: Job, enclosed: bool) -> Future[Answer]:
        both = [parcel(thing) for thing in job[:2]]
        content = {p.digest: p for p in both} if enclosed else {}
        digests = both[0].digest, both[1].digest
        return executor.submit(simulate_supervised, digests, dict(job[2]), content, (time_limit, memory_limit))

    def run(jobs: Sequence[Job]) -> list[Outcome]:
        futures: list[Future[Answer]] = []
        try:
            futures += [submit(job, enclosed=False) for job in jobs]
            answers = [future.result() for future in futures]
            again = {k: submit(jobs[k], enclosed=True) for k, answer in enumerate(answers) if answer is None}
            futures += again.values()
            answers = [again[k].result() if k in again else answer for k, answer in enumerate(answers)]
        except FmuidError:
            raise
        except Exception as error:  # answers raise nothing: it is the executor's
            raise FmuidError(
                f"has lost its workers ({type(error).__name__}: {error})",
                where=type(executor).__name__,
                fix="look at their logs; with --resume nothing is simulated twice",
            ) from error
        finally:
            for future in futures:
                future.cancel()
        return [_outcome(answer) for answer in answers]

    return run


def _outcome(answer: Answer) -> Outcome:
    assert answer is not None  # what was missing was enclosed
    if isinstance(answer, Raised):
        raise answer.error
    return answer


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """Connect to the Dask scheduler at `address`, such as ``tcp://10.0.0.1:8786``, and yield its executor.

    Raises
    ------
    FmuidError
        Dask is not installed, nothing answers, there are no workers, or they have another version of fmuid.
    """
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise FmuidError("Dask is not installed", where="--dask", fix="pip install 'fmuid[dask]'") from None
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
    found = client.run(version, "fmuid", on_error="return")
    if not found:
        raise FmuidError("the cluster has no workers", where=address, fix="start some with: dask worker ADDRESS")
    for worker, its in found.items():
        if its != version("fmuid"):
            raise FmuidError(
                f"worker {worker} has {'fmuid ' + its if isinstance(its, str) else 'no fmuid'}",
                where=address,
                fix=f"install fmuid {version('fmuid')} there",
            )
    executor: Executor = client.get_executor(pure=False)
    return executor


# ---- in the executor's workers --------------------------------------------------------------------------------


@dataclass(slots=True)
class _Held:
    """What one worker of the executor holds."""

    parcels: dict[str, Parcel] = field(default_factory=dict)
    pools: dict[tuple[float | None, int | None], WorkerPool] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def clear(self, *, at_exit: bool = False) -> None:
        """Let go of everything; what has begun is finished, but not at the process's exit."""
        self.parcels.clear()
        for pool in self.pools.values():
            pool.shutdown(wait=at_exit, cancel_futures=at_exit)
        self.pools.clear()

    def pool(self, limits: tuple[float | None, int | None]) -> WorkerPool:
        """Return the pool with these limits."""
        if limits not in self.pools:
            # Dask's workers are daemons, which multiprocessing lets have no children; ours leave with them.
            multiprocessing.current_process().daemon = False
            Finalize(None, self.clear, kwargs={"at_exit": True}, exitpriority=10)  # before its own clearing up
            self.pools[limits] = WorkerPool(time_limit=limits[0], memory_limit=limits[1])
        return self.pools[limits]


_held = _Held()


def simulate_supervised(
    digests: tuple[str, str],
    parameters: Mapping[str, float],
    enclosed: Mapping[str, Parcel],
    limits: tuple[float | None, int | None],
) -> Answer:
    """Simulate in a supervised process of this worker."""
    with _held.lock:
        if sum(len(p.content) for p in _held.parcels.values()) > _MOST_HELD:
            _held.clear()
        _held.parcels |= enclosed
        if not _held.parcels.keys() >= set(digests):
            return None
        simulator, task = (_held.parcels[digest] for digest in digests)
        pool = _held.pool(limits)
    try:
        return pool.run_packed(simulator, task, parameters)
    except Exception as error:
        return Raised(error)
