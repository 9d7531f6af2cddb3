"""One simulation of a light FMU: fmuid, FMPy with everything reused, and a hand-written C loop, side by side."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from timing import in_turn

from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task

sys.path.append(str(Path(__file__).parents[1]))
from tests.simulation.fmus import HEADERS, make_oscillator

LOOP = r"""
#include "fmi2Functions.h"
typedef struct {
    fmi2ResetTYPE *reset; fmi2SetupExperimentTYPE *setup; fmi2EnterInitializationModeTYPE *enter;
    fmi2ExitInitializationModeTYPE *leave; fmi2SetRealTYPE *set; fmi2GetRealTYPE *get; fmi2DoStepTYPE *step;
    fmi2TerminateTYPE *terminate;
} Functions;
int loop(const Functions *f, fmi2Component c, size_t n, const double *t, size_t nu, const unsigned *ur,
         const double *u, size_t ny, const unsigned *yr, double *y)
{
    f->reset(c); f->setup(c, 0, 0, t[0], 1, t[n - 1]); f->enter(c);
    if (nu) f->set(c, ur, nu, u);
    f->leave(c);
    f->get(c, yr, ny, y);
    for (size_t k = 0; k + 1 < n; k++) {
        if (nu && f->set(c, ur, nu, u + k * nu) > 1) return 1;
        if (f->step(c, t[k], t[k + 1] - t[k], 1) > 1) return 1;
        if (f->get(c, yr, ny, y + (k + 1) * ny) > 1) return 1;
    }
    f->terminate(c);
    return 0;
}
"""
NO_PARAMETERS: Mapping[str, float] = {}


def with_fmuid(path: Path, task: Task) -> Callable[[], np.ndarray]:
    fmu = Fmu(path)
    return lambda: fmu.simulate(task, NO_PARAMETERS)


def with_c(path: Path, task: Task) -> Callable[[], np.ndarray]:
    """Return the simulation as somebody would write it in C for this one FMU."""
    fmu = Fmu(path)
    fmu.simulate(task, NO_PARAMETERS)  # loads and instantiates it
    source, shared = path.with_name("loop.c"), path.with_name("loop.so")
    source.write_text(LOOP)
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", f"-I{HEADERS}", "-o", shared, source], check=True)
    names = "Reset SetupExperiment EnterInitializationMode ExitInitializationMode SetReal GetReal DoStep Terminate"
    functions = (ctypes.c_void_p * 8)(*(fmu._load().address(n) for n in names.split()))
    n, inputs, outputs = len(task.time), list(task.inputs), list(task.outputs)
    u = np.column_stack([*task.inputs.values(), np.zeros(n)])[:, : len(inputs)].copy()
    ur, yr = (np.array([fmu._slots[k].reference for k in group], np.uint32) for group in (inputs, outputs))
    y = np.empty((n, len(outputs)))
    loop = ctypes.CDLL(str(shared)).loop
    size, pointer = ctypes.c_size_t, ctypes.c_void_p
    loop.argtypes = [pointer, pointer, size, pointer, size, pointer, pointer, size, pointer, pointer]
    arrays = (task.time, ur, u, yr, y)
    places = [a.ctypes.data for a in arrays]

    def run() -> np.ndarray:
        assert len(arrays) == len(places)  # which also keeps them alive
        assert not loop(
            functions, fmu._instance, n, places[0], len(inputs), *places[1:3], len(outputs), *places[3:]
        )
        return y.T

    return run


def with_fmpy(path: Path, task: Task) -> Callable[[], np.ndarray]:
    description, extracted = fmpy.read_model_description(str(path)), fmpy.extract(str(path))
    instance = fmpy.instantiate_fmu(extracted, description, "CoSimulation")
    signals = None
    if task.inputs:
        signals = np.zeros(len(task.time), dtype=[("time", float), *((k, float) for k in task.inputs)])
        signals["time"] = task.time
        for k, values in task.inputs.items():
            signals[k] = values
    settings: dict[str, Any] = {"model_description": description, "fmu_instance": instance, "input": signals}
    settings |= {"start_time": task.time[0], "stop_time": task.time[-1], "output": list(task.outputs)}

    def run() -> np.ndarray:
        instance.reset()
        y = fmpy.simulate_fmu(extracted, output_interval=task.time[1], fmi_type="CoSimulation", **settings)
        return np.array([y[k] for k in task.outputs])

    return run


def measure(folder: Path, *, quick: bool = False) -> list[tuple[str, float, float, float]]:
    """Return (what, C loop, fmuid, FMPy) in ms, medians."""
    path = make_oscillator(folder)
    long, short = np.arange(2001) * 1e-3, np.arange(501) * 1e-3
    prbs = np.sign(np.sin(np.cumsum(np.arange(501) % 37)))
    rows = []
    for label, task in {
        "2000 steps, no input": Task(long, {}, ("x", "v")),
        "2000 steps, 1 input": Task(long, {"u": np.sin(7 * long)}, ("x", "v")),
        "2000 steps, 2 inputs": Task(long, {"u": np.sin(7 * long), "w": np.cos(7 * long)}, ("x", "v")),
        "500 steps, 1 input": Task(short, {"u": prbs}, ("x", "v")),
    }.items():
        by_c, ours, theirs = (make(path, task) for make in (with_c, with_fmuid, with_fmpy))
        np.testing.assert_allclose(theirs()[:, : len(task.time)], ours(), rtol=1e-9, atol=1e-12)
        assert np.array_equal(by_c(), ours())
        compiled = in_turn({"C": by_c, "fmuid": ours}, 20 if quick else 1000)
        slow = in_turn({"FMPy": theirs}, 1 if quick else 9)["FMPy"]
        rows.append((label, *(1e3 * t.median for t in (compiled["C"], compiled["fmuid"], slow))))
    return rows
