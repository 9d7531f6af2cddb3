"""Inputs that are band-limited between their samples, as after an anti-aliasing filter.

Between its samples such an input is their interpolation by a windowed sinc. The simulation gets further
communication points, between which the input is linear. Values at those points are corrected so that the lines
have the integral of the interpolation: three intervals a sample are then exact to some 1e-4 of the response.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fmuid.core.errors import FmuError
from fmuid.core.immutable import FloatArray
from fmuid.simulation.simulator import Feedback, Task, Variable

_PARTS = 3  # intervals from one sample to the next
_REACH = (
    32  # samples on either side that a value between two depends on: exact up to 0.92 of the Nyquist frequency
)
_BETA = 8.0  # of the Kaiser window: errors below -80 dB
_UNEVEN = 0.01  # deviation of a step from the mean one


def refined(task: Task, variables: Mapping[str, Variable]) -> Task:
    """Return a task with more communication points, whose inputs are held or linear between them.

    Inputs that are not continuous are held. A task without band-limited inputs, whose outputs are read when the
    inputs of their sample act, is returned as it is.

    Raises
    ------
    FmuError
        The samples are not even, or outputs are read a step or more after the inputs, or beside band-limited ones.
    """
    whole = task.interpolation == "band-limited"
    if task.read_after:
        return _with_readings(task)
    smooth = {n for n in task.inputs if n in task.band_limited or (whole and n not in task.linear)}
    if not (whole or smooth):
        return task
    smooth = {n for n in smooth if n not in variables or variables[n].variability == "continuous"}
    if not smooth:
        return replace(task, interpolation="hold" if whole else task.interpolation, band_limited=())
    _require_even(task.time)
    lines = task.inputs.keys() if task.interpolation == "linear" else {*task.linear, *smooth}
    inputs = {}
    for name, u in task.inputs.items():
        if name in smooth:
            inputs[name] = band_limited(u)
        elif name in lines:
            inputs[name] = between(u)
        else:
            inputs[name] = np.repeat(u, _PARTS)[: 1 - _PARTS]
    mixed = any(name not in lines for name in task.inputs)
    feedback = task.feedback
    if feedback is not None:
        measured = np.full((len(feedback.measured), _PARTS * (feedback.measured.shape[1] - 1) + 1), np.nan)
        measured[:, ::_PARTS] = feedback.measured
        feedback = Feedback(measured, feedback.gain)
    return replace(
        task,
        time=between(task.time),
        inputs=inputs,
        interpolation="hold" if mixed else "linear",
        linear=tuple(n for n in task.inputs if n in lines) if mixed else (),
        band_limited=(),
        every=_PARTS * task.every,
        feedback=feedback,
        shared=task.shared and (task.shared[0], _PARTS * task.shared[1]),
    )


def at_samples(predictions: FloatArray, task: Task) -> FloatArray:
    """Return predictions at the samples of a task, of those at all communication points."""
    return predictions if task.every == 1 else np.ascontiguousarray(task.sampled(predictions))


def _with_readings(task: Task) -> Task:
    """Return a task with a communication point after each sample, at which its outputs are read."""
    grid = np.column_stack([task.time, task.time + task.read_after]).ravel()
    if task.interpolation == "band-limited" or task.band_limited:
        raise FmuError("outputs are read after band-limited inputs", where="timing", fix="leave read_after out")
    if np.any(np.diff(grid) <= 0.0):
        raise FmuError(
            f"outputs are read {task.read_after:g} s after the inputs act, but the next inputs act by then",
            where="read_after",
            fix='write less than the step between samples, or timing = "preceding"',
        )
    lines = task.inputs.keys() if task.interpolation == "linear" else task.linear
    inputs = {n: np.interp(grid, task.time, u) if n in lines else np.repeat(u, 2) for n, u in task.inputs.items()}
    feedback = task.feedback
    if feedback is not None:
        measured = np.full((len(feedback.measured), grid.size), np.nan)
        measured[:, 1::2] = feedback.measured
        feedback = Feedback(measured, feedback.gain)
    shared = task.shared and (task.shared[0], 2 * task.shared[1])
    return replace(
        task,
        time=grid,
        inputs=inputs,
        every=2,
        first=1,
        read_after=0.0,
        after=(),
        feedback=feedback,
        shared=shared,
    )


def between(u: FloatArray) -> FloatArray:
    """Return (N,) samples with further ones on the lines between them."""
    shares = np.arange(_PARTS) / _PARTS
    return np.append((u[:-1, None] + shares * np.diff(u)[:, None]).ravel(), u[-1])


def band_limited(u: FloatArray) -> FloatArray:
    """Return (N,) samples with further ones, so that lines between all have the integral of their interpolation.

    Before the first and after the last sample the signal is continued by its reflection at that sample.
    """
    padded = np.pad(u, _REACH, mode="reflect", reflect_type="odd")
    values = np.repeat(u, _PARTS)[: 1 - _PARTS]
    for k in range(1, _PARTS):
        away = k / _PARTS - np.arange(1 - _REACH, _REACH + 1)
        weight = np.sinc(away) * np.i0(_BETA * np.sqrt(1.0 - (away / _REACH) ** 2))
        values[k::_PARTS] = np.convolve(padded, weight[::-1] / np.sum(weight), "valid")[1 : len(u)]
    # Lines between values of a curve miss a twelfth of its second difference; samples stay as they are.
    bend = np.zeros_like(values)
    bend[1:-1] = np.diff(values, 2)
    bend[::_PARTS] = 0.0
    return np.asarray(values - bend * _PARTS / (12.0 * (_PARTS - 1)))


def _require_even(time: FloatArray) -> None:
    steps = np.diff(time)
    mean = float(np.mean(steps))
    if np.max(np.abs(steps - mean)) > _UNEVEN * mean:
        raise FmuError(
            f"steps of {steps.min():g} to {steps.max():g} s, but band-limited inputs need even samples",
            where="timing",
            fix='resample the run (`fmuid import --rate`), or use timing = "linear"',
        )
