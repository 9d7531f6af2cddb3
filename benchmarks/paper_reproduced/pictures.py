"""The paper's figures, drawn from our runs, with its numbers where its text or tables give them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.paper_reproduced.recorded import FIRST_ROW, ROOT
from fmuid.core.campaign import Campaign, ModelSource
from fmuid.core.files import write_atomically
from fmuid.identification.history import read_history
from fmuid.identification.result import Result
from fmuid.identification.validate import Validation
from fmuid.report import figures
from fmuid.report.figures import Overlay
from fmuid.report.friction_figures import bearing_friction
from fmuid.report.model_graph import drawing, graph_of
from fmuid.report.plots import save_figure
from fmuid.report.plots.figure_data import Axis, Figure, LineFigure, Panel, Series
from fmuid.report.predicted import heading
from fmuid.report.stage_sections import iterates, search_history
from fmuid.simulation.coupled.loading import load_simulator
from fmuid.simulation.model_source import flat_model

PEAK, SETTLED = 25.0, 17.5  # N.m, of Fig. 6
BEARING = 0.09  # N.m at 10 rad/s, read by the paper from its Fig. 10
SENSOR = "tau_sensor"
FIG_7 = ("step_0p5", "step_1p0", "sine_0p5_5", "sine_0p75_10", "prbs_0p5", "prbs_0p8")


def write_pictures(direct: Result, validation: Validation, campaign: Campaign, out: Path) -> None:
    """Draw the figures into a folder; `validation` are predictions of the runs of Figs. 7 and 14."""
    simulators = {name: load_simulator(model) for name, model in campaign.models.items()}
    recorded = read_history(str(direct.folder))
    stages = {stage.name: stage for stage in direct.stages}
    linear, first = (
        iterates(stages[name], recorded[name], campaign, simulators) for name in ("linear", "first_10")
    )
    start = {name: p.start for name, p in campaign.parameters.items()}
    friction = bearing_friction(campaign, simulators, start, stages["bearing"].parameters)
    loads = [case.id for case in validation.cases if case.id not in FIG_7]
    searched = search_history(stages["first_10"], recorded["first_10"])
    truths = dict(zip(searched.names, FIRST_ROW[1:], strict=False))
    drawn: list[Figure] = [
        _history(
            "paper-fig6", [_marked(_panel(o), (PEAK, SETTLED)) for o in linear if o.experiment == "step_0p5"]
        ),
        _validated("paper-fig7", validation, campaign, FIG_7),
        _history("paper-fig13", [f(o) for f in (_panel, _errors) for o in first if o.experiment == "first_10"]),
        _validated("paper-fig14", validation, campaign, loads),
        replace(figures.parallel_figure(searched, campaign.parameters, truths), name="paper-parameters"),
        replace(figures.parallel_criteria_figure(searched), name="paper-criteria"),
    ]
    if friction is not None:
        drawn.append(_read_off(replace(friction, name="paper-fig10")))
    for figure in drawn:
        save_figure(figure, out)
    setup = ROOT / "modelica" / "Drives" / "Setups" / "EccentricLoad.mo"
    graph = drawing(graph_of(flat_model(ModelSource(setup, "Drives.Setups.EccentricLoad"))), ())
    if graph is not None:
        write_atomically(out / "paper-fig11.svg", graph.svg + "\n")


def _panel(overlay: Overlay) -> Panel:
    """Return an overlay as the paper has it, without the residual."""
    return replace(figures.overlay_panel(overlay), beneath=None)


def _errors(overlay: Overlay) -> Panel:
    """Return an overlay with the residual of each prediction."""
    left = tuple((label, role, y - overlay.measurement) for label, role, y in overlay.predictions)
    series = _panel(replace(overlay, predictions=left)).series[1:]
    axis = Axis(f"{overlay.signal} less measured", overlay.unit)
    return Panel("prediction less measurement", figures.TIME, axis, series)


def _history(name: str, panels: Sequence[Panel]) -> LineFigure:
    return LineFigure(name, "", tuple(panels), "", 1 if len(panels) == 1 else 2)


def _marked(panel: Panel, levels: Sequence[float]) -> Panel:
    """Return a panel with the paper's figures as levels."""
    ends = panel.series[0].x[[0, -1]]
    label = f"paper: {' and '.join(f'{level:g}' for level in levels)} {panel.y.unit}"
    lines = tuple(Series(label, ends, np.full(2, level), "reference") for level in levels)
    return replace(panel, series=panel.series + lines)


def _validated(name: str, validation: Validation, campaign: Campaign, runs: Sequence[str]) -> LineFigure:
    """Return measured and simulated sensor torque of runs."""
    panels = {}
    for case, predicted in zip(validation.cases, validation.predictions, strict=True):
        k = next(k for k, channel in enumerate(case.channels) if channel.signal == SENSOR)
        measured, unit = case.channels[k].mean, case.channels[k].unit or ""
        lines = () if predicted is None else (("simulation", "final", predicted[k]),)
        overlay = Overlay(case.id, SENSOR, unit, case.time, measured, lines, heading(campaign, case))
        panels[case.id] = _panel(overlay)
    return LineFigure(name, "", tuple(panels[run] for run in runs), "", 2)


def _read_off(friction: LineFigure) -> LineFigure:
    """Return bearing friction over speed, with what the paper read from its figure as the start."""
    (panel,) = friction.panels
    labels = ("measured", f"start: {BEARING:g} N.m, as read in the paper", "identified", "truth of the rig")
    series = tuple(replace(s, label=label) for s, label in zip(panel.series, labels, strict=True))
    return replace(friction, panels=(replace(panel, series=series),))
