"""Values print as tables on a terminal, and as HTML in a notebook."""

from __future__ import annotations

from xml.etree import ElementTree

from fmuid.core.experiments import Measurements
from fmuid.identification.result import Estimate, Result, StageResult
from fmuid.identification.solvers import Status
from fmuid.identification.validate import RunScore, Validation


def cells(html: str) -> list[list[str]]:
    """Return the table rows of an HTML fragment, which has to be well-formed."""
    return [
        ["".join(c.itertext()) for c in row] for row in ElementTree.fromstring(f"<div>{html}</div>").iter("tr")
    ]


def test_measurements(measurements: Measurements) -> None:
    lines = str(measurements).splitlines()
    assert lines[0].split() == ["experiment", "setup", "samples", "end", "inputs", "outputs", "repeat", "of"]
    assert lines[1].startswith("step_1 ")
    assert "i_cmd [A]" in lines[1]
    assert cells(measurements._repr_html_())[1][:3] == ["step_1", "fixed_shaft", "11"]
    assert "array(" not in repr(measurements)


def test_results() -> None:
    estimate = Estimate("d<1>", 2.66, 0.6, "N.m.s/rad", standard_error=0.01, interval=(2.64, 2.68))
    stage = StageResult("linear", Status.CONVERGED, "done", "trf", "", (estimate,), ("a",), (), 9.0, 1.0, 5, 0, 1.0, warnings=("a & b",))  # fmt: skip
    result = Result("bench", "", "", (stage,), {"d<1>": 2.66})
    shown = result._repr_html_()
    assert cells(shown)[1][:4] == ["d<1>", "2.66", "N.m.s/rad", "0.01"]
    assert "a &amp; b" in shown
    assert "d<1>       2.66   N.m.s/rad  0.01" in str(result)


def test_validation() -> None:
    score = RunScore("pulse", "bench", "x", "m", 1, 0.5, 0.01, 0.02, None)
    validation = Validation((score,))
    assert cells(validation._repr_html_())[1] == ["pulse", "x", "m", "0.5", "", "1 %", "2 %"]
    assert str(validation).splitlines()[1].split() == ["pulse", "x", "m", "0.5", "1", "%", "2", "%"]
