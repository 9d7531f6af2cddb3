"""Effects between a model and its signals; they wrap any FMU, even one without source code.

A parameter named ``<signal>.<property>`` disturbs that signal: ``offset``, ``gain`` (neutral 1), ``lag`` (s, the
sum of two time constants; ``lag_split`` is the share of the smaller one), ``delay`` (s), ``drift`` (per second of
a run, at its beginning; ``drift_settling`` is the reciprocal of its time constant, in 1/s, negative for a drift
that grows faster and faster), ``dead_zone`` (half its width; ``dead_zone_skew`` moves its middle by that share of
it), ``saturation`` (largest absolute value in the signal's unit; 0 for none), ``compression`` (the reciprocal of
that value; ``hardness`` determines how abruptly it is reached), ``rectification`` (share of its magnitude; 1: the
sign is lost), ``play`` (half its width: the signal follows only as far as it moves beyond), ``slowness`` (of an
input: the reciprocal of its largest rate; 0 for none), and ``crosstalk[<other>]`` (that share of another signal).

Before its first sample, a signal is assumed constant at that sample's value. This holds for delays and lags of
inputs and outputs.

A delayed signal changes between samples; the simulation gets additional communication points there, so delays and
lags far below a sample time are simulated exactly. Replacing a late input by its mean over each step instead would
make an estimated delay of f samples too small by the fraction ``(1 - f) dt / (2 T)`` in a plant with time constant
T.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fmuid.core.immutable import FloatArray
from fmuid.simulation.band_limited import refined
from fmuid.simulation.simulator import Task, Variable

NEUTRAL = {
    "offset": 0.0, "gain": 1.0, "lag": 0.0, "delay": 0.0, "saturation": 0.0, "drift": 0.0, "dead_zone": 0.0,
    "compression": 0.0, "hardness": 4.0, "rectification": 0.0, "play": 0.0, "slowness": 0.0, "lag_split": 0.0,
    "drift_settling": 0.0, "dead_zone_skew": 0.0,
}  # fmt: skip
_CROSSTALK = re.compile(r"(?P<signal>.+)\.(?P<property>crosstalk\[(?P<other>.+)\])")
_APART = 1e-6  # share of the shortest step: points closer to each other are merged

Effects = Mapping[str, Mapping[str, float]]
"""Signal -> property -> value."""


def split_signal_parameters(
    values: Mapping[str, float], signals: Collection[str]
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Split parameters into those of the model and non-neutral signal effects (signal -> property -> value)."""
    plain: dict[str, float] = {}
    disturbed: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        signal, _, prop = name.rpartition(".")
        crosstalk = _CROSSTALK.fullmatch(name)
        if crosstalk is not None and {crosstalk["signal"], crosstalk["other"]} <= set(signals):
            if value != 0.0:
                disturbed.setdefault(crosstalk["signal"], {})[crosstalk["property"]] = value
        elif signal in signals and prop in NEUTRAL:
            if value != NEUTRAL[prop]:
                disturbed.setdefault(signal, {})[prop] = value
        else:
            plain[name] = value
    return plain, disturbed


def signal_and_property(name: str) -> tuple[str, str] | None:
    """Return the signal and property in a parameter's name, whether or not the signal exists."""
    match = _CROSSTALK.fullmatch(name)
    if match is not None:
        return match["signal"], match["property"]
    signal, _, prop = name.rpartition(".")
    return (signal, prop) if prop in NEUTRAL else None


def signal_parameters(signals: Collection[str]) -> set[str]:
    """Return the names of all effect parameters of these signals."""
    properties = {f"{signal}.{prop}" for signal in signals for prop in NEUTRAL}
    return properties | {crosstalk(a, b) for a in signals for b in signals if a != b}


