"""Results of an identification: estimates, outcomes of the stages, and uncertainty.

A run folder contains ``result.json`` (`Result.to_json`), ``history.h5`` (`history`), and the output of reports.
The result of a killed run is reconstructed from its history.
"""

from __future__ import annotations

import html
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from fmuid.core.errors import FmuidError
from fmuid.core.files import write_atomically
from fmuid.core.formatting import html_lines, html_table, interval_text, text_table
from fmuid.core.plottable import Plottable
from fmuid.identification.history import FILE as HISTORY
from fmuid.identification.history import JOURNAL, StageHistory, read_run
from fmuid.identification.misfit import Unexplained
from fmuid.identification.solvers.pareto import Front
from fmuid.identification.solvers.search import Link, Start, Status
from fmuid.identification.uncertainty.between_machines import MachineSpread
from fmuid.identification.uncertainty.confidence import Uncertainty
from fmuid.identification.uncertainty.new_runs import NewRuns
from fmuid.identification.uncertainty.posterior import Posterior
from fmuid.identification.uncertainty.profiles import Profile
from fmuid.identification.uncertainty.propagation import CriterionSpread

if TYPE_CHECKING:
    from fmuid.core.frames import Library

FILE = "result.json"
_WITHIN, _NEAR = 0.1, 1e-3  # standard errors, and share of the range, within which an estimate is at its bound
_TOUCHING, _ROUNDING = 1e-6, 1e-14  # share of the range, without a standard error and at least
_MISSED = 0.01  # share of a signal's energy that a sound fit may leave in a coloured residual
FEW_RUNS = (
    "one run, few runs: no more than three runs determine the parameter, so its interval does not contain how "
    "much it differs from run to run; record at least four"
)
LEAST_SHOWN = 0.005  # share of a variance from which on a column is shown


