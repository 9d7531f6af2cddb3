"""The integrator in the FMU holds its tolerance, has its order, and does not depend on how it is stepped."""

from __future__ import annotations

import handmade
import numpy as np
import pytest
from scipy.integrate import solve_ivp


def reference(model, h, inputs, tol=1e-11):
    """States and outputs at the communication points by SciPy's Radau on the model's own equations."""
    f = model.functions
    p = np.array([v.start for v in model.variables if v.location.vector == "p"])
    d = np.array(f["dependent"](p)).ravel()
    empty = np.zeros(0)
    steps = len(inputs)

    def call(name, t, x, u):
        given = u if model.n_u else empty
        return f[name](t, x, given, p if len(p) else empty, d if len(d) else empty, empty, empty, empty, empty)

    x = np.array(f["start"](p, d)[0]).ravel()
    rows = [x]
    begin = 0
    for end in [k for k in range(1, steps) if inputs[k] != inputs[k - 1]] + [steps]:
        u = inputs[begin]
        s = solve_ivp(
            lambda t, x, u=u: np.array(call("derivatives", t, x, u)).ravel(),
            (begin * h, end * h),
            x,
            "Radau",
            t_eval=np.arange(begin + 1, end + 1) * h,
            rtol=tol,
            atol=tol * 1e-4,
            jac=lambda t, x, u=u: np.array(call("jacobian", t, x, u)[1]),
        )
        rows.extend(s.y.T)
        x, begin = s.y[:, -1], end
    return np.array(rows)


