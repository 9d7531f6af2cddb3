"""Least-squares solvers: trust region and Levenberg-Marquardt (SciPy), and derivative-free DFO-LS."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np

from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray, frozen_mapping
from fmuid.identification.problem.derivatives import Differences, NoiseFloor, noise_floor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers.box import CandidateFailedError, around_failures
from fmuid.identification.solvers.search import Outcome, Search, Status, StopSearch, number_of
from fmuid.identification.solvers.trust_region import BlockedError, SettledError, trust_region

NOTHING_MOVES = "no free parameter changes a prediction"
_FLAT = 3.0  # times the noise of the cost: a smaller change is meaningless
_FLAT_TRIALS = 2
_LEVEL = 1e-4  # relative change of the cost below which the search is about to settle
_MEASUREMENTS = 2
_BLOCKED, _PROGRESS = 6, 0.1  # failed trials without relative progress of the cost: the way is blocked
_EXACT = 1e-11  # relative noise of a simulator with hardly more than rounding errors
_NEAR = 1e-3  # relative size that a last step must not exceed
_STILL = 1e-9
_LAST_STEPS = 20
_SMALLEST_RADIUS = 1e-8  # for DFO-LS: search coordinates are of order one


@dataclass(frozen=True, slots=True)
class TrustRegion:
    """Trust-region reflective or Levenberg-Marquardt least squares with noise-aware differences.

    A candidate that cannot be simulated shrinks the trust region.

    Parameters
    ----------
    name
        ``trf`` (bounds) or ``lm`` (MINPACK; only without bounds).
    tolerance
        Stop at this relative change of the point.
    """

    name: Literal["trf", "lm"] = "trf"
    tolerance: float = 1e-10
    needs_residuals: bool = field(default=True, init=False)

    def check(self, problem: Problem) -> None:
        """See `Solver.check`."""
        _require_smooth(problem, self.name)
        if self.name == "lm" and np.any(np.isfinite([problem.space.lower, problem.space.upper])):
            raise ProblemError("solver 'lm' takes no bounds", fix="use 'trf', or remove the bounds")

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        trials = _Trials(search, _start(search, start, differentiated=True))
        try:
            status = trust_region(
                trials.residuals,
                trials.jacobian,
                trials.first.x,
                search.lower,
                search.upper,
                method=self.name,
                cost_tolerance=1e-15,
                step_tolerance=self.tolerance,
            )
        except SettledError:
            ended = Outcome(Status.CONVERGED, "the cost changes by no more than the simulator's noise")
        except BlockedError as blocked:
            ended = Outcome(Status.STALLED, str(blocked))
        else:
            ended = Outcome(Status.CONVERGED if status else Status.BUDGET, _in_words(status))
        at_best = ended.status is Status.CONVERGED and search.reached is search.best
        floor = None if trials.exact else trials.floor
        if at_best and floor is not None and floor.relative <= _EXACT:
            with suppress(StopSearch, SimulationError):  # the search had ended before
                _polish(search, floor)
        return ended


def _polish(search: Search, floor: NoiseFloor) -> None:
    """Take the last Gauss-Newton steps with central differences.

    One-sided differences leave a minimum some thousandths of a standard error off. Noise hides that, but not in a
    simulator with rounding errors only; there the cost is flat to its last digits, so steps count, not gains.
    """
    derivative = partial(search.evaluate_many, purpose="derivative")
    differences = Differences(search.problem, floor, central=True)
    here, before, stalled = search.reached, _NEAR, 0
    for _ in range(_LAST_STEPS):
        if here is None:
            return
        inside = (search.lower < here.x) & (here.x < search.upper)
        step = np.zeros(len(here.x))
        j = differences.jacobian(derivative, here)[:, inside]
        step[inside] = np.linalg.lstsq(j, here.residuals, rcond=differences.tolerance)[0]
        size = float(np.linalg.norm(step) / max(np.linalg.norm(here.x), np.finfo(float).tiny))
        stalled += size > 0.9 * before
        if size > _NEAR or stalled == _FLAT_TRIALS:
            return
        here, before = search.evaluate(here.x - step), size
        if not here.ok or size < _STILL:
            return


class _Trials:
    """The residual function with its Jacobian, which also judges whether the search has settled.

    Near a minimum, a solver that assumes a smooth cost continues for long: the gain it predicts is less than the
    simulator's noise, so it rejects every step and shrinks its region. Exact derivatives need no noise floor; with
    them, the noise is measured once the cost no longer falls by much. Until then, most trials are accepted, so
    their Jacobians are computed in the same runs.
    """

    def __init__(self, search: Search, first: Evaluation) -> None:
        self.search, self.first = search, first
        self.flat = self.level = self.measured = self.blocked = 0
        self.floor: NoiseFloor | None = None  # as first measured
        self._differences: Differences | None = None
        self.exact = search.problem.exact.jacobian(first) is not None  # the last Jacobian
        if not self.exact:
            self.differences(first.x)

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Return the Jacobian at `x`."""
        here = self.search.evaluate(x)
        exact = self.search.problem.exact.jacobian(here)
        self.exact = exact is not None
        j = exact if exact is not None else self.differences(here.x).jacobian(self._evaluate, here)
        if not j.any():
            raise BlockedError(NOTHING_MOVES)
        return j

    def differences(self, x: FloatArray) -> Differences:
        """Return the difference quotients; the noise floor they need is measured at `x` if it is unknown."""
        if self._differences is None:
            self.floor = self.search.noise_floor = noise_floor(self.search.problem, x, evaluate=self._evaluate)
            self._differences = Differences(self.search.problem, self.floor, central=False)
        return self._differences

    def residuals(self, x: FloatArray) -> FloatArray:
        """Return the residuals at `x`, NaN where it fails (the solver then shrinks its region)."""
        best = self.search.reached or self.first
        again = np.array_equal(x, best.x)
        evaluation = self.search.evaluate(x, differentiated=self._differences is None)
        if not evaluation.ok:
            self.blocked += 1
            if self.blocked == _BLOCKED:
                raise BlockedError("every further step fails")
            return np.full(len(self.first.residuals), np.nan)
        if evaluation.cost < (1.0 - _PROGRESS) * best.cost:
            self.blocked = 0
        if not again:
            self._judge(evaluation, best)
        return evaluation.residuals

    def _judge(self, evaluation: Evaluation, best: Evaluation) -> None:
        """Count consecutive trials without significant change."""
        if self._differences is None:
            if evaluation.cost < (1.0 - _LEVEL) * best.cost:
                return
            self.measured = _MEASUREMENTS  # near the solution, where it matters
        try:
            floor = self.differences(best.x).floor
        except SimulationError:
            return  # the solver's own tolerances end the search
        change = abs(evaluation.cost - best.cost)
        self.flat = self.flat + 1 if change <= meaningless(best, floor) else 0
        self.level = self.level + 1 if change <= _LEVEL * best.cost else 0
        if self.flat == _FLAT_TRIALS:
            raise SettledError
        if self.level > _FLAT_TRIALS and self.measured < _MEASUREMENTS:
            self._measure(best.x)
            self.level = 0

    def _evaluate(self, points: Sequence[FloatArray]) -> list[Evaluation]:
        return self.search.evaluate_many(points, purpose="derivative")

    def _measure(self, x: FloatArray) -> None:
        """Measure the noise again where the search is about to settle: it may differ from that at the start."""
        self.measured += 1
        differences = self.differences(x)
        with suppress(SimulationError):
            measured = noise_floor(self.search.problem, x, evaluate=self._evaluate)
            if measured.residual > differences.floor.residual:
                differences.adopt(measured)
                self.search.noise_floor = measured


