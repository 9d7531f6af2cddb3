"""The score of the check abroad: answers held against labels, figure by figure of its table of aims.

Effects that a case's recordings cannot tell apart count as one. *Sizeable* is a gap of a floor or more
(0.95: gaps are set to 5 %).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.blind.blind_score import FLOOR, LARGE, Figure, Scored, share
from benchmarks.blind.renamed import renamed

_KNOWN = ("one", "two", "held")
_BINS = 10  # of the probability, each with as many cases


@dataclass(frozen=True, slots=True)
class Abroad:
    """The outcome of a check abroad.

    Attributes
    ----------
    cases
        Those that have an answer and are no twins, of `made`.
    pairs
        Twins, each with the case that it is a twin of.
    digest, rules
        SHA-256 of the labels, and lines on what was frozen with them.
    planned
        Cases of the whole grid, twins among them.
    closed
        Whether the labels could not be opened while the diagnosis ran.
    """

    cases: tuple[Scored, ...]
    pairs: tuple[tuple[Scored, Scored], ...]
    made: int
    planned: int
    digest: str
    rules: Mapping[str, str]
    closed: bool


def scored(label: Mapping[str, Any], answer: Mapping[str, Any], closure: float | None = None) -> Scored:
    """Return a case to be scored, with the names of equals in its answer replaced by those of its label.

    A held parameter that the campaign frees is no effect: its model is complete.
    """
    if label["kind"] == "held" and label["effects"][0].partition("@")[2] in answer["free"]:
        label = {**label, "kind": "none", "effects": [], "gaps": [], "gap": 0.0}
    name = {other: effect for effect, others in label["same"].items() for other in others}
    return Scored(label, renamed(answer, name), closure)


def sets(case: Scored) -> list[set[str]]:
    """Return the sets of effects that the verdict leaves open."""
    verdict = case.answer["verdict"]
    return [{*verdict["effects"], *names} for names in verdict["one_of"] or [[]]]


def wrong(case: Scored) -> bool:
    """Return whether an effect is named that is not there: in the verdict, or in all of what one is needed of."""
    return all(s - case.truth for s in sets(case))


def in_class(case: Scored) -> bool:
    """Return whether the truth is one of the sets that the verdict leaves open."""
    return bool(case.named) and set(case.truth) in sets(case)


def figures(outcome: Abroad) -> tuple[Figure, ...]:
    """Return every figure of the table of aims."""
    cases = outcome.cases
    repeated, single = ([c for c in cases if (c.label["repeats"] > 1) is many] for many in (True, False))
    known = [c for c in repeated if c.label["kind"] in _KNOWN and _gap(c) >= FLOOR]
    one, held = ([c for c in known if c.label["kind"] == kind] for kind in ("one", "held"))
    two = [c for c in known if c.label["kind"] == "two" and sizeable(c)]
    outside = [c for c in repeated if c.label["kind"] == "outside" and _gap(c) >= FLOOR]
    large = [c for c in single if c.label["kind"] != "none" and _gap(c) >= LARGE]
    bounded = [c for c in single if c.label["sigma"] or c.label["noise"] in ("white", "quantised")]
    ambiguous = [len(sets(c)) for c in cases if c.kind == "ambiguous"]
    closed = np.array([c.closure for c in cases if c.right and c.closure is not None and _gap(c) >= LARGE])
    covered, widths = _intervals([c for c in cases if c.right and c.closure is not None])
    clear = [c for c in cases if sizeable(c)]
    error, ratio = calibration(clear)
    return (
        share("false alarm on complete models, R ≥ 2", [c.alarmed for c in _of(repeated, "none")], upper=0.03),
        share(
            "R = 1, effect of 3 floors or more called complete", [c.kind == "complete" for c in large], upper=0.05
        ),
        share("exactly right, one effect, R ≥ 2", [c.right for c in one], lower=0.92),
        share("a wrong effect named", [wrong(c) for c in cases], upper=0.02),
        share(
            "known effect called unknown or insufficient, R ≥ 2",
            [c.kind in ("unknown", "insufficient") for c in known],
            upper=0.05,
        ),
        Figure("mean number of answers where ambiguous", _mean(ambiguous), len(ambiguous), upper=2.5),
        share(
            "insufficient or ambiguous, R ≥ 2",
            [c.kind in ("insufficient", "ambiguous") for c in repeated],
            upper=0.1,
        ),
        share(
            "R = 1, noise bounded: complete called complete",
            [c.kind == "complete" for c in _of(bounded, "none")],
            lower=0.85,
        ),
        _power_ratio(bounded, [c for c in cases if c.label["repeats"] == 3]),
        share("unknown called unknown, R ≥ 2", [c.kind == "unknown" for c in outside], lower=0.9),
        share("its port class right", [_placed(c) for c in outside if c.kind == "unknown"], lower=0.8),
        share("two effects: both, R ≥ 2", [any(c.truth <= s for s in sets(c)) for c in two], lower=0.85),
        share("wrong held parameter named, R ≥ 2", [in_class(c) for c in held], lower=0.85),
        Figure("held-out closure of right answers, median", _quantile(closed, 0.5), len(closed), lower=0.9),
        Figure(
            "held-out closure of right answers, 10th percentile", _quantile(closed, 0.1), len(closed), lower=0.7
        ),
        _covers(covered),
        Figure("median width of the closure interval", _quantile(widths, 0.5), len(widths), upper=0.3),
        Figure("calibration error of the likeliest answer", error, len(clear), upper=0.03),
        Figure("Brier score of all answers against a constant guess", brier(clear), len(clear), upper=0.5),
        Figure("the same of the likeliest answer, right or wrong", ratio, len(clear)),
        share("same information, same verdict", [same_verdict(a, b) for a, b in outcome.pairs], lower=0.98),
    )


def sizeable(case: Scored) -> bool:
    """Return whether every effect of the plant is sizeable; where one is not, more than one answer is right.

    The second of two effects also has to leave a gap where the first one is refitted without it.
    """
    return all(gap >= FLOOR for gap in (*case.label["gaps"], *case.label.get("beside", ())))


def likeliest(case: Scored) -> tuple[float, bool]:
    """Return the probability of the likeliest answer, and whether it is true; of a *partial* one, a part of it."""
    best = max(case.answer["answers"], key=lambda a: float(a["probability"]))
    own = frozenset(best["effects"])
    part = case.kind == "partial" and own == case.named
    return float(best["probability"]), own <= case.truth if part else own == case.truth


def calibration(cases: Sequence[Scored]) -> tuple[float | None, float | None]:
    """Return the calibration error of the likeliest answer and its Brier score, over that of a constant guess.

    The error is the root of the mean squared difference of share and probability over bins of as many cases each,
    less what sampling adds to it (Kumar, Liang, Ma: Verified uncertainty calibration. NeurIPS 2019). None where
    every answer or none is right.
    """
    if len(cases) < 2 * _BINS:
        return None, None
    sure, hits = np.array([likeliest(c) for c in cases], dtype=float).T
    squared = 0.0
    for chosen in np.array_split(np.argsort(sure, kind="stable"), _BINS):
        share_, n = hits[chosen].mean(), len(chosen)
        squared += n / len(cases) * ((share_ - sure[chosen].mean()) ** 2 - share_ * (1 - share_) / (n - 1))
    constant = float(hits.mean() * (1 - hits.mean()))
    ratio = float(np.mean((sure - hits) ** 2)) / constant if constant else None
    return float(np.sqrt(max(squared, 0.0))), ratio


def brier(cases: Sequence[Scored]) -> float | None:
    """Return the Brier score of the probabilities of all answers, over that of a constant guess.

    The score of a case is the sum over its answers of (probability - 1 if it is true, else 0)^2 (Brier:
    Verification of forecasts expressed in terms of probability. Monthly Weather Review 78, 1950). The constant
    guess knows how often everything is true on each rig. None without cases, or where it is always right.
    """
    scores, guessed = [], []
    for own in by(cases, lambda case: str(case.label["rig"])).values():
        shares = np.array(list(Counter(case.truth for case in own).values())) / len(own)
        guessed += [1.0 - float(shares @ shares)] * len(own)
        for case in own:
            said = {frozenset(a["effects"]): float(a["probability"]) for a in case.answer["answers"]}
            said.setdefault(case.truth, 0.0)
            scores.append(sum((p - (answer == case.truth)) ** 2 for answer, p in said.items()))
    return float(np.mean(scores) / np.mean(guessed)) if any(guessed) else None


def resolution(cases: Sequence[Scored]) -> list[tuple[float, float, int]]:
    """Return mean probability, share right and number of cases, by bins of as many cases each."""
    order = sorted(map(likeliest, cases))
    bins = [order[k * len(order) // 5 : (k + 1) * len(order) // 5] for k in range(5)]
    return [(*map(float, np.mean(b, axis=0)), len(b)) for b in bins if b]


def same_verdict(a: Scored, b: Scored) -> bool:
    """Return whether two verdicts name the same."""
    return a.kind == b.kind and {frozenset(s) for s in sets(a)} == {frozenset(s) for s in sets(b)}


def good(case: Scored) -> bool:
    """Return whether the verdict is right; of a wrong held parameter also within a class."""
    return case.right or (case.label["kind"] == "held" and in_class(case))


def by(cases: Sequence[Scored], key: Callable[[Scored], str]) -> dict[str, list[Scored]]:
    """Return the cases by a property, sorted."""
    found: dict[str, list[Scored]] = {}
    for case in cases:
        found.setdefault(key(case), []).append(case)
    return dict(sorted(found.items()))


def _of(cases: Sequence[Scored], kind: str) -> list[Scored]:
    return [c for c in cases if c.label["kind"] == kind]


def _gap(case: Scored) -> float:
    return float(case.label["gap"])


def _placed(case: Scored) -> bool:
    """Return whether the place is among the verdict's, or one that cannot be told from it."""
    effect = case.label["effects"][0]
    places = {effect.partition("@")[2], *(s.partition("@")[2] for s in case.label["same"].get(effect, ()))}
    return bool(places & set(case.answer["verdict"]["ports"]))


