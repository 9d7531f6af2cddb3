"""The initial states of segments in a diagnosis: fitted to each run, and projected off its residuals.

Predictions in segments have their initial states fitted to the measurements (`fmuid.simulation.segmented`). Noise
that the states follow is no longer in the residual, so it must not be expected there, and effects after the
simulation, such as a wrong gain of a sensor, must be allowed to move the states. Both hold if the whitened
tangents of the states are projected off every residual and every difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fmuid.core.campaign import StageSpec
from fmuid.core.immutable import read_only
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.projection import orthonormal
from fmuid.identification.problem.segments import why_whole
from fmuid.simulation.segmented import Segmented

_DEPENDENT = 1e-8  # smallest singular value of unit columns, relative to the largest


def with_states(observed: Observed, model: CampaignModel, values: Mapping[str, float]) -> Observed:
    """Return the measurements with the initial states of segments as nuisances, linearised at `values`.

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
        bases.append(read_only(orthonormal(columns, _DEPENDENT)))
    return replace(observed, nuisances=tuple(bases))


def findings_of(model: CampaignModel, stages: Mapping[str, StageSpec]) -> tuple[str, ...]:
    """Return notes on how each setup is predicted; `stages` are the ones whose segments or observer count."""
    found = []
    for setup in dict.fromkeys(case.setup for case in model.cases):
        own = [c.simulator for c in model.cases if c.setup == setup]
        cut = [simulator for simulator in own if isinstance(simulator, Segmented)]
        stage = stages.get(setup)
        if stage is not None and not cut and (why := why_whole(stage, own[0])):
            found.append(
                f"Runs of setup '{setup}' are predicted whole, not as stage '{stage.name}' does: with effects, "
                f"{why}. This diagnosis says little about an unstable plant."
            )
        if cut:
            segments, states = sum(s.segments for s in cut), sum(s.nuisances for s in cut)
            why = f"; stage '{stage.name}' has an observer instead" if stage is not None and stage.observer else ""
            found.append(
                f"Runs of setup '{setup}' are predicted in {segments} segments, whose {states} initial states are "
                f"fitted as well{why}."
            )
    return tuple(found)
