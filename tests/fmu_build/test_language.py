"""Each construct of the language subset gives the value that Modelica defines; the rest is refused."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fmu_build import compile_modelica
from fmu_build.errors import ModelicaError
from fmu_build.model import CompiledModel
from tests.fmu_build.simulate import Instance, find, values

LANGUAGE = Path(__file__).parent / "models" / "Language.mo"
NOTHING = np.zeros(0)


@cache
def compiled(name: str) -> CompiledModel:
    return compile_modelica(LANGUAGE, f"Language.{name}")


def test_parameters_follow_each_other():
    instance = Instance.of(compiled("Parameters"), {"a": 4.0})
    x = instance.start()

    def get(name: str) -> float:
        return instance.get(name, 0.0, x)

    assert [get(n) for n in ("b", "copy", "later", "fixedValue", "c", "n", "unbound")] == [
        10.5, 4.0, 31.5, 7.0, 2.5, 3.0, 4.0,
    ]  # fmt: skip
    assert get("vector[2]") == 4.0
    assert get("product") == 1.0 + 16.0 + 9.0
    assert (get("s"), get("q")) == (3.0, 17.5)
    np.testing.assert_allclose(instance.derivative(0.0, np.array([1.0, 2.0, 3.0])), [-1.0, -5.0, -10.0])


def test_boolean_and_enumeration_parameters_choose_at_run_time():
    instance = Instance.of(compiled("Parameters"), {"swap": 1.0, "mode": 1.0})
    x = instance.start()
    assert instance.get("s", 0.0, x) == -3.0
    assert instance.get("q", 0.0, x) == instance.get("later", 0.0, x)


def test_parameters_as_fmi_sees_them():
    model = compiled("Parameters")
    a, b, n = find(model, "a"), find(model, "b"), find(model, "n")
    assert (a.causality, a.initial, a.start, a.min, a.max) == ("parameter", "exact", 2.0, 0.0, 10.0)
    assert (a.unit, a.description) == ("m", "A length")
    assert (b.causality, b.initial, b.start) == ("calculatedParameter", "calculated", None)
    assert find(model, "copy").causality == "calculatedParameter"
    assert (n.causality, n.variability) == ("local", "constant"), "it decides array sizes"
    assert find(model, "fixedValue").variability == "constant"
    assert find(model, "table[2,2]").start == 3.0
    assert find(model, "mode").enumeration == ("Stuck", "Forward", "Backward")
    assert find(model, "swap").type == "Boolean"
    assert any("unbound" in w for w in model.warnings)


@pytest.mark.parametrize(("u", "y", "z"), [(-1.0, 1.0, 1.0), (0.5, 2.0, 1.0), (1.25, 3.25, 3.0), (9.0, 4.0, 4.0)])
def test_functions(u, y, z):
    instance = Instance.of(compiled("Functions"))
    assert instance.get("y", 0.0, NOTHING, [u]) == pytest.approx(y)
    assert instance.get("z", 0.0, NOTHING, [u]) == z
    assert instance.get("total", 0.0, NOTHING, [u]) == pytest.approx(6 * u**2)
    assert instance.get("largest", 0.0, NOTHING, [u]) == max(u, 2 * u, -u)


@pytest.mark.parametrize("u", [-7.3, -2.0, -1.5, -0.4, 0.0, 0.3, 1.0, 1.7, 4.0, 6.5])
def test_arithmetic(u):
    instance = Instance.of(compiled("Arithmetic"))
    expected = [
        math.sqrt(max(u, 0.0)),
        u,
        max(u, 2) + min(u, -1),
        math.atan2(u, 2) + math.sinh(u / 10) + math.log10(abs(u) + 1),
        u - math.floor(u / 3) * 3,
        math.fmod(u, 3) + math.trunc(u / 2),
        math.floor(u) + math.ceil(u),
        abs(u) * u,
        math.exp(-u * u) + math.tanh(u) + math.cos(u) ** 3,
        u + 5 + 2 * u + 3 * u,
        u + 2,
        3 * u + 4,
        u + 16,
        6 * u + max(u, 4),
        1.0 if u > 1 or -2 <= u < -1 else 2.0,
        math.log(u) if u > 0 else math.log(-u) if u < -1 else 0.0,
    ]
    got = [instance.get(f"y[{i + 1}]", 0.0, NOTHING, [u]) for i in range(16)]
    np.testing.assert_allclose(got, expected, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("u", [-7.3, -0.4, 0.0, 0.3, 6.5])
def test_derivatives_never_come_from_the_branch_not_taken(u):
    instance = Instance.of(compiled("Arithmetic"))
    dv = instance.model.functions["variable_partials"](*instance.env(0.0, NOTHING, [u]), [], [1.0], [], [], [])
    assert np.all(np.isfinite(values(dv)))
    where = find(instance.model, "y[1]").location
    assert values(dv)[where.index] == pytest.approx(0.5 / math.sqrt(u) if u > 0 else 0.0)


def test_linear_loop_is_solved_symbolically():
    instance = Instance.of(compiled("LinearLoop"))
    assert instance.model.n_y == 0
    solution = np.linalg.solve([[2, 3, 1], [3, -2, 1], [1, 1, -2]], [5.0, 1.0, 0.25])
    got = [instance.get(n, 0.25, NOTHING, [5.0]) for n in "xyz"]
    np.testing.assert_allclose(got, solution, rtol=1e-12)


def test_nonlinear_loop_is_left_to_newton_with_its_jacobian():
    instance = Instance.of(compiled("NonlinearLoop"))
    assert instance.model.n_y == 1
    x = instance.simulate([0.0, 1.0])
    m, angle = x[-1, 0], instance.get("angle", 1.0, x[-1])
    assert angle - 0.6 * math.sin(angle) == pytest.approx(m, abs=1e-12)
    assert instance.get("x", 1.0, x[-1]) == pytest.approx(math.cos(angle) - 0.6)
    # the whole derivative of the output along x, loop included
    f, env = instance.model.functions, instance.env(1.0, x[-1])
    slope = f["loop"](*env)[1]
    by_x = f["jacobian"](*env)[1][-1, 0]
    (along,) = values(f["loop_partials"](*env, [1.0], [], np.zeros(1), []))
    assert along == float(by_x)
    sy = -along / float(slope)
    dv = f["variable_partials"](*env, [1.0], [], np.zeros(1), [], [sy])
    assert values(dv)[find(instance.model, "x").location.index] == pytest.approx(
        -math.sin(angle) / (1 - 0.6 * math.cos(angle))
    )


def test_initial_equations():
    model = compiled("SteadyStart")
    assert model.has_initial
    x = Instance.of(model, {"u": 7.5}).start()
    np.testing.assert_allclose(x, [2.0, 0.5], rtol=1e-12)
    assert find(model, "x").initial == "approx"
    assert find(model, "w").initial == "exact"


def test_redeclared_component_and_conditional_variable():
    instance = Instance.of(compiled("Redeclared"))
    assert instance.get("y", 0.0, NOTHING, [2.0]) == 36.0
    assert instance.get("loss", 0.0, NOTHING, [2.0]) == 12.0


def test_algorithm_section():
    instance = Instance.of(compiled("WithAlgorithm"))
    assert [instance.get("x", t, NOTHING) for t in (0.5, 2.0)] == [3.0, 4.0]


def test_a_parameter_that_decides_a_size_becomes_a_constant():
    model = compiled("Sized")
    assert find(model, "m").variability == "constant"
    assert find(model, "k").variability == "constant", "its value is used up with m's"
    assert Instance.of(model).get("y", 0.0, NOTHING) == 6.0


def test_assertions():
    instance = Instance.of(compiled("Checked"))
    model = instance.model
    assert model.n_assert == 2

    def hold(u: float) -> list[bool]:
        return [bool(a) for a in values(model.functions["asserts"](*instance.env(0.0, NOTHING, [u])))]

    assert hold(6.0) == [False, True]
    assert hold(-6.0) == [True, False]
    assert "Language.mo:" in model.c_header
    assert "u is \\001%.6g\\001, too much" in model.c_header, "with the value of the moment"


def test_a_while_loop_that_a_variable_ends():
    model = compile_modelica(LANGUAGE, "Language.WhileLoop")
    instance = Instance.of(model)
    assert [instance.get("y", 0.0, NOTHING, [u]) for u in (0.5, 20.0, 2.0**90)] == [0.5, 20.0 / 32.0, 1.0]
    ends = [values(model.functions["asserts"](*instance.env(0.0, NOTHING, [2.0**k])))[0] for k in (90, 150)]
    assert ends == [1.0, 0.0], "a loop of more than 100 rounds is an error, never a wrong number"
    assert "Language.mo:68: a while loop goes on for more than 100 rounds" in model.c_header


def test_parameters_stay_parameters_where_a_loop_has_an_end_whatever_they_are(tmp_path):
    (tmp_path / "Loops.mo").write_text("""
