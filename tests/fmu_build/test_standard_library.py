"""Models that use the Standard Library's interfaces: connectors, friction with modes, tables."""

from __future__ import annotations

import cmath
import math
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fmu_build import build, compile_modelica, load
from fmu_build.errors import ModelicaError
from fmu_build.model import CompiledModel
from fmuid.core.errors import SimulationError
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task
from tests.conftest import LIBRARY_FOLDERS, MODELICA, needs_the_library
from tests.fmu_build.simulate import Instance, find, values

HERE = Path(__file__).parent
MODELS, ROOTS = HERE / "models" / "Standard.mo", [HERE / "standard", MODELICA]
NOTHING = np.zeros(0)


@cache
def compiled(name: str) -> CompiledModel:
    return compile_modelica(MODELS, f"Standard.{name}", ROOTS)


def test_flanges_of_both_libraries_connect():
    instance = Instance.of(compiled("Coupled"))
    times = np.linspace(0, 1, 11)
    twist = [instance.get("twist", t, x) for t, x in zip(times, instance.simulate(times), strict=True)]
    np.testing.assert_allclose(twist, -0.1 * np.cos(np.sqrt(300 * 1.5) * times), atol=1e-6)


def test_friction_element_in_the_standard_librarys_manner(tmp_path):
    fmu = Fmu(build(MODELS, "Standard.Bearing", tmp_path, roots=ROOTS))
    time = np.arange(0, 4, 1e-3)
    torque = 2.5 * np.sin(2 * time)
    w, mode = fmu.simulate(Task(time, {"u": torque}, ("w", "mode")), {})

    speed, expected, step = 0.0, [0.0], 2e-5
    for u in torque[:-1]:
        for _ in range(50):
            friction = np.sign(speed) * (1 + 0.05 * abs(speed)) if speed else np.sign(u)
            new = speed if speed == 0.0 and abs(u) <= 1.2 else speed + step * (u - friction) / 0.1
            speed = 0.0 if new * speed < 0 else new
        expected.append(speed)
    np.testing.assert_allclose(w, expected, atol=1e-4 * np.ptp(expected))
    assert set(mode) == {-1, 0, 1}


LINES = {  # u, linear with the last two points, held, steps (lines beyond the ends): of the first column
    -1.0: (-1.0, 1.0, -1.0), 0.5: (2.0, 2.0, 1.0), 1.0: (3.0, 3.0, 3.0), 2.0: (3.5, 3.5, 3.0), 5.0: (5.0, 4.0, 5.0),
}  # fmt: skip


SMOOTH = {-1.0: -1.75, 0.5: 2.234375, 1.0: 3.0, 3.5: 4.075757576, 6.25: -2.056640625, 8.0: 4.5}


@pytest.mark.parametrize("u", LINES)
@pytest.mark.parametrize(("name", "which"), [("Table", 0), ("Held", 1), ("Steps", 2), ("FromFile", 0)])
def test_tables(name, which, u):
    instance = Instance.of(compiled(name))
    assert instance.get("y[1]", 0.0, NOTHING, [u]) == pytest.approx(LINES[u][which])
    assert instance.get("last", 0.0, NOTHING, [u]) == 3.0
    second = {-1.0: (0.0, 10.0, 0.0), 0.5: (15.0, 15.0, 10.0), 2.0: (30.0, 30.0, 20.0), 5.0: (60.0, 40.0, 60.0)}
    if u in second:
        assert instance.get("y[2]", 0.0, NOTHING, [u]) == pytest.approx(second[u][which])


def test_an_fmu_is_built_again_after_its_table_changed(tmp_path):
    for name in ("Standard.mo", "table.txt"):
        shutil.copy(MODELS.with_name(name), tmp_path)
    for first in (1.0, 5.0):
        fmu = Fmu(build(tmp_path / "Standard.mo", "Standard.FromFile", tmp_path, roots=ROOTS))
        assert fmu.simulate(Task(np.arange(2.0), {"u": np.zeros(2)}, ("y[1]",)), {})[0, 0] == first
        (tmp_path / "table.txt").write_text("#1\nfloat tab(2, 3)\n0 5 1\n1 6 2\n")


