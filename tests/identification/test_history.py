import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fmuid import (
    AnalysisSpec,
    CriterionSpec,
    Observer,
    ParameterSpec,
    Problem,
    Result,
    Status,
    StopRules,
    Task,
    identify,
    measured_case,
    read_history,
)
from fmuid.core.folder_lock import LockedError, claim
from fmuid.core.journal import Journal, JournalError, records
from fmuid.identification import history as history_module
from fmuid.identification.history import _MAGIC, JOURNAL, History, HistoryError
from fmuid.identification.recorded_rows import Row, Rows

# A run that identifies the mass-spring-damper with a slow model, to be killed from outside.
SCRIPT = """
    import sys, time
    sys.path.insert(0, {folder!r})
    from conftest import Analytic, MSD_TRUTH, msd_problem, step_response
    from fmuid import identify

    def slow(time_, inputs, p):
        time.sleep({pause})
        return step_response(time_, inputs, p)

    result = identify(
        msd_problem(model=Analytic(slow, MSD_TRUTH)),
        solver={solver!r},
        out=sys.argv[1],
        resume="resume" in sys.argv,
    )
    print(sorted(result.parameters.items()), result.stages[0].cost, result.stages[0].evaluations)
"""


def start(tmp_path, solver, *more, pause=0.004, folder=None, stderr=None):
    script = tmp_path / "run.py"
    here = str(Path(__file__).parent)
    script.write_text(textwrap.dedent(SCRIPT.format(folder=here, solver=solver, pause=pause)))
    command = [sys.executable, str(script), str(folder or tmp_path / "run"), *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True)


def killed_and_resumed(tmp_path, solver, kills, generator):
    """Kill a run at random moments, resume it each time, and return its last output."""
    process = start(tmp_path, solver)
    journal = tmp_path / "run" / JOURNAL
    for _ in range(kills):
        while process.poll() is None and (not journal.exists() or journal.stat().st_size < 100):
            time.sleep(0.002)
        time.sleep(generator.uniform(0.0, 0.25))
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        if not journal.exists():  # it was done already
            break
        process = start(tmp_path, solver, "resume")
    printed, _ = process.communicate(timeout=600)
    return printed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "kills"),
    [("nelder_mead", 3), *(pytest.param(s, 10, marks=pytest.mark.slow) for s in ("trf", "crs2 > bobyqa"))],
)
def test_a_run_killed_at_random_moments_ends_as_an_unbroken_one(tmp_path, solver, kills):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    unbroken, _ = start(tmp_path / "a", solver, pause=0).communicate(timeout=600)
    assert "('k', 30" in unbroken
    broken = killed_and_resumed(tmp_path / "b", solver, kills, np.random.default_rng(kills))
    assert broken == unbroken


class Interrupt(Observer):
    """Presses Ctrl-C at an evaluation."""

    def __init__(self, at):
        self.at = at

    def evaluated(self, progress):
        if progress.evaluations == self.at:
            raise KeyboardInterrupt


LONG = {("sbplx", 4), ("crs2", 4), ("dfols", 4)}


@pytest.mark.parametrize(
    ("solver", "starts"),
    [
        pytest.param(solver, starts, marks=[pytest.mark.slow] if (solver, starts) in LONG else [])
        for solver in ("trf", "bobyqa", "sbplx", "praxis", "crs2", "dfols", "slsqp", "trf > bobyqa")
        for starts in (1, 4)
    ],
)
def test_ctrl_c_keeps_what_was_reached_and_resume_goes_on_exactly(tmp_path, msd, solver, starts):
    options, threads = {"starts": starts}, threading.active_count()
    whole = identify(msd(), solver=solver, options=options, with_uncertainty=False)
    stopped = identify(msd(), solver=solver, options=options, out=tmp_path, observer=Interrupt(12))
    assert stopped.status is Status.INTERRUPTED
    assert stopped.stages[0].cost < stopped.stages[0].start_cost
    assert Result.from_json(tmp_path) == stopped
    assert len(read_history(tmp_path)["msd"].rows) >= 12
    problem = msd()
    resumed = identify(problem, solver=solver, options=options, out=tmp_path, resume=True, with_uncertainty=False)
    assert resumed.parameters == whole.parameters
    assert resumed.stages[0].starts == whole.stages[0].starts
    assert resumed.stages[0].evaluations == whole.stages[0].evaluations
    assert threading.active_count() == threads
    assert problem.cases[0].simulator.count <= whole.stages[0].evaluations - 11
    assert not (tmp_path / JOURNAL).exists()


