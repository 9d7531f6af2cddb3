"""The corrected model and campaign, and their validation on other measurements."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.errors import ModelicaError, UserError
from fmu_build.flat_model import FlatModel, numbers
from fmu_build.model_ports import places
from fmu_build.modelica_text import modelica_text
from fmuid.core.campaign import SEPARATOR, Campaign, ModelSource, ModelSpec, segments_in_toml, without_owner
from fmuid.core.errors import FmuidError, SimulationError
from fmuid.core.experiments import Experiment
from fmuid.core.files import path_from, write_atomically
from fmuid.core.immutable import FloatArray
from fmuid.core.one_thread import in_one_thread
from fmuid.core.toml_tables import SCHEMAS, read_toml, toml_document
from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.cross_validation import closure_interval, losses, share_closed
from fmuid.diagnosis.extended_model import CampaignModel, Prediction
from fmuid.diagnosis.made_catalogue import with_catalogue, with_effect
from fmuid.diagnosis.observed import Observed, gap
from fmuid.diagnosis.subject import Subject, carrier, model_of, with_states
from fmuid.diagnosis.variants import acts_on, model_exchange, with_laws
from fmuid.effects.effect import Effect
from fmuid.effects.table_blocks import with_table_blocks
from fmuid.identification.identified_models import start_values, write_models
from fmuid.identification.problem.cases import Case, experiments_of
from fmuid.identification.problem.segments import in_segments
from fmuid.simulation.coupled.coupled_model import CoupledModel
from fmuid.simulation.coupled.loading import load_model, load_simulator
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.model_source import built_model, flat_model, with_plain_states
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.signal_effects import signal_and_property
from fmuid.simulation.signal_model import COMMUTE
from fmuid.simulation.simulator import Simulator, Variable

FOLDER, EFFECTS = "corrected", "effects.toml"
_HEAD = """\
#:schema {schemas}/campaign.schema.json
# The model with {effects}, and the values found by fmuid diagnose.
# Continue from here with identify, validate and diagnose; a second diagnosis looks for what is still missing.

