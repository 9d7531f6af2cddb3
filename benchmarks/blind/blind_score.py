"""The score of the blind check: answers held against labels, figure by figure of the aims table.

A *sizeable* case leaves a gap of at least the floor after the nominal refit (0.95: gaps are set to 5 %). The rank
of an effect is its place among the probabilities of all effects, ``none`` and ``unknown``.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from fmuid.diagnosis.summary import named, probability

FLOOR = 0.95
LARGE = 3 * FLOOR
_NO_EFFECT = (["none"], ["unknown"])
_NEAR = 0.03  # of an aim: how far an interval may reach beyond it
_BINS = 10  # of the probability, for the calibration error


@dataclass(frozen=True, slots=True)
class Scored:
    """One case: what it is, what was answered, and what came of the answer.

    Attributes
    ----------
    label, answer
        JSON values of the generator's label and of the diagnosis.
    closure
        Share of the gap on the held-out runs that the answer's model closes beyond the nominal refit; None where
        the answer names no effect.
    second
        The answer after the suggested experiment was made; None where none was suggested or made.
    """

    label: Mapping[str, Any]
    answer: Mapping[str, Any]
    closure: float | None = None
    second: Mapping[str, Any] | None = None

    @property
    def truth(self) -> frozenset[str]:
        """Names that are right at the head of the probabilities."""
        kind = str(self.label["kind"])
        return frozenset({"none": ["none"], "outside": ["unknown"]}.get(kind, self.label["effects"]))

    @property
    def kind(self) -> str:
        """Kind of the verdict."""
        return str(self.answer["verdict"]["kind"])

    @property
    def named(self) -> frozenset[str]:
        """Effects that the verdict names: all present, or, if ambiguous, some of them."""
        return frozenset(named(self.answer["verdict"]))

    @property
    def ranked(self) -> list[tuple[str, float]]:
        """Probabilities, the largest first."""
        pairs = [(str(e["id"]), float(e["probability"])) for e in self.answer["effects"]]
        pairs += [
            ("".join(a["effects"]), a["probability"]) for a in self.answer["answers"] if a["effects"] in _NO_EFFECT
        ]
        return sorted(pairs, key=lambda pair: -pair[1])

    @property
    def right(self) -> bool:
        """Whether the verdict is the truth and nothing else."""
        truth = {"none": "complete", "outside": "unknown"}.get(str(self.label["kind"]), "effect")
        return self.kind == truth and (truth != "effect" or self.named == self.truth)

    @property
    def holds(self) -> bool:
        """Whether one of the answers that the verdict leaves open is the truth, or a part of it is named."""
        verdict = self.answer["verdict"]
        if self.kind in ("complete", "unknown", "insufficient"):
            return self.truth == {"unknown" if self.kind == "unknown" else "none"}
        sets = [{*verdict["effects"], *names} for names in verdict["one_of"] or [[]]]
        return self.named <= self.truth if self.kind == "partial" else self.truth in sets

    @property
    def alarmed(self) -> bool:
        """Whether the verdict says that the model lacks something."""
        return self.kind not in ("complete", "insufficient")

    def top(self, count: int) -> bool:
        """Whether one of the `count` likeliest is true."""
        return bool(self.truth & {name for name, _ in self.ranked[:count]})


@dataclass(frozen=True, slots=True)
class Outcome:
    """A whole blind check.

    Attributes
    ----------
    cases
        Those that have an answer, of `made`.
    ports
        The catalogue's.
    count, seed
        The grid that the cases are from.
    digest
        SHA-256 of the labels, written before the first diagnosis.
    closed
        Whether the labels' folder could not be opened while the diagnosis ran.
    """

    cases: tuple[Scored, ...]
    ports: tuple[str, ...]
    made: int
    count: int
    seed: int
    digest: str
    closed: bool


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure, and what it is held against.

    Attributes
    ----------
    value
        None where no case bears on it.
    count
        Cases that do.
    interval
        90 % of its sampling distribution; None for what is no share of cases.
    lower, upper
        The aim.
    """

    name: str
    value: float | None
    count: int
    lower: float | None = None
    upper: float | None = None
    interval: tuple[float, float] | None = None

    @property
    def met(self) -> bool | None:
        """Whether the value is inside its aim, and the worse end of the interval no more than 0.03 outside.

        None without a value or an aim.
        """
        if self.value is None or (self.lower is None and self.upper is None):
            return None
        low, high = self.interval or (self.value, self.value)
        near = (self.lower is None or low >= self.lower - _NEAR) and (
            self.upper is None or high <= self.upper + _NEAR
        )
        return self.missed_by == 0.0 and near

    @property
    def missed_by(self) -> float:
        """How far the value is outside its aim; 0 inside or where there is no value."""
        if self.value is None:
            return 0.0
        below = 0.0 if self.lower is None else self.lower - self.value
        above = 0.0 if self.upper is None else self.value - self.upper
        return max(0.0, below, above)


