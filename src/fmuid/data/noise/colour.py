"""Coloured noise of one signal, estimated from differences between repeats, and whitening in the time domain.

The noise is modelled as an autoregression (Levinson and Durbin) around a shift of the whole run. Its spectrum is
smooth, and the whitened residuals are independent, even at the first samples and for strongly coloured noise;
Fourier coefficients of a non-periodic record are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.data.noise.spectrum import estimate_noise, rounding_draws

_HIGHEST_ORDER = 40


@dataclass(frozen=True, slots=True, eq=False)
class Colour:
    """Noise of one signal.

    Parameters
    ----------
    predictors
        Coefficients of the best linear prediction from the preceding 0, 1, ... p samples.
    deviations
        (p + 1,) standard deviations of the prediction errors.
    shift
        Variance of a run's shift beyond the variance of the mean of its noise.
    """

    predictors: tuple[FloatArray, ...]
    deviations: FloatArray
    shift: float

    @property
    def order(self) -> int:
        """Order of the autoregression."""
        return len(self.predictors) - 1

    def whitened(self, r: FloatArray) -> FloatArray:
        """Return (N,) residuals as (N,) independent ones of unit variance under the noise of a single run."""
        white = self._innovations(r)
        ones = self._innovations(np.ones(len(r)))
        energy = float(np.sum(ones**2))
        # The shift adds a rank-one term to the covariance, and a matching one to its inverse root.
        taken = (1.0 - 1.0 / np.sqrt(1.0 + self.shift * energy)) / energy
        return np.asarray(white - taken * float(np.sum(ones * white)) * ones)

    def _innovations(self, r: FloatArray) -> FloatArray:
        last = self.predictors[-1]
        out = np.convolve(r, np.concatenate([[1.0], -last]))[: len(r)] / self.deviations[-1]
        for k, predictor in enumerate(self.predictors[:-1][: len(r)]):
            out[k] = (r[k] - predictor @ r[:k][::-1]) / self.deviations[k]
        return np.asarray(out)


def estimate_colour(runs: Sequence[RepeatedRuns], *, count: float = 1.0) -> Colour:
    """Estimate the noise of one signal from the differences between repeats.

    Akaike's criterion selects the order.

    Parameters
    ----------
    runs
        Experiments of one setup, with this signal only and the same sampling interval.
    count
        Number of runs whose mean is whitened. Rounding errors that the runs share do not average out, so their
        variance counts `count` times.

    Raises
    ------
    ProblemError
        No experiment has a second run; or repeats agree exactly in a signal that is not counted, and its standard
        deviation was not given.
    """
    repeated = [r for r in runs if r.n_repeats > 1]
    if not repeated:
        raise ProblemError(
            f"no experiment of setup '{runs[0].setup}' was repeated, so the noise's colour cannot be measured",
            fix="repeat at least one experiment, better five times",
        )
    noise = estimate_noise(runs)
    highest = min(_HIGHEST_ORDER, min(len(r.time) for r in repeated) // 4)
    covariance, samples = np.zeros(highest + 1), 0.0
    for run in repeated:
        centred = run.deviations[:, 0] - run.deviations[:, 0].mean(axis=1, keepdims=True)
        covariance += _sums(centred, highest)
        samples += float(run.mask[0].sum()) * (run.n_repeats - 1)
    covariance /= samples
    covariance[0] = max(covariance[0], float(noise.variance[0]) if covariance[0] == 0.0 else 0.0)
    if noise.repeating[0] > 0.0:
        shared = [rounding_draws(run, noise)[:, 0] * run.mask[0] for run in repeated]
        there = sum(len(s) * float(run.mask[0].sum()) for s, run in zip(shared, repeated, strict=True))
        covariance += count * sum(_sums(s, highest) for s in shared) / there
    predictors, errors = _levinson(covariance)
    order = int(np.argmin(samples * np.log(errors) + 2.0 * np.arange(len(errors))))
    kept = tuple(predictors[: order + 1])
    # Variance of the mean of a run of the greatest length, according to the autoregression.
    n = max(len(r.time) for r in repeated)
    of_mean = errors[order] / (1.0 - float(np.sum(kept[-1]))) ** 2 / n
    return Colour(kept, np.sqrt(errors[: order + 1]), max(float(noise.mean_variance[0]) - of_mean, 0.0))


def _sums(rows: FloatArray, highest: int) -> FloatArray:
    """Return the sums of products of (R, N) rows with themselves 0, 1, ... `highest` samples later."""
    n = rows.shape[1]
    return np.array([np.sum(rows[:, : n - lag] * rows[:, lag:]) for lag in range(highest + 1)])


def _levinson(covariance: FloatArray) -> tuple[list[FloatArray], FloatArray]:
    """Return the best predictors of order 0 to the highest, and the variance of their errors."""
    predictors, errors = [np.zeros(0)], [float(covariance[0])]
    for k in range(1, len(covariance)):
        before = predictors[-1]
        reflection = (covariance[k] - before @ covariance[1:k][::-1]) / errors[-1]
        if not abs(reflection) < 1.0:  # an estimated autocovariance that no process can have
            break
        predictors.append(np.append(before - reflection * before[::-1], reflection))
        errors.append(errors[-1] * (1.0 - reflection**2))
    return predictors, np.array(errors)
