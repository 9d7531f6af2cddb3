"""The contents of figures, as values: no drawing, no numerics.

Four kinds cover every picture of fmuid: panels of lines (`LineFigure`), a matrix of cells (`MapFigure`), bars
with intervals (`BarFigure`), and parallel coordinates (`ParallelFigure`). The same value is drawn with
matplotlib for print (`fmuid.report.plots`), with plotly for the screen (`fmuid.report`), and written as CSV
(`tables`), so the three cannot disagree.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fmuid.core.immutable import FloatArray, read_only

Role = Literal["measurement", "start", "iterate", "final", "reference", "before", "after", "floor", "alternative"]
"""The role of a line, point or bar, which determines its look (`fmuid.report.plots.style`)."""

Cell = float | str | None


@dataclass(frozen=True, slots=True)
class Axis:
    """A quantity on an axis: its name and unit as in the campaign (``N.m``), empty if it has none."""

    name: str
    unit: str = ""
    log: bool = False

    @property
    def label(self) -> str:
        """Quantity over unit, ``speed / (rad/s)``, as ISO 80000 labels axes."""
        unit = pretty_unit(self.unit)
        if not unit:
            return self.name
        return f"{self.name} / ({unit})" if "/" in unit or "·" in unit else f"{self.name} / {unit}"

    def wrapped(self, break_: str) -> str:
        """Return the label, with the unit of a long one on a separate line."""
        return self.label.replace(" / ", f"{break_}/ ", 1) if len(self.label) > 26 else self.label

    @property
    def column(self) -> str:
        """Header of a CSV column: ``tau_sensor [N.m]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One line or cloud of points.

    Parameters
    ----------
    label
        Text in the legend.
    x, y
        (N,) in the panel's units; NaN breaks a line.
    role
        Role of the line, which determines its look.
    error
        (N,) standard errors of `y`, or None.
    """

    label: str
    x: FloatArray
    y: FloatArray
    role: Role
    error: FloatArray | None = None
    points: bool = False

    def __post_init__(self) -> None:
        for name in ("x", "y", "error"):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, read_only(values))
                if getattr(self, name).shape != np.shape(self.y):
                    raise ValueError(f"series '{self.label}': {name} and y differ in shape")


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One pair of axes with the series drawn into it.

    Parameters
    ----------
    marks
        Vertical lines, such as stage borders.
    beneath
        A smaller panel under this one, over the same abscissa, such as a residual.
    link
        Panels of a page with the same link are zoomed together, such as those of one run.
    """

    title: str
    x: Axis
    y: Axis
    series: tuple[Series, ...]
    marks: tuple[tuple[float, str], ...] = ()
    beneath: Panel | None = None
    link: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class LineFigure:
    """Panels of lines in a grid of `columns`, with one legend for all."""

    name: str
    title: str
    panels: tuple[Panel, ...]
    caption: str = ""
    columns: int = 2


