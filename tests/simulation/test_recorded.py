"""The record of simulations that interrupted work continues from."""

from __future__ import annotations

import gc
import weakref
from dataclasses import dataclass

import numpy as np
import pytest

from fmuid.simulation import recorded
from fmuid.simulation.recorded import RecordedSimulations
from fmuid.simulation.simulator import Simulator, Task

TASK = Task(np.linspace(0.0, 1.0, 1001), {}, ("y",))


class Doubling(Simulator):
    """A model that tells how often it was simulated."""

    variables = None

    def __init__(self):
        self.variables, self.simulated = {}, []

    def simulate(self, task, parameters):
        self.simulated.append(parameters["k"])
        return 2.0 * parameters["k"] * task.time[None, :]


def work(folder, model, *, resume=False, stop=None):
    """Ten simulations of 8 kB each, each recorded."""
    with RecordedSimulations(folder / "a.journal", resume=resume, complete=False) as record:

        def runner(jobs):
            outcomes = [simulator.simulate(task, parameters) for simulator, task, parameters in jobs]
            for job, outcome in zip(jobs, outcomes, strict=True):
                record.keep(job, outcome)
            return outcomes

        courses = []
        for k in range(10):
            if k == stop:
                raise KeyboardInterrupt
            courses += record.over(runner)([(model, TASK, {"k": float(k)})])
        return courses


@pytest.mark.parametrize(("largest", "kept"), [(2**30, 8), (20_000, 2)])
def test_a_record_ends_before_it_fills_the_disk_and_the_result_is_the_same(tmp_path, monkeypatch, largest, kept):
    monkeypatch.setattr(recorded, "_LARGEST", largest)
    model = Doubling()
    with pytest.raises(KeyboardInterrupt):
        work(tmp_path, model, stop=8)
    assert (tmp_path / "a.journal").stat().st_size < largest + 1_000
    model.simulated.clear()
    courses = work(tmp_path, model, resume=True)
    assert model.simulated == [float(k) for k in range(kept, 10)]
    assert all(np.array_equal(f, 2.0 * k * TASK.time[None, :]) for k, f in enumerate(courses))


@dataclass(init=False)
class Compared(Doubling):
    """A model that is compared by value, so it has no hash."""


def test_a_model_without_a_hash_is_recorded_and_not_kept_afterwards(tmp_path):
    model = Compared()
    assert len(work(tmp_path, model)) == 10
    gone = weakref.ref(model)
    del model
    gc.collect()
    assert gone() is None
