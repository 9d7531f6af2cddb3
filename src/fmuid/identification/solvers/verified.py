"""Checks that a search ended at a minimum: another solver must not improve the cost from there."""

from __future__ import annotations

import enum
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import Differences, noise_floor
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers.compound import Compound
from fmuid.identification.solvers.least_squares import NOTHING_MOVES, TrustRegion, meaningless
from fmuid.identification.solvers.nlopt_solver import NloptSolver
from fmuid.identification.solvers.search import Outcome, Search, Solver, Status, StopSearch, in_short

_ROUNDS = 8
_GAIN = 1e-3  # improvement in shares of the residual variance that another solver must not find
_SMALL = 1e-4  # the same, of a cost that is not a sum of squares, relative to it
_RESOLVED = 1e-6  # relative error of the predictions below which a fit without noise is perfect
_HALVINGS = 6
_PROBING = 40  # evaluations per parameter of a direct search that checks another one


@dataclass(frozen=True, slots=True)
class Verified(Compound):
    """A solver whose end point is checked; the search continues where another method improves the cost.

    A smooth sum of squares is checked by a Gauss-Newton step; along a wall of failing candidates and for other
    costs, a direct search from the end point is the check. The search has converged only if the check improves
    nothing. At a wall that the cost still falls towards, it has not.

    Parameters
    ----------
    solver
        The solver.
    again
        The solver that continues from an improved point: the same one, without further starts; of a global solver,
        a local one.
    polished
        Whether the latter also polishes what the former reached within its default number of evaluations, or half
        the budget.
    """

    solver: Solver
    again: Solver
    polished: bool

    @property
    def name(self) -> str:
        """The solver's name."""
        return self.solver.name

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        try:
            with search.share(2 if self.polished else 1):
                outcome = _outcome_of(self.solver, search, start)
        except StopSearch as stopped:
            if not self.polished or stopped.outcome.status is not Status.BUDGET:
                raise
            outcome = stopped.outcome
        if outcome.status is Status.BUDGET and self.polished and search.reached is not None:
            ended = _outcome_of(self.again, search, search.reached.x)
            return Outcome(Status.BUDGET, f"{outcome.message}, then {self.again.name}: {ended.message}")
        for _ in range(_ROUNDS):
            if outcome.status not in (Status.CONVERGED, Status.STALLED) or search.reached is None:
                return outcome
            with search.with_residuals():
                verdict = _verdict(search, self.again)
                if verdict is not _Verdict.IMPROVED:
                    return _judged(search, outcome, verdict)
                again = TrustRegion() if search.plain and search.problem.smooth else self.again
                outcome = _outcome_of(again, search, search.reached.x)
                if again.name != self.again.name:
                    outcome = replace(outcome, message=f"{outcome.message}, continued by {again.name}")
        return Outcome(Status.STALLED, "other solvers still improve the cost")


def _outcome_of(solver: Solver, search: Search, start: FloatArray) -> Outcome:
    """Return how a solver ended; where its first steps from a valid point fail, it is stalled."""
    try:
        return solver.solve(search, start)
    except SimulationError as error:
        if search.reached is None:
            raise
        return Outcome(Status.STALLED, error.what)


class _Verdict(enum.Enum):
    """Result of a check: another method improved the cost, or the end point is a minimum, a wall or a plateau."""

    IMPROVED = enum.auto()
    MINIMUM = enum.auto()
    FALLING = enum.auto()  # the cost falls to first order, but candidates there fail
    FLAT = enum.auto()
    DEAD = enum.auto()  # no parameter changes anything


def _verdict(search: Search, solver: Solver) -> _Verdict:
    """Let other methods continue from the best point."""
    best = search.reached
    assert best is not None
    failures, verdict = search.failures, _Verdict.MINIMUM
    if search.plain and search.problem.smooth:
        with suppress(SimulationError):
            verdict = _by_gauss_newton(search, best)
            if verdict in (_Verdict.IMPROVED, _Verdict.MINIMUM, _Verdict.DEAD):
                return verdict
    for probe in _probes(search, solver, 1.0 if verdict is _Verdict.FLAT else None):
        with suppress(SimulationError):
            probe.solve(search, best.x)
        assert search.reached is not None
        if _gain(search, best, search.reached) > 0.0:
            return _Verdict.IMPROVED
    if search.failures > failures:
        return _Verdict.FALLING
    return verdict if verdict is _Verdict.FLAT else _Verdict.MINIMUM


