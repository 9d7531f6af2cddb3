"""A model in pure Python behind the interface of a loaded FMU."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import numpy as np
from scipy.integrate import solve_ivp

from fmuid.core.errors import FmuError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.simulation.simulator import Simulator, Task, Variable

Values = Mapping[str, float]


class Instance(Protocol):
    """The equations of a model with the values of its parameters."""

    def start(self) -> Sequence[float]:
        """Return the start values of the states."""
        ...

    def derivatives(self, x: Sequence[float], u: Sequence[float]) -> Sequence[float]:
        """Return the time derivatives of the states `x` under the inputs `u`."""
        ...

    def values(self, x: Sequence[float], u: Sequence[float]) -> dict[str, float]:
        """Return outputs and local variables by name."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """A model: its variables, the size of an error that matters in each state, and how to instantiate it."""

    name: str
    variables: tuple[Variable, ...]
    state_scale: tuple[float, ...]
    instantiate: Callable[[Values], Instance]


def parameter(name: str, start: float, unit: str | None = None, minimum: float | None = None) -> Variable:
    """Return the declaration of a parameter."""
    return Variable(name, "parameter", "fixed", unit, start, minimum)


def input_variable(name: str, unit: str) -> Variable:
    """Return the declaration of an input that starts at zero."""
    return Variable(name, "input", "continuous", unit, 0.0)


def computed(name: str, unit: str, causality: str = "output") -> Variable:
    """Return the declaration of an output or a local variable."""
    return Variable(name, causality, "continuous", unit)


class ReferenceFmu(Simulator):
    """A reference model with names, units, start values and causality of an FMU; it is a `Simulator`.

    ``set`` start values, then ``step`` and ``get``: the first of these two ends initialisation. Inputs are
    held over a step. ``reset`` goes back to the start values of the model.

    Parameters
    ----------
    equations
        The model.
    tolerance
        Relative tolerance; absolute ones are `tolerance` times the scale of each state.
    method
        Method of ``scipy.integrate.solve_ivp``.
    """

    def __init__(self, equations: Equations, *, tolerance: float = 1e-8, method: str = "LSODA") -> None:
        self.name = equations.name
        self._equations = equations
        self._tolerance = tolerance
        self._method = method
        self._variables = MappingProxyType({v.name: v for v in equations.variables})
        self._inputs = tuple(v.name for v in equations.variables if v.causality == "input")
        self.reset()

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Every variable by name."""
        return self._variables

    @property
    def time(self) -> float:
        """Present time in s."""
        return self._time

    def reset(self) -> None:
        """Go back to time 0 and to the start values of the model."""
        self._time = 0.0
        self._set = {v.name: v.start for v in self._variables.values() if v.start is not None}
        self._instance: Instance | None = None
        self._state: Sequence[float] = ()

    def set(self, name: str, value: float) -> None:
        """Set an input, or a parameter before the first ``step`` or ``get``.

        Raises
        ------
        FmuError
            The variable does not exist, cannot be set (any more), or the value is not finite.
        """
        variable = self._variable(name)
        if variable.causality not in ("input", "parameter"):
            raise FmuError(
                f"'{name}' is of causality {variable.causality}",
                where=self.name,
                fix="set inputs or parameters",
            )
        if variable.causality == "parameter" and self._instance is not None:
            raise FmuError(f"parameter '{name}' set after initialisation", where=self.name, fix="call reset first")
        if not np.isfinite(value):
            raise FmuError(f"'{name}' set to {value}", where=self.name, fix="give a finite value")
        self._set[name] = float(value)

    def get(self, name: str) -> float:
        """Return the present value of a variable; of anything computed this ends initialisation."""
        if self._variable(name).causality in ("input", "parameter"):
            return self._set[name]
        instance = self._initialised()
        return instance.values(self._state, self._input_values())[name]

    def step(self, step_size: float) -> None:
        """Advance by `step_size` s with the inputs held.

        Raises
        ------
        SimulationError
            The integrator could not reach the end of the step.
        """
        instance = self._initialised()
        stop = self._time + step_size
        u = self._input_values()
        x = self._integrate(instance, self._state, lambda _: u, np.array([self._time, stop]))
        self._state, self._time = x[:, -1].tolist(), stop

    def simulate(self, task: Task, parameters: Values) -> FloatArray:
        """Return predictions, shape (len(task.outputs), N); see `fmuid.simulation.simulator.Simulator`."""
        self.reset()
        for name, value in {**task.start_values, **parameters}.items():
            self.set(name, value)
        for name in task.inputs:
            if self._variable(name).causality != "input":
                raise FmuError(f"'{name}' is no input", where=self.name)
        for name in task.outputs:
            self._variable(name)
        time = task.time
        count = len(time)
        u = np.array([task.inputs.get(name, np.full(count, self._set[name])) for name in self._inputs])
        u = u.reshape(len(self._inputs), count)
        for name, first in zip(self._inputs, u[:, 0], strict=True):
            self.set(name, first)
        instance = self._initialised()
        known = self._set
        predictions = np.empty((len(task.outputs), count))

        def record(k: int, x: Sequence[float], held: Sequence[float]) -> None:
            values = instance.values(x, held)
            at_hand = dict(zip(self._inputs, held, strict=True))
            predictions[:, k] = [values[n] if n in values else at_hand.get(n, known.get(n)) for n in task.outputs]

        record(0, self._state, u[:, 0].tolist())
        for first, last in _segments(u, task.interpolation):
            drive = _driver(u, time, first, last, task.interpolation)
            x = self._integrate(instance, self._state, drive, time[first : last + 1])
            for k in range(first + 1, last + 1):
                record(k, x[:, k - first].tolist(), drive(time[k]))
            self._state = x[:, -1].tolist()
        self._time = float(time[-1])
        return predictions

    def _variable(self, name: str) -> Variable:
        try:
            return self._variables[name]
        except KeyError:
            raise FmuError(f"no variable '{name}'", where=self.name) from None

    def _input_values(self) -> list[float]:
        return [self._set[name] for name in self._inputs]

    def _initialised(self) -> Instance:
        if self._instance is None:
            self._instance = self._equations.instantiate(self._set)
            self._state = list(self._instance.start())
        return self._instance

    def _integrate(
        self,
        instance: Instance,
        x: Sequence[float],
        drive: Callable[[float], Sequence[float]],
        time: FloatArray,
    ) -> FloatArray:
        """Return the states at `time`, shape (n_states, len(time)), from `x` at its beginning."""
        derivatives = instance.derivatives
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lsoda warns before it reports the failure that is raised below
            result = solve_ivp(
                lambda t, state: derivatives(state.tolist(), drive(t)),
                (time[0], time[-1]),
                x,
                method=self._method,
                t_eval=time,
                rtol=self._tolerance,
                atol=self._tolerance * np.asarray(self._equations.state_scale),
            )
        if not result.success or not np.all(np.isfinite(result.y)):
            raise SimulationError(
                f"integration failed after t = {result.t[-1]:g} s: {result.message}", where=self.name
            )
        states: FloatArray = result.y
        return states


def _driver(
    u: FloatArray, time: FloatArray, first: int, last: int, interpolation: str
) -> Callable[[float], list[float]]:
    """Return the inputs as a function of time on the segment [first, last]."""
    start = u[:, first]
    if interpolation == "hold":
        held: list[float] = start.tolist()
        return lambda _: held
    origin = time[first]
    slope = (u[:, last] - start) / (time[last] - origin)

    def ramp(t: float) -> list[float]:
        values: list[float] = (start + slope * (t - origin)).tolist()
        return values

    return ramp


def _segments(u: FloatArray, interpolation: str) -> list[tuple[int, int]]:
    """Return index ranges [first, last] over which the inputs have no kink or jump."""
    count = u.shape[1]
    change = np.any(np.diff(u, axis=1) != 0.0, axis=0) if len(u) else np.zeros(count - 1, dtype=bool)
    kink = change[:-1] | change[1:] if interpolation == "linear" else change[:-1]
    begins = [0, *(np.flatnonzero(kink) + 1).tolist()]
    return list(zip(begins, [*begins[1:], count - 1], strict=True)) if count > 1 else []
