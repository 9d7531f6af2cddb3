"""Standard errors under coloured residuals, against those of least squares with the covariance known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from fmuid.identification.uncertainty.coloured_residuals import Record, coloured_covariance


@pytest.mark.parametrize("n", [100, 2000])
def test_standard_errors_do_not_depend_on_the_sampling_rate(n):
    """Noise with a correlation time of 0.5 s over 10 s, at rates of 10 and 200 Hz."""
    generator, rho = np.random.default_rng(5), np.exp(-10.0 / n / 0.5)
    time = np.linspace(0.0, 10.0, n)
    jacobian = np.stack([np.sin(2.0 * time), time / 10.0, np.exp(-time / 1.5)], axis=1)
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    true = np.sqrt(np.diag(inverse @ jacobian.T @ toeplitz(rho ** np.arange(n)) @ jacobian @ inverse))

    variances = []
    for _ in range(30):
        white = np.sqrt(1.0 - rho**2) * generator.standard_normal(10 * n)
        noise = lfilter([1.0], [1.0, -rho], white)[-n:]
        residuals = noise - jacobian @ (inverse @ jacobian.T @ noise)
        meat, _ = coloured_covariance({"run": [Record("y", residuals, jacobian, np.ones(n))]}, 3)
        variances.append(np.diag(inverse @ meat @ inverse))
    assert np.sqrt(np.mean(variances, axis=0)) / true == pytest.approx(1.0, abs=0.25)
