"""The evaluation of one candidate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fmuid.core.immutable import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The evaluation of one candidate.

    Parameters
    ----------
    x
        (n,) point in search space.
    parameters
        Every parameter in model space.
    criteria
        (n_criteria,) values, each divided by its demand; NaN if the candidate failed.
    residuals
        (m,) residuals of all criteria, each multiplied by the square root of its criterion's weight.
    cost
        The scalar that is minimised; NaN if the candidate failed.
    constraints
        (n_constraints,) violations: satisfied if at most 0 (inequalities) or 0 (equalities).
    failure
        Why there is no prediction, or None.
    seconds
        Wall time of its simulations.
    predictions
        (channels, N) sensor readings for each case.
    """

    x: FloatArray
    parameters: Mapping[str, float]
    criteria: FloatArray
    residuals: FloatArray
    cost: float
    constraints: FloatArray
    failure: str | None = None
    seconds: float = 0.0
    predictions: tuple[FloatArray, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether there is a prediction."""
        return self.failure is None
