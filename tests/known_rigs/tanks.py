"""A pump fills a tank that drains into another; both levels are read."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tests.known_rigs.plant import Extra, Floats, Rig, acting, hidden_start, integrate, steps

_G = 9.81


def _simulate(
    factors: Mapping[str, float],
    effect: Mapping[str, float],
    time: Floats,
    u: Floats,
    extra: Extra | None = None,
) -> Floats:
    k, s1, s2, lower_section = (
        factors[name] * value
        for name, value in (("pump", 3e-6), ("first", 8e-6), ("second", 8e-6), ("lower", 2e-3))
    )
    e = {"offset": 0.0, "drift": 0.0, "rim": 0.0, "dead": 0.0, "lag": 0.0, "limit": 0.0} | dict(effect)
    drive = u - np.clip(u, -e["dead"], e["dead"])
    drive = np.minimum(drive, e["limit"]) if e["limit"] else drive

    def slope(x: Floats, volts: float, t: float) -> list[float]:
        upper, lower, flow, *hidden = x
        places = {
            "upper": {"p": upper, "u": volts},
            "lower": {"p": lower, "u": volts},
            "first": {"p": lower - upper, "u": volts},  # flows from the lower to the upper tank
        }
        more, rates = acting(extra, places, hidden, t)
        pumped = k * (flow if e["lag"] else volts)
        first, second = (s * np.sqrt(2 * _G * max(h, 0.0)) for s, h in ((s1, upper), (s2, lower)))
        out = 1e-3 * max(upper - e["rim"], 0.0) if e["rim"] else 0.0
        behind = (volts - flow) / e["lag"] if e["lag"] else 0.0
        return [
            (pumped - first - out - more["upper"] + more["first"]) / 2e-3,
            (first - second - more["lower"] - more["first"]) / lower_section,
            behind,
            *rates,
        ]

    upper, lower, *_ = integrate(slope, [0.05, 0.05, drive[0], *hidden_start(extra)], time, drive, steps=4)
    return np.stack([upper + e["offset"], lower + e["drift"] * time])


_TIME = np.arange(0.0, 2400.0, 4.0)
# No tank runs empty, not even with a dead zone: the plain model would let its level sink below the bottom.
TANKS = Rig(
    "tanks",
    "Tanks",
    _TIME,
    {
        "stairs": steps(_TIME, [3.0, 5.0, 0.8, 6.0, 4.0, 1.0]),
        "down": steps(_TIME, [6.5, 5.0, 3.5, 2.0, 0.9, 3.0]),
        "wave": 3.5 + 2.5 * np.sign(np.sin(2 * np.pi * _TIME / 500.0)) * np.abs(np.sin(2 * np.pi * _TIME / 900.0)),
        "pulses": np.where(_TIME % 400.0 < 200.0, 6.0, 1.0),
    },
    {"u": "V", "h_upper": "m", "h_lower": "m"},
    (5e-4, 5e-4),
    {
        "offset@h_upper": {"offset": 0.006},
        "overflow@upper": {"rim": 0.2},
        "dead_zone@u": {"dead": 0.4},
        "lag@u": {"lag": 15.0},
        "saturation@u": {"limit": 5.5},
        "drift@h_lower": {"drift": 0.01 / 2400.0},
    },
    ("pump", "first", "second", "lower"),
    _simulate,
)
