"""What fmuid costs around the FMU's own work, in calls, lines and bytes; `make bench` measures the times."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid.core.campaign import ParameterSpec
from fmuid.identification.problem.cases import measured_case
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.pool.worker_process import resident_memory
from fmuid.simulation.simulator import Task

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def stepping():
    sys.path.insert(0, str(BENCHMARKS))
    import stepping

    yield stepping
    sys.path.remove(str(BENCHMARKS))


def lines_of_python(run):
    """Return how many lines of Python are executed."""
    lines = 0

    def trace(_frame, event, _argument):
        nonlocal lines
        lines += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        run()
    finally:
        sys.settrace(before)
    return lines


@pytest.mark.parametrize("signals", [{}, {"u": np.sin(np.arange(2001) / 9)}], ids=["free", "driven"])
def test_no_python_and_no_needless_call_between_two_steps(build, stepping, signals):
    """As in the loop that somebody would write in C for this FMU: set the inputs, step, get the outputs."""
    path, lines = build(2, defines=("CALLS",)), []
    for steps in (500, 2000):
        t = np.arange(steps + 1) * 1e-3
        task = Task(t, {name: u[: steps + 1] for name, u in signals.items()}, ("x", "v", "count"))
        fmu = Fmu(path)
        y = fmu.simulate(task, {})
        assert set(np.diff(y[2])) == {2.0 + bool(signals)}
        plain = replace(task, outputs=("x", "v"))
        assert np.array_equal(stepping.with_c(path, plain)(), y[:2])
        fmu.simulate(plain, {})  # what is prepared once
        lines.append(lines_of_python(lambda fmu=fmu, plain=plain: fmu.simulate(plain, {})))
    assert lines[0] == lines[1] < 400


def memory_after(path, counts):
    """Return the resident memory, in bytes, after so many evaluations."""
    t = np.arange(301) * 1e-3
    with Fmu(path) as fmu:
        task = Task(t, {"u": np.sin(20 * t)}, ("x", "v"))
        y = fmu.simulate(task, {})
        problem = Problem(
            [measured_case("run", fmu, task, {"x": y[0], "v": y[1]}, sigma={"x": 1e-3, "v": 1e-2})],
            [ParameterSpec("c", 100.0, 10.0, 1000.0), ParameterSpec("d", 0.5, 0.0, 5.0)],
        )
        rng, sizes = np.random.default_rng(0), []
        for k in range(1, counts[-1] + 1):
            assert problem.evaluate(problem.space.start * (1.0 + 1e-3 * rng.standard_normal(2))).ok
            if k in counts:
                gc.collect()
                sizes.append(resident_memory(os.getpid()))
        return sizes


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux tells")
def test_evaluations_leave_nothing_in_memory(build):
    early, kept, late = memory_after(build(2), (200, 4_500, 6_500))
    assert kept - early < 20 * 2**20  # by then as many predictions are kept as ever will be
    assert late - kept < 4 * 2**20


@pytest.mark.parametrize(
    "code", ["import fmuid", "import sys; from fmuid.cli import main; sys.argv = ['fmuid', '--help']; main()"]
)
def test_what_starts_often_loads_nothing_heavy(code):
    heavy = "{'scipy', 'fmpy', 'matplotlib', 'plotly', 'pandas', 'nlopt', 'h5py'}"
    check = (
        f"import atexit, sys; atexit.register(lambda: sys.stderr.write(str(sorted({heavy} & set(sys.modules)))))"
    )
    done = subprocess.run([sys.executable, "-c", f"{check}; {code}"], check=True, capture_output=True, text=True)
    assert done.stderr.endswith("[]")
