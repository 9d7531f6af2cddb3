"""Rigs whose plants are in C, with their effects at unit size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from tests.known_rigs.compiled import SHAPE, CompiledPlant, Place
from tests.known_rigs.plant import Floats, Rig

_DIRECTED = {  # laws whose sign is open
    "asymmetry",
    "weight",
    "thermal_friction",
    "gain",
    "offset",
    "drift",
    "crosstalk",
    "hardening",
    "pulsation",
    "chaos",
    "product",
    "slip",
    "value",
}
# What shapes a law, by the usual potential and rate at its place and the run's length.
_SHAPES: Mapping[str, Callable[[Place, float], float]] = {
    "stribeck": lambda at, _: 0.15 * at.rate,
    "cogging": lambda at, _: max(round(12.0 / at.range), 2.0),  # once per turn would be an imbalance
    "presliding": lambda at, _: 0.01 * at.range,
    "hysteresis": lambda at, _: 0.2 * at.range,
    "thermal_friction": lambda _, duration: 0.3 * duration,
    "capacity": lambda _, duration: 0.08 * duration,
    "resonator": lambda _, duration: 2 * np.pi * 9.0 / duration,
    "pulsation": lambda _, __: 5.3,
    "relay": lambda _, duration: 0.02 * duration,
    "chaos": lambda _, duration: duration / 40.0,
    "slip": lambda _, __: 0.55,
}


def directed(effect: str) -> bool:
    """Return whether an effect's size may have either sign."""
    return effect.partition("@")[0] in _DIRECTED


def compiled_rig(
    name: str,
    plant: CompiledPlant,
    step: float,
    runs: Mapping[str, Floats],
    *,
    units: Mapping[str, str],
    noise: Mapping[str, float],
    inside: Sequence[str],
    held: Sequence[str],
    outside: Sequence[str],
    redundant: Sequence[str] = (),
    same: Mapping[str, Sequence[str]] = {},
    near: Mapping[str, Sequence[str]] = {},
) -> Rig:
    """Make a rig whose effects have a size of 1, to be scaled; inputs are held for two samples each.

    No catalogue has the effects of `outside`. `held` and `redundant` are the parameters that a first campaign
    does not free: the former have an effect of their own, what the latter do others can do.
    """
    whole = np.hstack([np.atleast_2d(u) for u in runs.values()])
    plant = replace(plant, largest=dict(zip(plant.inputs, np.abs(whole).max(axis=1).tolist(), strict=True)))
    samples = 2 * np.shape(next(iter(runs.values())))[-1]
    time = step * np.arange(samples)

    def unit(effect: str) -> dict[str, float]:
        law, _, where = effect.partition("@")
        if where not in plant.places or law == "value":
            return {effect: 1.0}
        shape = _SHAPES.get(law)
        return {effect: 1.0, effect + SHAPE: 1.0 if shape is None else float(shape(plant.places[where], time[-1]))}

    return Rig(
        name,
        plant.name,
        time,
        {n: np.repeat(u, 2, axis=-1) for n, u in runs.items()},
        units,
        [noise[n] for n in plant.outputs],
        {e: unit(e) for e in (*inside, *outside, *(f"value@{h}" for h in held))},
        [p for p in plant.parameters if p not in (*held, *redundant)],
        plant,
        same,
        tuple(outside),
        {e: {o: unit(o) for o in others} for e, others in near.items()},
    )


def times(step: float, samples: int) -> Floats:
    return 2 * step * np.arange(samples // 2)


def chirp(time: Floats, slow: float, fast: float) -> Floats:
    """Return a sine whose frequency rises in proportion to time."""
    end = time[-1]
    return np.sin(2 * np.pi * (slow + 0.5 * (fast - slow) * time / end) * time)
