"""Measurements and predictions of a case, and the signals that a campaign judges."""

from __future__ import annotations

from collections.abc import Sequence

from fmuid.core.campaign import Campaign
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem import cases as case_building
from fmuid.identification.problem.cases import Case
from fmuid.report.figures import Overlay
from fmuid.report.plots.figure_data import Role


def judged_signals(campaign: Campaign) -> set[tuple[str, str, str]]:
    """Return (setup, experiment, signal) of everything a stage of the campaign judges."""
    judged: set[tuple[str, str, str]] = set()
    for stage in campaign.stages.values():
        for run in case_building.experiments_of(campaign, stage.experiments, where=stage.name):
            signals = [c.signal for c in stage.criteria] or list(run.outputs)
            judged |= {(run.setup, run.id, s) for s in signals}
    return judged


def overlays(
    campaign: Campaign | None, case: Case, versions: Sequence[tuple[str, Role, FloatArray | None]]
) -> list[Overlay]:
    """Return one overlay for each channel of `case`; `versions` are (label, role, predictions)."""
    compared = []
    for k, channel in enumerate(case.channels):
        convert = channel.to_shown
        drawn = tuple((label, role, convert(p[k])) for label, role, p in versions if p is not None)
        sigma = None if channel.noise.source == "unknown" else channel.noise.of_mean(channel.count)
        compared.append(
            Overlay(
                case.id,
                channel.signal,
                channel.shown_unit,
                case.task.time,
                convert(channel.mean),
                drawn,
                heading(campaign, case),
                None if sigma is None else abs(convert.factor) * sigma,
            )
        )
    return compared


def heading(campaign: Campaign | None, case: Case) -> str:
    """Return the title of a case's panel: its id and the kind of run."""
    if campaign is None:
        return case.id
    run = campaign.measurements.experiments.get(case.experiments[0] if case.experiments else case.id)
    return f"{case.id}: {run.description}" if run is not None and run.description else case.id
