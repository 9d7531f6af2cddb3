"""A plain study over a grid of parameters."""

import numpy as np
import pytest

from fmuid import ParameterSpec
from fmuid.core.errors import ProblemError
from fmuid.identification.parameter_study import grid_values, parameter_study
from fmuid.report.study_page import table_of, write_study_page
from tests.identification.test_held import LEVEL, SLOPE, campaign, line


def test_grids_are_written_as_spans_or_lists():
    for text, expected in (
        ("k=1..3:5", [1.0, 1.5, 2.0, 2.5, 3.0]),
        ("k=1..100:3:log", [1.0, 10.0, 100.0]),
        ("k=-0.5,1e-3, 2", [-0.5, 1e-3, 2.0]),
    ):
        name, values = grid_values(text)
        assert name == "k"
        assert values == pytest.approx(np.array(expected))


@pytest.mark.parametrize("text", ["k", "=1,2", "k=1..3", "k=1..3:1", "k=0..3:4:log", "k=a,b", "k=nan"])
def test_other_grids_are_refused(text):
    with pytest.raises(ProblemError, match=r"is not understood; write NAME=LOW\.\.HIGH:COUNT"):
        grid_values(text)


@pytest.fixture
def bench(analytic):
    def fails_above(time, inputs, p):
        return None if p["b"] > 0.9 else line(time, inputs, p)

    return {"bench": analytic(fails_above, ["a", "b", "c", "load"])}


def test_the_best_point_of_a_grid_is_nearest_to_the_truth(bench, tmp_path):
    over = {"a": np.linspace(1.0, 3.0, 5), "b": np.array([0.25, 0.5, 1.0])}
    study = parameter_study(campaign(LEVEL, SLOPE), over, stage="slope", simulators=bench)
    assert study.points.shape == (15, 2)
    assert study.points[study.best].tolist() == [2.0, 0.5]
    assert sorted(study.failures) == [2, 5, 8, 11, 14]  # b = 1 cannot be simulated
    assert np.isnan(study.cost[2])
    lines = str(study).splitlines()
    assert lines[0] == "slope: 15 points, 5 of them failed (the first: loaded: the integrator gave up)"
    assert lines[2].split()[:2] == ["2", "0.5"]  # best points first
    assert table_of(study).csv().splitlines()[0].startswith("a,b,cost,")
    page = write_study_page(study, tmp_path, campaign="bench", units={"a": "m"})
    text = page.read_text()
    assert "Parameter study: bench" in text
    assert "at a = 2, b = 0.5" in text


def test_one_parameter_has_a_curve(bench, tmp_path):
    study = parameter_study(campaign(LEVEL, b=ParameterSpec("b", 0.5)), {"a": [1.0, 2.0, 3.0]}, simulators=bench)
    assert study.stage == "level"
    assert study.best == 1
    assert write_study_page(study, tmp_path, campaign="bench", units={}).is_file()


def test_unknown_names_are_refused(bench):
    with pytest.raises(ProblemError, match="no parameter 'q' in stage 'level'"):
        parameter_study(campaign(LEVEL), {"q": [1.0]}, simulators=bench)
    with pytest.raises(ProblemError, match="no stage 'lvel'; the campaign has: level"):
        parameter_study(campaign(LEVEL), {"a": [1.0]}, stage="lvel", simulators=bench)
