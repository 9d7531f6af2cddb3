"""Further inputs that are interpolated while those of the campaign are held."""

from __future__ import annotations

import numpy as np

from fmu_build import build
from fmuid.diagnosis.extended_model import _lined
from fmuid.diagnosis.free_functions import hats
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task

MODEL = """
model Twice "Two integrators, so that every course of the inputs shows"
  input Real held;
  input Real driven;
  output Real x(start = 0, fixed = true);
  output Real y(start = 0, fixed = true);
equation
  der(x) = held + driven;
  der(y) = x;
end Twice;
"""


def test_a_held_and_a_linear_input(tmp_path):
    (tmp_path / "Twice.mo").write_text(MODEL)
    time = np.linspace(0.0, 2.0, 41)
    held, driven = np.where(np.arange(41) % 7 < 3, 1.0, -1.0), np.interp(time, [0.5, 1.0, 1.3], [0.0, 2.0, 0.0])
    with Fmu(build(tmp_path / "Twice.mo", "Twice", tmp_path)) as fmu:
        assert fmu.interpolates_inputs
        x, y = fmu.simulate(Task(time, {"held": held, "driven": driven}, ("x", "y"), linear=("driven",)), {})
    h = np.diff(time)
    slope = np.diff(driven) / h
    exact_x = np.append(0.0, np.cumsum(h * (held[:-1] + 0.5 * (driven[:-1] + driven[1:]))))
    exact_y = np.append(0.0, np.cumsum(h * exact_x[:-1] + h**2 / 2 * (held[:-1] + driven[:-1]) + h**3 / 6 * slope))
    np.testing.assert_allclose(x, exact_x, atol=1e-9)
    np.testing.assert_allclose(y, exact_y, atol=1e-9)


def test_lines_follow_a_course_and_leave_zeros():
    time = np.sort(np.random.default_rng(0).uniform(0.0, 3.0, 900))
    course = np.where(time > 1.0, np.sin(5.0 * time) * np.exp(-time), 0.0)
    lined = _lined(course, time)
    assert np.abs(lined - course)[time > 1.01].max() < 0.04 * np.ptp(course)
    assert not lined[time <= 1.0].any()
    assert np.count_nonzero(np.abs(np.diff(np.diff(lined) / np.diff(time))) > 1e-6) < 60
    for (hat,) in hats([time], np.linspace(0.0, 3.0, 9)):
        np.testing.assert_allclose(_lined(hat, time), hat, atol=0.02)
