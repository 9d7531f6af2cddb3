"""Localisation of the gap: shares of the excess energy by experiment and signal, and by regime within them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.immutable import FloatArray, read_only
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.verdict import Share

_BINS = 6  # of a variable: enough to see where a gap lies, each with many samples
_SHOWN = 0.01  # share of the gap that is worth a row


@dataclass(frozen=True, slots=True, eq=False)
class ExcessMap:
    """Excess energy of every experiment and signal, binned over regimes.

    Attributes
    ----------
    rows
        (experiment, signal) pairs.
    energy
        (rows,) excess energy in squared sigmas, never below 0.
    edges
        Regime variable -> (B + 1,) bin edges.
    binned
        Regime variable -> (rows, B) share of the row's energy.
    """

    rows: tuple[tuple[str, str], ...]
    energy: FloatArray
    edges: Mapping[str, FloatArray]
    binned: Mapping[str, FloatArray]

    def shares(self, limit: int = 8) -> tuple[Share, ...]:
        """Return the largest shares, each with its most prominent regime, if any."""
        total = float(self.energy.sum())
        if total <= 0.0:
            return ()
        found = []
        for row in np.argsort(-self.energy)[:limit]:
            share = float(self.energy[row]) / total
            if share < _SHOWN:
                break
            experiment, signal = self.rows[row]
            found.append(Share(experiment, signal, share, self._regime(int(row))))
        return tuple(found)

    def _regime(self, row: int) -> tuple[str, float, float] | None:
        best: tuple[float, str, int] | None = None
        for name, table in self.binned.items():
            k = int(np.argmax(table[row]))
            if best is None or table[row, k] > best[0]:
                best = (float(table[row, k]), name, k)
        if best is None or best[0] < 2.0 / _BINS:
            return None
        _, name, k = best
        return name, float(self.edges[name][k]), float(self.edges[name][k + 1])


def excess_map(
    observed: Observed, predictions: Sequence[FloatArray], regimes: Mapping[str, Sequence[FloatArray]]
) -> ExcessMap:
    """Bin the excess energy of predictions.

    Parameters
    ----------
    predictions
        (C, N) per experiment.
    regimes
        Variable -> (N,) samples per experiment: speed, load torque, time and so on.
    """
    whitened, taken = observed.residuals(predictions), observed.taken
    edges = {name: _edges(values) for name, values in regimes.items()}
    rows, energy = [], []
    binned: dict[str, list[FloatArray]] = {name: [] for name in regimes}
    for e, (run, prediction, z) in enumerate(zip(observed.runs, predictions, whitened, strict=True)):
        by_channel = z.reshape(len(run.channels), -1)
        for c, channel in enumerate(run.channels):
            n = float(np.sum(1.0 - taken[e].reshape(len(run.channels), -1)[c]))
            rows.append((run.id, channel))
            energy.append(max(0.0, float(by_channel[c] @ by_channel[c]) - n / run.n_repeats))
            raw = ((prediction[c] - run.mean[c]) * run.mask[c]) ** 2
            for name, values in regimes.items():
                index = np.clip(np.searchsorted(edges[name], values[e], side="right") - 1, 0, len(edges[name]) - 2)
                part = np.bincount(index, weights=raw, minlength=len(edges[name]) - 1)
                binned[name].append(part / max(float(part.sum()), 1e-300))
    return ExcessMap(
        tuple(rows),
        read_only(energy),
        {n: read_only(v) for n, v in edges.items()},
        {n: read_only(np.array(v)) for n, v in binned.items()},
    )


def _edges(values: Sequence[FloatArray]) -> FloatArray:
    low = min(float(v.min()) for v in values)
    high = max(float(v.max()) for v in values)
    return np.linspace(low, high if high > low else low + 1.0, _BINS + 1)
