"""Start values that are not fixed: which of them determine the states, and what is reported."""

from __future__ import annotations

from pathlib import Path

import pytest

from fmu_build import compile_modelica
from tests.fmu_build.simulate import Instance

SPECIES = """type T = Real(start = 7); model S parameter Real V = 2; Real n; Real c; equation der(n) = -0.1*c; c = n/V; end S;
  model G parameter Real V = 2; Real n(start = 1); Real c(start = 1); equation der(n) = -0.1*c; c = n/V; end G;
  model V Real o; Real p(start = 2); Real q; equation der(o) = 1 - o; der(p) = -q; q = (o + 1)*(p - 2); end V;
  model Q V v(q(start = 0)); end Q;
"""
CASES = {
    "of a variable that follows from the state": (
        "parameter Real V = 2; Real n; Real c(start = 5); equation der(n) = -0.1*c; c = n/V;", "n", 10, ["fixed: c"],
    ),
    "whatever stateSelect says": (
        "Real n(stateSelect = StateSelect.prefer); Real c(start = 5, stateSelect = StateSelect.prefer);"
        " equation der(n) = -0.1*c; c = n/2;", "n", 10, ["fixed: c"],
    ),
    "from a higher level": ("S s(c(start = 5));", "s.n", 10, ["fixed: s.c"]),
    "from a higher level than the state's": ("G s(c(start = 5));", "s.n", 10, ["fixed: s.c"]),
    "of the state at the same level": (
        "Real n(start = 3); Real c(start = 5); equation der(n) = -0.1*c; c = n/2;", "c", 1.5,
        ["fixed: n", "the start value 5 of 'c' is not used: 1.5 follows from the states"],
    ),
    "of an alias": ("Real a(stateSelect = StateSelect.always); Real b(start = 2); equation der(a) = -a; b = -a;",
                    "a", -2, ["fixed: a (that of b)"]),
    "of two aliases at one level": ("G s(n(start = 4)); Real b(start = 2) = s.n;", "s.n", 2,
                                      ["fixed: b", "start value of 's.n' contradicts that of 'b'"]),
    "of two aliases that agree": ("Real a(start = 2); Real b(start = 2); equation der(a) = -a; b = a;", "a", 2,
                                  ["fixed: a"]),
    "of a variable on which one state alone has an influence at the start": (
        "Q q;", "q.v.p", 2, ["fixed: q.v.o, q.v.q"],
    ),
    "of a type": ("T c; Real n; equation der(n) = -n; c = n/2;", "n", 0, ["fixed: n"]),
    "where the state is fixed": (
        "Real n(start = 3, fixed = true); Real c(start = 5); equation der(n) = -0.1*c; c = -n;", "n", 3,
        [],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_start_value_that_counts(case: str, tmp_path: Path) -> None:
    body, name, value, warnings = CASES[case]
    file = tmp_path / "P.mo"
    file.write_text(f"package P\n  {SPECIES}  model M {body} end M;\nend P;\n")
    model = compile_modelica(file, "P.M")
    instance = Instance.of(model)
    assert instance.get(name, 0.0, instance.start()) == pytest.approx(value)
    assert len(model.warnings) == len(warnings)
    assert all(part in line for part, line in zip(warnings, model.warnings, strict=True))
