"""Figures a person can publish: PNG, SVG and PDF, and the data behind each as CSV.

The values a figure shows are in `fmuid.plots.data`; matplotlib is imported when the first one is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from fmuid.errors import FmuidError
from fmuid.files import write_atomically
from fmuid.plots.data import Figure, tables

Format = Literal["png", "svg", "pdf"]

__all__ = ["Format", "render", "save_data", "save_figure"]


def render(figure: Figure, format: Format = "png") -> bytes:
    """Draw `figure` and return it as a file's content; the same values give the same bytes.

    Raises
    ------
    FmuidError
        `format` is not one of png, svg and pdf.
    """
    if format not in get_args(Format):
        raise FmuidError(f"figures cannot be written as '{format}'", fix="choose png, svg or pdf")
    from fmuid.plots.draw import drawn  # matplotlib is slow to import

    return drawn(figure, format)


def save_figure(figure: Figure, folder: Path, formats: Sequence[Format] = ("png",)) -> tuple[Path, ...]:
    """Write `figure` as ``folder/<name>.<format>`` for each format and return the paths."""
    paths = tuple(folder / f"{figure.name}.{format}" for format in formats)
    for path, format in zip(paths, formats, strict=True):
        write_atomically(path, render(figure, format))
    return paths


def save_data(figure: Figure, folder: Path) -> tuple[Path, ...]:
    """Write the values `figure` shows as CSV, one file a panel, and return the paths."""
    paths = []
    for stem, table in tables(figure):
        paths.append(folder / f"{stem}.csv")
        write_atomically(paths[-1], table.csv())
    return tuple(paths)
