"""The next experiment: limits of the rig, the design, and its input and predictions as curves."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.errors import FmuidError, UnitError
from fmuid.core.units import conversion
from fmuid.design_pipeline import FILE_NAME, INPUT
from fmuid.page.command_control import Command, CommandControl
from fmuid.page.elements import Charts, Choice, Field, captioned, element, errors_shown, header, text
from fmuid.page.workspace import Workspace
from fmuid.report.figures import TIME
from fmuid.report.plots.figure_data import Axis, Figure, LineFigure, Panel, Role, Series, pretty_unit

_ENDS = {"min": "Least", "max": "Largest", "rate": "Largest change per second"}
_ROLES: Mapping[str, Role] = {"noise": "measurement", "limit": "floor"}
_MODELS: tuple[Role, ...] = ("final", "reference", "alternative", "start")


class NextExperiment:
    """A part of the page that designs the next run of the rig.

    Parameters
    ----------
    workspace
        Has the campaign with its limits.
    run, diagnosis
        Folders of the identification and of the diagnosis to continue from, if there are any.
    folder
        The folder of the design.
    """

    def __init__(self, workspace: Workspace, run: Path | None, diagnosis: Path | None, folder: Path) -> None:
        self._work = workspace
        self._run, self._diagnosis, self._folder = run, diagnosis, folder
        purposes = {"parameters": "narrow the parameters' intervals"}
        if diagnosis is not None:
            purposes = {"diagnosis": "settle what the diagnosis left open"} | purposes
        self._purposes, self._purpose = purposes, next(iter(purposes))
        self._control = CommandControl(
            "Next experiment",
            "Design",
            self._command,
            look="Show the design",
            finished=self.show,
            purpose="The most informative run within the limits of the rig.",
            stop="Stop",
            options=self._options,
        )
        self._facts = element("dl", "facts")
        self._charts = Charts()

    def _options(self) -> None:
        with element("div", "buttons"), captioned("It should"):
            Choice("Purpose of the next experiment", self._purposes, self._purpose, self._choose)
        with element("details"):
            text("summary", "Limits of the rig")
            text("p", "If no input has limits, the ranges of the recorded runs are used.", "soft")
            self._limits()

    def _choose(self, purpose: str) -> None:
        self._purpose = purpose

    def _command(self) -> Command:
        def words() -> list[object]:
            self._work.demand_ready()
            source: list[object] = [self._work.file.path]
            if self._purpose == "diagnosis" and self._diagnosis is not None:
                source += ["--from", self._diagnosis]
            elif self._run is not None:
                source += ["--from", self._run]
            trust = ["--trust"] if self._work.trust else []
            return ["design", *source, "--for", self._purpose, "--out", self._folder, *trust]

        return Command(words, self._folder / FILE_NAME)

    # ---------------------------------------------------------------- limits

    def _limits(self) -> None:
        self._updates: list[tuple[Field, Callable[[], object]]] = []
        with element("table", "rows", aria_label="Limits of the rig"):
            header("Signal", "Unit", *_ENDS.values())
            with element("tbody"):
                with element("tr"):
                    text("th", "duration of the run", "name wide", scope="row")
                    text("td", "s", data_label="Unit")
                    with element("td", data_label="Largest"):
                        field = Field("Duration of the run", "", lambda typed: self._set(("duration",), typed))
                        self._updates.append((field, lambda: self._table().get("duration")))
                for name, (kind, unit) in self._signals().items():
                    with element("tr"):
                        text("th", f"{kind} {name}", "name wide", scope="row")
                        text("td", pretty_unit(unit), data_label="Unit")
                        for key, words in _ENDS.items():
                            if key == "rate" and kind != "input":
                                continue
                            with element("td", data_label=words):
                                self._limit(name, key, words, unit)
        self.refresh()

    def _limit(self, name: str, key: str, words: str, unit: str) -> None:
        field = Field(f"{words} of {name}", "", lambda typed: self._set((name, key), typed, unit))
        self._updates.append((field, lambda: self._in_log_unit(name, self._table().get(name, {}), key, unit)))

    def _table(self) -> Mapping[str, Any]:
        limits: Mapping[str, Any] = self._work.file.tables.get("limits", {})
        return limits

    def refresh(self) -> None:
        """Show the limits as they are in the campaign now."""
        for field, value in self._updates:
            field.show(_written(value()))

    def _signals(self) -> dict[str, tuple[str, str]]:
        """Return the connected signals of the recorded runs, with kind and unit of the log."""
        return {
            signal.name: (signal.causality, signal.unit)
            for run in self._work.runs
            for signal in run.signals.values()
            if self._variable(run.setup, signal.name) in self._work.variables(run.setup)
        }

    def _variable(self, setup: str, signal: str) -> str:
        campaign = self._work.campaign
        return campaign.models[setup].variable(signal) if campaign and setup in campaign.models else signal

    def _in_log_unit(self, name: str, table: Mapping[str, Any], key: str, unit: str) -> float | None:
        value = table.get(key)
        if value is None:
            return None
        of_model = next(
            (
                self._work.variables(run.setup)[variable].unit
                for run in self._work.runs
                if (variable := self._variable(run.setup, name)) in self._work.variables(run.setup)
            ),
            None,
        )
        convert = conversion(str(table.get("unit") or of_model or unit), unit)
        return float(convert.factor * value + (0.0 if key == "rate" else convert.offset))

    def _set(self, keys: tuple[str, ...], typed: str, unit: str = "") -> None:
        with errors_shown():
            try:
                value = float(typed.replace("−", "-")) if typed.strip() else None
            except ValueError:
                raise FmuidError(f"'{typed}' is not a number", where=keys[0], fix="write it as in 1e-3") from None
            changes: dict[tuple[str | int, ...], Any] = {("limits", *keys): value}
            table = self._table().get(keys[0], {})
            if unit:  # the whole table gets the unit of the log
                for key in _ENDS:
                    if key != keys[1] and key in table:
                        changes["limits", keys[0], key] = self._in_log_unit(keys[0], table, key, unit)
                changes["limits", keys[0], "unit"] = unit
            self._work.edit(lambda file: file.set_all(changes))

    # ---------------------------------------------------------------- the design

    def show(self) -> None:
        """Show the design: its facts, its input within the limits, and what the model predicts."""
        with errors_shown():
            try:
                answer = json.loads((self._folder / FILE_NAME).read_text(encoding="utf-8"))
                inputs = [self._panel(f) for f in sorted((self._folder / "data").glob("input-*.csv"))]
                outputs = [self._panel(f) for f in sorted((self._folder / "data").glob("prediction-*.csv"))]
            except (OSError, ValueError) as error:
                raise FmuidError(f"cannot be read ({error})", where=self._folder, fix="design it again") from None
            self._facts.clear()
            with self._facts:
                for label, value, *_ in answer["facts"]:
                    text("dt", str(label))
                    text("dd", str(value))
                text("dt", "Input for the rig")
                text("dd", str(self._folder / INPUT), "name")
            figures: list[Figure] = [
                LineFigure("design-input", "Input", tuple(inputs), "Dashed: limits.", 1),
                LineFigure("design-prediction", "Predictions", tuple(outputs), "", 1),
            ]
            self._charts.show(figures)

    def _panel(self, file: Path) -> Panel:
        """Return a panel of the design's figures from its data, in the unit of the log."""
        with file.open(encoding="utf-8", newline="") as stream:
            (_, _, column, *_), *rows = csv.reader(stream)
        name, _, unit = column.rstrip("]").rpartition(" [") if column.endswith("]") else (column, "", "")
        of_log = self._signals().get(name, ("", unit))[1]
        try:
            convert = conversion(unit or "1", of_log)
        except UnitError:
            convert, of_log = conversion("1", "1"), unit
        parts: list[tuple[str, list[tuple[float, float]]]] = []
        for label, time, value, *_ in rows:
            point = float(time), float(value) if value else math.nan
            if not parts or parts[-1][0] != label or point[0] < parts[-1][1][-1][0]:
                parts.append((label, []))
            parts[-1][1].append(point)
        models = list(dict.fromkeys(label for label, _ in parts if label not in _ROLES))
        series = []
        for label, points in parts:
            x, y = np.array(points).T
            role = _ROLES.get(label) or _MODELS[models.index(label) % len(_MODELS)]
            series.append(Series(label, x, convert(y), role))
        return Panel(name, TIME, Axis(name, of_log), tuple(series))


def _written(value: Any) -> str:
    return f"{float(value):.6g}" if isinstance(value, int | float) else ""
