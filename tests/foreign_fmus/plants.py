"""Model Exchange FMUs written by hand in C (`plants.c`), and logs of rigs that have more than these models."""

from __future__ import annotations

import subprocess
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from fmuid.data.crosscheck_csv import Table, write_csv
from fmuid.simulation.fmu_description import library_name
from tests.conftest import c_compiler

SOURCE = Path(__file__).with_name("plants.c")
Floats = np.ndarray
Slope = Callable[[Floats, Floats, Floats], Floats]


@dataclass(frozen=True)
class Plant:
    """Names and units of inputs, parameters and states; the slope of the states; inputs and noise of the rig."""

    inputs: Mapping[str, str]
    parameters: Mapping[str, str]
    states: Mapping[str, str]
    nominal: tuple[float, ...]  # of the model, as in plants.c
    start: tuple[float, ...]
    values: tuple[float, ...]  # of the rig, near the model's
    slope: Slope  # of states, inputs and parameters
    duration: float
    course: Callable[[np.ndarray, int], np.ndarray]  # (inputs, N) at times, by number of the run
    noise: tuple[float, ...]
    measured: tuple[int, ...]


def _drive(x, u, p):
    shaft = p[1] * (x[0] - x[1]) + p[2] * (x[2] - x[3])
    return np.array([x[2], x[3], (u[0] - shaft) / p[0], shaft / p[3]])


def _house(x, u, p):
    inside = p[1] * (x[0] - x[1])
    return np.array([(u[0] - inside) / p[0], (inside - p[3] * (x[1] - u[1])) / p[2]])


def _circuit(x, u, p):
    return np.array([(u[0] - p[1] * x[0] - x[1]) / p[0], (x[0] - x[1] / p[3]) / p[2]])


def _tank(x, u, p):
    between = p[2] * np.sqrt(max(x[0], 0.0))
    return np.array([(u[0] - between) / p[0], (between - p[3] * np.sqrt(max(x[1], 0.0))) / p[1]])


def _vessel(x, u, p):
    return np.array([(u[0] - p[1] * x[0]) / p[0]])


def _rod(x, u, p):
    left, right = p[1] * (x[0] - x[1]), p[1] * (x[1] - x[2])
    return np.array([u[0] - left, left - right, right - p[2] * (x[2] - p[3])]) / p[0]


def _steps(t, k, every):
    """A random staircase between -1 and 1."""
    return np.random.default_rng(k).uniform(-1, 1, 1 + int(t[-1] / every))[(t / every).astype(int)]


