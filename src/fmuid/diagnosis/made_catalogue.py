"""A catalogue made from the model itself: laws of physics at the ports of its source, sized by simulation."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from fmu_build.cache import remove_unused, user_cache
from fmu_build.flat_model import FlatModel
from fmu_build.model_ports import Port, find_ports, held_parameters
from fmu_build.model_ports import places as find_places
from fmuid.campaigns.signal_catalogue import HEAD, RecordedSetup, signal_catalogue
from fmuid.core.campaign import Campaign, EffectsSpec, ModelSource, ModelSpec, ParameterSpec
from fmuid.core.errors import CampaignError
from fmuid.core.experiments import Experiment
from fmuid.core.files import write_atomically
from fmuid.core.immutable import FloatArray
from fmuid.core.toml_tables import SCHEMAS, read_toml, toml_document, toml_text
from fmuid.diagnosis.candidates import costs_with, refit_only
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.subject import Subject, subject_of
from fmuid.diagnosis.variants import (
    acts_on,
    carrier,
    exchanged,
    observed_states,
    state_of,
    state_places,
    with_laws,
)
from fmuid.diagnosis.varying import LawThere, laws_beyond, linearised, varying_lines
from fmuid.effects.effects_file import load_catalogue
from fmuid.effects.flat_expressions import names_at, seen_at
from fmuid.effects.laws import SHARES, SIZES, Law, Place, effect_lines, fitting, inline
from fmuid.effects.quantities import quantity_words
from fmuid.identification.problem.cases import experiments_of
from fmuid.identification.problem.segments import in_segments
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.model_source import built_model, flat_model
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator

_KEPT = "catalogue.toml"  # in the folder of a diagnosis
_MAGNITUDE = 0.01  # disturbance at which a port's response is taken, as a share of the nominal flow
_OFF = (1.05, 1.2)  # trial factors on a held value
_TOGETHER = 0.9999  # squared correlation of angles from which two shafts count as geared to each other
_TOLERATED = 10.0  # standard deviations by which a held value may be wrong
_HEAD = f"""\
#:schema {SCHEMAS}/effects.schema.json
# What the model may lack, for `fmuid diagnose`: laws at the ports of its source, its signals and held parameters.
# `expression` is Modelica and is added to the model at the port; it may use every variable of the model.
# To add a law of your own, add an entry. Sizes are shares of the flows and motions of the refitted model.
"""


def catalogue_text(
    places: Sequence[Place],
    held: Mapping[str, Held],
    signals: str,
    beyond: Mapping[str, Law] = MappingProxyType({}),
) -> str:
    """Return the text of a catalogue.

    Parameters
    ----------
    places
        Ports with their sizes.
    held
        Held parameters, by name.
    signals
        The catalogue of the campaign's signals, or only its head.
    beyond
        By effect, the laws that act beyond a threshold only.
    """
    lines: list[str] = []
    for place in places:
        laws = list(fitting(place))
        if not laws:
            continue
        lines += _port_lines(place)
        for name, law in laws:
            lines += effect_lines(name, beyond.get(f"{name}@{place.port.name}", law), place)
    for name, parameter in held.items():
        lines += _held_lines(name, parameter)
    _, _, rest = signals.partition("format = ")
    return f"{_HEAD}format = {rest}\n" + "\n".join([*lines, ""])


def _port_lines(place: Place) -> list[str]:
    port, sizes = place.port, place.sizes
    name, (potential, flow) = toml_text(port.name), port.units
    also = f", also {', '.join(port.same[:4])}" if port.same else ""
    lines = [f"[ports.{name}]", f"description = {toml_text(f'{port.kind} {port.name} ({port.domain}{also})')}"]
    moved = {"node": "F", "branch": "F", "signal": "P", "loop": "P"}.get(port.kind)
    if moved is not None:
        added = f"{port.name}.added_{'signal' if port.kind == 'signal' else 'flow'}"
        lines += [f"input = {toml_text(added)}", "added = true", f"magnitude = {_MAGNITUDE * sizes[moved]:.3g}"]
    lines += [f"unit = {toml_text(port.added_unit)}", ""]
    regimes = {}
    of = quantity_words(port.domain, potential)
    if port.kind == "node" and port.probes.get("rate"):
        regimes[of["rate"]] = (port.probes["rate"][0], "speed", f"{potential}/s")
    if port.kind == "node" and port.probes.get("p"):
        kind = "angle" if port.domain == "rotational" else "value"
        regimes[of["p"]] = (port.probes["p"][0], kind, potential)
    if port.kind == "branch" and port.compliant and port.probes.get("flow"):
        regimes[of["through"]] = (port.probes["flow"][0], "value", flow)
    for what, (variable, kind, unit) in regimes.items():
        lines += [f"[regimes.{toml_text(f'{port.name} {what}')}]", f"variable = {toml_text(variable)}"]
        lines += [f"kind = {toml_text(kind)}", f"unit = {toml_text(unit)}", ""]
    return lines


@dataclass(frozen=True, slots=True)
class Held:
    """A held parameter that may be wrong.

    Attributes
    ----------
    tolerance
        Relative standard deviation of its value, if that is known.
    bounds
        Between which it may lie, as the campaign says; needed if its value is zero, which has no scale.
    """

    value: float
    unit: str
    tolerance: float | None = None
    bounds: tuple[float, float] | None = None


def _held_lines(name: str, held: Held) -> list[str]:
    key, table, value = toml_text(name), f"[effects.{toml_text(f'value@{name}')}", held.value
    scale, known = abs(value), ""
    if not value and held.bounds is not None:
        low, high = held.bounds
        scale = high - low
        off = [share * end for share in SHARES for end in (high, low) if end]
    elif held.tolerance is None:
        low, high = sorted((value / 5, value * 5))
        off = [f * value for f in (*_OFF, 2 - _OFF[-1])]
    else:
        sd = held.tolerance * abs(value)
        low, high = value - _TOLERATED * sd, value + _TOLERATED * sd
        off, known = [value + n * sd for n in (1, 3, -3)], f"sd = {sd:.6g}, "
    trials = ", ".join(inline({name: v}) for v in off)
    return [
        f"[ports.{key}]",
        f"description = {toml_text(f'Value of {name}')}",
        f"unit = {toml_text(held.unit)}",
        "",
        f"{table}]",
        f"description = {toml_text(f'{name} is off')}",
        'source = "A value taken from a data sheet, a drawing or another unit"',
        f"port = {key}",
        *(["two_sided = true"] if low < value < high else []),
        f"trials = [{trials}]",
        f"{table}.parameters]",
        f"{key} = {{ neutral = {value!r}, lower = {low!r}, upper = {high!r}, step = {2e-3 * scale:.4g}, "
        f"{known}unit = {toml_text(held.unit)} }}",
        "",
    ]


def sized(
    ports: Sequence[Port], time: Sequence[FloatArray], courses: Sequence[Mapping[str, FloatArray]]
) -> list[Place]:
    """Return the ports with sizes taken from their variables over time, one mapping per run.

    A port where nothing moves or flows is left out, because an effect there would not show.
    """
    duration = max(float(t[-1] - t[0]) for t in time)
    by_name = {port.name: port for port in ports}
    places_with_sizes = []
    for port in by_name.values():
        seen = [one for t, course in zip(time, courses, strict=True) if (one := seen_at(port, course, t))]
        if not seen:
            continue
        p = [one.p for one in seen if one.p is not None]
        sizes = {
            "P": max([one.drop for one in seen] + [float(np.ptp(x)) for x in p]),
            "M": max((float(np.abs(x).max()) for x in p), default=0.0),
            "V": max(float(np.abs(one.rate).max()) for one in seen),
            "A": max(float(np.abs(np.gradient(one.rate, one.time)).max()) for one in seen),
            "F": max(one.flow for one in seen),
            "T": duration,
        } | ({"Z": float(p[0][0])} if p else {})
        if "load" in port.quantities:
            load = port.quantities["load"]
            near = [b for b in ports if b.kind == "branch" and b.quantities.get("through") == load]
            names = [n for b in near for n in b.probes["flow"][:1]]
            sizes["L"] = max((float(np.abs(c[n]).max()) for c in courses for n in names if n in c), default=0.0)
        if port.kind == "branch" and port.domain == "rotational" and port.connectors:
            sizes["W"], sizes["N"] = _turns(port, ports, courses)
        own_sizes = {k: v for k, v in sizes.items() if v > 0.0 or k == "Z"}
        if ("P" in own_sizes or "V" in own_sizes) and (port.kind == "signal" or "F" in own_sizes):
            places_with_sizes.append(Place(port, own_sizes))
    return places_with_sizes


def _turns(
    branch: Port, ports: Sequence[Port], courses: Sequence[Mapping[str, FloatArray]]
) -> tuple[float, float]:
    """Return the angle through which a branch's first node turns, and how much faster the fastest shaft turns.

    Shafts that turn in proportion to it count, in the run in which it turns most.
    """
    shafts = [p.probes["p"][0] for p in ports if p.connectors and p.kind == "node" and p.domain == "rotational"]
    first = branch.probes["p"][0]
    course = max((c for c in courses if first in c), key=lambda c: float(np.ptp(c[first])))
    course_of_port = course[first] - course[first].mean()
    energy, ratio = float(course_of_port @ course_of_port), 1.0
    for other in (course[s] - course[s].mean() for s in shafts if s in course):
        together = abs(float(course_of_port @ other))
        if together**2 > _TOGETHER * energy * float(other @ other) > 0.0:
            ratio = max(ratio, together / energy)
    return float(np.ptp(course_of_port)), ratio


@dataclass(frozen=True, slots=True)
class _Setup:
    model: ModelSpec
    source: ModelSource
    flat: FlatModel


def with_catalogue(
    campaign: Campaign,
    load: Callable[[ModelSpec], Simulator],
    *,
    runner: Runner = in_process,
) -> Campaign:
    """Return the campaign with a catalogue of effects, and with models built to carry them.

    A campaign that names no catalogue gets one made from the source of its models, or from its signals and held
    parameters where there is no source. Effects with an `expression` are added to the source of the models.

    Raises
    ------
    CampaignError
        A catalogue adds effects to models whose source the campaign does not name.
    ModelicaError, BuildError
        A model cannot be built with the effects.
    """
    spec = campaign.effects
    setups = _sources(campaign)
    if spec is not None and spec.catalogue is not None:
        text = spec.catalogue.read_text() if spec.catalogue.is_file() else ""
        catalogue = load_catalogue(spec.catalogue)
        if not any(e.expression for e in catalogue.effects.values()):
            return campaign
        if not setups and not exchanged(campaign):
            raise CampaignError(
                "adds effects to the source of a model, but the campaign names none",
                where=spec.catalogue,
                fix='give [models.<setup>] source = "Model.mo"',
            )
    else:
        text, fitted = _made(campaign, load, runner)
        spec = replace(_spec(campaign), catalogue=_in_cache(text), fitted=fitted)
        catalogue = load_catalogue(spec.file)
    carriers, models = {}, dict(campaign.models)
    ports = {e.port for e in catalogue.effects.values() if e.expression}
    having = [name for name, setup in setups.items() if ports & find_places(setup.flat).keys()] or [*setups]
    for name, setup in setups.items():
        plain = built_model(setup.source)
        if name in having:
            carriers[plain.stem] = carrier(setup.source, catalogue).stem
        models[name] = replace(setup.model, fmu=plain)
    for name, fmu in exchanged(campaign).items():
        effects = catalogue.effects.values()
        if any(state_of(port, fmu.states) for port in catalogue.ports) or any(acts_on(fmu, e) for e in effects):
            plain, with_all = with_laws(fmu, catalogue)
            carriers[plain.stem] = with_all.stem
            models[name] = replace(models[name], fmu=plain, interface=None)
    if carriers:
        text = _with_models(text, carriers)
        spec = replace(spec, catalogue=_in_cache(text))
    return replace(campaign, effects=spec, models=models)


def keep_catalogue(folder: Path, campaign: Campaign, first: EffectsSpec | None) -> None:
    """Write the catalogue into the folder of a diagnosis, unless it is the `first` one, of the campaign."""
    kept = folder / _KEPT
    kept.unlink(missing_ok=True)
    assert campaign.effects is not None
    if first is None or campaign.effects.file != first.file:
        write_atomically(kept, toml_document(_without_models(campaign.effects.file)))


def with_kept_catalogue(campaign: Campaign, folder: Path) -> Campaign:
    """Return the campaign with the catalogue that is in the folder of its diagnosis, if there is one."""
    kept = folder / _KEPT
    return replace(campaign, effects=replace(_spec(campaign), catalogue=kept)) if kept.is_file() else campaign


def with_effect(campaign: Campaign, id: str, table: Mapping[str, Any]) -> Campaign:
    """Return a campaign with one more effect, a table of a catalogue; `with_catalogue` then builds its models."""
    assert campaign.effects is not None
    tables = _without_models(campaign.effects.file)
    text = toml_document({**tables, "effects": {**tables["effects"], id: table}})
    return replace(campaign, effects=replace(campaign.effects, catalogue=_in_cache(text)))


def _without_models(catalogue: Path) -> dict[str, Any]:
    """Return the tables of a catalogue without the models that were built for it."""
    return {key: table for key, table in read_toml(catalogue).items() if key != "models"}


def _in_cache(text: str) -> Path:
    folder = user_cache() / "catalogues"
    remove_unused(folder, "*.toml")
    file = folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.toml"
    write_atomically(file, text)
    return file


def _with_models(text: str, carriers: Mapping[str, str]) -> str:
    if "models" in tomllib.loads(text):
        return text
    return "\n".join([text, "[models]", *(f"{toml_text(k)} = {toml_text(v)}" for k, v in carriers.items()), ""])


def _sources(campaign: Campaign) -> dict[str, _Setup]:
    used = {e.setup for e in campaign.measurements}
    return {
        name: _Setup(model, model.source, flat_model(model.source))
        for name, model in campaign.models.items()
        if name in used and model.source is not None
    }


def _spec(campaign: Campaign) -> EffectsSpec:
    """Return the subject of the diagnosis: the campaign's own choice, or all free parameters and runs."""
    if campaign.effects is not None:
        return campaign.effects
    free = tuple(p.name for p in campaign.parameters.values() if p.free)
    return EffectsSpec(None, free, experiments=tuple(e.id for e in _seen(campaign)))


