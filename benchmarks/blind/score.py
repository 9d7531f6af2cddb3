"""The score of the blind check: answers against labels, figure by figure of the table of aims.

Cases cluster by rig: intervals hold 90 % and allow for it, and the interval for a new rig is wider still. Effects
that a case's runs cannot tell apart count as one, and effects of the background are not wrong: the plant has them.
A case without an answer is not right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm, t

from benchmarks.blind.plants.cases import STRATA, bad_file

_NAMING = ("effect", "partial", "ambiguous")
_BINS = 10  # of the probability, each with as many cases
_SPEEDS = ("rad/s", "m/s")
_NEAR = 0.03  # of an aim: how far an interval may reach beyond it
LISDD = {"detection": 1.0, "localisation F1": 0.80, "parameter bias": 0.002, "right form": 1.0}  # arXiv 2606.23215


def canonical(name: str) -> str:
    """Return an id with the two ends of a branch in alphabetical order, as written models name them."""
    law, at, place = name.partition("@")
    place, bracket, rest = place.partition("(")
    ends = place.split(".")
    if len(ends) == 2 and ends[1] != "balance" and law not in ("value", "varies"):
        place = ".".join(sorted(ends))
    return f"{law}{at}{place}{bracket}{rest}"


def means(name: str, other: str) -> bool:
    """Return whether an id is the other one, which names what a coefficient varies with in a part of a word."""
    if not other.startswith("varies@"):
        return canonical(name) == canonical(other)
    (place, _, variable), (wanted, _, part) = (x.rstrip(")").partition("(") for x in (name, other))
    return place == wanted and part.lower().replace("warming", "warmth") in variable.lower()


def in_words(answer: Mapping[str, Any]) -> str:
    """Return the verdict of a diagnosis in a few words."""
    verdict = answer["verdict"]
    joined = " and ".join(verdict["effects"])
    if verdict["one_of"]:
        either = " or ".join(" and ".join(names) for names in verdict["one_of"])
        joined = f"{joined} and ({either})" if joined else either
    kind = ("provisional " if verdict.get("provisional") else "") + str(verdict["kind"])
    return f"{kind}: {joined}" if joined else kind


def as_measured(label: Mapping[str, Any], measured: Mapping[str, Any]) -> dict[str, Any]:
    """Return a label by what real refits leave (`cases.measured`).

    An effect that leaves less than a floor, the others being known, is one of the background, and a case without
    another effect is complete, unless all of it together leaves a floor or more: its background is then loud.
    """
    visible = {e: gap >= 1.0 for e, gap in zip(label["effects"], measured["alone"], strict=True)}
    effects = [e for e in label["effects"] if visible[e]]
    hidden = [n for e in label["effects"] if not visible[e] for n in (e, *label["same"].get(e, ()))]
    stratum = label["stratum"] if len(effects) == len(label["effects"]) else "one" if effects else "none"
    return {
        **label, **{k: measured[k] for k in ("gap", "background", "determined")},
        "effects": effects, "background_effects": [*label["background_effects"], *hidden], "stratum": stratum,
        "loud": label["loud"] or (stratum == "none" and measured["gap"] >= 1.0),
        "sizes": {e: v for e, v in label["sizes"].items() if visible[e]},
    }  # fmt: skip


@dataclass(frozen=True)
class Scored:
    """A case: its label and what was answered, as JSON; see the module."""

    label: Mapping[str, Any]
    record: Mapping[str, Any]

    @property
    def answer(self) -> Mapping[str, Any] | None:
        """The diagnosis, if there is one."""
        return self.record.get("answer")

    @property
    def verdict(self) -> Mapping[str, Any]:
        """Of the diagnosis; of a case without an answer, an empty one."""
        without = {"kind": "none given", "effects": [], "one_of": [], "ports": []}
        return self.answer["verdict"] if self.answer else without

    @property
    def kind(self) -> str:
        """Of the verdict."""
        return str(self.verdict["kind"])

    @property
    def provisional(self) -> bool:
        """Whether the verdict says that it is."""
        return bool(self.verdict.get("provisional"))

    @property
    def sets(self) -> list[set[str]]:
        """The sets of effects that the verdict leaves open."""
        effects = self.verdict["effects"]
        return [{canonical(n) for n in (*effects, *names)} for names in self.verdict["one_of"] or [[]]]

    def is_a(self, name: str, truth: str) -> bool:
        """Return whether a name is the truth, or one that the runs cannot tell from it."""
        itself = [f"{truth}({v})" for v in self.label["variable"]] if truth.startswith("varies@") else [truth]
        return any(means(name, one) for one in (*itself, *self.label["same"].get(truth, ())))

    def called(self, names: set[str]) -> list[set[str]]:
        """Return a set of effects, and those that the answer itself says are the same model in these runs."""
        groups = [[{canonical(n) for n in one} for one in same] for same in (self.answer or {}).get("equal", [])]
        return [names, *(one for same in groups if names in same for one in same)]

    @property
    def right(self) -> bool:
        """Whether the verdict is exactly right."""
        stratum = self.label["stratum"]
        if self.kind == "complete":  # so is a model to its tolerance, a noise floor
            return float(self.label["gap"]) < 1.0
        if stratum == "unknown" and self.kind == "unknown":
            return True
        return self.kind in _NAMING and all(map(self._true, self.sets))

    def _true(self, names: set[str]) -> bool:
        """Return whether a set, by one of its names, has the truth, and otherwise nothing but the background."""
        truths = self.label["effects"]
        plain = [one for one in self.called(names) if truths and not self._strange(one)]
        return any(all(any(self.is_a(n, truth) for n in one) for truth in truths) for one in plain)

    def _foreign(self, names: set[str]) -> set[str]:
        """Return the effects of a set, by those of its names that have fewest, that the plant does not have."""
        return min(map(self._strange, self.called(names)), key=len)

    def _strange(self, names: set[str]) -> set[str]:
        behind, truths = (*self.label["background_effects"], *self.label["background_same"]), self.label["effects"]
        known = {n for n in names if any(means(n, o) for o in behind) or any(self.is_a(n, t) for t in truths)}
        return names - known

    @property
    def wrong(self) -> bool:
        """Whether an effect is named that the plant does not have, in every set that the verdict leaves open."""
        return self.kind in _NAMING and all(self._foreign(s) for s in self.sets)

    @property
    def alarmed(self) -> bool:
        """Whether the verdict says that the model lacks something."""
        return self.kind in (*_NAMING, "unknown")

    @property
    def placed(self) -> bool:
        """Whether the true place is among those that the verdict names."""
        named = {canonical("@" + p)[1:].removesuffix(".balance") for p in self.verdict.get("ports") or []}
        return any(p.removesuffix(".balance") in named for p in self.label.get("places", ()))

    @property
    def likeliest(self) -> tuple[float, bool] | None:
        """The probability of the likeliest answer, and whether it is true."""
        if not self.answer or not self.answer["answers"]:
            return None
        best = max(self.answer["answers"], key=lambda a: float(a["probability"] or 0.0))
        unknown = best["effects"] == ["unknown"] and self.label["stratum"] == "unknown"
        return float(best["probability"] or 0.0), unknown or self._holds(set(best["effects"]))

    def _holds(self, names: set[str]) -> bool:
        """Return whether an answer is true; *unknown* is none."""
        return not self.label["effects"] if names == {"none"} else self._true(names)

    @property
    def claim(self) -> tuple[float, bool]:
        """The probability that the verdict claims for what it says to be missing, and whether that holds."""
        assert self.answer is not None
        claimed = {"complete": [{"none"}], "insufficient": [{"none"}], "unknown": [{"unknown"}]}.get(self.kind)
        open_ = claimed or [{canonical(n) for n in s} for s in self.sets]
        weight = sum(
            float(a["probability"] or 0.0)
            for a in self.answer["answers"]
            if {canonical(n) for n in a["effects"]} in open_
        )
        if self.kind in _NAMING:
            return weight, any(not self._foreign(s) for s in self.sets)
        if self.kind == "unknown":  # none of the answers that are listed
            return weight, not any(self._holds(set(a["effects"])) for a in self.answer["answers"])
        return weight, self.right if self.kind != "insufficient" else self.label["stratum"] == "none"

    @property
    def miss(self) -> str:
        """What kind of answer the case has instead of the right one."""
        if not self.answer:
            return "no answer"
        if self.kind == "insufficient":
            return "not enough data to say"
        if self.kind == "complete":
            return "the gap is not seen"
        if self.label["stratum"] == "none":
            return "a complete model is not called complete"
        if self.wrong:
            return "another effect is named" + (", provisionally" if self.provisional else "")
        if self.kind == "unknown":
            return "called unknown" + ("" if self.placed else ", at another place")
        return "not every effect is named, or others in addition"

    @property
    def reason(self) -> str:
        """Why the case is not right, as far as a program can say it."""
        if not self.answer:
            lines = str(self.record.get("said", "")).strip().splitlines()
            return f"{self.miss}{': ' + lines[-1] if lines else ''}"[:160]
        if self.kind == "insufficient":
            best = (self.answer.get("best") or {}).get("effects") or []
            return f"{self.miss}; best explanation: {' and '.join(best) or 'none'}"
        if self.wrong:
            named = set().union(*map(self._foreign, self.sets))
            as_well = [n for names in self.label["as_well"].values() for n in names]
            fitting = all(any(means(n, o) for o in as_well) for n in named)
            fits = ", which fits these runs no worse than the catalogue's own law" if fitting else ""
            return f"{self.miss}: {', '.join(sorted(named))}{fits}"
        return self.miss


@dataclass(frozen=True)
class Figure:
    """A line of the table of aims: a value with its intervals, how many cases and rigs, and what is aimed at."""

    name: str
    value: float | None
    cases: int
    rigs: int = 0
    lower: float | None = None
    upper: float | None = None
    interval: tuple[float, float] | None = None
    new_rig: tuple[float, float] | None = None

    @property
    def met(self) -> bool | None:
        """Whether the aim is met, by the figure and by its interval but for a little; None without an aim."""
        if self.value is None or (self.lower is None and self.upper is None):
            return None
        worst, best = self.interval or (self.value, self.value)
        low, high = self.lower is None or self.value >= self.lower, self.upper is None or self.value <= self.upper
        if self.lower is not None and self.upper is not None:  # a range: the interval has to reach it
            return best >= self.lower and worst <= self.upper
        near_low = self.lower is None or worst >= self.lower - _NEAR
        near_high = self.upper is None or best <= self.upper + _NEAR
        return low and high and near_low and near_high


def share(
    name: str,
    cases: Sequence[Scored],
    holds: Callable[[Scored], bool | None],
    *,
    lower: float | None = None,
    upper: float | None = None,
) -> Figure:
    """Return a share with its interval and that for a new rig, of the cases for which `holds` is not None."""
    by_rig: dict[tuple[int, int], list[bool]] = {}
    for case in cases:
        if (hit := holds(case)) is not None:
            by_rig.setdefault((case.label["seed"], case.label["rig"]), []).append(bool(hit))
    if not by_rig:
        return Figure(name, None, 0, 0, lower, upper)
    hits = np.array([sum(x) for x in by_rig.values()], dtype=float)
    sizes = np.array([len(x) for x in by_rig.values()], dtype=float)
    n, k = sizes.sum(), len(sizes)
    p = float(hits.sum() / n)
    binomial = p * (1 - p) / n
    clustered = float(np.sum((hits - p * sizes) ** 2) / n**2 * k / max(k - 1, 1))
    effective = n / max(clustered / binomial, 1.0) if binomial > 0 else k
    z = float(norm.ppf(0.95))
    middle = (p + z**2 / (2 * effective)) / (1 + z**2 / effective)
    half = z * np.sqrt(p * (1 - p) / effective + z**2 / (4 * effective**2)) / (1 + z**2 / effective)
    between = max(float(np.average((hits / sizes - p) ** 2, weights=sizes)) - p * (1 - p) * k / n, 0.0)
    far = float(t.ppf(0.95, max(k - 1, 1))) * np.sqrt(between + half**2 / z**2)
    interval = (max(middle - half, 0.0), min(middle + half, 1.0))
    new = (max(min(p - far, interval[0]), 0.0), min(max(p + far, interval[1]), 1.0))
    return Figure(name, p, int(n), k, lower, upper, interval, new)


def figures(everything: Sequence[Scored]) -> list[Figure]:
    """Return every figure of the table of aims, single runs first."""
    cases = [c for c in everything if not c.label["twin_of"] and not c.label["own_shape"]]
    calm = [c for c in cases if not c.label["loud"]]
    by = {
        (s, r): [c for c in cases if c.label["stratum"] == s and (c.label["repeats"] == 1) is r]
        for s in STRATA
        for r in (True, False)
    }
    none = {
        r: [c for c in calm if c.label["stratum"] == "none" and (c.label["repeats"] == 1) is r]
        for r in (True, False)
    }
    both = {s: by[s, True] + by[s, False] for s in STRATA}
    seconds = [float(c.record["seconds"]) for c in cases if "seconds" in c.record]
    tables = [x for c in both["unknown"] if (x := _learned(c)) is not None]
    catalogue_shaped = [c for c in everything if c.label["own_shape"] and not c.label["twin_of"]]
    damaged = [c for c in cases if c.label["damaged"]]
    return [
        share("single runs: one effect right, firm or provisional", by["one", True], _right, lower=0.80),
        share("single runs: false alarm on complete models", none[True], lambda c: c.alarmed, upper=0.05),
        share("single runs: complete called complete", none[True], _right),
        share("repeated runs: one effect right", by["one", False], _right, lower=0.92),
        share("repeated runs: false alarm on complete models", none[False], lambda c: c.alarmed, upper=0.03),
        share("repeated runs: complete called complete", none[False], _right),
        share("wrong name, firm", cases, lambda c: c.wrong and not c.provisional, upper=0.02),
        share("wrong name, provisional", cases, lambda c: c.wrong and c.provisional, upper=0.08),
        share("a coefficient that varies: it and its variable right", both["varies"], _right, lower=0.75),
        share("unknown: place right", both["unknown"], lambda c: c.placed, lower=0.85),
        Figure("unknown: corrected/ closes on left-out runs, median", _median(tables), len(tables), lower=0.7),
        share("unknown: an equation is found", both["unknown"], _equation_found),
        share("two effects: both right", both["two"], _right, lower=0.80),
        share("size inside its 90 % interval", cases, _size_covered, lower=0.85, upper=0.95),
        share("promised closure kept on a new run", cases, _closure_covered, lower=0.85, upper=0.95),
        share("corrected/ is the fitted model, to 0.05 standard deviations", cases, _corrected, lower=1.0),
        Figure("calibration error of the likeliest answer", *calibration(cases), upper=0.03),
        _same_information(everything),
        Figure("median processor time, s", _median(seconds), len(seconds), upper=10.0),
        share(
            "background of a noise floor: alarm on complete models",
            [c for c in by["none", True] + by["none", False] if c.label["loud"]],
            lambda c: c.alarmed,
        ),
        share("cases with an answer", cases, lambda c: c.answer is not None),
        share("the catalogue's own shapes: one effect right", catalogue_shaped, _right),
        share(
            "damaged logs refused by name, and no other; the others diagnosed",
            damaged,
            lambda c: (
                c.answer is not None
                and {n for n, _ in c.record["refused"]}
                == {bad_file(k) + ".csv" for k in range(len(c.label["damaged"]))}
            ),
        ),
    ]


def _right(case: Scored) -> bool:
    return case.right


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _equation_found(case: Scored) -> bool | None:
    return bool((case.answer.get("law_found") or {}).get("formula")) if case.answer else None


def _corrected(case: Scored) -> bool | None:
    differs = (case.answer or {}).get("corrected_differs")
    return None if differs is None else bool(differs <= 0.05)


def _size_covered(case: Scored) -> bool | None:
    """Return whether the size that the catalogue's law should have is in the 90 % interval; None without one."""
    if not case.answer or not case.right:
        return None
    for truth, size in case.label["sizes"].items():
        law = truth.partition("@")[0]
        if law in ("lag", "drift", "dead_zone") or (case.label["units"] and law == "offset"):
            continue  # it depends on a further shape that is fitted, or is in the unit of the log
        for effect in case.answer["effects"]:
            if canonical(effect["id"]) == canonical(truth):
                parameters = effect.get("parameters") or {}
                one = next((v for n, v in parameters.items() if n.rpartition(".")[2] == law), None)
                if one and one.get("standard_error"):
                    return bool(abs(one["value"] - size) < norm.ppf(0.95) * one["standard_error"])
    return None


