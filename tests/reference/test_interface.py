"""The reference behaves as a loaded FMU does."""

from __future__ import annotations

import numpy as np
import pytest

from fmuid.core.errors import FmuError, SimulationError
from fmuid.reference import MODELS, reference_fmu
from fmuid.simulation.simulator import Simulator, Task
from tests.reference.experiments import LOSSY, axis_closed_loop, fixed_shaft


@pytest.mark.parametrize("name", MODELS)
def test_is_a_simulator(name):
    fmu = reference_fmu(name)

    assert isinstance(fmu, Simulator)
    assert {v.causality for v in fmu.variables.values()} == {"parameter", "input", "output", "local"}
    fmu.step(1e-3)
    assert all(np.isfinite(fmu.get(name)) for name in fmu.variables)


def test_stepping_by_hand_equals_simulate_and_reset_repeats_it():
    fmu = reference_fmu("FixedShaft")
    task = fixed_shaft("prbs")
    expected = fmu.simulate(task, LOSSY)
    runs = []
    for _ in range(2):
        fmu.reset()
        for name, value in LOSSY.items():
            fmu.set(name, value)
        torque = []
        for k, current in enumerate(task.inputs["i_cmd"][:-1]):
            fmu.set("i_cmd", current)
            torque.append(fmu.get("tau_sensor"))
            fmu.step(task.time[k + 1] - task.time[k])
        runs.append(torque)

    assert runs[0] == runs[1]
    assert np.array(runs[0]) == pytest.approx(expected[0, :-1], abs=1e-5)


def test_methods_agree():
    whole = fixed_shaft("sine")
    task = Task(whole.time[:60], {"i_cmd": whole.inputs["i_cmd"][:60]}, whole.outputs)
    runs = [reference_fmu("FixedShaft", method=method).simulate(task, LOSSY) for method in ("LSODA", "Radau")]

    for lsoda, radau in zip(*runs, strict=True):
        assert np.sqrt(np.mean((lsoda - radau) ** 2)) < 1e-6 * np.ptp(radau)


def test_linear_interpolation_differs_from_hold():
    task = axis_closed_loop()
    held = Task(task.time, task.inputs, task.outputs)
    fmu = reference_fmu("LinearAxisClosedLoop")

    # Held samples lag half an interval behind.
    lag = np.mean((fmu.simulate(task, {})[0] - fmu.simulate(held, {})[0]) * np.gradient(task.inputs["qg"]))
    assert lag / np.mean(np.gradient(task.inputs["qg"]) ** 2) == pytest.approx(0.5, rel=0.05)


def test_start_values():
    fmu = reference_fmu("EccentricLoad")
    fmu.set("phi_load_start", 0.3)
    fmu.set("w_motor_start", 10.0)

    assert fmu.get("phi_load") == 0.3
    assert fmu.get("w_motor") == 10.0
    assert fmu.get("gear.tau_load") == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(FmuError, match="after initialisation"):
        fmu.set("mgr", 13.5)
    fmu.reset()
    assert fmu.get("phi_load") == 0.0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("d_X", 1.0, "no variable 'd_X'"), ("tau_sensor", 1.0, "causality output"), ("d_S", np.nan, "finite")],
)
def test_refused_values(name, value, message):
    with pytest.raises(FmuError, match=message):
        reference_fmu("FixedShaft").set(name, value)


def test_failed_integration_is_an_error_not_a_prediction():
    with pytest.raises((SimulationError, FmuError)):
        reference_fmu("FixedShaft").simulate(fixed_shaft("step"), {"J_R": -2e-4, "d_G": -1e9})


def test_unknown_reference():
    with pytest.raises(FmuError, match="FixedShaft"):
        reference_fmu("Unknown")