def _seen(campaign: Campaign) -> list[Experiment]:
    """Return the runs of models that are not reserved for validation."""
    return [e for e in campaign.measurements if e.id not in campaign.validation and e.setup in campaign.models]


def made_catalogue(
    campaign: Campaign, load: Callable[[ModelSpec], Simulator], *, runner: Runner = in_process
) -> str:
    """Return the text of the catalogue of a campaign's models, sized by the refitted models in the runs."""
    return _made(campaign, load, runner)[0]


def _made(
    campaign: Campaign, load: Callable[[ModelSpec], Simulator], runner: Runner
) -> tuple[str, Mapping[str, float]]:
    """Return the text of a campaign's catalogue, and the values of the refit that sized it, if there was one."""
    setups, states = _sources(campaign), exchanged(campaign)
    named = experiments_of(campaign, _spec(campaign).experiments, where="[effects] experiments")
    chosen = named or _seen(campaign)
    held: dict[str, Held] = {}
    recorded: list[RecordedSetup] = []
    models: dict[str, CampaignModel] = {}
    fixed = campaign.start_values
    nominal = {m.variable(name) for name in _spec(campaign).nominal for m in campaign.models.values()}
    for name in dict.fromkeys(e.setup for e in chosen):
        model = campaign.models[name]
        runs = [e for e in chosen if e.setup == name]
        simulator = load(model)
        recorded.append(RecordedSetup(runs, model, simulator.variables))
        models[name] = CampaignModel(in_segments(campaign, runs, {name: simulator}, fixed), runner, fixed)
        given = {model.variable(p.name): p for p in campaign.parameters.values()}
        for parameter, unit in _parameters(setups.get(name), simulator).items():
            value, spec = _held_value(parameter, models[name], fixed), given.get(parameter)
            known = parameter in nominal or (spec is not None and spec.known)
            bounds = _bounds(models[name], spec) if spec is not None and value == 0.0 else None
            if not known and value is not None and (value or bounds) and parameter not in held:
                held[parameter] = Held(value, unit, None if spec is None else spec.tolerance, bounds)
    signals = signal_catalogue(recorded)
    plain = catalogue_text([], held, signals)
    if not setups and not states:
        return plain, {}
    subject = _plain_subject(campaign, plain, setups, load, runner)
    fit = refit_only(subject, (), [{}])
    at = {} if fit is None else fit.values
    parts: list[Place] = []
    for name, simulated in models.items():
        if name in setups:
            parts += _at_ports(setups[name].flat, simulated, at)
        elif name in states:
            parts += _at_states(states[name], simulated, at)
    places = _merged(parts)
    if fit is None:
        return catalogue_text(places, held, signals), {}

    def costs(lines: Sequence[str], special: Mapping[str, str] = MappingProxyType({})) -> dict[str, float]:
        alone = "\n".join([catalogue_text([], {}, HEAD), *lines])
        spec = replace(_spec(campaign), catalogue=_in_cache(alone))
        built = with_catalogue(replace(campaign, effects=spec), load, runner=runner)
        return costs_with(subject_of(built, load, runner=runner), fit, special)

    varying: dict[str, FlatModel | Fmu] = {**{name: setup.flat for name, setup in setups.items()}, **states}
    linear = linearised(subject, fit, varying, places)
    beyond = laws_beyond(subject, fit, linear, places, costs=lambda laws: costs(_lines_there(laws), _plain(laws)))
    text = catalogue_text(places, held, signals, beyond)
    known = tomllib.loads(text)["ports"]
    lines = varying_lines(subject, fit, campaign, linear, known, costs=costs)
    return "\n".join([text, *lines]), fit.values


