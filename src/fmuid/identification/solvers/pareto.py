"""Trade-offs: points of the Pareto front, where no objective can improve unless another gets worse."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from fmuid.core.campaign import ParetoSpec
from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.combination import matching
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers.search import Goals, Search, Solver, StopSearch

_EQUAL = 1e-6  # share of an objective's range over the front: closer points are the same
_GIVES = 1e-3  # share of its range by which the end of a front may be worse, so that the other objectives count
_SMALLEST_WEIGHT = 0.02
_GENERATIONS = 12  # of the exploration before the searches along rays
_SHARE = 8  # of a budget that is left for the searches along rays
_CROSSING = 0.7  # share of the coordinates that a child takes from others


@dataclass(frozen=True, slots=True)
class FrontPoint:
    """One trade-off: the objectives' values (divided by their demands), and the free parameters in model space."""

    values: tuple[float, ...]
    parameters: dict[str, float]


@dataclass(frozen=True, slots=True)
class Front:
    """The trade-offs found, sorted by the first objective; none is worse than another in every objective.

    `chosen` are the objectives' values at the stage's estimate. `message` says how the search ended.
    """

    objectives: tuple[str, ...]
    points: tuple[FrontPoint, ...]
    chosen: tuple[float, ...]
    evaluations: int
    message: str

    @property
    def beats_chosen(self) -> bool:
        """Whether a point is better than the stage's estimate by more than 1 % and worse in no objective."""
        return any(
            all(v <= c * (1.0 + _EQUAL) for v, c in zip(p.values, self.chosen, strict=True))
            and any(v < 0.99 * c for v, c in zip(p.values, self.chosen, strict=True))
            for p in self.points
        )

    def __str__(self) -> str:
        """Return the front as a table."""
        names = list(self.points[0].parameters) if self.points else []
        rows = [[*self.objectives, *names]]
        rows += [[f"{v:.5g}" for v in (*p.values, *p.parameters.values())] for p in self.points]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)
        return "\n".join([f"Pareto front: {self.message}", *lines])


@dataclass(frozen=True, slots=True, eq=False)
class Objectives:
    """The objectives of a problem: each is the weighted root mean square of its criteria."""

    names: tuple[str, ...]
    rows: tuple[NDArray[np.intp], ...]
    weights: FloatArray

    @classmethod
    def of(cls, problem: Problem, names: Sequence[str]) -> Objectives:
        """Return the objectives for `names` (labels of criteria or globs); one for each label if empty.

        Raises
        ------
        ProblemError
            There are fewer than two objectives, or one matches no criterion.
        """
        names = tuple(names or dict.fromkeys(criterion.label for _, criterion in problem.criteria))
        rows = [np.array(matching(problem.labels, name), dtype=np.intp) for name in names]
        for name, of_objective in zip(names, rows, strict=True):
            if not len(of_objective):
                raise ProblemError(
                    f"no criterion matches the objective '{name}'",
                    where=f"stage '{problem.name}'",
                    fix=f"there are: {', '.join(problem.labels)}",
                )
        if len(names) < 2:
            raise ProblemError(
                "a Pareto front needs at least two objectives",
                where=f"stage '{problem.name}'",
                fix="add a criterion",
            )
        return cls(names, tuple(rows), problem.root_weights**2)

    def __call__(self, evaluation: Evaluation) -> FloatArray:
        """Return the (k,) values of the objectives."""
        squares = self.weights * evaluation.criteria**2
        totals = [
            (np.sum(squares[of_objective]), np.sum(self.weights[of_objective])) for of_objective in self.rows
        ]
        return np.array([np.sqrt(total / max(weight, np.finfo(float).tiny)) for total, weight in totals])


