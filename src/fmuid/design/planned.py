"""The run to be designed: a setup's model with its sensors, driven inputs and limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.campaign import Campaign, Limit, ModelSpec
from fmuid.core.errors import CampaignError, FmuError
from fmuid.core.experiments import Experiment, Measurements, Signal, widened
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only
from fmuid.core.units import Conversion, conversion_at
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.data.noise.spectrum import SetupNoise, Whitener, estimate_noise, whitener
from fmuid.design.excitation import Bounds, Signals
from fmuid.diagnosis.extended_model import CampaignModel, Prediction
from fmuid.identification.problem.cases import Case, from_campaign
from fmuid.identification.problem.solver_error import solver_accuracy
from fmuid.simulation.simulator import Simulator

DESIGNED = "designed"
_BEYOND = 0.5  # share of the range of recorded runs by which a designed one may exceed it, where no limit is given
_SAMPLES = 1000  # samples of a run without a given sample time
_LOOSEST = (1e-3, 1e-4)  # initial solver tolerances
_TYPICAL = 0.7  # typical value of each number that defines an excitation
_FEWEST = 20  # smallest number of samples for which a design makes sense


@dataclass(frozen=True, slots=True)
class Driven:
    """An input to be designed: its name in measurements, FMU variable, and bounds in the variable's unit.

    `written` converts from the variable's unit to `unit`, the unit in the output file.
    """

    name: str
    variable: str
    bounds: Bounds
    unit: str
    written: Conversion


@dataclass(frozen=True, slots=True)
class Watched:
    """A quantity with limits (in the model's unit), read by a sensor or inside the model."""

    name: str
    variable: str
    lower: float
    upper: float
    channel: int | None = None

    def left(self, values: FloatArray) -> float:
        """Return the share of the range (or bound) by which the values exceed the limits, 0 if they do not."""
        over = max(float(np.max(values)) - self.upper, self.lower - float(np.min(values)))
        finite = [abs(b) for b in (self.lower, self.upper) if np.isfinite(b)]
        width = self.upper - self.lower if len(finite) == 2 else max(finite, default=1.0)
        return max(0.0, over) / (width or 1.0)


@dataclass(frozen=True, slots=True)
class Settable:
    """A value, such as a payload, that a run can set on the model, in the model's unit."""

    name: str
    variable: str
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class Planned:
    """A run without its excitation.

    Attributes
    ----------
    model
        Model of the single run, at rest.
    whiten
        Whitens (C, N) differences of predictions by the noise of the mean of the run's repeats.
    sigma
        (C,) standard deviation of a sample.
    """

    model: CampaignModel
    whitener: Whitener
    repeats: int
    driven: tuple[Driven, ...]
    watched: tuple[Watched, ...]
    settable: tuple[Settable, ...]
    sigma: FloatArray
    assumed: tuple[str, ...] = ()

    @property
    def case(self) -> Case:
        """The run."""
        return self.model.cases[0]

    @property
    def time(self) -> FloatArray:
        """(N,) sample times, s."""
        return self.case.time

    def whiten(self, difference: FloatArray) -> FloatArray:
        """Whiten (C, N) differences by the noise of the mean of the repeats, to (C * N,)."""
        return np.asarray(np.sqrt(self.repeats) * self.whitener(difference).ravel())

    def under(self, samples: FloatArray) -> CampaignModel:
        """Return the model with its inputs driven by (inputs, N) samples in the model's units."""
        return replace(self.model, cases=(self.driven_case(samples),))

    def driven_case(self, samples: FloatArray) -> Case:
        """Return the run driven by (inputs, N) samples in the model's units."""
        inputs = {d.variable: u for d, u in zip(self.driven, samples, strict=True)}
        if self.case.lead:
            inputs = {name: np.append(u, u[-1]) for name, u in inputs.items()}
        return replace(self.case, task=replace(self.case.task, inputs={**self.case.task.inputs, **inputs}))

    def solved_well_enough(self, shapes: Sequence[Signals], points: Sequence[Mapping[str, float]]) -> Planned:
        """Return the run with a solver tolerance whose errors no measurement would show for any excitation.

        One excitation of each shape is tried at every point.
        """
        cases, starts = [], []
        for k, (shape, values) in enumerate((shape, values) for shape in shapes for values in points):
            case = self.driven_case(shape(np.full(shape.size, _TYPICAL), self.time))
            starts.append(self.model.start_values(case, {**self.model.fixed, **values}))
            simulator = self.model.variant(case.setup, starts[-1]) or case.simulator
            cases.append(replace(case, id=f"{k}", simulator=simulator))
        sigma = [self.sigma / np.sqrt(self.repeats)] * len(cases)
        accuracy = solver_accuracy(cases, points[0], starts, self.model.runner, sigma=sigma, loosest=_LOOSEST)
        tightest = min(accuracy.tolerances.values(), default=self.case.task.tolerance)
        task = replace(self.case.task, tolerance=tightest)
        return replace(self, model=replace(self.model, cases=(replace(self.case, task=task),)))

    def violation(
        self, model: CampaignModel, points: Sequence[Mapping[str, float]], predictions: Sequence[Prediction]
    ) -> tuple[float, str]:
        """Return the largest violation of the limits in the runs, and the limit concerned.

        Raises
        ------
        SimulationError
            A run failed.
        """
        worst, name = 0.0, ""
        hidden = [w for w in self.watched if w.channel is None]
        for values, (prediction,) in zip(points, predictions, strict=True):
            inside = model.trajectories(values, [w.variable for w in hidden])[0] if hidden else ()
            rows = dict(zip((w.name for w in hidden), inside, strict=True))
            for w in self.watched:
                over = w.left(rows[w.name] if w.channel is None else prediction[w.channel])
                if over > worst:
                    worst, name = over, w.name
        return worst, name


def template_of(campaign: Campaign, simulator: Simulator, setup: str) -> Case:
    """Return a run at rest for a setup without recordings, with the outputs whose noise the user gives.

    Raises
    ------
    CampaignError
        No duration or no standard deviation is given.
    FmuError
        An output does not exist in the model.
    """
    spec, where = campaign.design, f"{campaign.file or campaign.folder}"
    if spec.duration is None:
        raise CampaignError(
            "has no duration, and no run is recorded", where=f"{where} [limits]", fix="write duration = ..."
        )
    if not spec.sigma:
        raise CampaignError(
            "gives no noise of the outputs, and no run is recorded",
            where=f"{where} [design]",
            fix="write sigma = { output = ... }",
        )
    run = unrecorded_run(campaign, simulator, setup, unrecorded_times(spec.duration, spec.sample_time))
    campaign = replace(campaign, measurements=Measurements({DESIGNED: run}))
    return from_campaign(campaign, [run], (), {setup: simulator})[0]


def unrecorded_times(duration: float, sample_time: float | None) -> FloatArray:
    """Return the (N,) sample times of a run without recording; a thousand samples if no sample time is given."""
    return _times(duration, sample_time or duration / _SAMPLES)


def unrecorded_run(
    campaign: Campaign,
    simulator: Simulator,
    setup: str,
    time: FloatArray,
    driven: Mapping[str, Signal] = frozen_mapping({}),
) -> Experiment:
    """Return a run of a setup at (N,) times without recording: its outputs are zero.

    It has the outputs whose noise the user gives, or else those that other runs of the setup measure, or else
    those of the model. Inputs that are not `driven` stay at their start values.

    Raises
    ------
    FmuError
        The model has no such output, or no such input.
    """
    spec, model = campaign.design, campaign.models[setup]
    variables = simulator.variables
    given: dict[str, tuple[str | None, float | None]] = {n: (None, sigma) for n, sigma in spec.sigma.items()}
    recorded = {n: (s.unit, None) for e in campaign.measurements if e.setup == setup for n, s in e.outputs.items()}
    outputs = {v.name: (None, None) for v in variables.values() if v.causality == "output"}
    measured = given or {n: u for n, u in recorded.items() if model.variable(n) in variables} or outputs
    signals = {}
    for name, (written, sigma) in measured.items():
        variable = model.variable(name)
        if variable not in variables:
            raise FmuError(
                f"{model.fmu.name} has no variable '{variable}'",
                where=f"{campaign.file or campaign.folder} [design] sigma",
                fix=suggestion(variable, [v.name for v in variables.values() if v.causality == "output"]),
            )
        unit = written or model.unit(name, variables[variable].unit) or "1"
        signals[name] = Signal(name, np.zeros(len(time)), unit, "output", sigma)
    inputs = [v for v in variables.values() if v.causality == "input"]
    for name in driven:
        if model.variable(name) not in {v.name for v in inputs}:
            raise FmuError(
                f"{model.fmu.name} has no input '{name}'", fix=suggestion(name, [v.name for v in inputs])
            )
    reached = {model.variable(name) for name in driven}
    back = {variable: name for name, variable in model.map.items()}
    for still in (v for v in inputs if v.name not in reached):
        name = back.get(still.name, still.name)
        signals[name] = Signal(name, np.full(len(time), still.start or 0.0), still.unit or "1", "input")
    return Experiment(DESIGNED, setup, time, {**signals, **driven})


def planned_run(
    campaign: Campaign, model: CampaignModel, template: Case, noise: SetupNoise | None = None
) -> Planned:
    """Return the run to be designed.

    Parameters
    ----------
    model
        Model to simulate; its recorded runs show how far the rig has been driven.
    template
        A run of the same setup.
    noise
        Noise of the setup; by default, the noise that the user gives for the template's outputs.

    Raises
    ------
    CampaignError, FmuError, UnitError
        A limit applies to no quantity of the model, or cannot be satisfied.
    """
    spec, of_setup = campaign.design, campaign.models[template.setup]
    step = spec.sample_time or float(np.median(np.diff(template.time)))
    time = _times(spec.duration or float(np.ptp(template.time)), step)
    channels = tuple(replace(c, repeats=read_only(np.zeros((1, len(time))))) for c in template.channels)
    rest = {n: float(u[0]) for n, u in template.task.inputs.items()}
    recorded = [c for c in model.cases if c.setup == template.setup]
    limits, assumed = _limits(campaign, template, recorded)
    driven, watched, settable = _resolved(campaign, of_setup, template, limits, rest)
    if not driven:
        inputs = [v.name for v in template.simulator.variables.values() if v.causality == "input"]
        raise CampaignError(
            f"no input of setup '{template.setup}' has limits, so none can be driven",
            where=f"{campaign.file or campaign.folder} [limits]",
            fix=f"give min and max of {' or '.join(inputs) or 'an input'}",
        )
    full = np.concatenate([[2 * time[0] - time[1]], time]) if template.lead else time
    task = replace(
        template.task, time=full, inputs={n: np.full(len(full), at) for n, at in rest.items()}, along=()
    )
    case = replace(template, id=DESIGNED, task=task, channels=channels, criteria=(), experiments=(DESIGNED,))
    given = np.array([c.noise.sigma if c.noise.source == "given" else np.nan for c in channels])
    run = RepeatedRuns(
        DESIGNED,
        case.setup,
        time,
        tuple(c.signal for c in channels),
        np.zeros((1, len(channels), len(time))),
        given,
    )
    if noise is None:
        noise = estimate_noise([run])
    sigma = np.where(np.isfinite(given), given, np.sqrt(noise.variance + noise.repeating))
    whitened = whitener(run, replace(noise, pieces=1))
    designed = replace(model, cases=(case,))
    return Planned(designed, whitened, spec.repeats, driven, watched, settable, sigma, assumed)


def _times(duration: float, step: float) -> FloatArray:
    count = int(np.floor(duration / step * (1 + 1e-9)))
    if count < _FEWEST:
        raise CampaignError(
            f"a run of {duration:g} s has {count} samples of {step:g} s",
            where="[limits] duration",
            fix="make it longer, or give a shorter sample_time in [design]",
        )
    return np.asarray(step * np.arange(count + 1))


def _limits(
    campaign: Campaign, template: Case, recorded: Sequence[Case]
) -> tuple[dict[str, Limit], tuple[str, ...]]:
    """Return the user's limits, or, if no input has any, the range of recorded runs, in the model's units."""
    limits, model = dict(campaign.design.limits), campaign.models[template.setup]
    variables = template.simulator.variables
    asked = {model.variable(name) for name in limits}
    if any(v in asked for v in template.task.inputs) or not recorded:
        return limits, ()
    assumed = []
    back = {model.variable(n): n for e in campaign.measurements for n in e.inputs}
    for name in template.task.inputs:
        ranges = [c.task.inputs[name] for c in recorded if name in c.task.inputs]
        slopes = [
            np.max(np.abs(np.diff(c.task.inputs[name]) / np.diff(c.task.time)))
            for c in recorded
            if name in c.task.inputs
        ]
        low, high = widened(ranges)
        if low < high:
            limits[back.get(name, name)] = Limit(name, low, high, float(max(slopes)), variables[name].unit)
            assumed.append(
                f"{back.get(name, name)} from {low:.4g} to {high:.4g}, at most {max(slopes):.4g} per second"
            )
    for k, channel in enumerate(template.channels):
        if channel.signal in limits:
            continue
        means = [
            c.channels[k].mean for c in recorded if len(c.channels) > k and c.channels[k].signal == channel.signal
        ]
        low, high = widened(means, _BEYOND)
        limits[channel.signal] = Limit(channel.signal, low, high, unit=channel.unit)
        assumed.append(f"{channel.signal} from {low:.4g} to {high:.4g}")
    return limits, tuple(assumed)


def _resolved(
    campaign: Campaign, model: ModelSpec, template: Case, limits: Mapping[str, Limit], rest: Mapping[str, float]
) -> tuple[tuple[Driven, ...], tuple[Watched, ...], tuple[Settable, ...]]:
    variables = template.simulator.variables
    recorded = {n: s for e in campaign.measurements for n, s in e.inputs.items() if e.setup == template.setup}
    driven, watched, settable = [], [], []
    for name, limit in limits.items():
        where = f"{campaign.file or campaign.folder} [limits] {name}"
        variable = model.variable(name)
        if variable not in variables:
            known = [v.name for v in variables.values() if v.causality in ("input", "output")]
            raise FmuError(
                f"{model.fmu.name} has no variable '{variable}'", where=where, fix=suggestion(name, known)
            )
        unit = model.unit(name, variables[variable].unit)
        convert = conversion_at(limit.unit, unit, where)
        low, high = sorted(convert.factor * b + convert.offset for b in (limit.lower, limit.upper))
        match variables[variable].causality:
            case "input":
                if not (np.isfinite(low) and np.isfinite(high)):
                    raise CampaignError("an input needs both limits", where=where, fix="give min and max")
                at = float(np.clip(rest.get(variable, variables[variable].start or 0.0), low, high))
                written = recorded[name].unit if name in recorded else limit.unit or unit or "1"
                back = conversion_at(unit, written, where) if unit else Conversion()
                bounds = Bounds(low, high, abs(convert.factor) * limit.rate, at)
                driven.append(Driven(name, variable, bounds, written, back))
            case "parameter":
                settable.append(Settable(name, variable, low, high))
            case _:
                if np.isfinite(limit.rate):
                    raise CampaignError("only an input has a rate", where=where, fix="remove rate")
                channel = next(
                    (k for k, c in enumerate(template.channels) if name in (c.signal, c.variable)), None
                )
                watched.append(Watched(name, variable, low, high, channel))
    return tuple(driven), tuple(watched), tuple(settable)
