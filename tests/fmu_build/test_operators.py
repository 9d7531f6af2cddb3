"""Operator records: operators, constructors and arrays of them, in equations and in functions."""

from __future__ import annotations

import pytest

from fmu_build import compile_modelica
from fmu_build.errors import ModelicaError
from tests.fmu_build.simulate import Instance

Z = """package P
  operator record Z "Complex number"
    Real re;
    Real im;
    encapsulated operator 'constructor'
      import P.Z;
      function fromReal
        input Real re;
        input Real im = 0;
        output Z result(re = re, im = im);
      algorithm
      end fromReal;
    end 'constructor';
    encapsulated operator function '0' import P.Z; output Z c; algorithm c := Z(0); end '0';
    encapsulated operator function '+' import P.Z; input Z a; input Z b; output Z c;
      algorithm c := Z(a.re + b.re, a.im + b.im); end '+';
    encapsulated operator '-'
      import P.Z;
      function negate input Z a; output Z c; algorithm c := Z(-a.re, -a.im); end negate;
      function subtract input Z a; input Z b; output Z c; algorithm c := Z(a.re - b.re, a.im - b.im); end subtract;
    end '-';
    encapsulated operator '*'
      import P.Z;
      function multiply input Z a; input Z b; output Z c;
        algorithm c := Z(a.re*b.re - a.im*b.im, a.re*b.im + a.im*b.re); end multiply;
      function scalarProduct input Z a[:]; input Z b[size(a, 1)]; output Z c;
        algorithm c := Z(0); for i in 1:size(a, 1) loop c := c + a[i]*b[i]; end for; end scalarProduct;
    end '*';
    encapsulated operator function '==' import P.Z; input Z a; input Z b; output Boolean e;
      algorithm e := a.re == b.re and a.im == b.im; end '==';
  end Z;
  operator record Voltage = Z(re(unit = "V"), im(unit = "V"));
  function square input Z a; output Z c; protected Z b; algorithm b := a; c := b*b; end square;
  function re input Z a; output Real x = a.re; end re;
  connector Pin Voltage v; flow Z i; end Pin;
  model Resistor Pin p; Pin n; parameter Z r = Z(1, 1); equation p.v - n.v = r*p.i; p.i + n.i = Z(0); end Resistor;
  model Ground Pin p; equation p.v = Z(0); end Ground;
  model Source Pin p; equation p.v = Z(2*time, 4); end Source;
"""
VALUES = {
    "Z a = Z(1, 2); Z b = a*a;": {"b.re": -3.0, "b.im": 4.0},
    "Z a = Z(1, 2); Z b = -a + Z(time, 1);": {"b.re": -1 + 0.5, "b.im": -1.0},
    "Z a = Z(1, 2); Z b = a - 1;": {"b.re": 0.0, "b.im": 2.0},
    "Z a = Z(1, 2); Z b = 2*a;": {"b.re": 2.0, "b.im": 4.0},
    "Z a = Z(re = 3); Real x = a.im;": {"a.re": 3.0, "x": 0.0},
    "Z a = Z(1, 2); Z b = square(a);": {"b.re": -3.0, "b.im": 4.0},
    "parameter Z a = Z(1, 2); parameter Boolean e = a == Z(1, 2); Real x = if e then 1 else 2;": {"x": 1.0},
    "Z a[2] = {Z(1, 2), Z(3, 4)}; Z b[2] = a + {Z(1), Z(2)};": {"b[2].re": 5.0, "b[2].im": 4.0},
    "Z a[2] = {Z(1, 2), Z(3, 4)}; Z b[2] = a + {1, time};": {"b[2].re": 3.5, "b[1].im": 2.0},
    "Z a[2] = {Z(1, 2), Z(3, 4)}; Z b = a*a;": {"b.re": -3.0 - 7.0, "b.im": 4.0 + 24.0},
    "Z a[2] = fill(Z(1, 2), 2); Z b[2] = a.*a;": {"b[1].re": -3.0, "b[2].im": 4.0},
    "Z a[2, 2] = {{Z(1), Z(0, 1)}, {Z(2), Z(1)}}; Z v[2] = {Z(1, 2), Z(3)}; Z b[2] = a*v;": {"b[1].re": 1, "b[1].im": 5, "b[2].re": 5},
    "Z a[2, 2] = {{Z(1), Z(0, 1)}, {Z(2), Z(1)}}; Z b[2, 2] = a*a;": {"b[1,1].re": 1, "b[1,1].im": 2, "b[2,2].im": 2, "b[2,1].re": 4},
    "function f input Z a[:]; output Real s = sum(re({a[k]*a[k] for k in 1:size(a, 1)})); end f; Real x = f({Z(1, 2), Z(0, time)});": {"x": -3.25},
    "Z a[1] = {Z(1, 2)}; Z b[1] = a + {Z(time)};": {"b[1].re": 1.5, "b[1].im": 2.0},
    "Z a[2]; equation a - fill(Z(1, 2), 2) = fill(Z(0), 2);": {"a[2].re": 1.0, "a[1].im": 2.0},
    "Source s; Resistor r; Ground g; equation connect(s.p, r.p); connect(r.n, g.p);": {"r.p.i.re": 2.5, "r.p.i.im": 1.5},
}  # fmt: skip
REFUSED = {
    "Z a = Z(1, 2); Z b = a/a;": "'Z' has no operator '/' for such operands",
    "function f input Z a[2, 2]; output Z b[2, 2] = a*a; end f; Z a[2, 2]; Z b[2, 2] = f(a);": "'Z' has no operator '*' for such operands",
    "operator record W Real x; end W; connector C Real e; flow W f; end C; C c;": "is a flow, but 'W' has no operator '+'",
    "operator record W Real x; encapsulated operator 'constructor' constant Real k = 1; end 'constructor'; end W; W w = W(1);": "an operator consists of functions alone",
}


def translated(tmp_path, body):
    (tmp_path / "P.mo").write_text(f"{Z}  model M\n{body}\n  end M;\nend P;\n")
    return compile_modelica(tmp_path / "P.mo", "P.M")


@pytest.mark.parametrize("body", VALUES)
def test_values(tmp_path, body):
    instance = Instance.of(translated(tmp_path, body))
    x = instance.start()
    assert {name: instance.get(name, 0.5, x) for name in VALUES[body]} == pytest.approx(VALUES[body], abs=1e-12)


@pytest.mark.parametrize("body", REFUSED)
def test_refused(tmp_path, body):
    with pytest.raises(ModelicaError, match=r"^P\.mo:\d+: ") as caught:
        translated(tmp_path, body)
    assert REFUSED[body] in str(caught.value)
