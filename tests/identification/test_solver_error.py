"""The tolerance that a model is solved to is tightened until no measurement would show its error."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from fmuid import Simulator, Task, Variable, measured_case
from fmuid.core.errors import ProblemError
from fmuid.identification.problem.solver_error import UNSEEN, solver_accuracy
from fmuid.simulation.runners import in_process

TIME = np.linspace(0.0, 2.0, 101)


class Solved(Simulator):
    """An exponential whose error is `worse` times the tolerance and grows at a rate."""

    variables: ClassVar = {"a": Variable("a", "parameter"), "y": Variable("y", "output")}

    default_tolerance = None

    def __init__(self, worse, rate=0.0, default_tolerance=1e-4):
        self.worse, self.rate, self.default_tolerance, self.asked = worse, rate, default_tolerance, []

    def simulate(self, task, parameters):
        tolerance = task.tolerance or self.default_tolerance
        self.asked.append(tolerance)
        # What is left of the error at the tightest tolerance is rounding, not small where it grows fast.
        error = self.worse * tolerance * (-1) ** round(-np.log10(tolerance)) * np.exp(self.rate * task.time)
        error = np.tanh(error)  # however far astray, it stays on the attractor
        return (np.exp(-parameters["a"] * task.time) + error)[None]


def accuracy_of(model, sigma, **options):
    case = measured_case("run", model, Task(TIME, {}, ("y",)), {"y": np.exp(-TIME)}, sigma={"y": sigma})
    return case, solver_accuracy([case], {"a": 1.0}, [{"a": 1.0}], in_process, **options)


@pytest.mark.parametrize("sigma", [1e-1, 1e-3, 1e-5, 1e-6])
def test_a_prediction_is_solved_as_well_as_its_noise_asks_for(sigma):
    model = Solved(worse=3.0)
    case, accuracy = accuracy_of(model, sigma)
    (case,) = accuracy.applied([case])
    error = model.simulate(case.task, {"a": 1.0}) - np.exp(-TIME)
    assert np.linalg.norm(error) / sigma < 2.0 * UNSEEN
    assert not accuracy.until
    if sigma == 1e-1:
        assert case.task.tolerance is None  # the model's own is good enough
        assert model.asked == pytest.approx([1e-4] * 3 + [1e-5, 1e-4])  # two show that it repeats itself


def test_a_diagnosis_begins_looser():
    model = Solved(worse=3.0)
    _, accuracy = accuracy_of(model, 10.0, loosest=(3e-3, 1e-3, 1e-4))
    assert accuracy.tolerances == {"run": 3e-3}


def test_a_run_that_never_settles_is_left_out_from_where_it_goes_astray():
    _, accuracy = accuracy_of(Solved(worse=1.0, rate=20.0), 1e-3)
    assert 0.5 < accuracy.until["run"] < 2.0
    assert "cannot be predicted from" in accuracy.findings[0]


def test_a_model_that_draws_random_numbers_is_not_blamed_on_its_tolerance():
    class Drawing(Solved):
        def simulate(self, task, parameters):
            return super().simulate(task, parameters) + 0.01 * len(self.asked)

    with pytest.raises(ProblemError, match=r"two equal simulations differ in y by up to 0\.01"):
        accuracy_of(Drawing(worse=3.0), 1e-3)


def test_a_model_without_a_tolerance_is_left_alone():
    case, _ = accuracy_of(Solved(worse=3.0), 1.0)
    task = replace(case.task, tolerance=1e-4)
    plain = replace(case, simulator=Solved(3.0, default_tolerance=None), task=task)
    accuracy = solver_accuracy([plain], {"a": 1.0}, [{"a": 1.0}], in_process)
    assert (accuracy.tolerances, accuracy.until) == ({}, {})
    assert plain.simulator.asked == [1e-4, 1e-4]  # that show that it repeats itself
