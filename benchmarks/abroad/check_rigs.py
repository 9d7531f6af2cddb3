"""The rigs of the check abroad. They are not unseen: rules came from labels of earlier grids of them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from benchmarks.abroad.compiled import CompiledPlant, Place
from benchmarks.abroad.compiled_rig import chirp, compiled_rig, times
from benchmarks.abroad.plant import Rig, random_steps, steps

OUTSIDE = Path(__file__).with_name("outside.toml")
_OUTSIDE = tomllib.loads(OUTSIDE.read_text())["rigs"]


def _gantry_crane() -> Rig:
    plant = CompiledPlant(
        "GantryCrane",
        {
            "drive.k": 30.0,
            "trolley.M": 12.0,
            "trolley.d": 25.0,
            "trolley.F": 6.0,
            "payload.m": 5.0,
            "payload.L": 0.8,
            "payload.b": 0.15,
            "buffer.c": 400.0,
        },
        ("u",),
        ("s", "theta"),
        {"trolley": Place(0, 1.0, 1.0)},
        substeps=16,
    )
    t = times(0.04, 400)
    runs = {
        "steps": steps(
            t, [1.0, -1.0, -1.8, 1.8, 0.4, -0.4, -1.2, 1.2, 2.0, -2.0, -0.7, 0.7, 1.5, -1.5, -2.2, 2.2]
        ),
        "sine": 2.0 * np.sin(2 * np.pi * 0.45 * t),
        "sweep": 1.5 * chirp(t, 0.2, 1.2),
        "far": 2.6 * np.sin(2 * np.pi * 0.125 * t),
        "cycle": steps(t, np.repeat([1.3, -1.3, -0.6, 0.6, 1.9, -1.9, -1.1, 1.1, 0.3, -0.3], 2)),
    }
    return compiled_rig(
        "gantry crane",
        plant,
        0.04,
        runs,
        units={"u": "V", "s": "m", "theta": "rad"},
        noise={"s": 3e-3, "theta": 3e-3},
        inside=(
            "stribeck@trolley",
            "asymmetry@trolley",
            "quadratic@trolley",
            "presliding@trolley",
            "weight@trolley",
            "delay@u",
            "dead_zone@u",
            "lag@theta",
            "offset@theta",
        ),
        held=("buffer.c",),
        outside=_OUTSIDE[plant.name],
        redundant=("trolley.F",),
        same={
            "weight@trolley": ("offset@u", "asymmetry@trolley"),
            "asymmetry@trolley": ("offset@u", "weight@trolley"),
            "coulomb@trolley": ("value@trolley.F",),
        },
        near={
            "delay@u": ("lag@u",),
            "lag@theta": ("delay@theta",),
            "presliding@trolley": ("coulomb@trolley",),
        },
    )


def _ball_screw() -> Rig:
    plant = CompiledPlant(
        "BallScrew",
        {
            "motor.k": 0.3,
            "screw.J": 4e-4,
            "screw.d": 2e-3,
            "nut.c": 4e6,
            "nut.d": 3000.0,
            "table.m": 40.0,
            "table.d": 200.0,
            "table.F": 40.0,
            "table.stop": 2e4,
        },
        ("i",),
        ("phi", "s"),
        {
            "screw.shaft": Place(0, 20.0, 100.0, turning=True),
            "table": Place(1, 0.04, 0.2),
            "nut": Place(2, 1e-4, 0.005),
        },
        substeps=12,
    )
    t = times(0.001, 600)
    runs = {
        "steps": random_steps(t, 0.04, 4.0, seed=21),
        "sine": 4.0 * np.sin(2 * np.pi * 6.0 * t),
        "sweep": 5.0 * chirp(t, 5.0, 60.0),
        "far": 3.2 * np.sign(np.sin(2 * np.pi * 2.0 * t)),
        "cycle": random_steps(t, 0.025, 4.5, seed=22),
    }
    return compiled_rig(
        "ball screw",
        plant,
        0.001,
        runs,
        units={"i": "A", "phi": "rad", "s": "m"},
        noise={"phi": 2e-3, "s": 2e-6},
        inside=(
            "stribeck@table",
            "backlash@nut",
            "hardening@nut",
            "hysteresis@nut",
            "cogging@screw.shaft",
            "weight@table",
            "delay@i",
            "lag@i",
            "presliding@table",
        ),
        held=("table.stop",),
        outside=_OUTSIDE[plant.name],
        redundant=("screw.d", "table.d"),
        same={"weight@table": ("offset@i", "asymmetry@table")},
        near={
            "weight@table": ("asymmetry@screw.shaft",),
            "presliding@table": (
                "presliding@screw.shaft",
                "coulomb@table",
                "coulomb@screw.shaft",
            ),
            "delay@i": ("lag@i",),
            "lag@i": ("delay@i",),
            "stribeck@table": ("stribeck@screw.shaft",),
        },
    )


def _two_link_arm() -> Rig:
    plant = CompiledPlant(
        "TwoLinkArm",
        {
            "links.I1": 1.2,
            "links.I2": 0.25,
            "links.h": 0.3,
            "shoulder.d": 1.5,
            "shoulder.F": 1.0,
            "elbow.d": 0.5,
            "elbow.F": 0.4,
            "stop.c": 25.0,
        },
        ("tau1", "tau2"),
        ("q1", "q2"),
        {"links.shoulder": Place(0, 1.5, 2.0, turning=True), "links.elbow": Place(1, 2.0, 4.0, turning=True)},
        substeps=10,
    )
    t = times(0.01, 400)
    sines = (6.0 * np.sin(2 * np.pi * 1.0 * t), 1.8 * np.sin(2 * np.pi * 1.7 * t + 1.0))
    runs = {
        "steps": np.stack([random_steps(t, 0.3, 5.0, seed=31), random_steps(t, 0.2, 1.8, seed=32)]),
        "sines": np.stack(sines),
        "sweep": np.stack([7.0 * chirp(t, 0.5, 3.0), -2.0 * chirp(t, 0.7, 4.0)]),
        "far": np.stack([7.5 * np.sin(2 * np.pi * 0.3 * t), 0.3 * sines[1]]),
        "cycle": np.stack([random_steps(t, 0.25, 6.0, seed=33), random_steps(t, 0.25, 2.0, seed=34)]),
    }
    return compiled_rig(
        "two-link arm",
        plant,
        0.01,
        runs,
        units={"tau1": "N.m", "tau2": "N.m", "q1": "rad", "q2": "rad"},
        noise={"q1": 3e-3, "q2": 3e-3},
        inside=(
            "weight@links.shoulder",
            "position_friction@links.shoulder",
            "stribeck@links.elbow",
            "asymmetry@links.shoulder",
            "cogging@links.elbow",
            "quadratic@links.elbow",
            "delay@tau1",
            "offset@tau2",
            "saturation@tau2",
            "lag@q2",
        ),
        held=("stop.c",),
        outside=_OUTSIDE[plant.name],
        same={
            "weight@links.shoulder": ("imbalance@links.shoulder",),
            "asymmetry@links.shoulder": ("offset@tau1",),
            "offset@tau2": ("asymmetry@links.elbow",),
        },
        near={
            "delay@tau1": ("lag@tau1",),
            "lag@q2": ("delay@q2",),
            "position_friction@links.shoulder": ("coulomb@links.shoulder",),
        },
    )


def _heat_exchanger() -> Rig:
    plant = CompiledPlant(
        "HeatExchanger",
        {
            "hot.C": 3e5,
            "wall.C": 8e4,
            "cold.C": 2.5e5,
            "film.G": 1500.0,
            "skin.G": 1200.0,
            "mains.flow_rate": 0.3,
            "bleed.K": 600.0,
        },
        ("m_hot", "T_in"),
        ("T_hot", "T_cold"),
        {"hot": Place(0, 45.0, 45.0), "wall": Place(1, 25.0, 25.0), "cold": Place(2, 15.0, 15.0)},
        substeps=8,
        zero=288.15,
    )
    t = times(20.0, 400)
    runs = {
        "steps": np.stack([0.2 + random_steps(t, 700.0, 0.15, seed=41), np.full(t.shape, 338.15)]),
        "warming": np.stack([np.full(t.shape, 0.25), steps(t, [318.15, 340.15, 328.15, 343.15, 310.15])]),
        "both": np.stack([steps(t, [0.1, 0.35, 0.05, 0.25, 0.4]), 328.15 + random_steps(t, 900.0, 14.0, seed=42)]),
        "hot": np.stack([np.full(t.shape, 0.45), steps(t, [358.15, 374.15, 345.15, 376.15])]),
        "cycle": np.stack(
            [0.22 + random_steps(t, 500.0, 0.16, seed=43), 333.15 + random_steps(t, 800.0, 9.0, seed=44)]
        ),
    }
    return compiled_rig(
        "heat exchanger",
        plant,
        20.0,
        runs,
        units={"m_hot": "kg/s", "T_in": "K", "T_hot": "K", "T_cold": "K"},
        noise={"T_hot": 0.1, "T_cold": 0.05},
        inside=(
            "loss@hot",
            "radiation@hot",
            "capacity@cold",
            "capacity@wall",
            "lag@T_cold",
            "offset@T_hot",
            "drift@T_cold",
            "gain@m_hot",
            "offset@T_in",
            "delay@T_in",
            "lag@T_in",
        ),
        held=("bleed.K",),
        outside=_OUTSIDE[plant.name],
        redundant=("film.G",),
        near={
            "loss@hot": ("radiation@hot",),
            "radiation@hot": ("loss@hot",),
            "offset@T_in": ("gain@T_in", "dead_zone@T_in"),
            "offset@T_hot": ("gain@T_hot",),
            "delay@T_in": ("lag@T_in",),
            "lag@T_in": ("delay@T_in",),
            "lag@T_cold": ("delay@T_cold",),
        },
    )


def _buck_converter() -> Rig:
    plant = CompiledPlant(
        "BuckConverter",
        {"bridge.V": 24.0, "choke.L": 1e-3, "choke.R": 0.3, "capacitor.C": 2e-4, "load.R": 6.0, "clamp.G": 0.8},
        ("duty",),
        ("v", "i"),
        {"choke.n": Place(0, 12.0, 12.0), "choke": Place(1, 2.5, 2.5)},
        substeps=12,
        crosstalk={"v": "i"},
    )
    t = times(2e-5, 500)
    runs = {
        "steps": 0.3 + random_steps(t, 6e-4, 0.2, seed=51),
        "sine": 0.3 + 0.15 * np.sin(2 * np.pi * 400.0 * t),
        "sweep": 0.3 + 0.2 * chirp(t, 100.0, 2000.0),
        "high": 0.65 + random_steps(t, 1e-3, 0.2, seed=52),
        "cycle": 0.28 + random_steps(t, 4e-4, 0.22, seed=53),
    }
    return compiled_rig(
        "buck converter",
        plant,
        2e-5,
        runs,
        units={"duty": "1", "v": "V", "i": "A"},
        noise={"v": 0.04, "i": 0.01},
        inside=(
            "voltage_drop@choke",
            "capacity@choke.n",
            "saturation@duty",
            "delay@duty",
            "lag@duty",
            "dead_zone@duty",
            "lag@i",
            "offset@v",
            "drift@i",
            "crosstalk@v",
        ),
        held=("clamp.G",),
        outside=_OUTSIDE[plant.name],
        same={"voltage_drop@choke": ("voltage_drop@bridge",)},
        near={
            "delay@duty": ("lag@duty",),
            "lag@duty": ("delay@duty",),
            "lag@i": ("delay@i",),
            "dead_zone@duty": ("offset@duty",),
        },
    )


def _pneumatic_cylinder() -> Rig:
    plant = CompiledPlant(
        "PneumaticCylinder",
        {
            "valve.k": 1e-4,
            "chamber.C": 1.5e-9,
            "throttle.G": 2e-9,
            "cylinder.A": 1.2e-3,
            "piston.m": 2.0,
            "piston.d": 60.0,
            "piston.F": 8.0,
            "springs.c": 2500.0,
            "springs.cushion": 8000.0,
        },
        ("u",),
        ("p", "s"),
        {"chamber": Place(0, 1e5, 1e5), "piston": Place(1, 0.05, 0.5)},
        substeps=48,
    )
    t = times(0.006, 500)
    runs = {
        "steps": random_steps(t, 0.2, 2.5, seed=61),
        "sine": 2.5 * np.sin(2 * np.pi * 1.5 * t),
        "sweep": 4.0 * chirp(t, 1.0, 8.0),
        "far": 7.5 * np.sin(2 * np.pi * 0.5 * t),
        "cycle": random_steps(t, 0.12, 3.0, seed=62),
    }
    return compiled_rig(
        "pneumatic cylinder",
        plant,
        0.006,
        runs,
        units={"u": "V", "p": "Pa", "s": "m"},
        noise={"p": 300.0, "s": 1e-4},
        inside=(
            "stribeck@piston",
            "weight@piston",
            "asymmetry@piston",
            "presliding@piston",
            "quadratic@piston",
            "outflow@chamber",
            "capacity@chamber",
            "dead_zone@u",
            "delay@u",
            "lag@p",
            "offset@p",
        ),
        held=("springs.cushion",),
        outside=_OUTSIDE[plant.name],
        redundant=("cylinder.A",),
        same={"asymmetry@piston": ("weight@piston",), "weight@piston": ("asymmetry@piston",)},
        near={
            "delay@u": ("lag@u",),
            "lag@p": ("delay@p",),
            "presliding@piston": ("coulomb@piston",),
        },
    )


def _magnetic_bearing() -> Rig:
    plant = CompiledPlant(
        "MagneticBearing",
        {
            "magnets.k": 8e-6,
            "rotor.m": 3.0,
            "magnets.R": 2.0,
            "magnets.L": 1e-3,
            "controller.kp": 3e4,
            "controller.kd": 30.0,
            "rotor.touch": 3e5,
        },
        ("r",),
        ("x", "i"),
        {"rotor": Place(0, 3e-5, 0.02), "controller": Place(1, 0.2, 0.2)},
        substeps=10,
        crosstalk={"x": "i"},
    )
    t = times(1e-4, 600)
    runs = {
        "steps": random_steps(t, 3e-3, 1.5e-5, seed=71),
        "sine": 1.5e-5 * np.sin(2 * np.pi * 60.0 * t),
        "sweep": 1.5e-5 * chirp(t, 20.0, 300.0),
        "wide": 5e-5 * np.sin(2 * np.pi * 40.0 * t),
        "cycle": random_steps(t, 2e-3, 1.8e-5, seed=72),
    }
    return compiled_rig(
        "magnetic bearing",
        plant,
        1e-4,
        runs,
        units={"r": "m", "x": "m", "i": "A"},
        noise={"x": 1e-7, "i": 2e-3},
        inside=(
            "weight@rotor",
            "viscous@rotor",
            "voltage_drop@controller",
            "offset@x",
            "lag@x",
            "crosstalk@x",
            "gain@r",
            "delay@r",
            "saturation@r",
            "drift@i",
        ),
        held=("rotor.touch", "magnets.L"),
        outside=_OUTSIDE[plant.name],
        redundant=("rotor.m",),
        same={"gain@r": ("gain@controller.x",)},
        near={
            "weight@rotor": ("asymmetry@rotor",),
            "lag@x": ("delay@x",),
            "delay@r": ("lag@r",),
        },
    )


def _ship_drive() -> Rig:
    plant = CompiledPlant(
        "ShipDrive",
        {
            "engine.J": 400.0,
            "coupling.c": 6000.0,
            "coupling.d": 300.0,
            "propeller.J": 900.0,
            "propeller.Q": 25.0,
            "propeller.q": 30.0,
            "propeller.T": 80.0,
            "hull.m": 3e4,
            "hull.R": 900.0,
            "hull.waves": 4000.0,
        },
        ("tau",),
        ("w_engine", "w_propeller", "U"),
        {
            "engine": Place(0, 1500.0, 10.0, turning=True),
            "propeller.shaft": Place(1, 1500.0, 10.0, turning=True),
            "coupling": Place(2, 0.4, 1.0),
            "hull": Place(3, 400.0, 3.0),
        },
        substeps=16,
    )
    t = times(0.4, 500)
    runs = {
        "steps": 1200.0 + random_steps(t, 10.0, 900.0, seed=81),
        "sine": 1200.0 + 900.0 * np.sin(2 * np.pi * 0.08 * t),
        "sweep": 1000.0 + 1000.0 * chirp(t, 0.02, 0.9),
        "full": 4500.0 + random_steps(t, 15.0, 1500.0, seed=82),
        "cycle": 1300.0 + random_steps(t, 6.0, 1000.0, seed=83),
    }
    return compiled_rig(
        "ship's drive train",
        plant,
        0.4,
        runs,
        units={"tau": "N.m", "w_engine": "rad/s", "w_propeller": "rad/s", "U": "m/s"},
        noise={"w_engine": 0.03, "w_propeller": 0.03, "U": 0.01},
        inside=(
            "backlash@coupling",
            "hardening@coupling",
            "quadratic@engine",
            "coulomb@propeller.shaft",
            "viscous@engine",
            "viscous@hull",
            "load_friction@engine",
            "lag@U",
            "delay@tau",
            "offset@U",
            "saturation@tau",
        ),
        held=("hull.waves",),
        outside=_OUTSIDE[plant.name],
        redundant=("hull.R",),
        same={
            "viscous@engine": ("viscous_asymmetry@engine",),
            "viscous@propeller.shaft": ("viscous_asymmetry@propeller.shaft",),
            "viscous@hull": ("viscous_asymmetry@hull",),
        },
        near={
            "viscous@engine": ("viscous@propeller.shaft",),
            "quadratic@engine": ("quadratic@propeller.shaft",),
            "load_friction@engine": (
                "load_friction@propeller.shaft",
                "gain@tau",
            ),
            "coulomb@propeller.shaft": (
                "coulomb@engine",
                "asymmetry@engine",
                "asymmetry@propeller.shaft",
                "offset@tau",
                "dead_zone@tau",
                "presliding@engine",
                "presliding@propeller.shaft",
            ),
            "delay@tau": ("lag@tau",),
            "lag@U": ("delay@U",),
        },
    )


CHECKED_ON: tuple[Rig, ...] = (
    _gantry_crane(),
    _ball_screw(),
    _two_link_arm(),
    _heat_exchanger(),
    _buck_converter(),
    _pneumatic_cylinder(),
    _magnetic_bearing(),
    _ship_drive(),
)
