"""Algebraic loops with several solutions, without one, and what assertions say."""

from __future__ import annotations

from pathlib import Path

import fmpy
import numpy as np
import pytest

from fmu_build import build, compile_modelica
from fmu_build.errors import ModelicaError
from fmuid.core.errors import SimulationError
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Task

LIMITS = {
    "plain": "y = if V0*e > 1 then 1 else if V0*e < -1 then -1 else V0*e;",
    "smooth": "y = smooth(0, if V0*e > 1 then 1 else if V0*e < -1 then -1 else V0*e);",
    "strict": "y = smooth(0, noEvent(if V0*e > 1 then 1 else if V0*e < -1 then -1 else V0*e));",
}
REFUSED = {
    "noEvent": "y = noEvent(if V0*e > 1 then 1 else if V0*e < -1 then -1 else V0*e);",
    "min": "y = min(1, max(-1, V0*e));",
}
GAIN = 1000.0
SCHMITT = "parameter Real V0 = 1000; Real u = 2*sin(2*3.141592653589793*time); Real y{start}; Real e = 0.5*y - u; equation "
ASTABLE = "parameter Real V0 = 1000; Real x(start = 0.1, fixed = true); Real y{start}; Real e = 0.5*y - x; equation der(x) = y - x; "


@pytest.fixture(scope="module")
def simulate(tmp_path_factory):
    """Simulates a model that is given by its text; each is built once."""
    built: dict[str, Path] = {}

    def run(text: str, outputs: list[str], stop_time: float = 2.0, **options: object) -> np.ndarray:
        if text not in built:
            folder = tmp_path_factory.mktemp("limits")
            file = folder / "M.mo"
            file.write_text(f"model M {text} end M;")
            built[text] = build(file, "M", folder)
        return fmpy.simulate_fmu(
            str(built[text]), output=outputs, stop_time=stop_time, output_interval=0.01, **options
        )

    return run


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("limit", LIMITS)
def test_a_schmitt_trigger_jumps_where_its_branch_ends(simulate, limit, kind):
    text = SCHMITT.format(start="(start = 1)") + LIMITS[limit]
    simulated = simulate(text, ["u", "y"], fmi_type=kind)
    expected, branch = [], 1.0
    for u in 2 * np.sin(2 * np.pi * simulated["time"]):
        branch = -1.0 if u > 0.5 - 1 / GAIN else 1.0 if u < -0.5 + 1 / GAIN else branch
        expected.append(branch)
    away = np.abs(np.abs(simulated["u"]) - 0.5) > 0.01
    np.testing.assert_allclose(simulated["y"][away], np.array(expected)[away], atol=1e-6)


@pytest.mark.parametrize(
    ("tolerance", "kind"), [(1e-4, "CoSimulation"), (1e-7, "CoSimulation"), (1e-6, "ModelExchange")]
)
@pytest.mark.parametrize("limit", LIMITS)
def test_a_multivibrator_has_its_period_whatever_the_solver(simulate, limit, tolerance, kind):
    text = ASTABLE.format(start="(start = 1)") + LIMITS[limit]
    simulated = simulate(text, ["x", "y"], fmi_type=kind, relative_tolerance=tolerance, stop_time=10.0)
    edge = 0.5 - 1 / GAIN
    falls = simulated["time"][1:][np.diff(simulated["y"]) < -1.9]
    assert np.diff(falls) == pytest.approx(2 * np.log((1 + edge) / (1 - edge)), abs=0.0201)
    assert np.abs(simulated["x"]).max() == pytest.approx(edge, abs=2e-3)


@pytest.mark.parametrize(("start", "first"), [("(start = 1)", 1.0), ("(start = -1)", -1.0)])
@pytest.mark.parametrize("limit", [LIMITS["plain"], "y = if e > 0 then 1 else -1;"])
def test_a_start_value_chooses_the_first_solution(simulate, start, first, limit):
    simulated = simulate(SCHMITT.format(start=start) + limit, ["y"])
    assert simulated["y"][0] == first


def test_homotopy_chooses_the_first_solution_and_nothing_is_told(simulate, tmp_path):
    limit = LIMITS["smooth"].replace("y = ", "y = homotopy(").replace(";", ", -1);")
    file = tmp_path / "M.mo"
    file.write_text(f"model M {SCHMITT.format(start='')} {limit} end M;")
    assert compile_modelica(file, "M").warnings == ()
    assert simulate(SCHMITT.format(start="") + limit, ["y"])["y"][0] == -1.0
    file.write_text(f"model M {SCHMITT.format(start='')} {LIMITS['plain']} end M;")
    (warning,) = compile_modelica(file, "M").warnings
    assert "may have several solutions" in warning