"""


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


def checked(written: Corrected, subject: Subject, fitted: Fitted, *, runner: Runner) -> Corrected:
    """Simulate the corrected campaign, also with its Modelica files built again, and compare it with the fit.

    Returns
    -------
    Corrected
        With the larger difference from the fitted prediction: root mean square over all samples, in standard
        deviations of a single run's noise. A note gives the reason if a Modelica file cannot be built again.

    Raises
    ------
    SimulationError
        A run cannot be simulated.
    """
    from fmuid.campaigns.campaign_toml import load_campaign

    campaign = load_campaign(written.folder / "campaign.toml")
    campaigns, notes = [campaign], list(written.notes)
    try:
        campaigns += [] if (again := _built_again(campaign, written)) is None else [again]
    except (ModelicaError, FmuidError) as error:
        notes.append(f"the corrected Modelica source cannot be built again: {error}")
    (expected,) = subject.model.predict([fitted.fit.values])
    if isinstance(expected, SimulationError):
        raise expected
    differs = max(_difference(one, subject, fitted, expected, runner) for one in campaigns)
    return replace(written, differs=differs, notes=tuple(notes))


def _difference(
    campaign: Campaign, subject: Subject, fitted: Fitted, expected: Prediction, runner: Runner
) -> float:
    cases = subject.model.cases_at(fitted.fit.values)
    chosen = [campaign.measurements[name] for case in cases for name in case.experiments]
    again = {case.id: case for case in _cases_of(campaign, chosen)}
    same = []
    for case in cases:
        there = again[case.id]  # what suffices for the fitted model need not for this one
        given = (c.task.tolerance or c.simulator.default_tolerance or np.inf for c in (case, there))
        posed = replace(case.task, tolerance=None if (least := min(given)) == np.inf else least)
        task = replace(case, task=posed).with_model(there.simulator).task
        task = task.with_names(_quoted(there.simulator.variables))
        same.append(replace(there, task=task, lead=case.lead))
    (outcome,) = CampaignModel(tuple(same), runner, campaign.start_values).predict([{}])
    if isinstance(outcome, SimulationError):
        raise outcome
    energy, count = 0.0, 0
    for run, a, b in zip(subject.observed.runs, expected, outcome, strict=True):
        sigma = subject.observed.noise[run.setup].of_mean(1)
        energy += float(np.sum(((a - b) / sigma[:, None]) ** 2))
        count += a.size
    return float(np.sqrt(energy / count))


def _cases_of(campaign: Campaign, chosen: Sequence[Experiment]) -> tuple[Case, ...]:
    """Return the cases of chosen runs with the models and values of a corrected campaign."""
    simulators = {s: load_simulator(campaign.models[s]) for s in dict.fromkeys(e.setup for e in chosen)}
    return in_segments(campaign, chosen, simulators, campaign.start_values)


def _built_again(campaign: Campaign, written: Corrected) -> Campaign | None:
    """Return the corrected campaign with models built from the Modelica files written; None if there is none.

    Parameters have the values in these files, unless they differ from run to run.
    """
    models, parameters = dict(campaign.models), dict(campaign.parameters)
    for setup, spec in campaign.models.items():
        file = None if spec.source is None else written.folder / f"{_stem(spec.source)}Corrected.mo"
        if spec.source is not None and file in written.files:
            source = ModelSource(file, file.stem, roots=spec.source.roots)
            fmu = built_model(source)
            variables = load_model(replace(spec, fmu=fmu, source=source)).variables
            models[setup] = replace(_with_names(spec, _quoted(variables)), fmu=fmu, source=source)
            settable = {n for n, v in variables.items() if v.causality == "parameter"}
            inside = [
                n for n, p in parameters.items() if p.per == "campaign" and models[setup].variable(n) in settable
            ]
            parameters = {n: p for n, p in parameters.items() if n not in inside}
    return replace(campaign, models=models, parameters=parameters) if models != campaign.models else None


def _with_names(spec: ModelSpec, names: Mapping[str, str]) -> ModelSpec:
    """Return the specification for a model that has other names for some of its variables."""

    def renamed(text: str) -> str:
        if text in names:
            return names[text]
        if text.startswith("gradient("):
            return f"gradient({renamed(text[len('gradient(') : -1])})"
        signal, prop = signal_and_property(text) or (text, "")
        if prop.startswith("crosstalk["):
            prop = f"crosstalk[{renamed(prop[len('crosstalk[') : -1])}]"
        return f"{names.get(signal, signal)}.{prop}" if prop else text

    known = {**{n: n for n in (*names, *spec.signal_effects)}, **spec.map}
    effects = tuple(map(renamed, spec.signal_effects))
    return replace(spec, map={name: renamed(v) for name, v in known.items()}, signal_effects=effects)


def _quoted(variables: Iterable[str]) -> dict[str, str]:
    """Return the quoted identifiers among variables of a flattened model, by what is between the quotes."""
    return {name[1:-1]: name for name in variables if name.startswith("'") and name.endswith("'")}


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
        self.diagnosed = tuple(dict.fromkeys(case.setup for case in subject.model.cases))

    def write(self, runner: Runner) -> Corrected:
        """Write everything, the campaign last."""
        self._write_effects()
        specs, models = self._models()
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
                write_atomically(file, self._modelica(source, flat, models[setup], starts[setup]))
                files.append(file)
            except ModelicaError as error:
                self.notes.append(f"no Modelica source is written: {error}")
        names = " and ".join(e.id for e in self.effects)
        text = _HEAD.format(schemas=SCHEMAS, effects=names) + toml_document(
            self._tables(specs, written.fmus, models)
        )
        write_atomically(self.folder / "campaign.toml", text)
        return Corrected(self.folder, tuple(files), tuple(self.notes))

    def _write_effects(self) -> None:
        """Write a catalogue of the effects that are added to the source, with those of an earlier diagnosis."""
        assert self.campaign.effects is not None
        inside = [e.id for e in self.effects if e.expression]
        if not inside:
            return
        raw = read_toml(self.campaign.effects.file)
        tables: dict[str, Any] = {"effects": {}, "ports": {}}
        for source in (m.source for m in self.campaign.models.values()):
            if source is not None and source.effects is not None:  # effects of an earlier diagnosis
                before = read_toml(source.effects)
                tables = {key: {**tables[key], **before.get(key, {})} for key in tables}
        tables["effects"] |= {name: raw["effects"][name] for name in inside}
        ports = {e["port"] for e in tables["effects"].values()}
        tables["ports"] |= {n: {"unit": raw["ports"][n].get("unit", "")} for n in ports if n in raw["ports"]}
        head = {"format": "fmuid-effects", "version": 1}
        write_atomically(self.folder / EFFECTS, toml_document({**head, **tables}))

    def _models(self) -> tuple[dict[str, ModelSpec], dict[str, Fmu | CoupledModel]]:
        """Return the models of all setups with runs, also of validation, with the effects inside them."""
        specs, models = {}, {}
        recorded = [e.setup for e in self.campaign.measurements if e.setup in self.campaign.models]
        for setup in dict.fromkeys((*self.diagnosed, *recorded)):
            try:
                spec = self._spec(setup)
                models[setup] = load_model(spec)
                specs[setup] = spec
            except (UserError, FmuidError) as error:
                if setup in self.diagnosed:
                    raise
                self.sources.pop(setup, None)
                self.notes.append(f"the effects cannot be added to the model of '{setup}': {error}")
        return specs, models

    def _spec(self, setup: str) -> ModelSpec:
        """Return the model of a setup that has the effects inside it."""
        model = self.campaign.models[setup]
        if model.source is None:
            catalogue = self.subject.catalogue
            fmu = model_exchange(model)
            if fmu is not None and any(acts_on(fmu, e) for e in self.effects):
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
        self.sources[setup] = source, with_plain_states(source, flat_model(source))
        return replace(model, source=source, fmu=built_model(source))

    def _modelica(
        self, source: ModelSource, flat: FlatModel, model: Simulator, starts: Mapping[str, float]
    ) -> str:
        """Return the source of a model with the effects, and the values found."""
        settable = {n: v.start for n, v in model.variables.items() if v.causality == "parameter"}
        known = {n: starts.get(n, start) for n, start in settable.items()}
        variables = dict(flat.variables)
        for name, v in flat.variables.items():
            indices = [",".join(str(k + 1) for k in at) for at in np.ndindex(v.shape)]
            values = {n: known.get(n) for at in indices for n in [f"{name}[{at}]" if at else name]}
            if any(n in starts for n in values) and None not in values.values():
                variables[name] = replace(v, binding=numbers(np.reshape([*values.values()], v.shape).tolist()))
        flat, blocks = with_table_blocks(
            replace(flat, variables=variables), [tuple(u.name for u in e.unknowns) for e in self.effects]
        )
        as_blocks = {block.sizes for block in blocks}
        lines = [f"{source.class_name} of {source.file.name}, flattened, with what fmuid diagnose found:"]
        for effect in self.effects:
            lines.append(f"  {effect.id}: {effect.description}")
            if tuple(u.name for u in effect.unknowns) in as_blocks:
                lines.append(
                    f"    {effect.acts} at {effect.port}: a CombiTable1Ds of the Modelica Standard Library"
                )
            elif effect.expression:
                lines.append(f"    {effect.acts} at {effect.port}: {effect.expression}")
                lines += [f"    and flow: {effect.flow}"] if effect.flow else []
                lines += [f"    and flow out of its first node: {effect.reaction}"] if effect.reaction else []
            elif all(self._of_a_signal(u.name) for u in effect.unknowns):
                lines.append("    acts between the model and its signals, so it is not part of this source")
        return modelica_text(
            flat,
            f"{_stem(source)}Corrected",
            lines,
            components=[block.declaration for block in blocks],
            connections=[block.equation for block in blocks],
        )

    def _of_a_signal(self, name: str) -> bool:
        known = any(name in case.simulator.variables for case in self.subject.model.cases)
        return signal_and_property(name) is not None and not known

    def _tables(
        self, specs: Mapping[str, ModelSpec], fmus: Mapping[str, Path], models: Mapping[str, Simulator]
    ) -> dict[str, Any]:
        campaign, raw = self.campaign, dict(self.raw)
        nominal = list(dict.fromkeys(without_owner(u.name) for u in self.subject.nominal))
        unknowns = [u for e in self.effects for u in e.unknowns]
        head = {"name": f"{campaign.name}-corrected", "title": f"{campaign.title}, corrected"}
        raw["campaign"] = {**raw.get("campaign", {}), **head}
        raw["campaign"].pop("make", None)
        assert campaign.measurements_file is not None
        raw["campaign"]["measurements"] = self._path(campaign.measurements_file)
        raw["models"] = {
            s: self._model(specs[s], fmus[s], t, models[s].variables)
            if s in specs
            else self._located(campaign.models[s], t)
            for s, t in raw["models"].items()
        }
        others = [s for s in raw["models"] if s not in specs]
        if others:
            self.notes.append(f"Models without the effects are as they were in {FOLDER}/: {', '.join(others)}.")
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
        for u in unknowns:
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
        raw["stages"] = {"corrected": self._stage([*nominal, *(u.name for u in unknowns)], tie)}
        if "effects" in raw:
            chosen: dict[str, Any] = {**raw["effects"], "nominal": [*nominal, *(u.name for u in unknowns)]}
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
            table.pop("read_after", None)
            if self.campaign.models[setup].read_after:
                table["read_after"] = self.campaign.models[setup].read_after
        signals = {name: dict(table) for name, table in raw.get("signals", {}).items()}
        for name, timing in self.campaign.timings.items():
            signals.setdefault(name, {})["timing"] = timing
        if signals:
            raw["signals"] = signals

    def _starts(self, name: str, otherwise: float = 0.0) -> dict[str, Any]:
        """Return the value found for a parameter, and those of single machines or runs if it has them."""
        begin = f"{name}{SEPARATOR}"
        by_owner = {n.removeprefix(begin): v for n, v in self.values.items() if n.startswith(begin)}
        if not by_owner:
            return {"start": self.values.get(name, otherwise)}
        return {"start": float(np.mean(list(by_owner.values()))), "starts": by_owner}

    def _model(
        self, spec: ModelSpec, fmu: Path, table: Mapping[str, Any], known: Mapping[str, Variable]
    ) -> dict[str, Any]:
        """Return the table of a setup's model, with paths from here and the effects at its signals."""
        new = self._located(spec, table)
        if spec.coupling is None:
            new["fmu"] = fmu.name
            if spec.interface is None:
                new.pop("interface", None)
        at_signals, renamed = list(spec.signal_effects), dict(table.get("map", {}))
        for name in (u.name for e in self.effects for u in e.unknowns if self._of_a_signal(u.name)):
            signal, prop = signal_and_property(name) or ("", "")
            variable = spec.variable(signal)
            if variable not in known:
                continue
            if prop.startswith("crosstalk["):
                prop = f"crosstalk[{spec.variable(prop[len('crosstalk[') : -1])}]"
            if spec.differentiates(signal) and prop not in COMMUTE:
                self.notes.append(f"{name} is not in the corrected campaign: '{signal}' is differentiated")
                continue
            at_signals.append(f"{variable}.{prop}")
            if at_signals[-1] != name:
                renamed[name] = at_signals[-1]
        if at_signals:
            new["signal_effects"] = at_signals
        return new | ({"map": renamed} if renamed else {})

    def _located(self, spec: ModelSpec, table: Mapping[str, Any]) -> dict[str, Any]:
        """Return the table of a model, with paths from here."""
        new = dict(table)
        if "fmu" in table:
            new["fmu"] = self._path(spec.fmu)
        if spec.coupling is not None:
            new["fmus"] = {n: self._path(file) for n, file in spec.coupling.components.items()}
        return new | ({} if spec.source is None else self._source(spec.source))

    def _source(self, source: ModelSource) -> dict[str, Any]:
        """Return the entries of a model's table about its Modelica source."""
        entries: dict[str, Any] = {"source": self._path(source.file), "class": source.class_name}
        if source.effects is not None:
            entries["effects"] = self._path(source.effects)
        if source.roots:
            entries["roots"] = [self._path(root) for root in source.roots]
        if source.libraries:
            entries["libraries"] = dict(source.libraries)
        return entries

    def _stage(self, free: list[str], tie: Mapping[str, str]) -> dict[str, Any]:
        """Return one stage with all diagnosed runs, read by the sensors that the campaign specifies."""
        used = [id for case in self.subject.model.cases for id in case.experiments]
        used = [id for id in used if id in self.campaign.identification]
        stage: dict[str, Any] = {"experiments": used, "free": free} if used else {"free": free}
        if tie:
            stage["tie"] = dict(tie)
        sensors: dict[str, Any] = {}
        lengths = [s.segments for s in self.campaign.stages.values() if s.segments is not None]
        if lengths:
            stage["segments"] = segments_in_toml(lengths[-1])
        for table in self.raw.get("stages", {}).values():
            if "observer" in table:
                stage["observer"] = table["observer"]
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


