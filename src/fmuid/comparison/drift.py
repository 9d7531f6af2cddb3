"""Comparison of an FMU or results with stored references: how far they have drifted, and where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.comparison.compare import Comparison, compare_tables, funnel_around
from fmuid.core.campaign import Interpolation
from fmuid.core.errors import FmuError, FmuidError
from fmuid.core.files import write_atomically
from fmuid.core.immutable import FloatArray
from fmuid.core.units import conversion_at
from fmuid.data.crosscheck_csv import Table, read_csv
from fmuid.simulation.runners import Runner, in_process, simulated
from fmuid.simulation.simulator import Simulator, Task


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """One result compared with its reference."""

    name: str
    result: Table
    reference: Table
    comparisons: tuple[Comparison, ...]
    funnel: tuple[float, float] | None = None

    @property
    def within(self) -> bool:
        """Whether every variable is within tolerance."""
        return all(c.within for c in self.comparisons)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparisons as plain values."""
        return {"name": self.name, "within": self.within, "variables": [asdict(c) for c in self.comparisons]}


def drift_of(
    result: Path,
    reference: Path,
    *,
    tolerance: float = 1e-3,
    funnel: tuple[float, float] | None = None,
    names: Sequence[str] = (),
    parameters: Mapping[str, float] | None = None,
    interpolation: Interpolation = "hold",
    runner: Runner = in_process,
) -> tuple[Drift, ...]:
    """Compare an FMU or results with references.

    Parameters
    ----------
    result
        An FMU, a CSV file, or a folder of CSV files.
    reference
        A CSV file, or a folder of them. For an FMU, columns that are its inputs drive it (`interpolation` applies
        between samples) and the others are compared. For a folder of results, files of the same name are compared.
    tolerance, funnel, names
        As in `fmuid.comparison.compare.compare_tables`.
    parameters
        Values to set on the FMU.
    runner
        Runner of the simulations; this process by default.

    Raises
    ------
    FmuidError
        There is no reference, a result is missing, a reference names a variable that the FMU lacks, or the FMU
        cannot be simulated.
    """
    if reference.suffix in (".fmu", ".ssp"):
        raise FmuidError("is not a reference", where=reference, fix="name the FMU first, then the reference")
    files = sorted(reference.glob("*.csv")) if reference.is_dir() else [reference]
    if not files:
        raise FmuidError("has no CSV files", where=reference, fix="write references with: fmuid simulate")
    simulator = _load(result) if result.suffix in (".fmu", ".ssp") else None
    drifts = []
    for file in files:
        got = None if simulator else read_csv(result / file.name if result.is_dir() else result)
        table = read_csv(file)
        compared = list(names)
        where = f"{result} against {file}"
        if simulator is not None:
            inputs = [n for n in table.columns if _is_input(simulator, n)]
            compared = compared or [n for n in table.columns if n not in inputs]
            got = _simulated(
                simulator,
                table,
                inputs=inputs,
                outputs=compared,
                parameters=parameters or {},
                interpolation=interpolation,
                where=where,
                runner=runner,
            )
        assert got is not None
        try:
            comparisons = compare_tables(got, table, tolerance=tolerance, funnel=funnel, names=compared)
        except FmuidError as error:
            raise type(error)(error.what, where=error.where or where, fix=error.fix) from None
        drifts.append(Drift(file.stem, got, table, comparisons, funnel))
    return tuple(drifts)


def write_drift_report(drifts: Sequence[Drift], folder: Path, title: str) -> Path:
    """Write ``report.md``, with a figure and data for each drifted variable; return the report's path."""
    from fmuid.report.plots import save_data, save_figure

    lines = [f"# {title}", "", *_table(drifts), ""]
    for drift in drifts:
        for comparison in drift.comparisons:
            if comparison.within:
                continue
            figure = _figure(drift, comparison)
            save_figure(figure, folder / "figures", ("png", "svg", "pdf"))
            save_data(figure, folder / "data")
            spans = ", ".join(f"{a:g} to {b:g} s" for a, b in comparison.spans[:8])
            more = f" and {len(comparison.spans) - 8} more spans" if len(comparison.spans) > 8 else ""
            lines += [
                f"## {drift.name}: {comparison.name}",
                "",
                f"Outside: {spans}{more}. Largest error {comparison.max_error:.4g},"
                f" at {comparison.max_error_time:g} s.",
                "",
                f"![{comparison.name} over time](figures/{figure.name}.png)",
                "",
            ]
    page = folder / "report.md"
    write_atomically(page, "\n".join(lines))
    return page


