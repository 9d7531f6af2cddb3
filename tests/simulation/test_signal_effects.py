"""Effects between a model and its signals, against a plant whose response to them is computed independently."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.identification.problem.cases import measured_case
from fmuid.simulation.signal_effects import disturbed_input, disturbed_readings, split_signal_parameters
from fmuid.simulation.signal_model import SignalModel
from fmuid.simulation.simulator import Simulator, Task, Variable

DT, N, FINE = 0.01, 200, 500
TIME = DT * np.arange(N)
U = np.repeat(np.random.default_rng(1).choice([-1.0, -0.4, 0.3, 1.0], N // 10), 10)
TAU = 3.5 * DT


def first_order(u, h, tau, *, linear):
    """Return T der(y) = u - y at the samples of an input that is held or linear between them, settled at first."""
    keep = np.exp(-h / tau)
    mean = tau / h * (1.0 - keep)
    numerator = [1.0 - mean, mean - keep] if linear else [0.0, 1.0 - keep]
    return lfilter(numerator, [1.0, -keep], u - u[0]) + u[0]


class Plant(Simulator):
    """TAU der(x) = u - x, y = x + feedthrough u; exact at any communication points."""

    variables: ClassVar = {
        "tau": Variable("tau", "parameter", "fixed", start=TAU),
        "feedthrough": Variable("feedthrough", "parameter", "fixed", start=0.0),
        "u": Variable("u", "input"),
        "y": Variable("y", "output"),
    }

    even_steps = False

    def __init__(self, *, even_steps=False):
        self.even_steps, self.count = even_steps, 0

    def simulate(self, task, parameters):
        self.count += 1
        p = {"tau": TAU, "feedthrough": 0.0, **task.start_values, **parameters}
        u, h, x = task.inputs["u"], np.diff(task.time), [task.inputs["u"][0]]
        assert np.all(h > 0.0)
        assert not self.even_steps or np.ptp(h) < 1e-9
        for k, step in enumerate(h):
            keep = np.exp(-step / p["tau"])
            slope = (u[k + 1] - u[k]) / step if task.interpolation == "linear" else 0.0
            begin = u[k] - p["tau"] * slope
            x.append(begin + slope * step + keep * (x[-1] - begin))
        through = u if task.interpolation == "linear" else np.append(u[0], u[:-1])
        return np.array([np.array(x) + p["feedthrough"] * through])


def measured(effect, value, interpolation, feedthrough, u=U):
    """Return the outputs of the plant with one late signal, on a grid far finer than the samples."""
    h, linear = DT / FINE, interpolation == "linear"
    fine = h * np.arange((N - 1) * FINE + 1)
    moved = fine - (value if effect == "u.delay" else 0.0)
    v = np.interp(moved, TIME, u) if linear else u[np.clip(np.floor(moved / DT + 1e-9).astype(int), 0, N - 1)]
    if effect == "u.lag":
        v = first_order(v, h, value, linear=linear)
    y = first_order(v, h, TAU, linear=linear) + feedthrough * (v if linear else np.append(v[0], v[:-1]))
    if effect == "y.lag":
        y = first_order(y, h, value, linear=True)
    if effect == "y.delay":
        y = np.interp(fine - value, fine, y)
    return y[::FINE]


def campaign(y, interpolation="hold", u=U, **options):
    task = Task(TIME, {"u": u}, ("y",), interpolation=interpolation)
    return CampaignModel((measured_case("run", Plant(**options), task, {"y": y}),))


@pytest.mark.parametrize("feedthrough", [0.0, 0.5])
@pytest.mark.parametrize("interpolation", ["hold", "linear"])
@pytest.mark.parametrize("effect", ["u.delay", "u.lag", "y.delay", "y.lag"])
@pytest.mark.parametrize("samples", [0.3, 1.6, 5.25])
def test_how_late_a_signal_is_is_found_to_a_fraction_of_a_sample(effect, samples, interpolation, feedthrough):
    value = samples * DT
    y = measured(effect, value, interpolation, feedthrough)
    model = campaign(y, interpolation)

    def error(x):
        point = {effect: x[0] * value, "tau": x[1] * TAU, "feedthrough": feedthrough}
        return model.predict([point])[0][0][0] - y

    estimate = least_squares(error, [1.2, 1.0], diff_step=1e-4).x
    assert estimate == pytest.approx([1.0, 1.0], abs=6e-3)


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
@pytest.mark.parametrize("signal", ["u", "y"])
def test_a_lag_may_be_split_in_two(signal, interpolation):
    h, linear = DT / FINE, interpolation == "linear"
    fine = h * np.arange((N - 1) * FINE + 1)
    v = np.interp(fine, TIME, U) if linear else U[np.clip(np.floor(fine / DT + 1e-9).astype(int), 0, N - 1)]
    expected = first_order(v, h, TAU, linear=linear)
    for lag in (1.8 * DT, 4.2 * DT):
        expected = first_order(expected, h, lag, linear=True)
    values = {f"{signal}.lag": 6.0 * DT, f"{signal}.lag_split": 0.3}
    shown = campaign(np.zeros(N), interpolation).predict([values])[0][0][0]
    np.testing.assert_allclose(shown, expected[::FINE], atol=2e-3)
    single = campaign(np.zeros(N), interpolation).predict([{f"{signal}.lag": 6.0 * DT}])[0][0][0]
    assert np.abs(shown - single).max() > 0.02


@pytest.mark.parametrize("effect", ["u.delay", "u.lag", "y.delay", "y.lag"])
def test_before_its_first_sample_every_signal_is_settled(effect):
    y = np.full(N, 1.5)
    (shown,) = campaign(y, u=np.ones(N)).predict([{effect: 0.2, "feedthrough": 0.5}])
    np.testing.assert_allclose(shown[0][0], y, rtol=1e-12)


@pytest.mark.parametrize("effect", ["u.delay", "u.lag", "y.delay", "y.lag"])
def test_a_model_that_takes_even_steps_only_gets_the_mean_over_each_step(effect):
    value = 6.0 * DT
    y = measured(effect, value, "hold", 0.0)
    even = campaign(y, even_steps=True).predict([{effect: value}])[0][0][0]
    assert np.sqrt(np.mean((even - y) ** 2)) < 0.02
    assert np.sqrt(np.mean((campaign(y).predict([{effect: value}])[0][0][0] - y) ** 2)) < 1e-4


def test_the_lag_of_a_sensor_costs_one_simulation_whatever_it_is():
    model = campaign(np.zeros(N))
    model.predict([{"y.lag": 0.01}, {"y.lag": 0.03}, {"y.lag": 0.03, "y.gain": 1.1}])
    assert model.cases[0].simulator.count == 1


@pytest.mark.parametrize("effect", ["speed.delay", "speed.lag"])
def test_a_differentiated_reading_is_late_as_any_other(effect):
    y = 0.3 + 2.0 * TIME  # at constant speed from the very first sample on
    case = measured_case("run", Ramp(), Task(TIME, {}, ("y",)), {"y": y})
    channel = replace(case.channels[0], signal="speed", differentiated=True)
    model = CampaignModel((replace(case, channels=(channel,)),))
    np.testing.assert_allclose(model.predict([{effect: 0.035}])[0][0][0], 2.0, rtol=1e-9)


class Ramp(Simulator):
    variables: ClassVar = {"y": Variable("y", "output")}

    def simulate(self, task, parameters):
        return np.array([0.3 + 2.0 * task.time])


def test_signal_parameters_are_told_from_the_model_s():
    plain, disturbed = split_signal_parameters(
        {"d": 1.0, "gear.gain": 3.0, "y.gain": 1.1, "y.offset": 0.0, "u.delay": 2e-3}, {"y", "u"}
    )
    assert plain == {"d": 1.0, "gear.gain": 3.0}
    assert disturbed == {"y": {"gain": 1.1}, "u": {"delay": 2e-3}}
    plain, disturbed = split_signal_parameters({"y.crosstalk[u]": 0.1, "y.crosstalk[x]": 0.2}, {"y", "u"})
    assert (plain, disturbed) == ({"y.crosstalk[x]": 0.2}, {"y": {"crosstalk[u]": 0.1}})


def test_a_delay_of_whole_samples_moves_them_and_needs_no_further_ones():
    late = disturbed_input(TIME, U, {"delay": 3 * DT, "gain": 2.0, "offset": 0.1}, linear=False)
    np.testing.assert_allclose(late.on(TIME)[3:], 2.0 * U[:-3] + 0.1)
    np.testing.assert_allclose(late.on(TIME)[:3], 2.0 * U[0] + 0.1)


@pytest.mark.parametrize("linear", [False, True])
def test_a_lag_does_not_depend_on_how_often_the_input_is_sampled(linear):
    uneven = np.append([0, 1, 2], np.sort(np.random.default_rng(2).choice(np.arange(3, N), 60, replace=False)))
    step = np.where(TIME < DT, 0.0, 1.0)
    every, some = (
        disturbed_input(TIME[k], step[k], {"lag": 0.05}, linear=linear).on(TIME[uneven], average=True)[:-1]
        for k in (np.arange(N), uneven)
    )
    np.testing.assert_allclose(some, every, atol=1e-12)


def test_sensors_that_read_wrongly():
    y = np.stack([TIME, -TIME])
    read = disturbed_readings(
        y, ("a", "b"), {"a": {"gain": 2.0, "offset": 0.5}, "b": {"saturation": 0.5}}, TIME, {}
    )
    np.testing.assert_allclose(read[0], 2.0 * TIME + 0.5)
    assert np.abs(read[1]).max() < 0.5
    assert read[1, 1] == pytest.approx(-TIME[1], rel=1e-3)
    assert disturbed_readings(y, ("a", "b"), {}, TIME, {}) is y


def test_a_sensor_that_has_lost_the_sign():
    y = np.stack([np.sin(20.0 * TIME), -TIME])
    read = disturbed_readings(y, ("a", "b"), {"a": {"rectification": 1.0, "gain": 2.0}}, TIME, {})
    np.testing.assert_allclose(read[0], 2.0 * np.abs(y[0]))
    np.testing.assert_array_equal(read[1], y[1])
    half = disturbed_readings(y, ("a", "b"), {"a": {"rectification": 0.5}}, TIME, {})
    np.testing.assert_allclose(half[0], np.maximum(y[0], 0.0))


def test_sensors_that_drift_or_read_others():
    y, u = np.stack([np.sin(TIME), np.cos(TIME)]), {"u": U}
    effects = {"a": {"drift": 0.2, "crosstalk[u]": 0.1, "crosstalk[b]": -0.3}}
    read = disturbed_readings(y, ("a", "b"), effects, TIME, u)
    np.testing.assert_allclose(read[0], y[0] + 0.2 * (TIME - TIME[0]) + 0.1 * U - 0.3 * y[1])
    np.testing.assert_array_equal(read[1], y[1])
    settled = disturbed_readings(y, ("a", "b"), {"a": {"drift": 0.2, "drift_settling": 4.0}}, TIME, u)
    np.testing.assert_allclose(settled[0], y[0] + 0.05 * (1.0 - np.exp(-4.0 * (TIME - TIME[0]))))


def test_inputs_that_saturate_have_a_dead_zone_or_see_each_other():
    u = np.linspace(-2.0, 2.0, N)
    hard = disturbed_input(TIME, u, {"compression": 1.0, "hardness": 30.0}, linear=True).values
    np.testing.assert_allclose(hard, np.clip(u, -1.0, 1.0), atol=0.03)
    far = disturbed_input(TIME, 1e5 * u, {"compression": 1.0, "hardness": 100.0}, linear=True).values
    np.testing.assert_allclose(far, np.clip(1e5 * u, -1.0, 1.0))
    dead = disturbed_input(TIME, u, {"dead_zone": 0.5}, linear=True).values
    np.testing.assert_allclose(dead, np.sign(u) * np.maximum(np.abs(u) - 0.5, 0.0))
    skewed = {"dead_zone": 0.5, "dead_zone_skew": 0.4}
    moved = disturbed_input(TIME, u, skewed, linear=True).values
    np.testing.assert_allclose(moved, u - np.clip(u, -0.3, 0.7), atol=1e-12)
    both = disturbed_input(TIME, u, {"crosstalk[v]": 0.1}, linear=True, others={"u": u, "v": U}).values
    np.testing.assert_allclose(both, u + 0.1 * U)


def test_an_input_with_play_follows_only_what_moves_beyond_it():
    u = np.array([0.0, 1.0, 0.5, -1.0, -0.9, 0.0, 2.0])
    y = disturbed_input(np.arange(7.0), u, {"play": 0.6}, linear=True).values
    np.testing.assert_allclose(y, [0.0, 0.4, 0.4, -0.4, -0.4, -0.4, 1.4])
    read = disturbed_readings(u[None], ("a",), {"a": {"play": 0.6}}, np.arange(7.0), {})
    np.testing.assert_allclose(read[0], y)


@pytest.mark.parametrize("linear", [True, False])
def test_an_input_with_a_limited_rate_has_the_same_integral_as_a_ramp(linear):
    time = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    u = np.array([0.0, 1.0, 1.0, 1.0, -5.0])
    y = disturbed_input(time, u, {"slowness": 2.0}, linear=linear).values
    expected = [0.0, 0.5, 1.0, 1.0, 0.5] if linear else [0.0, 0.25, 0.75, 1.0, 1.0]
    np.testing.assert_allclose(y, expected)
    soon = disturbed_input(time, u, {"slowness": 0.1}, linear=False).values
    np.testing.assert_allclose(soon[:4], [0.0, 0.95, 1.0, 1.0])


@pytest.mark.parametrize(
    ("prop", "unit"),
    [
        ("gain", "1"),
        ("saturation", "N"),
        ("offset", "N"),
        ("dead_zone", "N"),
        ("lag", "s"),
        ("delay", "s"),
        ("hardness", "1"),
        ("drift_settling", "1/s"),
    ],
)
def test_effects_of_a_signal_have_units(prop, unit):
    plant = Plant()
    plant.variables = {**Plant.variables, "y": Variable("y", "output", unit="N")}
    assert SignalModel(plant, (f"y.{prop}",)).variables[f"y.{prop}"].unit == unit
