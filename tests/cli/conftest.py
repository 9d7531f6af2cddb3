from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fmuid.cli.app import run
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task

TOML = """\
[campaign]
name = "bench"

[models.oscillator]
fmu = "{fmu}"
map = {{ position = "x" }}

[parameters.m]
start = 1.0
lower = 0.5
upper = 2
unit = "kg"

[parameters.d]
start = 0.5
lower = 0.1
upper = 5

[settings]
c = 90

[roles]
identification = ["step", "sine"]
validation = ["pulse"]

[stages.all]
budget = {{ evaluations = 100 }}
"""


@pytest.fixture(scope="session")
def oscillator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A driven oscillator, built by `fmuid build`: m der(v) = u + wind - d v - c x, y = gain x."""
    folder = tmp_path_factory.mktemp("oscillator")
    source = Path(__file__).with_name("Oscillator.mo")
    assert run(["build", str(source), "Oscillator", "--out", str(folder), "--quiet"]) == 0
    return folder / "Oscillator.fmu"


@pytest.fixture(scope="session")
def measurements(oscillator: Path) -> Measurements:
    """Runs of an oscillator with m = 1.2 kg, d = 0.8, c = 90, recorded with 0.1 mm of noise."""
    rng = np.random.default_rng(1)
    time = np.linspace(0.0, 1.0, 201)
    runs = {}
    for name, u in (("step", 5.0 * (time > 0.2)), ("sine", 5 * np.sin(9 * time)), ("pulse", 9.0 * (time < 0.1))):
        task = Task(time, {"u": u}, ("x",), {"m": 1.2, "d": 0.8, "c": 90.0})
        x = load_fmu(oscillator).simulate(task, {})[0] + 1e-4 * rng.standard_normal(time.size)
        signals = {
            "u": Signal("u", u, "N", "input"),
            "position": Signal("position", 1e3 * x, "mm", "output", sigma=0.1),
        }
        runs[name] = Experiment(name, "oscillator", time, signals)
    return Measurements(runs)


@pytest.fixture
def folder(tmp_path: Path, oscillator: Path, measurements: Measurements, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A campaign that is right, in the current folder."""
    monkeypatch.chdir(tmp_path)
    write_measurements(measurements, tmp_path / "bench" / "measurements.h5")
    (tmp_path / "bench" / "campaign.toml").write_text(TOML.format(fmu=oscillator))
    return tmp_path / "bench"


Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def fmuid(capfd: pytest.CaptureFixture[str]) -> Command:
    """Run a command; return exit code, stdout and stderr."""

    def command(*arguments: object) -> tuple[int, str, str]:
        code = run([str(a) for a in arguments])
        out, err = capfd.readouterr()
        return code, out, re.sub(r"\x1b\[[0-9;]*m", "", err)

    return command
