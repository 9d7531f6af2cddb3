"""Laws at the ports of the actuator: off, they change nothing; on, each acts where it is put."""

from __future__ import annotations

from dataclasses import replace

import fmpy
import numpy as np
import pytest

from fmuid.simulation.simulator import Task
from tests.reference import experiments as e
from tests.reference.plain_fmpy import simulate_fmu

TASKS = {
    "FixedShaft": e.fixed_shaft("prbs"),
    "FreeShaft": e.free_shaft(),
    "EccentricLoad": e.eccentric_load(),
}


@pytest.mark.parametrize("name", TASKS)
def test_laws_that_are_off_leave_the_plain_model_bit_for_bit(fmus, effect_fmus, name):
    plain, with_laws = (simulate_fmu(f[name], TASKS[name], e.LOSSY, tolerance=1e-7) for f in (fmus, effect_fmus))
    assert np.array_equal(with_laws, plain)


@pytest.mark.parametrize("name", TASKS)
def test_every_course_that_may_be_added_shows_in_some_signal(effect_fmus, name):
    task = TASKS[name]
    description = fmpy.read_model_description(str(effect_fmus[name]))
    added = [v.name for v in description.modelVariables if v.causality == "input" and v.name not in task.inputs]
    assert {"rotor.added_flow", "motor.added_flow", "flexspline.added_flow"} <= set(added)
    assert ("controller.w.added_signal" in added) == (name != "FixedShaft")
    neutral = simulate_fmu(effect_fmus[name], task, e.CONSTANT_FRICTION)
    for input in added:
        course = {**task.inputs, input: np.full(len(task.time), 0.1)}
        outputs = simulate_fmu(effect_fmus[name], replace(task, inputs=course), e.CONSTANT_FRICTION)
        assert ((outputs - neutral).std(axis=1) / neutral.std(axis=1)).max() > 1e-6, input


def steady_current(fmu, speed: float, parameters: dict[str, float], stop: float = 2.0) -> float:
    time = np.linspace(0, stop, 401)
    task = Task(time, {"w_ref": np.full(401, speed)}, ("i_motor",))
    return float(simulate_fmu(fmu, task, parameters)[0, -100:].mean())


STRIBECK = {"stribeck": 0.05, "stribeck_speed": 50.0, "stribeck_exponent": 1.0, "stribeck_width": 0.1}


@pytest.mark.parametrize("port", ["motor", "rotor"])  # the console holds the stator
@pytest.mark.parametrize(
    ("parameters", "friction"),
    [
        ({}, 0.09),
        ({"viscous": 5e-4}, 0.09 + 5e-4 * 40),
        ({**STRIBECK, "stribeck_tail": 1e6}, 0.09 + 0.05 * np.exp(-0.8)),
        ({**STRIBECK, "stribeck_exponent": 2.0, "stribeck_tail": 1.0}, 0.09 + 0.05 / 1.64),
        ({"asymmetry": 0.02}, 0.11),
        ({"cogging_sine": 0.01, "cogging_order": 2.0}, 0.09),
    ],
)
def test_current_at_constant_speed(effect_fmus, port, parameters, friction):
    at_port = {f"{port}.{name}": value for name, value in parameters.items()}
    current = steady_current(effect_fmus["FreeShaft"], 40.0, at_port)

    assert 0.7 * current == pytest.approx(friction, rel=0.01)


def test_asymmetry_is_less_friction_backward(effect_fmus):
    current = steady_current(effect_fmus["FreeShaft"], -40.0, {"motor.asymmetry": 0.02})

    assert 0.7 * current == pytest.approx(-0.07, rel=5e-3)


def test_imbalance_is_a_weight_on_the_load(effect_fmus):
    time = np.linspace(0, 16, 1601)
    task = Task(time, {"w_ref": np.full(1601, 20.0)}, ("tau_sensor", "load.phi"))
    parameters = {"load.imbalance_sine": 1.5, "load.imbalance_cosine": 0.5}
    torque, phi = simulate_fmu(effect_fmus["FreeShaft"], task, parameters)

    late = time > 2
    assert torque[late] == pytest.approx(1.5 * np.sin(phi[late]) + 0.5 * np.cos(phi[late]), abs=0.05)


def test_a_course_at_the_load_brakes_it(effect_fmus):
    time = np.linspace(0, 2, 401)
    brake = np.where(time > 1, 3.0, 0.0)
    task = Task(time, {"w_ref": np.full(401, 20.0), "load.added_flow": brake}, ("tau_sensor",))
    (torque,) = simulate_fmu(effect_fmus["FreeShaft"], task, {})

    assert torque[-1] == pytest.approx(3.0, abs=0.05)
