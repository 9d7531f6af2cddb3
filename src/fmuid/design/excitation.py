"""Excitations defined by a few numbers each, which stay within a range and a slope whatever the numbers are.

Every signal begins and ends at rest. Multisines have random or optimised phases (Schoukens, Swevers, Pintelon and
van der Auweraer 2004); binary sequences are of maximum length (Godfrey 1993).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np

from fmuid.core.campaign import DesignSpec, Family
from fmuid.core.immutable import FloatArray

_LINES = 8  # lines of a multisine
_LEVELS = 8  # levels of a staircase
_FASTEST = 2.5  # samples per period of the highest frequency
_CLIPPED = 0.95  # largest share of a wave's crest that is clipped
_ORDER = 9  # order of the shift register


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits of an input: range, largest slope per second, and rest value."""

    lower: float
    upper: float
    rate: float
    rest: float


class Signals(Protocol):
    """Excitations of one or more inputs, each defined by some numbers in [0, 1]."""

    @property
    def bounds(self) -> tuple[Bounds, ...]:
        """Bounds of each input."""

    @property
    def size(self) -> int:
        """How many numbers define one excitation; the first one of each input is its size."""

    def __call__(self, x: FloatArray, time: FloatArray) -> FloatArray:
        """Return the (inputs, N) samples defined by (size,) numbers."""

    def words(self, x: FloatArray, time: FloatArray) -> str:
        """Return a description of the excitation."""


@dataclass(frozen=True, slots=True)
class Shape:
    """A family of excitations of one or more inputs.

    Parameters
    ----------
    family
        Family of the signals.
    bounds
        Bounds of each input.
    optimised
        Whether the phases of a multisine are searched for; otherwise they are drawn once.
    seed
        Seed of drawn phases.
    """

    family: Family
    bounds: tuple[Bounds, ...]
    optimised: bool = False
    seed: int = 0

    @property
    def size(self) -> int:
        """Number of values in [0, 1] that define one excitation."""
        return len(self.bounds) * self._each

    @property
    def _each(self) -> int:
        sizes = {"multisine": 6 + _LINES * self.optimised, "chirp": 5, "steps": 1 + _LEVELS, "prbs": 4}
        return sizes[self.family]

    def __call__(self, x: FloatArray, time: FloatArray) -> FloatArray:
        """Return the (inputs, N) samples defined by (size,) numbers in [0, 1].

        The first number of each input is its size: at 0, the input stays at rest.
        """
        parts = np.split(np.clip(x, 0.0, 1.0), len(self.bounds))
        made = _MADE[self.family]
        return np.array(
            [
                made(part, time - time[0], b, np.random.default_rng([self.seed, k]))
                for k, (part, b) in enumerate(zip(parts, self.bounds, strict=True))
            ]
        )

    def words(self, x: FloatArray, time: FloatArray) -> str:
        """Return a description of the excitation."""
        part = np.split(np.clip(x, 0.0, 1.0), len(self.bounds))[0]
        match self.family:
            case "multisine":
                lines = _lines(part, time)
                return f"multisine of {len(lines)} lines, {lines[0]:.3g} to {lines[-1]:.3g} Hz"
            case "chirp":
                first, last = _frequency(part[2], time), _frequency(part[3], time)
                return f"chirp from {first:.3g} to {last:.3g} Hz"
            case "steps":
                return f"{_LEVELS} steps of {(time[-1] - time[0]) / _LEVELS:.3g} s"
            case _:
                return f"pseudo-random binary sequence, a bit lasts {_clock(part[2], time):.3g} s"


def shapes(spec: DesignSpec, bounds: Sequence[Bounds], *, seed: int) -> tuple[Shape, ...]:
    """Return the families of a design that are defined by a few numbers."""
    chosen = [f for f in dict.fromkeys(spec.families) if f in _MADE]
    return tuple(Shape(f, tuple(bounds), spec.phases == "optimised", seed) for f in chosen)


def _frequency(x: float, time: FloatArray) -> float:
    """Return a frequency between one period per record and the highest that its samples can represent, Hz."""
    span = float(time[-1] - time[0])
    fastest = max(2.0 / span, (len(time) - 1) / span / _FASTEST)
    return float((1.0 / span) * (fastest * span) ** x)


def _lines(part: FloatArray, time: FloatArray) -> FloatArray:
    """Return the frequencies of a multisine: multiples of the record's own, evenly spaced in logarithm."""
    span = float(time[-1] - time[0])
    low, high = sorted((_frequency(part[2], time), _frequency(part[3], time)))
    return np.unique(np.round(np.geomspace(low, high, _LINES) * span)) / span


def _clock(x: float, time: FloatArray) -> float:
    """Return the duration of a bit: from one sample to a quarter of the record, s."""
    span = float(time[-1] - time[0])
    shortest = span / (len(time) - 1)
    return float(shortest * max(1.0, 0.25 * span / shortest) ** x)


