"""Checks that a search ended at a minimum: another solver must not improve the cost from there."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import Differences, noise_floor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers.least_squares import meaningless
from fmuid.identification.solvers.nlopt_solver import NloptSolver
from fmuid.identification.solvers.search import Outcome, Search, Solver, Status, in_short

_ROUNDS = 8
_GAIN = 1e-3  # relative improvement of a cost without statistics that another solver must not find
_RESOLVED = 1e-6  # relative error of the predictions below which a fit without noise is perfect
_HALVINGS = 6
_PROBING = 40  # evaluations per parameter of a direct search that checks another one
_EDGE = 1e-3  # distance in search units within which a failed candidate marks an edge


@dataclass(frozen=True, slots=True)
class Verified:
    """A solver whose end point is checked; the search continues where another method improves the cost.

    A smooth sum of squares is checked by a Gauss-Newton step; along a wall of failing candidates and for other
    costs, a direct search from the end point is the check. The search has converged only if the check improves
    nothing. At a wall that the cost still falls towards, it has not.

    Parameters
    ----------
    solver
        The solver.
    again
        The solver that continues from an improved point, without further starts.
    """

    solver: Solver
    again: Solver

    @property
    def name(self) -> str:
        """The solver's name."""
        return self.solver.name

    @property
    def needs_residuals(self) -> bool:
        """Whether the solver needs residuals."""
        return self.solver.needs_residuals

    def check(self, problem: Problem) -> None:
        """See `Solver.check`."""
        self.solver.check(problem)

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        outcome = _outcome_of(self.solver, search, start)
        for _ in range(_ROUNDS):
            if outcome.status not in (Status.CONVERGED, Status.STALLED) or search.reached is None:
                return outcome
            with search.with_residuals():
                improved, falling = _improved(search, self.again)
            if not improved:
                return _judged(search, outcome, falling)
            outcome = _outcome_of(self.again, search, search.reached.x)
        return Outcome(Status.STALLED, "other solvers still improve the cost")


def _outcome_of(solver: Solver, search: Search, start: FloatArray) -> Outcome:
    """Return how a solver ended; where its first steps from a valid point fail, it is stalled."""
    try:
        return solver.solve(search, start)
    except SimulationError as error:
        if search.reached is None:
            raise
        return Outcome(Status.STALLED, error.what)


def _improved(search: Search, solver: Solver) -> tuple[bool, bool]:
    """Let other methods continue from the best point; return whether they improved it, and whether it could be.

    The latter is True if the cost falls to first order in a direction in which nothing can be simulated.
    """
    best = search.reached
    assert best is not None
    failures = search.failures
    falling = False
    if search.plain and search.problem.smooth:
        with suppress(SimulationError):
            for central in (False, True):
                gained, falling = _by_gauss_newton(search, best, central=central)
                if gained or not falling:
                    return gained, falling
                if search.failures > failures:
                    break
    for probe in _probes(search, solver):
        with suppress(SimulationError):
            probe.solve(search, best.x)
        assert search.reached is not None
        if _gain(search, best, search.reached) > 0.0:
            return True, falling
    return False, falling or search.failures > failures


def _by_gauss_newton(search: Search, best: Evaluation, *, central: bool) -> tuple[bool, bool]:
    """Try the Gauss-Newton step within the bounds; return whether it improves the cost, and whether it should."""
    from scipy.optimize import lsq_linear

    problem = search.problem
    here = search.complete(best)
    derivative = partial(search.evaluate_many, purpose="derivative")
    floor = search.noise_floor or noise_floor(problem, here.x, evaluate=derivative)
    differences = Differences(problem, floor, central=central)
    jacobian = differences.jacobian(derivative, here)
    scale = differences.column_scale(jacobian)
    low, high = (search.lower - here.x) * scale, (search.upper - here.x) * scale
    step = lsq_linear(jacobian / scale, -here.residuals, (low - 1e-12, high + 1e-12)).x / scale
    predicted = here.cost - float(np.sum((here.residuals + jacobian @ step) ** 2))
    perfect = (_RESOLVED * floor.size) ** 2 * len(here.residuals)
    if predicted <= max(_GAIN * here.cost / len(here.residuals), meaningless(here, floor), perfect):
        return False, False
    for k in range(_HALVINGS):
        trial = search.evaluate(here.x + step / 2.0**k)
        if trial.ok and here.cost - trial.cost > 0.1 * predicted / 2.0**k:
            return True, True
    return False, True


def _probes(search: Search, solver: Solver) -> list[NloptSolver]:
    """Return the solvers that check the end point of `solver`."""
    limit = {"evaluations": _PROBING * (len(search) + 1)}
    if search.problem.constraints or search.goals_of is not None or not search.plain:
        names = ["cobyla", "slsqp"]
    else:
        names = ["sbplx", "nelder_mead"]
    return [NloptSolver(name, limit) for name in names if name != solver.name][:1]


def _gain(search: Search, before: Evaluation, after: Evaluation) -> float:
    """Return the improvement of the cost beyond what a search may leave, 0 if there is none."""
    if search.feasible(before) != search.feasible(after):
        return float(search.feasible(after))
    cost, new = search.cost_of(before), search.cost_of(after)
    return max(cost - new - _GAIN * abs(cost), 0.0)


def _judged(search: Search, outcome: Outcome, falling: bool) -> Outcome:
    """Return how a checked search ended."""
    assert search.reached is not None
    beyond = search.failure_near(search.reached.x, _EDGE) if falling else None
    search.at_edge = beyond is not None
    if beyond is not None:
        return Outcome(Status.STALLED, f"at the edge of what can be simulated; beyond it: {in_short(beyond)}")
    return Outcome(Status.CONVERGED, outcome.message)
