"""Every effect of the rig: nothing at its neutral value, and its own law when it is on."""

from functools import cache

import numpy as np
import pytest

from benchmarks.virtual_rig import Channel, Rig, Run, parameter_table
from tests.rig.rigs import constant, held, ramped

K_M, N, C_G = 0.7, 50, 25500
PLAIN = {"n", "K_m", "J_R", "J_S", "c_S", "d_S", "c_G", "d_G", "J_L", "mgr", "kp", "ki", "i_max"}
SHAPES = {  # values that matter only while another parameter is on
    "stribeck_speed": {"stribeck": 0.05},
    "hardening_angle": {"hardening": 0.5},
    "hysteresis_angle": {"hysteresis": 1.0},
    "kinematic_phase": {"kinematic_error": 1e-4},
    "cogging_order": {"cogging": 0.01},
    "cogging_phase": {"cogging": 0.01},
    "imbalance_phase": {"imbalance": 1.0},
    "thermal_time": {"thermal_friction": 0.2},
    "friction_patch_angle": {"friction_patch": 0.5},
    "gear_ripple_order": {"gear_ripple": 1e-4},
    "sensor_creep_time": {"sensor_creep": 0.05},
    "relaxation_time": {"relaxation": 0.1},
    "torque_ripple_order": {"torque_ripple": 0.05},
}
EFFECTS = sorted(parameter_table().keys() - PLAIN)
SIZES = {"friction_scale": 1.1, "sensor_gain": 1.05, "imbalance": 1.0, "sensor_offset": 0.3, "crosstalk": 0.5,
         "saturation": 0.8, "load_brush": 1.0, "hysteresis": 1.0, "hardening": 0.5, "torque_ripple": 0.05,
         "rotor_rub": 0.3, "friction_patch": 0.5, "relaxation": 0.1, "sensor_creep": 0.05, "line_hum": 0.02,
         "coulomb_asymmetry": 0.2, "stribeck": 0.05, "thermal_friction": 0.2, "cogging": 0.01,
         "viscous": 3e-4, "windage": 1e-5, "encoder_eccentricity": 0.01, "kinematic_error": 1e-4,
         "gear_ripple": 1e-4, "presliding": 1e-3, "backlash": 3e-4, "current_lag": 2e-3, "sensor_lag": 2e-3,
         "delay": 2e-3, "input_delay": 2e-3}  # fmt: skip


def locked(rig: Rig, current: np.ndarray, interval: float = 1e-3) -> Run:
    return rig.run("fixed_shaft", current, interval)


def turning(rig: Rig, speed: float, n: int = 600) -> Run:
    return rig.run("free_shaft", ramped(speed, n, 5e-3), 5e-3)


def eccentric(rig: Rig) -> Run:
    return rig.changed(J_L=0.5, mgr=25.0).run("eccentric_load", ramped(20, 800, 0.01), 0.01)


def order(values: np.ndarray, angle: np.ndarray, periods: float) -> float:
    """Amplitude of the part of `values` that repeats `periods` times a turn of `angle`."""
    basis = np.column_stack([np.cos(periods * angle), np.sin(periods * angle), np.ones_like(angle)])
    return float(np.hypot(*np.linalg.lstsq(basis, values, rcond=None)[0][:2]))


CURRENT = 0.8 * np.repeat([1.0, -1, 1, 1, -1], 40)
RUNS = {"locked": lambda r: locked(r, CURRENT), "eccentric": eccentric, "turning": lambda r: turning(r, 20)}


@cache
def of_constant(run: str) -> np.ndarray:
    return RUNS[run](constant()).channels


@pytest.mark.parametrize("name", EFFECTS)
def test_neutral_is_absent_and_otherwise_it_shows(name: str) -> None:
    neutral = parameter_table()[name].neutral
    base = constant().changed(**SHAPES.get(name, {}))
    value = neutral * 1.5 + 0.1 * (neutral == 0) if name in SHAPES else SIZES[name]
    if name in SHAPES:  # a shape alone does nothing
        assert np.array_equal(eccentric(constant().changed(**{name: value})).channels, of_constant("eccentric"))
    shown = 0.0
    for kind, run in RUNS.items():
        plain = run(base).channels if name in SHAPES else of_constant(kind)
        changed, again = run(base.changed(**{name: value})), run(base.changed(**{name: neutral}))
        assert np.array_equal(plain, again.channels)
        noise = np.array([0.1, 1e-3, np.inf, 4e-3, 2e-4])
        rms = np.sqrt(np.mean((plain - changed.channels)[:, :5] ** 2, axis=0))
        shown = max(shown, float(np.max(rms / noise)))
    assert shown > 0.3