PLANTS = {
    "DRIVE": Plant(
        {"tau": "N.m"},
        {"J1": "kg.m2", "c": "N.m/rad", "d": "N.m.s/rad", "J2": "kg.m2"},
        {"phi1": "rad", "phi2": "rad", "w1": "rad/s", "w2": "rad/s"},
        (2e-3, 15.0, 0.02, 5e-3),
        (0, 0, 0, 0),
        (2.1e-3, 14.0, 0.022, 5.2e-3),
        _drive,
        2.0,
        lambda t, k: np.array([0.15 * (_steps(t, k, 0.2) + np.sin((3 + k) * t))]),
        (0.0, 0.0, 0.02, 0.02),
        (2, 3),
    ),
    "HOUSE": Plant(
        {"P_heat": "W", "T_out": "K"},
        {"C_room": "J/K", "G_wall": "W/K", "C_wall": "J/K", "G_out": "W/K"},
        {"T_room": "K", "T_wall": "K"},
        (2e5, 80.0, 3e6, 40.0),
        (293.0, 290.0),
        (2.2e5, 85.0, 2.8e6, 42.0),
        _house,
        2e5,
        lambda t, k: np.array([700 + 600 * _steps(t, k, 7200.0), 283 + 6 * np.sin(2 * np.pi * t / 86400 + k)]),
        (0.02, 0.02),
        (0, 1),
    ),
    "CIRCUIT": Plant(
        {"v_in": "V"},
        {"L": "H", "R": "Ohm", "C": "F", "R_load": "Ohm"},
        {"i": "A", "v": "V"},
        (1e-2, 2.0, 1e-3, 20.0),
        (0.0, 0.0),
        (1.1e-2, 2.1, 1.05e-3, 19.0),
        _circuit,
        0.4,
        lambda t, k: np.array([10 * _steps(t, k, 0.02)]),
        (0.01, 0.02),
        (0, 1),
    ),
    "TANK": Plant(
        {"q": "m3/s"},
        {"A1": "m2", "A2": "m2", "k1": "m2.5/s", "k2": "m2.5/s"},
        {"h1": "m", "h2": "m"},
        (0.02, 0.015, 1.2e-3, 1e-3),
        (0.3, 0.25),
        (0.021, 0.0145, 1.25e-3, 1.05e-3),
        _tank,
        600.0,
        lambda t, k: np.array([6e-4 + 3e-4 * _steps(t, k, 40.0)]),
        (5e-4, 5e-4),
        (0, 1),
    ),
    "VESSEL": Plant(
        {"q": "m3/s"},
        {"C": "m3/Pa", "leak": "m3/(s.Pa)"},
        {"p": "Pa"},
        (0.5, 0.3),
        (1.0,),
        (0.52, 0.33),
        _vessel,
        8.0,
        lambda t, k: np.array([2.2 * (1 + _steps(t, k, 1.0))]),
        (0.01,),
        (0,),
    ),
    "ROD": Plant(
        {"P_heat": "W"},
        {"C": "J/K", "G": "W/K", "G_out": "W/K", "T_out": "K"},
        {"T[1]": "K", "T[2]": "K", "T[3]": "K"},
        (60.0, 0.8, 0.3, 293.0),
        (293.0, 293.0, 293.0),
        (62.0, 0.75, 0.31, 293.0),
        _rod,
        2000.0,
        lambda t, k: np.array([20 + 15 * _steps(t, k, 100.0)]),
        (0.02, 0.02, 0.02),
        (0, 1, 2),
    ),
}


def plant_fmu(name: str, folder: Path, fmi: int = 2) -> Path:
    """Compile and pack a plant."""
    plant = PLANTS[name]
    library = folder / f"{name}{fmi}.so"
    flags = ["-std=gnu11", "-O1", "-shared", "-fPIC", f"-D{name}", f"-DFMI={fmi}"]
    command = [c_compiler(), *flags, "-o", str(library), str(SOURCE), "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    path = folder / f"{name.title()}{fmi}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _description(name, plant, fmi))
        archive.write(library, f"binaries/{library_name(fmi, name).as_posix()}")
    return path


def _description(name: str, plant: Plant, fmi: int) -> str:
    known = [(n, u, "input", "continuous") for n, u in plant.inputs.items()]
    known += [(n, u, "parameter", "fixed") for n, u in plant.parameters.items()]
    starts = [*([0.0] * len(plant.inputs)), *plant.nominal, *plant.start]
    rows = [(*row, repr(starts[i]), None) for i, row in enumerate(known)]
    first, arrays = len(known), dict[str, str]()
    for (n, u), start in zip(plant.states.items(), starts[first:], strict=True):
        whole = n.partition("[")[0]  # the states of an array have one unit
        if whole not in arrays:
            rows.append((whole, u, "output", "continuous", "", None))
        arrays[whole] = f"{arrays[whole]} {start!r}" if whole in arrays else repr(start)
    rows = [(*row[:4], arrays.get(row[0], row[4]), None) for row in rows]
    rows += [(f"der({n})", "", "local", "continuous", None, first + i) for i, n in enumerate(arrays)]
    size = {n: f'<Dimension start="{len(a.split())}"/>' if " " in a else "" for n, a in arrays.items()}
    variables = []
    for i, (n, unit, causality, variability, start, of) in enumerate(rows):
        inner = (f' unit="{unit}"' if unit else "") + ("" if start is None else f' start="{start}"')
        inner += "" if of is None else f' derivative="{of + 1 if fmi == 2 else of}"'
        head = f'name="{n}" valueReference="{i}" causality="{causality}" variability="{variability}"'
        head += ' initial="exact"' if causality == "output" else ""
        variables.append(
            f"<ScalarVariable {head}><Real{inner}/></ScalarVariable>"
            if fmi == 2
            else f"<Float64 {head}{inner}>{size.get(n.removeprefix('der(').rstrip(')'), '')}</Float64>"
        )
    states, slopes = range(first, first + len(arrays)), range(first + len(arrays), len(rows))
    units = "".join(f'<Unit name="{u}"/>' for u in dict.fromkeys(row[1] for row in rows) if u)
    if fmi == 2:
        head = f'fmiVersion="2.0" guid="{name}" numberOfEventIndicators="0"'
        outputs, derivatives = ("".join(f'<Unknown index="{i + 1}"/>' for i in some) for some in (states, slopes))
        structure = f"<Outputs>{outputs}</Outputs><Derivatives>{derivatives}</Derivatives>"
    else:
        head = f'fmiVersion="3.0" instantiationToken="{name}"'
        variables.append(
            f'<Float64 name="time" valueReference="{len(rows)}" causality="independent" variability="continuous"/>'
        )
        structure = "".join(f'<Output valueReference="{i}"/>' for i in states)
        structure += "".join(f'<ContinuousStateDerivative valueReference="{i}"/>' for i in slopes)
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription modelName="{name.title()}" {head}>'
        f'<ModelExchange modelIdentifier="{name}"/><UnitDefinitions>{units}</UnitDefinitions>'
        f'<DefaultExperiment stopTime="{plant.duration}"/><ModelVariables>{"".join(variables)}</ModelVariables>'
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


