"""Derivatives of runs with events: analytic, or against central differences of accurate runs of the same FMU."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmu_build import build
from fmuid.core.errors import SimulationError
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task
from tests.conftest import MODELICA, build_setups
from tests.reference.experiments import LOSSY

JUMPS = Path(__file__).parent / "models" / "Jumps.mo"
STICK_SLIP = Path(__file__).parents[1] / "fmu_build" / "models" / "StickSlip.mo"


@pytest.fixture(scope="module")
def load(tmp_path_factory) -> Iterator[Callable[..., Fmu]]:
    folder, opened = tmp_path_factory.mktemp("jumps"), []

    def fmu(name: str, fmi: str = "2") -> Fmu:
        if name.startswith("StickSlip."):
            path = build(STICK_SLIP, name, folder / fmi, fmi=fmi, roots=[MODELICA])
        else:
            path = build(JUMPS, f"Jumps.{name}", folder / fmi, fmi)
        opened.append(Fmu(path))
        return opened[-1]

    yield fmu
    for one in opened:
        one.close()


def derivatives(fmu: Fmu, task: Task, values: Mapping[str, float]) -> np.ndarray:
    """Exact derivatives, (parameter, output, time); asking for them must not change the run."""
    got = fmu.simulate(replace(task, along=tuple({name: 1.0} for name in values)), values)
    assert np.array_equal(got[: len(task.outputs)], fmu.simulate(task, values))
    return got[len(task.outputs) :].reshape(len(values), len(task.outputs), -1)


def differences(
    fmu: Fmu, task: Task, values: Mapping[str, float], tolerance: float, step: float = 2e-6
) -> np.ndarray:
    accurate, out = replace(task, tolerance=tolerance), []
    for name, value in values.items():
        ends = [fmu.simulate(accurate, {**values, name: value * (1 + sign * step)}) for sign in (1, -1)]
        out.append((ends[0] - ends[1]) / (2 * step * value))
    return np.array(out)


def assert_close(got: np.ndarray, expected: np.ndarray, values: Sequence[float], bound: float) -> None:
    """Changes for equal relative changes of the parameters, by the largest of each output."""
    scale = np.array(values)[:, None, None]
    size = np.abs(scale * expected).max(axis=(0, 2))
    error = np.abs(scale * (got - expected)).max(axis=2) / size
    assert np.all(error < bound), error


def ball(t: float, e: complex, g: complex) -> tuple[complex, complex]:
    """Height and speed of a ball dropped from 1 m."""
    start, v = np.sqrt(2 / g), e * np.sqrt(2 * g)
    if t < start.real:
        return 1 - g * t**2 / 2, -g * t
    while t > (start + 2 * v / g).real:
        start, v = start + 2 * v / g, e * v
    return v * (t - start) - g * (t - start) ** 2 / 2, v - g * (t - start)


@pytest.mark.parametrize("fmi", ["2", "3"])
def test_a_bouncing_ball_after_six_bounces(load, fmi):
    time = np.linspace(0.0, 3.0, 98)
    task = Task(time, {}, ("h", "v"), tolerance=1e-8)
    fmu = load("Ball", fmi)
    assert fmu.differentiates(["e", "g"])
    got = derivatives(fmu, task, {"e": 0.8, "g": 9.81})
    for rows, moved in zip(got, [(0.8 + 1e-30j, 9.81), (0.8, 9.81 + 1e-30j)], strict=True):
        exact = np.array([ball(t, *moved) for t in time]).T.imag / 1e-30
        np.testing.assert_allclose(rows, exact, rtol=1e-7, atol=1e-6)


CASES: Mapping[str, tuple[Sequence[str], Mapping[str, float], float]] = {
    "Sampled": (["x", "u"], {"kp": 2, "ki": 3, "a": 1.5, "r": 1}, 3.0),
    "SampledLater": (["x", "u"], {"T0": 0.05, "T": 0.13, "k": 2}, 3.0),
    "Level": (["x", "w"], {"level": 0.7, "back": 0.2, "a": 1.3}, 3.0),
    "Thermostat": (["T", "heat"], {"low": 18, "high": 22, "tau": 2, "power": 12, "T0": 15}, 9.0),
    "Switch": (["x", "y"], {"t1": 0.37, "a": 2, "b": -3}, 2.0),
    "Loop": (["x", "y"], {"a": 1, "level": 0.8, "c": 2}, 2.0),
    "Timer": (["x", "w", "due"], {"level": 0.5, "delay": 0.3, "a": 1.1}, 3.0),
    "Chain": (["x", "w", "a", "b"], {"level": 0.5, "k": 1.7}, 1.5),
    "Slip": (["s", "v", "F"], {"F_c": 1, "F_max": 1.5, "c": 100, "v0": 0.1}, 2.0),
    "Initial": (["x", "z", "k"], {"a": 0.4, "b": 1.3}, 3.0),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_across_events(load, name):
    outputs, values, stop = CASES[name]
    fmu, task = load(name), Task(np.linspace(0.0, stop, 197), {}, tuple(outputs), tolerance=1e-8)
    expected = differences(fmu, task, values, 1e-10 if name == "Slip" else 1e-12)
    assert_close(derivatives(fmu, task, values), expected, list(values.values()), 5e-6)


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_friction_by_events_under_inputs(load, interpolation):
    """Break-away, sliding and stopping, set off by steps of the input at samples, or by ramps between them."""
    fmu, time = load("StickSlip.Brake"), np.arange(601) * 5.1e-3
    drive = np.interp(time, [0, 0.4, 1.1, 1.9, 2.5, 3.1], [0, 2.6, 2.3, -3.1, -2.2, 1.5])
    task = Task(time, {"drive": drive}, ("phi", "w"), {}, tolerance=1e-8, interpolation=interpolation)
    values = {"inertia.J": 0.1, "friction.tau_c": 2.0, "friction.b": 0.5}
    (w,) = fmu.simulate(replace(task, outputs=("w",)), values)
    assert np.any(w > 0.1)
    assert np.any(w < -0.1)
    assert np.count_nonzero(np.abs(w) < 1e-9) > 100
    expected = differences(fmu, task, values, 1e-10)
    assert_close(derivatives(fmu, task, values), expected, list(values.values()), 1e-4)


@pytest.mark.slow
def test_the_actuator_with_friction_by_events():
    """A stiff train whose friction law has a kink where it sticks: the events' ends are also kinks."""
    current = 0.8 * np.repeat(np.random.default_rng(3).choice([-1.0, 1.0], 6), 10)
    time = np.arange(current.size) * 1e-3
    task = Task(time, {"i_cmd": current}, ("tau_sensor", "w_motor"), LOSSY, tolerance=1e-6)
    values = {"K_m": 0.7, "lossTable[2,4]": 0.086781, "lossTable[1,4]": 0.095, "lossTable[2,2]": 0.979}
    with Fmu(build_setups(("FixedShaftWithEvents",))["FixedShaftWithEvents"]) as fmu:
        expected = differences(fmu, task, values, 1e-12, step=1e-4)
        assert_close(derivatives(fmu, task, values), expected, list(values.values()), 5e-5)