@pytest.mark.parametrize(
    ("effect", "friction"),
    [
        ({"viscous": 5e-4}, lambda w: 0.09 + 5e-4 * w),
        ({"windage": 1e-5}, lambda w: 0.09 + 1e-5 * w**2),
        ({"stribeck": 0.04, "stribeck_speed": 5.0}, lambda w: 0.09 + 0.04 / (1 + (w / 5) ** 2)),
        ({"coulomb_asymmetry": 0.1}, lambda w: 0.09 * (1.1 if w > 0 else 0.9)),
        ({"friction_scale": 0.8}, lambda w: 0.072),
    ],
)
def test_bearing_friction_over_speed(effect, friction) -> None:
    for speed in (5, 20, 60, -20) if "coulomb_asymmetry" in effect else (5, 20, 60):
        run = turning(constant().changed(**effect), speed)
        assert K_M * abs(run[Channel.I_MOTOR][-1]) == pytest.approx(friction(speed), rel=1e-3)


def test_presliding_gives_way_before_it_slides_and_comes_back_in_a_loop() -> None:
    rig = constant().changed(presliding=2e-3)
    current = 0.1 * np.interp(np.arange(1200) * 1e-3, [0, 0.3, 0.6, 0.9, 1.2], [0, 1, 0, -1, 0])
    theta = locked(rig, current)[Channel.THETA]
    assert theta[300] > 1e-4  # plain Coulomb friction would hold: K_m i < 0.09
    assert theta[600] > 0.2 * theta[300]  # unloaded, but not back
    assert turning(rig, 20)[Channel.FRICTION][-1] == pytest.approx(0.09, rel=1e-3)


def test_backlash_adds_its_width_to_the_swing() -> None:
    current = 0.5 * np.sin(2 * np.pi * np.arange(2000) * 1e-3)
    swing = [np.ptp(locked(constant().changed(backlash=b), current)[Channel.THETA][1000:]) for b in (0.0, 1e-3)]
    assert swing[1] - swing[0] == pytest.approx(N * 1e-3, rel=0.05)


def test_hardening_is_a_table_of_stiffness() -> None:
    rig = constant(0.0).changed(hardening=0.5, hardening_angle=5e-4)
    run = locked(rig, ramped(1.0, 3000, 1e-3, rise=2.0))
    deflection = run[Channel.THETA][-1] / N - run[Channel.TAU_SENSOR][-1] / 130000
    torque = C_G * 5e-4 * (1 + 1.5)  # two steps of the table, then twice the stiffness
    assert run[Channel.TAU_SENSOR][-1] == pytest.approx(35.0, abs=1e-3)
    assert 5e-4 * 2 + (35.0 - torque) / (2 * C_G) == pytest.approx(deflection, rel=1e-3)


def test_hysteresis_loops_as_wide_at_any_rate() -> None:
    def loop(frequency: float) -> float:
        interval = 1 / frequency / 1000
        current = 0.5 * np.sin(2 * np.pi * frequency * np.arange(2001) * interval)
        run = locked(constant(0.0).changed(hysteresis=2.0), current, interval)
        theta, torque = run[Channel.THETA][1000:], run[Channel.TAU_SENSOR][1000:]
        return float(np.trapezoid(torque, theta / N))

    assert loop(0.5) == pytest.approx(loop(1.0), rel=0.25)
    assert loop(0.5) > 1e-4


