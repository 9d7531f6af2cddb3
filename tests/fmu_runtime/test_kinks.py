"""Kinks of an event-free right-hand side: found in the equations, crossed without loss of accuracy."""

from __future__ import annotations

import casadi as ca
import numpy as np

from fmu_build.switches import switching_functions


def test_switching_functions_are_the_arguments_that_switch():
    arguments = [ca.SX.sym(name, n) for name, n in (("t", 1), ("x", 2), ("u", 1))]
    t, x, u = arguments
    smooth = ca.sin(x[0]) + u
    kinked = ca.fabs(x[1]) + ca.fmax(x[0], 2 * u) + ca.if_else(t < 3, x[0] ** 2, x[1])
    find = lambda *f: switching_functions(ca.Function("f", arguments, [ca.vertcat(*f)]))  # noqa: E731
    assert find(smooth).numel_out(0) == 0
    values = np.array(find(smooth, kinked)(5.0, [0.5, -7.0], 1.0)).ravel()
    assert sorted(np.abs(values)) == [1.5, 2.0, 7.0]  # x0 - 2 u, t - 3, x1


def test_impact_on_a_stop(fmu):
    """Free flight onto a stiff one-sided spring: the exact state when it leaves has the speed that it came with."""
    for tolerance in (1e-5, 1e-8):
        one = fmu("one_sided_spring").start(tolerance)
        x, v = one.run(["x", "v"], 40, 0.05).T
        free, w = 1.0, np.sqrt(1e6)  # reaches the stop at t = 1 with speed 1
        contact = np.pi / w
        expected = np.where(
            np.arange(41) * 0.05 <= free, 1 - np.arange(41) * 0.05, np.arange(41) * 0.05 - free - contact
        )
        assert np.abs(x - expected).max() < 20 * tolerance
        assert np.abs(v[-1] - 1.0) < 20 * tolerance
