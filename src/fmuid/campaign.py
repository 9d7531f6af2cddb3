"""What a campaign is: experiments, models, parameters, stages. Values only; files are read elsewhere."""

from __future__ import annotations

import copyreg
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmuid.errors import MeasurementsError
from fmuid.shown import html_table, text_table

if TYPE_CHECKING:
    from fmuid.coupled.structure import Coupling

FloatArray = NDArray[np.float64]
Causality = Literal["input", "output"]
Interpolation = Literal["hold", "linear"]
Sampling = Literal["hold", "linear", "preceding"]
Interface = Literal["co-simulation", "model exchange"]


def read_only(values: ArrayLike) -> FloatArray:
    """Return an own, C-ordered float64 copy of `values` that cannot be written to."""
    array = np.array(values, dtype=np.float64, order="C", copy=True)
    array.flags.writeable = False
    return array


def frozen_mapping(mapping: Mapping[str, Any]) -> MappingProxyType[str, Any]:
    """Return a read-only copy of `mapping`, in its order."""
    return MappingProxyType(dict(mapping))


# Tasks travel to other processes, and the standard library cannot pickle read-only mappings by itself.
copyreg.pickle(MappingProxyType, lambda mapping: (frozen_mapping, (dict(mapping),)))


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """One recorded signal.

    Parameters
    ----------
    name
        Measured name, such as ``tau_sensor``.
    values
        (N,) samples; NaN marks a missing output sample.
    unit
        Unit as written in the file, such as ``N.m``.
    causality
        ``input`` drives the model, ``output`` is compared with it.
    sigma
        Standard deviation of the measurement noise in `unit`, if known.
    resampled
        From which time base the samples were brought onto the run's, and how; empty if they are as recorded.
    """

    name: str
    values: FloatArray
    unit: str
    causality: Causality
    sigma: float | None = None
    resampled: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", read_only(self.values))


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """One recorded run.

    Parameters
    ----------
    id
        Its name in the measurement file.
    setup
        What it was made with; says which model stands for it.
    time
        (N,) in s, strictly increasing.
    signals
        Inputs and outputs by name, (N,) each.
    settings, setting_units
        Known values that the run sets on the model, by name, and their units (the model's where none is stated).
    repeat_of
        Id of the first run with the same inputs, settings and times; None for a run of its own.
    description
        For reports.
    """

    id: str
    setup: str
    time: FloatArray
    signals: Mapping[str, Signal]
    settings: Mapping[str, float] = field(default_factory=dict)
    setting_units: Mapping[str, str] = field(default_factory=dict)
    repeat_of: str | None = None
    description: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", read_only(self.time))
        for name in ("signals", "settings", "setting_units"):
            object.__setattr__(self, name, frozen_mapping(getattr(self, name)))

    @property
    def inputs(self) -> Mapping[str, Signal]:
        """The signals that drive the model, by measured name."""
        return {name: s for name, s in self.signals.items() if s.causality == "input"}

    @property
    def outputs(self) -> Mapping[str, Signal]:
        """The signals that are compared with predictions, by measured name."""
        return {name: s for name, s in self.signals.items() if s.causality == "output"}

    @property
    def origin(self) -> str:
        """Id of the run this one repeats, or its own."""
        return self.repeat_of or self.id


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """The experiments of one measurement file; prints as a table.

    Parameters
    ----------
    experiments
        By id, in the file's order.
    title, rig, source, licence
        Of the recording, as free text.
    """

    experiments: Mapping[str, Experiment]
    title: str = ""
    rig: str = ""
    source: str = ""
    licence: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "experiments", frozen_mapping(self.experiments))

    def __getitem__(self, experiment_id: str) -> Experiment:
        try:
            return self.experiments[experiment_id]
        except KeyError:
            known = ", ".join(self.experiments) or "none"
            raise MeasurementsError(f"no experiment '{experiment_id}'", fix=f"the file has: {known}") from None

    def __iter__(self) -> Iterator[Experiment]:
        return iter(self.experiments.values())

    def __len__(self) -> int:
        return len(self.experiments)

    def __str__(self) -> str:
        """Return the runs as a table."""
        return text_table(self._rows())

    def _repr_html_(self) -> str:
        return html_table(self._rows())

    def _rows(self) -> list[list[str]]:
        header = ["experiment", "setup", "samples", "end", "inputs", "outputs", "repeat of"]
        return [
            header,
            *(
                [
                    e.id,
                    e.setup,
                    str(e.time.size),
                    f"{e.time[-1]:.6g} s",
                    ", ".join(f"{s.name} [{s.unit}]" for s in e.inputs.values()),
                    ", ".join(f"{s.name} [{s.unit}]" for s in e.outputs.values()),
                    e.repeat_of or "",
                ]
                for e in self
            ),
        ]

    def repeats(self, experiment_id: str) -> tuple[Experiment, ...]:
        """Return every run with the same origin as `experiment_id`, itself included."""
        origin = self[experiment_id].origin
        return tuple(e for e in self if e.origin == origin)