@dataclass(frozen=True, slots=True)
class Comparison:
    """One signal of one run: root mean square errors in `unit`, and relative to the signal's spread (NRMSE).

    `noise` is the standard deviation of the sensor's noise; None where no run was repeated.
    """

    experiment: str
    signal: str
    unit: str | None
    noise: float | None
    rmse_nominal: float
    rmse_corrected: float
    nrmse_nominal: float
    nrmse_corrected: float


@dataclass(frozen=True, slots=True)
class DiagnosisValidation:
    """Benefit of the correction on data that the diagnosis has not seen.

    `runs` are the recordings used for validation. `used` are those of them that the diagnosis was made from, which
    only happens to runs asked for by name; None means that the diagnosis does not say. `gaps` gives, by experiment
    and for ``all`` together, the gap in noise floors of the refitted nominal model and of the corrected one.
    `interval` is the 90 % interval of the overall closure: a bootstrap over runs, and over pieces of runs that
    were not repeated.
    """

    comparisons: tuple[Comparison, ...]
    gaps: Mapping[str, tuple[float, float]]
    interval: tuple[float, float] | None = None
    runs: tuple[str, ...] = ()
    used: tuple[str, ...] | None = ()
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "runs": list(self.runs),
            "used_for_the_diagnosis": None if self.used is None else list(self.used),
            "comparisons": [asdict(c) for c in self.comparisons],
            "gaps": {
                n: {"nominal": a, "corrected": b, "closure": share_closed(a, b)} for n, (a, b) in self.gaps.items()
            },
            "closure_interval": None if self.interval is None else list(self.interval),
            "notes": list(self.notes),
        }