def share(
    name: str, hits: Sequence[bool], *, lower: float | None = None, upper: float | None = None, level: float = 0.9
) -> Figure:
    """Return the share of hits with its interval (Wilson 1927)."""
    n, k = len(hits), sum(hits)
    if n == 0:
        return Figure(name, None, 0, lower, upper)
    z = float(norm.ppf(0.5 + level / 2))
    centre, half = (k + z**2 / 2) / (n + z**2), z / (n + z**2) * np.sqrt(k * (n - k) / n + z**2 / 4)
    return Figure(name, k / n, n, lower, upper, (max(float(centre - half), 0.0), min(float(centre + half), 1.0)))


def figures(cases: Sequence[Scored], ports: Sequence[str]) -> tuple[Figure, ...]:
    """Return every figure of the aims table.

    Parameters
    ----------
    ports
        The catalogue's: a truth at any other cannot be asked for.
    """
    of = _by_kind(cases)
    sizeable = [c for c in of["one"] if c.label["gap"] >= FLOOR]
    seen, unseen = ([c for c in sizeable if c.label["load_encoder"] is has] for has in (True, False))
    naming = [c for c in unseen if c.named]
    outside = [c for c in of["outside"] if c.label["gap"] >= FLOOR]
    two = [c for c in of["two"] if c.label["gap"] >= FLOOR]
    both = [c for c in two if min(c.label["gaps"]) >= FLOOR]
    known = [*sizeable, *two]
    placed = [
        c
        for c in (*sizeable, *outside)
        if c.label["ports"][0] in ports and not (c.kind == "ambiguous" and len(c.answer["verdict"]["ports"]) > 1)
    ]
    closed = [c for c in of["one"] + of["two"] if c.right and c.closure is not None]
    large = np.array([c.closure for c in closed if c.label["gap"] >= LARGE], dtype=float)
    covered = [_covered(c) for c in closed if c.label["gap"] >= FLOOR]
    asked = [c for c in cases if c.second is not None and c.label["kind"] == "one"]
    ece, brier = calibration(cases)
    return (
        share("false alarm on complete models", [c.alarmed for c in of["none"]], upper=0.05),
        share("top-1, load encoder", [c.top(1) for c in seen], lower=0.9),
        share("top-2, load encoder", [c.top(2) for c in seen], lower=0.97),
        share("top-1, no load encoder", [c.top(1) for c in unseen], lower=0.75),
        share("class coverage, no load encoder", [c.truth <= c.named for c in unseen], lower=0.95),
        Figure("mean class size, no load encoder", _mean([len(c.named) for c in naming]), len(naming), upper=2.0),
        share("unknown called unknown", [c.kind == "unknown" for c in outside], lower=0.85),
        share("known called unknown", [c.kind == "unknown" for c in known], upper=0.07),
        share("two effects: both", [c.truth <= c.named for c in both], lower=0.75),
        share("two effects: at least one", [bool(c.truth & c.named) for c in two], lower=0.97),
        share("right port", [c.answer["verdict"]["port"] in c.label["ports"] for c in placed], lower=0.95),
        Figure("held-out closure, median", _quantile(large, 0.5), len(large), lower=0.85),
        Figure("held-out closure, 10th percentile", _quantile(large, 0.1), len(large), lower=0.6),
        share("90 % closure interval covers", covered, lower=0.85, upper=0.95),
        Figure("calibration error (ECE)", ece, len(cases), upper=0.05),
        Figure("Brier score", brier, len(cases), upper=0.15),
        share("suggested experiment settles", [_settled(c) for c in asked], lower=0.8),
    )


def baseline_figures(cases: Sequence[Scored], name: str) -> tuple[Figure, ...]:
    """Return what a baseline of the same cases can be held against; `name` is its key in the answers."""
    return verdict_figures(cases, lambda c: frozenset(c.answer["baselines"][name]))


