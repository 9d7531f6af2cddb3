"""Campaign files (`campaign.toml`): read and checked into the values of `fmuid.core.campaign`."""

# ruff: noqa: RUF012 - msgspec copies the empty containers that are defaults

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.campaign import (
    AnalysisSpec,
    Campaign,
    CriterionSpec,
    DesignSpec,
    EffectsSpec,
    Limit,
    ModelSource,
    ModelSpec,
    ParameterSpec,
    ParetoSpec,
    Prior,
    RobotSpec,
    StageSpec,
    Timing,
)
from fmuid.core.errors import CampaignError, MeasurementsError, ProblemError
from fmuid.core.experiments import Causality, Measurements, Outliers, Signal
from fmuid.core.formulas import parse
from fmuid.core.immutable import FloatArray, frozen_mapping
from fmuid.core.toml_tables import Table, convert, finite, numbers, read_toml
from fmuid.data.filtering import LowPass, derivative
from fmuid.data.measurements import read_measurements
from fmuid.data.noise.outliers import without_outliers
from fmuid.simulation.coupled.coupling_table import CoupledTable, coupling_of

FILE_NAME = "campaign.toml"
MAX_STARTS, MAX_DRAWS, MAX_POINTS = 1000, 100_000, 1000  # of a solver, Monte Carlo, a Pareto front
SIGNAL_TIMINGS: Mapping[Causality, tuple[Timing, ...]] = {
    "input": ("held", "linear", "band-limited"),
    "output": ("held", "held-read-after"),
}
_Table = Mapping[str, Any]


class _CampaignTable(Table):
    name: str | None = None
    title: str = ""
    measurements: str = "measurements.h5"
    make: str | None = None
    outliers: Literal["leave_out", "keep"] = "leave_out"


class _ModelTable(CoupledTable):
    map: dict[str, str] = {}
    initial: dict[str, Any] = {}
    interpolation: Literal["hold", "linear", "preceding"] | None = None
    timing: Timing | None = None
    read_after: float = 0.0
    interface: Literal["co-simulation", "model exchange"] | None = None
    source: str = ""
    class_: str = msgspec.field(name="class", default="")
    effects: str = ""
    roots: list[str] = []
    libraries: dict[str, str] = {}
    signal_effects: list[str] = []


class _ParameterTable(Table):
    start: float
    lower: float = -math.inf
    upper: float = math.inf
    unit: str | None = None
    scale: Literal["linear", "log"] = "linear"
    free: bool = True
    per: Literal["campaign", "experiment", "machine"] = "campaign"
    truth: float | None = None
    description: str = ""
    prior: dict[str, Any] | None = None
    known: bool = False
    tolerance: float | None = None
    starts: dict[str, Any] = msgspec.field(default_factory=dict)
    depends_on: list[str] = []


class _PriorTable(Table):
    mean: float
    sd: float


class _CriterionTable(Table):
    signal: str
    kind: str = "least_squares"
    demand: float | tuple[float, float] = 1.0
    weight: float = 1.0
    from_: float = msgspec.field(name="from", default=-math.inf)
    to: float = math.inf
    options: dict[str, Any] = {}


class _BudgetTable(Table):
    evaluations: int | None = None
    seconds: float | None = None


class _StageTable(Table):
    experiments: list[str] | None = None
    free: list[str] | None = None
    start: dict[str, Any] = {}
    tie: dict[str, str] = {}
    criteria: list[dict[str, Any]] = []
    combine: str = "weighted_sum"
    solver: str | dict[str, Any] = "auto"
    budget: dict[str, Any] = {}
    constraints: list[dict[str, Any]] = []
    profiles: bool = False
    monte_carlo: int = 0
    posterior: int = 0
    pareto: dict[str, Any] | None = None
    segments: float | str | None = None
    observer: bool | dict[str, dict[str, float]] = False


class _SignalTable(Table):
    derivative_of: str | None = None
    order: int = 1
    causality: Literal["input", "output"] = "input"
    filter: float | None = None
    timing: Literal["held", "linear", "band-limited", "held-read-after"] | None = None
    shift: float = 0.0
    sigma: float | None = None


class _ParetoTable(Table):
    objectives: list[str] = []
    points: int = 11


class _RolesTable(Table):
    identification: list[str] | None = None
    validation: list[str] = []


class _EffectsTable(Table):
    catalogue: str | None = None
    nominal: list[str] | None = None
    tie: dict[str, str] = {}
    experiments: list[str] = []


class _LimitTable(Table):
    min: float | None = None
    max: float | None = None
    rate: float | None = None
    unit: str | None = None


