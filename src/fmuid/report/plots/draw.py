"""Drawing of figure values with matplotlib; the only module that imports it.

It only uses objects and the Agg canvas, and its settings hold inside `drawn`, so the caller's own plots are
unaffected.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.figure import Figure as Canvas
from matplotlib.text import Text
from matplotlib.ticker import LogFormatterSciNotation, ScalarFormatter

from fmuid.report.plots import style
from fmuid.report.plots.figure_data import (
    RAISED,
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
)

_SETTINGS: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 8,
    "axes.edgecolor": "#444444",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.formatter.limits": (-4, 5),
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.solid_capstyle": "round",
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "fmuid",
    "pdf.fonttype": 42,
    "agg.path.chunksize": 20_000,
}
_DASHES = {"solid": "-", "dash": (0, (4, 2)), "dot": (0, (1, 1.2))}
_MARKERS = {"circle": "o", "square": "s", "diamond": "D", "triangle": "^"}
_DATELESS: dict[str, dict[str, Any]] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
_FORMULA, _FACTOR = re.compile(r"10\^\{(-?\d+)\}"), re.compile(r"(?:^1)?e([-\u2212]?\d+)")
_DPI = 200
_WIDTH = 6.9  # inches: the text width of A4
_MAX_CELLS_WITH_NUMBERS = 150


def drawn(figure: Figure, format: str) -> bytes:
    """Draw `figure` and return the file content, without a date, so that equal values give equal bytes."""
    with matplotlib.rc_context(_SETTINGS):
        canvas = canvas_of(figure)
        metadata: dict[str, Any] = {"Title": figure.title, **_DATELESS[format]}
        file = io.BytesIO()
        if format == "png":  # straight to the canvas: `savefig` would draw everything twice
            agg: Any = FigureCanvasAgg(canvas)
            agg.print_png(file, metadata=metadata)
        else:
            canvas.savefig(file, format=format, metadata=metadata)
    if format == "svg":
        label = html.escape(figure.title, quote=True)
        return file.getvalue().replace(b"<svg ", f'<svg role="img" aria-label="{label}" '.encode(), 1)
    return file.getvalue()


def canvas_of(figure: Figure) -> Canvas:
    """Return the drawn matplotlib figure, for changing or embedding it."""
    match figure:
        case LineFigure():
            canvas = _lines(figure)
        case MapFigure():
            canvas = _map(figure)
        case BarFigure():
            canvas = _bars(figure)
        case ParallelFigure():
            canvas = _parallel(figure)
    _number_plainly(canvas)
    return canvas


def _number_plainly(canvas: Canvas) -> None:
    """Set numbers at axes as text: Matplotlib takes longer to set a formula than to draw all lines."""
    for axis in (axis for axes in canvas.axes for axis in (axes.xaxis, axes.yaxis)):
        if isinstance(axis.get_major_formatter(), LogFormatterSciNotation):
            axis.set_major_formatter(_PowersOfTen())
            axis.set_minor_formatter(_PowersOfTen(labelOnlyBase=False))
        elif type(axis.get_major_formatter()) is ScalarFormatter:
            axis.set_major_formatter(_Decimals())


class _PowersOfTen(LogFormatterSciNotation):
    def __call__(self, x: float, pos: int | None = None) -> str:
        text = super().__call__(x, pos).removeprefix(r"$\mathdefault{").removesuffix("}$")
        return _FORMULA.sub(_power, text.replace(r"\times", "×"))


class _Decimals(ScalarFormatter):
    def get_offset(self) -> str:
        return _FACTOR.sub(lambda match: f"×{_power(match)}", super().get_offset())


def _power(exponent: re.Match[str]) -> str:
    return f"10{exponent[1].translate(RAISED)}"


def _canvas(width: float, height: float, *, constrained: bool = True) -> Canvas:
    layout: Any = "constrained" if constrained else None
    canvas = Canvas(figsize=(width, height), dpi=_DPI, layout=layout)
    FigureCanvasAgg(canvas)
    return canvas


def _lines(figure: LineFigure) -> Canvas:
    n = max(1, len(figure.panels))
    columns = min(figure.columns, n)
    rows = -(-n // columns)
    # A grid has fixed margins: measuring every text of a large one takes longer than drawing it.
    paired = any(panel.beneath is not None for panel in figure.panels)
    height = (3.5 if n == 1 else 2.1) + (1.0 if paired else 0.0)
    canvas = _canvas(_WIDTH, 0.35 + height * rows, constrained=n == 1 and not paired)
    if n > 1 or paired:
        wrapped = any("\n" in panel.y.wrapped("\n") for panel in figure.panels)
        canvas.subplots_adjust(**_margins(canvas, rows, columns, 0.15 if wrapped else 0.0))
    grid = canvas.subplots(rows, columns, squeeze=False)
    handles: dict[str, Any] = {}
    for k, axes in enumerate(grid.flat):
        if k >= len(figure.panels):
            axes.set_axis_off()
            continue
        panel = figure.panels[k]
        width = axes.get_position().width * _WIDTH
        _panel(axes, panel, handles)
        if panel.beneath is not None:
            box = axes.get_position()
            under = canvas.add_axes((box.x0, box.y0, box.width, 0.28 * box.height))
            axes.set_position((box.x0, box.y0 + 0.34 * box.height, box.width, 0.66 * box.height))
            _panel(under, panel.beneath, handles)
            under.yaxis.set_label_coords(-0.54 / width, 0.5)
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
        if n > 1 or paired:
            axes.yaxis.set_label_coords(-0.54 / width, 0.5)
        if n > 1:
            _fit(axes.set_title(panel.title, fontsize=8.5), width)
            _fit(axes.xaxis.label, width + 0.2)
    if handles:
        where: Any = "upper center" if n > 1 or paired else "outside upper center"
        canvas.legend(list(handles.values()), list(handles), loc=where, ncols=min(len(handles), 5))
    return canvas


def _margins(canvas: Canvas, rows: int, columns: int, second_line: float) -> dict[str, float]:
    """Return the margins of a grid: 0.75 inches for a vertical axis, 0.65 for a horizontal one and a title."""
    width, height = canvas.get_size_inches()
    left, right, top, bottom, across, down = 0.75 + second_line, 0.12, 0.58, 0.42, 0.85 + second_line, 0.68
    panel_width = (width - left - right - across * (columns - 1)) / columns
    panel_height = (height - top - bottom - down * (rows - 1)) / rows
    return {
        "left": left / width,
        "right": 1 - right / width,
        "top": 1 - top / height,
        "bottom": bottom / height,
        "wspace": across / panel_width,
        "hspace": down / panel_height,
    }


def _fit(text: Text, width: float) -> None:
    """Make a text hardly wider than its panel (inches): first in a smaller font, then cut."""
    content, size = text.get_text(), float(text.get_fontsize())
    fits = width / (0.0068 * size)  # characters
    share = max(0.75, min(1.0, fits / max(len(content), 1)))
    room = int(fits / share)
    text.set_text(content if len(content) <= room else f"{content[: room - 1]}…")
    text.set_fontsize(share * size)


def _panel(axes: Axes, panel: Panel, handles: dict[str, Any]) -> None:
    for series in panel.series:
        handle = _series(axes, series)
        handles.setdefault(style.legend(series), handle)
    for position, text in panel.marks:
        axes.axvline(position, color=style.GREY, linewidth=0.6, linestyle=(0, (2, 2)))
        _above(axes, position, text, 3, va="bottom", fontsize=6.5, color=style.INK, rotation=90)
    _label(axes, panel.x, panel.y)
    if not panel.x.log and panel.series:
        alone = axes.get_position().width > 0.5  # wide enough for numbers of seven digits
        axes.locator_params(axis="x", nbins=7 if alone else 5)
        spans = [s.x[np.isfinite(s.x)] for s in panel.series]
        if all(not s.points for s in panel.series) and any(x.size for x in spans):
            axes.set_xlim(min(x.min() for x in spans if x.size), max(x.max() for x in spans if x.size))


def _above(axes: Axes, x: float, text: str, points: float, **look: Any) -> None:
    """Write a text some points above the panel, at a value of its horizontal axis."""
    place: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "ha": "center"}
    axes.annotate(text, (x, 1), xytext=(0, points), **place, **look)


def _label(axes: Axes, x: Axis, y: Axis) -> None:
    axes.set_xlabel(x.label)
    axes.set_ylabel(y.wrapped("\n"))
    if x.log:
        axes.set_xscale("log")
    if y.log:
        axes.set_yscale("log")


def _series(axes: Axes, series: Series) -> Any:
    look = style.LOOKS[series.role]
    common: dict[str, Any] = {"color": look.colour, "alpha": look.alpha, "zorder": look.order + 2}
    if series.points:
        if series.role == "measurement":
            common["color"] = style.INK
        return axes.errorbar(
            series.x,
            series.y,
            yerr=series.error,
            linestyle="none",
            marker=_MARKERS[look.marker],
            markersize=3.5,
            elinewidth=0.8,
            capsize=2,
            **common,
        )
    (line,) = axes.plot(series.x, series.y, linewidth=look.width, linestyle=_DASHES[look.dash], **common)
    if series.error is not None:
        axes.fill_between(
            series.x,
            series.y - series.error,
            series.y + series.error,
            color=look.colour,
            alpha=0.2,
            linewidth=0,
        )
    return line


def _colours(figure: MapFigure) -> Colormap:
    stops = style.DIVERGING if figure.diverging else style.SEQUENTIAL
    return LinearSegmentedColormap.from_list("fmuid", list(stops))


def _map(figure: MapFigure) -> Canvas:
    n_rows, n_columns = figure.values.shape
    letters = 0.6 * _WIDTH / n_columns / 0.055  # that a column has room for
    fits = all(len(line) <= n * letters for name, n in figure.headings for line in name.split("\n"))
    canvas = _canvas(_WIDTH, 1.5 + 0.24 * n_rows + (0.0 if fits else 0.7))
    axes = canvas.subplots()
    axes.grid(visible=False)
    axes.set_facecolor("white")
    colours = _colours(figure)
    image = axes.imshow(
        figure.values,
        cmap=colours,
        vmin=figure.limits[0],
        vmax=figure.limits[1],
        aspect="equal" if n_rows == n_columns else "auto",
        interpolation="nearest",
    )
    axes.set_xticks(range(n_columns), figure.columns, rotation=45 if n_columns <= 12 else 90, ha="right")
    if n_columns > 12:
        axes.set_xticks(range(n_columns), figure.columns, rotation=90, ha="center", fontsize=6)
    axes.set_yticks(range(n_rows), figure.rows)
    axes.tick_params(length=0)
    if figure.values.size <= _MAX_CELLS_WITH_NUMBERS:
        _numbers(axes, figure, colours)
    start = 0
    for name, width in figure.headings if fits else figure.groups:
        place = {"ha": "center"} if fits else {"ha": "left", "rotation": 30, "rotation_mode": "anchor"}
        axes.text(start + width / 2 - 0.5, -0.65, name, va="bottom", fontsize=7, **place)
        start += width
        if start < n_columns:
            axes.axvline(start - 0.5, color="white", linewidth=3)
    bar = canvas.colorbar(image, ax=axes, shrink=0.9, pad=0.02, aspect=25)
    bar.set_label(figure.quantity.label)
    bar.outline.set_visible(False)
    return canvas


def _numbers(axes: Axes, figure: MapFigure, colours: Colormap) -> None:
    norm = Normalize(*figure.limits)
    for (row, column), value in np.ndenumerate(figure.values):
        if np.isfinite(value):
            red, green, blue, _ = colours(norm(value))
            dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
            text = f"{value:.2f}".replace("-0.00", "0.00")
            axes.text(
                column, row, text, ha="center", va="center", fontsize=6, color="white" if dark else style.INK
            )


def _bars(figure: BarFigure) -> Canvas:
    canvas = _canvas(_WIDTH, 0.75 + 0.27 * max(1, len(figure.bars)) + (0.2 if figure.marks else 0))
    axes = canvas.subplots()
    axes.grid(visible=False, axis="y")
    for k, bar in enumerate(figure.bars):
        _bar(axes, k, bar)
    axes.set_yticks(range(len(figure.bars)), [b.label for b in figure.bars])
    axes.tick_params(axis="y", length=0)
    axes.invert_yaxis()
    axes.set_xlabel(figure.quantity.label)
    if figure.quantity.log:
        axes.set_xscale("log")
    if figure.limits:
        axes.set_xlim(*figure.limits)
    for position, text in figure.marks:
        axes.axvline(position, color=style.INK, linewidth=0.8, linestyle=(0, (3, 2)))
        _above(axes, position, text, 2, fontsize=7)
    return canvas


def _bar(axes: Axes, k: int, bar: Bar) -> None:
    axes.barh(k, bar.value, height=0.62, color=style.bar_colour(bar.role))
    end = bar.value
    if bar.interval is not None:
        low, high = bar.interval
        axes.plot([low, high], [k, k], color=style.INK, linewidth=1, marker="|", markersize=5)
        end = max(end, high)
    if bar.note:
        axes.annotate(
            bar.note,
            (max(end, 0.0), k),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=7,
            annotation_clip=False,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},  # a mark may pass behind it
            zorder=4,
        )


def _position(scale: Scale) -> Callable[[Any], Any]:
    """Return a function for the position of a value between the ends of its scale, 0 to 1."""
    to_line: Callable[[Any], Any] = np.log if scale.axis.log else np.asarray
    low, high = to_line(scale.lower), to_line(scale.upper)
    return lambda value: (to_line(value) - low) / (high - low) if high > low else 0.5 + 0 * to_line(value)


def _parallel(figure: ParallelFigure) -> Canvas:
    n = len(figure.scales)
    canvas = _canvas(_WIDTH, 3.4)
    axes = canvas.subplots()
    axes.grid(visible=False)
    heights = np.column_stack([_position(s)(v) for s, v in zip(figure.scales, figure.values.T, strict=True)])
    usable = np.isfinite(figure.cost) & np.isfinite(heights).all(axis=1)
    order = np.flatnonzero(usable)[np.argsort(-figure.cost[usable], kind="stable")]  # the best on top
    positive = figure.cost[usable].size > 0 and figure.cost[usable].min() > 0
    low, high = (figure.cost[usable].min(), figure.cost[usable].max()) if usable.any() else (0.0, 1.0)
    norm = LogNorm(low, max(high, low * 1.001)) if positive else Normalize(low, high)
    colours = matplotlib.colormaps[style.ORDERED]
    lines = [np.column_stack([np.arange(n), heights[k]]) for k in order]
    axes.add_collection(LineCollection(lines, colors=colours(norm(figure.cost[order])), linewidths=0.7, alpha=0.7))
    axes.plot(np.arange(n), heights[figure.best], color=style.VERMILLION, linewidth=1.8, marker="o", label="best")
    for k, scale in enumerate(figure.scales):
        axes.axvline(k, color="#444444", linewidth=0.7, zorder=1)
        for value, y, va in ((scale.lower, -0.02, "top"), (scale.upper, 1.02, "bottom")):
            axes.text(k, y, f"{value:.4g}", ha="center", va=va, fontsize=7)
        if scale.reference is not None:
            axes.plot(
                k,
                _position(scale)(scale.reference),
                marker="D",
                color=style.GREEN,
                linestyle="none",
                markersize=6,
                markerfacecolor="none",
                markeredgewidth=1.4,
                zorder=6,
                label="reference" if k == 0 else None,
            )
    turned: dict[str, Any] = {"rotation": 30, "ha": "right"} if n > 6 else {}
    labels = [s.axis.label.replace(" / ", "\n/ ").replace(": ", "\n") for s in figure.scales]
    axes.set_xticks(range(n), labels, fontsize=7, **turned)
    axes.tick_params(axis="x", length=0, pad=12)
    axes.set_yticks([])
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.set_xlim(-0.3, n - 0.7)
    axes.set_ylim(-0.08, 1.1)
    canvas.legend(loc="outside upper center", ncols=2)
    bar = canvas.colorbar(ScalarMappable(norm, colours), ax=axes, pad=0.02, aspect=25)
    bar.set_label("cost")
    bar.outline.set_visible(False)
    return canvas
