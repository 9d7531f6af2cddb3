"""Checks of a campaign against its models: names, units, causalities, signals and sensitivities."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.campaign import Campaign, ModelSpec, ParameterSpec
from fmuid.core.errors import FmuError, SimulationError, UnitError
from fmuid.core.experiments import Experiment, Signal
from fmuid.core.formulas import parse
from fmuid.core.one_thread import in_one_thread
from fmuid.core.units import conversion
from fmuid.identification.problem.segments import growth_of
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator, Variable

Level = Literal["error", "warning", "note"]
_SETTABLE = ("parameter", "input", "structuralParameter")
_STEP_ERROR = 0.3  # sigmas: a larger change means that the communication step is too long
_GAP = 5.0  # a step longer than this many median steps is a gap in the recording


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding of a check: an `error` prevents an identification, a `warning` may spoil it."""

    level: Level
    where: str
    what: str
    fix: str = ""

    def __str__(self) -> str:
        return f"{self.where}: {self.what}" + (f"; {self.fix}" if self.fix else "")


class _Findings(list[Finding]):
    def add(self, level: Level, where: str, what: str, fix: str = "") -> None:
        self.append(Finding(level, where, what, fix))


def load_models(campaign: Campaign) -> dict[str, Simulator]:
    """Return by setup the models of all experiments that have a role.

    Raises
    ------
    FmuError
        An FMU is missing or cannot be used.
    """
    from fmuid.simulation.coupled.loading import load_simulator

    models: dict[str, Simulator] = {}
    for setup in dict.fromkeys(experiment.setup for experiment in _first_runs(campaign)):
        for path in campaign.models[setup].files:
            if not path.is_file():
                raise FmuError(
                    "is a folder, not an FMU" if path.is_dir() else "no such file",
                    where=os.path.normpath(path),
                    fix=f"build it (make fmus, or fmuid build) or correct [models.{setup}] fmu",
                )
        models[setup] = load_simulator(campaign.models[setup])
    return models


def match_models(campaign: Campaign, simulators: Mapping[str, Simulator]) -> tuple[Finding, ...]:
    """Check that every name in a campaign exists in its models, with the right causality and unit.

    Parameters
    ----------
    campaign
        The campaign.
    simulators
        The model of each setup, as returned by `load_models`.

    Returns
    -------
    tuple of Finding
        Findings that are not errors: inputs that no signal drives, outputs that no model has.

    Raises
    ------
    FmuError
        A signal, setting, start value or parameter has no variable, or its variable has the wrong causality.
    UnitError
        A unit cannot be converted into the variable's.
    """
    findings = _Findings()
    for setup, simulator in simulators.items():
        if tool := simulator.needed_tool:
            findings.add("note", f"[models.{setup}]", f"needs {tool} to be installed (needsExecutionTool)")
    for experiment in _first_runs(campaign):
        model, simulator = campaign.models[experiment.setup], simulators[experiment.setup]
        where = f"experiment '{experiment.id}'"
        judged = _judged_signals(campaign, experiment)
        compared = 0
        for signal in experiment.signals.values():
            named = signal.causality == "input" or signal.name in judged | model.map.keys()
            if not named and signal.name not in simulator.variables:
                findings.add(
                    "note",
                    f"setup '{experiment.setup}'",
                    f"output '{signal.name}' is not in {model.fmu.name}, so it is not compared",
                    f"name its variable in [models.{model.setup}] map if it is",
                )
                continue
            _match_signal(signal, model, simulator.variables, where)
            compared += signal.causality == "output"
        if not compared:
            names = ", ".join(experiment.outputs) or "none"
            raise FmuError(
                f"{model.fmu.name} has none of the measured outputs ({names})",
                where=where,
                fix=f"name its variables in [models.{model.setup}] map",
            )
        for name in experiment.settings:
            variable = _settable(model.variable(name), model, simulator.variables, f"{where}, setting '{name}'")
            _match_unit(experiment.setting_units.get(name), variable, f"{where}, setting '{name}'")
        for name in _undriven(experiment, model, simulator.variables):
            start = simulator.variables[name].start
            kept = "its start value" if start is None else f"{start:g}"
            findings.add("note", f"[models.{model.setup}]", f"input '{name}' is not driven", f"it stays at {kept}")
    _match_names(campaign, simulators)
    return tuple(dict.fromkeys(findings))


