"""Runners for simulations in this process or on its threads; see `workers` and `remote` for others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.simulation.simulator import Simulator, Task

Job = tuple[Simulator, Task, Mapping[str, float]]
Outcome = FloatArray | SimulationError
Runner = Callable[[Sequence[Job]], list[Outcome]]
"""Simulates jobs and returns their outcomes in the same order; the outcome of a failed run is its error."""
Heard = Callable[[Job, Outcome], None]
"""Called when a simulation has ended."""


def simulate(job: Job) -> Outcome:
    """Run one job."""
    simulator, task, parameters = job
    try:
        return simulator.simulate(task, parameters)
    except SimulationError as error:
        return error


def simulated(runner: Runner, simulator: Simulator, task: Task, parameters: Mapping[str, float]) -> FloatArray:
    """Return the predictions of one simulation on `runner`; raise `SimulationError` if it fails."""
    (outcome,) = runner([(simulator, task, parameters)])
    if isinstance(outcome, SimulationError):
        raise outcome
    return outcome


def in_process(jobs: Sequence[Job]) -> list[Outcome]:
    """Run `jobs` one after the other in this process."""
    return [simulate(job) for job in jobs]


def one_by_one(runner: Runner, heard: Heard) -> Runner:
    """Return a runner that passes jobs to `runner` one by one and calls `heard` after each."""

    def run(jobs: Sequence[Job]) -> list[Outcome]:
        tell = reporting_after(runner, heard)
        return [outcome for job in jobs for outcome in tell([job])]

    return run


def reporting_after(runner: Runner, heard: Heard) -> Runner:
    """Return a runner that calls `heard` for every job once `runner` has finished the whole batch."""

    def run(jobs: Sequence[Job]) -> list[Outcome]:
        outcomes = runner(jobs)
        for job, outcome in zip(jobs, outcomes, strict=True):
            heard(job, outcome)
        return outcomes

    return run


def outcome_of(future: Future[Any]) -> Outcome:
    """Wait for a simulation; return its `SimulationError` if it failed."""
    try:
        outcome: Outcome = future.result()
    except SimulationError as error:
        return error
    return outcome


def on_threads(executor: ThreadPoolExecutor) -> Runner:
    """Return a runner that simulates on the threads of `executor`."""

    def run(jobs: Sequence[Job]) -> list[Outcome]:
        futures: list[Future[Outcome]] = [executor.submit(simulate, job) for job in jobs]
        try:
            return [outcome_of(future) for future in futures]
        except BaseException:
            for future in futures:
                future.cancel()
            raise

    return run
