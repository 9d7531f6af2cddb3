"""The model of the demo and the logs of its rig, which has what the model lacks."""

from __future__ import annotations

import math
import os
import shutil
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from fmu_build.build import check_tools
from fmu_build.errors import BuildError
from fmuid.core.errors import FmuidError
from fmuid.core.files import make_folder, write_atomically
from fmuid.data.crosscheck_csv import Table, write_csv
from fmuid.simulation.fmu_description import library_name

_STEP, _EVERY, _SAMPLES = 5e-4, 10, 400  # s; steps a sample; samples a run
_NOISE = 0.02  # rad/s
_RIG = {"J_rotor": 2.1e-3, "c": 15.0, "d": 0.015, "J_load": 5.2e-3}  # not what the model starts with
_INPUTS: Mapping[str, Callable[[float], float]] = {
    "steps": lambda t: 0.12 * (1 if math.sin(5.0 * t) >= 0 else -1),
    "sine": lambda t: 0.15 * math.sin(7.0 * t),
    "chirp": lambda t: 0.14 * math.sin(2.0 * t + 6.0 * t * t),
    "mixed": lambda t: 0.1 * math.sin(4.0 * t) + (0.06 if math.sin(17.0 * t) >= 0 else -0.06),
}
_VARIABLES = (
    ("tau", "input", "N.m", "Torque of the motor", 0.0),
    ("w_motor", "output", "rad/s", "Speed of the motor", None),
    ("w_load", "output", "rad/s", "Speed of the load", None),
    ("rotor.J", "parameter", "kg.m2", "Moment of inertia", 2.5e-3),
    ("shaft.c", "parameter", "N.m/rad", "Stiffness", 12.0),
    ("shaft.d", "parameter", "N.m.s/rad", "Damping", 0.02),
    ("load.J", "parameter", "kg.m2", "Moment of inertia", 4e-3),
)


@dataclass(frozen=True, slots=True)
class Lacking:
    """Effects of the rig that the model lacks: drag of the air at the load (N.m.s2/rad2), a late torque (s)."""

    drag: float = 0.0
    delay: float = 0.0

    def __str__(self) -> str:
        """Say it."""
        if self.drag:
            return f"a fan as its load, with a drag of {self.drag:g} N.m.s2/rad2 (quadratic@load)"
        return f"a torque that comes {1e3 * self.delay:g} ms late (delay@tau)"


@dataclass(frozen=True, slots=True)
class Rig:
    """Start of the demo: the options that choose the model, the logs, and the effect that the model lacks."""

    model: tuple[str, ...]
    logs: tuple[Path, ...]
    lacking: Lacking


def make_rig(folder: Path) -> Rig:
    """Write a model and the logs of its rig.

    Where the model can be built it is Modelica, and lacks a law of physics. Else it is an FMU that comes with
    fmuid, and one of its signals is wrong: of an FMU nobody can say more.

    Raises
    ------
    FmuidError
        The folder is there already.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FmuidError("already exists", where=folder, fix="remove it, or choose another folder with --out")
    make_folder(folder)
    if _can_build():
        file, lacking = folder / "Bench.mo", Lacking(drag=3e-4)
        write_atomically(file, files("fmuid.demo").joinpath("Bench.mo").read_bytes())
        model: tuple[str, ...] = ("--model", str(file), "--class", "Bench.Drive")
    else:
        file, lacking = folder / "Drive.fmu", Lacking(delay=8e-3)
        _write_fmu(file)
        model = ("--fmu", str(file))
    random = np.random.default_rng(1)
    logs = []
    for name, torque in _INPUTS.items():
        for again in ("", "_again"):
            logs.append(folder / "logs" / f"{name}{again}.csv")
            write_csv(_log(torque, lacking, random), logs[-1])
    return Rig(model, tuple(logs), lacking)


def _can_build() -> bool:
    try:
        check_tools()
    except BuildError:
        return False
    return any(map(shutil.which, (os.environ.get("CC", "cc").split()[0], "cc", "gcc", "clang")))


def _log(torque: Callable[[float], float], lacking: Lacking, random: np.random.Generator) -> Table:
    """Return a run of the rig, by a solver of its own."""
    j1, c, d, j2 = _RIG["J_rotor"], _RIG["c"], _RIG["d"], _RIG["J_load"]

    def slope(x: tuple[float, ...], u: float) -> tuple[float, float, float, float]:
        shaft = c * (x[0] - x[1]) + d * (x[2] - x[3])
        return x[2], x[3], (u - shaft) / j1, (shaft - lacking.drag * x[3] * abs(x[3])) / j2

    def moved(x: tuple[float, ...], k: tuple[float, ...], h: float) -> tuple[float, ...]:
        return tuple(a + h * b for a, b in zip(x, k, strict=True))

    x: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    period, rows = _STEP * _EVERY, []
    for i in range(_SAMPLES * _EVERY):
        if i % _EVERY == 0:
            rows.append((x[2], x[3]))
        acts = max(0, math.floor((i * _STEP - lacking.delay) / period + 1e-9))
        u = torque(acts * period)
        k1 = slope(x, u)
        k2 = slope(moved(x, k1, 0.5 * _STEP), u)
        k3 = slope(moved(x, k2, 0.5 * _STEP), u)
        k4 = slope(moved(x, k3, _STEP), u)
        x = tuple(v + _STEP / 6 * (a + 2 * b + 2 * e + g) for v, a, b, e, g in zip(x, k1, k2, k3, k4, strict=True))
    time = period * np.arange(_SAMPLES, dtype=np.float64)
    speeds = np.array(rows).T + _NOISE * random.standard_normal((2, _SAMPLES))
    columns = {"tau": np.array([torque(t) for t in time]), "w_motor": speeds[0], "w_load": speeds[1]}
    return Table(time, columns, {"tau": "N.m", "w_motor": "rad/s", "w_load": "rad/s"})


def _write_fmu(file: Path) -> None:
    spec = find_spec("fmuid.demo._drive")
    if spec is None or spec.origin is None:
        raise FmuidError("the demo's FMU is missing", where="fmuid", fix="install fmuid again")
    binary = Path("binaries") / library_name(2, "Drive")
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", _description())
        archive.write(spec.origin, binary.as_posix())


def _description() -> str:
    lines = []
    for reference, (name, causality, unit, words, start) in enumerate(_VARIABLES):
        fixed = "fixed" if causality == "parameter" else "continuous"
        value = "" if start is None else f' start="{start!r}"'
        lines.append(
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
            f'variability="{fixed}" description="{words}"><Real unit="{unit}"{value}/></ScalarVariable>'
        )
    units = "".join(f'<Unit name="{unit}"/>' for unit in dict.fromkeys(v[2] for v in _VARIABLES))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="Drive" guid="fmuid-demo" generationTool="fmuid demo">
<CoSimulation modelIdentifier="Drive" canHandleVariableCommunicationStepSize="true"/>
<UnitDefinitions>{units}</UnitDefinitions>
<ModelVariables>{"".join(lines)}</ModelVariables>
<ModelStructure><Outputs><Unknown index="2"/><Unknown index="3"/></Outputs></ModelStructure>
</fmiModelDescription>
"""
