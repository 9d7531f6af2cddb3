"""What drives the rig: current commands and speed references, as samples that are held."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fmu_build.suggest import suggestion
from fmuid.core.errors import CampaignError
from fmuid.core.immutable import FloatArray

_TAPS = {7: (7, 6), 9: (9, 5), 11: (11, 9)}


def binary_sequence(order: int = 9) -> FloatArray:
    """Return one period of a maximum-length sequence of -1 and +1, 2**order - 1 long."""
    register, bits = [1] * order, []
    for _ in range(2**order - 1):
        bits.append(2.0 * register[-1] - 1.0)
        first = register[_TAPS[order][0] - 1] ^ register[_TAPS[order][1] - 1]
        register = [first, *register[:-1]]
    return np.array(bits)


def step(time: FloatArray, *, amplitude: float, at: float = 0.0) -> FloatArray:
    """Zero, and `amplitude` from `at` on."""
    return np.where(time >= at - 1e-9, amplitude, 0.0)


def sine(time: FloatArray, *, amplitude: float, frequency: float) -> FloatArray:
    """Sine from zero; `frequency` in Hz."""
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency * time))


def prbs(
    time: FloatArray,
    *,
    amplitude: float,
    clock: float,
    order: int = 9,
    first: int = 0,
    mean: float = 0.0,
    rise: float = 0.0,
    begin: float = 0.0,
) -> FloatArray:
    """Pseudo-random binary signal around `mean`.

    A bit lasts `clock` s; the sequence starts at its bit `first`. The mean is reached in `rise` s, the
    bits begin at `begin`.
    """
    bits = np.roll(binary_sequence(order), -first)
    index = np.floor((time - begin) / clock + 1e-6).astype(int)
    values = np.where(time >= begin - 1e-9, amplitude * bits[index % len(bits)], 0.0)
    ramp = np.minimum(time / rise, 1.0) if rise > 0 else 1.0
    return np.asarray(mean * ramp + values)


def polyline(time: FloatArray, *, times: Sequence[float], values: Sequence[float]) -> FloatArray:
    """Straight lines between the points, constant outside them."""
    return np.asarray(np.interp(time, times, values))


def staircase(time: FloatArray, *, values: Sequence[float], dwell: float, rise: float) -> FloatArray:
    """From zero to each of `values` in `rise` s, a new one every `dwell` s."""
    starts = dwell * np.arange(len(values))
    knots = np.column_stack([starts, starts + rise]).ravel()
    levels = np.column_stack([[0.0, *values[:-1]], values]).ravel()
    return np.asarray(np.interp(time, knots, levels))


KINDS: Mapping[str, Callable[..., FloatArray]] = {f.__name__: f for f in (step, sine, prbs, polyline, staircase)}


def samples(kind: str, time: FloatArray, options: Mapping[str, Any], where: str) -> FloatArray:
    """Return the samples of the input `kind` at `time`.

    Raises
    ------
    CampaignError
        There is no such kind, or its options are wrong.
    """
    if kind not in KINDS:
        raise CampaignError(f"no input kind '{kind}'", where=where, fix=suggestion(kind, KINDS))
    try:
        values = KINDS[kind](time, **options)
    except (TypeError, ValueError, KeyError) as error:
        raise CampaignError(f"the input's options are wrong: {error}", where=where) from None
    return np.asarray(values, dtype=np.float64)
