"""Progress reports of an identification, independent of the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.result import StageResult
from fmuid.identification.solvers.search import StopRules


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a stage, reported after every evaluation.

    `best` are the free parameters in model space at the lowest cost so far; both are None before the first
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
    """Receives progress reports and ignores them. Derive from it to show or log an identification."""

    def started(self, problem: Problem, solver: str, why: str, stop: StopRules) -> None:
        """Handle the start of a stage."""

    def evaluated(self, progress: Progress) -> None:
        """Handle an evaluation."""

    def finished(self, result: StageResult) -> None:
        """Handle the end of a stage."""
