"""A recorded run and the response of a model to it, for the choices of a first campaign."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from fmuid.core.campaign import Interpolation
from fmuid.core.errors import FmuidError, SimulationError
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.core.units import conversion
from fmuid.identification.solvers.trust_region import trust_region
from fmuid.init.known_values import guessed_bounds
from fmuid.simulation.runners import Runner, simulated
from fmuid.simulation.segmented import Length, Segmented
from fmuid.simulation.simulator import Simulator, Task, Variable

_STEP = 0.01  # relative change of a parameter for estimating its effect
_LEAST_FACTOR = 0.1  # to the start value, for ranges that include 0
_AT_BOUND = 0.02  # distance from a bound, in logarithms
_CONVERGED = 1e-2  # relative change of the squared error that ends a refit


class SeenRun:
    """A run, with the model's response at the start values; outputs are divided by their ranges.

    Parameters
    ----------
    values
        Values of parameters instead of their start values.
    scale
        Ranges of the outputs; those of the response by default.
    """

    def __init__(
        self,
        model: Simulator,
        task: Task,
        measured: FloatArray,
        runner: Runner,
        *,
        values: Mapping[str, float] | None = None,
        scale: FloatArray | None = None,
    ) -> None:
        self._model, self._task, self._measured, self._runner = model, task, measured, runner
        self._values = values or {}
        self.nominal = simulated(runner, model, task, self._values)
        spans = np.maximum(np.ptp(self.nominal, axis=1, keepdims=True), 1e-12)
        self.scale = spans if scale is None else scale

    def at_bound(self, parameter: Variable) -> bool:
        """Return whether a parameter has reached its guessed bounds, which are wide enough for most."""
        ratio = self._value(parameter) / (parameter.start or 1.0)
        low, high = _reach(parameter)
        return not low + _AT_BOUND < np.log(max(ratio, 1e-300)) < high - _AT_BOUND

    @property
    def outputs(self) -> tuple[str, ...]:
        """The measured outputs of the model."""
        return self._task.outputs

    @property
    def inputs(self) -> Mapping[str, FloatArray]:
        """(N,) samples of the inputs by the model's variables."""
        return self._task.inputs

    @property
    def measured(self) -> FloatArray:
        """(outputs, N) measurements in the model's units, NaN where there is none."""
        return self._measured

    @property
    def time(self) -> FloatArray:
        """(N,) times of the samples, s."""
        return self._task.time

    @property
    def response(self) -> FloatArray:
        """(outputs, N) response of the model, relative to the ranges."""
        return np.asarray(self.nominal / self.scale)

    def timed(self, interpolation: Interpolation, after: tuple[str, ...] = (), read_after: float = 0.0) -> SeenRun:
        """Return the same run with another timing of its signals, relative to the same ranges."""
        timing: dict[str, Any] = {"linear": (), "band_limited": (), "after": after, "read_after": read_after}
        task = replace(self._task, interpolation=interpolation, **timing)
        return SeenRun(self._model, task, self._measured, self._runner, values=self._values, scale=self.scale)

    def a_row_later(self) -> SeenRun:
        """Return the same run if each row's outputs are those at the time of the next one."""
        measured = np.full_like(self._measured, np.nan)
        measured[:, 1:] = self._measured[:, :-1]
        return SeenRun(self._model, self._task, measured, self._runner, values=self._values, scale=self.scale)

    def _at(self, values: Mapping[str, float]) -> SeenRun:
        """Return the same run with these values of parameters, relative to the same ranges."""
        return SeenRun(self._model, self._task, self._measured, self._runner, values=values, scale=self.scale)

    def _value(self, parameter: Variable) -> float:
        return self._values.get(parameter.name, parameter.start or 0.0)

    def effects(
        self, parameters: Sequence[Variable], tell: Callable[[], object] | None = None
    ) -> dict[str, FloatArray]:
        """Return the (outputs, N) change of the outputs with each parameter's relative change.

        Redundant parameters look alike as far as derivatives are exact, which differences are not. Structural and
        otherwise delicate parameters, with which the model cannot be simulated, are left out. `tell` is called for
        every parameter.
        """
        exact = [v for v in parameters if self._model.differentiates([v.name])]
        effects: dict[str, FloatArray] = {}
        if exact:
            along = tuple({v.name: self._value(v)} for v in exact)
            with suppress(SimulationError):
                rows = simulated(self._runner, self._model, replace(self._task, along=along), self._values)
                slopes = np.split(rows, len(exact) + 1)[1:]
                effects = {v.name: slope / self.scale for v, slope in zip(exact, slopes, strict=True)}
        for parameter in parameters:
            if tell is not None:
                tell()
            if parameter.name not in effects:
                with suppress(FmuidError):
                    effects[parameter.name] = self._difference(parameter)
        return effects

    def _difference(self, parameter: Variable) -> FloatArray:
        value = self._value(parameter)
        above, below = (
            simulated(self._runner, self._model, self._task, {**self._values, parameter.name: value * factor})
            for factor in (1 + _STEP, 1 - _STEP)
        )
        return np.asarray((above - below) / self.scale / (2 * _STEP))

    def refitted(self, free: Sequence[Variable]) -> SeenRun:
        """Return the run where these parameters explain it best, each within its guessed bounds."""
        start = np.zeros(len(free))
        low, high = np.array([_reach(v) for v in free]).reshape(-1, 2).T
        known, tried = np.isfinite(self._measured), dict[bytes, SeenRun | None]({start.tobytes(): self})

        def at(x: FloatArray) -> SeenRun | None:
            if x.tobytes() not in tried:
                values = {v.name: self._value(v) * np.exp(step) for v, step in zip(free, x, strict=True)}
                try:
                    tried[x.tobytes()] = self._at({**self._values, **values})
                except SimulationError:
                    tried[x.tobytes()] = None
            return tried[x.tobytes()]

        def residuals(x: FloatArray) -> FloatArray:
            one = at(x)
            return np.full(int(known.sum()), np.nan) if one is None else one.errors[known]

        def jacobian(x: FloatArray) -> FloatArray:
            return -(at(x) or self)._columns(free)

        trust_region(residuals, jacobian, start, low, high, cost_tolerance=_CONVERGED, step_tolerance=1e-4)
        return min((one for one in tried.values() if one is not None), key=lambda one: one.left)

    def towards(self, other: SeenRun, free: Sequence[Variable], *, order: int = 0) -> tuple[float, float]:
        """Return the product of the error with the way to another simulation, and the square of that way.

        Of both, only what the parameters cannot imitate counts; the quotient is how far along that way the run is.
        With `order` 1, both are changes from sample to sample, in which slow errors hardly show.
        """
        errors, columns = np.diff(self.errors, order, axis=1), self._columns(free, order)
        known = np.isfinite(errors)
        way = np.diff((other.nominal - self.nominal) / self.scale, order, axis=1)[known]
        way -= columns @ np.linalg.lstsq(columns, way, rcond=None)[0]
        return float(way @ errors[known]), float(way @ way)

    def _columns(self, free: Sequence[Variable], order: int = 0) -> FloatArray:
        """Return the changes of the measured samples with each parameter's relative change: 0 where unknown."""
        known, effects = np.isfinite(np.diff(self._measured, order, axis=1)), self.effects(free)
        every = [np.diff(effects.get(v.name, np.zeros_like(self.nominal)), order, axis=1) for v in free]
        return np.stack([rows[known] for rows in every], axis=1)

    @property
    def left(self) -> float:
        """Squared error."""
        return float(np.nansum(self.errors**2))

    @property
    def errors(self) -> FloatArray:
        """(outputs, N) errors, relative to the ranges; NaN where nothing was measured."""
        return np.asarray((self._measured - self.nominal) / self.scale)


