"""Forward sensitivities of whole runs against central differences of accurate runs."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest


def choose(one, names):
    vr = (ctypes.c_uint * len(names))(*[one.vr[n] for n in names])
    return one.c.dll.fmuidSetSensitivityParameters(
        ctypes.c_void_p(one.c.component), vr, ctypes.c_size_t(len(names))
    )


def sensitivities(one, names, n):
    vr = (ctypes.c_uint * len(names))(*[one.vr[v] for v in names])
    values = (ctypes.c_double * (len(names) * n))()
    status = one.c.dll.fmuidGetSensitivities(
        ctypes.c_void_p(one.c.component), vr, ctypes.c_size_t(len(names)), values
    )
    assert status == 0, one.messages
    return np.array(values).reshape(len(names), n)


CASES = {
    "pendulum": (["phi", "energy", "der(w)", "through"], ["phi", "m", "l", "damping"], "tau", 0.05, 40),
    "train": (["tau_sensor", "w_motor", "b"], ["K_m", "J_R", "J_S", "d_S", "tau_bf"], "i_cmd", 5e-4, 40),
    "algebraic_loop": (["x", "out"], ["x", "a"], "u", 0.1, 10),
    "dependent_start": (["x", "out", "y", "c"], ["b"], None, 0.1, 20),
}


@pytest.mark.parametrize("name", CASES)
def test_sensitivities_of_a_run(fmu, name):
    outputs, parameters, drive, h, steps = CASES[name]
    u = 0.5 * np.where(np.arange(steps) // 6 % 2, -1.0, 1.0)
    one = fmu(name)
    assert choose(one, parameters) == 0
    one.start(1e-7)
    got = [sensitivities(one, outputs, len(parameters))]
    for k in range(steps):
        one.set(**({drive: u[k]} if drive else {}))
        one.c.doStep(k * h, h)
        got.append(sensitivities(one, outputs, len(parameters)))
    exact = np.empty_like(got)
    values = np.empty(len(parameters))
    for j, parameter in enumerate(parameters):
        value = one.get(parameter) if parameter not in ("phi", "x") else {"phi": 1.0, "x": 2.0}[parameter]
        values[j] = value
        eps = 1e-5 * value
        ends = [
            fmu(name)
            .start(1e-11, **{parameter: value + s * eps})
            .run(outputs, steps, h, inputs={drive: u} if drive else None)
            for s in (1, -1)
        ]
        exact[:, :, j] = (ends[0] - ends[1]) / (2 * eps)
    # changes for equal relative changes of the parameters; a difference has the noise of the largest in it
    got, exact = np.array(got) * values, exact * values
    size = np.abs(exact).max(axis=(0, 2))
    error = np.abs(got - exact).max(axis=(0, 2))
    # the worst by far is a stiff bristle as it turns; its mean error is small
    assert np.all(error <= np.where(np.array(outputs) == "b", 5e-3, 1e-3) * size)


def test_sensitivities_do_not_change_the_run(fmu):
    plain = fmu("train").start(1e-6, i_cmd=0.5).run(["tau_sensor"], 20, 1e-3)
    one = fmu("train")
    choose(one, ["d_S"])
    np.testing.assert_array_equal(one.start(1e-6, i_cmd=0.5).run(["tau_sensor"], 20, 1e-3), plain)


def test_what_has_no_sensitivity_is_refused(fmu):
    one = fmu("pendulum")
    assert choose(one, ["energy"]) == 3
    assert "no parameter" in one.messages[-1]
    ball = fmu("bouncing_ball")
    assert choose(ball, ["g"]) == 3
    assert "events" in ball.messages[-1]
    late = fmu("pendulum").start()
    assert choose(late, ["m"]) == 3
    assert "before a co-simulation starts" in late.messages[-1]


def test_parameters_that_move_together(fmu):
    # one direction of two parameters is the weighted sum of their own
    names, weights = ["J_R", "d_S", "tau_bf"], [[0.0, 2.0, -3.0], [1.0, 0.0, 0.0]]
    single, joint = fmu("train"), fmu("train")
    assert choose(single, names) == 0
    vr = (ctypes.c_uint * 3)(*[joint.vr[n] for n in names])
    flat = (ctypes.c_double * 6)(*np.ravel(weights))
    n = ctypes.c_size_t
    c = ctypes.c_void_p(joint.c.component)
    assert joint.c.dll.fmuidSetSensitivityDirections(c, vr, n(3), flat, n(2)) == 0
    for one in (single, joint):
        one.start(1e-7, i_cmd=0.5).run(["tau_sensor"], 20, 1e-3)
    each = sensitivities(single, ["tau_sensor", "b"], 3)
    both = sensitivities(joint, ["tau_sensor", "b"], 2)
    assert np.any(each[0] != 0.0)
    np.testing.assert_allclose(both, each @ np.transpose(weights), rtol=1e-6, atol=1e-12)
