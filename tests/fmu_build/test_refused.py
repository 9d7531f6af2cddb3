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
    "Modelica.Blocks.Sources.Sine s;": "this needs the Modelica Standard Library, which is not found: get it with",
    "Real x(start = 1, fixed = true); parameter Real k = x; equation der(x) = -k;": "parameter 'k'",
    "Real k = 5; One o(k = k);": "parameter 'o.k' depends on 'k', which is not a parameter",
    "Real x; equation Connections.uniqueRoot(x); x = 1;": "'Connections.uniqueRoot' is not supported",
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
    "Real x = cardinality(1);": "cardinality() is not allowed here",
    "Clock c = Clock(0.1);": "clocks are not supported; use sample() in a when-equation",
    "Real x = sample(time, Clock(0.1));": "clocks are not supported; use sample() in a when-equation",
    "Real x[2, 3]; Real y[2, 3] = x^2;": "^ on an array of size [2, 3], which is no square matrix",
    "Real x[3] = cat(2, {1, 2}, {3});": "cat(2, ...) of an array of size [2] and an array of size [1]",
    "partial model Q end Q; Q q;": "partial class 'P.M.Q'",
    "function f input Real u; output Real y = u; end f; Real x = f(1, 2);": "f() has 1 argument, not 2",
    "function f input Real u; output Real y = u; end f; Real x = f(v = 2);": "no argument 'v'",
    "function f input Real u; output Real y; equation y = u; end f; Real x = f(2);": "a function has no equations",
    "impure function f input Real u; output Real y = u; end f; Real x = f(time);": "impure function 'P.M.f'",
    "parameter Boolean b = true; impure function f output Real y = 1; end f; parameter Real x = if b then f() else 2;": "impure",
    'type T extends ExternalObject; function constructor input Real y; output T t; external "C" t = make(y); end constructor; '
    'end T; function g input T t; output Real y; external "C" y = read(t); end g; parameter T t = T(y = 1); Real x = g(t);': "external function 'P.M.",
    "import P.Kind.none; Real x = none;": "there is no 'P.Kind.none' to import",
    "final parameter Real k = 1; model Q extends One(final k = 4); end Q; Q q(k = 5);": "'k' is final",
    "function g input Real a; output Real y = 2*a; end g; function f output Real y; protected Real a; algorithm y := g(a); end f; Real x = f();": "'a' is used before it has a value",
    "Real x = delay(time, time);": "a delay time that varies is not supported",
    "Integer n; Real x = delay(time, n); equation when time > 1 then n = 1; end when;": "a delay time that varies is not supported",
    "Real y; equation (y, ) = spatialDistribution(1, 1, time, true, {0, 0.5}, {1, 1});": "initialPoints must rise from 0 to 1",
    "Real y; equation (y, ) = spatialDistribution(1, 1, time, true, {0, 1}, {1});": "2 initialPoints and 1 initialValues",
    "Real y; equation (y, ) = spatialDistribution(1, 1, time, true, {0, 1}, {1, time});": "initialValues that vary are not supported",
    "Real y; equation (y, ) = spatialDistribution({1, 2}, 1, time, true);": "spatialDistribution() of arrays is not supported",
    "Real y, x; equation x + sin(x) = time; (, y) = spatialDistribution(1, 1, x, true);": "the x of spatialDistribution() depends on an algebraic loop or on what leaves",
    "function f input Real u; output Real y; algorithm (, y) := spatialDistribution(u, u, u, true); end f; Real x = f(time);": "spatialDistribution() is not allowed in a function",
    "Real x = delay(time, -1);": "a delay of -1 s",
    "Real x = delay(time, 5.5, 1);": "a delay of 5.5 s, with a maximum of 1 s",
    "function f input Real u; output Real y = delay(u, 1); end f; Real x = f(time);": "delay() is not allowed in a function",
    "outer Real w; Real x = w; model Z outer Real v; Real y = v; end Z; Z z;": "has an inner 'v'",
}
INVALID = {  # specification 4, 5.3, 6, 7.1.3
    "Real x = if time then 1 else 2;": "a condition must be Boolean, not Real",
    "parameter Integer n = 2; Real x = if n then 1 else 2;": "a condition must be Boolean, not Integer",
    "Real x if 1;": "a condition must be a Boolean scalar, not a scalar number",
    "Real x; equation when time then x = 1; end when;": "a condition must be Boolean, not Real",
    "Integer n = 2.7;": "'n' is Integer, but its value is Real; use integer()",
    "parameter Integer n = 4/2;": "'n' is Integer, but its value is Real",
    "Integer n(start = 0.5);": "start of 'n' is Integer, but its value is Real",
    "Boolean b = 1;": "'b' is Boolean, but its value is Integer",
    'Real x = "a";': "'x' is Real, but its value is String",
    'Real x[integer("a")];': "a number is needed here, not a String (an argument of integer())",
    'Real x = sum({"a", "b"});': "the argument of sum() must be a number, not String",
    "Real x = true + 1;": "an operand of '+' must be a number, not Boolean",
    "Boolean b = not 1;": "the operand of 'not' must be Boolean, not Integer",
    "Boolean b = abs(true);": "the argument of abs() must be a number, not Boolean",
    "type A = enumeration(a, b); type B = enumeration(b, a); parameter A k = B.a;": "is enumeration(a, b), but its value is enumeration(b, a)",
    "type A = enumeration(a, b); parameter Integer k = A.b;": "is Integer, but its value is enumeration(a, b)",
    "Boolean b = P.Kind.one == 1;": "the operands of '==' are enumeration(one, two) and Integer",
    "type A = enumeration(start, b); parameter A a = A.b;": "an enumeration cannot have the literal 'start'",
    "function f input Real u; output Integer y; algorithm y := 2*u; end f; Real x = f(1);": "'y' is Integer, but its value is Real",
    "function f input Real u; output Real y; algorithm u := 1; y := u; end f; Real x = f(1);": "'u' is an input and cannot be assigned",
    "function f input Real u; Real z; output Real y; algorithm y := u; end f; Real x = f(1);": "'z' in a function must be an input, an output or protected",
    "function f input Integer k; output Real y = k; end f; Real x = f(1.5);": "argument 'k' of P.M.f() is Integer, but its value is Real",
    "discrete Real d = time;": "'d' is discrete and cannot have an equation here; assign it in a when-equation",
    "function f input Real u; output Integer n; algorithm n := integer(u); end f; Integer n = f(time);": "'n' changes at events only",
    "model H protected parameter Real k = 1; end H; H h; Real x = h.k;": "'k' is protected in 'h'",
    "model H protected parameter Real k = 1; end H; H h(k = 2);": "'k' is protected in 'h' and cannot be modified",
    "package H protected constant Real k = 1; end H; Real x = H.k;": "'k' is protected in 'P.M.H'",
    "Real y = 2; model H Real x = y; end H; H h;": "'y' belongs to the class around this one",
    "Real y = 2 if true; Real x = y;": "'y' is conditional, so it may only be used in connections",
    "inner Real w = 1; model H outer Real w = 2; end H; H h;": "'w' is outer and cannot be modified",
    "record R Real x; equation x = 1; end R; R r;": "a record cannot have equations",
    "record R protected Real x; end R; R r;": "a record cannot have protected elements",
    "connector C flow input Real x; algorithm x := 1; end C; C c;": "a connector cannot have algorithms",
    "block B extends One; end B; B b;": "a block cannot extend the model 'One'",
    "Real Integer = 2;": "'Integer' is the name of a predefined type",
    "Real x; algorithm x := 1; break;": "break outside a loop",
    "Real x; algorithm if time > 1 then return; end if; x := 1;": "return outside a function",
    "Real x; algorithm when time > 1 then when time > 2 then x := 1; end when; end when;": "a when-statement inside",
    "function f input Real u; output Real y; algorithm when u > 1 then y := 1; end when; end f; Real x = f(1);": "in a function",
    "model Real end Real;": "'Real' is the name of a predefined type",
    "record R Real x = time; end R; R r;": "time in a record",
    "connector C Real e; flow Integer f; end C; C c;": "'c.f' has the prefix flow, but is not Real",
    "parameter One o;": "'o' has the prefix parameter, but is a model",
    "input One o;": "'o' has the prefix input, but is a model",
    "connector C input Real u; end C; constant C c;": "'c' has the prefix constant, but is a connector",
    "connector C input Real u; end C; output C c;": "'c.u' has the prefix input, and what it is part of has the prefix output",
    "flow Real f;": "'f' has the prefix flow, but is not in a connector",
    "constant Real k; Real x = k;": "constant 'k' has no value",
    "block B discrete Real x; end B; B b; equation when time > 1 then b.x = 1; end when;": "'b.x' belongs to a component",
    "connector C Real e; flow Real f; end C; block B C c; end B; B b;": "is in a connector of a block",
    "connector C Real e; end C; C c;": "connector 'P.M.C' has 0 flow variables, but 1 potential variable; their numbers must be equal",
    "connector C stream Real h; end C; C c;": "has stream variables and 0 flow variables; it needs one",
    "connector C Real e; flow Real f; end C; model A C c; end A; model B A a; end B; B b; C d; equation connect(b.a.c, d);": "'b.a.c' is inside a component of a component",
    "expandable connector E end E; connector C Real e; flow Real f; end C; E e; C c; equation connect(e, c);": "'e' is expandable, but not 'c'",
    "expandable connector E Real x = 1; end E; E e;": "'e.x' is in an expandable connector and cannot have a value",
    "connector C constant Real k; end C; model A C c(k = 1); end A; model B C c(k = 2); end B; A a; B b; equation connect(a.c, b.c);": "'a.c.k' is 1.0, but 'b.c.k', which is connected to it, is 2.0",
    "connector U = input Real; connector Y = output Real; model A Y y = 1; end A; A a; A b; equation connect(a.y, b.y);": "both determine the signal",
    "connector C input Real x; Real e; flow Real f; end C; connector D Real x; output Real e; flow Real f; end D; model A C c; end A; model B D d; end B; A a; B b; equation connect(a.c, b.d);": "is an input or an output",
    "parameter Integer n = 1; Real x; equation if n then x = 1; end if;": "a condition must be",
    "function f input Real u; end f; Real x = f(1);": "P.M.f() has no result",
    "constant Integer k = 1; Real x = der(k);": "the argument of der() must be Real, not Integer",
    "Real x[-2];": "a size is -2; it cannot be negative",
    "Real x[Kind] = {1, 2}; Real y = x[1];": "'x' has a dimension of Kind, not of numbers",
    "Real x; algorithm for i in 1 loop x := i; end for;": "the range of 'i' is a scalar",
    "Real x[3]; Real y[4]; algorithm for i loop x[i] := y[i]; end for;": "indexes dimensions of 3 and 4 elements",
    "Real x = 1; Integer n = cardinality(x);": "cardinality() of 'x', which is not a connector",
    "One o if true; Real x = o.f(1);": "'o' is conditional",
    "inner Real w = 1; model H outer Integer w; end H; H h;": "'w' is outer and of Integer, but the inner one is Real",
    "inner Real w[2] = {1, 2}; model H outer Real w[3]; end H; H h;": "'w' is outer, and the inner one has size [2]",
    "record A Real a; end A; record B extends A; Real b; end B; inner B w(a = 1, b = 2); model H outer A w; Real x = w.b; end H; H h;": "'P.M.A', the class of 'w', has no 'b'",
    "partial record R Real x; end R; R r(x = 1);": "'r' is of the partial class 'P.M.R'",
    "partial model A end A; model B = A; B b;": "'b' is of the partial class",
    "function f input Real u; output Real y = u; end f; class g = f; Real x = g(1);": "'P.M.g' is a class, not a function",
    "partial package Q constant Real k = 1; end Q; Real x = Q.k;": "package 'P.M.Q' is partial",
    "model A Real x = 1; model B end B; end A; A.B b;": "'P.M.A' is not a package, and 'B' in it is not encapsulated",
    "model A protected encapsulated model B end B; end A; A.B b;": "'B' is protected in 'P.M.A'",
    "package Q protected constant Real k = 1; end Q; model A import P.M.Q.k; Real x = k; end A; A a;": "'P.M.Q.k' is protected",
    "package Q constant Real k = 1; end Q; model A import P.M.Q; import Q = P.Kind; end A; A a;": "'Q' is imported twice",
    "package Q constant Real k = 1; end Q; package R constant Real k = 2; end R; model A import P.M.Q.*; import P.M.R.*; Real x = k; end A; A a;": "two imports make 'k' visible",
    "Real x = 1; encapsulated model A end A; model C import B = P.M.A; B b; end C; C c;": "'P.M.A' is neither a package nor in one",
    "model A model B end B; end A; extends A; extends B;": "the base class 'B' is itself inherited",
    "replaceable model A end A; extends A;": "'A' is replaceable and cannot be a base class",
    "model A Real x = 1; end A; model B = A[3]; model C extends B; Real y = 2; end C; C c;": "'B' is an array; a class that extends it",
    "model A model D Real x = 1; end D; end A; extends A; model D Real x = 2; end D;": "'D' is inherited, but declared differently here",
    "model A protected extends One; end A; A a; Real x = a.k;": "'k' is protected in 'a'",
    "operator record R Real x; end R; operator record S extends R; end S; S s;": "an operator record cannot be extended",
    "model A replaceable One o; end A; model B end B; A a(redeclare B o);": "does not fit 'P.One': it has no 'k'",
    "model A replaceable model O = One; end A; model B end B; A a(redeclare model O = B);": "does not fit 'P.One': it has no 'k'",
    "model B end B; replaceable B b constrainedby One;": "does not fit 'P.One': it has no 'k'",
    "model A replaceable Real x = 1; end A; A a(redeclare Integer x = 1);": "does not fit 'Real': the types differ",
    "model A replaceable constant Real x = 1; end A; A a(redeclare Real x = 2);": "'x' is constant and cannot be redeclared",
    "model A replaceable One o; end A; model B extends A(redeclare One o); end B; B b(redeclare Two o);": "'o' is redeclared and not replaceable any more",
    "model A protected replaceable One o; end A; extends A; public redeclare Two o;": "'o' is protected and cannot be redeclared as public",
    "model A model B end B; end A; extends A; model extends B end B;": "'B' is not replaceable",
    "import A = P.M; A a;": "contains itself",
    "parameter Integer m = 65536*65536;": "integer overflow: 'm' would be 4294967296",
}
REFUSED |= INVALID
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
