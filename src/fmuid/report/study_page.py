"""The page of a parameter study: the cost over each parameter, and over two of them as a map."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fmuid.core.formatting import Fact
from fmuid.core.immutable import FloatArray
from fmuid.identification.parameter_study import Study
from fmuid.report.document import Document, Section, write_document
from fmuid.report.plots.figure_data import Axis, Figure, LineFigure, MapFigure, Panel, Role, Series, Table


def write_study_page(study: Study, out: Path, *, campaign: str, units: Mapping[str, str]) -> Path:
    """Write the page and return the path of its ``index.html``; `units` are those of the parameters.

    Raises
    ------
    FmuidError
        The folder cannot be written.
    """
    figures: list[Figure] = [_over_each(study, units)]
    figures += [_map(study, units)] if len(study.over) == 2 else []
    facts = [Fact("Points", str(len(study.points)))]
    if study.best is not None:
        at = ", ".join(f"{n} = {v:.5g}" for n, v in zip(study.over, study.points[study.best], strict=True))
        facts.append(Fact("Smallest cost", f"{study.cost[study.best]:.5g} at {at}"))
    if study.failures:
        reason = next(iter(study.failures.values()))
        facts.append(Fact("Failed", f"{len(study.failures)} (the first: {reason})", "warn"))
    sections = (
        Section(
            "Cost over the parameters", tuple(figures), "Each point is the best one over the other parameters."
        ),
        Section("Points", (), "", (table_of(study),), "All points"),
    )
    return write_document(
        Document(f"Parameter study: {campaign}", f"Stage {study.stage}", tuple(facts), sections), out
    )


def table_of(study: Study) -> Table:
    """Return all points as a table."""
    rows = tuple(tuple(None if np.isnan(v) else v for v in study.row(k)) for k in range(len(study.points)))
    return Table(tuple(study.header), rows, "study", "All points", "A dash: the point cannot be simulated.")


def _over_each(study: Study, units: Mapping[str, str]) -> LineFigure:
    panels = []
    for k, (name, values) in enumerate(study.over.items()):
        series = []
        for label, numbers in (("cost", study.cost), *zip(study.labels, study.criteria.T, strict=True)):
            best = _least(study.points[:, k], values, numbers)
            role: Role = "final" if label == "cost" else "alternative"
            axis = "cost" if label == "cost" else "criteria"
            series.append((axis, Series(label, values, best, role)))
        x = Axis(name, units.get(name, ""))
        for axis in ("cost", "criteria"):
            chosen = tuple(s for kind, s in series if kind == axis)
            panels.append(Panel(f"{axis} over {name}", x, Axis(axis), chosen))
    return LineFigure("over_each", "Cost and criteria over each parameter", tuple(panels))


def _least(points: FloatArray, values: FloatArray, numbers: FloatArray) -> FloatArray:
    """Return for each of the values the least number among its points, NaN where none could be simulated."""
    rows = [numbers[points == value] for value in values]
    return np.array([np.nan if np.isnan(row).all() else np.nanmin(row) for row in rows])


def _map(study: Study, units: Mapping[str, str]) -> MapFigure:
    (a, first), (b, second) = study.over.items()
    cost = study.cost.reshape(len(first), len(second))
    known = cost[np.isfinite(cost)]
    limits = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    return MapFigure(
        "cost",
        f"Cost over {Axis(a, units.get(a, '')).label} (rows) and {Axis(b, units.get(b, '')).label}",
        tuple(f"{v:.4g}" for v in first),
        tuple(f"{v:.4g}" for v in second),
        cost,
        Axis("cost"),
        limits,
    )
