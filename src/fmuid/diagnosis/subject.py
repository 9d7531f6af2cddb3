"""From a campaign to what a diagnosis works on: the model with effects, the nominal parameters, the noise."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.campaign import Campaign, EffectsSpec, ModelSpec, ParameterSpec
from fmuid.core.errors import CampaignError, FmuError, SimulationError
from fmuid.core.formulas import parse
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.catalogue import Catalogue, Effect, load_catalogue
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.modelled_noise import observe
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Unknown
from fmuid.diagnosis.signal_effects import NEUTRAL
from fmuid.identification.problem.cases import experiments_of, from_campaign
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator

# Looser than an FMU's default and still far below any noise floor: solver errors stay under 1 % of a noise sigma.
_TOLERANCE = 1e-4
_LOOSER = (3e-3, 1e-3)  # taken for an experiment whose whole prediction then moves by less than this many sigmas:
_UNSEEN = 0.2
_SLICE = re.compile(r"^(?P<name>.*)\[(?P<index>[\d:,\s]+)\]$")


@dataclass(frozen=True, eq=False)
class Subject:
    """What is diagnosed: model, measurements with their noise, nominal parameters and the effects to consider."""

    model: CampaignModel
    observed: Observed
    nominal: tuple[Unknown, ...]
    catalogue: Catalogue
    effects: tuple[Effect, ...]


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
        Ids or globs, instead of the campaign's own choice.

    An effect of which a parameter is nominal is none: it is refitted always.

    Raises
    ------
    CampaignError
        The campaign has no ``[effects]`` table.
    FmuError
        An FMU lacks the parameters of every effect, or one that a tie names.
    """
    model, catalogue, known = model_of(campaign, load, runner=runner, experiments=experiments)
    spec = campaign.effects
    assert spec is not None
    cases = model.cases
    signals = {c.signal for case in cases for c in case.channels} | {n for case in cases for n in case.task.inputs}
    known |= {f"{signal}.{name}" for signal in signals for name in NEUTRAL}
    given = {m.variable(name) for name in spec.nominal for m in campaign.models.values()}
    effects = tuple(
        e
        for e in catalogue.effects.values()
        if any(u.name in known for u in e.unknowns) and not any(u.name in given for u in e.unknowns)
    )
    missing = [u.name for e in effects for u in e.unknowns if u.name not in known]
    if missing or not effects:
        raise FmuError(
            f"no FMU has '{missing[0]}'" if missing else "no FMU has the parameters of any effect",
            where=spec.catalogue,
            fix=suggestion(missing[0], known) if missing else "name the FMUs that carry the effects in [models]",
        )
    nominal = _nominal(campaign, spec, cases_parameters={n for c in cases for n in c.setting})
    observed = observe(model, nominal, effects)
    return Subject(_loosened(model, observed, nominal), observed, nominal, catalogue, effects)


def _loosened(model: CampaignModel, observed: Observed, nominal: Sequence[Unknown]) -> CampaignModel:
    """Give every experiment the loosest solver tolerance whose error no measurement would show."""
    start = {u.name: u.start for u in nominal}

    def predicted(tolerance: float) -> Sequence[FloatArray] | SimulationError:
        cases = tuple(replace(c, task=replace(c.task, tolerance=tolerance)) for c in model.cases)
        return replace(model, cases=cases).predict([start])[0]

    exact = predicted(0.1 * _TOLERANCE)
    chosen = [_TOLERANCE] * len(model.cases)
    for tolerance in reversed(_LOOSER):
        coarse = predicted(tolerance)
        if isinstance(exact, SimulationError) or isinstance(coarse, SimulationError):
            break
        errors = observed.whiten([a - b for a, b in zip(coarse, exact, strict=True)])
        for k, (error, count) in enumerate(zip(errors, observed.repeats, strict=True)):
            if chosen[k] > 0.05 * tolerance and np.sqrt(count) * np.linalg.norm(error) < _UNSEEN:
                chosen[k] = tolerance
    cases = tuple(replace(c, task=replace(c.task, tolerance=t)) for c, t in zip(model.cases, chosen, strict=True))
    return replace(model, cases=cases)


def model_of(
    campaign: Campaign,
    load: Callable[[ModelSpec], Simulator],
    *,
    runner: Runner = in_process,
    experiments: Sequence[str] = (),
) -> tuple[CampaignModel, Catalogue, set[str]]:
    """Return the model that carries the effects, their catalogue, and the names of the model's variables."""
    spec = campaign.effects
    if spec is None:
        raise CampaignError(
            "no effects to look for",
            where=f"{campaign.folder / 'campaign.toml'}",
            fix='add [effects] with catalogue = "..."',
        )
    catalogue = load_catalogue(spec.catalogue)
    chosen = experiments_of(campaign, experiments or spec.experiments, where="[effects] experiments")
    if experiments:  # repeats come along
        origins = {e.origin for e in chosen}
        chosen = tuple(e for e in campaign.measurements if e.origin in origins)
    setups = list(dict.fromkeys(e.setup for e in chosen))
    models = {s: _with_effects(campaign, s, catalogue) for s in setups}
    campaign = replace(campaign, models={**campaign.models, **models})
    simulators = {s: load(models[s]) for s in setups}
    cases = tuple(
        replace(c, task=replace(c.task, tolerance=_TOLERANCE))
        for c in from_campaign(campaign, chosen, (), simulators)
    )
    known = {name for s in simulators.values() for name in s.variables}
    tie = {
        name: parse(text, where="[effects] tie")
        for target, text in spec.tie.items()
        for name in expand_slice(target, known)
    }
    fixed = {p.name: p.start for p in campaign.parameters.values()}
    return CampaignModel(cases, runner, fixed, tie), catalogue, known


def expand_slice(target: str, known: Sequence[str] | set[str]) -> list[str]:
    """Return the elements of an array that a slice such as ``lossTable[:,4:5]`` names, or the name itself.

    Raises
    ------
    FmuError
        No element is among `known`.
    """
    if target in known:
        return [target]
    found = []
    match = _SLICE.match(target)
    if match:
        wanted = [_range(part) for part in match["index"].split(",")]
        for name in known:
            other = _SLICE.match(name)
            if other is None or other["name"] != match["name"]:
                continue
            index = [int(i) for i in other["index"].split(",")]
            if len(index) == len(wanted) and all(a <= i <= b for i, (a, b) in zip(index, wanted, strict=True)):
                found.append(name)
    if not found:
        raise FmuError(f"no FMU has '{target}'", where="[effects] tie", fix=suggestion(target, known))
    return sorted(found)


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


def _nominal(campaign: Campaign, spec: EffectsSpec, *, cases_parameters: set[str]) -> tuple[Unknown, ...]:
    helpers = {n for text in spec.tie.values() for n in parse(text).names}
    unknowns = []
    for name in spec.nominal:
        if name not in cases_parameters and name not in helpers:
            raise CampaignError(
                f"nominal parameter '{name}' acts on no model", where="[effects]", fix="drop it or tie to it"
            )
        unknowns.append(_unknown(campaign.parameters[name]))
    return tuple(unknowns)


def _unknown(p: ParameterSpec) -> Unknown:
    width = p.upper - p.lower
    step = 0.02 * abs(p.start) if p.start != 0.0 else (1e-3 * width if np.isfinite(width) else 1e-3)
    return Unknown(p.name, p.start, p.lower, p.upper, step)