def read_diagnosis(path: Path) -> dict[str, Any]:
    """Return the JSON value of a diagnosis; the verdict of a version 1 file is converted to version 2.

    Raises
    ------
    FmuidError
        The file is missing, is not a diagnosis, or lacks its verdict or a model's values.
    """
    try:
        answer = json.loads(path.read_text())
    except OSError as error:
        raise FmuidError(f"cannot be read ({error.strerror})", where=path, fix="check the path") from None
    except ValueError:
        raise FmuidError("is not JSON", where=path, fix="give a file written by fmuid diagnose") from None
    if (
        not isinstance(answer, dict)
        or answer.get("format") != "fmuid-diagnosis"
        or answer.get("version") not in (1, 2, 3)
    ):
        raise FmuidError(
            "is not a diagnosis, version 1 to 3", where=path, fix="give a file written by fmuid diagnose"
        )
    verdict = answer.get("verdict")
    if not isinstance(verdict, dict) or not {"kind", "effects"} <= verdict.keys():
        raise FmuidError("no verdict", where=path, fix="diagnose again")
    if answer["version"] == 1:  # it lists indistinguishable effects in one list
        apart = [[name] for name in verdict["effects"]] if verdict["kind"] == "ambiguous" else []
        verdict |= {"one_of": apart, "effects": [] if apart else verdict["effects"]}
    verdict.setdefault("one_of", [])
    _check_models(answer, path)
    recordings = answer.get("experiments", [])
    if not isinstance(recordings, list) or not all(isinstance(r, dict) and "sha256" in r for r in recordings):
        raise FmuidError("'experiments' has no hashes of recordings", where=path, fix="diagnose again")
    return answer