def test_a_large_journal_leaves_out_residuals_and_a_resumed_search_ends_the_same(tmp_path, msd, monkeypatch):
    whole = identify(msd(), solver="trf", with_uncertainty=False)
    identify(msd(), solver="trf", out=tmp_path / "all", observer=Interrupt(12))
    monkeypatch.setattr(history_module, "_LARGEST", 10_000)
    identify(msd(), solver="trf", out=tmp_path / "some", observer=Interrupt(12))
    sizes = [(tmp_path / folder / JOURNAL).stat().st_size for folder in ("all", "some")]
    assert sizes[1] < 0.7 * sizes[0]
    resumed = identify(msd(), solver="trf", out=tmp_path / "some", resume=True, with_uncertainty=False)
    assert resumed.parameters == whole.parameters
    assert resumed.stages[0].evaluations == whole.stages[0].evaluations


def test_history_holds_every_evaluation_and_the_predictions_of_the_improving_ones(tmp_path, msd):
    problem = msd()
    stage = identify(problem, solver="nelder_mead", out=tmp_path, with_uncertainty=False).stages[0]
    history = read_history(tmp_path)["msd"]
    assert problem.cases[0].simulator.count == len(history.rows) + 2  # that show that the model repeats itself
    assert len(history.rows) == stage.evaluations
    assert np.min(history.costs) == stage.cost
    costs = [row.cost for _, row in history.iterates()]
    assert costs == sorted(costs, reverse=True)
    last = list(history.iterates())[-1][1]
    exact = problem.cases[0].simulator.simulate(problem.cases[0].task, last.parameters)
    assert np.array_equal(last.predictions[0], exact)


def test_failed_candidates_are_recorded_as_failed(tmp_path, analytic, msd, msd_truth):
    exact = msd().cases[0].simulator.function
    fragile = analytic(lambda t, u, p: None if p["k"] > 30.2 else exact(t, u, p), msd_truth)
    stage = identify(msd(model=fragile), solver="nelder_mead", out=tmp_path, with_uncertainty=False).stages[0]
    failed = [row for row in read_history(tmp_path)["msd"].rows if row.failure]
    assert len(failed) == stage.failures > 0
    assert all(np.isnan(row.cost) and row.parameters["k"] > 30.2 for row in failed)
    assert "the integrator gave up" in failed[0].failure


def test_a_journal_cut_anywhere_is_read_up_to_the_cut(tmp_path, msd):
    identify(msd(), solver="bobyqa", out=tmp_path, observer=Interrupt(6))
    *_, (_, _, after_rows), _ = records(tmp_path / JOURNAL, _MAGIC)  # the result comes last
    whole = (tmp_path / JOURNAL).read_bytes()[:after_rows]
    rows = len(read_history(tmp_path)["msd"].rows)
    for cut in range(1, 600, 7):
        (tmp_path / JOURNAL).write_bytes(whole[:-cut])
        assert rows - 3 <= len(read_history(tmp_path)["msd"].rows) < rows
    (tmp_path / JOURNAL).write_bytes(whole + bytes(4096))  # after a power failure
    assert len(read_history(tmp_path)["msd"].rows) == rows
    damaged = bytearray(whole)
    damaged[-5] ^= 0xFF
    (tmp_path / JOURNAL).write_bytes(damaged)
    assert len(read_history(tmp_path)["msd"].rows) == rows - 1