def crosstalk(signal: str, other: str) -> str:
    """Return the name of the parameter that adds a share of another signal."""
    return f"{signal}.crosstalk[{other}]"


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A signal over time: (M,) `values`, each held from its time in `edges` on, or linear between them."""

    edges: FloatArray
    values: FloatArray
    linear: bool

    def on(self, grid: FloatArray, *, average: bool = False) -> FloatArray:
        """Return (len(grid),) samples of the signal; `average` takes the mean of a held signal over each step."""
        if self.linear:
            return np.asarray(np.interp(grid, self.edges, self.values))
        if average:
            fine = np.union1d(grid, self.edges[(self.edges > grid[0]) & (self.edges < grid[-1])])
            area = np.concatenate([[0.0], np.cumsum(self.on(fine)[:-1] * np.diff(fine))])
            means = np.diff(area[np.searchsorted(fine, grid)]) / np.diff(grid)
            return np.append(means, means[-1])
        middle = np.append(0.5 * (grid[:-1] + grid[1:]), grid[-1])
        return np.asarray(self.values[np.maximum(np.searchsorted(self.edges, middle, "right") - 1, 0)])


def disturbed_input(
    time: FloatArray,
    u: FloatArray,
    effect: Mapping[str, float],
    *,
    linear: bool,
    others: Mapping[str, FloatArray] | None = None,
) -> Course:
    """Return the input that reaches the model for (N,) samples `u`: scaled, limited, delayed and lagged."""
    y = _limited(u * effect.get("gain", 1.0) + _added(time, effect, others or {}), effect)
    if (slowness := effect.get("slowness", 0.0)) > 0.0:
        y = _ramped(time, y, 1.0 / slowness, linear=linear)
    edges = time
    if effect.get("delay", 0.0) > 0.0:
        edges, y = np.append(time[0], time + effect["delay"]), np.append(y[0], y)
    course, stages = Course(edges, y, linear), _stages(effect)
    if not stages:
        return course
    edges = _joined(time, edges)
    parts = [(share, _behind(course, edges, lag)) for share, lag in stages]
    if len(parts) == 1:
        return parts[0][1]
    every = np.union1d(*(part.edges for _, part in parts))
    return Course(every, np.sum([share * part.on(every) for share, part in parts], axis=0), linear)


def _stages(effect: Mapping[str, float]) -> list[tuple[float, float]]:
    """Return the one or two lags of a signal, each with its share of the response (partial fractions)."""
    lag, split = effect.get("lag", 0.0), effect.get("lag_split", 0.0)
    if lag <= 0.0:
        return []
    if split <= 0.0:
        return [(1.0, lag)]
    larger, smaller = (1.0 - split) * lag, split * lag
    return [(larger / (larger - smaller), larger), (-smaller / (larger - smaller), smaller)]


def _ramped(time: FloatArray, y: FloatArray, rate: float, *, linear: bool) -> FloatArray:
    """Return a signal that follows another one at no more than a rate; if held, its mean over each step."""
    ramped, at = np.empty(len(y)), float(y[0])
    for k, (step, wanted) in enumerate(zip(np.diff(time).tolist(), y[int(linear) :].tolist(), strict=False)):
        most = rate * step
        moved = min(max(wanted - at, -most), most)
        ramped[k] = at if linear else at + moved * (1.0 - 0.5 * abs(moved) / most)
        at += moved
    ramped[-1] = at
    return ramped


def _behind(course: Course, edges: FloatArray, lag: float) -> Course:
    """Return the signal after a first-order lag, exact at `edges`, with one further point in each interval.

    If linear, it has the integral of the exact response over each interval. If held, it has the integral and
    centre of area of the exact response, and never leaves its range.
    """
    from scipy.special import gammainc

    h, y = np.diff(edges), course.on(edges)
    slope = np.diff(y) / h if course.linear else np.zeros(len(h))
    x = _lagged(h, y[:-1], slope, np.zeros(len(h)), lag=lag, first=y[0])
    decaying = x[:-1] - (y[:-1] - lag * slope)  # with exp(-s / lag) towards a line
    left, area = np.exp(-h / lag), -lag * np.expm1(-h / lag)
    if course.linear:
        split = -lag * np.log1p(-0.5 * area / lag)
        height = (2.0 * area - split - left * (h - split)) / h
        first, second = x[:-1], x[1:] - decaying * left + slope * (split - h) + decaying * height
    else:
        split = 2.0 * lag * gammainc(3, h / lag) / gammainc(2, h / lag)
        first, second = x[1:] + decaying * lag * gammainc(2, h / lag) / split, x[1:]
    points, values = np.column_stack([edges[:-1], edges[:-1] + split]), np.column_stack([first, second])
    return Course(np.append(points, edges[-1]), np.append(values, x[-1]), course.linear)


@dataclass(frozen=True, slots=True, eq=False)
class Disturbed:
    """A task with signal effects applied.

    Attributes
    ----------
    time
        (M,) communication points.
    inputs
        The inputs that differ from the task's, (M,) each; all inputs if the times differ.
    """

    time: FloatArray
    inputs: Mapping[str, FloatArray]
    _task: Task
    _samples: FloatArray
    _breaks: FloatArray
    _late: Mapping[int, Mapping[str, float]]

    def task(self, *, linear: Collection[str] = (), shared: tuple[int, int] | None = None) -> Task:
        """Return the task for the simulation, with further inputs that are `linear`."""
        return replace(
            self._task,
            time=self.time,
            inputs={**self._task.inputs, **self.inputs},
            linear=(*self._task.linear, *linear),
            every=1,
            first=0,
            shared=shared,
        )

    def readings(self, outcome: FloatArray, differentiated: Sequence[bool]) -> FloatArray:
        """Return the (C, N) outputs at the task's times, delayed where required.

        Parameters
        ----------
        outcome
            (C, M) outputs of the simulation.
        differentiated
            The outputs that will be differentiated; before the first sample they continue their initial trend.
        """
        same = self.time is self._samples
        out = np.array(outcome if same else outcome[:, np.searchsorted(self.time, self._samples)])
        width = (len(self.time) - 1) // (len(self._breaks) - 1)  # points per interval
        for row, effect in self._late.items():
            begin = self._samples[0]
            slope = (out[row, 1] - out[row, 0]) / (self._samples[1] - begin) if differentiated[row] else 0.0
            y = outcome[row] - slope * (self.time - begin)
            at_breaks = y[::width]
            if stages := _stages(effect):
                h, driven = np.diff(self._breaks), _smooth(self._breaks, y, width)
                lagged = [share * _lagged(h, *driven, lag=lag, first=y[0]) for share, lag in stages]
                at_breaks = np.sum(lagged, axis=0)
            moved = self._samples - effect.get("delay", 0.0)
            out[row] = np.interp(moved, self._breaks, at_breaks) + slope * (self._samples - begin)
        return out


def effects_on_simulation(effects: Effects, inputs: Collection[str], outputs: Collection[str]) -> Effects:
    """Return the effects that change what is simulated, not only how outputs read: on inputs, and late outputs."""
    late = {
        name: {prop: value for prop, value in effects[name].items() if prop in ("lag", "lag_split", "delay")}
        for name in outputs
        if any(effects.get(name, {}).get(prop, 0.0) > 0.0 for prop in ("lag", "delay"))
    }
    return {name: effects[name] for name in inputs if name in effects} | late


def disturbed_task(
    task: Task,
    effects: Effects,
    outputs: Sequence[str],
    drive: Mapping[str, FloatArray],
    *,
    any_times: bool,
    linear_drive: bool = False,
    variables: Mapping[str, Variable],
) -> Disturbed:
    """Return the task with signal effects applied.

    Parameters
    ----------
    effects
        Effects by variable for inputs and by signal for outputs, without neutral ones.
    outputs
        The signals of the task's outputs.
    drive
        (N,) samples of additional inputs, or replacements for the task's inputs; with `linear_drive` they are
        linear between the samples even if the task's inputs are held.
    any_times
        Whether the model accepts additional communication points. Without them, a delayed input acts by its mean
        over each step, and outputs are interpolated linearly between samples.
    variables
        Variables of the model.
    """
    effects = effects_on_simulation(effects, task.inputs, outputs)
    late = {row: effects[name] for row, name in enumerate(outputs) if name in effects}
    sampled = task
    if effects:
        task = refined(task, variables)
    linear, driven_linear = task.interpolation == "linear", linear_drive or task.interpolation != "hold"
    courses = {
        n: disturbed_input(task.time, u, effects[n], linear=linear or n in task.linear, others=task.inputs)
        for n, u in task.inputs.items()
        if n in effects
    }
    courses |= {n: Course(sampled.time, u, driven_linear) for n, u in drive.items()}
    if not any_times:
        time = sampled.time
        inputs = {n: c.on(time, average=True) for n, c in courses.items()}
        return Disturbed(time, inputs, sampled, sampled.sampled(time), time, late)
    delays = {effect["delay"] for effect in late.values() if effect.get("delay", 0.0) > 0.0}
    breaks = _joined(task.time, *(c.edges for c in courses.values()), *(task.time - d for d in delays))
    if len(breaks) == len(task.time):
        breaks = task.time
    grid = breaks
    if any(effect.get("lag", 0.0) > 0.0 for effect in late.values()):
        thirds = np.linspace(breaks[:-1], breaks[1:], 3, endpoint=False, axis=1)
        grid = np.append(thirds.ravel(), breaks[-1])
    if grid is not task.time:
        plain = {n: Course(task.time, u, linear or n in task.linear) for n, u in task.inputs.items()}
        courses = plain | courses
    return Disturbed(
        grid, {n: c.on(grid) for n, c in courses.items()}, task, task.sampled(task.time), breaks, late
    )


def disturbed_readings(
    y: FloatArray,
    names: Sequence[str],
    effects: Effects,
    time: FloatArray,
    inputs: Mapping[str, FloatArray],
) -> FloatArray:
    """Apply saturation, drift, crosstalk, scale, sign and offset errors of sensors to (C, N) readings `y`."""
    if not any(name in effects for name in names):
        return y
    out = np.array(y)
    others = {**inputs, **dict(zip(names, y, strict=True))}
    for row, effect in ((row, effects[name]) for row, name in enumerate(names) if name in effects):
        out[row] = effect.get("gain", 1.0) * _limited(out[row], effect) + _added(time, effect, others)
    return out


def _added(time: FloatArray, effect: Mapping[str, float], others: Mapping[str, FloatArray]) -> FloatArray:
    """Return the contribution of offset, drift and shares of other signals."""
    since, settling = time - time[0], effect.get("drift_settling", 0.0)
    since = -np.expm1(-settling * since) / settling if settling else since
    added = effect.get("offset", 0.0) + effect.get("drift", 0.0) * since
    for prop, share in effect.items():
        if prop.startswith("crosstalk[") and (other := prop[len("crosstalk[") : -1]) in others:
            added = added + share * others[other]
    return np.asarray(added)


def _limited(y: FloatArray, effect: Mapping[str, float]) -> FloatArray:
    limit, width, steep = (effect.get(p, 0.0) for p in ("saturation", "dead_zone", "compression"))
    if share := effect.get("rectification", 0.0):
        y = (1.0 - share) * y + share * np.abs(y)
    if width > 0.0:
        middle = effect.get("dead_zone_skew", 0.0) * width
        y = y - np.clip(y, middle - width, middle + width)
    if (play := effect.get("play", 0.0)) > 0.0:
        y = _with_play(y, play)
    if steep > 0.0:
        hardness = effect.get("hardness", NEUTRAL["hardness"])
        size = np.abs(steep * y)
        most = np.maximum(size, 1.0)  # powers of shares of it cannot overflow
        y = y / (most * (most**-hardness + (size / most) ** hardness) ** (1.0 / hardness))
    return np.asarray(limit * np.tanh(y / limit)) if limit > 0.0 else y


def _with_play(y: FloatArray, width: float) -> FloatArray:
    """Return a signal that another one takes along at either end of a play, in the middle of it at first."""
    played, at = np.empty(len(y)), float(y[0])
    for k, value in enumerate(y.tolist()):
        at = min(max(at, value - width), value + width)
        played[k] = at
    return played


def _joined(time: FloatArray, *others: FloatArray) -> FloatArray:
    """Return the points of `time` and the others between them, merging those that nearly coincide."""
    others = tuple(points for points in others if points is not time)
    if not others:
        return time
    between = np.unique(np.concatenate(others))
    between = between[(between > time[0]) & (between < time[-1])]
    apart = _APART * float(np.min(np.diff(time)))
    place: NDArray[np.intp] = np.searchsorted(time, between)
    between = between[(between - time[place - 1] > apart) & (time[place] - between > apart)]
    between = between[np.diff(between, prepend=-np.inf) > apart]
    return np.sort(np.concatenate([time, between]))


def _smooth(breaks: FloatArray, y: FloatArray, width: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return begin, slope and half the curvature of `y` in each interval, from up to three of its last points.

    An output may jump where an input does, so its value at the beginning is extrapolated.
    """
    h = np.diff(breaks)
    if width == 1:
        return y[:-1], np.diff(y) / h, np.zeros(len(h))
    a, b, c = y[1::3], y[2::3], y[3::3]
    return 3.0 * (a - b) + c, (-15.0 * a + 24.0 * b - 9.0 * c) / (2.0 * h), 9.0 * (a - 2.0 * b + c) / (2.0 * h**2)


def _lagged(
    h: FloatArray, begin: FloatArray, slope: FloatArray, bend: FloatArray, *, lag: float, first: float
) -> FloatArray:
    """Return the (M+1,) states of a first-order lag that starts at `first`.

    It is driven by ``begin + slope s + bend s**2``, s from 0 to h, in each of M intervals; exact for that.
    """
    from scipy.linalg.lapack import dtbtrs

    keep = np.exp(-h / lag)
    start = begin - lag * slope + 2.0 * lag**2 * bend  # the response it converges to
    stop = start + (slope + bend * h - 2.0 * lag * bend) * h
    ends = np.append(first, stop - keep * start)
    # x[k+1] - keep[k] x[k] = ends[k+1]
    bands = np.vstack([np.ones(len(ends)), np.append(-keep, 0.0)])
    return np.asarray(dtbtrs(bands, ends, uplo="L")[0])
