"""The page of a global sensitivity analysis: which parameter matters to which output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fmu_build.errors import counted
from fmuid.core.campaign import without_owner
from fmuid.core.formatting import Fact
from fmuid.core.immutable import FloatArray
from fmuid.identification.uncertainty.sobol_morris import STRONGEST, GlobalSensitivity, OutputSensitivity
from fmuid.report.document import Document, Section, write_document
from fmuid.report.plots.figure_data import (
    Axis,
    Bar,
    BarFigure,
    Cell,
    Figure,
    LineFigure,
    MapFigure,
    Panel,
    Series,
    Table,
    slug,
)
from fmuid.report.provenance_table import provenance_table

_DRAWN = 4  # outputs with separate bars and clouds: those that vary most between parameters
_POINTS = 400  # largest number of points in a cloud
_SCALARS = {
    "change": "root mean square change from the start values / standard deviation of the noise",
    "criterion": "criterion",
    "mean": "mean",
    "final": "final value",
    "minimum": "minimum",
    "maximum": "maximum",
}
_MEANINGS = {
    "sobol": "First: the share of the output's variance that the parameter causes alone; total: including its"
    " interactions with other parameters. Lines: 95 % intervals by bootstrap.",
    "morris": "Mean size of the elementary effects (mu*): the change of the scalar per range of the parameter,"
    " averaged over the other parameters. A spread (sigma) as large as mu* means that the effect depends on the"
    " others, or is not linear. Lines: 95 % intervals by bootstrap.",
}


def write_sensitivity_page(
    sensitivity: GlobalSensitivity,
    out: Path,
    *,
    campaign: str,
    units: Mapping[str, str],
    provenance: Mapping[str, str],
) -> Path:
    """Write the page and return the path of its ``index.html``; `units` are those of the parameters.

    Raises
    ------
    FmuidError
        The folder cannot be written.
    """
    moving = [o for o in sensitivity.outputs if o.indices]
    drawn = moving[:_DRAWN]
    figures: list[Figure] = [_map(sensitivity, moving)] if len(moving) > 1 else []
    figures += [_bars(sensitivity, output) for output in drawn]
    clouds = tuple(_clouds(sensitivity, output, units) for output in drawn)
    sections = [
        Section("What matters", tuple(figures), _MEANINGS[sensitivity.method]),
        Section(
            "All indices", (_table(sensitivity), _ranges(sensitivity, units)), " ".join(sensitivity.remarks())
        ),
        Section("What was simulated", (), "Every point is one draw.", clouds, "The scalar over each parameter"),
        Section("Provenance", (provenance_table(provenance),)),
    ]
    document = Document(
        f"Global sensitivity: {campaign}",
        f"Scalar of each output: {_SCALARS[sensitivity.quantity]}.",
        _facts(sensitivity, moving),
        tuple(sections),
    )
    return write_document(document, out)


def _facts(sensitivity: GlobalSensitivity, moving: Sequence[OutputSensitivity]) -> tuple[Fact, ...]:
    facts = []
    for output in moving[:_DRAWN]:
        strengths = output.strengths(sensitivity.method)
        ranked = [sensitivity.names[k] for k in np.argsort(-strengths)]
        shown = ", ".join(f"{n} {s:.2g}" for n, s in zip(ranked, -np.sort(-strengths), strict=True))
        facts.append(Fact(output.label, shown))
    if sensitivity.negligible:
        facts.append(Fact("Below 1 % everywhere", ", ".join(sensitivity.negligible)))
    if sensitivity.unmoved:
        facts.append(Fact("Moved by no parameter", ", ".join(sensitivity.unmoved), "warn"))
    what = "base samples" if sensitivity.method == "sobol" else "trajectories"
    tone = "warn" if sensitivity.failed or sensitivity.interrupted else "plain"
    failed = f", {sensitivity.failed} failed" if sensitivity.failed else ""
    facts.append(
        Fact(
            "Simulated", f"{counted(len(sensitivity.draws), 'draw')} in {sensitivity.samples} {what}{failed}", tone
        )
    )
    return tuple(facts)


def _map(sensitivity: GlobalSensitivity, moving: Sequence[OutputSensitivity]) -> MapFigure:
    quantity = "total index" if sensitivity.method == "sobol" else "mu* / largest mu*"
    return MapFigure(
        "strengths",
        "Which parameter matters to which output",
        tuple(o.label for o in moving),
        sensitivity.names,
        np.array([o.strengths(sensitivity.method) for o in moving]),
        Axis(quantity),
        (0.0, 1.0),
    )


def _bars(sensitivity: GlobalSensitivity, output: OutputSensitivity) -> BarFigure:
    kind = STRONGEST[sensitivity.method]
    strong = output.indices[kind]
    bars = []
    for k in sorted(range(len(sensitivity.names)), key=lambda k: -strong[k].value):
        index = strong[k]
        width = index.half_width or 0.0
        note = f"{index.value:.3g}"
        if sensitivity.method == "sobol":
            note += f", alone {output.indices['first'][k].value:.2g}"
        else:
            note += f", sigma {output.indices['sigma'][k].value:.2g}"
        bars.append(
            Bar(sensitivity.names[k], index.value, "final", (index.value - width, index.value + width), note)
        )
    top = max(b.interval[1] for b in bars if b.interval)
    quantity = Axis("total index") if sensitivity.method == "sobol" else Axis("mu*", output.unit)
    limits = (min(0.0, *(b.value for b in bars)), 1.25 * top)
    return BarFigure(f"indices-{slug(output.label)}", output.label, tuple(bars), quantity, limits=limits)


def _clouds(sensitivity: GlobalSensitivity, output: OutputSensitivity, units: Mapping[str, str]) -> LineFigure:
    there = np.flatnonzero(np.isfinite(output.scalars))
    kept = there[np.unique(np.linspace(0, len(there) - 1, min(_POINTS, len(there))).astype(int))]
    scalar = Axis(sensitivity.quantity, output.unit)
    panels = tuple(
        _cloud(name, units, scalar, sensitivity.draws[kept, k], output.scalars[kept])
        for k, name in enumerate(sensitivity.names)
    )
    return LineFigure(f"draws-{slug(output.label)}", output.label, panels)


def _cloud(name: str, units: Mapping[str, str], scalar: Axis, x: FloatArray, y: FloatArray) -> Panel:
    axis = Axis(name, units.get(without_owner(name), ""))
    return Panel(name, axis, scalar, (Series("draw", x, y, "final", points=True),))


def _table(sensitivity: GlobalSensitivity) -> Table:
    kinds = ("first", "total") if sensitivity.method == "sobol" else ("mu_star", "mu", "sigma")
    header = ["output", "unit", "parameter"]
    for kind in kinds:
        header += [kind, "±"] if kind not in ("mu", "sigma") else [kind]
    rows = []
    for output in sensitivity.outputs:
        for k, name in enumerate(sensitivity.names):
            row: list[Cell] = [output.label, output.unit, name]
            for kind in kinds:
                index = output.indices[kind][k] if output.indices else None
                row.append(None if index is None else index.value)
                if kind not in ("mu", "sigma"):
                    row.append(None if index is None else index.half_width)
            rows.append(tuple(row))
    digits = (5, 5, 5, *(3 for _ in header[3:]))
    return Table(tuple(header), tuple(rows), "indices", "Indices", digits=digits)


def _ranges(sensitivity: GlobalSensitivity, units: Mapping[str, str]) -> Table:
    rows = tuple(
        (name, low, high, units.get(without_owner(name), ""))
        for name, (low, high) in zip(sensitivity.names, sensitivity.ranges, strict=True)
    )
    return Table(("parameter", "from", "to", "unit"), rows, "ranges", "Ranges of the parameters")
