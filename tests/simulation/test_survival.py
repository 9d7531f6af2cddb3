"""Commands as a user runs them: FMUs that misbehave, and processes that are killed, do not change where they end."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest
from fmus import FAULTS

from fmuid import (
    Experiment,
    Measurements,
    Signal,
    Task,
    diagnosis_pipeline,
    load_fmu,
    read_history,
    write_measurements,
)
from fmuid.campaigns.signal_catalogue import RecordedSetup, signal_catalogue
from fmuid.cli import main
from fmuid.core.campaign import ModelSpec
from fmuid.identification.history import JOURNAL

TIME = np.arange(301) * 1e-3
TOML = """
[models.bench]
fmu = "{fmu}"

[parameters.d]
start = 0.5
lower = 0.1
upper = 2

[parameters.c]
start = 100
lower = 50
upper = 300

[stages.near]
free = ["c"]
solver = {{ name = "crs2 > bobyqa", crs2 = {{ evaluations = {evaluations} }} }}

[stages.both]
"""


def campaign(fmu: Path, folder: Path, evaluations: int) -> Path:
    """Runs of an oscillator with d = 0.7 and c = 130."""
    inputs = {"u": np.sin(TIME / 9e-3)}
    (y,) = load_fmu(fmu).simulate(Task(TIME, inputs, ("y",)), {"d": 0.7, "c": 130.0})
    noise = 1e-4 * np.random.default_rng(0).standard_normal(y.size)
    signals = {"u": Signal("u", inputs["u"], "N", "input"), "y": Signal("y", y + noise, "1", "output", 1e-4)}
    folder.mkdir()
    write_measurements(
        Measurements({"run": Experiment("run", "bench", TIME, signals)}), folder / "measurements.h5"
    )
    (folder / "campaign.toml").write_text(TOML.format(fmu=fmu, evaluations=evaluations))
    return folder


def arguments(folder: Path, *more: str) -> list[str]:
    return ["identify", str(folder), "--out", str(folder / "run"), "--no-report", "--quiet", *more]


def command(folder: Path, *more: str) -> list[str]:
    return [sys.executable, "-c", "from fmuid.cli import main; main()", *arguments(folder, *more)]


def files(folder: Path) -> set[str]:
    """What a run consists of; a lock that nobody holds is none."""
    return {str(path.relative_to(folder)) for path in (folder / "run").rglob("*") if path.name != ".lock"}


def outcome(folder: Path) -> list[object]:
    """What a result says, but for the time it took."""
    result = json.loads((folder / "run" / "result.json").read_text())
    keep = ("parameters", "cost", "evaluations", "failures", "status", "uncertainty", "criteria", "warnings")
    return [{key: stage[key] for key in keep} for stage in result["stages"]]


class Identification:
    """`fmuid identify`, for the kills: what it is run on, its files, and what must be as in an unbroken run."""

    share = 17  # of twenty kills
    journal, result = JOURNAL, "result.json"
    late = ("history.h5", "result.json", "identified")  # what is written when it ends, in this order

    @staticmethod
    def campaign(fmu: Path, folder: Path) -> Path:
        return campaign(fmu, folder, evaluations=150)

    @staticmethod
    def arguments(folder: Path) -> list[str]:
        return arguments(folder, "--workers", "0")

    @staticmethod
    def outcome(folder: Path) -> object:
        return files(folder), outcome(folder)


class Diagnosis:
    """`fmuid diagnose`: the force acts in a wrong scale."""

    share = 3
    journal, result = diagnosis_pipeline.JOURNAL, diagnosis_pipeline.FILE_NAME
    late = ("diagnosis.json", "index.html", "corrected")

    @staticmethod
    def campaign(fmu: Path, folder: Path) -> Path:
        model, random, runs = load_fmu(fmu), np.random.default_rng(3), {}
        for name, period in (("fast", 9e-3), ("slow", 17e-3), ("slower", 29e-3)):
            u = np.sin(TIME / period)
            (y,) = model.simulate(Task(TIME, {"u": 1.2 * u}, ("y",)), {"d": 0.7, "c": 130.0})
            for k in range(2):
                noisy = y + 1e-4 * random.standard_normal(y.size)
                signals = {"u": Signal("u", u, "N", "input"), "y": Signal("y", noisy, "1", "output")}
                id_ = f"{name}{k or ''}"
                runs[id_] = Experiment(id_, "bench", TIME, signals, repeat_of=name if k else None)
        folder.mkdir()
        write_measurements(Measurements(runs), folder / "measurements.h5")
        head, *effects = re.split(
            r'(?m)^(?=\[effects\."[^"]*"\]$)',
            signal_catalogue([RecordedSetup([*runs.values()], ModelSpec("bench", fmu), model.variables)]),
        )
        few = [effect for effect in effects if effect.startswith(('[effects."gain', '[effects."offset'))]
        (folder / "effects.toml").write_text("".join([head, *few]))
        named = '[effects]\ncatalogue = "effects.toml"\n'
        (folder / "campaign.toml").write_text(TOML.format(fmu=fmu, evaluations=12) + named)
        return folder

    @staticmethod
    def arguments(folder: Path) -> list[str]:
        return ["diagnose", str(folder), "--out", str(folder / "run"), "--workers", "0", "--quiet"]

    @staticmethod
    def outcome(folder: Path) -> object:
        text = (folder / "run" / "diagnosis.json").read_text()
        return files(folder), text.replace(str(folder), "")  # it names its campaign


@pytest.mark.parametrize(
    "kind",
    [
        "crash",
        *(
            pytest.param(k, marks=pytest.mark.slow)
            for k in ("hang", "segfault", "nan", "devours", "leaves", "fatal")
        ),
    ],
)
def test_an_fmu_that_misbehaves_in_a_region_does_not_stop_the_search(build, tmp_path, kind):
    fmu = build(2, defines=(f"BAD={FAULTS[kind]}",))
    folder = campaign(fmu, tmp_path / "bench", evaluations=12)
    limits = ["--workers", "2", "--time-limit", "4", "--memory-limit", "200"]
    done = subprocess.run(command(folder, *limits), capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    near, both = outcome(folder)
    assert near["failures"] > 3
    assert both["parameters"]["c"] == pytest.approx(130.0, rel=5e-3)
    assert both["parameters"]["d"] == pytest.approx(0.7, rel=0.05)
    rows = read_history(folder / "run")["near"].rows
    assert all(row.failure for row in rows if row.parameters["c"] > 140.0)
    assert all(np.isnan(row.cost) for row in rows if row.failure)


BESIDE_A_WALL = [
    "crash",
    "segfault",
    "leaves",
    "hang",
    "slow",
    "interrupts",
    "nan",
    "fails",
    "fatal",
    "devours",
    "ends",
]


@pytest.mark.parametrize(
    ("kind", "solver"),
    [
        pytest.param(k, s, marks=() if (k, s) == ("crash", "trf") else pytest.mark.slow)
        for k in BESIDE_A_WALL
        for s in ("trf", "bobyqa", "sbplx")
    ],
)
def test_the_truth_beside_a_wall_of_failures_is_found(build, tmp_path, kind, solver):
    """At c = 130; above 140 the FMU fails, in eleven ways."""
    folder = campaign(build(2, defines=(f"BAD={FAULTS[kind]}",)), tmp_path / "bench", evaluations=12)
    more = ["--workers", "2", "--time-limit", "1", "--memory-limit", "200", "--stage", "both", "--solver", solver]
    done = subprocess.run(command(folder, *more), capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    (both,) = outcome(folder)
    assert both["status"] == "converged"
    assert both["parameters"]["c"] == pytest.approx(130.0, rel=5e-3)
    assert both["parameters"]["d"] == pytest.approx(0.7, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_killed_at_ten_random_moments_it_ends_as_an_unbroken_run(build, tmp_path, workers):
    fmu = build(2, defines=(f"BAD={FAULTS['fails']}",))
    unbroken = campaign(fmu, tmp_path / "unbroken", evaluations=150)
    assert subprocess.run(command(unbroken), timeout=600, check=False).returncode == 0
    folder = campaign(fmu, tmp_path / "broken", evaluations=150)
    journal, kills, moments = folder / "run" / JOURNAL, 0, random.Random(10)
    process = subprocess.Popen(command(folder, "--workers", workers), start_new_session=True)
    sizes = []
    while kills < 10:
        before = journal.stat().st_size if journal.exists() else 0
        while process.poll() is None and (not journal.exists() or journal.stat().st_size <= before):
            time.sleep(0.001)
        time.sleep(moments.uniform(0.0, 0.01))  # while it writes, simulates, thinks
        if process.poll() is not None:
            break
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        kills += 1
        sizes.append(journal.stat().st_size)
        process = subprocess.Popen(command(folder, "--workers", workers, "--resume"), start_new_session=True)
    assert process.wait(100) == 0
    assert kills == 10
    assert sizes == sorted(sizes)  # each went on from where the one before was
    assert outcome(folder) == outcome(unbroken)
    # As many evaluations as without a kill: none was made twice.
    rows = [[len(s.rows) for s in read_history(f / "run").values()] for f in (folder, unbroken)]
    assert rows[0] == rows[1]


@contextmanager
def started(*arguments: str) -> Iterator[BaseProcess]:
    """A command in a process of its own, forked from one that has the libraries: they take longer than the run."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["fmuid.cli.app", "fmuid.identification.identify", "fmuid.diagnosis_pipeline"])
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "argv", ["fmuid", *arguments])  # a child's are its parent's
        process = context.Process(target=main)
        process.start()
    yield process
    process.join(600)


