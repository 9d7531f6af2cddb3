"""Covariance of estimates under coloured residuals and near-collinearity."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from fmuid.core.campaign import SEPARATOR
from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import Differences, EvaluateMany, NoiseFloor, noise_floor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.uncertainty.active_constraints import Active, active_constraints, tangent_space
from fmuid.identification.uncertainty.clusters import (
    CHANCE,
    PLAIN,
    RUNS,
    Clustered,
    clustered,
    information_of_runs,
    without_moves,
)
from fmuid.identification.uncertainty.coloured_residuals import Whiteness, score_covariance
from fmuid.identification.uncertainty.identifiability import Identifiability, identifiability
from fmuid.identification.uncertainty.inherited import Held, effective_degrees
from fmuid.identification.uncertainty.input_noise import InputNoise, input_noise, noisy_inputs
from fmuid.identification.uncertainty.new_runs import NewRuns, new_runs

Matrix = tuple[tuple[float, ...], ...]
LEVEL = 0.95
_DOUBTED = 0.01  # significance at which residuals contradict a given sigma
_APART = 0.05  # the same for what the runs say about the parameters; more tests decide what follows from it
_MISSED, _LARGE = 1e-6, 4.0  # p-value, and mean square in sigmas, of a run that the model does not follow
_EXPLODED = 100.0  # growth of sensitivities over a run at which segments help
_CHAOTIC = 1e-3  # relative scatter of predictions under tiny changes of the parameters
_FEW = 2.0  # degrees of freedom that the scatter between runs needs to be known
_TWO = 0.01  # two clusters have an interval that is six times as wide
_COLLINEAR = 1000.0  # ratio of the correlation's eigenvalues above which a direction is explored by steps
_FARTHEST = 64.0
_BIASED = 0.5  # standard errors: a smaller bias hardly changes an interval
_COUNTS = 0.01  # share of the information on a parameter from which on a run counts
_FEW_RUNS = 3  # so many do not show how much a parameter differs between runs
_FOLLOWING = 4  # evaluations for refitting the others to a moved parameter


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Covariance of the free parameters `names` at `point`, and its basis.

    Parameters
    ----------
    names, point
        The n free parameters and their values.
    covariance, correlation
        (n, n), in search space.
    standard_errors, intervals
        (n,), in model space, with the errors in `inherited`; the intervals have 95 %. None if the experiments do
        not determine the parameter.
    degrees_of_freedom, degrees
        Degrees of freedom of the stage's own noise, and (n,) of the standard errors; None means infinite.
    identifiability
        The directions that the experiments determine.
    whiteness
        Tests of the residuals.
    naive_errors
        (n,) standard errors that would hold for white noise.
    noise_floor
        That of the simulator.
    held, held_slopes
        Parameters that earlier stages identified and this stage fixes, and the (n, h) derivatives of the estimate
        with respect to them in model space.
    inherited
        (n, n), the part of `covariance` that comes from their errors.
    notes
        Conditions of the standard errors, or why there are none.
    robust
        Parameters whose errors come from the scatter between runs (clusters), which exceeds that of coloured
        noise.
    few_runs
        Parameters that a single run determines, or up to three, with that number: nothing shows how much they
        differ from run to run.
    biased
        Parameters that noise of recorded inputs moves by more than half a standard error, which intervals include.
    constraints
        The active ones.
    new_runs
        Errors of predictions of new runs.
    """

    names: tuple[str, ...]
    point: tuple[float, ...]
    covariance: Matrix
    standard_errors: tuple[float | None, ...]
    intervals: tuple[tuple[float, float] | None, ...]
    correlation: Matrix
    degrees_of_freedom: float | None
    identifiability: Identifiability
    whiteness: tuple[Whiteness, ...] = ()
    naive_errors: tuple[float | None, ...] = field(default=())
    noise_floor: float = 0.0
    held: tuple[str, ...] = ()
    held_slopes: Matrix = ()
    inherited: Matrix = ()
    degrees: tuple[float | None, ...] = ()
    notes: tuple[str, ...] = ()
    robust: tuple[str, ...] = ()
    few_runs: dict[str, int] = field(default_factory=dict)
    biased: tuple[str, ...] = ()
    constraints: tuple[str, ...] = ()
    new_runs: tuple[NewRuns, ...] = ()

    @property
    def freedom(self) -> FloatArray:
        """(n,) degrees of freedom of the standard errors, possibly infinite."""
        return np.array([math.inf if d is None else d for d in self.degrees])

    @property
    def inherited_shares(self) -> tuple[float, ...]:
        """(n,) share of each variance due to parameters fixed at earlier estimates."""
        if not self.inherited:
            return (0.0,) * len(self.names)
        pairs = zip(np.diag(self.inherited), np.diag(self.covariance), strict=True)
        return tuple(float(part / whole) if whole > 0.0 else 0.0 for part, whole in pairs)