def meaningless(best: Evaluation, floor: NoiseFloor) -> float:
    """Return the largest change of the cost that is meaningless."""
    # Scatter of the cost: its gradient by the residuals, 2 r, times their scatter.
    noise = _FLAT * 2.0 * float(np.linalg.norm(best.residuals)) * floor.residual
    # A hundredth of a standard error justifies a few steps of an exact simulator, but not many of a noisy one.
    return max(noise, 1e-4 * best.cost / len(best.residuals)) if floor.relative > _EXACT else noise


def _in_words(status: int) -> str:
    words = {
        0: "10000 evaluations",
        1: "the gradient is zero",
        2: "the cost no longer changes",
        3: "the parameters no longer change",
        4: "neither cost nor parameters change",
    }
    return words.get(status, f"SciPy's status {status}")


@dataclass(frozen=True, slots=True)
class DfoLs:
    """DFO-LS (Cartis and others, 2019): least squares by interpolation, suitable for noisy simulations."""

    options: Mapping[str, Any] = field(default_factory=dict)
    name: str = field(default="dfols", init=False)
    needs_residuals: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "options", frozen_mapping(self.options))
        if unknown := self.options.keys() - {"initial_step", "tolerance"}:
            raise ProblemError(
                f"solver 'dfols' has no option '{min(unknown)}'", fix="it has: initial_step, tolerance"
            )

    @property
    def _radii(self) -> tuple[float, float]:
        """First and last radius of the trust region."""
        first = number_of(self.options, "initial_step", 0.1, solver=self.name)
        return first, number_of(self.options, "tolerance", _SMALLEST_RADIUS, solver=self.name)

    def check(self, problem: Problem) -> None:
        """See `Solver.check`."""
        if find_spec("dfols") is None:
            raise ProblemError("solver 'dfols' is not installed", fix="pip install 'fmuid[dfols]'")
        _require_smooth(problem, self.name)
        _ = self._radii

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        import dfols

        first = _start(search, start)
        step, smallest = self._radii

        def residuals(point: FloatArray) -> FloatArray:
            evaluation = search.evaluate(point)
            if not evaluation.ok:
                raise CandidateFailedError(evaluation.x)
            return evaluation.residuals

        def run(x: FloatArray, lower: FloatArray, upper: FloatArray) -> Outcome:
            radius = float(min(step, 0.45 * np.min(upper - lower)))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                np.random.seed(search.seed)  # noqa: NPY002 - DFO-LS draws from the global generator
                result = dfols.solve(
                    residuals,
                    x,
                    bounds=(np.maximum(lower, -1e20), np.minimum(upper, 1e20)),
                    rhobeg=radius,
                    rhoend=min(smallest, 0.1 * radius),
                    maxfun=search.stop.evaluations or 1000 * (len(x) + 1),
                    do_logging=False,
                )
            good = result.flag in (result.EXIT_SUCCESS, result.EXIT_SLOW_WARNING)
            return Outcome(Status.CONVERGED if good else Status.FAILED, result.msg)

        return around_failures(search, first.x, run)


def _require_smooth(problem: Problem, name: str) -> None:
    if problem.combination.kind != "weighted_sum" or problem.constraints:
        raise ProblemError(
            f"solver '{name}' minimises sums of squares without constraints",
            fix='use combine = "weighted_sum" without constraints, or another solver such as cobyla',
        )


def _start(search: Search, start: FloatArray, *, differentiated: bool = False) -> Evaluation:
    first = search.evaluate(start, differentiated=differentiated)
    if first.failure is not None:
        raise SimulationError(f"the start point fails ({first.failure})", fix="choose other start values")
    return first
