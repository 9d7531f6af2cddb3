"""Effects between a model and its signals: they wrap any FMU, also one whose inside nobody can edit.

A parameter named ``<signal>.<property>`` disturbs that signal: ``offset``, ``gain`` (neutral 1), ``lag`` (s),
``delay`` (s) and ``saturation`` (largest absolute value over the unit; 0 for none).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from scipy.signal import lfilter

from fmuid.core.immutable import FloatArray

NEUTRAL = {"offset": 0.0, "gain": 1.0, "lag": 0.0, "delay": 0.0, "saturation": 0.0}


def split_signal_parameters(
    values: Mapping[str, float], signals: Collection[str]
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Return the parameters of the model, and signal -> property -> value of those that are not neutral."""
    plain: dict[str, float] = {}
    disturbed: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        signal, _, prop = name.rpartition(".")
        if signal in signals and prop in NEUTRAL:
            if value != NEUTRAL[prop]:
                disturbed.setdefault(signal, {})[prop] = value
        else:
            plain[name] = value
    return plain, disturbed


def disturb_input(time: FloatArray, u: FloatArray, effect: Mapping[str, float]) -> FloatArray:
    """Return the (N,) samples that reach the model; delay and lag of held inputs act in the mean over a step."""
    if not effect:
        return u
    y = u * effect.get("gain", 1.0) + effect.get("offset", 0.0)
    limit = effect.get("saturation", 0.0)
    if limit > 0.0:
        y = limit * np.tanh(y / limit)
    if effect.get("delay", 0.0) > 0.0:
        y = _delayed_hold(time, y, effect["delay"])
    if effect.get("lag", 0.0) > 0.0:
        y = _lagged_hold(time, y, effect["lag"])
    return np.asarray(y)


def disturb_output(
    time: FloatArray, y: FloatArray, names: Sequence[str], effects: Mapping[str, Mapping[str, float]]
) -> FloatArray:
    """Return the (C, N) readings of disturbed sensors."""
    if not any(name in effects for name in names):
        return y
    out = np.array(y)
    for row, name in enumerate(names):
        effect = effects.get(name)
        if not effect:
            continue
        if effect.get("lag", 0.0) > 0.0:
            out[row] = _lagged_samples(time, out[row], effect["lag"])
        if effect.get("delay", 0.0) > 0.0:
            out[row] = np.interp(time - effect["delay"], time, out[row])
        limit = effect.get("saturation", 0.0)
        if limit > 0.0:
            out[row] = limit * np.tanh(out[row] / limit)
        out[row] = effect.get("gain", 1.0) * out[row] + effect.get("offset", 0.0)
    return out


def _delayed_hold(time: FloatArray, u: FloatArray, delay: float) -> FloatArray:
    """Mean over each step of a held input delayed by `delay`."""
    edges = np.append(time, 2 * time[-1] - time[-2])
    area = np.concatenate([[0.0], np.cumsum(u * np.diff(edges))])
    shifted = np.interp(edges - delay, edges, area)
    early = edges - delay < edges[0]
    shifted[early] = u[0] * (edges[early] - delay - edges[0])
    return np.asarray(np.diff(shifted) / np.diff(edges))


def _lagged_hold(time: FloatArray, u: FloatArray, lag: float) -> FloatArray:
    """Mean over each step of a held input after a first-order lag, at rest before the first sample."""
    dt = float(np.mean(np.diff(time)))
    keep = np.exp(-dt / lag)
    end = lfilter([1.0 - keep], [1.0, -keep], u)
    begin = np.concatenate([[0.0], end[:-1]])
    return np.asarray(u + (begin - u) * lag / dt * (1.0 - keep))


def _lagged_samples(time: FloatArray, y: FloatArray, lag: float) -> FloatArray:
    """First-order lag of samples taken as linear between each other, settled before the first."""
    dt = float(np.mean(np.diff(time)))
    keep = np.exp(-dt / lag)
    mean = lag / dt * (1.0 - keep)
    out = np.asarray(lfilter([1.0 - mean, mean - keep], [1.0, -keep], y - y[0]))
    return out + float(y[0])
