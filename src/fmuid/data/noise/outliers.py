"""Outliers: spikes of a few samples, and values at which a sensor was stuck.

They are searched run by run in the differences from the repeats, before the noise is estimated: a single spike of
fifty standard deviations would otherwise triple the noise of a whole setup. A difference that many samples show is
part of the signal and is kept. In a run without repeats, the signal's own motion hides spikes; what a model leaves
of it shows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from fmuid.core.experiments import Experiment, Measurements, OutlierKind, Outliers
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.resolution import quantum

Mask = NDArray[np.bool_]

_LONGEST = 3  # samples in the longest spike
_WINDOW = 51  # samples from which a signal's usual step is taken
_AT_ONCE = 50_000  # windows processed together: 20 MB
_SPIKE = 10.0  # relative to that step; normal noise has such a spike once in 1e20 samples
_SPIKE_LEFT = 5.0  # the same of what a model leaves, which hardly moves: once in 6e8 samples
_RELEASE = 5.0  # relative to the steps after it: a jump ends a held value, but not a signal at rest
_SHORTEST = 3  # samples in the shortest held value
_BY_CHANCE = 1e-3  # expected number of stretches of equal values below which they are not chance
_MOST = 0.05  # share of the samples above which they belong to the signal
_MAD = 1.4826  # from a normal's median absolute value to its standard deviation


def without_outliers(measurements: Measurements) -> tuple[Measurements, tuple[Outliers, ...]]:
    """Return the measurements with outliers in outputs replaced by NaN, and the list of outliers."""
    removed: list[Outliers] = []
    changed: dict[str, Experiment] = {}
    for origin in dict.fromkeys(e.origin for e in measurements):
        group = measurements.repeats(origin)
        for name in dict.fromkeys(n for e in group for n in e.outputs):
            runs = [e for e in group if name in e.outputs]
            same = [e for e in runs if e.sampled_like(runs[0])]
            others = [[e] for e in runs if e not in same]
            for alike in (same, *others):
                values = np.array([e.outputs[name].values for e in alike])
                stirred = just_moved([signal.values for signal in alike[0].inputs.values()], len(alike[0].time))
                for e, spikes, held in zip(alike, *outliers(values, stirred), strict=True):
                    kinds: dict[OutlierKind, Mask] = {"spike": spikes, "held": held & ~spikes}
                    for kind, mask in kinds.items():
                        if mask.any():
                            removed.append(Outliers(e.id, name, kind, tuple(map(float, e.time[mask]))))
                    if (spikes | held).any():
                        changed[e.id] = _masked(changed.get(e.id, e), name, spikes | held)
    if not changed:
        return measurements, ()
    experiments = {e.id: changed.get(e.id, e) for e in measurements}
    return replace(measurements, experiments=experiments), tuple(removed)


def outliers(values: FloatArray, stirred: Mask) -> tuple[Mask, Mask]:
    """Return masks of spikes and of held values in (R, N) samples of one signal, from R runs with the same inputs.

    Parameters
    ----------
    stirred
        (N,) mask of samples just after a jump of an input; a deviation of a single run there may be its response.
    """
    spikes, held = np.zeros(values.shape, dtype=bool), np.zeros(values.shape, dtype=bool)
    step = quantum(values)
    for k, run in enumerate(values):
        if np.isfinite(run).sum() < _WINDOW:
            continue
        others = np.delete(values, k, axis=0)
        common = _median(others) if len(others) else np.zeros(len(run))
        lonely = _spikes(run - common, step) & _spikes_or_all(run, others, step)
        if not len(others):
            lonely &= ~stirred
        stuck = _held(run, step)
        for mask, out in ((lonely, spikes), (stuck, held)):
            if mask.sum() <= _MOST * len(run):
                out[k] = mask
    return spikes, held


def spikes_left(run: FloatArray, predicted: FloatArray, stirred: Mask) -> Mask:
    """Return the (N,) mask of spikes of one sample in what a prediction leaves of a run.

    Longer ones may be what the model lacks. `stirred` is as for `outliers`. Where an input has just moved, a spike
    that is smaller than what the prediction moves nearby may come from it, late or early; a larger one has moved
    the input itself, through a controller.
    """
    left = run - predicted
    spikes = _spikes(left, 0.0, _SPIKE_LEFT, longest=1)
    moves = np.abs(np.diff(predicted, prepend=predicted[:1], append=predicted[-1:]))
    nearby = np.max(sliding_window_view(np.pad(moves, 2 * _LONGEST), 4 * _LONGEST + 2), axis=1)
    there = np.flatnonzero(spikes)
    size = np.abs(left[there] - 0.5 * (left[there - 1] + left[there + 1]))
    spikes[there] = ~stirred[there] | (size > nearby[there])
    enough = np.isfinite(left).sum() >= _WINDOW and spikes.sum() <= _MOST * len(left)
    return spikes if enough else np.zeros(len(left), dtype=bool)


def _spikes_or_all(run: FloatArray, others: FloatArray, step: float) -> Mask:
    """Return spikes; if two runs differ in a sample, either may have the spike: also the one it sticks out of."""
    return _spikes(run, step, factor=0.5 * _SPIKE) if len(others) == 1 else np.ones(len(run), dtype=bool)


def _spikes(values: FloatArray, step: float, factor: float = _SPIKE, longest: int = _LONGEST) -> Mask:
    """Return where a few samples stick out to one side of those before and after them."""
    there = np.flatnonzero(np.isfinite(values))
    y = values[there]
    moves = np.abs(np.diff(y))
    least = max(step, 0.1 * _MAD * float(np.mean(moves)))
    windows = sliding_window_view(np.pad(moves, _WINDOW // 2, mode="symmetric"), _WINDOW)
    spikes = np.zeros(len(values), dtype=bool)
    for width in range(1, longest + 1):
        beyond = _sticks_out(y, width)
        places = np.flatnonzero(beyond > factor * least)
        usual = _MAD * _medians(windows, places)
        for begin in places[beyond[places] > factor * usual] + 1:
            spikes[there[begin : begin + width]] = True
    return spikes


def _medians(windows: FloatArray, places: NDArray[np.intp]) -> FloatArray:
    """Return the medians of some windows, in batches that fit into memory."""
    some = np.array_split(places, len(places) // _AT_ONCE + 1)
    return np.concatenate([np.median(windows[chosen], axis=1) for chosen in some])


def _sticks_out(y: FloatArray, width: int) -> FloatArray:
    """Return by how much the smallest of every block of `width` inner samples exceeds both its neighbours."""
    n = len(y)
    count = n - width - 1
    if count < 1:
        return np.zeros(0)
    blocks = np.stack([y[1 + k : 1 + k + count] for k in range(width)])
    before, after = y[:count], y[width + 1 :]
    above = blocks.min(axis=0) - np.maximum(before, after)
    below = np.minimum(before, after) - blocks.max(axis=0)
    return np.asarray(np.maximum(above, below))


def _held(values: FloatArray, step: float) -> Mask:
    """Return the samples that repeat the previous one while the signal moved on: a jump ends them."""
    repeats = np.zeros(len(values), dtype=bool)
    moves = np.abs(np.diff(values))
    equal = moves == 0.0
    chance = float(np.mean(equal))
    if chance in (0.0, 1.0):
        return repeats
    ends = np.flatnonzero(np.diff(np.concatenate([[False], equal, [False]]).astype(int)))
    for begin, end in ends.reshape(-1, 2):  # steps begin..end-1 are zero, so samples begin..end are equal
        length = end - begin
        outside = (equal.sum() - length) / max(len(equal) - length, 1)
        after = moves[end + 1 : end + 1 + 20]
        expected = len(values) * outside**length  # expected number of such stretches, if equal values were chance
        if length + 1 < _SHORTEST or end >= len(moves) - 5 or expected > _BY_CHANCE:
            continue
        if moves[end] > max(_RELEASE * _MAD * float(np.nanmedian(after)), 3.0 * step):
            repeats[begin + 1 : end + 1] = True
    return repeats


def _median(others: FloatArray) -> FloatArray:
    there = np.isfinite(others).any(axis=0)
    return np.asarray(np.where(there, np.nanmedian(np.where(there, others, 0.0), axis=0), np.nan))


def just_moved(inputs: Sequence[FloatArray], samples: int) -> Mask:
    """Return the (N,) mask of samples where an input, (N,), has just moved far more than it usually does."""
    stirred = np.zeros(samples, dtype=bool)
    for values in inputs:
        moves = np.abs(np.diff(values, prepend=values[0]))
        jumps = moves > _SPIKE * max(float(np.median(moves)), 1e-12 * float(np.abs(values).max(initial=0.0)))
        for late in range(-1, 2 * _LONGEST):
            stirred |= np.roll(jumps, late)
    return stirred


def _masked(experiment: Experiment, name: str, mask: Mask) -> Experiment:
    signal = experiment.signals[name]
    left = replace(signal, values=np.where(mask, np.nan, signal.values))
    return replace(experiment, signals={**experiment.signals, name: left})
