"""Prepare: connect columns and variables, choose parameters and runs, next to the edited file."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import replace

from nicegui import run, ui

from fmuid.campaigns.campaign_toml import SIGNAL_TIMINGS
from fmuid.core.errors import FmuidError
from fmuid.core.immutable import FloatArray
from fmuid.page.elements import (
    Choice,
    Input,
    Notes,
    button,
    captioned,
    curve,
    element,
    enable,
    errors_shown,
    header,
    set_text,
    text,
)
from fmuid.page.parameter_table import ParameterTable
from fmuid.page.placed_messages import Kind, Message, by_place
from fmuid.page.workspace import TIMINGS, Column, Workspace
from fmuid.report.plots.figure_data import pretty_unit

_NOT_USED = "(not used)"
_TIMING = {
    "held": "held until the next sample",
    "linear": "linear between samples",
    "band-limited": "band-limited (anti-aliasing filter)",
    "held-read-after": "held, outputs read just after",
    "preceding": "a sample acts from the time of the previous one",
}
_OF_SIGNALS = {
    "": "as the model",
    "held": "held",
    "linear": "linear",
    "band-limited": "band-limited",
    "held-read-after": "read after",
}
_ROLES = {"identification": "identification", "validation": "validation", "none": "not used"}
_QUIET = 1.2  # s without an edit before the parameters' effects are simulated


class PrepareView:
    """The first tab of the page."""

    def __init__(self, workspace: Workspace) -> None:
        self._work = workspace
        self._shown = self._simulated = -1  # versions of the campaign
        self._busy = False
        self._run = next((r.id for r in workspace.runs if not r.repeats_another), "")
        self._dragged: str | None = None
        self._pictures: dict[str, tuple[ui.html, tuple[str, FloatArray, FloatArray]]] = {}
        self._updates: list[Callable[[Mapping[tuple[Kind, str], list[Message]]], None]] = []
        self._places: set[tuple[Kind, str]] = set()
        self._shape: object = None
        with element("div", "beside"):
            self._main = element("div")
            with element("section", "side", aria_label="The file"):
                self._side()
        self._build()
        ui.timer(0.4, self._tick)

    # ---------------------------------------------------------------- what the file says

    def _side(self) -> None:
        text("h2", "campaign.toml")
        with element("div", "buttons"):
            self._undo = button("Undo", lambda: self._act(self._work.undo))
            self._redo = button("Redo", lambda: self._act(lambda: self._work.edit(lambda f: f.redo())))
        self._file_text = self._work.file.text
        self._file = Input("textarea", "Text of campaign.toml", self._file_text, self._typed, spellcheck="false")
        self._file.element.classes("file")
        text("p", f"Saved as {self._work.file.path}. Comments are kept.", "soft")

    def _typed(self, content: str) -> None:
        self._act(lambda: self._work.edit(lambda f: f.replace(content)))

    def _act(self, action: Callable[[], object]) -> None:
        with errors_shown():
            action()
        self._show()

    # ---------------------------------------------------------------- structure

    def _structure(self) -> object:
        work = self._work
        recorded = {} if not self._run else work.measurements[self._run].signals
        kinds = {name: signal.causality for name, signal in recorded.items()}
        columns = tuple((c.name, c.unit, kinds.get(c.name)) for c in work.columns(self._run)) if self._run else ()
        setup = self._setup
        return (
            self._run,
            columns,
            tuple(work.variables(setup)) if setup else (),
            tuple((row.name, row.in_file) for row in work.parameters()),
            tuple(r.id for r in work.runs),
        )

    @property
    def _setup(self) -> str:
        return self._work.measurements[self._run].setup if self._run else ""

    def _build(self) -> None:
        self._shape = self._structure()
        self._updates.clear()
        self._places.clear()
        self._pictures.clear()
        self._main.clear()
        with self._main:
            self._status = text("p", "", "headline", role="status")
            elsewhere = Notes()
            self._columns()
            self._parameters()
            self._runs()
            self._graph()
        self._updates.append(lambda messages: elsewhere.show(self._without_place(messages)))
        self._shown = self._simulated = -1
        self._show()

    def _show(self) -> None:
        """Bring everything up to date; elements stay, so that the keyboard's focus does."""
        if self._structure() != self._shape:
            self._build()
            return
        if self._shown == self._work.version:
            return
        self._shown = self._work.version
        messages = by_place(self._work.messages)
        for update in self._updates:
            update(messages)
        errors = sum(m.level == "error" for m in self._work.messages)
        others = sum(m.level == "warning" for m in self._work.messages)
        words = f"{errors} to correct" if errors else "Ready to run"
        set_text(self._status, words + (f", {others} warnings" if others > 1 else ", 1 warning" if others else ""))
        # More messages may follow from simulations.
        self._status.props["aria-busy"] = str(not errors and not self._work.effects_known).lower()
        self._status.update()
        if self._file_text != self._work.file.text:  # otherwise a text that was refused stays, to be corrected
            self._file_text = self._work.file.text
            self._file.show(self._file_text)
        enable(self._undo, self._work.file.can_undo)
        enable(self._redo, self._work.file.can_redo)

    async def _tick(self) -> None:
        with errors_shown():
            self._work.follow()
        self._show()
        if self._simulated != self._work.version:
            self._simulated = self._work.version
            await self._simulate()
        if not self._work.effects_known and not self._busy:
            version = self._work.version
            await asyncio.sleep(_QUIET)
            if version != self._work.version:
                return
            self._busy = True
            try:
                await run.io_bound(self._work.simulate_effects)
            finally:
                self._busy = False
            self._show()

    def _notes(self, kind: Kind, name: str) -> None:
        notes = Notes()
        self._places.add((kind, name))
        self._updates.append(lambda messages: notes.show(messages.get((kind, name), [])))

    def _without_place(self, messages: Mapping[tuple[Kind, str], list[Message]]) -> list[Message]:
        """Return the messages about parts of the campaign that are not on the page, with the name of the part."""
        return [
            replace(m, what=f"{kind} {name}: {m.what}") if name else m
            for (kind, name), some in messages.items()
            if (kind, name) not in self._places
            for m in some
        ]

    # ---------------------------------------------------------------- columns and variables

    def _columns(self) -> None:
        text("h2", "Log and model")
        if not self._run:
            return
        setup = self._setup
        self._notes("model", setup)
        with element("div", "buttons"):
            with captioned("Show run"):
                Choice("Run to show", {r.id: r.id for r in self._work.runs}, self._run, self._choose_run)
            with captioned("Timing"):
                self._timing(setup)
        with element("table", "rows", aria_label="Columns of the log and variables of the model"):
            header("Column of the log", "Measured, simulated", "Variable of the model", "Timing")
            with element("tbody"):
                for column in self._work.columns(self._run):
                    self._column(column, setup)
        self._chips = element("div")
        self._chips_of: list[str] = []
        self._updates.append(lambda _: self._free_variables(setup))

    def _timing(self, setup: str) -> None:
        options = {key: _TIMING.get(key, key) for key in TIMINGS}
        choice = Choice(
            "Timing of inputs between samples",
            options,
            self._work.timing(setup),
            lambda key: self._act(lambda: self._work.set_timing(setup, key)),
        )
        self._updates.append(lambda _: choice.show(self._work.timing(setup)))

    def _choose_run(self, run: str) -> None:
        self._run = run
        self._build()

    def _column(self, column: Column, setup: str) -> None:
        variables = self._work.variables(setup)
        options = {"": _NOT_USED}
        options |= {n: f"{n} [{pretty_unit(v.unit or '') or '1'}], {v.causality}" for n, v in variables.items()}
        row = element("tr", draggable="true")
        row.on("dragstart", lambda _: setattr(self, "_dragged", column.name))
        with row:
            with element("th", "name", scope="row"):
                text("span", column.name)
                text("span", f" [{pretty_unit(column.unit) or '1'}]" if column.unit else " [?]", "soft")
            with element("td", data_label="Measured, simulated"):
                measured = ("measured", column.time, column.values)
                picture = ui.html(curve(f"{column.name} over time", [measured]), sanitize=False)
                self._pictures[column.name] = picture, measured
            with element("td", "wide", data_label="Variable of the model"):
                choice = Choice(
                    f"Variable for {column.name}",
                    options,
                    column.variable or "",
                    lambda key: self._connect(column.name, key or None),
                )
                notes = Notes()
            signal = self._work.measurements[self._run].signals.get(column.name)
            timing = None
            with element("td", data_label="Timing"):
                if signal is not None:
                    timing = Choice(
                        f"Timing of {column.name}",
                        {key: _OF_SIGNALS[key] for key in ("", *SIGNAL_TIMINGS[signal.causality])},
                        self._work.signal_timing(column.name),
                        lambda key: self._act(lambda: self._work.set_signal_timing(column.name, key)),
                    )
        now = column.variable or ""
        self._places.add(("signal", column.name))

        def update(messages: Mapping[tuple[Kind, str], list[Message]]) -> None:
            current = {c.name: c.variable or "" for c in self._work.columns(self._run)}
            choice.show(current.get(column.name, now))
            if timing is not None:
                timing.show(self._work.signal_timing(column.name))
            of_column = messages.get(("signal", column.name), [])
            if not current.get(column.name):
                of_column = [m for m in of_column if m.level != "note"]
            notes.show(of_column)

        self._updates.append(update)

    def _connect(self, column: str, variable: str | None) -> None:
        self._act(lambda: self._work.connect(column, variable, self._setup))
        self._show()

    def _free_variables(self, setup: str) -> None:
        taken = {c.variable for c in self._work.columns(self._run)}
        left = {n: v for n, v in self._work.variables(setup).items() if n not in taken}
        if self._chips_of == list(left):  # a chip stays while something is dragged to it
            return
        self._chips_of = list(left)
        self._chips.clear()
        if not left:
            return
        with self._chips:
            text("p", "Variables without a column. Drag a column onto one, or choose in the table.", "soft")
            with element("ul", "chips"):
                for name, variable in left.items():
                    unit = pretty_unit(variable.unit or "") or "1"
                    chip = text("li", f"{variable.causality} {name} [{unit}]", "chip name")
                    chip.on("dragover", js_handler="(event) => event.preventDefault()")
                    chip.on("drop", lambda _, name=name: self._dropped(name))

    def _dropped(self, variable: str) -> None:
        if self._dragged is not None:
            self._connect(self._dragged, variable)
        self._dragged = None

    async def _simulate(self) -> None:
        """Draw the simulation at the start values over each measured curve."""
        if not self._run:
            return
        lines = await run.io_bound(self._work.simulated, self._run) or {}
        for name, (picture, measured) in self._pictures.items():
            drawn = [measured, *([("simulated", *lines[name])] if name in lines else [])]
            what = f"{name} over time, measured" + (" and simulated" if name in lines else "")
            if (content := curve(what, drawn)) != picture.content and not picture.is_deleted:
                picture.set_content(content)

    # ---------------------------------------------------------------- parameters

    def _parameters(self) -> None:
        rows = self._work.parameters()
        mine, others = [r for r in rows if r.in_file], [r for r in rows if not r.in_file]
        text("h2", "Parameters")
        self._tables = [ParameterTable("Parameters of the campaign", mine, self._work, self._act)]
        if others:
            with element("details"):
                text("summary", f"{len(others)} more parameters of the model, fixed at its values")
                self._tables.append(ParameterTable("Other parameters of the model", others, self._work, self._act))

        self._places |= {("parameter", row.name) for row in rows}
        for table in self._tables:
            self._updates.append(table.show)

    # ---------------------------------------------------------------- runs and model

    def _runs(self) -> None:
        text("h2", "Runs")
        self._notes("roles", "")
        firsts = [r for r in self._work.runs if not r.repeats_another]
        with element("table", "rows", aria_label="Recorded runs"):
            header("Run", "Used for", "Repeats", "Samples", "Duration")
            with element("tbody"):
                for first in firsts:
                    repeats = [r.id for r in self._work.runs if first.id in (r.repeat_of, r.repeat_of_reference)]
                    with element("tr"):
                        with element("th", "name wide", scope="row"):
                            text("span", first.id)
                            notes = Notes()
                            ids = (first.id, *repeats)
                            self._places |= {("experiment", id) for id in ids}
                        with element("td", data_label="Used for"):
                            choice = Choice(
                                f"Use of run {first.id}",
                                _ROLES,
                                self._work.role(first.id),
                                lambda key, id=first.id: self._act(lambda: self._work.set_role(id, key)),  # type: ignore[misc]
                            )
                        text("td", ", ".join(repeats) or "none", "name", data_label="Repeats")
                        text("td", str(first.time.size), data_label="Samples")
                        text("td", f"{first.time[-1] - first.time[0]:.4g} s", data_label="Duration")

                    def update(
                        messages: Mapping[tuple[Kind, str], list[Message]],
                        ids: tuple[str, ...] = ids,
                        choice: Choice = choice,
                        notes: Notes = notes,
                    ) -> None:
                        choice.show(self._work.role(ids[0]))
                        notes.show([m for id in ids for m in messages.get(("experiment", id), [])])

                    self._updates.append(update)
        for stage in self._work.file.tables.get("stages", {}):
            self._notes("stage", stage)

    def _graph(self) -> None:
        campaign = self._work.campaign
        source = campaign.models[self._setup].source if campaign and self._setup in campaign.models else None
        if source is None:
            return
        from fmuid.report.model_graph import drawing, graph_of
        from fmuid.simulation.model_source import flat_model

        try:
            drawn = drawing(graph_of(flat_model(source)), ())
        except FmuidError:
            return
        if drawn is not None:
            text("h2", "Model")
            with element("figure", "model-graph"):
                ui.html(drawn.svg, sanitize=False)
                text("figcaption", drawn.caption, "soft")
