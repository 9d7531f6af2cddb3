"""The noise floor: the spectrum of differences between repeats, and whitening by it.

Repeats share their inputs, so they differ only by noise and run-to-run nuisance. The spectrum of these
differences, within and between channels, is pooled over the experiments of one setup in frequency bands; residuals
are then whitened by its inverse square root. The mean of a run (the DC bin) has a separate variance, because
sensors shift from run to run by more than the noise averaged over a run would allow.

Repeats do not show the rounding error of quantised signals, which repeats as well (`fmuid.data.noise.resolution`).
A standard deviation given by the user replaces the measured one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray, read_only
from fmuid.data.noise.resolution import quantum, repeating_variance, rounding_along, rounding_errors
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.data.noise.single_run import fast_variance, single_run_variance
from fmuid.data.noise.transform import coefficient_frequencies, real_spectrum

_BANDS_PER_OCTAVE = 1
_MIN_BIN_COUNT = 3
_FEWEST = 16  # narrowest bandwidth, in periods of the record
_TWICE = 2.0  # ratio of power to that of the noise at which signal and noise are equal


@dataclass(frozen=True, slots=True, eq=False)
class SetupNoise:
    """Noise of one setup.

    Runs are cut into `pieces` before they are whitened.

    Attributes
    ----------
    edges
        (B + 1,) edges of the frequency bands, Hz.
    covariance
        (B, C, C) covariance of the differences between runs.
    variance
        (C,) variance of one sample, over all bands.
    mean_variance
        (C,) variance of the mean of a run.
    step
        (C,) quantisation step, 0 for a signal that is not quantised.
    repeating
        (C,) variance of the rounding error that all repeats share.
    bounded
        Whether the noise is only a bound because there are no repeats; slow noise and drift may exceed it.
    """

    channels: tuple[str, ...]
    dt: float
    edges: FloatArray
    covariance: FloatArray
    variance: FloatArray
    mean_variance: FloatArray
    degrees_of_freedom: FloatArray
    step: FloatArray
    repeating: FloatArray
    calibrated: bool
    bounded: bool = False
    pieces: int = 1

    @property
    def sigma(self) -> Mapping[str, float]:
        """(C,) standard deviations of a sample's error around the mean of its run, in the channels' units."""
        total = np.sqrt(self.variance + self.repeating)
        return {c: float(v) for c, v in zip(self.channels, total, strict=True)}

    def of_mean(self, count: int) -> FloatArray:
        """Return (C,) standard deviations of the mean of `count` samples."""
        return np.asarray(np.sqrt(self.variance / count + self.repeating))

    def beside(self, error: FloatArray) -> SetupNoise:
        """Return the noise of a setup where a model has errors of its own, in the same floors.

        The spectrum becomes that of the noise plus white errors of (C,) variance `error`, scaled so that a sample
        keeps its noise floor. Where errors are far larger than the noise, every sample counts alike: the spectrum
        of the noise says nothing about them.
        """
        error = np.where(self.variance > 0.0, error, 0.0)
        scale = np.sqrt(self.variance / np.maximum(self.variance + error, np.finfo(float).tiny))
        return replace(
            self,
            covariance=scale[:, None] * (self.covariance + np.diag(error)) * scale,
            mean_variance=scale**2 * self.mean_variance,
        )

    def at_most(self, variance: FloatArray, mean_variance: FloatArray) -> SetupNoise:
        """Return the noise of a setup with (C,) bounds on the variance of a sample and of the mean of a run."""
        variance = np.minimum(self.variance, variance)
        scale = np.sqrt(variance / self.variance)
        return replace(
            self,
            covariance=scale[:, None] * self.covariance * scale,
            variance=variance,
            mean_variance=np.minimum(self.mean_variance, mean_variance),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Whitener:
    """Transforms a residual of one experiment into components of unit variance under the noise of a single run.

    Each factor, (C, C), applies to the components of its band.
    """

    mask: FloatArray
    factors: FloatArray
    bands: tuple[slice, ...]
    mean_scale: FloatArray
    frequencies: FloatArray

    @property
    def size(self) -> int:
        """Length of a whitened residual."""
        return self.mask.size

    def __call__(self, residual: FloatArray) -> FloatArray:
        """Whiten (..., C, N) residuals to (..., C, N); coefficient 0 of each channel is its mean."""
        spectrum = real_spectrum(residual * self.mask)
        out = np.empty_like(spectrum)
        out[..., 0] = spectrum[..., 0] * self.mean_scale
        for band, factor in zip(self.bands, self.factors, strict=True):
            out[..., band] = factor @ spectrum[..., band]
        return out


@dataclass(frozen=True, slots=True, eq=False)
class PiecewiseWhitener:
    """Whitens a run without repeats piece by piece.

    Parameters
    ----------
    pieces
        Begin, end and whitener of each piece.
    """

    pieces: tuple[tuple[int, int, Whitener], ...]

    @property
    def size(self) -> int:
        """Length of a whitened residual."""
        return sum(w.size for _, _, w in self.pieces)

    def __call__(self, residual: FloatArray) -> FloatArray:
        """Whiten (..., C, N) residuals to (..., C, N), with the pieces concatenated."""
        return np.concatenate([w(residual[..., a:b]) for a, b, w in self.pieces], axis=-1)

    @property
    def mask(self) -> FloatArray:
        """(C, N) array of 1 where there is a sample, else 0."""
        return np.concatenate([w.mask for _, _, w in self.pieces], axis=-1)

    @property
    def frequencies(self) -> FloatArray:
        """(N,) frequencies of the components of a whitened residual, Hz."""
        return np.concatenate([w.frequencies for _, _, w in self.pieces])

    @property
    def folds(self) -> tuple[NDArray[np.intp], ...]:
        """Indices of each piece's components in a flattened (C * K,) whitened residual."""
        index = np.arange(self.size).reshape(len(self.pieces[0][2].mask), -1)
        return tuple(np.ravel(index[:, a:b]) for a, b, _ in self.pieces)


