"""Units of a model's equations: differences are reported with their line, unknown units are not."""

from __future__ import annotations

import shutil

import pytest
from fmpy import read_model_description

from fmu_build import build, compile_modelica
from fmu_build.front.flatten import load
from fmu_build.unit_check import check
from tests.conftest import MODELICA

SETUPS = sorted(MODELICA.glob("*/Setups/*With*.mo"))  # they extend the others
DECLARED = """model M
  parameter Real m(unit = "kg") = 2;
  parameter Real c(unit = "N/m") = 3;
  parameter Real J(unit = "kg.m2") = 1;
  parameter Real tau(unit = "N.m") = 1;
  parameter Real plain = 1;
  parameter Real n(unit = "1") = 5;
  Real s(unit = "m", start = 1, fixed = true);
  Real v(unit = "m/s", start = 0, fixed = true);
  Real w(unit = "rad/s", start = 0, fixed = true);
  Real F(unit = "N") = -c*s;
"""
GOOD = [
    "m*der(v) = F;",
    "m*der(v) = -c*s*plain;",
    "m*der(v) = noEvent(if s > 0 then F else 2*F);",
    "m*der(v) = if v > 1e-3 then F*sin(10*time) else sqrt(F^2);",
    "m*v*der(v)/2 = 9.81*F + max(0, F*v*3);",
]
BAD = {
    "m*der(v) = c*v;": ("kg.m/s2", "kg.m/s3"),
    "m*der(v) = F + s;": ("N", "m"),
    "m*der(v) = if s > v then F else 0;": ("m", "m/s"),
    "m*der(v) = F*sin(s);": ("1", "m"),
    "der(v) = F;": ("m/s2", "N"),
    "m*der(v) = noEvent(max(F, s));": ("N", "m"),
    "m*der(v) = if s > 1 then F else c;": ("N", "N/m"),
    "m*der(v) = sqrt(F);": ("kg.m/s2", "kg1/2.m1/2/s"),
}


def findings(tmp_path, equation: str, more: str = "") -> tuple[str, ...]:
    file = tmp_path / "M.mo"
    file.write_text(f"{DECLARED}{more}equation\n  der(s) = v;\n  J*der(w) = tau;\n  {equation}\nend M;\n")
    return tuple(w for w in compile_modelica(file, "M").warnings if "units differ" in w)


def test_units_of_another_scale_are_told_with_it(tmp_path):
    more = '  parameter Real h(unit = "min") = 1; Real f(unit = "1/s") = 1/h;'
    assert findings(tmp_path, GOOD[0], more) == ("M.mo:12: the units differ: 1/s and 0.0166667 1/s",)


def test_constants_of_packages_keep_their_units(tmp_path):
    more = '  package P constant Real k(unit = "N/m") = 3; constant Real plain = 3; end P; Real f(unit = "N");\n'
    assert findings(tmp_path, GOOD[0], more + 'Real g(unit = "N") = P.plain*v; equation f = P.k*s;') == ()
    assert findings(tmp_path, GOOD[0], more + "equation f = P.k*v;") == (
        "M.mo:13: the units differ: N and kg.m/s3",
    )


IF_EQUATIONS = {
    "q = s; der(v) = F/m; else q = F; der(v) = 2*F/m;": (),
    "q = s; m*der(v) = F; else m*der(v) = F; q = s;": (),
    "q = s; der(v) = F/m; else q = F; der(v) = c;": (("m/s2", "N/m"),),
    "q = s + F; der(v) = F/m; else q = F; der(v) = F/m;": (("m", "N"),),
}


@pytest.mark.parametrize("branches", IF_EQUATIONS)
def test_branches_of_if_equations_need_not_have_one_unit(tmp_path, branches):
    """In a curve with a parameter (an ideal switch, a port of a tank) it changes with the branch."""
    told = findings(tmp_path, f"if s > 1 then {branches} end if;", "  Real q;\n")
    assert told == tuple(f"M.mo:16: the units differ: {a} and {b}" for a, b in IF_EQUATIONS[branches])


@pytest.mark.parametrize("branches", ["q = s; else q = F;", "q = s; else F = q;"])
def test_conditions_of_if_equations_are_checked(tmp_path, branches):
    told = findings(tmp_path, f"if s > F then {branches} end if; m*der(v) = F;", "  Real q;\n")
    assert told == ("M.mo:16: the units differ: m and N",)


