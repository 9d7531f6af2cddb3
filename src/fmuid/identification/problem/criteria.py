"""Criteria: measures of the mismatch between a prediction and a measurement.

Every criterion gives a vector of residuals, already divided by its demand value; its value is their root
mean square, so at most 1 means "satisfied". Which one to use when:

========================  ============================================================================
`least_squares`           the default: (prediction - measurement) / sigma, efficient for white noise; with the
                          option `whiten = "repeats"` whitened by the spectrum of differences between repeats,
                          efficient for coloured noise
`error_vector`            the plain error, in the signal's unit, sample by sample
`maximum`                 the largest error; with `combine = "min_max"` a guaranteed bound
`quantile`                the q-quantile of the error's size (option `q`, default 0.95): outliers allowed
`integral_absolute`       mean of abs(e) over time; `integral_squared`: root of the mean of e^2;
                          `integral_time_absolute`: abs(e) weighted by time since the start
`rise_time` ...           one response feature: also `overshoot` (%), `settling_time`, `steady_state`, `peak`
`magnitude`, `phase`      frequency response from the input (option `input`) in dB and in degrees, at the
                          option `frequencies` (Hz), by default where the input has power
`user`                    option `function`: ``package.module:name``, or any name given to `register`
========================  ============================================================================

Samples where the measurement is NaN are left out everywhere.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmuid.core.campaign import CriterionSpec
from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.colour import estimate_colour
from fmuid.data.noise.level import NoiseLevel
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.identification.problem import features

Rows = NDArray[np.intp]
Residuals = Callable[[FloatArray], FloatArray]
"""(N,) prediction -> (m,) residuals, before the demand value."""


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """The measurement of one signal for a criterion; all arrays are (N,), in the model's unit.

    `mean` is the mean over the repeats (NaN where no repeat has a sample), `count` is the number of repeats with a
    sample, and `noise` is the noise of a single sample. `repeated` are the runs for estimating the noise spectrum,
    for criteria that need it.
    """

    signal: str
    time: FloatArray
    mean: FloatArray
    count: FloatArray
    noise: NoiseLevel
    inputs: Mapping[str, FloatArray]
    repeated: tuple[RepeatedRuns, ...] = ()

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the noise level: infinite if given, 0 if unknown."""
        if self.noise.source == "repeats":
            return float(np.sum(np.maximum(self.count - 1.0, 0.0)))
        return math.inf if self.noise.source == "given" else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Criterion:
    """A criterion prepared for one signal of one case.

    `rows` are the sample indices of its residuals if it has one residual per sample, else None. If `affine`, the
    residuals are an affine function of the prediction, and several predictions, (..., N), may be passed at once.
    `priority` orders criteria of a lexicographic combination, 1 first. `scatter` are the standard deviations of
    its residuals under the noise, whose level has `degrees` degrees of freedom; None if the noise is unknown or
    residuals do not correspond to samples.
    """

    label: str
    signal: str
    kind: str
    weight: float
    demand: float
    smooth: bool
    residuals: Residuals
    rows: Rows | None = None
    priority: int = 1
    affine: bool = False
    scatter: FloatArray | None = None
    degrees: float = 0.0

    def length(self, measured: FloatArray) -> int:
        """Return the number of its residuals, from its value on (N,) `measured` or on data close to it.

        Raises
        ------
        ProblemError
            A user's function is undefined for both.
        """
        for prediction in (measured, 1.1 * measured + 1e-3):
            with suppress(SimulationError):
                return len(self.residuals(prediction))
        raise ProblemError(
            "is undefined on the measurement and on data close to it",
            where=f"criterion '{self.label}'",
            fix="correct its function",
        )


User = Callable[[FloatArray, FloatArray, FloatArray], Any]
"""(time, prediction, measurement), all (m,) -> a number or a vector of residuals."""

_registered: dict[str, User] = {}


def register(name: str, function: User) -> None:
    """Register `function` as a criterion of kind `name`, for use as `kind = name` in a stage."""
    _registered[name] = function


