"""The part of a report that belongs to one stage of an identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.immutable import FloatArray
from fmuid.identification.history import StageHistory as Recorded
from fmuid.identification.problem import cases as case_building
from fmuid.identification.result import StageResult
from fmuid.report import figures
from fmuid.report.analysis_sections import front_items, profile_items, spread_table, starts_figure, whiteness_table
from fmuid.report.document import Section, present
from fmuid.report.figures import Overlay, StageHistory
from fmuid.report.plots.figure_data import Figure, Role, Table, slug
from fmuid.report.predicted import overlays
from fmuid.simulation.simulator import Simulator

_PANELS = 6
_DETAILS = "Parallel coordinates, correlation, criteria"


def stage_section(
    result: StageResult,
    recorded: Recorded | None,
    campaign: Campaign | None,
    simulators: Mapping[str, Simulator],
) -> Section:
    """Return the section of one stage: history over the measurement, cost, parallel coordinates, criteria."""
    items: list[Figure | Table | None] = []
    details: list[Figure | Table | None] = []
    history = None if recorded is None else search_history(result, recorded)
    if campaign is not None and recorded is not None and result.name in campaign.stages:
        shown = _most_improved(result, iterates(result, recorded, campaign, simulators))
        items.append(_history_figure(result.name, shown))
    if history is not None and np.isfinite(history.cost).any() and len(history.names) > 1:
        specs = {} if campaign is None else campaign.parameters
        truths = {e.name: e.truth for e in result.estimates if e.truth is not None}
        details.append(figures.parallel_figure(history, specs, truths))
    if history is not None and np.isfinite(history.cost).any() and len(history.labels) > 1:
        details.append(figures.parallel_criteria_figure(history))
    details += [
        starts_figure(result),
        figures.correlation_figure(result),
        _criteria(result),
        whiteness_table(result),
    ]
    items += [*front_items(result), *profile_items(result)]
    details.append(spread_table(result))
    text = ". ".join(s[:1].upper() + s[1:] for s in (result.summary.partition(": ")[2], result.why)) + "."
    text += "".join(f" {str(new)[:1].upper()}{str(new)[1:]}." for new in result.new_runs)
    text += "".join(f" Warning: {w}." for w in result.warnings)
    return Section(f"Stage {result.name}", present(*items), text, present(*details), _DETAILS)


def search_history(result: StageResult, recorded: Recorded) -> StageHistory:
    """Return the evaluations of the search, without those of analyses of its result."""
    names = tuple(e.name for e in result.estimates if e.name not in result.ties)
    searched = recorded.rows.searched
    values = recorded.rows.parameters(names)[searched].reshape(-1, len(names))
    criteria = recorded.rows.criteria[searched].reshape(-1, len(recorded.criteria))
    return StageHistory(
        result.name, names, values, recorded.rows.costs[searched], _short(recorded.criteria), criteria
    )


def _short(labels: Sequence[str]) -> tuple[str, ...]:
    """Return the criteria's labels, without the kind if it is the same for all."""
    if len({label.rpartition(" ")[2] for label in labels}) > 1:
        return tuple(labels)
    return tuple(label.rpartition(" ")[0] if ": " in label.rpartition(" ")[0] else label for label in labels)


def iterates(
    result: StageResult, recorded: Recorded, campaign: Campaign, simulators: Mapping[str, Simulator]
) -> list[Overlay]:
    """Return measurement, start, some intermediate iterates and the final one of every judged signal.

    Nothing is simulated: the history contains the predictions of every iterate that improved.
    """
    spec = campaign.stages[result.name]
    runs = case_building.experiments_of(campaign, spec.experiments, where=result.name)
    made = case_building.from_campaign(campaign, runs, spec.criteria, simulators, apart=spec.apart)
    cases = {c.id: c for c in made}
    rows = list(recorded.iterates())
    if not rows:
        return []
    costs = np.array([row.cost for _, row in rows])
    chosen = [(0, "start", "start"), *((k, "", "iterate") for k in figures.milestones(costs, 4))]
    if len(rows) > 1:
        chosen.append((len(rows) - 1, "final", "final"))
    drawn: list[Overlay] = []
    for i, case_id in enumerate(recorded.cases):
        if case_id not in cases:
            continue
        versions: list[tuple[str, Role, FloatArray | None]] = []
        for k, label, role in chosen:
            number, row = rows[k]
            kind: Any = role
            versions.append((label or f"evaluation {number + 1}", kind, row.predictions[i]))
        drawn += overlays(campaign, cases[case_id], versions)
    return drawn


def _most_improved(result: StageResult, drawn: Sequence[Overlay]) -> list[Overlay]:
    """Keep the signals whose criteria were worst at the start, in the campaign's order."""
    worst: dict[str, float] = {}
    for c in result.criteria:
        worst[c.case] = max(worst.get(c.case, 0.0), c.start if c.start is not None else np.inf)
    ranked = sorted(range(len(drawn)), key=lambda k: -worst.get(drawn[k].experiment, 0.0))
    return [drawn[k] for k in sorted(ranked[:_PANELS])]


def _history_figure(name: str, shown: Sequence[Overlay]) -> Figure | None:
    if not shown:
        return None
    title = f"Optimisation history over the measurement: {name}"
    caption = (
        "Measurement, start, some of the best iterates, and the final one; below, its "
        "residual: prediction minus measurement."
    )
    return figures.overlay_figure(f"history-{slug(name)}", title, shown, caption)


def _criteria(result: StageResult) -> Table | None:
    if not result.criteria:
        return None
    rows = tuple((c.case, c.label, c.start, c.value) for c in result.criteria)
    return Table(
        ("case", "criterion", "start", "end"),
        rows,
        f"criteria-{slug(result.name)}",
        "Error relative to the demand, by criterion",
        "Each criterion is divided by its demand: at most 1 meets the demand. If the demand is the noise, the "
        "error of a perfect fit scatters about 1.",
        (5, 5, 3, 3),
    )