@pytest.mark.parametrize(
    ("effect", "periods", "channel"),
    [
        ({"kinematic_error": 1e-4}, 2, Channel.TAU_SENSOR),
        ({"gear_ripple": 1e-4, "gear_ripple_order": 1.0}, 1, Channel.TAU_SENSOR),
        ({"cogging": 0.01, "cogging_order": 8.0}, 8, Channel.I_MOTOR),
        ({"rotor_rub": 0.2}, 1, Channel.I_MOTOR),
        ({"encoder_eccentricity": 0.01}, 1, Channel.I_MOTOR),
    ],
)
def test_ripples_repeat_with_the_rotor_angle(effect, periods, channel) -> None:
    run, plain = (turning(constant().changed(**e), 20, 1200) for e in (effect, {}))
    late = run.time > 2
    ripple = order(run[channel][late], run[Channel.THETA][late], periods)
    assert ripple > 20 * order(plain[channel][late], plain[Channel.THETA][late], periods)
    assert ripple > 2 * order(run[channel][late], run[Channel.THETA][late], periods + 0.5)


@pytest.mark.parametrize("name", ["current_lag", "delay", "input_delay", "sensor_lag"])
def test_lags_shift_by_their_value(name: str) -> None:
    lag, interval = 2e-3, 1e-4
    current = 0.2 * np.sin(2 * np.pi * 5 * np.arange(6000) * interval)
    runs = [locked(constant(0.0).changed(**c), current, interval) for c in ({}, {name: lag})]
    time = runs[0].time[2000:]
    phase = [np.angle(np.sum(r[Channel.TAU_SENSOR][2000:] * np.exp(-2j * np.pi * 5 * time))) for r in runs]
    assert (phase[0] - phase[1]) / (2 * np.pi * 5) == pytest.approx(lag, rel=0.02)


def test_saturation_takes_torque_only_at_high_current() -> None:
    rig = constant(0.0).changed(saturation=0.5)
    for current, share in ((0.2, 1.0), (2.0, 2**-0.25)):
        torque = locked(rig, ramped(current, 2000, 1e-3))[Channel.TAU_SENSOR][-1]
        assert torque == pytest.approx(N * K_M * current * share, rel=1e-3)


def test_the_sensor_s_offset_gain_cross_talk_and_creep() -> None:
    rig = constant(0.0).changed(sensor_offset=0.3, sensor_gain=1.05, crosstalk=0.5, sensor_creep=0.1)
    run = locked(rig.changed(sensor_creep_time=0.5), held(0.5, 8000))
    assert run[Channel.TAU_SENSOR][-1] == pytest.approx(17.5 * 1.05 + 0.3 + 0.25, abs=1e-3)
    early = run[Channel.TAU_SENSOR][300] / run[Channel.TAU_SENSOR][-1]
    assert 0.9 < early < 0.97


def test_imbalance_is_a_load_torque_over_the_output_angle() -> None:
    run = turning(constant().changed(imbalance=2.0, imbalance_phase=0.5), 100, 1500)
    late = run.time > 1
    expected = 2.0 * np.sin(run[Channel.PHI_LOAD][late] + 0.5)
    np.testing.assert_allclose(run[Channel.TAU_SENSOR][late], expected, atol=0.05)


def test_friction_falls_while_it_heats_and_comes_to_rest_at_its_own_power() -> None:
    run = turning(constant().changed(thermal_friction=0.3, thermal_time=0.5), 50, 1200)
    friction = K_M * run[Channel.I_MOTOR]
    assert friction[100] > friction[200] > friction[-1]
    assert friction[-1] == pytest.approx(0.09 * np.exp(-0.3 * friction[-1] * 50), rel=2e-3)


def test_the_load_brush_holds_the_load_until_the_flexspline_pulls_harder() -> None:
    rig = constant(0.0).changed(load_brush=2.0)
    assert K_M * turning(rig, 50)[Channel.I_MOTOR][-1] == pytest.approx(2.0 / N * 0.6, rel=0.02)
    slow = rig.run("free_shaft", held(0.05, 400), 5e-3)
    held_still = np.abs(slow[Channel.TAU_SENSOR]) < 1.9
    assert np.all(slow[Channel.PHI_LOAD][: np.argmin(held_still)] == 0)


def test_relaxation_is_stiff_at_once_and_soft_later() -> None:
    rig = constant(0.0).changed(relaxation=0.2, relaxation_time=0.2)
    theta = locked(rig, held(0.5, 3000))[Channel.THETA]
    assert theta[-1] == pytest.approx(17.5 * N * (1 / C_G + 1 / 130000), rel=1e-3)
    assert 0.83 < theta[100] / theta[-1] < 0.95
