"""What is known beforehand, samples of the posterior, and parameters that each machine has its own of."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fmuid import AnalysisSpec, ParameterSpec, Problem, Task, identify, measured_case
from fmuid.core.campaign import Prior
from fmuid.core.errors import ProblemError
from fmuid.identification.problem.combination import Combination
from fmuid.identification.uncertainty.between_machines import machine_spread

TIME = np.linspace(0.0, 1.0, 50)


def line(time, inputs, p):
    return {"y": p["a"] + p["b"] * time}


def problem(analytic, noise, specs, sigma=0.1, **options):
    model = analytic(line, ["a", "b"])
    y = 1.0 + 2.0 * TIME + noise
    case = measured_case("line", model, Task(TIME, {}, ("y",)), {"y": y}, sigma={"y": sigma})
    return Problem([case], specs, **options)


def test_a_prior_is_one_more_measurement(analytic):
    noise = 0.1 * np.random.default_rng(1).standard_normal(TIME.size)
    specs = [ParameterSpec("a", 0.5, -9, 9, prior=Prior(1.03, 0.02)), ParameterSpec("b", 1.0, -9, 9)]
    result = identify(problem(analytic, noise, specs))
    # Normal equations of the line and the prior together, with the noise that the residuals have.
    design = np.column_stack([np.ones_like(TIME), TIME]) / 0.1
    rows, right = np.vstack([design, [1 / 0.02, 0.0]]), np.append((1 + 2 * TIME + noise) / 0.1, 1.03 / 0.02)
    expected = np.linalg.lstsq(rows, right, rcond=None)[0]
    assert [result["a"].value, result["b"].value] == pytest.approx(expected, rel=1e-5)
    errors = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))
    assert [result["a"].standard_error, result["b"].standard_error] == pytest.approx(errors, rel=0.25)


def test_a_prior_makes_up_for_what_the_runs_do_not_determine(analytic):
    same = analytic(lambda time, inputs, p: {"y": p["a"] * p["b"] * (1 + time)}, ["a", "b"])
    y = 6.0 * (1 + TIME) + 0.01 * np.random.default_rng(0).standard_normal(TIME.size)
    case = measured_case("product", same, Task(TIME, {}, ("y",)), {"y": y}, sigma={"y": 0.01})
    specs = [ParameterSpec("a", 1.0, 0.1, 9, prior=Prior(2.0, 0.1)), ParameterSpec("b", 1.0, 0.1, 9)]
    result = identify(Problem([case], specs))
    assert result["a"].value == pytest.approx(2.0, abs=1e-3)
    assert result["a"].standard_error == pytest.approx(0.1, rel=0.1)
    assert result["b"].standard_error == pytest.approx(0.15, rel=0.1)


def test_a_prior_needs_a_sum_of_squares(analytic):
    specs = [ParameterSpec("a", 0.5, -9, 9, prior=Prior(1.5, 0.02))]
    with pytest.raises(ProblemError, match="a prior is a residual"):
        problem(analytic, 0.0 * TIME, specs, combination=Combination("min_max"))


def test_samples_of_the_posterior_spread_as_the_standard_errors(analytic):
    pytest.importorskip("emcee")
    noise = 0.1 * np.random.default_rng(2).standard_normal(TIME.size)
    specs = [ParameterSpec("a", 0.5, -9, 9), ParameterSpec("b", 1.0, 0.1, 9, scale="log", prior=Prior(2.0, 0.05))]
    asked = AnalysisSpec(posterior=2000)
    result = identify(problem(analytic, noise, specs), analyses=asked)
    drawn = result.stages[0].posterior
    samples = np.array(drawn.samples)
    assert samples.shape == (2000, 2)
    for k, name in enumerate(("a", "b")):
        assert np.mean(samples[:, k]) == pytest.approx(result[name].value, abs=0.3 * result[name].standard_error)
        assert np.std(samples[:, k]) == pytest.approx(result[name].standard_error, rel=0.35)
        assert drawn.quantiles[k][0] < result[name].value < drawn.quantiles[k][-1]
    again = identify(problem(analytic, noise, specs), analyses=asked).stages[0].posterior
    assert again.samples == drawn.samples


def test_each_machine_has_its_own_parameter(analytic):
    generator, model, cases = np.random.default_rng(4), None, []
    model = analytic(line, ["a", "b"])
    for k in range(6):
        y = 1.0 + (2.0, 2.5, 3.2)[k // 2] * TIME + 0.05 * generator.standard_normal(TIME.size)
        case = measured_case(f"run_{k}", model, Task(TIME, {}, ("y",)), {"y": y}, sigma={"y": 0.05})
        cases.append(replace(case, machine="ABC"[k // 2]))
    specs = [ParameterSpec("a", 0.5, -9, 9, per="machine"), ParameterSpec("b", 1.0, -9, 9, per="machine")]
    result = identify(Problem(cases, specs))
    assert [result[f"b@{m}"].value for m in "ABC"] == pytest.approx([2.0, 2.5, 3.2], abs=0.1)
    a, b = result.stages[0].machines
    assert b.differs
    assert not a.differs
    assert b.next_machine[0] < 2.0 < 3.2 < b.next_machine[1]
    assert "b differs between machines" in str(result)


def test_the_spread_between_machines_is_that_of_a_random_effects_model():
    """Against the DerSimonian and Laird estimate of six studies, by hand."""
    y, se = np.array([0.1, 0.3, 0.35, 0.65, 0.45, 0.15]), np.sqrt([0.03, 0.03, 0.05, 0.01, 0.05, 0.02])
    spread = machine_spread("effect", list("ABCDEF"), y, se)
    w = 1 / se**2
    q = np.sum(w * (y - np.sum(w * y) / w.sum()) ** 2)
    between = (q - 5) / (w.sum() - np.sum(w**2) / w.sum())
    assert spread.spread == pytest.approx(np.sqrt(between))
    w = 1 / (se**2 + between)
    assert spread.mean == pytest.approx(np.sum(w * y) / w.sum())
    assert spread.next_machine[0] < spread.mean < spread.next_machine[1]
    two = machine_spread("effect", list("AB"), [1.0, 2.0], [0.1, 0.2], [1.0, 4.0])
    welch = stats.t(0.05**2 / (0.1**4 / 1.0 + 0.2**4 / 4.0))
    assert two.p_value == pytest.approx(2.0 * welch.sf(1.0 / np.sqrt(0.05)))
    same = machine_spread("effect", list("AB"), [1.0, 1.0], [0.1, 0.1])
    assert same.spread == 0.0
    assert same.p_value == pytest.approx(1.0)
    assert same.next_machine is None
