"""What is outside the subset is refused with the construct and its line, never mistranslated."""

from __future__ import annotations

from pathlib import Path

import pytest

from fmu_build import compile_modelica
from fmu_build.errors import ModelicaError

# One construct a line; the refusal must name its line.
LAWS = """package P
  model One parameter Real k = 1; Real y = k; end One;
  model Two extends One(k = 2); end Two;
  model Part replaceable One law; replaceable model Law = One; Law other; end Part;
  model Whole extends Part; end Whole; type Kind = enumeration(one, two);
"""
REFUSED = {
    "One o(k = break);": "'break'",
    "Real x = missing;": "'missing'",
    "Real x = Modelica.Constants.nothing;": "'Modelica.Constants' has no 'nothing'",
    "Modelica.Blocks.Sources.Sine s;": "this needs the Modelica Standard Library, and it is not shipped; give the folder it lies in with --root",
    "Real x(start = 1, fixed = true); parameter Real k = x; equation der(x) = -k;": "parameter 'k'",
    "Real k = 5; One o(k = k);": "parameter 'o.k' depends on 'k', which is not a parameter",
    "Real x; equation Connections.root(x); x = 1;": "Connections.root",
    "One o; One o;": "'o' is declared twice",
    "One o(l = 3);": "'P.One' has no element 'l'",
    "One o(k = 2, k = 3);": "'k' is modified twice",
    "One o = 3;": "is not a variable and cannot have a value",
    "Real x(strat = 1) = 1;": "no attribute 'strat'; did you mean 'start'?",
    "extends Part(redeclare Two other);": "'other' is not replaceable",
    "extends Part(redeclare model other = Two);": "redeclared as an element of another kind",
    "redeclare One law;": "'law' is redeclared, but not inherited",
    "Missing m;": "there is no class 'Missing'",
    "Real x[2] = {1, 2, 3};": "'x' has size [2], its value has size [3]",
    "Real x[2]; equation x[3] = 1;": "subscript 3 is outside 1..2",
    "Real n = time; Real x[integer(n)];": "must be known at translation",
    "Real x; equation connect(x, x);": "'x' is not a connector",
    "Real x; equation if time > 1 then x = 1; end if;": "different numbers of equations",
    "Real x = noSuch(1);": "there is no function 'noSuch'",
    "Real x = sin(1, 2) + atan3(1);": "there is no function 'atan3'",
    "Real x = cardinality(x);": "'cardinality' is not supported",
    "Real x = terminal();": "'terminal' is not supported",
    "partial model Q end Q; Q q;": "partial class 'P.M.Q'",
    "function f input Real u; output Real y = u; end f; Real x = f(1, 2);": "f() has 1 arguments, not 2",
    "function f input Real u; output Real y = u; end f; Real x = f(v = 2);": "no argument 'v'",
    "function f input Real u; output Real y; equation y = u; end f; Real x = f(2);": "a function has no equations",
    "impure function f input Real u; output Real y = u; end f; Real x = f(time);": "impure function 'P.M.f'",
    "parameter Boolean b = true; impure function f output Real y = 1; end f; parameter Real x = if b then f() else 2;": "impure",
    'type T extends ExternalObject; function constructor input Real y; output T t; external "C" t = make(y); end constructor; '
    'end T; function g input T t; output Real y; external "C" y = read(t); end g; parameter T t = T(y = 1); Real x = g(t);': "external function 'P.M.",
    "import P.Kind.none; Real x = none;": "there is no 'P.Kind.none' to import",
    "final parameter Real k = 1; model Q extends One(final k = 4); end Q; Q q(k = 5);": "'k' is final",
    "outer Real w; Real x = w; model Z outer Real v; Real y = v; end Z; Z z;": "has an inner 'v'",
}
IF_EQUATIONS = {
    "Real w(start = 1), v(start = 0), t; equation der(w) = -t; der(v) = t;": "if time > 1 then w - v = 0; else t = 0; end if;",
    "Real x(start = 1), v(start = 0); equation der(x) = v;": "if time < 1 then der(v) = -x; else x = 1; end if;",
    "input Real u; Real a, b; equation": "if u > 0 then a = u; b = 2; else a = u; a - 1 = u; end if;",
}


def refusal(tmp_path: Path, text: str, class_name: str) -> str:
    file = tmp_path / "P.mo"
    file.write_text(text)
    with pytest.raises(ModelicaError) as caught:
        compile_modelica(file, class_name)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("line", REFUSED)
def test_refused_with_its_line(tmp_path, line):
    text = f"{LAWS}  model Holder Part part; end Holder;\n  model M\n{line}\n  end M;\nend P;\n"
    message = refusal(tmp_path, text, "P.M")
    assert message.startswith("P.mo:8: "), message
    assert any(words in message for words in REFUSED[line].split("|")), message


@pytest.mark.parametrize("rest", IF_EQUATIONS)
def test_branches_of_different_index_are_refused_with_their_line(tmp_path, rest):
    message = refusal(tmp_path, f"model M\n{rest}\n{IF_EQUATIONS[rest]}\nend M;\n", "M")
    assert message.startswith("P.mo:3: the branches of this if-equation"), message


@pytest.mark.parametrize(
    "body",
    [
        "input Real u; Real a, b; equation if u > 0 then a = u; b = 2; else a + b = u; a - b = 1; end if;",
        "Real s, v, i; equation if s > 0 then v = 0; i = s; else v = s; i = 0; end if; sin(time) = v + 2*i;",
    ],
)
def test_branches_of_different_form_and_the_same_index_are_translated(tmp_path, body):
    (tmp_path / "M.mo").write_text(f"model M {body} end M;")
    assert compile_modelica(tmp_path / "M.mo", "M").n_x == 0


def test_a_file_with_nothing_but_an_extends_is_looked_at_too(tmp_path):
    package = tmp_path / "P"
    package.mkdir()
    (package / "package.mo").write_text("package P end P;")
    for name, text in {
        "A": "model A parameter Real k = 1; end A;",
        "B": "model B A a; Real y = a.k; end B;",
        "C": "model C\n  extends B(a(k = break));\nend C;",
        "D": "model D extends C; end D;",
    }.items():
        (package / f"{name}.mo").write_text(f"within P;\n{text}")
    with pytest.raises(ModelicaError, match=r"C\.mo:3: 'break' in a modification"):
        compile_modelica(package / "D.mo", "P.D")


def test_a_message_is_one_line_of_readable_length(tmp_path):
    library = tmp_path / "lib"
    (library / "Q" / "R").mkdir(parents=True)
    for k in range(30):
        (library / "Q" / "R" / f"C{k}.mo").write_text(f"within Elsewhere;\nmodel C{k} end C{k};")
    (tmp_path / "M.mo").write_text("model M Q.R.C1 c; end M;")
    with pytest.raises(ModelicaError) as caught:
        compile_modelica(tmp_path / "M.mo", "M", [library])
    assert len(str(caught.value)) < 500
