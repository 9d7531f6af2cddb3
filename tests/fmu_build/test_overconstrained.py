"""Overconstrained connectors: plane frames in loops, roots and branches, functions of the world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmu_build import build, compile_flat, compile_modelica, load
from fmu_build.errors import ModelicaError
from fmu_build.instrument import Added, instrument
from fmu_build.model_ports import find_ports
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task
from tests.conftest import LIBRARY_FOLDERS, MODELICA, needs_the_library
from tests.every_law import every_law
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
    needs_the_library()
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


# An arm of 2 kg with its centre of mass at 0.2 m: a body in frames of this file or of the library, or a torque.
ARMS = {
    "frames": """
    model Hinge extends Joint(tau = axis.tau); Rotational.Interfaces.Flange_a axis; Rotational.Interfaces.Flange_b support;
    equation axis.phi = phi; support.phi = 0; end Hinge;
    inner World world; Hinge joint(phi(fixed = true), w(fixed = true)); Rod rod(l = 0.2, m = 2);
  equation
    connect(world.frame, joint.a); connect(joint.b, rod.a);""",
    "MultiBody": """
    import Modelica.Mechanics.MultiBody;
    inner MultiBody.World world(g = 9.81, n = {0, -1, 0});
    MultiBody.Joints.Revolute joint(useAxisFlange = true, phi(fixed = true), w(fixed = true));
    MultiBody.Parts.Body rod(m = 2, r_CM = {0.2, 0, 0}, I_33 = 0);
  equation
    connect(world.frame_b, joint.frame_a); connect(joint.frame_b, rod.frame_a);""",
    "torque": """
    model Arm
      Rotational.Interfaces.Flange_a axis; Real phi(fixed = true); Real w(fixed = true);
    equation
      axis.phi = phi; w = der(phi); 2*0.2^2*der(w) = axis.tau - 2*9.81*0.2*cos(phi);
    end Arm;
    Arm joint;
  equation""",
}  # fmt: skip
MOTOR = """
    import Modelica.Mechanics.Rotational;
    model Rotor Rotational.Interfaces.Flange_b flange; Real w; input Real torque(unit = "N.m");
    equation w = der(flange.phi); 0.01*der(w) = flange.tau + torque; end Rotor;
    Rotor rotor; input Real tau(unit = "N.m");"""


def accelerations(tmp_path: Path, arm: str) -> dict[str, list[float]]:
    """The joint's acceleration in four states, without a law and with each that makes no variant at its flange."""
    file = tmp_path / "P.mo"
    flanges = "rotor.torque = tau; connect(rotor.flange, joint.axis);"
    file.write_text(f"{PLANE}  model M {MOTOR}{ARMS[arm]} {flanges}\n  end M;\nend P;\n")
    flat = load(file, "P.M", LIBRARY_FOLDERS if arm == "MultiBody" else ())
    (node,) = (p for p in find_ports(flat) if p.kind in ("node", "branch"))  # none from the flange to the ground
    assert node.kind == "node"
    assert "joint.axis" in {*node.connectors, *node.same}
    effects = [e for e in every_law(flat, tmp_path).effects.values() if e.id.endswith(f"@{node.name}")]
    effects = [e for e in effects if not e.variant]
    neutral = {name: value for e in effects for name, value in e.neutral.items()}
    terms = [t for e in effects for t in e.terms]
    model = compile_flat(instrument(flat, terms, [Added(*item) for item in neutral.items()]))
    assert sorted(states(model)) == ["joint.phi", "joint.w"]
    order = [["joint.phi", "joint.w"].index(name) for name in states(model)]
    points = np.random.default_rng(1).normal(size=(4, 2))
    values = {"": neutral} | {e.id.partition("@")[0]: {**neutral, **e.trials[-1]} for e in effects}
    return {
        law: [Instance.of(model, v).get("der(joint.w)", 0.3, x[order], [1.0]) for x in points]
        for law, v in values.items()
    }


