"""Coloured residuals: their covariance, autocorrelation and effective number of samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.data.filtering import first_order
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation

_SAMPLES = 50  # residuals that show whether their size depends on the signal
_DOUBTED = 0.01  # significance of that
_LEAST = 0.05  # of the mean square: the least that a sample's may be


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Test of whether the residuals of one channel are white noise.

    Parameters
    ----------
    variance
        Mean square of the residuals in sigmas; 1 if the model is complete and sigma is right.
    lag_one
        Autocorrelation from sample to sample.
    p_value
        p-value of a portmanteau test on 20 lags that is valid for noise of varying size (Lobato, Nankervis and
        Savin, 2001); a small value means that the residuals are not white.
    samples, effective
        Number of samples, and number of independent samples with the same information.
    """

    case: str
    signal: str
    variance: float
    lag_one: float
    p_value: float
    samples: int
    effective: float


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """Residuals (N,) of one channel over its case's samples, their Jacobian (N, n); `there` (N,) is 1 or 0.

    Residuals that grow with the signal are divided by their `level` (N,), by which the Jacobian is multiplied.
    """

    signal: str
    residuals: FloatArray
    jacobian: FloatArray
    there: FloatArray
    level: FloatArray | float = 1.0

    @property
    def count(self) -> float:
        """Number of samples."""
        return float(self.there.sum())


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Covariance J' W J (n, n) of the scores of coloured residuals, and what the residuals show.

    `memory` is the longest lag, in samples, at which residuals are correlated; `growth_p` the smallest p-value of
    residuals whose size does not depend on the signal's.
    """

    meat: FloatArray
    whiteness: tuple[Whiteness, ...]
    memory: int
    growth_p: float


def score_covariance(problem: Problem, best: Evaluation, j: FloatArray) -> Scores:
    """Return J' W J, (n, n), with W the covariance of coloured residuals, and the residuals' statistics.

    W holds each case's auto- and cross-covariances, tapered (Bartlett) beyond the lag where they vanish in their
    own scatter. Where residuals grow with the signal, W does.
    """
    n = j.shape[1]
    features = np.zeros((n, n))
    by_case: dict[str, list[Record]] = {}
    levels = _levels(problem, best)
    for k, ((case, criterion), rows) in enumerate(zip(problem.criteria, problem.slices, strict=True)):
        r, jr = best.residuals[rows], j[rows]
        if criterion.rows is None:
            features += jr.T @ (jr * r[:, None] ** 2)
            continue
        length = len(case.task.time)
        residuals, jacobian, there, level = (
            np.zeros(length),
            np.zeros((length, n)),
            np.zeros(length),
            np.ones(length),
        )
        level[criterion.rows], there[criterion.rows] = levels.scale[k], 1.0
        residuals[criterion.rows], jacobian[criterion.rows] = r, jr
        record = Record(criterion.signal, residuals / level, jacobian * level[:, None], there, level)
        by_case.setdefault(case.id, []).append(record)
    prior = j[len(j) - len(problem.space.priors) :]  # of unit variance by definition
    meat, whiteness = coloured_covariance(by_case, n)
    memory = max((_memory(r.residuals, r.count) for records in by_case.values() for r in records), default=0)
    return Scores(features + prior.T @ prior + meat, whiteness, memory, levels.p_value)


@dataclass(frozen=True, slots=True, eq=False)
class _Levels:
    """For each criterion, the size of its residuals (m,) relative to their root mean square; 1 if constant."""

    scale: list[FloatArray]
    p_value: float


def _levels(problem: Problem, best: Evaluation) -> _Levels:
    """Return by how much residuals grow with the signal, one law for every signal.

    Their squares are regressed on those of the prediction (Koenker's version of Breusch and Pagan's test).
    """
    from scipy.optimize import nnls
    from scipy.special import chdtrc

    scale = [np.ones(rows.stop - rows.start) for rows in problem.slices]
    shown = {
        case.id: dict(zip((c.signal for c in case.channels), y, strict=True))
        for case, y in zip(problem.cases, best.predictions, strict=True)
    }
    by_signal: dict[str, list[int]] = {}
    for k, (_, criterion) in enumerate(problem.criteria):
        if criterion.rows is not None and len(scale[k]) == len(criterion.rows):
            by_signal.setdefault(criterion.label, []).append(k)
    least = 1.0
    for members in by_signal.values():
        square = [best.residuals[problem.slices[k]] ** 2 for k in members]
        signal = [
            shown[problem.criteria[k][0].id][problem.criteria[k][1].signal][problem.criteria[k][1].rows]
            for k in members
        ]
        y, q = np.concatenate(square), np.concatenate(signal) ** 2
        if len(y) < _SAMPLES or not (np.std(y) > 0.0 and np.std(q) > 0.0):
            continue
        effective = sum(_independent(best.residuals[problem.slices[k]]) for k in members)
        p_value = float(chdtrc(1, effective * np.corrcoef(y, q)[0, 1] ** 2))
        least = min(least, p_value * len(by_signal))
        if p_value * len(by_signal) < _DOUBTED and np.corrcoef(y, q)[0, 1] > 0.0:
            (constant, slope), _ = nnls(np.column_stack([np.ones(len(q)), q / np.mean(q)]), y)
            level = np.maximum(constant + slope * q / np.mean(q), _LEAST * np.mean(y))
            root = np.sqrt(level / np.mean(level))
            for k, part in zip(members, np.split(root, np.cumsum([len(s) for s in square])[:-1]), strict=True):
                scale[k] = part
    return _Levels(scale, least)


def _independent(r: FloatArray) -> float:
    """Return the number of independent squares among (N,) residuals."""
    rho = _correlations(r)[1 : 1 + _memory(r, len(r))]
    return len(r) / (1.0 + 2.0 * float(np.sum(rho**2)))


def coloured_covariance(
    by_case: Mapping[str, Sequence[Record]], n: int
) -> tuple[FloatArray, tuple[Whiteness, ...]]:
    """Return J' W J, (n, n), for the cases' records of all channels, and the residuals' statistics."""
    meat = np.zeros((n, n))
    whiteness: list[Whiteness] = []
    for case_id, records in by_case.items():
        # One filter for all channels of a case, which keeps their cross-covariances defined.
        colour = float(np.mean([_colour(r.residuals, r.count) for r in records]))
        white = [_prewhitened(r, colour) for r in records]
        lag = max(_memory(w.residuals, w.count) for w in white)
        for a in white:
            for b in white:
                meat += _quadratic(a, b, lag)
        whiteness += [_whiteness(case_id, r, w, colour, lag) for r, w in zip(records, white, strict=True)]
    return 0.5 * (meat + meat.T), tuple(whiteness)


