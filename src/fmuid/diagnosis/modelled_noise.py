"""A noise floor without repeats: what the most flexible admissible model leaves of the measurements.

The nominal parameters and as many effects of the catalogue as are worth anything are fitted together; the spectrum
of what remains, band by band and between channels, stands for the noise. It contains whatever no effect explains,
so that a gap is then one that *some* admissible model closes. It is no measurement of noise: results say
"uncalibrated", and `Observed.modelled_noise` widens what is concluded from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.runs import RepeatedRuns, cut
from fmuid.data.noise.spectrum import PiecewiseWhitener, noise_of_residuals
from fmuid.diagnosis.catalogue import Effect
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Refit, Unknown, refit
from fmuid.diagnosis.scores import score_effects, stack

_PIECES = 6  # that a run without repeats is cut into: each is left out in turn
_SHORTEST = 64  # samples of a piece
_PASSES = 2  # nominal refits, each weighted by what the one before left
_MOST = 6  # effects together
_WORTH = 0.01  # share of the cost that a further effect must save


def observe(model: CampaignModel, nominal: Sequence[Unknown], effects: Sequence[Effect]) -> Observed:
    """Return the measurements with their noise floor: from repeats where there are some, else from residuals.

    Raises
    ------
    SimulationError
        The nominal model cannot be simulated at its start values.
    """
    runs = model.runs
    single = {r.setup for r in runs if np.isnan(r.given).any()} - {r.setup for r in runs if r.n_repeats > 1}
    if not single:
        return _in_pieces(Observed.from_runs(runs))
    (begin,) = model.predict([{u.name: u.start for u in nominal}])
    if isinstance(begin, SimulationError):
        raise begin
    # First by the size of what is left, for a model that does not fit yet has no noise spectrum to speak of.
    observed = _observed(runs, begin, None, single)
    fit: Refit | None = None
    for _ in range(_PASSES):
        fit = refit(model.predict, observed, nominal, starts=[{}] if fit is None else [{}, fit.values])
        observed = _reweighted(model, observed, fit, single, spectrum=False)
    assert fit is not None
    flexible = _flexible(model, observed, fit, effects)
    observed = _reweighted(model, observed, flexible, single, spectrum=True)
    flexible = refit(model.predict, observed, flexible.unknowns, starts=[flexible.values], max_iterations=3)
    return _reweighted(model, observed, flexible, single, spectrum=True)


def _in_pieces(observed: Observed) -> Observed:
    """Cut the only experiment, if there is but one run of it: something must be left out to be judged on."""
    run, *others = observed.runs
    pieces = len(run.time) // _SHORTEST
    if others or run.n_repeats > 1 or pieces < 2:
        return observed
    cut_up = {s: replace(n, pieces=min(_PIECES, pieces)) for s, n in observed.noise.items()}
    return replace(observed, noise=cut_up)


def _flexible(model: CampaignModel, observed: Observed, fit: Refit, effects: Sequence[Effect]) -> Refit:
    """Add effects to `fit`, the one that promises most first, as long as one promises anything."""
    by_id = {e.id: e for e in effects}
    fit = refit(model.predict, observed, fit.unknowns, starts=[fit.values], max_iterations=3)
    tried: set[str] = set()
    chosen = failures = 0
    while chosen < _MOST and failures < 2:
        left = [e for e in effects if e.id not in tried]
        scores = score_effects(model.predict, observed, fit, left) if left else ()
        if not scores or scores[0].drop < _WORTH * fit.cost:
            break
        effect = by_id[scores[0].effect]
        tried.add(effect.id)
        factor = float(np.clip(scores[0].scale, -3.0 if effect.two_sided else 0.03, 3.0))
        start = {**fit.values, **effect.scaled(scores[0].trial, factor)}
        unknowns = (*fit.unknowns, *effect.unknowns)
        try:
            more = refit(model.predict, observed, unknowns, starts=[start], max_iterations=4)
        except SimulationError:
            failures += 1
            continue
        if more.cost < (1.0 - _WORTH) * fit.cost:
            chosen, fit = chosen + 1, more
        else:
            failures += 1
    return refit(model.predict, observed, fit.unknowns, starts=[fit.values], max_iterations=3)


def _reweighted(
    model: CampaignModel, observed: Observed, fit: Refit, single: set[str], *, spectrum: bool
) -> Observed:
    """Noise from what `fit`, weighted as in `observed`, leaves: its spectrum, or white."""
    (prediction,) = model.predict([fit.values])
    if isinstance(prediction, SimulationError):
        raise prediction
    return _observed(observed.runs, prediction, _leverage(observed, fit) if spectrum else None, single)


def _observed(
    runs: Sequence[RepeatedRuns],
    prediction: Sequence[FloatArray],
    leverage: Sequence[FloatArray] | None,
    single: set[str],
) -> Observed:
    repeated = [r for r in runs if r.setup not in single]
    noise = dict(Observed.from_runs(repeated).noise) if repeated else {}
    for setup in single:
        own = [k for k, r in enumerate(runs) if r.setup == setup]
        pieces = max(1, min(_PIECES, *(len(runs[k].time) // _SHORTEST for k in own)))
        parts, residuals, taken = [], [], []
        for k in own:
            error = prediction[k] - runs[k].mean
            ends = []
            for a, b, part in cut(runs[k], pieces):
                parts.append(part)
                residuals.append(error[:, a:b])
                ends.append(b)
            taken += [] if leverage is None else np.split(leverage[k], ends[:-1], axis=1)
        noise[setup] = noise_of_residuals(parts, residuals, taken or None, pieces=pieces)
    return Observed(tuple(runs), noise, modelled_noise=True)


def _leverage(observed: Observed, fit: Refit) -> list[FloatArray]:
    """(C, N) an experiment: the share of each coefficient of each piece that the fit's parameters can take up."""
    jacobian = stack(fit.jacobian, observed)
    norms = np.linalg.norm(jacobian, axis=0)
    u, s, _ = np.linalg.svd(jacobian[:, norms > 0] / norms[norms > 0], full_matrices=False)
    taken = np.sum(u[:, s > 1e-6 * s[0]] ** 2, axis=1)
    shares = []
    for run, w in zip(observed.runs, observed.whiteners, strict=True):
        own = taken[: w.size].reshape(len(run.channels), -1)
        taken = taken[w.size :]
        share = np.zeros(run.mask.shape)  # above a cutoff nothing is taken
        begin = 0
        for a, _, piece in w.pieces if isinstance(w, PiecewiseWhitener) else ((0, 0, w),):
            count = len(piece.band_of)
            share[:, a : a + count] = own[:, begin : begin + count]
            begin += count
        shares.append(share)
    return shares