def _closure_covered(case: Scored) -> bool | None:
    """Return whether the closure on the run that was kept is in the promised interval."""
    validated = case.record.get("validate")
    if not isinstance(validated, dict) or case.kind not in _NAMING or not validated.get("closure_interval"):
        return None
    gap = validated["gaps"]["all"]
    if gap["nominal"] < 0.5:  # a run that shows no gap
        return None
    low, high = validated["closure_interval"]
    return bool(low <= gap["closure"] <= high)


def _learned(case: Scored) -> float | None:
    """Return the left-out closure of the best explanation, 0 without one; None unless the verdict is unknown."""
    if not case.answer or case.kind != "unknown":
        return None
    return float(((case.answer.get("best") or {}).get("closure") or {}).get("held_out") or 0.0)


def calibration(cases: Sequence[Scored]) -> tuple[float | None, int]:
    """Return the calibration error of the likeliest answer, without what sampling adds to it, and how many cases.

    It is the root of the mean squared difference of share and probability over bins of as many cases each (Kumar,
    Liang, Ma: Verified uncertainty calibration. NeurIPS 2019).
    """
    known = [x for c in cases if (x := c.likeliest) is not None]
    if len(known) < 2 * _BINS:
        return None, len(known)
    sure, hits = np.array(known, dtype=float).T
    squared = 0.0
    for chosen in np.array_split(np.argsort(sure, kind="stable"), _BINS):
        rate, n = hits[chosen].mean(), len(chosen)
        squared += n / len(known) * ((rate - sure[chosen].mean()) ** 2 - rate * (1 - rate) / (n - 1))
    return float(np.sqrt(max(squared, 0.0))), len(known)