def _reach(parameter: Variable) -> tuple[float, float]:
    """Return the logarithms of the smallest and the largest factor to a parameter's start value."""
    low, high = sorted(bound / (parameter.start or 1.0) for bound in guessed_bounds(parameter))
    return min(float(np.log(max(low, _LEAST_FACTOR))), -1e-9), max(float(np.log(max(high, 1.0))), 1e-9)


def ports_of(
    model: Simulator, run: Experiment, mapping: Mapping[str, str]
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return the (N,) inputs and measured outputs of a run by the model's variables, in their units."""
    ports: tuple[dict[str, FloatArray], dict[str, FloatArray]] = {}, {}
    for name, signal in run.signals.items():
        port = model.variables[mapping.get(name, name)]
        ports[signal.causality == "output"][port.name] = conversion(signal.unit, port.unit)(signal.values)
    return ports


def seen_run(
    model: Simulator,
    run: Experiment,
    mapping: Mapping[str, str],
    runner: Runner,
    *,
    segments: Length | None = None,
) -> SeenRun:
    """Return a run with the response of a model at its start values, in segments if their length is given."""
    inputs, measured = ports_of(model, run, mapping)
    if segments is not None:
        model = in_segments(model, run, mapping, segments)
    return SeenRun(model, Task(run.time, inputs, tuple(measured)), np.array(list(measured.values())), runner)


def in_segments(
    model: Simulator, run: Experiment, mapping: Mapping[str, str], length: Length = "auto"
) -> Segmented:
    """Return a model that is restarted along a run, in segments that suit it.

    Raises
    ------
    ProblemError
        The states of the model cannot be set.
    """
    inputs, measured = ports_of(model, run, mapping)
    values = np.array(list(measured.values()))
    known = np.isfinite(values).astype(np.float64)
    return Segmented(model, Task(run.time, inputs, tuple(measured)), length, target=values, weight=known, at={})
