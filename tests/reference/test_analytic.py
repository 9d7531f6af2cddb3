"""FMUs of test models, in co-simulation and model exchange, against analytic solutions and SciPy."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from fmu_build import build
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task
from tests.conftest import FMUS

MODELS = Path(__file__).parents[1] / "fmu_build" / "models"
BOTH = ["co-simulation", "model exchange"]
STICK_SLIP = """
model DraggedMass "Mass that a spring drags over Coulomb friction with the modes of BearingFriction"
  parameter Real c = 100 "Stiffness of the spring";
  parameter Real v0 = 0.1 "Speed of its other end";
  Hybrid.Coulomb friction "Mass and friction";
  output Real v = friction.v "Speed";
  output Real s = friction.s "Position";
equation
  friction.F = c*(v0*time - friction.s);
end DraggedMass;
"""


@cache
def built(package: str, name: str) -> Path:
    return build(MODELS / f"{package}.mo", f"{package}.{name}", FMUS / "tests")


@pytest.fixture(params=BOTH)
def simulate(request):
    def run(path: Path, outputs: str, stop: float, values=None, n=200, tolerance=1e-9, **inputs: float):
        time = np.linspace(0.0, stop, n + 1)
        driven = {name: np.full(n + 1, value) for name, value in inputs.items()}
        task = Task(time, driven, tuple(outputs.split()), tolerance=tolerance)
        return time, *load_fmu(path, request.param).simulate(task, values or {})

    return run


def test_oscillator(simulate):
    t, y = simulate(built("Trains", "Oscillator"), "y", 10.0)
    assert y == pytest.approx(0.1 * np.cos(10 * t), abs=2e-7)


def test_two_mass_train(simulate):
    t, w1, w2 = simulate(built("Trains", "TwoMass"), "w1 w2", 2.0, u=2.0)
    c, d, j1, j2 = 300.0, 0.5, 1.0, 3.0
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1
    a[1] = np.array([-c, -d, c, d, 1]) / j1
    a[3] = np.array([c, d, -c, -d, 0]) / j2
    exact = np.array([expm(a * at) @ [0, 0, 0.2, 0, 2.0] for at in t])
    assert w1 == pytest.approx(exact[:, 1], abs=1e-7)
    assert w2 == pytest.approx(exact[:, 3], abs=1e-7)


def test_pendulum(simulate):
    """Against SciPy's DOP853; the energy stays."""
    t, phi, energy = simulate(built("Trains", "Pendulum"), "phi energy", 5.0, {"phi0": 2.0})
    exact = solve_ivp(
        lambda _, x: [x[1], -9.81 / 0.5 * np.sin(x[0])], (0, 5), [2.0, 0], "DOP853", t, rtol=1e-12, atol=1e-12
    )
    assert phi == pytest.approx(exact.y[0], abs=1e-7)
    assert energy == pytest.approx(energy[0], rel=1e-7)


def test_gear(simulate):
    """Motor and load on an ideal gear of ratio 10 are one inertia; the load starts at 0.5 rad."""
    t, w_motor, phi = simulate(built("Trains", "Geared"), "w_motor load.phi", 1.0, u=1.2)
    acceleration = 1.2 * 10 / (2 + 0.1 * 100)
    assert w_motor == pytest.approx(10 * acceleration * t, rel=1e-9)
    assert phi == pytest.approx(0.5 + acceleration * t**2 / 2, rel=1e-9)


def test_rc_circuit(simulate):
    t, y = simulate(built("Structure", "RC"), "y", 0.5, u=5.0)
    assert y == pytest.approx(-5.0 * np.expm1(-t / 0.1), abs=2e-8)


def test_bouncing_ball(simulate):
    """Falls from 1 m, leaves each impact with 0.8 of its speed."""
    t, h, v, bounces = simulate(built("Hybrid", "BouncingBall"), "h v bounces", 2.0)
    left, speed, number, exact = 0.0, 0.0, 0, []
    height = 1.0
    for at in t:
        while height + speed * (at - left) - 9.81 * (at - left) ** 2 / 2 < 0:
            fall = (speed + np.sqrt(speed**2 + 2 * 9.81 * height)) / 9.81
            left, speed, height, number = left + fall, 0.8 * (9.81 * fall - speed), 0.0, number + 1
        exact.append(
            (height + speed * (at - left) - 9.81 * (at - left) ** 2 / 2, speed - 9.81 * (at - left), number)
        )
    for ours, theirs in zip((h, v, bounces), np.transpose(exact), strict=True):
        assert ours == pytest.approx(theirs, abs=1e-6)
    assert number == 3


def stick_slip(t, c=100.0, v0=0.1, sliding=1.0, break_away=1.5):
    """Position and speed by SciPy: alternately stuck and sliding, each until its event."""

    def breaks(at, x):
        return c * (v0 * at - x[0]) - break_away

    def stops(at, x):
        return x[1]

    stops.direction, breaks.terminal, stops.terminal = -1, True, True
    now, x, moving, out = 0.0, np.zeros(2), False, np.zeros((2, t.size))
    while now < t[-1]:

        def rate(at, x, moving=moving):
            return [x[1], c * (v0 * at - x[0]) - sliding] if moving else [0.0, 0.0]

        wanted = t[(t >= now)]
        part = solve_ivp(
            rate,
            (now, t[-1]),
            x,
            "DOP853",
            wanted,
            events=stops if moving else breaks,
            rtol=1e-12,
            atol=1e-13,
        )
        out[:, np.searchsorted(t, part.t)] = part.y
        if part.status == 0:
            break
        now, x, moving = part.t_events[0][0], np.array([part.y_events[0][0][0], 0.0]), not moving
        if moving:
            x[1] = 1e-15  # past the event that stops it
    return out


def test_stick_slip(simulate, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stick-slip")
    (folder / "DraggedMass.mo").write_text(STICK_SLIP)
    path = build(folder / "DraggedMass.mo", "DraggedMass", FMUS / "tests", roots=[MODELS])
    t, s, v = simulate(path, "s v", 2.5, n=500)
    expected_s, expected_v = stick_slip(t)
    assert np.ptp(np.sign(expected_v)) == 1
    assert np.sum(np.diff(expected_v > 0)) >= 4  # slides twice at least
    assert s == pytest.approx(expected_s, abs=1e-6)
    assert v == pytest.approx(expected_v, abs=1e-5)
