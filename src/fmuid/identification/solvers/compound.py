"""Composite solvers: chains, multistart, and lexicographic order."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers.parallel_searches import ParallelSearches
from fmuid.identification.solvers.search import Link, Outcome, Search, Solver, Start, Status, StopSearch


class Compound:
    """A solver that is made of others."""

    __slots__ = ()
    solver: Solver

    @property
    def parts(self) -> tuple[Solver, ...]:
        """The solvers that it is made of: by default, `solver`."""
        return (self.solver,)

    @property
    def needs_residuals(self) -> bool:
        """Whether any part needs residuals."""
        return any(part.needs_residuals for part in self.parts)

    def check(self, problem: Problem) -> None:
        """See `Solver.check`."""
        for part in self.parts:
            part.check(problem)


@dataclass(frozen=True, slots=True)
class Chain(Compound):
    """Several solvers in sequence, each from the best point so far: global, then local.

    Each gets an equal share of the remaining budget; the last one gets all of it.
    """

    links: tuple[Solver, ...]

    @property
    def name(self) -> str:
        """The links' names, in order."""
        return " > ".join(link.name for link in self.links)

    @property
    def parts(self) -> tuple[Solver, ...]:
        """The links."""
        return self.links

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        outcome = Outcome(Status.FAILED, "no solver in the chain")
        for k, link in enumerate(self.links):
            left, before = len(self.links) - k, search.evaluations
            try:
                with search.share(left):
                    outcome = link.solve(search, start)
            except StopSearch as stopped:
                if left == 1 or stopped.outcome.status is not Status.BUDGET:
                    raise
                outcome = stopped.outcome
            if search.reached is None:
                break
            search.links.append(Link(link.name, search.cost_of(search.reached), search.evaluations - before))
            start = search.reached.x
        return outcome


@dataclass(frozen=True, slots=True)
class MultiStart(Compound):
    """The same solver from several starts: the given start, and a scrambled Sobol sequence within the bounds.

    The starts depend on the seed only, and the searches run in parallel (`parallel_searches`). The outcome of each
    start is kept for the waterfall plot.
    """

    solver: Solver
    starts: int

    @property
    def name(self) -> str:
        """Number of starts and the solver's name."""
        return f"{self.starts} x {self.solver.name}"

    def check(self, problem: Problem) -> None:
        """See `Solver.check`."""
        Compound.check(self, problem)
        if not problem.space.bounded:
            raise ProblemError(
                "several starts need both bounds of every free parameter",
                fix=f"give lower and upper of {', '.join(problem.space.unbounded)}",
            )

    def points(self, search: Search, start: FloatArray) -> list[FloatArray]:
        """Return the start points."""
        from scipy.stats import qmc

        sobol = qmc.Sobol(len(search), rng=np.random.default_rng(search.seed))
        # Sobol sequences are balanced only at powers of two, so one is drawn and its beginning used.
        unit = sobol.random_base2(max(1, int(np.ceil(np.log2(max(self.starts - 1, 1))))))
        width = search.upper - search.lower
        return [start, *(search.lower + u * width for u in unit[: self.starts - 1])]

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        points = self.points(search, start)
        abreast = ParallelSearches(search, [partial(self.solver.solve, start=point) for point in points])
        try:
            abreast.run()
        finally:
            for point, (branch, outcome) in zip(points, abreast.ended, strict=True):
                if (end := branch.best) is not None:
                    started, ended = (tuple(map(float, x)) for x in (point, end.x))
                    cost, count = search.cost_of(end), branch.evaluations
                    search.starts.append(Start(started, ended, cost, outcome.status, count))
        for branch, outcome in abreast.ended:
            if search.best is not None and branch.best is search.best:
                search.noise_floor = branch.noise_floor
                return outcome
        return Outcome(Status.FAILED, "none of the starts could be simulated")


@dataclass(frozen=True, slots=True)
class Lexicographic(Compound):
    """Minimises criteria by priority; the earlier ones keep their demands, or their best values if larger."""

    solver: Solver
    slack: float = field(default=1e-3)  # relative: without it, later levels could not move

    @property
    def name(self) -> str:
        """The inner solver's name."""
        return f"lexicographic {self.solver.name}"

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        priorities = np.array([criterion.priority for _, criterion in search.problem.criteria])
        outcome = Outcome(Status.FAILED, "no criteria")
        held: list[tuple[int, float]] = []
        for level in sorted(set(priorities.tolist())):
            mine = np.flatnonzero(priorities == level)
            limits = tuple(held)

            def cost(evaluation: Evaluation, mine: NDArray[np.intp] = mine) -> float:
                weights = search.problem.root_weights[mine] ** 2
                return float(np.sum(weights * evaluation.criteria[mine] ** 2))

            def excess(evaluation: Evaluation, limits: tuple[tuple[int, float], ...] = limits) -> FloatArray:
                return np.array([evaluation.criteria[i] - limit for i, limit in limits])

            search.refocus(cost, excess)
            outcome = self.solver.solve(search, start)
            if search.best is None:
                break
            start = search.best.x
            # A criterion that is satisfied (at most 1) may grow up to its demand.
            best = search.best.criteria
            held += [(int(i), max(1.0, float(best[i]) * (1.0 + self.slack))) for i in mine]
        return outcome