class _DesignTable(Table):
    setup: str | None = None
    families: list[str] = []
    phases: Literal["random", "optimised"] = "random"
    sample_time: float | None = None
    repeats: int = 1
    sigma: dict[str, Any] = {}


class _JointTable(Table):
    friction: str | None = None
    damping: str | None = None
    armature: str | None = None


class _RobotTable(Table):
    file: str
    joints: dict[str, dict[str, Any]]


class _Document(Table):
    campaign: dict[str, Any] = {}
    signals: dict[str, dict[str, Any]] = {}
    models: dict[str, dict[str, Any]] = {}
    parameters: dict[str, dict[str, Any]] = {}
    settings: dict[str, Any] = {}
    stages: dict[str, dict[str, Any]] = {}
    roles: dict[str, Any] = {}
    effects: dict[str, Any] | None = None
    limits: dict[str, Any] = {}
    design: dict[str, Any] = {}
    robot: dict[str, Any] | None = None
    published: dict[str, Any] = {}


def load_campaign(
    path: str | Path,
    *,
    measurements: str | Path | Measurements | None = None,
    judged: bool = False,
    trust: bool = False,
    planned: bool = False,
) -> Campaign:
    """Read and check a campaign: its `campaign.toml` and the measurement file that it names.

    Parameters
    ----------
    path
        The campaign's folder, or the TOML file itself.
    measurements
        Measurements, or a file of them, to use instead of the ones in the campaign.
    judged
        Use every run for validation and ignore [roles], since `measurements` contains other runs.
    trust
        Whether functions named by the campaign (criteria of kind ``user``) may be imported and called.
    planned
        Whether the runs may not have been recorded yet; without a measurement file the campaign then has no runs
        and no stages.

    Raises
    ------
    CampaignError
        The TOML file is missing or malformed, or refers to something that does not exist; the message names the
        table.
    MeasurementsError
        The measurement file is missing or violates its format.

    Examples
    --------
    >>> campaign = fmuid.load_campaign("tank")
    >>> sorted(campaign.parameters)
    ['C', 'G']
    """
    file = _file_of(Path(path))
    document = convert(read_toml(file), _Document, str(file))
    head = convert(document.campaign, _CampaignTable, f"{file} [campaign]")
    _check_names(head, document, file)
    folder = file.parent
    given = measurements if isinstance(measurements, Measurements) else None
    source = Path(measurements) if isinstance(measurements, str | Path) else folder / head.measurements
    make = f"make it with: {head.make}" if head.make and measurements is None else None
    planned = planned and given is None and not source.exists()
    recorded = given or (Measurements({}) if planned else read_measurements(source, fix_missing=make))
    if planned:
        document.signals, document.roles, document.stages, document.effects = {}, {}, {}, None
    outliers: tuple[Outliers, ...] = ()
    if head.outliers == "leave_out":
        recorded, outliers = without_outliers(recorded)
    recorded, filters, timings = _signals(document.signals, recorded, str(file))
    parameters = {n: _parameter(n, t, f"{file} [parameters.{n}]") for n, t in document.parameters.items()}
    if not planned and measurements is None:
        _check_owners(parameters, recorded, str(file))
    settings = numbers(document.settings, f"{file} [settings]")
    for name in settings.keys() & parameters.keys():
        raise CampaignError(
            f"'{name}' is also a parameter", where=f"{file} [settings]", fix="give it in one of the two tables"
        )
    if judged:
        _have_every_run_judged(document, recorded)
    roles = _Roles((), ()) if planned else _Roles.from_table(document.roles, recorded, str(file))
    if judged:
        roles = _Roles(roles.identification, roles.identification)
    models = {s: _model(s, t, folder, f"{file} [models.{s}]") for s, t in document.models.items()}
    if not planned:
        _check_models(models, recorded, roles=roles, parameters=parameters, settings=settings, file=str(file))
    stages = {
        n: _stage(n, t, measurements=recorded, roles=roles, parameters=parameters, where=f"{file} [stages.{n}]")
        for n, t in document.stages.items()
    }
    effects = None
    if document.effects is not None:
        effects = _effects(
            document.effects,
            folder,
            measurements=recorded,
            parameters=parameters,
            validation=() if judged else roles.validation,
            where=f"{file} [effects]",
        )
    name = head.name or file.resolve().parent.name
    return Campaign(
        name=name,
        title=head.title or name,
        folder=folder,
        measurements=recorded,
        models=frozen_mapping(models),
        parameters=frozen_mapping(parameters),
        settings=frozen_mapping(settings),
        stages=frozen_mapping(stages),
        identification=roles.identification,
        validation=roles.validation,
        effects=effects,
        design=_design(document, models, str(file)),
        robot=_robot(document.robot, folder, parameters, f"{file} [robot]"),
        published=frozen_mapping(document.published),
        filters=frozen_mapping(filters),
        timings=frozen_mapping(timings),
        outliers=outliers,
        trusted=trust,
        file=file,
        measurements_file=source,
    )


