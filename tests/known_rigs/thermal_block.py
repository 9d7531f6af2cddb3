"""A heated block in a casing, over hours: thermocouples in the block and on the casing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tests.known_rigs.plant import Extra, Floats, Rig, acting, hidden_start, integrate, lagged, steps

_ROOM = 293.15


def _simulate(
    factors: Mapping[str, float],
    effect: Mapping[str, float],
    time: Floats,
    u: Floats,
    extra: Extra | None = None,
) -> Floats:
    c1, c2, g1, g2 = (
        factors[name] * value
        for name, value in (("body", 1500.0), ("casing", 2500.0), ("wall", 1.2), ("air", 0.8))
    )
    e = {
        "radiation": 0.0,
        "hidden": 0.0,
        "contact": 0.5,
        "loss": 0.0,
        "lag": 0.0,
        "drift": 0.0,
        "gain": 1.0,
        "bend": 0.0,
    } | dict(effect)

    def slope(x: Floats, power: float, t: float) -> list[float]:
        body, casing, third, *hidden = x
        places = {
            "body": {"p": body - _ROOM, "P": power},
            "casing": {"p": casing - _ROOM, "P": power},
            "wall": {"p": casing - body, "P": power},  # flows from the casing to the body
        }
        more, rates = acting(extra, places, hidden, t)
        through = g1 * (body - casing)
        beside = e["contact"] * (body - third) if e["hidden"] else 0.0
        out = g2 * (casing - _ROOM) + e["radiation"] * (casing**4 - _ROOM**4)
        heat = power / (1.0 + (e["bend"] * power) ** 4) ** 0.25
        return [
            (heat - through - beside - e["loss"] * (body - _ROOM) - more["body"] + more["wall"]) / c1,
            (through - out - more["casing"] - more["wall"]) / c2,
            beside / e["hidden"] if e["hidden"] else 0.0,
            *rates,
        ]

    x = integrate(slope, [_ROOM] * 3 + list(hidden_start(extra)), time, u, steps=4)
    body = lagged(time, x[0], e["lag"]) if e["lag"] else x[0]
    return np.stack([body, x[1] + e["drift"] * time])


_TIME = np.arange(0.0, 5 * 3600.0, 30.0)
THERMAL_BLOCK = Rig(
    "thermal block",
    "ThermalBlock",
    _TIME,
    {
        "full": np.where(_TIME < 9000.0, 60.0, 0.0),
        "half": np.where((_TIME > 1800.0) & (_TIME < 12600.0), 30.0, 0.0),
        "stairs": steps(_TIME, [10.0, 50.0, 20.0, 60.0, 0.0, 40.0]),
        "pulses": np.where(_TIME % 3600.0 < 1200.0, 55.0, 5.0),
    },
    {"P": "W", "T_body": "K", "T_casing": "K"},
    (0.05, 0.05),
    {
        "radiation@casing": {"radiation": 3e-9},
        "capacity@body": {"hidden": 400.0},
        "loss@body": {"loss": 0.15},
        "lag@T_body": {"lag": 60.0},
        "drift@T_casing": {"drift": 1.0 / 18000.0},
        "saturation@P": {"bend": 1.0 / 75.0},
    },
    ("body", "casing", "wall", "air"),
    _simulate,
)
