"""The actuator without a C compiler: its models in Python take the place of its FMUs."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np

from fmuid import CriterionSpec, ParameterSpec, Problem, Task, identify, measured_case
from tests.conftest import ROOT

TRUTH = {"d_S": 2.66, "J_S": 0.003039, "d_G": 70.625}  # as the paper identified them


def test_the_damping_of_the_gear_is_identified(shipped):
    model, time = shipped("FixedShaft"), np.arange(101) * 1e-3
    known = {name: TRUTH[name] for name in ("d_S", "J_S")}
    task = Task(time, {"i_cmd": np.where(time >= 0.01, 0.5, 0.0)}, ("tau_sensor",), known, tolerance=1e-8)
    exact = model.simulate(task, {"d_G": TRUTH["d_G"]})[0]
    noisy = exact + 0.05 * np.random.default_rng(3).standard_normal((3, time.size))
    criteria = [CriterionSpec("tau_sensor", options={"whiten": "sigma"})]
    case = measured_case("step", model, task, {"tau_sensor": noisy}, sigma={"tau_sensor": 0.05}, criteria=criteria)
    problem = Problem([case], [ParameterSpec("d_G", 56.5, 5.0, 500.0, scale="log")])
    damping = identify(problem).stages[0]["d_G"]
    assert damping.standard_error < 0.2
    assert abs(damping.value - TRUTH["d_G"]) < 4 * damping.standard_error


def test_without_a_compiler_the_tests_of_the_actuator_run_on_its_reference_models():
    files = ["tests/reference/test_physics.py", "tests/reference/test_effects.py"]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "-n",
        "0",
        "-k",
        "step or bit_for_bit",
        *files,
    ]
    scripts = os.path.dirname(sys.executable)  # noqa: PTH120
    environment = {k: v for k, v in os.environ.items() if k != "CC"} | {"PATH": scripts}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "note: the actuator's tests run on its pure-Python reference models (no C compiler)" in done.stdout
    assert "1 passed, 3 skipped" in done.stdout, done.stdout
    assert "needs FMUs of the actuator, not only its reference models" in done.stdout
