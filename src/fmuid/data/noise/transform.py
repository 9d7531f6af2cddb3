"""The real Fourier transform, whose coefficients of noise are uncorrelated."""

from __future__ import annotations

import numpy as np

from fmuid.core.immutable import FloatArray


def real_spectrum(values: FloatArray) -> FloatArray:
    """Return orthonormal real Fourier coefficients over the last axis: DC, then cosine and sine of each bin.

    Shape (..., N) to (..., N); keeps the sum of squares (Parseval).
    """
    from scipy.fft import rfft  # three times as fast as NumPy's where N is a large prime

    n = values.shape[-1]
    bins = rfft(values, axis=-1, norm="ortho")
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
    """Return the frequency in Hz of every coefficient that `real_spectrum` returns for N samples."""
    return np.asarray(np.ceil(np.arange(n) / 2.0) / (n * dt))
