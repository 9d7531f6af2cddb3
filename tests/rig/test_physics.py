"""The base rig against what is known without simulating: statics, Table 1, energy, Coulomb's law of stiction."""

import numpy as np
import pytest

from benchmarks.virtual_rig import Channel, Rig
from tests.rig.rigs import constant, held, lossless, paper, ramped

K_M, N = 0.7, 50


def test_positive_current_gives_positive_torque_n_km_i_at_rest() -> None:
    run = lossless().run("fixed_shaft", held(0.5, 2000), 1e-3)
    assert run[Channel.TAU_SENSOR][-1] == pytest.approx(N * K_M * 0.5, abs=1e-6)
    assert run[Channel.TAU_SENSOR].max() == pytest.approx(25.0, abs=2.0)  # Fig. 6 of the paper


@pytest.mark.parametrize("direction", [1, -1])
def test_steady_friction_is_table_1_in_all_four_quadrants(direction: int) -> None:
    interval, speed = 0.01, 10.0
    eta1, eta2, tau1, tau2 = 0.9, 0.8, 0.08, 0.05
    rig = Rig(np.array([[0.0, eta1, eta2, tau1, tau2]]), {"J_L": 0.5, "mgr": 35.5})
    run = rig.run("eccentric_load", ramped(direction * speed, 3200, interval), interval)
    steady = run.time > 2
    friction = run[Channel.FRICTION][steady]
    tau_w = run[Channel.LOAD_TORQUE][steady] + friction
    driving = tau_w * direction >= 0
    table_1 = np.where(
        driving,
        (1 - eta1) * tau_w + direction * tau1,
        (1 - 1 / eta2) * tau_w + direction * tau2,
    )
    assert 0.2 < driving.mean() < 0.8
    np.testing.assert_allclose(friction, table_1, atol=1e-12)


def test_current_carries_load_and_friction_and_the_sensor_only_the_load() -> None:
    interval = 0.01
    run = paper().changed(J_L=0.5, mgr=25.0).run("eccentric_load", ramped(10, 3000, interval), interval)
    steady = run.time > 2
    motor = run[Channel.LOAD_TORQUE] + run[Channel.FRICTION]
    np.testing.assert_allclose(K_M * run[Channel.I_MOTOR][steady], motor[steady], atol=2e-3)
    np.testing.assert_allclose(
        run[Channel.TAU_SENSOR][steady], 25.0 * np.sin(run[Channel.PHI_LOAD][steady]), atol=0.2
    )


def test_the_loss_table_is_linear_between_its_rows_and_constant_outside() -> None:
    rig = Rig(np.array([[10, 1, 1, 0.1, 0.1], [20, 1, 1, 0.06, 0.06]]))
    for speed, friction in ((5, 0.1), (10, 0.1), (15, 0.08), (20, 0.06), (40, 0.06)):
        run = rig.run("free_shaft", ramped(speed, 400, 5e-3), 5e-3)
        assert run[Channel.FRICTION][-1] == pytest.approx(friction, abs=1e-5)


def test_a_current_that_friction_can_hold_moves_nothing() -> None:
    run = constant(0.09).run("fixed_shaft", held(0.128, 500), 1e-3)
    assert np.all(run[Channel.THETA] == 0)
    assert np.all(run[Channel.TAU_SENSOR] == 0)
    assert constant(0.09).run("fixed_shaft", held(0.13, 500), 1e-3)[Channel.THETA][-1] > 1e-5


