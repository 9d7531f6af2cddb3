"""A counted signal that is the same in every repeat: no better than its counts, and no worse."""

import numpy as np
import pytest

from fmuid import ParameterSpec, Problem, Task, identify, measured_case

TRUTH = {"K_m": 0.12, "J": 0.02}


def drive(time, inputs, p):
    """A motor with its load: the speed follows the torque with a time constant J / d."""
    d = 0.05
    tau = p["K_m"] * (2.0 + np.sin(3.0 * time))
    pole, amplitude = d / p["J"], p["K_m"] / p["J"]
    constant = 2.0 * amplitude / pole * (1.0 - np.exp(-pole * time))
    sine = (
        amplitude / (pole**2 + 9.0) * (pole * np.sin(3 * time) - 3 * np.cos(3 * time) + 3 * np.exp(-pole * time))
    )
    return {"w": constant + sine, "tau": tau}


@pytest.mark.parametrize("repeats", [2, 4, 5])
def test_a_speed_counted_alike_in_every_run_is_weighed_by_its_counts(analytic, repeats):
    time = np.linspace(0.0, 4.0, 401)
    exact = drive(time, {}, TRUTH)
    rng = np.random.default_rng(0)
    w = np.tile(np.round(exact["w"] / 0.01) * 0.01, (repeats, 1))
    tau = exact["tau"] + 1e-3 * rng.standard_normal((repeats, time.size))
    case = measured_case(
        "run", analytic(drive, TRUTH, ("w", "tau")), Task(time, {}, ("w", "tau")), {"w": w, "tau": tau}
    )
    noise = {c.signal: c.noise for c in case.channels}
    assert noise["w"].sigma == pytest.approx(0.01 / np.sqrt(12), rel=1e-6)
    assert noise["tau"].sigma == pytest.approx(1e-3, rel=0.1)
    result = identify(Problem([case], [ParameterSpec("K_m", 0.1, 0.01, 1.0), ParameterSpec("J", 0.03, 1e-3, 1.0)]))
    for estimate in result.stages[0].estimates:
        error = abs(estimate.value - TRUTH[estimate.name])
        assert error < 4.0 * estimate.standard_error
        assert error < 2e-3 * TRUTH[estimate.name]
