"""Cases whose runs are cut into segments; how these are simulated: `fmuid.simulation.segmented`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.cases import Case
from fmuid.simulation.segmented import Growth, Length, Segmented, open_loop


def segmented(case: Case, length: Length, values: Mapping[str, float], free: Collection[str] = ()) -> Case:
    """Return a case whose run is cut into segments.

    Parameters
    ----------
    case
        The case.
    length
        Of the segments.
    values
        Of all parameters, in model space: with them the segments are laid out.
    free
        Names of the parameters that are estimated.

    Raises
    ------
    ProblemError
        The model's states cannot be set, a sensor stands between model and measurement, or a free parameter is an
        initial state.
    """
    where = f"segments of '{case.id}'"
    for channel in case.channels:
        if not channel.plain:
            raise ProblemError(
                f"'{channel.signal}' has a sensor of its own (gradient, filter, offset, gain or delay)",
                where=where,
                fix="put the sensor into the model, or leave segments out",
            )
    try:
        simulator = Segmented(case.simulator, case.task, length, *_judged(case), at=case.start_values(values))
    except ProblemError as error:
        raise ProblemError(error.what, where=where, fix=error.fix) from None
    for name in free:
        if name in case.setting and case.setting[name][0] in simulator.states:
            raise ProblemError(
                f"'{name}' is an initial state, which each segment has its own of",
                where=where,
                fix="take it out of 'free'",
            )
    return replace(case, simulator=simulator)


def growth_of(case: Case, values: Mapping[str, float]) -> Growth | None:
    """Return how errors grow when a case is simulated as a whole; None where its model cannot be started anywhere.

    Parameters
    ----------
    case
        The case, in one piece.
    values
        Of all parameters, in model space.
    """
    try:
        simulator = segmented(case, "auto", values).simulator
    except ProblemError:
        return None
    assert isinstance(simulator, Segmented)
    return open_loop(simulator)


def _judged(case: Case) -> tuple[FloatArray, FloatArray]:
    """Return what a case's outputs are compared with, and the weights of the errors in its cost; (outputs, N)."""
    n = len(case.time)
    squares = np.zeros((len(case.channels), n))
    rows = {channel.signal: k for k, channel in enumerate(case.channels)}
    for criterion in case.criteria:
        if criterion.affine and criterion.rows is not None:
            unit = criterion.residuals(np.ones(n)) - criterion.residuals(np.zeros(n))
            squares[rows[criterion.signal], criterion.rows] += criterion.weight * unit**2
    if not np.any(squares):  # judged by features or colour: as the sensors' noise says
        squares = np.array([np.where(np.isfinite(c.mean), c.count / c.sigma**2, 0.0) for c in case.channels])
    target = np.array([c.mean for c in case.channels])
    weight = np.where(np.isfinite(target), np.sqrt(squares), 0.0)
    lead = ((0, 0), (case.lead, 0))
    return np.pad(target, lead), np.pad(weight, lead)