def _same_information(cases: Sequence[Scored]) -> Figure:
    named = {(c.label["seed"], c.label["case"]): c for c in cases}
    twins = [c for c in cases if c.label["twin_of"] and (c.label["seed"], c.label["twin_of"]) in named]

    def same(case: Scored) -> bool:
        other = named[case.label["seed"], case.label["twin_of"]]
        return case.kind == other.kind and {frozenset(s) for s in case.sets} == {frozenset(s) for s in other.sets}

    return share("same information, same verdict", twins, same, lower=0.98)


# Effects in one regime only --------------------------------------------------------------------------------------


def localisation(case: Scored) -> float:
    """Return the F1 score of the samples that the diagnosis places the gap at, of those where the effect acts.

    Of the regimes that ``where`` names, those of the variable that decides count; without one, no sample is named.
    """
    regime = case.label["regime"]
    x = np.array(regime["trace"])
    value = np.abs(x) if regime["what"] == "rate" else x
    truth, located = value > regime["over"], np.zeros(len(x), dtype=bool)
    node = case.label["places"][0].removesuffix(".balance")
    for place in (case.answer or {"where": []})["where"]:
        bounds = place.get("regime")
        if bounds and node in bounds["variable"] and (bounds["unit"] in _SPEEDS) is (regime["what"] == "rate"):
            located |= (x >= bounds["from"]) & (x <= bounds["to"])
    hit = float(np.sum(truth & located))
    return 2 * hit / max(float(truth.sum() + located.sum()), 1.0)


