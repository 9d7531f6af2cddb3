"""Derivatives of runs of FMUs with laws: the contained FMU gives those by its states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmu_build.instrument import Added, State
from fmuid.core.errors import SimulationError
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_with_laws import CoefficientLaw, StateLaw, write_fmu_with_laws
from fmuid.simulation.simulator import Task

TIME = np.linspace(0.0, 0.24, 49)
LAWS = [
    StateLaw("v", "v.drag*v*abs(v)", {"v.drag": 0.0}),
    StateLaw("v", "v.slow*z", {"v.slow": 0.0}, (State("z", "(v - z)/v.time", "0.5*v.drag*v"),)),
    CoefficientLaw("c", "p*(1 + c.grows*time)", {"c.grows": 0.0}),
]
ADDED = [Added("v.drag", 0.0), Added("v.slow", 0.0), Added("v.time", 0.05), Added("c.grows", 0.0)]
VALUES = {"c": 400.0, "d": 2.0, "gain": 1.5, "x": 0.1, "v.drag": 0.8, "v.slow": 5.0, "v.time": 0.05}


@pytest.fixture(params=[2, 3])
def fmu(request, build, tmp_path):
    declared = Fmu(build(request.param, ("ModelExchange",), ("NOISE=1e-10",)), "model exchange")
    write_fmu_with_laws(declared, LAWS, ADDED, tmp_path / "Laws.fmu")
    return Fmu(tmp_path / "Laws.fmu")


def test_runs_are_differentiated(fmu):
    """By parameters of the FMU and of laws, one of which has a state, by a start value, and along a mixture."""
    assert fmu.differentiates(VALUES)
    along = (*({name: 1.0} for name in VALUES), {"c": 100.0, "v.slow": -2.0})
    task = Task(TIME, {}, ("x", "v", "y"), {"level": -1.0}, tolerance=1e-7, along=along)
    run = fmu.simulate(task, VALUES)
    np.testing.assert_array_equal(run[:3], fmu.simulate(replace(task, along=()), VALUES))
    exact = replace(task, along=(), tolerance=1e-10)
    for k, direction in enumerate(along):
        size = 1e-4 * min(abs(VALUES[n] / w) for n, w in direction.items())
        ends = [
            fmu.simulate(exact, VALUES | {n: VALUES[n] + sign * size * w for n, w in direction.items()})
            for sign in (1, -1)
        ]
        expected = (ends[0] - ends[1]) / (2 * size)
        slopes = run[3 * (k + 1) : 3 * (k + 2)]
        for row in range(3):
            tolerance = 1e-4 * np.abs(expected[row]).max()
            np.testing.assert_allclose(slopes[row], expected[row], atol=tolerance, err_msg=str(direction))


@pytest.mark.parametrize(
    ("time", "values", "message"),
    [
        (np.linspace(0.0, 0.5, 51), VALUES, "not given, or there is an event at t = 0.25 s"),
        (TIME, VALUES | {"c.grows": 0.1}, "no derivatives while a parameter varies"),
    ],
)
def test_a_run_that_is_not_differentiated_fails(fmu, time, values, message):
    """Refits then compare runs; the same FMU still simulates."""
    task = Task(time, {}, ("x",), {"level": -1.0}, along=({"c": 1.0},))
    with pytest.raises(SimulationError, match=message):
        fmu.simulate(task, values)
    assert np.isfinite(fmu.simulate(replace(task, along=()), values)).all()
