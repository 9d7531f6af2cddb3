"""Repeated runs of one experiment, and their differences."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from fmuid.core.immutable import FloatArray, read_only


@dataclass(frozen=True, eq=False)
class RepeatedRuns:
    """The runs of one experiment: the same inputs, recorded R times.

    Parameters
    ----------
    id
        Id of the first run.
    setup
        Its setup; noise is pooled over the experiments of a setup.
    time
        (N,) s. Jitter is ignored: the noise spectrum refers to sample numbers.
    channels
        Names of the C measured outputs.
    values
        (R, C, N) measurements, NaN where missing.
    given
        (C,) standard deviations of a sample's noise as given by the user, NaN where not given; empty if none is
        given.
    conditions
        A label shared by runs with the same inputs and settings; empty if unknown.
    """

    id: str
    setup: str
    time: FloatArray
    channels: tuple[str, ...]
    values: FloatArray
    given: FloatArray = ()  # type: ignore[assignment]
    conditions: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", read_only(self.time))
        object.__setattr__(self, "values", read_only(self.values))
        given = self.given if len(self.given) else np.full(len(self.channels), np.nan)
        object.__setattr__(self, "given", read_only(given))

    @property
    def n_repeats(self) -> int:
        """Number of runs."""
        return int(self.values.shape[0])

    @cached_property
    def mask(self) -> FloatArray:
        """(C, N) 1 where every run has a sample, else 0."""
        return read_only(np.isfinite(self.values).all(axis=0).astype(np.float64))

    @cached_property
    def mean(self) -> FloatArray:
        """(C, N) mean over the runs, 0 where a sample is missing."""
        there = self.mask > 0
        return read_only(np.where(there, self.values[0] + (self.values - self.values[0]).mean(axis=0), 0.0))

    @cached_property
    def deviations(self) -> FloatArray:
        """(R, C, N) runs minus their mean, 0 where a sample is missing; exactly 0 where all runs agree."""
        there = self.mask > 0
        apart = np.where(there, self.values - self.values[0], 0.0)
        return read_only(apart - apart.mean(axis=0))


def cut(run: RepeatedRuns, pieces: int) -> tuple[tuple[int, int, RepeatedRuns], ...]:
    """Return a run cut into pieces of about equal length, each with its begin and end."""
    ends = np.linspace(0, len(run.time), pieces + 1).astype(int).tolist()
    return tuple((a, b, replace(run, time=run.time[a:b], values=run.values[..., a:b])) for a, b in pairwise(ends))
