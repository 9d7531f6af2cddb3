"""NLopt's solvers with the common signature; only this module imports nlopt."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray, frozen_mapping
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers.box import CandidateFailedError, around_failures
from fmuid.identification.solvers.search import FEASIBLE, Outcome, Search, Status, StopRules, number_of


@dataclass(frozen=True, slots=True)
class _Algorithm:
    nlopt: str
    finite_bounds: bool = False
    constraints: bool = False
    gradient: bool = False
    model: bool = False  # fits a model to the costs, which a failed candidate would spoil
    subsidiary: bool = False


ALGORITHMS: Mapping[str, _Algorithm] = {
    "nelder_mead": _Algorithm("LN_NELDERMEAD"),
    "sbplx": _Algorithm("LN_SBPLX"),
    "cobyla": _Algorithm("LN_COBYLA", constraints=True, model=True),
    "bobyqa": _Algorithm("LN_BOBYQA", model=True),
    "newuoa_bound": _Algorithm("LN_NEWUOA_BOUND", model=True),
    "praxis": _Algorithm("LN_PRAXIS", model=True),
    "crs2": _Algorithm("GN_CRS2_LM", finite_bounds=True),
    "isres": _Algorithm("GN_ISRES", finite_bounds=True, constraints=True),
    # The original DIRECT codes handle hidden constraints, that is candidates that fail.
    "direct": _Algorithm("GN_ORIG_DIRECT", finite_bounds=True),
    "direct_l": _Algorithm("GN_ORIG_DIRECT_L", finite_bounds=True),
    "esch": _Algorithm("GN_ESCH", finite_bounds=True),
    "mlsl": _Algorithm("G_MLSL_LDS", finite_bounds=True, subsidiary=True),
    "ags": _Algorithm("GN_AGS", finite_bounds=True, model=True),
    "lbfgs": _Algorithm("LD_LBFGS", gradient=True, model=True),
    "slsqp": _Algorithm("LD_SLSQP", constraints=True, gradient=True, model=True),
}
_ALIASES = {"neldermead": "nelder_mead", "newuoa": "newuoa_bound", "direct-l": "direct_l", "sqp": "slsqp"}
_LOCAL = tuple(name for name, a in ALGORITHMS.items() if not (a.finite_bounds or a.gradient))  # for MLSL
_OPTIONS: Mapping[str, float] = {  # defaults or typical values; `local` is a name
    "initial_step": 0.1,
    "tolerance": 1e-7,
    "cost_tolerance": 1e-12,
    "population": 50,
    "local": 0,
    "evaluations": 1000,
}
_LOWEST_LEVEL = 1e-6  # lower bound of the largest goal, which determines its step
_GLOBAL_EVALUATIONS = 200  # per parameter, for global solvers without any stop rule, which never converge
_RESTARTS, _SHORTER, _GAIN = 4, 0.3, 1e-3  # restarts of COBYLA: number, factor on the step, least gain
_IDLE = 300  # consecutive requests for known points
_PENALTY_EVALUATIONS = 500  # per parameter: an augmented Lagrangian does not end if constraints cannot be met


@dataclass(frozen=True, slots=True)
class NloptSolver:
    """One of NLopt's algorithms (Johnson, The NLopt nonlinear-optimization package).

    Parameters
    ----------
    name
        A key of `ALGORITHMS`.
    options
        ``initial_step`` (search units, 0.1), ``tolerance`` (relative, of the point, 1e-7), ``cost_tolerance``
        (relative, 1e-12), ``population``, ``local`` (subsidiary of MLSL, ``sbplx``), ``evaluations`` (for this
        solver alone, as a link of a chain).
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    needs_residuals: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", _ALIASES.get(self.name, self.name))
        object.__setattr__(self, "options", frozen_mapping(self.options))
        for key in self.options:
            if key not in _OPTIONS:
                raise ProblemError(
                    f"solver '{self.name}' has no option '{key}'", fix=f"it has: {', '.join(_OPTIONS)}"
                )
            if key != "local":
                self._number(key)
        local = self.options.get("local", "sbplx")
        if local not in _LOCAL:
            raise ProblemError(f"'{local}' is not a local solver", fix=f"local is one of: {', '.join(_LOCAL)}")

    def _number(self, key: str) -> float:
        return number_of(self.options, key, _OPTIONS[key], solver=self.name)

    def check(self, problem: Problem) -> None:
        """See `Solver.check`."""
        if ALGORITHMS[self.name].finite_bounds and not problem.space.bounded:
            raise ProblemError(
                f"solver '{self.name}' needs both bounds of every free parameter",
                fix=f"give lower and upper of {', '.join(problem.space.unbounded)}",
            )

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        algorithm = ALGORITHMS[self.name]
        first = search.evaluate(start)
        if first.failure is not None and (algorithm.model or not algorithm.finite_bounds):
            raise SimulationError(f"the start point fails ({first.failure})", fix="choose other start values")
        first_step = self._number("initial_step")

        def run(x: FloatArray, scale: float) -> Outcome:
            return around_failures(
                search,
                x,
                lambda x, lower, upper: self._run(
                    search, algorithm, first, x=x, lower=lower, upper=upper, initial_step=scale
                ),
            )

        outcome = run(start, first_step)
        if self.name == "cobyla" and "evaluations" not in self.options:
            # It may stop short of a minimum where goals meet in a narrow valley, so continue with smaller steps.
            for k in range(1, _RESTARTS + 1):
                before = search.reached
                if outcome.status is not Status.CONVERGED or before is None:
                    break
                outcome = run(before.x, first_step * _SHORTER**k)
                after = search.reached
                assert after is not None
                gain = search.cost_of(before) - search.cost_of(after)
                if search.feasible(before) and gain <= _GAIN * abs(search.cost_of(before)):
                    break
        return outcome

    def _run(
        self,
        search: Search,
        algorithm: _Algorithm,
        first: Evaluation,
        *,
        x: FloatArray,
        lower: FloatArray,
        upper: FloatArray,
        initial_step: float,
    ) -> Outcome:
        import nlopt

        epigraph = search.goals_of is not None and algorithm.constraints
        constrained = bool(search.problem.constraints) or len(search.limits_of(first)) > 0
        n = len(search) + epigraph
        opt = nlopt.opt(getattr(nlopt, algorithm.nlopt), n)
        functions = _Functions(search, opt, algorithm, epigraph, first)
        inner = opt
        if constrained and not algorithm.constraints:
            opt = nlopt.opt(nlopt.AUGLAG, n)  # augmented Lagrangian around a solver without constraints
            functions.opt = opt
        here = x
        step = np.minimum(initial_step, 0.4 * (upper - lower))
        if epigraph:
            evaluation = search.evaluate(x)
            level = max(search.cost_of(evaluation), _LOWEST_LEVEL) if evaluation.ok else 1.0
            lower, upper = np.append(lower, 0.0), np.append(upper, 10.0 * level)
            here, step = np.append(x, level), np.append(step, 0.1 * level + 1e-12)
        # Local solvers draw random numbers too, such as PRAXIS in ill-conditioned problems. A seed of 0 would mean
        # the clock.
        nlopt.srand(search.seed + 1)
        for each in {id(opt): opt, id(inner): inner}.values():
            each.set_lower_bounds(lower)
            each.set_upper_bounds(upper)
            if not algorithm.finite_bounds:
                each.set_initial_step(step)
            self._set_tolerances(each)
        self._set_parts(opt, inner, algorithm)
        limit = self.options.get("evaluations")
        if limit is None and search.stop == StopRules() and (algorithm.finite_bounds or opt is not inner):
            limit = (_GLOBAL_EVALUATIONS if algorithm.finite_bounds else _PENALTY_EVALUATIONS) * (n + 1)
        if limit is not None:
            opt.set_maxeval(int(limit))
        opt.set_min_objective(functions.objective)
        if count := functions.count(first, equality=False):
            opt.add_inequality_mconstraint(functions.inequalities, np.full(count, FEASIBLE / 10.0))
        if count := functions.count(first, equality=True):
            opt.add_equality_mconstraint(functions.equalities, np.full(count, FEASIBLE / 10.0))
        return _optimized(opt, functions, np.clip(here, lower, upper)) or Outcome(
            Status.BUDGET, f"{limit} evaluations of {self.name}"
        )

    def _set_tolerances(self, opt: Any) -> None:
        tolerance = self._number("tolerance")
        opt.set_xtol_rel(tolerance)
        opt.set_xtol_abs(0.1 * tolerance)  # search coordinates are of order one, but may be 0
        opt.set_ftol_rel(self._number("cost_tolerance"))

    def _set_parts(self, opt: Any, inner: Any, algorithm: _Algorithm) -> None:
        """Give a global algorithm its local one and its population, and an enclosing one the algorithm inside."""
        import nlopt

        if algorithm.subsidiary:
            name = ALGORITHMS[self.options.get("local", "sbplx")].nlopt
            local = nlopt.opt(getattr(nlopt, name), opt.get_dimension())
            local.set_xtol_rel(1e-5)
            local.set_ftol_rel(1e-9)
            inner.set_local_optimizer(local)
        if "population" in self.options:
            inner.set_population(int(self.options["population"]))
        if opt is not inner:
            opt.set_local_optimizer(inner)