def trace(search: Search, spec: ParetoSpec, solver: Solver, best: Evaluation) -> Front:
    """Find points of the Pareto front.

    Each objective alone gives an end of the front. Between the ends lie rays, spread evenly as by Das and Dennis
    (1998), from the ideal point (the best of every objective) into the front. Along each ray the largest of the
    scaled distances from the ideal is minimised (Wierzbicki, 1980), which reaches concave parts as well.

    Parameters
    ----------
    search
        A separate search, because the best point of an objective is not the stage's estimate.
    solver
        Solver for the minimum along a ray, from the nearest known point.
    best
        The stage's estimate, where the search begins.
    """
    objectives = Objectives.of(search.problem, spec.objectives)
    traced: list[Evaluation] = []
    message = "complete"
    try:
        _trace(search, solver, objectives=objectives, points=spec.points, best=best, front=traced)
    except StopSearch as stop:
        message = f"incomplete ({stop.outcome.message})"
    names = search.problem.space.names
    points = tuple(
        FrontPoint(tuple(map(float, objectives(e))), {n: float(e.parameters[n]) for n in names})
        for e in _undominated(traced, objectives)
    )
    message = f"{message}, {len(points)} points in {search.evaluations} evaluations"
    return Front(objectives.names, points, tuple(map(float, objectives(best))), search.evaluations, message)


def _trace(
    search: Search,
    solver: Solver,
    *,
    objectives: Objectives,
    points: int,
    best: Evaluation,
    front: list[Evaluation],
) -> None:
    """Add points to `front`, so that those traced within the budget remain available."""
    known = [best, *_explored(search, objectives, points)]

    def solve(start: Evaluation, goals: Goals, limits: Goals | None = None) -> Evaluation:
        search.aim(goals, limits)
        # Behind every piece of a front there may be local ones, so the search begins at the best point known.
        candidates = [start, *known, *front]
        allowed = [e for e in candidates if limits is None or np.all(limits(e) <= 0.0)] or [start]
        first = min(allowed, key=lambda e: float(np.max(goals(e))))
        search.evaluate(first.x)
        with suppress(SimulationError):
            solver.solve(search, first.x)
        return search.reached or first

    k = len(objectives.names)
    alone = [solve(best, lambda e, i=i: objectives(e)[[i]]) for i in range(k)]  # type: ignore[misc]
    values = np.array([objectives(e) for e in alone])
    ideal = np.min(values, axis=0)
    reach = np.maximum(np.ptp(values, axis=0), _EQUAL * np.max(np.abs(values), axis=0) + np.finfo(float).tiny)

    def distances(e: Evaluation) -> FloatArray:
        return np.asarray((objectives(e) - ideal) / reach)

    for i, end in enumerate(alone):  # at an end, the other objectives may be anywhere at no cost
        others = np.arange(k) != i
        front.append(
            solve(
                end,
                lambda e, others=others: distances(e)[others],  # type: ignore[misc]
                lambda e, i=i: distances(e)[[i]] - _GIVES,  # type: ignore[misc]
            )
        )
    rays = list(np.eye(k))
    for ray in _between(k, points):
        near = front[int(np.argmin([np.linalg.norm(ray - other) for other in rays]))]
        weights = np.maximum(ray, _SMALLEST_WEIGHT)
        front.append(solve(near, lambda e, weights=weights: distances(e) / weights))  # type: ignore[misc]
        rays.append(ray)

    if k == 2:
        _fill(front, objectives, points, distances, solve)


def _fill(
    solved: list[Evaluation],
    objectives: Objectives,
    points: int,
    distances: Goals,
    solve: Callable[[Evaluation, Goals, Goals], Evaluation],
) -> None:
    """Add points in the widest gaps of a front of two objectives, where rays end at equal or dominated points."""
    tried: set[tuple[float, float]] = set()
    for _ in range(points):
        front = _undominated(solved, objectives)
        if len(front) >= points:
            return
        places = [float(distances(e)[0]) for e in front]
        gaps = [(b - a, k) for k, (a, b) in enumerate(pairwise(places)) if (a, b) not in tried]
        if not gaps:
            return
        _, k = max(gaps)
        tried.add((places[k], places[k + 1]))
        middle = 0.5 * (places[k] + places[k + 1])
        solved.append(
            solve(front[k], lambda e: distances(e)[[1]], lambda e, m=middle: distances(e)[[0]] - m)  # type: ignore[misc]
        )


