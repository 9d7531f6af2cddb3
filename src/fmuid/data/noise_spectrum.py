"""The noise floor: what repeated runs of the same experiment differ by, and whitening by it.

Repeats share their inputs, so what differs between them is noise and run-level nuisance. Its spectrum,
channel by channel and between channels, is pooled over the experiments of one setup in bands of frequency;
residuals are then whitened by the inverse square root of it. The mean of a run (the DC bin) has a variance of
its own: sensors shift from run to run by more than their noise averaged over a run would allow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray, read_only

_BANDS_PER_OCTAVE = 1
_MIN_BIN_COUNT = 3
_QUIETEST = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class RepeatedRuns:
    """The runs of one experiment: the same inputs, recorded R times.

    Parameters
    ----------
    id
        Id of the first run.
    setup
        Its setup; noise is pooled over the experiments of a setup.
    time
        (N,) s, evenly spaced.
    channels
        Names of the C measured outputs.
    values
        (R, C, N) measurements, NaN where missing.
    """

    id: str
    setup: str
    time: FloatArray
    channels: tuple[str, ...]
    values: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", read_only(self.time))
        object.__setattr__(self, "values", read_only(self.values))
        steps = np.diff(self.time)
        if steps.max() - steps.min() > 1e-6 * steps.mean() * len(self.time):
            raise ProblemError(
                "the noise spectrum needs evenly spaced samples",
                where=self.id,
                fix="resample the run with `fmuid import --resample` first",
            )

    @property
    def n_repeats(self) -> int:
        """How many runs there are."""
        return int(self.values.shape[0])

    @property
    def mask(self) -> FloatArray:
        """(C, N) 1 where every run has a sample, else 0."""
        return np.asarray(np.isfinite(self.values).all(axis=0), dtype=np.float64)

    @property
    def mean(self) -> FloatArray:
        """(C, N) mean over the runs, 0 where a sample is missing."""
        return np.asarray(np.where(self.mask > 0, self.values.mean(axis=0), 0.0))


def real_spectrum(values: FloatArray) -> FloatArray:
    """Orthonormal real Fourier coefficients over the last axis: DC, then cosine and sine of each bin.

    Shape (..., N) to (..., N); keeps the sum of squares (Parseval).
    """
    n = values.shape[-1]
    bins = np.fft.rfft(values, axis=-1, norm="ortho")
    out = np.empty_like(values)
    out[..., 0] = bins[..., 0].real
    last = (n - 1) // 2
    out[..., 1 : 2 * last + 1 : 2] = np.sqrt(2.0) * bins[..., 1 : last + 1].real
    out[..., 2 : 2 * last + 2 : 2] = np.sqrt(2.0) * bins[..., 1 : last + 1].imag
    if n % 2 == 0:
        out[..., -1] = bins[..., -1].real
    return out


def from_real_spectrum(coefficients: FloatArray) -> FloatArray:
    """Return the (..., N) values whose `real_spectrum` is given."""
    n = coefficients.shape[-1]
    bins = np.zeros((*coefficients.shape[:-1], n // 2 + 1), dtype=np.complex128)
    bins[..., 0] = coefficients[..., 0]
    last = (n - 1) // 2
    cosine, sine = coefficients[..., 1 : 2 * last + 1 : 2], coefficients[..., 2 : 2 * last + 2 : 2]
    bins[..., 1 : last + 1] = (cosine + 1j * sine) / np.sqrt(2.0)
    if n % 2 == 0:
        bins[..., -1] = coefficients[..., -1]
    return np.asarray(np.fft.irfft(bins, n, axis=-1, norm="ortho"))


def coefficient_frequencies(n: int, dt: float) -> FloatArray:
    """Frequency in Hz of every coefficient that `real_spectrum` returns for N samples."""
    return np.asarray(np.ceil(np.arange(n) / 2.0) / (n * dt))


@dataclass(frozen=True, slots=True, eq=False)
class SetupNoise:
    """Noise of one setup: band edges in Hz, a (C, C) covariance a band, and the variance of a run's mean.

    Nothing is said about frequencies from `cutoff` (Hz) on: whitened residuals do not have them. Runs are taken
    apart into `pieces` before they are whitened.
    """

    channels: tuple[str, ...]
    dt: float
    edges: FloatArray
    covariance: FloatArray
    mean_variance: FloatArray
    degrees_of_freedom: FloatArray
    calibrated: bool
    cutoff: float = np.inf
    pieces: int = 1

    @property
    def sigma(self) -> Mapping[str, float]:
        """Standard deviation of each channel's noise around its run's mean, in the channel's unit."""
        n = np.maximum(self.degrees_of_freedom, 1e-12)
        pooled = np.average(np.diagonal(self.covariance, axis1=1, axis2=2), axis=0, weights=n)
        return {c: float(np.sqrt(v)) for c, v in zip(self.channels, pooled, strict=True)}


