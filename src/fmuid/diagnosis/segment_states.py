"""The initial states of segments in a diagnosis: fitted to each run, and projected off its residuals.

Predictions in segments have their initial states fitted to what was measured (`fmuid.simulation.segmented`).
Noise that the states follow is no longer in the residual, so it must not be expected there; and what acts after
the simulation, such as a wrong gain of a sensor, must be allowed to move the states. Both follow if the tangents
of the states, whitened, are projected off every residual and every difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fmuid.core.immutable import FloatArray, read_only
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.simulation.segmented import Segmented

_DEPENDENT = 1e-8  # smallest singular value of unit columns, over the largest


def with_states(observed: Observed, model: CampaignModel, values: Mapping[str, float]) -> Observed:
    """Return the measurements with the initial states of segments as nuisances, linear at `values`.

    Raises
    ------
    SimulationError
        A segment cannot be simulated.
    """
    if not any(isinstance(case.simulator, Segmented) for case in model.cases):
        return observed
    bases = []
    for case, whiten in zip(model.cases, observed.whiteners, strict=True):
        columns = np.zeros((whiten.size, 0))
        if isinstance(case.simulator, Segmented):
            at = model.start_values(case, {**model.fixed, **values})
            tangents = case.simulator.state_tangents(at)[:, :, case.lead :]
            columns = whiten(tangents).reshape(len(tangents), -1).T
        bases.append(read_only(_basis(columns)))
    return replace(observed, nuisances=tuple(bases))


def _basis(columns: FloatArray) -> FloatArray:
    norms = np.linalg.norm(columns, axis=0)
    kept = columns[:, norms > 0.0] / norms[norms > 0.0]
    if not kept.shape[1]:
        return np.asarray(kept)
    u, s, _ = np.linalg.svd(kept, full_matrices=False)
    return np.asarray(u[:, s > _DEPENDENT * s[0]])


def findings_of(model: CampaignModel, observers: Mapping[str, str]) -> tuple[str, ...]:
    """Return what was done, by setup; `observers` are the stages with an observer."""
    found = []
    for setup in dict.fromkeys(case.setup for case in model.cases):
        cut = [c.simulator for c in model.cases if c.setup == setup and isinstance(c.simulator, Segmented)]
        if cut:
            segments, states = sum(s.segments for s in cut), sum(s.nuisances for s in cut)
            why = f"; stage '{observers[setup]}' has an observer instead" if setup in observers else ""
            found.append(
                f"Runs of setup '{setup}' are predicted in {segments} segments, whose {states} initial states are "
                f"fitted along{why}."
            )
    return tuple(found)
