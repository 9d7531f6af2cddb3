"""Overconstrained connectors: plane frames in loops, roots and branches, functions of the world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmu_build import compile_modelica
from fmu_build.errors import ModelicaError
from tests.conftest import LIBRARY_FOLDERS, MODELICA
from tests.fmu_build.simulate import Instance, states

# Plane frames: a position and a redundant orientation (cosine and sine of the angle).
PLANE = """package P
  record Turn Real e[2];
    function equalityConstraint input Turn a; input Turn b; output Real residue[1];
    algorithm residue := {a.e[1]*b.e[2] - a.e[2]*b.e[1]};
    end equalityConstraint;
  end Turn;
  connector Frame Real r[2]; Turn R; flow Real f[2]; flow Real t; end Frame;
  function fall input Real r[2]; input Real g = 10; output Real a[2]; algorithm a := {0, -g}; end fall;
  model World
    Frame frame; parameter Real g = 9.81;
    replaceable function gravity = fall(g = g);
  equation
    Connections.root(frame.R); frame.r = {0, 0}; frame.R.e = {1, 0};
  end World;
  model Joint
    Frame a; Frame b; Real phi(start = 0); Real w; Real tau = 0;
    Real near = if Connections.rooted(a.R) then 1 else 0;
  equation
    Connections.branch(a.R, b.R);
    w = der(phi); a.r = b.r;
    if Connections.rooted(a.R) then
      b.R.e = {a.R.e[1]*cos(phi) - a.R.e[2]*sin(phi), a.R.e[2]*cos(phi) + a.R.e[1]*sin(phi)};
    else
      a.R.e = {b.R.e[1]*cos(phi) + b.R.e[2]*sin(phi), b.R.e[2]*cos(phi) - b.R.e[1]*sin(phi)};
    end if;
    a.f + b.f = {0, 0}; a.t + b.t = 0; b.t = -tau;
  end Joint;
  model Rod
    outer World world; Frame a; Frame b; parameter Real l = 1; parameter Real m = 1; Real v[2]; Real F[2];
    parameter Boolean mayBeRoot = false; Real root = if Connections.isRoot(a.R) then 1 else 0;
    Real n = cardinality(b);
  equation
    Connections.branch(a.R, b.R);
    if mayBeRoot then
      Connections.potentialRoot(a.R);
    end if;
    b.R.e = a.R.e; b.r = a.r + l*a.R.e;
    v = der(b.r); F = m*der(v) - m*world.gravity(b.r);
    a.f + b.f = F;
    a.t + b.t + l*(a.R.e[1]*(b.f[2] - F[2]) - a.R.e[2]*(b.f[1] - F[1])) = 0;
  end Rod;
"""
PENDULUM = """  model M
    inner World world; Joint joint(phi(start = 0.5, fixed = true), w(fixed = true)); Rod rod(l = 2, m = 3);
  equation
    connect(world.frame, joint.a); connect(joint.b, rod.a);
  end M;
"""


def compiled(tmp_path: Path, model: str) -> Instance:
    file = tmp_path / "P.mo"
    file.write_text(f"{PLANE}{model}end P;\n")
    return Instance.of(compile_modelica(file, "P.M"))


def test_a_pendulum_of_frames_falls_like_one_in_an_angle(tmp_path: Path) -> None:
    instance = compiled(tmp_path, PENDULUM)
    assert states(instance.model) == ["joint.phi", "joint.w"]
    times = np.linspace(0, 2, 21)
    x = instance.simulate(times)
    plain = tmp_path / "Plain.mo"
    plain.write_text("model Plain Real phi(start = 0.5, fixed = true); Real w(start = 0, fixed = true); "
                     "equation der(phi) = w; 2*der(w) = -9.81*cos(phi); end Plain;")  # fmt: skip
    expected = Instance.of(compile_modelica(plain, "Plain")).simulate(times)
    np.testing.assert_allclose(x, expected, atol=1e-6)
    assert instance.get("joint.near", 0.0, x[0]) == 1.0
    assert instance.get("rod.root", 0.0, x[0]) == 0.0
    assert instance.get("rod.n", 0.0, x[0]) == 0.0


def test_a_connection_is_broken_where_frames_form_a_loop(tmp_path: Path) -> None:
    """A parallelogram: its links of one length swing like a pendulum of it."""
    model = """  model M
    inner World world; Rod base(l = 2); Rod left; Rod right; Rod top(l = 2);
    Joint a(phi(start = 0.5, fixed = true), w(fixed = true)); Joint b(phi(start = -0.5)); Joint c(phi(start = 0.5)); Joint d;
  equation
    connect(world.frame, base.a); connect(world.frame, a.a); connect(a.b, left.a); connect(left.b, b.a);
    connect(b.b, top.a); connect(base.b, c.a); connect(c.b, right.a); connect(right.b, d.a); connect(top.b, d.b);
  end M;
"""
    instance = compiled(tmp_path, model.replace("Joint d;", "Joint d(phi(start = -0.5));"))
    x = instance.start()
    assert instance.get("der(a.w)", 0.0, x) == pytest.approx(-9.81 * np.cos(0.5))


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("Joint joint; Rod rod; equation connect(joint.b, rod.a);", "is a root; connect it to a root"),
        ("Joint a; Joint b; equation connect(world.frame, a.a); connect(a.b, b.a); Connections.branch(a.b.R, a.a.R);",
         "form a loop"),
        ("Joint a; equation connect(world.frame, a.a); Connections.root(a.a.R); Connections.root(a.b.R);",
         "are both roots of the same branches"),
        ("Joint a; equation connect(world.frame, a.a); Connections.uniqueRoot(a.a.R);",
         "'Connections.uniqueRoot' is not supported"),
    ],
)  # fmt: skip
def test_wrong_graphs_are_refused(tmp_path: Path, model: str, message: str) -> None:
    with pytest.raises(ModelicaError, match=message):
        compiled(tmp_path, f"  model M inner World world; {model} end M;\n")


def test_the_eccentric_load_of_multibody_equals_the_torque_of_its_weight() -> None:
    if not any((folder / "Modelica" / "package.mo").is_file() for folder in LIBRARY_FOLDERS):
        pytest.skip("no Modelica Standard Library in MODELICAPATH or a tool's folder")
    plain, body = (
        Instance.of(
            compile_modelica(
                MODELICA / "Drives" / "Setups" / f"{name}.mo", f"Drives.Setups.{name}", LIBRARY_FOLDERS
            )
        )
        for name in ("EccentricLoad", "EccentricLoadMultiBody")
    )
    names = [name.replace("bearing.", "load.") for name in states(body.model)]
    order = [states(plain.model).index(name) for name in names]
    for seed in range(5):
        x = np.random.default_rng(seed).normal(size=len(order))
        expected = plain.derivative(0.0, x, [1.0])[order]
        np.testing.assert_allclose(body.derivative(0.0, x[order], [1.0]), expected, rtol=1e-6)