def bias(case: Scored) -> float | None:
    """Return the mean relative error of the free parameters that the runs determine."""
    if not case.answer:
        return None
    fitted = case.answer["model"]["parameters"]
    errors = [
        abs(fitted[n] / v - 1.0)
        for n, v in case.label["values"].items()
        if n in fitted and n in case.label["determined"] and n in case.record.get("free", ())
    ]
    return float(np.mean(errors)) if errors else None


def regimes(cases: Sequence[Scored]) -> list[tuple[str, float | None, int, float]]:
    """Return the figures of the stratum with effects in one regime only, each beside LISDD's published one."""
    gated = [c for c in cases if c.label["stratum"] == "regime" and not c.label["twin_of"]]
    biases = [b for c in gated if (b := bias(c)) is not None]
    mean = lambda x: float(np.mean(x)) if len(x) else None  # noqa: E731
    return [
        ("detection", mean([c.alarmed for c in gated]), len(gated), LISDD["detection"]),
        ("localisation F1", mean([localisation(c) for c in gated]), len(gated), LISDD["localisation F1"]),
        ("parameter bias, mean", mean(biases), len(biases), LISDD["parameter bias"]),
        ("parameter bias, median", _median(biases), len(biases), LISDD["parameter bias"]),
        ("right form", mean([c.right for c in gated]), len(gated), LISDD["right form"]),
    ]
