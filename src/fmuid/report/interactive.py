"""Figure values as plotly figures for the screen: plain dictionaries, drawn by plotly.js in the browser.

Arrays are stored as base64 of their bytes, so a report with many runs stays small.

What a figure shows is decided once, in `plots.figure_data`. This module draws it for the screen, `plots.draw` for
print; `docs/architecture.md` says why one renderer does not serve both.
"""

from __future__ import annotations

import base64
import html
import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.report.plots import style
from fmuid.report.plots.figure_data import (
    Axis,
    Bar,
    BarFigure,
    Figure,
    LineFigure,
    MapFigure,
    Panel,
    ParallelFigure,
    Scale,
    Series,
    pretty_unit,
)

Spec = dict[str, Any]

_DASHES = {"solid": "solid", "dash": "6px,3px", "dot": "2px,2px"}
_MARKERS = {"circle": "circle", "square": "square", "diamond": "diamond", "triangle": "triangle-up"}
_LINE, _LETTER = 17, 7  # px: height of a line and width of a letter in a figure
_GRID = "#E6E6E6"
_FONT = {"family": "system-ui, 'Segoe UI', 'DejaVu Sans', sans-serif", "size": 12, "color": style.INK}
_MOST_TICKS = 4.0  # from one end of a logarithmic axis of bars to the other


def specification(figure: Figure) -> Spec:
    """Return `figure` as plotly's ``{"data": [...], "layout": {...}}``.

    ``"narrow"`` holds the layout changes for a phone; ``"links"`` names the axes that zoom together.

    Lines often share their abscissa. It is stored once, in ``"shared"``, and a trace has its index as ``x``; the
    page restores it before drawing.
    """
    match figure:
        case LineFigure():
            data, layout = _lines(figure)
        case MapFigure():
            data, layout = _map(figure)
        case BarFigure():
            data, layout = _bars(figure)
        case ParallelFigure():
            data, layout = _parallel(figure)
    common = {
        "font": _FONT,
        "paper_bgcolor": "rgba(255,255,255,0)",  # so that a dark page shows through
        "plot_bgcolor": "rgba(255,255,255,0)",
        "autosize": True,
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yref": "container", "yanchor": "top"},
        "hoverlabel": {"font": {"size": 12}},
    }
    shared: dict[str, int] = {}
    arrays: list[Spec] = []
    for trace in data:
        x = trace.get("x")
        if isinstance(x, dict):
            key = x["dtype"] + x["bdata"]
            if key not in shared:
                shared[key] = len(arrays)
                arrays.append(x)
            trace["x"] = shared[key]
    narrow, links = layout.pop("narrow", {}), layout.pop("links", {})
    return {"data": data, "layout": common | layout, "narrow": narrow, "links": links, "shared": arrays}