def _check_models(answer: Mapping[str, Any], path: Path) -> None:
    """Refuse a diagnosis whose models lack their values."""
    parts = {part: answer.get(part) for part in ("nominal", "model")}
    law = law_of(answer)
    if law is not None:
        parts["law_found"] = law.get("model")
        if not isinstance(law.get("id"), str) or not isinstance(law.get("effect"), dict):
            raise FmuidError("'law_found' has no effect", where=path, fix="diagnose again")
    for part, model in parts.items():
        values = model.get("parameters") if isinstance(model, dict) else None
        if not isinstance(values, dict) or not all(type(v) in (int, float) for v in values.values()):
            raise FmuidError(f"no parameter values in '{part}'", where=path, fix="diagnose again")


@in_one_thread
def validate_diagnosis(
    answer: Mapping[str, Any],
    campaign: Campaign,
    *,
    others: Campaign | None = None,
    corrected: Campaign | None = None,
    experiments: Sequence[str] = (),
    runner: Runner = in_process,
) -> DiagnosisValidation:
    """Simulate other runs with the diagnosed model and with the refitted nominal model.

    Parameters
    ----------
    answer
        The JSON value of a diagnosis.
    campaign
        The diagnosed campaign, or one with an ``[effects]`` table that names the same catalogue.
    others
        The same campaign with other recordings, on which to validate.
    corrected
        The corrected campaign that the diagnosis wrote: its own models and values are simulated. By default, the
        models are built again from the values in `answer`.
    experiments
        Ids or globs. By default, the campaign's validation set, or all of its runs if it has none, without those
        that the diagnosis was made from. Repeats of named runs are included if they were not used.

    Raises
    ------
    FmuidError
        No run is left by default, or the diagnosis does not say which runs it was made from.
        Or the diagnosis is of another model: it has parameters unknown to campaign, catalogue and FMUs.
    SimulationError
        A run cannot be simulated.
    """
    diagnosed = with_catalogue(campaign, load_simulator, runner=runner)  # its runs give the effects their sizes
    law = law_of(answer)
    added = [*([] if law is None else [law]), *answer.get("refinements", ())]
    for one in added:
        diagnosed = with_effect(diagnosed, one["id"], one["effect"])
    if added:
        diagnosed = with_catalogue(diagnosed, load_simulator, runner=runner)
    campaign = replace(others or campaign, effects=diagnosed.effects, models=diagnosed.models)
    chosen, used = _chosen(answer, campaign, experiments)
    model, catalogue, known, _ = model_of(campaign, load_simulator, chosen, runner=runner)
    points = [answer["nominal"]["parameters"], (law or answer)["model"]["parameters"]]
    known |= {*campaign.parameters, *(u.name for e in catalogue.effects.values() for u in e.unknowns)}
    foreign = sorted({name for point in points for name in point if without_owner(name) not in known})
    if foreign:
        raise FmuidError(
            f"neither the campaign nor its catalogue or FMUs know '{foreign[0]}', which the diagnosis has",
            where=campaign.name,
            fix="validate on runs of the model that was diagnosed",
        )
    outcomes = model.predict(points[: 1 if corrected is not None else 2])
    if corrected is not None:
        outcomes += _of_corrected(corrected, campaign, chosen, runner)
    predictions = []
    for outcome in outcomes:
        if isinstance(outcome, SimulationError):
            raise outcome
        predictions.append(outcome)
    runs = model.runs
    channels = {(case.id, c.signal): c for case in model.cases for c in case.channels}
    floor = with_states(Observed.from_runs(runs), model, points[0])
    comparisons = []
    for e, run in enumerate(runs):
        sigma = floor.noise[run.setup].sigma
        for c, signal in enumerate(run.channels):
            before, after = (_rmse(p[e][c], run.values[:, c]) for p in predictions)
            spread = float(np.nanstd(run.values[:, c])) or float("nan")
            channel = channels[run.id, signal]
            factor = abs(channel.to_shown.factor)
            noise = None if sigma.get(signal) is None else factor * sigma[signal]
            errors = (factor * before, factor * after, before / spread, after / spread)
            comparisons.append(Comparison(run.id, signal, channel.shown_unit or None, noise, *errors))
    gaps, interval = _gaps(floor, predictions), _interval(floor, predictions)
    notes = _of_others(points[0], model)
    return DiagnosisValidation(tuple(comparisons), gaps, interval, tuple(e.id for e in chosen), used, notes)


