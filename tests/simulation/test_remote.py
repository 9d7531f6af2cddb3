"""Executors of other makes: the same numbers from a process pool and a Dask cluster, and no FMU stops them."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from distributed import LocalCluster
from fmus import FAULTS

from fmuid import ParameterSpec, Problem, Task, identify, measured_case
from fmuid.cli.app import run as command
from fmuid.core.errors import FmuError, FmuidError, SimulationError
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.pool.remote import dask_executor, on_executor
from fmuid.simulation.runners import in_process

TASK = Task(np.arange(301) * 1e-3, {"u": np.sin(np.arange(301) / 9)}, ("y", "x"))


@pytest.fixture(autouse=True, scope="module")
def environment() -> Iterator[None]:
    """Take back what Dask sets in this process for its workers, as OMP_NUM_THREADS."""
    before = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture(scope="module")
def cluster(environment: None) -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
    ) as cluster:
        yield cluster


@pytest.fixture(scope="module", params=["threads", "processes", "dask"])
def executor(request: pytest.FixtureRequest) -> Iterator[Executor]:
    match request.param:
        case "threads":
            pool = ThreadPoolExecutor(2)
        case "processes":
            pool = ProcessPoolExecutor(2, multiprocessing.get_context("spawn"))
        case _:
            with dask_executor(request.getfixturevalue("cluster").scheduler_address) as pool:
                yield pool
            return
    with pool:
        yield pool


def problem(path: Path, **start: float) -> Problem:
    """An oscillator to be found again: d = 0.7, c = 130."""
    truth = load_fmu(path).simulate(TASK, {"d": 0.7, "c": 130.0})
    measured = {
        n: y + 1e-4 * np.random.default_rng(0).standard_normal(y.size)
        for n, y in zip(TASK.outputs, truth, strict=True)
    }
    case = measured_case("run", load_fmu(path), TASK, measured, sigma={"y": 1e-4, "x": 1e-4})
    return Problem([case], [ParameterSpec("d", 0.5, 0.1, 2.0), ParameterSpec("c", 100.0, 50.0, 300.0)])


@pytest.mark.parametrize("solver", ["trf", "crs2 > bobyqa"])
def test_results_are_those_of_this_process(build, executor, solver):
    options = {"crs2": {"evaluations": 60}} if ">" in solver else {}
    here = identify(problem(build(2)), solver=solver, options=options)
    there = identify(problem(build(2)), solver=solver, options=options, executor=executor)
    assert there.parameters == here.parameters
    assert there["c"].value == pytest.approx(130.0, rel=0.01)
    a, b = here.stages[0], there.stages[0]
    assert (a.cost, a.evaluations, a.uncertainty) == (b.cost, b.evaluations, b.uncertainty)


@pytest.mark.parametrize("executor", ["processes", "dask"], indirect=True)
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("crash", r"crashed \(SIGABRT\) \(with c = 100, fault = 1\)"),
        ("hang", r"took longer than the time limit of 3 s"),
        ("devours", r"took more memory than the limit of 200 MB"),
        ("nan", r"is not finite"),
    ],
)
def test_a_bad_evaluation_costs_itself_only(build, executor, fault, message):
    fmu = load_fmu(build(2))
    jobs = [(fmu, TASK, {"c": 100.0 + i, "fault": FAULTS[fault] if i == 0 else 0}) for i in range(6)]
    limit = 3.0 if fault == "hang" else 60.0  # a busy machine is slow at all of it
    bad, *outcomes = on_executor(executor, time_limit=limit, memory_limit=200 * 2**20)(jobs)
    assert isinstance(bad, SimulationError)
    assert re.search(message, str(bad)), bad
    for outcome, expected in zip(outcomes, in_process(jobs[1:]), strict=True):
        assert np.array_equal(outcome, expected)


@pytest.mark.parametrize("executor", ["processes", "dask"], indirect=True)
def test_short_jobs_travel_together(build, executor, monkeypatch):
    fmu, submitted, submit = load_fmu(build(2)), [], executor.submit
    monkeypatch.setattr(executor, "submit", lambda *a: submitted.append(len(a[1])) or submit(*a))
    run = on_executor(executor)
    for c in (100.0, 110.0, 120.0):
        submitted.clear()
        jobs = [(fmu, TASK, {"c": c + i}) for i in range(40)]
        outcomes = run(jobs)
    assert sorted(submitted) == [20, 20]  # one task for each of two workers
    assert np.array_equal(outcomes, in_process(jobs))


def test_mistakes_are_raised(build, executor):
    with pytest.raises(FmuError, match="no variable 'cc'"):
        on_executor(executor)([(load_fmu(build(2)), TASK, {"cc": 1.0})])


def test_the_workers_need_no_common_disk(build, tmp_path, cluster):
    copy = Path(shutil.copy(build(2), tmp_path / "elsewhere.fmu"))
    jobs = [(load_fmu(copy), TASK, {"c": 100.0 + i}) for i in range(3)]
    with dask_executor(cluster.scheduler_address) as executor:
        run = on_executor(executor)
        run(jobs)  # the FMU is there
        copy.unlink()
        jobs[1] = (jobs[1][0], TASK, {"fault": FAULTS["crash"]})  # even where a fresh process has to load it
        outcomes = run(jobs)
    assert [isinstance(o, SimulationError) for o in outcomes] == [False, True, False]


def test_workers_that_only_the_scheduler_reaches(build, cluster, monkeypatch):
    monkeypatch.setattr("fmuid.simulation.pool.remote._REACH_LIMIT", 0.0)
    jobs = [(load_fmu(build(2)), TASK, {"c": 100.0 + i}) for i in range(3)]
    with dask_executor(cluster.scheduler_address) as executor:
        assert np.array_equal(on_executor(executor)(jobs), in_process(jobs))


def test_lost_workers_are_one_line(build):
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
        run = on_executor(executor)
        run([(load_fmu(build(2)), TASK, {})])
        (process,) = executor._processes.values()
        process.kill()
        process.join()
        with pytest.raises(FmuidError, match=r"ProcessPoolExecutor: has lost its workers .* resume=True"):
            run([(load_fmu(build(2)), TASK, {})])


def test_no_scheduler_and_no_workers_are_one_line(monkeypatch):
    monkeypatch.setattr("fmuid.simulation.pool.remote._CONNECT_LIMIT", 0.3)
    with pytest.raises(FmuidError, match="no Dask scheduler answers"), dask_executor("tcp://127.0.0.1:1"):
        pass
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as empty,
        pytest.raises(FmuidError, match="the cluster has no workers"),
        dask_executor(empty.scheduler_address),
    ):
        pass


@pytest.mark.slow
def test_the_command_line_on_a_cluster(
    build: Callable[..., Path], tmp_path: Path, cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fmuid import Experiment, Measurements, Signal, write_measurements

    (x,) = load_fmu(build(2)).simulate(Task(TASK.time, TASK.inputs, ("x",)), {"c": 130.0})
    signals = {
        "u": Signal("u", TASK.inputs["u"], "N", "input"),
        "x": Signal("x", x + 1e-4 * np.random.default_rng(0).standard_normal(x.size), "m", "output", 1e-4),
    }
    runs = {n: Experiment(n, "bench", TASK.time, signals) for n in ("run", "held")}
    write_measurements(Measurements(runs), tmp_path / "measurements.h5")
    (tmp_path / "campaign.toml").write_text(
        f'[models.bench]\nfmu = "{build(2)}"\n[parameters.c]\nstart = 100\nlower = 50\nupper = 300\n'
        '[roles]\nvalidation = ["held"]\n[stages.all]\n'
    )
    results, validation = {}, {}
    for where in (("--workers", "1"), ("--dask", cluster.scheduler_address)):
        out = tmp_path / where[0].strip("-")
        summary = tmp_path / f"{out.name}.json"
        arguments = [
            "identify",
            tmp_path,
            "--quiet",
            "--json",
            summary,
            "--time-limit",
            "20",
            "--out",
            out,
            *where,
        ]
        if where[0] == "--dask":  # nothing is simulated by processes of this machine's own
            monkeypatch.setattr("fmuid.simulation.pool.workers.Supervisor", None)
            monkeypatch.setattr("fmuid.simulation.runners.simulate", None)
        assert command([str(a) for a in arguments]) == 0
        results[where[0]] = json.loads((out / "result.json").read_text())["parameters"]
        validation[where[0]] = json.loads(summary.read_text())["validation"]
        assert (out / "report" / "index.html").exists()
        assert (out / "identified" / "parameters.ssv").exists()
    assert results["--dask"] == results["--workers"]
    assert validation["--dask"] == validation["--workers"]
    assert validation["--dask"][0]["experiment"] == "held"
    assert results["--dask"]["c"] == pytest.approx(130.0, rel=0.01)
