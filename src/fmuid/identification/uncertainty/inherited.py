"""Errors inherited from earlier stages: two-step estimates (Murphy and Topel, 1985).

A stage that fixes parameters at an earlier stage's estimates inherits their errors. To first order its own
estimate moves by S dh with ``S = -(J'J)^-1 J' J_h``, so its covariance is that of its own noise plus ``S C_h S'``.
The noise of different stages is assumed independent; if two stages fit the same runs, their noise is counted
twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.estimation_problem import Problem


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Parameters that a stage fixes at estimates of earlier stages.

    Parameters
    ----------
    problem
        The stage's problem, with these parameters free after its own.
    rows
        (h, k) errors in the search space of `problem`, as sums of k independent sources of unit variance.
    degrees
        (k,) degrees of freedom of each source.
    """

    problem: Problem
    rows: FloatArray
    degrees: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.problem.space.names[-len(self.rows) :]

    def point(self, x: FloatArray) -> FloatArray:
        """Return the search point of `problem` for the stage's (n,) search point `x`."""
        return np.concatenate([x, self.problem.space.start[len(x) :]])


def effective_degrees(parts: FloatArray, degrees: FloatArray) -> FloatArray:
    """Return (n,) degrees of freedom of sums of (n, k) variances with (k,) each (Welch and Satterthwaite)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        total, below = np.sum(parts, axis=1), np.sum(parts**2 / degrees, axis=1)
        return np.asarray(np.where(below > 0.0, total**2 / below, np.inf))