def _robot(
    raw: _Table | None, folder: Path, parameters: Mapping[str, ParameterSpec], where: str
) -> RobotSpec | None:
    if raw is None:
        return None
    table = convert(raw, _RobotTable, where)
    joints = {}
    for name, entry in table.joints.items():
        here = f"{where[:-1]}.joints.{name}]"
        given = msgspec.to_builtins(convert(entry, _JointTable, here))
        joints[name] = frozen_mapping({quantity: text for quantity, text in given.items() if text is not None})
        for quantity, text in joints[name].items():
            for used in sorted(parse(text, where=f"{here} {quantity}").names - parameters.keys()):
                fix = suggestion(used, parameters)
                raise CampaignError(f"'{used}' is not a parameter", where=f"{here} {quantity}", fix=fix)
    return RobotSpec(folder / table.file, frozen_mapping(joints))


def _have_every_run_judged(document: _Document, recorded: Measurements) -> None:
    """Make stages, which define how sensors read, name no run and no signal that is missing."""
    measured = {name for experiment in recorded for name in experiment.outputs}
    document.roles = {}
    for table in document.stages.values():
        table.pop("experiments", None)
        criteria = table.get("criteria", [])
        table["criteria"] = [c for c in criteria if not isinstance(c, dict) or c.get("signal") in measured]
    if document.effects is not None:
        document.effects.pop("experiments", None)


def _signals(
    raw: Mapping[str, _Table], recorded: Measurements, file: str
) -> tuple[Measurements, dict[str, float], dict[str, Timing]]:
    """Return the measurements with derived, shifted and filtered signals, the filters of outputs, and timings."""
    filters: dict[str, float] = {}
    timings: dict[str, Timing] = {}
    experiments = dict(recorded.experiments)
    for name, entry in raw.items():
        where = f"{file} [signals.{name}]"
        table = convert(entry, _SignalTable, where)
        source = table.derivative_of or name
        known = dict.fromkeys(n for e in experiments.values() for n in e.signals)
        _check_signal_table(name, table, known, where)
        for experiment in [e for e in experiments.values() if source in e.signals]:
            signal = experiment.signals[source]
            causality = signal.causality if table.derivative_of is None else table.causality
            if causality == "output" and table.filter is not None:
                filters[name] = table.filter  # applied to measurement and prediction
            if table.timing is not None:
                timings[name] = _signal_timing(table.timing, causality, where)
            try:
                made = _derived(experiment.time, _shifted(experiment.time, signal, table), name, causality, table)
            except MeasurementsError as error:
                raise CampaignError(f"{error.what} in run '{experiment.id}'", where=where, fix=error.fix) from None
            if table.sigma is not None:
                made = replace(made, sigma=table.sigma)
            signals = dict(experiment.signals) | {name: made}
            experiments[experiment.id] = replace(experiment, signals=signals)
    return replace(recorded, experiments=experiments), filters, timings


def _check_signal_table(name: str, table: _SignalTable, known: Collection[str], where: str) -> None:
    source = table.derivative_of or name
    if source not in known:
        raise CampaignError(f"'{source}' is not measured", where=where, fix=suggestion(source, known))
    if table.derivative_of is not None and name in known:
        raise CampaignError("is measured already", where=where, fix="give the derivative another name")
    if table.order not in (1, 2) or (table.derivative_of is None and table.order != 1):
        raise CampaignError(f"order is {table.order}", where=where, fix="write 1, or 2 beside derivative_of")
    if table.filter is not None and not (math.isfinite(table.filter) and table.filter > 0):
        raise CampaignError(f"filter is {table.filter:g}", where=where, fix="write a frequency in Hz")
    _positive("sigma", table.sigma, where)


def _signal_timing(timing: Timing, causality: Causality, where: str) -> Timing:
    known = SIGNAL_TIMINGS[causality]
    if timing not in known:
        what = f"timing is '{timing}', which {causality}s cannot have"
        fix = f"choose {', '.join(known[:-1])} or {known[-1]}"
        raise CampaignError(what, where=where, fix=fix)
    return timing


def _shifted(time: FloatArray, signal: Signal, table: _SignalTable) -> Signal:
    """Return a signal whose samples belong `shift` seconds later, interpolated at the times of the run."""
    shift = table.shift
    if shift == 0.0:
        return signal
    if not abs(shift) < float(time[-1] - time[0]):
        raise MeasurementsError(f"shift is {shift:g} s, longer than the run", fix="write seconds")
    known = np.isfinite(signal.values)
    times, values = time[known] + shift, signal.values[known]
    moved = np.interp(time, times, values)
    if signal.causality == "output":
        moved[~known | (time < times[0]) | (time > times[-1])] = np.nan
    note = f"shifted by {shift:g} s"
    return replace(signal, values=moved, resampled="; ".join(filter(None, [signal.resampled, note])))


