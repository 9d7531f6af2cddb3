"""The subject of a diagnosis: models, experiments and effects, ready to be simulated and compared.

Repeats of a reference. In a closed loop the controller reacts to the noise of every run, and an input that is
measured has noise of its own. Each run is simulated with its own input. What the model predicts to differ between
the runs is subtracted from their measurements, which then are repeats of one experiment with the mean input. Their
differences contain the noise that recorded inputs pass on to the outputs, so it is in the noise floor, and in its
covariance.

Segments. Predictions in segments have their initial states fitted to the measurements
(`fmuid.simulation.segmented`). Noise that the states follow is no longer in the residual, so it must not be
expected there, and effects after the simulation, such as a wrong gain of a sensor, must be allowed to move the
states. Both hold if the whitened tangents of the states are projected off every residual and every difference.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.campaign import Campaign, EffectsSpec, ModelSpec, ParameterSpec, StageSpec, without_owner
from fmuid.core.errors import CampaignError, FmuError, SimulationError
from fmuid.core.experiments import Experiment, Outliers
from fmuid.core.formulas import parse
from fmuid.core.immutable import FloatArray, read_only
from fmuid.data.noise.level import noise_level
from fmuid.data.noise.outliers import just_moved, spikes_left
from fmuid.diagnosis.extended_model import CampaignModel, Prediction
from fmuid.diagnosis.observed import Observed, orthonormal
from fmuid.diagnosis.variants import Variants, left_out
from fmuid.diagnosis.verdict import LeftOut
from fmuid.effects.effect import Catalogue, Effect, Unknown
from fmuid.effects.effects_file import load_catalogue
from fmuid.identification.problem.cases import Case, Channel, experiments_of, from_campaign
from fmuid.identification.problem.segments import in_segments, last_stages, why_whole
from fmuid.identification.problem.solver_error import SolverAccuracy, accuracy, solver_accuracy
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.segmented import Segmented
from fmuid.simulation.signal_effects import signal_parameters
from fmuid.simulation.simulator import Simulator


def as_repeats(
    model: CampaignModel, values: Mapping[str, float], reference: Mapping[str, str]
) -> tuple[Case, ...]:
    """Return the cases of a model with repeats of a reference joined.

    Parameters
    ----------
    values
        Nominal parameters; the differences between such runs hardly depend on them.
    reference
        By run, the first run with the same reference.

    Runs that cannot be simulated, or that are predicted in segments, stay apart.
    """
    groups: dict[object, list[Case]] = {}
    for case in model.cases:
        first = reference.get(case.experiments[0], case.id)
        apart = case.id if isinstance(case.simulator, Segmented) else ""
        groups.setdefault((first, case.setup, case.machine, apart), []).append(case)
    return tuple(joined for group in groups.values() for joined in _joined(model, values, group))


def _joined(model: CampaignModel, values: Mapping[str, float], group: Sequence[Case]) -> Sequence[Case]:
    if len(group) == 1:
        return group
    weights = [len(case.experiments) for case in group]
    inputs = {
        name: read_only(np.average([case.task.inputs[name] for case in group], axis=0, weights=weights))
        for name in group[0].task.inputs
    }
    mean = replace(group[0], task=replace(group[0].task, inputs=inputs))
    (outcome,) = replace(model, cases=(mean, *group)).predict([values])
    if isinstance(outcome, SimulationError):
        return group
    moved = [prediction - outcome[0] for prediction in outcome[1:]]
    channels = []
    for k, channel in enumerate(mean.channels):
        rows = [case.channels[k].repeats - y[k] for case, y in zip(group, moved, strict=True)]
        channels.append(_channel(channel, np.concatenate(rows)))
    ids = tuple(id for case in group for id in case.experiments)
    return [replace(mean, channels=tuple(channels), experiments=ids)]


def _channel(channel: Channel, repeats: FloatArray) -> Channel:
    given = channel.noise.source == "given"
    noise = channel.noise if given else noise_level(repeats, [None] * len(repeats))
    return replace(channel, repeats=read_only(repeats), noise=noise)


_DEPENDENT = 1e-8  # smallest singular value of unit columns, relative to the largest


def with_states(observed: Observed, model: CampaignModel, values: Mapping[str, float]) -> Observed:
    """Return the measurements with the initial states of segments as nuisances, linearised at `values`.

    Raises
    ------
    SimulationError
        A segment cannot be simulated.
    """
    if not any(isinstance(case.simulator, Segmented) for case in model.cases):
        return observed
    responses = responses_to_states(observed, model, values)
    return replace(observed, nuisances=tuple(read_only(orthonormal(r, _DEPENDENT)) for r in responses))


def responses_to_states(
    observed: Observed, model: CampaignModel, values: Mapping[str, float]
) -> Iterator[FloatArray]:
    """Yield the whitened responses of each run to the initial states of its segments, linearised at `values`."""
    for case, whiten in zip(model.cases, observed.whiteners, strict=True):
        if isinstance(case.simulator, Segmented):
            at = model.start_values(case, {**model.fixed, **values})
            tangents = case.simulator.state_tangents(at)[:, :, case.lead :]
            yield whiten(tangents).reshape(len(tangents), -1).T
        else:
            yield np.zeros((whiten.size, 0))


def findings_of(model: CampaignModel, stages: Mapping[str, StageSpec]) -> tuple[str, ...]:
    """Return notes on how each setup is predicted; `stages` are the ones whose segments or observer count."""
    findings = []
    for setup in dict.fromkeys(case.setup for case in model.cases):
        simulators = [c.simulator for c in model.cases if c.setup == setup]
        cut = [simulator for simulator in simulators if isinstance(simulator, Segmented)]
        stage = stages.get(setup)
        if stage is not None and not cut and (why := why_whole(stage, simulators[0])):
            findings.append(
                f"Runs of setup '{setup}' are predicted whole, not as stage '{stage.name}' does: with effects, "
                f"{why}. This diagnosis says little about an unstable plant."
            )
        if cut and all(s.length == math.inf for s in cut):
            findings.append(
                f"Runs of setup '{setup}' start from values of {', '.join(cut[0].states)} that are fitted to"
                " each run, not from the model's start values."
            )
        elif cut:
            segments, states = sum(s.segments for s in cut), sum(s.nuisances for s in cut)
            why = f"; stage '{stage.name}' has an observer instead" if stage is not None and stage.observer else ""
            findings.append(
                f"Runs of setup '{setup}' are predicted in {segments} segments, whose {states} initial states are "
                f"fitted as well{why}."
            )
    return tuple(findings)


_STEP = 0.02  # of a nominal parameter relative to its start value: large compared with the noise of solvers
_OF_WIDTH = 1e-3  # of one that starts at zero, relative to its range
_LOOSEST = (3e-3, 1e-3, 1e-4)  # initial solver tolerances
_SLICE = re.compile(r"^(?P<name>.*)\[(?P<index>[\d:,\s]+)\]$")


@dataclass(frozen=True, eq=False)
class Subject:
    """Model, measurements with their noise, nominal parameters and effects to consider.

    `recordings` are the runs in use, by id, with their digests. `modelled` are the effects of the catalogue that
    the campaign's own values put into the model, with these values: they are not candidates. `tolerances` are the
    largest errors that the user tolerates, by signal. `fitted` are values of nominal parameters near which a refit
    of the plain model ends, if one is known.
    """

    model: CampaignModel
    observed: Observed
    nominal: tuple[Unknown, ...]
    catalogue: Catalogue
    effects: tuple[Effect, ...]
    recordings: Mapping[str, str] = field(default_factory=dict)
    modelled: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    outliers: tuple[LeftOut, ...] = ()
    tolerances: Mapping[str, float] = field(default_factory=dict)
    fitted: Mapping[str, float] = field(default_factory=dict)

    @property
    def by_id(self) -> Mapping[str, Effect]:
        """The effects to consider, by id."""
        return {e.id: e for e in self.effects}

    @property
    def starts(self) -> Mapping[str, float]:
        """Start values of the nominal parameters."""
        return {u.name: u.start for u in self.nominal}


def subject_of(
    campaign: Campaign,
    load: Callable[[ModelSpec], Simulator],
    *,
    runner: Runner = in_process,
    experiments: Sequence[str] = (),
) -> Subject:
    """Set up the diagnosis of a campaign.

    Parameters
    ----------
    load
        Loads the model of a setup.
    experiments
        Ids or globs, instead of the campaign's own choice. Repeats are included, except those reserved for
        validation.

    An effect with a nominal parameter is not a candidate, because the parameter is always refitted. Neither is one
    that the campaign holds at a value other than the catalogue's neutral one, because it is in the model.

    Raises
    ------
    CampaignError
        The campaign has no ``[effects]`` table.
    FmuError
        An FMU lacks the parameters of every effect, or one that a tie names.
    """
    spec = _spec(campaign)
    chosen = experiments_of(campaign, experiments or spec.experiments, where="[effects] experiments")
    if experiments:
        named, origins = {e.id for e in chosen}, {e.origin for e in chosen}
        kept = set(campaign.validation) - named
        chosen = tuple(e for e in campaign.measurements if e.origin in origins and e.id not in kept)
    model, catalogue, known, modelled = model_of(campaign, load, chosen, runner=runner)
    nominal = _nominal(campaign, spec, model.cases)
    begin = {u.name: u.start for u in nominal}
    reference = {e.id: e.repeat_of_reference for e in chosen if e.repeat_of_reference is not None}
    model = replace(model, cases=as_repeats(model, begin, reference))
    cases = model.cases
    signals = {c.signal for case in cases for c in case.channels} | {n for case in cases for n in case.task.inputs}
    known |= signal_parameters(signals)
    elsewhere = _elsewhere(campaign) - known
    effects = tuple(
        e.without(elsewhere)
        for e in _not_nominal(campaign, catalogue)
        if any(u.name in known for u in e.unknowns) and e.id not in modelled
    )
    if modelled and not effects:
        raise FmuError(
            f"every effect is already in the model: {', '.join(modelled.values())}",
            where=spec.file,
            fix="set their parameters to neutral values, or add effects",
        )
    missing = [u.name for e in effects for u in e.unknowns if u.name not in known]
    if missing or not effects:
        raise FmuError(
            f"no FMU has '{missing[0]}'" if missing else "no FMU has the parameters of any effect",
            where=spec.file,
            fix=suggestion(missing[0], known) if missing else "name the FMUs that carry the effects in [models]",
        )
    model, findings = solved_well_enough(model, campaign, begin, reference)
    used = {id for case in model.cases for id in case.experiments}
    left_out_of, outliers = _told([o for o in campaign.outliers if o.experiment in used])
    findings += left_out_of
    models = [campaign.models[setup] for setup in {case.setup for case in model.cases}]
    findings += tuple(
        f"Not looked for, because the model cannot be built with it: {', '.join(ids)} ({why})."
        for why, ids in left_out(models, catalogue, known).items()
    )
    recordings = {e.id: e.digest for e in chosen}
    stages = last_stages(campaign)
    findings += findings_of(model, stages)
    observed = with_states(Observed.from_runs(model.runs), model, {**begin, **spec.fitted})
    told = recordings, modelled, findings, outliers
    return Subject(model, observed, nominal, catalogue, effects, *told, fitted=spec.fitted)


def without_spikes(subject: Subject, predicted: Prediction, values: Mapping[str, float]) -> Subject:
    """Return the subject without samples that stick out of what a prediction leaves of runs without repeats.

    The noise is estimated again, and start states that are estimated are linearised at `values`.
    """
    runs, spiked = list(subject.observed.runs), list[Outliers]()
    for e, (run, case, prediction) in enumerate(zip(runs, subject.model.cases, predicted, strict=True)):
        if run.n_repeats > 1:
            continue
        stirred = just_moved([u[case.lead :] for u in case.task.inputs.values()], len(run.time))
        spikes = np.array([spikes_left(y, p, stirred) for y, p in zip(run.values[0], prediction, strict=True)])
        shown = zip(run.channels, spikes, strict=True)
        spiked += [Outliers(run.id, c, "spike", tuple(map(float, run.time[at]))) for c, at in shown if at.any()]
        runs[e] = replace(run, values=np.where(spikes, np.nan, run.values))
    if not spiked:
        return subject
    observed = replace(Observed.from_runs(runs), predicted=subject.observed.predicted)
    findings, outliers = _told(spiked)
    return replace(
        subject,
        observed=with_states(observed, subject.model, values),
        findings=(*subject.findings, *findings),
        outliers=(*subject.outliers, *outliers),
    )


def _told(outliers: Sequence[Outliers]) -> tuple[tuple[str, ...], tuple[LeftOut, ...]]:
    """Return findings about outliers that were left out, and their numbers."""
    findings = (f"Left out of experiment '{o.experiment}', signal '{o.signal}': {o}." for o in outliers)
    return tuple(findings), tuple(LeftOut(o.experiment, o.signal, len(o.times)) for o in outliers)


def _elsewhere(campaign: Campaign) -> set[str]:
    """Return the effect parameters of all signals of the campaign, whether or not they are in the runs in use."""
    runs = [e for e in campaign.measurements if e.setup in campaign.models]
    inputs = {campaign.models[e.setup].variable(name) for e in runs for name in e.inputs}
    return signal_parameters({name for e in runs for name in e.outputs} | inputs)


def solved_well_enough(
    model: CampaignModel,
    campaign: Campaign,
    values: Mapping[str, float],
    reference: Mapping[str, str] | None = None,
) -> tuple[CampaignModel, tuple[str, ...]]:
    """Return the model with the loosest tolerances whose errors no measurement would show, and findings.

    `reference` tells which runs repeat the reference of another (`as_repeats`). Runs that cannot be predicted to
    their end at any tolerance are cut where prediction fails.
    """
    accuracy = _accuracy(model, values)
    cases: Sequence[Case] = model.cases
    if accuracy.until:
        recorded = {c.id: [campaign.measurements[id] for id in c.experiments] for c in cases}
        cut = {
            c.id: from_campaign(campaign, recorded[c.id], (), {c.setup: c.simulator}, until=accuracy.until)
            for c in cases
            if c.id in accuracy.until
        }
        joined = {id: as_repeats(replace(model, cases=c), values, reference or {})[0] for id, c in cut.items()}
        cases = [joined.get(c.id, c) for c in cases]
    return replace(model, cases=accuracy.applied(cases)), accuracy.findings


def tightened(subject: Subject, points: Sequence[Mapping[str, float]]) -> Subject:
    """Return the subject with tolerances that are tight enough at these points as well; `subject` if its own are.

    An effect may need a tighter one than the plain model, which is solved anew at every jump of an input: then
    only points that name its parameters get it. A point that cannot be predicted whatever the tolerance is left
    out.
    """
    model, always = subject.model, {u.name for u in subject.nominal}
    every = [(k, case, values) for values in points for k, case in enumerate(model.cases_at(values))]
    sigma = _sigma(model)
    result = accuracy(
        [replace(case, id=f"{n}") for n, (_, case, _) in enumerate(every)],
        lambda wanted: model.predict_cases([(every[n][0], task, every[n][2]) for n, task in wanted]),
        sigma=[sigma[k] for k, _, _ in every],
    )
    needed: dict[frozenset[str], dict[str, float]] = {}
    for n, (_, case, values) in enumerate(every):
        tolerance = result.tolerances.get(f"{n}", np.inf)
        if f"{n}" not in result.until and tolerance < (
            case.task.tolerance or case.simulator.default_tolerance or 0.0
        ):
            of = needed.setdefault(frozenset(values.keys() - always), {})
            of[case.id] = min(of.get(case.id, np.inf), tolerance)
    if not needed:
        return subject
    plain = SolverAccuracy(needed.pop(frozenset(), {}))
    finer = {names: {**model.finer.get(names, {}), **of} for names, of in needed.items()}
    model = replace(model, cases=plain.applied(model.cases), finer={**model.finer, **finer})
    return replace(subject, model=model)


def _sigma(model: CampaignModel) -> list[FloatArray]:
    noise = Observed.from_runs(model.runs).noise
    return [noise[run.setup].of_mean(run.n_repeats) for run in model.runs]


def _accuracy(model: CampaignModel, values: Mapping[str, float]) -> SolverAccuracy:
    every = {**model.fixed, **values}
    starts = [model.start_values(case, every) for case in model.cases]
    return solver_accuracy(model.cases, every, starts, model.runner, sigma=_sigma(model), loosest=_LOOSEST)


def model_of(
    campaign: Campaign,
    load: Callable[[ModelSpec], Simulator],
    chosen: Sequence[Experiment],
    *,
    runner: Runner = in_process,
) -> tuple[CampaignModel, Catalogue, set[str], dict[str, str]]:
    """Return the model of the chosen runs that carries the effects.

    Also return the catalogue of effects, the names of the model's variables, and the effects that the campaign's
    own values put into the model, with these values.
    """
    spec = _spec(campaign)
    catalogue = load_catalogue(spec.file)
    setups = list(dict.fromkeys(e.setup for e in chosen))
    models = {s: _with_effects(campaign, s, catalogue) for s in setups}
    campaign = replace(campaign, models={**campaign.models, **models})
    simulators = {s: load(models[s]) for s in setups}
    cases = in_segments(campaign, chosen, simulators, campaign.start_values)
    known = {name for s in simulators.values() for name in s.variables}
    # A gap is examined along variables that every model in use has; one that none has is reported later.
    common = set.intersection(*(set(s.variables) for s in simulators.values()))
    regimes = {n: r for n, r in catalogue.regimes.items() if r.variable in common or r.variable not in known}
    ports = {n: p for n, p in catalogue.ports.items() if not p.added or p.input in known}
    catalogue = replace(catalogue, regimes=regimes, ports=ports)
    tie = {
        name: parse(text, where="[effects] tie")
        for target, text in spec.tie.items()
        for name in expand_slice(target, known)
        if name != text  # a slice may contain the element that the others follow
    }
    fixed = campaign.start_values
    modelled: dict[str, str] = {}
    for effect in _not_nominal(campaign, catalogue):
        sizes = [u.name for u in effect.unknowns if u.name not in effect.shapes]
        for name, value in ((n, v) for case in cases for n in sizes for v in _held(case, n, fixed)):
            if not math.isclose(value, effect.neutral[name], rel_tol=1e-9):
                modelled[effect.id] = f"{name} = {value:.6g}"
        if effect.id not in modelled:
            # Its own values act from here on, whatever name and unit the campaign gives them.
            modelled_names = {u.name for u in effect.unknowns}
            cases = tuple(_without(case, modelled_names) for case in cases)
            fixed = {n: effect.neutral.get(without_owner(n), v) for n, v in fixed.items()}
    variants = Variants({s: m for s, m in models.items() if m.source is not None}, catalogue, load)
    return CampaignModel(cases, runner, fixed, tie, variants.simulator), catalogue, known, modelled


def _not_nominal(campaign: Campaign, catalogue: Catalogue) -> list[Effect]:
    """Return the effects without nominal parameters."""
    assert campaign.effects is not None
    nominal = set(campaign.effects.nominal)
    nominal |= {m.variable(name) for name in nominal for m in campaign.models.values()}
    return [e for e in catalogue.effects.values() if not any(u.name in nominal for u in e.unknowns)]


def _held(case: Case, unknown: str, fixed: Mapping[str, float]) -> list[float]:
    """Return the values that a campaign gives an effect's parameter in a case, in the model's unit, if any."""
    if unknown in case.task.start_values:
        return [case.task.start_values[unknown]]
    values = case.values(fixed)
    given = [
        to.factor * values[n] + to.offset for n, (variable, to) in case.setting.items() if variable == unknown
    ]
    of_a_signal = unknown in values and unknown not in case.simulator.variables
    return [values[unknown]] if of_a_signal else given


def _without(case: Case, variables: Collection[str]) -> Case:
    """Return the case without the parameters of the campaign that set one of the model's `variables`."""
    if not any(variable in variables for variable, _ in case.setting.values()):
        return case
    return replace(case, setting={n: to for n, to in case.setting.items() if to[0] not in variables})