@dataclass(frozen=True, slots=True)
class ModelSpec:
    """Which FMU stands for a setup, and how its variables are named.

    `map` translates measured signal, setting and parameter names to FMU variables; what is not in it is
    looked up under its own name. A signal mapped to ``gradient(v)`` is compared with the central difference
    of the FMU's `v` over the samples, as a differentiated encoder measures it. `initial` holds start values
    by FMU variable. `interpolation` says when input sample k acts: ``hold`` on [t_k, t_{k+1}), ``linear``
    between the samples, ``preceding`` on (t_{k-1}, t_k] (a recorder that writes a row after each step).

    `interface` is how the FMU is simulated: ``co-simulation`` (by the solver inside it) or ``model exchange`` (by
    fmuid's, to its tolerance); None for co-simulation where the FMU has it.

    Several FMUs may stand for it: those that `coupling` connects, `fmu` being what errors name; or those of an
    SSP file.
    """

    setup: str
    fmu: Path
    map: Mapping[str, str] = field(default_factory=dict)
    initial: Mapping[str, float] = field(default_factory=dict)
    interpolation: Sampling = "hold"
    coupling: Coupling | None = None
    interface: Interface | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the model is made of."""
        components = self.coupling.components if self.coupling is not None else {}
        return tuple(components.values()) or (self.fmu,)

    def variable(self, name: str) -> str:
        """Return the FMU variable that stands for a campaign's `name`."""
        target = self.map.get(name, name)
        return target[len("gradient(") : -1] if self.differentiates(name) else target

    def differentiates(self, name: str) -> bool:
        """Return whether `name` is measured as the difference of an FMU variable over the samples."""
        target = self.map.get(name, name)
        return target.startswith("gradient(") and target.endswith(")")


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """A parameter of the campaign.

    Parameters
    ----------
    name
        Here and, unless a model's `map` says otherwise, in the FMUs.
    start, lower, upper
        Start value and bounds in `unit`.
    unit
        The FMU's where it is None.
    scale
        Whether the search sees the value or its logarithm.
    free
        False: held, unless a stage frees it.
    per
        One value for the campaign, or one for each experiment.
    truth
        The rig's own value where it is known; for reports only.
    description
        For reports.
    """

    name: str
    start: float
    lower: float = -np.inf
    upper: float = np.inf
    unit: str | None = None
    scale: Literal["linear", "log"] = "linear"
    free: bool = True
    per: Literal["campaign", "experiment"] = "campaign"
    truth: float | None = None
    description: str = ""

    def __post_init__(self) -> None:
        for name in ("start", "lower", "upper"):  # NumPy's numbers are no JSON
            object.__setattr__(self, name, float(getattr(self, name)))


