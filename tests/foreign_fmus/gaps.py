"""Ten effects for each of four rigs, and the ids of a right answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.foreign_fmus.plants import Floats, Gap


def at(state: int, n: int, flow: Callable[[Floats, Floats], float]) -> Gap:
    """Return a gap at one of n states."""
    return Gap(lambda x, z: np.eye(n)[state] * flow(x, z))


def with_hidden(
    gap: Gap, slope: Callable[[Floats, Floats, Floats], float], start: Callable[[Floats], float]
) -> Gap:
    """Return a gap with a hidden state."""
    return replace(gap, hidden=lambda x, u, z: np.array([slope(x, u, z)]), start=lambda x, u: np.array([start(x)]))


def lagging_input(time: float) -> Gap:
    """Return a gap whose first input lags."""
    return Gap(
        hidden=lambda x, u, z: (u[:1] - z) / time,
        start=lambda x, u: u[:1],
        drive=lambda u, z: np.concatenate([z, u[1:]]),
    )


def of_input(changed: Callable[[float], float], column: int = 0) -> Gap:
    """Return a gap with another value of an input."""

    def drive(u: Floats, z: Floats) -> Floats:
        new = np.array(u, dtype=float)
        new[column] = changed(u[column])
        return new

    return Gap(drive=drive)


def of_sensor(state: int, shown: Callable[[Floats, Floats, Floats], Floats]) -> Gap:
    """Return a gap of a sensor: its reading for the state's course, the inputs and the times."""

    def reads(x: Floats, u: Floats, t: Floats, z: Floats) -> Floats:
        new = x.copy()
        new[state] = shown(x[state], u, t)
        return new

    return Gap(reads=reads)


def lagging_sensor(state: int, time: float) -> Gap:
    """Return a gap whose sensor lags."""

    def reads(x: Floats, u: Floats, t: Floats, z: Floats) -> Floats:
        new = x.copy()
        new[state] = z[0]
        return new

    return Gap(
        hidden=lambda x, u, z: (x[state : state + 1] - z) / time,
        start=lambda x, u: x[state : state + 1],
        reads=reads,
    )


def _bristle(speed: float, z: Floats) -> float:
    return float(speed * (1.0 - np.sign(speed) * z[0] / 0.01))  # Dahl's model, 0.01 rad


GAPS: dict[str, dict[str, Gap]] = {
    "DRIVE": {
        "coulomb@der(w2)": at(3, 4, lambda x, z: -4 * np.tanh(x[3] / 0.02)),
        "stribeck@der(w1)": at(2, 4, lambda x, z: -(5 + 5 * np.exp(-((x[2] / 1.5) ** 2))) * np.tanh(x[2] / 0.02)),
        "quadratic@der(w2)": at(3, 4, lambda x, z: -0.05 * x[3] * abs(x[3])),
        "weight@der(w2)": at(3, 4, lambda x, z: -12 * np.sin(x[1])),
        "cogging@der(w1)": at(2, 4, lambda x, z: -8 * np.sin(8 * x[0])),
        "presliding@der(w2)": with_hidden(
            at(3, 4, lambda x, z: -5 * z[0] / 0.01), lambda x, u, z: _bristle(x[3], z), lambda x: 0.0
        ),
        "viscous@der(w1)": at(2, 4, lambda x, z: -1.5 * x[2]),
        "viscous_asymmetry@der(w2)": at(3, 4, lambda x, z: -1.0 * x[3] - 0.4 * abs(x[3])),
        "lag@tau": lagging_input(0.008),
        "gain@w2": of_sensor(3, lambda y, u, t: 1.08 * y),
    },
    "HOUSE": {
        "loss@der(T_room)": at(0, 2, lambda x, z: -1.0e-4 * (x[0] - 293)),
        "radiation@der(T_room)": at(0, 2, lambda x, z: -1.2e-12 * (x[0] ** 4 - 285.0**4)),
        "loss@der(T_wall)": at(1, 2, lambda x, z: -5e-6 * (x[1] - 284)),
        "radiation@der(T_wall)": at(1, 2, lambda x, z: -1.5e-13 * (x[1] ** 4 - 280.0**4)),
        "capacity@der(T_room)": with_hidden(
            at(0, 2, lambda x, z: -1.5e-4 * (x[0] - z[0])), lambda x, u, z: (x[0] - z[0]) / 9e3, lambda x: x[0]
        ),
        "capacity@der(T_wall)": with_hidden(
            at(1, 2, lambda x, z: -2e-5 * (x[1] - z[0])), lambda x, u, z: (x[1] - z[0]) / 4e4, lambda x: x[1]
        ),
        "lag@T_room": lagging_sensor(0, 600.0),
        "delay@P_heat": Gap(late=2),
        "saturation@P_heat": of_input(lambda u: min(u, 1050.0)),
        "offset@T_out": of_input(lambda u: u + 3.0, 1),
    },
    "CIRCUIT": {
        "voltage_drop@der(i)": at(0, 2, lambda x, z: -60 * np.tanh(x[0] / 0.02)),
        "eddy@der(i)": with_hidden(
            at(0, 2, lambda x, z: -80.0 * (x[0] - z[0])), lambda x, u, z: (x[0] - z[0]) / 4e-3, lambda x: 0.0
        ),
        "capacity@der(v)": with_hidden(
            at(1, 2, lambda x, z: -60 * (x[1] - z[0])), lambda x, u, z: (x[1] - z[0]) / 0.02, lambda x: 0.0
        ),
        "dead_zone@v_in": of_input(lambda u: u - np.clip(u, -0.8, 0.8)),
        "saturation@v_in": of_input(lambda u: float(np.clip(u, -7.5, 7.5))),
        "delay@v_in": Gap(late=1),
        "lag@v_in": lagging_input(1.5e-3),
        "offset@v": of_sensor(1, lambda y, u, t: y + 0.3),
        "lag@i": lagging_sensor(0, 1.5e-3),
        "crosstalk@v": of_sensor(1, lambda y, u, t: y + 0.03 * u[0]),
    },
    "TANK": {
        "leakage@der(h1)": at(0, 2, lambda x, z: -6e-3 * x[0]),
        "leakage@der(h2)": at(1, 2, lambda x, z: -6e-3 * x[1]),
        "overflow@der(h1)": at(0, 2, lambda x, z: -0.1 * max(x[0] - 0.35, 0.0)),
        "overflow@der(h2)": at(1, 2, lambda x, z: -0.1 * max(x[1] - 0.4, 0.0)),
        "saturation@q": of_input(lambda u: min(u, 8e-4)),
        "lag@q": lagging_input(15.0),
        "delay@q": Gap(late=4),
        "lag@h1": lagging_sensor(0, 10.0),
        "offset@h1": of_sensor(0, lambda y, u, t: y + 0.02),
        "lag@h2": lagging_sensor(1, 10.0),
    },
}  # fmt: skip
"""Gaps by rig, and by the id of a right answer."""
