"""Runs with far more samples than their signals need, averaged over several of them.

Responses of a model to what it may lack are smooth where its signals are. A run that is sampled a hundred times as
often as its signals change costs a hundred times as much to simulate, and says no more about them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.experiments import Experiment, Signal
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.transform import coefficient_frequencies, real_spectrum

_KEPT = 1500  # samples of a run that remain at least
_LOST = 1e-4  # share of each output's energy that may be faster than what remains: a hundredth of its amplitude
_EVEN = 1e-6  # relative differences of a sampling interval that do not count


def averaged(campaign: Campaign) -> tuple[Campaign, tuple[str, ...]]:
    """Return a campaign whose runs are averaged over as many samples as loses next to nothing, with notes.

    Outputs lose at most a ten-thousandth of their energy, that above half the new sampling rate. Held inputs keep
    their mean between two samples; outputs and linear inputs are weighted means around theirs. Runs stay as they
    are if they have fewer than 3000 samples, or uneven or missing ones, if inputs are neither held nor linear, and
    if runs are cut into segments or have an observer, or signals a filter or a timing of their own.
    """
    if campaign.filters or campaign.timings or any(s.segments or s.observer for s in campaign.stages.values()):
        return campaign, ()
    notes, experiments = [], dict(campaign.measurements.experiments)
    for setup in dict.fromkeys(e.setup for e in campaign.measurements):
        runs = [e for e in campaign.measurements if e.setup == setup]
        timing = campaign.models[setup].timing if setup in campaign.models else ""
        judged = [e for e in runs if e.id not in campaign.validation]
        count = _count(judged) if judged and timing in ("held", "linear") else 1
        if count > 1:
            experiments |= {e.id: _averaged(e, count, held=timing == "held") for e in runs}
            rate = 0.5 / (count * float(np.mean(np.diff(runs[0].time))))
            notes.append(
                f"Runs of setup '{setup}' were averaged over {count} samples: no output has more than "
                f"{_LOST:.2%} of its energy above {rate:.3g} Hz."
            )
    measurements = replace(campaign.measurements, experiments=experiments)
    return (replace(campaign, measurements=measurements), tuple(notes)) if notes else (campaign, ())


def _count(runs: Sequence[Experiment]) -> int:
    """Return over how many samples runs may be averaged: a power of two."""
    steps = [np.diff(e.time) for e in runs]
    step = float(np.mean(np.concatenate(steps)))
    if any(np.abs(s - step).max() > _EVEN * step for s in steps):
        return 1
    courses = [s.values for e in runs for s in e.outputs.values()]
    most, count = min(len(e.time) for e in runs) // _KEPT, 1
    while 2 * count <= most and all(_lost(y, step, 2 * count) <= _LOST for y in courses):
        count *= 2
    return count


def _lost(y: FloatArray, step: float, count: int) -> float:
    """Return the share of a signal's energy that is faster than what an average over `count` samples keeps."""
    power = real_spectrum((y - np.linspace(y[0], y[-1], len(y)))[None])[0] ** 2
    fast = coefficient_frequencies(len(y), step) > 0.5 / (count * step)
    return float(power[fast].sum() / power.sum()) if 0.0 < power.sum() < np.inf else 1.0


def _averaged(e: Experiment, count: int, *, held: bool) -> Experiment:
    rows = len(e.time) // count

    def mean(signal: Signal) -> Signal:
        values, noise = signal.values, signal.sigma
        if held and signal.causality == "input":
            means = values[: rows * count].reshape(rows, count).mean(axis=1)
        else:
            around = np.pad(values, count // 2, mode="reflect", reflect_type="odd")
            weights = np.concatenate([[0.5], np.ones(count - 1), [0.5]]) / count
            means = np.convolve(around, weights, "valid")[::count][:rows]
        return replace(signal, values=means, sigma=None if noise is None else noise / np.sqrt(count))

    return replace(
        e,
        time=e.time[: rows * count : count],
        signals={name: mean(s) for name, s in e.signals.items()},
        unused={name: mean(s) for name, s in e.unused.items()},
    )
