"""The Modelica library itself: standard syntax, one class a file, friction elements in new trains."""

from __future__ import annotations

import numpy as np
import pytest

import fmu_build
from fmuid.simulation.simulator import Task
from tests.conftest import MODELICA
from tests.reference.plain_fmpy import simulate_fmu

SOURCES = sorted(MODELICA.rglob("*.mo"))

BRAKE = """
model Brake "Inertia held by a brake"
  input Drives.Types.Torque drive "Torque on the inertia";
  output Drives.Types.Angle phi "Angle";
  output Drives.Types.AngularVelocity w "Speed";
  Drives.Components.Inertia inertia(J = 0.1, phi(fixed = true), w(fixed = true)) "Inertia";
  Drives.Components.Friction brake(tau_c = 2, b = 0.5, bristle(t_s = 4e-3)) "Brake";
  Drives.Components.Fixed frame "Frame";
  Drives.Components.Torque torque "Drive";
equation
  connect(inertia.flange_b, brake.flange_b);
  connect(brake.flange_a, frame.flange);
  connect(torque.flange, inertia.flange_a);
  torque.tau = drive;
  phi = inertia.phi;
  w = inertia.w;
end Brake;
"""


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: str(p.relative_to(MODELICA)))
def test_sources_parse_with_a_second_front_end(source):
    parser = pytest.importorskip("pymoca.parser")

    assert parser.parse(source.read_text()) is not None


@pytest.mark.parametrize("folder", sorted({p.parent for p in SOURCES}), ids=lambda p: p.name)
def test_package_order_lists_every_class(folder):
    listed = (folder / "package.order").read_text().split()
    files = {p.stem for p in folder.glob("*.mo")} - {"package"}
    folders = {p.parent.name for p in folder.glob("*/package.mo")}

    assert set(listed) == files | folders
    assert len(listed) == len(set(listed))


def test_friction_between_two_flanges_sticks_and_slides(tmp_path):
    (tmp_path / "Brake.mo").write_text(BRAKE)
    fmu = fmu_build.build(tmp_path / "Brake.mo", "Brake", tmp_path, roots=[MODELICA])
    time = np.linspace(0, 3, 301)
    drive = np.select([time < 1, time < 2], [1.8, 3.0], 0.0)
    phi, w = simulate_fmu(fmu, Task(time, {"drive": drive}, ("phi", "w")), {})

    assert np.abs(phi[time < 1]).max() <= 2e-5
    sliding = (time >= 1) & (time < 2)
    assert w[sliding] == pytest.approx(2.0 * -np.expm1(-(time[sliding] - 1) * 0.5 / 0.1), abs=2e-3)
    assert np.abs(w[time > 2.2]).max() < 1e-6