def estimate_noise(runs: Sequence[RepeatedRuns]) -> SetupNoise:
    """Estimate the noise of one setup from the differences between repeats.

    Without repeats, the noise is taken as white, with the standard deviation given by the user or else a
    model-free bound (`fmuid.data.noise.single_run`); rounding errors of quantised signals are added.

    Parameters
    ----------
    runs
        Experiments of one setup, with the same channels and sampling interval.

    Returns
    -------
    SetupNoise
        Covariances pooled over experiments in bands one octave wide; ``calibrated`` is False with fewer
        than five runs of every experiment, unless every signal's standard deviation was given.

    Raises
    ------
    ProblemError
        Repeats agree exactly in a signal that is not quantised, or a signal is constant.
    """
    channels = runs[0].channels
    dt = float(np.mean(np.diff(runs[0].time)))
    step, given = _steps(runs), _given(runs)
    repeated = [r for r in runs if r.n_repeats > 1]
    if not repeated:
        return _without_repeats(runs, given, step, dt)
    edges = _band_edges(max(len(r.time) for r in repeated), dt)
    n_bands, n_channels = len(edges) - 1, len(channels)
    total = np.zeros((n_bands, n_channels, n_channels))
    dof = np.zeros(n_bands)
    mean_sum, mean_dof = np.zeros(n_channels), 0
    for run in repeated:
        spectrum = real_spectrum(run.deviations)
        bands = _bands_of(len(run.time), dt, edges)
        for band in range(n_bands):
            part = spectrum[..., bands == band]
            total[band] += np.einsum("rcn,rdn->cd", part, part)
            dof[band] += part.shape[-1] * (run.n_repeats - 1)
        mean_sum += np.sum(spectrum[..., 0] ** 2, axis=0) / len(run.time)
        mean_dof += run.n_repeats - 1
    variance = np.diag(total.sum(axis=0)) / dof.sum()
    repeating = repeating_variance(variance, step)
    # Where repeats agree exactly, only the user's values are known.
    silent = variance == 0.0
    variance = np.where(silent & np.isfinite(given), np.nan_to_num(given) ** 2, variance)
    prior = 4.0  # bands with few differences are shrunk towards the mean spectrum, as if it were four more of them
    covariance = (total + prior * np.diag(variance)) / (dof + prior)[:, None, None]
    covariance += np.diag(np.where(silent, variance, 0.0)) * (dof / (dof + prior))[:, None, None]
    if np.any(variance + repeating <= 0.0):
        raise ProblemError(
            f"signal '{channels[int(np.argmin(variance + repeating))]}' is the same in every repeat, "
            "so its noise cannot be measured",
            where=f"setup '{runs[0].setup}'",
            fix="give its `sigma` in the measurement file",
        )
    return SetupNoise(
        channels=channels,
        dt=dt,
        edges=edges,
        covariance=covariance,
        variance=variance,
        mean_variance=mean_sum / mean_dof,
        degrees_of_freedom=dof,
        step=step,
        repeating=repeating,
        calibrated=all(r.n_repeats >= 5 for r in runs),
    )


