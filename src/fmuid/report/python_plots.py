"""The plots behind `.plot()` of campaigns, results, validations and diagnoses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from fmu_build.suggest import suggestion
from fmuid.core.campaign import Campaign
from fmuid.core.errors import FmuidError
from fmuid.diagnosis.diagnose import Found
from fmuid.identification.result import Result
from fmuid.identification.validate import Validation, validate
from fmuid.report.analysis_sections import profile_items, starts_figure
from fmuid.report.diagnosis_figures import effects_figure, gap_figure, law_figure
from fmuid.report.figures import TIME, correlation_figure, fit_figure, overlay_figure
from fmuid.report.plots.draw import canvas_of
from fmuid.report.plots.figure_data import Axis, Bar, BarFigure, Figure, LineFigure, Panel, Series
from fmuid.report.predicted import overlays
from fmuid.report.thinning import kept_samples

_DRAWN = 6  # largest number of panels


def plot(shown: Campaign | Result | Validation | Found, kind: str | None = None) -> Any:
    """Return the Matplotlib figure of a kind; see `fmuid.core.plottable.Plottable.plot`."""
    kinds = _kinds(shown)
    if kind is not None and kind not in kinds:
        raise FmuidError(f"no plot '{kind}' of a {type(shown).__name__.lower()}", fix=suggestion(kind, kinds))
    for name in [kind] if kind is not None else kinds:
        figure = kinds[name]()
        if figure is not None:
            return canvas_of(figure)
    what = "there is nothing to plot" if kind is None else f"it has no values for the plot '{kind}'"
    raise FmuidError(what, fix="request the analysis in campaign.toml (docs/identification.md)")


def _kinds(shown: Campaign | Result | Validation | Found) -> Mapping[str, Callable[[], Figure | None]]:
    if isinstance(shown, Campaign):
        return {"measurements": lambda: _measurements(shown)}
    if isinstance(shown, Validation):
        return {"overlay": lambda: _overlay(shown), "errors": lambda: fit_figure("fit", shown.scores)}
    if isinstance(shown, Found):
        answer = shown.diagnosis.to_dict()
        return {
            "gap": lambda: gap_figure(answer),
            "effects": lambda: effects_figure(answer),
            "law": lambda: law_figure(answer),
        }
    return {
        "parameters": lambda: _parameters(shown),
        "correlation": lambda: next((f for f in map(correlation_figure, reversed(shown.stages)) if f), None),
        "starts": lambda: next((f for f in map(starts_figure, shown.stages) if f), None),
        "profile": lambda: next(
            (f for s in shown.stages for f in profile_items(s) if isinstance(f, LineFigure)), None
        ),
        "overlay": lambda: _overlay(
            validate(shown, experiments=sorted({e for s in shown.stages for e in s.experiments}))
        ),
    }


def _measurements(campaign: Campaign) -> Figure | None:
    panels = []
    for run in [r for r in campaign.measurements if not r.repeats_another][:_DRAWN]:
        for signal in run.signals.values():
            keep = kept_samples([signal.values])
            line = Series(signal.causality, run.time[keep], signal.values[keep], "measurement")
            panels.append(Panel(f"{run.id}: {signal.name}", TIME, Axis(signal.name, signal.unit), (line,)))
    return LineFigure("measurements", campaign.title, tuple(panels)) if panels else None


def _parameters(result: Result) -> Figure | None:
    """Return the estimates with their 95 % intervals, each relative to its value."""
    bars = []
    for e in result.estimates:
        if e.value:
            interval = None if e.interval is None else (e.interval[0] / e.value, e.interval[1] / e.value)
            ordered = None if interval is None else (min(interval), max(interval))
            bars.append(Bar(e.name, 1.0, "final", ordered, f"{e.value:.4g} {e.unit or ''}".strip()))
    return BarFigure("parameters", "Parameters with 95 % intervals", tuple(bars), Axis("relative to the estimate"))


def _overlay(validation: Validation) -> Figure | None:
    predicted = zip(validation.cases, validation.predictions, strict=True)
    drawn = [o for case, y in predicted for o in overlays(None, case, [("simulation", "final", y)])]
    return overlay_figure("overlay", "Measurement and simulation", drawn[:_DRAWN]) if drawn else None
