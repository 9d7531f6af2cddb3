"""Reference and FMU against the paper's figures and against physics: balance of energy, quadrants, reversal."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import simpson

from fmuid.simulation.simulator import Task
from tests.reference.experiments import CONSTANT_FRICTION, LOSSY, eccentric_load, fixed_shaft
from tests.reference.test_friction import table_1


def test_step_with_locked_shaft_as_in_figure_6(model):
    identified = {"d_S": 2.66, "J_S": 0.003039, "d_G": 70.625}
    tau_sensor, w_motor = model("FixedShaft").simulate(fixed_shaft("step"), identified)

    assert tau_sensor[-1] == pytest.approx(50 * 0.7 * 0.5, rel=1e-3)
    assert tau_sensor.max() == pytest.approx(25, abs=2)
    assert abs(w_motor[-1]) < 0.05


def lossy_row(speed: float) -> list[float]:
    speeds = [0, 10, 15, 20, 30, 100, 300]
    return [np.interp(speed, speeds, [LOSSY[f"lossTable[{k},{j}]"] for k in range(1, 8)]) for j in range(2, 6)]


def test_reversal_under_load_passes_all_quadrants_of_table_1(model):
    base = eccentric_load()
    outputs = ("w_motor", "gear.tau_load", "gear.dtau", "gear.lossPower", "gear.bristle.z")
    task = Task(base.time, base.inputs, outputs, base.start_values)
    w, load, loss, power, z = model("EccentricLoad").simulate(task, LOSSY)

    sliding = (np.abs(w) > 1) & (np.abs(load + loss) > 0.01)
    expected = [table_1(t + d, v, *lossy_row(abs(v))) for v, t, d in zip(w, load, loss, strict=True)]
    assert loss[sliding] == pytest.approx(np.array(expected)[sliding], abs=1e-7)
    quadrants = {(s, q) for s, q in zip(np.sign(w[sliding]), np.sign(load + loss)[sliding], strict=True)}
    assert quadrants == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    assert power.min() >= 0.0
    assert np.abs(z).max() <= 1 + 1e-6


@pytest.mark.parametrize("friction", [{}, CONSTANT_FRICTION, LOSSY], ids=["none", "constant", "lossy"])
def test_energy_supplied_is_stored_or_lost(model, friction):
    time = np.arange(40_001) * 5e-6
    names = ("motor.tau", "w_motor", "tau_sensor", "gear.tau_load", "gear.lossPower")
    states = ("housing.phi", "housing.w", "rotor.phi", "rotor.w")
    task = Task(time, {"i_cmd": np.full(time.size, 1.0)}, names + states)
    motor, w, sensor, load, lost, phi_c, w_c, phi_w, w_w = model("FixedShaft").simulate(task, friction)

    n, j_r, j_s, c_s, d_s, c_g, d_g = 50, 2e-4, 0.003, 130000.0, 0.6, 25500.0, 50.0
    wind, unwinding = (phi_w + (n - 1) * phi_c) / n, (w_w + (n - 1) * w_c) / n
    assert n * load == pytest.approx(c_g * wind + d_g * unwinding, abs=1e-9)
    assert sensor == pytest.approx(-c_s * phi_c - d_s * w_c, abs=1e-9)
    stored = 0.5 * (j_r * w_w**2 + j_s * w_c**2 + c_s * phi_c**2 + c_g * wind**2)
    supplied = simpson(motor * w, x=time)
    dissipated = simpson(d_s * w_c**2 + d_g * unwinding**2 + lost, x=time)
    # What the bristle can hold, 2e-5 rad times 0.1 N.m, is all that is left out.
    assert supplied == pytest.approx(stored[-1] + dissipated, rel=1e-6, abs=2e-6)
    assert lost.min() >= 0.0


def test_free_shaft_current_is_bearing_friction(model):
    time = np.linspace(0, 2, 201)
    task = Task(time, {"w_ref": np.full(201, -30.0)}, ("i_motor", "w_motor"))
    current, w = model("FreeShaft").simulate(task, {})

    assert w[-1] == pytest.approx(-30, rel=1e-3)
    assert current[-1] == pytest.approx(-0.09 / 0.7, rel=1e-3)


def test_speed_controller_limits_current_and_holds_its_integral(model):
    time = np.linspace(0, 0.2, 2001)
    task = Task(time, {"w_ref": np.full(2001, 290.0)}, ("i_motor", "w_motor", "controller.integral"))
    current, w, integral = model("FreeShaft").simulate(task, {"i_max": 2.0})

    limited = current >= 2.0
    assert limited[0]
    assert current.max() == 2.0
    assert integral[limited].max() < 1e-3 * integral.max()
    assert w.max() < 290 * 1.2


def test_linear_axis_sticks_then_moves(model):
    time = np.linspace(0, 2, 2001)
    voltage = np.where(time < 1, 0.9, 1.5) * 20.39 / 35.15
    parameters = {"M": 95.109, "Fv": 203.5, "Fc": 20.39, "gtau": 35.15}
    qm, v = model("LinearAxisOpenLoop").simulate(Task(time, {"vir": voltage}, ("qm", "v")), parameters)

    assert np.abs(qm[time < 1]).max() <= 1e-7
    moving = time[time > 1] - 1
    steady = 0.5 * 20.39 / 203.5
    assert v[time > 1] == pytest.approx(steady * -np.expm1(-moving * 203.5 / 95.109), abs=2e-4 * steady)


def test_linear_axis_follows_its_reference(model):
    time = np.linspace(0, 2, 2001)
    qg = 0.1 * (1 - np.cos(np.pi * time))
    task = Task(time, {"qg": qg}, ("qm", "vir", "force"), interpolation="linear")
    qm, vir, force = model("LinearAxisClosedLoop").simulate(task, {})

    velocity = 0.1 * np.pi * np.sin(np.pi * time)
    assert np.abs(qm + velocity / 160.18 - qg)[100:].max() < 5e-4
    assert force == pytest.approx(35.15065188248547 * vir)
