"""Everything that the page works on: one campaign, its measurements, its models and its messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.campaign import SEPARATOR, Campaign, Timing
from fmuid.core.errors import FmuidError
from fmuid.core.experiments import Causality, Experiment, Measurements, Signal
from fmuid.core.immutable import FloatArray
from fmuid.core.units import conversion
from fmuid.data.measurements import read_measurements, write_measurements
from fmuid.data.recordings.conversion import Run, read_run
from fmuid.data.table_layout import TableLayout
from fmuid.identification.check import load_models
from fmuid.identification.full_check import Checked, static_check, with_effects
from fmuid.identification.problem.cases import Case
from fmuid.identification.validate import cases_of, predicted
from fmuid.init.new_campaign import parameter_text
from fmuid.page.campaign_edits import CampaignFile
from fmuid.page.placed_messages import Message
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator, Variable

TIMINGS: tuple[str, ...] = get_args(Timing)
_OLD = {"hold": "held"}  # of the key `interpolation`


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """A column of a log.

    Parameters
    ----------
    name, unit
        As in the log.
    variable
        The model's variable that it is connected to, None if it is not used.
    time, values
        (N,) samples of the chosen run.
    """

    name: str
    unit: str
    variable: str | None
    time: FloatArray
    values: FloatArray


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """A parameter of the campaign or of its models, as the table of the page shows it.

    `state` is ``free``, ``fixed`` (``free = false``, or not in the campaign) or ``known``. `reason` says why it is
    free or fixed.
    """

    name: str
    state: str
    start: float | None
    lower: float | None
    upper: float | None
    unit: str
    description: str
    reason: str
    in_file: bool


class Workspace:
    """The campaign that the page shows.

    Parameters
    ----------
    folder
        The campaign's folder or its `campaign.toml`.
    logs
        The files that it was made from, if known: their unused columns can then also be connected.
    layout
        Layout of these files.
    runner
        Runner of the simulations.
    trust
        Whether functions that the campaign names may be called.
    """

    def __init__(
        self,
        folder: Path,
        logs: Mapping[str, Path] | None = None,
        *,
        layout: TableLayout | None = None,
        runner: Runner = in_process,
        trust: bool = False,
    ) -> None:
        path = folder / "campaign.toml" if folder.is_dir() else folder
        self.file = CampaignFile(path)
        self.runner = runner
        self.trust = trust
        self.campaign: Campaign | None = None
        self.models: Mapping[str, Simulator] = {}
        self.messages: tuple[Message, ...] = ()
        self.checked: Checked | None = None
        self.effects_known = self._effects_begun = False
        self.version = 0
        self._logs = dict(logs or {})
        self._layout = layout
        self._runs: dict[str, Run] = {}
        self._recorded: list[tuple[str, Measurements]] = []  # text of the campaign -> what was recorded before it
        self.refresh()

    @property
    def folder(self) -> Path:
        """The campaign's folder."""
        return self.file.path.parent

    @property
    def measurements_file(self) -> Path:
        """The campaign's measurement file."""
        return self.folder / str(self.file.tables.get("campaign", {}).get("measurements", "measurements.h5"))

    def refresh(self) -> None:
        """Read the campaign again and check it without simulating."""
        self.version += 1
        self.checked, self.effects_known, self._effects_begun = None, False, False
        messages: list[Message] = []
        try:
            self.measurements = read_measurements(self.measurements_file)
            campaign = load_campaign(self.file.path, trust=self.trust)
            if self.campaign is None or campaign.models != self.campaign.models or not self.models:
                self.models = load_models(campaign)
            self.campaign = campaign
            self.checked = static_check(campaign, self.models)
            messages = [Message.of_finding(finding) for finding in self.checked.findings]
        except FmuidError as error:
            messages.append(Message.of_error(error))
        self.messages = tuple(messages)

    def demand_ready(self) -> None:
        """Raise an error unless the campaign can be simulated.

        Raises
        ------
        FmuidError
            The campaign has errors.
        """
        if self.campaign is None or any(m.level == "error" for m in self.messages):
            raise FmuidError("the campaign has errors", where="Prepare", fix="correct them first")

    def simulate_effects(self) -> None:
        """Simulate the stages around their start, as `fmuid check` does, and add what that shows."""
        if self._effects_begun or self.campaign is None or self.checked is None or self.checked.errors:
            return
        self._effects_begun = True  # until something changes, whichever window asks
        version = self.version
        try:
            checked = with_effects(self.checked, self.campaign, self.models, self.runner)
            messages = tuple(Message.of_finding(finding) for finding in checked.findings)
        except FmuidError as error:
            checked, messages = self.checked, (*self.messages, Message.of_error(error))
        if version == self.version:
            self.checked, self.messages, self.effects_known = checked, messages, True
            self.version += 1

    def edit(self, change: Callable[[CampaignFile], object]) -> None:
        """Change the campaign's file and check it again."""
        change(self.file)
        self.refresh()

    def undo(self) -> None:
        """Undo the last edit."""
        if self._recorded and self._recorded[-1][0] == self.file.text:
            write_measurements(self._recorded.pop()[1], self.measurements_file)
        self.file.undo()
        self.refresh()

    def follow(self) -> None:
        """Take over what another program has written to the campaign's file."""
        if self.file.reload():
            self.refresh()

    @property
    def runs(self) -> tuple[Experiment, ...]:
        """The recorded runs."""
        return tuple(self.measurements)

    def variables(self, setup: str) -> dict[str, Variable]:
        """Return the inputs and outputs of the model of a setup, and variables that columns are connected to."""
        every = self.models[setup].variables if setup in self.models else {}
        mapped = set(self._map(setup).values())
        return {n: v for n, v in every.items() if v.causality in ("input", "output") or n in mapped}

    def columns(self, run: str) -> list[Column]:
        """Return the columns of a run: those that were recorded, then those of its log that are not used."""
        experiment = self.measurements[run]
        variables = self.variables(experiment.setup)
        columns = []
        for signal in experiment.signals.values():
            variable = self._map(experiment.setup).get(signal.name, signal.name)
            used = variable if variable in variables or not self.models else None
            columns.append(Column(signal.name, signal.unit, used, experiment.time, signal.values))
        if log := self._log(run):
            table = log.table
            columns += [
                Column(name, table.units.get(name, ""), None, table.time, values)
                for name, values in table.columns.items()
                if name not in experiment.signals
            ]
        return columns

    def connect(self, column: str, variable: str | None, setup: str) -> None:
        """Connect a column with a variable of the model, or with none.

        Raises
        ------
        FmuidError
            The column's unit does not fit the variable's.
        """
        variables = self.variables(setup)
        causality: Causality = (
            "input" if variable is not None and variables[variable].causality == "input" else "output"
        )
        runs = dict(self.measurements.experiments)
        for id, run in runs.items():
            if run.setup != setup:
                continue
            signals = dict(run.signals)
            old = signals.get(column) or self._unused(id, column, variables.get(variable or ""))
            if old is None:
                continue
            if variable is not None:
                conversion(old.unit, variables[variable].unit)
            signals[column] = replace(old, causality=causality)
            if variable is None and column in variables:  # it would be used by its name
                del signals[column]
            runs[id] = replace(run, signals=signals)
        target = None if variable is None or variable == column else variable
        changed = any(runs[id].signals != run.signals for id, run in self.measurements.experiments.items())
        before = self.measurements
        if changed:
            write_measurements(replace(self.measurements, experiments=runs), self.measurements_file)
        values: dict[tuple[str | int, ...], Any] = {("models", setup, "map", column): target}
        values |= {  # a variable has one column
            ("models", setup, "map", other): None
            for other, taken in self._map(setup).items()
            if taken == variable and other != column
        }
        self.file.set_all(values)
        if changed:
            self._recorded.append((self.file.text, before))
        self.refresh()

    def timing(self, setup: str) -> str:
        """Return when the inputs of a setup act, and when its outputs are read."""
        table = self.file.tables.get("models", {}).get(setup, {})
        old = str(table.get("interpolation", TIMINGS[0]))
        return str(table.get("timing", _OLD.get(old, old)))

    def set_timing(self, setup: str, timing: str) -> None:
        """Choose when the inputs of a setup act, and when its outputs are read."""
        self.file.set_all({("models", setup, "timing"): timing, ("models", setup, "interpolation"): None})
        self.refresh()

    def signal_timing(self, column: str) -> str:
        """Return the timing of one signal where it differs from that of its model, or nothing."""
        return str(self.file.tables.get("signals", {}).get(column, {}).get("timing", ""))

    def set_signal_timing(self, column: str, timing: str) -> None:
        """Choose the timing of one signal; nothing means that of its model."""
        if timing or self.signal_timing(column):
            self.file.set(("signals", column, "timing"), timing or None)
            self.refresh()

    def parameters(self) -> list[ParameterRow]:
        """Return the campaign's parameters, then the other parameters of its models."""
        reasons = self.file.reasons()
        every = {
            n: v
            for model in self.models.values()
            for n, v in model.variables.items()
            if v.causality == "parameter"
            and v.type in ("Real", "Float64", "Float32")
            and v.variability != "constant"
        }
        tables = self.file.tables.get("parameters", {})
        effects = {e.parameter: e for e in (self.checked.effects if self.checked else ())}
        rows = []
        for name, table in tables.items():
            if not isinstance(table, dict):
                continue
            variable = every.get(name)
            state = "known" if table.get("known") else "free" if table.get("free", True) else "fixed"
            reason = reasons.get(name, "")
            if name in effects:
                effect = effects[name]
                moved = effect.criterion.removesuffix(" least_squares")
                reason = f"1 % more moves {moved} by {effect.change:.2g} σ"
            rows.append(
                ParameterRow(
                    name,
                    state,
                    _number(table.get("start")),
                    _number(table.get("lower")),
                    _number(table.get("upper")),
                    str(table.get("unit") or (variable.unit if variable else "") or ""),
                    str(table.get("description") or (variable.description if variable else "")),
                    reason,
                    True,
                )
            )
        settings = self.file.tables.get("settings", {})
        for name, variable in every.items():
            if name not in tables and name not in settings:
                rows.append(
                    ParameterRow(
                        name,
                        "fixed",
                        variable.start,
                        None,
                        None,
                        variable.unit or "",
                        variable.description,
                        reasons.get(name, "at the model's value"),
                        False,
                    )
                )
        return rows

    def set_state(self, name: str, state: str) -> None:
        """Make a parameter ``free``, ``fixed`` or ``known``."""
        text = next((parameter_text(m.variables[name]) for m in self.models.values() if name in m.variables), "")
        with self.file.one_edit():
            self.file.free(name, text)
            if state != "free":
                self.file.set_all(
                    {
                        ("parameters", name, "free"): False,
                        ("parameters", name, "known"): True if state == "known" else None,
                    }
                )
        self.refresh()

    def start_from(self, values: Mapping[str, float]) -> None:
        """Make values the start values of the campaign's parameters, within their bounds.

        The names are those of results: ``name@owner`` is the value of one machine or experiment.
        """
        changes: dict[tuple[str | int, ...], Any] = {}
        tables = self.file.tables.get("parameters", {})
        for full, value in values.items():
            name, of_one, owner = full.partition(SEPARATOR)
            if name not in tables or not np.isfinite(value):
                continue
            value = float(min(max(value, tables[name].get("lower", -np.inf)), tables[name].get("upper", np.inf)))
            path = ("parameters", name, "starts", owner) if of_one else ("parameters", name, "start")
            changes[path] = value
        self.file.set_all(changes)
        self.refresh()

    def set_criterion(self, stage: str, number: int, key: str, typed: str) -> None:
        """Set ``demand`` or ``weight`` of a criterion of a stage.

        Raises
        ------
        FmuidError
            The text is not a number.
        """
        try:
            numbers = [float(part) for part in typed.split(",")]
        except ValueError:
            raise FmuidError(f"'{typed}' is not a number", where=key, fix="write it as in 0.5") from None
        self.file.set(("stages", stage, "criteria", number, key), numbers if len(numbers) > 1 else numbers[0])
        self.refresh()

    def role(self, run: str) -> str:
        """Return the role of a run: ``identification``, ``validation`` or ``none``."""
        roles = self.file.tables.get("roles", {})
        origin = self._origin(run)
        for role in ("validation", "identification"):
            if origin in roles.get(role, ()):
                return role
        if self.campaign is not None:
            return (
                "identification"
                if run in self.campaign.identification
                else ("validation" if run in self.campaign.validation else "none")
            )
        return "none"

    def set_role(self, run: str, role: str) -> None:
        """Choose what a run and its repeats are used for."""
        firsts = [e.id for e in self.measurements if not e.repeats_another]
        roles: dict[str, list[str]] = {"identification": [], "validation": []}
        for first in firsts:
            used = role if first == self._origin(run) else self.role(first)
            if used in roles:
                roles[used].append(first)
        self.file.set_all({("roles", name): ids for name, ids in roles.items()})
        self.refresh()

    def cases(self, runs: Sequence[str]) -> tuple[Case, ...]:
        """Return the cases of runs, ready to be simulated many times; none if the campaign has errors."""
        if self.campaign is None:
            return ()
        chosen = [run for run in self.campaign.measurements if run.id in runs and run.setup in self.models]
        return cases_of(self.campaign, chosen, self.models, self.campaign.start_values)

    def simulated(self, run: str) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Return time and simulation at the start values by column, in the log's units; empty if it fails."""
        if self.campaign is None:
            return {}
        curves: dict[str, tuple[FloatArray, FloatArray]] = {}
        try:
            cases = self.cases([run])
            outcomes = predicted(cases, self.campaign.start_values, self.runner)
        except FmuidError:
            return {}
        for case, outcome in zip(cases, outcomes, strict=True):
            if isinstance(outcome, FmuidError):
                continue
            for channel, values in zip(case.channels, outcome, strict=True):
                unit = self.measurements[run].signals[channel.signal].unit
                curves[channel.signal] = case.time, conversion(channel.unit or "1", unit)(values)
        return curves

    def _map(self, setup: str) -> dict[str, str]:
        model = self.file.tables.get("models", {}).get(setup, {})
        return {str(k): str(v) for k, v in model.get("map", {}).items()}

    def _origin(self, run: str) -> str:
        experiment = self.measurements[run]
        return experiment.repeat_of or experiment.repeat_of_reference or run

    def _log(self, run: str) -> Run | None:
        if run not in self._runs and run in self._logs:
            self._runs[run] = read_run(self._logs[run], layout=self._layout)
        return self._runs.get(run)

    def _unused(self, run: str, column: str, variable: Variable | None) -> Signal | None:
        """Return a column of a log that was not recorded as a signal."""
        log = self._log(run)
        if log is None or column not in log.table.columns:
            return None
        unit = log.table.units.get(column) or (variable.unit if variable else None) or "1"
        values = np.asarray(log.table.columns[column], dtype=np.float64)
        return Signal(column, values, unit, "output", resampled=log.resampled.get(column, ""))


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