def _multisine(part: FloatArray, time: FloatArray, b: Bounds, rng: np.random.Generator) -> FloatArray:
    lines = _lines(part, time)
    phases = 2 * np.pi * (part[6:] if len(part) > 6 else rng.random(_LINES))[: len(lines)]
    weights = (lines / lines[0]) ** (1.0 - 3.0 * part[5])  # from velocity-like to acceleration-like spectra
    wave = weights @ np.sin(2 * np.pi * lines[:, None] * time + phases[:, None])
    return _oscillation(part, time, b, wave)


def _chirp(part: FloatArray, time: FloatArray, b: Bounds, _: np.random.Generator) -> FloatArray:
    first, last = _frequency(part[2], time), _frequency(part[3], time)
    growth = np.log(last / first) / time[-1]
    phase = first * (np.expm1(growth * time) / growth if abs(growth) * time[-1] > 1e-9 else time)
    return _oscillation(part, time, b, np.sin(2 * np.pi * phase))


def _oscillation(part: FloatArray, time: FloatArray, b: Bounds, wave: FloatArray) -> FloatArray:
    """Return a wave with its size, mean and clipping given by three numbers, no steeper than allowed."""
    size = part[0] * 0.5 * (b.upper - b.lower)
    crest = max(float(np.max(np.abs(wave))), 1e-300) * (1.0 - _CLIPPED * part[4])
    wave = size * np.clip(wave / crest, -1.0, 1.0)
    steepest = float(np.max(np.abs(np.diff(wave)) / np.diff(time)))
    wave *= min(1.0, b.rate / steepest) if steepest > 0.0 else 1.0
    low, high = (b.rest + part[0] * (end - b.rest) for end in (b.lower, b.upper))
    size = float(np.max(np.abs(wave)))
    mean = low + size + part[1] * max(0.0, high - low - 2.0 * size)
    return _from_rest(mean + wave, time, b)


def _from_rest(values: FloatArray, time: FloatArray, b: Bounds) -> FloatArray:
    """Return the signal with both ends moved to rest, no steeper than allowed."""
    values = np.clip(values, b.lower, b.upper)
    if np.isfinite(b.rate):  # clipping by a cone of the allowed slope makes nothing steeper
        reach = b.rate * np.minimum(time, time[-1] - time)
        values = np.clip(values, b.rest - reach, b.rest + reach)
    values[[0, -1]] = b.rest
    return values


def _steps(part: FloatArray, time: FloatArray, b: Bounds, _: np.random.Generator) -> FloatArray:
    levels = b.rest + part[0] * (b.lower + part[1:] * (b.upper - b.lower) - b.rest)
    return held(levels, np.asarray(np.linspace(0.0, float(time[-1]), _LEVELS + 1)), time, b)


def _prbs(part: FloatArray, time: FloatArray, b: Bounds, _: np.random.Generator) -> FloatArray:
    size = part[0] * (b.upper - b.lower)
    low = b.rest + part[0] * (b.lower - b.rest)
    low, high = low + part[1] * 0.5 * size, low + size
    clock = _clock(part[2], time)
    count = int(np.ceil(time[-1] / clock))
    bits = _bits()
    chosen = bits[(np.arange(count) + int(part[3] * (len(bits) - 1))) % len(bits)]
    return held(np.asarray(np.where(chosen > 0, high, low)), np.asarray(clock * np.arange(count + 1)), time, b)


@cache
def _bits() -> FloatArray:
    from scipy.signal import max_len_seq  # takes a second to import

    return np.asarray(max_len_seq(_ORDER)[0], dtype=np.float64)


def held(levels: FloatArray, edges: FloatArray, time: FloatArray, b: Bounds) -> FloatArray:
    """Return levels held between `edges`, with ramps where steps would be too steep."""
    if not np.isfinite(b.rate):
        index = np.clip(np.searchsorted(edges, time * (1 + 1e-12), side="right") - 1, 0, len(levels) - 1)
        return _from_rest(levels[index], time, b)
    knots, values, here = [0.0], [b.rest], b.rest
    for begin, end, level in zip(edges[:-1].tolist(), edges[1:].tolist(), levels.tolist(), strict=True):
        reached = min(end, begin + abs(level - here) / b.rate)
        knots += [begin, reached]
        values.append(here)
        here += float(np.sign(level - here)) * b.rate * (reached - begin)
        values.append(here)
    return _from_rest(np.interp(time, knots, values), time, b)


_Made = Callable[[FloatArray, FloatArray, Bounds, np.random.Generator], FloatArray]
_MADE: Mapping[Family, _Made] = {"multisine": _multisine, "chirp": _chirp, "steps": _steps, "prbs": _prbs}
