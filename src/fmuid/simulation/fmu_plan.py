"""A task prepared for one FMU in the stepper's layout: prepared once, run many times."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmu_build.suggest import suggestion
from fmuid.core.errors import FmuError
from fmuid.core.immutable import FloatArray
from fmuid.simulation.band_limited import refined
from fmuid.simulation.fmu_description import DescribedInterface, FmuDescription
from fmuid.simulation.fmu_library import FmuLibrary
from fmuid.simulation.fmu_variables import Slot
from fmuid.simulation.simulator import Feedback, Task, Variable
from fmuid.simulation.stepper import DTYPES, FUNCTIONS, SAMPLES, Group, Plan, require_reading_after

_ROUNDED = 1e-3  # times a fixed step: how far times of samples may be rounded
UNKNOWN_TOLERANCE = 1e-6  # for FMUs that suggest none
_MAX_PREPARED = 64 * 2**20  # bytes of prepared tasks kept in memory; the oldest is dropped first
_MAX_LAYOUTS = 200  # layouts of variables, the same


class PreparedTask:
    """A `Plan` for one task and one set of parameter names, with the arrays it points to.

    Parameters
    ----------
    task
        The task; `self.task` has the communication points of its band-limited inputs as well.
    names
        Parameters that every run sets, in the order of their values.
    restored
        Names set in earlier runs of the same instance; they are set to their start values again, for FMUs whose
        reset does not do so.
    linear_inputs
        Whether a co-simulation FMU interpolates its inputs (fmi2SetRealInputDerivatives).
    directional_references
        References of derivatives and states, if the FMU gives directional derivatives.
    """

    def __init__(
        self,
        task: Task,
        names: tuple[str, ...],
        restored: Sequence[str],
        *,
        variables: Mapping[str, Variable],
        slots: Mapping[str, Slot],
        library: FmuLibrary,
        described: FmuDescription,
        linear_inputs: bool,
        interface: DescribedInterface,
        directional_references: NDArray[np.uint32] | None = None,
    ) -> None:
        self.asked, self.names = task, names
        self.library = library
        self._slots, self._where = slots, library.where
        self._kept: list[Any] = []  # arrays the plan points into
        self.task, steps, inputs = self._checked(task, variables)
        task = self.task
        check_steps(steps, interface, self._where)
        n = len(task.time)
        self.size = 8 * n * (2 * len(task.inputs) + 1)  # approximate bytes, including the task's own
        self.inputs = inputs
        fixed = {k: v for k, v in task.start_values.items() if k not in names}
        back = [name for name in restored if name not in names and name not in fixed and slots[name].has_start]
        self._check_settable([*names, *fixed], variables)
        # Restore first, so that an alias among the names that are really set takes precedence.
        self.starts = np.zeros(len(back) + len(fixed) + len(names))
        self.starts[: len(back)] = [slots[k].starts[slots[k].element] for k in back]
        for i, (name, value) in enumerate(fixed.items()):
            slots[name].check(name, value, self._where)
            self.starts[len(back) + i] = value
        self.values = self.starts[len(back) + len(fixed) :]
        self._any_whole = any(slots[k].whole_numbers for k in names)
        for name in task.outputs:
            if self._slot(name).suffix is None:
                raise FmuError(
                    f"'{name}' is a {variables[name].type}, not a number",
                    where=self._where,
                    fix="record another variable",
                )
        plan = self.plan = Plan()
        plan.function = library.functions
        plan.fmi, plan.model_exchange, plan.branch = library.version, library.model_exchange, -1
        plan.linear = task.interpolation == "linear"
        plan.tolerance_defined = task.tolerance is not None
        plan.tolerance = task.tolerance or 0.0
        if library.model_exchange:
            self._integrate(described, inputs.shape[1], directional_references)
        # Sums of time and step size may round up past the last time; the FMU must not refuse that.
        plan.stop = float(np.max(task.time[:-1] + steps))
        if interface.fixed_step is not None:
            plan.fixed_step = interface.fixed_step
            plan.stop += _ROUNDED * plan.fixed_step
        plan.n_times, plan.n_inputs, plan.n_outputs = n, inputs.shape[1], len(task.outputs)
        plan.n_starts = len(self.starts)
        plan.time, plan.inputs, plan.starts = map(self._pointer, (task.time, inputs, self.starts))
        plan.row = self._pointer(np.zeros(max(inputs.shape[1], len(task.outputs), 1)))
        plan.n_start_groups, plan.start_groups = self._groups([*back, *fixed, *names], "Set")
        plan.n_input_groups, plan.input_groups = self._groups(list(task.inputs), "Set")
        plan.n_output_groups, plan.output_groups = self._groups(list(task.outputs), "Get", after=task.after)
        if task.after:
            require_reading_after()
        if task.feedback is not None:
            self._feed_back(task.feedback)
        if task.along:
            self._differentiate(task)
        if plan.linear or task.linear:
            self._interpolate(variables, linear_inputs or library.model_exchange)
        self._n_rows = len(task.outputs) * (1 + len(task.along))

    def set_parameters(self, parameters: Mapping[str, float]) -> None:
        """Set the values of `names`, in their order, for the next run."""
        if not self.names:
            return
        self.values[:] = list(parameters.values())
        if self._any_whole or not all(map(math.isfinite, parameters.values())):
            for name, value in parameters.items():
                self._slots[name].check(name, value, self._where)

    def outputs(self, n_times: int | None = None) -> FloatArray:
        """Return a new array for the predictions of all or `n_times` samples, and point the plan to it."""
        self.plan.n_times = n = len(self.task.time) if n_times is None else n_times
        array = np.empty((self._n_rows, n))
        if array.size:
            self.plan.outputs = ctypes.addressof(ctypes.c_char.from_buffer(array.data))  # the fastest way
        return array

    def _slot(self, name: str) -> Slot:
        try:
            return self._slots[name]
        except KeyError:
            raise FmuError(f"no variable '{name}'", where=self._where, fix=suggestion(name, self._slots)) from None

    def _steps(self, time: FloatArray) -> FloatArray:
        steps = np.diff(time) if time.ndim == 1 else np.zeros(0)
        if not len(steps) or not np.isfinite(time).all() or np.min(steps) <= 0.0:
            raise FmuError(
                "times must be at least two, finite and strictly increasing",
                where=self._where,
                fix="check them",
            )
        return steps

    def _pointer(self, array: NDArray[Any]) -> int:
        return _pointer_to(self._kept, array)

    def _groups(
        self, names: Sequence[str], action: str, only: Sequence[int] | None = None, after: Sequence[str] = ()
    ) -> tuple[int, Any]:
        """Return the layout of variables; tasks that set or read the same ones share it."""
        key = (tuple(names), action, None if only is None else tuple(only), tuple(after))
        known = self.library.layouts
        if key not in known:
            if len(known) == _MAX_LAYOUTS:
                del known[next(iter(known))]
            known[key] = self._laid_out(names, action, only, after)
        count, array, kept = known[key]
        self._kept.append(kept)
        return count, ctypes.cast(array, ctypes.POINTER(Group))

    def _laid_out(
        self, names: Sequence[str], action: str, only: Sequence[int] | None, after: Sequence[str]
    ) -> tuple[int, Any, list[Any]]:
        """Lay out variables, all or `only` those columns of the row, as one call for each FMI type.

        Outputs that are read `after` the inputs of their sample act have calls of their own.

        Return the number of groups, their array, and all that it points to.
        """
        groups: list[Group] = []
        kept: list[Any] = []
        pointer = partial(_pointer_to, kept)
        chosen = range(len(names)) if only is None else only
        kinds = {j: (self._slots[names[j]].suffix, names[j] in after) for j in chosen}
        for suffix, late in dict.fromkeys(kinds.values()):
            columns = [j for j in chosen if kinds[j] == (suffix, late)]
            members = [self._slots[names[j]] for j in columns]
            offsets: dict[int, int] = {}
            buffer: list[float] = []
            for slot in members:
                if slot.reference not in offsets:
                    offsets[slot.reference] = len(buffer)
                    buffer += [0.0 if np.isnan(s) else s for s in slot.starts]
                    if action == "Set" and slot.size > 1 and np.isnan(slot.starts).any():
                        raise FmuError(
                            "an array without start values cannot be set element by element",
                            where=self._where,
                            fix="export the FMU with start values",
                        )
            function = self.library.address(f"{action}{suffix}")
            if function is None:
                raise FmuError(
                    f"its library lacks fmi{self.library.version}{action}{suffix}",
                    where=self._where,
                    fix="export the FMU again",
                )
            storage = members[0].storage
            values = np.array(buffer, dtype=np.float64).astype(DTYPES[storage])
            groups.append(
                Group(
                    function=function,
                    references=pointer(np.array(list(offsets), dtype=np.uint32)),
                    n_references=len(offsets),
                    n_values=len(buffer),
                    type=storage,
                    direct=int(storage == 0 and len(columns) == len(names) == len(buffer) == len(offsets)),
                    n_columns=len(columns),
                    after=int(late),
                    column=pointer(np.array(columns, dtype=np.int32)),
                    place=pointer(np.array([offsets[s.reference] + s.element for s in members], dtype=np.int32)),
                    buffer=pointer(values),
                )
            )
        array = (Group * max(1, len(groups)))(*groups)
        return len(groups), array, [array, *kept]

    def _checked(self, task: Task, variables: Mapping[str, Variable]) -> tuple[Task, FloatArray, FloatArray]:
        """Return a task with all its communication points, their steps (N - 1,) and its inputs as columns."""
        steps, inputs = self._steps(task.time), self._inputs(task, variables)
        fine = refined(task, variables)
        return fine, *((steps, inputs) if fine is task else (np.diff(fine.time), self._inputs(fine, variables)))

    def _inputs(self, task: Task, variables: Mapping[str, Variable]) -> FloatArray:
        """Return the inputs of a task as columns, (N, n)."""
        n = len(task.time)
        inputs = np.empty((n, len(task.inputs)))
        for j, (name, values) in enumerate(task.inputs.items()):
            if self._slot(name) and variables[name].causality != "input":
                known = [v.name for v in variables.values() if v.causality == "input"]
                raise FmuError(
                    f"'{name}' is not an input but has causality {variables[name].causality}",
                    where=self._where,
                    fix=suggestion(name, known),
                )
            if self._slots[name].suffix is None:
                raise FmuError(
                    f"'{name}' is a {variables[name].type}, not a number", where=self._where, fix="leave it out"
                )
            if values.shape != (n,) or not np.isfinite(values).all():
                raise FmuError(
                    f"input '{name}' must have {n} finite samples, one for each time",
                    where=self._where,
                    fix="an input may not have missing samples",
                )
            inputs[:, j] = values
            self._slots[name].check(name, values, self._where)
        return inputs

    def _check_settable(self, names: Sequence[str], variables: Mapping[str, Variable]) -> None:
        for name in names:
            refusal = self._slot(name).refusal
            if refusal is not None:
                known = [
                    k for k, s in self._slots.items() if s.refusal is None and variables[k].causality != "input"
                ]
                text = self._slots[name].suffix is None
                raise FmuError(
                    f"'{name}' {refusal}: its start value cannot be set",
                    where=self._where,
                    fix="export the FMU with the value that you want" if text else suggestion(name, known),
                )
            if name in self.task.inputs:
                raise FmuError(
                    f"'{name}' has both a signal and a start value", where=self._where, fix="give one of them"
                )

    def _integrate(self, described: FmuDescription, n_inputs: int, references: NDArray[np.uint32] | None) -> None:
        """Set up the integrator of model_exchange.c."""
        plan, exchange = self.plan, described.model_exchange
        suggested = described.default_experiment.get("tolerance")
        plan.tolerance = self.task.tolerance or suggested or UNKNOWN_TOLERANCE
        plan.n_states, plan.n_indicators = described.n_states, described.n_indicators
        plan.completed_step_needed = exchange is not None and exchange.needs_completed_step
        n, nz = plan.n_states, plan.n_indicators
        plan.work = self._pointer(np.zeros(15 * n + 2 * n * n + 2 * nz + n_inputs + 1))
        plan.pivots = self._pointer(np.zeros(n + 1, dtype=np.int32))
        if references is not None:
            plan.derivative_references = self._pointer(references)

    def _feed_back(self, feedback: Feedback) -> None:
        """Set up the correction of the states by measured outputs."""
        plan = self.plan
        if not self.library.model_exchange:
            raise FmuError(
                "an observer can correct states in model exchange only",
                where=self._where,
                fix='use interface = "model exchange"',
            )
        plan.measured = self._pointer(np.array(feedback.measured, order="C"))
        plan.gain = self._pointer(np.array(feedback.gain, order="C"))
        plan.n_measured = feedback.measured.shape[1]

    def _differentiate(self, task: Task) -> None:
        """Set up the outputs' derivatives along directions."""
        plan, moved = self.plan, list(dict.fromkeys(name for along in task.along for name in along))
        needed = ("SET_DIRECTIONS", "SET_INPUT_DIRECTIONS") if task.driven else ("SET_DIRECTIONS",)
        if self.library.model_exchange or not all(self.library.functions[FUNCTIONS.index(f)] for f in needed):
            raise FmuError(
                "this FMU cannot differentiate its runs", where=self._where, fix="use finite differences"
            )
        for name in [*moved, *task.driven, *task.outputs]:
            if self._slots[name].suffix not in ("Real", "Float64") or self._slots[name].size != 1:
                raise FmuError(
                    f"'{name}' is not a real scalar: it has no derivatives", where=self._where, fix="leave it out"
                )
        plan.n_directions, plan.n_moved = len(task.along), len(moved)
        plan.moved = self._pointer(np.array([self._slots[n].reference for n in moved], dtype=np.uint32))
        plan.weights = self._pointer(np.array([[along.get(n, 0.0) for n in moved] for along in task.along]))
        references = [self._slots[n].reference for n in task.outputs]
        plan.output_references = self._pointer(np.array(references, dtype=np.uint32))
        plan.sensitivities = self._pointer(np.zeros((SAMPLES, len(task.outputs), len(task.along))))
        self.size *= 1 + len(task.along)
        if task.driven:
            plan.n_driven = len(task.driven)
            plan.driven = self._pointer(np.array([self._slots[n].reference for n in task.driven], dtype=np.uint32))
            seeds = np.stack([by_direction.T for by_direction in task.driven.values()], axis=1)
            plan.seeds = self._pointer(np.ascontiguousarray(seeds))
            plan.rates = self._pointer(np.zeros(seeds.shape[1:]))
            lines = [plan.linear or name in task.linear for name in task.driven]
            plan.driven_lines = self._pointer(np.array(lines, dtype=np.int32))

    def _interpolate(self, variables: Mapping[str, Variable], linear_inputs: bool) -> None:
        columns = [
            j
            for j, name in enumerate(self.task.inputs)
            if variables[name].variability == "continuous" and (self.plan.linear or name in self.task.linear)
        ]
        if columns and not linear_inputs:
            raise FmuError(
                "this FMU cannot interpolate its inputs between communication points",
                where=self._where,
                fix='use timing = "held", or an FMU for model exchange',
            )
        names = list(self.task.inputs)
        plan = self.plan
        plan.n_slope_groups, plan.slope_groups = self._groups(names, "Set", columns)
        plan.n_slopes = len(columns)
        plan.slope_columns = self._pointer(np.array(columns, dtype=np.int32))
        plan.slope_references = self._pointer(
            np.array([self._slots[names[j]].reference for j in columns], dtype=np.uint32)
        )
        plan.slope_orders = self._pointer(np.ones(len(columns), dtype=np.int32))
        plan.slopes = self._pointer(np.zeros(max(1, len(columns))))


