"""The campaign: measurements, models, parameters and stages. Values only; files are read elsewhere."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fmuid.core.coupling import Coupling
from fmuid.core.experiments import Measurements, Outliers
from fmuid.core.formatting import html_lines, html_table, text_table
from fmuid.core.immutable import frozen_mapping
from fmuid.core.plottable import Plottable

Interpolation = Literal["hold", "linear", "band-limited"]
Timing = Literal["held", "linear", "band-limited", "held-read-after", "preceding"]
Interface = Literal["co-simulation", "model exchange"]
SEPARATOR = "@"  # "offset@run_3" is the parameter `offset` as it is in experiment run_3


def without_owner(name: str) -> str:
    """Return the name of a parameter without the experiment or machine that its value belongs to."""
    return name.partition(SEPARATOR)[0]


@dataclass(frozen=True, slots=True)
class ModelSource:
    """Modelica source of a model: the file that contains the class, and its qualified name.

    `effects` is a catalogue of expression effects that the model includes at its ports. `roots` are folders of
    the libraries that it uses, `libraries` names and versions of those with which the campaign was made.
    """

    file: Path
    class_name: str
    effects: Path | None = None
    roots: tuple[Path, ...] = ()
    libraries: tuple[tuple[str, str], ...] = ()

    @classmethod
    def at(
        cls, path: Path, class_name: str | None = None, effects: Path | None = None, roots: Iterable[Path] = ()
    ) -> ModelSource:
        """Return the source at `path`, a file or the folder of a package; by default, its class has that name."""
        file = path / "package.mo" if path.is_dir() else path
        return cls(file, class_name or path.stem, effects, tuple(roots))


def is_modelica(path: Path) -> bool:
    """Whether `path` is a Modelica file or the folder of a package."""
    return path.suffix.casefold() == ".mo" or (path / "package.mo").is_file()


@dataclass(frozen=True, slots=True)
class ModelSpec:
    """The FMU that models a setup, and the names of its variables.

    `map` translates names of measured signals, settings and parameters to FMU variables; a name that is not in it
    is looked up as it is. A signal mapped to ``gradient(v)`` is compared with the central difference of the FMU's
    `v` over the samples, as a differentiated encoder measures it. `initial` contains start values by FMU variable.
    `timing` says when input sample k acts and when outputs are read: ``held`` on [t_k, t_{k+1}), outputs just
    before it acts; ``held-read-after`` the same, but outputs just after it acts; ``linear`` between the samples;
    ``band-limited`` on their interpolation by a sinc (a recorder with an anti-aliasing filter); ``preceding`` on
    (t_{k-1}, t_k] (a recorder that writes a row after each step). `read_after` is the time from then to the
    reading of the outputs, s, for recorders that read in the middle of a step.

    `interface` says how the FMU is simulated: ``co-simulation`` (with the solver inside it) or ``model exchange``
    (with fmuid's solver, to its tolerance); None chooses co-simulation if the FMU supports it.

    A setup may also be modelled by several FMUs: those that `coupling` connects (errors then name `fmu`), or those
    of an SSP file. `source` is the Modelica source, if the campaign gives it. `signal_effects` are effects at the
    FMU's inputs and outputs that become parameters (see `fmuid.simulation.signal_model`).
    """

    setup: str
    fmu: Path
    map: Mapping[str, str] = field(default_factory=dict)
    initial: Mapping[str, float] = field(default_factory=dict)
    timing: Timing = "held"
    read_after: float = 0.0
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
        """Return the FMU variable that corresponds to the campaign's `name`."""
        target = self.map.get(name, name)
        return target[len("gradient(") : -1] if self.differentiates(name) else target

    def differentiates(self, name: str) -> bool:
        """Return whether `name` is compared with the time derivative of an FMU variable over the samples."""
        target = self.map.get(name, name)
        return target.startswith("gradient(") and target.endswith(")")

    def unit(self, name: str, of_variable: str | None) -> str | None:
        """Return the unit in which `name` is compared, given that of its FMU variable."""
        return f"({of_variable or '1'})/s" if self.differentiates(name) else of_variable


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior knowledge of a parameter: a normal distribution of its value, in the parameter's unit."""

    mean: float
    sd: float


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """A parameter of the campaign.

    Parameters
    ----------
    name
        Name in the campaign and, unless a model's `map` says otherwise, in the FMUs.
    start, lower, upper
        Start value and bounds in `unit`.
    starts
        Start values of single machines or experiments, by name, where they differ from `start`.
    unit
        Unit of the values; None for the FMU's unit.
    scale
        ``linear`` or ``log``: the search varies the value or its logarithm.
    free
        If False, the parameter is fixed unless a stage frees it.
    per
        One value for the campaign, or one for each experiment or machine.
    truth
        The true value on the rig, if known; for reports only.
    description
        For reports.
    prior
        Prior knowledge; it counts as one more residual, (value - mean) / sd.
    known
        While the parameter is fixed, a diagnosis trusts its value and does not consider an error in it.
    tolerance
        Otherwise the relative standard deviation of the fixed value.
    depends_on
        Names of fixed variables on whose values the estimate depends; for reports.
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
    starts: Mapping[str, float] = field(default_factory=dict, hash=False)
    depends_on: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("start", "lower", "upper"):  # NumPy's numbers are no JSON
            object.__setattr__(self, name, float(getattr(self, name)))
        object.__setattr__(self, "starts", frozen_mapping(self.starts))

    @property
    def values(self) -> dict[str, float]:
        """The start value by name, and those of single machines or experiments as ``name@owner``."""
        return {self.name: self.start, **{f"{self.name}{SEPARATOR}{o}": v for o, v in self.starts.items()}}

    def of_each(self, owners: Iterable[str]) -> list[ParameterSpec]:
        """Return the parameter of each machine or experiment, ``name@owner``."""
        return [
            replace(self, name=f"{self.name}{SEPARATOR}{o}", start=self.starts.get(o, self.start), starts={})
            for o in dict.fromkeys(owners)
        ]


@dataclass(frozen=True, slots=True)
class CriterionSpec:
    """One criterion of a stage: a measure of a signal's mismatch, scaled by its demand value.

    Parameters
    ----------
    signal
        Measured name.
    kind
        For example ``least_squares``, ``maximum`` or ``rise_time``; see `fmuid.identification.problem.criteria`.
    demand
        The acceptable value: a criterion divided by its demand is satisfied at 1. With the option ``good`` it is
        the bad end of an interval: the criterion is 0 up to the good end, and 1 at the bad one.
    weight
        Weight in the weighted sum.
    start_time, stop_time
        Window (s) that is evaluated.
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
    """A requested Pareto front.

    Parameters
    ----------
    objectives
        Labels of criteria, or globs; each is one objective. If none is given, every label is an objective.
    points
        Number of points on each edge of the front, including its ends.
    """

    objectives: tuple[str, ...] = ()
    points: int = 11


@dataclass(frozen=True, slots=True)
class AnalysisSpec:
    """Analyses that run after the search of a stage.

    Parameters
    ----------
    uncertainty
        Standard errors, correlations and undetermined directions: 2 n + 6 evaluations for n parameters.
    profiles
        Profile likelihood of every parameter; tens of evaluations for each.
    monte_carlo
        Number of parameter draws from the estimate's distribution, for the distribution of the criteria; 0 for
        none.
    pareto
        The requested Pareto front, or None.
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
    """One step of the identification: its experiments, free parameters, criteria and solver.

    Parameters
    ----------
    name
        Name of the stage.
    experiments, free
        Ids of the fitted runs, and names of the estimated parameters.
    start
        Start values that differ from the campaign's, by name.
    tie
        Follower -> expression of parameters.
    criteria, combine
        The criteria, and how they are combined into one cost.
    solver, solver_options
        Name (``auto`` chooses by the problem) and options; see `fmuid.identification.solvers`.
    max_evaluations, max_seconds
        Budget, seconds of simulation time; None for the solver's default.
    constraints
        Constraints as written in ``campaign.toml``.
    analyses
        Analyses after the search.
    segments
        Length (s) of the segments that runs are cut into, ``auto`` for a length that suits the model, infinite for
        whole runs that start from estimated states, or None for whole runs that start as the model says; see
        `fmuid.simulation.segmented`.
    observer
        True for output feedback with gains estimated together with the parameters; or given gains, state -> output
        -> gain, where states and outputs are FMU variables; see `fmuid.simulation.observer_model`.
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

    @property
    def apart(self) -> bool:
        """Whether each run is predicted by itself, repeats as well, since its states follow its measurements."""
        return bool(self.observer) or self.segments not in (None, math.inf)


def segments_in_toml(segments: float | Literal["auto"]) -> float | str:
    """Return segments as ``campaign.toml`` has them: a length, ``auto``, or ``run`` for whole runs."""
    return "run" if segments == math.inf else segments


@dataclass(frozen=True, slots=True)
class EffectsSpec:
    """Input of a diagnosis: the catalogue of effects and the nominal model.

    `nominal` names the campaign parameters of the base model; they are refitted with every effect. `tie` sets
    FMU variables (also slices such as ``lossTable[:,4:5]``) to expressions of campaign parameters.
    `experiments` are the runs to use. Without a `catalogue`, one is made from the models, and `fitted` are then
    the nominal parameters with which these were sized.
    """

    catalogue: Path | None = None
    nominal: tuple[str, ...] = ()
    tie: Mapping[str, str] = field(default_factory=dict)
    experiments: tuple[str, ...] = ()
    fitted: Mapping[str, float] = field(default_factory=dict)

    @property
    def file(self) -> Path:
        """The file of the catalogue, once there is one."""
        assert self.catalogue is not None
        return self.catalogue


Family = Literal["multisine", "chirp", "steps", "prbs", "binary"]


@dataclass(frozen=True, slots=True)
class Limit:
    """Limits of a quantity of the rig, in `unit` (None for the model's unit).

    Parameters
    ----------
    lower, upper
        Range of a driven input, of an output, or of a value that a run can set, such as a payload.
    rate
        Largest rate of change of an input, per second.
    """

    name: str
    lower: float = -np.inf
    upper: float = np.inf
    rate: float = np.inf
    unit: str | None = None


@dataclass(frozen=True, slots=True)
class DesignSpec:
    """Limits and options for the design of experiments.

    Parameters
    ----------
    limits
        Limits by signal or FMU variable. Inputs without limits stay at rest.
    duration
        Duration of a run, s; None for that of the longest recorded run.
    setup
        The setup to design for; None for the first recorded setup, or the first model if nothing is recorded.
    families
        Families of excitations to try; ``binary``, an optimised sequence, only if the parameters' information is
        what counts and the model is linear in its inputs.
    phases
        Whether the phases of a multisine are drawn at random or searched as well.
    sample_time
        Time between samples of the input, s; None for that of the recorded runs.
    repeats
        Number of times the run will be made.
    sigma
        Standard deviations of the noise, in the model's units, for outputs that no run has measured.
    """

    limits: Mapping[str, Limit] = field(default_factory=dict)
    duration: float | None = None
    setup: str | None = None
    families: tuple[Family, ...] = ("multisine", "chirp", "steps", "prbs", "binary")
    phases: Literal["random", "optimised"] = "random"
    sample_time: float | None = None
    repeats: int = 1
    sigma: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RobotSpec:
    """A robot description (URDF or MJCF), and the joint values that follow from the parameters.

    Parameters
    ----------
    file
        The description file; it is not changed.
    joints
        For each joint, ``friction``, ``damping`` and ``armature`` as formulas of the campaign's parameters.
    """

    file: Path
    joints: Mapping[str, Mapping[str, str]]


@dataclass(frozen=True, slots=True)
class Campaign(Plottable):
    """All data of one identification question, as read by `fmuid.load_campaign`.

    Parameters
    ----------
    name, title
        Short and long name.
    folder
        Folder to which paths are relative.
    file, measurements_file
        Files that the campaign was read from, if any.
    measurements
        The recorded runs.
    models
        The model of each setup, by setup.
    parameters
        All parameters by name, estimated or not.
    settings
        Fixed values by FMU variable, in the FMU's units.
    stages
        Stages by name, in their order.
    identification, validation
        Ids of the runs for fitting, and of those kept for validation.
    effects
        Input of a diagnosis, if the campaign gives one.
    design
        Limits and options for the design of experiments.
    robot
        The robot description that receives the identified values.
    published
        Free-form figures to compare with the estimates.
    filters
        Cut-off frequency (Hz) by signal, of a zero-phase low-pass that is applied to the measured and the
        simulated output before they are compared.
    timings
        Timing of single signals that differ from their model's: ``held``, ``linear`` or ``band-limited`` for
        inputs, ``held`` or ``held-read-after`` for outputs.
    outliers
        Outliers in the recording; they are missing samples in `measurements`.
    trusted
        Whether functions named by the campaign may be imported and called; such functions are arbitrary code.
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
    timings: Mapping[str, Timing] = field(default_factory=dict)
    outliers: tuple[Outliers, ...] = ()
    trusted: bool = False
    file: Path | None = None
    measurements_file: Path | None = None

    def __str__(self) -> str:
        """Return a summary, and the parameters as a table."""
        return f"{self._summary}\n{text_table(self._cells())}"

    def _repr_html_(self) -> str:
        return html_lines([self._summary]) + html_table(self._cells())

    @property
    def _summary(self) -> str:
        runs = f"{len(self.identification)} runs to identify, {len(self.validation)} to validate"
        return f"{self.title}: {runs}; stages: {', '.join(self.stages) or 'none'}"

    def _cells(self) -> list[list[str]]:
        rows = [["parameter", "start", "lower", "upper", "unit", "free"]]
        for p in self.parameters.values():
            numbers = [f"{value:.6g}" for value in (p.start, p.lower, p.upper)]
            rows.append([p.name, *numbers, p.unit or "", "yes" if p.free else "known" if p.known else "no"])
        return rows

    @property
    def start_values(self) -> dict[str, float]:
        """Start values of all parameters; those of single machines or experiments as ``name@owner``."""
        return {name: value for spec in self.parameters.values() for name, value in spec.values.items()}
