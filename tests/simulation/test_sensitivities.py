"""Derivatives of whole runs: exact through reversals, the same from both steppers and from workers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmu_build import build as build_modelica
from fmuid import stepper
from fmuid.errors import FmuError
from fmuid.fmu import Fmu
from fmuid.simulation import Task, differentiates
from fmuid.workers import WorkerPool

MODEL = """
model Slider "A mass that reverses in dry friction"
  parameter Real m = 0.8;
  parameter Real d = 0.5;
  parameter Real fc[2] = {0.4, 0.4} "Coulomb friction forward, backward";
  input Real u;
  output Real x(start = 0, fixed = true);
  output Real v(start = 0.1, fixed = true);
protected
  Real z(start = 0, fixed = true) "Bristle";
  Real level = if noEvent(v > 0) then fc[1] else fc[2];
equation
  der(x) = v;
  m*der(v) = u - d*v - level*z;
  0.002*der(z) = v - abs(v)*z;
end Slider;
"""
TIME = 5e-3 * np.arange(401)
TASK = Task(TIME, {"u": 1.5 * np.sign(np.sin(2 * np.pi * 1.3 * TIME))}, ("x", "v"), tolerance=1e-9)
VALUES = {"m": 0.8, "d": 0.5, "fc[1]": 0.4, "fc[2]": 0.4}
ALONG = ({"m": 1.0}, {"d": 2.0}, {"fc[1]": 1.0, "fc[2]": 1.0}, {"v": 1.0})


@pytest.fixture(scope="module")
def slider(tmp_path_factory):
    folder = tmp_path_factory.mktemp("slider")
    (folder / "Slider.mo").write_text(MODEL)
    return build_modelica(folder / "Slider.mo", "Slider", folder)


def test_derivatives_are_those_of_accurate_runs_through_reversals(slider):
    fmu = Fmu(slider)
    assert differentiates(fmu, ["m", "d", "fc[1]", "v"])
    assert not differentiates(fmu, ["m", "u"])
    assert not differentiates(fmu, ["nothing"])
    got = fmu.simulate(replace(TASK, along=ALONG), VALUES)
    assert np.array_equal(got[:2], fmu.simulate(TASK, VALUES))
    assert np.count_nonzero(np.diff(np.sign(got[1]))) >= 4
    start = {**VALUES, "v": 0.1}
    for direction, rows in zip(ALONG, got[2:].reshape(-1, 2, len(TIME)), strict=True):
        ends = [
            fmu.simulate(
                replace(TASK, tolerance=1e-12), start | {n: start[n] + s * 1e-4 * w for n, w in direction.items()}
            )
            for s in (1, -1)
        ]
        exact = (ends[0] - ends[1]) / 2e-4
        error = np.linalg.norm(rows - exact, axis=1) / np.linalg.norm(exact, axis=1)
        assert np.all(error < 2e-3), (direction, error)


def test_steppers_and_workers_agree(slider, monkeypatch):
    task = replace(TASK, along=ALONG[:2], tolerance=1e-5)
    fast = Fmu(slider).simulate(task, VALUES)
    with WorkerPool(1) as pool:
        (far,) = pool.run([(Fmu(slider), task, VALUES)])
    assert np.array_equal(far, fast)
    stepper.library.cache_clear()
    monkeypatch.setenv("FMUID_STEPPER", "python")
    slow = Fmu(slider).simulate(task, VALUES)
    stepper.library.cache_clear()
    assert np.array_equal(slow, fast)


def test_other_fmus_have_none(build):
    fmu = Fmu(build(2))
    assert not differentiates(fmu, ["c"])
    with pytest.raises(FmuError, match="cannot differentiate"):
        fmu.simulate(Task(TIME, {}, ("x",), along=({"c": 1.0},)), {})
