"""The page `docs/tutorials/paper.md`, from the results of two identifications."""

from __future__ import annotations

from pathlib import Path

import jinja2
import numpy as np

from benchmarks.paper_reproduced.losses import law_figures, output_bearing, sliding
from benchmarks.paper_reproduced.pictures import FIG_7, SENSOR, write_pictures
from benchmarks.paper_reproduced.recorded import ROOT
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.campaign import Campaign
from fmuid.core.files import write_atomically
from fmuid.identification.result import Result, StageResult
from fmuid.identification.validate import Validation, validate
from fmuid.report.plots import save_figure

PAGE = ROOT / "docs" / "tutorials" / "paper.md"
FIGURES = ROOT / "docs" / "figures"
_PAPER_LINEAR = {"d_S": 2.66, "J_S": 0.003039, "d_G": 70.625}
_PAPER_FIRST = (0.923, 0.864, 0.058, 0.058)
_PAPER_ROWS = {
    10: (0.979, 0.945, 0.086781, 0.086781),
    15: (0.9625, 0.92125, 0.090313, 0.088438),
    20: (0.854, 0.847, 0.0565, 0.049),
}
_SPEEDS = (0, 10, 15, 20, 30, 100, 300)
KINDS = ("η_mf1", "η_mf2", "τ_bf1 / (N.m)", "τ_bf2 / (N.m)")
_ITERATIONS = {"linear": 18, "first_10": 103}


def write_page(direct: Path, least_squares: Path) -> None:
    """Write the page and its figures.

    Parameters
    ----------
    direct
        Run folder of the identification without derivatives.
    least_squares
        That of the same campaign with least squares.
    """
    ours, other = Result.from_json(direct), Result.from_json(least_squares)
    campaign = load_campaign(ours.source)
    runs = [*FIG_7, *(run for run in campaign.validation if run.startswith("valid_") and "_r" not in run)]
    validation = validate(ours, campaign, experiments=runs)
    write_pictures(ours, validation, campaign, FIGURES)
    for figure in law_figures(campaign, _values(ours)):
        save_figure(figure, FIGURES)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    text = environment.get_template("page.md.jinja").render(
        linear=_linear(ours),
        peak=_peak(validation),
        friction=_at_ten(ours),
        first=_first(ours),
        searches=_searches(ours, other),
        totals=[sum(s.evaluations for s in r.stages) for r in (ours, other)],
        quadrants=_quadrants(campaign, ours),
        output_bearing=output_bearing(_values(ours)),
        table=_table(ours),
        rows=_rows(ours),
        worst=_worst(validation),
    )
    write_atomically(PAGE, text)


def _stage(result: Result, name: str) -> StageResult:
    return next(stage for stage in result.stages if stage.name == name)


def _linear(ours: Result) -> list[tuple[str, str, str, str, str, str]]:
    stage = _stage(ours, "linear")
    return [
        (
            e.name,
            e.unit or "",
            f"{e.start:g}",
            f"{_PAPER_LINEAR[e.name]:g}",
            f"{e.value:.4g}",
            f"{e.standard_error:.2g}",
        )
        for e in stage.estimates
    ]


def _peak(validation: Validation) -> tuple[str, str]:
    """Return the largest measured torque of the 0.5 A step, and that at its end, N.m."""
    case = next(case for case in validation.cases if case.id == "step_0p5")
    torque = next(channel.mean for channel in case.channels if channel.signal == SENSOR)
    return f"{np.max(torque):.1f}", f"{np.mean(torque[-40:]):.1f}"


def _at_ten(ours: Result) -> str:
    return f"{_stage(ours, 'bearing')['lossTable[2,4]'].value:.4f}"


