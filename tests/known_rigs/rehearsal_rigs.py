"""The home rigs with every kind of effect, and plants in C."""

from __future__ import annotations

import numpy as np

from tests.known_rigs.compiled import CompiledPlant, Place
from tests.known_rigs.compiled_rig import compiled_rig, times
from tests.known_rigs.plant import Rig, random_steps, steps


def _belt_axis() -> Rig:
    plant = CompiledPlant(
        "BeltAxis",
        {
            "motor.k": 0.12,
            "pulley.r": 0.02,
            "rotor.J": 1.2e-4,
            "belt.c": 6e4,
            "belt.d": 40.0,
            "carriage.m": 1.5,
            "carriage.d": 4.0,
            "carriage.F": 3.0,
        },
        ("i",),
        ("phi", "s"),
        {
            "rotor": Place(0, 5.0, 30.0, turning=True),
            "carriage": Place(1, 0.1, 0.5),
            "belt": Place(2, 5e-4, 0.02),
        },
        substeps=16,
    )
    t = times(0.002, 750)
    runs = {
        "slow": 1.6 * np.sin(2 * np.pi * 1.0 * t),
        "fast": 3.0 * np.sin(2 * np.pi * 3.0 * t),
        "levels": random_steps(t, 0.06, 3.0, seed=1),
        "jumps": random_steps(t, 0.15, 2.5, seed=2),
        "cycle": random_steps(t, 0.1, 2.2, seed=3),
    }
    return compiled_rig(
        "belt axis",
        plant,
        0.002,
        runs,
        units={"i": "A", "phi": "rad", "s": "m"},
        noise={"phi": 2e-3, "s": 5e-5},
        inside=(
            "stribeck@carriage",
            "backlash@belt",
            "cogging@rotor",
            "weight@carriage",
            "asymmetry@carriage",
            "quadratic@carriage",
            "presliding@carriage",
            "delay@i",
            "lag@i",
            "saturation@i",
            "lag@phi",
            "offset@s",
        ),
        held=("belt.d",),
        outside=(
            "resonator@carriage",
            "wear@carriage",
            "pulsation@carriage",
            "relay@carriage",
            "chaos@rotor",
            "slip@carriage",
        ),
        same={
            "weight@carriage": ("offset@i", "asymmetry@carriage"),
            "asymmetry@carriage": ("offset@i", "weight@carriage"),
            "value@belt.d": ("viscous@belt",),
        },
        near={
            "weight@carriage": ("asymmetry@rotor",),
            "asymmetry@carriage": ("asymmetry@rotor",),
            "quadratic@carriage": ("quadratic@rotor",),
            "stribeck@carriage": ("stribeck@rotor",),
            "presliding@carriage": ("presliding@rotor", "coulomb@carriage", "coulomb@rotor"),
            "delay@i": ("lag@i",),
            "lag@i": ("delay@i",),
            "lag@phi": ("delay@phi",),
        },
    )


def _thermal_block() -> Rig:
    plant = CompiledPlant(
        "ThermalBlock",
        {"body.C": 1500.0, "casing.C": 2500.0, "wall.G": 1.2, "air.G": 0.8},
        ("P",),
        ("T_body", "T_casing"),
        {"body": Place(0, 40.0, 40.0), "casing": Place(1, 30.0, 30.0)},
        substeps=4,
        zero=293.15,
    )
    t = times(30.0, 600)
    runs = {
        "full": np.where(t < 9000.0, 60.0, 0.0),
        "half": np.where((t > 1800.0) & (t < 12600.0), 30.0, 0.0),
        "stairs": steps(t, [10.0, 50.0, 20.0, 60.0, 0.0, 40.0]),
        "pulses": np.where(t % 3600.0 < 1200.0, 55.0, 5.0),
        "cycle": steps(t, [40.0, 5.0, 55.0, 30.0, 15.0, 45.0, 0.0, 25.0]),
    }
    return compiled_rig(
        "thermal block",
        plant,
        30.0,
        runs,
        units={"P": "W", "T_body": "K", "T_casing": "K"},
        noise={"T_body": 0.05, "T_casing": 0.05},
        inside=(
            "radiation@casing",
            "capacity@body",
            "loss@body",
            "lag@T_body",
            "drift@T_casing",
            "offset@T_body",
            "offset@P",
            "saturation@P",
            "delay@P",
            "lag@P",
        ),
        held=(),
        outside=(
            "resonator@body",
            "wear@body",
            "pulsation@casing",
            "chaos@body",
            "product@casing",
            "slip@body",
        ),
        near={
            "loss@body": ("radiation@body",),
            "radiation@casing": ("loss@body", "radiation@body"),
            "capacity@body": ("capacity@casing",),
            "offset@T_body": ("gain@T_body",),
            "delay@P": ("lag@P",),
            "lag@P": ("delay@P",),
            "lag@T_body": ("delay@T_body",),
        },
    )