def check_signals(campaign: Campaign) -> tuple[Finding, ...]:
    """Check the recordings: uninformative signals, gaps, unknown noise."""
    findings = _Findings()
    for experiment in _first_runs(campaign):
        where = f"experiment '{experiment.id}'"
        steps = np.diff(experiment.time)
        usual = float(np.median(steps))
        longest = int(np.argmax(steps))
        if steps[longest] > _GAP * usual:
            what = (
                f"a gap of {steps[longest]:.3g} s at {experiment.time[longest]:.6g} s where {usual:.3g} s is usual"
            )
            findings.add("warning", where, what, "cut the run there, or leave the gap if the input was constant")
        for signal in experiment.signals.values():
            findings += _check_values(signal, f"{where}, signal '{signal.name}'")
        runs = len(campaign.measurements.repeats(experiment.id))
        if runs == 1 and any(s.sigma is None for s in experiment.outputs.values()):
            fix = "give it (--sigma of fmuid init and import), or repeat the run"
            findings.add("warning", where, "its noise is unknown: one run and no sigma", fix)
    for outlier in campaign.outliers:
        where = f"experiment '{outlier.experiment}', signal '{outlier.signal}'"
        fix = 'check the sensor, or keep them with outliers = "keep" in [campaign]'
        findings.add("warning", where, f"{outlier} excluded", fix)
    return tuple(findings)


@dataclass(frozen=True, slots=True)
class Effect:
    """Effect of a 1 % change of a parameter, at the start of a stage.

    Parameters
    ----------
    change
        Largest root mean square change of a criterion's residuals, in standard deviations of the noise.
    criterion
        The criterion with the largest change.
    step
        Relative step of finite differences, from the simulator's noise floor.
    floor
        That noise floor: the scatter of the stage's residuals under tiny parameter changes, in standard deviations
        of the noise.
    """

    stage: str
    parameter: str
    change: float
    criterion: str
    step: float
    floor: float


