"""Designs for parameters, compared with known optima and with the true errors of parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from fmuid.core.campaign import Campaign, DesignSpec, Limit, ModelSpec, ParameterSpec
from fmuid.core.errors import CampaignError, FmuError, FmuidError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.design.parameters import ParameterDesign, design_for_parameters
from fmuid.simulation.runners import in_process
from fmuid.simulation.simulator import Simulator, Task, Variable


class Line(Simulator):
    """y = a u + b, without memory."""

    variables: ClassVar = {
        "a": Variable("a", "parameter", "fixed", start=2.0),
        "b": Variable("b", "parameter", "fixed", start=1.0),
        "u": Variable("u", "input", unit="V", start=0.0),
        "y": Variable("y", "output", unit="m"),
    }

    def simulate(self, task: Task, parameters: Mapping[str, float]) -> np.ndarray:
        p = {"a": 2.0, "b": 1.0, **parameters}
        return np.array([p["a"] * task.inputs["u"] + p["b"]])


DESIGN = DesignSpec(
    limits={"u": Limit("u", -1.0, 1.0)},
    duration=1.0,
    sample_time=0.005,
    sigma={"y": 0.1},
    families=("steps", "prbs"),
)
PARAMETERS = {"a": ParameterSpec("a", 2.0, 0.1, 10.0), "b": ParameterSpec("b", 1.0, 0.1, 10.0)}


def campaign(design: DesignSpec = DESIGN, runs: Measurements = Measurements({})) -> Campaign:  # noqa: B008
    ids = tuple(runs.experiments)
    models = {"line": ModelSpec("line", Path("Line.fmu"))}
    return Campaign("line", "Line", Path(), runs, models, PARAMETERS, {}, {}, ids, (), design=design)


def designed(what: Campaign, **options: object) -> ParameterDesign:
    return design_for_parameters(what, lambda _: Line(), in_process, evaluations=120, **options)  # type: ignore[arg-type]


def test_of_a_straight_line_the_ends_are_measured_and_the_errors_are_those_of_theory() -> None:
    design = designed(campaign())
    (u,) = design.excitation.samples
    n = len(u)
    best = n * 0.5 * np.log(n / 0.1**2)  # half of the samples at either end
    information = np.array([[np.sum(u**2), np.sum(u)], [np.sum(u), n]]) / 0.1**2
    assert n * 0.25 * np.linalg.slogdet(information)[1] > 0.97 * best
    theory = np.sqrt(np.diag(np.linalg.inv(information)))
    assert design.after["a"] == pytest.approx(theory[0] / 2.0, rel=0.02)
    assert design.after["b"] == pytest.approx(theory[1] / 1.0, rel=0.02)


def test_what_recorded_runs_told_is_not_asked_again() -> None:
    time = np.linspace(0.0, 1.0, 201)
    signals = {
        "u": Signal("u", np.where(np.arange(201) % 2, 0.0, 1e-3), "V", "input"),
        "y": Signal("y", np.ones(201), "m", "output", 1e-3),  # b is known to 7e-5
    }
    runs = Measurements({"rest": Experiment("rest", "line", time, signals)})
    limits = {"u": Limit("u", -1.0, 1.0), "y": Limit("y", 0.0, 2.9)}
    design = designed(campaign(replace(DESIGN, limits=limits), runs), optimality="A")
    assert design.before["b"] < 1e-3 < design.before["a"]
    (u,) = design.excitation.samples
    assert 2.0 * u.max() + 1.0 <= 2.9  # the limit of the output
    assert 2.0 * u.min() + 1.0 >= 0.0
    assert design.gain > 100.0
    assert design.repeated is not None
    assert design.repeated[0] == "rest"
    assert design.repeated[1]["a"] > 10.0 * design.after["a"]


def test_limits_are_kept_whatever_the_parameters_may_be() -> None:
    design = designed(campaign(replace(DESIGN, limits={**DESIGN.limits, "y": Limit("y", -0.5, 2.0)})))
    (u,) = design.excitation.samples
    assert np.ptp(u) > 0.3
    assert 2.0 * u.max() + 1.0 < 2.0  # with a margin for a that is larger
    with pytest.raises(FmuidError, match=r"none of .* excitations stays within every limit: each one exceeds y"):
        designed(campaign(replace(DESIGN, limits={**DESIGN.limits, "y": Limit("y", 5.0, 6.0)})))


def test_the_same_seed_gives_the_same_run() -> None:
    first, second = (designed(campaign()).excitation for _ in range(2))
    assert np.array_equal(first.samples, second.samples)


def test_what_does_not_fit_the_model_is_told() -> None:
    with pytest.raises(
        CampaignError, match=r"no input of setup 'line' has limits, so none can be driven.*give min and max of u"
    ):
        designed(campaign(replace(DESIGN, limits={})))
    with pytest.raises(FmuError, match="no variable 'v'"):
        designed(campaign(replace(DESIGN, limits={"v": Limit("v", 0.0, 1.0)})))
    with pytest.raises(CampaignError, match="only an input has a rate"):
        designed(campaign(replace(DESIGN, limits={**DESIGN.limits, "y": Limit("y", -9.0, 9.0, rate=1.0)})))
    with pytest.raises(CampaignError, match="needs both limits"):
        designed(campaign(replace(DESIGN, limits={"u": Limit("u", 0.0)})))
    with pytest.raises(CampaignError, match="gives no noise of the outputs"):
        designed(campaign(replace(DESIGN, sigma={})))
    with pytest.raises(CampaignError, match="has 3 samples"):
        designed(campaign(replace(DESIGN, sample_time=0.3)))


def test_an_interrupted_search_gives_what_it_has_reached() -> None:
    class Stopped(Line):
        left = 60

        def simulate(self, task: Task, parameters: Mapping[str, float]) -> np.ndarray:
            Stopped.left -= 1
            if Stopped.left == 0:
                raise KeyboardInterrupt
            return super().simulate(task, parameters)

    design = design_for_parameters(campaign(), lambda _: Stopped(), in_process, evaluations=120)
    assert design.excitation.interrupted
    assert 0 < design.excitation.evaluations < 60
    assert design.after["a"] < design.before["a"]
