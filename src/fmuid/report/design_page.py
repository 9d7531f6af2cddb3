"""The page of a designed experiment: its input, the predictions of each model, and its expected information."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.formatting import Fact
from fmuid.core.immutable import FloatArray
from fmuid.report.document import Document, Section, write_document
from fmuid.report.figures import TIME
from fmuid.report.plots.figure_data import Axis, LineFigure, Panel, Role, Series, Table
from fmuid.report.provenance_table import provenance_table
from fmuid.report.thinning import kept_samples

_ROLES: tuple[Role, ...] = ("final", "reference", "alternative", "start")
_BAND = 2.0  # standard deviations of the noise on either side


@dataclass(frozen=True, slots=True, eq=False)
class PlannedSignal:
    """A signal of the designed run: (N,) samples by model, or a single line for an input.

    `sigma` is the standard deviation of a sample's noise, drawn around the first line.
    """

    name: str
    unit: str
    time: FloatArray
    lines: Mapping[str, FloatArray]
    sigma: float | None = None
    lower: float = -np.inf
    upper: float = np.inf


def write_design_page(
    answer: Mapping[str, Any],
    out: Path,
    *,
    campaign: str,
    inputs: Sequence[PlannedSignal],
    outputs: Sequence[PlannedSignal],
    provenance: Mapping[str, str],
) -> Path:
    """Write the page of a design (the value of its JSON) and return the path of its ``index.html``.

    Raises
    ------
    FmuidError
        The folder cannot be written.
    """
    figures = [
        LineFigure("input", "Input", tuple(map(_panel, inputs)), "Dashed: limits.", 1),
        LineFigure(
            "prediction",
            "Predictions",
            tuple(map(_panel, outputs)),
            "The band is two standard deviations of a sample's noise on either side of the first model.",
            1,
        ),
    ]
    if any(len(signal.lines) > 1 for signal in outputs):
        apart = tuple(_panel(_less_the_first(signal)) for signal in outputs)
        first = next(iter(outputs[0].lines))
        figures.append(
            LineFigure(
                "difference",
                "Differences",
                apart,
                f"Minus the prediction of {first}, before any answer is refitted to the run.",
                1,
            )
        )
    document = Document(
        f"Designed experiment: {campaign}",
        "The input is in input.csv, next to this page.",
        tuple(Fact(*fact) for fact in answer["facts"]),
        (
            Section("The run", tuple(figures), answer["text"]),
            Section("Expected information", (_expected(answer),)),
            Section("Provenance", (provenance_table(provenance),)),
        ),
    )
    return write_document(document, out)


def _less_the_first(signal: PlannedSignal) -> PlannedSignal:
    first = next(iter(signal.lines.values()))
    lines = {label: values - first for label, values in signal.lines.items()}
    return replace(signal, lines=lines, lower=-np.inf, upper=np.inf)


def _panel(signal: PlannedSignal) -> Panel:
    series = []
    first = next(iter(signal.lines.values()))
    kept = kept_samples(list(signal.lines.values()))
    if signal.sigma is not None:
        for sign, label in ((1.0, "noise"), (-1.0, "noise")):
            edge = first + sign * _BAND * signal.sigma
            series.append(Series(label, signal.time[kept], edge[kept], "measurement"))
    for k, (label, values) in enumerate(signal.lines.items()):
        series.append(Series(label, signal.time[kept], values[kept], _ROLES[k % len(_ROLES)]))
    ends = signal.time[[0, -1]]
    for bound in (signal.lower, signal.upper):
        if np.isfinite(bound):
            series.append(Series("limit", ends, np.full(2, bound), "floor"))
    return Panel(signal.name, TIME, Axis(signal.name, signal.unit), tuple(series))


def _expected(answer: Mapping[str, Any]) -> Table:
    if answer["purpose"] == "parameters":
        rows = tuple(
            (name, entry["value"], _percent(entry["before"]), _percent(entry["after"]))
            for name, entry in answer["parameters"].items()
        )
        return Table(("parameter", "value", "before / %", "with this run / %"), rows, "told", "Standard errors")
    rows = tuple((*map(" and ".join, pair["between"]), pair["separation_sigma"]) for pair in answer["pairs"])
    return Table(("if true", "against", "separation / sigma"), rows, "told", "Separation of the answers")


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share
