"""The compiled loop: failures, interruptions, and the message where it is missing."""

from __future__ import annotations

import ctypes
import itertools
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from fmus import FAULTS

from fmu_build import build as build_modelica
from fmuid.core.errors import FmuError, SimulationError
from fmuid.simulation import stepper
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task
from fmuid.simulation.stepper import Outcome


@pytest.mark.parametrize("fault", ["nan", "fails", "fatal", "ends"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_failure_is_said_with_its_time(build, fmi, fault):
    with pytest.raises(SimulationError, match=r"at t = 0\.1"):
        Fmu(build(fmi)).simulate(Task(np.arange(500) * 1e-3, {}, ("y",)), {"fault": FAULTS[fault]})


@pytest.fixture
def loaded_anew():
    stepper.library.cache_clear()
    yield
    stepper.library.cache_clear()


def test_without_the_compiled_part_one_line_says_what_to_do(build, loaded_anew, monkeypatch):
    monkeypatch.setattr(stepper, "find_spec", lambda _: None)
    with pytest.raises(FmuError, match="the compiled stepper is missing; install fmuid again"):
        Fmu(build(2)).simulate(Task(np.arange(5) * 1e-3, {}, ("y",)), {})


def test_a_compiled_part_of_another_version_is_refused(loaded_anew, monkeypatch):
    class Longer(ctypes.Structure):
        _fields_ = (("plan", stepper.Plan), ("more", ctypes.c_double))

    monkeypatch.setattr(stepper, "Plan", Longer)
    with pytest.raises(FmuError, match="older than the code"):
        stepper.library()


def test_ctrl_c_stops_a_simulation_between_two_steps(build):
    script = f"""
        import numpy as np
        from fmuid.simulation.fmu import Fmu
        from fmuid.simulation.simulator import Task
        fmu = Fmu({str(build(2))!r})
        task = Task(np.arange(500_000) * 1e-3, {{}}, ("y",))
        try:
            fmu.simulate(task, {{"fault": {FAULTS["interrupts"]}}})  # would last three hours
        except KeyboardInterrupt:
            print("stopped", fmu.simulate(task, {{}}).shape)
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    assert done.stdout == "stopped (1, 500000)\n"


def test_a_run_that_takes_far_longer_than_others_is_stopped(build, monkeypatch):
    monkeypatch.setattr(stepper, "_SLICE", 0.0)
    fmu, task = Fmu(build(2)), Task(np.arange(500) * 1e-3, {}, ("y",))
    monkeypatch.setattr(stepper.time, "thread_time", clock(1.0))
    expected = fmu.simulate(task, {})
    monkeypatch.setattr(stepper.time, "thread_time", clock(1e3))
    with pytest.raises(SimulationError, match=r"over 100 times as long as others and was stopped at t = 0\.\d+ s"):
        fmu.simulate(task, {})
    monkeypatch.setattr(stepper.time, "thread_time", clock(1e-2))
    assert np.array_equal(fmu.simulate(task, {}), expected)


OSCILLATOR = """
model Oscillator
  parameter Real w = 1;
  output Real x(start = 1, fixed = true);
  Real y(start = 0, fixed = true);
equation
  der(x) = w*y;
  der(y) = -w*x;
end Oscillator;
"""


def test_a_single_step_that_takes_far_longer_than_others_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(stepper, "_PATIENCE", 1e-2)
    (tmp_path / "Oscillator.mo").write_text(OSCILLATOR)
    fmu = Fmu(build_modelica(tmp_path / "Oscillator.mo", "Oscillator", tmp_path))
    task = Task(np.arange(3.0), {}, ("x",))
    expected = fmu.simulate(task, {})
    with pytest.raises(SimulationError, match=r"one step takes over \S+ s of processor time"):
        fmu.simulate(task, {"w": 1e9})
    assert np.array_equal(fmu.simulate(task, {}), expected)


def test_hours_in_which_the_machine_slept_are_no_measure_for_other_runs(monkeypatch):
    """Of a short run, only the clock is known; it must not let a later run go on for ever."""

    class Run:
        taken = 3600.0

    monkeypatch.setattr(stepper.time, "thread_time", clock(10.0))
    patience = stepper.Patience()
    assert patience.run_to_end(lambda *_: Outcome.DONE, Run(), 100) == Outcome.DONE
    outcomes = iter([*[Outcome.PAUSED] * 9, Outcome.DONE])
    assert patience.run_to_end(lambda *_: next(outcomes), Run(), 100) == Outcome.TOO_SLOW


def test_one_slow_run_leaves_others_no_more_time(monkeypatch):
    class Run:
        taken = 0.01

    monkeypatch.setattr(stepper.time, "thread_time", clock(1.0))
    patience = stepper.Patience()
    for _ in range(200):
        patience.run_to_end(lambda *_: Outcome.DONE, Run(), 100)
    slow, slower = (iter([*[Outcome.PAUSED] * pauses, Outcome.DONE]) for pauses in (1, 9))
    assert patience.run_to_end(lambda *_: next(slow), Run(), 100) == Outcome.DONE
    assert patience.run_to_end(lambda *_: next(slower), Run(), 100) == Outcome.TOO_SLOW


def clock(tick: float):
    """Return a clock that goes on by `tick` s each time it is looked at."""
    times = itertools.count()
    return lambda: tick * next(times)