def _plain(laws: Sequence[LawThere]) -> dict[str, str]:
    """Return the laws that always act, by id, with those that are the same beyond a threshold."""
    return {law.without: law.id for law in laws if law.beyond}


def _lines_there(laws: Sequence[LawThere]) -> list[str]:
    """Return the entries of a catalogue for laws at places, and of these."""
    at = {law.place.port.name: law.place for law in laws}
    lines = [line for place in at.values() for line in _port_lines(place)]
    return lines + [line for law in laws for line in effect_lines(law.name, law.law, law.place)]


def _parameters(setup: _Setup | None, simulator: Simulator) -> dict[str, str]:
    """Return the parameters of a setup's model that may be held, with their units."""
    if setup is not None:
        return {v.name: v.unit or "1" for v in held_parameters(setup.flat)}
    return {
        n: v.unit or "1"
        for n, v in simulator.variables.items()
        if v.causality == "parameter" and v.type in ("Real", "Float64")
    }


def _plain_subject(
    campaign: Campaign,
    text: str,
    setups: Mapping[str, _Setup],
    load: Callable[[ModelSpec], Simulator],
    runner: Runner,
) -> Subject:
    """Return the subject of a diagnosis of the plain models, with a catalogue that adds nothing to them."""
    built = {n: replace(s.model, fmu=built_model(s.source)) for n, s in setups.items()}
    built |= {n: replace(campaign.models[n], interface="model exchange") for n in exchanged(campaign)}
    spec = replace(_spec(campaign), catalogue=_in_cache(text))
    return subject_of(replace(campaign, effects=spec, models={**campaign.models, **built}), load, runner=runner)