model Loops
  function divided input Real u, limit; output Real y; algorithm
    y := u; while y > limit loop y := y/2; end while; end divided;
  function row input Real x, t[:]; output Integer i; algorithm
    i := 1; while i < size(t, 1) and t[i] < x loop i := i + 1; end while; end row;
  function equal "As Modelica.Math.Matrices.isEqual: a difference sets both counters to their ends"
    input Real a[:, :], b[:, :]; output Boolean same; protected Integer i, j;
  algorithm
    same := true; i := 1;
    while i <= size(a, 1) loop
      j := 1;
      while j <= size(a, 2) loop
        if a[i, j] <> b[i, j] then same := false; i := size(a, 1); j := size(a, 2); end if;
        j := j + 1;
      end while;
      i := i + 1;
    end while;
  end equal;
  function root input Real c; output Real x; protected Real e; algorithm
    x := c; e := 1; while e > 1e-13 loop e := abs(x - c/x); x := (x + c/x)/2; end while; end root;
  parameter Real limit = 3, x = 2.5, c = 2, t[2, 3] = [1, 2, 3; 4, 5, 6];
  input Real u; output Real y = divided(u, limit); output Real i = row(x, {1, 2, 3, 4}); output Real square = root(c)^2;
  output Real same = if equal(t, [1, 2, 3; 4, 5, 7]) then 1 else 0;
