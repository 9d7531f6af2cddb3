"""How large a gap an effect leaves in the rig's own signals once the nominal parameters are refitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.virtual_rig.library import Channel
from benchmarks.virtual_rig.recorder import Sensors
from benchmarks.virtual_rig.rig import Rig
from benchmarks.virtual_rig.rig_plan import PlannedExperiment, run_planned
from fmuid.core.immutable import FloatArray

NOMINAL = ("d_S", "J_S", "d_G", "tau_bf")
_COARSER = 2.0  # steps twice as long: a gap need not be known better than to a few per cent


def with_nominal(rig: Rig, values: Sequence[float]) -> Rig:
    """Return the rig with other values of `NOMINAL`; tau_bf is the friction of the whole loss table."""
    d_s, j_s, d_g, tau = values
    table = np.array(rig.loss_table)
    table[:, 3:] = tau
    return Rig(table, {**rig.parameters, "d_S": d_s, "J_S": j_s, "d_G": d_g})


def nominal_of(rig: Rig) -> tuple[float, float, float, float]:
    """Return the rig's values of `NOMINAL`."""
    p = rig.parameters
    return p["d_S"], p["J_S"], p["d_G"], float(rig.loss_table[0, 3])


class Gap:
    """The whitened response of one actuator to its nominal parameters, and the gap of any effect added to it.

    The floor is the sensors' own: white noise and counting within a run, and the offset of the torque sensor
    from run to run for the mean of its signal.

    Parameters
    ----------
    rig
        The actuator without any effect.
    load_encoder
        Whether `phi_load` is recorded.
    """

    def __init__(
        self, rig: Rig, sensors: Sensors, experiments: Sequence[PlannedExperiment], *, load_encoder: bool
    ) -> None:
        self._sensors, self._experiments, self._load_encoder = sensors, tuple(experiments), load_encoder
        self._plain = self.whitened(rig)
        nominal = np.array(nominal_of(rig))
        columns = []
        for k, value in enumerate(nominal):
            moved = nominal.copy()
            moved[k] = 1.01 * value
            columns.append(self.whitened(with_nominal(rig, moved.tolist())) - self._plain)
        # Orthonormal directions of the refit: what is along them, nominal parameters can close.
        self._directions = np.linalg.qr(np.column_stack(columns))[0]

    def whitened(self, rig: Rig) -> FloatArray:
        """Return every recorded signal of every experiment in units of the floor, as one vector."""
        parts = []
        for planned in self._experiments:
            run = run_planned(rig, planned, preceding=True, coarser=_COARSER)
            n, noise = len(run.time), self._sensors
            torque = run[Channel.TAU_SENSOR]
            mean = torque.mean()
            offset = np.hypot(noise.torque_offset, noise.torque_noise / np.sqrt(n))
            parts += [(torque - mean) / noise.torque_noise, np.array([mean / offset])]
            speed = np.gradient(run[Channel.THETA], planned.interval)
            parts.append(speed / noise.speed_sigma(planned.interval))
            if planned.setup != "fixed_shaft":
                parts.append(run[Channel.I_MOTOR] / noise.current_noise)
            if planned.setup == "eccentric_load" and self._load_encoder:
                parts.append(run[Channel.PHI_LOAD] / noise.load_sigma())
        return np.concatenate(parts)

    def of(self, rig: Rig) -> float:
        """Return the gap of `rig` in floors: the RMS of what the refit leaves of its whitened difference."""
        difference = self.whitened(rig) - self._plain
        left = difference - self._directions @ (self._directions.T @ difference)
        return float(np.sqrt(np.mean(left**2)))

    def magnitude(
        self, put: Callable[[float], Rig], low: float, high: float, target: float
    ) -> tuple[float, float]:
        """Return the magnitude in [low, high] whose gap comes within 5 % of `target`, and that gap.

        Where no magnitude in the range is large enough (or small enough), the end of the range is taken.
        """
        below, above = (np.log(low), 0.0), (np.log(high), self.of(put(high)))
        if above[1] <= target:
            return high, above[1]
        x, gap = above
        for _ in range(12):
            guess = x + np.log(target / max(gap, 1e-6))  # a gap in proportion to the magnitude
            inside = below[0] + 0.02 * (above[0] - below[0]), above[0] - 0.02 * (above[0] - below[0])
            x = float(np.clip(guess, *inside))
            gap = self.of(put(float(np.exp(x))))
            if abs(gap / target - 1) < 0.05:
                break
            below, above = ((x, gap), above) if gap < target else (below, (x, gap))
        return float(np.exp(x)), gap
