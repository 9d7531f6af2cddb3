"""Hidden constraints: how to continue solvers that cannot handle failed candidates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fmuid.core.immutable import FloatArray
from fmuid.identification.solvers.search import Outcome, Search, Status

_RUNS = 60
_SMALLEST = 1e-9
_EDGE = 1e-6


class CandidateFailedError(Exception):
    """The candidate `x` cannot be simulated, and the solver has no way to handle that."""

    def __init__(self, x: FloatArray) -> None:
        super().__init__("a candidate failed")
        self.x = np.array(x)


def around_failures(
    search: Search, start: FloatArray, run: Callable[[FloatArray, FloatArray, FloatArray], Outcome]
) -> Outcome:
    """Run a solver; whenever a candidate fails, restart it from the best point in a smaller box.

    The box is cut half-way to the failed candidate, across the coordinate that differs most. A cut is moved if the
    optimum lies on it.

    Parameters
    ----------
    run
        (start, lower, upper) -> outcome; raises CandidateFailedError. The start has been simulated.
    """
    x = start
    lower, upper = search.lower.copy(), search.upper.copy()
    failed_at = np.full(len(x), np.nan)
    for _ in range(_RUNS):
        before = search.reached
        try:
            outcome = run(x, lower, upper)
        except CandidateFailedError as failed:
            assert search.reached is not None  # the start was simulated
            x = search.reached.x
            i = int(np.argmax(np.abs(failed.x - x)))
            if abs(failed.x[i] - x[i]) < _SMALLEST:
                break
            bound = upper if failed.x[i] > x[i] else lower
            bound[i], failed_at[i] = 0.5 * (failed.x[i] + x[i]), failed.x[i]
            continue
        assert search.reached is not None
        x = search.reached.x
        on_cut = _cuts_reached(x, lower, upper, search)
        if search.reached is before or not np.any(on_cut):
            return outcome
        for i in map(int, np.flatnonzero(on_cut)):
            bound = upper if failed_at[i] > x[i] else lower
            bound[i] = 0.5 * (bound[i] + failed_at[i])
    return Outcome(Status.STALLED, "simulations near the best point keep failing")


def _cuts_reached(x: FloatArray, lower: FloatArray, upper: FloatArray, search: Search) -> NDArray[np.bool_]:
    low = (x - lower <= _EDGE) & (lower > search.lower)
    high = (upper - x <= _EDGE) & (upper < search.upper)
    return np.asarray(low | high)
