"""A voice coil shakes a table on a suspension; a specimen stands on it on a mount. Lasers read both positions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tests.known_rigs.plant import Extra, Floats, Rig, acting, hidden_start, integrate, random_steps


def _simulate(
    factors: Mapping[str, float],
    effect: Mapping[str, float],
    time: Floats,
    u: Floats,
    extra: Extra | None = None,
) -> Floats:
    del effect  # the rig has laws alone
    table, specimen, c_below, d_below, c_above, d_above = (
        factors[name] * value
        for name, value in (("M", 0.5), ("m", 0.2), ("C", 2000.0), ("D", 10.0), ("c", 3000.0), ("d", 3.0))
    )

    def slope(x: Floats, i: float, t: float) -> list[float]:
        s, v, s_up, v_up, *hidden = x
        places = {
            "table": {"p": s, "rate": v, "i": i},
            "specimen": {"p": s_up, "rate": v_up, "i": i},
            "mount": {"p": s_up - s, "rate": v_up - v, "i": i},  # flows from the specimen to the table
        }
        more, rates = acting(extra, places, hidden, t)
        above = c_above * (s_up - s) + d_above * (v_up - v) + more["mount"]
        below = 10.0 * i - c_below * s - d_below * v + above - more["table"]
        return [v, below / table, v_up, (-above - more["specimen"]) / specimen, *rates]

    return integrate(slope, [0.0] * 4 + list(hidden_start(extra)), time, u, steps=8)[[0, 2]]


_TIME = np.arange(0.0, 1.2, 0.001)
SHAKER = Rig(
    "shaker",
    "Shaker",
    _TIME,
    {
        "chirp": 2.0 * np.sin(2 * np.pi * (2.0 + 10.0 * _TIME) * _TIME),
        "steps": random_steps(_TIME, 0.05, 3.0, seed=5),
        "bursts": random_steps(_TIME, 0.02, 3.0, seed=6),
        "sine": 1.5 * np.sin(2 * np.pi * 8.0 * _TIME),
    },
    {"i": "A", "s_table": "m", "s_specimen": "m"},
    (2e-5, 2e-5),
    {},
    ("M", "m", "C", "D", "c", "d"),
    _simulate,
)
