"""Calibration of probabilities: how often verdicts are right on plants simulated from the model and its noise.

Plants are the fitted nominal model with no effect, with one, with two, with one whose law has another shape, or
with a free function at a port that matches no effect of the catalogue. Like a real machine, each also has a
background of small effects. Its noise is mixed, frequency by frequency, from the differences between repeats.
Each plant is diagnosed like the measurements, and for each kind of verdict a logistic curve (Platt 1999) maps the
weight of its answers to how often they were true. Answers with several effects have a curve of their own, because
a second effect often stands in for the shape of the first. No label of any real measurement is used.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from fmu_build.cache import user_cache
from fmuid.core.errors import SimulationError
from fmuid.core.files import write_atomically
from fmuid.core.immutable import FloatArray
from fmuid.core.progress import Say, quiet
from fmuid.data.noise.spectrum import whitener
from fmuid.data.noise.transform import from_real_spectrum, real_spectrum
from fmuid.diagnosis.extended_model import Prediction
from fmuid.diagnosis.free_functions import bases
from fmuid.diagnosis.observed import Observed, excesses, project_off
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import nominal_basis, stack
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.verdict import Verdict
from fmuid.effects.effect import Effect, Port

KINDS = ("none", "one", "shape", "two", "unknown")
SHARES = (0.25, 0.25, 0.2, 0.15, 0.15)  # of the kinds: as many plants without an effect as with one
GAPS = (0.5, 1.0, 3.0, 10.0)  # gaps of the plants, in noise floors
_BACKGROUND, _BEHIND = (0.1, 0.5), (3, 6)  # gap of the background, in noise floors; how many effects it has
_APPROACHES = 3  # simulations to reach a gap that was drawn, which need not be met exactly
_FACTORS = (0.02, 50.0)  # by which one of them changes a size: laws are not linear
_DRAWS = 10  # attempts to draw a plant of a kind that can be simulated
_MISMATCH = 0.15  # share of an effect's gap that the wrong shape of its law leaves
_SPREAD = (1.5, 0.5)  # prior standard deviations of a curve's offset from 0 and of its slope from 1
_EDGE = 1e-3  # probabilities are kept this far from 0 and 1


@dataclass(frozen=True, slots=True)
class Trial:
    """Outcome for one simulated plant: the verdict's kind, the weight of its answers, and whether one is true.

    Attributes
    ----------
    several
        Whether an answer of the verdict has several effects.
    truth, gap
        True answer of the plant and the gap that it leaves, in noise floors.
    named
        Effects of the verdict; those that it leaves open follow.
    background
        Small effects that the plant has in addition.
    """

    kind: str
    weight: float
    right: bool
    several: bool = False
    truth: tuple[str, ...] = ()
    gap: float = 0.0
    named: tuple[str, ...] = ()
    background: tuple[str, ...] = ()

    @property
    def curve(self) -> str:
        """The curve of the verdict."""
        return _curve_of(self.kind, several=self.several)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON value."""
        return {
            "truth": list(self.truth),
            "gap": self.gap,
            "background": list(self.background),
            "verdict": self.kind,
            "named": list(self.named),
            "right": self.right,
        }


def _curve_of(kind: str, *, several: bool) -> str:
    """Return the name of the curve for verdicts of a kind, an answer of which may have `several` effects."""
    return f"{kind} of several" if several else kind


