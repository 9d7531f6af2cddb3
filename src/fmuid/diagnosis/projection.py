"""Orthonormal bases of the responses of residuals to unknowns, and projections off them."""

from __future__ import annotations

import numpy as np

from fmuid.core.immutable import FloatArray


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
