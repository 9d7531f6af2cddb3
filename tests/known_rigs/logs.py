"""Logs of a plant: readings with the noise of sensors, one CSV file a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.signal import lfilter

from tests.known_rigs.plant import Extra, Floats, Rig

SPREAD = 0.2  # of the plant's parameters around the model's
Noise = Literal["white", "coloured", "heteroscedastic", "quantised", "drift", "spikes", "inputs"]
NOISES: tuple[Noise, ...] = get_args(Noise)
UNITS: Mapping[str, tuple[str, float]] = {  # what else a signal may be logged in
    "m": ("mm", 1e3), "rad": ("deg", 180 / np.pi), "V": ("mV", 1e3), "A": ("mA", 1e3), "N.m": ("kN.m", 1e-3),
    "Pa": ("kPa", 1e-3), "kg/s": ("g/s", 1e3), "m/s": ("km/h", 3.6),
}  # fmt: skip
_MEMORY = 20.0  # samples, of coloured noise
_QUANTUM = 3.0  # standard deviations of what noise would be otherwise; an encoder that all but repeats exactly
_SPIKED = 0.004  # of the samples
INPUT_NOISE = 3e-3  # of the input's range


@dataclass(frozen=True)
class Recording:
    """How a plant was recorded.

    Attributes
    ----------
    every
        Takes every so many samples only.
    quieter
        By what factor the noise is less than the rig's.
    other_units
        Whether signals are logged in `UNITS`.
    """

    repeats: int = 3
    noise: Noise = "white"
    every: int = 1
    quieter: float = 1.0
    other_units: bool = False


def drawn_factors(rig: Rig, rng: np.random.Generator) -> dict[str, float]:
    """Return by what factors a plant's parameters differ from its model's."""
    return {name: float(np.exp(rng.uniform(-SPREAD, SPREAD))) for name in rig.parameters}


def _white(y: Floats, sigma: Floats, rng: np.random.Generator) -> Floats:
    return np.asarray(y + rng.normal(size=y.shape) * sigma)


def _averaged(white: Floats, every: int) -> Floats:
    """Return noise of the same spectral density at a lower rate, of unit variance again."""
    starts = np.arange(0, white.shape[1], every)
    return np.asarray(np.add.reduceat(white, starts, axis=1) / np.sqrt(np.diff([*starts, white.shape[1]])))


def _coloured(y: Floats, sigma: Floats, rng: np.random.Generator) -> Floats:
    keep = np.exp(-1.0 / _MEMORY)
    drive = rng.normal(size=y.shape)
    drive[:, 1:] *= np.sqrt(1.0 - keep**2)
    return np.asarray(y + lfilter([1.0], [1.0, -keep], drive, axis=1) * sigma)


def _heteroscedastic(y: Floats, sigma: Floats, rng: np.random.Generator) -> Floats:
    share = np.abs(y - y[:, :1]) / np.maximum(np.max(np.abs(y - y[:, :1]), axis=1, keepdims=True), 1e-300)
    return np.asarray(y + rng.normal(size=y.shape) * sigma * (0.4 + 1.6 * share))


def _quantised(y: Floats, sigma: Floats, rng: np.random.Generator) -> Floats:
    step = _QUANTUM * sigma
    return np.asarray(step * np.round((y + 0.05 * rng.normal(size=y.shape) * sigma) / step))


def _drift(y: Floats, sigma: Floats, rng: np.random.Generator) -> Floats:
    course = np.linspace(0.0, 1.0, y.shape[1])
    run_level = rng.normal(size=(len(y), 1)) + rng.normal(size=(len(y), 1)) * course
    return _white(np.asarray(y + run_level * sigma), sigma, rng)


def decorrelated(y: Floats, noise: Noise) -> Floats:
    """Return readings (..., N), in standard deviations, transformed such that their noise would be white."""
    if noise == "coloured":
        keep = np.exp(-1.0 / _MEMORY)
        after = (y[..., 1:] - keep * y[..., :-1]) / np.sqrt(1.0 - keep**2)
        return np.concatenate([y[..., :1], after], axis=-1)
    if noise == "drift":
        courses = np.stack([np.ones(y.shape[-1]), np.linspace(0.0, 1.0, y.shape[-1])], axis=1)
        u, s, _ = np.linalg.svd(courses, full_matrices=False)
        return np.asarray(y - (y @ u) * (1.0 - 1.0 / np.sqrt(1.0 + s**2)) @ u.T)
    return y


def _spikes(y: Floats, sigma: Floats, rng: np.random.Generator) -> Floats:
    where = rng.random(y.shape) < _SPIKED
    size = rng.uniform(10.0, 40.0, y.shape) * rng.choice([-1.0, 1.0], y.shape)
    return _white(np.asarray(y + where * size * sigma), sigma, rng)


KINDS: Mapping[Noise, Callable[[Floats, Floats, np.random.Generator], Floats]] = {
    "coloured": _coloured, "heteroscedastic": _heteroscedastic, "quantised": _quantised,
    "drift": _drift, "spikes": _spikes, "inputs": _white,
}  # fmt: skip


def write_logs(
    rig: Rig,
    factors: Mapping[str, float],
    effect: Mapping[str, float],
    folder: Path,
    recording: Recording,
    rng: np.random.Generator,
    *,
    extras: Mapping[str, Extra] | None = None,
) -> list[Path]:
    """Write one CSV a run: every input, each several times with noise of its own, maybe with extras by input."""
    sigma = np.asarray(rig.noise)[:, None] / recording.quieter
    units = {n: UNITS.get(u, (u, 1.0)) if recording.other_units else (u, 1.0) for n, u in rig.signals.items()}
    header = ",".join(["time [s]", *(f"{n} [{unit}]" for n, (unit, _) in units.items())])
    scale = np.array([1.0, *(s for _, s in units.values())])
    files = []
    for name, u in rig.inputs.items():
        more = () if extras is None else (extras[name],)
        full = rig.simulate(factors, effect, rig.time, u, *more)
        y = full[:, :: recording.every]
        given = np.atleast_2d(u)[:, :: recording.every]
        for k in range(recording.repeats):
            if recording.noise == "white":  # of one generator, the same information at every rate
                noisy = np.asarray(y + _averaged(rng.normal(size=full.shape), recording.every) * sigma)
            else:
                noisy = KINDS[recording.noise](y, sigma, rng)
            read = given
            if recording.noise == "inputs":
                read = given + rng.normal(size=given.shape) * INPUT_NOISE * np.ptp(given, axis=1, keepdims=True)
            table = np.vstack([rig.time[:: recording.every], read, noisy]).T * scale
            file = folder / f"{name}_{k}.csv"
            np.savetxt(file, table, delimiter=",", header=header, comments="", fmt="%.9g")
            files.append(file)
    return files
