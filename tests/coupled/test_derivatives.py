"""Exact derivatives of coupled runs: they are those by finite differences, through connections, starts and events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from systems import coupled, split

import fmu_build
from fmuid.simulation.simulator import Task

TIME = np.linspace(0, 1, 51)
MASTERS = [(a, e) for a in ("jacobi", "gauss_seidel") for e in ("constant", "linear")]


def check(model, values, outputs, inputs=None, *, within=1e-5, interpolation="linear"):
    """Compare derivatives by every value with central differences."""
    assert model.differentiates(values)
    plain = Task(TIME, inputs or {}, outputs, {}, interpolation, 1e-10)
    along = (*({name: 1.0} for name in values), dict.fromkeys(values, 0.5))
    task = Task(TIME, inputs or {}, outputs, {}, interpolation, 1e-10, along)
    run = model.simulate(task, values).reshape(1 + len(along), len(outputs), len(TIME))
    np.testing.assert_allclose(run[0], model.simulate(plain, values), rtol=1e-7, atol=1e-9)
    differences = []
    for name, value in values.items():
        step = 1e-4 * (abs(value) or 1.0)
        up, down = (model.simulate(plain, values | {name: value + s * step}) for s in (1, -1))
        differences.append((up - down) / (2 * step))
    errors = np.abs(run[1:-1] - differences).max(axis=2)
    np.testing.assert_array_less(errors, within * np.abs(differences).max(axis=2) + 1e-9)
    np.testing.assert_allclose(run[-1], 0.5 * run[1:-1].sum(axis=0), rtol=1e-9, atol=1e-9)
    return run[1:-1]


@pytest.mark.parametrize(("algorithm", "extrapolation"), MASTERS)
def test_the_split_actuator(drive, algorithm, extrapolation):
    model = split(drive, step=5e-4, algorithm=algorithm, extrapolation=extrapolation)
    speed = {"controller.w_ref": 30 * np.sin(2 * np.pi * TIME)}
    values = {"controller.kp": 0.02, "controller.ki": 0.4, "plant.J_R": 4e-5, "plant.mgr": 8.0}
    values |= {"controller.integral_start": 0.1}
    outputs = ("plant.w_motor", "plant.phi_load", "plant.i", "controller.i")
    check(model, values, outputs, speed)


@pytest.mark.parametrize("order", [("source", "gain", "steady"), ("steady", "gain", "source")])
def test_initial_states_follow_connected_inputs(made, order):
    files = {"source": made("Gain"), "gain": made("Gain"), "steady": made("Steady")}
    wires = {"steady.u": ("gain.y", 2.0, 0.1), "gain.u": "source.y"}
    model = coupled({name: files[name] for name in order}, wires, step=2e-2)
    values = {"source.b": 0.7, "gain.k": 1.5, "steady.T": 0.2}
    slopes = check(model, values, ("steady.y", "gain.y"))
    at_rest = np.roots([1, 0, 1, -(2 * 1.5 * 0.7 + 0.1)]).real.max()
    np.testing.assert_allclose(slopes[0, 0], 2 * 1.5 / (1 + 3 * at_rest**2), rtol=1e-6)


@pytest.mark.parametrize(("algorithm", "extrapolation"), MASTERS)
def test_events_move_with_a_connected_input(made, algorithm, extrapolation):
    components = {"wave": made("Wave"), "threshold": made("Threshold")}
    model = coupled(
        components, {"threshold.u": "wave.y"}, step=5e-3, algorithm=algorithm, extrapolation=extrapolation
    )
    values = {"wave.a": 0.9, "wave.w": 7.0, "threshold.level": 0.3141}
    slopes = check(model, values, ("threshold.y",), within=1e-4)
    held = extrapolation == "constant"  # then an event is at a communication point, which does not move
    assert (np.abs(slopes[:, 0, -1]) > 0.1).all() != held


def test_feedback_without_delay_in_the_loop_by_communication(made):
    model = coupled(
        {"lag": made("Lag"), "gain": made("Gain")},
        {"gain.u": "lag.y", "lag.u": ("gain.y", -1.0, 0.3)},
        step=1e-2,
        loops="delay",
    )
    values = {"lag.T": 0.3, "lag.d": 0.2, "gain.k": 0.8, "lag.x_start": 0.5}
    check(model, values, ("lag.y", "gain.y"), within=1e-4)  # starts are solved to the loops' tolerance


@pytest.mark.parametrize("extrapolation", ["constant", "linear"])
def test_iterated_loops_of_a_large_gain(made, extrapolation):
    model = coupled(
        {"lag": made("Lag"), "gain": made("Gain"), "follower": made("Lag")},
        {"gain.u": "lag.y", "lag.u": ("gain.y", -1.0, 0.3), "follower.u": "gain.y"},
        step=1e-2,
        extrapolation=extrapolation,
        loops="iterate",
        loop_tolerance=1e-10,
    )
    values = {"lag.T": 0.3, "lag.d": 0.9, "gain.k": 3.5, "lag.x_start": 0.5, "follower.T": 0.05}
    slopes = check(model, values, ("lag.y", "gain.y", "follower.x"))
    x, d, k, b = 0.5, 0.9, 3.5, 0.3  # at the start: y = x + d*(b - k*y)
    np.testing.assert_allclose(
        slopes[1:3, 0, 0], [(b - k * x) / (1 + d * k) ** 2, -d * (x + d * b) / (1 + d * k) ** 2]
    )


def test_what_cannot_be_differentiated_is_not(made, python_pi, tmp_path, monkeypatch):
    counted = coupled({"first": made("Counter"), "second": made("Counter")}, {"second.n": "first.twice"}, step=0.1)
    assert not counted.differentiates({"first.u"})
    with monkeypatch.context() as patch:
        patch.setenv("FMU_BUILD_CFLAGS", "-DfmuidSetInputDirections=unknown")
        old = fmu_build.build(
            Path(__file__).parent / "models" / "Gain.mo", "Gain", tmp_path
        )  # as of a version without this function
    earlier = coupled({"lag": made("Lag"), "gain": old}, {"gain.u": "lag.x"}, step=1e-2)
    assert not earlier.differentiates({"lag.T"})
    foreign = coupled({"lag": made("Lag"), "pi": python_pi}, {"pi.w": "lag.x"}, step=1e-2)
    assert not foreign.differentiates({"lag.T"})  # it reaches an FMU without derivatives
    upstream = coupled({"pi": python_pi, "lag": made("Lag")}, {"lag.u": "pi.i"}, step=1e-2)
    assert upstream.differentiates({"lag.T"})
    check(upstream, {"lag.T": 0.2, "lag.d": 0.1}, ("lag.y",), {"pi.w": np.sin(9 * TIME)}, interpolation="hold")
