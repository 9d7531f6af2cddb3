"""The loop of stepper.c in Python: the same calls in the same order, where there is no C compiler."""

from __future__ import annotations

import ctypes
import time
from ctypes import CFUNCTYPE, byref, c_bool, c_double, c_int32, c_size_t, c_void_p
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from fmuid.simulators.model_exchange_python import Integrator
from fmuid.simulators.stepper import DTYPES, FUNCTIONS, Outcome, Plan

_PLACE = {name: i for i, name in enumerate(FUNCTIONS)}


class RunEndedError(Exception):
    """The run ends with this outcome."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__()
        self.outcome = outcome


def array_at(address: int | None, n: int, dtype: str = "f8") -> NDArray[Any]:
    """Return the array that begins at an address, without a copy."""
    if not n or not address:
        return np.empty(0, dtype)
    size = n * np.dtype(dtype).itemsize
    memory: Any = (ctypes.c_char * size).from_address(address)
    array: NDArray[Any] = np.frombuffer(memory, dtype)
    return array


class _Groups:
    """Variables that are set or read together, one call for each type."""

    def __init__(self, run: Run, groups: Any, n: int, place: str) -> None:
        self._run, self._place = run, place
        self._calls = []
        for g in groups[:n]:
            signature: list[Any] = [c_void_p, c_void_p, c_size_t, c_void_p]
            arguments = [run.plan.instance, g.references, g.n_references, g.buffer]
            if run.plan.fmi == 3:
                signature.append(c_size_t)
                arguments.append(g.n_values)
            columns, places = (array_at(a, g.n_columns, "i4") for a in (g.column, g.place))
            buffer = array_at(g.buffer, g.n_values, DTYPES[g.type])
            self._calls.append((CFUNCTYPE(c_int32, *signature)(g.function), arguments, columns, places, buffer))

    def set(self, row: NDArray[np.float64]) -> None:
        for function, arguments, columns, places, buffer in self._calls:
            buffer[places] = row[columns]
            self._run.check(self._place, function(*arguments))

    def get(self, row: NDArray[np.float64]) -> None:
        for function, arguments, columns, places, buffer in self._calls:
            self._run.check(self._place, function(*arguments))
            row[columns] = buffer[places]


class Run:
    """One simulation; `plan` holds its progress as it does in C."""

    Ended = RunEndedError

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        n = plan.n_times
        self.time = array_at(plan.time, n)
        self.inputs = array_at(plan.inputs, n * plan.n_inputs).reshape(n, -1)
        rows = plan.n_outputs * (1 + plan.n_directions)
        self.predictions = array_at(plan.outputs, rows * n).reshape(rows, n)
        self.integrator: Integrator | None = None
        self.row = np.empty(plan.n_outputs)
        self.set_starts = _Groups(self, plan.start_groups, plan.n_start_groups, "SET_VALUES")
        self.set_inputs = _Groups(self, plan.input_groups, plan.n_input_groups, "SET_VALUES")
        self.set_slopes = _Groups(self, plan.slope_groups, plan.n_slope_groups, "SET_VALUES")
        self.slope_columns = [int(j) for j in array_at(plan.slope_columns, plan.n_slopes, "i4")]
        self.get_outputs = _Groups(self, plan.output_groups, plan.n_output_groups, "GET_VALUES")

    def check(self, place: str, status: int) -> None:
        """End the run if the status is worse than a warning."""
        if status > 1:
            self.plan.call, self.plan.status = _PLACE[place], status
            self.end(Outcome.CALL_FAILED)

    def end(self, outcome: Outcome) -> NoReturn:
        """End the run with this outcome."""
        raise RunEndedError(outcome)

    def has(self, place: str) -> bool:
        """Whether the FMU has the function at `place`."""
        return bool(self.plan.function[_PLACE[place]])

    def call(self, place: str, *arguments: tuple[Any, Any]) -> int:
        """Call the function at `place` of the instance with (type, value) pairs; return its status."""
        signature = CFUNCTYPE(c_int32, c_void_p, *(kind for kind, _ in arguments))
        function = signature(self.plan.function[_PLACE[place]])
        return int(function(self.plan.instance, *(value for _, value in arguments)))

    def do(self, place: str, *arguments: tuple[Any, Any]) -> None:
        """Call, and end the run if that fails."""
        self.check(place, self.call(place, *arguments))

    def enter_initialisation(self) -> None:
        """Bring the FMU from where it is into initialisation, its start values set."""
        plan = self.plan
        plan.reached, plan.reached_time = -1, float(self.time[0])
        if plan.reset:
            self.do("RESET")
        flag = c_int32 if plan.fmi == 2 else c_bool
        experiment = [
            (flag, bool(plan.tolerance_defined)),
            (c_double, plan.tolerance),
            (c_double, float(self.time[0])),
            (flag, True),
            (c_double, plan.stop),
        ]
        if plan.fmi == 2:
            self.do("SETUP_EXPERIMENT", *experiment)
        if plan.n_directions:
            moved = [(c_void_p, plan.moved), (c_size_t, plan.n_moved)]
            self.do("SET_DIRECTIONS", *moved, (c_void_p, plan.weights), (c_size_t, plan.n_directions))
        self.set_starts.set(array_at(plan.starts, plan.n_starts))
        self.do("ENTER_INITIALIZATION", *(experiment if plan.fmi == 3 else []))

    def initialise(self) -> None:
        """Bring the FMU from where it is to initialised, with inputs of the first communication point."""
        self.enter_initialisation()
        self.set_inputs.set(self.inputs[0])
        self.do("EXIT_INITIALIZATION")

    def read(self, k: int) -> None:
        """Read the outputs of communication point k."""
        plan = self.plan
        self.get_outputs.get(self.row)
        for j, value in enumerate(self.row):
            self.predictions[j, k] = value
            if not np.isfinite(value):
                plan.column, plan.reached_time = j, float(self.time[k])
                raise RunEndedError(Outcome.NOT_FINITE)
        if plan.n_directions:
            self.read_sensitivities(k)
        plan.reached, plan.reached_time = k, float(self.time[k])

    def read_sensitivities(self, k: int) -> None:
        """Read the outputs' derivatives along the directions."""
        plan, n = self.plan, self.plan.n_outputs
        variables = [(c_void_p, plan.output_references), (c_size_t, n)]
        self.do("GET_SENSITIVITIES", *variables, (c_void_p, plan.sensitivities))
        values = array_at(plan.sensitivities, n * plan.n_directions).reshape(n, -1)
        self.predictions[n:, k] = values.T.ravel()
        if not np.isfinite(values).all():
            plan.column = int(np.argmin(np.isfinite(values).all(axis=1)))
            plan.reached_time = float(self.time[k])
            raise RunEndedError(Outcome.NOT_FINITE)

    def do_step(self, k: int) -> None:
        """Step a co-simulation FMU from communication point k to the next."""
        plan, t = self.plan, float(self.time[k])
        h = float(self.time[k + 1]) - t
        self.set_inputs.set(self.inputs[k])
        if plan.fmi == 2:
            if plan.n_slopes:
                u = self.inputs[:, self.slope_columns]
                array_at(plan.slopes, plan.n_slopes)[:] = (u[k + 1] - u[k]) / h
                self.do(
                    "SET_INPUT_DERIVATIVES",
                    (c_void_p, plan.slope_references),
                    (c_size_t, plan.n_slopes),
                    (c_void_p, plan.slope_orders),
                    (c_void_p, plan.slopes),
                )
            status = self.call("DO_STEP", (c_double, t), (c_double, h), (c_int32, not plan.rewinds))
            if status == 2 and self.has("GET_BOOLEAN_STATUS"):
                ended = c_int32()
                answer = self.call("GET_BOOLEAN_STATUS", (c_int32, 3), (c_void_p, ctypes.addressof(ended)))
                if answer <= 1 and ended.value:
                    raise RunEndedError(Outcome.TERMINATED)
            self.check("DO_STEP", status)
            return
        event, terminate, early, last = c_bool(), c_bool(), c_bool(), c_double(t)
        pointers = [(c_void_p, byref(p)) for p in (event, terminate, early, last)]
        self.do("DO_STEP", (c_double, t), (c_double, h), (c_bool, not plan.rewinds), *pointers)
        if terminate.value:
            raise RunEndedError(Outcome.TERMINATED)
        if early.value:
            plan.reached_time = last.value
            raise RunEndedError(Outcome.EARLY_RETURN)


_runs: dict[int, Run] = {}


def run(plan: Plan, resume: int, seconds: float) -> int:
    """Simulate, or go on where the last call paused; returns PAUSED after about `seconds`."""
    key = ctypes.addressof(plan)
    try:
        if resume:
            this = _runs.pop(key)
        else:
            this = Run(plan)
            this.initialise()
            if plan.model_exchange:
                this.integrator = Integrator(this)
            this.read(0)
        begun = time.monotonic()
        for k in range(plan.reached, plan.n_times - 1):
            if this.integrator is not None:
                this.integrator.integrate(k)
            else:
                this.do_step(k)
            this.read(k + 1)
            if time.monotonic() - begun > seconds and k + 2 < plan.n_times:
                _runs[key] = this
                return Outcome.PAUSED
        if this.has("TERMINATE"):
            this.call("TERMINATE")
    except RunEndedError as end:
        return end.outcome
    return Outcome.DONE