@pytest.mark.parametrize("arm", ["frames", "MultiBody"])
def test_laws_at_the_flange_of_a_joint_between_frames_act_as_at_a_flange_alone(tmp_path: Path, arm: str) -> None:
    if arm == "MultiBody":
        needs_the_library()
    bodies, plain = accelerations(tmp_path, arm), accelerations(tmp_path, "torque")
    assert {"coulomb", "stribeck", "quadratic", "asymmetry", "weight", "cogging"} <= plain.keys() <= bodies.keys()
    for law, expected in plain.items():
        np.testing.assert_allclose(bodies[law], expected, rtol=1e-9)
        assert not law or not np.allclose(expected, plain[""], rtol=1e-6), law


def test_axes_of_joints_are_constants_and_animation_is_left_out(tmp_path: Path) -> None:
    needs_the_library()
    file, flanges = tmp_path / "M.mo", "rotor.torque = tau; connect(rotor.flange, joint.axis);"
    file.write_text(f"model M {MOTOR}{ARMS['MultiBody']} {flanges} end M;")
    model = compile_modelica(file, "M", LIBRARY_FOLDERS)
    shown = ("joint.cylinder.", "rod.cylinder.", "rod.sphere.", "world.x_arrowLine.")
    assert not [v.name for v in model.variables if v.name.startswith(shown)]
    assert {v.causality for v in model.variables if v.name.startswith("joint.e[")} == {"local"}
    assert model.functions["derivatives"].n_instructions() < 100  # the rotation about any axis takes 156


# Where examples of the library end; the results that the Modelica Association publishes.
ENDS = {
    "Elementary.Pendulum": (5.0, {"rev.phi": -1.679635, "rev.w": -2.318147}),
    "Elementary.DoublePendulum": (3.0, {"revolute1.phi": -2.317929, "revolute2.phi": -1.736492}),
    "Elementary.PendulumWithSpringDamper": (10.0, {"prismatic.s": 0.746850, "revolute.phi": -1.332908}),
    "Elementary.SpringDamperSystem": (10.0, {"body1.frame_a.r_0[1]": 0.300592, "body1.frame_a.r_0[2]": -0.426901}),
    "Loops.PlanarFourbar": (5.0, {"revolute1.phi": -0.939783, "revolute1.w": 6.993490}),
    "Elementary.InitSpringConstant": (1.01, {"rev.phi": 0.0, "rev.w": 0.0}),
    "Elementary.ForceAndTorque": (1.01, {"revolute1.phi": -9.643255, "revolute2.phi": 0.235321}),
    "Elementary.ThreeSprings": (10.0, {"body1.frame_a.r_0[2]": -0.841532, "body1.frame_a.r_0[3]": 0.257003}),
    "Elementary.FreeBody": (10.0, {"body.body.frame_a.r_0[1]": 0.196094, "body.body.w_a[2]": 0.267863}),
    "Loops.Fourbar2": (5.0, {"j1.phi": 40.241258, "j1.w": 11.633989}),
    "Loops.Fourbar_analytic": (5.0, {"j1.phi": 40.241258, "j1.w": 11.633989}),
    "Elementary.LineForceWithTwoMasses": (3.0, {"revolute1.phi": -0.920147, "revolute2.phi": -0.920147}),
    "Loops.Fourbar1": (5.0, {"j1.phi": 40.328236, "j1.w": 11.739422}),
    "Loops.PlanarLoops_analytic": (5.0, {"rev.phi": -0.019059, "rev.w": 4.396055}),
    "Loops.Engine1b_analytic": (0.5, {"inertia.phi": 41.030155, "inertia.w": 137.0892}),
    "Systems.RobotR3.OneAxis": (0.7504, {"axis.initializeFlange.phi_flange": 1.788888}),
}


@pytest.mark.slow
@pytest.mark.parametrize("example", ENDS)
def test_examples_of_multibody_end_where_the_published_results_do(tmp_path: Path, example: str) -> None:
    needs_the_library()
    (folder,) = (f for f in LIBRARY_FOLDERS if (f / "Modelica" / "package.mo").is_file())
    name = f"Modelica.Mechanics.MultiBody.Examples.{example}"
    stop, expected = ENDS[example]
    with load_fmu(build(folder / "Modelica" / "package.mo", name, tmp_path, roots=[folder])) as fmu:
        ends = fmu.simulate(Task(np.linspace(0.0, stop, 501), {}, tuple(expected)), {})[:, -1]
    np.testing.assert_allclose(ends, [*expected.values()], rtol=1e-3, atol=1e-6)
