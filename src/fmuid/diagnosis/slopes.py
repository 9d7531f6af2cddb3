"""Predictions and their derivatives at several points, simulated together: exact, or else finite differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fmuid.core.errors import SimulationError
from fmuid.diagnosis.extended_model import CampaignModel, Prediction
from fmuid.effects.effect import Unknown


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """A model near a point: (C, N) predictions of every run, and their derivatives by each unknown."""

    values: Mapping[str, float]
    prediction: Prediction
    slopes: Mapping[str, Prediction]


def predicted(model: CampaignModel, points: Sequence[Mapping[str, float]]) -> list[Prediction]:
    """Return the predictions at every point.

    Raises
    ------
    SimulationError
        A run failed.
    """
    found: list[Prediction] = []
    for outcome in model.predict(points):
        if isinstance(outcome, SimulationError):
            raise outcome
        found.append(outcome)
    return found


def linear_at(
    model: CampaignModel, points: Sequence[Mapping[str, float]], unknowns: Sequence[Sequence[Unknown]]
) -> list[Linear]:
    """Return the model near every point, linearised along the unknowns of that point.

    Raises
    ------
    SimulationError
        A run failed.
    """
    names = list(dict.fromkeys(u.name for us in unknowns for u in us))
    exact = model.tangents_at(points, names)
    moved: list[tuple[int, Unknown, float, Mapping[str, float]]] = []
    for k, (values, us) in enumerate(zip(points, unknowns, strict=True)):
        for u in us:
            if u.name not in exact[k]:
                step = u.step if values[u.name] + u.step <= u.upper else -u.step
                moved.append((k, u, step, {**values, u.name: values[u.name] + step}))
    predictions = predicted(model, [*points, *(there for *_, there in moved)])
    slopes = [
        {u.name: found[u.name] for u in us if u.name in found} for found, us in zip(exact, unknowns, strict=True)
    ]
    for (k, u, step, _), there in zip(moved, predictions[len(points) :], strict=True):
        slopes[k][u.name] = tuple((a - b) / step for a, b in zip(there, predictions[k], strict=True))
    return [
        Linear(values, prediction, found)
        for values, prediction, found in zip(points, predictions, slopes, strict=False)
    ]