@dataclass(frozen=True, slots=True, eq=False)
class MapFigure:
    """Cells of a matrix: correlation of parameters, or where the energy of a residual lies.

    Parameters
    ----------
    rows, columns
        Names of the R rows and C columns.
    values
        (R, C); NaN where there is nothing to show.
    groups
        Name and number of columns of neighbouring columns that belong together (bins of one variable).
    limits
        Ends of the colour scale; symmetric ends get a diverging scale.
    """

    name: str
    title: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    values: FloatArray
    quantity: Axis
    limits: tuple[float, float]
    groups: tuple[tuple[str, int], ...] = ()
    caption: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", read_only(self.values))
        if self.values.shape != (len(self.rows), len(self.columns)):
            raise ValueError(f"map '{self.name}': values {self.values.shape} do not fit rows and columns")
        if self.groups and sum(n for _, n in self.groups) != len(self.columns):
            raise ValueError(f"map '{self.name}': groups do not cover the columns")

    @property
    def headings(self) -> tuple[tuple[str, int], ...]:
        """The groups with the unit on a separate line, because neighbours have little room."""
        return tuple((name.replace(" / ", "\n/ ", 1), n) for name, n in self.groups)

    @property
    def diverging(self) -> bool:
        """Whether zero is the middle of the colour scale."""
        return self.limits[0] == -self.limits[1]


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar: its length, the interval around it if known, and a note printed next to it."""

    label: str
    value: float
    role: Role = "final"
    interval: tuple[float, float] | None = None
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class BarFigure:
    """Horizontal bars, first on top, with vertical reference lines (value, label) in `marks`."""

    name: str
    title: str
    bars: tuple[Bar, ...]
    quantity: Axis
    marks: tuple[tuple[float, str], ...] = ()
    caption: str = ""
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Scale:
    """One vertical axis of parallel coordinates, with its ends and, if known, the reference value."""

    axis: Axis
    lower: float
    upper: float
    reference: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ParallelFigure:
    """Parallel coordinates, MOPS' view of a search: one line per evaluation, coloured by its cost.

    `values` is (evaluations, scales); `best` is the row drawn on top.
    """

    name: str
    title: str
    scales: tuple[Scale, ...]
    values: FloatArray
    cost: FloatArray
    best: int
    caption: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", read_only(self.values))
        object.__setattr__(self, "cost", read_only(self.cost))
        if self.values.shape != (self.cost.size, len(self.scales)):
            raise ValueError(f"parallel coordinates '{self.name}': {self.values.shape} do not fit the scales")


Figure = LineFigure | MapFigure | BarFigure | ParallelFigure


@dataclass(frozen=True, slots=True)
class Table:
    """Rows under a header; numbers stay numbers until they are written or shown.

    `digits` are the significant digits that a reader is shown, by column; five by default. `precise` are those of
    a row, where it needs more in every column that would have five.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    name: str = ""
    title: str = ""
    caption: str = ""
    digits: tuple[int, ...] = ()
    precise: tuple[int, ...] = ()

    def digits_at(self, row: int, column: int) -> int:
        """Return the significant digits of a cell."""
        digits = self.digits[column] if self.digits else 5
        return self.precise[row] if self.precise and digits == 5 else digits

    def csv(self) -> str:
        """Return the table as CSV: nine significant digits, empty where unknown, formulas escaped."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([_written(cell) for cell in self.header])
        if self.rows and all(isinstance(cell, float) for row in self.rows for cell in row):
            line = ",".join(["%.9g"] * len(self.header)) + "\n"  # recordings are long: one format per row
            return text.getvalue() + "".join([line % row for row in self.rows]).replace("nan", "")
        writer.writerows([_written(cell) for cell in row] for row in self.rows)
        return text.getvalue()


def tables(figure: Figure) -> Iterator[tuple[str, Table]]:
    """Yield the data behind `figure` as (file stem, table): one table per panel, one for any other kind."""
    match figure:
        case LineFigure():
            for k, panel in enumerate(figure.panels, start=1):
                stem = figure.name if len(figure.panels) == 1 else f"{figure.name}-{k:02d}-{slug(panel.title)}"
                yield stem, _panel_table(panel)
                if panel.beneath is not None:
                    yield f"{stem}-{slug(panel.beneath.title)}", _panel_table(panel.beneath)
        case MapFigure():
            header = ("row", *figure.columns)
            groups = [name for name, n in figure.groups for _ in range(n)]
            if groups:
                header = ("row", *(f"{g}: {c}" for g, c in zip(groups, figure.columns, strict=True)))
            rows = tuple((r, *v) for r, v in zip(figure.rows, figure.values.tolist(), strict=True))
            yield figure.name, Table(header, rows)
        case BarFigure():
            header = ("name", figure.quantity.column, "lower", "upper", "note")
            yield (
                figure.name,
                Table(
                    header,
                    tuple((b.label, b.value, *(b.interval or (None, None)), b.note) for b in figure.bars),
                ),
            )
        case ParallelFigure():
            header = ("evaluation", "cost", *(s.axis.column for s in figure.scales))
            rows = tuple(
                (k, c, *v)
                for k, (c, v) in enumerate(zip(figure.cost.tolist(), figure.values.tolist(), strict=True))
            )
            yield figure.name, Table(header, rows)


def _panel_table(panel: Panel) -> Table:
    first = panel.series[0].x if panel.series else np.empty(0)
    shared = all(np.array_equal(s.x, first) for s in panel.series)
    if shared:
        header = [panel.x.column]
        columns = [first]
        for s in panel.series:
            header.append(f"{s.label}: {panel.y.column}")
            columns.append(s.y)
            if s.error is not None:
                header.append(f"{s.label}: standard error")
                columns.append(s.error)
        rows = tuple(zip(*(c.tolist() for c in columns), strict=True))
        return Table(tuple(header), rows)
    long_header = ("series", panel.x.column, panel.y.column, "error")
    long_rows: list[tuple[Cell, ...]] = []
    for s in panel.series:
        errors: Sequence[float | None] = [None] * s.x.size if s.error is None else s.error.tolist()
        long_rows += zip([s.label] * s.x.size, s.x.tolist(), s.y.tolist(), errors, strict=True)
    return Table(long_header, tuple(long_rows))


def _written(cell: Cell) -> str:
    if cell is None or (isinstance(cell, float) and np.isnan(cell)):
        return ""
    if isinstance(cell, int | float):
        return f"{cell:.9g}"
    return f"'{cell}" if cell.startswith(("=", "+", "@")) else cell  # spreadsheets would run it as a formula


def slug(text: str) -> str:
    """Return `text` as a file name: lower case letters, digits and dashes."""
    return re.sub(r"[^a-z0-9_]+", "-", text.lower()).strip("-") or "panel"


RAISED = str.maketrans("-\u22120123456789", "⁻⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def pretty_unit(unit: str) -> str:
    """Return a unit as it is printed: ``kg.m2`` as ``kg·m²``; ``1`` as nothing."""
    if unit in ("", "1"):
        return ""
    return re.sub(
        r"(?<=[A-Za-zΩ°%])\^?(-?\d+)",
        lambda m: m[1].translate(RAISED),
        unit.replace(".", "·").replace("*", "·"),
    )