end Loops;
""")
    model = compile_modelica(tmp_path / "Loops.mo", "Loops")
    vectors = {name: find(model, name).location.vector for name in ("limit", "x", "t[1,1]", "c")}
    assert vectors == {"limit": "p", "x": "p", "t[1,1]": "p", "c": "constant"}

    def outputs(**values: float) -> list[float]:
        instance = Instance.of(model, {name.replace("_", ","): v for name, v in values.items()})
        return [instance.get(name, 0.0, NOTHING, [8.0]) for name in ("y", "i", "square", "same")]

    assert outputs(limit=5.0, x=3.5) == pytest.approx([4.0, 4.0, 2.0, 0.0])
    assert outputs(**{"t[2_3]": 7.0}) == pytest.approx([2.0, 3.0, 2.0, 1.0])
    for element in ("t[1_1]", "t[1_3]", "t[2_1]", "t[2_2]"):
        assert outputs(**{"t[2_3]": 7.0, element: 0.0})[-1] == 0.0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("InputDerivative", r"Language\.mo:\d+: .*der"),
        ("Singular", r"Language\.mo:\d+: singular"),
        ("Contradiction", r"Language\.mo:\d+: .*contradict"),
        ("Circle", r"Language\.mo:\d+: parameters depend on each other"),
    ],
)
def test_refused_in_one_line(name, message):
    with pytest.raises(ModelicaError, match=message) as caught:
        compile_modelica(LANGUAGE, f"Language.{name}")
    assert "\n" not in str(caught.value)


def test_errors_of_the_source_have_their_line(tmp_path):
    file = tmp_path / "M.mo"
    file.write_text("model M\n  Real x;\nequation\n  x = ;\nend M;\n")
    with pytest.raises(ModelicaError, match=r"M\.mo:4: unexpected"):
        compile_modelica(file, "M")
    with pytest.raises(ModelicaError, match="no such Modelica file"):
        compile_modelica(tmp_path / "N.mo", "N")
    file.write_text("model M\n  Real x = y;\nend M;\n")
    with pytest.raises(ModelicaError, match=r"M\.mo:2: there is no variable 'y'"):
        compile_modelica(file, "M")


@pytest.mark.parametrize(
    "tail", ["// the end", "// the end\n", "/* the end */", "/* the end */\n", "\n\n// a\n// b"]
)
def test_a_file_may_end_with_a_comment(tmp_path, tail):
    file = tmp_path / "M.mo"
    file.write_text(f"// M\nmodel M\n  Real x = 2; /* x */\nend M;{tail}")
    assert [v.name for v in compile_modelica(file, "M").variables] == ["x"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("/* not closed", r"M\.mo:3: this comment does not end"),
        ('Real y "not closed;', r"M\.mo:3: this string does not end"),
        ("Real y = 2 § 3;", r"M\.mo:3: unexpected '§'"),
        ('Real y; // fine " here\n Real z = 1 ? 2;', r"M\.mo:4: unexpected '\?'"),
    ],
)
def test_what_is_no_token_has_its_line(tmp_path, line, message):
    file = tmp_path / "M.mo"
    file.write_text(f"model M\n  Real x = 2;\n{line}\nend M;\n")
    with pytest.raises(ModelicaError, match=message):
        compile_modelica(file, "M")


def test_operators_arrays_functions_and_modifiers():
    model = compile_modelica(LANGUAGE.with_name("Semantics.mo"), "Semantics.T")
    instance = Instance.of(model)
    env = instance.env(0.0, NOTHING)
    env[5], env[7], _ = instance.settle(env, init=1.0)
    v = values(model.functions["variables"](*env))
    a = np.arange(1.0, 10.0).reshape(3, 3)
    f = 8 + (1 + 2 + 7 + 8) + np.arange(1, 4) @ a[:, :2].sum(axis=1) - 1
    expected = [
        -4, 8, 7, -4, 1, 1, 5 + 8, 9 + 4, 16 + 9, 9 - 1, f + 1, f + 4, 1 + 2, 120, 3, 3 + 4, a[0] @ a[:, 0],
        (a @ a).sum(), a[0].sum(), -4, 5, 5, 1, 2.501, 6 + 1 + 11, 6 + 45 + 6, 3 - 1 - 3 + 3 - 1, 6, 4, 5, 6, 8,
        2.5, 2, 2, 3 + 11, 6 + 2,
    ]  # fmt: skip
    places = [find(model, f"y[{k + 1}]").location for k in range(len(expected))]
    got = [{"v": v, "p": instance.p}[place.vector][place.index] for place in places]
    np.testing.assert_allclose(got, expected, rtol=1e-14)
    modified = {"mid.q": 5, "mid.r": 10, "mid.sub[1].q": 5, "mid.sub[2].q": 10, "mid.sub[1].r": 10, "mid2.q": 2,
                "mid2.r": 1, "mid2.sub[2].q": 4, "mid2.sub[1].r": 9}  # fmt: skip
    assert {name: instance.get(name, 0.0, NOTHING) for name in modified} == modified
    assert env[5][find(model, "bb").location.index] == 1
    assert env[5][find(model, "ii").location.index] == 3 + 2 + 2


def test_latin_1_is_read_with_a_warning(tmp_path):
    (tmp_path / "M.mo").write_bytes('model M "Gr\xf6\xdfe" Real x = time; end M;'.encode("latin-1"))
    model = compile_modelica(tmp_path / "M.mo", "M")
    assert model.description == "Gr\xf6\xdfe"
    assert model.warnings == ("M.mo: not UTF-8, so it is read as Latin-1",)


def test_terminal_is_reported(tmp_path):
    (tmp_path / "M.mo").write_text(
        "model M discrete Real x; equation when terminal() then x = 1; end when; end M;"
    )
    (warning,) = compile_modelica(tmp_path / "M.mo", "M").warnings
    assert warning == "M.mo:1: terminal() is never true, because an FMU does not know where its simulation ends"


def test_a_connector_that_extends_a_record_has_no_flow_where_nothing_is_connected(tmp_path):
    text = """model M
      record R Real v; end R;
      connector C extends R; flow Real i; end C;
      C c;
      output Real y = c.i;
      equation c.v = 2*time;
    end M;"""
    file = tmp_path / "M.mo"
    file.write_text(text)
    assert find(compile_modelica(file, "M"), "y")