def uncertainty_of(
    problem: Problem,
    best: Evaluation,
    *,
    evaluate: EvaluateMany | None = None,
    floor: NoiseFloor | None = None,
    held: Held | None = None,
    evaluate_held: EvaluateMany | None = None,
) -> Uncertainty:
    """Return the uncertainty of the estimate `best` of a problem.

    The covariance is the sandwich ``(J'J)^-1 J' W J (J'J)^-1`` in search space. If sigma was given for every
    residual, W is that noise, taken as exactly known. If the residuals contradict it (by their energy or colour,
    at 1 %, or as runs move the estimate apart, at 5 %), or if sigma was not given, W contains each case's residual
    auto- and cross-covariances, tapered (Bartlett) beyond the lag where they vanish in their scatter. Coloured
    residuals (model error, friction) therefore give a wider covariance than white ones. With only as many
    residuals as parameters, the noise is unknown, and without a sigma there are no standard errors. At active
    constraints, the covariance is restricted to directions along them. Errors of parameters fixed at an earlier
    stage's estimate are added (`fmuid.identification.uncertainty.inherited`).

    Parameters
    ----------
    problem, best
        The problem, and its evaluation at the estimate.
    evaluate
        Replacement for the problem's `evaluate_many`, for example to record evaluations.
    floor
        The simulator's noise floor, if already known.
    held, evaluate_held
        Parameters fixed at estimates of earlier stages (`inherited`), and the evaluation function of their
        problem.

    Raises
    ------
    SimulationError
        The neighbourhood of the estimate cannot be simulated.

    References
    ----------
    H. White, Econometrica 48 (1980), 817-838; W. K. Newey and K. D. West, Econometrica 55 (1987), 703-708.
    """
    from scipy.special import stdtrit

    evaluate = evaluate or problem.evaluate_many
    floor = floor or noise_floor(problem, best.x, evaluate=evaluate)
    # A resumed run does not store all of an evaluation.
    here = best if best.predictions and best.residuals.size else evaluate([best.x])[0]
    differences = Differences(problem, floor, central=True)
    j, tolerance = differences.jacobian(evaluate, here), differences.tolerance
    scale = differences.column_scale(j)
    first = identifiability(problem, best.x, j, scale, tolerance=tolerance)
    scaled = j / scale
    free = _bread(scaled, scale, np.eye(len(best.x)), tolerance)
    active = active_constraints(problem, here, evaluate, floor.central_step, -free @ j.T @ here.residuals)
    along = tangent_space(active.gradients / scale)
    bread = _bread(scaled, scale, along, tolerance) if active.texts else free
    n = len(best.x)
    whole = first.complete and not active.texts and not problem.segments
    recorded, unknown = InputNoise.none(n), ""
    try:
        recorded = input_noise(problem, here, j, bread, floor)
    except SimulationError as error:
        unknown = f"the noise of the inputs is not in the intervals: {error}"
    extent = along.shape[1] + problem.nuisances
    scatter = _scatter(problem, here, j, bread, extent, of_inputs=recorded.covariance, whole=whole)
    covariance, whiteness = scatter.covariance, scatter.whiteness
    if n > 1 and first.complete and not active.texts and scatter.degrees > 0.0:
        covariance = _widened(problem, evaluate, here, j, covariance)
    spoken = covariance if scatter.degrees > 0.0 else None
    separable = identifiability(problem, best.x, j, scale, tolerance=tolerance, covariance=spoken)
    separable = separable if first.complete else first
    plain_degrees = scatter.degrees
    slope = problem.space.slope(best.x)
    degrees = np.array([scatter.robust[k].degrees[k] if k in scatter.robust else plain_degrees for k in range(n)])
    parts = np.column_stack([np.maximum(np.diag(covariance), 0.0), recorded.bias**2])
    biased: list[int] = np.flatnonzero(parts[:, 1] > _BIASED**2 * parts[:, 0]).tolist()
    if biased:
        degrees = effective_degrees(parts, np.column_stack([degrees, np.full(n, np.inf)]))
    covariance = covariance + np.outer(recorded.bias, recorded.bias)
    inherited, held_slopes = np.zeros((n, n)), np.zeros((n, 0))
    if held is not None:
        there, evaluate = replace(here, x=held.point(best.x)), evaluate_held or held.problem.evaluate_many
        across = Differences(held.problem, floor, central=False).jacobian(evaluate, there, n)
        moves = -bread @ j.T @ across
        held_slopes = slope[:, None] * moves / held.problem.space.slope(there.x)[n:]
        roots = moves @ held.rows
        inherited = roots @ roots.T
        parts = np.column_stack([np.maximum(np.diag(covariance), 0.0), roots**2])
        degrees = effective_degrees(parts, np.column_stack([degrees, np.tile(held.degrees, (n, 1))]))
        covariance = covariance + inherited
    t = stdtrit(np.maximum(degrees, 1.0), 0.5 + 0.5 * LEVEL)
    variance = np.diag(covariance)
    spread = np.sqrt(np.maximum(variance, 0.0))
    low, high = (problem.space.to_model(best.x + sign * t * spread) for sign in (-1.0, 1.0))
    # A kernel estimate can be indefinite, and a negative variance is invalid.
    sound = (variance >= -1e-9 * np.max(np.abs(variance))) & (scatter.degrees > 0.0)
    fixed = np.diag(bread) < 1e-9 * np.diag(free)  # does not move along the constraints
    names = problem.space.names
    known = [n not in separable.undetermined and bool(s) for n, s in zip(names, sound & ~fixed, strict=True)]
    spare = max(scatter.residuals - scatter.parameters, 1)
    naive = np.sqrt(np.diag(bread) * float(here.residuals @ here.residuals) / spare)
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
        degrees_of_freedom=_limited(plain_degrees),
        identifiability=separable,
        whiteness=whiteness,
        naive_errors=tuple(float(s) if k else None for s, k in zip(slope * naive, known, strict=True)),
        noise_floor=floor.residual,
        held=() if held is None else held.names,
        held_slopes=_matrix(held_slopes),
        inherited=() if held is None else _matrix(inherited),
        degrees=tuple(map(_limited, degrees)),
        robust=tuple(names[k] for k in sorted(scatter.robust)),
        few_runs=_of_few_runs(problem, j, [names[k] for k in scatter.robust]),
        biased=tuple(names[k] for k in biased if known[k]),
        constraints=active.texts,
        new_runs=new_runs(problem, best.x, here.residuals, j) if whole else (),
        notes=(
            *_notes(scatter, active, [n for n, f in zip(names, fixed, strict=True) if f], names, known),
            *_exploding(problem, scaled, whiteness, floor),
            *_biases(problem, slope * recorded.bias, [k for k in biased if known[k]]),
            *([unknown] if unknown else []),
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Scatter:
    """Scatter of estimates from noise: covariance (n, n) and its degrees of freedom, 0 if the noise is unknown."""

    covariance: FloatArray
    degrees: float
    whiteness: tuple[Whiteness, ...]
    residuals: int
    parameters: int
    robust: Mapping[int, Clustered] = field(default_factory=dict)
    plain: frozenset[int] = frozenset()  # those whose scatter between clusters is plainly larger
    runs: int = 1
    few: tuple[int, ...] = ()  # those whose scatter between runs is unknown


def _scatter(
    problem: Problem,
    here: Evaluation,
    j: FloatArray,
    bread: FloatArray,
    parameters: int,
    *,
    of_inputs: FloatArray,
    whole: bool,
) -> _Scatter:
    """Return the scatter, at least that `of_inputs`; clusters are looked at if all parameters are determined."""
    from scipy.special import chdtrc

    m = len(here.residuals)
    scores = score_covariance(problem, here, j)
    whiteness = scores.whiteness
    known, degrees = _noise(problem)
    of_noise = bread @ (j.T @ (j * known[:, None] ** 2)) @ bread + of_inputs

    def by(covariance: FloatArray, freedom: float) -> _Scatter:
        return _Scatter(covariance, freedom, whiteness, m, parameters)

    if m <= parameters:
        return by(of_noise if degrees > 0.0 else bread, degrees)
    colour = _combined([w.p_value for w in whiteness])
    memory = scores.memory if colour < _DOUBTED else None
    clusters = clustered(problem, here.residuals, j, known, memory) if whole else []
    if math.isinf(degrees):
        there = known > 0.0
        energy = float(np.sum((here.residuals[there] / known[there]) ** 2))
        moved = min((c.p_value for c in clusters), default=1.0) * len(clusters)
        doubts = [float(chdtrc(m - parameters, energy)), *(p for p in (colour, scores.growth_p) if p < 1.0)]
        if min(doubts) * len(doubts) >= _DOUBTED and (not clusters or moved >= _APART):
            return by(of_noise, degrees)
    covariance = m / (m - parameters) * bread @ scores.meat @ bread
    if math.isinf(degrees):  # the scatter may exceed the given noise, but not fall below it
        covariance = _not_below(covariance, of_noise)
    # Residuals that are not samples (whitened ones, features) count individually.
    others = sum(
        r.stop - r.start for (_, c), r in zip(problem.criteria, problem.slices, strict=True) if c.rows is None
    )
    effective = sum(w.effective for w in whiteness) + others - parameters
    # Segments restart, so they are as many independent samples (Cameron and Miller 2015: t with clusters - 1).
    freedom = max(effective, problem.segments - (parameters - problem.nuisances), 1.0)
    scatter = by(covariance, freedom)
    if clusters:
        within = np.maximum(_within(problem, here, j, bread, covariance), np.diag(of_noise))
        scatter = _by_clusters(scatter, clusters, within)
    between = next((c for c in clusters if c.of == RUNS), None)
    informed = set() if between is None else set(np.flatnonzero(between.degrees >= _FEW).tolist())
    few = sorted(set(range(j.shape[1])) - informed - scatter.robust.keys())
    return replace(scatter, runs=1 if between is None else between.clusters, few=tuple(few))


def _combined(p_values: Sequence[float]) -> float:
    """Return one p-value for tests of many runs: of what one of them shows alone, or all together (Fisher)."""
    from scipy.special import chdtrc

    if len(p_values) < 2:
        return min(p_values, default=1.0)
    together = -2.0 * float(np.sum(np.log(np.maximum(p_values, np.finfo(float).tiny))))
    return 2.0 * min(min(p_values) * len(p_values), float(chdtrc(2 * len(p_values), together)))


def _within(
    problem: Problem, here: Evaluation, j: FloatArray, bread: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return the (n,) variances that the noise within the runs explains.

    They follow from what each run leaves after it has moved the parameters on its own, so that a parameter that
    differs between the runs does not raise them. Runs of too few independent samples explain the `covariance`.
    """
    apart = without_moves(problem, here.residuals, j)
    scores = score_covariance(problem, replace(here, residuals=apart.residuals), j)
    effective = sum(w.effective for w in scores.whiteness)
    variances = np.diag(covariance)
    if effective <= 2.0 * apart.removed:
        return variances
    return np.minimum(variances, effective / (effective - apart.removed) * np.diag(bread @ scores.meat @ bread))


def _by_clusters(scatter: _Scatter, clusters: Sequence[Clustered], within: FloatArray) -> _Scatter:
    """Return the scatter with the variances between clusters where they exceed those `within` runs, (n,)."""
    covariance, robust, plain = scatter.covariance, dict[int, Clustered](), set[int]()
    degrees = np.full(len(within), scatter.degrees)
    for cluster in clusters:
        many = cluster.clusters > 2 or cluster.p_value < _TWO
        larger = cluster.exceeding(within, CHANCE if many else _TWO)
        larger &= cluster.wider_than(np.diag(covariance), degrees)
        degrees = np.where(larger, cluster.degrees, degrees)
        robust |= dict.fromkeys(np.flatnonzero(larger).tolist(), cluster)
        plain |= set(np.flatnonzero(cluster.exceeding(within, PLAIN)).tolist())
        covariance = _not_below(covariance, np.diag(np.where(larger, cluster.variances, 0.0)))
    return replace(scatter, covariance=covariance, robust=robust, plain=frozenset(plain & robust.keys()))


def _not_below(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """Return the (n, n) covariance with its variances raised to those of another one, with its correlations."""
    variance = np.diag(covariance)
    wider = np.sqrt(np.maximum(np.diag(least) / np.where(variance > 0.0, variance, np.inf), 1.0))
    return np.asarray(covariance * np.outer(wider, wider))


def _noise(problem: Problem) -> tuple[FloatArray, float]:
    """Return the (m,) standard deviations of the residuals from the noise, and their degrees of freedom."""
    parts, degrees = [], math.inf
    rows = zip(problem.criteria, problem.slices, problem.root_weights, strict=True)
    for (_, criterion), where, weight in rows:
        part = np.zeros(where.stop - where.start)
        if weight > 0.0:
            degrees = min(degrees, criterion.degrees if criterion.scatter is not None else 0.0)
            part = part if criterion.scatter is None else weight * criterion.scatter
        parts.append(part)
    parts.append(np.ones(len(problem.space.priors)))  # of unit variance by definition
    return np.concatenate(parts), degrees


def _bread(scaled: FloatArray, scale: FloatArray, along: FloatArray, tolerance: float) -> FloatArray:
    """Return the inverse of J'J within the directions `along`, for a Jacobian J of `scaled` columns."""
    moved = scaled @ along
    inner = np.linalg.pinv(moved.T @ moved, rcond=tolerance**2, hermitian=True)
    return np.asarray(along @ inner @ along.T / np.outer(scale, scale))


def _notes(
    scatter: _Scatter, active: Active, fixed: Sequence[str], names: Sequence[str], known: Sequence[bool]
) -> list[str]:
    notes = []
    if scatter.degrees <= 0.0:
        notes.append(
            f"no standard errors: {scatter.residuals} residuals for {scatter.parameters} parameters say nothing "
            "about the noise; give sigma, or record more data"
        )
    if active.texts:
        held = ", ".join(f"'{text}'" for text in active.texts)
        notes.append(f"standard errors apply along the active constraint on {held}")
    for cluster in {id(scatter.robust[k]): scatter.robust[k] for k in sorted(scatter.plain)}.values():
        names_shown = ", ".join(names[k] for k in sorted(scatter.plain) if scatter.robust[k] is cluster)
        notes.append(
            f"{names_shown}: robust standard errors, from the scatter between {cluster.clusters} {cluster.of}, "
            "which is larger than their residuals explain"
        )
    few = [names[k] for k in scatter.few if known[k]]
    if few and any(map(_missed, scatter.whiteness)):
        count = "1 run does" if scatter.runs == 1 else f"{scatter.runs} runs do"
        notes.append(
            f"the residuals are more than white noise, and {count} not show how much estimates differ between "
            f"runs: intervals may be too narrow: {', '.join(few)}"
        )
    if fixed:
        notes.append(f"no standard error, because the active constraints alone determine: {', '.join(fixed)}")
    return notes


def _of_few_runs(problem: Problem, j: FloatArray, robust: Sequence[str]) -> dict[str, int]:
    """Return the number of runs that determine a parameter, where it is small.

    Parameters that belong to a run by definition do not count, nor do those with errors from the scatter of runs.
    """
    counts = np.sum(information_of_runs(problem, j) > _COUNTS, axis=0)
    ids = {case.id for case in problem.cases}
    return {
        name: count
        for name, count in zip(problem.space.names, counts.tolist(), strict=True)
        if count <= _FEW_RUNS and name.partition(SEPARATOR)[2] not in ids and name not in robust
    }


def _biases(problem: Problem, bias: FloatArray, biased: Sequence[int]) -> list[str]:
    """Report the (n,) bias, in model space, that the noise of recorded inputs causes."""
    if not biased:
        return []
    names = problem.space.names
    inputs = [f"{name} ({sigma:.2g})" for name, sigma in noisy_inputs(problem).items()]
    moves = [f"{names[k]} by about {bias[k]:+.2g}" for k in biased]
    return [
        f"noise of the recorded input{'s' * (len(inputs) > 1)} {', '.join(inputs)} biases {', '.join(moves)}; the "
        f"interval{'s include' if len(moves) > 1 else ' includes'} this. Record the input with less noise, or "
        "drive the model with the commanded signal"
    ]


def _missed(whiteness: Whiteness) -> bool:
    """Return whether a model does not follow a signal of a run."""
    return whiteness.p_value < _MISSED or whiteness.variance > _LARGE


def _exploding(
    problem: Problem, scaled: FloatArray, whiteness: Sequence[Whiteness], floor: NoiseFloor
) -> list[str]:
    """Advise segments where sensitivities, (m, n), grow without bound over runs that the model does not follow."""
    missed = {w.case for w in whiteness if _missed(w)}
    growth: dict[str, float] = {}
    for (case, criterion), place in zip(problem.criteria, problem.slices, strict=True):
        if criterion.rows is None or case.id not in missed or not (early := len(criterion.rows) // 5):
            continue
        size = np.linalg.norm(scaled[place], axis=1)
        early_size = float(np.sqrt(np.mean(size[early : 2 * early] ** 2)))
        late_size = float(np.sqrt(np.mean(size[-early:] ** 2)))
        growth[case.id] = max(late_size / max(early_size, np.finfo(float).tiny), growth.get(case.id, 0.0))
    if growth and floor.relative > _CHAOTIC:
        return [
            "predictions scatter under tiny changes of the parameters, as in chaos, and the model does not follow "
            'the runs: try segments = "auto"'
        ]
    if not growth or max(growth.values()) < _EXPLODED:
        return []
    worst = max(growth, key=growth.__getitem__)
    return [
        f"sensitivities grow by a factor of {growth[worst]:.2g} over '{worst}', which the model does not follow: "
        'try segments = "auto"'
    ]


def _limited(degrees: float) -> float | None:
    return None if math.isinf(degrees) else float(degrees)


def _widened(
    problem: Problem, evaluate: EvaluateMany, best: Evaluation, j: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return the covariance, widened where parameters compensate each other better than it predicts.

    Nearly collinear columns of a Jacobian differ by its own errors (kinks, noise), which look like information. So
    in the weakest directions the leading parameter is moved by two standard errors, and the others follow by
    Gauss-Newton steps. If the cost grows by less than a quarter of the expected amount, the parameter is moved
    further until it does, and that distance is its spread.
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
                moved = _followed(problem, evaluate, best, j=j, x=best.x + offset, i=i)
                if moved is None or moved.cost - best.cost >= 0.25 * expected:
                    break
                offset = 2.0 * (moved.x - best.x)
                reach *= 2.0
                if reach > factor:
                    factor, way = reach, (moved.x - best.x) / reach
        covariance = covariance + (factor**2 - 1.0) * np.outer(way, way)
    return covariance


def _followed(
    problem: Problem, evaluate: EvaluateMany, best: Evaluation, *, j: FloatArray, x: FloatArray, i: int
) -> Evaluation | None:
    """Return the evaluation at `x` after all parameters except `i` were refitted, or None if that fails."""
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


def _matrix(values: FloatArray) -> Matrix:
    return tuple(tuple(float(v) for v in row) for row in values)


def without_intervals(estimate: Uncertainty, names: Sequence[str]) -> Uncertainty:
    """Return `estimate` without standard errors for `names`, for example for parameters at a bound."""
    hide = partial(_hidden, estimate.names, names)
    return replace(estimate, standard_errors=hide(estimate.standard_errors), intervals=hide(estimate.intervals))


def with_held(estimate: Uncertainty, held: Held) -> Uncertainty:
    """Return `estimate` with the fixed parameters added, to draw both together."""
    space, n = held.problem.space, len(estimate.names)
    point = held.point(np.array(estimate.point))
    slope = space.slope(point)
    moves = np.array(estimate.held_slopes) * slope[n:] / slope[:n, None]
    root = np.vstack([moves @ held.rows, held.rows])
    covariance = root @ root.T
    covariance[:n, :n] = estimate.covariance
    return replace(estimate, names=space.names, point=tuple(map(float, point)), covariance=_matrix(covariance))


_T = TypeVar("_T")


def _hidden(names: tuple[str, ...], hidden: Sequence[str], values: tuple[_T | None, ...]) -> tuple[_T | None, ...]:
    return tuple(None if n in hidden else v for n, v in zip(names, values, strict=True))
