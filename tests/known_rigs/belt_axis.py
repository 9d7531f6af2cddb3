"""A motor moves a carriage by a belt; encoder at the motor, linear scale at the carriage."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tests.known_rigs.plant import Extra, Floats, Rig, acting, delayed, hidden_start, integrate, random_steps


def _simulate(
    factors: Mapping[str, float],
    effect: Mapping[str, float],
    time: Floats,
    u: Floats,
    extra: Extra | None = None,
) -> Floats:
    k, r, j, c, m, v0 = (
        factors[name] * value
        for name, value in (("k", 0.12), ("r", 0.02), ("J", 1.2e-4), ("c", 6e4), ("m", 1.5), ("viscous", 4.0))
    )
    e = {
        "stribeck": 0.0, "speed": 0.05, "gap": 0.0, "cogging": 0.0, "weight": 0.0, "delay": 0.0, "bristle": 0.0,
        "damping": 40.0,
        **effect,
    }  # fmt: skip

    def slope(x: Floats, i: float, t: float) -> list[float]:
        phi, w, s, v, z, *hidden = x
        stretch, rate = s - r * phi, v - r * w
        if e["gap"]:
            free = min(max(stretch, -e["gap"]), e["gap"])
            stretch, rate = stretch - free, rate if abs(stretch) > e["gap"] else 0.0
        belt = c * stretch + e["damping"] * rate
        direction = np.tanh(v / 0.005)
        friction = v0 * v + 3.0 * direction + e["stribeck"] * direction * np.exp(-((v / e["speed"]) ** 2))
        friction += e["bristle"] * z
        places = {
            "carriage": {"p": s, "rate": v, "i": i},
            "rotor": {"p": phi, "rate": w, "i": i},
            "belt": {"p": stretch, "rate": rate, "i": i},  # flows from the carriage to the pulley
        }
        more, rates = acting(extra, places, hidden, t)
        belt += more["belt"]
        torque = k * i + r * belt - e["cogging"] * np.sin(12 * phi + 0.7)
        drive = torque - more["rotor"]
        force = -belt - friction - e["weight"] - more["carriage"]
        return [w, drive / j, v, force / m, (v - abs(v) * z) / 2e-3, *rates]

    x = integrate(slope, [0.0] * 5 + list(hidden_start(extra)), time, delayed(time, u, e["delay"]), steps=16)
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
        "value@belt.d": {"damping": 80.0},
    },
    ("k", "r", "J", "c", "m", "viscous"),
    _simulate,
    {"value@belt.d": ("viscous@belt",)},
)
