"""The effects of the catalogues: off at neutral, there when on, and each with its law."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import fmpy
import numpy as np
import pytest

from fmuid.diagnosis.catalogue import load_catalogue
from fmuid.simulation.simulator import Task
from tests.conftest import MODELICA
from tests.reference import experiments as e
from tests.reference.plain_fmpy import simulate_fmu

FILE = MODELICA / "Drives" / "effects.toml"
CATALOGUE = tomllib.loads(FILE.read_text())
TASKS = {
    "FixedShaft": e.fixed_shaft("prbs"),
    "FreeShaft": e.free_shaft(),
    "EccentricLoad": e.eccentric_load(),
}


def simulate(fmus, setup: str, values=None, inputs=None, tolerance: float = 1e-7):
    """Return the outputs of a setup with its effects, plain values and further ones set, further inputs driven."""
    task = TASKS[setup]
    task = replace(task, inputs={**task.inputs, **(inputs or {})})
    return simulate_fmu(fmus[f"{setup}WithEffects"], task, {**e.CONSTANT_FRICTION, **(values or {})}, tolerance)


@pytest.fixture(scope="module")
def neutral(effect_fmus):
    return {setup: simulate(effect_fmus, setup) for setup in TASKS}


@pytest.mark.parametrize("name", TASKS)
def test_neutral_equals_the_plain_model(fmus, effect_fmus, name):
    plain = simulate_fmu(fmus[name], TASKS[name], e.LOSSY, tolerance=1e-10)
    with_effects = simulate_fmu(effect_fmus[CATALOGUE["models"][name]], TASKS[name], e.LOSSY, tolerance=1e-10)

    for ours, theirs in zip(with_effects, plain, strict=True):
        assert ours == pytest.approx(theirs, abs=1e-9 * np.ptp(theirs))


def test_catalogue_is_what_the_specification_lists():
    assert set(CATALOGUE["effects"]) == {
        *("viscous", "stribeck", "coulomb_asymmetry", "mesh_loss", "presliding", "backlash", "hardening"),
        *("hysteresis", "kinematic_error", "cogging", "current_lag", "saturation", "sensor_offset"),
        *("sensor_gain", "sensor_lag", "imbalance", "thermal_friction", "delay"),
    }


def test_catalogue_is_read():
    loaded = load_catalogue(FILE)

    for effect in loaded.effects.values():
        assert effect.port in loaded.ports
        assert effect.description
        assert effect.source


@pytest.mark.parametrize("setup", TASKS)
def test_catalogue_matches_the_fmus(effect_fmus, setup):
    description = fmpy.read_model_description(str(effect_fmus[CATALOGUE["models"][setup]]))
    variables = {v.name: v for v in description.modelVariables}

    def unit_of(name: str) -> str | None:
        variable = variables[name]
        return variable.unit or (variable.declaredType.unit if variable.declaredType else None)

    for port in CATALOGUE["ports"].values():
        name = port.get("input") or port["output"]
        assert variables[name].causality == ("input" if "input" in port else "output")
        assert unit_of(name) == port["unit"]
        assert float(variables[name].start or 0.0) == 0.0
    for effect in CATALOGUE["effects"].values():
        for name, parameter in effect["parameters"].items():
            off = parameter.get("neutral", parameter.get("start"))
            assert variables[name].causality == "parameter"
            assert float(variables[name].start) == off, name
            assert unit_of(name) == parameter["unit"], name


# Those between the first and the last are asked where time allows.
TRIALS = [
    pytest.param(effect, trial, marks=[pytest.mark.slow] if 0 < trial < len(entry["trials"]) - 1 else [])
    for effect, entry in CATALOGUE["effects"].items()
    for trial in range(len(entry["trials"]))
]


@pytest.mark.parametrize(("effect", "trial"), TRIALS)
def test_every_trial_shows_in_some_signal(effect_fmus, neutral, effect, trial):
    largest = 0.0
    for setup in TASKS:
        outputs = simulate(effect_fmus, setup, CATALOGUE["effects"][effect]["trials"][trial])
        difference = outputs - neutral[setup]
        assert np.all(np.isfinite(difference))
        largest = max(largest, float((np.abs(difference).mean(axis=1) / neutral[setup].std(axis=1)).max()))

    assert largest > 3e-4


@pytest.mark.parametrize("port", [port for port, p in CATALOGUE["ports"].items() if "input" in p])
def test_every_port_shows_in_some_signal(effect_fmus, neutral, port):
    entry = CATALOGUE["ports"][port]
    moved = 0.0
    for setup in TASKS:
        push = {entry["input"]: np.full(len(TASKS[setup].time), entry["magnitude"])}
        outputs = simulate(effect_fmus, setup, inputs=push)
        moved = max(moved, float((outputs - neutral[setup]).std() / neutral[setup].std()))

    assert moved > 1e-4


def steady_current(fmu, speed: float, parameters: dict[str, float], stop: float = 2.0) -> float:
    time = np.linspace(0, stop, 401)
    task = Task(time, {"w_ref": np.full(401, speed)}, ("i_motor",))
    return float(simulate_fmu(fmu, task, parameters)[0, -100:].mean())


@pytest.mark.parametrize(
    ("parameters", "friction"),
    [
        ({}, 0.09),
        ({"gear.viscous": 5e-4}, 0.09 + 5e-4 * 40),
        ({"gear.stribeck": 0.05, "gear.stribeck_speed": 50.0}, 0.09 + 0.05 * np.exp(-0.64)),
        ({"gear.asymmetry": 0.02}, 0.11),
        ({"gear.ripple_sin": 0.01, "gear.ripple_cos": 0.01}, 0.09),
        ({"motor.cogging_sin": 0.01}, 0.09),
        ({"motor.saturation": 0.5}, 0.09 * np.sqrt(1 + 0.5 * (0.09 / 0.7) ** 2)),
    ],
)
def test_current_at_constant_speed(effect_fmus, parameters, friction):
    current = steady_current(effect_fmus["FreeShaftWithEffects"], 40.0, parameters)

    assert 0.7 * current == pytest.approx(friction, rel=0.01)


def test_asymmetry_is_less_friction_backward(effect_fmus):
    current = steady_current(effect_fmus["FreeShaftWithEffects"], -40.0, {"gear.asymmetry": 0.02})

    assert 0.7 * current == pytest.approx(-0.07, rel=5e-3)


def test_friction_falls_as_the_gear_warms_up(effect_fmus):
    parameters = {"gear.thermal": 0.1, "gear.thermal_time": 1.0}
    current = steady_current(effect_fmus["FreeShaftWithEffects"], 40.0, parameters, stop=20.0)

    friction = 0.7 * current
    assert friction == pytest.approx(0.09 * np.exp(-0.1 * friction * 40), rel=1e-3)


def slow_ramp(fmu, parameters: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return motor torque times n and the Flexspline's deflection while the current rises and falls slowly."""
    time = np.linspace(0, 4, 2001)
    current = np.interp(time, [0, 1, 3, 4], [0, 1, -1, 0])
    task = Task(time, {"i_cmd": current}, ("motor.tau", "flexspline.phi_rel"))
    motor, deflection = simulate_fmu(fmu, task, parameters)
    return 50 * motor, -deflection


