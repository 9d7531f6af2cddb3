"""A noise floor without repeats: what the most flexible admissible model leaves of the measurements.

The nominal parameters and as many effects of the catalogue as are worth anything are fitted together; the spectrum
of what remains, band by band and between channels, stands for the noise. It contains whatever no effect explains,
so that a gap is then one that *some* admissible model closes. It is no measurement of noise: results say
"uncalibrated", and `Observed.modelled_noise` widens what is concluded from it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmuid.campaign import FloatArray
from fmuid.diagnosis.catalogue import Effect
from fmuid.diagnosis.model import CampaignModel
from fmuid.diagnosis.noise import RepeatedRuns, noise_of_residuals
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Refit, Unknown, refit
from fmuid.diagnosis.scores import score_effects
from fmuid.errors import SimulationError

_PASSES = 2  # nominal refits, each weighted by what the one before left
_MOST = 8  # effects together
_WORTH = 2e-3  # share of the cost that a further effect must promise


def observe(model: CampaignModel, nominal: Sequence[Unknown], effects: Sequence[Effect]) -> Observed:
    """Return the measurements with their noise floor: from repeats where there are some, else from residuals.

    Raises
    ------
    SimulationError
        The nominal model cannot be simulated at its start values.
    """
    runs = model.runs
    single = {r.setup for r in runs} - {r.setup for r in runs if r.n_repeats > 1}
    if not single:
        return Observed.from_runs(runs)
    (begin,) = model.predict([{u.name: u.start for u in nominal}])
    if isinstance(begin, SimulationError):
        raise begin
    # First by the size of what is left, for a model that does not fit yet has no noise spectrum to speak of.
    observed = _observed(runs, begin, None, single)
    fit: Refit | None = None
    for _ in range(_PASSES):
        fit = refit(model.predict, observed, nominal, start=None if fit is None else fit.values)
        observed = _reweighted(model, runs, fit, single, spectrum=False)
    assert fit is not None
    flexible = _flexible(model, observed, fit, effects)
    observed = _reweighted(model, runs, flexible, single, spectrum=True)
    flexible = refit(model.predict, observed, flexible.unknowns, start=flexible.values, max_iterations=4)
    return _reweighted(model, runs, flexible, single, spectrum=True)


def _flexible(model: CampaignModel, observed: Observed, fit: Refit, effects: Sequence[Effect]) -> Refit:
    """Add effects to `fit`, the one that promises most first, as long as one promises anything."""
    by_id = {e.id: e for e in effects}
    fit = refit(model.predict, observed, fit.unknowns, start=fit.values, max_iterations=3)
    chosen: list[str] = []
    refused: set[str] = set()
    while len(chosen) < _MOST:
        left = [e for e in effects if e.id not in chosen and e.id not in refused]
        scores = score_effects(model.predict, observed, fit, left) if left else ()
        if not scores or scores[0].drop < _WORTH * fit.cost:
            break
        effect = by_id[scores[0].effect]
        factor = float(np.clip(scores[0].scale, -3.0 if effect.two_sided else 0.03, 3.0))
        start = {**fit.values, **effect.scaled(scores[0].trial, factor)}
        try:
            more = refit(
                model.predict,
                observed,
                (*fit.unknowns, *effect.unknowns),
                start=start,
                known=fit,
                max_iterations=4,
            )
        except SimulationError:
            more = fit
        if more.cost < fit.cost:
            chosen.append(effect.id)
            fit = more
        else:
            refused.add(effect.id)
    return refit(model.predict, observed, fit.unknowns, start=fit.values, max_iterations=4)


def _reweighted(
    model: CampaignModel, runs: Sequence[RepeatedRuns], fit: Refit, single: set[str], *, spectrum: bool
) -> Observed:
    (prediction,) = model.predict([fit.values])
    if isinstance(prediction, SimulationError):
        raise prediction
    return _observed(runs, prediction, fit if spectrum else None, single)


def _observed(
    runs: Sequence[RepeatedRuns], prediction: Sequence[FloatArray], fit: Refit | None, single: set[str]
) -> Observed:
    """Noise of unrepeated setups from residuals: its spectrum, if they are those of `fit`; else white."""
    repeated = [r for r in runs if r.setup not in single]
    noise = dict(Observed.from_runs(repeated).noise) if repeated else {}
    leverage = None if fit is None else _leverage(runs, fit)
    for setup in single:
        own = [k for k, r in enumerate(runs) if r.setup == setup]
        noise[setup] = noise_of_residuals(
            [runs[k] for k in own],
            [prediction[k] - runs[k].mean for k in own],
            None if leverage is None else [leverage[k] for k in own],
        )
    return Observed(tuple(runs), noise, modelled_noise=True)


def _leverage(runs: Sequence[RepeatedRuns], fit: Refit) -> list[FloatArray]:
    """(C, N) an experiment: the share of each whitened coefficient that the fit's parameters can take up."""
    shapes = [r.mask.shape for r in runs]
    jacobian = np.concatenate([np.sqrt(r.n_repeats) * j for r, j in zip(runs, fit.jacobian, strict=True)])
    norms = np.linalg.norm(jacobian, axis=0)
    u, s, _ = np.linalg.svd(jacobian[:, norms > 0] / norms[norms > 0], full_matrices=False)
    taken = np.sum(u[:, s > 1e-6 * s[0]] ** 2, axis=1)
    ends = np.cumsum([r.mask.size for r in runs])[:-1]
    return [part.reshape(shape) for part, shape in zip(np.split(taken, ends), shapes, strict=True)]