@pytest.mark.parametrize("u", SMOOTH)
def test_derivatives_of_a_smooth_table_are_those_of_its_curve(u):
    instance = Instance.of(compiled("Akima"))
    place = find(instance.model, "y[2]").location.index
    env = instance.env(0.0, NOTHING, [u])
    slope = values(
        instance.model.functions["variable_partials"](*env, [], [1.0], np.zeros(instance.model.n_p), [], [])
    )
    nearby = [instance.get("y[2]", 0.0, NOTHING, [u + h]) for h in (-1e-6, 1e-6)]
    assert instance.get("y[2]", 0.0, NOTHING, [u]) == pytest.approx(SMOOTH[u])
    assert slope[place] == pytest.approx((nearby[1] - nearby[0]) / 2e-6, abs=1e-5)


def test_derivatives_of_a_table_by_its_entries_and_abscissa():
    instance = Instance.of(compiled("Table"))
    seed = np.zeros(instance.model.n_p)
    seed[find(instance.model, "table[2,2]").location.index] = 1.0
    place = find(instance.model, "y[1]").location.index
    partials = instance.model.functions["variable_partials"]
    env = instance.env(0.0, NOTHING, [2.0])
    assert values(partials(*env, [], [1.0], 0 * seed, [], []))[place] == pytest.approx(0.5)
    assert values(partials(*env, [], [0.0], seed, [], []))[place] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("name", "message"),
    [("Periodic", "HoldLastPoint"), ("NoFile", "'tab' cannot be read from the text file '.*none.txt'")],
)
def test_tables_that_are_not_supported_are_refused_with_their_line(name, message):
    with pytest.raises(ModelicaError, match=rf"Standard\.mo:\d+: .*{message}"):
        compile_modelica(MODELS, f"Standard.{name}", ROOTS)


WITHOUT = """model Drive
  import SI = Modelica.Units.SI;
  import Modelica.Constants.pi;
  import Modelica.Units.Conversions.from_rpm;
  extends Modelica.Icons.Example;
  parameter SI.Inertia J = 2;
  parameter SI.AngularVelocity limit = from_rpm(30);
  Modelica.Mechanics.Rotational.Interfaces.Flange_a flange;
  output Real y = Modelica.Math.sin(pi/2);
equation
  flange.phi = time;
end Drive;
"""


def test_units_constants_and_connectors_are_there_without_the_library(tmp_path):
    file = tmp_path / "Drive.mo"
    file.write_text(WITHOUT)
    instance = Instance.of(compile_modelica(file, "Drive"))
    assert find(instance.model, "flange.phi").unit == "rad"
    assert instance.get("limit", 0.0, NOTHING) == pytest.approx(np.pi)
    assert instance.get("y", 0.0, NOTHING) == 1.0


def test_what_the_library_alone_has_says_what_root_needs(tmp_path):
    file = tmp_path / "M.mo"
    file.write_text("model M\n  Modelica.Blocks.Sources.Sine s;\nend M;\n")
    with pytest.raises(ModelicaError, match=r"M\.mo:2: .*needs the Modelica Standard Library.*git clone .*--root"):
        compile_modelica(file, "M")


def library(folder: Path, version: str) -> None:
    folder.mkdir(parents=True)
    text = f'package Mech constant Real k = {version[0]}; annotation(version = "{version}"); end Mech;'
    (folder / "package.mo").write_text(text)


