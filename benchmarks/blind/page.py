"""The page about the blind check, `docs/blind.md`, from what is published of every seed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.blind.plants.cases import CHECK, REHEARSAL
from benchmarks.blind.score import Figure, Scored, as_measured, figures, in_words, regimes, share
from benchmarks.timing import table

_INTRODUCTION = """\
# The blind check

How often a diagnosis is right on random rigs. A grammar draws networks of 2 to 8 components in one or two
domains, with parameters, inputs, sensors, rates and noise. Each has a plain Modelica model, half of them with
components and half as equations, and a plant by nodal assembly in C that shares nothing with the program. A plant
has parameters up to a fifth off, a background of three to six small effects, and what is asked for: nothing, one
or two effects in shapes that are not the catalogue's, a coefficient that varies, something that no catalogue has,
or an effect in one operating regime only. Six of ten logs are single runs; some start in motion, run in a closed
loop, have the timing of a PLC or columns that nothing uses; one file in twenty is damaged.

`fmuid init` and `fmuid diagnose` get logs and model as from a user. Every seed is used once and then published
whole, in `benchmarks/blind/published/<seed>/`: commit, labels, answers, SHA-256 of every log. Labels of the first
{rehearsal} cases (or as many as `seed.json` says) may be read while rules change; the next {check} are the check.

    make blind SEED=...  # draw and diagnose
    make blind-verify    # recompute this page from what is committed, and logs and labels from their seeds

Before any diagnosis, 50 random rigs were compared with their models: `make blind-agreement` (largest difference
0.001 standard deviations of the noise).

A gap is in noise floors of a sample after refits of all parameters to the end (`measured.jsonl`; quick ones draw
the sizes). An effect that leaves less than a floor is background. Effects that a case's runs cannot tell
apart (less than 3 standard deviations over all runs, by the plant) count as one, coefficients that vary included;
a drag is a damper that grows with speed. A model whose gap is below its tolerance, one floor, is complete. The
background's effects may be named, and what the runs cannot tell from one of them that is visible itself. An answer
that is one model under several names counts by any of them. Intervals hold 90 %; cases cluster by rig, and the
intervals allow for it. The interval for a new rig is where the share of a rig that is not among these lies.
[Earlier checks](history.md) were on rigs that did not stay unseen.
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
    in_the_way: str

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
        by_case = [{one["case"]: one for one in every} for every in (records, measured)]
        causes = "".join(why.read_text() for why in file.parent.glob("in_the_way.md"))  # written by hand, later
        seeds.append(Seed(told["seed"], told, labels, *by_case, causes))
    return seeds


def page(seeds: Sequence[Seed]) -> str:
    """Return the Markdown page about published seeds."""
    *earlier, newest = [grid for seed in seeds for grid in _grids(seed)]
    introduction = _INTRODUCTION.format(rehearsal=REHEARSAL, check=CHECK)
    return "\n".join([introduction, _section(newest, earlier), "Next: [how good it is](quality.md).\n"])


def case_by_case(seed: Seed) -> str:
    """Return the Markdown page of a seed with every group of cases and every case that is not right."""
    parts = [f"# Seed {seed.seed}, case by case\n"]
    for grid in _grids(seed):
        cases = grid.cases
        aimed, others = _with_aims(figures(cases))
        drawn = seed.cases(grid.first, grid.first + grid.count, drawn=True)
        parts += [f"## {grid.title}\n", grid.told.capitalize() + "\n", _aims(aimed, {"as drawn": figures(drawn)})]
        parts += ["### Figures without an aim\n", _aims(others)]
        parts += ["### By stratum, repeats, noise and rig\n", _shares(cases)]
        parts += ["### Every case that is not right\n", _misses(cases)]
    return "\n".join(parts)


@dataclass(frozen=True)
class _Grid:
    """Cases of a seed from `first` on, `count` when all are diagnosed."""

    seed: Seed
    title: str
    first: int
    count: int
    cases: list[Scored]

    @property
    def rigs(self) -> int:
        return len({c.label["rig"] for c in self.cases})

    @property
    def told(self) -> str:
        """What was diagnosed, by which commit."""
        many, told = len(self.cases), self.seed.told
        part = f"the first {many} of {self.count} cases" if many < self.count else f"{many} cases"
        by = f"diagnosed by commit `{told['commit'][:10]}`, grammar {told['grammar']}."
        return f"{part}, on {self.rigs} rigs, {by}"


def _grids(seed: Seed) -> list[_Grid]:
    read = seed.told.get("rehearsal", REHEARSAL)
    groups = ("a rehearsal", 0, read), ("the check", read, CHECK)
    every = [(title, first, count, seed.cases(first, first + count)) for title, first, count in groups]
    return [_Grid(seed, f"Seed {seed.seed}: {title}", *rest) for title, *rest in every if rest[-1]]


def _with_aims(every: Sequence[Figure]) -> tuple[list[Figure], list[Figure]]:
    """Return the figures that have an aim, and the others."""
    aimed = [f for f in every if (f.lower, f.upper) != (None, None)]
    return aimed, [f for f in every if f not in aimed]


def _section(grid: _Grid, earlier: Sequence[_Grid]) -> str:
    cases, every, earlier = grid.cases, [*earlier, grid], earlier[-4:]  # a table is no wider than a page
    lines = [
        f"## {grid.title}",
        "",
        grid.told.capitalize(),
        *(f"For comparison, seed {one.seed.seed}: {len(one.cases)} cases on {one.rigs} rigs." for one in earlier),
        f"Together, these are {sum(len(g.cases) for g in every)} cases on {sum(g.rigs for g in every)} rigs.",
        "",
        _aims(_with_aims(figures(cases))[0], {f"seed {one.seed.seed}": figures(one.cases) for one in earlier}),
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
        grid.seed.in_the_way,
        f"Every case, and figures without an aim: `benchmarks/blind/published/<seed>/{CASES}`.",
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


def _aims(every: Sequence[Figure], beside: Mapping[str, Sequence[Figure]] | None = None) -> str:
    def bounds(pair: tuple[float, float] | None) -> str:
        return "" if pair is None else f"{pair[0]:.2f} to {pair[1]:.2f}"

    rows = []
    others = {title: {f.name: f.value for f in of_it} for title, of_it in (beside or {}).items()}
    for f in every:
        aim = f"{f.lower:g} to {f.upper:g}" if f.lower is not None and f.upper is not None else ""
        aim = aim or (f"≥ {f.lower:g}" if f.lower is not None else f"≤ {f.upper:g}" if f.upper is not None else "")
        met = {True: "yes", False: "no", None: ""}[f.met]
        intervals = [bounds(f.interval), bounds(f.new_rig)]
        compared = [number(of_it.get(f.name)) for of_it in others.values()]
        rows.append([f.name, aim, number(f.value), *intervals, str(f.cases), str(f.rigs or ""), met, *compared])
    return table(["figure", "aim", "value", "90 %", "a new rig", "cases", "rigs", "met", *others], rows) + "\n"


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
