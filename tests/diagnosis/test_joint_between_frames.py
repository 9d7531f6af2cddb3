"""What acts at the flange of a joint between frames of the Standard Library is found there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import fmuid
from fmu_build import build
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task
from tests.conftest import LIBRARY_FOLDERS, needs_the_library

ARM = """
model Arm
  import Modelica.Mechanics.MultiBody;
  model Drive
    import Modelica.Mechanics.Rotational;
    input Real torque; parameter Real J(unit = "kg.m2", min = 0) = 0.1; Rotational.Interfaces.Flange_b flange;
    Rotational.Components.Inertia rotor(J = J); Rotational.Sources.Torque motor(tau = torque);
  equation connect(motor.flange, rotor.flange_a); connect(rotor.flange_b, flange); end Drive;
  input Real u(unit = "N.m"); output Real phi(unit = "rad") = joint.phi;
  parameter Real J(unit = "kg.m2", min = 0) = 0.1; parameter Real m(unit = "kg", min = 0) = 2;
  inner MultiBody.World world(g = 9.81, n = {0, -1, 0});
  MultiBody.Joints.Revolute joint(useAxisFlange = true, phi(fixed = true), w(fixed = true));
  MultiBody.Parts.BodyShape rod(m = m, r = {0, -0.4, 0}, r_CM = {0, -0.2, 0}, I_33 = 0);
  Drive drive(J = J, torque = u);
  // second joint
equation
  connect(world.frame_b, joint.frame_a); connect(joint.frame_b, rod.frame_a); connect(drive.flange, joint.axis);
  // its connections
end Arm;
"""
TWO = ARM.replace(
    "// second joint",
    """input Real v(unit = "N.m"); output Real psi(unit = "rad") = elbow.phi;
  parameter Real K(unit = "kg.m2", min = 0) = 0.05; parameter Real n(unit = "kg", min = 0) = 1;
  MultiBody.Joints.Revolute elbow(useAxisFlange = true, phi(fixed = true), w(fixed = true));
  MultiBody.Parts.Body hand(m = n, r_CM = {0, -0.2, 0}, I_33 = 0); Drive second(J = K, torque = v);""",
).replace(
    "// its connections",
    "connect(rod.frame_b, elbow.frame_a); connect(elbow.frame_b, hand.frame_a); connect(second.flange, elbow.axis);",
)
SIGNALS = {ARM: (("u",), ("phi",)), TWO: (("u", "v"), ("phi", "psi"))}
TIME = 0.01 * np.arange(301)


@pytest.mark.slow
@pytest.mark.parametrize("model", [ARM, TWO], ids=["one joint", "two joints"])
def test_friction_in_a_joint_between_frames_is_found_at_its_flange(tmp_path: Path, model: str) -> None:
    needs_the_library()
    (inputs, outputs), rng = SIGNALS[model], np.random.default_rng(1)
    (tmp_path / "Arm.mo").write_text(model)
    (tmp_path / "plant.mo").write_text(model.replace("torque = u", "torque = u - 0.3*tanh(joint.w/0.02)"))
    with load_fmu(build(tmp_path / "plant.mo", "Arm", tmp_path, roots=LIBRARY_FOLDERS)) as plant:
        for k in range(3):
            torques = np.repeat(rng.uniform(-3, 3, (len(inputs), 31)), 10, axis=1)[:, : TIME.size]
            angles = plant.simulate(Task(TIME, dict(zip(inputs, torques, strict=True)), outputs), {})
            angles = angles + 1e-3 * rng.standard_normal(angles.shape)
            header = ",".join(["time", *(f"{n} [N.m]" for n in inputs), *(f"{n} [rad]" for n in outputs)])
            table = np.column_stack([TIME, *torques, *angles])
            np.savetxt(tmp_path / f"run_{k}.csv", table, "%.7f", ",", header=header, comments="")
    logs = sorted(tmp_path.glob("run_*.csv"))
    campaign = fmuid.start(logs, model=tmp_path / "Arm.mo", roots=LIBRARY_FOLDERS, out=tmp_path / "arm")
    fmuid.diagnose(campaign, out=tmp_path / "out")
    best = json.loads((tmp_path / "out" / "diagnosis.json").read_text())["answers"][0]
    assert best["effects"] == ["coulomb@joint.axis"]
    assert best["closure"]["held_out"] > 0.95