@pytest.mark.parametrize(
    ("onset", "exponent"),
    [(0.0, 3.0), (4e-4, 2.0)],  # a cubic law; a stiffness that rises evenly from some wind-up on
)
def test_wind_up_of_the_flexspline(effect_fmus, onset, exponent):
    shape = {"flexspline.hardening_onset": onset, "flexspline.hardening_exponent": exponent}
    for size in (0.0, 0.4):
        fmu = effect_fmus["FixedShaftWithEffects"]
        torque, wind = slow_ramp(fmu, {"flexspline.hardening": size, **shape})
        beyond = np.maximum(np.abs(wind) - onset, 0.0) / 1e-3
        expected = 25500 * (wind + 1e-3 * size * np.sign(wind) * beyond**exponent)
        assert torque == pytest.approx(expected, abs=0.3)


def test_backlash_is_lost_motion(effect_fmus):
    torque, wind = slow_ramp(effect_fmus["FixedShaftWithEffects"], {"flexspline.backlash": 4e-4})

    loaded = np.abs(torque) > 5
    assert wind[loaded] == pytest.approx(torque[loaded] / 25500 + 2e-4 * np.sign(torque[loaded]), abs=3e-5)


def test_hysteresis_is_a_loop_that_loses_energy(effect_fmus):
    parameters = {"flexspline.hysteresis": 2.0, "flexspline.hysteresis_angle": 1e-4}
    torque, wind = slow_ramp(effect_fmus["FixedShaftWithEffects"], parameters)

    area = np.trapezoid(torque, wind)
    amplitude = np.ptp(wind) / 2
    assert area == pytest.approx(4 * 2.0 * amplitude, rel=0.25)
    none = np.trapezoid(*slow_ramp(effect_fmus["FixedShaftWithEffects"], {}))
    assert abs(none) < 0.05 * area


