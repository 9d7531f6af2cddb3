"""How an identification tells what it does while it runs, without knowing about terminals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.result import StageResult
from fmuid.identification.solvers.search import StopRules


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a stage is: told after every evaluation.

    `best` holds the free parameters in model space at the least cost so far; both are None before the first
    success.
    """

    stage: str
    evaluations: int
    failures: int
    seconds: float
    cost: float | None
    start_cost: float | None
    best: Mapping[str, float] | None
    stop: StopRules


class Observer:
    """Told what happens; does nothing. Derive from it to show or log an identification."""

    def started(self, problem: Problem, solver: str, why: str, stop: StopRules) -> None:
        """Take note that a stage begins."""

    def evaluated(self, progress: Progress) -> None:
        """Take note of an evaluation."""

    def finished(self, result: StageResult) -> None:
        """Take note that a stage ended."""
