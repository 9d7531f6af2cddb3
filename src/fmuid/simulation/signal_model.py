"""A model with signal effects (scale, offset, delay, limits) as parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any

from fmu_build.suggest import suggestion
from fmuid.core.campaign import Interface
from fmuid.core.errors import FmuError
from fmuid.core.immutable import FloatArray
from fmuid.simulation.signal_effects import (
    NEUTRAL,
    Disturbed,
    disturbed_readings,
    disturbed_task,
    effects_on_simulation,
    signal_and_property,
)
from fmuid.simulation.simulator import Simulator, Task, Variable, Wrapped

_UNITS = {
    "gain": "1", "hardness": "1", "lag": "s", "delay": "s", "lag_split": "1", "drift_settling": "1/s",
    "dead_zone_skew": "1",
}  # fmt: skip
_IN_UNIT = ("offset", "saturation", "dead_zone", "play")  # values in the signal's unit
_POSED = 64  # tasks with effects that are remembered: those of every run, while parameters of the model move
COMMUTE = ("gain", "lag", "lag_split", "delay")  # effects that commute with differentiating the signal


class SignalModel(Wrapped):
    """A model with effects on its inputs and outputs.

    Parameters
    ----------
    simulator
        The model.
    names
        Effects that become parameters: ``variable.property`` of an input or output; see `signal_effects`.
    differentiated
        Outputs that will be differentiated.

    Raises
    ------
    FmuError
        A name is not a property of an input or output of the model.
    """

    def __init__(
        self, simulator: Simulator, names: tuple[str, ...], differentiated: Collection[str] = frozenset()
    ) -> None:
        self.simulator, self._names, self._differentiated = simulator, names, frozenset(differentiated)
        self._inputs = tuple((n, v) for n, v in simulator.variables.items() if v.causality == "input")
        file = next(iter(simulator.files), None)
        self._of: dict[str, tuple[str, str]] = {}
        added = {}
        for name in names:
            signal, prop = signal_and_property(name) or (name.rpartition(".")[0], "")
            variable = simulator.variables.get(signal)
            if not prop or variable is None or variable.causality not in ("input", "output"):
                known = [n for n, v in simulator.variables.items() if v.causality in ("input", "output")]
                asked = name.rpartition(".")[2]
                fix = suggestion(asked, NEUTRAL) if signal in known else suggestion(signal, known)
                raise FmuError(f"'{name}' is not an effect of an input or output", where=file, fix=fix)
            if signal in self._differentiated and prop not in COMMUTE:
                fix = "differentiate it in the model instead"
                raise FmuError(f"'{signal}' is differentiated after its {prop}", where=file, fix=fix)
            self._of[name] = signal, prop
            unit = variable.unit if prop in _IN_UNIT else _UNITS.get(prop)
            added[name] = Variable(name, "parameter", "fixed", unit, NEUTRAL.get(prop, 0.0))
        self._variables = MappingProxyType({**simulator.variables, **added})

    def __reduce__(self) -> tuple[Any, ...]:
        return SignalModel, (self.simulator, self._names, self._differentiated)

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Variables of the model, and the effects on its signals."""
        return self._variables

    @property
    def states(self) -> tuple[str, ...]:
        """Continuous states of the model."""
        return self.simulator.states

    @property
    def unsettable(self) -> frozenset[str]:
        """States of the model that cannot be set."""
        return self.simulator.unsettable

    @property
    def interface(self) -> Interface | None:
        """How the model's FMU is simulated."""
        return self.simulator.interface

    @property
    def token(self) -> str:
        """Identity of the model for fingerprints: the inner model's token and the effects on its signals."""
        return f"{self.simulator.token} {self._names} {sorted(self._differentiated)}"

    @property
    def default_tolerance(self) -> float | None:
        """Relative solver tolerance for tasks that name none."""
        return self.simulator.default_tolerance

    @property
    def even_steps(self) -> bool:
        """Whether the model takes communication steps of one size only."""
        return self.simulator.even_steps

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return predictions, shape (len(task.outputs), N); see `fmuid.simulation.simulator.Simulator`."""
        effects: dict[str, dict[str, float]] = {}
        for name, value in {**task.start_values, **parameters}.items():
            if name in self._of and value != self._variables[name].start:
                signal, prop = self._of[name]
                effects.setdefault(signal, {})[prop] = value
        plain = {name: value for name, value in parameters.items() if name not in self._of}
        if task.start_values.keys() & self._of.keys():
            starts = {name: value for name, value in task.start_values.items() if name not in self._of}
            task = replace(task, start_values=starts)
        if not effects:
            return self.simulator.simulate(task, plain)
        acting = effects_on_simulation(effects, task.inputs, task.outputs)
        if acting:
            of_signals = tuple((name, tuple(of_one.items())) for name, of_one in acting.items())
            disturbed, posed = _posed(task, of_signals, self.simulator.even_steps, self._inputs)
            late = [name in self._differentiated for name in task.outputs]
            shown = disturbed.readings(self.simulator.simulate(posed, plain), late)
        else:
            shown = self.simulator.simulate(task, plain)
        inputs = {name: task.sampled(u) for name, u in task.inputs.items()}
        return disturbed_readings(shown, task.outputs, effects, task.sampled(task.time), inputs)


@lru_cache(maxsize=_POSED)
def _posed(
    task: Task,
    effects: tuple[tuple[str, tuple[tuple[str, float], ...]], ...],
    even_steps: bool,
    inputs: tuple[tuple[str, Variable], ...],
) -> tuple[Disturbed, Task]:
    """Return a task with effects applied, the same object as the last time: simulators prepare each task once."""
    of_signals = {name: dict(of_one) for name, of_one in effects}
    disturbed = disturbed_task(
        task, of_signals, task.outputs, {}, any_times=not even_steps, variables=dict(inputs)
    )
    return disturbed, disturbed.task()
