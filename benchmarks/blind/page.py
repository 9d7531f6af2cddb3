"""The page about the blind check, `docs/blind.md`, from what is published of every seed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.blind.plants.cases import CHECK, REHEARSAL
from benchmarks.blind.score import Figure, Scored, as_measured, figures, in_words, regimes, share
from benchmarks.timing import table

_INTRODUCTION = """\
# The blind check

How often a diagnosis is right on random rigs. Rigs are drawn at random from a grammar:
networks of 2 to 8 components in one or two domains, with parameters, inputs, sensors, rates and noise. Each has
a plain Modelica model, half of them with components and half as equations, and a plant by nodal assembly in C
that shares nothing with the program. Plants differ from their models by parameters up to a fifth off, by a
background of three to six small effects, and by what is asked for: nothing, one or two effects of the
catalogue's kinds in shapes that are not the catalogue's, a coefficient that varies, something that no catalogue
has, or an effect in one operating regime only. Logs are as they come: six of ten are single runs; some start in
motion, run in a closed loop, have the timing of a PLC or columns that nothing uses; one file in twenty is damaged.
Rigs are light (120 to 200 samples a run): 400 cases have to end within three hours on two cores.

`fmuid init` and `fmuid diagnose` get logs and model as from a user. Every seed is used once and then published
whole, in `benchmarks/blind/published/<seed>/`: version of the grammar, labels, answers, SHA-256 of every log.
The first {rehearsal} cases of a seed are a rehearsal, whose labels may be read while rules change; the next
{check} are the check.

    make blind SEED=...  # draw and diagnose
    make blind-verify    # recompute this page from what is committed, and logs and labels from their seeds

Before any diagnosis, 50 random rigs were compared with their models: `make blind-agreement` (largest difference
0.001 standard deviations of the noise).

