"""A motor moves a carriage by a belt; encoder at the motor, linear scale at the carriage."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.abroad.plant import Floats, Rig, delayed, integrate, random_steps

_K, _J, _R, _C, _D, _M, _V, _F = 0.12, 1.2e-4, 0.02, 6e4, 40.0, 1.5, 4.0, 3.0


def _simulate(factors: Mapping[str, float], effect: Mapping[str, float], time: Floats, u: Floats) -> Floats:
    j, c, d, m, v0, f0 = (
        factors[name] * value
        for name, value in (("J", _J), ("c", _C), ("d", _D), ("m", _M), ("viscous", _V), ("dry", _F))
    )
    e = {
        "stribeck": 0.0,
        "speed": 0.05,
        "gap": 0.0,
        "cogging": 0.0,
        "weight": 0.0,
        "delay": 0.0,
        "bristle": 0.0,
    } | dict(effect)

    def slope(x: Floats, i: float, _: float) -> list[float]:
        phi, w, s, v, z = x
        stretch, rate = s - _R * phi, v - _R * w
        if e["gap"]:
            free = min(max(stretch, -e["gap"]), e["gap"])
            stretch, rate = stretch - free, rate if abs(stretch) > e["gap"] else 0.0
        belt = c * stretch + d * rate
        direction = np.tanh(v / 0.005)
        friction = v0 * v + f0 * direction + e["stribeck"] * direction * np.exp(-((v / e["speed"]) ** 2))
        friction += e["bristle"] * z
        torque = _K * i + _R * belt - e["cogging"] * np.sin(12 * phi + 0.7)
        return [w, torque / j, v, (-belt - friction - e["weight"]) / m, (v - abs(v) * z) / 2e-3]

    x = integrate(slope, [0.0] * 5, time, delayed(time, u, e["delay"]), steps=16)
    return x[[0, 2]]


_TIME = np.arange(0.0, 1.5, 0.002)
BELT_AXIS = Rig(
    "belt axis",
    "BeltAxis",
    _TIME,
    {
        "slow": 1.6 * np.sin(2 * np.pi * 1.0 * _TIME),
        "fast": 3.0 * np.sin(2 * np.pi * 3.0 * _TIME),
        "levels": random_steps(_TIME, 0.06, 3.0, seed=1),
        "jumps": random_steps(_TIME, 0.15, 2.5, seed=2),
    },
    {"i": "A", "phi": "rad", "s": "m"},
    (2e-3, 5e-5),
    {
        "stribeck@carriage": {"stribeck": 1.0},
        "backlash@belt": {"gap": 2e-4},
        "cogging@rotor": {"cogging": 0.006},
        "weight@carriage": {"weight": 0.5},
        "delay@i": {"delay": 0.004},
        "presliding@carriage": {"bristle": 0.8},
    },
    ("J", "c", "d", "m", "viscous", "dry"),
    _simulate,
    {"weight@carriage": ("weight@pulley.rim",)},
)
