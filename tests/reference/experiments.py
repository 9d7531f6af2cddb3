"""Experiments the reference is tested with: one or more of each setup, in the manner of the paper."""

from __future__ import annotations

import numpy as np

from fmuid.simulation.simulator import Task

LOSSY = {
    f"lossTable[{row},{column}]": value
    for row, values in enumerate(
        [
            (0.95, 0.92, 0.095, 0.093),
            (0.979, 0.945, 0.086781, 0.086781),
            (0.9625, 0.92125, 0.090313, 0.088438),
            (0.854, 0.847, 0.0565, 0.049),
            (0.88, 0.86, 0.06, 0.055),
            (0.9, 0.89, 0.08, 0.08),
            (0.91, 0.9, 0.15, 0.15),
        ],
        start=1,
    )
    for column, value in enumerate(values, start=2)
}
CONSTANT_FRICTION = {f"lossTable[{row},{column}]": 0.09 for row in range(1, 8) for column in (4, 5)}


def prbs(amplitude: float, count: int, hold: int, seed: int = 3) -> np.ndarray:
    """Return `count` samples of a random telegraph signal that may switch every `hold` samples."""
    bits = np.random.default_rng(seed).integers(0, 2, -(-count // hold)) * 2 - 1
    return amplitude * np.repeat(bits, hold)[:count]


def _time(stop: float, interval: float) -> np.ndarray:
    return np.arange(round(stop / interval) + 1) * interval


def fixed_shaft(kind: str) -> Task:
    time = _time(0.2 if kind == "step" else 0.5, 1e-3)
    current = {
        "step": np.full(time.size, 0.5),
        "sine": 0.75 * np.sin(2 * np.pi * 10 * time),
        "prbs": prbs(0.8, time.size, 5),
    }[kind]
    return Task(time, {"i_cmd": current}, ("tau_sensor", "w_motor"))


def free_shaft() -> Task:
    time = _time(3.0, 2e-3)
    steps = np.array([0.0, 20.0, 150.0, -30.0, -300.0, 5.0])
    w_ref = steps[np.minimum((time / 0.5).astype(int), steps.size - 1)]
    return Task(time, {"w_ref": w_ref}, ("i_motor", "w_motor", "tau_sensor"))


def eccentric_load() -> Task:
    time = _time(20.0, 1e-2)
    w_ref = np.where(time < 9.0, 25.0, -25.0)
    start = {"mgr": 35.5}
    return Task(time, {"w_ref": w_ref}, ("i_motor", "w_motor", "tau_sensor", "phi_load"), start)


def axis_reference(time: np.ndarray) -> np.ndarray:
    """Return a back-and-forth motion in m, in the manner of EMPS."""
    return 0.1 * (1 - np.cos(2 * np.pi * time / 2.0))


def axis_closed_loop() -> Task:
    time = _time(2.0, 1e-3)
    pulses = np.where((time % 1.0 > 0.3) & (time % 1.0 < 0.35), 3.0, 0.0)
    inputs = {"qg": axis_reference(time), "pulses": pulses}
    return Task(time, inputs, ("qm", "v", "vir", "force"), interpolation="linear")


def axis_open_loop() -> Task:
    time = _time(2.0, 1e-3)
    voltage = 4.0 * np.cos(2 * np.pi * time / 2.0)
    return Task(time, {"vir": voltage}, ("qm", "v", "force"))