def _derived(time: FloatArray, signal: Signal, name: str, causality: Causality, table: _SignalTable) -> Signal:
    values, unit = signal.values, signal.unit
    if table.derivative_of is None and (causality == "output" or table.filter is None):
        return signal
    if table.filter is not None and causality == "input":
        values = LowPass(table.filter)(time, values)
    if table.derivative_of is not None:
        values, unit = derivative(time, values, table.order), f"({unit})/s{table.order if table.order > 1 else ''}"
        if causality == "input" and not np.isfinite(values).all():
            raise MeasurementsError(
                f"'{table.derivative_of}' has missing samples, and so has its derivative",
                fix="cut the run there, or fill the samples on import",
            )
    return Signal(name, values, unit, causality, resampled=signal.resampled)


def _effects(
    raw: _Table,
    folder: Path,
    *,
    measurements: Measurements,
    parameters: Mapping[str, ParameterSpec],
    validation: Collection[str],
    where: str,
) -> EffectsSpec:
    table = convert(raw, _EffectsTable, where)
    free = [name for name, spec in parameters.items() if spec.free]
    nominal = free if table.nominal is None else table.nominal
    for name in nominal:
        if name not in parameters:
            raise CampaignError(f"unknown parameter '{name}' in nominal", where=where, fix=suggestion(name, free))
    for name in table.experiments or ():
        if name in validation:
            raise CampaignError(
                f"'{name}' is kept for validation",
                where=f"{where} experiments",
                fix="remove it from one of the two; `fmuid diagnose --experiment` uses it once",
            )
    unseen = tuple(name for name in measurements.experiments if name not in validation)
    experiments = expand(table.experiments or ["*"], measurements, unseen, f"{where} experiments")
    catalogue = None if table.catalogue is None else folder / table.catalogue
    return EffectsSpec(catalogue, tuple(nominal), frozen_mapping(table.tie), experiments)


def _design(document: _Document, models: Collection[str], file: str) -> DesignSpec:
    where = f"{file} [limits]"
    limits = dict(document.limits)
    duration = limits.pop("duration", None)
    _positive("duration", duration, where)
    table = convert(document.design, _DesignTable, f"{file} [design]")
    where = f"{file} [design]"
    if table.setup is not None and table.setup not in models:
        raise CampaignError(
            f"no model for setup '{table.setup}'", where=where, fix=suggestion(table.setup, models)
        )
    known = DesignSpec().families
    for family in table.families:
        if family not in known:
            raise CampaignError(f"no family '{family}'", where=f"{where} families", fix=suggestion(family, known))
    _positive("sample_time", table.sample_time, where)
    if table.repeats < 1:
        raise CampaignError(f"repeats is {table.repeats}", where=where, fix="write 1 or more")
    sigma = numbers(table.sigma, f"{where} sigma")
    for name, value in sigma.items():
        _positive(name, value, f"{where} sigma")
    return DesignSpec(
        limits=frozen_mapping(
            {name: _limit(name, raw, f"{file} [limits] {name}") for name, raw in limits.items()}
        ),
        duration=duration,
        setup=table.setup,
        families=tuple(f for f in known if f in table.families) or known,
        phases=table.phases,
        sample_time=table.sample_time,
        repeats=table.repeats,
        sigma=frozen_mapping(sigma),
    )


def _limit(name: str, raw: Any, where: str) -> Limit:
    table = convert(raw, _LimitTable, where)
    low, high = (-math.inf if table.min is None else table.min), (math.inf if table.max is None else table.max)
    if not low < high:
        raise CampaignError(f"min {low:g} is not below max {high:g}", where=where, fix="swap them")
    _positive("rate", table.rate, where)
    return Limit(name, low, high, math.inf if table.rate is None else table.rate, table.unit)