def _spec(campaign: Campaign) -> EffectsSpec:
    if campaign.effects is None or campaign.effects.catalogue is None:
        raise CampaignError(
            "the campaign names no catalogue of effects",
            where=f"{campaign.folder / 'campaign.toml'}",
            fix='add [effects] with catalogue = "..."',
        )
    return campaign.effects


def expand_slice(target: str, known: Sequence[str] | set[str]) -> list[str]:
    """Return the elements of an array that a slice such as ``lossTable[:,4:5]`` names, or the name itself.

    Raises
    ------
    FmuError
        No element is among `known`.
    """
    if target in known:
        return [target]
    names = []
    match = _SLICE.match(target)
    if match:
        wanted = [_range(part) for part in match["index"].split(",")]
        for name in known:
            other = _SLICE.match(name)
            if other is None or other["name"] != match["name"]:
                continue
            index = [int(i) for i in other["index"].split(",")]
            if len(index) == len(wanted) and all(a <= i <= b for i, (a, b) in zip(index, wanted, strict=True)):
                names.append(name)
    if not names:
        raise FmuError(f"no FMU has '{target}'", where="[effects] tie", fix=suggestion(target, known))
    return sorted(names)


def _range(part: str) -> tuple[float, float]:
    first, _, last = part.strip().partition(":")
    if ":" not in part:
        return float(first), float(first)
    return float(first) if first else -np.inf, float(last) if last else np.inf