def _lines(figure: LineFigure) -> tuple[list[Spec], Spec]:
    labelled = any(text for panel in figure.panels for _, text in panel.marks)
    layout: Spec = {"hovermode": "x unified", "annotations": [], "shapes": [], "links": {}}
    data: list[Spec] = []
    seen: set[str] = set()
    number = 0
    for panel in figure.panels:
        first = number
        for part in _parts(panel):
            suffix = "" if number == 0 else str(number + 1)
            number += 1
            layout[f"xaxis{suffix}"] = _axis(part.x) | {"anchor": f"y{suffix}"}
            layout[f"yaxis{suffix}"] = _axis(part.y, part.y.wrapped("\n")) | {"anchor": f"x{suffix}"}
            if part is panel.beneath:
                layout[f"xaxis{suffix}"]["matches"] = "x" if first == 0 else f"x{first + 1}"
                layout[f"yaxis{suffix}"]["nticks"] = 4
            elif panel.beneath is not None:
                layout[f"xaxis{suffix}"] |= {"showticklabels": False, "title": None}
            if panel.link:
                layout["links"][f"xaxis{suffix}"] = panel.link
            if part is panel and len(figure.panels) > 1:
                layout["annotations"].append(_title(panel.title, suffix))
            _marks(layout, part, suffix)
            for series in part.series:
                text = html.escape(style.legend(series), quote=False)
                place = {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}", "legendgroup": text}
                trace = _series(part, series)
                if text not in seen:  # a separate empty trace carries the legend, and each line keeps its name
                    data.append(trace | place | {"name": text, "x": [None], "y": [None]})
                    seen.add(text)
                data.append(trace | place | {"showlegend": False})
    top = 130 if labelled else 48
    wide = _places(figure, min(figure.columns, max(1, len(figure.panels))), top)
    layout["narrow"] = _places(figure, 1, top + 20 * (len(seen) // 2))
    for name, value in wide.items():
        layout[name] = layout.get(name, {}) | value if isinstance(value, dict) else value
    return data, layout


def _parts(panel: Panel) -> tuple[Panel, ...]:
    return (panel,) if panel.beneath is None else (panel, panel.beneath)


def _places(figure: LineFigure, columns: int, top: int) -> Spec:
    """Return the positions of the axes of every panel in a grid of `columns`, and the height of the grid."""
    rows = -(-max(1, len(figure.panels)) // columns)
    paired = any(panel.beneath is not None for panel in figure.panels)
    tall, between = (300 if len(figure.panels) == 1 else 205) + (110 if paired else 0), 72
    inner = rows * tall + (rows - 1) * between
    places: Spec = {"height": inner + top + 44, "margin": {"l": 64, "r": 16, "t": top, "b": 44}}
    gap = 0.1 if columns < 3 else 0.12
    width, share = (1 - gap * (columns - 1)) / columns, tall / inner
    number = 0
    for k, panel in enumerate(figure.panels):
        row, column = divmod(k, columns)
        left, bottom = column * (width + gap), 1 - (row * (tall + between) + tall) / inner
        split = bottom if panel.beneath is None else bottom + 0.32 * share
        ends = ((split, bottom + share), (bottom, split - 0.05 * share))
        for low, high in ends[: len(_parts(panel))]:
            suffix = "" if number == 0 else str(number + 1)
            number += 1
            places[f"xaxis{suffix}"] = {"domain": [left, min(left + width, 1.0)]}
            places[f"yaxis{suffix}"] = {"domain": [max(low, 0.0), min(high, 1.0)]}
    return places


def _marks(layout: Spec, panel: Panel, suffix: str) -> None:
    axes = {"xref": f"x{suffix}", "yref": f"y{suffix} domain"}
    for position, text in panel.marks:
        layout["shapes"].append(_upright(position, style.GREY, "dot") | axes)
        note = _note(text, position, 1, textangle=-90, yanchor="bottom", xanchor="center")
        layout["annotations"].append(note | axes)


def _upright(x: float, colour: str, dash: str) -> Spec:
    """Return a vertical line over the whole height of what it refers to."""
    line = {"color": colour, "width": 1, "dash": dash}
    return {"type": "line", "x0": x, "x1": x, "y0": 0, "y1": 1, "line": line}


def _note(text: str, x: float, y: float, **place: Any) -> Spec:
    text = html.escape(text, quote=False)
    return {"text": text, "x": x, "y": y, "showarrow": False, "font": {"size": 12}, **place}


def _title(text: str, suffix: str) -> Spec:
    """Return the title of a panel, above its left end."""
    axes = {"xref": f"x{suffix} domain", "yref": f"y{suffix} domain"}
    return _note(text, 0, 1, xanchor="left", yanchor="bottom", **axes)


def _series(panel: Panel, series: Series) -> Spec:
    look = style.LOOKS[series.role]
    unit = html.escape(pretty_unit(panel.y.unit))
    trace: Spec = {
        "type": "scatter",
        "name": html.escape(series.label, quote=False),
        "x": packed(series.x),
        "y": packed(series.y),
        "hovertemplate": f"%{{y:.5~g}} {unit}",
        "opacity": look.alpha,
        "zorder": look.order,
    }
    colour = look.colour
    if series.points:
        colour = style.INK if series.role == "measurement" else colour
        trace |= {"mode": "markers", "marker": {"color": colour, "size": 6, "symbol": _MARKERS[look.marker]}}
    else:
        line = {"color": colour, "width": max(1.0, look.width * 1.3), "dash": _DASHES[look.dash]}
        trace |= {"mode": "lines", "line": line}
    if series.error is not None:
        trace["error_y"] = {"type": "data", "array": packed(series.error), "thickness": 1, "width": 3}
    return trace


def _axis(axis: Axis, label: str = "") -> Spec:
    label = label or axis.label
    return {
        # Of ticks between decades, plotly writes the first digit, and small.
        **({"nticks": 4, "tickformat": "~g"} if axis.log else {}),
        "title": {
            "text": html.escape(label, quote=False).replace("\n", "<br>"),
            "standoff": 6,
            "font": {"size": 12},
        },
        "type": "log" if axis.log else "linear",
        "gridcolor": _GRID,
        "zeroline": False,
        "linecolor": "#444444",
        "ticks": "outside",
        "ticklen": 3,
        "exponentformat": "e",  # exponents that are raised would be too small
    }


def _map(figure: MapFigure) -> tuple[list[Spec], Spec]:
    """Return a heat map for each group of columns, side by side; fewer in a row where the window is narrow."""
    n_rows, n_columns = figure.values.shape
    stops = style.DIVERGING if figure.diverging else style.SEQUENTIAL
    blocks = figure.headings or (("", n_columns),)
    rows = [html.escape(r, quote=False) for r in figure.rows]
    traces: list[Spec] = []
    layout: Spec = {"annotations": [], "coloraxis": _colours(figure, stops)}
    start = 0
    for k, (_, width) in enumerate(blocks):
        suffix = "" if k == 0 else str(k + 1)
        columns = [html.escape(c, quote=False) for c in figure.columns[start : start + width]]
        values = figure.values[:, start : start + width].tolist()
        start += width
        trace = {
            "type": "heatmap",
            "z": [[None if math.isnan(v) else round(v, 6) for v in row] for row in values],
            "y": rows,
            "customdata": [columns] * n_rows,
            "hovertemplate": "%{y}<br>%{customdata}<br>%{z:.3~g}<extra></extra>",
            "coloraxis": "coloraxis",
            "xaxis": f"x{suffix}",
            "yaxis": f"y{suffix}",
            "xgap": 1,
            "ygap": 1,
            "hoverongaps": False,
        }
        if figure.values.size <= 150 and not figure.groups:  # otherwise cells are too narrow for numbers
            trace |= {"texttemplate": "%{z:.2f}", "textfont": {"size": 12}}
        traces.append(trace)
        bare = {"showgrid": False, "zeroline": False, "fixedrange": True}
        ticks = {"tickvals": list(range(width)), "ticktext": columns, "tickangle": -60, "tickfont": {"size": 12}}
        layout[f"xaxis{suffix}"] = ticks | bare | {"anchor": f"y{suffix}", "automargin": True}
        layout[f"yaxis{suffix}"] = bare | {"anchor": f"x{suffix}", "autorange": "reversed", "type": "category"}
    wide = _map_places(figure, min(4, len(blocks)), 1000, 290)
    layout["narrow"] = _map_places(figure, min(2, len(blocks)), 360, 130)
    layout["narrow"]["coloraxis"] = {"colorbar": None, "showscale": False}
    if not figure.groups:
        wide |= {"width": 260 + 44 * n_columns, "autosize": False}
        layout["narrow"] |= {"width": None, "autosize": True}
    for name, value in wide.items():
        layout[name] = layout.get(name, {}) | value if isinstance(value, dict) else value
    return traces, layout


def _colours(figure: MapFigure, stops: Sequence[tuple[float, str]]) -> Spec:
    return {
        "cmin": figure.limits[0],
        "cmax": figure.limits[1],
        "colorscale": [list(stop) for stop in stops],
        "colorbar": {
            "title": {"text": html.escape(figure.quantity.label), "side": "right"},
            "thickness": 12,
            "outlinewidth": 0,
        },
    }


def _map_places(figure: MapFigure, columns: int, across: int, label: int) -> Spec:
    """Return the positions of the blocks of a map in a grid of `columns`, with their labels, and its height.

    The grid and the names of its rows are `across` pixels wide, of which these names get at most `label`.
    """
    count = max(1, len(figure.groups))
    lines = -(-count // columns)
    rows = [_folded(row, label) for row in figure.rows]
    cells = 40 if not figure.groups else 24 if len(rows) < 20 else 16
    cells = max(cells, _LINE * max(map(len, rows)) + 4)
    labels = 16 + round(6.2 * max(len(c) for c in figure.columns))
    left = 20 + _LETTER * max(len(line) for row in rows for line in row)
    gap = 0.03
    width = (1 - gap * (columns - 1)) / columns
    headings = [_folded(name, width * (across - left)) for name, _ in figure.headings]
    above = _LINE * max(map(len, headings), default=0) + 6
    tall, between = cells * len(rows), labels + above
    inner = lines * tall + (lines - 1) * between
    places: Spec = {
        "height": inner + 30 + above + labels,
        "margin": {"l": left, "r": 10, "t": 30 + above, "b": labels},
        "annotations": [],
    }
    for k in range(count):
        suffix = "" if k == 0 else str(k + 1)
        line, column = divmod(k, columns)
        top = 1 - line * (tall + between) / inner
        at = column * (width + gap)
        places[f"xaxis{suffix}"] = {"domain": [at, min(at + width, 1.0)]}
        low = max(top - tall / inner, 0.0)
        ticks = {"tickvals": list(range(len(rows))), "ticktext": ["<br>".join(row) for row in rows]}
        places[f"yaxis{suffix}"] = {"domain": [low, top], "showticklabels": column == 0} | ticks
        if figure.headings and (heading := headings[k]):
            places["annotations"].append(_title("", suffix) | {"text": "<br>".join(heading), "align": "left"})
    return places


def _folded(text: str, width: float) -> list[str]:
    """Return a text in lines of about `width` pixels, for a figure."""
    most = max(int(width / _LETTER), 8)
    return [html.escape(line, quote=False) for part in text.split("\n") for line in textwrap.wrap(part, most)]


def _decades(figure: BarFigure) -> int:
    """Return the decades from one tick of a logarithmic axis to the next, so that labels do not overlap."""
    low, high = figure.limits or (1.0, 1.0)
    return math.ceil(max(1.0, math.log10(high / low) / _MOST_TICKS))


def _bars(figure: BarFigure) -> tuple[list[Spec], Spec]:
    bars = figure.bars
    above = [0.0 if b.interval is None else b.interval[1] - b.value for b in bars]
    below = [0.0 if b.interval is None else b.value - b.interval[0] for b in bars]
    trace: Spec = {
        "type": "bar",
        "orientation": "h",
        "x": [b.value for b in bars],
        "y": list(range(len(bars))),
        "width": 0.62,
        "marker": {"color": [style.bar_colour(b.role) for b in bars]},
        "customdata": [html.escape(b.label, quote=False) for b in bars],
        "hovertemplate": "%{customdata}: %{x:.4~g}<extra></extra>",
    }
    if any(b.interval for b in bars):
        trace["error_x"] = {
            "type": "data",
            "array": above,
            "arrayminus": below,
            "thickness": 1.2,
            "width": 4,
            "color": style.INK,
        }
    layout: Spec = {
        "narrow": {
            "xaxis": {} if figure.quantity.log else {"nticks": 5},
            "margin": {"l": 10, "r": 70, "t": 36, "b": 44},
        },
        "height": 100 + 28 * max(1, len(bars)),
        "margin": {"l": 10, "r": max(90, _beyond(figure, 450)), "t": 48, "b": 44},
        "showlegend": False,
        "xaxis": _axis(figure.quantity)
        | {"tickangle": 0}
        | ({"dtick": _decades(figure)} if figure.quantity.log else {}),
        "yaxis": {
            "tickvals": list(range(len(bars))),
            "ticktext": [html.escape(b.label, quote=False) for b in bars],
            "range": [len(bars) - 0.5, -0.5],
            "automargin": True,
            "showgrid": False,
            "zeroline": False,
        },
        "annotations": [],
        "shapes": [],
    }
    if figure.limits:
        low, high = figure.limits
        layout["xaxis"]["range"] = [math.log10(low), math.log10(high)] if figure.quantity.log else [low, high]
    for k, bar in enumerate(bars):
        if bar.note:
            end = _end(bar)
            at = math.log10(end) if figure.quantity.log and end > 0 else end
            white = "white"  # a mark may pass behind it
            layout["annotations"].append(_note(bar.note, at, k, xanchor="left", xshift=8, bgcolor=white))
    for position, text in figure.marks:
        at = math.log10(position) if figure.quantity.log else position
        layout["shapes"].append(_upright(position, style.INK, "dash") | {"yref": "paper"})
        layout["annotations"].append(_note(text, at, 1, yref="paper", yanchor="bottom"))
    if _beyond(figure, 200) > 70:  # on a phone, notes are below their bars
        under = {"x": 1, "xref": "paper", "xanchor": "right", "xshift": 0, "yshift": -22}
        notes = layout["annotations"]
        layout["narrow"] |= {
            "annotations": [note | under if "xshift" in note else note for note in notes],
            "height": 100 + (_LINE + 28) * len(bars),
            "yaxis": {"range": [len(bars) - 0.2, -0.5]},
            "margin": {"l": 10, "r": 20, "t": 36, "b": 44},
        }
    return [trace], layout


def _beyond(figure: BarFigure, width: int) -> int:
    """Return the pixels that notes need beyond the end of an axis of a width in pixels."""
    low, high = figure.limits or (0.0, max(map(_end, figure.bars), default=0.0))

    def place(bar: Bar) -> float:
        known = high > low and not figure.quantity.log
        return (min(_end(bar), high) - low) / (high - low) if known else 1.0

    needs = (8 + _LETTER * len(bar.note) - (1.0 - place(bar)) * width for bar in figure.bars if bar.note)
    return round(max(needs, default=0.0))


def _end(bar: Bar) -> float:
    return max(bar.value, bar.interval[1] if bar.interval else bar.value, 0.0)


def _parallel(figure: ParallelFigure) -> tuple[list[Spec], Spec]:
    usable = np.isfinite(figure.cost) & np.isfinite(figure.values).all(axis=1)
    cost, values = figure.cost[usable], figure.values[usable]
    order = np.argsort(-cost, kind="stable")
    log = cost.size > 0 and cost.min() > 0
    label, shown = "log₁₀ cost" if log else "cost", packed(np.log10(cost[order]) if log else cost[order])
    line: Spec = {
        "color": shown,
        "colorscale": style.ORDERED.capitalize(),
        "showscale": True,
        "colorbar": {"title": {"text": label, "side": "right"}, "thickness": 12},
    }
    dimensions = [_dimension(s, values[order, k]) for k, s in enumerate(figure.scales)]
    dimensions.append({"label": label, "values": shown})
    crowded = len(dimensions) > 5
    trace: Spec = {"type": "parcoords", "line": line, "dimensions": dimensions}
    trace |= {font: {"size": 12} for font in ("labelfont", "tickfont", "rangefont")}
    trace["labelangle"] = -30 if crowded else 0
    top = 150 if crowded else 70
    margin = {"l": 70, "r": 110 if crowded else 70, "t": top, "b": 30}
    narrow = {"width": 180 + 52 * len(dimensions)}  # scrolls sideways, and no tick covers the next axis
    return [trace], {"height": 330 + top, "margin": margin, "narrow": narrow}


def _dimension(scale: Scale, values: FloatArray) -> Spec:
    low, high, ticks = scale.lower, scale.upper, {}
    if scale.axis.log:
        low, high, values = math.log10(low), math.log10(high), np.log10(values)
        at = np.linspace(low, high, 5).tolist()
        ticks = {"tickvals": at, "ticktext": [f"{float(f'{10**t:.3g}'):g}" for t in at]}
    label = html.escape(scale.axis.label, quote=False)
    return {"label": label, "range": [low, high], "values": packed(values), **ticks}


def packed(values: FloatArray) -> Spec:
    """Return an array in plotly's base64 form: 4 bytes per number, or 8 where 4 would merge neighbours."""
    short = values.astype("<f4")
    finite = values[np.isfinite(values)]
    steps = np.abs(np.diff(finite))
    steps = steps[steps > 0]
    blur = float(np.max(np.abs(finite))) * 1e-7 if finite.size else 0.0
    fits = finite.size == 0 or (blur < 1e30 and (steps.size == 0 or blur < 1e-2 * float(np.median(steps))))
    kind, data = ("f4", short) if fits else ("f8", values.astype("<f8"))
    return {"dtype": kind, "bdata": base64.b64encode(data.tobytes()).decode("ascii")}