@pytest.mark.parametrize(
    ("places", "uses", "version"),
    [
        (["path/Mech"], "", "4.0.0"),
        ([".openmodelica/libraries/Mech 4.0.0+maint.om"], "", "4.0.0"),
        ([".openmodelica/libraries/Mech 3.2.3", ".openmodelica/libraries/Mech 4.0.0"], "", "4.0.0"),
        ([".openmodelica/libraries/Mech 4.0.0", ".openmodelica/libraries/Mech 3.2.3"], "3.2.3", "3.2.3"),
        ([".openmodelica/libraries/Mech 3.2.3", "path/Mech 4.0.0"], "", "4.0.0"),
        ([".openmodelica/libraries/Mech 4.0.0", "root/Mech 3.2.3"], "", "3.2.3"),
    ],
)
def test_libraries_of_modelica_tools_are_found(tmp_path, monkeypatch, places, uses, version):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("MODELICAPATH", str(tmp_path / "path"))
    for place in places:
        library(tmp_path / place, "3.2.3" if place.endswith("3.2.3") else "4.0.0")
    file = tmp_path / "M.mo"
    (tmp_path / "root").mkdir(exist_ok=True)
    file.write_text(f'model M Real x = Mech.k; annotation(uses(Mech(version = "{uses}"))); end M;')
    flat = load(file, "M", [tmp_path / "root"])
    assert flat.libraries == (("Mech", version),)
    monkeypatch.setenv("MODELICAPATH", "")
    if "root" not in places[-1]:
        with pytest.raises(ModelicaError, match="'Mech'"):
            load(file, "M")


def test_linear_systems_of_parameters_as_pumps_have_them(tmp_path):
    """LAPACK's dgesv, as the library calls it: a pump's curve through three points."""
    (tmp_path / "P.mo").write_text("""package P
      function dgesv_vec input Real A[:, size(A, 1)]; input Real b[size(A, 1)]; output Real x[size(A, 1)] = b; output Integer info;
      protected Integer n = size(A, 1); Real Awork[n, n] = A; Integer ipiv[n];
      external "FORTRAN 77" dgesv(n, 1, Awork, n, ipiv, x, n, info); end dgesv_vec;
      function curve input Real V; input Real Vs[3]; input Real h[3]; output Real y; protected Real c[3]; Integer info;
      algorithm (c, info) := dgesv_vec({{1, v, v^2} for v in Vs}, h); assert(info == 0, "singular"); y := c*{1, V, V^2};
      end curve;
      model M parameter Real h[3] = {100, 60, 0}; output Real y = curve(time, {0, 0.25, 0.5}, h); end M;
    end P;""")
    model = compile_modelica(tmp_path / "P.mo", "P.M")
    assert Instance.of(model).get("y", 0.1, NOTHING) == pytest.approx(100 - 12 - 1.6)
    assert Instance.of(model, {"h[1]": 0.0, "h[2]": 1.0, "h[3]": 2.0}).get("y", 0.1, NOTHING) == pytest.approx(0.4)


def test_what_a_branch_prepares_for_an_error_is_not_evaluated(tmp_path):
    """A String made of variables, as the library checks the fractions of a fluid."""
    (tmp_path / "P.mo").write_text("""package P
      function error input String text; algorithm assert(false, text); end error;
      function check input Real x[:]; protected String s; algorithm
        if abs(sum(x) - 1) > 1e-10 then
          s := ""; for i in 1:size(x, 1) loop s := s + " " + String(x[i]); end for;
          error("the sum is " + String(sum(x)));
        end if; end check;
      model M parameter Real b = 1; output Real y = time; equation check({0.25, 0.75 + (1 - b)*time}); end M;
    end P;""")
    fmu = Fmu(build(tmp_path / "P.mo", "P.M", tmp_path))
    task = Task(np.linspace(0, 1, 3), {}, ("y",))
    assert fmu.simulate(task, {})[0, -1] == 1.0
    with pytest.raises(SimulationError, match=r"P\.mo:6: the sum is 0\.5"):
        fmu.simulate(task, {"b": 2.0})


