"""Analyses of a stage's estimate, as figures and tables."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from fmuid.identification.result import Estimate, StageResult
from fmuid.identification.uncertainty.profiles import Profile
from fmuid.report.plots.figure_data import Axis, Cell, Figure, LineFigure, Panel, Series, Table, pretty_unit, slug

_MOST_PAIRS = 6


def front_items(result: StageResult) -> list[Figure | Table]:
    """Return the Pareto front: each pair of objectives, and the points with their parameters."""
    front = result.front
    if front is None or not front.points:
        return []
    values = np.array([p.values for p in front.points])
    panels = []
    for i, k in list(combinations(range(len(front.objectives)), 2))[:_MOST_PAIRS]:
        series = (
            Series("trade-off", values[:, i], values[:, k], "final", points=True),
            Series("estimate", np.array([front.chosen[i]]), np.array([front.chosen[k]]), "start", points=True),
        )
        name, other = front.objectives[i], front.objectives[k]
        x, y = (Axis(f"{objective}, relative to its demand") for objective in (name, other))
        panels.append(Panel(f"{name} against {other}", x, y, series))
    title = f"Pareto front: {result.name}"
    caption = (
        "Errors relative to their demands: at most 1 meets the demand. No point is worse than another in every "
        f"objective: along the front, one improves at the expense of another. The search: {front.message}."
    )
    names = [e.name for e in result.estimates if e.name in front.points[0].parameters]
    units = {e.name: pretty_unit(e.unit or "") for e in result.estimates}
    header = (*front.objectives, *(f"{n}, {units[n]}" if units[n] else n for n in names))
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (*p.values, *(p.parameters[n] for n in names)) for p in front.points
    )
    stem = f"front-{slug(result.name)}"
    return [
        LineFigure(stem, title, tuple(panels), caption, min(len(panels), 2)),
        Table(header, rows, f"{stem}-points", "Trade-offs", digits=(4,) * len(header)),
    ]


def profile_items(result: StageResult) -> list[Figure | Table]:
    """Return the profiles, and their intervals beside those from the standard errors."""
    if not result.profiles:
        return []
    panels = tuple(_profile_panel(profile, result[profile.name]) for profile in result.profiles)
    caption = (
        "Rise of the least cost as one parameter is fixed and the others are refitted, relative to the rise that "
        "bounds a 95 % interval: the interval ends where the curve crosses 1."
    )
    stem = f"profiles-{slug(result.name)}"
    rows = tuple(
        (p.name, pretty_unit(result[p.name].unit or ""), *p.interval, *(result[p.name].interval or (None, None)))
        for p in result.profiles
    )
    header = ("parameter", "unit", "profile from", "to", "standard error from", "to ")
    return [
        LineFigure(stem, f"Profiles: {result.name}", panels, caption, min(len(panels), 2)),
        Table(header, rows, f"{stem}-intervals", "95 % intervals", "A dash: the search found no end."),
    ]


def _profile_panel(profile: Profile, estimate: Estimate) -> Panel:
    from scipy.interpolate import PchipInterpolator

    values, rise = np.array(profile.values), np.array(profile.rise)
    grid = np.linspace(values[0], values[-1], 81)
    # The signed root of a profile is nearly straight.
    root = PchipInterpolator(values, np.sqrt(rise) * np.sign(values - estimate.value))(grid)
    series = [
        Series("profile", grid, root**2, "final"),
        Series("others refitted", values, rise, "final", points=True),
    ]
    if estimate.interval is not None:
        low, high = estimate.interval
        half = np.where(grid < estimate.value, estimate.value - low, high - estimate.value)
        parabola = ((grid - estimate.value) / np.maximum(half, np.finfo(float).tiny)) ** 2
        series.append(Series("from the standard error", grid, np.where(parabola < 2.5, parabola, np.nan), "start"))
    if estimate.truth is not None and values[0] <= estimate.truth <= values[-1]:
        series.append(Series("truth", np.array([estimate.truth]), np.zeros(1), "reference", points=True))
    marks = tuple((end, "") for end in profile.interval if end is not None)
    return Panel(
        profile.name, Axis(profile.name, estimate.unit or ""), Axis("rise of the cost"), tuple(series), marks
    )


def spread_table(result: StageResult) -> Table | None:
    """Return the distribution of the criteria given the uncertainty of the parameters."""
    if not result.spread:
        return None
    rows = tuple((s.label, s.value, s.median, s.high, s.worst, 100.0 * s.satisfied) for s in result.spread)
    return Table(
        ("criterion", "estimate", "median", "95 % below", "worst", "meets its demand, %"),
        rows,
        f"spread-{slug(result.name)}",
        "Criteria over the uncertainty of the parameters",
        "Monte Carlo over the joint distribution of the estimates. Errors are divided by their demands: at most 1 "
        "meets the demand. Worst: also includes the points of the joint 95 % region where an error is expected to "
        "be largest.",
        (5, 3, 3, 3, 3, 3),
    )


def starts_figure(result: StageResult) -> Figure | None:
    """Return the sorted final costs of the starts: a waterfall plot."""
    if len(result.starts) < 2:
        return None
    cost = np.sort([s.cost for s in result.starts])
    # Rounding differences do not count, and a figure would show nothing else.
    above = np.round(cost / cost[0], 6) if cost[0] > 0.0 else cost
    number = np.arange(1, cost.size + 1, dtype=np.float64)
    series = (Series("final cost of a start", number, above, "final", points=True),)
    axis = Axis("cost over the lowest" if cost[0] > 0.0 else "cost", log=bool(cost[0] > 0.0 and above[-1] > 10.0))
    panel = Panel(result.name, Axis("start, sorted"), axis, series)
    caption = "Starts that end at the same lowest cost make a global minimum likely."
    return LineFigure(
        f"starts-{slug(result.name)}", f"Agreement of the starts: {result.name}", (panel,), caption, 1
    )


def whiteness_table(result: StageResult) -> Table | None:
    """Return a test of the residuals for whiteness, channel by channel."""
    if result.uncertainty is None or not result.uncertainty.whiteness:
        return None
    rows = tuple(
        (w.case, w.signal, w.variance, w.lag_one, w.p_value, w.samples, w.effective)
        for w in result.uncertainty.whiteness
    )
    header = ("case", "signal", "variance in σ²", "lag-one correlation", "p", "samples", "independent")
    return Table(
        header,
        rows,
        f"whiteness-{slug(result.name)}",
        "Are the residuals noise?",
        "Portmanteau test on 20 lags, valid for noise of varying size; standard errors allow for residuals that "
        "are not white.",
        (5, 5, 3, 3, 2, 6, 3),
    )
