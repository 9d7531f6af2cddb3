"""Runs of one FMU that share their beginning: later ones go on from a state that an earlier one left.

A course over time at a place of a model is tried piece by piece, and up to its piece every run is the same one.
The FMU's state restores all that the integrator knows, so the results are those of whole runs to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.simulation.fmu_library import FmuLibrary
from fmuid.simulation.fmu_plan import PreparedTask
from fmuid.simulation.stepper import FUNCTIONS

_MOST = 16  # states kept at a time
_Key = tuple[object, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Branch:
    """A state of the FMU at a sample, and what led to it.

    `inputs` are (sample, number of inputs), `outputs` (number of outputs, sample + 1).
    """

    sample: int
    state: int
    inputs: FloatArray
    outputs: FloatArray


class Branches:
    """States that runs of one instance left, by the group of their tasks and their parameters."""

    def __init__(self) -> None:
        self._known: dict[_Key, _Branch] = {}

    def begin(self, prepared: PreparedTask, outputs: FloatArray) -> None:
        """Let the next run of a plan go on from the latest state that fits, and leave one for later runs."""
        plan, task = prepared.plan, prepared.task
        plan.from_state = plan.kept = None
        plan.branch = -1
        able = all(prepared.library.functions[FUNCTIONS.index(name)] for name in _NEEDED)
        branch = 0 if task.shared is None else task.shared[1]
        if branch == 0 or not able or plan.n_times < len(task.time) or plan.n_directions:
            return  # the first inputs act in the initialisation, too
        known = self._known.get(_key(prepared))
        if (
            known is not None
            and known.sample <= branch
            and np.array_equal(known.inputs, prepared.inputs[: known.sample])
        ):
            outputs[:, : known.sample + 1] = known.outputs
            plan.from_state, plan.begin = known.state, known.sample
        if known is None or plan.from_state is None or known.sample < branch:
            plan.branch = branch

    def end(self, instance: int, prepared: PreparedTask, outputs: FloatArray) -> None:
        """Keep the state that a complete run left."""
        plan = prepared.plan
        if plan.kept is None:
            return
        key, sample = _key(prepared), plan.branch
        if key not in self._known and len(self._known) == _MOST:
            self._forget(instance, prepared.library, next(iter(self._known)))
        elif key in self._known:
            self._forget(instance, prepared.library, key)
        inputs, before = prepared.inputs[:sample].copy(), outputs[:, : sample + 1].copy()
        self._known[key] = _Branch(sample, plan.kept, inputs, before)

    def clear(self, instance: int | None, library: FmuLibrary | None) -> None:
        """Forget all states; free them if there is an instance that can."""
        for key in list(self._known):
            if instance is None or library is None:
                del self._known[key]
            else:
                self._forget(instance, library, key)

    def _forget(self, instance: int, library: FmuLibrary, key: _Key) -> None:
        library.free_state(instance, self._known.pop(key).state)


_NEEDED = ("GET_FMU_STATE", "SET_FMU_STATE", "FREE_FMU_STATE", "SET_DIRECTIONS")  # the last: of `fmuid build`


def _key(prepared: PreparedTask) -> _Key:
    task = prepared.task
    assert task.shared is not None
    own = task.time.tobytes(), prepared.starts.tobytes()
    return task.shared[0], task.tolerance, task.outputs, tuple(task.inputs), prepared.names, own
