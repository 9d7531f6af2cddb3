"""The report of an identification run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.formatting import Fact, interval_digits, interval_text
from fmuid.core.immutable import FloatArray
from fmuid.identification.history import read_history
from fmuid.identification.result import FEW_RUNS, LEAST_SHOWN, Estimate, Result
from fmuid.identification.validate import RunScore, Validation, validate, within_intervals
from fmuid.report import figures
from fmuid.report.document import Document, Section, present, write_document
from fmuid.report.figures import Overlay
from fmuid.report.friction_figures import bearing_friction
from fmuid.report.plots import Format
from fmuid.report.plots.figure_data import Cell, Figure, Role, Table, pretty_unit, slug
from fmuid.report.predicted import judged_signals, overlays
from fmuid.report.provenance_table import provenance_table
from fmuid.report.stage_sections import search_history, stage_section
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator

_CLOSE = 2.0  # relative to the noise: a residual of two standard deviations
_DRAWN = 48  # largest number of runs in one figure
_SIMULATED = 0.3  # share of the report's time that passes before figures are drawn


def write_report(
    run_folder: str | Path,
    out: str | Path | None = None,
    *,
    campaign: Campaign | None = None,
    simulators: Mapping[str, Simulator] | None = None,
    formats: tuple[Format, ...] = ("png",),
    trust: bool = False,
    runner: Runner = in_process,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> Path:
    """Write the report of an identification run and return the path of its ``index.html``.

    Parameters
    ----------
    run_folder
        Output folder of ``fmuid identify --out``, with ``result.json`` and ``history.h5``.
    out
        Folder for ``index.html``, ``figures/`` and ``data/``; ``report`` in the run folder by default.
    campaign, simulators
        The campaign and its models by setup; by default, read from the paths that the result names.
    formats
        File formats of the figures: png, svg, pdf.
    trust
        Whether functions that the campaign names may be called if it is read here; see `load_campaign`.
    runner
        Runner of the simulations; this process by default.
    progress
        Called with the share of the work that is done, and the next step.

    Raises
    ------
    FmuidError
        Result, history, campaign or a model cannot be read, or `out` cannot be written.
    """
    folder = Path(run_folder)
    result = Result.from_json(folder)
    recorded = read_history(folder)
    if campaign is None and result.source:
        from fmuid.campaigns.campaign_toml import load_campaign

        campaign = load_campaign(result.source, trust=trust)
    if campaign is not None and simulators is None:
        from fmuid.identification.check import load_models

        simulators = load_models(campaign)
    models = simulators or {}
    sections = [_estimates_section(result, campaign)]
    validation: tuple[RunScore, ...] = ()
    progress(0.0, "simulating the runs")
    if campaign is not None:
        seen, validation = _fit_sections(result, campaign, models, runner)
        sections = [*_before_and_after(result, campaign, validation, models, runner), *sections, *seen]
    searches = [search_history(s, recorded[s.name]) for s in result.stages if s.name in recorded]
    searches = [s for s in searches if np.isfinite(s.cost).any()]
    if searches:
        sections.append(Section("Search", (figures.cost_figure(searches), _stages_table(result))))
    for k, stage in enumerate(result.stages):
        progress(_SIMULATED * (1 + k) / (1 + len(result.stages)), f"simulating stage {stage.name}")
        sections.append(stage_section(stage, recorded.get(stage.name), campaign, models))
    sections.append(Section("Provenance", (provenance_table(_provenance(result)),)))
    document = Document(
        f"Identification: {result.title or result.campaign}",
        estimates_sentence(result),
        facts(result, validation),
        tuple(s for s in sections if s.items or s.text),
    )

    def drawing(share: float) -> None:
        progress(_SIMULATED + (1 - _SIMULATED) * share, "drawing")

    return write_document(document, folder / "report" if out is None else Path(out), formats, drawing)


def estimates_sentence(result: Result, most: int = 6) -> str:
    """Return the estimates with their 95 % intervals as one sentence."""
    words = []
    for e in result.estimates[:most]:
        interval = "" if e.interval is None else f" ({interval_text(*e.interval)})"
        words.append(f"{e.name} = {e.value:.4g} {pretty_unit(e.unit or '')}".strip() + interval)
    more = len(result.estimates) - most
    return ", ".join(words) + (f" and {more} more" if more > 0 else "") + "."


def facts(result: Result, validation: Sequence[RunScore]) -> tuple[Fact, ...]:
    """Return the facts at the top: success, accuracy, and errors on held-out runs."""
    evaluations = sum(s.evaluations for s in result.stages)
    good = all(stage.sound for stage in result.stages)
    left = "; ".join(f"{stage.name}: {one}" for stage in result.stages for one in stage.unexplained)
    facts = []
    judged = [(s.rmse / s.noise_floor, s) for s in validation if s.noise_floor and np.isfinite(s.rmse)]
    if judged:
        ratio, worst_run = max(judged, key=lambda pair: pair[0])
        close = ratio <= _CLOSE
        missed = f"errors up to {ratio:.3g} times the noise ({worst_run.experiment}, {worst_run.signal})"
        text = f"errors up to {ratio:.2g} times the noise" if close else f"{missed}: run fmuid diagnose"
        facts.append(Fact("Held-out runs", text, "good" if close else "warn"))
    facts.append(
        Fact(
            "Search",
            f"{result.status.value}, {evaluations} evaluations in {result.seconds:.1f} s"
            + (f"; {left}" if left else ""),
            "good" if good else "warn",
        )
    )
    known = [e for e in result.estimates if e.relative_error is not None]
    if known:
        worst = max(known, key=lambda e: abs(e.relative_error or 0.0))
        facts.append(
            Fact("Largest deviation from the truth", f"{worst.name}, {100 * (worst.relative_error or 0.0):+.2f} %")
        )
    usable = [f for f in validation if np.isfinite(f.nrmse)]
    if usable:
        worst_fit = max(usable, key=lambda f: f.nrmse)
        median = float(np.median([f.nrmse for f in usable]))
        facts.append(
            Fact(
                "NRMSE on validation runs",
                f"median {100 * median:.2g} %, worst {100 * worst_fit.nrmse:.2g} % ({worst_fit.experiment})",
            )
        )
    criteria = {(c.case, c.label): c.value for s in result.stages for c in s.criteria}  # the last stage counts
    if criteria:
        largest, middle = max(criteria.values()), float(np.median(list(criteria.values())))
        # If a demand is the noise, the error of a perfect fit scatters about 1: counting those below says little.
        text = f"median {middle:.3g}, worst {largest:.3g}"
        facts.append(Fact("Error relative to the demand", text, "good" if largest <= 1 else "plain"))
    warnings = sum(len(s.warnings) for s in result.stages)
    if warnings:
        facts.append(Fact("Warnings", f"{warnings}, in the stages below", "warn"))
    return tuple(facts)


def _before_and_after(
    result: Result,
    campaign: Campaign,
    validation: Sequence[RunScore],
    simulators: Mapping[str, Simulator],
    runner: Runner,
) -> list[Section]:
    """Return the run that is predicted worst, with the start values and with the values found."""

    def predicted(values: Result | dict[str, float], runs: Sequence[str]) -> Validation:
        return validate(values, campaign, experiments=runs, simulators=simulators, runner=runner)

    used = sorted({e for s in result.stages for e in s.experiments})
    judged = {(setup, signal) for setup, _, signal in judged_signals(campaign)}
    known = validation or predicted(result, used).scores
    scores = [s for s in known if s.failure is None and (s.setup, s.signal) in judged]
    if not scores:
        return []
    worst = max(scores, key=lambda s: s.rmse / s.noise_floor if s.noise_floor else s.nrmse)
    start = {e.name: e.start for s in reversed(result.stages) for e in s.estimates}
    values: tuple[Result | dict[str, float], ...] = ({**result.parameters, **start}, result)
    before, after = (predicted(v, [worst.experiment]) for v in values)
    k = next(k for k, case in enumerate(after.cases) if case.id == worst.experiment)
    lines: list[tuple[str, Role, FloatArray | None]] = [
        ("start", "start", before.predictions[k]),
        ("identified", "final", after.predictions[k]),
    ]
    (shown,) = (o for o in overlays(campaign, after.cases[k], lines) if o.signal == worst.signal)
    kind = "The run reserved for validation" if validation else "The run"
    caption = f"{kind} that is predicted worst, {worst.experiment}. Below: simulation minus measurement."
    return [Section("Before and after", (figures.overlay_figure("before-after", "Worst run", [shown], caption),))]


def _estimates_section(result: Result, campaign: Campaign | None) -> Section:
    published = {} if campaign is None else published_groups(campaign)
    names = {e.name for e in result.estimates}
    columns = {group: v for group, v in published.items() if names & v.keys()}
    items: list[Figure | Table | None] = [_estimates_table(result, campaign, columns)]
    items.append(figures.deviation_figure(_in_order(result, campaign)))
    rest = tuple(
        (group, name, value)
        for group, values in published.items()
        for name, value in values.items()
        if not (group in columns and name in names)
    )
    if rest:
        items.append(Table(("source", "figure", "value"), rest, "published", "Published figures"))
    return Section("Estimates", present(*items))


def _estimates_table(
    result: Result, campaign: Campaign | None, published: Mapping[str, Mapping[str, float]]
) -> Table:
    stage_of = {e.name: s.name for s in result.stages for e in s.estimates}
    first = {e.name: e.start for s in reversed(result.stages) for e in s.estimates}
    truths = any(e.truth is not None for e in result.estimates)
    inherited = any((e.inherited or 0.0) >= LEAST_SHOWN for e in result.estimates)
    header = ["parameter", "unit", "start", "estimate", "moved, %", "standard error", "95 % from", "to"]
    header += ["inherited, %"] if inherited else []
    header += ["truth", "deviation, %"] if truths else []
    header += [*published, "stage", "note"]
    rows = []
    for e in _in_order(result, campaign):
        row: list[Cell] = [e.name, pretty_unit(e.unit or ""), first[e.name], e.value]
        moved = e.value - first[e.name]
        row += [100 * moved / abs(first[e.name]) if first[e.name] else None, e.standard_error]
        row += e.interval or (None, None)
        row += [None if e.inherited is None else round(100 * e.inherited)] if inherited else []
        if truths:
            row += [e.truth, None if e.relative_error is None else 100 * e.relative_error]
        row += [values.get(e.name) for values in published.values()]
        note = f"at its {e.at_bound} bound" if e.at_bound else e.description
        given = f"given the values of {', '.join(e.depends_on)}" if e.depends_on else ""
        row += [stage_of[e.name], "; ".join(filter(None, [e.note, note, given]))]
        rows.append(tuple(row))
    caption = (
        "Standard errors and intervals cover the noise, the colour of the residuals, and the errors of values "
        "that the stage fixed at estimates of earlier stages (inherited: their share of the variance). Values "
        "that no stage identified are treated as known. A dash: none; the stage's warnings give the reason. "
        f"{FEW_RUNS[:1].upper()}{FEW_RUNS[1:]}."
    )
    digits = tuple(
        dict.fromkeys(("moved, %", "standard error", "deviation, %", "inherited, %"), 2).get(name, 5)
        for name in header
    )
    precise = tuple(interval_digits(*e.interval) if e.interval else 5 for e in _in_order(result, campaign))
    return Table(tuple(header), tuple(rows), "estimates", "Parameters", caption, digits, precise)


def _in_order(result: Result, campaign: Campaign | None) -> list[Estimate]:
    order = {} if campaign is None else {name: k for k, name in enumerate(campaign.parameters)}
    return sorted(result.estimates, key=lambda e: order.get(e.name, len(order)))


def published_groups(campaign: Campaign) -> dict[str, dict[str, float]]:
    """Return the campaign's published numbers by source."""
    groups: dict[str, dict[str, float]] = {}
    for key, value in campaign.published.items():
        if isinstance(value, Mapping):
            numbers = {n: float(v) for n, v in value.items() if isinstance(v, int | float)}
            groups[key.replace("_", " ")] = numbers
        elif isinstance(value, int | float):
            groups.setdefault("published", {})[key] = float(value)
    return groups


