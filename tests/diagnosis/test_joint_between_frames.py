"""What acts at the flange of a joint between frames of the Standard Library is found there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import fmuid
from tests.conftest import LIBRARY_FOLDERS, needs_the_library

ARM = """
model Arm
  import Modelica.Mechanics.MultiBody;
  input Real tau(unit = "N.m"); output Real phi(unit = "rad") = joint.phi;
  parameter Real J(unit = "kg.m2", min = 0) = 0.1; parameter Real m(unit = "kg", min = 0) = 2;
  inner MultiBody.World world(g = 9.81, n = {0, -1, 0});
  MultiBody.Joints.Revolute joint(useAxisFlange = true, phi(fixed = true), w(fixed = true));
  MultiBody.Parts.Body rod(m = m, r_CM = {0, -0.2, 0}, I_33 = 0);
  Modelica.Mechanics.Rotational.Components.Inertia rotor(J = J);
  Modelica.Mechanics.Rotational.Sources.Torque motor(tau = tau);
equation
  connect(world.frame_b, joint.frame_a); connect(joint.frame_b, rod.frame_a);
  connect(motor.flange, rotor.flange_a); connect(rotor.flange_b, joint.axis);
end Arm;
"""
STEP, SAMPLES = 0.01, 301


def angle(torque: np.ndarray) -> np.ndarray:
    """Angle of an arm with dry friction of 0.3 N.m, by the equations of a pendulum in small steps."""
    x, h, seen = np.zeros(2), STEP / 20, np.empty(SAMPLES)

    def rate(x: np.ndarray, u: float) -> np.ndarray:
        load = 0.3 * np.tanh(x[1] / 0.02) + 2 * 9.81 * 0.2 * np.sin(x[0])
        return np.array([x[1], (u - load) / (0.1 + 2 * 0.2**2)])

    for k, u in enumerate(torque):
        seen[k] = x[0]
        for _ in range(20):
            a = rate(x, u)
            b = rate(x + h / 2 * a, u)
            c = rate(x + h / 2 * b, u)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, u))
    return seen


@pytest.mark.slow
def test_friction_in_a_joint_between_frames_is_found_at_its_flange(tmp_path: Path) -> None:
    needs_the_library()
    rng = np.random.default_rng(1)
    runs = []
    for k in range(3):
        torque = np.repeat(rng.uniform(-3, 3, SAMPLES // 10 + 1), 10)[:SAMPLES]
        phi = angle(torque) + 1e-3 * rng.standard_normal(SAMPLES)
        runs.append(tmp_path / f"run_{k}.csv")
        table = np.column_stack([STEP * np.arange(SAMPLES), torque, phi])
        np.savetxt(runs[-1], table, "%.7f", ",", header="time,tau [N.m],phi [rad]", comments="")
    (tmp_path / "Arm.mo").write_text(ARM)
    campaign = fmuid.start(runs, model=tmp_path / "Arm.mo", roots=LIBRARY_FOLDERS, out=tmp_path / "arm")
    fmuid.diagnose(campaign, out=tmp_path / "out")
    best = json.loads((tmp_path / "out" / "diagnosis.json").read_text())["answers"][0]
    assert best["effects"] == ["coulomb@joint.axis"]
    assert best["closure"]["held_out"] > 0.95
