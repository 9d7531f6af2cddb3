"""Measurements as a diagnosis sees them: whitened, without what nuisances take; and projections of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from fmuid.core.immutable import FloatArray
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.data.noise.runs import RepeatedRuns, cut
from fmuid.data.noise.spectrum import PiecewiseWhitener, SetupNoise, Whitener, bandwidth, estimate_noise, whitener


def orthonormal(columns: FloatArray, dependent: float = 1e-6) -> FloatArray:
    """Return an orthonormal basis, (M, K), of (M, P) columns.

    Columns of zeros, and directions of unit columns whose singular value is below `dependent` times the largest,
    are left out.
    """
    norms = np.linalg.norm(columns, axis=0)
    kept = columns[:, norms > 0.0] / norms[norms > 0.0]
    if not kept.shape[1]:
        return np.asarray(kept)
    u, s, _ = np.linalg.svd(kept, full_matrices=False)
    return np.asarray(u[:, s > dependent * s[0]])


def project_off(vectors: FloatArray, basis: FloatArray) -> FloatArray:
    """Return a vector (M,), or columns (M, D), less their part in the span of an orthonormal (M, K) `basis`."""
    return np.asarray(vectors - basis @ (basis.T @ vectors))


_FEW = 4  # experiments: with fewer, too little remains when one is left out
_PIECES = 6  # number of pieces that a run without repeats is then cut into
_SHORTEST = 64  # samples in the shortest piece
_EXCEEDED = 0.05  # probability that noise exceeds the bound that a model's errors show
_MOST_TAKEN = 0.5  # largest share of the components in the bandwidth that nuisances may take


@dataclass(frozen=True, eq=False)
class Observed:
    """Runs with their noise floor.

    Attributes
    ----------
    runs
        One entry per experiment.
    noise
        Noise by setup.
    predicted
        (C, N) predictions per experiment; what a prediction contains and the measurements lack also belongs to the
        signals' bandwidth. Empty if none is known yet.
    nuisances
        (M, K) orthonormal bases, one per experiment, of the effect of its own unknowns, such as the initial states
        of segments, on its whitened residual. They are projected off all residuals and cost as many degrees of
        freedom. Empty if there are none.
    """

    runs: tuple[RepeatedRuns, ...]
    noise: Mapping[str, SetupNoise]
    predicted: tuple[FloatArray, ...] = ()
    nuisances: tuple[FloatArray, ...] = ()

    @classmethod
    def from_runs(cls, runs: Sequence[RepeatedRuns]) -> Observed:
        """Estimate each setup's noise, from repeats where available.

        If there is a single experiment, or only a few runs without repeats, they are cut into pieces for
        cross-validation.
        """
        setups = dict.fromkeys(run.setup for run in runs)
        noise = {s: estimate_noise([r for r in runs if r.setup == s]) for s in setups}
        pieces = min(_PIECES, *(len(r.time) // _SHORTEST for r in runs))
        few = len(runs) == 1 or (len(runs) < _FEW and all(r.n_repeats == 1 for r in runs))
        if few and pieces > 1:
            noise = {s: replace(n, pieces=pieces) for s, n in noise.items()}
        return cls(tuple(runs), noise)

    @property
    def bounded(self) -> bool:
        """Whether a noise level is only a bound, for lack of repeats; it does not cover slow noise."""
        return any(n.bounded for n in self.noise.values())

    def select(self, ids: Sequence[str]) -> Observed:
        """Return the same noise with only the experiments `ids`."""
        kept = [k for k, r in enumerate(self.runs) if r.id in ids]
        return Observed(
            tuple(self.runs[k] for k in kept),
            self.noise,
            tuple(self.predicted[k] for k in kept if self.predicted),
            tuple(self.nuisances[k] for k in kept if self.nuisances),
        )

    def beside_errors(self, predictions: Sequence[FloatArray]) -> Observed:
        """Return the measurements with the errors of `predictions` added to their noise, in the same floors.

        The mean of a run does not count among the errors: sensors shift from run to run. The measurements are
        the same if the noise of each signal is larger than the errors.
        """
        changed = {}
        for setup, plain, of_setup in self._errors(predictions):
            counts = np.sum([r.mask.sum(axis=1) for _, r in of_setup], axis=0)
            error = np.zeros(len(plain.channels))
            for left, run in of_setup:
                beyond = _squares(left, run.mask, _mean(left, run.mask))
                beyond -= run.mask.sum(axis=1) * plain.of_mean(run.n_repeats) ** 2
                error += run.n_repeats * beyond / np.maximum(counts, 1.0)
            if np.any(error > plain.variance):
                changed[setup] = plain.beside(np.maximum(error, 0.0))
        return Observed(self.runs, {**self.noise, **changed}, self.predicted) if changed else self

    def bounded_by(self, predictions: Sequence[FloatArray], parameters: int) -> Observed:
        """Return the measurements with the tighter bounds of their noise that a model's errors show.

        Until a model is known, a sample of a run without repeats may be off by what its fast changes show, and the
        whole run be shifted by as much. A model's errors contain the noise and scatter by at least as much: those
        of samples around the mean of their run, less `parameters` that were fitted, and those means from run to
        run. What all runs have in common is no shift. Noise exceeds either bound once in twenty times. Errors of a
        quarter of the noise may be numerical.
        """
        changed, fitted = {}, parameters + sum(basis.shape[1] for basis in self.nuisances)
        for setup, plain, of_setup in self._errors(predictions):
            if not plain.bounded:
                continue
            known = np.isfinite(of_setup[0][1].given)
            means = np.array([_mean(left, run.mask) for left, run in of_setup])
            around = np.sum(
                [_squares(left, run.mask, m) for (left, run), m in zip(of_setup, means, strict=True)], axis=0
            )
            samples = np.sum([run.mask.sum(axis=1) for _, run in of_setup], axis=0)
            level = np.where(known, np.inf, _at_most(around, samples - len(means) - fitted))
            level = np.maximum(level, GAP_THAT_MATTERS**2 * plain.variance)
            shift = _at_most(np.sum((means - means.mean(axis=0)) ** 2, axis=0), len(means) - 1.0)
            if np.any(level < plain.variance) or np.any(shift < plain.mean_variance):
                changed[setup] = plain.at_most(level, shift)
        return replace(self, noise={**self.noise, **changed}) if changed else self

    def _errors(
        self, predictions: Sequence[FloatArray]
    ) -> Iterator[tuple[str, SetupNoise, list[tuple[FloatArray, RepeatedRuns]]]]:
        """Yield each setup with its noise, and the errors (C, N) of predictions of its runs."""
        for setup, plain in self.noise.items():
            of_setup = [(p, r) for p, r in zip(predictions, self.runs, strict=True) if r.setup == setup]
            yield setup, plain, [(p - r.mean, r) for p, r in of_setup]

    @cached_property
    def whiteners(self) -> tuple[Whitener | PiecewiseWhitener, ...]:
        """Whitener of each experiment's residual."""
        return tuple(_whitener(r, self.noise[r.setup]) for r in self.runs)

    @cached_property
    def folds(self) -> tuple[tuple[int, NDArray[np.intp] | slice], ...]:
        """Cross-validation folds: experiment, and components of its whitened residual.

        A fold is a whole experiment, or a piece of one that was cut.
        """
        return tuple(
            (e, fold)
            for e, w in enumerate(self.whiteners)
            for fold in (w.folds if isinstance(w, PiecewiseWhitener) else (slice(None),))
        )

    @cached_property
    def fold_times(self) -> tuple[tuple[int, int], ...]:
        """The samples of each fold: begin and end."""
        return tuple(
            (a, b)
            for run, w in zip(self.runs, self.whiteners, strict=True)
            for a, b in (
                [(a, b) for a, b, _ in w.pieces] if isinstance(w, PiecewiseWhitener) else [(0, len(run.time))]
            )
        )

    @cached_property
    def groups(self) -> tuple[int, ...]:
        """(F,) group of each fold: runs with the same input and conditions are left out together."""
        first: dict[object, int] = {}
        pieces = [isinstance(self.whiteners[e], PiecewiseWhitener) for e, _ in self.folds]
        return tuple(
            f if cut or not self.runs[e].conditions else first.setdefault(self.runs[e].conditions, f)
            for f, ((e, _), cut) in enumerate(zip(self.folds, pieces, strict=True))
        )

    @cached_property
    def in_band(self) -> tuple[NDArray[np.bool_], ...]:
        """Which components of each experiment's whitened residual lie in the bandwidth of their signal.

        Gaps are means over these components, so they do not depend on the sampling rate of a signal. Where
        nuisances take more than half of them, all components count.
        """
        predicted = self.predicted or (None,) * len(self.runs)
        limits = [
            bandwidth(r, self.noise[r.setup], r.mean, *([] if y is None else [y]))
            for r, y in zip(self.runs, predicted, strict=True)
        ]
        bands = [
            np.ravel(w.frequencies[None, :] <= limit[:, None])
            for w, limit in zip(self.whiteners, limits, strict=True)
        ]
        return tuple(
            band if taken[band].sum() <= _MOST_TAKEN * band.sum() else np.ones_like(band)
            for band, taken in zip(bands, self.taken, strict=True)
        )

    @cached_property
    def taken(self) -> tuple[FloatArray, ...]:
        """(M,) share of each component of an experiment's whitened residual that nuisances take."""
        if not self.nuisances:
            return tuple(np.zeros(w.size) for w in self.whiteners)
        return tuple(np.asarray(np.sum(basis**2, axis=1)) for basis in self.nuisances)

    @cached_property
    def repeats(self) -> FloatArray:
        """(E,) number of runs of each experiment."""
        return np.array([float(r.n_repeats) for r in self.runs])

    @cached_property
    def scatter(self) -> tuple[FloatArray, ...]:
        """(R, M) whitened deviations of each experiment's repeats from their mean."""
        whitened_runs = zip(self.runs, self.whiteners, strict=True)
        return tuple(w(run.deviations).reshape(run.n_repeats, -1) for run, w in whitened_runs)

    def residuals(self, predictions: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Return prediction minus the mean of the repeats, whitened: one (C * N,) vector per experiment."""
        return self.whiten([p - r.mean for p, r in zip(predictions, self.runs, strict=True)])

    def residual(self, experiment: int, prediction: FloatArray) -> FloatArray:
        """Return the whitened residual of one experiment, by its number: (C * N,)."""
        part = self.whiteners[experiment](prediction - self.runs[experiment].mean).ravel()
        return part if not self.nuisances else project_off(part, self.nuisances[experiment])

    def whiten(self, differences: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Whiten differences of predictions: (C, N) to (C * N,), one per experiment, nuisances projected off."""
        parts = tuple(w(d).ravel() for d, w in zip(differences, self.whiteners, strict=True))
        if not self.nuisances:
            return parts
        return tuple(project_off(part, q) for part, q in zip(parts, self.nuisances, strict=True))


def _mean(values: FloatArray, mask: FloatArray) -> FloatArray:
    """Return the (C,) means of (C, N) values over the samples that there are."""
    return np.asarray(np.sum(values * mask, axis=1) / np.maximum(mask.sum(axis=1), 1.0))


def _squares(values: FloatArray, mask: FloatArray, mean: FloatArray) -> FloatArray:
    """Return the (C,) sums of squares of (C, N) values around their mean."""
    return np.asarray(np.sum(((values - mean[:, None]) * mask) ** 2, axis=1))


def _at_most(squares: FloatArray, degrees_of_freedom: FloatArray | float) -> FloatArray:
    """Return the variance that one with this sum of squares exceeds once in twenty times."""
    there = np.asarray(degrees_of_freedom) > 0.0
    least = chdtri(np.where(there, degrees_of_freedom, 1.0), 1.0 - _EXCEEDED)
    return np.where(there, squares / least, np.inf)


def _whitener(run: RepeatedRuns, noise: SetupNoise) -> Whitener | PiecewiseWhitener:
    if noise.pieces == 1:
        return whitener(run, noise)
    return PiecewiseWhitener(tuple((a, b, whitener(part, noise)) for a, b, part in cut(run, noise.pieces)))


def gap(residuals: Sequence[FloatArray], observed: Observed) -> float:
    """Return the gap in floors: G = sqrt(max(0, mean whitened residual^2 - 1)), for one run on average.

    The mean is over components in the signals' bandwidth. The mean of R runs carries 1/R of a run's noise, which
    is the part that noise alone would leave in it.
    """
    return float(np.sqrt(max(0.0, excess(residuals, observed))))


def excess(residuals: Sequence[FloatArray], observed: Observed) -> float:
    """Return G^2 before it is clipped at zero."""
    beyond, count = excesses(residuals, observed)
    return float(np.average(beyond, weights=count))


def excesses(residuals: Sequence[FloatArray], observed: Observed) -> tuple[FloatArray, FloatArray]:
    """Return (E,) G^2 of every experiment before it is clipped, and the number of components averaged."""
    count = np.array(
        [band.sum() - t[band].sum() for band, t in zip(observed.in_band, observed.taken, strict=True)]
    )
    energy = np.array([float(r[band] @ r[band]) for r, band in zip(residuals, observed.in_band, strict=True)])
    return energy / count - 1.0 / observed.repeats, count


def squares_finite(parts: Iterable[FloatArray]) -> bool:
    """Return whether squares of residuals are numbers: those of a model that grows without limit are not."""
    with np.errstate(over="ignore"):
        return all(bool(np.isfinite(part @ part)) for part in parts)