def prepare(spec: CriterionSpec, target: Target) -> Criterion:
    """Return the criterion for `spec` on `target`.

    Raises
    ------
    ProblemError
        The kind is unknown, an option is invalid, or no sample is left.
    """
    where = f"criterion '{spec.kind}' on '{spec.signal}'"
    if not spec.demand > 0.0:
        raise ProblemError(f"demand {spec.demand:g} is not positive", where=where, fix="use a value above 0")
    if not spec.weight >= 0.0:
        raise ProblemError(f"weight {spec.weight:g} is negative", where=where, fix="use 0 or more")
    inside = (target.time >= spec.start_time) & (target.time <= spec.stop_time)
    rows = np.flatnonzero(inside & (target.count > 0))
    if len(rows) == 0:
        raise ProblemError("no measured sample in its time window", where=where, fix="widen 'from' and 'to'")
    options = dict(spec.options)
    label = str(options.pop("name", f"{spec.signal} {spec.kind}"))
    priority = int(options.pop("priority", 1))
    degrees = math.inf if "sigma" in options else target.degrees
    good = options.pop("good", None)
    raw = _residuals(spec.kind, target, rows, options, where)
    if options:
        raise ProblemError(f"unknown option '{next(iter(options))}'", where=where, fix="leave it out")
    by_sample = spec.kind in ("least_squares", "error_vector")
    if good is not None:
        return Criterion(
            label=label,
            signal=spec.signal,
            kind=spec.kind,
            weight=spec.weight,
            demand=spec.demand,
            smooth=False,
            residuals=_between(raw, float(good), spec.demand),
            priority=priority,
        )
    scatter = None
    if by_sample and not whitened(spec) and degrees > 0.0:
        unit = spec.kind == "least_squares"
        scatter = np.ones(len(rows)) if unit else target.noise.of_mean(target.count[rows])
        scatter = scatter / spec.demand
    return Criterion(
        label=label,
        signal=spec.signal,
        kind=spec.kind,
        weight=spec.weight,
        demand=spec.demand,
        smooth=spec.kind in ("least_squares", "error_vector", "integral_squared", "magnitude", "phase"),
        residuals=lambda prediction: raw(prediction) / spec.demand,
        rows=rows if by_sample else None,
        priority=priority,
        affine=spec.kind in ("least_squares", "error_vector", "integral_squared") and not whitened(spec),
        scatter=scatter,
        degrees=degrees,
    )


def value(residuals: FloatArray) -> float:
    """Return a criterion's value, the root mean square of its residuals (m,)."""
    return math.sqrt(np.sum(np.square(residuals)) / len(residuals))


def _between(raw: Residuals, good: float, bad: float) -> Residuals:
    """Return the criterion of a demand that is an interval: 0 up to the good value, 1 at the bad one."""
    return lambda prediction: np.array([max(value(raw(prediction)) - good, 0.0) / (bad - good)])


def _residuals(kind: str, target: Target, rows: Rows, options: dict[str, Any], where: str) -> Residuals:
    time, measured = target.time[rows], target.mean[rows]
    # If no sample is left out between the first and the last one, no copy is needed.
    chosen = slice(rows[0], rows[-1] + 1) if len(rows) == rows[-1] + 1 - rows[0] else rows
    match kind:
        case "least_squares":
            return _least_squares(target, rows, chosen, options, where)
        case "error_vector":
            return lambda p: p[..., chosen] - measured
        case "maximum":
            return lambda p: np.max(np.abs(p[rows] - measured), keepdims=True)
        case "quantile":
            q = _positive(options.pop("q", 0.95), "q", where)
            return lambda p: np.atleast_1d(np.quantile(np.abs(p[rows] - measured), q))
        case "integral_absolute" | "integral_squared" | "integral_time_absolute":
            return _integral(kind, time, chosen, measured)
        case "magnitude" | "phase":
            return _spectral(kind, target, rows, options, where)
    if kind in features.FEATURES:
        feature = features.FEATURES[kind]
        aim = feature(time, measured)
        if not np.isfinite(aim):
            raise ProblemError(
                "the measurement does not show this feature", where=where, fix="choose another feature"
            )
        return lambda p: np.array([feature(time, p[rows]) - aim])
    if kind == "user" or kind in _registered:
        user = _registered[kind] if kind in _registered else _load(options.pop("function", None), where)
        return lambda p: _called(user, where, time, p[rows], measured)
    known = ["least_squares", "error_vector", "maximum", "quantile", "integral_absolute", "integral_squared"]
    known += ["integral_time_absolute", *features.FEATURES, "magnitude", "phase", "user", *_registered]
    raise ProblemError("unknown kind of criterion", where=where, fix=f"known: {', '.join(known)}")


