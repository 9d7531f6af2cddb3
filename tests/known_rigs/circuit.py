"""An amplifier drives a damped resonant circuit; voltage of the capacitor and current are read."""

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
    r, inductance, c = (factors[name] * value for name, value in (("R", 20.0), ("L", 0.02), ("C", 5e-6)))
    e = {"leak": 0.0, "limit": 0.0, "delay": 0.0, "share": 0.0, "stray": 0.0, "drop": 0.0, "offset": 0.0} | dict(
        effect
    )
    drive = np.clip(u, -e["limit"], e["limit"]) if e["limit"] else u

    def slope(x: Floats, volts: float, t: float) -> list[float]:
        v, i, middle, *hidden = x
        places = {"capacitor": {"p": v, "u": volts}}
        more, rates = acting(extra, places, hidden, t)
        drop = e["drop"] * np.tanh(i / 1e-3)
        if e["stray"]:  # between resistor and inductor
            return [
                (i - e["leak"] * v - more["capacitor"]) / c,
                (middle - v) / inductance,
                ((volts - drop - middle) / r - i) / e["stray"],
                *rates,
            ]
        return [
            (i - e["leak"] * v - more["capacitor"]) / c,
            (volts - drop - r * i - v) / inductance,
            0.0,
            *rates,
        ]

    x = integrate(
        slope, [0.0, 0.0, drive[0], *hidden_start(extra)], time, delayed(time, drive, e["delay"]), steps=20
    )
    return np.stack([x[0] + e["share"] * u, x[1] + e["offset"]])


_TIME = np.arange(0.0, 0.02, 2e-5)
CIRCUIT = Rig(
    "RLC circuit",
    "Circuit",
    _TIME,
    {
        "chirp": 5.0 * np.sin(2 * np.pi * (100.0 + 2e4 * _TIME) * _TIME),
        "steps": random_steps(_TIME, 1e-3, 5.0, seed=3),
        "small": random_steps(_TIME, 4e-4, 2.0, seed=4),
        "sine": 4.0 * np.sin(2 * np.pi * 300.0 * _TIME),
    },
    {"u": "V", "v": "V", "i": "A"},
    (5e-3, 2e-4),
    {
        "leakage@capacitor": {"leak": 1e-3},
        "saturation@u": {"limit": 4.0},
        "delay@u": {"delay": 4e-5},
        "crosstalk@v": {"share": 0.02},
        "capacity@resistor.n": {"stray": 2e-6},
        "voltage_drop@source": {"drop": 0.3},
    },
    ("R", "L", "C"),
    _simulate,
    {
        "leakage@capacitor": ("leakage@inductor.n",),
        "voltage_drop@source": ("voltage_drop@resistor", "voltage_drop@inductor", "voltage_drop@capacitor"),
    },
)
