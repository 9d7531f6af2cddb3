"""Comparison of a fit's residual with the noise; if it is large, a search for a wrong sign, scale or unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.core.units import convertible
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.uncertainty.coloured_residuals import Whiteness

_TIMES_NOISE = 2.0  # at this ratio, three quarters of the residual's energy are not noise
_UNEXPLAINED = 0.1  # share of the signal's energy in the residual above which sign and unit are doubted
_LOST = 0.5  # share of the signal's energy in the residual above which the whole fit is doubted
_PLAINLY, _CORRELATED = 1e-6, 0.2  # p-value and autocorrelation of a residual that is plainly not white
_SHOWN, _ABOVE = 1e-4, 1.2  # share of a signal's energy, or times its noise, that is worth a word
_ALIKE = 0.8  # correlation: scaled by one number, the prediction then explains two thirds of the signal
_SCALED = 2.5  # ratio of measurement to prediction that is unlikely to come from a start value alone
_NEAR = math.log(1.5)  # distance from the factor between two units, since start values are wrong as well
# Factor between two units, and the quantities that are measured in them; empty: any quantity.
_FACTORS: Mapping[str, tuple[float, tuple[str, ...]]] = {
    "degrees and radians": (180.0 / math.pi, ("rad", "rad/s", "rad/s2")),
    "turns and radians, or Hz and rad/s": (2.0 * math.pi, ("rad", "rad/s", "rad/s2")),
    "rpm and rad/s": (30.0 / math.pi, ("rad/s",)),
    "percent and fractions, or cm and m": (100.0, ("1", "m", "m/s")),
    "mm and m, or any unit and its thousandth": (1e3, ()),
    "a unit and its millionth": (1e6, ()),
    "kgf and N": (9.80665, ("N", "N.m")),
    "km/h and m/s": (3.6, ("m/s",)),
}


@dataclass(frozen=True, slots=True)
class Unexplained:
    """A signal whose residual is plainly not white, or far above its noise.

    `share` is the residual's share of the signal's energy (mean removed), `lag_one` its autocorrelation from
    sample to sample, and `times_noise` its root mean square relative to the noise of a sample, if that is known.
    """

    signal: str
    share: float
    lag_one: float
    times_noise: float | None = None

    def __str__(self) -> str:
        """Return it in words."""
        share = f"{100.0 * self.share:.2g} %" if self.share < 1.0 else "all"
        coloured = abs(self.lag_one) > _CORRELATED
        return f"{share} of {self.signal} unexplained, " + (
            "not white" if coloured else f"{self.times_noise or 0.0:.3g} times its noise"
        )


def unexplained(problem: Problem, best: Evaluation, whiteness: Sequence[Whiteness]) -> tuple[Unexplained, ...]:
    """Return the signals of which a fit leaves more than noise; the test for colour needs no repeats."""
    best = best if best.predictions else problem.evaluate(best.x)
    parts, times = [], _times_noise(problem, best)
    for signal in dict.fromkeys(w.signal for w in whiteness):
        of_signal = [w for w in whiteness if w.signal == signal]
        seen = _seen(problem, best, signal)
        lag_one = sum(w.lag_one * w.samples for w in of_signal) / max(sum(w.samples for w in of_signal), 1)
        coloured = min(w.p_value for w in of_signal) * len(of_signal) < _PLAINLY and abs(lag_one) > _CORRELATED
        large = times.get(signal, 0.0) > _TIMES_NOISE
        shown = seen is not None and (seen.unexplained > _SHOWN or times.get(signal, 0.0) > _ABOVE)
        if (coloured or large) and seen is not None and shown:
            parts.append(Unexplained(signal, seen.unexplained, lag_one if coloured else 0.0, times.get(signal)))
    return tuple(parts)


@dataclass(frozen=True, slots=True)
class _Seen:
    """One signal, measured and predicted, each with its mean removed in every case: samples of all cases."""

    correlation: float
    gain: float  # measured = gain * predicted, by least squares
    unexplained: float  # residual energy divided by the signal's


def misfit(problem: Problem, first: Evaluation | None, best: Evaluation) -> tuple[str, ...]:
    """Return advice to the user as sentences; none if the fit is as good as the noise allows.

    A signal with a large residual is compared with its prediction at the start, then at the estimate. A wrong sign
    or unit keeps the shape, so prediction and measurement are proportional, and the factor shows what is wrong.

    Parameters
    ----------
    problem
        The fitted problem.
    first, best
        Its evaluations at the start, if it could be simulated, and at the estimate.
    """
    # A resumed run does not store the predictions of every point.
    best = best if best.predictions else problem.evaluate(best.x)
    if first is not None and not first.predictions:
        first = problem.evaluate(first.x)
    doubtful = []
    times = _times_noise(problem, best)
    for signal in dict.fromkeys(c.signal for case in problem.cases for c in case.channels):
        if times.get(signal, math.inf) <= _TIMES_NOISE:
            continue
        views = [(_seen(problem, e, signal), where) for e, where in ((first, "start"), (best, "end")) if e]
        known = [(seen, where) for seen, where in views if seen is not None]
        if known and known[-1][0].unexplained > _UNEXPLAINED:
            # The start comes first, because a fit distorts the shape towards what it cannot reach.
            units = _units(problem, signal)
            doubts = next((d for d in (_doubt(signal, units, *one) for one in known) if d), [])
            doubtful += doubts
            if not doubts and known[-1][0].unexplained > _LOST and problem.segments == 0:
                doubtful.append(
                    f"the fit follows little of {signal}, as in a wrong optimum: try starts = 8, or segments = "
                    '"auto", which restarts the model along the runs'
                )
    if times and (worst := max(times, key=lambda name: times[name])) and times[worst] > _TIMES_NOISE:
        doubtful.append(
            f"the residual of {worst} is {times[worst]:.3g} times its noise: "
            "the model misses something, or holds a wrong value; run fmuid diagnose"
        )
    return tuple(doubtful)


def _times_noise(problem: Problem, best: Evaluation) -> dict[str, float]:
    """Return, by signal, the RMS of residuals relative to the noise of one sample, for criteria over samples."""
    energy: dict[str, list[FloatArray]] = {}
    for case, prediction in zip(problem.cases, best.predictions, strict=False):
        for criterion in case.criteria:
            k = next(i for i, c in enumerate(case.channels) if c.signal == criterion.signal)
            channel = case.channels[k]
            if criterion.rows is not None and channel.noise.source != "unknown":
                error = (prediction[k] - channel.mean)[criterion.rows] / channel.noise.sigma
                energy.setdefault(criterion.signal, []).append(error**2)
    return {signal: float(np.sqrt(np.mean(np.concatenate(parts)))) for signal, parts in energy.items()}


def _seen(problem: Problem, evaluation: Evaluation, signal: str) -> _Seen | None:
    measured, predicted, residual = [], [], []
    for case, prediction in zip(problem.cases, evaluation.predictions, strict=False):
        for channel, y in zip(case.channels, prediction, strict=True):
            there = np.isfinite(channel.mean)
            if channel.signal == signal and there.any():
                m, p = channel.mean[there], y[there]
                measured.append(m - np.mean(m))
                predicted.append(p - np.mean(p))
                residual.append(p - m)
    if not measured:
        return None
    m, p, e = (np.concatenate(parts) for parts in (measured, predicted, residual))
    mm, pp, mp = (float(np.sum(a * b)) for a, b in ((m, m), (p, p), (m, p)))
    if not (mm > 0.0 and pp > 0.0):
        return None
    return _Seen(mp / math.sqrt(mm * pp), mp / pp, float(np.sum(e * e)) / mm)


def _units(problem: Problem, signal: str) -> tuple[str | None, ...]:
    """Return the units of a signal and of the inputs it depends on; one of them may be wrong."""
    seen = [(case, c) for case in problem.cases for c in case.channels if c.signal == signal]
    outputs = [c.unit or case.simulator.variables[c.variable].unit for case, c in seen]
    variables = [case.simulator.variables.get(n) for case, _ in seen for n in case.task.inputs]
    inputs = [None if v is None else v.unit for v in variables]
    return tuple(dict.fromkeys([*outputs, *inputs]))


def _measured_in(units: tuple[str | None, ...], known: tuple[str, ...]) -> bool:
    """Return whether one of the units is of a known quantity; a variable without a unit may be of any."""
    return not known or None in units or any(u is not None and convertible(u, k) for u in units for k in known)


def _doubt(signal: str, units: tuple[str | None, ...], seen: _Seen, where: str) -> list[str]:
    at = f"at the {where} (correlation {seen.correlation:+.2f})"
    if seen.correlation < -_ALIKE:
        return [
            f"{signal} was measured with the opposite sign of its prediction {at}: "
            "check its sign and those of the inputs"
        ]
    if seen.correlation > _ALIKE:
        ratio = max(seen.gain, 1.0 / seen.gain)
        if ratio > _SCALED:
            possible = {pair: factor for pair, (factor, known) in _FACTORS.items() if _measured_in(units, known)}
            far = {pair: abs(math.log(ratio / factor)) for pair, factor in possible.items()}
            close = [
                f"{pair} ({possible[pair]:.4g})" for pair in sorted(far, key=far.__getitem__) if far[pair] < _NEAR
            ]
            near = f", about as between {' or '.join(close)}" if close else ""
            what = f"{signal} was measured as {seen.gain:.3g} times its prediction {at}{near}"
            return [f"{what}: check its unit and those of the inputs"]
    return []
