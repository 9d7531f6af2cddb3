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
  model Whole extends Part; end Whole;
"""
REFUSED = {
    "Part b(law.k = 3);": "dotted name",
    "extends Part(redeclare model Law = Two(k = 3));": "redeclared in a modification",
    "extends Whole(redeclare Two law);": "'law', which 'Whole' itself inherits",
    "Holder h(part(redeclare Two law));": "below the first level",
    "Holder h(part(redeclare model Law = Two));": "below the first level",
    "One o(k = break);": "'break'",
    "extends Part; redeclare model extends Law Real z = 1; end Law;": "'redeclare ... extends'",
    "Real x = missing;": "'missing'",
    "Real x = Modelica.Constants.pi;": "Modelica.Constants.pi",
    "Real x = Modelica.Math.sin(time);": "Modelica.Math.sin",
    "Real u = time; Real y = der(u^2);": "der",
    "Real x(start = 1, fixed = true); parameter Real k = x; equation der(x) = -k;": "parameter 'k'",
    "Real k = 5; One o(k = k);": "parameter 'o.k' depends on 'k', which is no parameter",
    "Real x; algorithm x := 0; for i in 1:3 loop x := x + i; end for;": "algorithm",
    "Real x; equation Connections.root(x); x = 1;": "Connections.root",
    "One o; One o;": "o",
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
