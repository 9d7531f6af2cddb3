"""Inputs that passed an anti-aliasing filter before they were sampled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmu_build import build as build_model
from fmuid.core.errors import FmuError
from fmuid.simulation.coupled.loading import couple
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.segmented import Segmented
from fmuid.simulation.signal_model import SignalModel
from fmuid.simulation.simulator import Feedback, Task

MODEL = """
model Resonant
  parameter Real k = 2500;
  parameter Real d = 2;
  input Real F;
  input Real brake = 0;
  input Integer mode = 0;
  output Real x(start = 0, fixed = true);
  output Real v(start = 0, fixed = true);
  output Real direct = 2*F + mode;
equation
  der(x) = v;
  der(v) = F - (d + brake)*v - k*x;
end Resonant;
"""
STEP, COUNT, FINE = 0.02, 300, 24
TIME = STEP * np.arange(COUNT)
BETWEEN = STEP / FINE * np.arange(FINE * (COUNT - 1) + 1)
TOP = 0.65 * 0.5 / STEP  # Hz
INSIDE = slice(20, -20)  # the samples before and after a run are not known


def multisine(time: np.ndarray) -> np.ndarray:
    tones = np.linspace(0.05, 1.0, 23) * TOP
    phases = np.random.default_rng(7).uniform(0, 2 * np.pi, tones.size)
    return np.asarray(np.sum(np.cos(2 * np.pi * tones[:, None] * time + phases[:, None]), axis=0))


U = multisine(TIME)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("resonant")
    (folder / "Resonant.mo").write_text(MODEL)
    return build_model(folder / "Resonant.mo", "Resonant", folder, "2")


def true(fmu: Fmu, outputs: tuple[str, ...] = ("x", "v"), **inputs: np.ndarray) -> np.ndarray:
    """Return the response to the signal itself, which is known between the samples."""
    driven = {"F": multisine(BETWEEN)} | inputs
    return fmu.simulate(Task(BETWEEN, driven, outputs, interpolation="linear"), {})[:, ::FINE]


def error(y: np.ndarray, expected: np.ndarray) -> float:
    inside = (y - expected)[:, INSIDE]
    return float(np.max(np.sqrt(np.mean(inside**2, axis=1)) / np.std(expected, axis=1)))


@pytest.mark.parametrize("interface", ["co-simulation", "model exchange"])
def test_the_response_is_that_to_the_signal_that_was_sampled(path: Path, interface) -> None:
    with Fmu(path, interface) as fmu:
        expected = true(fmu)
        task = Task(TIME, {"F": U}, ("x", "v"), interpolation="band-limited")
        assert error(fmu.simulate(replace(task, interpolation="linear"), {}), expected) > 0.02
        assert error(fmu.simulate(task, {}), expected) < 1e-3
        direct = fmu.simulate(replace(task, outputs=("direct",)), {})
    np.testing.assert_allclose(direct[0], 2 * U, rtol=1e-12, atol=1e-12)


def test_inputs_of_other_timings_beside_it(path: Path) -> None:
    brake = np.repeat(np.random.default_rng(3).uniform(0, 8, COUNT // 10), 10)
    mode = np.repeat(np.arange(COUNT // 50), 50).astype(float)
    with Fmu(path) as fmu:
        held = np.append(np.repeat(brake[:-1], FINE), brake[-1])
        task = Task(BETWEEN, {"F": multisine(BETWEEN), "brake": held}, ("x", "v"), linear=("F",))
        expected = fmu.simulate(task, {})[:, ::FINE]
        task = Task(TIME, {"F": U, "brake": brake}, ("x", "v"), band_limited=("F",))
        assert error(fmu.simulate(task, {}), expected) < 1e-3
        expected = true(fmu, brake=np.interp(BETWEEN, TIME, brake))
        lines = replace(task, interpolation="band-limited", band_limited=(), linear=("brake",))
        assert error(fmu.simulate(lines, {}), expected) < 1e-3
        whole = Task(TIME, {"F": U, "mode": mode}, ("direct",), interpolation="band-limited")
        simulated = fmu.simulate(whole, {})[0]
    np.testing.assert_allclose(simulated, 2 * U + np.append(mode[0], mode[:-1]), rtol=1e-12, atol=1e-12)


def test_derivatives_are_those_of_the_same_response(path: Path) -> None:
    task = Task(TIME, {"F": U}, ("x",), interpolation="band-limited", tolerance=1e-9)
    with Fmu(path) as fmu:
        above, below = (fmu.simulate(task, {"k": 2500.0 + d, "d": 2.0}) for d in (1.0, -1.0))
        exact = fmu.simulate(replace(task, along=({"k": 1.0},)), {"k": 2500.0, "d": 2.0})[1:]
    np.testing.assert_allclose(exact, (above - below) / 2.0, atol=1e-4 * np.ptp(exact))


def test_segments_know_the_samples_beyond_their_ends(path: Path) -> None:
    task = Task(TIME, {"F": U}, ("x", "v"), interpolation="band-limited")
    with Fmu(path) as fmu:
        expected = true(fmu)
        cut = Segmented(fmu, task, 30 * STEP, expected, np.ones_like(expected), at={})
        assert cut.segments > 5
        assert error(cut.simulate(task, {}), expected) < 1e-3
        assert cut.state_tangents({}).shape == (2 * cut.segments, 2, COUNT)


def test_effects_on_the_signals_act_on_the_signal_that_was_sampled(path: Path) -> None:
    late = np.interp(BETWEEN - 0.4 * STEP, BETWEEN, multisine(BETWEEN))
    with Fmu(path) as fmu:
        expected = 1.2 * true(fmu, F=8.0 * np.tanh(late / 8.0))
        at = {"F.delay": 0.4 * STEP, "F.saturation": 8.0, "x.gain": 1.2, "v.gain": 1.2}
        model, task = SignalModel(fmu, tuple(at)), Task(TIME, {"F": U}, ("x", "v"), interpolation="linear")
        assert error(model.simulate(task, at), expected) > 0.02
        assert error(model.simulate(replace(task, interpolation="band-limited"), at), expected) < 5e-3


def test_coupled_models(path: Path) -> None:
    with Fmu(path) as fmu:
        expected = true(fmu, ("x",))
    model = couple({"rig": path, "idle": path}, {"idle.F": "rig.x"})
    task = Task(TIME, {"rig.F": U}, ("rig.x",), interpolation="band-limited")
    assert error(model.simulate(task, {}), expected) < 1e-3


def test_an_observer_corrects_at_the_samples(path: Path) -> None:
    with Fmu(path, "model exchange") as fmu:
        expected = true(fmu)
        task = Task(TIME, {"F": U}, ("x", "v"), interpolation="band-limited")
        feedback = Feedback(expected, np.diag([0.3, 0.3]))
        observed = fmu.simulate(replace(task, feedback=feedback), {"x": 0.01})
    assert error(observed, expected) < 1e-2


def test_what_cannot_be_band_limited(path: Path, build: Callable[..., Path]) -> None:
    uneven = TIME + np.where(np.arange(COUNT) > 100, 0.5 * STEP, 0.0)
    with Fmu(path) as fmu, pytest.raises(FmuError, match="band-limited inputs need even samples; resample"):
        fmu.simulate(Task(uneven, {"F": U}, ("x",), interpolation="band-limited"), {})
    task = Task(TIME, {"u": U}, ("y",), interpolation="band-limited")
    with Fmu(build(2)) as other, pytest.raises(FmuError, match=r'cannot interpolate its inputs.*timing = "held"'):
        other.simulate(task, {})
