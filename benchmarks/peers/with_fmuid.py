"""The race with fmuid: its default solver for least squares."""

from __future__ import annotations

import numpy as np
import scipy.optimize  # noqa: F401  imports do not count
from race import Race

from fmuid.core.campaign import ParameterSpec
from fmuid.identification.problem.cases import measured_case
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.solvers import make
from fmuid.identification.solvers.search import Search, StopRules
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.runners import Job, Outcome, in_process
from fmuid.simulation.simulator import Task

race = Race()
job = race.job


def count(jobs: list[Job]) -> list[Outcome]:
    race.simulations += len(jobs)
    return in_process(jobs)


def stop(evaluation: Evaluation, _purpose: str, _improved: bool) -> None:
    if evaluation.ok:
        race.judge(evaluation.residuals)


def tool() -> None:
    with Fmu(job["fmu"]) as fmu:
        task = Task(race.time, {k: np.array(v) for k, v in job["inputs"].items()}, (job["output"],))
        case = measured_case("run", fmu, task, {job["output"]: race.measured}, sigma={job["output"]: 1.0})
        specs = [ParameterSpec(name, *values) for name, values in race.parameters.items()]
        search = Search(Problem([case], specs, runner=count), StopRules(), record=stop)
        make("auto", {}, search.problem)[0].solve(search, search.problem.space.start)


race.run(tool)
