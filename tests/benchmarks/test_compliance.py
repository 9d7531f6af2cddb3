"""The study of the Modelica-Compliance suite: what it takes for right, and that its page keeps the aims."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.compliance import cases, judge
from tests.conftest import ROOT

BODIES = {  # the model, whether it should pass, and whether it does
    "Valid": ('Real x(start = 1, fixed = true); equation der(x) = -x; assert(x > 0, "positive");', "true", True),
    "Wrong": ("Integer n = 2.7;", "false", False),
    "Fails": ('Real y = 1; equation assert(y > 2, "large");', "false", False),
    "Warns": ('Real y = 1; equation assert(y > 2, "large", AssertionLevel.warning);', "true", True),
}


def test_tests_of_the_suite_are_translated_refused_or_fail_their_assertions(tmp_path: Path) -> None:
    folder = tmp_path / "ModelicaCompliance" / "Small"
    folder.mkdir(parents=True)
    for place, within in ((folder, "within ModelicaCompliance;"), (folder.parent, "")):
        (place / "package.mo").write_text(f"{within} package {place.name} end {place.name};\n")
    for name, (body, should, _) in BODIES.items():
        note = f"annotation(__ModelicaAssociation(TestCase(shouldPass = {should})))"
        (folder / f"{name}.mo").write_text(
            f"within ModelicaCompliance.Small; model {name} {body} {note}; end {name};\n"
        )
    outcomes = {case.name.rpartition(".")[2]: judge(case, ()) for case in cases(tmp_path)}
    assert {name: o.passed for name, o in outcomes.items()} == {n: passed for n, (*_, passed) in BODIES.items()}
    assert all(o.is_right for o in outcomes.values())


@pytest.mark.parametrize(("columns", "aim"), [((1, 2), 0.95), ((3, 4), 0.9)])
def test_the_page_keeps_the_aims(columns: tuple[int, int], aim: float) -> None:
    page = (ROOT / "docs" / "modelica_compliance.md").read_text()
    (row,) = re.findall(r"^\| all (\|.*)\|$", page, re.MULTILINE)
    number, right = (int(row.split("|")[k]) for k in columns)
    assert right >= aim * number > 400 * aim
