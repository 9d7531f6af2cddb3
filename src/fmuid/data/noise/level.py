"""Noise level of a measured signal: from the file, from repeats, or from the setup's other runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.experiments import NEAR_TIMES, Experiment, Measurements
from fmuid.core.immutable import FloatArray
from fmuid.core.units import conversion_at
from fmuid.data.noise.resolution import quantum, repeating_variance
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.data.noise.single_run import fast_variance

Source = Literal["given", "repeats", "unknown"]
GAP_THAT_MATTERS = 0.25  # noise floors: smaller gaps are within what sampling and discretisation of a rig leave


@dataclass(frozen=True, slots=True)
class NoiseLevel:
    """Noise of one sample of a signal.

    Parameters
    ----------
    differing
        Variance of the differences between repeats.
    repeating
        Variance of the rounding error that repeats share; averaging over runs does not reduce it.
    source
        ``given`` in the file; ``repeats``, from the spread of this run's repeats or those of the setup's other
        runs; or ``unknown``: then `differing` is the variance of the signal itself, and only the relative size of
        residuals is meaningful.
    """

    differing: float
    repeating: float = 0.0
    source: Source = "unknown"

    @property
    def sigma(self) -> float:
        """Standard deviation of the error of one sample."""
        return float(np.sqrt(self.differing + self.repeating))

    def scaled(self, factor: float) -> NoiseLevel:
        """Return the noise of the signal multiplied by `factor`."""
        return NoiseLevel(factor**2 * self.differing, factor**2 * self.repeating, self.source)

    def of_mean(self, count: FloatArray) -> FloatArray:
        """Return the standard deviation of the mean of `count` samples, inf where the count is zero."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.sqrt(self.differing / np.asarray(count, dtype=np.float64) + self.repeating))


def noise_elsewhere(campaign: Campaign, run: Experiment, signal: str, unit: str | None) -> NoiseLevel | None:
    """Return the signal's noise in other runs of the same setup; None if it is unknown there as well."""
    variances = []
    for other in campaign.measurements:
        if other.setup != run.setup or other.repeat_of is not None or signal not in other.outputs:
            continue
        runs = campaign.measurements.repeats(other.id)
        convert = conversion_at(other.outputs[signal].unit, unit, f"signal '{signal}' of experiment '{other.id}'")
        given = [e.outputs[signal].sigma for e in runs if signal in e.outputs]
        same = [e.outputs[signal].values for e in runs if signal in e.outputs and e.sampled_like(other)]
        level = noise_level(np.array(same), given if len(given) == len(same) else [None])
        if level.source != "unknown":
            variances.append((convert.factor**2 * level.differing, convert.factor**2 * level.repeating))
    if not variances:
        return None
    differing, repeating = np.mean(variances, axis=0)
    return NoiseLevel(float(differing), float(repeating), "repeats")


def input_sigma(measurements: Measurements, run: Experiment, name: str) -> float | None:
    """Return the standard deviation of the noise of a recorded input, in its unit; None if it is unknown.

    It is given, or follows from runs of one reference: from the fast part of the differences between them, as
    controllers react more slowly.
    """
    signal = run.inputs[name]
    if signal.sigma is not None:
        return signal.sigma
    reference = run.repeat_of_reference or run.id
    near = [e for e in measurements if reference in (e.id, e.repeat_of_reference)]
    recorded = [e.inputs[name].values for e in near if name in e.inputs and e.sampled_like(run, within=NEAR_TIMES)]
    if len(recorded) < 2:
        return None
    apart = np.array(recorded) - np.mean(recorded, axis=0)
    sigma = float(np.sqrt(fast_variance(apart) * len(recorded) / (len(recorded) - 1)))
    return sigma if sigma > 0.0 else None


def repeated_runs(campaign: Campaign, run: Experiment, signal: str, unit: str | None) -> tuple[RepeatedRuns, ...]:
    """Return the runs of the same setup and sampling interval that have the signal, each with its repeats."""
    repeated = []
    for other in campaign.measurements:
        if other.setup != run.setup or other.repeat_of is not None or signal not in other.outputs:
            continue
        if not np.isclose(np.mean(np.diff(other.time)), np.mean(np.diff(run.time)), rtol=1e-6):
            continue
        convert = conversion_at(other.outputs[signal].unit, unit, f"signal '{signal}' of experiment '{other.id}'")
        same = [
            convert(e.outputs[signal].values)
            for e in campaign.measurements.repeats(other.id)
            if signal in e.outputs and e.sampled_like(other)
        ]
        repeated.append(RepeatedRuns(other.id, other.setup, other.time, (signal,), np.array(same)[:, None]))
    return tuple(repeated)


def noise_level(repeats: FloatArray, given: Sequence[float | None]) -> NoiseLevel:
    """Return the noise level of a channel.

    Parameters
    ----------
    repeats
        (R, N) samples, NaN where one is missing.
    given
        Standard deviation of the runs' noise as given by the user. For a quantised signal, the quantisation noise
        is the lower limit.
    """
    step = quantum(repeats)
    known = [s for s in given if s is not None and s > 0.0]
    if len(known) == len(given):
        total = float(np.mean(np.square(known)))
        repeating = float(repeating_variance(_differing(repeats)[0], step)) if len(repeats) > 1 else 0.0
        return NoiseLevel(max(total - repeating, 0.0), repeating, "given")
    differing, degrees = _differing(repeats)
    if degrees > 0:
        repeating = float(repeating_variance(differing, step))
        if differing + repeating > 0.0:
            return NoiseLevel(differing, repeating, "repeats")
    scale = float(np.nanstd(repeats))
    return NoiseLevel(scale**2 if scale > 0.0 else 1.0)


def _differing(repeats: FloatArray) -> tuple[float, float]:
    """Return the variance of the differences between (R, N) repeats, exactly 0 if they agree, and its degrees."""
    there = np.isfinite(repeats)
    count = there.sum(axis=0)
    degrees = float(np.sum(np.maximum(count - 1, 0)))
    if degrees == 0.0:
        return 0.0, 0.0
    first = repeats[np.argmax(there, axis=0), np.arange(repeats.shape[1])]
    apart = np.where(there, repeats - first, 0.0)
    apart = np.where(there, apart - apart.sum(axis=0) / np.maximum(count, 1), 0.0)
    return float(np.sum(apart**2)) / degrees, degrees
