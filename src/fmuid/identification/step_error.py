"""The error from the communication step of coupled models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fmuid.core.campaign import Campaign, StageSpec
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.simulation.coupled.coupled_model import CoupledModel
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator


def step_error(
    campaign: Campaign, stage: StageSpec, simulators: Mapping[str, Simulator], runner: Runner = in_process
) -> dict[str, float]:
    """Return the change by criterion when the communication step is halved; empty without a coupled model.

    The change is the root mean square change of a criterion's residuals (in sigmas) at the stage's start. The
    total error is up to twice as large, since it is proportional to the step or to its square.
    """
    problem = Problem.of_stage(campaign, stage, simulators, runner=runner)
    interval = min(float(np.diff(case.task.time).min()) for case in problem.cases)
    finer = {
        setup: model.stepped(replace(model.master, step=(model.master.step or interval) / 2))
        for setup, model in simulators.items()
        if isinstance(model, CoupledModel)
    }
    if not finer:
        return {}
    here = problem.evaluate(problem.space.start)
    halved = Problem.of_stage(campaign, stage, {**simulators, **finer}, runner=runner)
    there = halved.evaluate(problem.space.start)
    if here.failure is not None or there.failure is not None:
        return {}
    moved = here.residuals - there.residuals
    return {
        label: float(np.sqrt(np.mean(moved[rows] ** 2)))
        for label, rows in zip(problem.labels, problem.slices, strict=True)
    }
