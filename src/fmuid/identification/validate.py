"""Validation of an identified model on unused runs, compared with the sensor noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu_build.errors import counted
from fmuid.core.campaign import Campaign
from fmuid.core.errors import CampaignError, ProblemError, SimulationError
from fmuid.core.experiments import Experiment
from fmuid.core.formatting import html_lines, html_table, text_table
from fmuid.core.immutable import FloatArray
from fmuid.core.one_thread import in_one_thread
from fmuid.core.plottable import Plottable
from fmuid.identification.check import load_models
from fmuid.identification.problem.cases import Case, experiments_of, from_campaign
from fmuid.identification.problem.segments import last_stages, observed, segmented
from fmuid.identification.result import Result
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator

if TYPE_CHECKING:
    from fmuid.core.frames import Library

_ENOUGH = 0.85  # share of a run's samples within an interval that 95 % of the samples of all runs are within


@dataclass(frozen=True, slots=True)
class RunScore:
    """Prediction errors for one signal of one run (all its repeats together).

    Parameters
    ----------
    unit
        Unit of the log.
    rmse
        Root mean square error, in `unit`.
    nrmse
        `rmse` divided by the standard deviation of the measurement; 0 is perfect, 1 as bad as its mean.
    relative_error
        Norm of the error divided by the norm of the measurement, without removing the mean.
    noise_floor
        Root mean square of the sensor noise, in `unit`: no model can be expected to be better. None if unknown.
    expected, within
        Half width, in `unit`, of the 95 % interval of the samples of new runs, and the share of the samples within
        it. None for runs that were identified, and where the result has no such interval
        (`fmuid.identification.uncertainty.new_runs`).
    """

    experiment: str
    setup: str
    signal: str
    unit: str | None
    repeats: int
    rmse: float
    nrmse: float
    relative_error: float
    noise_floor: float | None
    failure: str | None = None
    expected: float | None = None
    within: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Validation(Plottable):
    """The `scores` of every run and signal; prints as a table.

    Parameters
    ----------
    scores
        One for each run and signal.
    cases, predictions
        What was compared, and (signals, N) predictions, for figures.
    """

    scores: tuple[RunScore, ...]
    cases: tuple[Case, ...] = field(default=(), repr=False)
    predictions: tuple[FloatArray | None, ...] = field(default=(), repr=False)

    def __getitem__(self, key: tuple[str, str]) -> RunScore:
        """Return the score of (experiment, signal)."""
        for score in self.scores:
            if (score.experiment, score.signal) == key:
                return score
        raise ProblemError(f"no score for {key[1]} in {key[0]}", fix="see the table of scores")

    def __str__(self) -> str:
        """Return the scores as a table, and how many new runs are as their intervals predict."""
        return "\n".join([text_table(self._rows()), *within_intervals(self.scores)])

    def _repr_html_(self) -> str:
        return html_table(self._rows()) + html_lines(within_intervals(self.scores))

    def _rows(self) -> list[list[str]]:
        header = ["run", "signal", "unit", "RMSE", "noise", "NRMSE", "relative error"]
        with_intervals = any(s.expected is not None for s in self.scores)
        header += ["95 % interval", "within"] if with_intervals else []
        rows = [header]
        for s in self.scores:
            noise = "" if s.noise_floor is None else f"{s.noise_floor:.3g}"
            numbers = [f"{s.rmse:.4g}", noise, f"{100 * s.nrmse:.3g} %", f"{100 * s.relative_error:.3g} %"]
            if s.expected is not None and s.within is not None:
                numbers += [f"±{s.expected:.3g}", f"{100 * s.within:.3g} %"]
            rows.append([s.experiment, s.signal, s.unit or "", *(numbers if s.failure is None else [s.failure])])
            rows[-1] += [""] * (len(header) - len(rows[-1]))
        return rows

    def to_frame(self, library: Library = "pandas") -> Any:
        """Return the scores as a data frame of pandas, polars or pyarrow, one row for each run and signal."""
        from fmuid.core.frames import to_frame

        names = [f.name for f in fields(RunScore)]
        return to_frame({name: [getattr(s, name) for s in self.scores] for name in names}, library)

    def to_dict(self) -> dict[str, object]:
        """Return the scores as plain values."""
        return {"scores": [asdict(score) for score in self.scores]}


def within_intervals(scores: Sequence[RunScore]) -> list[str]:
    """Return how many new runs lie within their prediction intervals, as a sentence; empty without intervals."""
    runs: dict[str, list[float]] = {}
    for score in scores:
        if score.within is not None:
            runs.setdefault(score.experiment, []).append(score.within)
    if not runs:
        return []
    inside = sum(min(shares) >= _ENOUGH for shares in runs.values())
    share = float(np.mean([share for shares in runs.values() for share in shares]))
    return [
        f"95 % prediction intervals contain at least {100 * _ENOUGH:.0f} % of the samples of {inside} of "
        f"{counted(len(runs), 'new run')} (mean {100 * share:.3g} %)"
    ]


@in_one_thread
def validate(
    result: Result | Mapping[str, float],
    campaign: Campaign | str | Path | None = None,
    *,
    experiments: Iterable[str] | None = None,
    simulators: Mapping[str, Simulator] | None = None,
    runner: Runner = in_process,
) -> Validation:
    """Simulate runs with identified parameters and compare them with measurements.

    Parameters
    ----------
    result
        An identification's result, or parameter values by name. In runs that were not fitted, per-experiment
        parameters have their start values.
    campaign
        Campaign; by default that of `result`.
    experiments
        Ids or globs; the campaign's validation set by default. Repeats are compared together.
    simulators
        Models by setup; the campaign's FMUs by default.
    runner
        Runner of the simulations; this process by default.

    Returns
    -------
    Validation
        Scores by run and signal; prints as a table.

    Raises
    ------
    CampaignError
        There are no runs for validation.

    Examples
    --------
    >>> scores = fmuid.validate({"C": 5000.0, "G": 8.0}, "tank", experiments=["log"])
    >>> round(scores["log", "T"].rmse, 2)  # in the unit of the log
    0.05
    """
    if campaign is None:
        if not isinstance(result, Result) or not result.source:
            raise CampaignError("no campaign to validate on", fix="give a campaign as second argument")
        campaign = result.source
    if not isinstance(campaign, Campaign):
        from fmuid.campaigns.campaign_toml import load_campaign

        campaign = load_campaign(campaign)
    ids = list(campaign.validation if experiments is None else experiments)
    if not ids:
        raise CampaignError("no runs are kept for validation", where="[roles]", fix="name some in validation")
    chosen = experiments_of(campaign, ids, where="validation")
    estimates = result.parameters if isinstance(result, Result) else result
    names = [n for n in estimates if not n.startswith("observer[")]
    unknown = sorted(n for n in names if n.split("@")[0] not in campaign.parameters)
    if unknown:
        raise CampaignError(
            f"parameter '{unknown[0]}' of the result is not in campaign '{campaign.name}'",
            fix="validate on a campaign with the same parameters",
        )
    values = campaign.start_values | dict(estimates)
    cases = cases_of(campaign, chosen, simulators or load_models(campaign), values)
    stages = result.stages if isinstance(result, Result) else ()
    seen = set(result.recordings) if isinstance(result, Result) else set()
    identified = {run.id for run in chosen if run.digest in seen}
    intervals = (new for stage in stages if stage.uncertainty is not None for new in stage.uncertainty.new_runs)
    expected = {(new.setup, new.signal): new.half_width for new in intervals}  # the last stage's count
    scores: list[RunScore] = []
    predictions: list[FloatArray | None] = []
    for case, outcome in zip(cases, predicted(cases, values, runner), strict=True):
        sensed, failure = (None, str(outcome)) if isinstance(outcome, SimulationError) else (outcome, None)
        predictions.append(sensed)
        scores += _scores(case, sensed, failure, expected if identified.isdisjoint(case.experiments) else {})
    return Validation(tuple(scores), cases, tuple(predictions))


def predicted(
    cases: Sequence[Case], values: Mapping[str, float], runner: Runner = in_process
) -> list[FloatArray | SimulationError]:
    """Simulate cases; return the (channels, N) sensor readings of each, or why it cannot be simulated."""
    outcomes = runner([(case.simulator, case.task, case.start_values(values)) for case in cases])
    return [
        outcome if isinstance(outcome, SimulationError) else case.sensed(outcome, values)
        for case, outcome in zip(cases, outcomes, strict=True)
    ]


def cases_of(
    campaign: Campaign,
    runs: Sequence[Experiment],
    simulators: Mapping[str, Simulator],
    values: Mapping[str, float],
) -> tuple[Case, ...]:
    """Return the cases of runs, in segments or with an observer as in the last stage of their setup."""
    stages = last_stages(campaign)
    cases: list[Case] = []
    for setup, stage in stages.items():
        recorded = [run for run in runs if run.setup == setup]
        of_setup = from_campaign(campaign, recorded, (), simulators, apart=stage.apart)
        if stage.segments is not None:
            of_setup = tuple(segmented(case, stage.segments, values) for case in of_setup)
        if stage.observer:
            of_setup = observed(of_setup, stage.observer, values)[0]
        cases += of_setup
    rest = [run for run in runs if run.setup not in stages]
    cases += from_campaign(campaign, rest, (), simulators)
    order = {run.id: k for k, run in enumerate(runs)}
    return tuple(sorted(cases, key=lambda case: order[case.experiments[0]]))


def _scores(
    case: Case, prediction: FloatArray | None, failure: str | None, expected: Mapping[tuple[str, str], float]
) -> Sequence[RunScore]:
    scores = []
    for k, channel in enumerate(case.channels):
        measured = channel.repeats
        there = np.isfinite(measured)
        error = np.full(1, np.nan) if prediction is None else (prediction[k] - measured)[there]
        rmse = float(np.sqrt(np.mean(error**2)))
        factor = abs(channel.to_shown.factor)
        half_width = None if prediction is None else expected.get((case.setup, channel.signal))
        spread, size = float(np.std(measured[there])), float(np.sqrt(np.mean(measured[there] ** 2)))
        scores.append(
            RunScore(
                case.id,
                case.setup,
                channel.signal,
                channel.shown_unit or None,
                len(measured),
                factor * rmse,
                rmse / spread if spread > 0.0 else float("nan"),
                rmse / size if size > 0.0 else float("nan"),
                None if channel.noise.source == "unknown" else factor * channel.noise.sigma,
                failure,
                half_width,
                None if half_width is None else float(np.mean(factor * np.abs(error) <= half_width)),
            )
        )
    return scores
