"""Noise of recorded inputs: the model is driven by more than the plant was."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid import (
    Campaign,
    Experiment,
    Measurements,
    ParameterSpec,
    Problem,
    Signal,
    StageSpec,
    Task,
    identify,
    measured_case,
)
from fmuid.core.campaign import ModelSpec
from fmuid.data.noise.level import input_sigma
from tests.identification.test_robust_errors import SIGMA

NOISE = 0.5


def static(time, inputs, p):
    return {"y": p["k"] * inputs["u"]}


def amplified(analytic, seed, noise=NOISE, *, stated=True):
    """A gain of 2 whose input is white, and is recorded with noise."""
    random = np.random.default_rng(seed)
    cases = []
    for k in range(4):
        u = random.standard_normal(500)
        recorded = u + noise * random.standard_normal(500)
        y = 2.0 * u + SIGMA * random.standard_normal(500)
        task = Task(0.01 * np.arange(500), {"u": recorded}, ("y",), {}, "hold")
        sigma = {"y": SIGMA} | ({"u": noise} if stated else {})
        cases.append(measured_case(f"run{k}", analytic(static, ["k"]), task, {"y": y}, sigma=sigma))
    return Problem(cases, [ParameterSpec("k", 1.0, 0.1, 10.0)])


def test_a_bias_is_reported_and_part_of_the_interval(analytic):
    for seed in range(5):
        silent = identify(amplified(analytic, seed, stated=False)).stages[0]
        assert silent["k"].interval[1] < 2.0
        stage = identify(amplified(analytic, seed)).stages[0]
        low, high = stage["k"].interval
        assert stage["k"].value == silent["k"].value
        assert low < 2.0 < high
        assert high - low < 2.0 * 2.1 * stage["k"].standard_error  # few runs widen the scatter, not the bias
        assert "biased" in stage["k"].note
        (warning,) = [w for w in stage.warnings if "biases" in w]
        assert warning.startswith(f"noise of the recorded input u ({NOISE:g}) biases k by about -0.3")
        assert "the interval includes this" in warning


def test_what_does_not_bias_is_not_reported(analytic):
    stage = identify(amplified(analytic, 0, 0.01)).stages[0]
    assert stage["k"].note == ""
    assert not any("biases" in w for w in stage.warnings)


def test_known_noise_widens_the_interval_also_where_residuals_do_not_show_it(analytic):
    def error(noise):
        u = np.sin(0.1 * np.arange(500))
        y = 2.0 * u + SIGMA * np.random.default_rng(1).standard_normal(500)
        task = Task(0.01 * np.arange(500), {"u": u}, ("y",), {}, "hold")
        case = measured_case("run", analytic(static, ["k"]), task, {"y": y}, sigma={"y": SIGMA, "u": noise})
        return identify(Problem([case], [ParameterSpec("k", 1.0)])).stages[0]["k"].standard_error

    scatter, bias = np.sqrt(1.0 + 2.0**2) * error(1e-6), 2.0 * SIGMA**2 / 0.5
    assert error(SIGMA) == pytest.approx(np.hypot(scatter, bias), rel=0.2)
    assert error(SIGMA / 100) == pytest.approx(error(1e-6), rel=0.01)


def test_a_model_that_fails_with_more_noise_keeps_its_intervals(analytic):
    def fragile(time, inputs, p):
        return None if np.max(np.abs(inputs["u"])) > 1.0 else static(time, inputs, p)

    u = np.clip(np.random.default_rng(0).standard_normal(300), -1.0, 1.0)
    y = 2.0 * u + SIGMA * np.random.default_rng(1).standard_normal(300)
    task = Task(0.01 * np.arange(300), {"u": u}, ("y",), {}, "hold")
    case = measured_case("run", analytic(fragile, ["k"]), task, {"y": y}, sigma={"y": SIGMA, "u": 0.1})
    stage = identify(Problem([case], [ParameterSpec("k", 1.0)])).stages[0]
    assert stage["k"].interval is not None
    assert any("the noise of the inputs is not in the intervals: " in w for w in stage.warnings)


def recorded(values, sigma=None, of=None, id="a"):
    y = Signal("y", np.zeros(400), "1", "output")
    return Experiment(
        id,
        "bench",
        0.01 * np.arange(400),
        {"u": Signal("u", values, "mV", "input", sigma), "y": y},
        repeat_of_reference=of,
    )


def test_runs_of_one_reference_show_the_noise_of_their_inputs():
    random, u = np.random.default_rng(0), 10.0 * np.sin(0.1 * np.arange(400))
    slow = 0.2 * np.sin(0.02 * np.arange(400))  # as a controller reacts
    first = recorded(u + 0.1 * random.standard_normal(400))
    second = recorded(u + slow + 0.1 * random.standard_normal(400), of="a", id="b")
    both = Measurements({"a": first, "b": second})
    for run in both:
        assert input_sigma(both, run, "u") == pytest.approx(0.1, rel=0.25)
    assert input_sigma(both, replace(first, signals={"u": replace(first.signals["u"], sigma=0.3)}), "u") == 0.3
    assert input_sigma(Measurements({"a": first}), first, "u") is None
    alike = Measurements({"a": first, "b": replace(first, id="b", repeat_of="a")})
    assert input_sigma(alike, first, "u") is None  # commanded: known exactly


def test_stated_noise_is_converted_to_the_unit_of_the_model(analytic):
    bench = {"bench": analytic(static, ["k"], units={"u": "V", "y": "1"})}
    run = recorded(np.zeros(400), sigma=50.0)
    campaign = Campaign(
        "gain",
        "",
        Path(),
        Measurements({"a": run}),
        {"bench": ModelSpec("bench", Path("gain.fmu"))},
        {"k": ParameterSpec("k", 1.0)},
        {},
        {},
        ("a",),
        (),
    )
    problem = Problem.of_stage(campaign, StageSpec("all", ("a",), ("k",)), bench, settled=False)
    assert problem.cases[0].input_noise == pytest.approx({"u": 0.05})
