"""One simulation of a light FMU: fmuid, FMPy with everything reused, and a hand-written C loop, side by side.

Run ``python benchmarks/stepping.py``; it prints times in ms (best of many) and ratios.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import fmpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "simulation"))
from fmus import HEADERS, make_oscillator

from fmuid import stepper
from fmuid.fmu import Fmu
from fmuid.simulation import Task

LOOP = r"""
#include "fmi2Functions.h"
typedef struct {
    fmi2ResetTYPE *reset; fmi2SetupExperimentTYPE *setup; fmi2EnterInitializationModeTYPE *enter;
    fmi2ExitInitializationModeTYPE *leave; fmi2SetRealTYPE *set; fmi2GetRealTYPE *get; fmi2DoStepTYPE *step;
    fmi2TerminateTYPE *terminate;
} Functions;
int loop(const Functions *f, fmi2Component c, size_t n, const double *t, size_t nu, const unsigned *ur, const double *u,
         size_t ny, const unsigned *yr, double *y)
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


def best(run: Callable[[], object], repeats: int) -> float:
    """Return the shortest time of `run` in ms."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return 1e3 * min(times)


def c_loop(folder: Path, fmu: Fmu, task: Task) -> Callable[[], np.ndarray]:
    """Return the simulation as somebody would write it in C for this one FMU."""
    source, library = folder / "loop.c", folder / "loop.so"
    source.write_text(LOOP)
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", f"-I{HEADERS}", "-o", library, source], check=True)
    dll = fmu._load()
    names = "Reset SetupExperiment EnterInitializationMode ExitInitializationMode SetReal GetReal DoStep Terminate"
    functions = (ctypes.c_void_p * 8)(*(dll.address(n) for n in names.split()))
    n, nu, ny = len(task.time), len(task.inputs), len(task.outputs)
    u = np.ascontiguousarray(np.column_stack(list(task.inputs.values()) or [np.zeros(n)]))
    ur, yr = (np.array([fmu._slots[k].reference for k in names], np.uint32) for names in (task.inputs, task.outputs))
    y = np.empty((n, ny))
    loop = ctypes.CDLL(str(library)).loop
    size, pointer = ctypes.c_size_t, ctypes.c_void_p
    loop.argtypes = [pointer, pointer, size, pointer, size, pointer, pointer, size, pointer, pointer]

    def run() -> np.ndarray:
        assert not loop(
            functions, fmu._instance, n, task.time.ctypes.data, nu, ur.ctypes.data, u.ctypes.data, ny, yr.ctypes.data,
            y.ctypes.data,
        )  # fmt: skip
        return y.T

    return run


def main() -> None:
    folder = Path(tempfile.mkdtemp())
    path = make_oscillator(folder, 2, defines=())
    description = fmpy.read_model_description(str(path))
    extracted = fmpy.extract(str(path))
    print(f"stepper: {'compiled' if stepper.library() else 'python'}; light FMU, FMI 2.0 co-simulation")
    print(f"{'':28}{'C loop':>10}{'fmuid':>10}{'FMPy':>10}{'fmuid / C':>12}{'FMPy / fmuid':>14}")
    time_ = np.arange(2001) * 1e-3
    for label, inputs in (("2000 steps, no input", ()), ("2000 steps, 1 input", ("u",)), ("2000 steps, 2 inputs", ("u", "d2"))):
        samples = {"u": np.sin(7 * time_), "d2": np.cos(7 * time_)}
        if "d2" in inputs:  # the second one is Boolean in this FMU: only fmuid and FMPy can tell
            samples = {"u": samples["u"], "flip": (samples["d2"] > 0).astype(float)}
            inputs = ("u", "flip")
        fmu = Fmu(path)
        task = Task(time_, {k: samples[k] for k in inputs}, ("x", "v"))
        parameters = {"c": 120.0, "d": 0.3}
        ours = best(lambda: fmu.simulate(task, parameters), 300)
        direct = float("nan")
        if "flip" not in inputs:
            run = c_loop(folder, fmu, task)
            plain = fmu.simulate(task, {"c": 100.0, "d": 0.5})
            fmu._instance, kept = fmu._instance, fmu._instance
            assert np.array_equal(run(), plain), kept
            direct = best(run, 300)
        instance = fmpy.instantiate_fmu(extracted, description, "CoSimulation")
        signals = None
        if inputs:
            types = {"flip": np.bool_}
            signals = np.zeros(len(time_), dtype=[("time", float), *((k, types.get(k, float)) for k in inputs)])
            signals["time"] = time_
            for k in inputs:
                signals[k] = samples[k]

        def peer() -> object:
            instance.reset()
            return fmpy.simulate_fmu(
                extracted, start_time=0.0, stop_time=2.0, output_interval=1e-3, input=signals, output=["x", "v"],
                start_values=parameters, model_description=description, fmu_instance=instance, fmi_type="CoSimulation",
            )  # fmt: skip

        theirs = best(peer, 5)
        print(f"{label:28}{direct:10.3f}{ours:10.3f}{theirs:10.2f}{ours / direct:12.2f}{theirs / ours:14.1f}")
    short = Task(time_[:501], {"u": np.sign(np.sin(50 * time_[:501]))}, ("x", "v"))
    fmu = Fmu(path)
    ours = best(lambda: fmu.simulate(short, {"c": 100.0, "d": 0.5}), 500)
    direct = best(c_loop(folder, fmu, short), 500)
    print(f"{'500 steps, PRBS-like input':28}{direct:10.3f}{ours:10.3f}{'':10}{ours / direct:12.2f}")


if __name__ == "__main__":
    main()