def test_the_error_follows_the_tolerance(load):
    outputs, values, stop = CASES["Thermostat"]
    fmu, task = load("Thermostat"), Task(np.linspace(0.0, stop, 197), {}, tuple(outputs))
    exact = derivatives(fmu, replace(task, tolerance=1e-11), values)
    for tolerance in (1e-4, 1e-6, 1e-8):
        got = derivatives(fmu, replace(task, tolerance=tolerance), values)
        assert_close(got, exact, list(values.values()), 300 * tolerance)


def test_an_event_that_is_only_grazed_is_refused(load):
    fmu, task = load("Ceiling"), Task(np.linspace(0.0, 1.0, 11), {}, ("h", "v"))
    assert np.any(fmu.simulate(task, {"H": 0.8 - 1e-9})[1] < -1.0)
    assert np.all(np.isfinite(derivatives(fmu, task, {"H": 0.79, "v0": 4.0})))
    assert np.all(derivatives(fmu, task, {"H": 0.81})[0] == 0.0)  # no event, no influence
    with pytest.raises(
        SimulationError, match=r"t = 0\.39\d+: the sensitivities are not defined.*only grazes zero"
    ):
        derivatives(fmu, task, {"H": 0.8 - 1e-9})


def test_an_indicator_that_is_zero_at_the_start_is_refused(load):
    """Stuck at the start: with any speed it would slide, one way or the other."""
    fmu, task = load("Slip"), Task(np.linspace(0.0, 0.1, 11), {}, ("s", "v"))
    assert np.all(derivatives(fmu, task, {"F_max": 1.5, "s": 0.0})[0] == 0.0)
    with pytest.raises(SimulationError, match="an event indicator is zero at the start"):
        derivatives(fmu, task, {"v": 0.0})
    assert np.any(derivatives(fmu, task, {"v": 0.01})[0, 1] != 0.0)


def test_two_events_at_once_are_refused_where_their_times_part(load):
    fmu, task = load("Crossing"), Task(np.linspace(0.0, 1.0, 12), {}, ("w",))
    values = {"T": 0.5, "level": 0.4}
    assert_close(derivatives(fmu, task, values), differences(fmu, task, values, 1e-10), [0.5, 0.4], 5e-6)
    with pytest.raises(SimulationError, match="two events at once whose times move differently"):
        derivatives(fmu, task, {"T": 0.5, "level": 0.5})
    assert np.all(derivatives(fmu, task, {"w": 1.0})[0] > 0.0)  # neither time depends on it
