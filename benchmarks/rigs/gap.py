"""How large a gap an effect leaves on a plant once the parameters that a user would free are refitted."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from scipy.optimize import least_squares

from benchmarks.rigs.compiled import SHAPE
from benchmarks.rigs.logs import Noise, decorrelated
from benchmarks.rigs.plant import Floats, Rig
from fmuid.core.errors import SimulationError

_STEP = 1e-3  # of a parameter's logarithm, for derivatives
_REFITS = 8  # steps of a least-squares search at most
_FAR = 1.0  # that parameters may move, in their logarithms
_CORRECTED = 4  # times a size is corrected once the rough gap is right
_FURTHER = 3.0  # times the size of the same gap, that an effect may have in another one's place
_CLOSE = 0.05
_DRAWS = 8  # of the noise of inputs
_MOST = {"saturation": 0.8, "value": 0.7, "gain": 0.5}  # sizes that are plausible at all
_FIRST = 1e-7


class SizedPlant:
    """A plant without effects, and the gap of any effect in addition to it.

    The floor is the noise of a sample, given those before it: that of the rig's sensors, and with `inputs` also
    what the noise of measured inputs, a share of their ranges, passes on to the outputs. The last experiment is
    for validation and does not count.
    """

    def __init__(
        self, rig: Rig, factors: Mapping[str, float], *, noise: Noise = "white", inputs: float = 0.0
    ) -> None:
        self._rig, self._factors, self._noise = rig, dict(factors), noise
        self._floor = np.hypot(rig.noise, self._passed_on(inputs) if inputs else 0.0)
        self._plain = self._whitened({}, {})
        columns = [
            (self._whitened({name: _STEP}, {}) - self._whitened({name: -_STEP}, {})) / (2 * _STEP)
            for name in rig.parameters
        ]
        self._inverse = np.linalg.pinv(np.column_stack(columns))

    def _readings(self, moved: Mapping[str, float], effect: Mapping[str, float]) -> Floats:
        """Return all readings in units of the floor, by run; parameters are `moved` in their logarithms."""
        rig = self._rig
        factors = {n: f * np.exp(moved.get(n, 0.0)) for n, f in self._factors.items()}
        sigma = self._floor[:, None]
        return np.stack([rig.simulate(factors, effect, rig.time, u) / sigma for u in self._runs])

    def _whitened(self, moved: Mapping[str, float], effect: Mapping[str, float]) -> Floats:
        return decorrelated(self._readings(moved, effect), self._noise).ravel()

    @property
    def _runs(self) -> list[Floats]:
        return list(self._rig.inputs.values())[:-1]

    def _passed_on(self, share: float) -> Floats:
        """Return the root mean square of what noise of the inputs passes on to each output."""
        rig, rng = self._rig, np.random.default_rng(0)
        squares = []
        for u in map(np.atleast_2d, self._runs):
            plain = rig.simulate(self._factors, {}, rig.time, u)
            for _ in range(_DRAWS):
                noise = share * np.ptp(u, axis=1, keepdims=True) * rng.normal(size=u.shape)
                squares.append(
                    np.mean((rig.simulate(self._factors, {}, rig.time, u + noise) - plain) ** 2, axis=1)
                )
        return np.asarray(np.sqrt(np.mean(squares, axis=0)))

    def gap(self, effect: Mapping[str, float]) -> float:
        """Return the gap in floors: the RMS that the refit leaves; infinite where it cannot be simulated."""
        try:
            measured = self._whitened({}, effect)
        except SimulationError:
            return np.inf
        begin, _ = self._roughly(measured)
        found = least_squares(
            lambda moved: self._beside(measured, moved),
            begin,
            bounds=(-_FAR, _FAR),
            diff_step=_STEP,
            max_nfev=_REFITS,
        )
        return float(np.sqrt(np.mean(found.fun**2)))

    def _roughly(self, measured: Floats) -> tuple[Floats, float]:
        """Return parameters that come close to readings, with the derivatives of the plain plant, and the gap."""
        best, moved = (np.zeros(len(self._rig.parameters)), np.inf), np.zeros(len(self._rig.parameters))
        for _ in range(3):
            left = self._beside(measured, moved)
            size = float(np.sqrt(np.mean(left**2)))
            best = (moved, size) if size < best[1] else best
            moved = np.clip(moved + self._inverse @ left, -0.99 * _FAR, 0.99 * _FAR)
        return best

    def _beside(self, measured: Floats, moved: Floats) -> Floats:
        """Return the rest of readings that a model with such parameters leaves, a lot if it cannot simulate."""
        try:
            return measured - self._whitened(dict(zip(self._rig.parameters, moved.tolist(), strict=True)), {})
        except SimulationError:
            return np.full(len(measured), 1e6)

    def beside(self, effects: Mapping[str, float], other: Mapping[str, float]) -> float:
        """Return the gap in floors of `effects` to a model that has the `other` one of them, in any size.

        It is infinite where they cannot be simulated together, although each can.
        """
        try:
            return float(np.sqrt(np.mean(self._nearest(effects, other) ** 2)))
        except SimulationError:
            return np.inf

    def separation(
        self, effect: Mapping[str, float], other: Mapping[str, float], recordings: float, every: int = 1
    ) -> float:
        """Return by how many standard deviations an effect differs from another one.

        The size of the other one, and the parameters, are refitted to the readings with the effect, of
        which one sample in `every` is recorded.
        """
        return float(np.linalg.norm(self._nearest(effect, other, every)) * np.sqrt(recordings))

    def _nearest(self, effects: Mapping[str, float], other: Mapping[str, float], every: int = 1) -> Floats:
        """Return the rest of readings that an effect leaves whose size is refitted with the parameters."""
        names = self._rig.parameters
        measured = self._readings({}, effects)

        def left(x: Floats) -> Floats:
            try:
                found = self._readings(dict(zip(names, x[1:].tolist(), strict=True)), _scaled(other, float(x[0])))
            except SimulationError:
                found = measured - 1e6
            return decorrelated((measured - found)[..., ::every], self._noise).ravel()

        begin, _ = self._roughly(self._whitened({}, effects) - self._whitened({}, other) + self._plain)
        far = np.full(len(names), _FAR)
        bounds = [0.0, *-far], [_FURTHER, *far]
        found = least_squares(left, [1.0, *begin], bounds=bounds, diff_step=_STEP, max_nfev=_REFITS)
        return np.asarray(found.fun)

    def sized(
        self, unit: Mapping[str, float], target: float, *, sign: float = 1.0, shape: float = 1.0
    ) -> tuple[dict[str, float], float]:
        """Return an effect, given at unit size, at the size whose gap comes close to `target`, and that gap.

        Where no plausible size is large enough, the largest is taken.
        """
        most = _MOST.get(next(iter(unit)).partition("@")[0], np.inf)
        unit = {n: v * (shape if n.endswith(SHAPE) else sign) for n, v in unit.items()}
        at = partial(_scaled, unit)
        low, high, size = 0.0, np.inf, _FIRST
        for _ in range(40):
            gap = self._rough_gap(at(size))
            if abs(gap / target - 1.0) < _CLOSE or (gap < target and size >= most):
                break
            low, high = (size, high) if gap < target else (low, size)
            guess = size * float(np.clip(target / max(gap, 1e-12), 1e-2, 1e3))
            inside = low + 0.02 * (high - low) < guess < high - 0.02 * (high - low) if np.isfinite(high) else True
            size = min(guess if inside else np.sqrt(max(low, 1e-3 * high) * high), most)
        for _ in range(_CORRECTED):
            gap = self.gap(at(size))
            if abs(gap / target - 1.0) < _CLOSE or (gap < target and size >= most):
                break
            size = min(size * float(np.clip(target / max(gap, 1e-12), 0.3, 3.0)), most)
        else:
            gap = self.gap(at(size))
        return at(size), gap

    def _rough_gap(self, effect: Mapping[str, float]) -> float:
        try:
            return self._roughly(self._whitened({}, effect))[1]
        except SimulationError:
            return np.inf


def _scaled(effect: Mapping[str, float], size: float) -> dict[str, float]:
    """Return an effect at so many times its size, of the same shape."""
    return {n: v if n.endswith(SHAPE) else size * v for n, v in effect.items()}
