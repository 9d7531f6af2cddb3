"""The corrected model: the named effects with the values found, and a campaign to continue with."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.errors import ModelicaError
from fmu_build.flat_model import FlatModel, constant, number
from fmu_build.model_ports import places
from fmu_build.modelica_text import modelica_text
from fmuid.core.campaign import SEPARATOR, Campaign, ModelSource, ModelSpec, without_owner
from fmuid.core.errors import SimulationError
from fmuid.core.files import path_from, write_atomically
from fmuid.core.toml_tables import read_toml, toml_document
from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.state_places import model_exchange, state_of, with_laws
from fmuid.diagnosis.subject import Subject, carrier
from fmuid.effects.effect import Effect
from fmuid.identification.identified_models import start_values, write_models
from fmuid.identification.problem.segments import in_segments
from fmuid.simulation.coupled.loading import load_model
from fmuid.simulation.model_source import built_model, flat_model
from fmuid.simulation.runners import Runner
from fmuid.simulation.signal_effects import signal_and_property

FOLDER, EFFECTS = "corrected", "effects.toml"
_HEAD = """\
# The model with {effects}, and the values found by fmuid diagnose.
# Continue from here with identify, validate and diagnose; a second diagnosis looks for what is still missing.

"""
_COMMUTE = ("gain", "lag", "delay")  # effects that commute with the differentiation of a signal after the model


@dataclass(frozen=True, slots=True)
class Corrected:
    """The files written: the folder, its models and source, and notes for the user.

    `differs` is the root mean square difference of its prediction from the fitted one, in standard deviations of
    the noise.
    """

    folder: Path
    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    differs: float = 0.0


def write_corrected(
    campaign: Campaign,
    subject: Subject,
    named: Sequence[str],
    values: Mapping[str, float],
    *,
    folder: Path,
    runner: Runner,
) -> Corrected | None:
    """Write the model with effects included, and a campaign in which their parameters are free.

    Parameters
    ----------
    campaign
        The diagnosed campaign, with its catalogue of effects.
    subject
        The subject of the diagnosis.
    named
        Ids of the effects that go into the model.
    values
        Parameters of the campaign and of the effects.
    folder
        Output folder; files of an earlier diagnosis there are replaced.
    runner
        Runs simulations that check the start values of the FMUs.

    Returns
    -------
    Corrected
        None if no effect is named, or if the campaign was not read from a file.
    """
    if folder.exists():
        shutil.rmtree(folder)
    effects = [e for e in subject.effects if e.id in named]
    if not effects or campaign.file is None:
        return None
    document = _Document(campaign, subject, effects, {**subject.model.expanded(values)}, folder)
    return document.write(runner)


def difference(written: Corrected, subject: Subject, fitted: Fitted, *, runner: Runner) -> float:
    """Simulate the corrected campaign, and return how much it differs from the fitted prediction.

    Returns
    -------
    float
        Root mean square over all samples, in standard deviations of a single run's noise.

    Raises
    ------
    SimulationError
        A run cannot be simulated.
    """
    from fmuid.campaigns.campaign_toml import load_campaign
    from fmuid.simulation.coupled.loading import load_simulator

    campaign = load_campaign(written.folder / "campaign.toml")
    cases = subject.model.cases_at(fitted.fit.values)
    chosen = [campaign.measurements[case.id] for case in cases]
    simulators = {case.setup: load_simulator(campaign.models[case.setup]) for case in cases}
    again = {case.id: case for case in in_segments(campaign, chosen, simulators, campaign.start_values)}
    fitted_to = {case.id: case.with_model(again[case.id].simulator).task for case in cases}
    same = tuple(replace(again[case.id], task=fitted_to[case.id], lead=case.lead) for case in cases)
    outcomes = [
        *subject.model.predict([fitted.fit.values]),
        *CampaignModel(same, runner, campaign.start_values).predict([{}]),
    ]
    predictions = []
    for outcome in outcomes:
        if isinstance(outcome, SimulationError):
            raise outcome
        predictions.append(outcome)
    energy, count = 0.0, 0
    for run, a, b in zip(subject.observed.runs, *predictions, strict=True):
        sigma = subject.observed.noise[run.setup].of_mean(1)
        energy += float(np.sum(((a - b) / sigma[:, None]) ** 2))
        count += a.size
    return float(np.sqrt(energy / count))


class _Document:
    """The corrected campaign while it is put together."""

    def __init__(
        self,
        campaign: Campaign,
        subject: Subject,
        effects: Sequence[Effect],
        values: Mapping[str, float],
        folder: Path,
    ) -> None:
        assert campaign.file is not None
        self.campaign, self.subject, self.effects, self.folder = campaign, subject, effects, folder
        self.values = values
        self.raw = read_toml(campaign.file)
        self.notes: list[str] = []
        self.sources: dict[str, tuple[ModelSource, FlatModel]] = {}
        self.stems: dict[str, str] = {}  # of FMUs with laws at their states
        self.setups = tuple(dict.fromkeys(case.setup for case in subject.model.cases))

    def write(self, runner: Runner) -> Corrected:
        """Write everything, the campaign last."""
        self._write_effects()
        specs = {setup: self._spec(setup) for setup in self.setups}
        models = {setup: load_model(spec) for setup, spec in specs.items()}
        starts = {s: start_values(self.campaign, self.values, s, m) for s, m in models.items()}
        for setup, model in models.items():
            tied = {n: v for n, v in self.values.items() if n not in self.campaign.parameters}
            starts[setup] |= {n: v for n, v in tied.items() if n in model.variables}
        stems = self.stems | {setup: _stem(source) for setup, (source, _) in self.sources.items()}
        written = write_models(self.campaign.name, starts, models, self.folder, runner, stems=stems)
        self.notes += written.warnings
        files = [*dict.fromkeys(written.fmus.values()), written.parameters]
        for setup, (source, flat) in self.sources.items():
            file = self.folder / f"{_stem(source)}Corrected.mo"
            if file in files:
                continue
            try:
                write_atomically(file, self._modelica(source, flat, starts[setup]))
                files.append(file)
            except ModelicaError as error:
                self.notes.append(f"no Modelica source is written: {error}")
        names = " and ".join(e.id for e in self.effects)
        text = _HEAD.format(effects=names) + toml_document(self._tables(specs, written.fmus))
        write_atomically(self.folder / "campaign.toml", text)
        return Corrected(self.folder, tuple(files), tuple(self.notes))

    def _write_effects(self) -> None:
        """Write a catalogue of the effects that are added to the source, with those of an earlier diagnosis."""
        assert self.campaign.effects is not None
        inside = [e.id for e in self.effects if e.expression]
        if not inside:
            return
        raw = read_toml(self.campaign.effects.file)
        found: dict[str, Any] = {"effects": {}, "ports": {}}
        for source in (m.source for m in self.campaign.models.values()):
            if source is not None and source.effects is not None:  # effects of an earlier diagnosis
                before = read_toml(source.effects)
                found = {key: {**found[key], **before.get(key, {})} for key in found}
        found["effects"] |= {name: raw["effects"][name] for name in inside}
        ports = {e["port"] for e in found["effects"].values()}
        found["ports"] |= {n: {"unit": raw["ports"][n].get("unit", "")} for n in ports if n in raw["ports"]}
        head = {"format": "fmuid-effects", "version": 1}
        write_atomically(self.folder / EFFECTS, toml_document({**head, **found}))

    def _spec(self, setup: str) -> ModelSpec:
        """Return the model of a setup that has the effects inside it."""
        model = self.campaign.models[setup]
        if model.source is None:
            catalogue = self.subject.catalogue
            fmu = model_exchange(model)
            if fmu is not None and any(e.expression and state_of(e.port, fmu.states) for e in self.effects):
                self.stems[setup] = model.fmu.stem
                return replace(model, fmu=with_laws(fmu, catalogue, [e for e in self.effects if e.expression])[1])
            if model.coupling is None:
                return replace(model, fmu=carrier(model.fmu, catalogue))
            parts = {n: carrier(file, catalogue) for n, file in model.coupling.components.items()}
            return replace(model, coupling=replace(model.coupling, components=parts))
        plain = flat_model(model.source)
        known = places(plain)
        if not any(e.expression and e.port in known for e in self.effects):
            self.sources[setup] = model.source, plain
            return model
        source = replace(model.source, effects=self.folder / EFFECTS)
        self.sources[setup] = source, flat_model(source)
        return replace(model, source=source, fmu=built_model(source))

    def _modelica(self, source: ModelSource, flat: FlatModel, starts: Mapping[str, float]) -> str:
        """Return the source of a model with the effects, and the values found."""
        variables = dict(flat.variables)
        for name, value in starts.items():
            v = variables.get(name)
            if v is not None and not v.shape and v.variability == "parameter" and constant(v.binding) is not None:
                variables[name] = replace(v, binding=number(value))
        lines = [f"{source.class_name} of {source.file.name}, flattened, with what fmuid diagnose found:"]
        for effect in self.effects:
            lines.append(f"  {effect.id}: {effect.description}")
            if effect.expression:
                lines.append(f"    {effect.acts} at {effect.port}: {effect.expression}")
                lines += [f"    and flow: {effect.flow}"] if effect.flow else []
                lines += [f"    and flow out of its first node: {effect.reaction}"] if effect.reaction else []
            elif all(self._of_a_signal(u.name) for u in effect.unknowns):
                lines.append("    acts between the model and its signals, so it is not part of this source")
        return modelica_text(replace(flat, variables=variables), f"{_stem(source)}Corrected", lines)

    def _of_a_signal(self, name: str) -> bool:
        known = any(name in case.simulator.variables for case in self.subject.model.cases)
        return signal_and_property(name) is not None and not known

    def _tables(self, specs: Mapping[str, ModelSpec], fmus: Mapping[str, Path]) -> dict[str, Any]:
        campaign, raw = self.campaign, dict(self.raw)
        nominal = list(dict.fromkeys(without_owner(u.name) for u in self.subject.nominal))
        own = [u for e in self.effects for u in e.unknowns]
        head = {"name": f"{campaign.name}-corrected", "title": f"{campaign.title}, corrected"}
        raw["campaign"] = {**raw.get("campaign", {}), **head}
        raw["campaign"].pop("make", None)
        assert campaign.measurements_file is not None
        raw["campaign"]["measurements"] = self._path(campaign.measurements_file)
        raw["models"] = {s: self._model(s, specs[s], fmus[s], t) for s, t in raw["models"].items() if s in specs}
        self._time(raw)
        units = {n: unit for e in self.effects for n, unit in e.units.items() if unit != "1"}
        units |= {n: v.unit for c in self.subject.model.cases for n, v in c.simulator.variables.items() if v.unit}
        parameters = {name: dict(table) for name, table in raw.get("parameters", {}).items()}
        for name in parameters:
            parameters[name] |= self._starts(name, campaign.parameters[name].start)
            if "starts" in parameters[name]:
                per = campaign.parameters[name].per
                self.notes.append(
                    f"{name} has one value per {per}; the values found are only in the corrected campaign"
                )
        described = {u.name: e.description for e in self.effects for u in e.unknowns}
        for u in own:
            value = min(max(self.values[u.name], u.lower), u.upper)
            table = {"start": value, "lower": u.lower, "upper": u.upper, "description": described[u.name]}
            parameters[u.name] = table | ({"unit": units[u.name]} if units.get(u.name) else {})
        tie = {name: e.text for name, e in self.subject.model.tie.items()}
        for name, expression in self.subject.model.tie.items():
            leaders = [campaign.parameters[n] for n in expression.names if n in campaign.parameters]
            per = next((p.per for p in leaders if p.per != "campaign"), "campaign")
            followed = {**self._starts(name), "free": False, **({} if per == "campaign" else {"per": per})}
            parameters.setdefault(name, followed)
        raw["parameters"] = parameters
        raw["stages"] = {"corrected": self._stage([*nominal, *(u.name for u in own)], tie)}
        if "effects" in raw:
            chosen: dict[str, Any] = {**raw["effects"], "nominal": [*nominal, *(u.name for u in own)]}
            if "catalogue" in chosen:
                catalogue = campaign.file.parent / chosen["catalogue"] if campaign.file else Path()
                chosen["catalogue"] = self._path(catalogue)
            raw["effects"] = chosen
        order = ("campaign", "signals", "models", "parameters", "settings", "roles", "stages", "effects")
        return {key: raw[key] for key in (*order, *raw) if key in raw}

    def _time(self, raw: dict[str, Any]) -> None:
        """Write the timing that the diagnosis used, if it is not that of the campaign's file."""
        for setup, table in raw["models"].items():
            old = table.get("timing") or {"hold": "held"}.get(i := table.get("interpolation", "hold"), i)
            if self.campaign.models[setup].timing != old:
                table.pop("interpolation", None)
                table["timing"] = self.campaign.models[setup].timing
        signals = {name: dict(table) for name, table in raw.get("signals", {}).items()}
        for name, timing in self.campaign.timings.items():
            signals.setdefault(name, {})["timing"] = timing
        if signals:
            raw["signals"] = signals

    def _starts(self, name: str, otherwise: float = 0.0) -> dict[str, Any]:
        """Return the value found for a parameter, and those of single machines or runs if it has them."""
        begin = f"{name}{SEPARATOR}"
        own = {n.removeprefix(begin): v for n, v in self.values.items() if n.startswith(begin)}
        if not own:
            return {"start": self.values.get(name, otherwise)}
        return {"start": float(np.mean(list(own.values()))), "starts": own}

    def _model(self, setup: str, spec: ModelSpec, fmu: Path, table: Mapping[str, Any]) -> dict[str, Any]:
        """Return the table of a setup's model, with paths from here and the effects at its signals."""
        new = dict(table)
        if spec.coupling is not None:
            new["fmus"] = {n: self._path(file) for n, file in spec.coupling.components.items()}
        else:
            new["fmu"] = fmu.name
            if spec.interface is None:
                new.pop("interface", None)
        if spec.source is not None:
            new |= self._source(spec.source)
        at_signals, renamed = list(spec.signal_effects), dict(table.get("map", {}))
        known = next(c.simulator for c in self.subject.model.cases if c.setup == setup).variables
        for name in (u.name for e in self.effects for u in e.unknowns if self._of_a_signal(u.name)):
            signal, prop = signal_and_property(name) or ("", "")
            variable = spec.variable(signal)
            if variable not in known:
                continue
            if prop.startswith("crosstalk["):
                prop = f"crosstalk[{spec.variable(prop[len('crosstalk[') : -1])}]"
            if spec.differentiates(signal) and prop not in _COMMUTE:
                self.notes.append(f"{name} is not in the corrected campaign: '{signal}' is differentiated")
                continue
            at_signals.append(f"{variable}.{prop}")
            if at_signals[-1] != name:
                renamed[name] = at_signals[-1]
        if at_signals:
            new["signal_effects"] = at_signals
        return new | ({"map": renamed} if renamed else {})

    def _source(self, source: ModelSource) -> dict[str, Any]:
        """Return the entries of a model's table about its Modelica source."""
        said: dict[str, Any] = {"source": self._path(source.file), "class": source.class_name}
        if source.effects is not None:
            said["effects"] = self._path(source.effects)
        if source.roots:
            said["roots"] = [self._path(root) for root in source.roots]
        if source.libraries:
            said["libraries"] = dict(source.libraries)
        return said

    def _stage(self, free: list[str], tie: Mapping[str, str]) -> dict[str, Any]:
        """Return one stage with all diagnosed runs, read by the sensors that the campaign specifies."""
        used = [id for case in self.subject.model.cases for id in case.experiments]
        used = [id for id in used if id in self.campaign.identification]
        stage: dict[str, Any] = {"experiments": used, "free": free} if used else {"free": free}
        if tie:
            stage["tie"] = dict(tie)
        sensors: dict[str, Any] = {}
        for table in self.raw.get("stages", {}).values():
            for key in ("segments", "observer"):
                if key in table:
                    stage[key] = table[key]
            for criterion in table.get("criteria", []):
                if "sensor" in criterion.get("options", {}):
                    sensors[criterion["signal"]] = criterion["options"]["sensor"]
        if sensors:
            names = dict.fromkeys(c.signal for case in self.subject.model.cases for c in case.channels)
            stage["criteria"] = [
                {"signal": n, "options": {"sensor": sensors[n]}} if n in sensors else {"signal": n} for n in names
            ]
        return stage

    def _path(self, file: Path) -> str:
        return path_from(self.folder, file)


def _stem(source: ModelSource) -> str:
    return source.class_name.rpartition(".")[2]