@dataclass(frozen=True)
class Gap:
    """What a rig has beyond its model.

    Attributes
    ----------
    flow
        What is added to the slope of the states `x`, with hidden states `z`.
    hidden, start
        Slope of the hidden states, and where they begin.
    drive
        Inputs that act, for those that are commanded; `late` is by how many samples the first one acts later.
    reads
        Readings of the states, shape (states, N), at times `t`, with inputs and hidden states.
    """

    flow: Callable[[Floats, Floats], Floats] = lambda x, z: 0 * x
    hidden: Callable[[Floats, Floats, Floats], Floats] = lambda x, u, z: np.zeros(0)
    start: Callable[[Floats, Floats], Floats] = lambda x, u: np.zeros(0)
    drive: Callable[[Floats, Floats], Floats] = lambda u, z: u
    reads: Callable[[Floats, Floats, Floats, Floats], Floats] = lambda x, u, t, z: x
    late: int = 0


def simulated(plant: Plant, gap: Gap, time: Floats, inputs: Floats) -> Floats:
    """Return the readings of a rig without noise, (states, N), by SciPy; inputs are held."""
    acting = inputs.copy()
    acting[0] = inputs[0, np.maximum(np.arange(time.size) - gap.late, 0)]
    values, n = np.array(plant.values), len(plant.states)
    x0 = np.array(plant.start, dtype=float)
    both = [np.concatenate([x0, gap.start(x0, acting[:, 0])])]
    for k in range(time.size - 1):
        u = acting[:, k]

        def slope(_: float, y: Floats, u: Floats = u) -> Floats:
            x, z = y[:n], y[n:]
            here = plant.slope(x, gap.drive(u, z), values) + gap.flow(x, z)
            return np.concatenate([here, gap.hidden(x, u, z)])

        solution = solve_ivp(slope, (time[k], time[k + 1]), both[-1], "LSODA", rtol=1e-8, atol=1e-9)
        both.append(solution.y[:, -1])
    rows = np.array(both).T
    return gap.reads(rows[:n], acting, time, rows[n:])


def write_logs(
    name: str, gap: Gap, folder: Path, runs: int = 4, repeats: int = 2, samples: int = 400, seed: int = 7
) -> list[Path]:
    """Write the logs of a rig, with noise; every run is repeated."""
    plant = PLANTS[name]
    time = np.linspace(0.0, plant.duration, samples + 1)
    random = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    units = {**plant.inputs, **plant.states}
    names = list(plant.states)
    logs = []
    for run in range(runs):
        inputs = plant.course(time, run)
        exact = simulated(plant, gap, time, inputs)
        for again in range(repeats):
            noisy = exact + np.array(plant.noise)[:, None] * random.standard_normal(exact.shape)
            columns = dict(zip(plant.inputs, inputs, strict=True)) | {names[i]: noisy[i] for i in plant.measured}
            logs.append(folder / f"run{run}_{again}.csv")
            write_csv(Table(time, columns, {n: units[n] for n in columns}), logs[-1])
    return logs