@dataclass(frozen=True, slots=True, eq=False)
class Whitener:
    """Turns a residual of one experiment into components of unit variance under the noise of a single run."""

    mask: FloatArray
    factors: FloatArray
    band_of: FloatArray
    mean_scale: FloatArray

    @property
    def size(self) -> int:
        """Length of a whitened residual."""
        return len(self.mask) * len(self.band_of)

    def __call__(self, residual: FloatArray) -> FloatArray:
        """Whiten (..., C, N) to (..., C, K), K = N below a cutoff; coefficient 0 of each channel is its mean."""
        spectrum = real_spectrum(residual * self.mask)[..., : len(self.band_of)]
        out = np.empty_like(spectrum)
        out[..., 0] = spectrum[..., 0] * self.mean_scale
        for band, factor in enumerate(self.factors):
            chosen = np.flatnonzero(self.band_of == band)
            out[..., chosen] = factor @ spectrum[..., chosen]
        return out


def quantum(values: FloatArray) -> float:
    """Return the step of the lattice that all `values` lie on, as an encoder's counts do; 0 if there is none."""
    levels = np.unique(values[np.isfinite(values)])
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * max(float(np.abs(levels).max(initial=0.0)), 1e-300)]
    if gaps.size < 2:
        return 0.0
    step = float(gaps.min())
    counts = gaps / step
    return step if np.all(np.abs(counts - np.round(counts)) < 0.02) else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PiecewiseWhitener:
    """Whitens the pieces of a run that was not repeated one by one.

    Parameters
    ----------
    pieces
        Where each begins and ends, and its whitener.
    """

    pieces: tuple[tuple[int, int, Whitener], ...]

    @property
    def size(self) -> int:
        """Length of a whitened residual."""
        return sum(w.size for _, _, w in self.pieces)

    def __call__(self, residual: FloatArray) -> FloatArray:
        """Whiten (..., C, N) to (..., C, K), the pieces one after the other."""
        return np.concatenate([w(residual[..., a:b]) for a, b, w in self.pieces], axis=-1)

    @property
    def folds(self) -> tuple[NDArray[np.intp], ...]:
        """Indices of each piece's components in a flattened (C * K,) whitened residual."""
        counts = [len(w.band_of) for _, _, w in self.pieces]
        channels, total = len(self.pieces[0][2].mask), sum(counts)
        index = np.arange(channels * total).reshape(channels, total)
        ends = np.cumsum([0, *counts])
        return tuple(np.ravel(index[:, a:b]) for a, b in pairwise(ends.tolist()))


def cut(run: RepeatedRuns, pieces: int) -> tuple[tuple[int, int, RepeatedRuns], ...]:
    """Return a run cut into pieces of about equal length: where each begins and ends, and itself."""
    ends = np.linspace(0, len(run.time), pieces + 1).astype(int).tolist()
    return tuple(
        (a, b, RepeatedRuns(run.id, run.setup, run.time[a:b], run.channels, run.values[..., a:b]))
        for a, b in pairwise(ends)
    )