class ResultError(FmuidError):
    """A result cannot be read."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """One estimated parameter, in model space.

    `standard_error` and `interval` (95 %) are None where the experiments do not determine the parameter alone, or
    where it sits at a bound. `inherited` is the share of its variance due to errors of parameters fixed at earlier
    estimates. `truth` is the true value on the rig, if known. `depends_on` names fixed variables on whose values
    the estimate depends. `note` marks standard errors that are robust to the model's misfit, intervals that hold
    for one or few runs only, estimates biased by noise of inputs, and values conditional on others that the stage
    holds.
    """

    name: str
    value: float
    start: float
    unit: str | None = None
    lower: float | None = None
    upper: float | None = None
    standard_error: float | None = None
    interval: tuple[float, float] | None = None
    at_bound: str | None = None
    truth: float | None = None
    description: str = ""
    inherited: float | None = None
    scale: str = "linear"
    depends_on: tuple[str, ...] = ()
    note: str = ""

    @property
    def relative_error(self) -> float | None:
        """Deviation from the truth, relative to it; None if the truth is unknown or 0."""
        return self.value / self.truth - 1.0 if self.truth else None


@dataclass(frozen=True, slots=True)
class CriterionValue:
    """A criterion of a case at the start and at the end, divided by its demand: satisfied if at most 1."""

    case: str
    label: str
    start: float | None
    value: float


@dataclass(frozen=True, slots=True)
class StageResult:
    """Outcome of one stage.

    Parameters
    ----------
    name, status, message
        Name of the stage, and how it ended.
    solver, why, links
        The solver, why it was chosen, and the solvers of a chain with the cost that each reached.
    estimates, parameters
        Estimates of the free parameters, and the values of all parameters after the stage.
    experiments, criteria
        Ids of its experiments, and the values of its criteria.
    start_cost, cost
        Cost at the start and at the end; None if no candidate could be simulated.
    evaluations, failures, seconds
        Number of evaluations, how many of them failed, and the time they took.
    starts, profiles, spread, front, posterior
        Outcomes of starts, profiles, spreads of criteria, Pareto front and posterior, where they were requested.
    uncertainty, ties
        Covariance of the estimates, and formulas of tied parameters.
    machines
        Differences between machines.
    unexplained
        Shares of the outputs that the model does not explain.
    warnings
        Messages for the user.
    """

    name: str
    status: Status
    message: str
    solver: str
    why: str
    estimates: tuple[Estimate, ...]
    experiments: tuple[str, ...]
    criteria: tuple[CriterionValue, ...]
    start_cost: float | None
    cost: float | None
    evaluations: int
    failures: int
    seconds: float
    starts: tuple[Start, ...] = ()
    uncertainty: Uncertainty | None = None
    warnings: tuple[str, ...] = ()
    ties: dict[str, str] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    profiles: tuple[Profile, ...] = ()
    spread: tuple[CriterionSpread, ...] = ()
    front: Front | None = None
    posterior: Posterior | None = None
    machines: tuple[MachineSpread, ...] = ()
    unexplained: tuple[Unexplained, ...] = ()
    links: tuple[Link, ...] = ()

    def __getitem__(self, name: str) -> Estimate:
        return _find(self.estimates, name)

    def __str__(self) -> str:
        """Return the stage as text: one line on its outcome, a table, and warnings."""
        return "\n".join([self.summary, text_table(_cells(self.estimates)), *self._below])

    def _repr_html_(self) -> str:
        table = html_table(_cells(self.estimates))
        return html_lines([self.summary]) + table + html_lines(self._below)

    @property
    def _below(self) -> list[str]:
        """Lines below the table of estimates."""
        lines = [FEW_RUNS] if any(" run" in e.note for e in self.estimates) else []
        lines += [*map(str, self.machines), *([] if self.front is None else [str(self.front)])]
        return [*lines, *map(str, self.new_runs), *(f"! {w}" for w in self.warnings)]

    @property
    def summary(self) -> str:
        """One-line summary."""
        cost = (
            ""
            if self.cost is None or self.start_cost is None
            else (f", cost {self.start_cost:.4g} -> {self.cost:.4g}")
        )
        each = "; ".join(f"{one.solver}: {one.cost:.6g} after {one.evaluations}" for one in self.links)
        how = f"{self.name}: {self.status.value} ({self.message}) by {self.solver}" + (
            f" ({each})" if each else ""
        )
        left = "".join(f"; {one}" for one in self.unexplained)
        return f"{how}, {self.evaluations} evaluations in {self.seconds:.1f} s{cost}{left}"

    @property
    def new_runs(self) -> tuple[NewRuns, ...]:
        """Errors of predictions of new runs, where residuals are more than noise."""
        return self.uncertainty.new_runs if self.uncertainty is not None and self.unexplained else ()

    @property
    def sound(self) -> bool:
        """Whether the search has converged and the residuals show no part of the signals that the model misses."""
        return self.status is Status.CONVERGED and all(u.share < _MISSED for u in self.unexplained)


@dataclass(frozen=True, slots=True)
class Result(Plottable):
    """The outcome of an identification; prints as tables, in a notebook as HTML.

    Parameters
    ----------
    campaign, title, source
        Name and title of the campaign, and its folder as an absolute path.
    stages
        Outcomes of the stages, in order.
    parameters
        Best value of every parameter, free or not, in model space.
    versions
        Versions of fmuid and of the libraries used.
    inputs
        SHA-256 of the measurement file and the FMUs, by name.
    recordings
        SHA-256 of the runs of its stages.
    seconds
        Total wall time, s.
    folder
        The run folder, if any.
    """

    campaign: str
    title: str
    source: str
    stages: tuple[StageResult, ...]
    parameters: dict[str, float]
    seconds: float = 0.0
    versions: dict[str, str] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    recordings: tuple[str, ...] = ()
    folder: str | None = None

    @property
    def status(self) -> Status:
        """The worst status of the stages."""
        order = [Status.FAILED, Status.INTERRUPTED, Status.STALLED, Status.BUDGET, Status.CONVERGED]
        return min((stage.status for stage in self.stages), key=order.index, default=Status.INTERRUPTED)

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """Every estimated parameter, with the estimate of its last stage."""
        last = {e.name: e for stage in self.stages for e in stage.estimates}
        return tuple(last.values())

    def __getitem__(self, name: str) -> Estimate:
        """Return the estimate of a parameter."""
        return _find(self.estimates, name)

    def stage(self, name: str) -> StageResult:
        """Return a stage by its name."""
        for stage in self.stages:
            if stage.name == name:
                return stage
        raise ResultError(f"no stage '{name}'", fix=f"there are: {', '.join(s.name for s in self.stages)}")

    def __str__(self) -> str:
        """Return the result as text, stage by stage."""
        head = f"{self.title or self.campaign}: {self.status.value}, {self.seconds:.1f} s"
        return "\n\n".join([head, *map(str, self.stages)])

    def _repr_html_(self) -> str:
        title = f"<h3>{html.escape(self.title or self.campaign)}</h3>"
        return title + "".join(stage._repr_html_() for stage in self.stages)

    def to_frame(self, library: Library = "pandas") -> Any:
        """Return the estimates as a data frame of pandas, polars or pyarrow, one row for each parameter."""
        from fmuid.core.frames import to_frame

        estimates = self.estimates
        simple = ("name", "value", "unit", "standard_error", "lower", "upper", "start", "truth", "description")
        columns = {name: [getattr(e, name) for e in estimates] for name in simple}
        for k, name in enumerate(("interval_from", "interval_to")):
            columns[name] = [None if e.interval is None else e.interval[k] for e in estimates]
        return to_frame(columns, library)

    def to_json(self, path: str | Path | None = None) -> str:
        """Return the result as JSON, and write it to `path` if given."""
        written = self.encoded(None if path is None else Path(path).parent)
        text = msgspec.json.format(written, indent=1).decode() + "\n"
        if path is not None:
            write_atomically(Path(path), text)
        return text

    def encoded(self, folder: Path | None) -> bytes:
        """Return the result as JSON for a file in `folder`; the campaign is named relative to it.

        The run can then be found from everywhere, and can be moved together with its campaign.
        """
        near = self.source if folder is None else self.source and os.path.relpath(self.source, folder.resolve())
        return msgspec.json.encode(replace(self, source=near))

    @classmethod
    def from_json(cls, path: str | Path) -> Result:
        """Read a result from a file or a run folder; for a killed run, the best values reached.

        Raises
        ------
        ResultError
            The result is missing or damaged.
        """
        path = Path(path)
        file = path / FILE if path.is_dir() else path
        try:
            if path.is_dir() and ((path / JOURNAL).exists() or not file.exists()):
                recorded = _recorded(path)
                if recorded is not None:
                    return recorded
            return _decoded(file.read_bytes(), file.parent)
        except OSError:
            raise ResultError("no such file", where=file, fix="give a folder written by fmuid identify") from None
        except (msgspec.DecodeError, msgspec.ValidationError, UnicodeDecodeError) as error:
            raise ResultError(f"is not a result ({error})", where=file, fix="identify again") from None


def _decoded(text: bytes, folder: Path) -> Result:
    result = msgspec.json.decode(text, type=Result)
    return replace(result, source=result.source and str((folder / result.source).resolve()))


def _recorded(folder: Path) -> Result | None:
    """Return the result recorded in the history of a run folder, None if there is no history."""
    if not ((folder / JOURNAL).exists() or (folder / HISTORY).exists()):
        return None
    run = read_run(folder)
    if run.result is not None:
        return _decoded(run.result, folder)
    if run.begun is None:
        return None
    stages = tuple(_reached(stage) for stage in run.stages.values() if stage.begun is not None)
    if not stages:
        raise ResultError("the run was stopped before its first stage", where=folder, fix="identify again")
    return replace(
        _decoded(run.begun, folder),
        stages=stages,
        parameters=dict(stages[-1].parameters),
        seconds=sum(stage.seconds for stage in stages),
    )


def _reached(stage: StageHistory) -> StageResult:
    """Return the result of a recorded stage, finished or not."""
    begun = msgspec.json.decode(stage.result or stage.begun or b"", type=StageResult)
    if stage.result is not None:
        return begun
    rows, searched, failed = stage.rows, stage.rows.searched, stage.rows.failed
    first, best = (
        rows[int(numbers[end])] if numbers.size else None
        for numbers, end in ((np.flatnonzero(searched & ~failed), 0), (np.flatnonzero(rows.improved), -1))
    )
    counted = replace(
        begun,
        evaluations=int(searched.sum()),
        failures=int((searched & failed).sum()),
        seconds=float(rows.seconds.sum()),
        start_cost=None if first is None else first.cost,
    )
    if best is None or first is None:
        return replace(counted, criteria=())
    values = dict(best.parameters)
    estimates = [replace(e, value=values[e.name], at_bound=_bound(e, values)) for e in begun.estimates]
    measures = zip(begun.criteria, first.criteria, best.criteria, strict=True)
    return replace(
        counted,
        cost=best.cost,
        parameters=values,
        estimates=tuple(estimates),
        criteria=tuple(replace(c, start=float(a), value=float(b)) for c, a, b in measures),
    )


def _bound(estimate: Estimate, values: Mapping[str, float]) -> str | None:
    ends = (estimate.lower, estimate.upper)
    low, high = (end if e is None else e for e, end in zip(ends, (-math.inf, math.inf), strict=True))
    return at_bound(values[estimate.name], low, high, log=estimate.scale == "log")


def finite(value: float) -> float | None:
    """Return `value`, or None if it is infinite or NaN, which JSON cannot represent."""
    return float(value) if math.isfinite(value) else None


def _find(estimates: Sequence[Estimate], name: str) -> Estimate:
    for estimate in estimates:
        if estimate.name == name:
            return estimate
    raise ResultError(f"'{name}' was not estimated", fix=f"estimated: {', '.join(e.name for e in estimates)}")


def _cells(estimates: Sequence[Estimate]) -> list[list[str]]:
    with_truth = any(e.truth is not None for e in estimates)
    with_inherited = any((e.inherited or 0.0) >= LEAST_SHOWN for e in estimates)
    header = ["parameter", "value", "unit", "standard error", "95 % interval"]
    header += ["inherited"] if with_inherited else []
    with_fixed, noted = any(e.depends_on for e in estimates), any(e.note for e in estimates)
    header += ["note"] if noted else []
    header += ["start", *(["truth", "deviation"] if with_truth else [])]
    rows = [[*header, *(["given the values of"] if with_fixed else [])]]
    for e in estimates:
        error = f"at its {e.at_bound} bound" if e.at_bound else "–"  # the warnings say why
        row = [
            e.name,
            f"{e.value:.6g}",
            e.unit or "",
            error if e.standard_error is None else f"{e.standard_error:.2g}",
            "" if e.interval is None else interval_text(*e.interval),
        ]
        if with_inherited:
            row.append("" if e.inherited is None else f"{100.0 * e.inherited:.0f} %")
        if noted:
            row.append(e.note)
        row.append(f"{e.start:.4g}")
        if with_truth:
            deviation = e.relative_error
            row += [
                "" if e.truth is None else f"{e.truth:.6g}",
                "" if deviation is None else f"{100.0 * deviation:+.2f} %",
            ]
        row += [", ".join(e.depends_on)] if with_fixed else []
        rows.append(row)
    return rows


def at_bound(
    value: float, lower: float, upper: float, *, error: float | None = None, log: bool = False
) -> str | None:
    """Return ``lower`` or ``upper`` if `value` is at that bound, else None.

    It is if the distance in search space is below a tenth of the standard `error` and a thousandth of the range;
    without an error, if it is within a millionth of the range.
    """
    if log:
        error = None if error is None else error / value
        lower, value, upper = (math.log(v) if v > 0.0 else -math.inf for v in (lower, value, upper))
    width = upper - lower if math.isfinite(upper - lower) else max(abs(value), 1e-300)
    reach = _TOUCHING * width if error is None else min(_WITHIN * error, _NEAR * width)
    reach = max(reach, _ROUNDING * width)
    if value - lower <= reach:
        return "lower"
    return "upper" if upper - value <= reach else None
