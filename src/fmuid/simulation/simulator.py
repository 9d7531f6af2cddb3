"""The interface of a model: parameters and a task go in, predictions come out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from fmuid.core.campaign import Interface, Interpolation
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


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
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
        rows. Only for simulators for which `Simulator.differentiates` is true.
    linear
        Inputs that are interpolated although the others are held, where `Simulator.interpolates_inputs` is true.
    band_limited
        The same for inputs that are band-limited.
    every, first
        Communication points from one sample of the prediction to the next, and the point of the first sample.
    shared
        The group of tasks that this one belongs to, and a sample: those of a group whose inputs are the same up to
        a sample may be simulated up to there together. None if it belongs to none.
    after
        Outputs that are read after the inputs of their sample act; the others are read before. The outputs differ
        if they depend on an input without delay.
    read_after
        Time from the inputs of a sample to the reading of its outputs, s, less than the step; 0 for none.
    driven
        Inputs that move along the directions too, by (directions, N) samples, which are held or interpolated as
        the inputs are. Only for simulators for which `Simulator.moves_inputs` is true.
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
    first: int = 0
    read_after: float = 0.0
    driven: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", read_only(self.time))
        object.__setattr__(self, "inputs", frozen_mapping({k: read_only(v) for k, v in self.inputs.items()}))
        object.__setattr__(self, "start_values", frozen_mapping(self.start_values))
        object.__setattr__(self, "along", tuple(frozen_mapping(d) for d in self.along))
        object.__setattr__(self, "driven", frozen_mapping({k: read_only(v) for k, v in self.driven.items()}))

    def sampled(self, values: FloatArray) -> FloatArray:
        """Return those of (..., points) values at the communication points that belong to the task's samples."""
        return values if self.every == 1 else values[..., self.first :: self.every]

    def with_names(self, names: Mapping[str, str]) -> Task:
        """Return the task for a model that has other names for some of its variables."""

        def renamed(known: Iterable[str]) -> tuple[str, ...]:
            return tuple(names.get(name, name) for name in known)

        return replace(
            self,
            inputs=dict(zip(renamed(self.inputs), self.inputs.values(), strict=True)),
            outputs=renamed(self.outputs),
            start_values=dict(zip(renamed(self.start_values), self.start_values.values(), strict=True)),
            linear=renamed(self.linear),
            after=renamed(self.after),
            band_limited=renamed(self.band_limited),
        )


class EndedError(SimulationError):
    """The model ended its simulation before the last time; `predictions` (outputs, n) are those up to then."""

    def __init__(
        self, what: str, *, where: object = None, fix: str | None = None, predictions: FloatArray
    ) -> None:
        self.predictions = predictions
        super().__init__(what, where=where, fix=fix)

    def __reduce__(self) -> tuple[object, ...]:
        return partial(type(self), where=self.where, fix=self.fix, predictions=self.predictions), (self.what,)


class Simulator(ABC):
    """A model that can be simulated: an FMU, a reference model or an analytic one.

    A subclass has `variables` and `simulate`, and replaces the defaults of what it can do in addition.

    Outputs at ``time[0]`` are those after initialisation with the first input sample; outputs at
    ``time[k+1]`` are those at the end of the step from ``time[k]``, before input sample k+1 is set, or after it
    for those in `Task.after`.
    """

    @property
    @abstractmethod
    def variables(self) -> Mapping[str, Variable]:
        """Every variable by name."""

    @abstractmethod
    def simulate(self, task: Task, parameters: Mapping[str, float]) -> FloatArray:
        """Return predictions, shape (len(task.outputs), N), at its samples only.

        Raises
        ------
        SimulationError
            The run failed; there is no prediction for these parameters.
        """

    @property
    def token(self) -> str:
        """Identity of the model for fingerprints."""
        return type(self).__qualname__

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the model was loaded from, if any."""
        return ()

    @property
    def interface(self) -> Interface | None:
        """How an FMU is simulated; None if the model is no FMU."""
        return None

    @property
    def needed_tool(self) -> str | None:
        """The tool that must be installed to simulate the model, None if it needs none."""
        return None

    @property
    def default_tolerance(self) -> float | None:
        """Relative tolerance for tasks that name none, None if there is no default."""
        return None

    @property
    def even_steps(self) -> bool:
        """Whether further communication points change the model, and not only the accuracy of predictions."""
        return False

    @property
    def interpolates_inputs(self) -> bool:
        """Whether some inputs are interpolated while others are held (see `Task.linear`)."""
        return False

    @property
    def states(self) -> tuple[str, ...]:
        """The continuous states by name, if a run can start from values of them."""
        return ()

    @property
    def unsettable(self) -> frozenset[str]:
        """The states that cannot be started from a given value."""
        return frozenset()

    @property
    def segments(self) -> int:
        """Number of segments that a run is cut into, 0 if it is simulated as a whole."""
        return 0

    @property
    def nuisances(self) -> int:
        """Number of unknowns that a run is fitted with in addition to the parameters."""
        return 0

    @property
    def affinity(self) -> Hashable:
        """What one process should simulate, as it remembers what serves other runs of it; None if it does not."""
        return None

    def differentiates(self, names: Collection[str]) -> bool:
        """Return whether runs are differentiated exactly with respect to `names` (see `Task.along`)."""
        del names
        return False

    @property
    def moves_inputs(self) -> bool:
        """Whether inputs can move along directions in runs that are differentiated (see `Task.driven`)."""
        return False


class Wrapped(Simulator):
    """A simulator around another one, `simulator`."""

    simulator: Simulator

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Variables of the model."""
        return self.simulator.variables

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the model."""
        return self.simulator.files
