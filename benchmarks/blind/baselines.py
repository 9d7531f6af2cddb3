"""What simpler methods would answer, for the blind check: three baselines on the refits of a diagnosis.

They choose among the same models and the same noise floor, so what they get wrong is their rule's doing. Only the
best-scored effects were refitted, which flatters them: the others cannot be named by mistake.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.diagnose import Found
from fmuid.diagnosis.null_distribution import draw_noise
from fmuid.diagnosis.scores import stack

BASELINES = {
    "white_noise_bic": "white-noise BIC",
    "hold_out_rmse": "hold-out RMSE",
    "score_without_projection": "score without projection",
}


def baseline_answers(found: Found) -> Mapping[str, tuple[str, ...]]:
    """Return the effects that each of `BASELINES` names, none if it calls the model complete.

    - white-noise BIC (Schwarz 1978): least n log(RSS / n) summed over signals, plus P log n, samples of every run
      taken as independent;
    - hold-out RMSE: least error on experiments left out, in noise units, with no margin;
    - score without projection: largest fall of the cost along one effect's own signature, nominal parameters held
      where they were refitted; above what noise reaches in 1 % of draws.
    """
    models = [found.nominal, *found.candidates]
    bic = _white_noise_bic(found, models)
    held_out = [m.held_out.mean for m in models]
    return {
        "white_noise_bic": models[int(np.argmin(bic))].names,
        "hold_out_rmse": models[int(np.argmin(held_out))].names,
        "score_without_projection": _unprojected(found),
    }


def _white_noise_bic(found: Found, models: Sequence[Fitted]) -> FloatArray:
    observed = found.subject.observed
    signals = [(run.setup, c) for run in observed.runs for c in run.channels]
    values = np.full(len(models), np.inf)
    for k, (model, outcome) in enumerate(
        zip(models, found.subject.model.predict([m.fit.values for m in models]), strict=True)
    ):
        if isinstance(outcome, SimulationError):
            continue
        rss, count = dict.fromkeys(signals, 0.0), dict.fromkeys(signals, 0)
        for run, prediction in zip(observed.runs, outcome, strict=True):
            for c, name in enumerate(run.channels):
                error = prediction[c] - run.values[:, c]
                rss[run.setup, name] += float(np.nansum(error**2))
                count[run.setup, name] += int(np.isfinite(error).sum())
        deviance = sum(n * np.log(rss[s] / n) for s, n in count.items())
        values[k] = deviance + len(model.fit.unknowns) * np.log(sum(count.values()))
    return values


def _unprojected(found: Found) -> tuple[str, ...]:
    observed, nominal = found.subject.observed, found.nominal.fit
    effects = {e.id: e for e in found.subject.effects}
    scores = [s for s in found.scores if s.signature is not None]
    points = [{**effects[s.effect].neutral, **nominal.values, **s.trial} for s in scores]
    residual = stack(nominal.residuals, observed)
    drops, signatures = {}, []
    for score, outcome in zip(scores, found.subject.model.predict(points), strict=True):
        if isinstance(outcome, SimulationError):
            continue
        moved = stack(observed.residuals(outcome), observed) - residual
        signature = moved / max(float(np.linalg.norm(moved)), 1e-300)
        amount = -float(signature @ residual)
        drops[score.effect] = amount**2 if amount > 0.0 or effects[score.effect].two_sided else 0.0
        signatures.append(signature)
    if not drops:
        return ()
    threshold = draw_noise(observed).null(np.zeros((residual.size, 0)), signatures).threshold()
    best = max(drops, key=lambda name: drops[name])
    return (best,) if drops[best] > threshold else ()
