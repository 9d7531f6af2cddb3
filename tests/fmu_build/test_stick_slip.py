"""Friction by events against the event-free friction of the same law, Table 1 of the paper and set-valued friction."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task
from tests.conftest import MODELICA, build_once, build_setups
from tests.fmu_build.test_events import set_valued_gear
from tests.reference.experiments import LOSSY, eccentric_load
from tests.reference.test_friction import table_1
from tests.reference.test_physics import lossy_row

MODELS = Path(__file__).parent / "models" / "StickSlip.mo"
BOTH = ("", "WithEvents")
PRESLIDING = 2e-5


def fmu(name: str) -> Fmu:
    if name.startswith("StickSlip."):
        return Fmu(build_once(MODELS, name, roots=[MODELICA]))
    return Fmu(build_setups((name,))[name])


def uniform(values: Mapping[int, float]) -> dict[str, float]:
    """Loss table with the same entries in every row."""
    return {f"lossTable[{row},{column}]": value for row in range(1, 8) for column, value in values.items()}


@pytest.mark.slow
@pytest.mark.parametrize("direction", [1, -1])
def test_sliding_agrees_to_solver_tolerance(direction):
    """Started in full sliding: rotor at speed, bristle at its full deflection; the load turns once, so T changes sign."""
    time = np.linspace(0, 15, 1501)
    inputs = {"w_ref": np.full(time.size, direction * 25.0)}
    outputs = ("w_motor", "tau_sensor", "i_motor", "phi_load", "gear.tau_load", "gear.dtau")
    start = {"mgr": 35.5, "w_motor_start": direction * 25.0}
    free = fmu("EccentricLoad").simulate(
        Task(time, inputs, outputs, {**start, "gear.bristle.z": direction}), LOSSY
    )
    by_events = fmu("EccentricLoadWithEvents").simulate(Task(time, inputs, outputs, start), LOSSY)

    assert free[4].min() < -0.5
    assert free[4].max() > 0.5
    scale = np.ptp(free, axis=1)
    assert np.max(np.abs(by_events - free).max(axis=1) / scale) < 5e-6  # tolerance of the setups: 1e-6


def test_reversal_under_load_passes_all_quadrants_of_table_1():
    base = eccentric_load()
    outputs = ("w_motor", "gear.tau_load", "gear.dtau", "gear.lossPower", "phi_load", "gear.modes.mode")
    task = Task(base.time, base.inputs, outputs, base.start_values)
    w, load, loss, power, phi, mode = fmu("EccentricLoadWithEvents").simulate(task, LOSSY)

    sliding = mode != 0
    expected = [table_1(t + d, v, *lossy_row(abs(v))) for v, t, d in zip(w, load, loss, strict=True)]
    clear = sliding & (np.abs(load + loss) > 0.01)  # Table 1 jumps where the driving side changes
    np.testing.assert_allclose(loss[clear], np.array(expected)[clear], atol=1e-9)
    np.testing.assert_array_equal(np.sign(w[sliding]), mode[sliding])
    quadrants = {(s, q) for s, q in zip(mode[clear], np.sign(load + loss)[clear], strict=True)}
    assert quadrants == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    assert power.min() >= -1e-12
    (event_free,) = fmu("EccentricLoad").simulate(
        Task(base.time, base.inputs, ("phi_load",), base.start_values), LOSSY
    )
    assert np.abs(phi - event_free).max() < PRESLIDING


@pytest.mark.parametrize("kind", BOTH)
def test_break_away_and_sliding_by_direction_and_sign_of_the_load(kind):
    """A slow triangle of current with the output locked: the load torque T follows Table 1, and holds between."""
    eta1, eta2, bearing = 0.9, 0.85, 0.1
    time = np.linspace(0, 8, 8001)
    motor = 0.7 * np.interp(time, [0, 2, 6, 8], [0, 1, -1, 0])
    task = Task(time, {"i_cmd": motor / 0.7}, ("gear.tau_load", "gear.phi_rel"))
    losses = uniform({2: eta1, 3: eta2, 4: bearing, 5: bearing})
    load, _ = fmu(f"FixedShaft{kind}").simulate(task, losses)

    held, expected = 0.0, []
    for tau in motor:
        # T from Table 1 with tau_W = T + Dtau: where the motor drives, and where the load does
        forward = (eta1 * tau if tau >= 0 else tau / eta2) - bearing
        backward = (tau / eta2 if tau >= 0 else eta1 * tau) + bearing
        held = min(max(held, forward), backward)
        expected.append(held)
    assert np.abs(load - expected).max() < 3e-3
    moving = np.abs(np.gradient(np.array(expected), time)) > 0.01
    assert np.count_nonzero(~moving) > 1500  # stuck about the reversals


@pytest.mark.parametrize("kind", BOTH)
def test_held_at_90_percent_of_break_away_does_not_creep(kind):
    time = np.linspace(0, 60, 601)
    task = Task(time, {"i_cmd": np.full(time.size, 0.9 * 0.09 / 0.7)}, ("gear.phi_rel",))
    (deflection,) = fmu(f"FixedShaft{kind}").simulate(task, uniform({4: 0.09, 5: 0.09}))

    assert np.abs(deflection).max() <= PRESLIDING
    assert abs(deflection[-1] - deflection[10]) < 1e-6 * PRESLIDING


def test_a_brake_holds_lets_go_and_stops():
    tau_c, b, inertia = 2.0, 0.5, 0.1
    time = np.linspace(0, 3, 3001)
    drive = np.select([time < 0.5, time < 1.0, time < 2], [1.999, -1.999, 2.4])
    phi, w = fmu("StickSlip.Brake").simulate(Task(time, {"drive": drive}, ("phi", "w")), {})

    assert np.abs(phi[time < 1]).max() == 0.0
    run = (time >= 1) & (time <= 2)
    rate, final = b / inertia, 0.4 / b
    np.testing.assert_allclose(w[run], -final * np.expm1(-rate * (time[run] - 1)), atol=1e-6)
    stop = 2 + np.log1p(w[time <= 2][-1] * b / tau_c) / rate
    assert np.abs(w[time > stop]).max() < 1e-9
    assert w[time < stop][-1] > 0.0


def test_break_away_above_sliding_friction():
    time = np.linspace(0, 4, 4001)
    outputs = ("w", "friction.modes.mode", "friction.tau")
    task = Task(time, {"drive": time}, outputs, interpolation="linear")
    w, mode, friction = fmu("StickSlip.Brake").simulate(task, {"friction.peak": 1.5})
    slides = time > 3.0
    np.testing.assert_array_equal(mode, slides)
    np.testing.assert_allclose(friction, np.where(slides, 2 + 0.5 * w, time), atol=1e-9)
    # 0.1 w' = t - 2 - 0.5 w from t = 3 on
    s = time[slides] - 3
    np.testing.assert_allclose(w[slides], 2 * s + 1.6 * -np.expm1(-5 * s), rtol=1e-4)


def test_a_lossy_gear_between_rigid_inertias():
    time = np.arange(0.0, 6.0, 5e-4)
    inputs = {"u": 0.6 * np.sin(2.0 * time), "load": 2.4 * np.sin(1.3 * time + 1.0)}
    task = Task(time, inputs, ("w_a", "lossEnergy", "gear.modes.mode"))
    w, energy, mode = fmu("StickSlip.Geared").simulate(task, {})
    expected_w, expected_energy = set_valued_gear(time, inputs["u"], inputs["load"])
    assert set(mode) == {-1.0, 0.0, 1.0}
    assert np.max(np.abs(w - expected_w)) < 1e-3 * np.ptp(expected_w)
    assert np.max(np.abs(energy - expected_energy)) < 1e-3 * expected_energy[-1]