def test_sensor_reads_with_gain_and_offset(effect_fmus, neutral):
    parameters = {**e.CONSTANT_FRICTION, "sensor.gain": 1.05, "sensor.offset": -0.4}
    torque = simulate_fmu(effect_fmus["FixedShaftWithEffects"], TASKS["FixedShaft"], parameters)[0]

    assert torque == pytest.approx(1.05 * neutral["FixedShaft"][0] - 0.4, abs=1e-9)


@pytest.mark.parametrize(
    ("parameter", "expected"),
    [("motor.delay", lambda t: 1.0 * (t > 2e-2)), ("motor.current_lag", lambda t: -np.expm1(-t / 2e-2))],
)
def test_current_behind_its_command(effect_fmus, parameter, expected):
    time = np.linspace(0, 0.2, 2001)
    task = Task(time, {"i_cmd": np.ones(2001)}, ("motor.tau",))
    (torque,) = simulate_fmu(effect_fmus["FixedShaftWithEffects"], task, {parameter: 2e-2})

    lost = np.trapezoid(0.7 - torque, time)
    assert lost == pytest.approx(np.trapezoid(0.7 * (1 - expected(time)), time), rel=0.01)
    assert torque[0] == pytest.approx(0.0, abs=1e-9)


def test_imbalance_is_a_weight_on_the_output(effect_fmus):
    fmu = effect_fmus["FreeShaftWithEffects"]
    time = np.linspace(0, 16, 1601)
    task = Task(time, {"w_ref": np.full(1601, 20.0)}, ("tau_sensor", "load.phi"))
    parameters = {"shaft.imbalance_sin": 1.5, "shaft.imbalance_cos": 0.5}
    torque, phi = simulate_fmu(fmu, task, parameters)

    late = time > 2
    assert torque[late] == pytest.approx(1.5 * np.sin(phi[late]) + 0.5 * np.cos(phi[late]), abs=0.05)


def test_load_port_pushes_the_shaft(effect_fmus):
    time = np.linspace(0, 2, 401)
    push = np.where(time > 1, 3.0, 0.0)
    task = Task(time, {"w_ref": np.full(401, 20.0), "port_load_torque": push}, ("tau_sensor",))
    (torque,) = simulate_fmu(effect_fmus["FreeShaftWithEffects"], task, {})

    assert torque[-1] == pytest.approx(-3.0, abs=0.05)


def test_transmission_error_shakes_the_load_without_losing_energy(effect_fmus):
    time = np.linspace(0, 3, 3001)
    names = ("load.phi", "rotor.phi", "i_motor", "tau_sensor")
    task = Task(time, {"w_ref": np.full(3001, 30.0)}, names)
    error = {"gear.error_sin": 1e-4, "gear.error_cos": 5e-5}
    phi, rotor, current, torque = simulate_fmu(effect_fmus["FreeShaftWithEffects"], task, error)

    late = time > 1
    expected = 1e-4 * np.sin(2 * rotor[late]) + 5e-5 * (np.cos(2 * rotor[late]) - 1)
    wind = (rotor / 50 - phi)[late] + expected
    assert wind == pytest.approx(torque[late] / 25500, abs=2e-6)
    assert torque[late].std() > 0.01
    assert 0.7 * current[late].mean() == pytest.approx(0.09, rel=0.02)
