"""Runs that share their beginning: going on from a kept state changes nothing, to the last bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fmu_build import build
from fmuid.core.errors import SimulationError
from fmuid.simulation import branches
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.fmu_library import FmuLibrary
from fmuid.simulation.simulator import Task

MODEL = """
model Bouncing "A driven mass with a stop, so that there are events and a memory of them"
  parameter Real k = 40;
  parameter Real limit = 1e9;
  input Real force;
  input Real push;
  output Real x(start = 0, fixed = true);
  output Real v(start = 0, fixed = true);
  output Integer hits(start = 0, fixed = true);
equation
  der(x) = v;
  der(v) = force + push - k*x - 0.5*v;
  when x > 0.02 then
    reinit(v, -0.8*pre(v));
    hits = pre(hits) + 1;
  end when;
  assert(x < limit, "too far");
end Bouncing;
"""
N = 400


@pytest.fixture(scope="module", params=["2", "3"])
def path(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("branches")
    (folder / "Bouncing.mo").write_text(MODEL)
    return build(folder / "Bouncing.mo", "Bouncing", folder, request.param)


def task(begin: int, group: int = 0, force: float = 1.0) -> Task:
    time = np.linspace(0.0, 4.0, N)
    push = np.where((np.arange(N) >= begin) & (np.arange(N) < begin + 30), 0.7, 0.0)
    inputs = {"force": force * np.sign(np.sin(7.0 * time) + 1e-9), "push": push}
    return Task(time, inputs, ("x", "v", "hits"), shared=(group, begin))


def alone(path, task: Task, parameters) -> np.ndarray:
    with Fmu(path) as fmu:
        return fmu.simulate(replace(task, shared=None), parameters)


@pytest.fixture
def steps(monkeypatch):
    """The samples that runs went on from."""
    begun = []
    begin = branches.Branches.begin

    def watched(self, prepared, outputs):
        key = begin(self, prepared, outputs)
        begun.append(prepared.plan.begin if prepared.plan.from_state else 0)
        return key

    monkeypatch.setattr(branches.Branches, "begin", watched)
    return begun


def test_results_are_those_of_whole_runs(path, steps):
    with Fmu(path) as fmu:
        tasks = [task(begin) for begin in (40, 90, 200, 200, 60, 350)]
        simulated = [fmu.simulate(one, {"k": 40.0}) for one in tasks]
        assert steps[-6:] == [0, 40, 90, 200, 0, 60]
    for one, y in zip(tasks, simulated, strict=True):
        np.testing.assert_array_equal(y, alone(path, one, {"k": 40.0}))
    assert simulated[0][2, -1] > 2  # there were events


def test_other_parameters_inputs_and_groups_begin_anew(path, steps):
    with Fmu(path) as fmu:
        fmu.simulate(task(100), {"k": 40.0})
        for one, k in ((task(200), 41.0), (task(200, force=2.0), 40.0), (task(200, group=1), 40.0)):
            np.testing.assert_array_equal(fmu.simulate(one, {"k": k}), alone(path, one, {"k": k}))
    assert not any(steps)


def test_a_failed_run_leaves_nothing_behind(path, steps):
    with Fmu(path) as fmu:
        fmu.simulate(task(100), {"k": 40.0, "limit": 1e9})
        with pytest.raises(SimulationError, match="too far"):
            fmu.simulate(task(120), {"k": 40.0, "limit": 0.0})
        y = fmu.simulate(task(200), {"k": 40.0, "limit": 1e9})
    assert steps[-1] == 0
    np.testing.assert_array_equal(y, alone(path, task(200), {"k": 40.0, "limit": 1e9}))


def test_the_state_of_a_run_that_fails_later_is_freed(path, monkeypatch):
    freed = []
    free = FmuLibrary.free_state
    monkeypatch.setattr(FmuLibrary, "free_state", lambda *given: (freed.append(given), free(*given)))
    late = 0.5 * (np.abs(alone(path, task(20), {"k": 40.0})[0][:20]).max() + 0.02)
    with Fmu(path) as fmu, pytest.raises(SimulationError, match="too far"):
        fmu.simulate(task(20), {"k": 40.0, "limit": float(late)})
    assert len(freed) == 1


def test_only_so_many_states_are_kept(path):
    with Fmu(path) as fmu:
        for group in range(40):
            fmu.simulate(task(50, group), {"k": 40.0})
        assert len(fmu._branches._known) == branches._MOST
