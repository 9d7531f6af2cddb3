"""Algebraic loops: named and refused, delayed by the communication step, or iterated."""

from __future__ import annotations

import numpy as np
import pytest
from systems import coupled

from fmuid.core.errors import FmuError, SimulationError
from fmuid.simulation.simulator import Task

TIME = np.linspace(0, 1, 101)
RING = {"a.u": "b.y", "b.u": "a.y"}
RING_TASK = Task(TIME, {}, ("a.y", "b.y"))
LAG_AND_GAIN = {"lag.u": "gain.y", "gain.u": "lag.y"}


def test_a_loop_is_named_and_refused(made):
    loop = 'algebraic loop: a.y -> b.u -> b.y -> a.u -> a.y; iterate it with loops = "iterate"'
    with pytest.raises(FmuError, match=loop):
        coupled({"a": made("Gain"), "b": made("Gain")}, RING)
    with pytest.raises(FmuError, match=r"gain.y -> lag.u -> lag.y -> gain.u -> gain.y|lag.y -> gain.u"):
        coupled({"lag": made("Lag"), "gain": made("Gain")}, LAG_AND_GAIN)
    with pytest.raises(FmuError, match=r"algebraic loop: a.y -> a.u -> a.y"):
        coupled({"a": made("Gain")}, {"a.u": "a.y"})
    coupled({"lag": made("Lag"), "gain": made("Gain")}, LAG_AND_GAIN | {"gain.u": "lag.x"})  # a state: no loop


@pytest.mark.parametrize(("ka", "kb"), [(0.5, 0.5), (3.0, -2.0), (-50.0, 7.0), (0.0, 1.0)])
def test_an_iterated_loop_is_solved_whatever_its_gain(made, ka, kb):
    """A fixed-point iteration would run away for all but the first."""
    model = coupled({"a": made("Gain"), "b": made("Gain", 3)}, RING, loops="iterate", loop_tolerance=1e-9)
    y = model.simulate(RING_TASK, {"a.k": ka, "b.k": kb, "a.b": 1.0, "b.b": 2.1})
    a = (1 + 2.1 * ka) / (1 - ka * kb)
    np.testing.assert_allclose(y, np.outer([a, kb * a + 2.1], np.ones(101)), rtol=1e-7, atol=1e-9)


def test_loops_that_cross_are_solved_together(made):
    """Two loops through one sum: every unknown at once."""
    gains = {name: made("Gain") for name in "abc"}
    model = coupled(
        gains, {"a.u": "b.y", "b.u": "c.y", "c.u": ("a.y", -3.0)}, loops="iterate", loop_tolerance=1e-9
    )
    y = model.simulate(Task(TIME, {}, ("a.y",)), {"a.b": 1.0, "b.k": 2.0, "c.b": 0.5})
    np.testing.assert_allclose(y, (1 + 2 * 0.5) / (1 + 6), rtol=1e-8)  # a = 1 + 2 (0.5 - 3 a)


def test_a_loop_without_a_solution_fails(made):
    model = coupled({"a": made("Gain"), "b": made("Gain")}, RING, loops="iterate", loop_iterations=20)
    message = (
        "system: the loop a.y -> b.u -> b.y -> a.u -> a.y is not solved after 20 iterations in initialisation"
    )
    with pytest.raises(SimulationError, match=message):
        model.simulate(RING_TASK, {"a.k": 2.0, "b.k": 0.5, "a.b": 1.0})
    assert model.simulate(RING_TASK, {"a.b": 1.0, "b.k": 0.5})[0, 0] == pytest.approx(2.0)


@pytest.mark.parametrize(("extrapolation", "order"), [("constant", 1), ("linear", 2)])
@pytest.mark.parametrize("algorithm", ["jacobi", "gauss_seidel"])
def test_an_iterated_loop_with_states_converges(made, algorithm, extrapolation, order):
    """T x' = u - x with u = -4 (x + x(t)/2 u): the held input is the one at the end of the step."""
    gain, feedthrough, errors = 4.0, 0.5, []
    fall = np.exp(-(1 + gain / (1 + gain * feedthrough)) / 0.1 * TIME)
    parameters = {"lag.d": feedthrough, "gain.k": -gain}
    for step in (5e-3, 2.5e-3, 1.25e-3):
        model = coupled(
            {"lag": made("Lag"), "gain": made("Gain")},
            LAG_AND_GAIN,
            step=step, algorithm=algorithm, extrapolation=extrapolation, loops="iterate",
        )  # fmt: skip
        x, u = model.simulate(Task(TIME, {}, ("lag.x", "gain.y"), {}, "hold", 1e-9), parameters)
        errors.append(np.abs(x - fall).max())
        np.testing.assert_allclose(u, -gain * x / (1 + gain * feedthrough), atol=1e-5)  # in and out agree
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), order, atol=0.1)


def test_a_delayed_loop_lags_one_step_and_is_refused_where_it_does_not_settle(made):
    parts = {"a": made("Gain"), "b": made("Gain")}
    model = coupled(parts, RING, loops="delay", loop_tolerance=1e-9)
    y = model.simulate(RING_TASK, {"a.k": 0.5, "b.k": 0.5, "a.b": 1.0})
    np.testing.assert_allclose(y[0], 4 / 3, rtol=1e-8)
    with pytest.raises(SimulationError, match=r"is not solved after 50 iterations in initialisation"):
        model.simulate(RING_TASK, {"a.k": 3.0, "b.k": -2.5, "a.b": 1.0})


def test_what_cannot_go_back_is_not_iterated(made, python_pi):
    parts = {"pi": python_pi, "gain": made("Gain")}
    with pytest.raises(FmuError, match=r"cannot be iterated: component 'pi' cannot go back to an earlier state"):
        coupled(parts, {"pi.w": "gain.y", "gain.u": "pi.i"}, loops="iterate")
