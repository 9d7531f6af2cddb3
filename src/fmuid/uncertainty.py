"""How far estimates can be trusted: covariance under coloured residuals, profiles, propagation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from fmuid.campaign import FloatArray
from fmuid.derivatives import Differences, EvaluateMany, NoiseFloor, noise_floor
from fmuid.errors import SimulationError
from fmuid.identifiability import Identifiability, identifiability
from fmuid.problem import Evaluation, Problem

Matrix = tuple[tuple[float, ...], ...]
_LEVEL = 0.95
_COLLINEAR = 1000.0  # ratio of eigenvalues of the correlation from which a direction is walked
_FARTHEST = 64.0
_FOLLOWING = 4  # evaluations for the others to follow a parameter that is moved


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Whether the residuals of one channel are noise.

    Parameters
    ----------
    variance
        Mean square of the residuals in sigmas; 1 if the model is complete and sigma right.
    lag_one
        Autocorrelation from sample to sample.
    p_value
        Of Ljung and Box's test on 20 lags; small means not white.
    samples, effective
        Number of samples, and of independent ones that carry as much.
    """

    case: str
    signal: str
    variance: float
    lag_one: float
    p_value: float
    samples: int
    effective: float


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Covariance of the free parameters, and what it rests on.

    `covariance` (n, n) and `correlation` are in search space, `standard_errors` (n,) and `intervals` (95 %) in
    model space; the latter are None where the experiments do not determine the parameter.
    """

    names: tuple[str, ...]
    point: tuple[float, ...]
    covariance: Matrix
    standard_errors: tuple[float | None, ...]
    intervals: tuple[tuple[float, float] | None, ...]
    correlation: Matrix
    degrees_of_freedom: float
    identifiability: Identifiability
    whiteness: tuple[Whiteness, ...] = ()
    naive_errors: tuple[float | None, ...] = field(default=())
    noise_floor: float = 0.0


def uncertainty_of(
    problem: Problem,
    best: Evaluation,
    *,
    evaluate: EvaluateMany | None = None,
    floor: NoiseFloor | None = None,
) -> Uncertainty:
    """Return the uncertainty of the estimate `best` of a problem.

    The covariance is the sandwich ``(J'J)^-1 J' W J (J'J)^-1`` in search space; W holds each case's residual
    auto- and cross-covariances, tapered (Bartlett) beyond the lag where they drown in their own scatter. White
    residuals give the textbook covariance, coloured ones (model error, friction) a wider one.

    Parameters
    ----------
    evaluate
        Instead of the problem's own, as when evaluations are recorded.
    floor
        The simulator's noise floor, if it is known already.

    Raises
    ------
    SimulationError
        The neighbourhood of the estimate cannot be simulated.
    """
    from scipy.special import stdtrit

    evaluate = evaluate or problem.evaluate_many
    floor = floor or noise_floor(problem, best.x, evaluate=evaluate)
    here = best if best.predictions else evaluate([best.x])[0]
    j = Differences(problem, floor, central=True).jacobian(evaluate, here)
    tolerance = max(1e-6, 5.0 * floor.central_step**2)
    first = identifiability(problem, best.x, j, tolerance=tolerance)
    bread = np.linalg.pinv(j.T @ j, rcond=tolerance**2, hermitian=True)
    meat, whiteness = _meat(problem, here, j)
    n, m = len(best.x), len(here.residuals)
    correction = m / max(m - n, 1)
    covariance = correction * bread @ meat @ bread
    if n > 1 and first.complete:
        covariance = _widened(problem, evaluate, here, j, covariance)
    found = identifiability(problem, best.x, j, tolerance=tolerance, covariance=covariance)
    found = found if first.complete else first
    effective = sum(w.effective for w in whiteness) or float(m)
    degrees = max(effective - n, 1.0)
    t = float(stdtrit(degrees, 0.5 + 0.5 * _LEVEL))
    slope = problem.space.slope(best.x)
    spread = np.sqrt(np.diag(covariance))
    low, high = (problem.space.to_model(best.x + sign * t * spread) for sign in (-1.0, 1.0))
    known = [name not in found.undetermined for name in problem.space.names]
    naive = np.sqrt(np.diag(bread) * float(here.residuals @ here.residuals) / max(m - n, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(spread, spread)
    return Uncertainty(
        names=problem.space.names,
        point=tuple(map(float, best.x)),
        covariance=_matrix(covariance),
        standard_errors=tuple(float(s) if k else None for s, k in zip(slope * spread, known, strict=True)),
        intervals=tuple(
            (low[name], high[name]) if k else None for name, k in zip(problem.space.names, known, strict=True)
        ),
        correlation=_matrix(np.nan_to_num(correlation)),
        degrees_of_freedom=degrees,
        identifiability=found,
        whiteness=whiteness,
        naive_errors=tuple(float(s) if k else None for s, k in zip(slope * naive, known, strict=True)),
        noise_floor=floor.residual,
    )


def profile_interval(
    problem: Problem, estimate: Uncertainty, name: str, *, level: float = _LEVEL
) -> tuple[float, float]:
    """Return the profile-likelihood interval of one parameter, in model space.

    The others are fitted again while this one moves outwards, until the cost has grown by what `level` allows
    (scaled as the sandwich covariance is, so coloured residuals count). An end that is never reached is the
    bound, or infinite.

    Raises
    ------
    SimulationError
        A refit fails.
    """
    from scipy.optimize import brentq
    from scipy.special import stdtrit

    i = estimate.names.index(name)
    x = np.array(estimate.point)
    best = problem.evaluate(x)
    spread = float(np.sqrt(estimate.covariance[i][i]))
    floor = noise_floor(problem, x)
    j = Differences(problem, floor, central=True).jacobian(problem.evaluate_many, best)
    plain = np.linalg.pinv(j.T @ j, hermitian=True)[i, i]
    t = float(stdtrit(estimate.degrees_of_freedom, 0.5 + 0.5 * level))
    allowed = t**2 * spread**2 / plain
    ends = []
    for sign, bound in ((-1.0, problem.space.lower[i]), (1.0, problem.space.upper[i])):
        refit = _Refit(problem, i, x)

        def excess(distance: float, sign: float = sign, refit: _Refit = refit) -> float:
            return float(refit.cost(x[i] + sign * distance) - best.cost - allowed)

        far, limit = t * spread, abs(bound - x[i])
        while excess(min(far, limit)) < 0.0 and far < min(limit, 64.0 * t * spread):
            far *= 2.0
        far = min(far, limit)
        reached = excess(far) >= 0.0
        distance = brentq(excess, 0.0, far, xtol=1e-3 * far, rtol=1e-3) if reached else limit
        point = x.copy()
        point[i] = x[i] + sign * distance
        ends.append(problem.space.to_model(point)[name] if np.isfinite(distance) else sign * np.inf)
    return float(ends[0]), float(ends[1])


def _widened(
    problem: Problem, evaluate: EvaluateMany, best: Evaluation, j: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return the covariance, widened where parameters compensate each other better than it says.

    Nearly collinear columns of a Jacobian differ by its own errors (kinks, noise), which look like information.
    So in the weakest directions the leading parameter is moved by two standard errors and the others follow by
    Gauss-Newton steps: where the cost grows by less than a quarter of what is expected, the parameter is moved
    on until it does, and the way it went is its spread.
    """
    spread = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    plain = np.linalg.inv(j.T @ j)
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value < _COLLINEAR * max(values[0], 0.0):
            break
        i = int(np.argmax(np.abs(vector)))
        expected = 4.0 * spread[i] ** 2 / plain[i, i]
        factor, way = 1.0, np.zeros(len(spread))
        for sign in (1.0, -1.0):
            offset = 2.0 * sign * covariance[i] / spread[i]  # where the others are expected
            reach = 1.0
            while reach <= _FARTHEST:
                moved = _followed(problem, evaluate, best, j, best.x + offset, i)
                if moved is None or moved.cost - best.cost >= 0.25 * expected:
                    break
                offset = 2.0 * (moved.x - best.x)
                reach *= 2.0
                if reach > factor:
                    factor, way = reach, (moved.x - best.x) / reach
        covariance = covariance + (factor**2 - 1.0) * np.outer(way, way)
    return covariance


def _followed(
    problem: Problem, evaluate: EvaluateMany, best: Evaluation, j: FloatArray, x: FloatArray, i: int
) -> Evaluation | None:
    """Return the evaluation at `x` after all parameters but `i` have followed, or None where it fails."""
    others = np.arange(len(x)) != i
    solve = np.linalg.pinv(j[:, others])
    for _ in range(_FOLLOWING):
        if np.any(x < problem.space.lower) or np.any(x > problem.space.upper):
            return None
        (here,) = evaluate([x])
        if not here.ok:
            return None
        if here.cost <= best.cost:
            break
        x = x.copy()
        x[others] -= solve @ here.residuals
    return here


class _Refit:
    """Fits all parameters but one, each time from the last fit."""

    def __init__(self, problem: Problem, i: int, x: FloatArray) -> None:
        self.problem, self.i = problem, i
        self.others = np.arange(len(x)) != i
        self.x = x.copy()

    def cost(self, value: float) -> float:
        """Return the least cost with parameter i at `value` of search space."""
        from scipy.optimize import least_squares

        if not np.any(self.others):
            return self._evaluate(np.zeros(0), value).cost
        lower, upper = self.problem.space.lower[self.others], self.problem.space.upper[self.others]
        start = np.clip(self.x[self.others], np.nextafter(lower, np.inf), np.nextafter(upper, -np.inf))
        step = 1e-4
        result = least_squares(
            lambda others: self._evaluate(others, value).residuals,
            start,
            bounds=(lower, upper),
            diff_step=step,
            ftol=1e-9,
            xtol=1e-8,
        )
        self.x[self.others] = result.x
        return float(2.0 * result.cost)

    def _evaluate(self, others: FloatArray, value: float) -> Evaluation:
        point = self.x.copy()
        point[self.others], point[self.i] = others, value
        evaluation = self.problem.evaluate(point)
        if evaluation.failure is not None:
            raise SimulationError(f"the profile meets a failing point ({evaluation.failure})")
        return evaluation


@dataclass(frozen=True, slots=True, eq=False)
class Propagated:
    """Predictions over the uncertainty of the parameters, by Monte Carlo.

    `lower` and `upper` are the (channels, N) bounds of the level asked for, one pair a case; `worst` the largest
    value of each criterion met.
    """

    lower: tuple[FloatArray, ...]
    upper: tuple[FloatArray, ...]
    worst: FloatArray
    failed: int


def propagate(
    problem: Problem, estimate: Uncertainty, *, draws: int = 200, level: float = _LEVEL, seed: int = 0
) -> Propagated:
    """Simulate parameters drawn from the estimate's distribution.

    Raises
    ------
    SimulationError
        No draw can be simulated.
    """
    generator = np.random.default_rng(seed)
    points = generator.multivariate_normal(np.array(estimate.point), np.array(estimate.covariance), draws)
    points = np.clip(points, problem.space.lower, problem.space.upper)
    evaluations = problem.evaluate_many(list(points))
    good = [e for e in evaluations if e.ok]
    if not good:
        raise SimulationError("no draw can be simulated", fix="narrow the bounds")
    tails = (0.5 - 0.5 * level, 0.5 + 0.5 * level)
    bands = [np.quantile(np.array(p), tails, axis=0) for p in zip(*(e.predictions for e in good), strict=True)]
    return Propagated(
        tuple(b[0] for b in bands),
        tuple(b[1] for b in bands),
        np.max([e.criteria for e in good], axis=0),
        draws - len(good),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Record:
    """Residuals (N,) of one channel over its case's samples, their Jacobian (N, n), where they exist (N,)."""

    signal: str
    residuals: FloatArray
    jacobian: FloatArray
    there: FloatArray

    @property
    def count(self) -> float:
        """Number of samples."""
        return float(self.there.sum())


def _meat(problem: Problem, best: Evaluation, j: FloatArray) -> tuple[FloatArray, tuple[Whiteness, ...]]:
    """Return J' W J, (n, n), and the residuals' statistics."""
    n = j.shape[1]
    meat = np.zeros((n, n))
    by_case: dict[str, list[_Record]] = {}
    for (case, criterion), rows in zip(problem.criteria, problem.slices, strict=True):
        r, jr = best.residuals[rows], j[rows]
        if criterion.rows is None:
            meat += jr.T @ (jr * r[:, None] ** 2)
            continue
        length = len(case.task.time)
        record = _Record(criterion.signal, np.zeros(length), np.zeros((length, n)), np.zeros(length))
        record.residuals[criterion.rows], record.jacobian[criterion.rows] = r, jr
        record.there[criterion.rows] = 1.0
        by_case.setdefault(case.id, []).append(record)
    whiteness: list[Whiteness] = []
    for case_id, records in by_case.items():
        # One filter for all channels of a case, so that their cross-covariances stay defined.
        colour = float(np.mean([_colour(r.residuals, r.count) for r in records]))
        white = [_prewhitened(r, colour) for r in records]
        lag = max(_memory(w.residuals, w.count) for w in white)
        for a in white:
            for b in white:
                meat += _quadratic(a, b, lag)
        whiteness += [_whiteness(case_id, r, w, colour, lag) for r, w in zip(records, white, strict=True)]
    return 0.5 * (meat + meat.T), tuple(whiteness)


def _colour(r: FloatArray, count: float) -> float:
    """Return the coefficient of a first-order autoregression of (N,) residuals; 0 if it is within scatter."""
    rho = float(_correlations(r)[1]) if len(r) > 1 else 0.0
    if abs(rho) < 2.0 / np.sqrt(max(count, 1.0)):
        return 0.0
    # Kendall (1954): the estimate is low by (1 + 3 rho) / N, a little more where parameters were fitted.
    return float(np.clip(rho + (1.0 + 4.0 * rho) / max(count, 1.0), -0.97, 0.97))


def _prewhitened(record: _Record, colour: float) -> _Record:
    """Return ``L r`` and ``L^-T J`` for the autoregressive filter L, so that J' W J keeps its value.

    Andrews and Monahan (1992): what is left of the correlation is short, and the kernel estimate of it is
    hardly biased.
    """
    if colour == 0.0:
        return record
    from scipy.signal import lfilter

    first = np.sqrt(1.0 - colour**2)
    r = record.residuals.copy()
    r[1:] -= colour * record.residuals[:-1]
    r[0] *= first
    j = lfilter([1.0], [1.0, -colour], record.jacobian[::-1], axis=0)[::-1].copy()
    j[0] /= first
    return _Record(record.signal, r, j, record.there)


def _correlations(r: FloatArray) -> FloatArray:
    """Return the autocorrelation of (N,) residuals at lags 0..N-1."""
    covariance = _cross(r, r)[: len(r)]
    return np.asarray(covariance / covariance[0] if covariance[0] > 0.0 else np.eye(1, len(r))[0])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return sum_k a_k b_{k+l} for lags l = 0..N-1 and, at the end, -(N-1)..-1 of a (2N,) circle."""
    size = 2 * len(a)
    return np.asarray(np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size))


def _memory(r: FloatArray, count: float) -> int:
    """Return the lag beyond which autocorrelation is scatter: the first of five lags in a row within it."""
    inside = np.abs(_correlations(r)[1:]) < 2.0 / np.sqrt(max(count, 1.0))
    run = 5
    for lag in range(len(inside) - run):
        if np.all(inside[lag : lag + run]):
            return lag
    return max(len(inside) - run, 0)


def _taper(n: int, lag: int) -> FloatArray:
    """Return (n,) Bartlett weights; twice the memory keeps most of a decaying correlation."""
    return np.maximum(1.0 - np.arange(n) / (2 * lag + 1), 0.0)


def _quadratic(a: _Record, b: _Record, lag: int) -> FloatArray:
    """Return sum_kl ja_k gamma_(l-k) jb_l with gamma the tapered covariance of channels a and b."""
    n = len(a.residuals)
    decay = _taper(n, lag)
    taper = np.concatenate([decay, [0.0], decay[1:][::-1]])
    gamma = _cross(a.residuals, b.residuals) / np.sqrt(a.count * b.count) * taper
    # gamma belongs to l - k, so (W jb)_k = sum_l gamma_(l-k) jb_l is a correlation.
    spectrum = np.conj(np.fft.rfft(gamma))
    moved = np.fft.irfft(spectrum[:, None] * np.fft.rfft(b.jacobian, 2 * n, axis=0), 2 * n, axis=0)[:n]
    return np.asarray(a.jacobian.T @ moved)


def _whiteness(case: str, record: _Record, white: _Record, colour: float, lag: int) -> Whiteness:
    from scipy.special import chdtrc

    r, count = record.residuals, int(record.count)
    rho = _correlations(r)
    lags = min(20, max(count // 5, 1), len(rho) - 1)
    terms = rho[1 : lags + 1] ** 2 / (count - np.arange(1, lags + 1))
    ljung_box = count * (count + 2) * float(np.sum(terms))
    # Long-run variance over variance: what a sample is worth.
    rest = 1.0 + 2.0 * float(np.sum((_taper(len(r), lag) * _correlations(white.residuals))[1:]))
    energy = float(np.sum(white.residuals**2)) / max(float(np.sum(r**2)), np.finfo(float).tiny)
    inflation = max(energy * rest / (1.0 - colour) ** 2, 1.0)
    return Whiteness(
        case,
        record.signal,
        float(np.sum(r**2) / max(count, 1)),
        float(rho[1]) if len(rho) > 1 else 0.0,
        float(chdtrc(lags, ljung_box)) if lags > 0 else 1.0,
        count,
        count / inflation,
    )


def _matrix(values: FloatArray) -> Matrix:
    return tuple(tuple(float(v) for v in row) for row in values)


def without_intervals(estimate: Uncertainty, names: Sequence[str]) -> Uncertainty:
    """Return `estimate` without standard errors for `names`, as for parameters at a bound."""
    hide = partial(_hidden, estimate.names, names)
    return replace(estimate, standard_errors=hide(estimate.standard_errors), intervals=hide(estimate.intervals))


_T = TypeVar("_T")


def _hidden(names: tuple[str, ...], hidden: Sequence[str], values: tuple[_T | None, ...]) -> tuple[_T | None, ...]:
    return tuple(None if n in hidden else v for n, v in zip(names, values, strict=True))