def _stages_table(result: Result) -> Table:
    header = ("stage", "outcome", "solver", "free", "evaluations", "failed", "seconds", "start cost", "cost")
    rows = tuple(
        (
            s.name,
            f"{s.status.value} ({s.message})",
            "; ".join([s.solver, *(f"{k.solver}: cost {k.cost:.6g} after {k.evaluations}" for k in s.links)]),
            ", ".join(e.name for e in s.estimates if e.name not in s.ties),
            s.evaluations,
            s.failures,
            s.seconds,
            s.start_cost,
            s.cost,
        )
        for s in result.stages
    )
    return Table(header, rows, "stages", "Stages", digits=(5, 5, 5, 5, 6, 6, 3, 4, 4))


def _fit_sections(
    result: Result, campaign: Campaign, simulators: Mapping[str, Simulator], runner: Runner
) -> tuple[list[Section], tuple[RunScore, ...]]:
    """Simulate every run at the final values: friction over speed, validation, then the runs that were used."""
    judged = judged_signals(campaign)
    of_setup = {(setup, signal) for setup, _, signal in judged}
    used = {e for s in result.stages for e in s.experiments}
    sections: list[Section] = []
    start = {e.name: e.start for s in reversed(result.stages) for e in s.estimates}
    friction = bearing_friction(campaign, simulators, start, result.parameters)
    if friction is not None:
        sections.append(Section("Friction over speed", (friction,)))
    validation: tuple[RunScore, ...] = ()
    for role, title, text in (
        ("validation", "Validation", "Held-out runs, simulated with the final values."),
        ("identification", "Fit", "The runs used for identification, simulated with the final values."),
    ):
        runs = campaign.validation if role == "validation" else sorted(used)
        if not runs:
            continue
        validated = validate(result, campaign, experiments=runs, simulators=simulators, runner=runner)
        # A used run shows the signals it was used for; any other run shows those that similar runs were used for.
        keep = (
            judged
            if role == "identification"
            else {(s.setup, s.experiment, s.signal) for s in validated.scores if (s.setup, s.signal) in of_setup}
        )
        drawn: dict[tuple[str, str], list[Overlay]] = {}
        for case, predicted in zip(validated.cases, validated.predictions, strict=True):
            for overlay in overlays(campaign, case, [("simulation", "final", predicted)]):
                if (case.setup, case.id, overlay.signal) in keep:
                    drawn.setdefault((case.setup, overlay.signal), []).append(overlay)
        scores = tuple(s for s in validated.scores if (s.setup, s.experiment, s.signal) in keep)
        sections.append(_fit_section(title, text, role=role, drawn=drawn, judged=scores, scores=validated.scores))
        validation = scores if role == "validation" else validation
    return sections, validation


