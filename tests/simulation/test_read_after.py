"""Outputs that a recorder reads a part of a step after the inputs of their row act."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmu_build import build
from fmuid.core.errors import FmuError
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.segmented import Segmented
from fmuid.simulation.signal_model import SignalModel
from fmuid.simulation.simulator import Task

MODEL = """
model Resonant
  parameter Real k = 400;
  input Real F;
  input Real drag = 0;
  output Real x(start = 0, fixed = true);
  output Real v(start = 0, fixed = true);
  output Real direct = 2*F;
equation
  der(x) = v;
  der(v) = F - (2 + drag)*v - k*x;
end Resonant;
"""
STEP, AFTER = 0.02, 0.014
TIME = STEP * np.arange(120)
FORCE = np.repeat(np.random.default_rng(1).normal(size=24), 5)
DRAG = 3.0 + np.sin(3.0 * TIME)
TASK = Task(TIME, {"F": FORCE, "drag": DRAG}, ("x", "v", "direct"), linear=("drag",), read_after=AFTER)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("resonant")
    (folder / "Resonant.mo").write_text(MODEL)
    return build(folder / "Resonant.mo", "Resonant", folder, "2")


def expected(fmu: Fmu, force: np.ndarray = FORCE) -> np.ndarray:
    """The response on a grid ten times finer, of which every sample but the last has a reading after seven steps."""
    grid = 0.1 * STEP * np.arange(10 * len(TIME))
    inputs = {"F": np.repeat(force, 10), "drag": np.interp(grid, TIME, DRAG)}
    return fmu.simulate(Task(grid, inputs, TASK.outputs, linear=("drag",)), {})[:, 7::10]


@pytest.mark.parametrize("interface", ["co-simulation", "model exchange"])
def test_outputs_are_those_a_part_of_a_step_after_the_inputs(path: Path, interface) -> None:
    with Fmu(path, interface) as fmu:
        y, true = fmu.simulate(TASK, {}), expected(fmu)
        at_once = fmu.simulate(replace(TASK, read_after=0.0), {})
    assert y.shape == (3, len(TIME))
    np.testing.assert_allclose(y, true, rtol=1e-3, atol=1e-6)
    assert np.abs(at_once[:2] - true[:2]).max() > 0.1 * np.ptp(true[0])
    np.testing.assert_array_equal(y[2], 2 * FORCE)  # the input of the same row


def test_segments_and_derivatives_read_as_whole_runs_do(path: Path) -> None:
    with Fmu(path, "co-simulation") as fmu:
        task = replace(TASK, outputs=("x", "v"), along=({"k": 1.0},))
        whole = fmu.simulate(task, {})
        steps = [fmu.simulate(replace(TASK, outputs=("x", "v")), {"k": k}) for k in (401.0, 399.0)]
        np.testing.assert_allclose(whole[2:], 0.5 * (steps[0] - steps[1]), rtol=1e-3, atol=1e-6)
        known = np.ones_like(whole[:2])
        segmented = Segmented(fmu, replace(task, along=()), 0.5, target=whole[:2], weight=known, at={})
        np.testing.assert_allclose(segmented.simulate(replace(task, along=()), {}), whole[:2], atol=1e-4)


def test_effects_at_signals_act_before_the_reading(path: Path) -> None:
    with Fmu(path, "co-simulation") as fmu:
        model = SignalModel(fmu, ("F.gain", "x.delay", "v.offset"))
        scaled = model.simulate(TASK, {"F.gain": 0.5, "v.offset": 1.0})
        np.testing.assert_allclose(scaled[0], expected(fmu, 0.5 * FORCE)[0], rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(scaled[1] - 1.0, expected(fmu, 0.5 * FORCE)[1], rtol=1e-3, atol=1e-6)
        late = model.simulate(TASK, {"x.delay": AFTER})[0]
        at_once = fmu.simulate(replace(TASK, read_after=0.0), {})[0]
    np.testing.assert_allclose(late, at_once, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("how", [{"read_after": AFTER}, {"interpolation": "band-limited", "linear": ()}])
def test_segments_read_through_sensors_with_effects(path: Path, how) -> None:
    """Start states of segments are fitted through the sensors."""
    values = {"F.gain": 0.5, "v.offset": 1.0, "x.delay": 0.5 * STEP}
    task = replace(TASK, outputs=("x", "v"), **{"read_after": 0.0, **how})
    with Fmu(path, "co-simulation") as fmu:
        model = SignalModel(fmu, ("F.gain", "x.delay", "v.offset"))
        whole = model.simulate(task, values)
        segmented = Segmented(model, task, 0.8, target=whole, weight=np.ones_like(whole), at=values)
        np.testing.assert_allclose(segmented.simulate(task, values), whole, atol=1e-3)


def test_readings_after_the_next_inputs_and_beside_band_limited_ones_are_refused(path: Path) -> None:
    with Fmu(path, "co-simulation") as fmu:
        with pytest.raises(FmuError, match=r"read 0\.02 s after the inputs act, but the next inputs act by then"):
            fmu.simulate(replace(TASK, read_after=STEP), {})
        with pytest.raises(FmuError, match="outputs are read after band-limited inputs"):
            fmu.simulate(replace(TASK, linear=(), band_limited=("F",)), {})
