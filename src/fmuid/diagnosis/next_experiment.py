"""Which run to make next: the one whose predictions tell apart what is still open by the most noise sigmas.

The library of safe experiments is made of the campaign's own: their inputs scaled down, up and turned round, and
never beyond what the campaign has already driven the rig to by more than half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.result import NextExperiment
from fmuid.diagnosis.scores import project_off
from fmuid.diagnosis.setting_up import Subject
from fmuid.errors import SimulationError

_SCALES = (-1.0, 0.25, 0.5, 1.25, 1.5)


def suggest(subject: Subject, alike: Sequence[Fitted]) -> NextExperiment | None:
    """Return the variation of an experiment that separates the first two of `alike` best; None if none does.

    It is taken to be repeated as often as the experiment that it varies.
    """
    if len(alike) < 2:
        return None
    a, b = alike[0], alike[1]
    best: NextExperiment | None = None
    for scale in _SCALES:
        cases = tuple(
            replace(c, task=replace(c.task, inputs={n: scale * u for n, u in c.task.inputs.items()}))
            for c in subject.model.cases
        )
        model = replace(subject.model, cases=cases)
        # What refitting a's nominal parameters could imitate is no separation.
        steps = [{**a.fit.values, u.name: a.fit.values[u.name] + u.step} for u in subject.nominal]
        outcomes = model.predict([a.fit.values, b.fit.values, *steps])
        if any(isinstance(o, SimulationError) for o in outcomes):
            continue
        good = [o for o in outcomes if not isinstance(o, SimulationError)]
        whitened = [subject.observed.whiten(o) for o in good]
        for k, case in enumerate(cases):
            base, other = whitened[0][k], whitened[1][k]
            moves = np.stack([w[k] - base for w in whitened[2:]], axis=1)
            norms = np.linalg.norm(moves, axis=0)
            difference = other - base
            if (norms > 0).any():
                q, _ = np.linalg.qr(moves[:, norms > 0] / norms[norms > 0])
                difference = project_off(difference, q)
            sigma = float(np.sqrt(subject.observed.repeats[k]) * np.linalg.norm(difference))
            if best is None or sigma > best.separation_sigma:
                best = NextExperiment(
                    case.setup, f"as {case.id}, with its input times {scale:g}", sigma, (a.id, b.id)
                )
    return best if best is not None and best.separation_sigma > 1.0 else None