class Plant(NamedTuple):
    """A simulated plant: its recordings, true answer, gap in noise floors, and the effects of its background."""

    subject: Subject
    truth: frozenset[str]
    gap: float
    background: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Calibration:
    """For each kind of verdict, offset and slope that map the log odds of its weight to those of being right.

    Attributes
    ----------
    curves
        Curves by kind, those of answers with several effects as ``kind of several``.
    trials
        Number of plants used for the fit.
    source
        Origin of the plants, as text.
    """

    curves: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    trials: int = 0
    source: str = "none"

    @property
    def note(self) -> str:
        """The basis of the probabilities, as a sentence."""
        return f"Probabilities are calibrated on {self.trials} simulated plants {self.source}."

    def curve(self, kind: str, *, several: bool) -> tuple[float, float] | None:
        """Return a curve, that of single effects if answers with several were never tried; None if neither was."""
        return self.curves.get(_curve_of(kind, several=several), self.curves.get(kind))

    def apply(
        self, verdict: Verdict, probability: Mapping[tuple[str, ...], float]
    ) -> dict[tuple[str, ...], float]:
        """Return the probabilities of answers, scaling those that the verdict leaves open and all others.

        The former then sum to the rate at which such verdicts are right.
        """
        weight, curve = says(verdict, probability), self.curve(verdict.kind, several=_several(verdict))
        if curve is None or not 0.0 < weight < 1.0:
            return dict(probability)
        offset, slope = curve
        sure = float(np.clip(expit(offset + slope * logit(np.clip(weight, _EDGE, 1 - _EDGE))), _EDGE, 1 - _EDGE))
        inside, outside = sure / weight, (1.0 - sure) / (1.0 - weight)
        listed = {frozenset(a) for a in verdict.answers}
        return {name: p * (inside if frozenset(name) in listed else outside) for name, p in probability.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON value."""
        curves = {name: list(curve) for name, curve in self.curves.items()}
        return {"format": "fmuid-calibration", "version": 1, "trials": self.trials, "curves": curves}


def says(verdict: Verdict, probability: Mapping[tuple[str, ...], float]) -> float:
    """Return the total probability of the answers that a verdict leaves open."""
    listed = {frozenset(answer) for answer in verdict.answers}
    return sum(p for answer, p in probability.items() if frozenset(answer) in listed)


def _several(verdict: Verdict) -> bool:
    return any(len(answer) > 1 for answer in verdict.answers)


def is_true(
    verdict: Verdict,
    truth: frozenset[str],
    background: frozenset[str] = frozenset(),
    listed: Iterable[tuple[str, ...]] = (),
) -> bool:
    """Return whether all effects of one of a verdict's answers are in `truth` or in the `background`.

    *Unknown* is true if none of the answers `listed` with it is.
    """
    if verdict.kind == "unknown":
        return not any(
            frozenset(answer) - background == truth for answer in listed if answer not in verdict.answers
        )
    return any(truth | background >= set(answer) for answer in verdict.answers)


def fit_curves(trials: Sequence[Trial], source: str) -> Calibration:
    """Fit every curve; with few trials it stays near the identity."""
    curves = {}
    for name in dict.fromkeys(t.curve for t in trials):
        of_curve = [t for t in trials if t.curve == name]
        x = logit(np.clip([t.weight for t in of_curve], _EDGE, 1 - _EDGE))
        right = np.array([t.right for t in of_curve])

        def loss(c: FloatArray, x: FloatArray = x, right: FloatArray = right) -> float:
            odds = c[0] + c[1] * x
            prior = (c[0] / _SPREAD[0]) ** 2 / 2 + ((c[1] - 1.0) / _SPREAD[1]) ** 2 / 2
            return float(np.sum(np.logaddexp(0.0, np.where(right, -odds, odds))) + prior)

        coefficients = minimize(loss, np.array([0.0, 1.0]), method="Nelder-Mead").x
        curves[name] = (float(coefficients[0]), float(max(coefficients[1], 0.0)))
    return Calibration(curves, len(trials), source)


def simulated_plants(
    subject: Subject, fit: Refit, paths: Mapping[str, tuple[FloatArray, ...]], count: int, *, seed: int = 0
) -> Iterator[Plant]:
    """Make plants from the refitted nominal model, each with its true answer.

    Parameters
    ----------
    subject, fit
        The subject of the diagnosis and its nominal refit.
    paths
        Samples of the regimes' variables along the nominal model's trajectory.
    count
        Number of plants, at least 1. A plant that cannot be simulated is drawn again.

    Raises
    ------
    SimulationError
        None of the plants drawn for a kind can be simulated.
    """
    rng = np.random.default_rng(seed)
    maker = _Maker(subject, fit, paths, rng)
    kinds = [kind for kind, number in zip(KINDS, _numbers(count), strict=True) for _ in range(number)]
    for kind in rng.permutation(kinds).tolist():
        made = next((plant for _ in range(_DRAWS) if (plant := maker.plant(kind)) is not None), None)
        if made is None:
            raise SimulationError(
                f"none of {_DRAWS} plants of the kind '{kind}' can be simulated",
                where="calibration",
                fix="check the bounds and trials of the catalogue's effects",
            )
        yield made


def _numbers(count: int) -> list[int]:
    """Return the number of plants of each kind among `count`: `SHARES` rounded by largest remainder."""
    quotas = count * np.array(SHARES)
    numbers = np.floor(quotas + 1e-9).astype(int)
    numbers[np.argsort(numbers - quotas, kind="stable")[: count - numbers.sum()]] += 1
    return [int(n) for n in numbers]


@dataclass(frozen=True, slots=True, eq=False)
class _Maker:
    subject: Subject
    fit: Refit
    paths: Mapping[str, tuple[FloatArray, ...]]
    rng: np.random.Generator

    def plant(self, kind: str) -> Plant | None:
        """Return a plant; None if it cannot be simulated."""
        values, truth = dict(self.fit.values), frozenset({"none"})
        drive: dict[str, list[FloatArray]] = {}
        size, chosen = float(self.rng.choice(GAPS)), list[Effect]()
        if kind in ("one", "shape", "two"):
            effects = self.rng.choice(len(self.subject.effects), 2 if kind == "two" else 1, replace=False)
            chosen = [self.subject.effects[k] for k in effects]
            truth = frozenset(e.id for e in chosen)
            for effect in chosen:
                values |= self._sized(effect, size)
        if kind in ("shape", "unknown"):
            drive = self._function(_MISMATCH * size if kind == "shape" else size)
            truth = truth if kind == "shape" else frozenset({"unknown"})
        small, background = self._background(chosen)
        values |= small
        (prediction,) = self.subject.model.predict_driven(values, [drive])
        if isinstance(prediction, SimulationError):
            return None
        return Plant(self._measured(prediction), truth, self._gap(prediction), background)

    def _background(self, chosen: Sequence[Effect]) -> tuple[dict[str, float], frozenset[str]]:
        """Return the values and the ids of small effects, none of which shares a parameter with another one."""
        values, ids = dict[str, float](), list[str]()
        taken = {name for effect in chosen for name in effect.neutral}
        count, gap = int(self.rng.integers(*_BEHIND, endpoint=True)), float(self.rng.uniform(*_BACKGROUND))
        for k in self.rng.permutation(len(self.subject.effects)):
            effect = self.subject.effects[k]
            if len(ids) < count and effect.usual and not effect.variant and not taken & effect.neutral.keys():
                taken |= effect.neutral.keys()
                ids.append(effect.id)
                values |= self._sized(effect, gap * float(self.rng.uniform(0.5, 1.5)) / np.sqrt(count))
        return values, frozenset(ids)

    def _gap(self, prediction: Prediction) -> float:
        observed = self.subject.observed
        moved = stack(observed.residuals(prediction), observed) - stack(self.fit.residuals, observed)
        left = project_off(moved, nominal_basis(self.fit, observed)) / np.sqrt(_weights(observed))
        _, count = excesses(self.fit.residuals, observed)
        return float(np.linalg.norm(left) / np.sqrt(count.sum()))

    def _sized(self, effect: Effect, size: float) -> dict[str, float]:
        """Return the values at which the effect leaves a gap of `size`, as far as its bounds allow."""
        trial, factor = effect.trials[int(self.rng.integers(len(effect.trials)))], 1.0
        for _ in range(_APPROACHES):
            values = effect.scaled(trial, factor)
            (prediction,) = self.subject.model.predict([{**self.fit.values, **values}])
            if isinstance(prediction, SimulationError):
                return effect.scaled(trial, 0.1)
            factor *= float(np.clip(size / max(self._gap(prediction), 1e-6), *_FACTORS))
        return effect.scaled(trial, factor)

    def _function(self, size: float) -> dict[str, list[FloatArray]]:
        """Return a random function of a regime, acting at a port, that leaves a gap of `size`."""
        ports: list[Port] = [p for p in self.subject.catalogue.ports.values() if p.input is not None]
        port = ports[int(self.rng.integers(len(ports)))]
        families = list(bases(self.paths, self.subject.catalogue.regimes).values())
        family = families[int(self.rng.integers(len(families)))]
        weights = self.rng.standard_normal(len(family))
        runs = range(len(self.subject.model.cases))
        shape = [sum(w * b[e] for w, b in zip(weights, family, strict=True)) * port.magnitude for e in runs]
        factor = 1.0
        for _ in range(_APPROACHES):
            drive = {str(port.input): [np.asarray(factor * f) for f in shape]}
            (prediction,) = self.subject.model.predict_driven(self.fit.values, [drive])
            if isinstance(prediction, SimulationError):
                break
            factor *= float(np.clip(size / max(self._gap(prediction), 1e-6), *_FACTORS))
        return {str(port.input): [np.asarray(factor * f) for f in shape]}

    def _measured(self, prediction: Prediction) -> Subject:
        """Return the subject with its runs replaced by the prediction, with noise like that of the measurements.

        The noise is mixed from the differences between repeats. Runs without repeats get noise of the variance
        that the diagnosis assumes in each band.
        """
        cases = []
        for case, run, clean in zip(self.subject.model.cases, self.subject.observed.runs, prediction, strict=True):
            repeats = run.n_repeats
            if repeats == 1:
                assumed = whitener(run, self.subject.observed.noise[run.setup])
                noise = self.rng.standard_normal((1, *clean.shape))
                noise[0, :, 0] /= assumed.mean_scale
                for band, factor in zip(assumed.bands, assumed.factors, strict=True):
                    noise[0][:, band] = np.linalg.solve(factor, noise[0][:, band])
            else:
                deviation = real_spectrum(run.deviations)
                # Mixed anew at every frequency: with only a few differences, the runs would otherwise be too much
                # alike.
                mix = self.rng.standard_normal((repeats, *deviation.shape[::2])) / np.sqrt(repeats - 1)
                noise = np.einsum("rkn,kcn->rcn", mix, deviation)
            values = clean + from_real_spectrum(noise)
            channels = tuple(replace(c, repeats=values[:, k]) for k, c in enumerate(case.channels))
            cases.append(replace(case, channels=channels))
        model = replace(self.subject.model, cases=tuple(cases))
        return replace(self.subject, model=model, observed=Observed.from_runs(model.runs))


def _weights(observed: Observed) -> FloatArray:
    return np.concatenate([np.full(w.size, n) for w, n in zip(observed.whiteners, observed.repeats, strict=True)])


@cache
def shipped() -> Calibration:
    """Return the calibration shipped with the package, on the published cases of the blind check."""
    return _read(
        (files("fmuid.diagnosis") / "calibration.json").read_text(),
        "of random rigs, the default (--rehearse 60 makes them from this model and its noise)",
    )


def kept(key: str) -> Calibration | None:
    """Return the calibration stored under `key` in the user's cache, if any."""
    file = user_cache() / f"calibration-{key}.json"
    return _read(file.read_text(), "of this model, noise and set-up") if file.is_file() else None


def keep(key: str, calibration: Calibration) -> None:
    """Store a calibration in the user's cache."""
    write_atomically(user_cache() / f"calibration-{key}.json", json.dumps(calibration.to_dict(), indent=1) + "\n")


def key_of(paths: Sequence[Path], subject: Subject) -> str:
    """Return a hash of the files, the experiments with their sensors and repeats, and the nominal parameters."""
    digest = hashlib.sha256(b"several")
    for path in paths:
        digest.update(path.read_bytes())
    runs = [(r.id, r.setup, r.channels, r.n_repeats, len(r.time)) for r in subject.observed.runs]
    digest.update(repr((runs, [u.name for u in subject.nominal])).encode())
    return digest.hexdigest()[:16]


def _read(text: str, source: str) -> Calibration:
    value = json.loads(text)
    curves = {name: (float(a), float(b)) for name, (a, b) in value["curves"].items()}
    return Calibration(curves, int(value["trials"]), source)


def calibrate(
    subject: Subject,
    fit: Refit,
    paths: Mapping[str, tuple[FloatArray, ...]],
    diagnose: Callable[[Subject], tuple[Verdict, Mapping[tuple[str, ...], float]]],
    *,
    count: int,
    seed: int = 0,
    say: Say = quiet,
) -> list[Trial]:
    """Diagnose `count` simulated plants; `diagnose` returns a verdict and uncalibrated probabilities."""
    trials = []
    for k, (plant, truth, gap, background) in enumerate(simulated_plants(subject, fit, paths, count, seed=seed)):
        say(f"rehearsing on simulated plant {k + 1} of {count}", k / count)
        verdict, probability = diagnose(plant)
        named = tuple(dict.fromkeys([*verdict.effects, *(n for names in verdict.one_of for n in names)]))
        weight, right = says(verdict, probability), is_true(verdict, truth, background, probability)
        known = tuple(sorted(truth)), gap, named, tuple(sorted(background))
        trials.append(Trial(verdict.kind, weight, right, _several(verdict), *known))
    return trials
