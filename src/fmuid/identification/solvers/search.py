"""A search in progress, as a solver sees it: evaluations are counted, recorded and stopped here."""

from __future__ import annotations

import enum
import math
import re
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import NoiseFloor
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation

FEASIBLE = 1e-6  # a constraint violated by less counts as satisfied
_REMEMBERED = 64  # evaluations that a solver may request again
_EDGE = 1e-3  # distance in search units within which a failed candidate marks an edge


class Status(enum.StrEnum):
    """Outcome of a search, as readable text."""

    CONVERGED = "converged"
    STALLED = "stalled"
    BUDGET = "budget spent"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Outcome:
    """Status and message of a solver."""

    status: Status
    message: str


@dataclass(frozen=True, slots=True)
class StopRules:
    """Limits of a search; None means no limit.

    Parameters
    ----------
    evaluations
        Number of evaluations.
    seconds
        Time that evaluations take in all.
    cost
        A sufficient cost.
    """

    evaluations: int | None = None
    seconds: float | None = None
    cost: float | None = None


class StopSearch(Exception):  # noqa: N818 - not an error: control flow out of a solver's depths
    """A stop rule applies."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.message)
        self.outcome = outcome


@dataclass(frozen=True, slots=True)
class Start:
    """A start of a search and its end point, in search space."""

    start: tuple[float, ...]
    end: tuple[float, ...]
    cost: float
    status: Status
    evaluations: int


@dataclass(frozen=True, slots=True)
class Link:
    """A solver of a chain: the cost that it reached, and the number of its evaluations."""

    solver: str
    cost: float
    evaluations: int


Record = Callable[[Evaluation, str, bool], None]
"""Called with every evaluation, its purpose, and whether it is the best so far."""
Recall = Callable[[FloatArray, bool], Evaluation | None]
"""Returns an evaluation of an earlier, interrupted run; the flag also requests residuals."""


class Wish(NamedTuple):
    """A point to evaluate, the purpose, and whether to compute its Jacobian in the same runs."""

    x: FloatArray
    purpose: str = "search"
    differentiated: bool = False


Simulate = Callable[[Sequence[Wish]], list[Evaluation]]
"""Evaluates points."""
Goals = Callable[[Evaluation], FloatArray]
"""(k,) numbers of an evaluation."""


class Search:
    """The objective of one stage, as presented to solvers.

    Failed candidates have the cost NaN and never become the best.
    """

    def __init__(
        self,
        problem: Problem,
        stop: StopRules | None = None,
        *,
        record: Record = lambda *_: None,
        recall: Recall = lambda *_: None,
        seed: int = 0,
        needs_residuals: bool = True,
    ) -> None:
        self.problem = problem
        self.stop = stop or StopRules()
        self.seed = seed
        self.needs_residuals = needs_residuals
        self.lower, self.upper = problem.space.lower, problem.space.upper
        self.evaluations = 0
        self.failures = 0
        self.reasons: Counter[str] = Counter()
        self.seconds = 0.0
        self.best: Evaluation | None = None
        self.reached: Evaluation | None = None  # best since `refocus`
        self.starts: list[Start] = []
        self.links: list[Link] = []
        self.cost_of: Callable[[Evaluation], float] = lambda evaluation: evaluation.cost
        self.limits_of: Goals = lambda _: np.zeros(0)
        # Goals whose largest value is the cost, if any: solvers that take constraints then have a smooth problem.
        self.goals_of: Goals | None = None
        if problem.combination.kind == "min_max":
            self.goals_of = lambda evaluation: problem.root_weights**2 * evaluation.criteria
        self.noise_floor: NoiseFloor | None = None  # left here by a solver that measured it
        self.at_edge = False  # set by a solver that ended against a wall of failing candidates
        self._equality = np.array([c.is_equality for c in problem.constraints], dtype=bool)
        self._record, self.recall = record, recall
        self._simulate: Simulate = lambda wanted: problem.evaluate_many(
            [wish.x for wish in wanted], differentiated=[wish.differentiated for wish in wanted]
        )
        self._remembered = _REMEMBERED
        self._recent: OrderedDict[bytes, Evaluation] = OrderedDict()
        self._failed: list[Evaluation] = []
        self._plain = True

    def __len__(self) -> int:
        return len(self.problem.space)

    def refocus(self, cost_of: Callable[[Evaluation], float], limits_of: Goals) -> None:
        """Minimise another objective from now on, subject to additional limits (each at most 0)."""
        self.cost_of, self.limits_of, self.goals_of = cost_of, limits_of, None
        self._plain = False
        self.reached, self.starts = None, []
        if self.best is not None:
            self._compare(self.best)

    def aim(self, goals_of: Goals, limits_of: Goals | None = None) -> None:
        """Minimise the largest of some goals from now on, subject to limits (each at most 0)."""
        self.refocus(lambda evaluation: float(np.max(goals_of(evaluation))), limits_of or (lambda _: np.zeros(0)))
        self.goals_of = goals_of

    def evaluate(self, x: FloatArray, *, differentiated: bool = False) -> Evaluation:
        """Evaluate one search point; `differentiated` if its Jacobian is wanted next (`Problem.evaluate_many`)."""
        return self.evaluate_all([Wish(x, differentiated=differentiated)])[0]

    def evaluate_many(self, points: Sequence[FloatArray], purpose: str = "search") -> list[Evaluation]:
        """Evaluate points, in parallel if the problem's runner supports it.

        Raises
        ------
        StopSearch
            A stop rule applies.
        """
        return self.evaluate_all([Wish(x, purpose) for x in points])

    def evaluate_all(self, wanted: Sequence[Wish]) -> list[Evaluation]:
        """Evaluate points, each with its purpose; see `evaluate_many`."""
        self._check_budget()
        keys: list[bytes] = []
        wishes: dict[bytes, Wish] = {}
        for wish in wanted:
            x = np.clip(np.asarray(wish.x, dtype=np.float64), self.lower, self.upper)
            keys.append(x.tobytes())
            if keys[-1] not in wishes or wish.purpose == "search":
                wishes[keys[-1]] = wish._replace(x=x)
        evaluations = {key: self.complete(e) for key in wishes if (e := self._recent.get(key)) is not None}
        recalled = set()
        for key, wish in wishes.items():
            if key not in evaluations and (old := self.recall(wish.x, self.needs_residuals)) is not None:
                evaluations[key] = old
                recalled.add(key)
        new = {key: wish for key, wish in wishes.items() if key not in evaluations}
        if new:
            evaluations |= zip(new, self._simulate(list(new.values())), strict=True)
        for key, wish in wishes.items():
            if key in new or key in recalled:
                self._count(evaluations[key], wish.purpose, recorded=key in recalled)
                self._remember(key, evaluations[key])
            elif wish.purpose == "search":
                self._compare(evaluations[key])
        return [evaluations[key] for key in keys]

    @property
    def plain(self) -> bool:
        """Whether the cost is the problem's own, without additional limits."""
        return self._plain

    def failure_near(self, x: FloatArray) -> str | None:
        """Return why a candidate at the (n,) point `x` failed, or very close to it; None if there is none."""
        reach = _EDGE * np.maximum(np.abs(x), 1.0)
        return next((e.failure for e in self._failed if bool((np.abs(e.x - x) <= reach).all())), None)

    @contextmanager
    def with_residuals(self) -> Iterator[None]:
        """Need residuals within the block, whatever the solver needs."""
        before, self.needs_residuals = self.needs_residuals, True
        try:
            yield
        finally:
            self.needs_residuals = before

    def complete(self, evaluation: Evaluation) -> Evaluation:
        """Return an evaluation with its residuals, which a resumed run may have forgotten."""
        forgotten = self.needs_residuals and evaluation.ok and not evaluation.residuals.size
        return self.problem.evaluate(evaluation.x) if forgotten else evaluation

    def cost(self, x: FloatArray) -> float:
        """Return the cost at `x`, NaN where the simulation fails."""
        evaluation = self.evaluate(x)
        return self.cost_of(evaluation) if evaluation.ok else float("nan")

    def violations(self, evaluation: Evaluation, *, equality: bool) -> FloatArray:
        """Return the constraint violations of one kind, limits included among the inequalities."""
        violations = evaluation.constraints[self._equality if equality else ~self._equality]
        return violations if equality else np.concatenate([violations, self.limits_of(evaluation)])

    def feasible(self, evaluation: Evaluation) -> bool:
        """Return whether every constraint is satisfied."""
        return bool(
            (self.violations(evaluation, equality=False) <= FEASIBLE).all()
            and (np.abs(self.violations(evaluation, equality=True)) <= FEASIBLE).all()
        )

    @contextmanager
    def share(self, links: int) -> Iterator[None]:
        """Limit the block to its share, one of `links`, of the remaining budget; then raise `StopSearch`."""
        whole = self.stop
        evaluations, seconds = whole.evaluations, whole.seconds
        if evaluations is not None:
            evaluations = self.evaluations + math.ceil((evaluations - self.evaluations) / links)
        if seconds is not None:
            seconds = self.seconds + (seconds - self.seconds) / links
        self.stop = replace(whole, evaluations=evaluations, seconds=seconds)
        try:
            yield
        finally:
            self.stop = whole

    def _check_budget(self) -> None:
        stop = self.stop
        if stop.evaluations is not None and self.evaluations >= stop.evaluations:
            raise StopSearch(Outcome(Status.BUDGET, f"{self.evaluations} evaluations"))
        if stop.seconds is not None and self.seconds >= stop.seconds:
            raise StopSearch(Outcome(Status.BUDGET, f"{stop.seconds:g} s"))
        if stop.cost is not None and self.best is not None and self.best.cost <= stop.cost:
            raise StopSearch(Outcome(Status.CONVERGED, f"cost at most {stop.cost:g}"))

    def _count(self, evaluation: Evaluation, purpose: str, *, recorded: bool) -> None:
        self.evaluations += 1
        self.seconds += evaluation.seconds
        if evaluation.failure is not None:
            self.failures += 1
            self.reasons[in_short(evaluation.failure)] += 1
            self._failed.append(evaluation)
        improved = purpose == "search" and self._compare(evaluation)
        if not recorded:
            self._record(evaluation, purpose, improved)

    def _compare(self, evaluation: Evaluation) -> bool:
        """Keep `evaluation` as the best if it is; return whether it is."""
        if not evaluation.ok:
            return False
        if self.reached is None or self._better(evaluation, self.reached):
            self.reached = evaluation
        if self.best is None or self._better(evaluation, self.best):
            self.best = evaluation
            return True
        return False

    def _better(self, a: Evaluation, b: Evaluation) -> bool:
        feasible_a, feasible_b = self.feasible(a), self.feasible(b)
        if feasible_a != feasible_b:
            return feasible_a
        if not feasible_a:
            return self._broken(a) < self._broken(b)
        return self.cost_of(a) < self.cost_of(b)

    def _broken(self, evaluation: Evaluation) -> float:
        inequality = np.maximum(self.violations(evaluation, equality=False), 0.0)
        return float(np.sum(inequality) + np.sum(np.abs(self.violations(evaluation, equality=True))))

    def _remember(self, key: bytes, evaluation: Evaluation) -> None:
        self._recent[key] = evaluation
        while len(self._recent) > self._remembered:
            self._recent.popitem(last=False)


def in_short(failure: str) -> str:
    """Return why a candidate failed, without the values that differ from candidate to candidate."""
    return re.sub(r" \(with [^()]*\)| at [-+.\de]+ s\b", "", failure)


class Solver(Protocol):
    """A search method. Solvers are small immutable values with a common signature."""

    @property
    def name(self) -> str:
        """The solver's name."""
        ...

    @property
    def needs_residuals(self) -> bool:
        """Whether the solver needs the residual vector, not only the cost."""
        ...

    def check(self, problem: Problem) -> None:
        """Raise an error if the solver cannot solve a problem.

        Raises
        ------
        ProblemError
            The solver cannot handle the problem's bounds, constraints or cost.
        """
        ...

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """Search from the (n,) `start`; the results are ``search.reached`` and ``search.best``.

        Raises
        ------
        StopSearch
            A stop rule applies.
        """
        ...


def number_of(options: Mapping[str, Any], key: str, default: float, *, solver: str) -> float:
    """Return a solver option, which must be a positive number.

    Raises
    ------
    ProblemError
        The option is not a positive number.
    """
    value = options.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise ProblemError(
            f"option {key} of solver '{solver}' is {value!r}", fix=f"write a positive number, such as {default:g}"
        )
    return float(value)
