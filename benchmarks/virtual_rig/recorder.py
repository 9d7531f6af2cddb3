"""What the rig's sensors make of a run: noise, offsets, encoder counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.virtual_rig.library import Channel
from benchmarks.virtual_rig.rig import Run
from fmuid.core.experiments import Signal
from fmuid.core.immutable import FloatArray


@dataclass(frozen=True, slots=True)
class Sensors:
    """The rig's sensors; standard deviations unless said otherwise, zero for a perfect one.

    Parameters
    ----------
    torque_noise
        White noise of the torque sensor, N.m.
    torque_drift, drift_time
        Coloured noise of the torque sensor, N.m, and its correlation time in s.
    torque_offset
        Offset of the torque sensor from run to run, N.m.
    current_noise
        White noise of the recorded current command, A.
    motor_counts, load_counts
        Counts a turn of the encoders; the motor's is differentiated over the neighbouring samples.
    """

    torque_noise: float = 0.1
    torque_drift: float = 0.0
    drift_time: float = 0.02
    torque_offset: float = 0.03
    current_noise: float = 0.004
    motor_counts: float = 16384.0
    load_counts: float = 20000.0

    def torque_sigma(self) -> float:
        """Return the standard deviation of the torque signal within a run, N.m."""
        return float(np.hypot(self.torque_noise, self.torque_drift))

    def speed_sigma(self, interval: float) -> float:
        """Return the standard deviation that counting leaves in the motor speed, rad/s."""
        return 2 * np.pi / self.motor_counts / interval / float(np.sqrt(24.0))

    def load_sigma(self) -> float:
        """Return the standard deviation that counting leaves in the load angle, rad."""
        return 2 * np.pi / self.load_counts / float(np.sqrt(12.0))


def _drift(sensors: Sensors, interval: float, n: int, rng: np.random.Generator) -> FloatArray:
    """First-order coloured noise of standard deviation `torque_drift`."""
    keep = float(np.exp(-interval / sensors.drift_time))
    noise = rng.standard_normal(n) * np.sqrt(1 - keep**2)
    noise[0] = rng.standard_normal()
    for k in range(1, n):
        noise[k] += keep * noise[k - 1]
    return np.asarray(sensors.torque_drift * noise)


def record(run: Run, sensors: Sensors, rng: np.random.Generator, *, sigmas: bool = True) -> dict[str, Signal]:
    """Return the signals that the sensors of this setup record of `run`, its input among them.

    The encoder starts at any angle; its counts are differentiated centrally (to one side at the ends).
    """
    n, interval = len(run.time), float(run.time[1] - run.time[0])
    torque = run[Channel.TAU_SENSOR] + sensors.torque_noise * rng.standard_normal(n)
    torque += sensors.torque_offset * rng.standard_normal()
    if sensors.torque_drift > 0:
        torque += _drift(sensors, interval, n, rng)
    count = 2 * np.pi / sensors.motor_counts
    counts = np.floor(run[Channel.THETA] / count + rng.random())
    speed = np.gradient(counts, interval) * count

    def output(name: str, values: FloatArray, unit: str, sigma: float) -> Signal:
        return Signal(name, values, unit, "output", sigma if sigmas else None)

    fixed = run.setup == "fixed_shaft"
    name, unit = ("i_cmd", "A") if fixed else ("w_ref", "rad/s")
    signals = [
        Signal(name, run.inputs, unit, "input"),
        output("tau_sensor", torque, "N.m", sensors.torque_sigma()),
        output("w_motor", speed, "rad/s", sensors.speed_sigma(interval)),
    ]
    if not fixed:
        current = run[Channel.I_MOTOR] + sensors.current_noise * rng.standard_normal(n)
        signals.append(output("i_motor", current, "A", sensors.current_noise))
    if run.setup == "eccentric_load":
        count = 2 * np.pi / sensors.load_counts
        angle = np.round(run[Channel.PHI_LOAD] / count) * count
        signals.append(output("phi_load", angle, "rad", sensors.load_sigma()))
    return {signal.name: signal for signal in signals}