def _by_gauss_newton(search: Search, best: Evaluation) -> _Verdict:
    """Try the Gauss-Newton step within the bounds."""
    problem = search.problem
    here = search.complete(best)
    derivative = partial(search.evaluate_many, purpose="derivative")
    floor = search.noise_floor or noise_floor(problem, here.x, evaluate=derivative)
    perfect = (_RESOLVED * floor.size) ** 2 * len(here.residuals)
    negligible = max(_GAIN * here.cost / len(here.residuals), meaningless(here, floor), perfect)
    if here.cost <= perfect:
        return _Verdict.MINIMUM
    failures = search.failures
    for central in (False, True):
        differences = Differences(problem, floor, central=central)
        jacobian = differences.jacobian(derivative, here)
        if _on_plateau(search, here, jacobian):
            return _Verdict.FLAT
        if not jacobian.any():
            return _Verdict.DEAD
        step, predicted = _bounded_step(search, here, jacobian, differences.column_scale(jacobian))
        if predicted <= negligible:
            return _Verdict.MINIMUM
        for k in range(_HALVINGS):
            trial = search.evaluate(here.x + step / 2.0**k)
            if trial.ok and here.cost - trial.cost > 0.1 * predicted / 2.0**k:
                return _Verdict.IMPROVED
        if search.failures > failures:
            break
    return _Verdict.FALLING


def _bounded_step(
    search: Search, here: Evaluation, jacobian: FloatArray, scale: FloatArray
) -> tuple[FloatArray, float]:
    """Return the (n,) Gauss-Newton step within the bounds, and by how much it should reduce the cost."""
    from scipy.optimize import lsq_linear

    low, high = (search.lower - here.x) * scale, (search.upper - here.x) * scale
    step = lsq_linear(jacobian / scale, -here.residuals, (low - 1e-12, high + 1e-12)).x / scale
    return step, here.cost - float(np.sum((here.residuals + jacobian @ step) ** 2))


def _on_plateau(search: Search, here: Evaluation, jacobian: FloatArray) -> bool:
    """Return whether a parameter changes the predictions, but not by small steps."""
    points = [
        here.x + sign * direction
        for direction, column in zip(np.eye(len(search)), jacobian.T, strict=True)
        for sign in (1.0, -1.0)
        if not column.any()
    ]
    far = search.evaluate_many(points) if points else []
    return any(e.ok and not np.array_equal(e.residuals, here.residuals) for e in far)


def _probes(search: Search, solver: Solver, step: float | None) -> list[NloptSolver]:
    """Return the solvers that check the end point of `solver`, with another first step if given."""
    limit: dict[str, float] = {"evaluations": _PROBING * (len(search) + 1)}
    limit |= {} if step is None else {"initial_step": step}
    if search.problem.constraints or search.goals_of is not None or not search.plain:
        return [NloptSolver(name, limit) for name in ("cobyla", "slsqp") if name != solver.name]
    return [NloptSolver("nelder_mead" if solver.name == "sbplx" else "sbplx", limit)]


def _gain(search: Search, before: Evaluation, after: Evaluation) -> float:
    """Return the improvement of the cost beyond what a search may leave, 0 if there is none."""
    if search.feasible(before) != search.feasible(after):
        return float(search.feasible(after))
    cost, new = search.cost_of(before), search.cost_of(after)
    return max(cost - new - _SMALL * abs(cost), 0.0)


def _judged(search: Search, outcome: Outcome, verdict: _Verdict) -> Outcome:
    """Return how a checked search ended."""
    assert search.reached is not None
    if verdict is _Verdict.FLAT:
        return Outcome(Status.STALLED, "on a plateau: small changes of a parameter change no prediction")
    if verdict is _Verdict.DEAD:
        return Outcome(Status.STALLED, NOTHING_MOVES)
    beyond = search.failure_near(search.reached.x) if verdict is _Verdict.FALLING else None
    search.at_edge = beyond is not None
    if beyond is not None:
        return Outcome(Status.STALLED, f"at the edge of what can be simulated; beyond it: {in_short(beyond)}")
    return Outcome(Status.CONVERGED, outcome.message)