@in_one_thread
def check_effects(
    campaign: Campaign, simulators: Mapping[str, Simulator], runner: Runner = in_process
) -> tuple[tuple[Finding, ...], tuple[Effect, ...]]:
    """Simulate each stage around its start, and check what its parameters affect and its runs determine.

    A parameter that affects no output by more than the simulator's own noise is an error; parameters that can only
    be determined in combination, and missing excitation, are warnings (see `uncertainty.sensitivity`). `runner`
    runs the simulations.
    """
    from fmuid.identification.problem.estimation_problem import Problem
    from fmuid.identification.step_error import step_error
    from fmuid.identification.uncertainty.sensitivity import excitation, sensitivity_of

    findings = _Findings(Finding("warning", "identification runs", what) for what in excitation(campaign))
    effects: list[Effect] = []
    for stage in campaign.stages.values():
        where = f"[stages.{stage.name}]"
        try:
            problem = Problem.of_stage(campaign, stage, simulators, runner=runner)
            # First where a worker would report that a model crashes, because growth is examined in this process.
            sensitivity = sensitivity_of(problem)
            if stage.segments is None and not stage.observer:
                longest = {case.setup: case for case in sorted(problem.cases, key=lambda case: np.ptp(case.time))}
                for case in longest.values():
                    growth = growth_of(case, problem.space.to_model(problem.space.start))
                    if growth is not None and growth.runs_away:
                        at, what = (
                            f"{where}, experiment '{case.id}'",
                            f"the simulation diverges in open loop: {growth}",
                        )
                        segments = f'segments = "auto" (about {growth.length:.2g} s)'
                        findings.add("warning", at, what, f"write {segments} or observer = true in the stage")
        except SimulationError as error:
            what = f"cannot be simulated at the start values ({error.what})"
            findings.add("error", where, what, "move the start values")
            continue
        cut = "cut the run there, or use segments"
        findings += [Finding("warning", where, what, cut) for what in problem.findings]
        moved = step_error(campaign, stage, simulators, runner)
        worst = max(moved, key=lambda label: moved[label], default="")
        if worst and moved[worst] > _STEP_ERROR:
            what = f"halving the communication step changes '{worst}' by {moved[worst]:.2g} sigma"
            findings.add("warning", where, what, 'take a shorter step, or extrapolation = "linear"')
        for name, row, step in zip(sensitivity.names, sensitivity.effect, sensitivity.steps, strict=True):
            strongest = int(np.argmax(row))
            label, floor = sensitivity.labels[strongest], sensitivity.floor.residual
            effects.append(Effect(stage.name, name, float(row[strongest]), label, float(step), floor))
        for name in sensitivity.dead:
            fix = "fix it, or add an experiment that excites it"
            findings.add("error", f"{where}, parameter '{name}'", "does not affect any measured output", fix)
        alive = [n for n in sensitivity.identifiability.undetermined if n not in sensitivity.dead]
        if alive:
            fix = "fix one of them, or add an experiment that distinguishes them"
            findings.add("warning", where, str(sensitivity.identifiability), fix)
    return tuple(findings), tuple(effects)


def _first_runs(campaign: Campaign) -> Iterator[Experiment]:
    """Yield the experiments with a role, without repeats, which have the same inputs."""
    used = set(campaign.identification + campaign.validation)
    origins = {campaign.measurements[i].origin for i in used}
    yield from (e for e in campaign.measurements if e.id in origins)


def _judged_signals(campaign: Campaign, experiment: Experiment) -> set[str]:
    return {
        criterion.signal
        for stage in campaign.stages.values()
        if experiment.id in stage.experiments
        for criterion in stage.criteria
        if criterion.signal in experiment.outputs
    }


def _match_signal(signal: Signal, model: ModelSpec, variables: Mapping[str, Variable], where: str) -> None:
    where = f"{where}, signal '{signal.name}'"
    variable = _variable(model.variable(signal.name), model, variables, where)
    if signal.causality == "input" and variable.causality != "input":
        raise FmuError(
            f"'{variable.name}' is {_article(variable.causality)} of {model.fmu.name}, not an input",
            where=where,
            fix=suggestion(signal.name, [v.name for v in variables.values() if v.causality == "input"]),
        )
    if signal.causality == "output" and variable.causality in ("input", "parameter"):
        raise FmuError(
            f"'{variable.name}' is {_article(variable.causality)} of {model.fmu.name}, not a prediction",
            where=where,
            fix=suggestion(signal.name, [v.name for v in variables.values() if v.causality == "output"]),
        )
    _match_unit(signal.unit, replace(variable, unit=model.unit(signal.name, variable.unit)), where)


def _match_names(campaign: Campaign, simulators: Mapping[str, Simulator]) -> None:
    models = {s: m for s, m in campaign.models.items() if s in simulators}
    for setup, model in models.items():
        for name in model.initial:
            _settable(name, model, simulators[setup].variables, f"[models.{setup}] initial")
    every = {name: v for s in models for name, v in simulators[s].variables.items()}
    settable = [n for n, v in every.items() if v.causality == "parameter"]
    helpers = _helper_names(campaign)

    def with_variable(name: str) -> list[tuple[ModelSpec, Mapping[str, Variable]]]:
        pairs = [(model, simulators[setup].variables) for setup, model in models.items()]
        return [(model, variables) for model, variables in pairs if model.variable(name) in variables]

    for name in campaign.settings:
        matches = with_variable(name)
        for model, variables in matches:
            _settable(model.variable(name), model, variables, f"[settings] '{name}'")
        if not matches:
            raise FmuError(f"no FMU has a variable '{name}'", where="[settings]", fix=suggestion(name, settable))
    for spec in campaign.parameters.values():
        matches = with_variable(spec.name)
        for model, variables in matches:
            _match_parameter(spec, model, variables)
        if not matches and spec.name not in helpers and models:
            names = sorted({m.fmu.name for m in models.values()})
            raise FmuError(
                f"{' and '.join(names)} {'has' if len(names) == 1 else 'have'} no variable '{spec.name}'",
                where=f"[parameters.{spec.name}]",
                fix=suggestion(spec.name, settable),
            )