def _positive(key: str, value: Any, where: str) -> None:
    """Refuse a value that is given and not a positive number."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is not None and not (number and math.isfinite(value) and value > 0):
        shown = f"{value:g}" if number else repr(value)
        raise CampaignError(f"{key} is {shown}", where=where, fix="write a positive number")


def _check_start(value: float, of: str, bounds: _ParameterTable | ParameterSpec, where: str) -> None:
    low, high = bounds.lower, bounds.upper
    if not low <= value <= high:
        what = f"start {value:g}{of} is outside [{low:g}, {high:g}]"
        raise CampaignError(what, where=where, fix="move the start or the bounds")


def _model(setup: str, raw: _Table, folder: Path, where: str) -> ModelSpec:
    table = convert(raw, _ModelTable, where)
    source = _source(table, folder, where)
    if source is not None and not (table.fmu and (folder / table.fmu).is_file()):
        from fmuid.simulation.model_source import built_model  # slow to import

        table.fmu = str(built_model(source))
    coupling = coupling_of(table, folder, where)
    if table.interface and (coupling is not None or table.fmu.endswith(".ssp")):
        raise CampaignError(
            "interface applies to a single FMU only", where=where, fix="leave it out for coupled ones"
        )
    return ModelSpec(
        setup=setup,
        fmu=folder / (table.fmu or "+".join(table.fmus)),
        map=frozen_mapping(table.map),
        initial=frozen_mapping(numbers(table.initial, f"{where} initial")),
        timing=_timing(table, where),
        read_after=table.read_after,
        coupling=coupling,
        interface=table.interface,
        source=source,
        signal_effects=tuple(table.signal_effects),
    )


def _timing(table: _ModelTable, where: str) -> Timing:
    if table.timing is not None and table.interpolation is not None:
        raise CampaignError("has timing and interpolation", where=where, fix="remove interpolation")
    old: dict[str | None, Timing] = {"hold": "held", "linear": "linear", "preceding": "preceding", None: "held"}
    timing = table.timing or old[table.interpolation]
    if table.read_after:
        _positive("read_after", table.read_after, where)
        if timing not in ("held", "linear"):
            raise CampaignError(f"read_after beside timing '{timing}'", where=where, fix="remove one of them")
    return timing


def _source(table: _ModelTable, folder: Path, where: str) -> ModelSource | None:
    """Return the Modelica source that a model's table names; by default, the class has the name of the file."""
    if not table.source:
        if table.class_:
            raise CampaignError("names a class without its source", where=where, fix='write source = "file.mo"')
        optional = (("effects", table.effects), ("roots", table.roots), ("libraries", table.libraries))
        for key, value in optional:
            if value:
                raise CampaignError(f"has {key} but no source", where=where, fix='write source = "file.mo"')
        return None
    if table.fmus or table.fmu.endswith(".ssp"):
        raise CampaignError(
            "source applies to a single FMU only", where=where, fix="leave it out for coupled ones"
        )
    effects = folder / table.effects if table.effects else None
    source = ModelSource.at(folder / table.source, table.class_, effects, (folder / r for r in table.roots))
    return replace(source, libraries=tuple(table.libraries.items()))


def _file_of(path: Path) -> Path:
    file = path / FILE_NAME if path.is_dir() else path
    if file.is_file() and file.suffix != ".toml":
        fix = "give a folder with a campaign.toml, or make one with: fmuid init"
        raise CampaignError("is not a campaign", where=path, fix=fix)
    return file


def _check_names(head: _CampaignTable, document: _Document, file: Path) -> None:
    """Refuse names that cannot be those of folders, files and groups."""
    if head.name and (head.name in (".", "..") or "/" in head.name or "\\" in head.name):
        where = f"{file} [campaign] name"
        raise CampaignError(f"'{head.name}' is not a valid folder name", where=where, fix="leave out / and ..")
    for n in document.stages:
        if n in ("", ".", "..") or "/" in n or not n.isprintable():
            fix = "use letters, digits, spaces, . - _"
            raise CampaignError(f"'{n}' is not a valid stage name", where=f"{file} [stages]", fix=fix)


def _parameter(name: str, raw: _Table, where: str) -> ParameterSpec:
    if "start" not in raw and any(isinstance(value, dict) for value in raw.values()):
        fix = f'a name with dots needs quotes, as in [parameters."{name}.{next(iter(raw))}"]'
        raise CampaignError("has no 'start'", where=where, fix=fix)
    table = convert(raw, _ParameterTable, where)
    _check_bounds(table, where)
    if table.truth is not None:
        finite("truth", table.truth, where)
    starts = numbers(table.starts, f"{where} starts")
    if starts and table.per == "campaign":
        raise CampaignError(
            "has starts, but one value", where=where, fix='write per = "machine" or "experiment", or remove starts'
        )
    for owner, value in starts.items():
        _check_start(value, f" of '{owner}'", table, f"{where} starts")
    keys = {**msgspec.structs.asdict(table), "prior": _prior(table, where), "starts": starts}
    keys["depends_on"] = tuple(table.depends_on)
    return ParameterSpec(name=name, **keys)