def _without_repeats(runs: Sequence[RepeatedRuns], given: FloatArray, step: FloatArray, dt: float) -> SetupNoise:
    channels, known = runs[0].channels, np.isfinite(given)
    values = [[r.values[:, c] for r in runs] for c in range(len(channels))]
    # What the differences show of a counter's error is fast; the rest follows the signal.
    repeating = np.where(
        known, 0.0, repeating_variance(np.array([fast_variance(samples) for samples in values]), step)
    )
    bound = [single_run_variance(*of) for of in zip(values, step.tolist(), repeating.tolist(), strict=True)]
    variance = np.where(known, np.nan_to_num(given) ** 2, bound)
    if np.any(variance <= 0.0):
        raise ProblemError(
            f"signal '{channels[int(np.argmin(variance))]}' is constant, so its noise cannot be estimated",
            where=f"setup '{runs[0].setup}'",
            fix="remove the signal, or give its `sigma` in the measurement file",
        )
    return SetupNoise(
        channels=channels,
        dt=dt,
        edges=np.array([0.0, np.inf]),
        covariance=np.diag(variance)[None],
        variance=variance,
        # Sensors shift from run to run by an unknown amount, so a shift as large as the noise is allowed for.
        mean_variance=np.where(known, 0.0, variance),
        degrees_of_freedom=np.array([np.inf]),
        step=step,
        repeating=repeating,
        calibrated=bool(known.all()),
        bounded=not known.all(),
    )


def _steps(runs: Sequence[RepeatedRuns]) -> FloatArray:
    return np.array([max(quantum(r.values[:, c]) for r in runs) for c in range(len(runs[0].channels))])


def _given(runs: Sequence[RepeatedRuns]) -> FloatArray:
    """Return the (C,) root mean square of the user's values for all runs; NaN if a run has none."""
    return np.asarray(np.sqrt(np.mean(np.square([r.given for r in runs]), axis=0)))


def whitener(run: RepeatedRuns, noise: SetupNoise) -> Whitener:
    """Return a whitener for residuals of `run` under `noise`; the mean's variance is at least that of its noise.

    Rounding errors that repeat do not average out, so their variance counts R times; the whitened mean of R runs
    then has variance 1/R.
    """
    n = len(run.time)
    band_of = _bands_of(n, noise.dt, noise.edges)
    known = np.isfinite(run.given)
    # The user's value is the total error of a sample, but a counted signal is no better than its counts.
    wanted = np.where(known, np.nan_to_num(run.given) ** 2 - noise.repeating, noise.variance)
    scale = np.sqrt(np.divide(np.maximum(wanted, 0.0), noise.variance, where=noise.variance > 0.0, out=wanted * 0))
    rounding = run.n_repeats * _rounding_spectrum(run, noise)
    factors, bands = [], []
    for k, covariance in enumerate(noise.covariance):
        band = slice(*np.searchsorted(band_of, (k, k + 1)))
        if band.start == band.stop:  # a piece of a run has fewer low frequencies
            continue
        repeating = np.diag(np.mean(rounding[:, band], axis=1))
        lower = cholesky(scale[:, None] * covariance * scale + repeating, lower=True)
        factors.append(solve_triangular(lower, np.eye(len(lower)), lower=True))
        bands.append(band)
    lowest = scale**2 * np.diagonal(noise.covariance[0])
    mean_variance = np.maximum(n * scale**2 * noise.mean_variance, lowest) + rounding[:, 0]
    return Whitener(
        mask=read_only(run.mask),
        factors=read_only(np.array(factors)),
        bands=tuple(bands),
        mean_scale=read_only(1.0 / np.sqrt(mean_variance)),
        frequencies=read_only(coefficient_frequencies(n, noise.dt)),
    )


