"""The interface of a model: parameters and a task go in, predictions come out."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol, runtime_checkable

from fmuid.core.campaign import Interpolation
from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only


@dataclass(frozen=True, slots=True)
class Variable:
    """A scalar variable of a model, in FMI's terms.

    Parameters
    ----------
    name, description
        As in the model description.
    causality, variability
        For example ``parameter``, ``input``, ``output``, ``local``; ``fixed``, ``tunable``, ``continuous``.
    unit
        Unit, None if not stated.
    start, min, max
        Start value and bounds, None if not stated.
    type
        ``Real``, ``Integer``, ``Boolean``, ``Float64`` and so on.
    """

    name: str
    causality: str
    variability: str = "continuous"
    unit: str | None = None
    start: float | None = None
    min: float | None = None
    max: float | None = None
    description: str = ""
    type: str = "Real"


@dataclass(frozen=True, slots=True, eq=False)
class Feedback:
    """An observer: at every sample the states move by `gain` times the output errors.

    Parameters
    ----------
    measured
        (outputs, N) samples, NaN where missing.
    gain
        (states, outputs), states in the FMU's order.
    """

    measured: FloatArray
    gain: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """One simulation to be run many times with different parameters.

    Parameters
    ----------
    time
        (N,) communication points in s, strictly increasing.
    inputs
        FMU variable name -> (N,) samples.
    outputs
        FMU variable names to record.
    start_values
        Values set before initialisation in every run (settings, initial states).
    interpolation
        ``hold``: input sample k acts on [t_k, t_{k+1}); ``linear``: between the samples; ``band-limited``: their
        interpolation by a sinc, for inputs with an anti-aliasing filter, at even times.
    tolerance
        Relative tolerance passed to the FMU, or None for its default.
    along
        Directions along which to differentiate, each a weight by parameter. The prediction then also contains the
        derivatives of the outputs, direction by direction, below the outputs, so (1 + len(along)) * len(outputs)
        rows. Only for simulators for which `differentiates` is true.
    linear
        Inputs that are interpolated although the others are held, for simulators for which `interpolates` is true.
    band_limited
        The same for inputs that are band-limited.
    every
        Communication points from one sample of the prediction to the next.
    shared
        The group of tasks that this one belongs to, and a sample: those of a group whose inputs are the same up to
        a sample may be simulated up to there together. None if it belongs to none.
    after
        Outputs that are read after the inputs of their sample act; the others are read before. The outputs differ
        if they depend on an input without delay.
    feedback
        Output feedback, for FMUs with model exchange: outputs are then predictions from the preceding samples.
    """

    time: FloatArray
    inputs: Mapping[str, FloatArray]
    outputs: tuple[str, ...]
    start_values: Mapping[str, float] = field(default_factory=dict)
    interpolation: Interpolation = "hold"
    tolerance: float | None = None
    along: tuple[Mapping[str, float], ...] = ()
    feedback: Feedback | None = None
    linear: tuple[str, ...] = ()
    shared: tuple[int, int] | None = None
    after: tuple[str, ...] = ()
    band_limited: tuple[str, ...] = ()
    every: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", read_only(self.time))
        object.__setattr__(self, "inputs", frozen_mapping({k: read_only(v) for k, v in self.inputs.items()}))
        object.__setattr__(self, "start_values", frozen_mapping(self.start_values))
        object.__setattr__(self, "along", tuple(frozen_mapping(d) for d in self.along))


class EndedError(SimulationError):
    """The model ended its simulation before the last time; `predictions` (outputs, n) are those up to then."""

    def __init__(
        self, what: str, *, where: object = None, fix: str | None = None, predictions: FloatArray
    ) -> None:
        self.predictions = predictions
        super().__init__(what, where=where, fix=fix)

    def __reduce__(self) -> tuple[object, ...]:
        return partial(type(self), where=self.where, fix=self.fix, predictions=self.predictions), (self.what,)


@runtime_checkable
class Simulator(Protocol):
    """A model that can be simulated: an FMU, a reference model or an analytic one.

    Outputs at ``time[0]`` are those after initialisation with the first input sample; outputs at
    ``time[k+1]`` are those at the end of the step from ``time[k]``, before input sample k+1 is set, or after it
    for those in `Task.after`.
    """

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Every variable by name."""
        ...

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return predictions, shape (len(task.outputs), N), with `Task.every` at every so many points only.

        Raises
        ------
        SimulationError
            The run failed; there is no prediction for these parameters.
        """
        ...


def default_tolerance(simulator: Simulator) -> float | None:
    """Return a simulator's relative tolerance for tasks that name none, None if it has no default."""
    tolerance = getattr(simulator, "default_tolerance", None)
    return None if tolerance is None else float(tolerance)


def differentiates(simulator: Simulator, names: Collection[str]) -> bool:
    """Return whether a simulator differentiates its runs exactly with respect to `names` (see `Task.along`)."""
    method = getattr(simulator, "differentiates", None)
    return method is not None and bool(method(names))


def interpolates(simulator: Simulator) -> bool:
    """Return whether a simulator interpolates some of its inputs while it holds others (see `Task.linear`)."""
    return bool(getattr(simulator, "interpolates_inputs", False))


def takes_any_times(simulator: Simulator) -> bool:
    """Return whether additional communication points only affect the accuracy of predictions."""
    return not getattr(simulator, "even_steps", False)


def needed_tool(simulator: Simulator) -> str | None:
    """Return the tool that must be installed to simulate a model, None if it needs none."""
    tool = getattr(simulator, "needed_tool", None)
    return None if tool is None else str(tool)
