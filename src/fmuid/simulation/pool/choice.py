"""Choice of where simulations run: on an executor, in worker processes, or in this process."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import partial
from typing import Any

from fmuid.core.errors import FmuidError
from fmuid.simulation.pool.worker_supervision import leave_if_starting
from fmuid.simulation.pool.workers import WorkerPool
from fmuid.simulation.runners import Heard, Runner, in_process, one_by_one, reporting_after


@contextmanager
def runner_on(
    workers: int | None = None,
    *,
    executor: Executor | None = None,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    heard: Heard | None = None,
) -> Iterator[Runner]:
    """Yield a runner on `executor`, or with `workers` processes (None: one per processor; 0: this process).

    `time_limit` (s) and `memory_limit` (bytes) default to those of a `WorkerPool`. `heard` is called after every
    simulation.

    Raises
    ------
    FmuidError
        A limit is given without workers.
    """
    leave_if_starting()
    asked = {"time_limit": time_limit, "memory_limit": memory_limit}
    limits: dict[str, Any] = {name: limit for name, limit in asked.items() if limit is not None}
    if executor is not None:
        from fmuid.simulation.pool.remote import on_executor

        runner = on_executor(executor, **limits)
        yield runner if heard is None else reporting_after(runner, heard)
    elif workers != 0:
        pool = WorkerPool(workers, **limits)
        try:
            yield partial(pool.run, heard=heard)
        finally:
            pool.shutdown(cancel_futures=True)  # nobody waits for what an interrupted search has left running
    elif limits:
        raise FmuidError(f"a {next(iter(limits)).replace('_', ' ')} needs worker processes", fix="use workers = 1")
    else:
        yield in_process if heard is None else one_by_one(in_process, heard)
