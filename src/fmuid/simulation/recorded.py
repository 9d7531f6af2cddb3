"""Simulations recorded on disk, so that interrupted work continues without repeating any of them."""

from __future__ import annotations

import hashlib
import struct
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from fmuid.core.files import make_folder
from fmuid.core.immutable import FloatArray
from fmuid.core.journal import Journal, check_resumable, records
from fmuid.simulation.runners import Job, Outcome, Runner
from fmuid.simulation.simulator import Simulator, Task

_MAGIC = b"fmuid-simulations 1\n"
_MODELS = 256  # number of models, and of files, whose digests are remembered
_LARGEST = 96_000_000  # bytes: to repeat some of a search's simulations is better than a full disk
_OF_TASKS: WeakKeyDictionary[Task, bytes] = WeakKeyDictionary()


class RecordedSimulations:
    """Predictions made for one result, each a record in a journal under a key of everything that it depends on.

    The key covers the model with its files, the task and the parameters, so interrupted work continues exactly
    where it stopped, and no change of these is overlooked. A failed simulation is not recorded but tried again.
    Only positions in the file are held in memory. When the file has 96 MB, nothing more is recorded, and
    interrupted work repeats what came later.

    Parameters
    ----------
    file
        The journal.
    resume
        Whether to continue an interrupted run from the records there.
    complete
        Whether a result exists already.

    Raises
    ------
    JournalError
        The folder contains an interrupted run and `resume` is False, or a complete one and `resume` is True.
    """

    def __init__(self, file: Path, *, resume: bool, complete: bool) -> None:
        make_folder(file.parent)
        there = file.exists()
        positions = list(_positions(file)) if there else []
        check_resumable(file.parent, resume, interrupted=bool(positions), complete=complete and not there)
        self._places = {key: place for key, place, _ in positions}
        end = positions[-1][2] if positions else None
        self._full = False
        self._journal = Journal(file, _MAGIC, end=end)
        self._models: OrderedDict[int, tuple[Simulator, bytes]] = OrderedDict()  # kept: ids are not reused

    def __enter__(self) -> RecordedSimulations:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._journal.closed:
            self._journal.close(remove=error is None or not self._places)

    def over(self, runner: Runner) -> Runner:
        """Return a runner that uses `runner` for simulations that are not recorded."""

        def run(jobs: Sequence[Job]) -> list[Outcome]:
            outcomes = {k: self._recalled(job) for k, job in enumerate(jobs)}
            missing = [k for k, outcome in outcomes.items() if outcome is None]
            simulated = runner([jobs[k] for k in missing]) if missing else []
            new = dict(zip(missing, simulated, strict=True))
            return [new[k] if outcome is None else outcome for k, outcome in outcomes.items()]

        return run

    def keep(self, job: Job, outcome: Outcome) -> None:
        """Record the outcome of a job.

        Raises
        ------
        JournalError
            The disk is full.
        """
        if isinstance(outcome, Exception) or self._full:
            return
        prediction = np.ascontiguousarray(outcome, dtype=np.float64)
        if self._journal.size + prediction.nbytes > _LARGEST:
            self._full = True
            return
        key = self._key(job)
        place = self._journal.append((key, prediction.shape, prediction.tobytes()))
        self._places[key] = place

    def _recalled(self, job: Job) -> FloatArray | None:
        place = self._places.get(self._key(job)) if self._places else None
        if place is None:
            return None
        _, shape, data = self._journal.read(place)
        return np.frombuffer(data).reshape(shape)

    def _key(self, job: Job) -> bytes:
        simulator, task, parameters = job
        digest = hashlib.blake2b(self._of_model(simulator) + digest_of_task(task), digest_size=16)
        digest.update(digest_of_values(parameters))
        return digest.digest()

    def _of_model(self, simulator: Simulator) -> bytes:
        key = id(simulator)
        if key not in self._models:
            self._models[key] = simulator, _digest_of_model(simulator)
            if len(self._models) > _MODELS:
                self._models.popitem(last=False)
        self._models.move_to_end(key)
        return self._models[key][1]


def _positions(file: Path) -> list[tuple[bytes, int, int]]:
    """Return the keys of a journal, each with the positions where its record begins and ends."""
    return [(content[0], begin, end) for content, begin, end in records(file, _MAGIC)]


def digest_of_values(values: Mapping[str, float]) -> bytes:
    """Return bytes that differ with the values."""
    return b"".join(name.encode() + b"\0" + struct.pack("<d", values[name]) for name in sorted(values))


def digest_of_task(task: Task) -> bytes:
    """Return a digest of a task and its data."""
    along = b"".join(b"|" + digest_of_values(direction) for direction in task.along)
    along += b"".join(name.encode() + b"\0" + moves.tobytes() for name, moves in sorted(task.driven.items()))
    return digest_without_along(task) + hashlib.blake2b(along, digest_size=16).digest()


def digest_without_along(task: Task) -> bytes:
    """Return a digest of a task and its data, whatever it is differentiated along; it is remembered."""
    if task in _OF_TASKS:
        return _OF_TASKS[task]
    digest = hashlib.blake2b(digest_size=16)
    how = (
        task.interpolation,
        task.tolerance,
        sorted(task.inputs),
        task.linear,
        task.band_limited,
        task.after,
        task.read_after,
    )
    digest.update(repr((task.outputs, *how, task.every)).encode())
    digest.update(digest_of_values(task.start_values))
    arrays: list[Any] = [task.time, *(task.inputs[name] for name in sorted(task.inputs))]
    if task.feedback is not None:
        arrays += [task.feedback.measured, task.feedback.gain]
    for array in arrays:
        digest.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return _OF_TASKS.setdefault(task, digest.digest())


def _digest_of_model(simulator: Simulator) -> bytes:
    """Return a digest of a model and its files, because a copy with other start values has the same token."""
    digest = hashlib.blake2b(repr((simulator.token, simulator.interface)).encode(), digest_size=16)
    for path in simulator.files:
        if path.is_file():
            there = path.stat()
            digest.update(_digest_of_file(path, there.st_mtime_ns, there.st_size))
    return digest.digest()


@lru_cache(maxsize=_MODELS)
def _digest_of_file(path: Path, modified: int, size: int) -> bytes:
    """Return a digest of a file that was modified at that time and has that size."""
    del modified, size
    return hashlib.sha256(path.read_bytes()).digest()