def _fit_section(
    title: str,
    text: str,
    *,
    role: str,
    drawn: Mapping[tuple[str, str], Sequence[Overlay]],
    judged: Sequence[RunScore],
    scores: Sequence[RunScore],
) -> Section:
    items: list[Figure | Table] = []
    overlaid: list[Figure | Table] = []
    caption = "Below: simulation minus measurement (mean of the repeats)."
    for (setup, signal), all_ in drawn.items():
        worst = {s.experiment for s in _worst([s for s in judged if (s.setup, s.signal) == (setup, signal)])}
        some = [o for o in all_ if o.experiment in worst]
        chosen = "" if len(some) == len(all_) else f", the {len(some)} largest errors of {len(all_)} runs"
        stem = f"{role}-{slug(setup)}-{slug(signal)}"
        heading = f"{signal}, {setup}{chosen}: measurement and simulation"
        overlaid.append(figures.overlay_figure(stem, heading, some, caption))
    if role == "validation":  # the stages show the other runs with their history
        items += overlaid
        overlaid = []
    if any(s.failure is None for s in judged):
        items.append(figures.fit_figure(f"nrmse-{role}", _worst(judged)))
    header = ["run", "signal", "unit", "repeats", "RMSE", "noise floor", "NRMSE, %", "relative error, %"]
    with_intervals = any(s.expected is not None for s in scores)
    header += ["95 % interval, ±", "within, %"] if with_intervals else []
    rows = tuple(
        (
            s.experiment,
            s.signal,
            pretty_unit(s.unit or ""),
            s.repeats,
            s.rmse,
            s.noise_floor,
            100 * s.nrmse,
            100 * s.relative_error,
            *([s.expected, None if s.within is None else 100 * s.within] if with_intervals else []),
            s.failure or "",
        )
        for s in scores
    )
    caption = (
        "Over all repeats. Noise floor: RMSE that the sensor noise alone leaves. NRMSE: relative to the standard "
        "deviation of the measurement; relative error: relative to its root mean square."
    )
    if with_intervals:
        caption += (
            " 95 % interval: 95 % of the samples of a new run are expected within this distance of their "
            "prediction; it follows from the errors of the fitted runs, each predicted from the others."
        )
    digits = (5, 5, 5, 5, *(3,) * (len(header) - 4), 5)
    items.append(Table((*header, "note"), rows, f"fit-{role}", "Fit, run by run", caption, digits))
    text += "".join(f" {sentence[:1].upper()}{sentence[1:]}." for sentence in within_intervals(scores))
    return Section(title, tuple(items), text, tuple(overlaid), "Every run over time")


def _worst(scores: Sequence[RunScore]) -> list[RunScore]:
    """Return the scores that are drawn, in their order: all, or the worst of very many."""
    ranked = sorted(range(len(scores)), key=lambda k: -np.nan_to_num(scores[k].nrmse, nan=np.inf))
    return [scores[k] for k in sorted(ranked[:_DRAWN])]


def _provenance(result: Result) -> dict[str, str]:
    return {
        "campaign": result.campaign,
        **{f"{name} (SHA-256)": value for name, value in result.inputs.items()},
        **{f"version of {name}": value for name, value in result.versions.items()},
    }