# Models made of the library's packages, and what their equations give by hand.
WITH_THE_LIBRARY = {
    "a state graph": (
        """import Modelica.StateGraph.*; inner StateGraphRoot stateGraphRoot; output Integer n(start = 0, fixed = true);
        InitialStep s(nIn = 1, nOut = 1); StepWithSignal on(nIn = 1, nOut = 1); output Boolean active = on.active;
        Transition a(enableTimer = true, waitTime = 0.5); Transition b(enableTimer = true, waitTime = 1);
        equation connect(s.outPort[1], a.inPort); connect(a.outPort, on.inPort[1]); connect(on.outPort[1], b.inPort);
        connect(b.outPort, s.inPort[1]); when active then n = pre(n) + 1; end when;""",
        {"n": 2, "active": 1},
    ),
    "complex functions": (
        """import Modelica.ComplexMath; function f input Complex a; output Complex b; output Real m; protected Complex t[2];
        algorithm t := {a, a*a}; b := t[1] + t[2]*Complex(0, 1); m := ComplexMath.abs(b); end f;
        Complex u = Complex(2, 1); Complex b; output Real m; output Real x = b.re; output Complex e = ComplexMath.exp(u)/u;
        equation (b, m) = f(u);""",
        {"x": -2, "m": abs(-2 + 4j), "e.im": (cmath.exp(2 + 1j) / (2 + 1j)).imag},
    ),
    "quasi-static circuits": (
        """import Modelica.Electrical.QuasiStatic.SinglePhase.*; Sources.VoltageSource v(f = 50, V = 100, phi = 0);
        Basic.Resistor r(R_ref = 10); Basic.Inductor l(L = 0.1/Modelica.Constants.pi); Basic.Ground g;
        output Real re = l.i.re; output Real im = l.i.im;
        equation connect(v.pin_p, r.pin_p); connect(r.pin_n, l.pin_p); connect(l.pin_n, v.pin_n); connect(g.pin, v.pin_n);""",
        {"re": 5, "im": -5},
    ),
    "pipes, tanks and a pump": (
        """import Modelica.Fluid.*; package Water = Modelica.Media.Water.ConstantPropertyLiquidWater; inner System system;
        model Tank = Vessels.OpenTank(redeclare package Medium = Water, height = 200, nPorts = 1, use_portsData = false);
        Tank a(crossArea = 1, level_start = 2); Tank b(crossArea = 1, level_start = 1); Tank c(crossArea = 0.1, level_start = 60);
        model Linear = Pipes.BaseClasses.FlowModels.NominalLaminarFlow(dp_nominal = 1e4, m_flow_nominal = 10);
        Pipes.StaticPipe pipe(redeclare package Medium = Water, length = 1, diameter = 0.1, redeclare model FlowModel = Linear);
        Sources.FixedBoundary s(redeclare package Medium = Water, nPorts = 1, p = system.p_ambient);
        function Curve = Machines.BaseClasses.PumpCharacteristics.quadraticFlow(V_flow_nominal = {0, 0.25, 0.5}, head_nominal = {100, 60, 0});
        Machines.PrescribedPump pump(redeclare package Medium = Water, N_nominal = 1000, redeclare function flowCharacteristic = Curve);
        Real level(start = 60, fixed = true); output Real pumped = c.level - level; output Real apart = a.level - b.level;
        equation connect(a.ports[1], pipe.port_a); connect(pipe.port_b, b.ports[1]);
        connect(s.ports[1], pump.port_a); connect(pump.port_b, c.ports[1]);
        der(level) = (sqrt(120^2 + 640*(100 - level)) - 120)/320/0.1;""",
        {"apart": math.exp(-2 * 9.80665e-3 * 2.5), "pumped": 0},
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WITH_THE_LIBRARY)
def test_models_of_the_library(tmp_path, what):
    needs_the_library()
    body, ends = WITH_THE_LIBRARY[what]
    (tmp_path / "M.mo").write_text(f"model M {body} end M;")
    fmu = Fmu(build(tmp_path / "M.mo", "M", tmp_path, roots=LIBRARY_FOLDERS))
    task = Task(np.linspace(0, 2.5, 11), {}, tuple(ends))
    np.testing.assert_allclose(fmu.simulate(task, {})[:, -1], [*ends.values()], rtol=1e-5, atol=1e-5)
