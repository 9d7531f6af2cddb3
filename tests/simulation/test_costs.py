"""What fmuid costs around the FMU's own work, by processor time: load of the machine must not decide."""

from __future__ import annotations

import gc
import os
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid.core.campaign import ParameterSpec
from fmuid.identification.problem.cases import measured_case
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.pool.worker_process import resident_memory
from fmuid.simulation.simulator import Task

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="the loop in C is compiled")


@pytest.fixture(scope="module")
def stepping():
    sys.path.insert(0, str(BENCHMARKS))
    import stepping

    yield stepping
    sys.path.remove(str(BENCHMARKS))


def least(run, repeats):
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        run()
        times.append(time.process_time() - begun)
    return min(times)


def ratio(run, other, repeats):
    """The least of several rounds, in which the two alternate."""
    return min(least(run, repeats) / least(other, repeats) for _ in range(5))


@needs_compiler
@pytest.mark.parametrize("steps", [500, 2000])
def test_a_light_fmu_is_stepped_about_as_fast_as_by_hand(stepping, tmp_path, steps):
    path, t = stepping.make_oscillator(tmp_path), np.arange(steps + 1) * 1e-3
    task = Task(t, {"u": np.sign(np.sin(np.cumsum(np.arange(steps + 1) % 37)))}, ("x", "v"))
    ours, by_hand = stepping.with_fmuid(path, task), stepping.with_c(path, task)
    assert np.array_equal(ours(), by_hand())
    assert ratio(ours, by_hand, 300) < 1.3


@needs_compiler
def test_around_the_steps_of_a_real_fmu_next_to_nothing_is_spent(stepping, fmus, tmp_path):
    path = tmp_path / "FixedShaft.fmu"
    path.write_bytes(fmus["FixedShaft"].read_bytes())
    u = 0.8 * np.where(np.arange(501) // 15 % 2, -1.0, 1.0)
    task = Task(1e-3 * np.arange(501), {"i_cmd": u}, ("tau_sensor", "w_motor"))
    assert ratio(stepping.with_fmuid(path, task), stepping.with_c(path, task), 7) < 1.05


def test_a_run_with_its_derivatives_costs_less_than_differences(fmus):
    """By a dozen parameters, elements of the loss table among them: less than half of forward differences."""
    fmu, t = load_fmu(fmus["FixedShaft"]), 5e-4 * np.arange(401)
    plain = Task(t, {"i_cmd": 0.8 * np.where(np.arange(401) // 60 % 2, -1.0, 1.0)}, ("tau_sensor", "w_motor"))
    names = [n for n, v in fmu.variables.items() if v.causality == "parameter" and fmu.differentiates([n])][:12]
    assert any(name.startswith("lossTable") for name in names)
    for chosen, most in ((names[:3], 4.0), (names, 6.0)):
        along = replace(plain, along=tuple({name: 1.0} for name in chosen))
        assert ratio(lambda along=along: fmu.simulate(along, {}), lambda: fmu.simulate(plain, {}), 20) < most


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
        rng, found = np.random.default_rng(0), []
        for k in range(1, counts[-1] + 1):
            assert problem.evaluate(problem.space.start * (1.0 + 1e-3 * rng.standard_normal(2))).ok
            if k in counts:
                gc.collect()
                found.append(resident_memory(os.getpid()))
        return found


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux tells")
def test_evaluations_leave_nothing_in_memory(build):
    early, kept, late = memory_after(build(2), (200, 4_500, 6_500))
    assert kept - early < 20 * 2**20  # by then as many predictions are kept as ever will be
    assert late - kept < 4 * 2**20


@pytest.mark.parametrize(
    ("code", "seconds"),
    [
        ("import fmuid", 0.3),
        ("import sys; from fmuid.cli import main; sys.argv = ['fmuid', '--help']; main()", 0.5),
    ],
)
def test_what_starts_often_starts_fast(code, seconds):
    def spent(text):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", text], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    assert min(spent(code) for _ in range(3)) < seconds
    heavy = "{'scipy', 'fmpy', 'matplotlib', 'plotly', 'pandas', 'nlopt', 'h5py'}"
    check = (
        f"import atexit, sys; atexit.register(lambda: sys.stderr.write(str(sorted({heavy} & set(sys.modules)))))"
    )
    done = subprocess.run([sys.executable, "-c", f"{check}; {code}"], check=True, capture_output=True, text=True)
    assert done.stderr.endswith("[]")
