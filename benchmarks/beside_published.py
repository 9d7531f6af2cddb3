"""Identified and published parameters: both sets, and how well they predict the validation runs.

For a campaign with a table `[published.<source>]` of parameters, such as `campaigns/double_pendulum`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from benchmarks.study_command import run_module
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.campaign import Campaign
from fmuid.core.errors import CampaignError
from fmuid.core.formatting import text_table
from fmuid.identification.check import load_models
from fmuid.identification.result import Result
from fmuid.identification.validate import Validation, validate
from fmuid.report.figures import Overlay, overlay_figure
from fmuid.report.plots import save_figure


@dataclass(frozen=True, slots=True, eq=False)
class Beside:
    """Two sets of parameters, and their predictions of the validation runs.

    Attributes
    ----------
    source
        Name of the published set.
    result
        The identification.
    published
        Parameter -> published value, in the campaign's unit.
    ours, theirs
        Predictions of the validation set. With `theirs`, what is not published has the identified value.
    """

    source: str
    result: Result
    published: Mapping[str, float]
    ours: Validation
    theirs: Validation

    def parameters(self) -> str:
        """Return the parameters as a table: published, identified, 95 % interval."""
        rows = [["parameter", "unit", self.source, "identified", "95 % from", "to"]]
        for e in self.result.estimates:
            known = self.published.get(e.name)
            ends = [f"{v:.4g}" for v in e.interval] if e.interval else [f"at its {e.at_bound} bound"] * 2
            rows.append([e.name, e.unit or "", "" if known is None else f"{known:.4g}", f"{e.value:.4g}", *ends])
        return text_table(rows)

    def errors(self) -> str:
        """Return the root mean square errors of both as a table, one row for each run and signal."""
        rows = [["run", "signal", "unit", f"RMSE, {self.source}", "identified", "ratio"]]
        for a, b in zip(self.theirs.scores, self.ours.scores, strict=True):
            failed = [a.failure or f"{a.rmse:.4g}", b.failure or f"{b.rmse:.4g}", f"{b.rmse / a.rmse:.2f}"]
            rows.append([a.experiment, a.signal, a.unit or "", *failed])
        return text_table(rows)


def overlays_of(validations: Mapping[str, Validation], signal: str = "*") -> list[Overlay]:
    """Return measurements and predictions of validation runs; other models start from the first one."""
    (first, *_), drawn = validations.values(), []
    for k, case in enumerate(first.cases):
        for row, channel in enumerate(case.channels):
            lines = tuple(
                (label, "start" if one is first else "final", prediction[row])
                for label, one in validations.items()
                if (prediction := one.predictions[k]) is not None
            )
            if fnmatchcase(channel.signal, signal):
                drawn.append(Overlay(case.id, channel.signal, channel.unit or "", case.time, channel.mean, lines))
    return drawn


def beside(result: Result, campaign: Campaign, source: str) -> Beside:
    """Return a run's parameters beside those in the table `[published.<source>]` of its campaign.

    Raises
    ------
    CampaignError
        There is no such table, it has no parameter of the run, or no run is kept for validation.
    """
    group = campaign.published.get(source)
    names = {e.name for e in result.estimates}
    known = {n: float(v) for n, v in group.items() if n in names} if isinstance(group, Mapping) else {}
    if not known:
        what = f"no table [published.{source}] with parameters of the run"
        raise CampaignError(what, where=campaign.folder / "campaign.toml", fix="write one: name = value")
    simulators = load_models(campaign)
    ours = validate(result, campaign, simulators=simulators)
    theirs = validate(dict(result.parameters) | known, campaign, simulators=simulators)
    return Beside(source, result, known, ours, theirs)


def main(arguments: Sequence[str]) -> int:
    """`python -m benchmarks.beside_published RUN SOURCE [RUNS]`: print two tables, write a figure there.

    `RUNS` is a glob of the runs that the figure shows; all are shown without it.
    """
    return run_module("benchmarks.beside_published RUN SOURCE [RUNS]", arguments, _command)


def _command(arguments: Sequence[str]) -> None:
    run, source, shown = Path(arguments[0]), arguments[1], (*arguments[2:], "*")[0]
    result = Result.from_json(run)
    compared = beside(result, load_campaign(result.source), source)
    both = overlays_of({source: compared.theirs, "identified": compared.ours})
    overlays = [o for o in both if fnmatchcase(o.experiment, shown)]
    title = f"Validation runs: measured, and predicted with the parameters of {source} and with those identified"
    print(compared.parameters(), compared.errors(), sep="\n\n")
    print(*save_figure(overlay_figure(f"beside-{source}", title, overlays), run), sep="\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