def _at_ports(flat: FlatModel, simulated: CampaignModel, values: Mapping[str, float]) -> list[Place]:
    """Return the ports of a model with source, sized by its runs with some parameter values."""
    ports, known = find_ports(flat), simulated.cases[0].simulator.variables
    probes = [p for port in ports for group in port.probes.values() for p in group]
    probes += [name for port in ports for name in names_at(port)]
    return sized(ports, *_courses(simulated, values, [n for n in dict.fromkeys(probes) if n in known]))


def _at_states(fmu: Fmu, simulated: CampaignModel, values: Mapping[str, float]) -> list[Place]:
    """Return the places at the states of an FMU without source, sized by its runs with some parameter values."""
    wanted = [name for name in observed_states(fmu) if name in simulated.cases[0].simulator.variables]
    at_states, _ = state_places(fmu, *_courses(simulated, values, wanted))
    return [Place(p.port, p.sizes, p.names, state_of(p.port.name, fmu.states) or "") for p in at_states]


def _courses(
    simulated: CampaignModel, values: Mapping[str, float], wanted: Sequence[str]
) -> tuple[list[FloatArray], list[dict[str, FloatArray]]]:
    """Return times and courses of variables in each run, with some parameter values."""
    trajectories = simulated.trajectories(values, wanted)
    return [c.time for c in simulated.cases], [dict(zip(wanted, rows, strict=True)) for rows in trajectories]


