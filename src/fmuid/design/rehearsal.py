"""The separation of rivals as a diagnosis will find it: each is played, and all are refitted.

The search for an excitation takes a wrong rival for linear in its parameters. Where it bends far, as friction at
reversals does, it can follow much further than that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray, read_only
from fmuid.design.planned import Planned
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.next_experiment import Rival
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import refit
from fmuid.diagnosis.scores import stack
from fmuid.diagnosis.subject import Subject


def rehearsed(planned: Planned, samples: FloatArray, rivals: Sequence[Rival], subject: Subject) -> FloatArray:
    """Return the (R, R) distances of rivals in a run driven by (inputs, N) samples.

    The first rival plays the run without noise, then both are refitted to it and the recorded runs. The squared
    distance is by how much the cost of the second exceeds that of the first, beyond what it did before.

    Raises
    ------
    SimulationError
        A run failed.
    """
    separations = np.zeros((len(rivals), len(rivals)))
    before = [float(rival.residual @ rival.residual) for rival in rivals]
    under = planned.under(samples)
    for a, outcome in enumerate(under.predict([r.values for r in rivals])):
        if isinstance(outcome, SimulationError):
            raise outcome
        case = under.cases[0]
        channels = tuple(
            replace(c, repeats=read_only(np.tile(y, (planned.repeats, 1))))
            for c, y in zip(case.channels, outcome[0], strict=True)
        )
        model = replace(subject.model, cases=(*subject.model.cases, replace(case, channels=channels)))
        observed = Observed(model.runs, subject.observed.noise)
        after = [_cost(model, observed, rival) for rival in rivals]
        gained = np.subtract(after, before) - (after[a] - before[a])
        separations[a] = np.sqrt(np.maximum(gained, 0.0))
    return separations


def _cost(model: CampaignModel, observed: Observed, rival: Rival) -> float:
    """Return the cost of a rival that is refitted to all runs."""
    fit = refit(model.predict, observed, rival.unknowns, starts=[rival.values], tangents=model.tangents)
    residual = stack(fit.residuals, observed)
    return float(residual @ residual)
