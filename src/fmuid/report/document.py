"""A report as a value, and its writer: one HTML page that opens offline, with folders of figures and data."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from fmuid.core.files import write_atomically
from fmuid.core.folder_lock import claim
from fmuid.core.formatting import Fact
from fmuid.report.interactive import specification
from fmuid.report.plotly_js import plotly_js
from fmuid.report.plots import Format, save_data, save_figures
from fmuid.report.plots.figure_data import RAISED, Cell, Figure, MapFigure, ParallelFigure, Table, slug, tables

_MOST_ROWS = 500  # rows of a table shown on the page
_PLACEHOLDER = "@plotly.js@"


@dataclass(frozen=True, slots=True)
class Drawing:
    """A picture that is not a plot: an SVG element, also written as ``figures/NAME.svg``."""

    name: str
    title: str
    svg: str
    caption: str = ""


Item = Figure | Table | Drawing


def present(*items: Item | None) -> tuple[Item, ...]:
    """Return the items that there are; a table without rows is none."""
    return tuple(i for i in items if i is not None and not (isinstance(i, Table) and not i.rows))


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, a paragraph, and the figures and tables under it; `details` are folded on the screen.

    In a section that is `abreast`, a wide screen shows the first two items side by side.
    """

    title: str
    items: tuple[Item, ...]
    text: str = ""
    details: tuple[Item, ...] = ()
    details_title: str = "Details"
    abreast: bool = False

    @property
    def anchor(self) -> str:
        """Id of the heading."""
        return slug(self.title)


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report."""

    title: str
    subtitle: str
    facts: tuple[Fact, ...]
    sections: tuple[Section, ...]
    footer: str = ""


def write_document(
    document: Document,
    out: Path,
    formats: tuple[Format, ...] = ("png",),
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Write ``index.html``, ``figures/*`` and ``data/*.csv`` into `out` and return the path of the HTML.

    The HTML contains everything it shows (plotly.js included, once) and needs no network; it is written last.
    `progress` is called with the share of the drawing that is done.

    Raises
    ------
    FmuidError
        The folder cannot be written.
    """
    drawn: list[Figure] = []
    path = out / "index.html"
    with claim(out):
        for section in document.sections:
            for item in (*section.items, *section.details):
                if isinstance(item, Table):
                    if item.name:
                        write_atomically(out / "data" / f"{item.name}.csv", item.csv())
                elif isinstance(item, Drawing):
                    write_atomically(out / "figures" / f"{item.name}.svg", item.svg)
                else:
                    drawn.append(item)
                    save_data(item, out / "data")
        save_figures(drawn, out / "figures", formats, progress)
        write_atomically(path, rendered(document))
    return path


def rendered(document: Document) -> str:
    """Return the HTML of `document`."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("fmuid.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["cell"] = shown
    environment.tests["table"] = lambda item: isinstance(item, Table)
    environment.tests["drawing"] = lambda item: isinstance(item, Drawing)
    environment.tests["webgl"] = lambda item: isinstance(item, ParallelFigure)
    environment.tests["picture_on_paper"] = lambda item: isinstance(item, MapFigure | ParallelFigure)
    environment.filters["json"] = _json
    page = environment.get_template("report.html.jinja").render(
        document=document,
        specification=specification,
        stems=lambda figure: [stem for stem, _ in tables(figure)],
        most_rows=_MOST_ROWS,
    )
    # The library is 5 MB, so it is inserted last and the template engine need not carry it.
    return page.replace(_PLACEHOLDER, plotly_js().replace("</script", "<\\/script"), 1)


def _json(spec: Any) -> str:
    # "<" is written as an escape, so that nothing in the data can close the enclosing script element.
    text = json.dumps(spec, separators=(",", ":"), allow_nan=False, default=float)
    return text.replace("<", "\\u003c")


def shown(cell: Cell, digits: int = 5) -> str:
    """Return a table's cell as text, with `digits` significant digits; a dash where unknown."""
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return "–"
    if isinstance(cell, str):
        return cell
    text = f"{cell:.{digits}g}" if abs(cell) < 10**digits or not float(cell).is_integer() else f"{cell:.0f}"
    if "e" in text:
        mantissa, _, exponent = text.partition("e")
        text = f"{mantissa}·10" + str(int(exponent)).translate(RAISED)
    return text.replace("-", "−")
