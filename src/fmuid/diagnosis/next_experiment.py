"""Which run to make next, or which sensor to add: what tells apart by the most noise sigmas what is still open.

The library of safe experiments is made of the campaign's own: their inputs scaled down, up and turned round, and
never beyond what the campaign has already driven the rig to by more than half. Sensors are those of the catalogue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.level import NoiseLevel
from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.catalogue import Sensor
from fmuid.diagnosis.extended_model import CampaignModel, Prediction
from fmuid.diagnosis.scores import project_off, stack
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.verdict import AddedSensor, NextExperiment
from fmuid.identification.problem.cases import Case, Channel

_SCALES = (-1.0, 0.25, 0.5, 1.25, 1.5)


def suggest(subject: Subject, alike: Sequence[Fitted]) -> NextExperiment | None:
    """Return the variation of an experiment that separates the first two of `alike` best; None if none does.

    It is taken to be repeated as often as the experiment that it varies.
    """
    if len(alike) < 2:
        return None
    a, b = alike[0], alike[1]
    best: NextExperiment | None = None
    for scale in _SCALES:
        cases = tuple(
            replace(c, task=replace(c.task, inputs={n: scale * u for n, u in c.task.inputs.items()}))
            for c in subject.model.cases
        )
        model = replace(subject.model, cases=cases)
        predictions = _predicted(subject, model, a, b)
        if predictions is None:
            continue
        whitened = [subject.observed.whiten(p) for p in predictions]
        for k, case in enumerate(cases):
            sigma = float(np.sqrt(subject.observed.repeats[k])) * _separation([w[k] for w in whitened])
            if best is None or sigma > best.separation_sigma:
                best = NextExperiment(
                    case.setup, f"as {case.id}, with its input times {scale:g}", sigma, (a.id, b.id)
                )
    return best if best is not None and best.separation_sigma > 1.0 else None


def sensor_to_add(subject: Subject, alike: Sequence[Fitted], *, beyond: float = 1.0) -> AddedSensor | None:
    """Return the sensor that separates the first two of `alike` best in the experiments as they are.

    None if none does by more than `beyond` sigma: what the best of further experiments would.
    """
    if len(alike) < 2:
        return None
    a, b = alike[0], alike[1]
    best: AddedSensor | None = None
    for sensor in subject.catalogue.sensors.values():
        new = [_is_new(c, sensor) for c in subject.model.cases]
        cases = tuple(_with(c, sensor) if n else c for c, n in zip(subject.model.cases, new, strict=True))
        predictions = _predicted(subject, replace(subject.model, cases=cases), a, b) if any(new) else None
        if predictions is None:
            continue
        sigma = _separation([_in_sigmas(subject, p, sensor, new) for p in predictions])
        if sigma > (beyond if best is None else best.separation_sigma):
            best = AddedSensor(sensor.name, sensor.description or sensor.variable, sigma, (a.id, b.id))
    return best


def _is_new(case: Case, sensor: Sensor) -> bool:
    read = {channel.variable for channel in case.channels}
    return sensor.variable in case.simulator.variables and sensor.variable not in read


def _with(case: Case, sensor: Sensor) -> Case:
    shape = case.channels[0].repeats.shape
    noise = NoiseLevel(sensor.noise**2, source="given")
    channel = Channel(sensor.name, sensor.variable, sensor.unit, np.zeros(shape), noise)
    task = replace(case.task, outputs=(*case.task.outputs, sensor.variable))
    return replace(case, task=task, channels=(*case.channels, channel))


def _in_sigmas(subject: Subject, prediction: Prediction, sensor: Sensor, new: Sequence[bool]) -> FloatArray:
    """Return what all runs read, in standard deviations of its noise; the last rows are the added sensor's."""
    observed = subject.observed
    known = observed.whiten([p[:-1] if n else p for p, n in zip(prediction, new, strict=True)])
    read = [
        np.sqrt(repeats) * p[-1] / sensor.noise
        for p, n, repeats in zip(prediction, new, observed.repeats, strict=True)
        if n
    ]
    return np.concatenate([stack(known, observed), *read])


def _predicted(subject: Subject, model: CampaignModel, a: Fitted, b: Fitted) -> list[Prediction] | None:
    """Return the predictions of `a`, of `b`, and of `a` with each nominal parameter moved; None if one fails."""
    steps = [{**a.fit.values, u.name: a.fit.values[u.name] + u.step} for u in subject.nominal]
    outcomes = model.predict([a.fit.values, b.fit.values, *steps])
    good = [o for o in outcomes if not isinstance(o, SimulationError)]
    return good if len(good) == len(outcomes) else None


def _separation(whitened: Sequence[FloatArray]) -> float:
    """Return how far the second is from the first, less what the others, moved parameters, can imitate."""
    base, other, *moved = whitened
    moves = np.stack([m - base for m in moved], axis=1)
    norms = np.linalg.norm(moves, axis=0)
    difference = other - base
    if (norms > 0).any():
        q, _ = np.linalg.qr(moves[:, norms > 0] / norms[norms > 0])
        difference = project_off(difference, q)
    return float(np.linalg.norm(difference))
