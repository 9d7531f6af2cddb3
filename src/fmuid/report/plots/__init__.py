"""Publishable figures as PNG, SVG and PDF, and the data behind each as CSV.

The values a figure shows are in `figure_data`; matplotlib is imported when the first figure is drawn.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Literal, get_args

from fmuid.core import exit_status
from fmuid.core.errors import FmuidError
from fmuid.core.files import write_atomically
from fmuid.report.plots.figure_data import Figure, tables

_WORTH_A_PROCESS = 12  # figures: starting a process takes about as long as drawing this many
Format = Literal["png", "svg", "pdf"]

__all__ = ["Format", "render", "save_data", "save_figure", "save_figures"]


def render(figure: Figure, format: Format = "png") -> bytes:
    """Draw `figure` and return it as a file's content; the same values give the same bytes.

    Raises
    ------
    FmuidError
        `format` is not one of png, svg and pdf.
    """
    if format not in get_args(Format):
        raise FmuidError(f"figures cannot be written as '{format}'", fix="choose png, svg or pdf")
    from fmuid.report.plots.draw import drawn  # matplotlib is slow to import

    return drawn(figure, format)


def save_figure(figure: Figure, folder: Path, formats: Sequence[Format] = ("png",)) -> tuple[Path, ...]:
    """Write `figure` as ``folder/<name>.<format>`` for each format and return the paths."""
    paths = tuple(folder / f"{figure.name}.{format}" for format in formats)
    for path, format in zip(paths, formats, strict=True):
        write_atomically(path, render(figure, format))
    return paths


def save_figures(
    figures: Sequence[Figure],
    folder: Path,
    formats: Sequence[Format] = ("png",),
    progress: Callable[[float], None] | None = None,
) -> None:
    """Write many figures like `save_figure`, on several processors; `progress` takes the share that is done.

    Raises
    ------
    FmuidError
        The folder cannot be written, or a helper process died.
    """
    helpers = min(os.cpu_count() or 1, 4, len(figures) // _WORTH_A_PROCESS + 1) - 1
    # Separate processes instead of `multiprocessing`, which would run the caller's script again.
    command = [sys.executable, "-P", "-m", "fmuid.report.plots", str(folder), *formats]
    started = [subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) for _ in range(helpers)]
    with ExitStack() as stack:
        for k, helper in enumerate(started, start=1):
            stack.enter_context(helper)
            assert helper.stdin is not None
            with suppress(BrokenPipeError):  # it has died, as its status will show
                helper.stdin.write(pickle.dumps(figures[k :: helpers + 1]))
                helper.stdin.close()
        mine = figures[:: helpers + 1]
        for k, figure in enumerate(mine):
            if progress is not None:
                progress(k / len(mine))
            save_figure(figure, folder, formats)
        for helper in started:
            assert helper.stderr is not None
            words = helper.stderr.read().decode(errors="replace").strip().splitlines()
            status = helper.wait()
            if status != 0:
                died = f"a helper process ended: {exit_status.in_words(status)}"
                raise FmuidError(
                    f"figures could not be drawn ({words[-1] if words else died})",
                    where=folder,
                    fix="free memory, then try again" if status == exit_status.KILLED else None,
                )


def save_data(figure: Figure, folder: Path) -> tuple[Path, ...]:
    """Write the values that `figure` shows as CSV, one file per panel, and return the paths."""
    paths = []
    for stem, table in tables(figure):
        paths.append(folder / f"{stem}.csv")
        write_atomically(paths[-1], table.csv())
    return tuple(paths)