def ended(arguments: list[str]) -> int | None:
    """Run a command to its end and return its exit code."""
    with started(*arguments) as process:
        pass
    return process.exitcode


def await_file(process: BaseProcess, file: Path) -> None:
    """Wait until a process has made a file, or has ended."""
    while process.exitcode is None and not file.exists():
        time.sleep(0.0002)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Identification, Diagnosis])
def test_killed_at_any_moment_of_a_run_nothing_is_lost(build, tmp_path, kind):
    """`make kills` does so 200 times; every third kill is aimed at the last 50 ms, when the result is written."""
    fmu, moments = build(2), random.Random(21)
    unbroken = kind.campaign(fmu, tmp_path / "unbroken")
    kills = int(os.environ.get("FMUID_KILLS", "12")) * kind.share // 20
    ended(kind.arguments(unbroken))  # and the libraries are loaded
    shutil.rmtree(unbroken / "run")
    with started(*kind.arguments(unbroken)) as process:
        await_file(process, unbroken / "run" / kind.journal)
        begin = time.monotonic()
    assert process.exitcode == 0
    recording, seen = time.monotonic() - begin, Counter()
    for k in range(kills):
        folder = kind.campaign(fmu, tmp_path / f"broken{k}")
        with started(*kind.arguments(folder)) as process:
            if k % 3:
                await_file(process, folder / "run" / kind.journal)
                time.sleep(moments.uniform(0.0, recording))
            else:
                await_file(process, folder / "run" / kind.late[k // 3 % len(kind.late)])
                time.sleep(moments.uniform(0.0, 0.05))
            alive = process.exitcode is None
            process.kill()
        seen["killed"] += alive
        seen["killed in the last 50 ms"] += alive and not k % 3
        recorded = (folder / "run" / kind.journal).exists()
        seen["killed after the last record"] += alive and not recorded and (folder / "run" / kind.result).exists()
        seen["resumed"] += recorded
        code = ended([*kind.arguments(folder), "--resume"])
        complete = not recorded and (folder / "run" / kind.result).exists()
        assert code == 0 or (code == 2 and complete), k  # then it says that the run is complete
        assert kind.outcome(folder) == kind.outcome(unbroken), k
        shutil.rmtree(folder)
    print(f"\n{kind.__name__}, recording for {recording:.2f} s; of {kills}: {dict(seen)}")
    assert min(seen[what] for what in ("killed", "killed in the last 50 ms", "resumed")) > 0
