"""How noisy a measured signal is: from the file, from repeats, or from the setup's other runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.errors import UnitError
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.core.units import Conversion, conversion
from fmuid.data.noise_spectrum import RepeatedRuns


def conversion_at(source: str | None, target: str | None, where: str) -> Conversion:
    """Return the conversion between units; one that cannot be is an error that says `where`."""
    if source is None:
        return Conversion()
    try:
        return conversion(source, target)
    except UnitError as error:
        raise UnitError(error.what, where=where, fix=error.fix) from None


def noise_elsewhere(
    campaign: Campaign, run: Experiment, signal: str, unit: str | None, otherwise: FloatArray
) -> tuple[FloatArray, str]:
    """Return the noise that the same signal has in other runs of the same setup, if it is known there."""
    found = []
    for other in campaign.measurements:
        if other.setup != run.setup or other.repeat_of is not None or signal not in other.outputs:
            continue
        runs = campaign.measurements.repeats(other.id)
        convert = conversion_at(other.outputs[signal].unit, unit, f"signal '{signal}' of experiment '{other.id}'")
        given = [e.outputs[signal].sigma for e in runs if signal in e.outputs]
        same = [
            e.outputs[signal].values for e in runs if signal in e.outputs and np.array_equal(e.time, other.time)
        ]
        level, noise = noise_level(np.array(same), given if len(given) == len(same) else [None])
        if noise != "unknown":
            found.append(abs(convert.factor) * level[0])
    if not found:
        return otherwise, "unknown"
    return np.full(len(otherwise), float(np.sqrt(np.mean(np.square(found))))), "repeats"


def repeated_runs(campaign: Campaign, run: Experiment, signal: str, unit: str | None) -> tuple[RepeatedRuns, ...]:
    """Return the runs of the same setup and sampling interval that have the signal, each with its repeats."""
    found = []
    for other in campaign.measurements:
        if other.setup != run.setup or other.repeat_of is not None or signal not in other.outputs:
            continue
        if not np.isclose(np.mean(np.diff(other.time)), np.mean(np.diff(run.time)), rtol=1e-6):
            continue
        convert = conversion_at(other.outputs[signal].unit, unit, f"signal '{signal}' of experiment '{other.id}'")
        same = [
            convert(e.outputs[signal].values)
            for e in campaign.measurements.repeats(other.id)
            if signal in e.outputs and np.array_equal(e.time, other.time)
        ]
        found.append(RepeatedRuns(other.id, other.setup, other.time, (signal,), np.array(same)[:, None]))
    return tuple(found)


def noise_level(repeats: FloatArray, given: Sequence[float | None]) -> tuple[FloatArray, str]:
    """Return the noise level (N,) of a channel and where it comes from."""
    n = repeats.shape[1]
    known = [s for s in given if s is not None and s > 0.0]
    if len(known) == len(given):
        return np.full(n, float(np.sqrt(np.mean(np.square(known))))), "given"
    degrees = np.sum(np.maximum(np.sum(np.isfinite(repeats), axis=0) - 1, 0))
    if len(repeats) > 1 and degrees > 0:
        with np.errstate(invalid="ignore"):
            count = np.sum(np.isfinite(repeats), axis=0)
            mean = np.nansum(repeats, axis=0) / np.where(count > 0, count, np.nan)
        spread = float(np.sqrt(np.nansum((repeats - mean) ** 2) / degrees))
        # A quantised signal may repeat exactly; its noise is not below the quantum's.
        jumps = np.abs(np.diff(repeats, axis=1))
        quantum = float(np.min(jumps[jumps > 0.0], initial=np.inf))
        level = max(spread, quantum / np.sqrt(12.0) if spread == 0.0 and np.isfinite(quantum) else 0.0)
        if level > 0.0:
            return np.full(n, level), "repeats"
    scale = float(np.nanstd(repeats))
    return np.full(n, scale if scale > 0.0 else 1.0), "unknown"