@dataclass(frozen=True, slots=True)
class CriterionSpec:
    """One criterion of a stage: what is measured of the mismatch of a signal, scaled by its demand value.

    Parameters
    ----------
    signal
        Measured name.
    kind
        Such as ``least_squares``, ``maximum``, ``rise_time``; see `fmuid.problems.criteria`.
    demand
        The value that would do: a criterion over its demand is satisfied at 1.
    weight
        In the weighted sum.
    start_time, stop_time
        Window (s) that is looked at.
    options
        Of the kind.
    """

    signal: str
    kind: str = "least_squares"
    demand: float = 1.0
    weight: float = 1.0
    start_time: float = -np.inf
    stop_time: float = np.inf
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ParetoSpec:
    """A Pareto front that is asked for.

    Parameters
    ----------
    objectives
        Labels of criteria, or globs: each is one objective. Every label is, where none is given.
    points
        On each edge of the front, its ends included.
    """

    objectives: tuple[str, ...] = ()
    points: int = 11


@dataclass(frozen=True, slots=True)
class AnalysisSpec:
    """What a stage is asked when its search is over.

    Parameters
    ----------
    uncertainty
        Standard errors, correlation, and what is not determined: 2 n + 6 evaluations for n parameters.
    profiles
        Profile likelihood of every parameter: some tens of evaluations each.
    monte_carlo
        Number of draws of the parameters from their distribution, for the criteria over it; 0 for none.
    pareto
        The front of trade-offs, or None.
    """

    uncertainty: bool = True
    profiles: bool = False
    monte_carlo: int = 0
    pareto: ParetoSpec | None = None


@dataclass(frozen=True, slots=True)
class StageSpec:
    """One step of the identification: which experiments, which parameters, judged how, solved by what.

    Parameters
    ----------
    name
        Of the stage.
    experiments, free
        Ids of the runs that are fitted, and names of the parameters that are estimated.
    start
        Other start values than the campaign's, by name.
    tie
        Follower -> expression of parameters.
    criteria, combine
        What is judged, and how criteria become one cost.
    solver, solver_options
        Name (``auto`` chooses by the problem) and options; see `fmuid.solvers`.
    max_evaluations, max_seconds
        Budget; None is the solver's own.
    constraints
        As in ``campaign.toml``.
    analyses
        What is asked when the search is over.
    """

    name: str
    experiments: tuple[str, ...]
    free: tuple[str, ...]
    start: Mapping[str, float] = field(default_factory=dict)
    tie: Mapping[str, str] = field(default_factory=dict)
    criteria: tuple[CriterionSpec, ...] = ()
    combine: str = "weighted_sum"
    solver: str = "auto"
    solver_options: Mapping[str, Any] = field(default_factory=dict)
    max_evaluations: int | None = None
    max_seconds: float | None = None
    constraints: tuple[Mapping[str, Any], ...] = ()
    analyses: AnalysisSpec = AnalysisSpec()


@dataclass(frozen=True, slots=True)
class EffectsSpec:
    """What a diagnosis starts from: the catalogue of effects and the nominal model.

    `nominal` names the campaign parameters of the base model; they are refitted with every effect. `tie` sets
    FMU variables (also slices such as ``lossTable[:,4:5]``) to expressions of campaign parameters.
    `experiments` are the runs to use.
    """

    catalogue: Path
    nominal: tuple[str, ...] = ()
    tie: Mapping[str, str] = field(default_factory=dict)
    experiments: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Campaign:
    """Everything of one identification question, as `fmuid.load_campaign` reads it.

    Parameters
    ----------
    name, title
        Short and long name.
    folder
        Anchors relative paths.
    measurements
        The recorded runs.
    models
        Which FMU stands for a setup, by setup.
    parameters
        By name, estimated or not.
    settings
        Fixed values by FMU variable, in the FMU's units.
    stages
        By name, in their order.
    identification, validation
        Ids of the runs that may be fitted, and of those that are kept back.
    effects
        What a diagnosis starts from, if the campaign says.
    published
        Free-form figures to put beside the estimates.
    """

    name: str
    title: str
    folder: Path
    measurements: Measurements
    models: Mapping[str, ModelSpec]
    parameters: Mapping[str, ParameterSpec]
    settings: Mapping[str, float]
    stages: Mapping[str, StageSpec]
    identification: tuple[str, ...]
    validation: tuple[str, ...]
    effects: EffectsSpec | None = None
    published: Mapping[str, Any] = field(default_factory=dict)
