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
_NEEDED = ("GET_FMU_STATE", "SET_FMU_STATE", "FREE_FMU_STATE", "SET_DIRECTIONS")  # the last: of `fmuid build`
_Key = tuple[object, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Branch:
    """A state of the FMU at a sample, and what led to it.

    `inputs` are those up to the sample, (n, number of inputs), `outputs` (number of outputs, sample + 1).
    """

    sample: int
    state: int
    inputs: FloatArray
    outputs: FloatArray


class Branches:
    """States that runs of one instance left, by the group of their tasks and their parameters."""

    def __init__(self) -> None:
        self._known: dict[_Key, _Branch] = {}

    def begin(self, prepared: PreparedTask, outputs: FloatArray) -> _Key | None:
        """Let the next run of a plan go on from the latest state that fits, and leave one for later runs.

        Return the arguments of `end`; None if the run shares nothing after all.
        """
        plan, task = prepared.plan, prepared.task
        assert task.shared is not None
        plan.from_state, plan.kept, plan.branch = None, None, -1
        act = bool(task.after)  # inputs of a sample have then acted when the state is kept
        branch = task.shared[1] - act
        able = all(prepared.library.functions[FUNCTIONS.index(name)] for name in _NEEDED)
        if branch <= 0 or not able or plan.n_times < len(task.time) or plan.n_directions:
            return None  # the first inputs act in the initialisation, too
        key, begun = _key(prepared), 0
        known = self._known.get(key)
        if (
            known is not None
            and known.sample <= branch
            and np.array_equal(known.inputs, prepared.inputs[: known.sample + act])
        ):
            begun = known.sample
            outputs[:, : begun + 1] = known.outputs
            plan.from_state, plan.begin = known.state, begun
        if begun < branch:
            plan.branch = branch
        return key

    def end(self, key: _Key, prepared: PreparedTask, outputs: FloatArray | None) -> None:
        """Keep the state that a run left; free it if the run has no complete `outputs`."""
        plan = prepared.plan
        if plan.kept is None:
            return
        if outputs is None:
            prepared.library.free_state(plan.instance, plan.kept)
            return
        if key in self._known or len(self._known) == _MOST:
            self._forget(plan.instance, prepared.library, key if key in self._known else next(iter(self._known)))
        inputs = prepared.inputs[: plan.branch + bool(prepared.task.after)].copy()
        before = outputs[:, : plan.branch + 1].copy()
        self._known[key] = _Branch(plan.branch, plan.kept, inputs, before)

    def clear(self, instance: int | None, library: FmuLibrary | None) -> None:
        """Forget all states; free them if there is an instance that can."""
        for key in list(self._known):
            if instance is None or library is None:
                del self._known[key]
            else:
                self._forget(instance, library, key)

    def _forget(self, instance: int, library: FmuLibrary, key: _Key) -> None:
        library.free_state(instance, self._known.pop(key).state)


def _key(prepared: PreparedTask) -> _Key:
    task = prepared.task
    assert task.shared is not None
    names = tuple(task.inputs), task.linear, task.outputs, task.after, prepared.names, tuple(task.start_values)
    return (
        task.shared[0],
        names,
        task.interpolation,
        task.tolerance,
        task.time.tobytes(),
        prepared.starts.tobytes(),
    )