def _check_bounds(table: _ParameterTable, where: str) -> None:
    finite("start", table.start, where)
    if math.isnan(table.lower) or math.isnan(table.upper):
        raise CampaignError("a bound is nan", where=where, fix="write a number, or leave the bound out")
    if table.lower >= table.upper:
        raise CampaignError(
            f"lower {table.lower:g} is not below upper {table.upper:g}",
            where=where,
            fix="swap them, or set free = false to keep it constant",
        )
    _check_start(table.start, "", table, where)
    if table.scale == "log" and not (table.lower > 0 or (table.lower == -math.inf and table.start > 0)):
        raise CampaignError(
            f"scale is log but lower is {table.lower:g}",
            where=where,
            fix="give lower > 0, or scale = 'linear'",
        )
    if table.scale == "log" and not math.isfinite(table.lower):
        raise CampaignError("scale is log without lower", where=where, fix="give lower > 0")


def _check_owners(parameters: Mapping[str, ParameterSpec], measurements: Measurements, file: str) -> None:
    """Check that machines and experiments with their own start values were recorded."""
    owners = {"machine": {e.machine for e in measurements}, "experiment": set(measurements.experiments)}
    for spec in parameters.values():
        for owner in spec.starts:
            if owner not in owners[spec.per]:
                raise CampaignError(
                    f"no {spec.per} '{owner}' was recorded",
                    where=f"{file} [parameters.{spec.name}] starts",
                    fix=suggestion(owner, owners[spec.per]),
                )


def _prior(table: _ParameterTable, where: str) -> Prior | None:
    """Return the prior knowledge about a parameter, which may be stated in one way only."""
    if table.tolerance is not None and not (math.isfinite(table.tolerance) and table.tolerance > 0):
        raise CampaignError(
            f"tolerance is {table.tolerance:g}", where=where, fix="write tolerance > 0, relative; or known = true"
        )
    if table.known and table.tolerance is not None:
        raise CampaignError("is known and has a tolerance", where=where, fix="remove one of the two")
    if table.prior is None:
        return None
    prior = convert(table.prior, _PriorTable, f"{where} prior")
    if not (math.isfinite(prior.mean) and math.isfinite(prior.sd) and prior.sd > 0):
        raise CampaignError(f"prior has mean {prior.mean:g} and sd {prior.sd:g}", where=where, fix="write sd > 0")
    return Prior(prior.mean, prior.sd)


@dataclass(frozen=True, slots=True)
class _Roles:
    identification: tuple[str, ...]
    validation: tuple[str, ...]

    @classmethod
    def from_table(cls, raw: _Table, measurements: Measurements, file: str) -> _Roles:
        table = convert(raw, _RolesTable, f"{file} [roles]")
        where = f"{file} [roles]"
        everything = tuple(measurements.experiments)
        held_out = expand(table.validation, measurements, everything, f"{where} validation")
        named = {i for i in held_out if i in table.validation}
        if table.identification is None:
            used = tuple(i for i in everything if i not in held_out)
        else:
            used = expand(table.identification, measurements, everything, f"{where} identification")
        if not used:
            raise CampaignError(
                "no run is left for identification", where=where, fix="name some in identification"
            )
        # A repeat that one role names by its id is not included in the other.
        used = tuple(i for i in used if i not in named or i in (table.identification or ()))
        for experiment_id in used:
            if experiment_id in held_out:
                raise CampaignError(
                    f"'{experiment_id}' is both in identification and in validation",
                    where=where,
                    fix="validate on runs that are not used",
                )
        return cls(used, held_out)


def expand(
    patterns: Sequence[str], measurements: Measurements, among: Sequence[str], where: str
) -> tuple[str, ...]:
    """Return the experiments named by ids and globs, with their repeats, in the file's order.

    Globs select from the experiment ids `among`; repeats are included if they are also in `among`.

    Raises
    ------
    CampaignError
        A pattern matches nothing.
    """
    chosen: set[str] = set()
    for pattern in patterns:
        if pattern in measurements.experiments:
            matched = {pattern}
            if pattern not in among:
                raise CampaignError(
                    f"'{pattern}' is not in the identification set",
                    where=where,
                    fix="see [roles] in the same file",
                )
        else:
            matched = {i for i in among if fnmatchcase(i, pattern)}
        if not matched:
            is_glob = any(c in pattern for c in "*?[")
            what = "matches no experiment" if is_glob else "is not an experiment"
            first_runs = [e.id for e in measurements if not e.repeats_another and e.id in among]
            raise CampaignError(f"'{pattern}' {what}", where=where, fix=suggestion(pattern, first_runs))
        chosen |= matched
    repeated = {i: {measurements[i].repeat_of, measurements[i].repeat_of_reference} for i in among}
    return tuple(i for i in among if i in chosen or repeated[i] & chosen)