def _helper_names(campaign: Campaign) -> set[str]:
    """Return the parameters that act through ties, sensors or constraints, not as variables of an FMU."""
    names: set[str] = set()
    for stage in campaign.stages.values():
        for text in stage.tie.values():
            names |= parse(text).names
        for criterion in stage.criteria:
            for text in dict(criterion.options.get("sensor", {})).values():
                names |= parse(str(text)).names
    return names


def _match_parameter(spec: ParameterSpec, model: ModelSpec, variables: Mapping[str, Variable]) -> None:
    where = f"[parameters.{spec.name}]"
    variable = _settable(model.variable(spec.name), model, variables, where)
    if variable.type not in ("Real", "Float64", "Float32"):
        raise FmuError(
            f"'{variable.name}' of {model.fmu.name} is {variable.type}, not a real number",
            where=where,
            fix="set it in [settings]",
        )
    _match_unit(spec.unit, variable, where)


def _variable(name: str, model: ModelSpec, variables: Mapping[str, Variable], where: str) -> Variable:
    try:
        return variables[name]
    except KeyError:
        raise FmuError(
            f"{model.fmu.name} has no variable '{name}'", where=where, fix=suggestion(name, variables)
        ) from None


def _settable(name: str, model: ModelSpec, variables: Mapping[str, Variable], where: str) -> Variable:
    variable = _variable(name, model, variables, where)
    # An output or local variable with a start value is a state or a guess.
    calculated = variable.causality in ("output", "local") and variable.start is None
    if (
        calculated
        or variable.causality in ("calculatedParameter", "independent")
        or variable.variability == "constant"
    ):
        raise FmuError(
            f"'{name}' of {model.fmu.name} cannot be set ({_article(variable.causality)})",
            where=where,
            fix=suggestion(name, [n for n, v in variables.items() if v.causality in _SETTABLE]),
        )
    return variable


def _match_unit(unit: str | None, variable: Variable, where: str) -> None:
    if unit is None:
        return
    try:
        conversion(unit, variable.unit)
    except UnitError as error:
        at = f" of variable '{variable.name}'" if "converted" in error.what else ""
        raise UnitError(error.what + at, where=where, fix=error.fix) from None


def _undriven(experiment: Experiment, model: ModelSpec, variables: Mapping[str, Variable]) -> Sequence[str]:
    driven = {model.variable(n) for n in experiment.inputs}
    driven |= {model.variable(n) for n in experiment.settings} | model.initial.keys()
    return [n for n, v in variables.items() if v.causality == "input" and n not in driven]


def _check_values(signal: Signal, where: str) -> list[Finding]:
    known = signal.values[np.isfinite(signal.values)]
    if not known.size:
        return [Finding("error", where, "every sample is missing", "remove the signal")]
    if signal.causality == "output" and np.ptp(known) == 0:
        return [Finding("warning", where, f"is constant at {known[0]:g}", "check the sensor")]
    missing = signal.values.size - known.size
    if missing > 0.5 * signal.values.size:
        return [Finding("warning", where, f"{missing} of {signal.values.size} samples are missing")]
    return []


def _article(causality: str) -> str:
    return f"an {causality}" if causality[:1] in "aeiou" else f"a {causality}"
