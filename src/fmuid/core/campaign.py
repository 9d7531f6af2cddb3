"""What a campaign is: measurements, models, parameters, stages. Values only; files are read elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fmuid.core.coupling import Coupling
from fmuid.core.experiments import Measurements, Outliers

Interpolation = Literal["hold", "linear"]
Sampling = Literal["hold", "linear", "preceding"]
Interface = Literal["co-simulation", "model exchange"]


@dataclass(frozen=True, slots=True)
class ModelSource:
    """Modelica source of a model: the file that has the class, and its qualified name.

    `effects` is a catalogue of effects with an expression that are part of the model, at its ports.
    """

    file: Path
    class_name: str
    effects: Path | None = None


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
    SSP file. `source` is the Modelica source, where the campaign says it. `signal_effects` are effects of the
    FMU's inputs and outputs that become parameters (see `fmuid.simulation.signal_model`).
    """

    setup: str
    fmu: Path
    map: Mapping[str, str] = field(default_factory=dict)
    initial: Mapping[str, float] = field(default_factory=dict)
    interpolation: Sampling = "hold"
    coupling: Coupling | None = None
    interface: Interface | None = None
    source: ModelSource | None = None
    signal_effects: tuple[str, ...] = ()

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
class Prior:
    """What is known of a parameter beforehand: a normal distribution of its value, in the parameter's unit."""

    mean: float
    sd: float


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
        One value for the campaign, or one for each experiment or machine.
    truth
        The rig's own value where it is known; for reports only.
    description
        For reports.
    prior
        What is known of it beforehand; counts as one more residual, (value - mean) / sd.
    known
        While it is held, a diagnosis takes its value for right: that it is off is no candidate.
    tolerance
        Otherwise how well the held value is known: relative, one standard deviation.
    """

    name: str
    start: float
    lower: float = -np.inf
    upper: float = np.inf
    unit: str | None = None
    scale: Literal["linear", "log"] = "linear"
    free: bool = True
    per: Literal["campaign", "experiment", "machine"] = "campaign"
    truth: float | None = None
    description: str = ""
    prior: Prior | None = None
    known: bool = False
    tolerance: float | None = None

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
        Such as ``least_squares``, ``maximum``, ``rise_time``; see `fmuid.identification.problem.criteria`.
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
    posterior
        Number of samples of the posterior; 0 for none.
    """

    uncertainty: bool = True
    profiles: bool = False
    monte_carlo: int = 0
    pareto: ParetoSpec | None = None
    posterior: int = 0


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
        Name (``auto`` chooses by the problem) and options; see `fmuid.identification.solvers`.
    max_evaluations, max_seconds
        Budget; None is the solver's own.
    constraints
        As in ``campaign.toml``.
    analyses
        What is asked when the search is over.
    segments
        Length (s) of the segments that runs are cut into, ``auto`` for one that suits the model, or None for whole
        runs; see `fmuid.simulation.segmented`.
    observer
        True for output feedback with gains that are estimated along, or the gains, state -> output -> gain, both
        variables of the FMU; see `fmuid.simulation.observer_model`.
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
    segments: float | Literal["auto"] | None = None
    observer: bool | Mapping[str, Mapping[str, float]] = False


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


Family = Literal["multisine", "chirp", "steps", "prbs"]


@dataclass(frozen=True, slots=True)
class Limit:
    """What a quantity of the rig may not leave, in `unit` (the model's where it is None).

    Parameters
    ----------
    lower, upper
        Range of an input that is driven, of an output, or of a value that a run can set, such as a payload.
    rate
        Largest slope of an input, a second.
    """

    name: str
    lower: float = -np.inf
    upper: float = np.inf
    rate: float = np.inf
    unit: str | None = None


@dataclass(frozen=True, slots=True)
class DesignSpec:
    """Within which limits experiments are designed, and how.

    Parameters
    ----------
    limits
        By signal or FMU variable. Inputs that it does not name stay at rest.
    duration
        Of a run, s; None for that of the longest recorded run.
    setup
        The setup to design for; None for the first one that has been recorded, or else the first model.
    families
        Of excitations that are tried.
    phases
        Whether the phases of a multisine are drawn, or searched as well.
    sample_time
        Time between samples of the input, s; None for that of the recorded runs.
    repeats
        How often the run will be made.
    sigma
        Standard deviations of the noise by output, in the model's units, of outputs that no run has measured.
    """

    limits: Mapping[str, Limit] = field(default_factory=dict)
    duration: float | None = None
    setup: str | None = None
    families: tuple[Family, ...] = ("multisine", "chirp", "steps", "prbs")
    phases: Literal["random", "optimised"] = "random"
    sample_time: float | None = None
    repeats: int = 1
    sigma: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RobotSpec:
    """A robot's description, URDF or MJCF, and what its joints get from the parameters.

    Parameters
    ----------
    file
        The description; it is not changed.
    joints
        By name of the joint: ``friction``, ``damping`` and ``armature`` as formulas of the campaign's parameters.
    """

    file: Path
    joints: Mapping[str, Mapping[str, str]]


@dataclass(frozen=True, slots=True)
class Campaign:
    """Everything of one identification question, as `fmuid.load_campaign` reads it.

    Parameters
    ----------
    name, title
        Short and long name.
    folder
        Anchors relative paths.
    file, measurements_file
        What it was read from, if it was.
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
    design
        Within which limits experiments are designed.
    robot
        The robot's description that the values found go into.
    published
        Free-form figures to put beside the estimates.
    filters
        Cut-off frequency (Hz) of the zero-phase low-pass that measured and simulated samples of an output go
        through before they are compared, by signal.
    outliers
        Samples of the recording that are no measurements; `measurements` has them as missing.
    trusted
        Whether functions that it names may be imported and called: they are code, wherever they lie.
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
    design: DesignSpec = DesignSpec()
    robot: RobotSpec | None = None
    published: Mapping[str, Any] = field(default_factory=dict)
    filters: Mapping[str, float] = field(default_factory=dict)
    outliers: tuple[Outliers, ...] = ()
    trusted: bool = False
    file: Path | None = None
    measurements_file: Path | None = None