def broken_at_every_file_operation(folder, *arguments):
    """Return the records of `broken_disk.py`: of the run without a failure, and of the others."""
    script = Path(__file__).with_name("broken_disk.py")
    command = [sys.executable, str(script), str(folder), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    whole, *runs = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(runs) > 12
    for run in runs:
        assert run["resumed"] == whole["resumed"], run
        assert not run["left"], run
    return whole, runs


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("more", [(), ("interrupted",)])
def test_killed_at_any_file_operation_a_run_can_be_read_and_resumed(tmp_path, step, more):
    whole, runs = broken_at_every_file_operation(tmp_path, "killed", step, *more)
    assert {run["code"] for run in runs} == {9}
    # What could be read before the run was resumed: ever more, and in the end as much as of the whole run.
    reached = [run["read"] for run in runs if run["read"] is not None]
    assert len(reached) > len(runs) - 8  # the first operations make folder, lock and journal
    assert [r["evaluations"] for r in reached] == sorted(r["evaluations"] for r in reached)
    assert reached[-1] == whole["read"]


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_a_disk_that_gets_full_is_one_line_and_loses_nothing(tmp_path, step):
    _, runs = broken_at_every_file_operation(tmp_path, "full", step)
    for run in runs:
        refused = run["code"] == 2 and "cannot be written (No space left on device); " in run["line"]
        assert refused or (run["code"] == 0 and run["read"] == run["resumed"]), run


def test_a_disk_that_is_full_during_the_analyses_ends_the_run_with_nothing_left_out(tmp_path, msd, monkeypatch):
    record = History.record

    def full(self, stage, evaluation, purpose, *more, **named):
        if purpose == "uncertainty":
            raise JournalError("cannot be written (No space left on device)")
        record(self, stage, evaluation, purpose, *more, **named)

    monkeypatch.setattr(History, "record", full)
    with pytest.raises(JournalError, match="No space left"):
        identify(msd(), solver="bobyqa", out=tmp_path)
    monkeypatch.undo()
    resumed = identify(msd(), solver="bobyqa", out=tmp_path, resume=True)
    assert resumed.stages[0].uncertainty == identify(msd(), solver="bobyqa").stages[0].uncertainty is not None


def test_the_history_of_ten_thousand_runs_is_written_and_read(tmp_path, msd):
    problem = msd()
    (case,) = problem.cases
    cases = tuple(replace(case, id=f"run number {k}") for k in range(10_000))
    evaluation = problem.evaluate(problem.space.start)
    many = SimpleNamespace(
        name="all", space=problem.space, labels=tuple(f"{c.id}: x least_squares" for c in cases), cases=cases
    )
    with History(tmp_path) as history:
        history.begin(many, "", b"")
        numbers = np.ones(10_000)
        history.record("all", replace(evaluation, criteria=numbers), "search", False, residuals=False)
        history.conclude(b"{}")
    assert read_history(tmp_path)["all"].criteria == many.labels


def test_an_interrupted_run_is_never_overwritten(tmp_path, msd):
    stopped = identify(msd(), solver="bobyqa", out=tmp_path, observer=Interrupt(6))
    with pytest.raises(JournalError, match="contains an interrupted run; continue with resume=True"):
        identify(msd(), solver="bobyqa", out=tmp_path)
    assert Result.from_json(tmp_path) == stopped
    done = identify(msd(), solver="bobyqa", out=tmp_path, resume=True)
    again = identify(msd(), solver="bobyqa", out=tmp_path)  # a complete one is
    assert again.parameters == done.parameters


def test_two_writers_the_second_is_told_who_the_first_is(tmp_path, msd):
    class Second(Observer):
        """Starts another run in the same folder while the first one goes on: in a thread, in a process."""

        messages = ()

        def started(self, problem, solver, why, stop):
            with ThreadPoolExecutor(1) as pool, pytest.raises(LockedError) as refused:
                pool.submit(identify, msd(), solver="bobyqa", out=tmp_path).result()
            with start(tmp_path, "bobyqa", folder=tmp_path, stderr=subprocess.PIPE) as other:
                self.messages = (str(refused.value), other.communicate(timeout=60)[1])

    observer = Second()
    result = identify(msd(), solver="bobyqa", out=tmp_path, observer=observer)
    for message in observer.messages:
        assert f"(process {os.getpid()} on " in message
        assert "is writing to this folder; wait until it ends, or choose another folder" in message
    assert Result.from_json(tmp_path) == result
    assert {p.name for p in tmp_path.iterdir()} == {"result.json", "history.h5", "run.py"}


def test_a_record_that_is_written_in_parts_is_whole(tmp_path, msd, monkeypatch):
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, data: write(file, data[: len(data) // 2 + 1]))
    identify(msd(), solver="bobyqa", out=tmp_path, observer=Interrupt(20))
    assert len(read_history(tmp_path)["msd"].rows) == 20


def test_a_changed_problem_is_not_resumed(tmp_path, msd):
    identify(msd(), solver="bobyqa", out=tmp_path, observer=Interrupt(6))
    with pytest.raises(HistoryError, match="has changed since"):
        identify(msd(seed=5), solver="bobyqa", out=tmp_path, resume=True)


def test_a_criterion_with_other_options_is_another_problem(tmp_path, analytic):
    def asked(**options):
        y = np.sin(np.arange(50.0)) + np.random.default_rng(0).standard_normal((3, 50))
        task = Task(np.arange(50) * 0.1, {}, ("y",))
        model = analytic(lambda time, inputs, p: {"y": p["a"] * np.sin(10 * time)}, ["a"])
        criteria = [CriterionSpec("y", options=options)]
        case = measured_case("run", model, task, {"y": y}, criteria=criteria)
        return Problem([case], [ParameterSpec("a", 0.5, 0.1, 2.0)])

    identify(asked(), solver="bobyqa", out=tmp_path, observer=Interrupt(4))
    with pytest.raises(HistoryError, match="has changed since"):
        identify(asked(whiten="repeats"), solver="bobyqa", out=tmp_path, resume=True)
    assert identify(asked(), solver="bobyqa", out=tmp_path, resume=True).status is Status.CONVERGED


def test_a_complete_run_is_not_resumed_and_a_budget_can_be_raised(tmp_path, msd):
    identify(msd(), solver="bobyqa", out=tmp_path, stop=StopRules(evaluations=9), with_uncertainty=False)
    with pytest.raises(JournalError, match="the run is complete"):
        identify(msd(), solver="bobyqa", out=tmp_path, resume=True)


def test_ctrl_c_before_the_first_evaluation(tmp_path, msd):
    class AtOnce(Observer):
        def started(self, problem, solver, why, stop):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        identify(msd(), solver="trf", out=tmp_path, observer=AtOnce())
    assert len(read_history(tmp_path / "history.h5")["msd"].rows) == 0
    assert identify(msd(), solver="trf", out=tmp_path, resume=True).status is Status.CONVERGED


def test_a_foreign_file_is_no_history(tmp_path):
    (tmp_path / "history.h5").write_bytes(b"no")
    with pytest.raises(HistoryError, match="cannot be read"):
        read_history(tmp_path)


def test_a_resumed_run_may_be_asked_more_and_simulates_no_search_again(tmp_path, msd):
    class Second(Observer):
        """Presses Ctrl-C when the stage is done, before the run is."""

        def finished(self, result):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        identify(msd(), solver="bobyqa", out=tmp_path, observer=Second(), with_uncertainty=False)
    problem = msd()
    asked = AnalysisSpec(profiles=True, monte_carlo=20)
    stage = identify(problem, solver="bobyqa", out=tmp_path, resume=True, analyses=asked).stages[0]
    assert len(stage.profiles) == 3
    assert len(stage.spread) == 1
    history = read_history(tmp_path)["msd"]
    assert [r.purpose != "uncertainty" for r in history.rows].count(True) == stage.evaluations


def test_only_what_a_dead_process_left_is_removed_and_nothing_of_a_run_below(tmp_path):
    left = [tmp_path / "identified" / ".a.xml.fmuid-unfinished", tmp_path / ".b.json.fmuid-unfinished"]
    others = tmp_path / "other" / "figures" / ".c.png.fmuid-unfinished"
    for file in (*left, others):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    with claim(tmp_path / "other"):
        others.touch()  # what it writes now
        with claim(tmp_path):
            assert not any(file.exists() for file in left)
            assert others.exists()


def interrupted_at(step: int, action: Callable[[], object], module: str) -> bool:
    """Run `action` with a Ctrl-C before its instruction number `step` in `module`; return whether it came."""
    left = step

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal left
        if not frame.f_code.co_filename.endswith(module):
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            left -= 1
            if left == 0:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def test_ctrl_c_at_any_instruction_leaves_whole_rows() -> None:
    def row(k: int, failure: str | None = None) -> Row:
        point, values = np.array([k, -k], dtype=float), {"a": float(k), "b": 2.0 * k}
        return Row(point, values, point + 1, np.zeros(0), 3.0 * k, failure, "search", 0.1, k == 1)

    step = 1
    while True:
        rows = Rows()
        rows.append(row(1))
        came = interrupted_at(step, partial(rows.append, row(2, "failed")), "recorded_rows.py")
        assert rows.parameters(["a"]).ravel().tolist() == [1.0, 2.0][: len(rows)]
        assert rows.failed.tolist() == [False, True][: len(rows)]
        rows.append(row(3))
        assert rows[-1].parameters == {"a": 3.0, "b": 6.0}
        assert rows.failed.tolist()[-1] is False
        assert rows.improved.tolist() == [True, False, False][: len(rows)]
        if not came:
            break
        step += 1
    assert step > 50


def test_ctrl_c_at_any_instruction_leaves_whole_records(tmp_path: Path) -> None:
    path, magic, step = tmp_path / "journal", b"some journal\n", 1
    while True:
        journal = Journal(path, magic)
        journal.append("first")
        came = interrupted_at(step, partial(journal.append, "second, a longer one"), "journal.py")
        position = journal.append("third")
        assert journal.read(position) == "third"
        journal.close()
        contents = [content for content, _, _ in records(path, magic)]
        assert contents in (["first", "third"], ["first", "second, a longer one", "third"])
        if not came:
            break
        step += 1
    assert step > 50