def estimate_noise(runs: Sequence[RepeatedRuns]) -> SetupNoise:
    """Estimate the noise of one setup from the differences between repeats.

    Parameters
    ----------
    runs
        Experiments of one setup, with the same channels and sampling interval.

    Returns
    -------
    SetupNoise
        Covariances pooled over experiments in bands one octave wide; ``calibrated`` is False with fewer
        than five runs of every experiment. Counted signals are never taken as better than their counts: at rest
        they repeat exactly, and are as wrong as before.

    Raises
    ------
    ProblemError
        No experiment has a second run.
    """
    channels = runs[0].channels
    dt = float(np.mean(np.diff(runs[0].time)))
    repeated = [r for r in runs if r.n_repeats > 1]
    if not repeated:
        raise ProblemError(
            f"no experiment of setup '{runs[0].setup}' was repeated, so its noise cannot be measured",
            fix="repeat at least one experiment, better five times",
        )
    floor = np.array([max(quantum(r.values[:, c]) for r in runs) for c in range(len(channels))]) / np.sqrt(12.0)
    edges = _band_edges(max(len(r.time) for r in repeated), dt)
    n_bands, n_channels = len(edges) - 1, len(channels)
    total = np.zeros((n_bands, n_channels, n_channels))
    dof = np.zeros(n_bands)
    mean_sum, mean_dof = np.zeros(n_channels), 0
    for run in repeated:
        deviation = (run.values - run.mean) * run.mask
        deviation = np.nan_to_num(deviation)
        spectrum = real_spectrum(deviation)
        bands = _bands_of(len(run.time), dt, edges)
        for band in range(n_bands):
            part = spectrum[..., bands == band]
            total[band] += np.einsum("rcn,rdn->cd", part, part)
            dof[band] += part.shape[-1] * (run.n_repeats - 1)
        mean_sum += np.sum(spectrum[..., 0] ** 2, axis=0) / len(run.time)
        mean_dof += run.n_repeats - 1
    pooled = total.sum(axis=0) / dof.sum()
    prior = 4.0  # bands with few differences lean on the mean spectrum, as if it were four more of them
    covariance = (total + prior * np.diag(np.diag(pooled))) / (dof + prior)[:, None, None]
    covariance += np.diag(np.maximum(floor**2 - np.diag(pooled), 0.0))
    rounding = np.max([np.abs(r.mean).max(axis=1) for r in repeated], axis=0) * 1e-12
    if np.any(np.diagonal(covariance, axis1=1, axis2=2) <= rounding**2):
        raise ProblemError(
            "a signal is the same in every repeat, so its noise cannot be measured",
            where=f"setup '{runs[0].setup}'",
            fix="give its `sigma` in the measurement file",
        )
    return SetupNoise(
        channels=channels,
        dt=dt,
        edges=edges,
        covariance=covariance,
        mean_variance=mean_sum / mean_dof,
        degrees_of_freedom=dof,
        calibrated=all(r.n_repeats >= 5 for r in runs),
    )