def _with_effects(campaign: Campaign, setup: str, catalogue: Catalogue) -> ModelSpec:
    model = campaign.models[setup]
    coupling = model.coupling
    if coupling is not None:
        components = {name: carrier(file, catalogue) for name, file in coupling.components.items()}
        coupling = replace(coupling, components=components)
    return replace(model, fmu=carrier(model.fmu, catalogue), coupling=coupling)


def carrier(file: Path, catalogue: Catalogue) -> Path:
    """Return the file that carries the effects in place of a plain one."""
    return file.with_name(f"{catalogue.models.get(file.stem, file.stem)}{file.suffix}")


def _nominal(campaign: Campaign, spec: EffectsSpec, cases: Sequence[Case]) -> tuple[Unknown, ...]:
    """Return the nominal parameters; those that differ between machines or experiments, one per owner."""
    helpers = {n for text in spec.tie.values() for n in parse(text).names}
    unknowns: list[Unknown] = []
    for name in spec.nominal:
        affected = [case for case in cases if name in helpers or name in case.setting or name in _of_sensors(case)]
        if not affected:
            raise CampaignError(
                f"nominal parameter '{name}' affects no model",
                where="[effects]",
                fix="remove it, or tie a variable to it",
            )
        parameter = campaign.parameters[name]
        owners: dict[str, list[str]] = {
            "campaign": [],
            "machine": [c.machine for c in affected],
            "experiment": [c.id for c in affected],
        }
        unknowns += map(unknown_of, parameter.of_each(owners[parameter.per]) or [parameter])
    return tuple(unknowns)


def _of_sensors(case: Case) -> set[str]:
    return {n for channel in case.channels for expression in channel.sensor.values() for n in expression.names}


def unknown_of(p: ParameterSpec) -> Unknown:
    """Convert a parameter of the campaign to an unknown."""
    width = p.upper - p.lower
    step = _STEP * abs(p.start) if p.start != 0.0 else _OF_WIDTH * (width if np.isfinite(width) else 1.0)
    return Unknown(p.name, p.start, p.lower, p.upper, step)
