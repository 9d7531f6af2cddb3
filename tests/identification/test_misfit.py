"""A fit that cannot be good says what to look at."""

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Task, identify, measured_case

TIME = np.linspace(0.0, 600.0, 301)
HEAT = 1.0 * (TIME > 60.0) - 0.6 * (TIME > 300.0)


def tank(time, inputs, p):
    """A heated tank: C der(T) = u - G T."""
    temperature, step = np.zeros_like(time), time[1] - time[0]
    decay = np.exp(-step * p["G"] / p["C"])
    for k in range(1, time.size):
        temperature[k] = decay * temperature[k - 1] + (1 - decay) * inputs["u"][k - 1] / p["G"]
    return {"y": temperature}


TRUTH = {"C": 50.0, "G": 0.8}


def warnings(analytic, measured, sigma=1e-3, **task):
    model = analytic(tank, TRUTH)
    case = measured_case("run", model, Task(TIME, {"u": HEAT}, ("y",)), {"y": measured}, sigma={"y": sigma})
    specs = [ParameterSpec("C", 80.0, 10.0, 200.0), ParameterSpec("G", 1.0, 0.2, 5.0)]
    return identify(Problem([case], specs), solver="trf").stages[0].warnings


@pytest.fixture
def measured():
    exact = tank(TIME, {"u": HEAT}, TRUTH)["y"]
    return exact + 1e-3 * np.random.default_rng(4).standard_normal(TIME.size)


def test_a_good_fit_says_nothing(analytic, measured):
    assert warnings(analytic, measured) == ()


def test_a_wrong_sign_is_said_first(analytic, measured):
    first, second, *_ = warnings(analytic, -measured)
    assert first.startswith("y was measured with the opposite sign of its prediction at the ")
    assert first.endswith("check its sign and those of the inputs")
    assert "times its noise" in second


@pytest.mark.parametrize(
    ("factor", "units"),
    [
        (180 / np.pi, "degrees and radians"),
        (np.pi / 180, "degrees and radians"),
        (1000.0, "mm and m"),
        (0.001, "mm and m"),
    ],
)
def test_a_wrong_unit_is_said_first(analytic, measured, factor, units):
    first, *_ = warnings(analytic, factor * measured, sigma=1e-3 * factor)
    assert units in first
    assert first.endswith("check its unit and those of the inputs")


def test_only_units_of_the_signals_own_quantity_are_suggested(analytic, measured):
    def in_units(function, parameters):
        return analytic(function, parameters, units={"u": "W", "y": "K"})

    (first, *_) = warnings(in_units, np.rad2deg(measured), sigma=0.06)
    assert "was measured as" in first
    assert "about as between" not in first
    (first, *_) = warnings(in_units, 1000.0 * measured, sigma=1.0)
    assert "any unit and its thousandth" in first


def test_what_the_model_misses_is_told_in_terms_of_the_noise(analytic, measured):
    missed = 0.05 * np.sin(TIME / 20.0)  # RMS 35 sigma, 3 % of the signal
    (warning,) = (w for w in warnings(analytic, measured + missed) if w.startswith("the residual of y is"))
    assert warning.startswith("the residual of y is 3") or warning.startswith("the residual of y is 2")
    assert warning.endswith("run fmuid diagnose")


def test_noise_that_nobody_knows_is_no_measure(analytic, measured):
    model = analytic(tank, TRUTH)
    case = measured_case(
        "run", model, Task(TIME, {"u": HEAT}, ("y",), {"C": 50.0}), {"y": measured + 0.05 * np.sin(TIME / 20.0)}
    )
    stage = identify(Problem([case], [ParameterSpec("G", 1.0, 0.2, 5.0)]), solver="trf").stages[0]
    assert not any("times the noise" in warning for warning in stage.warnings)