def minimised(
    function: Callable[[FloatArray], float], start: FloatArray, *, step: float, evaluations: int
) -> None:
    """Minimise a function in the unit cube with Subplex (Rowan 1990), from (n,) `start`.

    The function must record its own evaluations; its exceptions are raised here after NLopt's C code has ended.
    """
    import nlopt

    opt = nlopt.opt(nlopt.LN_SBPLX, len(start))
    raised: list[BaseException] = []

    def guarded(x: FloatArray, _: FloatArray) -> float:
        try:
            return function(x)
        except BaseException as error:
            raised.append(error)
            opt.force_stop()
            return float("inf")

    opt.set_min_objective(guarded)
    opt.set_lower_bounds(0.0)
    opt.set_upper_bounds(1.0)
    opt.set_initial_step(step)
    opt.set_xtol_abs(1e-4)
    opt.set_maxeval(evaluations)
    with suppress(nlopt.exception, nlopt.ForcedStop, nlopt.RoundoffLimited):
        opt.optimize(np.clip(start, 0.0, 1.0))
    if raised:
        raise raised[0]


def _optimized(opt: Any, functions: _Functions, start: FloatArray) -> Outcome | None:
    """Run the search from `start` (n,) and return how it ended; None if its budget was spent."""
    import nlopt

    try:
        opt.optimize(start)
    except nlopt.RoundoffLimited:
        functions.reraise()
        return Outcome(Status.CONVERGED, "no further progress in floating point")
    except (nlopt.ForcedStop, nlopt.exception) as error:
        functions.reraise()
        if functions.stuck:
            return Outcome(Status.CONVERGED, "the solver no longer moves")
        return Outcome(Status.STALLED, f"NLopt failed {error}".strip())
    functions.reraise()
    messages = {
        nlopt.FTOL_REACHED: "cost no longer changes",
        nlopt.XTOL_REACHED: "parameters no longer change",
        nlopt.SUCCESS: "done",
    }
    code = opt.last_optimize_result()
    return Outcome(Status.CONVERGED, messages[code]) if code in messages else None


