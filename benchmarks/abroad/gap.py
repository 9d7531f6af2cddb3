"""How large a gap an effect leaves on a plant once the parameters that a user would free are refitted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.abroad.compiled import SHAPE
from benchmarks.abroad.plant import Floats, Rig
from fmuid.core.errors import SimulationError

_STEP = 1e-3  # of a parameter's logarithm, for derivatives
_REFITS = 2  # Gauss-Newton steps
_CLOSE = 0.05
_MOST = {"saturation": 0.8, "value": 0.7, "gain": 0.5}  # sizes that are plausible at all
_FIRST = 1e-7


class SizedPlant:
    """A plant without effects, and the gap of any effect beside it.

    The floor is the rig's own noise, sample by sample; the last experiment is for validation and does not count.
    """

    def __init__(self, rig: Rig, factors: Mapping[str, float]) -> None:
        self._rig, self._factors = rig, dict(factors)
        self._plain = self._whitened({}, {})
        columns = [
            (self._whitened({name: _STEP}, {}) - self._whitened({name: -_STEP}, {})) / (2 * _STEP)
            for name in rig.parameters
        ]
        self._columns = np.column_stack(columns)
        self._inverse = np.linalg.pinv(self._columns)

    def _whitened(self, moved: Mapping[str, float], effect: Mapping[str, float]) -> Floats:
        """Return all readings in units of the floor; parameters are `moved` in their logarithms."""
        rig = self._rig
        factors = {n: f * np.exp(moved.get(n, 0.0)) for n, f in self._factors.items()}
        sigma = np.asarray(rig.noise)[:, None]
        runs = list(rig.inputs.values())[:-1]
        return np.concatenate([(rig.simulate(factors, effect, rig.time, u) / sigma).ravel() for u in runs])

    def gap(self, effect: Mapping[str, float]) -> float:
        """Return the gap in floors: the RMS that the refit leaves; infinite where it cannot be simulated."""
        try:
            measured = self._whitened({}, effect)
            best, moved = np.inf, np.zeros(len(self._rig.parameters))
            for _ in range(_REFITS + 1):
                left = measured - self._whitened(dict(zip(self._rig.parameters, moved, strict=True)), {})
                best = min(best, float(np.sqrt(np.mean(left**2))))
                moved = np.clip(moved + self._inverse @ left, -1.0, 1.0)
        except SimulationError:
            return np.inf
        return best

    def separation(self, effect: Mapping[str, float], other: Mapping[str, float], recordings: float) -> float:
        """Return by how many standard deviations an effect differs from the best size of another beside it.

        Both responses are taken to be linear in small changes, and the noise to be white.
        """
        one, two = (self._left(e) for e in (effect, other))
        apart = one - two * float(one @ two) / max(float(two @ two), 1e-300)
        return float(np.linalg.norm(apart)) * float(np.sqrt(recordings))

    def _left(self, effect: Mapping[str, float]) -> Floats:
        moved = self._whitened({}, effect) - self._plain
        return np.asarray(moved - self._columns @ (self._inverse @ moved))

    def sized(
        self, unit: Mapping[str, float], target: float, *, sign: float = 1.0, shape: float = 1.0
    ) -> tuple[dict[str, float], float]:
        """Return an effect, given at unit size, at the size whose gap comes close to `target`, and that gap.

        Where no plausible size is large enough, the largest is taken.
        """
        most = _MOST.get(next(iter(unit)).partition("@")[0], np.inf)
        unit = {n: v * (shape if n.endswith(SHAPE) else sign) for n, v in unit.items()}

        def at(size: float) -> dict[str, float]:
            return {n: v if n.endswith(SHAPE) else size * v for n, v in unit.items()}

        low, high, size = 0.0, np.inf, _FIRST
        for _ in range(40):
            gap = self.gap(at(size))
            if abs(gap / target - 1.0) < _CLOSE or (gap < target and size >= most):
                break
            low, high = (size, high) if gap < target else (low, size)
            guess = size * float(np.clip(target / max(gap, 1e-12), 1e-2, 1e3))
            inside = low + 0.02 * (high - low) < guess < high - 0.02 * (high - low) if np.isfinite(high) else True
            size = min(guess if inside else np.sqrt(max(low, 1e-3 * high) * high), most)
        return at(size), gap