def check_steps(steps: FloatArray, interface: DescribedInterface, where: object) -> None:
    """Raise FmuError unless an FMU can take these communication steps (s).

    An FMU that cannot handle a variable communication step size takes multiples of the step that it declares, as
    several of its steps; if it declares none, all steps must be equal.
    """
    fixed = interface.fixed_step
    if fixed is not None:
        off = np.abs(steps - np.maximum(1.0, np.rint(steps / fixed)) * fixed)
        if np.max(off) > _ROUNDED * fixed:
            raise FmuError(
                f"a step of {steps[np.argmax(off)]:g} s, but the FMU declares "
                f"a fixed communication step size of {fixed:g} s",
                where=where,
                fix=f"record or resample at multiples of {fixed:g} s, or export the FMU for variable steps",
            )
    elif not interface.any_step and np.ptp(steps) > 1e-6 * steps[0]:
        raise FmuError(
            f"steps of {steps.min():g} to {steps.max():g} s, but the FMU declares that it cannot handle "
            "a variable communication step size",
            where=where,
            fix="record or resample on even times, or export the FMU for variable steps",
        )


def _pointer_to(kept: list[Any], array: NDArray[Any]) -> int:
    """Return the address of an array, and keep it alive."""
    kept.append(array)
    return int(array.__array_interface__["data"][0])


class PreparedTasks:
    """Prepared tasks by task and names of parameters; the oldest go once their signals take too much memory."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all of them."""
        self._kept: dict[
            tuple[int, tuple[str, ...]], PreparedTask
        ] = {}  # they keep the tasks, and so the ids, alive
        self._size = 0

    def get(self, task: Task, names: tuple[str, ...]) -> PreparedTask | None:
        """Return the one for a task and the names of its parameters, if it is known."""
        return self._kept.get((id(task), names))

    def add(self, prepared: PreparedTask) -> None:
        """Remember another one."""
        self._kept[id(prepared.asked), prepared.names] = prepared
        self._size += prepared.size
        while self._size > _MAX_PREPARED and len(self._kept) > 1:
            self._size -= self._kept.pop(next(iter(self._kept))).size
