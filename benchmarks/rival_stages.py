"""Stages as rivals: how well the model of each stage of a run predicts the runs used and the validation runs.

For a campaign whose stages are different laws of the same thing, such as the friction laws of `campaigns/go1`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from benchmarks.beside_published import overlays_of
from benchmarks.study_command import run_module
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.campaign import Campaign
from fmuid.core.errors import CampaignError
from fmuid.core.files import write_atomically
from fmuid.core.formatting import text_table
from fmuid.core.immutable import FloatArray
from fmuid.identification.check import load_models
from fmuid.identification.result import Result, StageResult
from fmuid.identification.validate import Validation, validate
from fmuid.report.figures import overlay_figure
from fmuid.report.plots import save_figure
from fmuid.report.plots.figure_data import Table

_PIECES = 6  # of a run, resampled for the interval
_DRAWS = 4000
_COVERED = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """What one stage's model predicts of one signal.

    Attributes
    ----------
    stage
        Name of the stage.
    free, at_bound
        Number of parameters that it estimated, and of those that ended at a bound.
    used, kept
        Run -> mean absolute error in the unit of the model's variable, of the campaign's identification and
        validation set.
    gain, interval
        By how much the mean over the validation runs is below that of the first stage, and the 90 % interval when
        pieces of these runs are drawn anew: how evenly the gain is spread over them. What another recording of the
        same runs would give, only repeats can tell.
    validation
        The predictions of the validation runs.
    """

    stage: str
    free: int
    at_bound: int
    used: Mapping[str, float]
    kept: Mapping[str, float]
    gain: float
    interval: tuple[float, float]
    validation: Validation

    @property
    def mean_used(self) -> float:
        """Mean over the runs used."""
        return float(np.mean([*self.used.values()]))

    @property
    def mean_kept(self) -> float:
        """Mean over the validation runs."""
        return float(np.mean([*self.kept.values()]))


def rivals_of(
    result: Result, campaign: Campaign, signal: str, stages: Sequence[str] = ("*",), *, seed: int = 0
) -> tuple[Rival, ...]:
    """Return one rival for each stage of `result` that the names or globs `stages` choose, judged on `signal`.

    Raises
    ------
    CampaignError
        There is no such stage, no run is kept for validation, or a run does not measure the signal.
    SimulationError
        A stage's model cannot be simulated.
    """
    simulators = load_models(campaign)
    rng = np.random.default_rng(seed)
    rivals: list[Rival] = []
    first: Mapping[str, FloatArray] = {}
    chosen = [s for s in result.stages if any(fnmatchcase(s.name, pattern) for pattern in stages)]
    if not chosen:
        what = f"the run has no stage '{' '.join(stages)}'"
        raise CampaignError(what, fix=f"it has {', '.join(s.name for s in result.stages)}")
    for stage in chosen:
        kept = validate(stage.parameters, campaign, simulators=simulators)
        used = validate(stage.parameters, campaign, experiments=campaign.identification, simulators=simulators)
        errors = _absolute_errors(kept, signal)
        first = first or errors
        better = [first[run] - errors[run] for run in errors]
        rivals.append(
            Rival(
                stage.name,
                *_counts(stage),
                {run: float(np.mean(e)) for run, e in _absolute_errors(used, signal).items()},
                {run: float(np.mean(e)) for run, e in errors.items()},
                float(np.mean([np.mean(b) for b in better])),
                _spread(better, rng),
                kept,
            )
        )
    return tuple(rivals)


def _counts(stage: StageResult) -> tuple[int, int]:
    free = [e for e in stage.estimates if e.name not in stage.ties]
    return len(free), sum(e.at_bound is not None for e in free)


def _absolute_errors(validation: Validation, signal: str) -> dict[str, FloatArray]:
    errors = {}
    for case, prediction in zip(validation.cases, validation.predictions, strict=True):
        rows = [k for k, c in enumerate(case.channels) if c.signal == signal]
        if not rows:
            what = f"run '{case.id}' does not measure '{signal}'"
            raise CampaignError(what, fix=f"it measures {', '.join(c.signal for c in case.channels)}")
        if prediction is None:
            raise CampaignError(f"run '{case.id}' cannot be simulated", fix="see fmuid validate")
        error = np.abs(prediction[rows[0]] - case.channels[rows[0]].mean)
        errors[case.id] = error[np.isfinite(error)]
    return errors


def _spread(better: Sequence[FloatArray], rng: np.random.Generator) -> tuple[float, float]:
    pieces = [[float(np.mean(p)) for p in np.array_split(b, _PIECES)] for b in better]
    draws = [rng.choice(p, (_DRAWS, len(p))).mean(axis=1) for p in pieces]
    low, high = np.quantile(np.mean(draws, axis=0), [(1 - _COVERED) / 2, (1 + _COVERED) / 2])
    return float(low), float(high)


def table_of(rivals: Sequence[Rival]) -> Table:
    """Return the rivals as a table, one row each; errors in thousandths of the unit."""
    header = ("stage", "parameters", "at a bound", "MAE used", "MAE validation", "better by", "from", "to")
    rows = [
        (
            r.stage,
            str(r.free),
            str(r.at_bound),
            *(f"{1e3 * v:.2f}" for v in (r.mean_used, r.mean_kept, r.gain, *r.interval)),
        )
        for r in rivals
    ]
    runs = tuple(rivals[0].kept) if rivals else ()
    each = [(*row, *(f"{1e3 * r.kept[n]:.2f}" for n in runs)) for row, r in zip(rows, rivals, strict=True)]
    return Table((*header, *runs), tuple(each))


def write_rivals(rivals: Sequence[Rival], signal: str, out: Path) -> tuple[Path, ...]:
    """Write the table as CSV, and overlay and errors of the validation runs for the first stage and the best."""
    write_atomically(out / "rivals.csv", table_of(rivals).csv())
    best = min(rivals[1:] or rivals, key=lambda r: r.mean_kept)
    overlays = overlays_of({r.stage: r.validation for r in (rivals[0], best)}, signal)
    title = f"{rivals[0].stage} and {best.stage} on the validation runs"
    return (out / "rivals.csv", *save_figure(overlay_figure("rivals", title, overlays), out))


def main(arguments: Sequence[str]) -> int:
    """`python -m benchmarks.rival_stages RUN SIGNAL [STAGE...]`: print a table; write it and figures there."""
    return run_module("benchmarks.rival_stages RUN SIGNAL [STAGE...]", arguments, _command)


def _command(arguments: Sequence[str]) -> None:
    run, signal, stages = Path(arguments[0]), arguments[1], arguments[2:] or ["*"]
    result = Result.from_json(run)
    rivals = rivals_of(result, load_campaign(result.source), signal, stages)
    written = write_rivals(rivals, signal, run / f"rivals-{rivals[0].stage}")
    table = table_of(rivals)
    print(text_table([[str(cell) for cell in row] for row in (table.header, *table.rows)]))
    print(f"\nmean absolute error (MAE) of {signal}, in thousandths of its unit, mean over the runs; 'better by':")
    print(f"than {rivals[0].stage} on the validation runs, with the 90 % interval over pieces of these runs")
    print(*written, sep="\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
