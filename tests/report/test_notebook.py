"""Results show with their pictures when a cell of a notebook ends with them."""

import base64
import importlib
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import report_samples as samples

import fmuid
from fmuid.diagnosis.diagnose import Found
from fmuid.identification.problem.cases import measured_case
from fmuid.identification.result import Estimate, Result, StageResult
from fmuid.identification.solvers import Status
from fmuid.identification.uncertainty.confidence import Uncertainty
from fmuid.identification.validate import RunScore, Validation
from fmuid.report.notebook import figures_of
from fmuid.simulation.simulator import Task, Variable

TIME = np.linspace(0.0, 1.0, 51)


@pytest.fixture
def shown(monkeypatch):
    """Return the formatters that are registered with IPython, by type."""
    known = {}

    def for_type_by_name(module, name, function):
        known[getattr(importlib.import_module(module), name)] = function

    html = SimpleNamespace(for_type_by_name=for_type_by_name)
    shell = SimpleNamespace(display_formatter=SimpleNamespace(formatters={"text/html": html}))
    with monkeypatch.context() as kernel:
        kernel.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
        fmuid._show_pictures_in_notebooks()
    return known


def pictures(html):
    """Titles of the pictures of an HTML fragment, all of which have to be PNG files."""
    images = re.findall(r'<img alt="([^"]+)"[^>]* src="data:image/png;base64,([^"]+)">', html)
    assert all(base64.b64decode(data).startswith(b"\x89PNG") for _, data in images)
    return [title for title, _ in images]


def result():
    free = ("a", "b")
    uncertainty = Uncertainty(
        free, (1.0, 2.0), ((1.0, 0.9), (0.9, 1.0)), (1.0, 1.0), (None, None), ((1.0, 0.9), (0.9, 1.0)), None, None
    )
    estimates = tuple(Estimate(n, 1.0, 0.5, "kg", standard_error=1.0) for n in free)
    stage = StageResult("all", Status.CONVERGED, "done", "trf", "", estimates, free, (), 9.0, 1.0, 5, 0, 1.0, uncertainty=uncertainty)  # fmt: skip
    return Result("bench", "", "", (stage,), {"a": 1.0, "b": 2.0})


def validation():
    model = SimpleNamespace(variables={"y": Variable("y", "output")})
    cases = [
        measured_case(f"run{k}", model, Task(TIME, {}, ("y",)), {"y": np.sin(TIME) + 0.1 * k}) for k in range(6)
    ]
    scores = [RunScore(c.id, "bench", "y", "m", 1, 0.1 * k, 0.1 * k, 0.1 * k, None) for k, c in enumerate(cases)]
    return Validation(tuple(scores), tuple(cases), tuple(np.sin(TIME)[None] for _ in cases))


def test_of_an_identification_the_correlations_are_drawn(shown):
    (figure,) = figures_of(result())
    assert figure.values[0, 1] == 0.9
    html = shown[Result](result())
    assert html.startswith("<")
    assert "<table>" in html
    assert pictures(html) == ["Correlation of the estimates: all"]
    alone = replace(result(), stages=(replace(result().stages[0], uncertainty=None),))
    assert pictures(shown[Result](alone)) == []


def test_of_a_validation_the_worst_runs_are_drawn(shown):
    runs, errors = figures_of(validation())
    assert [p.title for p in runs.panels] == ["run5", "run4", "run3", "run2"]
    assert len(errors.bars) == 6
    assert pictures(shown[Validation](validation())) == ["Runs with the largest errors", "NRMSE of every run"]
    failed = Validation(tuple(replace(s, failure="crashed") for s in validation().scores))
    assert pictures(shown[Validation](failed)) == []


def test_of_a_diagnosis_the_gap_and_the_effects_are_drawn(shown):
    diagnosis = SimpleNamespace(to_dict=samples.diagnosis)
    diagnosed = Found(diagnosis, *[None] * 9)
    titles = pictures(shown[Found](diagnosed))
    assert titles[0] == "From the gap to the noise floor"
    assert len(titles) == 2


def test_without_a_notebook_nothing_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))
    fmuid._show_pictures_in_notebooks()
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    fmuid._show_pictures_in_notebooks()