def _bounds(model: CampaignModel, spec: ParameterSpec) -> tuple[float, float] | None:
    """Return a parameter's bounds in the model's unit; None if they are infinite or do not contain zero."""
    settings = [case.setting[spec.name] for case in model.cases if spec.name in case.setting]
    if not settings:
        return None
    _, to = settings[0]
    low, high = sorted(to.factor * bound + to.offset for bound in (spec.lower, spec.upper))
    return (low, high) if np.isfinite([low, high]).all() and low <= 0.0 <= high else None


def _merged(parts: Sequence[Place]) -> list[Place]:
    """Return every port once, with its largest sizes in any setup.

    Where all setups only pass an input on, its laws are those of the input.
    """
    merged: dict[str, Place] = {}
    inside = {place.port.name for place in parts if not place.port.passed}
    for place in (place for place in parts if place.port.name in inside):
        same = merged.get(place.port.name, place)
        largest = {k: max(v, place.sizes.get(k, v)) for k, v in same.sizes.items()}
        sizes = {**place.sizes, **largest} | ({"Z": same.sizes["Z"]} if "Z" in same.sizes else {})
        if place.sizes.get("W", 0.0) < sizes.get("W", 0.0):  # a ratio is most precise where most turns
            sizes["N"] = same.sizes["N"]
        elif "N" in place.sizes:
            sizes["N"] = place.sizes["N"]
        merged[place.port.name] = Place(same.port, sizes, same.names, same.owner)
    return list(merged.values())


def _held_value(name: str, model: CampaignModel, fixed: Mapping[str, float]) -> float | None:
    """Return the value that every run has for a parameter of the model; None if they differ."""
    values = set()
    for case in model.cases:
        variable = case.simulator.variables.get(name)
        start = case.task.start_values.get(name, variable.start if variable is not None else None)
        given = model.start_values(case, fixed).get(name, start)
        values.add(given)
    (value,) = values if len(values) == 1 else (None,)
    return None if value is None else float(value)


def possible_laws(flat: FlatModel) -> dict[str, list[str]]:
    """Return the names of the laws that may act at each port of a model, whatever its sizes."""
    sizes = dict.fromkeys(SIZES, 1.0)
    ports = (port for port in find_ports(flat) if not port.passed)
    laws_at = {port.name: [name for name, _ in fitting(Place(port, sizes))] for port in ports}
    return {name: names for name, names in laws_at.items() if names}