def noise_of_residuals(
    runs: Sequence[RepeatedRuns],
    residuals: Sequence[FloatArray],
    leverage: Sequence[FloatArray] | None = None,
    *,
    pieces: int = 1,
) -> SetupNoise:
    """Take what a model leaves of runs without repeats for their noise, each channel by itself.

    Parameters
    ----------
    runs
        Experiments of one setup, with the same channels and sampling interval.
    residuals
        (C, N) prediction minus measurement an experiment.
    leverage
        (C, N) an experiment: degrees of freedom that the model's parameters have taken from each coefficient.
        Without it the noise is white, of each mean square: for a model that does not fit yet.

    pieces
        Number of pieces that whole runs are cut into; all arguments are of the pieces.

    Returns
    -------
    SetupNoise
        Variances in bands of an octave or more, up to where they have fallen below a tenth of their mean in every
        channel: what a model leaves lies in its slow motion, comes in bursts, and is no measure of the noise of
        the quiet bands. The mean of a run varies as the means of the residuals do.
    """
    channels = runs[0].channels
    dt = float(np.mean(np.diff(runs[0].time)))
    edges = np.array([0.0, np.inf]) if leverage is None else _band_edges(max(len(r.time) for r in runs), dt)
    total, dof = np.zeros((len(edges) - 1, len(channels))), np.zeros((len(edges) - 1, len(channels)))
    mean_sum, mean_dof = np.zeros(len(channels)), np.zeros(len(channels))
    for k, (run, residual) in enumerate(zip(runs, residuals, strict=True)):
        spectrum = real_spectrum(residual * run.mask)
        bands = _bands_of(len(run.time), dt, edges)
        taken = np.zeros_like(spectrum) if leverage is None else leverage[k]
        mean_sum += spectrum[:, 0] ** 2 / len(run.time)
        mean_dof += 1.0 - taken[:, 0]
        for band in range(len(dof)):
            chosen = bands == band
            total[band] += np.sum(spectrum[:, chosen] ** 2, axis=1)
            dof[band] += np.sum(1.0 - taken[:, chosen], axis=1)
    quiet = _QUIETEST * total.sum(axis=0) / dof.sum(axis=0)
    variance = total / np.maximum(dof, 1.0)
    loud = np.flatnonzero(np.any(variance >= quiet, axis=1))
    cutoff = float(edges[loud.max() + 1]) if len(loud) else np.inf
    variance = np.maximum(variance, quiet)
    if np.any(variance <= 0.0):
        raise ProblemError(
            "a signal without repeats is predicted without error, so its noise cannot be estimated",
            where=f"setup '{runs[0].setup}'",
            fix="leave the signal out, or repeat the experiment",
        )
    covariance = np.array([np.diag(v) for v in variance])
    return SetupNoise(
        channels=channels,
        dt=dt,
        edges=edges,
        covariance=covariance,
        mean_variance=mean_sum / np.maximum(mean_dof, 0.5),
        degrees_of_freedom=dof.mean(axis=1),
        calibrated=False,
        cutoff=cutoff,
        pieces=pieces,
    )


def whitener(run: RepeatedRuns, noise: SetupNoise) -> Whitener:
    """Return what whitens residuals of `run` by `noise`; the mean's variance is never below its noise's."""
    n = len(run.time)
    factors = []
    for covariance in noise.covariance:
        lower = cholesky(covariance, lower=True)
        factors.append(solve_triangular(lower, np.eye(len(lower)), lower=True))
    lowest = np.diagonal(noise.covariance[0])
    mean_variance = np.maximum(n * noise.mean_variance, lowest)
    return Whitener(
        mask=read_only(run.mask),
        factors=read_only(np.array(factors)),
        band_of=read_only(_bands_of(n, noise.dt, noise.edges)[: _below(n, noise.dt, noise.cutoff)]),
        mean_scale=read_only(1.0 / np.sqrt(mean_variance)),
    )


def _band_edges(n: int, dt: float) -> FloatArray:
    nyquist = 0.5 / dt
    lowest = _MIN_BIN_COUNT / (n * dt)
    count = max(1, int(np.floor(np.log2(nyquist / lowest) * _BANDS_PER_OCTAVE)))
    inner = nyquist * 2.0 ** (-np.arange(count, 0, -1.0) / _BANDS_PER_OCTAVE)
    return np.concatenate([[0.0], inner, [np.inf]])


def _below(n: int, dt: float, cutoff: float) -> int:
    return int(np.searchsorted(coefficient_frequencies(n, dt), cutoff, side="left"))


def _bands_of(n: int, dt: float, edges: FloatArray) -> FloatArray:
    bands = np.asarray(np.searchsorted(edges, coefficient_frequencies(n, dt), side="right") - 1.0)
    bands[0] = -1.0  # the mean is not in any band
    return bands
