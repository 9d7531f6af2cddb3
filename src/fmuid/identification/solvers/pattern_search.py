"""Pattern search (Hooke and Jeeves, JACM 8:212, 1961), polling both sides of every coordinate at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray, frozen_mapping
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.solvers.search import Outcome, Search, Status, number_of

_OPTIONS: Mapping[str, float] = {"initial_step": 0.1, "tolerance": 1e-6, "evaluations": 1000}


@dataclass(frozen=True, slots=True)
class PatternSearch:
    """Steps along the coordinates while they help, then in the same overall direction; else halves the step.

    It needs neither smoothness nor derivatives. The polls are independent and keep the workers busy. A point that
    satisfies the constraints is better than one that does not; diagonal steps move along constraints. Curved
    equality constraints are not followed.

    Parameters
    ----------
    options
        ``initial_step`` (search units, 0.1), ``tolerance`` (final step, 1e-6), ``evaluations`` (of this solver
        alone, as a link of a chain).
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    name: str = field(default="pattern_search", init=False)
    needs_residuals: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "options", frozen_mapping(self.options))
        if unknown := self.options.keys() - _OPTIONS.keys():
            raise ProblemError(
                f"solver '{self.name}' has no option '{min(unknown)}'", fix=f"it has: {', '.join(_OPTIONS)}"
            )
        for key in self.options:
            self._number(key)

    def _number(self, key: str) -> float:
        return number_of(self.options, key, _OPTIONS[key], solver=self.name)

    def check(self, problem: Problem) -> None:
        """See `Solver.check`."""

    def solve(self, search: Search, start: FloatArray) -> Outcome:
        """See `Solver.solve`."""
        limit = self._number("evaluations") + search.evaluations if "evaluations" in self.options else np.inf
        step, least = self._number("initial_step"), self._number("tolerance")
        search.evaluate(start)
        here = start if search.reached is None else search.reached.x
        directions = _directions(len(here), diagonal=bool(search.problem.constraints))
        while step > least:
            if search.evaluations >= limit:
                return Outcome(Status.BUDGET, f"{limit:.0f} evaluations of {self.name}")
            search.evaluate_many([here + step * d for d in directions])
            there = here if search.reached is None else search.reached.x
            if np.array_equal(there, here):
                step *= 0.5
                continue
            search.evaluate(2.0 * there - here)  # the pattern move
            assert search.reached is not None
            here = search.reached.x
        if search.reached is None:
            return Outcome(Status.FAILED, "no point could be simulated")
        return Outcome(Status.CONVERGED, "no step along a coordinate helps")


def _directions(n: int, *, diagonal: bool) -> FloatArray:
    """Return both ways along each coordinate, (2 n, n), and across each pair of them."""
    axes = np.eye(n)
    pairs = [axes[i] + sign * axes[k] for i in range(n) for k in range(i) for sign in (1.0, -1.0)]
    half = np.vstack([axes, *pairs]) if diagonal else axes
    return np.vstack([half, -half])