def _table(drifts: Sequence[Drift]) -> list[str]:
    rows = ["| reference | variable | NRMSE | largest error | at s | within |", "|---|---|---|---|---|---|"]
    return rows + [
        f"| {d.name} | {c.name} | {c.nrmse:.3g} | {c.max_error:.3g} | {c.max_error_time:g} |"
        f" {'yes' if c.within else '**no**'} |"
        for d in drifts
        for c in d.comparisons
    ]


def _figure(drift: Drift, comparison: Comparison) -> Any:
    from fmuid.report.plots.figure_data import Axis, LineFigure, Panel, Series, slug

    name = comparison.name
    unit = drift.reference.units.get(name) or drift.result.units.get(name, "")
    time = Axis("time", "s")
    series = [
        Series("reference", drift.reference.time, drift.reference.columns[name], "measurement"),
        Series("result", drift.result.time, drift.result.columns[name], "final"),
    ]
    known = np.isfinite(drift.reference.columns[name])
    at, values = drift.reference.time[known], drift.reference.columns[name][known]
    expected = np.interp(drift.result.time, at, values)
    errors = [Series("result", drift.result.time, drift.result.columns[name] - expected, "final")]
    if drift.funnel is not None:
        edges = funnel_around(drift.reference, name, drift.funnel)
        # One line there and back, broken in between: one entry in the legend.
        there = np.concatenate([at, [np.nan], at])
        series.append(Series("funnel", there, np.concatenate([edges[0], [np.nan], edges[1]]), "floor"))
        width = np.concatenate([edges[0] - values, [np.nan], edges[1] - values])
        errors.append(Series("funnel", there, width, "floor"))
    panels = (
        Panel("result and reference", time, Axis(name, unit), tuple(series)),
        Panel("result - reference", time, Axis(f"error of {name}", unit), tuple(errors)),
    )
    return LineFigure(slug(f"{drift.name}-{name}"), f"{drift.name}: {name}", panels)


def _load(path: Path) -> Simulator:
    from fmuid.simulation.coupled.loading import load_model

    return load_model(path)


def _is_input(simulator: Simulator, name: str) -> bool:
    return name in simulator.variables and simulator.variables[name].causality == "input"


def _simulated(
    simulator: Simulator,
    reference: Table,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
    parameters: Mapping[str, float],
    interpolation: Interpolation,
    where: str,
    runner: Runner,
) -> Table:
    """Return the FMU's response to the reference's inputs, in the reference's units."""
    variables = simulator.variables
    for name in (*outputs, *parameters):
        if name not in variables:
            raise FmuError(f"the FMU has no variable '{name}'", where=where, fix=suggestion(name, variables))

    def converted(name: str, values: FloatArray, source: str | None, target: str | None) -> FloatArray:
        # Values without a stated unit are assumed to be in the other's.
        return conversion_at(source or None, target or None, f"{where}: '{name}'")(values)

    driven = {n: converted(n, reference.columns[n], reference.units.get(n), variables[n].unit) for n in inputs}
    # At an event with two rows at one time, the last row is used as input.
    last = np.append(np.diff(reference.time) > 0, True)
    task = Task(
        reference.time[last],
        {n: v[last] for n, v in driven.items()},
        tuple(outputs),
        dict(parameters),
        interpolation,
    )
    columns = {
        n: converted(n, values, variables[n].unit, reference.units.get(n))
        for n, values in zip(outputs, simulated(runner, simulator, task, {}), strict=True)
    }
    return Table(reference.time[last], columns, {n: u for n, u in reference.units.items() if n in columns})
