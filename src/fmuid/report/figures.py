"""The figures of an identification, built from plain arrays: the paper's, MOPS', and residual views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fmuid.core.campaign import ParameterSpec
from fmuid.core.immutable import FloatArray
from fmuid.identification.result import Estimate, StageResult
from fmuid.identification.validate import RunScore
from fmuid.report.plots.figure_data import (
    Axis,
    Bar,
    BarFigure,
    LineFigure,
    MapFigure,
    Panel,
    ParallelFigure,
    Role,
    Scale,
    Series,
    slug,
)
from fmuid.report.thinning import MAX_SAMPLES, kept_samples

TIME = Axis("time", "s")
_AXES = 10  # number of criteria beside each other


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """One measured signal with the predictions of models.

    Parameters
    ----------
    experiment, signal, unit
        The run, the signal and its unit.
    time
        (N,) s.
    measurement
        (N,) the mean over repeats if there are any; NaN where a sample is missing.
    predictions
        (label, role, (N,) values), in drawing order.
    sigma
        Standard deviation of the measurement's noise: one number or (N,); None if unknown.
    """

    experiment: str
    signal: str
    unit: str
    time: FloatArray
    measurement: FloatArray
    predictions: tuple[tuple[str, Role, FloatArray], ...]
    title: str = ""
    sigma: float | FloatArray | None = None

    @property
    def heading(self) -> str:
        """Title of the panel."""
        return self.title or f"{self.experiment} · {self.signal}"


def overlay_panel(overlay: Overlay) -> Panel:
    """Return measurement and predictions over time, with the residual of the best prediction below."""
    rows = [overlay.measurement, *(y for _, _, y in overlay.predictions)]
    keep = kept_samples(rows)
    time = overlay.time[keep]
    series = [Series("measurement", time, overlay.measurement[keep], "measurement")]
    series += [Series(label, time, y[keep], role) for label, role, y in overlay.predictions]
    quantity = Axis(overlay.signal, overlay.unit)
    return Panel(
        overlay.heading, TIME, quantity, tuple(series), beneath=_residual(overlay), link=overlay.experiment
    )


def _residual(overlay: Overlay) -> Panel | None:
    """Return the last prediction minus the measurement, between two standard deviations of the noise.

    The other predictions are left out: beside theirs, the residual of a good one would be a flat line.
    """
    if not overlay.predictions:
        return None
    label, role, predicted = overlay.predictions[-1]
    residual = predicted - overlay.measurement
    keep = kept_samples([residual])
    time = overlay.time[keep]
    series = [Series(label, time, residual[keep], role)]
    if overlay.sigma is not None:
        sigma = np.broadcast_to(overlay.sigma, overlay.time.shape)[keep]
        sigma = np.where(np.isfinite(sigma), sigma, np.nan)
        series += [Series("noise, ±2σ", time, side * sigma, "floor") for side in (-2, 2)]
    return Panel("residual", TIME, Axis("residual", overlay.unit), tuple(series))


def overlay_figure(name: str, title: str, overlays: Sequence[Overlay], caption: str = "") -> LineFigure:
    """Return a grid of overlays (the paper's Figs. 6, 7, 13 and 14), each with its residual below."""
    columns = 1 if len(overlays) == 1 else 2
    return LineFigure(name, title, tuple(overlay_panel(o) for o in overlays), caption, columns)


@dataclass(frozen=True, slots=True, eq=False)
class StageHistory:
    """Every evaluation of one stage: `values` (evaluations, names), `cost` (evaluations,), NaN if failed.

    `criteria` (evaluations, labels) are divided by their demands.
    """

    stage: str
    names: tuple[str, ...]
    values: FloatArray
    cost: FloatArray
    labels: tuple[str, ...] = ()
    criteria: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def best(self) -> int:
        """Index of the evaluation with the lowest cost."""
        return int(np.nanargmin(self.cost))


def milestones(cost: FloatArray, count: int = 5) -> list[int]:
    """Return up to `count` evaluations between the first and the best, each the best so far when it was made.

    They are spread evenly over the logarithm of the cost, so that each looks different from the previous one.
    """
    so_far = np.fmin.accumulate(cost)
    improved = [k for k in range(1, cost.size) if cost[k] <= so_far[k] < so_far[k - 1]]
    inner = improved[:-1]  # the last one is the best itself
    if len(inner) <= count:
        return inner
    level = np.log(np.maximum(cost[inner], 1e-300))
    wanted = np.linspace(np.log(max(cost[0], 1e-300)), np.log(max(np.nanmin(cost), 1e-300)), count + 2)[1:-1]
    return sorted({inner[int(np.argmin(np.abs(level - w)))] for w in wanted})


def cost_figure(stages: Sequence[StageHistory]) -> LineFigure:
    """Return cost and best cost so far over the evaluations of all stages, each relative to its start."""
    numbers, costs, best, marks = [], [], [], []
    first = 1
    for stage in stages:
        finite = stage.cost[np.isfinite(stage.cost)]
        scale = finite[0] if finite.size and finite[0] > 0 else 1.0
        marks.append((float(first), stage.stage))
        # A missing value between two stages breaks the line.
        numbers.append(np.append(np.arange(first, first + stage.cost.size, dtype=np.float64), np.nan))
        costs.append(np.append(stage.cost / scale, np.nan))
        best.append(np.append(np.fmin.accumulate(stage.cost / scale), np.nan))
        first += stage.cost.size
    number, cost = np.concatenate(numbers), np.concatenate(costs)
    log = bool(np.nanmin(cost) > 0) if np.isfinite(cost).any() else False
    lowest = np.concatenate(best)
    keep = np.union1d(
        kept_samples([cost, lowest]), np.cumsum([n.size for n in numbers]) - 1
    )  # and the ends of stages
    series = (
        Series("evaluation", number[keep], cost[keep], "iterate", points=True),
        Series("best so far", number[keep], lowest[keep], "final"),
    )
    y = Axis("cost relative to the stage's first", log=log)
    panel = Panel("Search", Axis("evaluation"), y, series, tuple(marks) if len(marks) > 1 else ())
    caption = "Failed simulations have no cost and leave a gap."
    caption += " Vertical lines: the stages." if len(marks) > 1 else ""
    return LineFigure("cost", "Cost over evaluations", (panel,), caption, 1)


def parallel_figure(
    stage: StageHistory, specs: Mapping[str, ParameterSpec], references: Mapping[str, float]
) -> ParallelFigure:
    """Return the stage's evaluations as parallel coordinates (MOPS' view)."""
    scales = []
    for k, name in enumerate(stage.names):
        spec = specs.get(name)
        unit, log = ("", False) if spec is None else (spec.unit or "", spec.scale == "log")
        column = stage.values[:, k]
        low, high = float(np.nanmin(column)), float(np.nanmax(column))
        reference = references.get(name)
        if reference is not None:
            low, high = min(low, reference), max(high, reference)
        if low == high:
            low, high = low - 0.5 * abs(low) - 1e-12, high + 0.5 * abs(high) + 1e-12
        scales.append(Scale(Axis(name, unit, log and low > 0), low, high, reference))
    title = f"Parallel coordinates: {stage.stage}"
    return _parallel(f"parallel-{slug(stage.stage)}", title, scales, stage.values, stage)


def parallel_criteria_figure(stage: StageHistory) -> ParallelFigure:
    """Return the stage's evaluations with its criteria as axes: which goals are met at the expense of which.

    If there are many criteria, only those that are largest at the start are shown.
    """
    criteria = stage.criteria
    known = criteria[np.isfinite(criteria).all(axis=1)]
    chosen = np.sort(np.argsort(-known[0], kind="stable")[:_AXES])
    scales = []
    for k in chosen.tolist():
        low, high = min(float(known[:, k].min()), 1.0), max(float(known[:, k].max()), 1.0)
        if low == high:
            low, high = 0.9, 1.1
        scales.append(Scale(Axis(stage.labels[k], log=low > 0.0), low, high, 1.0))
    title = f"Parallel coordinates of the criteria: {stage.stage}"
    figure = _parallel(f"parallel-criteria-{slug(stage.stage)}", title, scales, criteria[:, chosen], stage)
    few = "" if len(chosen) == criteria.shape[1] else f" The {_AXES} criteria that are largest at the start."
    return replace(
        figure, caption=f"{figure.caption} Every criterion is divided by its demand: at most 1 meets it.{few}"
    )


def _parallel(
    name: str, title: str, scales: Sequence[Scale], values: FloatArray, stage: StageHistory
) -> ParallelFigure:
    every = -(-len(stage.cost) // MAX_SAMPLES)
    shown = np.union1d(np.arange(0, len(stage.cost), every), stage.best)
    which = "One line per evaluation" if every == 1 else f"One line for every {every} evaluations"
    return ParallelFigure(
        name,
        title,
        tuple(scales),
        values[shown],
        stage.cost[shown],
        int(np.searchsorted(shown, stage.best)),
        f"{which}, darker where the cost is lower. Drag along an axis to filter.",
    )


def correlation_figure(stage: StageResult) -> MapFigure | None:
    """Return the correlation of the estimates of a stage; None for fewer than two with an uncertainty."""
    known = stage.uncertainty
    if known is None or len(known.names) < 2:
        return None
    return MapFigure(
        f"correlation-{slug(stage.name)}",
        f"Correlation of the estimates: {stage.name}",
        known.names,
        known.names,
        np.array(known.correlation),
        Axis("correlation"),
        (-1.0, 1.0),
        caption="Near ±1, the experiments determine only a combination of the two.",
    )


def deviation_figure(estimates: Sequence[Estimate]) -> BarFigure | None:
    """Return deviations from the truth in percent, with 95 % intervals; None if nothing has one."""
    bars = []
    for e in estimates:
        if e.relative_error is None or e.truth is None:
            continue
        deviation, interval = 100 * e.relative_error, None
        if e.standard_error is not None and np.isfinite(e.standard_error):
            half = 100 * 1.96 * e.standard_error / abs(e.truth)
            interval = (deviation - half, deviation + half)
        bars.append(Bar(e.name, deviation, "final", interval, f"{deviation:+.2f} %"))
    if not bars:
        return None
    return BarFigure(
        "deviations",
        "Deviation of the estimates from the truth",
        tuple(bars),
        Axis("deviation from the truth", "%"),
        ((0.0, "truth"),),
        "Lines: 95 % intervals.",
    )


def fit_figure(name: str, scores: Sequence[RunScore]) -> BarFigure:
    """Return the NRMSE of every run, with the part that noise alone would leave."""
    bars = tuple(
        Bar(
            f"{s.experiment} · {s.signal}",
            100 * s.nrmse,
            note=f"{100 * s.nrmse:.2g} %"
            + ("" if not s.noise_floor else f", {s.rmse / s.noise_floor:.3g} noise floors"),
        )
        for s in scores
        if s.failure is None
    )
    caption = "RMSE divided by the standard deviation of the measurement: 0 is perfect, 100 % as bad as its mean."
    return BarFigure(name, "NRMSE of every run", bars, Axis("NRMSE", "%"), caption=caption)