def _circuit() -> Rig:
    plant = CompiledPlant(
        "Circuit",
        {"resistor.R": 20.0, "inductor.L": 0.02, "capacitor.C": 5e-6},
        ("u",),
        ("v", "i"),
        {"capacitor": Place(0, 4.0, 4.0), "inductor": Place(1, 0.06, 0.06)},
        substeps=10,
        crosstalk={"v": "u"},
    )
    t = times(2e-5, 1000)
    runs = {
        "chirp": 5.0 * np.sin(2 * np.pi * (100.0 + 2e4 * t) * t),
        "steps": random_steps(t, 1e-3, 5.0, seed=3),
        "small": random_steps(t, 4e-4, 2.0, seed=4),
        "sine": 4.0 * np.sin(2 * np.pi * 300.0 * t),
        "cycle": random_steps(t, 7e-4, 4.0, seed=5),
    }
    return compiled_rig(
        "RLC circuit",
        plant,
        2e-5,
        runs,
        units={"u": "V", "v": "V", "i": "A"},
        noise={"v": 0.02, "i": 5e-4},
        inside=(
            "leakage@capacitor",
            "voltage_drop@inductor",
            "saturation@u",
            "dead_zone@u",
            "delay@u",
            "lag@u",
            "lag@i",
            "offset@i",
            "crosstalk@v",
            "drift@v",
        ),
        held=(),
        outside=(
            "resonator@capacitor",
            "wear@capacitor",
            "pulsation@capacitor",
            "chaos@capacitor",
            "product@capacitor",
            "slip@capacitor",
        ),
        same={
            "leakage@capacitor": ("leakage@inductor.n",),
            "lag@u": ("capacity@resistor.n",),
            "voltage_drop@inductor": ("voltage_drop@source", "voltage_drop@resistor", "voltage_drop@capacitor"),
        },
        near={"delay@u": ("lag@u",), "lag@u": ("delay@u",), "lag@i": ("delay@i",), "dead_zone@u": ("offset@u",)},
    )


def _tanks() -> Rig:
    plant = CompiledPlant(
        "Tanks",
        {"pump.k": 3e-6, "first.S": 8e-6, "second.S": 8e-6, "upper.A": 2e-3, "lower.A": 2e-3},
        ("u",),
        ("h_upper", "h_lower"),
        {"upper": Place(0, 0.2, 0.2), "lower": Place(1, 0.2, 0.2)},
        substeps=4,
    )
    t = times(4.0, 600)
    runs = {
        "stairs": steps(t, [3.0, 5.0, 0.8, 6.0, 4.0, 1.0]),
        "down": steps(t, [6.5, 5.0, 3.5, 2.0, 0.9, 3.0]),
        "wave": 3.5 + 2.5 * np.sign(np.sin(2 * np.pi * t / 500.0)) * np.abs(np.sin(2 * np.pi * t / 900.0)),
        "pulses": np.where(t % 400.0 < 200.0, 6.0, 1.0),
        "cycle": steps(t, [2.0, 4.5, 6.0, 1.5, 3.0, 5.5, 2.5, 1.0]),
    }
    return compiled_rig(
        "tanks",
        plant,
        4.0,
        runs,
        units={"u": "V", "h_upper": "m", "h_lower": "m"},
        noise={"h_upper": 5e-4, "h_lower": 5e-4},
        inside=(
            "offset@h_upper",
            "drift@h_lower",
            "lag@h_lower",
            "dead_zone@u",
            "lag@u",
            "delay@u",
            "saturation@u",
            "leakage@lower",
        ),
        held=(),
        outside=(
            "resonator@upper",
            "wear@upper",
            "pulsation@lower",
            "chaos@upper",
            "product@lower",
            "slip@lower",
        ),
        same={"dead_zone@u": ("offset@u",), "leakage@lower": ("leakage@second",)},
        near={
            "delay@u": ("lag@u",),
            "lag@u": ("delay@u",),
            "lag@h_lower": ("delay@h_lower",),
            "leakage@lower": ("leakage@upper",),
            "offset@h_upper": ("gain@h_upper",),
        },
    )


REHEARSED_ON: tuple[Rig, ...] = (_belt_axis(), _thermal_block(), _circuit(), _tanks())