CASES = {
    "pendulum": (["phi", "w"], 0.02, np.where(np.arange(60) // 20 % 2, 0.5, -0.5)),
    "train": (["phi_R", "w", "phi_S", "w_S", "b"], 5e-4, np.where(np.arange(6) // 3 % 2, -0.8, 0.8)),
    "robertson": (["a", "b", "c"], 10.0, np.zeros(40)),
    "van_der_pol": (["x", "v"], 20.0, np.zeros(30)),
}


@pytest.mark.parametrize(
    "name", ["van_der_pol", *(pytest.param(n, marks=pytest.mark.slow) for n in ("train", "pendulum", "robertson"))]
)
def test_global_error_is_of_the_order_of_the_tolerance(fmu, name):
    states, h, inputs = CASES[name]
    expected = reference(getattr(handmade, name)(), h, inputs)
    size = np.abs(expected).max(axis=0)
    drive = {"pendulum": "tau", "train": "i_cmd"}.get(name)
    for tolerance in (1e-4, 1e-6, 1e-7):
        one = fmu(name).start(tolerance, **({drive: inputs[0]} if drive else {}))
        got = one.run(states, len(inputs), h, inputs={drive: inputs} if drive else None)
        error = np.abs(got - expected) / size
        assert error.max() < 5 * tolerance, tolerance


TOLERANCES = 10.0 ** -np.arange(3, 12)


@pytest.mark.parametrize("rate", [1e2, 1e6, 1e9])
def test_a_state_pulled_to_a_slow_motion_keeps_its_tolerance(fmu, rate):
    """However stiff, also between the integrator's steps."""
    t = np.arange(101) * 0.1
    exact = np.cos(t) - np.exp(-rate * t)
    for tolerance in TOLERANCES:
        got = fmu("pulled").start(tolerance, rate=rate).run(["x"], 100, 0.1)[:, 0]
        assert np.abs(got - exact).max() < tolerance


def test_undamped_oscillation_error_is_proportional_to_the_tolerance(fmu):
    t = np.arange(161) * 1e-4
    errors = []
    for tolerance in TOLERANCES:
        got = fmu("oscillator").start(tolerance).run(["x"], 160, 1e-4)[:, 0]
        errors.append(np.abs(got - np.cos(1e4 * t)).max())
    slope, _ = np.polyfit(np.log(TOLERANCES), np.log(errors), 1)
    assert slope == pytest.approx(1.0, abs=0.15)
    assert np.all(errors < 10 * TOLERANCES)


def test_order_five(fmu):
    """One step a communication step (a changed input restarts, the tolerance never acts): error ~ h^5."""
    exact = fmu("pendulum").start(1e-12).run(["phi"], 1, 1.0)[-1, 0]
    errors = []
    for steps in (10, 20, 40):
        one = fmu("pendulum").start(0.1)
        got = one.run(["phi"], steps, 1.0 / steps, inputs={"tau": 1e-200 * np.arange(1, steps + 1)})
        errors.append(abs(got[-1, 0] - exact))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx(5.0, abs=0.6)


@pytest.mark.parametrize("slope", [0.0, 2.0])
def test_order_five_with_dependence_on_time(fmu, slope):
    """df/dt and the slope of a linear input are in the method: without them the order falls to two."""

    def end(steps, tolerance):
        one = fmu("forced").start(tolerance)
        for k in range(steps):
            one.set(u=slope * k / steps + 1e-10 * (-1) ** k)  # a change that restarts, far below the errors
            one.c.setRealInputDerivatives([one.vr["u"]], [1], [slope])
            one.c.doStep(k / steps, 1 / steps)
        return one.get("x")

    exact = end(1, 1e-13)
    errors = np.array([abs(end(steps, 0.1) - exact) for steps in (8, 16, 32)])
    assert np.all(np.log2(errors[:-1] / errors[1:]) > 4.4)


def test_dense_output_between_steps(fmu):
    """A fine grid and a coarse one see the same solution: lookahead does not leak."""
    fine = fmu("pendulum").start(1e-7).run(["phi", "w"], 3000, 1e-3)
    coarse = fmu("pendulum").start(1e-7).run(["phi", "w"], 30, 0.1)
    assert np.abs(fine[::100] - coarse).max() < 1e-6


def test_input_that_changes_every_step(fmu):
    t = np.arange(60) * 0.01
    u = np.sin(5 * t)
    model = handmade.pendulum()
    expected = reference(model, 0.01, u, 1e-10)
    got = fmu("pendulum").start(1e-6, tau=u[0]).run(["phi", "w"], 60, 0.01, inputs={"tau": u})
    assert np.abs(got - expected).max() < 1e-5


def test_input_slope_makes_a_piecewise_linear_input(fmu):
    """With input derivatives the error of a sampled sine falls from the first to the second order of the sampling."""
    h, steps = 0.02, 100
    u = np.sin(3 * np.arange(steps + 1) * h)
    held = fmu("pendulum").start(1e-9)
    ramped = fmu("pendulum").start(1e-9)
    fine = fmu("pendulum").start(1e-9)
    fine_u = np.sin(3 * np.arange(steps * 200) * h / 200 + 3 * h / 400)
    truth = fine.run(["phi"], steps * 200, h / 200, inputs={"tau": fine_u})[-1, 0]
    for k in range(steps):
        held.set(tau=u[k])
        held.c.doStep(k * h, h)
        ramped.set(tau=u[k])
        ramped.c.setRealInputDerivatives([ramped.vr["tau"]], [1], [(u[k + 1] - u[k]) / h])
        ramped.c.doStep(k * h, h)
        assert ramped.get("through") == pytest.approx(2 * u[k + 1], abs=1e-12)  # outputs see the ramp's end
    assert abs(held.get("phi") - truth) > 100 * abs(ramped.get("phi") - truth)
    assert ramped.get("phi") == pytest.approx(truth, abs=1e-4)


def test_reset_repeats_bit_by_bit(fmu):
    u = np.where(np.arange(60) // 7 % 2, 0.8, -0.8)
    one = fmu("train").start(1e-6)
    first = one.run(["tau_sensor", "b"], 60, 1e-3, inputs={"i_cmd": u})
    one.c.reset()
    second = one.start(1e-6).run(["tau_sensor", "b"], 60, 1e-3, inputs={"i_cmd": u})
    other = fmu("train").start(1e-6).run(["tau_sensor", "b"], 60, 1e-3, inputs={"i_cmd": u})
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, other)


def test_algebraic_loop(fmu):
    """x' = -y, y^3 + y = x: dx/dt by the loop's solution; exact: t = y0' ... from (3 y^2 + 1) y' = -y."""
    got = fmu("algebraic_loop").start(1e-9).run(["x", "out"], 10, 0.1)
    y = got[:, 1] / 2
    np.testing.assert_allclose(y**3 + y, got[:, 0], rtol=1e-12)
    invariant = 1.5 * y**2 + np.log(y) + np.arange(11) * 0.1  # separated variables
    np.testing.assert_allclose(invariant, invariant[0], atol=1e-7)


def test_a_loop_that_overflows_is_damped_and_a_failure_leaves_no_trace(fmu):
    one = fmu("diode").start()
    for u in (1e-6, 1.0, -1.0, 1e3, -1e3, 1e6, 0.0):
        one.set(u=u)
        y = one.get("out")
        assert 1e-9 * np.expm1(y / 0.025) + y / 1e3 == pytest.approx(u, rel=1e-9, abs=1e-15)


def test_a_loop_that_is_nearly_singular(fmu):
    y = fmu("cubic").start(1e-7).run(["out"], 20, 0.1)[:, 0]
    np.testing.assert_allclose(y**3 + 1e-6 * y, np.arange(21) * 0.1 - 1, atol=1e-14)
    z = fmu("cubic").start(1e-7).run(["z"], 20, 0.1)[:, 0]
    assert z[-1] == pytest.approx(0.0, abs=1e-5)  # odd about t = 1
    assert z[10] == pytest.approx(-0.75, abs=1e-5)