def _colour(r: FloatArray, count: float) -> float:
    """Return the coefficient of a first-order autoregression of (N,) residuals; 0 if within its scatter."""
    rho = float(_correlations(r)[1]) if len(r) > 1 else 0.0
    if abs(rho) < 2.0 / np.sqrt(max(count, 1.0)):
        return 0.0
    # Kendall (1954): the estimate is low by (1 + 3 rho) / N, or slightly more if parameters were fitted.
    # Bound by Andrews and Monahan; at a higher sampling rate the same time spans more samples: up to half the
    # record.
    most = max(0.97, 1.0 - 2.0 / max(count, 1.0))
    return float(np.clip(rho + (1.0 + 4.0 * rho) / max(count, 1.0), -most, most))


def _prewhitened(record: Record, colour: float) -> Record:
    """Return ``L r`` and ``L^-T J`` for the autoregressive filter L, so that J' W J keeps its value.

    Andrews and Monahan (1992): the remaining correlation is short, so its kernel estimate is hardly biased.
    """
    if colour == 0.0:
        return record
    first = np.sqrt(1.0 - colour**2)
    r = record.residuals.copy()
    r[1:] -= colour * record.residuals[:-1]
    r[0] *= first
    j = first_order(record.jacobian[::-1], colour)[::-1].copy()
    j[0] /= first
    return replace(record, residuals=r, jacobian=j)


def _correlations(r: FloatArray) -> FloatArray:
    """Return the autocorrelation of (N,) residuals at lags 0..N-1."""
    covariance = _cross(r, r)[: len(r)]
    return np.asarray(covariance / covariance[0] if covariance[0] > 0.0 else np.eye(1, len(r))[0])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return sum_k a_k b_{k+l} for lags l = 0..N-1 and, at the end, -(N-1)..-1 of a (2N,) circle."""
    size = 2 * len(a)
    return np.asarray(np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size))


def _memory(r: FloatArray, count: float) -> int:
    """Return the lag beyond which autocorrelation is scatter: the first of five consecutive lags within it."""
    inside = np.abs(_correlations(r)[1:]) < 2.0 / np.sqrt(max(count, 1.0))
    run = 5
    for lag in range(len(inside) - run):
        if np.all(inside[lag : lag + run]):
            return lag
    return max(len(inside) - run, 0)


def _taper(n: int, lag: int) -> FloatArray:
    """Return (n,) Bartlett weights; twice the memory keeps most of a decaying correlation."""
    return np.maximum(1.0 - np.arange(n) / (2 * lag + 1), 0.0)


def _quadratic(a: Record, b: Record, lag: int) -> FloatArray:
    """Return sum_kl ja_k gamma_(l-k) jb_l, where gamma is the tapered covariance of channels a and b."""
    n = len(a.residuals)
    decay = _taper(n, lag)
    taper = np.concatenate([decay, [0.0], decay[1:][::-1]])
    gamma = _cross(a.residuals, b.residuals) / np.sqrt(a.count * b.count) * taper
    # gamma depends on l - k, so (W jb)_k = sum_l gamma_(l-k) jb_l is a correlation.
    spectrum = np.conj(np.fft.rfft(gamma))
    moved = np.fft.irfft(spectrum[:, None] * np.fft.rfft(b.jacobian, 2 * n, axis=0), 2 * n, axis=0)[:n]
    return np.asarray(a.jacobian.T @ moved)


def _whiteness(case: str, record: Record, white: Record, colour: float, lag: int) -> Whiteness:
    from scipy.special import chdtrc

    r, count = record.residuals * record.level, int(record.count)
    rho = _correlations(r)
    lags = min(20, max(count // 5, 1), len(rho) - 1)
    products, squares = _cross(r, r)[1 : lags + 1], _cross(r**2, r**2)
    scatter = np.maximum(squares[1 : lags + 1], 1e-12 * squares[0] + np.finfo(float).tiny)
    portmanteau = float(np.sum(products**2 / scatter))
    # Ratio of long-run variance to variance: the information in a sample.
    rest = 1.0 + 2.0 * float(np.sum((_taper(len(r), lag) * _correlations(white.residuals))[1:]))
    energy = float(np.sum(white.residuals**2)) / max(float(np.sum(record.residuals**2)), np.finfo(float).tiny)
    inflation = max(energy * rest / (1.0 - colour) ** 2, 1.0)
    return Whiteness(
        case,
        record.signal,
        float(np.sum(r**2) / max(count, 1)),
        float(rho[1]) if len(rho) > 1 else 0.0,
        float(chdtrc(lags, portmanteau)) if lags > 0 else 1.0,
        count,
        count / inflation,
    )