def verdict_figures(cases: Sequence[Scored], naming: Callable[[Scored], frozenset[str]]) -> tuple[Figure, ...]:
    """Return the figures that follow from the named effects alone (none: no alarm)."""
    of = _by_kind(cases)
    sizeable = [c for c in of["one"] if c.label["gap"] >= FLOOR]
    outside = [c for c in of["outside"] if c.label["gap"] >= FLOOR]
    both = [c for c in of["two"] if min(c.label["gaps"]) >= FLOOR]
    return (
        share("effect named in complete models", [bool(naming(c)) for c in of["none"]]),
        share("exactly the one effect", [naming(c) == c.truth for c in sizeable]),
        share("the one effect among the named", [c.truth <= naming(c) for c in sizeable]),
        share("both of two effects", [c.truth <= naming(c) for c in both]),
        share("effect named though outside the catalogue", [bool(naming(c)) for c in outside]),
    )


def calibration(cases: Sequence[Scored]) -> tuple[float | None, float | None]:
    """Return the expected calibration error of the verdict, and the Brier score over all names.

    Calibration error: mean over ten bins of probability of |share right - mean probability|, by cases in the bin
    (Naeini et al. 2015). A verdict is right if one of the answers that it leaves open is the truth; a partial one,
    if all that it names is there. Brier score: mean over cases
    of the squared difference of all probabilities from the truth (Brier 1950).
    """
    if not cases:
        return None, None
    sure, hits = [], []
    for case in cases:
        sure.append(probability(case.answer))
        hits.append(case.holds)
    head_p, hit = np.array(sure), np.array(hits, dtype=float)
    bins = np.minimum((head_p * _BINS).astype(int), _BINS - 1)
    ece = sum(abs(float(np.sum((hit - head_p)[bins == b]))) for b in range(_BINS)) / len(cases)
    brier = [sum((p - (name in c.truth)) ** 2 for name, p in c.ranked) for c in cases]
    return ece, float(np.mean(brier))


@dataclass(frozen=True, slots=True)
class Power:
    """Shares of cases with one effect whose gap is in [low, high) floors."""

    low: float
    high: float
    count: int
    detected: float
    named: float
    right: float


def power_curve(cases: Sequence[Scored], edges: Sequence[float] = (0.0, 0.75, 1.7, 5.0, np.inf)) -> list[Power]:
    """Return how often one effect is detected, is among the named, and is named alone, over its gap."""
    curve = []
    for low, high in itertools.pairwise(edges):
        inside = [c for c in cases if c.label["kind"] == "one" and low <= c.label["gap"] < high]
        if inside:
            tests = [(c.alarmed, c.truth <= c.named, c.right) for c in inside]
            detected, named, right = np.mean(tests, axis=0).tolist()
            curve.append(Power(low, high, len(inside), detected, named, right))
    return curve


def confusion(cases: Sequence[Scored]) -> dict[str, Counter[str]]:
    """Return by truth how often each verdict was given, in words; truths of two effects are sorted and joined."""
    table: dict[str, Counter[str]] = {}
    for case in cases:
        kind = case.label["kind"]
        outside = f"outside: {', '.join(case.label['effects'])}"
        truth = outside if kind == "outside" else " and ".join(sorted(case.truth))
        joint = " or " if case.kind == "ambiguous" else " and "
        table.setdefault(truth, Counter())[joint.join(sorted(case.named)) or case.kind] += 1
    return dict(sorted(table.items()))


def _by_kind(cases: Sequence[Scored]) -> dict[str, list[Scored]]:
    return {kind: [c for c in cases if c.label["kind"] == kind] for kind in ("none", "one", "two", "outside")}


def _covered(case: Scored) -> bool:
    """Whether the closure on held-out runs is inside the interval promised for the verdict's effects."""
    low, high = next(a["closure"]["interval"] for a in case.answer["answers"] if a.get("closure"))
    return case.closure is not None and bool(low <= case.closure <= high)


def _settled(case: Scored) -> bool:
    second = (case.second or {})["verdict"]
    return bool(second["kind"] == "effect" and frozenset(second["effects"]) == case.truth)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _quantile(values: np.ndarray[Any, np.dtype[np.float64]], q: float) -> float | None:
    return float(np.quantile(values, q)) if values.size else None
