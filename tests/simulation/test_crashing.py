"""Commands whose FMU crashes or hangs end with one clear line, not with it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fmus import FAULTS

from fmuid import Experiment, Measurements, Signal, StopRules, Task, identify, load_fmu, write_measurements
from fmuid.data.crosscheck_csv import Table, write_csv

TIME = np.arange(301) * 1e-3
TOML = """
[models.bench]
fmu = "{fmu}"

[parameters.c]
start = {start}
lower = 50
upper = 300

[roles]
identification = ["run"]
validation = ["other"]

[stages.all]
"""


@pytest.fixture(scope="module")
def bench(build, tmp_path_factory) -> Path:
    """A campaign and a run of it whose FMU is killed at 0.1 s where c > 140, and both say c = 150."""
    folder = tmp_path_factory.mktemp("crashing")
    good, bad = build(2), build(2, defines=(f"BAD={FAULTS['segfault']}",))
    (folder / "bad.fmu").symlink_to(bad)
    (folder / "hangs.fmu").symlink_to(build(2, defines=(f"BAD={FAULTS['hang']}",)))
    (folder / "never.fmu").symlink_to(build(2, defines=("TIRES=0",)))
    inputs = {"u": np.sin(TIME / 9e-3)}
    (y,) = load_fmu(good).simulate(Task(TIME, inputs, ("y",)), {"c": 130.0})
    signals = {"u": Signal("u", inputs["u"], "N", "input"), "y": Signal("y", y, "1", "output", 1e-4)}
    runs = {name: Experiment(name, "bench", TIME, signals) for name in ("run", "other")}
    write_measurements(Measurements(runs), folder / "measurements.h5")
    write_csv(Table(TIME, {**inputs, "y": y}, {"u": "N"}), folder / "reference.csv")
    (folder / "campaign.toml").write_text(TOML.format(fmu=good, start=100.0))
    identify(folder, out=folder / "run", stop=StopRules(4))
    (folder / "campaign.toml").write_text(TOML.format(fmu=bad, start=150.0))
    result = json.loads((folder / "run" / "result.json").read_text())
    result["parameters"]["c"] = 150.0
    (folder / "run" / "result.json").write_text(json.dumps(result))
    return folder


def fmuid(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from fmuid.cli import main; main()", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, check=False)


def name(folder: Path, model: str) -> str:
    return (folder / f"{model}.fmu").resolve().name


@pytest.mark.parametrize(
    ("command", "model", "line"),
    [
        ("simulate bad.fmu --set c=150", "bad", "crashed (SIGSEGV)"),
        ("simulate . -e run", "bad", "crashed (SIGSEGV) (with c = 150)"),
        ("simulate hangs.fmu --set c=150 --time-limit 1", "hangs", "took longer than the time limit of 1 s"),
        ("compare bad.fmu reference.csv --set c=150", "bad", "crashed (SIGSEGV)"),
        ("init reference.csv --fmu never.fmu --out new", "never", "crashed (SIGABRT)"),
    ],
)
def test_no_prediction_is_one_line(bench: Path, command: str, model: str, line: str) -> None:
    done = fmuid(bench, *command.split())
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"fmuid: {name(bench, model)}: {line}\n"


@pytest.mark.slow
def test_one_of_many_is_said_where_it_belongs(bench: Path) -> None:
    crashed = f"{name(bench, 'bad')}: crashed (SIGSEGV) (with c = 150)"
    check = fmuid(bench, "check", ".")
    assert (check.returncode, check.stderr) == (1, "")
    assert (
        f"error: [stages.all]: cannot be simulated at the start values (run: {crashed}); move the start values"
        in (check.stdout.splitlines())
    )
    validate = fmuid(bench, "validate", "run")
    assert (validate.returncode, validate.stderr) == (1, "")
    assert validate.stdout.splitlines()[-1].split(maxsplit=3) == ["other", "y", "1", crashed]
    report = fmuid(bench, "report", "run", "--out", "page")
    assert (report.returncode, report.stderr) == (0, "")
    assert crashed in (bench / "page" / "index.html").read_text()


@pytest.mark.slow
def test_validation_and_report_of_a_search_that_failed(bench: Path) -> None:
    crashed = f"{name(bench, 'bad')}: crashed (SIGSEGV) (with c = 150)"
    done = fmuid(bench, "identify", ".", "--out", "again", "--quiet", "--json", "again.json")
    assert (done.returncode, done.stderr) == (1, "")
    answer = json.loads((bench / "again.json").read_text())
    assert "validation" not in answer  # there is no estimate to validate
    assert crashed in (bench / "again" / "report" / "index.html").read_text()
