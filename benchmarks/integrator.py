"""The integrator inside our FMUs against CasADi's CVODES on the same equations, at equal error.

Each tool runs the actuator's experiments over a range of tolerances; the
table gives the time that each needs for an error, read off between its runs. The error is the root mean square
over all samples, relative to the largest value of the signal, of the worst output, against a run of the FMU at
1e-10. The FMU runs as a user runs it, through fmuid's step loop; CVODES gets the whole experiment in one call,
inputs piecewise constant, equations and Jacobian compiled with -O2, states over their largest values, so that its
absolute tolerance suits all. The shortest time counts.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np

from fmu_build import compile_modelica
from fmu_build.packaging import package
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task

SETUPS = Path(__file__).parents[1] / "modelica" / "Drives" / "Setups"
OURS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
CVODES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
ERRORS = (1e-4, 1e-5, 1e-6)


@dataclass(frozen=True)
class Case:
    label: str
    setup: str
    h: float
    u: np.ndarray
    outputs: tuple[str, ...]


def prbs(n: int, amplitude: float, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    lengths = rng.integers(2, 6, n)
    return amplitude * np.repeat(np.where(np.arange(n) % 2, -1.0, 1.0), lengths)[:n]


def cases() -> list[Case]:
    free = ("i_motor", "w_motor", "tau_sensor")
    ramp = 20.0 * np.minimum(1.0, np.arange(5001) * 0.01 / 2.0)
    sine = 0.75 * np.sin(2 * np.pi * 10.0 * np.arange(501) * 1e-3)
    fixed = ("tau_sensor", "w_motor")
    return [
        Case("step 0.5 A, 0.2 s at 1 kHz", "FixedShaft", 1e-3, np.full(201, 0.5), fixed),
        Case("sine 0.75 A 10 Hz, 0.5 s", "FixedShaft", 1e-3, sine, fixed),
        Case("PRBS 0.8 A, 0.5 s at 1 kHz", "FixedShaft", 1e-3, prbs(501, 0.8), fixed),
        Case("eccentric load, 50 s at 100 Hz", "EccentricLoad", 1e-2, np.full(5001, 20.0), (*free, "phi_load")),
        Case("the same after a ramp of 2 s", "EccentricLoad", 1e-2, ramp, (*free, "phi_load")),
        Case("free shaft, 10 s at 500 Hz", "FreeShaft", 2e-3, np.full(5001, 100.0), free),
    ]


class Ours:
    def __init__(self, case: Case, model, folder: Path) -> None:
        self.fmu = load_fmu(package(model, folder))
        name = next(v.name for v in model.variables if v.causality == "input")
        run = Task(np.arange(len(case.u)) * case.h, {name: case.u}, case.outputs)
        self.task = {tol: replace(run, tolerance=tol) for tol in (*OURS, 1e-10)}
        state = {v.location.index: v.name for v in model.variables if v.location.vector == "x"}
        seen = self.fmu.simulate(replace(run, outputs=tuple(state[i] for i in range(model.n_x))), {})
        self.largest = np.maximum(np.abs(seen).max(axis=1), 1e-6)

    def run(self, tol: float) -> tuple[float, np.ndarray]:
        begun = time.process_time()
        y = self.fmu.simulate(self.task[tol], {})
        return time.process_time() - begun, y


class Cvodes:
    def __init__(self, case: Case, model, largest: np.ndarray) -> None:
        f = model.functions
        p = np.zeros(model.n_p)
        for v in model.variables:
            if v.location.vector == "p" and v.start is not None:
                p[v.location.index] = v.location.sign * v.start
        d = f["dependent"](p)
        self.x0 = f["start"](p, d)[0] / largest
        t, scaled, u = ca.SX.sym("t"), ca.SX.sym("x", model.n_x), ca.SX.sym("u", model.n_u)
        x = largest * scaled
        zeros = [ca.DM.zeros(n, 1) for n in (model.n_z, model.n_z, model.n_m, model.n_y)]
        environment = [t, x, u, ca.DM(p), d, *zeros]
        slopes = f["derivatives"](*environment)
        self.dae = {"x": scaled, "u": u, "t": t, "ode": slopes / largest}
        self.t = np.arange(len(case.u)) * case.h
        self.u = case.u
        by_name = {v.name: v.location for v in model.variables}
        places = [by_name[name] for name in case.outputs]
        values = {"x": x, "v": f["variables"](*environment), "dx": slopes}
        out = ca.vertcat(*[at.sign * values[at.vector][at.index] for at in places])
        self.outputs = ca.Function("outputs", [t, scaled, u], [out]).map(len(case.u))
        self.integrators: dict[float, ca.Function] = {}

    def run(self, tol: float) -> tuple[float, np.ndarray]:
        if tol not in self.integrators:
            options = {"abstol": tol, "reltol": tol, "max_num_steps": 1000000, "jit": True, "compiler": "shell"}
            options["jit_options"] = {"flags": ["-O2"], "verbose": False}
            self.integrators[tol] = ca.integrator("cvodes", "cvodes", self.dae, 0.0, self.t[1:], options)
        begun = time.process_time()
        x = self.integrators[tol](x0=self.x0, u=self.u[:-1].reshape(1, -1))["xf"]
        elapsed = time.process_time() - begun
        before = np.concatenate([self.u[:1], self.u[:-1]])
        y = self.outputs(self.t.reshape(1, -1), ca.horzcat(self.x0, x), before.reshape(1, -1))
        return elapsed, np.array(y)


def time_for(error: float, curve: list[tuple[float, float]]) -> float:
    """Time for an error by log-log interpolation of (error, time); infinite where the tool did not reach it."""
    curve = sorted(curve)
    errors, times = np.log([c[0] for c in curve]), np.log([c[1] for c in curve])
    if np.log(error) < errors[0]:
        return np.inf
    return float(np.exp(np.interp(np.log(error), errors, times)))


def measure(repeats: int = 5, *, quick: bool = False) -> dict[str, dict[float, tuple[float, float]]]:
    """Times in s of the FMU and of CVODES by case and error."""
    results: dict[str, dict[float, tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for case in cases()[: 1 if quick else None]:
            model = compile_modelica(SETUPS / f"{case.setup}.mo", f"Drives.Setups.{case.setup}")
            ours = Ours(case, model, Path(folder))
            cvodes = Cvodes(case, model, ours.largest)
            truth = ours.run(1e-10)[1]
            size = np.abs(truth).max(axis=1)
            curves: Mapping[object, list[tuple[float, float]]] = {ours: [], cvodes: []}
            for tool, tolerances in ((ours, OURS), (cvodes, CVODES)):
                for tol in tolerances:
                    try:
                        runs = [tool.run(tol) for _ in range(repeats)]
                    except RuntimeError:  # CVODES gives up at a kink
                        continue
                    error = np.sqrt(np.mean((runs[0][1] - truth) ** 2, axis=1)) / size
                    curves[tool].append((float(error.max()), min(t for t, _ in runs)))
            results[case.label] = {e: (time_for(e, curves[ours]), time_for(e, curves[cvodes])) for e in ERRORS}
    return results
