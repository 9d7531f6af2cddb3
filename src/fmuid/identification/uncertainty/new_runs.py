"""How far a new run may be from its prediction: every run is predicted from what the others determine.

This needs no noise and no right model. What the model misses in the runs that were left out, it misses in new runs
of their kind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.uncertainty.clusters import whitening

_FEWEST = 2  # runs
_ALONE = 1e-3  # share of the information on a direction that the others must hold


@dataclass(frozen=True, slots=True)
class NewRuns:
    """Errors of a signal in new runs of the fitted ones' kind.

    Parameters
    ----------
    setup, signal, unit
        The signal, and the unit of its log.
    rmse
        Root mean square error in `runs` runs, each predicted from the parameters that the others determine.
    half_width
        95 % of the samples of a new run are expected within this distance of their prediction.
    """

    setup: str
    signal: str
    unit: str | None
    rmse: float
    half_width: float
    runs: int

    def __str__(self) -> str:
        """Return it as a sentence."""
        unit = f" {self.unit}" if self.unit and self.unit != "1" else ""
        return (
            f"new runs, 95 %: {self.signal} within ±{self.half_width:.3g}{unit} of its prediction "
            f"({self.runs} runs, each predicted from the others)"
        )


def new_runs(problem: Problem, x: FloatArray, residuals: FloatArray, j: FloatArray) -> tuple[NewRuns, ...]:
    """Return the errors of every signal in new runs.

    The parameters without a run are those after one Gauss-Newton step. Its errors differ from run to run, so their
    distribution is approximated by a t-distribution (Satterthwaite's degrees of freedom).

    Parameters
    ----------
    x, residuals, j
        Search point of the estimate (n,), its residuals (m,), and their Jacobian (m, n).
    """
    from scipy.special import stdtrit

    squares: dict[tuple[str, str], list[float]] = {}
    units: dict[tuple[str, str], str | None] = {}
    root, space, left_out = whitening(j.T @ j), problem.space, []
    for case in problem.cases:
        step = _step_without(_rows(problem, case.id), residuals, j, root)
        if step is not None:
            left_out.append((case, space.tried(np.clip(x + step, space.lower, space.upper))[0]))
    if len(left_out) < _FEWEST:
        return ()
    outcomes = problem.runner(
        [(case.simulator, case.task, case.start_values(values)) for case, values in left_out]
    )
    for (case, values), outcome in zip(left_out, outcomes, strict=True):
        if isinstance(outcome, SimulationError):
            return ()
        predicted = case.sensed(outcome, values)
        for k, channel in enumerate(case.channels):
            rows = [c.rows for c in case.criteria if c.signal == channel.signal and c.rows is not None]
            if not rows:
                continue
            error = (predicted[k] - channel.repeats)[:, np.unique(np.concatenate(rows))]
            of = (case.setup, channel.signal)
            squares.setdefault(of, []).append(channel.to_shown.factor**2 * float(np.nanmean(error**2)))
            units[of] = channel.shown_unit or None
    new_runs = []
    for of, each in squares.items():
        count, mean = len(each), float(np.mean(each))
        if count < _FEWEST or not mean > 0.0:
            continue
        scatter = float(np.var(each, ddof=1)) * (1.0 + 1.0 / count)
        degrees = 1e9 if scatter == 0.0 else max(2.0 * mean**2 / scatter, 1.0)
        rmse = float(np.sqrt(mean))
        new_runs.append(NewRuns(*of, units[of], rmse, rmse * float(stdtrit(degrees, 0.975)), count))
    return tuple(new_runs)


def _rows(problem: Problem, case: str) -> NDArray[np.intp]:
    """Return the residuals of a case."""
    slices = zip(problem.criteria, problem.slices, strict=True)
    return np.concatenate([np.arange(r.start, r.stop) for (c, _), r in slices if c.id == case])


def _step_without(
    rows: NDArray[np.intp], residuals: FloatArray, j: FloatArray, root: FloatArray
) -> FloatArray | None:
    """Return the step (n,) to the point that the other residuals determine, None if they do not.

    The columns of `j @ root` are orthonormal.
    """
    part = j[rows] @ root
    others = np.eye(len(root)) - part.T @ part
    if np.linalg.eigvalsh(others)[0] < _ALONE:
        return None
    return np.asarray(root @ np.linalg.solve(others, part.T @ residuals[rows]))
