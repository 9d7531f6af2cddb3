"""The page about a blind check, `docs/blind.md`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from benchmarks.blind.baselines import BASELINES
from benchmarks.blind.blind_score import (
    FLOOR,
    LARGE,
    Figure,
    Outcome,
    Scored,
    baseline_figures,
    confusion,
    figures,
    power_curve,
    verdict_figures,
)
from benchmarks.sealed import verdict_in_words

_INTRODUCTION = """\
# The blind check

How often a diagnosis is right, on actuators whose effects it is not told. It makes its catalogue from the plain
models. The virtual rig shares no model code with the FMUs and has other laws for the same effects.

    {command}

made this page: {answered} of {made} cases answered, of a grid of {count} (seed {seed}).

SHA-256 of `labels.json`, written before the first diagnosis and found the same after the last:
`{digest}`. The diagnoses are made by a process of its own that is told the folder of the campaigns; the folder of
the labels and the seed are neither among its arguments nor in its environment, and while it runs the labels'
folder has mode 000. {closed}

A case is *sizeable* if the gap in the rig's own signals, after the nominal refit, is at least {floor:g} noise
floors (gaps are set to within 5 %), *large* from {large:g}. Intervals hold 90 %.
"""
CLOSED = {
    True: "A process with the same rights was tried first and could not open it (of a superuser's, the right to "
    "pass over file modes is taken away).",
    False: "The user who made it can open it all the same: here the path alone is withheld.",
}
_NOTES = f"""\
- Top-1 and top-2: the true effect's place among the probabilities of all effects, *none* and *unknown*.
- A class is what the verdict names: one or more effects, or those it cannot tell apart.
- Effects have the rig's names here. Laws of the made catalogue that are the same in physics count as one: friction
  of the rotor against the stator and at the Wave Generator, or an offset of the current and friction that depends
  on the direction. The table `_SAME` of `benchmarks/blind/made.py` has them all.
- *Outside* is what the first, written catalogue of 18 effects lacked. *Unknown* is right there, and so is the
  effect's own law where the made catalogue has it: windage, a rub of the rotor, crosstalk, a brush at the load,
  ripples of other orders. Any other name is wrong.
- Right port: sizeable cases with one effect, less those whose verdict names effects at several ports that it
  cannot tell apart.
- Held-out closure: on runs at other speeds, loads and inputs, beyond the nominal refit; verdicts that are exactly
  right and gaps of at least {LARGE:g} floors. The interval is the one that the diagnosis promised.
- Calibration error (of the verdict, which is right if one of the answers that it leaves open is true) and Brier
  score (of all probabilities)
  are over all cases, also those whose gap is below the floor.
- Suggested experiment: made on the case's own actuator and added to its campaign; settled if the second diagnosis
  names the one true effect.
"""


def page(outcome: Outcome, command: str, notes: str = "") -> str:
    """Return the Markdown page; `notes` is what a person has to say to the figures, sections of Markdown."""
    cases = outcome.cases
    introduction = _INTRODUCTION.format(
        command=command,
        answered=len(cases),
        made=outcome.made,
        count=outcome.count,
        seed=outcome.seed,
        digest=outcome.digest,
        closed=CLOSED[outcome.closed],
        floor=FLOOR,
        large=LARGE,
    )
    parts = [introduction, aims(figures(cases, outcome.ports)), _NOTES, *([notes] if notes else [])]
    parts += [_baselines(cases), _power(cases)]
    return "\n".join([*parts, _confusion(cases), _failures(cases)])


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def number(value: float | None) -> str:
    """Return a figure with two decimals."""
    return "not measured" if value is None else f"{value:.2f}"


def aims(found: Sequence[Figure], *, verdicts: bool = False) -> str:
    """Return the table of figures; with `verdicts`, whether each aim is met stands in place of by how much not."""
    rows = []
    for f in found:
        bounds = [f"≥ {f.lower:g}" if f.lower is not None else "", f"≤ {f.upper:g}" if f.upper is not None else ""]
        interval = "" if f.interval is None else "{:.2f} … {:.2f}".format(*f.interval)
        missed = "" if f.value is None else f"by {f.missed_by:.2f}" if f.missed_by > 0.0 else "no"
        aim = ", ".join(b for b in bounds if b)
        met = {True: "yes", False: "no", None: ""}[f.met]
        rows.append([f.name, aim, number(f.value), interval, str(f.count), met if verdicts else missed])
    return table(("figure", "aim", "measured", "interval", "cases", "met" if verdicts else "missed"), rows)


def _baselines(cases: Sequence[Scored]) -> str:
    ours = verdict_figures(cases, lambda c: c.named)
    columns = [ours, *(baseline_figures(cases, name) for name in BASELINES)]
    rows = [
        [f"{ours[k].name} ({ours[k].count})", *(number(column[k].value) for column in columns)]
        for k in range(len(ours))
    ]
    return (
        "## Beside simpler methods\n\n"
        "Shares of (so many) sizeable cases, with the same refits: of the best-scored effects only, which\n"
        "flatters the baselines. *Named* is what the verdict names, also if it is ambiguous.\n\n"
    ) + table(("share", "fmuid", *BASELINES.values()), rows)


def _power(cases: Sequence[Scored]) -> str:
    rows = []
    for title, chosen in (
        ("all", cases),
        ("load encoder", [c for c in cases if c.label["load_encoder"]]),
        ("no load encoder", [c for c in cases if not c.label["load_encoder"]]),
        ("6 repeats", [c for c in cases if c.label["repeats"] >= 5]),
        ("3 repeats", [c for c in cases if c.label["repeats"] < 5]),
    ):
        for p in power_curve(chosen):
            gap = f"{p.low:g} … {p.high:g}"
            rows.append([title, gap, str(p.count), *(f"{x:.2f}" for x in (p.detected, p.named, p.right))])
    head = ("cases", "gap in floors", "number", "gap seen", "true effect named", "named alone")
    return "## Power\n\nCases with one effect of the catalogue.\n\n" + table(head, rows)


def _confusion(cases: Sequence[Scored]) -> str:
    rows = [
        [truth, ", ".join(f"{verdict}: {n}" for verdict, n in given.most_common())]
        for truth, given in confusion(cases).items()
    ]
    return "## Truth and verdicts\n\n" + table(("truth", "verdicts and how often"), rows)


def _failures(cases: Sequence[Scored]) -> str:
    rows = []
    for case in cases:
        if not case.right:
            label, probability = case.label, dict(case.ranked)
            encoder = "yes" if label["load_encoder"] else "no"
            rows.append(
                [
                    str(label["case"]),
                    " and ".join(label["effects"]) or "none",
                    " and ".join(f"{g:.2f}" for g in label["gaps"]) or "0",
                    f"{label['noise']}, {label['repeats']} runs, {encoder}",
                    verdict_in_words(case.answer),
                    f"{max(probability.get(name, 0.0) for name in case.truth):.2f}",
                    f"{case.answer['gap']['nominal_refit']:.2f} → {case.answer['gap']['corrected']:.2f}",
                    "" if case.closure is None else f"{case.closure:.2f}",
                ]
            )
    what = ("case", "truth", "gaps", "noise, repeats, load encoder")
    head = (*what, "verdict", "probability of the truth", "gap found", "held-out closure")
    return "## Every case that is not exactly right\n\n" + table(head, rows)
