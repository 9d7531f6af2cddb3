"""What noise alone would do: null distributions drawn from the runs' own differences.

The R runs of an experiment have R - 1 independent differences, each a draw of the error of one run. Random
mixtures of them, scaled to the mean of R runs, are residuals of a complete model: their energy and their largest
score, after the nominal parameters are refitted, show when a gap is more than noise. Unlike white noise, they
contain variations from run to run that affect many signals at once. Rounding errors that all runs share are added:
those of the signals that the model predicts, since it is complete.

Mixtures of whole runs have one multiplier for each difference. With two or three runs, their energy varies far
more than that of noise: a single multiplier may be near 0 or 3. Energies are therefore drawn with a multiplier for
every few frequencies (a wild bootstrap). What varies from run to run as a whole shows in how much the energies of
the differences vary (`_coherence`); that share of a drawn energy has one multiplier more. Where this gives a wider
distribution than mixtures of whole runs, as with two runs of one experiment, those are used.
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
_BLOCK = 8  # neighbouring frequencies with one multiplier: drift and smooth changes join a few of them


@dataclass(frozen=True, slots=True, eq=False)
class Null:
    """Draws under a complete model: excess energy of the residual, and the largest drop of any score.

    The excess is that of so many `experiments` together.
    """

    excess: FloatArray
    largest_drop: FloatArray
    experiments: int = 1

    @property
    def of_experiment(self) -> FloatArray:
        """Draws of the excess energy of a single experiment."""
        return np.asarray(np.sqrt(self.experiments) * self.excess)

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

    They are mixtures of whole runs, of so many `experiments`. `weight` is (M,): 1 / (number of repeats) within the
    signals' bandwidth, 0 beyond it. `free` is (M,): the share of each component that nuisances leave.
    `energy` is (D,), the weighted one of draws that mix a few frequencies at a time.
    """

    noise: FloatArray
    weight: FloatArray
    free: FloatArray
    energy: FloatArray
    experiments: int

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
        less = np.sum(taken * (basis.T @ weighted @ taken - 2.0 * (weighted.T @ self.noise)), axis=0)
        excess = (self.energy + less - self.weight @ self.free) / self.free[self.weight > 0.0].sum()
        largest = np.zeros(len(less))
        for i in range(0, len(signatures), _TOGETHER):
            own = np.array(signatures[i : i + _TOGETHER])
            scores = own @ self.noise - (own @ basis) @ taken
            largest = np.maximum(largest, (scores**2).max(axis=0))
        return Null(read_only(excess), read_only(largest), self.experiments)


def draw_noise(
    observed: Observed, predicted: Prediction | None = None, *, draws: int = 400, seed: int = 0
) -> NoiseDraws:
    """Draw residuals of a complete model, whose signals are `predicted`, before any refit."""
    rng = np.random.default_rng(seed)
    noise = np.empty((sum(w.size for w in observed.whiteners), draws))
    energy, of_runs = np.zeros(draws), np.zeros(draws)
    weights = [band / n for band, n in zip(observed.in_band, observed.repeats, strict=True)]
    contrasts = [_contrasts(r.deviations, w) for r, w in zip(observed.runs, observed.whiteners, strict=True)]
    coherent = _coherence([c[:, w > 0.0] for c, w in zip(contrasts, weights, strict=True) if len(c)])
    begin = 0
    for e, (run, w, c) in enumerate(zip(observed.runs, observed.whiteners, contrasts, strict=True)):
        own = noise[begin : begin + w.size]
        if len(c):
            own[:] = c.T @ (rng.standard_normal((len(c), draws)) / np.sqrt(len(c)))
            mixed = _by_blocks(c, len(run.channels), draws, rng)
        else:
            own[:] = rng.standard_normal((w.size, draws))
            mixed = own.copy()
        if np.any(observed.noise[run.setup].repeating):  # absent from every contrast
            course = None if predicted is None else predicted[e]
            shared = rounding_draws(
                run, observed.noise[run.setup], course=course, draws=draws, seed=seed + e * len(run.channels)
            )
            both = np.sqrt(len(run.values)) * w(shared).reshape(draws, -1).T
            if not len(c):  # of unit variance with the rounding
                white = np.sqrt(np.maximum(1.0 - np.mean(both**2, axis=1, keepdims=True), 0.0))
                own *= white
                mixed *= white
            own += both
            mixed += both
        if observed.nuisances:
            own[:], mixed = (project_off(x, observed.nuisances[e]) for x in (own, mixed))
        of_runs += _energy(weights[e], own)
        # The noise level is of the same differences: a factor that was small in all of them makes it too low.
        factor = rng.f(1.0, sum(map(len, contrasts)), draws) if len(c) else 1.0
        energy += (1.0 + coherent * (factor - 1.0)) * _energy(weights[e], mixed)
        begin += w.size
    if energy.std() > of_runs.std():  # both are upper bounds of what noise does
        energy = of_runs
    weight, free = np.concatenate(weights), 1.0 - np.concatenate(observed.taken)
    noise, weight, free, energy = map(read_only, (noise, weight, free, energy))
    return NoiseDraws(noise, weight, free, energy, len(observed.runs))


def _energy(weight: FloatArray, noise: FloatArray) -> FloatArray:
    """Return (D,) weighted sums of squares of (M, D) draws, without a copy of them: they may be large."""
    return np.asarray(np.einsum("m,md,md->d", weight, noise, noise))


def _by_blocks(contrasts: FloatArray, channels: int, draws: int, rng: np.random.Generator) -> FloatArray:
    """Return (M, draws) mixtures of (R - 1, M) contrasts, each with a multiplier for every few frequencies.

    The multipliers of the C channels are the same: what varies in several signals at once varies in the mixtures.
    """
    found = np.zeros((contrasts.shape[1], draws))
    n = contrasts.shape[1] // channels
    for c in contrasts:
        each = rng.standard_normal((-(-n // _BLOCK), draws)) / np.sqrt(len(contrasts))
        found += c[:, None] * np.tile(np.repeat(each, _BLOCK, axis=0)[:n], (channels, 1))
    return found


def _coherence(contrasts: Sequence[FloatArray]) -> float:
    """Return the share of the noise, between 0 and 1, that varies from run to run as a whole.

    If a share s of its energy is due to one random factor, noise has contrasts whose energies have a variance of
    2 s^2, relative to their mean: within experiments where there are three or more runs, else from one experiment
    to another.
    """
    energies = [np.mean(c**2, axis=1) for c in contrasts]
    within = [e for e in energies if len(e) > 1]
    groups = within or ([np.concatenate(energies)] if energies else [])
    freedom = sum(len(e) - 1 for e in groups)
    if freedom < 1:
        return 1.0
    seen = sum(float(np.sum((e / e.mean() - 1.0) ** 2)) for e in groups) / freedom
    return min(1.0, float(np.sqrt(0.5 * seen)))


def _contrasts(deviation: FloatArray, whiten: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the (R - 1, M) orthonormal contrasts of R whitened runs: each distributed as the noise of one run."""
    r = len(deviation)
    if r < 2:
        return np.zeros((0, 0))
    rows = whiten(deviation).reshape(r, -1)
    centred = np.eye(r) - 1.0 / r
    u, s, _ = np.linalg.svd(centred)
    return np.asarray(u[:, s > 0.5].T @ rows)
