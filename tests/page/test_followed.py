"""A run that another process makes is followed from its journal."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np

from fmuid.core.campaign import ParameterSpec
from fmuid.core.immutable import FloatArray
from fmuid.identification.history import FollowedRun
from fmuid.identification.identify import identify
from fmuid.identification.observer import Observer, Progress
from fmuid.identification.problem.cases import measured_case
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.simulation.simulator import Simulator, Task, Variable


class Line(Simulator):
    """y = a + b t."""

    variables: ClassVar = {n: Variable(n, k) for n, k in (("a", "parameter"), ("b", "parameter"), ("y", "output"))}

    def simulate(self, task: Task, parameters: dict[str, float]) -> FloatArray:
        return np.array([parameters["a"] + parameters["b"] * task.time])


def test_each_look_at_a_run_adds_what_is_new(tmp_path: Path) -> None:
    time = np.linspace(0.0, 1.0, 20)
    case = measured_case("run", Line(), Task(time, {}, ("y",)), {"y": 2.0 + 3.0 * time}, sigma={"y": 0.1})
    problem = Problem([case], [ParameterSpec("a", 0.0, -9.0, 9.0), ParameterSpec("b", 0.0, -9.0, 9.0)])
    followed, counts = FollowedRun(tmp_path / "run"), []

    class Looking(Observer):
        def evaluated(self, progress: Progress) -> None:
            followed.look()
            counts.append(len(followed.run.stages["identification"].rows) - progress.evaluations)
            assert followed.in_progress

    assert not followed.look()
    result = identify(problem, out=tmp_path / "run", observer=Looking())
    assert counts
    assert set(counts) == {0}
    assert followed.look()
    assert not followed.look()
    assert not followed.in_progress
    assert followed.run.result is not None
    assert followed.run.stages["identification"].rows[-1].parameters.keys() == result.parameters.keys()
