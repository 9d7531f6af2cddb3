"""Integration of model-exchange FMUs: accuracy, order, stiffness and events."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from fmuid.core.errors import SimulationError
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task

BOTH = pytest.mark.parametrize("fmi", [2, 3])


def exact(time, u, c, d, linear=False, x=(0.1, 0.0)):
    """The oscillator's response to held or linearly interpolated input."""
    rows = [np.array(x)]
    for k, h in enumerate(np.diff(time)):
        a = np.zeros((4, 4))
        a[0, 1], a[1, :3], a[2, 3] = 1, (-c, -d, 1), 1
        slope = (u[k + 1] - u[k]) / h if linear else 0
        rows.append((expm(a * h) @ [*rows[-1], u[k], slope])[:2])
    return np.array(rows).T


@BOTH
@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8])
def test_error_follows_the_tolerance(build, fmi, linear, tolerance):
    time = np.cumsum(np.random.default_rng(3).uniform(0.01, 0.2, 60))
    u = np.sin(5 * time)
    task = Task(time, {"u": u}, ("x", "v"), {}, "linear" if linear else "hold", tolerance)
    y = Fmu(build(fmi, ("ModelExchange",))).simulate(task, {"c": 80.0, "d": 0.7})
    reference = exact(time, u, 80.0, 0.7, linear)
    assert np.abs(y - reference).max() < 20 * tolerance * np.abs(reference).max()


def test_the_method_has_order_four(build):
    fmu = Fmu(build(2, ("ModelExchange",)))
    errors = []
    for n in (41, 81, 161):  # the communication points are the steps: tolerance out of the way
        time = np.linspace(0, 1, n)
        y = fmu.simulate(Task(time, {}, ("x", "v"), tolerance=1e3), {})
        errors.append(np.abs(y - exact(time, 0 * time, 100, 0.5)).max())
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (order > 3.7).all()


def test_a_stiff_model_costs_no_small_steps(build):
    # Eigenvalues -1e6 and -1: explicit methods need 1e6 steps here; at 1e-3 s a step this takes milliseconds.
    task = Task(np.linspace(0, 1, 101), {}, ("x",), tolerance=1e-6)
    y = Fmu(build(2, ("ModelExchange",))).simulate(task, {"c": 1e6, "d": 1e6 + 1})
    np.testing.assert_allclose(y[0, 5:], 0.1 * np.exp(-task.time[5:]), rtol=1e-4)


@BOTH
def test_directional_derivatives_spare_differences_of_noisy_derivatives(build, fmi):
    """The FMU's own solver leaves an error of 1e-8 in its derivatives, which differences would amplify."""
    time = np.linspace(0, 1, 101)
    task = Task(time, {}, ("x", "count"), {"level": -1.0}, tolerance=1e-6)
    x, calls = Fmu(build(fmi, ("ModelExchange",), ("NOISE=1e-8",))).simulate(task, {"c": 400.0, "d": 2.0})
    np.testing.assert_allclose(x, exact(time, 0 * time, 400.0, 2.0)[0], atol=2e-6)
    assert calls[-1] < 20 * len(time)  # about a hundred times as many with differences


@BOTH
def test_directional_derivatives_that_fail_leave_differences(build, fmi):
    task = Task(np.linspace(0, 1, 101), {}, ("x", "v"), tolerance=1e-6)
    declared = Fmu(build(fmi, ("ModelExchange",), ("DECLARES",)))
    assert declared.directional_references is not None
    plain = Fmu(build(fmi, ("ModelExchange",))).simulate(task, {"c": 80.0})
    np.testing.assert_array_equal(declared.simulate(task, {"c": 80.0}), plain)


@BOTH
def test_state_and_time_events(build, fmi):
    time = np.linspace(0, 2, 21)
    y = Fmu(build(fmi, ("ModelExchange",))).simulate(
        Task(time, {}, ("x", "count", "ticks"), tolerance=1e-8), {"d": 0.0, "c": 400.0, "level": 0.05}
    )
    falls = (np.arange(20) * 2 * np.pi + np.pi / 3) / 20  # cos(20 t) falls through one half
    np.testing.assert_allclose(y[0], 0.1 * np.cos(20 * time), atol=1e-6)
    assert y[1].tolist() == [np.sum(falls <= t) for t in time]
    assert y[2].tolist() == [np.sum(np.arange(0.25, t - 1e-9, 0.25) < t) for t in time]


@BOTH
def test_an_event_acts_at_its_time(build, fmi):
    time = np.linspace(0, 0.12, 9)
    y = Fmu(build(fmi, ("ModelExchange",))).simulate(
        Task(time, {}, ("x", "count"), tolerance=1e-9), {"d": 0.0, "c": 400.0, "level": 0.05, "kick": 3.0}
    )
    fall, speed = np.pi / 60, 3 - 2 * np.sin(np.pi / 3)
    after = 0.05 * np.cos(20 * (time - fall)) + speed / 20 * np.sin(20 * (time - fall))
    np.testing.assert_allclose(y[0], np.where(time < fall, 0.1 * np.cos(20 * time), after), atol=1e-7)
    assert y[1].tolist() == (time > fall).astype(float).tolist()


def test_predictions_are_read_before_the_next_input_is_set(build):
    time = np.linspace(0, 1, 11)
    switch = (time > 0.45).astype(float)
    y = Fmu(build(2, ("ModelExchange",))).simulate(Task(time, {"flip": switch}, ("y", "x")), {"bias": 1.0})
    assert np.round(y[0] - y[1], 9).tolist() == [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1]


def test_repeated_runs_are_identical(build):
    fmu = Fmu(build(2, ("ModelExchange",)))
    task = Task(np.linspace(0, 1, 101), {"u": np.sin(np.arange(101.0))}, ("x", "count"))
    first = fmu.simulate(task, {"c": 50.0})
    fmu.simulate(task, {"c": 5000.0})
    assert fmu.renewal == "reset"
    assert np.array_equal(fmu.simulate(task, {"c": 50.0}), first)


@pytest.mark.parametrize("define", ["STUCK", "RESTLESS"])
def test_events_without_end_are_an_error(build, define):
    fmu = Fmu(build(2, ("ModelExchange",), defines=(define,)))
    with pytest.raises(SimulationError, match="the event iteration does not settle"):
        fmu.simulate(Task(np.linspace(0, 1, 11), {}, ("x",)), {})


def test_a_step_into_the_impossible_is_shortened_or_fails(build):
    task = Task(np.linspace(0, 0.5, 3), {}, ("x",), tolerance=1e-3)
    fmu = Fmu(build(2, ("ModelExchange",), defines=("LIMIT=0.1001",)))
    np.testing.assert_allclose(fmu.simulate(task, {})[0], exact(task.time, 0 * task.time, 100, 0.5)[0], atol=1e-3)
    with pytest.raises(SimulationError, match=r"at t = 0\.000\d+ s: beyond the limit at"):
        fmu.simulate(task, {"v": 1.0})