A gap is in noise floors of a sample after a refit of all parameters. Sizes are drawn by quick refits; the label
then says what refits to the end leave (`measured.jsonl`). An effect that leaves less than a floor is one of the
background; the last column has the figures with labels as drawn. Effects that a case's runs cannot tell
apart (less than 3 standard deviations over all runs, by the plant) count as one, coefficients that vary included;
a drag is a damper that grows with speed. A model whose gap is below its tolerance, one floor, is complete. The
background's effects may be named, and what the runs cannot tell from one of them that is visible itself. Intervals
hold 90 %; cases cluster by rig, and the intervals allow for it. The interval for a new rig is where the share of a
rig that is not among these lies. [Earlier checks](history.md) were on rigs that did not stay unseen.
"""
_REGIMES = """\
Next to the figures that LISDD (arXiv 2606.23215) published of its controlled experiments, which are other systems,
by the definitions of its abstract: whether a discrepancy is seen; F1 of the samples in the regimes that are named;
the relative error of the parameters that the runs determine; whether the law is named."""


CASES = "cases.md"


@dataclass(frozen=True)
class Seed:
    """What is published of a seed."""

    seed: int
    told: dict[str, Any]
    labels: list[dict[str, Any]]
    records: dict[str, dict[str, Any]]
    measured: dict[str, dict[str, Any]]

    def cases(self, first: int, last: int, *, drawn: bool = False) -> list[Scored]:
        """Return the cases of these numbers that were diagnosed, with labels as measured, or as `drawn`."""
        known = {} if drawn else self.measured
        return [
            Scored(
                as_measured(label, known[label["case"]]) if label["case"] in known else label,
                self.records[label["case"]],
            )
            for label in self.labels
            if first <= label["number"] < last and label["case"] in self.records
        ]


def read_published(folder: Path) -> list[Seed]:
    """Read the published seeds."""
    seeds = []
    for file in sorted(folder.glob("*/seed.json")):
        told = json.loads(file.read_text())
        labels, records, measured = (
            [json.loads(line) for line in (file.parent / name).read_text().splitlines()]
            for name in ("labels.jsonl", "answers.jsonl", "measured.jsonl")
        )
        seeds.append(
            Seed(
                told["seed"], told, labels, {r["case"]: r for r in records},
                {m["case"]: m for m in measured},
            )
        )  # fmt: skip
    return seeds


def page(seeds: Sequence[Seed]) -> str:
    """Return the Markdown page about published seeds."""
    parts = [_INTRODUCTION.format(rehearsal=REHEARSAL, check=CHECK)]
    for seed in seeds:
        parts += [_section(seed, grid) for grid in _grids(seed)]
    if len(parts) == 1:
        parts.append("No seed has been published yet.\n")
    parts.append("Next: [how good it is](quality.md).\n")
    return "\n".join(parts)


def case_by_case(seed: Seed) -> str:
    """Return the Markdown page of a seed with every group of cases and every case that is not right."""
    parts = [f"# Seed {seed.seed}, case by case\n"]
    for grid in _grids(seed):
        cases = grid.cases
        others = [f for f in figures(cases) if f.lower is None and f.upper is None]
        parts += [f"## {grid.title}\n", "### Figures without an aim\n", _aims(others)]
        parts += ["### By stratum, repeats, noise and rig\n", _shares(cases)]
        parts += ["### Every case that is not right\n", _misses(cases)]
    return "\n".join(parts)


@dataclass(frozen=True)
class _Grid:
    """Cases of a seed, `count` when all are diagnosed, with labels as measured and as drawn."""

    title: str
    count: int
    cases: list[Scored]
    drawn: list[Scored]


def _grids(seed: Seed) -> list[_Grid]:
    grids = (("the check", REHEARSAL, CHECK), ("a rehearsal", 0, REHEARSAL))
    every = (
        _Grid(f"Seed {seed.seed}: {title}", count, seed.cases(n, n + count), seed.cases(n, n + count, drawn=True))
        for title, n, count in grids
    )
    return [grid for grid in every if grid.cases]


def _section(seed: Seed, grid: _Grid) -> str:
    cases, count = grid.cases, grid.count
    part = f"The first {len(cases)} of {count} cases," if len(cases) < count else f"{count} cases"
    rigs = len({c.label["rig"] for c in cases})
    lines = [
        f"## {grid.title}",
        "",
        f"{part} on {rigs} rigs, diagnosed by commit `{seed.told['commit'][:10]}`, grammar"
        f" {seed.told['grammar']}.",
        "",
        _aims([f for f in figures(cases) if f.lower is not None or f.upper is not None], figures(grid.drawn)),
        "### Effects in one regime only",
        "",
        _REGIMES,
        "",
        table(
            ["figure", "here", "cases", "LISDD"],
            [[n, number(v), str(k), f"{p:g}"] for n, v, k, p in regimes(cases)],
        ),
        "",
        "### What went wrong",
        "",
        f"Every case, and figures without an aim: `benchmarks/blind/published/{seed.seed}/{CASES}`.",
        "",
        _kinds_of_misses(cases),
    ]
    return "\n".join(lines)


def _kinds_of_misses(cases: Sequence[Scored]) -> str:
    misses: dict[str, list[str]] = {}
    for case in cases:
        if not case.right and not case.label["twin_of"]:
            misses.setdefault(case.miss, []).append(case.label["stratum"])
    rows = [
        [miss, str(len(strata)), ", ".join(f"{s} {n}" for s, n in sorted(Counter(strata).items()))]
        for miss, strata in sorted(misses.items(), key=lambda item: -len(item[1]))
    ]
    return table(["what", "cases", "by stratum"], rows) + "\n"


def number(value: float | None) -> str:
    """Return a figure as text."""
    if value is None:
        return ""
    return f"{value:.{3 if 0 < abs(value) < 0.01 else 2 if abs(value) < 10 else 0}f}"


def _aims(every: Sequence[Figure], drawn: Sequence[Figure] = ()) -> str:
    def bounds(pair: tuple[float, float] | None) -> str:
        return "" if pair is None else f"{pair[0]:.2f} to {pair[1]:.2f}"

    rows = []
    as_drawn = {f.name: f.value for f in drawn}
    for f in every:
        aim = f"{f.lower:g} to {f.upper:g}" if f.lower is not None and f.upper is not None else ""
        aim = aim or (f"≥ {f.lower:g}" if f.lower is not None else f"≤ {f.upper:g}" if f.upper is not None else "")
        met = {True: "yes", False: "no", None: ""}[f.met]
        intervals = [bounds(f.interval), bounds(f.new_rig)]
        before = [number(as_drawn[f.name])] if drawn else []
        rows.append([f.name, aim, number(f.value), *intervals, str(f.cases), str(f.rigs or ""), met, *before])
    columns = ["figure", "aim", "value", "90 %", "a new rig", "cases", "rigs", "met"]
    return table([*columns, *(["as drawn"] if drawn else [])], rows) + "\n"


def _shares(cases: Sequence[Scored]) -> str:
    rows = []
    for title in ("stratum", "repeats", "noise", "timing", "moving", "closed", "style", "kind", "loud"):
        groups: dict[str, list[Scored]] = {}
        for case in cases:
            value = case.label[title]
            groups.setdefault(str(bool(value) if title == "closed" else value), []).append(case)
        for name, group in sorted(groups.items()):
            right = share("", group, lambda c: c.right)
            kinds = Counter(case.kind for case in group)
            seconds = [c.record["seconds"] for c in group if "seconds" in c.record]
            rows.append(
                [
                    title, name, str(len(group)), number(right.value),
                    ", ".join(f"{k} {n}" for k, n in sorted(kinds.items())),
                    f"{np.median(seconds):.0f}" if seconds else "",
                ]
            )  # fmt: skip
    return table(["by", "which", "cases", "right", "verdicts", "seconds"], rows) + "\n"


def _misses(cases: Sequence[Scored]) -> str:
    rows = []
    for case in cases:
        label = case.label
        if case.right or label["twin_of"]:
            continue
        how = [
            f"{label['repeats']} runs",
            label["noise"],
            *([label["timing"]] if label["timing"] != "held" else []),
        ]
        how += [word for word in ("moving", "closed") if label[word]]
        rows.append(
            [
                label["case"], label["kind"] + ", " + label["style"],
                f"{label['stratum']}: {' and '.join(label['effects']) or 'none'}",
                number(label["gap"]), number(label["background"]), ", ".join(how),
                in_words(case.answer) if case.answer else "none", case.reason,
            ]
        )  # fmt: skip
    return table(["case", "rig", "truth", "gap", "background", "logs", "verdict", "reason"], rows) + "\n"
