"""The page about a check abroad, `docs/blind_abroad.md`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.abroad.score import Abroad, by, figures, good, resolution, same_verdict, sizeable
from benchmarks.blind.blind_page import CLOSED, aims, number, table
from benchmarks.blind.blind_score import Scored, power_curve
from benchmarks.sealed import verdict_in_words

_INTRODUCTION = """\
# The blind check abroad

How often a diagnosis is right on eight rigs other than actuators. They are not unseen: labels of earlier grids
were read, and rules came from them. Each rig has a plain Modelica model; its plant
is independent code in C, with parameters up to a fifth off, and with none, one or two effects, with something
that no catalogue has, or with a held parameter that is wrong. The diagnosis gets logs and the plain model, as
`fmuid init` and `fmuid diagnose` get them from a user; no file is edited in between.

    {command}

made this page: {answered} of {made} cases answered, the first ones of a grid of {planned}. Cases come in an
order in which the first so many are a fair sample: by stratum, rig, effect, repeats, noise and rate.

Seed and code decide every case. Before the first diagnosis these were committed: {frozen}
SHA-256 of `labels.json`, written before the first diagnosis of these cases and found the same after the last:
`{digest}`. The diagnoses are made by a process of its own, while the labels' folder has mode 000. {closed}

A gap is in noise floors of a sample, after a refit of the free parameters, without the run that is kept for
validation; of coloured or drifting noise, only what the samples before do not tell counts. An effect is *sizeable*
from {floor:g} on; one of two also if it leaves as much where the model has the other one. Effects that the sensors
cannot tell apart count as one:
by physics (a weight and an offset of the motor's current, say), or because in this case's recordings they would
differ by less than 3 standard deviations; the plant says so before the diagnosis. Intervals hold 90 % (Wilson).
An aim is met if the figure meets it and the worse end of its interval is within 0.03 of it.
"""
_NOTES = """\
- *Wrong* is an effect named that the plant does not have: in what the verdict names outright, or in each of the
  sets of which it says that one is needed.
- *Noise bounded* are single runs with white or quantised noise.
- *Port class right*: of those called unknown, the place is among those that the verdict names.
- *Held-out closure*: on the run that the diagnosis did not see, of verdicts that are exactly right. Runs that
  show no gap are left out.
- *Calibration error*: of the likeliest answer's probability, by ten bins of as many cases, less what sampling adds
  to it. Cases with an effect that is not sizeable are left out, because more than one answer to them is right.
- *Brier score of all answers*: the sum over a case's answers of the squared difference between the probability and
  1 or 0, on average. The constant guess has the true shares of every cause on each rig. The next line is for one
  answer a case, the likeliest: its probability against always the share of cases in which it is right.
- *Same information*: pairs of recordings of one plant at two rates with the same spectral density of the noise,
  in other units, or with a model that has an idle part more. All pairs count; none is left out for being near a
  threshold.
"""


def page(outcome: Abroad, command: str, notes: str = "") -> str:
    """Return the Markdown page; `notes` is what a person has to say to the figures, sections of Markdown."""
    introduction = _INTRODUCTION.format(
        command=command,
        answered=len(outcome.cases) + len(outcome.pairs),
        made=outcome.made,
        planned=outcome.planned,
        digest=outcome.digest,
        frozen=", ".join(f"{what} `{value}`" for what, value in outcome.rules.items()) + ".",
        closed=CLOSED[outcome.closed],
        floor=0.95,
    )
    parts = [introduction, aims(figures(outcome), verdicts=True), _NOTES, *([notes] if notes else [])]
    parts += [
        _shares(outcome.cases),
        _power(outcome.cases),
        _resolution([c for c in outcome.cases if sizeable(c)]),
    ]
    return "\n".join([*parts, _pairs(outcome), _failures(outcome.cases)])


def _shares(cases: Sequence[Scored]) -> str:
    rows = []
    for title, groups in (
        ("rig", by(cases, lambda c: str(c.label["rig"]))),
        ("stratum", by(cases, lambda c: str(c.label["kind"]))),
        ("noise", by(cases, lambda c: str(c.label["noise"]))),
        ("repeats", by(cases, lambda c: str(c.label["repeats"]))),
    ):
        for name, own in groups.items():
            seconds = float(np.median([c.answer["seconds"] for c in own]))
            kinds = by(own, lambda c: c.kind)
            said = ", ".join(f"{kind} {len(found)}" for kind, found in kinds.items())
            rows.append(
                [
                    title,
                    name,
                    str(len(own)),
                    number(float(np.mean([good(c) for c in own]))),
                    said,
                    f"{seconds:.0f}",
                ]
            )
    head = ("by", "which", "cases", "right", "verdicts", "seconds")
    return (
        "## By rig, stratum, noise and repeats\n\n"
        "Strata: *held* is a wrong held parameter, right also within a class. Seconds are the median of\n"
        "processor time, building the model's variants included.\n\n"
    ) + table(head, rows)


def _power(cases: Sequence[Scored]) -> str:
    rows = [
        [f"{p.low:g} … {p.high:g}", str(p.count), *(f"{x:.2f}" for x in (p.detected, p.named, p.right))]
        for p in power_curve(cases, (0.0, 0.95, 1.7, 3.0, 5.0, np.inf))
    ]
    head = ("gap in floors", "number", "gap seen", "true effect named", "named alone")
    return "## Power\n\nCases with one effect of the catalogue.\n\n" + table(head, rows)


def _resolution(cases: Sequence[Scored]) -> str:
    rows = [[f"{p:.2f}", f"{hit:.2f}", str(n)] for p, hit, n in resolution(cases)]
    text = "Likeliest answers by their probability, in five groups of as many cases.\n\n"
    return "## Calibration with resolution\n\n" + text + table(("mean probability", "share right", "cases"), rows)


def _pairs(outcome: Abroad) -> str:
    rows = [
        [
            f"{a.label['case']}, {b.label['case']}", str(b.label["rig"]), str(b.label["twin"]),
            verdict_in_words(a.answer), verdict_in_words(b.answer), "yes" if same_verdict(a, b) else "no",
        ]
        for a, b in outcome.pairs
    ]  # fmt: skip
    head = ("cases", "rig", "what differs", "verdict", "verdict of the twin", "same")
    return "## The same information in another way\n\n" + table(head, rows)


def _failures(cases: Sequence[Scored]) -> str:
    rows = []
    for case in cases:
        if not good(case):
            label, probabilities = case.label, dict(case.ranked)
            how = f"{label['noise']}, {label['repeats']} runs" + (", sigma given" if label["sigma"] else "")
            gap = case.answer["gap"]
            rows.append(
                [
                    str(label["case"]),
                    str(label["rig"]),
                    " and ".join(label["effects"]) or "none",
                    " and ".join(f"{g:.2f}" for g in label["gaps"]) or "0",
                    how,
                    verdict_in_words(case.answer),
                    f"{max(probabilities.get(name, 0.0) for name in case.truth):.2f}",
                    f"{gap['nominal_refit']:.2f} → {gap['corrected']:.2f}",
                ]
            )
    what = ("case", "rig", "truth", "gaps", "noise and repeats")
    head = (*what, "verdict", "probability of the truth", "gap found")
    return "## Every case that is not right\n\n" + table(head, rows)