INITIAL = {
    # Newton's first step from (10, 10) ends at (15, 2.5), where the Jacobian is singular
    "past a point where they are singular": (
        "Real x(start = 10); Real y(start = 10); initial equation der(x) = 0; der(y) = 0; "
        "equation der(x) = x*(0.1 - 0.02*y); der(y) = y*(0.01*x - 0.3);", {"x": 30, "y": 5},
    ),
    "from where whole steps lead away": (
        "Real x(start = 5); initial equation der(x) = 0; equation der(x) = atan(1 - x);", {"x": 1},
    ),
    "over a bend between whose sides whole steps go to and fro": (
        "Real x(start = 3); Real y; initial equation der(x) = 0; equation der(x) = -y; "
        "y = smooth(0, noEvent(if x > 0.1 then 1 + 0.1*x else if x < -0.1 then -1 + 0.1*x else 10.1*x));", {"x": 0},
    ),
    "from zero, where they are singular": (
        "Real x; initial equation der(x) = 0; equation der(x) = 4 - x^2;", {"x": 2},
    ),
    "where friction holds what shall not accelerate, whatever the current": (
        "Real w(start = 0, fixed = true); Real i(start = 3); Real x(start = 5); initial equation der(w) = 0; der(x) = 0; "
        "equation der(w) = if i <= 4 then 0 else i - 4; der(i) = -i; der(x) = w - x;", {"i": 3, "x": 0},
    ),
    "where friction holds it after all, from the start value again": (
        "Real w(start = 0, fixed = true); Real i(start = 3); Real x(start = 0); initial equation der(w) = 0; der(x) = 0; "
        "equation der(w) = if x > 0.5 then 0 else i - 4; der(i) = -i; der(x) = 1 - x;", {"i": 3, "x": 1},
    ),
    "by a parameter, where a start is fixed that is no state's": (
        "parameter Real c(fixed = false, start = 3); Real x(start = 2, fixed = true); Real v(start = 0, fixed = true); "
        "Real a(start = 0, fixed = true); equation der(x) = v; der(v) = a; a = 8 - c*x;", {"c": 4, "x": 2},
    ),
    "by a parameter, on which one depends that is to be evaluated": (
        "parameter Real n(fixed = false); parameter Real k = 2*n annotation(Evaluate = true); "
        "Real x(start = 3, fixed = true); initial equation n = x + 1; equation der(x) = -k*x;", {"k": 8, "der(x)": -24},
    ),
    "with a branch that they choose": (
        "parameter Boolean up(fixed = false); Real y; Real x(start = 2, fixed = true); initial equation up = y > 3; "
        "equation y = 2*x; der(x) = if up then 1 else -1;", {"up": 1, "der(x)": 1},
    ),
    "with a flow that says nothing where its valve is shut": (
        "connector P Real p; flow Real q(start = 0); end P; "
        "model T P p(p(start = 2)); initial equation p.p = 3; equation der(p.p) = p.q; end T; "
        "model V P a; P b; Real o; equation a.q + b.q = 0; a.q = o*(a.p - b.p); der(o) = 1 - o; end V; "
        "T t; V v; T r; equation connect(t.p, v.a); connect(v.b, r.p);", {"t.p.p": 3, "v.o": 0},
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", INITIAL)
def test_initial_equations_are_solved(simulate, case):
    text, values = INITIAL[case]
    simulated = simulate(text, list(values), stop_time=0.1)[0]
    assert {name: simulated[name] for name in values} == pytest.approx(values, rel=1e-9, abs=1e-9)


def test_what_is_at_rest_stays_at_rest_beside_equations_that_move_it_much_more(simulate):
    text = (
        "Real w(start = 0, fixed = true); Real a(start = 1); Real b(start = 2); initial equation der(a) = 0; der(b) = 0; "
        "equation der(w) = -w; der(a) = 1e6*w + 0.1*a + 0.3*b - 0.7; der(b) = 3e5*w - 0.3*a + 0.1*b - 0.1;"
    )
    assert simulate(text, ["w"], stop_time=0.1)["w"][0] == 0.0


def test_what_is_driven_back_to_its_threshold_stays_there_within_the_tolerance(simulate, capfd):
    text = "Real x(start = 1.2, fixed = true); equation der(x) = if x >= 1 then -1 else 1;"
    simulated = simulate(text, ["x"], stop_time=0.5, relative_tolerance=1e-4)
    np.testing.assert_allclose(simulated["x"], np.maximum(1.2 - simulated["time"], 1), atol=2e-4)
    # Not by a logger of its own: FMPy goes on calling the last one, which may be gone by then.
    assert capfd.readouterr().out.count("chattering") == 1


@pytest.mark.parametrize("limit", REFUSED)
def test_limits_that_are_no_events_are_refused_where_they_have_several_solutions(tmp_path, limit):
    file = tmp_path / "M.mo"
    file.write_text(f"model M {SCHMITT.format(start='')}\n{REFUSED[limit]} end M;")
    with pytest.raises(ModelicaError, match=r"M\.mo:2: the loop of y has several solutions"):
        compile_modelica(file, "M")
    file.write_text(f"model M {SCHMITT.format(start='').replace('0.5*y', '-0.5*y')} {REFUSED[limit]} end M;")
    assert compile_modelica(file, "M").n_y == 1


def failure(folder, text: str, output: str) -> str:
    (folder / "M.mo").write_text(f"model M {text} end M;")
    with pytest.raises(SimulationError) as caught:
        Fmu(build(folder / "M.mo", "M", folder)).simulate(Task(np.linspace(0, 1, 11), {}, (output,)), {})
    return str(caught.value)


def test_a_linear_loop_that_is_singular_at_a_sample_is_an_error_there(tmp_path):
    text = "Real a; Real b; equation a + b = 1; a + (time + 0.5)*b = 2;"
    message = failure(tmp_path, text, "a")
    assert "t = 0.5: a is " in message
    assert "singular" in message


SAID = {
    '"y = " + String(y)': "y = 0.5",
    '"k " + String(k) + ", n " + String(n) + ", " + String(on)': "k 2.34568, n 3, true",
    'String(k, significantDigits = 3, minimumLength = 6, leftJustified = false) + String(n, minimumLength = 3) + "|"': "  2.353  |",
    'String(k, format = "8.2f") + name': "    2.35abc",
    'String(kind) + " at " + String(y > 0.4)': "fast at true",
}


@pytest.mark.parametrize("message", SAID)
def test_messages_show_the_values_of_the_moment(tmp_path, message):
    text = f"""
      type Kind = enumeration(slow, fast);
      parameter Real k = 2.3456789; parameter Integer n = 3; parameter Boolean on = true; parameter String name = "abc";
      parameter Kind kind = Kind.fast; Real y = time;
      equation assert(y < 0.5 - 1e-9, {message});"""
    assert f": {' '.join(SAID[message].split())}" in failure(tmp_path, text, "y")


def test_a_format_that_is_none_is_refused(tmp_path):
    (tmp_path / "M.mo").write_text(
        'model M Real y = time;\nequation assert(y < 1, String(y, format = "s")); end M;'
    )
    with pytest.raises(ModelicaError, match=r"M\.mo:2: the format 's'"):
        compile_modelica(tmp_path / "M.mo", "M")


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_an_integer_overflow_ends_the_simulation(simulate, kind, capfd):
    text = "Integer n(start = 1, fixed = true); Real y = n; equation when sample(0.1, 0.1) then n = 10*pre(n); end when;"
    with pytest.raises(Exception, match="fmi2"):
        simulate(text, ["y"], fmi_type=kind)
    # By FMPy's own logger, as above.
    first = capfd.readouterr().out.splitlines()[0]
    assert first.endswith("t = 1: integer overflow: n would be 1e+10")


PRINTS = (
    "equation when y > 0.5 then {print}; end when;",
    "equation when y > 0.5 then if y > 2 then {print}; elseif y < 2 then {print}; end if; end when;",
    "algorithm when y > 0.5 then {print}; end when;",
    "initial equation if e < 1 then {print}; end if;",
)


@pytest.mark.parametrize("section", PRINTS)
def test_what_is_printed_is_a_warning(simulate, capfd, section):
    text = (
        'impure function print input String string = ""; input String fileName = "";'
        ' external "C" ModelicaInternal_print(string, fileName); end print; parameter Real e = 0; Real y = time; '
    )
    simulate(text + section.format(print='print("half, and n is " + String(2))'), ["y"], stop_time=1)
    assert capfd.readouterr().out.count("half, and n is 2") == 1


def test_an_assertion_among_initial_equations_is_checked_at_the_start_alone(simulate, tmp_path):
    text = 'Real y(start = {}, fixed = true); initial equation assert(y < 0.5, "too far"); equation der(y) = 1;'
    assert simulate(text.format(0), ["y"], stop_time=1)["y"][-1] == pytest.approx(1.0)
    assert "too far" in failure(tmp_path, text.format(0.6), "y")


@pytest.mark.parametrize("section", ["equation", "algorithm"])
def test_what_is_asserted_at_an_event_is_checked_there(tmp_path, section):
    text = f'Real y = time; {section} when y > 0.5 then assert(y > 1, "too early"); end when;'
    assert "too early" in failure(tmp_path, text, "y")
