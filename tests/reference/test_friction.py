"""The friction laws: Table 1 in sliding, stuck without creeping, close to a set-valued Coulomb law."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from fmuid.reference.friction_law import loss_table, sliding_torque
from fmuid.simulation.simulator import Task
from tests.reference.experiments import CONSTANT_FRICTION, fixed_shaft

FRICTION = 0.09


def table_1(tau_w: float, w: float, eta1: float, eta2: float, bearing1: float, bearing2: float) -> float:
    """Table 1 of the paper as it is printed."""
    if w > 0:
        return (1 - eta1) * tau_w + bearing1 if tau_w >= 0 else (1 - 1 / eta2) * tau_w + bearing2
    return (1 - 1 / eta2) * tau_w - bearing2 if tau_w >= 0 else (1 - eta1) * tau_w - bearing1


@pytest.mark.parametrize("load_torque", np.linspace(-0.8, 0.8, 16))
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("row", [(0.923, 0.864, 0.058, 0.058), (0.854, 0.847, 0.0565, 0.049), (1, 1, 0.09, 0.09)])
def test_sliding_torque_solves_table_1(load_torque, direction, row):
    loss = direction * sliding_torque(direction * load_torque, row, 1e-3)

    assert loss == pytest.approx(table_1(load_torque + loss, direction, *row), abs=1e-15)


def test_sliding_torque_is_continuous():
    load = np.linspace(-0.2, 0.2, 400_001)
    loss = np.array([sliding_torque(t, (0.854, 0.847, 0.0565, 0.049), 1e-3) for t in load])

    assert np.abs(np.diff(loss)).max() < 1e-5
    assert loss.min() > 0.0


def test_loss_table_between_and_outside_rows():
    losses = loss_table([(10, 1.0, 0.9, 0.1, 0.2), (20, 0.8, 0.7, 0.3, 0.2)])

    assert losses(0.0) == losses(10.0) == (1.0, 0.9, 0.1, 0.2)
    assert losses(12.5) == pytest.approx((0.95, 0.85, 0.15, 0.2))
    assert losses(99.0) == losses(20.0) == (0.8, 0.7, 0.3, 0.2)


def test_held_at_90_percent_of_break_away_does_not_creep(model):
    fmu = model("FixedShaft")
    task = Task(
        np.linspace(0, 60, 601), {"i_cmd": np.full(601, 0.9 * FRICTION / 0.7)}, ("rotor.phi", "housing.phi")
    )

    rotor, housing = fmu.simulate(task, CONSTANT_FRICTION)

    deflection = rotor - housing
    presliding = fmu.variables["phi_s"].start
    assert np.abs(deflection).max() <= presliding
    assert abs(deflection[-1] - deflection[10]) < 1e-6 * presliding


def test_stuck_under_vibration_does_not_ratchet(model):
    fmu = model("FixedShaft")
    time = np.linspace(0, 2, 2001)
    current = (0.6 + 0.25 * np.sin(2 * np.pi * 30 * time)) * FRICTION / 0.7
    (rotor,) = fmu.simulate(Task(time, {"i_cmd": current}, ("rotor.phi",)), CONSTANT_FRICTION)

    assert np.abs(rotor).max() <= fmu.variables["phi_s"].start


@cache
def set_valued_coulomb(step: float) -> np.ndarray:
    """Sensor torque by time stepping: the friction torque is whatever stops the sliding, up to its limit."""
    current, hold = fixed_shaft("prbs").inputs["i_cmd"], 1e-3
    n, k_m, j_r, j_s, c_s, d_s, c_g, d_g = 50, 0.7, 2e-4, 0.003, 130000.0, 0.6, 25500.0, 50.0
    phi_c = w_c = phi_w = w_w = 0.0
    record = [0.0]
    for i in current[:-1]:
        for _ in range(round(hold / step)):
            load = (c_g * (phi_w + (n - 1) * phi_c) + d_g * (w_w + (n - 1) * w_c)) / n**2
            w_c_free = w_c + step * (-k_m * i - (n - 1) * load - c_s * phi_c - d_s * w_c) / j_s
            w_w_free = w_w + step * (k_m * i - load) / j_r
            impulse = (w_w_free - w_c_free) / (1 / j_r + 1 / j_s)
            impulse = max(-FRICTION * step, min(FRICTION * step, impulse))
            w_c, w_w = w_c_free + impulse / j_s, w_w_free - impulse / j_r
            phi_c, phi_w = phi_c + step * w_c, phi_w + step * w_w
        record.append(-c_s * phi_c - d_s * w_c)
    return np.array(record)


def test_close_to_a_set_valued_coulomb_law(model):
    task = fixed_shaft("prbs")
    coarse, fine = set_valued_coulomb(4e-6), set_valued_coulomb(2e-6)
    tau_sensor, _ = model("FixedShaft").simulate(task, CONSTANT_FRICTION)

    difference = tau_sensor - (2 * fine - coarse)
    assert np.sqrt(np.mean(difference**2)) < 0.05
