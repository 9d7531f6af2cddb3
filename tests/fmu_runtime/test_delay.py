"""delay(): the past of an expression, in co-simulation and model exchange, against solutions by hand."""

from __future__ import annotations

from dataclasses import replace
from math import factorial
from pathlib import Path

import fmpy
import numpy as np
import pytest

from fmu_build import build
from fmuid import load_fmu
from fmuid.core.errors import SimulationError
from fmuid.simulation.simulator import Task
from tests.fmu_runtime.conftest import Fmu
from tests.fmu_runtime.test_sensitivity import choose, sensitivities

DELAYS = Path(__file__).parent / "models" / "Delays.mo"
KINDS = ("CoSimulation", "ModelExchange")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("delays")
    return lambda name, fmi="2": build(DELAYS, f"Delays.{name}", folder / fmi, fmi)


def by_steps(t, delay):
    """Solution of x' = -x(t - delay) with x = 1 before 0."""
    powers = [np.clip(t - (k - 1) * delay, 0, None) ** k * (-1) ** k / factorial(k) for k in range(12)]
    return sum(np.where(t >= (k - 1) * delay, p, 0) for k, p in enumerate(powers))


@pytest.mark.parametrize("fmi", ["2", "3"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_past_of_a_loop_and_of_the_past_itself(built, kind, fmi):
    run = fmpy.simulate_fmu(
        str(built("Past", fmi)), fmi_type=kind, stop_time=3, output_interval=0.05, relative_tolerance=1e-8,
        output=["x", "y", "w", "twice", "now"],
    )  # fmt: skip
    t = run["time"]
    np.testing.assert_allclose(run["y"], np.where(t < 0.5, 0, np.sin(3 * (t - 0.5))), atol=2e-8)
    np.testing.assert_allclose(run["twice"], np.where(t < 1, 0, np.sin(3 * (t - 1))), atol=2e-8)
    np.testing.assert_allclose(run["x"], by_steps(t, 0.7), atol=5e-7)
    np.testing.assert_allclose(run["w"], by_steps(t - 0.7, 0.7), atol=5e-7)
    np.testing.assert_array_equal(run["now"], run["x"])


@pytest.mark.parametrize("kind", KINDS)
def test_jumps_come_back_as_jumps_at_their_times(built, kind):
    run = fmpy.simulate_fmu(
        str(built("Jumps")), fmi_type=kind, stop_time=2, output_interval=0.03, relative_tolerance=1e-8,
        output=["x", "y", "z"],
    )  # fmt: skip
    jump = -np.log(0.6) + 0.31
    t = run["time"]
    away = (np.abs(t - jump) > 1e-5) & (np.abs(t - jump - 0.62) > 1e-5)  # model exchange records both sides of it
    np.testing.assert_allclose(run["y"][away], t[away] > jump, atol=1e-12)
    np.testing.assert_allclose(run["z"][away], t[away] > jump + 0.62, atol=1e-12)
    x = np.where(t < jump, 1 - np.exp(-t), 2 - (1 + np.exp(-jump)) * np.exp(-(t - jump)))
    np.testing.assert_allclose(run["x"], x, atol=1e-6)


def test_an_input_is_delayed_as_it_was(built):
    model = load_fmu(built("Jumps"))
    t = np.linspace(0, 2, 201)
    u = np.where(t < 0.5, 1.0, -2.0)
    run = model.simulate(Task(t, {"u": u}, ("v",)), {})[0]
    np.testing.assert_allclose(run, np.where(t < 0.8 + 1e-9, 1.0, -2.0))


def test_the_state_of_an_fmu_contains_the_past(built, tmp_path):
    path = built("Past")
    folder = fmpy.extract(str(path), str(tmp_path))

    def instance():
        return Fmu(path, Path(folder))

    one = instance().start()
    one.run(["w"], 20, 0.05)
    state = one.c.getFMUstate()
    data = one.c.serializeFMUstate(state)
    first = one.run(["x", "w", "twice"], 20, 0.05, at=1.0)
    one.c.setFMUstate(state)
    np.testing.assert_array_equal(one.run(["x", "w", "twice"], 20, 0.05, at=1.0), first)
    other = instance().start()
    other.c.setFMUstate(other.c.deSerializeFMUstate(data))
    np.testing.assert_array_equal(other.run(["x", "w", "twice"], 20, 0.05, at=1.0), first)
    one.c.reset()
    one.start().run(["w"], 20, 0.05)
    np.testing.assert_array_equal(one.run(["x", "w", "twice"], 20, 0.05, at=1.0), first)


def test_a_delay_must_be_positive(built):
    with pytest.raises(SimulationError, match=r"delay\(\) by 0 s; the delay must be positive"):
        load_fmu(built("Backwards")).simulate(Task(np.linspace(0, 1, 3), {}, ("y",)), {})


def test_derivatives_follow_the_past_its_jumps_and_the_delays_themselves(built):
    t = np.linspace(0, 3, 59)  # away from the delays, where derivatives are one-sided
    for name, values, inputs in (
        ("Past", {"T": 0.7, "k": 1.0, "x": 1.0}, {}),
        ("Jumps", {"T": 0.31, "h": 1.0}, {"u": np.sin(t)}),
    ):
        model = load_fmu(built(name))
        outputs = {"Past": ("x", "w", "twice"), "Jumps": ("x", "y", "z", "v")}[name]
        task = Task(t, inputs, outputs, interpolation="linear", tolerance=1e-9)
        assert model.differentiates(list(values))
        got = model.simulate(replace(task, along=tuple({n: 1.0} for n in values)), values)
        assert np.array_equal(got[: len(outputs)], model.simulate(task, values))
        for number, (parameter, value) in enumerate(values.items()):
            ends = [model.simulate(task, {**values, parameter: value + sign * 1e-5}) for sign in (1, -1)]
            expected = (ends[0] - ends[1]) / 2e-5
            exact = got[len(outputs) * (number + 1) : len(outputs) * (number + 2)]
            np.testing.assert_allclose(
                exact, expected, atol=2e-4 * (1 + np.abs(expected).max()), err_msg=parameter
            )


def test_derivatives_go_back_with_the_state(built, tmp_path):
    path = built("Past")
    one = Fmu(path, Path(fmpy.extract(str(path), str(tmp_path))))
    choose(one, ["T", "k"])
    one.start()

    def go_on(first):
        steps = []
        for k in range(first, 40):
            one.c.doStep(k * 0.05, 0.05)
            steps.append(sensitivities(one, ["x", "w"], 2))
        return steps

    for k in range(25):
        one.c.doStep(k * 0.05, 0.05)
    state = one.c.getFMUstate()
    there = go_on(25)
    one.c.setFMUstate(state)
    np.testing.assert_array_equal(go_on(25), there)
    assert np.any(np.array(there)[:, 1, 0] != 0)