class _Functions:
    """The callbacks of one NLopt run. An exception is kept and raised once NLopt has returned."""

    def __init__(self, search: Search, opt: Any, algorithm: _Algorithm, epigraph: bool, first: Evaluation) -> None:
        self.search, self.opt, self.algorithm, self.epigraph = search, opt, algorithm, epigraph
        # SLSQP and COBYLA fail for costs that are not of order one.
        scale = search.cost_of(first) if first.ok else 1.0
        self.scale = 1.0 / scale if scale > 0.0 else 1.0
        self.raised: BaseException | None = None
        self.seen = self.idle = 0

    def reraise(self) -> None:
        """Raise the exception of a callback."""
        if self.raised is not None:
            raise self.raised

    @property
    def stuck(self) -> bool:
        """Whether the solver keeps asking for known points, as COBYLA may if no constraint can be met."""
        return self.idle >= _IDLE

    def count(self, evaluation: Evaluation, *, equality: bool) -> int:
        """Return the number of constraints of a kind, epigraph ones included."""
        return len(self._vector(evaluation, equality, 0.0))

    def objective(self, x: FloatArray, gradient: FloatArray) -> float:
        """Return the cost, or the epigraph variable."""
        if self.epigraph:
            if gradient.size:
                gradient[:] = 0.0
                gradient[-1] = 1.0
            return float(x[-1])

        def cost() -> float:
            evaluation = self._evaluate(x)
            if gradient.size:
                gradient[:] = self._slopes(x, lambda e: np.array([self._cost(e)]))[0]
            return self._cost(evaluation) if evaluation.ok else float("inf")

        return self._guarded(cost, float("inf"))

    def inequalities(self, result: FloatArray, x: FloatArray, gradient: FloatArray) -> None:
        """Fill in the inequality constraints, which are satisfied if at most 0."""
        self._constraints(result, x, gradient, False)

    def equalities(self, result: FloatArray, x: FloatArray, gradient: FloatArray) -> None:
        """Fill in the equality constraints."""
        self._constraints(result, x, gradient, True)

    def _constraints(self, result: FloatArray, x: FloatArray, gradient: FloatArray, equality: bool) -> None:
        level = float(x[-1]) if self.epigraph else 0.0

        def fill() -> float:
            evaluation = self._evaluate(x)
            result[:] = self._vector(evaluation, equality, level) if evaluation.ok else np.inf
            if gradient.size:
                n = len(self.search)
                gradient[:, :n] = self._slopes(x, lambda e: self._vector(e, equality, level))
                if self.epigraph:
                    gradient[:, n:] = 0.0
                    if not equality:
                        count = len(self.search.violations(self._evaluate(x), equality=False))
                        gradient[count:, n:] = -1.0
            return 0.0

        if self._guarded(fill, float("nan")) != 0.0:
            result[:] = np.inf

    def _vector(self, evaluation: Evaluation, equality: bool, level: float) -> FloatArray:
        violations = self.search.violations(evaluation, equality=equality)
        if self.search.goals_of is None or not self.epigraph or equality:
            return violations
        return np.concatenate([violations, self.search.goals_of(evaluation) - level])

    def _cost(self, evaluation: Evaluation) -> float:
        return self.scale * self.search.cost_of(evaluation)

    def _evaluate(self, x: FloatArray) -> Evaluation:
        evaluation = self.search.evaluate(x[: len(self.search)])
        self.idle = self.idle + 1 if self.search.evaluations == self.seen else 0
        self.seen = self.search.evaluations
        if self.stuck:
            self.opt.force_stop()
        if not evaluation.ok and self.algorithm.model:
            raise CandidateFailedError(evaluation.x)
        return evaluation

    def _slopes(self, x: FloatArray, of: Callable[[Evaluation], FloatArray]) -> FloatArray:
        """Return the (k, n) central differences of a (k,) function of evaluations."""
        here = x[: len(self.search)]
        step = 1e-4
        points = [here + sign * step * unit for unit in np.eye(len(here)) for sign in (1.0, -1.0)]
        evaluations = self.search.evaluate_many(points, "derivative")
        columns = []
        for i, (a, b) in enumerate(zip(evaluations[::2], evaluations[1::2], strict=True)):
            if not (a.ok and b.ok):
                raise CandidateFailedError(b.x if a.ok else a.x)
            columns.append((of(a) - of(b)) / (a.x[i] - b.x[i]))
        return np.array(columns).T

    def _guarded(self, function: Callable[[], float], otherwise: float) -> float:
        if self.raised is not None:
            return otherwise
        try:
            return function()
        except BaseException as error:  # Ctrl-C too, because NLopt's C code must end first
            self.raised = error
            self.opt.force_stop()
            return otherwise
