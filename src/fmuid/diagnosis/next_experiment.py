"""Separation of rival answers by a future run, in standard deviations, and which run or sensor to add.

Once the run is made, a wrong rival is refitted and adapts as far as the recorded runs let it. So of the difference
of two predictions only the part counts that the rival's parameters cannot follow at less cost. `fmuid.design`
searches for the run; a diagnosis itself only suggests one of the campaign's own runs with its input scaled, by no
more than half beyond the original, if the outputs stay near what was recorded. Sensors are those of the catalogue.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from scipy.special import ndtr

from fmuid.core.errors import SimulationError
from fmuid.core.experiments import widened
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.level import NoiseLevel
from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.decide import OPEN, SAME, spread
from fmuid.diagnosis.extended_model import CampaignModel, Linear, Prediction, linear_at, predicted
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.scores import stack
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.verdict import AddedSensor, NextExperiment
from fmuid.effects.effect import Sensor, Unknown
from fmuid.identification.problem.cases import Case, Channel

_SCALES = (-1.0, 0.25, 0.5, 1.25, 1.5)  # factors on recorded inputs: a rig that has run them can run these
_BEYOND = 1.0  # recorded range by which outputs may leave it: as far as a mirrored input leads a plant from rest
_NINE_OF_TEN = 1.2816  # standard deviations: one-sided 90 %
_PRECISELY, _USUAL = 1e-2, 1e-4  # shares of a diagnosis' solver tolerance: nearly equal models are compared
_UNBOUNDED = 10.0  # standard deviation, in values, of an unbounded parameter that no run determines

Whiten = Callable[[Prediction], FloatArray]
"""Convert differences of predictions to one vector in standard deviations of the noise."""


@dataclass(frozen=True, eq=False)
class Rival:
    """An answer that may be right, with the uncertainty of its parameters from the recorded runs.

    Attributes
    ----------
    information
        (P, P) triangular factor of the available information: a change d of the parameters costs
        ``|information d|^2``.
    draws
        Plausible parameter values, the estimate first.
    residual
        (M,) whitened residual on the recorded runs.
    left
        Energy of the unexplained part there, relative to that of the noise.
    """

    names: tuple[str, ...]
    unknowns: tuple[Unknown, ...]
    information: FloatArray
    draws: tuple[Mapping[str, float], ...]
    residual: FloatArray
    left: float

    @property
    def values(self) -> Mapping[str, float]:
        """The parameter estimate."""
        return self.draws[0]


def rival_of(fitted: Fitted, observed: Observed, *, draws: int = 1, seed: int = 0) -> Rival:
    """Return a refitted model as a rival, with draws of its parameters."""
    unknowns, fit = fitted.fit.unknowns, fitted.fit
    here = np.array([fit.values[u.name] for u in unknowns])
    width = [(u.upper - u.lower) / np.sqrt(12.0) for u in unknowns]
    loose = [_UNBOUNDED * max(abs(x), u.step) for x, u in zip(here.tolist(), unknowns, strict=True)]
    wide = np.minimum(np.minimum(width, loose), [u.sd for u in unknowns])
    rows = np.vstack([stack(fit.jacobian, observed), np.diag(1.0 / wide)])
    information = np.asarray(np.linalg.qr(rows * wide, mode="r") / wide)
    lower, upper = np.array([u.lower for u in unknowns]), np.array([u.upper for u in unknowns])
    errors = np.random.default_rng(seed).standard_normal((draws - 1, len(here)))
    points = [here, *(here + wide * np.linalg.solve(information * wide, e) for e in errors)]
    names = [u.name for u in unknowns]
    drawn = tuple(dict(zip(names, np.clip(x, lower, upper).tolist(), strict=True)) for x in points)
    left = float(np.mean(observed.repeats)) * fitted.gap**2
    return Rival(fitted.effects, unknowns, information, drawn, stack(fit.residuals, observed), left)


def separations(apart: FloatArray, rivals: Sequence[Rival]) -> FloatArray:
    """Return by how many standard deviations a diagnosis will prefer the right one of two rivals, or more.

    It does so in nine cases out of ten, whichever draw of its parameters is true, using the recorded runs and the
    new one. A distance D in the new run makes the costs differ by D^2 on average, with a standard deviation of 2 D
    (see `decide.separation`).

    Parameters
    ----------
    apart
        (R, draws, R) distances in the new run.

    Returns
    -------
    (R, R): preference for the first rival, if it is right, over the second.
    """
    separation = np.zeros((len(rivals), len(rivals)))
    least = apart.min(axis=1)
    for (a, right), (b, wrong) in permutations(enumerate(rivals), 2):
        so_far, distance = _so_far(right, wrong)
        distance = float(np.hypot(distance, least[a, b]))
        if distance > 0.0:
            gained = so_far + least[a, b] ** 2 - 2.0 * _NINE_OF_TEN * least[a, b]
            separation[a, b] = max(0.0, gained / (2.0 * distance * _wider(right, wrong)))
    return separation


def chances(apart: FloatArray, rivals: Sequence[Rival]) -> FloatArray:
    """Return for each rival the probability that a diagnosis leaves no other one open if it is right.

    An answer is left open unless the odds against it exceed `decide.OPEN` (see `decide.log_odds`). The probability
    is averaged over the draws of the parameters.

    Parameters
    ----------
    apart
        (R, draws, R) distances in the new run.
    """
    chance = np.ones(len(rivals))
    for (a, right), (b, wrong) in permutations(enumerate(rivals), 2):
        so_far, distance = _so_far(right, wrong)
        new = apart[a, :, b]
        wider = _wider(right, wrong)
        price = 0.5 * np.log(len(right.residual)) * (len(wrong.unknowns) - len(right.unknowns))
        least = wider * np.sqrt(2.0 * max(0.0, np.log(OPEN) - price))
        needed = least * np.maximum(least, np.hypot(distance, new)) if least else np.full(len(new), -np.inf)
        with np.errstate(divide="ignore"):
            sure = ndtr((so_far + new**2 - needed) / (2.0 * new))
        chance[a] = min(chance[a], float(np.mean(sure)))
    return chance


def _so_far(right: Rival, wrong: Rival) -> tuple[float, float]:
    """Return by how much the cost of `wrong` exceeds that of `right` in the recorded runs, and their distance."""
    costs = [float(r.residual @ r.residual) for r in (right, wrong)]
    return costs[1] - costs[0], float(np.linalg.norm(right.residual - wrong.residual))


def _wider(a: Rival, b: Rival) -> float:
    return spread(min(a.left, b.left))


def distances(
    model: CampaignModel, rivals: Sequence[Rival], whiten: Whiten
) -> tuple[FloatArray, list[Prediction]]:
    """Return by how many standard deviations rivals differ in runs, however the wrong one is refitted.

    Returns
    -------
    array
        (R, draws, R): distance from each draw of the first rival, if it is true, to the second.
    list of Prediction
        Predictions of every draw of every rival, in their order.

    Raises
    ------
    SimulationError
        A run failed.
    """
    linear = linear_at(model, [r.values for r in rivals], [r.unknowns for r in rivals])
    drawn = predicted(model, [values for r in rivals for values in r.draws])
    return distance_matrix(linear, drawn, rivals, whiten), drawn


def distance_matrix(
    linear: Sequence[Linear], drawn: Sequence[Prediction], rivals: Sequence[Rival], whiten: Whiten
) -> FloatArray:
    """Return the (R, draws, R) distances computed from simulations; see `distances`."""
    distances = np.zeros((len(rivals), len(rivals[0].draws), len(rivals)))
    of = [k for k, rival in enumerate(rivals) for _ in rival.draws]
    for b, (wrong, here) in enumerate(zip(rivals, linear, strict=True)):
        differences = np.stack(
            [
                whiten(tuple(p - q for p, q in zip(prediction, here.prediction, strict=True)))
                for a, prediction in zip(of, drawn, strict=True)
                if a != b
            ],
            axis=1,
        )
        columns = [whiten(here.slopes[u.name]) for u in wrong.unknowns]
        bent = np.vstack(
            [np.stack(columns, axis=1) if columns else np.zeros((len(differences), 0)), wrong.information]
        )
        size = np.linalg.norm(bent, axis=0)
        basis, _ = np.linalg.qr(bent / np.where(size > 0.0, size, 1.0))
        whole = np.vstack([differences, np.zeros((len(bent) - len(differences), differences.shape[1]))])
        left = np.linalg.norm(whole - basis @ (basis.T @ whole), axis=0)
        distances[np.arange(len(rivals)) != b, :, b] = left.reshape(len(rivals) - 1, -1)
    return distances


def suggest(subject: Subject, alike: Sequence[Fitted]) -> NextExperiment | None:
    """Return the variation of an experiment that best separates the first two of `alike`.

    None if none would settle which of them is right (`decide.SAME` standard deviations). It is assumed to be
    repeated as often as the original experiment.
    """
    if len(alike) < 2 or subject.observed.nuisances:  # segments start from measurements of this very run
        return None
    observed, (a, b) = subject.observed, alike[:2]
    rivals = [rival_of(f, observed) for f in (a, b)]
    both = {**a.fit.values, **b.fit.values}
    best: NextExperiment | None = None
    for scale in _SCALES:
        for k, case in enumerate(subject.model.cases_at(both)):
            tolerance = _PRECISELY * (case.task.tolerance or case.simulator.default_tolerance or _USUAL)
            inputs = {n: scale * u for n, u in case.task.inputs.items()}
            task = replace(case.task, inputs=inputs, tolerance=tolerance)
            model = replace(subject.model, cases=(replace(case, task=task),))
            weight, whitener = np.sqrt(observed.repeats[k]), observed.whiteners[k]
            try:
                apart, drawn = distances(model, rivals, lambda d, w=weight, by=whitener: w * by(d[0]).ravel())  # type: ignore[misc]
            except SimulationError:
                continue
            sigma = _new(apart, rivals) if all(_near(p, case, observed) for (p,) in drawn) else 0.0
            if sigma > (SAME if best is None else best.separation_sigma):
                best = NextExperiment(
                    case.setup, f"as {case.id}, with its input times {scale:g}", sigma, (a.id, b.id)
                )
    return best


def _near(prediction: FloatArray, case: Case, observed: Observed) -> bool:
    """Return whether a prediction stays near what the runs of the same setup have shown of each signal."""
    for name, course in zip((c.signal for c in case.channels), prediction, strict=True):
        runs = [r for r in observed.runs if r.setup == case.setup and name in r.channels]
        low, high = widened([r.mean[r.channels.index(name)] for r in runs], _BEYOND)
        if course.min() < low or course.max() > high:
            return False
    return True


def sensor_to_add(subject: Subject, alike: Sequence[Fitted], *, beyond: float = SAME) -> AddedSensor | None:
    """Return the sensor that best separates the first two of `alike` in the existing experiments.

    None if no sensor exceeds `beyond` sigma, the separation by the best additional experiment.
    """
    if len(alike) < 2:
        return None
    a, b = alike[0], alike[1]
    rivals = [rival_of(f, subject.observed) for f in (a, b)]
    best: AddedSensor | None = None
    for sensor in subject.catalogue.sensors.values():
        new = [_is_new(c, sensor.variable) for c in subject.model.cases]
        cases = tuple(with_sensors(c, [sensor]) if n else c for c, n in zip(subject.model.cases, new, strict=True))
        model = replace(subject.model, cases=cases)
        try:
            apart, _ = distances(model, rivals, lambda d, s=sensor, n=new: _in_sigmas(subject, d, s, n))  # type: ignore[misc]
        except SimulationError:
            continue
        sigma = _new(apart, rivals) if any(new) else 0.0
        if sigma > (beyond if best is None else best.separation_sigma):
            best = AddedSensor(sensor.name, sensor.description or sensor.variable, sigma, (a.id, b.id))
    return best


def _new(apart: FloatArray, rivals: Sequence[Rival]) -> float:
    """Return the smaller separation of two rivals; 0 if a further run adds only chance."""
    distinct = min(apart[0, :, 1].min(), apart[1, :, 0].min()) > 2.0 * _NINE_OF_TEN
    separated = separations(apart, rivals)
    return float(min(separated[0, 1], separated[1, 0])) if distinct else 0.0


def _is_new(case: Case, variable: str) -> bool:
    read = {channel.variable for channel in case.channels}
    return variable in case.simulator.variables and variable not in read


def with_sensors(case: Case, sensors: Sequence[Sensor]) -> Case:
    """Return a case with additional sensors after its own."""
    shape = case.channels[0].repeats.shape
    more = tuple(
        Channel(s.name, s.variable, s.unit, np.zeros(shape), NoiseLevel(s.noise**2, source="given"))
        for s in sensors
    )
    task = replace(case.task, outputs=(*case.task.outputs, *(s.variable for s in sensors)))
    return replace(case, task=task, channels=(*case.channels, *more))


def _in_sigmas(subject: Subject, prediction: Prediction, sensor: Sensor, new: Sequence[bool]) -> FloatArray:
    """Return the readings of all runs, in standard deviations of their noise; those of the added sensor last."""
    observed = subject.observed
    known = observed.whiten([p[:-1] if n else p for p, n in zip(prediction, new, strict=True)])
    read = [
        np.sqrt(repeats) * p[-1] / sensor.noise
        for p, n, repeats in zip(prediction, new, observed.repeats, strict=True)
        if n
    ]
    return np.concatenate([stack(known, observed), *read])