def _least_squares(
    target: Target, rows: Rows, chosen: Rows | slice, options: dict[str, Any], where: str
) -> Residuals:
    whiten = options.pop("whiten", "sigma")
    if whiten not in ("sigma", "repeats"):
        raise ProblemError(f"unknown whiten '{whiten}'", where=where, fix="known: sigma, repeats")
    if whiten == "repeats":
        return _whitened(target, rows, where)
    noise = target.noise
    if "sigma" in options:
        noise = NoiseLevel(_positive(options.pop("sigma"), "sigma", where) ** 2)
    weight, measured = 1.0 / noise.of_mean(target.count[rows]), target.mean[rows]
    return lambda p: weight * (p[..., chosen] - measured)


def whitened(spec: CriterionSpec) -> bool:
    """Return whether `spec` needs the noise spectrum from repeats."""
    return spec.options.get("whiten") == "repeats"


def _whitened(target: Target, rows: Rows, where: str) -> Residuals:
    """Return the errors as independent residuals of unit variance under the noise between repeats."""
    count = np.max(target.count[rows])
    # If some repeats lack a sample, its mean has another variance, so it counts as missing.
    known = np.flatnonzero(target.count[rows] == count)
    try:
        colour = estimate_colour(target.repeated, count=count)
    except ProblemError as error:
        raise ProblemError(error.what, where=where, fix=error.fix) from None
    measured = target.mean[rows]

    def residuals(p: FloatArray) -> FloatArray:
        error = np.zeros(len(rows))
        error[known] = p[rows][known] - measured[known]
        return np.asarray(np.sqrt(count) * colour.whitened(error))

    return residuals


def _integral(kind: str, time: FloatArray, rows: Rows | slice, measured: FloatArray) -> Residuals:
    step = np.gradient(time) if len(time) > 1 else np.ones(1)
    if kind == "integral_time_absolute":
        step = step * (time - time[0])
    step = step / np.sum(step)
    if kind == "integral_squared":
        return lambda p: np.sqrt(step) * (p[..., rows] - measured) * np.sqrt(len(measured))
    return lambda p: np.array([step @ np.abs(p[rows] - measured)])


def _spectral(kind: str, target: Target, rows: Rows, options: dict[str, Any], where: str) -> Residuals:
    name = str(options.pop("input", next(iter(target.inputs), "")))
    if name not in target.inputs:
        raise ProblemError(f"no input '{name}'", where=where, fix=f"inputs: {', '.join(target.inputs)}")
    time, u = target.time[rows], target.inputs[name][rows]
    frequencies = np.asarray(options.pop("frequencies", None) or features.excited_frequencies(time, u))
    aim = features.frequency_response(time, u, target.mean[rows], frequencies)

    def residuals(p: FloatArray) -> FloatArray:
        ratio = features.frequency_response(time, u, p[rows], frequencies) / aim
        return 20.0 * np.log10(np.abs(ratio)) if kind == "magnitude" else np.angle(ratio, deg=True)

    return residuals


def _called(user: User, where: str, *arguments: FloatArray) -> FloatArray:
    """Return the result of a user's function as (m,) residuals; an invalid result fails the point."""
    try:
        answer = np.atleast_1d(np.asarray(user(*arguments), dtype=np.float64))
    except Exception as error:
        what = f"its function raises {type(error).__name__} ({error})"
        raise SimulationError(what, where=where, fix="correct it, or the bounds") from error
    if answer.ndim > 1 or answer.size == 0:
        what = f"its function returns an array of shape {answer.shape}"
        raise SimulationError(what, where=where, fix="return a number, or a vector of residuals")
    return answer


def _positive(number: Any, name: str, where: str) -> float:
    if isinstance(number, bool) or not isinstance(number, (int, float)) or not number > 0.0:
        raise ProblemError(f"{name} = {number!r} is not a positive number", where=where, fix="use one above 0")
    return float(number)


def _load(path: Any, where: str) -> User:
    fix = 'write function = "package.module:name"'
    if not isinstance(path, str) or ":" not in path:
        raise ProblemError("no function is named", where=where, fix=fix)
    module, _, name = path.partition(":")
    try:
        function: User = getattr(importlib.import_module(module), name)
    except Exception as error:  # a module may raise anything
        raise ProblemError(f"cannot load '{path}' ({error})", where=where, fix=fix) from None
    return function
