"""What a plant is made of: states over time by explicit steps of its own, and inputs to drive it with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Slope = Callable[[Sequence[float], float, float], Sequence[float]]
"""States, held input and time -> derivatives."""
MODELS = Path(__file__).parent / "models"


@dataclass(frozen=True)
class Extra:
    """A flow out of a place of the plant that none of the plant's effects is; it may have hidden states.

    Attributes
    ----------
    place
        Where it acts, as the model calls it.
    flow, rates
        Of the quantities there, the hidden states and time: the flow, and the states' derivatives.
    start
        Of the hidden states.
    heard
        Hears time, the quantities of every place, and the flow.
    """

    place: str
    flow: Callable[[Mapping[str, float], Sequence[float], float], float]
    rates: Callable[[Mapping[str, float], Sequence[float], float], Sequence[float]] = lambda *_: ()
    start: Sequence[float] = ()
    heard: Callable[[float, Mapping[str, Mapping[str, float]], float], None] | None = None


@dataclass(frozen=True)
class Rig:
    """A rig: its plain model, and the plant.

    Attributes
    ----------
    name, model
        Of the rig, and its Modelica class; the file is named after the class.
    inputs
        Experiment -> (N,) samples of the input, or (inputs, N).
    time
        (N,), s.
    signals
        Column of the log -> unit, inputs first.
    noise
        Standard deviations of the outputs.
    effects
        What a plant may have beyond the model, by the id that a diagnosis should name, and what is set on it.
    parameters
        Names of the plant's parameters that differ from the model's by up to a fifth; the others are as modelled.
    same
        Ids that no sensor of the rig tells from an effect, by physics.
    outside
        Those of the effects that no catalogue has.
    near
        Effect -> others, as in `effects`, that look so much like it that noise may hide which one it is.
    simulate
        From factors on the parameters, the effect, time and input, and maybe an `Extra`, to the (outputs, N)
        readings without noise.
    """

    name: str
    model: str
    time: Floats
    inputs: Mapping[str, Floats]
    signals: Mapping[str, str]
    noise: Sequence[float]
    effects: Mapping[str, Mapping[str, float]]
    parameters: Sequence[str]
    simulate: Callable[..., Floats]
    same: Mapping[str, Sequence[str]] = field(default_factory=dict)
    outside: Sequence[str] = ()
    near: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)

    @property
    def file(self) -> Path:
        """The plain model."""
        return MODELS / f"{self.model}.mo"


def integrate(slope: Slope, start: Sequence[float], time: Floats, u: Floats, *, steps: int) -> Floats:
    """Return (states, N): classical Runge-Kutta, `steps` a sample, each input sample held until the next."""
    x = np.array(start, dtype=float)
    rows = [x]
    for k in range(len(time) - 1):
        h = (time[k + 1] - time[k]) / steps
        for i in range(steps):
            t = time[k] + i * h
            a = np.asarray(slope(x, u[k], t))
            b = np.asarray(slope(x + 0.5 * h * a, u[k], t + 0.5 * h))
            c = np.asarray(slope(x + 0.5 * h * b, u[k], t + 0.5 * h))
            d = np.asarray(slope(x + h * c, u[k], t + h))
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        rows.append(x)
    return np.array(rows).T


def delayed(time: Floats, u: Floats, delay: float) -> Floats:
    """Return the held input as it was `delay` before, a whole number of samples; settled before the first one."""
    shift = round(delay / (time[1] - time[0]))
    return np.concatenate([np.full(shift, u[0]), u[: len(u) - shift]])


def lagged(time: Floats, y: Floats, lag: float) -> Floats:
    """Return a signal, linear between its samples, behind a first-order lag."""
    keep = np.exp(-np.diff(time) / lag)
    slope = np.diff(y) / np.diff(time)
    out = [y[0]]
    for k, part in enumerate(keep):
        out.append(y[k + 1] - lag * slope[k] + part * (out[-1] - y[k] + lag * slope[k]))
    return np.array(out)


def steps(time: Floats, levels: Sequence[float]) -> Floats:
    """Return a staircase of equally long levels."""
    return np.asarray(levels, dtype=float)[
        np.minimum((np.arange(len(time)) * len(levels)) // len(time), len(levels) - 1)
    ]


def random_steps(time: Floats, hold: float, size: float, *, seed: int) -> Floats:
    """Return levels drawn evenly from -size to size, each held for `hold` s."""
    count = int(np.ceil((time[-1] - time[0]) / hold)) + 1
    levels = np.random.default_rng(seed).uniform(-size, size, count)
    return levels[((time - time[0]) / hold).astype(int)]


def acting(
    extra: Extra | None, places: Mapping[str, Mapping[str, float]], hidden: Sequence[float], t: float
) -> tuple[Mapping[str, float], Sequence[float]]:
    """Return the further flow out of each place, given what its quantities are, and the hidden states' rates."""
    flows = dict.fromkeys(places, 0.0)
    if extra is None:
        return flows, ()
    here = places[extra.place]
    flows[extra.place] = extra.flow(here, hidden, t)
    if extra.heard is not None:
        extra.heard(t, places, flows[extra.place])
    return flows, extra.rates(here, hidden, t)


def hidden_start(extra: Extra | None) -> Sequence[float]:
    """Return the hidden states at the start."""
    return () if extra is None else extra.start
