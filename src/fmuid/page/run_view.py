"""Run: follow an identification, pause it, change what it searches, and continue from the best point."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import msgspec
import numpy as np
from nicegui import run, ui

from fmuid.core.errors import FmuidError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis_pipeline import FILE_NAME as DIAGNOSIS
from fmuid.diagnosis_pipeline import JOURNAL
from fmuid.identification.history import FollowedRun, StageHistory
from fmuid.identification.result import FILE as RESULT
from fmuid.identification.result import Result, StageResult
from fmuid.identification.validate import predicted
from fmuid.page.command_control import Command, CommandControl
from fmuid.page.command_process import CommandProcess
from fmuid.page.elements import (
    Charts,
    Choice,
    Field,
    button,
    captioned,
    element,
    enable,
    errors_shown,
    header,
    set_text,
    text,
)
from fmuid.page.outcome import in_log_units
from fmuid.page.parameter_table import ParameterTable
from fmuid.page.placed_messages import by_place
from fmuid.page.workspace import Workspace
from fmuid.report import figures
from fmuid.report.plots.figure_data import Figure, Role
from fmuid.report.predicted import overlays
from fmuid.report.stage_sections import search_history

_PAUSE = 3.0  # s between two drawings while a search runs, so that the browser has time for the user


class RunView:
    """The second tab of the page.

    Parameters
    ----------
    workspace
        Has the campaign.
    folder
        The run folder to follow.
    finished
        Called with the run folder when the user wants to look at the result.
    """

    def __init__(self, workspace: Workspace, folder: Path, finished: Callable[[Path], object]) -> None:
        self._work = workspace
        self._finished = finished
        self._process: CommandProcess | None = None
        self._follow(folder)
        self._drawing = False
        self._next_drawing = 0.0
        self._shown_campaign = -1
        self._shape: object = None
        self._run = next((r.id for r in workspace.runs if not r.repeats_another), "")
        self._status = text("p", "", "headline", role="status")
        with element("div", "buttons"):
            self._start = button("Start", self._started, "main")
            self._pause = button("Pause", self._paused)
            self._resume = button("Resume", self._resumed)
            self._stop = button("Look at the result", self._stopped)
            self._best = button("Continue from the best point", self._steered)
            with captioned("Show run"):
                Choice("Run to follow", {r.id: r.id for r in workspace.runs}, self._run, self._choose)
        self._where = text("p", "", "soft name")
        self._complaint = text("p", "", "note error", role="alert")
        self._diagnosis = CommandControl(
            "Diagnosis",
            "Diagnose",
            self._diagnose,
            look="Look at the diagnosis",
            finished=lambda: self._finished(self._diagnosis_folder),
            purpose="What the model misses, after an identification. fmuid diagnose takes seconds to minutes.",
        )
        self._charts = Charts()
        with element("details") as self._details:
            text("summary", "Parallel coordinates of parameters and criteria")
            self._parallel = Charts()
        self._details.on("toggle", self._opened, js_handler="(event) => emit(event.target.open)")
        self._open = False
        with element("details") as self._steering:
            text("summary", "Steer: bounds, free parameters, demands and weights")
            text(
                "p",
                "Pause, change what the search may do, then continue from the best point. "
                "The changes go into campaign.toml.",
                "soft",
            )
            self._inside = element("div")
        ui.timer(0.7, self._tick)

    def _follow(self, folder: Path) -> None:
        self._folder = folder
        self._followed = FollowedRun(folder)
        self._seen = ""

    # ---------------------------------------------------------------- buttons

    def _started(self) -> None:
        with errors_shown():
            folder = self._folder
            if self._followed.run.stages and not self._running:
                folder = _next_folder(folder)
            self._launch(folder)

    def _launch(self, folder: Path, *, resume: bool = False) -> None:
        self._work.demand_ready()
        if folder != self._folder:
            self._follow(folder)
        trust = ["--trust"] if self._work.trust else []
        self._process = CommandProcess("identify", self._work.file.path, "--out", folder, "--no-report", *trust)
        self._process.start(resume=resume)

    @property
    def _diagnosis_folder(self) -> Path:
        name = self._folder.name
        return self._folder.with_name(f"{name}-diagnosis")

    def _diagnose(self) -> Command:
        folder = self._diagnosis_folder

        def words() -> list[object]:
            self._work.demand_ready()
            source = self._folder if (self._folder / RESULT).is_file() else self._work.file.path
            return ["diagnose", source, "--out", folder, *(["--trust"] if self._work.trust else [])]

        return Command(words, folder / DIAGNOSIS, folder / JOURNAL)

    def _paused(self) -> None:
        if self._process is not None:
            self._process.stop()

    def _resumed(self) -> None:
        with errors_shown():
            self._launch(self._folder, resume=True)

    async def _stopped(self) -> None:
        if self._process is not None:
            self._process.stop()
            await run.io_bound(self._process.wait)
        self._finished(self._folder)

    async def _steered(self) -> None:
        """Start another search at the best point of this one, with the campaign as it is now."""
        if self._process is not None:
            self._process.stop()
            await run.io_bound(self._process.wait)
        with errors_shown():
            self._followed.look()
            best = self._best_values()
            self._work.start_from(best)
            self._launch(_next_folder(self._folder))

    def _choose(self, run: str) -> None:
        self._run = run
        self._seen = ""

    # ---------------------------------------------------------------- what is seen

    @property
    def _running(self) -> bool:
        return self._process is not None and self._process.running

    def _stage(self) -> StageHistory | None:
        stages = [s for s in self._followed.run.stages.values() if s.rows]
        return stages[-1] if stages else None

    def _best_values(self) -> dict[str, float]:
        for stage in reversed(list(self._followed.run.stages.values())):
            improved = np.flatnonzero(stage.rows.improved)
            if improved.size:
                return dict(stage.rows[int(improved[-1])].parameters)
        return {}

    async def _tick(self) -> None:
        running = self._running  # before the journal is read: of a process that has ended, it is complete
        with errors_shown():
            self._followed.look()
        self._words(running)
        self._steer()
        stage = self._stage()
        seen = "" if stage is None else f"{self._folder} {stage.name} {len(stage.rows)} {self._run}"
        due = perf_counter() >= self._next_drawing or not running
        if stage is not None and seen != self._seen and not self._drawing and due:
            self._drawing = True
            self._seen = seen
            try:
                await self._draw(stage)
            finally:
                self._drawing = False
                self._next_drawing = perf_counter() + _PAUSE

    def _words(self, running: bool) -> None:
        stage, complete = self._stage(), not self._followed.in_progress
        if stage is None:
            words = "Starting …" if running else "Not started"
        else:
            costs = stage.rows.costs[stage.rows.searched]
            known = costs[np.isfinite(costs)]
            cost = f", cost {known[0]:.4g} → {known.min():.4g}" if known.size else ""
            state = "Running" if running else "Done" if complete else "Paused"
            if not running and not complete and self._process is None:
                state = "Interrupted, or made by another process"
            words = f"{state}: stage {stage.name}, {costs.size} evaluations{cost}"
        set_text(self._status, words)
        set_text(self._where, f"Run folder: {self._folder}")
        set_text(self._stop, "Stop and look" if running else "Look at the result")
        set_text(self._complaint, self._process.complaint if self._process is not None else "")
        self._complaint.set_visibility(bool(self._process is not None and self._process.complaint))
        interrupted = bool(self._followed.run.stages) and not complete and not running
        for made, usable in (
            (self._start, not running),
            (self._pause, running),
            (self._resume, interrupted),
            (self._stop, stage is not None),
            (self._best, bool(self._best_values())),
        ):
            enable(made, usable)

    async def _draw(self, stage: StageHistory) -> None:
        drawn: list[Figure] = []
        histories = []
        for recorded in self._followed.run.stages.values():
            result = self._result(recorded)
            if result is not None:
                histories.append(search_history(result, recorded))
        histories = [h for h in histories if np.isfinite(h.cost).any()]
        if histories:
            drawn.append(figures.cost_figure(histories))
            drawn += await self._curves(stage)
        self._charts.show(drawn)
        if histories and self._open:
            last, campaign = histories[-1], self._work.campaign
            drawn = []
            if len(last.names) > 1:
                drawn.append(figures.parallel_figure(last, campaign.parameters if campaign else {}, {}))
            if len(last.labels) > 1:
                drawn.append(figures.parallel_criteria_figure(last))
            self._parallel.show(drawn)

    def _opened(self, event: Any) -> None:
        """Draw parallel coordinates only while they are open, because the browser needs WebGL for them."""
        self._open = bool(event.args)
        self._seen = ""

    def _result(self, stage: StageHistory) -> StageResult | None:
        """Return the result of a stage, which has no estimates yet while it runs."""
        if content := stage.result or stage.begun:
            return msgspec.json.decode(content, type=StageResult)
        whole = self._followed.run.result
        stages = () if whole is None else msgspec.json.decode(whole, type=Result).stages
        return next((s for s in stages if s.name == stage.name), None)

    async def _curves(self, stage: StageHistory) -> list[Figure]:
        """Return the best and the current simulation over the measurements."""
        versions: list[tuple[str, Role, dict[str, float]]] = [
            ("current", "alternative", dict(stage.rows[len(stage.rows) - 1].parameters)),
            ("best", "final", self._best_values()),
        ]
        try:
            cases = self._work.cases([self._run])
            simulations: list[tuple[str, Role, list[Any]]] = []
            for label, role, values in versions:
                outcome = await run.io_bound(predicted, cases, values, self._work.runner)
                simulations.append((label, role, list(outcome or [])))
        except (FmuidError, KeyError):  # the campaign has other parameters by now
            return []
        drawn: list[Figure] = []
        for k, case in enumerate(cases):
            lines: list[tuple[str, Role, FloatArray | None]] = [
                (label, role, None if isinstance(all_[k], FmuidError) else all_[k])
                for label, role, all_ in simulations
            ]
            signals = self._work.measurements[case.experiments[0]].signals
            for overlay in overlays(None, case, lines):
                shown = in_log_units(overlay, signals[overlay.signal].unit)
                title = f"{case.id}: {overlay.signal}"
                drawn.append(figures.overlay_figure(f"curve-{k}-{overlay.signal}", title, [shown]))
        return drawn

    # ---------------------------------------------------------------- steering

    def _steer(self) -> None:
        if self._shown_campaign == self._work.version:
            return
        rows = [row for row in self._work.parameters() if row.in_file]
        self._shown_campaign = self._work.version
        stages = self._work.file.tables.get("stages", {})
        shape = [row.name for row in rows], [(n, len(s.get("criteria", []))) for n, s in stages.items()]
        if shape != self._shape:  # otherwise the elements stay, and with them the keyboard's focus
            self._shape = shape
            self._inside.clear()
            with self._inside:
                self._table = ParameterTable("Parameters of the search", rows, self._work, self._act)
                self._criteria()
        self._table.show(by_place(self._work.messages))

    def _act(self, action: Callable[[], object]) -> None:
        with errors_shown():
            action()

    def _criteria(self) -> None:
        """Show demand and weight of every criterion that the campaign names."""
        for name, stage in self._work.file.tables.get("stages", {}).items():
            criteria = stage.get("criteria", [])
            if not criteria:
                continue
            text("h3", f"Criteria of stage {name}")
            with element("table", "rows", aria_label=f"Criteria of stage {name}"):
                header("Criterion", "Demand", "Weight")
                with element("tbody"):
                    for k, criterion in enumerate(criteria):
                        label = f"{criterion.get('signal', '')} {criterion.get('kind', 'least_squares')}"
                        with element("tr"):
                            text("th", label, "name wide", scope="row")
                            for key in ("demand", "weight"):
                                with element("td", data_label=key.capitalize()):
                                    Field(
                                        f"{key.capitalize()} of {label}",
                                        _written(criterion.get(key, 1.0)),
                                        lambda typed, name=name, k=k, key=key: self._act(  # type: ignore[misc]
                                            lambda: self._work.set_criterion(name, k, key, typed)
                                        ),
                                    )


def _written(demand: float | list[float]) -> str:
    return ", ".join(f"{value:g}" for value in (demand if isinstance(demand, list) else [demand]))


def _next_folder(folder: Path) -> Path:
    """Return the first folder of this name, with a number, that does not exist."""
    stem, _, number = folder.name.rpartition("-")
    stem = stem if number.isdigit() and stem else folder.name
    k = 2
    while (folder.parent / f"{stem}-{k}").exists():
        k += 1
    return folder.parent / f"{stem}-{k}"
