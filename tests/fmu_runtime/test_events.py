"""State events, time events, reinit, termination: co-simulation and model exchange."""

from __future__ import annotations

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException


def ball(t, e=0.8, g=9.81):
    """Height of a ball dropped from 1 m that bounces with restitution e."""
    first = np.sqrt(2 / g)
    if t < first:
        return 1 - g * t**2 / 2
    t, v = t - first, e * g * first
    while t > 2 * v / g:
        t, v = t - 2 * v / g, e * v
    return v * t - g * t**2 / 2


def test_bouncing_ball_in_co_simulation(fmu):
    one = fmu("bouncing_ball").start(1e-8)
    got = one.run(["h"], 150, 0.02)[:, 0]
    np.testing.assert_allclose(got, [ball(0.02 * k) for k in range(151)], atol=1e-8)
    assert one.get("bounces") == 6


def test_bouncing_ball_in_model_exchange(built):
    result = fmpy.simulate_fmu(
        str(built("bouncing_ball")[0]),
        fmi_type="ModelExchange",
        stop_time=3.0,
        output_interval=0.02,
        relative_tolerance=1e-8,
        output=["h", "bounces"],
    )
    np.testing.assert_allclose(result["h"], [ball(t) for t in result["time"]], atol=1e-6)
    assert result["bounces"][-1] == 6


@pytest.mark.parametrize("h", [0.05, 0.03, 0.3])
def test_time_events_and_termination(fmu, h):
    one = fmu("sampled_counter").start(1e-8)
    for k in range(100):
        t = (k + 1) * h
        if t > 0.95 - 1e-9:
            break
        one.c.doStep(k * h, h)
        assert one.get("count") == np.floor(t / 0.1 + 1e-9)
        assert one.get("held") == pytest.approx(0.1 * np.floor(t / 0.1 + 1e-9))
    with pytest.raises(FMICallException, match="discard"):
        one.c.doStep(k * h, 2 * h)
    assert one.get("time") == pytest.approx(0.95, abs=1e-9)
    assert "the model ends the simulation" in one.messages[-1]


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("interval", [0.05, 0.25, 0.1])
def test_time_events_on_output_points_in_model_exchange(built, fmi, interval):
    """An importer whose own sum of intervals is a rounding error short of the event is at the event."""
    result = fmpy.simulate_fmu(
        str(built("clock", fmi)[0]),
        fmi_type="ModelExchange",
        stop_time=1.0,
        output_interval=interval,
        output=["count", "held"],
    )
    assert result["count"][-1] == 10
    assert result["held"][-1] == pytest.approx(0.95)


@pytest.mark.parametrize("h", [0.002, 0.01, 0.018])
def test_long_steps_do_not_run_over_events_that_communication_points_show(fmu, h):
    x = fmu("pulses").start(1e-6).run(["x"], int(2 / h), h)[:, 0]
    t = np.arange(int(2 / h) + 1) * h
    whole, phase = np.divmod(50 * t, 2 * np.pi)
    width = np.pi - 2 * np.arcsin(0.9)
    exact = (whole * width + np.clip(phase - np.arcsin(0.9), 0, width)) / 50
    np.testing.assert_allclose(x, exact, atol=1e-9)


def test_relation_of_an_input(fmu):
    one = fmu("relay").start()
    assert one.get("direction") == -1
    one.set(u=1.0)
    assert one.get("direction") == 1
    one.c.doStep(0.0, 0.5)
    one.set(u=0.0)
    one.c.doStep(0.5, 0.2)
    assert one.get("x") == pytest.approx(0.3, abs=1e-12)


def test_stick_slip_against_its_closed_form(fmu):
    """Spring-dragged mass: break-away at f_static, then a harmonic motion around the sliding force."""
    one = fmu("stick_slip").start(1e-9)
    t = np.arange(401) * 0.005
    s, v, spring, mode = one.run(["s", "v", "spring", "mode"], 400, 0.005).T
    m, c, v0, f_slide, f_static = 1.0, 100.0, 0.1, 1.0, 1.5
    w = np.sqrt(c / m)
    start = f_static / (c * v0)
    # relative to the drag, v - v0 turns around: spring force F = f_slide + A cos + B sin
    tau = t - start
    force = f_slide + (f_static - f_slide) * np.cos(w * tau) + c * v0 / w * np.sin(w * tau)
    stop = start + (2 * np.pi - 2 * np.arctan2(f_static - f_slide, m * w * v0)) / w
    slides = (t > start) & (t < stop)
    stuck = (t < start) | ((t > stop) & (t < stop + 0.05))
    np.testing.assert_allclose(spring[slides], force[slides], atol=1e-7)
    assert slides.any()
    assert np.all(mode[slides] == 1)
    assert np.all(mode[stuck] == 0)
    assert np.all(v[stuck] == 0)
    assert np.ptp(s[(t > stop) & (t < stop + 0.05)]) == 0  # stuck is stuck: no creep