def _of_corrected(
    corrected: Campaign, campaign: Campaign, chosen: Sequence[Experiment], runner: Runner
) -> list[Prediction | SimulationError]:
    """Return the prediction of the chosen runs by the models and values of a corrected campaign."""
    cases = _cases_of(replace(corrected, measurements=campaign.measurements), chosen)
    return CampaignModel(cases, runner, corrected.start_values).predict([{}])


def _of_others(values: Mapping[str, float], model: CampaignModel) -> tuple[str, ...]:
    """Return notes on parameters of a machine or a run for which the diagnosis has no value."""
    names = dict.fromkeys(without_owner(n) for n in values if SEPARATOR in n)
    unseen = {
        name: dict.fromkeys(c.id for c in model.cases if name in c.setting and name not in c.values(values))
        for name in names
    }
    return tuple(
        f"{n} has its start value in {', '.join(ids)}: the diagnosis has none for it"
        for n, ids in unseen.items()
        if ids
    )


def law_of(answer: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the law found by a diagnosis, if any; the corrected model then contains it."""
    law = answer.get("law_found")
    return law if isinstance(law, dict) and law.get("formula") else None


def _chosen(
    answer: Mapping[str, Any], campaign: Campaign, experiments: Sequence[str]
) -> tuple[tuple[Experiment, ...], tuple[str, ...] | None]:
    """Return the runs to validate on, and which of them the diagnosis was made from; None if it does not say."""
    hashed = "experiments" in answer
    seen = {recording["sha256"] for recording in answer.get("experiments", ())}
    if experiments:
        named = {e.id: e.origin for e in experiments_of(campaign, experiments, where="--experiment")}
        chosen = tuple(
            e
            for e in campaign.measurements
            if e.id in named or (e.origin in named.values() and e.digest not in seen)
        )
        return chosen, tuple(e.id for e in chosen if e.digest in seen) if hashed else None
    fix = "record other runs, or name runs with --experiment"
    if not campaign.validation and not hashed:
        raise FmuidError(
            "the diagnosis does not say which runs it was made from",
            where=campaign.name,
            fix=f"diagnose again; {fix}",
        )
    ids = campaign.validation or tuple(campaign.measurements.experiments)
    chosen = tuple(e for e in campaign.measurements if e.id in ids and e.digest not in seen)
    if not chosen:
        kept = "run that is kept for validation" if campaign.validation else "run"
        raise FmuidError(f"every {kept} was used for the diagnosis", where=campaign.name, fix=fix)
    return chosen, () if hashed else None


def _rmse(prediction: FloatArray, measured: FloatArray) -> float:
    return float(np.sqrt(np.nanmean((prediction - measured) ** 2)))


def _interval(observed: Observed, predictions: Sequence[Sequence[FloatArray]]) -> tuple[float, float]:
    before, after = (
        losses([residuals[e][rows] for e, rows in observed.folds], observed)
        for residuals in map(observed.residuals, predictions)
    )
    return closure_interval(before, after)


def _gaps(observed: Observed, predictions: Sequence[Sequence[FloatArray]]) -> dict[str, tuple[float, float]]:
    before, after = (observed.residuals(p) for p in predictions)
    gaps = {"all": (gap(before, observed), gap(after, observed))}
    for k, run in enumerate(observed.runs):
        alone = observed.select([run.id])
        gaps[run.id] = (gap(before[k : k + 1], alone), gap(after[k : k + 1], alone))
    return gaps
