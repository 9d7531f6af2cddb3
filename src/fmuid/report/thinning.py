"""Fewer samples for plotting: long recordings are drawn by their extremes, never by averages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fmuid.core.immutable import FloatArray

MAX_SAMPLES = 2000


def kept_samples(rows: Sequence[FloatArray], most: int = MAX_SAMPLES) -> NDArray[np.intp]:
    """Return the indices of the samples to draw: first, last, and each row's extremes in every bucket.

    Parameters
    ----------
    rows
        Arrays (N,) over one time axis; NaN marks missing samples.
    most
        Approximate number of indices to keep; all of them if N is no larger.

    Returns
    -------
    Sorted indices, common to all rows, so that every drawn value is a recorded one.
    """
    n = rows[0].size
    if n <= most:
        return np.arange(n)
    buckets = max(1, most // (2 * len(rows)))
    edges = np.linspace(0, n, buckets + 1).astype(np.intp)
    width = int(np.max(np.diff(edges)))
    # Pad every bucket to one width by repeating its last sample, so that all are reduced together.
    index = np.minimum(edges[:-1, None] + np.arange(width), edges[1:, None] - 1)
    kept = [np.array([0, n - 1])]
    for row in rows:
        values = row[index]
        place = np.arange(buckets)
        kept.append(index[place, np.argmin(np.where(np.isnan(values), np.inf, values), axis=1)])
        kept.append(index[place, np.argmax(np.where(np.isnan(values), -np.inf, values), axis=1)])
    return np.unique(np.concatenate(kept))
