"""Simulations with a memory of predictions, so that none is repeated."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Mapping
from typing import Generic, TypeVar

from fmuid.core.immutable import FloatArray, read_only
from fmuid.simulation.runners import Job, Outcome, Runner

_SAMPLES = 4_000_000  # samples of predictions, 32 MB: enough for the columns of a Jacobian
Key = TypeVar("Key", bound=Hashable)


class Predictor(Generic[Key]):
    """Simulates jobs and remembers the latest predictions; a failed run is repeated when requested again.

    Parameters
    ----------
    samples
        Number of samples to remember; the least recently used predictions are forgotten first.
    """

    def __init__(self, samples: int = _SAMPLES) -> None:
        self._samples = samples
        self._known: OrderedDict[Key, FloatArray] = OrderedDict()
        self._size = 0

    def __call__(self, jobs: Mapping[Key, Job], runner: Runner) -> dict[Key, Outcome]:
        """Return the outcome of every job by its key, which covers everything that its prediction depends on."""
        outcomes: dict[Key, Outcome] = {key: self._known[key] for key in jobs if key in self._known}
        missing = {key: job for key, job in jobs.items() if key not in outcomes}
        if missing:
            outcomes |= dict(zip(missing, runner(list(missing.values())), strict=True))
        self.remember({key: o for key, o in outcomes.items() if not isinstance(o, Exception)})
        return outcomes

    def remember(self, predictions: Mapping[Key, FloatArray]) -> None:
        """Remember predictions computed elsewhere."""
        for key, prediction in predictions.items():
            if key not in self._known:
                self._known[key] = read_only(prediction)
                self._size += prediction.size
            self._known.move_to_end(key)
        while self._size > self._samples and len(self._known) > 1:
            self._size -= self._known.popitem(last=False)[1].size