def _explored(search: Search, objectives: Objectives, points: int) -> list[Evaluation]:
    """Return points of a differential evolution towards the front, from which the searches along rays begin.

    Children dominate their parents, or replace them where neither dominates and the parent is in a denser place
    (as in GDE3; Kukkonen and Lampinen, 2005). Without bounds there is no space to explore.
    """
    from scipy.stats import qmc

    if not search.problem.space.bounded:
        return []
    random = np.random.default_rng(search.seed)
    width, count = search.upper - search.lower, 2 * points
    unit = qmc.Sobol(len(search), rng=random).random_base2(int(np.ceil(np.log2(count))))
    search.aim(objectives)
    people = [e for e in search.evaluate_many([search.lower + u * width for u in unit]) if _admitted(search, e)]
    limit = search.stop.evaluations
    for _ in range(_GENERATIONS if limit is None else min(_GENERATIONS, limit // (_SHARE * len(unit)) - 1)):
        if len(people) < 4:
            return people
        children = []
        for one in people:
            a, b, c = (people[k].x for k in random.choice(len(people), 3, replace=False))
            crossed = random.random(len(search)) < _CROSSING
            crossed[random.integers(len(search))] = True
            children.append(np.clip(np.where(crossed, a + 0.5 * (b - c), one.x), search.lower, search.upper))
        people = [*people, *(e for e in search.evaluate_many(children) if _admitted(search, e))]
        people = _fittest(people, objectives, count)
    return people


def _admitted(search: Search, evaluation: Evaluation) -> bool:
    return evaluation.ok and search.feasible(evaluation)


def _fittest(people: Sequence[Evaluation], objectives: Objectives, count: int) -> list[Evaluation]:
    """Return the best `count`: by the number of points that dominate each, then those with far neighbours."""
    values = np.array([objectives(e) for e in people])
    scaled = values / np.maximum(np.ptp(values, axis=0), np.finfo(float).tiny)
    beaten = np.array([np.sum(np.all(scaled <= v, axis=1) & np.any(scaled < v, axis=1)) for v in scaled])
    away = np.linalg.norm(scaled[:, None] - scaled[None], axis=2) + np.diag(np.full(len(scaled), np.inf))
    order = np.lexsort([-np.min(away, axis=1), beaten])
    return [people[k] for k in order[:count]]


def _between(k: int, points: int) -> list[FloatArray]:
    """Return the (k,) directions of a simplex lattice with `points` on each edge, without its corners."""
    parts = points - 1
    lattice = []
    for bars in combinations(range(parts + k - 1), k - 1):
        counts = np.diff([-1, *bars, parts + k - 1]) - 1
        if np.max(counts) < parts:
            lattice.append(counts / parts)
    return lattice


def _undominated(evaluations: Sequence[Evaluation], objectives: Objectives) -> list[Evaluation]:
    """Return the points that no other dominates, without duplicates, sorted by the first objective."""
    values = np.array([objectives(e) for e in evaluations]).reshape(len(evaluations), len(objectives.names))
    scaled = values / np.maximum(np.ptp(values, axis=0), np.finfo(float).tiny) if len(evaluations) else values
    kept: list[int] = []
    for i in np.lexsort(values.T[::-1]).tolist():
        nowhere_worse = np.all(scaled <= scaled[i] + _EQUAL, axis=1)
        better = nowhere_worse & np.any(scaled < scaled[i] - _EQUAL, axis=1)
        same = any(np.all(np.abs(scaled[i] - scaled[j]) <= _EQUAL) for j in kept)
        if not same and not np.any(better):
            kept.append(i)
    return [evaluations[i] for i in kept]