def _power_ratio(single: Sequence[Scored], thrice: Sequence[Scored]) -> Figure:
    name, shares = "R = 1, noise bounded: power over that with R = 3", []
    for group in (single, thrice):
        own = [c for c in _of(group, "one") if _gap(c) >= FLOOR]
        shares.append(_mean([c.truth <= c.named for c in own]))
    if shares[0] is None or not shares[1]:
        return Figure(name, None, 0, lower=0.8)
    return Figure(name, shares[0] / shares[1], len(_of(single, "one")), lower=0.8)


def _covers(covered: Sequence[bool]) -> Figure:
    """Return the coverage; its aim is that 0.9 is within its interval."""
    found = share("90 % closure interval covers", covered)
    if found.interval is None:
        return found
    inside = found.interval[0] <= 0.9 <= found.interval[1]
    bounds = (None, None) if inside else (0.9, None) if found.interval[1] < 0.9 else (None, 0.9)
    return Figure(found.name, found.value, found.count, *bounds, found.interval)


def _intervals(cases: Sequence[Scored]) -> tuple[list[bool], np.ndarray[Any, Any]]:
    covered, widths = [], []
    for case in cases:
        entry = next((a["closure"] for a in case.answer["answers"] if a.get("closure")), None)
        if entry is not None and case.closure is not None:
            low, high = entry["interval"]
            covered.append(bool(low <= case.closure <= high))
            widths.append(high - low)
    return covered, np.array(widths)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _quantile(values: np.ndarray[Any, Any], q: float) -> float | None:
    return float(np.quantile(values, q)) if values.size else None
