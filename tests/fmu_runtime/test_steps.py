"""Communication steps of any size and place: tiny, huge, uneven, on events, past the end."""

from __future__ import annotations

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException


@pytest.mark.parametrize(
    ("t", "h", "message"),
    [
        (0.0, -0.1, "a step from t = 0 of size -0.1 is not possible"),
        (0.0, float("nan"), "of size nan is not possible"),
        (0.0, float("inf"), "of size inf is not possible"),
        (float("nan"), 0.1, "a step from t = nan"),
        (0.5, 0.1, "starts at t = 0.5 but the model is at t = 0"),
        (0.0, 2.1, "the step to t = 2.1 goes past the stop time 2"),
    ],
)
def test_impossible_steps_are_refused(fmu, t, h, message):
    one = fmu("pendulum").start(stop=2.0)
    with pytest.raises(FMICallException):
        one.c.doStep(t, h)
    assert message in one.messages[-1]


@pytest.mark.parametrize("h", [0.0, 5e-324, 1e-300, 1e-18])
def test_a_step_of_next_to_no_size_changes_nothing(fmu, h):
    one = fmu("pendulum").start()
    one.c.doStep(0.0, h)
    assert one.get("phi") == pytest.approx(1.0, abs=1e-15)
    one.c.doStep(h, 0.5)
    other = fmu("pendulum").start()
    other.c.doStep(0.0, 0.5)
    assert one.get("phi") == pytest.approx(other.get("phi"), abs=1e-6)


def test_the_last_step_may_be_off_by_rounding(fmu):
    one, t = fmu("pendulum").start(stop=0.3), 0.0
    for _ in range(3):
        one.c.doStep(t, 0.1)
        t += 0.1
    assert t > 0.3


def test_steps_over_nine_decades(fmu):
    rng, one, t = np.random.default_rng(0), fmu("pendulum").start(1e-9), 0.0
    for h in 10 ** rng.uniform(-9, -1, 1000):
        one.c.doStep(t, h)
        t += h
    whole = fmu("pendulum").start(1e-12)
    whole.c.doStep(0.0, t)
    assert one.get("phi") == pytest.approx(whole.get("phi"), abs=1e-8)


def test_a_start_far_from_zero(fmu):
    late, early = fmu("pendulum").start(1e-9, at=1e6), fmu("pendulum").start(1e-9)
    for k in range(50):
        late.c.doStep(1e6 + 0.02 * k, 0.02)
    early.c.doStep(0.0, 1.0)
    assert late.get("phi") == pytest.approx(early.get("phi"), abs=1e-8)


def test_steps_that_land_on_events(fmu):
    """The ball hits the ground at the end of a step, and a sample is due at the end of every step."""
    first = np.sqrt(2 / 9.81)
    one = fmu("bouncing_ball").start(1e-9)
    for k in range(1000):
        one.c.doStep(k * first / 500, first / 500)
    assert one.get("bounces") == 1
    assert one.get("h") == pytest.approx(0.6, abs=1e-8)  # 0.8 g f^2 - g f^2/2 with g f^2 = 2
    counter, t = fmu("sampled_counter").start(1e-9), 0.0
    for _ in range(900):
        counter.c.doStep(t, 0.001)
        t += 0.001
    assert (counter.get("count"), counter.get("held")) == (9, pytest.approx(0.9))


def test_inputs_that_jump_at_every_step(fmu):
    u = np.random.default_rng(1).choice([-5.0, 5.0], 200)
    names = ["tau_sensor", "w_motor"]
    exact = fmu("train").start(1e-12).run(names, 200, 1e-3, inputs={"i_cmd": u})
    for tolerance in (1e-4, 1e-6, 1e-8):
        got = fmu("train").start(tolerance).run(names, 200, 1e-3, inputs={"i_cmd": u})
        assert np.all(np.abs(got - exact).max(axis=0) < 3 * tolerance * np.abs(exact).max(axis=0))