DISPLAYED = {
    'unit = "K", displayUnit = "degF"': "",
    'unit = "J", displayUnit = "kWh"': "",
    'unit = "rad/s", displayUnit = "1/min"': "the displayUnit '1/min' of 'x' is no multiple of the unit 'rad/s'",
    'unit = "furlong", displayUnit = "m"': "the displayUnit 'm' of 'x' is no multiple of the unit 'furlong'",
    'displayUnit = "bar"': "the displayUnit 'bar' of 'x' belongs to no unit",
}


@pytest.mark.parametrize("attributes", DISPLAYED)
def test_display_units_that_are_none_are_left_out_and_reported(tmp_path, attributes, caplog):
    file, warning = tmp_path / "D.mo", DISPLAYED[attributes]
    file.write_text(f"model D\n  Real x[2](each {attributes.replace(',', ', each')}) = {{1, time}};\nend D;\n")
    build(file, "D", tmp_path)  # which a fixture validates
    assert caplog.messages == ([f"warning: D: D.mo:2: {warning}; it is left out"] if warning else [])


def test_a_model_without_variables_is_valid(tmp_path):
    file = tmp_path / "Empty.mo"
    file.write_text("model Empty\nend Empty;\n")
    variables = read_model_description(str(build(file, "Empty", tmp_path))).modelVariables
    assert [v.name for v in variables] == ["time"]


@pytest.mark.parametrize("equation", GOOD)
def test_consistent_units_are_not_mentioned(tmp_path, equation):
    assert findings(tmp_path, equation) == ()


@pytest.mark.parametrize("equation", BAD)
def test_units_that_differ_are_told_with_their_line(tmp_path, equation):
    line = DECLARED.count("\n") + 4
    assert findings(tmp_path, equation) == (f"M.mo:{line}: the units differ: {' and '.join(BAD[equation])}",)


@pytest.mark.parametrize(
    ("more", "units"),
    [
        ('  Real angle(unit = "deg") = n;\n', ("deg", "1")),
        ('  Real speed(unit = "rpm") = w;\n', ("rpm", "rad/s")),
        ('  parameter Real k(unit = "N") = tau;\n', ("N", "N.m")),
        ('  Real y(unit = "m", start = m) = s;\n', ("m", "kg")),
        ('  discrete Real d(unit = "m");\nequation\n  when v > 1 then\n    d = v;\n  end when;\n', ("m", "m/s")),
    ],
)
def test_declarations_and_when_clauses_are_looked_at(tmp_path, more, units):
    (finding,) = findings(tmp_path, "m*der(v) = F;", more)
    assert finding.endswith(f"the units differ: {' and '.join(units)}")


@pytest.mark.parametrize("value", ["1/50", "-2*3", "380e3*sqrt(2/3)", "max(1, 2)^2"])
def test_a_value_made_of_literals_has_the_unit_of_what_it_is_given_to(tmp_path, value):
    assert findings(tmp_path, "m*der(v) = F;", f'  parameter Real period(unit = "s") = {value};\n') == ()


def test_a_factor_made_of_whole_literals_changes_no_unit(tmp_path):
    (finding,) = findings(tmp_path, "m*der(v) = (1/2)*c*v;")
    assert finding.endswith("the units differ: kg.m/s2 and kg.m/s3")


def test_connected_signals_have_one_unit(tmp_path):
    file = tmp_path / "M.mo"
    file.write_text(
        "model M\n  Drives.Signals.SpeedController controller(w_ref = 1);\n"
        "  Drives.Components.Torque torque;\n  Drives.Components.Inertia inertia;\n"
        "equation\n  controller.w = inertia.w;\n  connect(torque.flange, inertia.flange_a);\n"
        "  connect(controller.i, torque.tau);\nend M;\n"
    )
    (finding,) = (w for w in compile_modelica(file, "M", [MODELICA]).warnings if "units differ" in w)
    assert finding.startswith("M.mo:8: ")
    assert set(finding.rpartition(": ")[2].split(" and ")) == {"A", "N.m"}


@pytest.mark.parametrize("setup", SETUPS, ids=lambda p: p.stem)
def test_shipped_models_have_consistent_units(setup):
    assert check(load(setup, f"{setup.parents[1].name}.Setups.{setup.stem}", [MODELICA])) == []


def test_a_wrong_unit_in_the_library_is_found(tmp_path):
    shutil.copytree(MODELICA / "Drives", tmp_path / "Drives")
    types = tmp_path / "Drives" / "Types.mo"
    types.write_text(types.read_text().replace('final unit = "N.m/A"', 'final unit = "N.m/rad"'))
    setup = tmp_path / "Drives" / "Setups" / "FixedShaft.mo"
    (finding,) = check(load(setup, "Drives.Setups.FixedShaft"))
    assert finding.startswith("Motor.mo:11: the units differ: N.m and ")
