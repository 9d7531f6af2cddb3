"""What noise alone would do: null distributions drawn from the runs' own differences.

The R runs of an experiment have R - 1 independent differences, each a draw of the error of one run. Random
mixtures of them, scaled to the mean of R runs, are residuals of a complete model: their energy and their largest
score, after the nominal parameters are refitted, show when a gap is more than noise. Unlike white noise, they
contain variations from run to run that affect many signals at once. Rounding errors that all runs share are added:
those of the signals that the model predicts, since it is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from fmuid.core.immutable import FloatArray, read_only
from fmuid.data.noise.spectrum import rounding_draws
from fmuid.diagnosis.extended_model import Prediction
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.projection import project_off

_TOGETHER = 32  # signatures whose scores are computed at once: the draws are read once, and memory stays bounded


@dataclass(frozen=True, slots=True, eq=False)
class Null:
    """Draws under a complete model: excess energy of the residual, and the largest drop of any score."""

    excess: FloatArray
    largest_drop: FloatArray

    def p_value(self, excess: float, drop: float = 0.0) -> float:
        """Return how likely noise alone leaves this excess energy, or a score as large as `drop`.

        For the excess, this is the share of draws with at least as much, continued by a fitted normal beyond the
        last draw. With a drop, it is twice the smaller of the two shares (Bonferroni).
        """
        energy = self._of_excess(excess)
        if drop <= 0.0:
            return energy
        reached = float(np.sum(self.largest_drop >= drop) + 1) / (len(self.largest_drop) + 1)
        return min(1.0, 2.0 * min(energy, reached))

    def _of_excess(self, excess: float) -> float:
        above = float(np.mean(self.excess >= excess))
        tail = float(ndtr((self.excess.mean() - excess) / max(self.excess.std(), 1e-12)))
        return max(above, tail) if above > 0 else min(tail, 1.0 / (len(self.excess) + 1))

    def threshold(self, quantile: float = 0.99) -> float:
        """Return the drop that noise alone exceeds in a share 1 - `quantile` of all diagnoses."""
        return float(np.quantile(self.largest_drop, quantile))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseDraws:
    """(M, D) draws of the residual that noise alone would leave, with all experiments concatenated.

    `weight` is (M,): 1 / (number of repeats) within the signals' bandwidth, 0 beyond it. `free` is (M,): the share
    of each component that nuisances leave. `energy` is (D,), the weighted one of each draw.
    """

    noise: FloatArray
    weight: FloatArray
    free: FloatArray
    energy: FloatArray

    def null(self, basis: FloatArray, signatures: Sequence[FloatArray]) -> Null:
        """Return the null distributions of a model whose refitted parameters span `basis`.

        Parameters
        ----------
        basis
            Orthonormal (M, P) basis of the refitted parameters, weighted by the root of the repeats.
        signatures
            Signatures of unit length, projected off that basis.
        """
        # What the basis leaves of the draws is as large as the draws: its sums follow from a few products.
        taken, weighted = basis.T @ self.noise, self.weight[:, None] * basis
        left = self.energy + np.sum(taken * (basis.T @ weighted @ taken - 2.0 * (weighted.T @ self.noise)), axis=0)
        excess = (left - self.weight @ self.free) / self.free[self.weight > 0.0].sum()
        largest = np.zeros(len(left))
        for i in range(0, len(signatures), _TOGETHER):
            own = np.array(signatures[i : i + _TOGETHER])
            scores = own @ self.noise - (own @ basis) @ taken
            largest = np.maximum(largest, (scores**2).max(axis=0))
        return Null(read_only(excess), read_only(largest))


def draw_noise(
    observed: Observed, predicted: Prediction | None = None, *, draws: int = 400, seed: int = 0
) -> NoiseDraws:
    """Draw residuals of a complete model, whose signals are `predicted`, before any refit."""
    rng = np.random.default_rng(seed)
    noise = np.empty((sum(w.size for w in observed.whiteners), draws))
    begin = 0
    for e, (run, w) in enumerate(zip(observed.runs, observed.whiteners, strict=True)):
        c = _contrasts(run.deviations, w)
        if len(c):
            mix = rng.standard_normal((draws, len(c))) / np.sqrt(len(c))
            noise[begin : begin + w.size] = (mix @ c).T
            if np.any(observed.noise[run.setup].repeating):  # absent from every contrast
                course = None if predicted is None else predicted[e]
                shared = rounding_draws(
                    run, observed.noise[run.setup], course=course, draws=draws, seed=seed + e * len(run.channels)
                )
                noise[begin : begin + w.size] += np.sqrt(len(run.values)) * w(shared).reshape(draws, -1).T
        else:
            noise[begin : begin + w.size] = rng.standard_normal((w.size, draws))
        if observed.nuisances:
            noise[begin : begin + w.size] = project_off(noise[begin : begin + w.size], observed.nuisances[e])
        begin += w.size
    weight = np.concatenate([band / n for band, n in zip(observed.in_band, observed.repeats, strict=True)])
    free = 1.0 - np.concatenate(observed.taken)
    energy = np.concatenate([weight @ noise[:, i : i + _TOGETHER] ** 2 for i in range(0, draws, _TOGETHER)])
    return NoiseDraws(*map(read_only, (noise, weight, free, energy)))


def _contrasts(deviation: FloatArray, whiten: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the (R - 1, M) orthonormal contrasts of R whitened runs: each distributed as the noise of one run."""
    r = len(deviation)
    if r < 2:
        return np.zeros((0, 0))
    rows = whiten(deviation).reshape(r, -1)
    centred = np.eye(r) - 1.0 / r
    u, s, _ = np.linalg.svd(centred)
    return np.asarray(u[:, s > 0.5].T @ rows)