def _first(ours: Result) -> list[tuple[str, str, str, str, str]]:
    stage, rows = _stage(ours, "first_10"), []
    for k, (kind, published) in enumerate(zip(KINDS, _PAPER_FIRST, strict=True)):
        e = stage[f"lossTable[2,{k + 2}]"]
        error = "–" if e.standard_error is None else f"{e.standard_error:.2g}"
        rows.append((kind, "1" if k < 2 else "0.09", f"{published:g}", f"{e.value:.4f}", error))
    return rows


def _searches(ours: Result, other: Result) -> list[tuple[str, str, int, str, int, str]]:
    rows = []
    for mine, theirs in zip(ours.stages, other.stages, strict=True):
        costs = [f"{s.cost:.5g}" for s in (mine, theirs) if s.cost is not None]
        paper = str(_ITERATIONS.get(mine.name, "–"))
        rows.append((mine.name, paper, mine.evaluations, costs[0], theirs.evaluations, costs[1]))
    return rows


def _values(ours: Result) -> dict[str, float]:
    return ours.stages[-1].parameters


def _table(ours: Result) -> list[tuple[str, ...]]:
    values = _values(ours)
    return [
        (str(w), *(f"{values[f'lossTable[{r},{c}]']:.5g}" for c in range(2, 6)))
        for r, w in enumerate(_SPEEDS, start=1)
    ]


def _rows(ours: Result) -> list[tuple[str, ...]]:
    """Return the rows of Table 3: the paper's, ours row by row, and ours of all rows together."""
    alone = {w: _stage(ours, f"row_{w}") for w in _PAPER_ROWS}
    together = _stage(ours, "rows")
    rows = []
    for w, published in _PAPER_ROWS.items():
        names = [f"lossTable[{_SPEEDS.index(w) + 1},{c}]" for c in range(2, 6)]
        for label, cells in (
            ("paper, and our rig", [f"{v:g}" for v in published]),
            ("ours, the row alone", [_with_error(alone[w], n) for n in names]),
            ("ours, all rows", [_with_error(together, n) for n in names]),
        ):
            rows.append((str(w), label, *cells))
    return rows


def _with_error(stage: StageResult, name: str) -> str:
    e = stage[name]
    return f"{e.value:.5f}" if e.standard_error is None else f"{e.value:.5f} ± {e.standard_error:.5f}"


def _worst(validation: Validation) -> dict[str, tuple[str, str]]:
    """Return, of Figs. 7 and 14, the least and largest error of the sensor torque, in multiples of its noise."""
    shares: dict[bool, list[float]] = {True: [], False: []}
    for score in validation.scores:
        if score.signal == SENSOR and score.noise_floor:
            shares[score.experiment in FIG_7].append(score.rmse / score.noise_floor)
    return {
        name: (f"{min(shares[fixed]):.2f}", f"{max(shares[fixed]):.2f}")
        for name, fixed in (("fig7", True), ("fig14", False))
    }


def _quadrants(campaign: Campaign, ours: Result) -> list[tuple[str, ...]]:
    """Return Table 1 against the FMU in all four quadrants: samples, and the largest deviation, N.m."""
    run = sliding(campaign, _values(ours), 10.0)
    forward, driving, deviation = run.w > 0, run.w * run.tau >= 0, np.abs(run.friction - run.law())
    rows = []
    for where, formula, chosen in (
        ("ω_W > 0, τ_W ≥ 0", "(1 − η_mf1) τ_W + \\|τ_bf1\\|", forward & driving),
        ("ω_W > 0, τ_W < 0", "(1 − 1/η_mf2) τ_W + \\|τ_bf2\\|", forward & ~driving),
        ("ω_W < 0, τ_W ≥ 0", "(1 − 1/η_mf2) τ_W − \\|τ_bf2\\|", ~forward & ~driving),
        ("ω_W < 0, τ_W < 0", "(1 − η_mf1) τ_W − \\|τ_bf1\\|", ~forward & driving),
    ):
        rows.append((where, formula, str(chosen.sum()), f"{np.max(deviation[chosen]):.1e}"))
    return rows
