"""The compiled loop and the Python one: the same numbers, and no compiler needed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from fmus import FAULTS

from fmuid.errors import SimulationError
from fmuid.simulators import stepper
from fmuid.simulators.fmu import Fmu
from fmuid.simulators.simulation import Task

UNEVEN = np.cumsum(np.random.default_rng(0).uniform(1e-3, 9e-3, 200))
SIGNALS = {"u": np.sin(20 * UNEVEN), "flip": (UNEVEN > 0.4).astype(float)}


@pytest.fixture
def python_only(monkeypatch):
    """Pretend that there is no compiler."""
    stepper.library.cache_clear()
    monkeypatch.setenv("FMUID_STEPPER", "python")
    yield
    stepper.library.cache_clear()


@pytest.mark.parametrize(
    ("fmi", "interface", "interpolation"),
    [
        (2, "CoSimulation", "hold"),
        (2, "CoSimulation", "linear"),
        (3, "CoSimulation", "hold"),
        (2, "ModelExchange", "hold"),
        (2, "ModelExchange", "linear"),
        (3, "ModelExchange", "hold"),
        (3, "ModelExchange", "linear"),
    ],
)
def test_python_and_c_agree_to_the_last_digit(build, fmi, interface, interpolation, python_only, monkeypatch):
    path = build(fmi, (interface,), interpolates=True)
    outputs = ("x", "v", "y", "count", "ticks")
    task = Task(UNEVEN, SIGNALS, outputs, {"x": 0.2}, interpolation, tolerance=1e-5)
    parameters = {"d": 1.0, "c": 2e3, "level": 0.02, "mode": 2}
    slow = Fmu(path).simulate(task, parameters)
    monkeypatch.delenv("FMUID_STEPPER")
    stepper.library.cache_clear()
    assert stepper.library() is not None
    assert np.array_equal(Fmu(path).simulate(task, parameters), slow)


@pytest.mark.parametrize("fault", ["nan", "fails", "fatal", "ends"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_python_fails_as_c_does(build, fmi, fault, python_only):
    with pytest.raises(SimulationError, match=r"at t = 0\.1"):
        Fmu(build(fmi)).simulate(Task(np.arange(500) * 1e-3, {}, ("y",)), {"fault": FAULTS[fault]})


def test_compiled_once_and_kept_by_content(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    sources = [Path(stepper.__file__).with_name(f"{n}.c") for n in ("stepper", "model_exchange")]
    library = stepper._compile(sources)
    assert library is not None
    assert library.parent == tmp_path / "fmuid"
    assert [p.name for p in library.parent.iterdir()] == [library.name]  # nothing half-made is left
    monkeypatch.setenv("PATH", "")
    assert stepper._compile(sources) == library


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    stepper.library.cache_clear()
    yield tmp_path / "fmuid"
    stepper.library.cache_clear()


def test_no_compiler_costs_speed_and_is_said(build, empty_cache, monkeypatch):
    path = build(2)
    monkeypatch.setenv("PATH", "")
    with pytest.warns(UserWarning, match="no working C compiler"):
        assert Fmu(path).simulate(Task(UNEVEN, SIGNALS, ("x",)), {}).shape == (1, 200)


@pytest.mark.parametrize("workers", ["0", "1"])
def test_a_command_says_in_one_line_that_there_is_no_compiler(build, empty_cache, workers):
    path = build(2)
    command = ["from fmuid.cli import main; main()", "simulate", str(path), "--stop", "1", "--workers", workers]
    environment = os.environ | {"PATH": "", "TMPDIR": str(empty_cache.parent)}
    told = subprocess.run(
        [sys.executable, "-c", *command, "--out", str(empty_cache.parent / "out.csv")],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stderr == (
        "fmuid: warning: no working C compiler: FMUs are stepped in Python, with the same results but slower\n"
    )


def test_a_spoilt_library_is_made_again(empty_cache):
    assert stepper.library() is not None
    (made,) = empty_cache.iterdir()
    stepper.library.cache_clear()
    made.unlink()
    made.write_bytes(b"spoilt")
    assert stepper.library() is not None


def test_ctrl_c_stops_a_simulation_between_two_steps(build):
    script = f"""
        import numpy as np
        from fmuid.simulators.fmu import Fmu
        from fmuid.simulators.simulation import Task
        fmu = Fmu({str(build(2))!r})
        task = Task(np.arange(5000) * 1e-3, {{}}, ("y",))
        print("go", flush=True)
        try:
            fmu.simulate(task, {{"fault": {FAULTS["slow"]}}})  # 100 s
        except KeyboardInterrupt:
            print("stopped", fmu.simulate(task, {{}}).shape)
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "go\n"
    time.sleep(0.4)
    os.kill(process.pid, signal.SIGINT)
    out, _ = process.communicate(timeout=10)
    assert out == "stopped (1, 5000)\n"