def bandwidth(run: RepeatedRuns, noise: SetupNoise, *courses: FloatArray) -> FloatArray:
    """Return (C,) bandwidths of (C, N) `courses` in Hz: the last octave in which one is as strong as the noise.

    The bandwidth is at least sixteen periods of the record, because a mean over fewer components says little.
    Above it the signal contains nothing to compare a model with, at any sampling rate. A straight line between the
    first and the last sample is subtracted first: a non-periodic record would otherwise seem to have power at
    every frequency.
    """
    n = len(run.time)
    edges = _band_edges(n, noise.dt)
    octave, band_of = _bands_of(n, noise.dt, edges), _bands_of(n, noise.dt, noise.edges)
    variance = np.diagonal(noise.covariance, axis1=1, axis2=2)[np.maximum(band_of, 0).astype(int)].T
    level = variance / run.n_repeats + _rounding_spectrum(run, noise)
    lines = [np.linspace(y[:, 0], y[:, -1], n, axis=1) for y in courses]
    power = np.stack([real_spectrum((y - x) * run.mask) ** 2 for y, x in zip(courses, lines, strict=True)])
    limits = np.full(len(run.channels), _FEWEST / (n * noise.dt))
    for b, end in enumerate(edges[1:]):
        within = octave == b
        if within.any():
            loud = np.any(power[..., within].mean(axis=-1) > _TWICE * level[:, within].mean(axis=1), axis=0)
            limits[loud] = np.maximum(limits[loud], end)
    return limits


def rounding_draws(
    run: RepeatedRuns, noise: SetupNoise, *, course: FloatArray | None = None, draws: int = 16, seed: int = 0
) -> FloatArray:
    """Return (draws, C, N) possible rounding errors shared by all repeats of `run`.

    Their spectrum depends on the signals before they are rounded: `course`, (C, N), if a model predicts it,
    otherwise what the counts tell.
    """
    errors = np.zeros((draws, len(run.channels), len(run.time)))
    for c, (step, variance) in enumerate(zip(noise.step, noise.repeating, strict=True)):
        if variance <= 0.0:
            continue
        if course is not None:
            errors[:, c] = rounding_along(course[c], step, variance, draws=draws, seed=seed + c)
        else:
            share = np.sqrt(12.0 * variance) / step
            errors[:, c] = share * rounding_errors(run.values[0, c], step, draws=draws, seed=seed + c)
    return errors


def _rounding_spectrum(run: RepeatedRuns, noise: SetupNoise) -> FloatArray:
    """Return the (C, N) mean square of each coefficient of the rounding errors that repeat."""
    if not np.any(noise.repeating):
        return np.zeros((len(run.channels), len(run.time)))
    return np.asarray(np.mean(real_spectrum(rounding_draws(run, noise) * run.mask) ** 2, axis=0))


def _band_edges(n: int, dt: float) -> FloatArray:
    nyquist = 0.5 / dt
    lowest = _MIN_BIN_COUNT / (n * dt)
    count = max(1, int(np.floor(np.log2(nyquist / lowest) * _BANDS_PER_OCTAVE)))
    inner = nyquist * 2.0 ** (-np.arange(count, 0, -1.0) / _BANDS_PER_OCTAVE)
    return np.concatenate([[0.0], inner, [np.inf]])


def _bands_of(n: int, dt: float, edges: FloatArray) -> FloatArray:
    bands = np.asarray(np.searchsorted(edges, coefficient_frequencies(n, dt), side="right") - 1.0)
    bands[0] = -1.0  # the mean is not in any band
    return bands