def test_the_wound_up_gear_holds_until_friction_no_longer_holds_it() -> None:
    # 0.5 A winds it up. It stays until K_m i is below the held torque by the bearing friction.
    time = np.arange(3000) * 1e-3
    current = np.interp(time, [0.0, 0.3, 0.6, 3.0], [0.0, 0.5, 0.5, 0.0])
    run = constant(0.09).run("fixed_shaft", current, 1e-3)
    torque, theta = run[Channel.LOAD_TORQUE], run[Channel.THETA]
    at = int(np.flatnonzero(time >= 0.6)[0])
    moved = at + int(np.flatnonzero(theta[at:] < theta[at] - 1e-7)[0])
    assert np.ptp(theta[at : moved - 1]) == 0.0
    assert K_M * current[moved] == pytest.approx(torque[at] - 0.09, abs=5e-3)
    assert torque[at] == pytest.approx(K_M * 0.5 - 0.09, abs=0.03)


def test_energy_is_accounted_for() -> None:
    prbs = np.repeat([0.8, -0.8, 0.8, 0.8, -0.8], 30)
    run = paper().run("fixed_shaft", np.concatenate([prbs, np.zeros(2000)]), 1e-3)
    torque = run[Channel.TAU_SENSOR][-1]
    assert run[Channel.W_MOTOR][-1] == pytest.approx(0.0, abs=1e-12)
    stored = 0.5 * torque**2 * (1 / 130000 + 1 / 25500)
    lost = run.works["friction"] + run.works["dampers"]
    assert run.works["motor"] == pytest.approx(lost + stored, rel=1e-6)

    run = paper().changed(J_L=0.5, mgr=35.5).run("eccentric_load", ramped(10, 1000, 0.01), 0.01)
    w, w_load = run[Channel.W_MOTOR][-1], run[Channel.W_LOAD][-1]
    torque = run[Channel.TAU_SENSOR][-1]
    kinetic = 0.5 * 2e-4 * w**2 + 0.5 * 0.5 * w_load**2
    stored = kinetic + 0.5 * torque**2 * (1 / 130000 + 1 / 25500)
    lost = run.works["friction"] + run.works["dampers"]
    assert run.works["motor"] + run.works["load"] == pytest.approx(lost + stored, rel=1e-5)
    assert run.works["load"] == pytest.approx(35.5 * (np.cos(run[Channel.PHI_LOAD][-1]) - 1), rel=1e-5)


def test_the_controller_is_limited_and_its_integral_waits() -> None:
    run = constant().run("free_shaft", held(800.0, 400), 5e-3)
    assert run[Channel.I_MOTOR].max() == 6.0
    assert run[Channel.W_MOTOR].max() < 850  # a running integral would go beyond 1500
    assert run[Channel.W_MOTOR][-1] == pytest.approx(800, rel=1e-4)


@pytest.mark.parametrize(
    ("setup", "settings", "inputs", "interval"),
    [
        ("fixed_shaft", {}, 0.8 * np.repeat([1.0, -1, 1, 1, -1, -1, -1, 1, 1, -1], 25), 1e-3),
        ("free_shaft", {}, 12 * np.interp(np.arange(800) * 5e-3, [0, 1, 3, 4], [0, 1, -1, 0]), 5e-3),
        ("eccentric_load", {"J_L": 0.5, "mgr": 35.5}, ramped(10, 1600, 0.01), 0.01),
    ],
)
def test_halving_the_step_changes_less_than_a_tenth_of_the_noise(setup, settings, inputs, interval) -> None:
    rig = paper().changed(**settings)
    step = interval / max(50, round(interval / (1e-5 if setup == "fixed_shaft" else 2e-5)))
    whole = rig.run(setup, inputs, interval).channels
    half = rig.run(setup, inputs, interval, step=step / 2).channels
    rms = np.sqrt(np.mean((whole - half) ** 2, axis=0))
    assert rms[Channel.TAU_SENSOR] < 0.01
    assert rms[Channel.I_MOTOR] < 4e-4
    assert rms[Channel.PHI_LOAD] < 1e-5
    assert rms[Channel.W_MOTOR] < 0.05 * np.pi / 16384 / interval


def test_the_same_run_twice_gives_the_same_numbers() -> None:
    first, again = (paper().run("fixed_shaft", held(0.7, 300), 1e-3).channels for _ in range(2))
    assert np.array_equal(first, again)
