"""The tool that measures how often intervals hold the truth."""

import numpy as np
import pytest

from benchmarks.interval_coverage import (
    KINDS,
    WRONG,
    Lag,
    drawn_campaigns,
    interval_coverage,
    light_campaign,
    light_coverage,
    main,
    new_run_coverage,
)
from fmuid import CriterionSpec, ParameterSpec, Simulator, identify, validate
from fmuid.core.errors import ProblemError
from tests.identification.test_held import LEVEL, SLOPE, campaign, line


@pytest.fixture
def bench(analytic):
    return {"bench": analytic(line, ["a", "b", "c", "load"])}


def test_intervals_of_a_line_hold_the_truth(bench):
    both = SLOPE.__class__("both", ("loaded",), ("a", "b"))
    truth = {n: ParameterSpec(n, 1.0, truth=v) for n, v in (("a", 2.0), ("b", 0.5))}
    for kind in ("white", "coloured"):
        coverages = interval_coverage(campaign(both, **truth), "both", draws=60, kind=kind, simulators=bench)
        assert coverages.names == ("a", "b")
        assert np.all(coverages.shares >= 0.85), (kind, coverages.shares)
        rms = np.sqrt(np.mean(coverages.deviations**2, axis=0))
        assert np.all((rms > 0.75) & (rms < 1.35)), (kind, rms)
        assert "inside, of 60" in str(coverages)


def test_intervals_around_what_is_not_the_truth_do_not_hold_it(bench):
    # By a model whose level is 1 above what it is set to: the fit is as good, and the estimate is 1 too low.
    wrong = LEVEL.__class__("wrong", ("loaded",), ("a",), criteria=(CriterionSpec("y", stop_time=5.0),))
    right = campaign(wrong, a=ParameterSpec("a", 1.0, truth=2.0), b=ParameterSpec("b", 0.5))
    assert interval_coverage(right, "wrong", draws=20, simulators=bench).shares[0] > 0.8
    biased = {"bench": Biased(bench["bench"])}
    assert interval_coverage(right, "wrong", draws=5, simulators=biased).shares[0] == 0.0


class Biased(Simulator):
    """A model that is another one after its third run: two show that it repeats itself, one makes the measurements."""

    variables = None

    def __init__(self, model):
        self.model, self.variables, self.runs = model, model.variables, 0

    def simulate(self, task, parameters):
        self.runs += 1
        return self.model.simulate(task, dict(parameters) | {"a": parameters["a"] + (self.runs > 3)})


@pytest.mark.parametrize("kind", KINDS)
def test_measurements_may_differ_from_the_model(bench, kind):
    both = SLOPE.__class__("both", ("loaded",), ("a", "b"))
    truth = {n: ParameterSpec(n, 1.0, truth=v) for n, v in (("a", 2.0), ("b", 0.5))}
    coverages = interval_coverage(campaign(both, **truth), "both", draws=20, kind=kind, simulators=bench)
    off = kind in ("gain", "friction")  # one run does not show how a gain varies
    assert np.min(coverages.shares) < 0.8 if off else np.min(coverages.shares) >= 0.8


def test_mistakes_are_one_line(bench, capsys):
    with pytest.raises(ProblemError, match="no stage 'slop'"):
        interval_coverage(campaign(LEVEL, SLOPE), "slop", simulators=bench)
    assert main(["nowhere", "level"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_light_model_is_measured_under_each_kind_of_noise():
    white = light_coverage("white", 10)
    assert white.names == ("k", "T", "b")
    assert white.inside.shape == (10, 3)
    assert np.mean(white.shares) >= 0.8
    gain = light_coverage("gain", 10, runs=2)
    assert gain.shares[0] < 0.8  # nothing shows how much it varies ...
    assert np.all(gain.warned == 1.0)  # ... and the table of the stage says so
    assert main(["0"]) == 2


@pytest.mark.parametrize("kind", WRONG)
def test_predictions_of_a_wrong_model_have_intervals_that_hold_new_runs(kind):
    coverages = new_run_coverage(kind, 8)
    assert np.mean(coverages.inside) >= 0.9
    assert np.all(coverages.warned == 1.0)


def test_predictions_of_a_complete_model_are_as_good_as_its_noise():
    coverages = new_run_coverage("white", 8)
    assert 0.93 <= np.mean(coverages.inside) <= 0.97
    assert np.mean(coverages.warned) < 0.2


def test_a_validation_counts_the_new_runs_that_are_within_their_intervals():
    models = {"bench": Lag()}
    old, new = (
        next(
            drawn_campaigns(
                light_campaign(seed, 4), "all", draws=1, kind="friction", seed=seed, simulators=models
            )[2]
        )
        for seed in (0, 1)
    )
    result = identify(old, simulators=models)
    (expected,) = result.stages[0].new_runs
    shown = validate(
        result, new, experiments=new.identification, simulators=models
    )  # other runs of the same names
    assert {score.expected for score in shown.scores} == {expected.half_width}
    assert all(score.within > 0.85 for score in shown.scores)
    assert "at least 85 % of the samples of 4 of 4 new runs (mean 9" in str(shown)
    assert "4 of 4 new runs" in shown._repr_html_()
    assert shown.to_dict()["scores"][0]["within"] == shown.scores[0].within
    identified = validate(result, old, experiments=old.identification, simulators=models)
    assert {score.within for score in identified.scores} == {None}
    assert "interval" not in str(identified)