def _check_models(
    models: Mapping[str, ModelSpec],
    measurements: Measurements,
    *,
    roles: _Roles,
    parameters: Mapping[str, ParameterSpec],
    settings: Mapping[str, float],
    file: str,
) -> None:
    for experiment_id in roles.identification + roles.validation:
        experiment = measurements[experiment_id]
        if experiment.setup not in models:
            raise CampaignError(
                f"no model for setup '{experiment.setup}' of experiment '{experiment_id}'",
                where=f"{file} [models]",
                fix=suggestion(experiment.setup, models)
                if models
                else f'write [models.{experiment.setup}] with fmu = "..."',
            )
        for name in experiment.settings.keys() & parameters.keys():
            raise CampaignError(
                f"'{name}' is set by experiment '{experiment_id}'",
                where=f"{file} [parameters.{name}]",
                fix="a value that the run sets cannot be a parameter: remove one of the two",
            )
    known = parameters.keys() | settings.keys()
    for experiment in measurements:
        known |= experiment.signals.keys() | experiment.settings.keys()
    for setup, model in models.items():
        for name in model.map:
            if name not in known:
                raise CampaignError(
                    f"'{name}' is not a signal, setting or parameter",
                    where=f"{file} [models.{setup}] map",
                    fix=suggestion(name, known),
                )


def _stage(
    name: str,
    raw: _Table,
    *,
    measurements: Measurements,
    roles: _Roles,
    parameters: Mapping[str, ParameterSpec],
    where: str,
) -> StageSpec:
    table = convert(raw, _StageTable, where)
    patterns = ["*"] if table.experiments is None else table.experiments
    experiments = expand(patterns, measurements, roles.identification, f"{where} experiments")
    if not experiments:
        raise CampaignError("has no experiments", where=where, fix="name experiments of the identification set")
    free = tuple(p.name for p in parameters.values() if p.free) if table.free is None else tuple(table.free)
    free = tuple(f for f in dict.fromkeys(free) if table.free is not None or f not in table.tie)
    _known(free, parameters, f"{where} free")
    if not free:
        raise CampaignError("has no free parameter", where=where, fix='write free = ["..."]')
    start = numbers(table.start, f"{where} start")
    _known(start, parameters, f"{where} start")
    for key, value in start.items():
        _check_start(value, f" of '{key}'", parameters[key], where)
    _check_ties(table.tie, free, parameters, f"{where} tie")
    solver, options = _solver(table.solver, where)
    budget = convert(table.budget, _BudgetTable, f"{where} budget")
    pareto = None if table.pareto is None else convert(table.pareto, _ParetoTable, f"{where} pareto")
    if pareto is not None and not 2 <= pareto.points <= MAX_POINTS:
        raise CampaignError(f"pareto points is {pareto.points}", where=where, fix=f"write 2 to {MAX_POINTS}")
    for key, draws in (("monte_carlo", table.monte_carlo), ("posterior", table.posterior)):
        if not 0 <= draws <= MAX_DRAWS:
            fix = f"write a number of draws up to {MAX_DRAWS}"
            raise CampaignError(f"{key} is {draws}", where=where, fix=fix)
    for key in ("evaluations", "seconds"):
        limit = getattr(budget, key)
        if limit is not None and not limit > 0:
            raise CampaignError(f"budget {key} is {limit:g}", where=where, fix="write a positive number")
    return StageSpec(
        name=name,
        experiments=experiments,
        free=free,
        start=frozen_mapping(start),
        tie=frozen_mapping(table.tie),
        criteria=tuple(
            _criterion(t, experiments, measurements, f"{where} criterion {i}")
            for i, t in enumerate(table.criteria, 1)
        ),
        combine=table.combine,
        solver=solver,
        solver_options=frozen_mapping(options),
        max_evaluations=budget.evaluations,
        max_seconds=budget.seconds,
        constraints=tuple(frozen_mapping(c) for c in table.constraints),
        analyses=AnalysisSpec(
            profiles=table.profiles,
            monte_carlo=table.monte_carlo,
            posterior=table.posterior,
            pareto=None if pareto is None else ParetoSpec(tuple(pareto.objectives), pareto.points),
        ),
        segments=_segments(table.segments, where),
        observer=_observer(table, where),
    )


def _observer(table: _StageTable, where: str) -> bool | Mapping[str, Mapping[str, float]]:
    if table.observer and table.segments is not None:
        raise CampaignError("has segments and an observer", where=where, fix="choose one of them")
    if isinstance(table.observer, bool):
        return table.observer
    return {state: numbers(gains, f"{where} observer") for state, gains in table.observer.items()}


