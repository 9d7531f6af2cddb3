"""Standard errors of a refit, whatever the colour of its residuals.

The refit minimises residuals e of the mean runs whitened by W, so the error of its estimate is ``(J'W'WJ)^-1 J'W'W
e``. Whitening knows the noise only from the differences of a few repeats, in bands of frequency and as if a run
were periodic. So the covariance of ``J'W'W e`` is taken from the residuals over time, as in an identification
(`fmuid.identification.uncertainty.coloured_residuals`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.data.noise.spectrum import PiecewiseWhitener, Whitener
from fmuid.data.noise.transform import from_real_spectrum
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import stack
from fmuid.identification.uncertainty.coloured_residuals import Record, coloured_covariance

_DETERMINED = 1e-6  # smallest singular value of unit columns, relative to the largest


def standard_errors(fit: Refit, observed: Observed, prediction: Sequence[FloatArray]) -> FloatArray:
    """Return the (P,) standard errors of a refit, all NaN if the data do not determine its parameters.

    They are not below those of the noise floor. A parameter that moves nothing has none either.

    Parameters
    ----------
    fit
        The refit, with its Jacobian of whitened residuals.
    observed
        The measurements that it was fitted to.
    prediction
        (C, N) per experiment, at the estimate.
    """
    steps = np.array([u.step for u in fit.unknowns])
    whitened = stack(fit.jacobian, observed) * steps
    norms = np.linalg.norm(whitened, axis=0)
    seen = norms > 0.0
    errors: FloatArray = np.full(len(steps), np.nan)
    if not seen.any():
        return errors
    scale = steps[seen] / norms[seen]
    _, s, axes = np.linalg.svd(whitened[:, seen] / norms[seen], full_matrices=False)
    if s[-1] <= _DETERMINED * s[0]:
        return errors
    bread = (axes.T / s**2) @ axes
    records: dict[str, list[Record]] = {}
    for run, whiten, jacobian, y in zip(observed.runs, observed.whiteners, fit.jacobian, prediction, strict=True):
        columns = (jacobian[:, seen] * scale).T.reshape(int(seen.sum()), len(run.channels), -1)
        slopes = run.n_repeats * _transposed(whiten, columns)
        left = (y - run.mean) * run.mask
        records[run.id] = [
            Record(name, left[c], slopes[:, c].T.copy(), run.mask[c]) for c, name in enumerate(run.channels)
        ]
    meat, _ = coloured_covariance(records, int(seen.sum()))
    variance = np.maximum(np.diag(bread @ meat @ bread), np.diag(bread))
    errors[seen] = np.sqrt(variance) * scale
    return errors


def _transposed(whiten: Whitener | PiecewiseWhitener, whitened: FloatArray) -> FloatArray:
    """Return W'y, (..., C, N), for whitened y (..., C, K)."""
    if isinstance(whiten, PiecewiseWhitener):
        return np.concatenate([_transposed(w, whitened[..., a:b]) for a, b, w in whiten.pieces], axis=-1)
    spectrum = np.zeros((*whitened.shape[:-1], whiten.mask.shape[1]))
    spectrum[..., 0] = whitened[..., 0] * whiten.mean_scale
    for band, factor in zip(whiten.bands, whiten.factors, strict=True):
        spectrum[..., band] = factor.T @ whitened[..., band]
    return from_real_spectrum(spectrum) * whiten.mask
