"""Cases: one simulation each, with the measurements for comparison."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.campaign import SEPARATOR, Campaign, CriterionSpec, Interpolation, ModelSpec, ParameterSpec
from fmuid.core.errors import CampaignError, FmuError, MeasurementsError, ProblemError
from fmuid.core.experiments import Experiment
from fmuid.core.formulas import Expression, parse
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only
from fmuid.core.units import Conversion, conversion, conversion_at
from fmuid.data.filtering import LowPass
from fmuid.data.noise.level import NoiseLevel, input_sigma, noise_elsewhere, noise_level, repeated_runs
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.identification.problem.criteria import Criterion, Target, prepare, whitened
from fmuid.simulation.simulator import Simulator, Task

LOGGED = "logged."  # begins the names of inputs that are columns which the plain model does not use
RUN_TIME = LOGGED + "run_time"  # the time since a run began: logs may count time from elsewhere
_T = TypeVar("_T")
_Set = tuple[str, str, Conversion]
"""A value set on a model: the variable, the parameter it comes from, and the conversion between them."""


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One measured signal of a case with its repeats, in the unit of the model's variable.

    Parameters
    ----------
    repeats
        (R, N) samples of the runs that share this case's simulation; NaN where one is missing.
    noise
        Noise of one sample, and its source.
    sensor
        Expressions for ``offset``, ``gain`` and ``delay`` (s) between model and sensor, if any.
    differentiated
        Whether the sensor differentiates its readings over its samples, as for an encoder's speed.
    filter
        Filter applied to measurement (already in `repeats`) and prediction.
    recorded
        Unit in the log, None if it is not known.
    """

    signal: str
    variable: str
    unit: str | None
    repeats: FloatArray
    noise: NoiseLevel
    sensor: Mapping[str, Expression] = field(default_factory=dict)
    differentiated: bool = False
    filter: LowPass | None = None
    recorded: str | None = None

    @property
    def shown_unit(self) -> str:
        """Unit for tables and figures: that of the log, else the model's."""
        return self.recorded or self.unit or ""

    @property
    def to_shown(self) -> Conversion:
        """Conversion of values to `shown_unit`; differences and errors use its factor only."""
        return conversion(self.unit, self.recorded) if self.unit and self.recorded else Conversion()

    @property
    def count(self) -> FloatArray:
        """(N,) number of repeats with a sample."""
        return np.asarray(np.sum(np.isfinite(self.repeats), axis=0), dtype=np.float64)

    @property
    def mean(self) -> FloatArray:
        """(N,) mean over the repeats, NaN where no repeat has a sample."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.nansum(self.repeats, axis=0) / np.where(self.count > 0, self.count, np.nan))

    @property
    def plain(self) -> bool:
        """Whether the sensor shows the model's output unchanged."""
        return not self.sensor and not self.differentiated and self.filter is None

    def sensed(self, time: FloatArray, y: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the sensor reading for the model's (N,) output `y`."""
        shown = self.scaled(time, y, values)
        return shown + self.sensor["offset"](values) if "offset" in self.sensor else shown

    def scaled(self, time: FloatArray, y: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the sensor reading for changes `y`, (..., N), of the model's output (without offset)."""
        if self.differentiated:
            y = np.asarray(np.gradient(y, time, axis=-1))
        if self.filter is not None:
            y = self.filter(time, y)
        if "delay" in self.sensor:
            moved = time - self.sensor["delay"](values)
            y = np.apply_along_axis(lambda row: np.interp(moved, time, row), -1, y)
        return self.sensor["gain"](values) * y if "gain" in self.sensor else y


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One simulation of a problem: its task, its channels and its criteria.

    Parameters
    ----------
    id, setup, machine
        Name of the case, and the setup and machine that it was recorded with.
    simulator, task
        The model, and what it has to simulate.
    channels, criteria
        Measured outputs, and what is judged of them.
    setting
        By parameter name, the model's variable and the conversion from the parameter's unit to the variable's;
        other parameters do not affect this model.
    experiments
        Ids of the experiment and its repeats.
    lead
        Number of the model's samples before the first measured one.
    columns
        (N,) means over repeats, with their units, of the logged columns that the plain model does not use, by the
        names of the inputs that they become.
    input_noise
        Standard deviations of the noise of recorded inputs, where known, by the model's variable and in its unit.
    """

    id: str
    simulator: Simulator
    task: Task
    channels: tuple[Channel, ...]
    criteria: tuple[Criterion, ...]
    setting: Mapping[str, tuple[str, Conversion]]
    experiments: tuple[str, ...] = ()
    setup: str = ""
    lead: int = 0
    machine: str = ""
    columns: Mapping[str, tuple[str, FloatArray]] = field(default_factory=dict)
    input_noise: Mapping[str, float] = field(default_factory=dict)
    _reached: dict[tuple[str, ...], tuple[_Set, ...]] = field(default_factory=dict, init=False, repr=False)

    @property
    def time(self) -> FloatArray:
        """(N,) times of the measured samples, s."""
        return self.task.time[self.lead :]

    def with_model(self, simulator: Simulator) -> Case:
        """Return the case with another model, whose inputs are the same but for the columns that it uses."""
        inputs = {n: u for n, u in self.task.inputs.items() if not _of_log(n)}
        used = {
            name: u for n, (_, u) in self.columns.items() for name in (n, f"'{n}'") if name in simulator.variables
        }
        inputs |= {n: np.append(u, np.full(self.lead, u[-1])) for n, u in used.items()}
        lines, smooth = (
            tuple(n for n in inputs_held if n in inputs)
            for inputs_held in (self.task.linear, self.task.band_limited)
        )
        task = replace(self.task, inputs=inputs, linear=lines, band_limited=smooth)
        return replace(self, simulator=simulator, task=task)

    def values(self, values: Mapping[str, _T]) -> dict[str, _T]:
        """Return the parameters for this case; ``name@case`` becomes the plain name."""
        shared = {n: v for n, v in values.items() if SEPARATOR not in n}
        if len(shared) == len(values):
            return shared
        for suffix in (f"{SEPARATOR}{self.machine}", f"{SEPARATOR}{self.id}"):
            shared |= {n.removesuffix(suffix): v for n, v in values.items() if n.endswith(suffix)}
        return shared

    def start_values(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the values set on the model, by variable, in the model's units."""
        return {
            variable: convert.factor * values[name] + convert.offset
            for variable, name, convert in self.reached(tuple(values))
        }

    def reached(self, names: tuple[str, ...]) -> tuple[_Set, ...]:
        """Return the settings of the model that depend on the parameters `names`."""
        if names not in self._reached:
            known = self.values({name: name for name in names})
            self._reached[names] = tuple(
                (variable, known[name], convert)
                for name, (variable, convert) in self.setting.items()
                if name in known
            )
        return self._reached[names]

    def sensed(self, prediction: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the (channels, N) sensor readings for the model's outputs `prediction`."""
        prediction = prediction[:, self.lead :]
        if all(channel.plain for channel in self.channels):
            return prediction
        of_case = self.values(values)
        return np.array([c.sensed(self.time, y, of_case) for c, y in zip(self.channels, prediction, strict=True)])

    def residuals(self, sensed: FloatArray) -> list[FloatArray]:
        """Return the residual vector of each criterion."""
        rows = {channel.signal: y for channel, y in zip(self.channels, sensed, strict=True)}
        return [criterion.residuals(rows[criterion.signal]) for criterion in self.criteria]


def experiments_of(campaign: Campaign, ids: Iterable[str], *, where: str) -> tuple[Experiment, ...]:
    """Return the experiments that `ids` (or globs) name, in the file's order."""
    chosen: set[str] = set()
    experiments = campaign.measurements.experiments
    for pattern in ids:
        matched = [pattern] if pattern in experiments else fnmatch.filter(experiments, pattern)
        if not matched:
            raise ProblemError(
                f"no experiment matches '{pattern}'",
                where=where,
                fix=suggestion(pattern, experiments),
            )
        chosen |= set(matched)
    return tuple(e for e in campaign.measurements if e.id in chosen)


def from_campaign(
    campaign: Campaign,
    experiments: Sequence[Experiment],
    criteria: Sequence[CriterionSpec],
    simulators: Mapping[str, Simulator],
    *,
    apart: bool = False,
    until: Mapping[str, float] | None = None,
) -> tuple[Case, ...]:
    """Return one case for each group of runs that share a simulation.

    Repeats with the same time axis, inputs and settings share a case; a repeat whose inputs were recorded with
    their own noise is simulated separately, and so is every run if `apart` is True. For a case in `until`, samples
    from that time (s) on count as missing.

    Raises
    ------
    CampaignError
        A criterion calls a function that the campaign names, and the campaign is not trusted.
    """
    groups: list[list[Experiment]] = []
    for experiment in experiments:
        for group in groups:
            if not apart and _same_simulation(group[0], experiment):
                group.append(experiment)
                break
        else:
            groups.append([experiment])
    measured = sorted({name for e in experiments for name in e.outputs})
    for spec in criteria:
        if "function" in spec.options and not campaign.trusted:
            raise CampaignError(
                f"criterion on '{spec.signal}' calls '{spec.options['function']}', code that the campaign chose",
                where=campaign.folder,
                fix="read it first; then run it with --trust, from Python with trust=True",
            )
        if spec.signal not in measured:
            raise ProblemError(
                f"criterion on '{spec.signal}', which no experiment of the stage measures",
                fix=suggestion(spec.signal, measured),
            )
    return tuple(_case(campaign, group, criteria, simulators[group[0].setup], until or {}) for group in groups)


def measured_case(
    id: str,
    simulator: Simulator,
    task: Task,
    measurements: Mapping[str, FloatArray],
    *,
    sigma: Mapping[str, float] | None = None,
    criteria: Sequence[CriterionSpec] = (),
    parameters: Mapping[str, str] | None = None,
) -> Case:
    """Return a case from arrays, without a campaign.

    Parameters
    ----------
    id
        Name of the case in results.
    simulator, task
        The model and its task.
    measurements
        (N,) or (R, N) samples by variable name, all of them among ``task.outputs``.
    sigma
        Noise standard deviations by variable name, also of recorded inputs.
    criteria
        Criteria; by default least squares on every measured variable.
    parameters
        Parameter name -> model variable; a parameter not named here is set under its own name.

    Raises
    ------
    ProblemError
        An output has no measurement, or a measurement does not fit the task.
    """
    channels = []
    for name in task.outputs:
        if name not in measurements:
            raise ProblemError(f"output '{name}' has no measurement", where=id, fix="measure it, or remove it")
        repeats = np.atleast_2d(np.asarray(measurements[name], dtype=np.float64))
        channels.append(
            Channel(name, name, None, read_only(repeats), noise_level(repeats, [(sigma or {}).get(name)]))
        )
    same = Conversion()
    setting = {n: (n, same) for n, v in simulator.variables.items() if v.causality == "parameter"}
    setting |= {n: (v, same) for n, v in (parameters or {}).items()}
    specs = criteria or [CriterionSpec(c.signal) for c in channels]
    prepared = []
    for spec in specs:
        channel = _find(channels, spec.signal, id)
        runs = (RepeatedRuns(id, id, task.time, (channel.signal,), channel.repeats[:, None]),)
        prepared.append(prepare(spec, _target(task.time, channel, task.inputs, runs if whitened(spec) else ())))
    recorded = {n: s for n, s in (sigma or {}).items() if n in task.inputs}
    return Case(
        id, simulator, task, tuple(channels), tuple(prepared), frozen_mapping(setting), input_noise=recorded
    )


def _same_simulation(a: Experiment, b: Experiment) -> bool:
    return (
        a.origin == b.origin
        and a.setup == b.setup
        and a.machine == b.machine
        and dict(a.settings) == dict(b.settings)
        and a.sampled_like(b)
        and a.inputs.keys() == b.inputs.keys()
        and all(np.array_equal(s.values, b.inputs[n].values) for n, s in a.inputs.items())
    )


def _channel(
    campaign: Campaign,
    group: Sequence[Experiment],
    simulator: Simulator,
    *,
    name: str,
    sensor: Mapping[str, Expression],
    known: FloatArray,
) -> Channel:
    """Return the output `name` of repeated runs, with its noise; `known` (N,) is NaN where nothing is compared."""
    first, model = group[0], campaign.models[group[0].setup]
    where = f"signal '{name}' of experiment '{first.id}'"
    variable = _variable(model, name, simulator, f"experiment '{first.id}'")
    unit = model.unit(name, simulator.variables[variable].unit)
    convert = conversion_at(first.outputs[name].unit, unit, where)
    repeats = known * convert(np.array([e.outputs[name].values for e in group]))
    given = [e.outputs[name].sigma for e in group]
    low_pass, gain = None, 1.0
    if name in campaign.filters:
        low_pass = LowPass(campaign.filters[name])
        try:
            repeats, gain = low_pass(first.time, repeats), low_pass.noise_gain(first.time)
        except MeasurementsError as error:
            raise MeasurementsError(error.what, where=where, fix=error.fix) from None
    noise = noise_level(repeats, [None if s is None else gain * abs(convert.factor) * s for s in given])
    if noise.source == "unknown":
        elsewhere = noise_elsewhere(campaign, first, name, unit)
        noise = noise if elsewhere is None else elsewhere.scaled(gain)
    differentiated = model.differentiates(name)
    recorded = first.outputs[name].unit
    return Channel(name, variable, unit, read_only(repeats), noise, sensor, differentiated, low_pass, recorded)


def _case(
    campaign: Campaign,
    group: Sequence[Experiment],
    criteria: Sequence[CriterionSpec],
    simulator: Simulator,
    until: Mapping[str, float],
) -> Case:
    first, model = group[0], campaign.models[group[0].setup]
    id = first.origin if all(e.origin == first.origin for e in group) and len(group) > 1 else first.id
    known_until = np.where(first.time < until.get(id, np.inf), 1.0, np.nan)
    where = f"experiment '{first.id}'"
    variables = simulator.variables
    specs = [spec for spec in criteria if spec.signal in first.outputs]
    if not criteria:
        specs = [CriterionSpec(n) for n in first.outputs if n in model.map or n in variables]
    if not specs:
        raise ProblemError("no criterion applies to its measured outputs", where=where, fix="add a criterion")
    # Without criteria, a sensor is as the stages define it, the last stage first.
    relevant = specs if criteria else [s for stage in campaign.stages.values() for s in stage.criteria]
    sensors = _sensors([s for s in relevant if s.signal in first.outputs], campaign.parameters, where)
    specs = [_without_sensor(spec) for spec in specs]
    channels = [
        _channel(campaign, group, simulator, name=name, sensor=sensors.get(name, {}), known=known_until)
        for name in dict.fromkeys(spec.signal for spec in specs)
    ]
    inputs, input_noise = _inputs(campaign, first, simulator, where)
    columns = _columns(group)
    for variable in (n for n, v in variables.items() if v.causality == "input" and _of_log(n)):
        inputs[variable] = _logged(group, columns, variable.strip("'"))
    known = _settings(campaign, first, model, simulator, where)
    time, raw_inputs = first.time, {name: signal.values for name, signal in first.inputs.items()}
    lead = 0
    if model.timing == "preceding":
        lead = 1
        time = np.concatenate([[2 * time[0] - time[1]], time])
        inputs = {name: np.append(values, values[-1]) for name, values in inputs.items()}
    timings = {model.variable(n): campaign.timings.get(n, model.timing) for n in first.inputs}
    lines, smooth = (
        tuple(n for n in inputs if timings.get(n, model.timing) == how) for how in ("linear", "band-limited")
    )
    kind: Interpolation = "hold"
    if model.timing in ("linear", "band-limited") and all(t == model.timing for t in timings.values()):
        kind = model.timing
    late = [c for c in channels if campaign.timings.get(c.signal, model.timing) == "held-read-after"]
    task = Task(
        time,
        inputs,
        tuple(c.variable for c in channels),
        known,
        kind,
        linear=lines if kind == "hold" else (),
        band_limited=smooth if kind == "hold" else (),
        after=tuple(dict.fromkeys(c.variable for c in late)),
        read_after=model.read_after,
    )
    setting, set_by_run = {}, {model.variable(name) for name in first.settings}
    for spec in campaign.parameters.values():
        variable = model.variable(spec.name)
        if variable in variables and variable not in set_by_run:
            convert = conversion_at(spec.unit, variables[variable].unit, f"parameter '{spec.name}'")
            setting[spec.name] = (variable, convert)
    known_inputs = {n: u[: len(first.time)] for n, u in inputs.items()} | raw_inputs
    prepared = []
    for criterion in specs:
        channel = _find(channels, criterion.signal, where)
        runs = repeated_runs(campaign, first, criterion.signal, channel.unit) if whitened(criterion) else ()
        prepared.append(prepare(criterion, _target(first.time, channel, known_inputs, runs)))
    return Case(
        id,
        simulator,
        task,
        tuple(channels),
        tuple(prepared),
        frozen_mapping(setting),
        tuple(e.id for e in group),
        first.setup,
        lead,
        first.machine,
        columns,
        input_noise,
    )


def _inputs(
    campaign: Campaign, run: Experiment, simulator: Simulator, where: str
) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """Return the inputs of a run by the model's variable, and the standard deviations of their noise if known."""
    model = campaign.models[run.setup]
    inputs, noise = {}, {}
    for name, signal in run.inputs.items():
        variable = _variable(model, name, simulator, where)
        convert = conversion_at(signal.unit, simulator.variables[variable].unit, f"signal '{name}' of {where}")
        inputs[variable] = convert(signal.values)
        sigma = input_sigma(campaign.measurements, run, name)
        if sigma is not None:
            noise[variable] = abs(convert.factor) * sigma
    return inputs, noise


def logged(column: str) -> str:
    """Return the name of the input of a model that a column becomes which the plain model does not use."""
    return LOGGED + re.sub(r"\W", "_", column)


def _of_log(variable: str) -> bool:
    """Return whether an input is a column of the log; flattened Modelica quotes its name."""
    return variable.strip("'").startswith(LOGGED)


def _logged(
    group: Sequence[Experiment], columns: Mapping[str, tuple[str, FloatArray]], variable: str
) -> FloatArray:
    """Return the values of a column that a model has as an input."""
    if variable not in columns:
        raise MeasurementsError(
            f"has no column '{variable.removeprefix(LOGGED)}', on which a coefficient of the model depends",
            where=f"experiment '{next(e.id for e in group if variable not in map(logged, e.unused))}'",
            fix="leave the run out, or add the column",
        )
    return columns[variable][1]


def _columns(group: Sequence[Experiment]) -> dict[str, tuple[str, FloatArray]]:
    """Return unit and mean over repeats of the columns that all of them have and the plain model does not use.

    The time since the run began is one of them.
    """
    common = [n for n in group[0].unused if all(n in e.unused for e in group)]
    return {RUN_TIME: ("s", group[0].time - group[0].time[0])} | {
        logged(n): (group[0].unused[n].unit, np.asarray(np.mean([e.unused[n].values for e in group], axis=0)))
        for n in common
    }


def _variable(model: ModelSpec, name: str, simulator: Simulator, where: str) -> str:
    variable = model.variable(name)
    if variable not in simulator.variables:
        raise FmuError(
            f"{model.fmu.name} has no variable '{variable}' for '{name}'",
            where=where,
            fix=f"correct [models.{model.setup}] map",
        )
    return variable


def _settings(
    campaign: Campaign, experiment: Experiment, model: ModelSpec, simulator: Simulator, where: str
) -> dict[str, float]:
    variables = simulator.variables
    known = {model.variable(n): v for n, v in campaign.settings.items() if model.variable(n) in variables}
    for name, start in model.initial.items():
        known[_variable(model, name, simulator, where)] = start
    for name, number in experiment.settings.items():
        variable = _variable(model, name, simulator, where)
        unit = experiment.setting_units.get(name)
        convert = conversion_at(unit, variables[variable].unit, f"setting '{name}' of {where}")
        known[variable] = convert.factor * number + convert.offset
    return known


def _sensors(
    specs: Sequence[CriterionSpec], parameters: Mapping[str, ParameterSpec], where: str
) -> dict[str, dict[str, Expression]]:
    sensors: dict[str, dict[str, Expression]] = {}
    for spec in specs:
        entries = dict(spec.options.get("sensor", {}))
        for key, text in entries.items():
            expression = parse(str(text), where=f"sensor {key} of '{spec.signal}'")
            unknown = sorted(expression.names - set(parameters))
            if key not in ("offset", "gain", "delay") or unknown:
                raise ProblemError(
                    f"unknown parameter '{unknown[0]}'" if unknown else f"unknown sensor property '{key}'",
                    where=f"sensor of '{spec.signal}' in {where}",
                    fix="use offset, gain and delay with names from [parameters]",
                )
            sensors.setdefault(spec.signal, {})[key] = expression
    return sensors


def _without_sensor(spec: CriterionSpec) -> CriterionSpec:
    options = {k: v for k, v in spec.options.items() if k != "sensor"}
    return CriterionSpec(
        spec.signal, spec.kind, spec.demand, spec.weight, spec.start_time, spec.stop_time, options
    )


def _find(channels: Sequence[Channel], signal: str, where: str) -> Channel:
    for channel in channels:
        if channel.signal == signal:
            return channel
    raise ProblemError(
        f"criterion on '{signal}', which is not measured",
        where=where,
        fix="measured: " + ", ".join(c.signal for c in channels),
    )


def _target(
    time: FloatArray, channel: Channel, inputs: Mapping[str, FloatArray], repeated: tuple[RepeatedRuns, ...]
) -> Target:
    return Target(channel.signal, time, channel.mean, channel.count, channel.noise, inputs, repeated)