def _segments(raw: float | str | None, where: str) -> float | Literal["auto"] | None:
    if raw is None or raw == "auto":
        return cast(Literal["auto"] | None, raw)
    if raw == "run":
        return math.inf
    if isinstance(raw, str) or not (math.isfinite(raw) and raw > 0):
        raise CampaignError(
            f"segments is {raw!r}", where=where, fix='write their length in s, or segments = "auto" or "run"'
        )
    return float(raw)


def _criterion(raw: _Table, experiments: Sequence[str], measurements: Measurements, where: str) -> CriterionSpec:
    table = convert(raw, _CriterionTable, where)
    outputs = {name: None for i in experiments for name in measurements[i].outputs}
    if table.signal not in outputs:
        raise CampaignError(
            f"signal '{table.signal}' is not measured in these experiments",
            where=where,
            fix=suggestion(table.signal, outputs),
        )
    good, bad = table.demand if isinstance(table.demand, tuple) else (None, table.demand)
    if good is not None and not 0.0 <= good < bad:
        raise CampaignError(
            f"demand is [{good:g}, {bad:g}]", where=where, fix="write [good, bad], such as [0.5, 2.0]"
        )
    _positive("demand", bad, where)
    _positive("weight", table.weight, where)
    if not table.from_ < table.to:
        raise CampaignError(
            f"'from' ({table.from_:g}) is not before 'to' ({table.to:g})", where=where, fix="swap them"
        )
    return CriterionSpec(
        signal=table.signal,
        kind=table.kind,
        demand=bad,
        weight=table.weight,
        start_time=table.from_,
        stop_time=table.to,
        options=frozen_mapping(table.options if good is None else {**table.options, "good": good}),
    )


def _check_ties(
    ties: Mapping[str, str], free: Sequence[str], parameters: Mapping[str, ParameterSpec], where: str
) -> None:
    _known(ties, parameters, where)
    leaders: dict[str, frozenset[str]] = {}
    for follower, text in ties.items():
        if follower in free:
            raise CampaignError(
                f"'{follower}' is both free and tied", where=where, fix="remove it from one of the two"
            )
        try:
            leaders[follower] = parse(text).names
        except ProblemError as error:
            raise CampaignError(error.what, where=where, fix=error.fix) from None
        _known(leaders[follower], parameters, where)
    try:
        TopologicalSorter({f: names & leaders.keys() for f, names in leaders.items()}).prepare()
    except CycleError as error:
        circle = " -> ".join(error.args[1])
        raise CampaignError(f"circular ties: {circle}", where=where, fix="break the circle") from None


def _solver(raw: str | _Table, where: str) -> tuple[str, dict[str, Any]]:
    if isinstance(raw, str):
        return raw, {}
    options = dict(raw)
    name = options.pop("name", None)
    if not isinstance(name, str):
        raise CampaignError("solver has no name", where=where, fix='write solver = { name = "bobyqa", ... }')
    starts = options.get("starts", 1)
    if type(starts) is not int or not 1 <= starts <= MAX_STARTS:
        fix = f"write a whole number from 1 to {MAX_STARTS}"
        raise CampaignError(f"solver starts {starts!r} times", where=where, fix=fix)
    return name, options


def _known(names: Iterable[str], parameters: Mapping[str, ParameterSpec], where: str) -> None:
    for name in names:
        if name not in parameters:
            raise CampaignError(f"unknown parameter '{name}'", where=where, fix=suggestion(name, parameters))


def document_type() -> type[Table]:
    """Return the type of a whole campaign file, with the types of its tables written out, for editors."""
    joint: Any = msgspec.defstruct("_Joints", [("file", str), ("joints", dict[str, _JointTable])], bases=(Table,))
    stage: Any = msgspec.defstruct(
        "_Stage",
        [
            ("criteria", list[_CriterionTable], []),
            ("budget", _BudgetTable, msgspec.UNSET),
            ("pareto", _ParetoTable, msgspec.UNSET),
        ],
        bases=(_StageTable,),
    )
    parameter: Any = msgspec.defstruct(
        "_Parameter", [("prior", _PriorTable, msgspec.UNSET)], bases=(_ParameterTable,)
    )
    types: dict[str, Any] = {
        "campaign": _CampaignTable,
        "signals": dict[str, _SignalTable],
        "models": dict[str, _ModelTable],
        "parameters": dict[str, parameter],
        "stages": dict[str, stage],
        "roles": _RolesTable,
        "effects": _EffectsTable,
        "limits": dict[str, _LimitTable | float],
        "design": _DesignTable,
        "robot": joint,
    }
    rest = {field.encode_name: field.type for field in msgspec.structs.fields(_Document)}
    fields = [(name, types.get(name, kind), msgspec.UNSET) for name, kind in rest.items()]
    return cast(type[Table], msgspec.defstruct("Campaign", fields, bases=(Table,)))
