"""spatialDistribution(): what leaves a pipe, in co-simulation and model exchange, against solutions by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import fmpy
import numpy as np
import pytest

from fmu_build import build
from fmuid import load_fmu
from fmuid.simulation.simulator import Task
from tests.fmu_runtime.conftest import Fmu

TRANSPORTS = Path(__file__).parent / "models" / "Transports.mo"
KINDS = ("CoSimulation", "ModelExchange")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("transports")
    return lambda name, fmi="2": build(TRANSPORTS, f"Transports.{name}", folder / fmi, fmi)


def run(path, kind, stop, outputs, tolerance=1e-8):
    result = fmpy.simulate_fmu(
        str(path), fmi_type=kind, stop_time=stop, output_interval=stop / 100, relative_tolerance=tolerance,
        output=outputs,
    )  # fmt: skip
    return result["time"], *(result[name] for name in outputs)


@pytest.mark.parametrize("fmi", ["2", "3"])
@pytest.mark.parametrize("kind", KINDS)
def test_contents_and_then_what_entered_leave_with_their_jumps(built, kind, fmi):
    t, a, b = run(built("Once", fmi), kind, 2, ["a", "b"])
    away = (np.abs(t - 0.375) > 1e-6) & (np.abs(t - 0.5) > 1e-6)  # model exchange records both sides of a jump
    y = 1 - 2 * t
    contents = np.where(y < 0.25, 1 + 4 * y, 4 - (y - 0.25) / 0.75)
    np.testing.assert_array_equal(a, np.sin(3 * t))
    np.testing.assert_allclose(b[away], np.where(t < 0.5, contents, np.sin(3 * (t - 0.5)))[away], atol=1e-8)


def leaves(t, v):
    """What leaves a pipe that is empty at the start, at the end to which x = v sin(t) flows at time t."""
    s = np.linspace(0, t, 20_001)
    forward = np.cos(t) >= 0

    def last(place, rising):
        off = (v * np.sin(s) - place) * (1 if rising else -1)
        (crossings,) = np.nonzero((off[:-1] < 0) & (off[1:] >= 0))
        if len(crossings) == 0:
            return -1.0
        i = crossings[-1]
        return s[i] + (s[i + 1] - s[i]) * off[i] / (off[i] - off[i + 1])

    x = v * np.sin(t)
    rising, falling = last(x - 1 if forward else x, True), last(x if forward else x + 1, False)
    if max(rising, falling) < 0:
        return 0.0
    return rising if rising > falling else -falling  # in0 = time, in1 = -time


@pytest.mark.parametrize("kind", KINDS)
def test_what_has_not_left_when_the_flow_turns_comes_back(built, kind):
    t, a, b = run(built("ThereAndBack"), kind, 8, ["a", "b"])
    back = np.pi - np.arcsin(1 / 3)  # what was inside at the first turn has left
    events = np.array([0.5 * np.pi, 1.5 * np.pi, 2.5 * np.pi, back, back + np.pi])
    keep = np.abs(t[:, None] - events).min(axis=1) > 1e-3  # model exchange records both sides of them
    t, a, b = t[keep], a[keep], b[keep]
    forward = np.cos(t) >= 0
    np.testing.assert_array_equal(np.where(forward, a, -b), t)
    expected = [leaves(time, 1.5) for time in t]
    np.testing.assert_allclose(np.where(forward, b, a), expected, atol=2e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_contents_that_decide_their_own_speed_stay_what_they_were(built, kind):
    _, x, a, b = run(built("Ring"), kind, 5, ["x", "a", "b"])
    y = -x % 1
    assert x[-1] > 11
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(b, 1 + 2 * np.minimum(y, 1 - y), atol=1e-7)


def test_the_state_of_an_fmu_contains_what_is_in_the_pipe(built, tmp_path):
    path = built("ThereAndBack")
    folder = fmpy.extract(str(path), str(tmp_path))
    one = Fmu(path, Path(folder)).start()
    one.run(["b"], 20, 0.1)
    data = one.c.serializeFMUstate(one.c.getFMUstate())
    first = one.run(["x", "a", "b", "y"], 30, 0.1, at=2.0)
    other = Fmu(path, Path(folder)).start()
    other.c.setFMUstate(other.c.deSerializeFMUstate(data))
    np.testing.assert_array_equal(other.run(["x", "a", "b", "y"], 30, 0.1, at=2.0), first)
    one.c.reset()
    one.start().run(["b"], 20, 0.1)
    np.testing.assert_array_equal(one.run(["x", "a", "b", "y"], 30, 0.1, at=2.0), first)


@pytest.mark.parametrize(
    ("name", "values", "stop", "outputs"),
    [
        ("Once", {"v": 2.0, "h": 4.0}, 2, ("b",)),
        ("ThereAndBack", {"v": 1.5, "k": 1.0}, 7, ("a", "b", "y")),
        ("Ring", {"c": 0.5, "top": 2.0, "v": 1.0}, 3, ("x", "v", "b")),
    ],
)
def test_derivatives_follow_what_moves_and_when_it_leaves(built, name, values, stop, outputs):
    t = np.linspace(0, stop, 60)
    model = load_fmu(built(name))
    task = Task(t, {}, outputs, tolerance=1e-9)
    assert model.differentiates(list(values))
    got = model.simulate(replace(task, along=tuple({n: 1.0} for n in values)), values)
    for number, (parameter, value) in enumerate(values.items()):
        low, high = (model.simulate(task, {**values, parameter: value + sign * 1e-5}) for sign in (-1, 1))
        expected = (high - low) / 2e-5
        exact = got[len(outputs) * (number + 1) : len(outputs) * (number + 2)]
        smooth = np.abs(expected) < 1e3  # no jump between the two
        np.testing.assert_allclose(
            exact[smooth], expected[smooth], atol=2e-4 * (1 + np.abs(expected[smooth]).max())
        )
