"""A log whose recorder has an anti-aliasing filter: its inputs are band-limited between the samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from fmu_build import build
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.identification.result import Result
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.simulator import Task

MODEL = """
model Rig "A mass on a spring"
  parameter Real m(unit = "kg") = 1;
  parameter Real d(unit = "N.s/m") = 2;
  parameter Real k(unit = "N/m") = 2000;
  input Real F(unit = "N");
  output Real x(unit = "m", start = 0, fixed = true);
  Real v(start = 0, fixed = true);
equation
  der(x) = v;
  m*der(v) = F - d*v - k*x;
end Rig;
"""
TRUE = {"m": 1.2, "d": 3.0, "k": 2800.0}
STEP, COUNT, FINE = 0.02, 400, 16
SAMPLES = np.arange(COUNT)
BETWEEN = np.arange(FINE * (COUNT - 1) + 1) / FINE


def multisine(at: np.ndarray, seed: int) -> np.ndarray:
    """Return a force at times in samples, with tones up to 0.65 of the Nyquist frequency."""
    tones = np.linspace(0.01, 0.325, 29)
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, tones.size)
    return np.asarray(np.sum(np.cos(2 * np.pi * tones[:, None] * at + phases[:, None]), axis=0))


def levels(seed: int, length: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=4.0, size=COUNT // length + 1)


def held_levels(at: np.ndarray, seed: int) -> np.ndarray:
    """Return the command of a PLC, a new level every five samples."""
    return levels(seed, 5)[np.floor(at / 5 + 1e-9).astype(int)]


def ramps(at: np.ndarray, seed: int) -> np.ndarray:
    return np.interp(at, np.arange(0, COUNT + 4, 4), levels(seed, 4))


def lines(at: np.ndarray, seed: int) -> np.ndarray:
    """Return a command that an amplifier ramps from sample to sample, whose samples are those of a multisine."""
    return np.interp(at, SAMPLES, multisine(SAMPLES, seed))


def held(at: np.ndarray, seed: int) -> np.ndarray:
    """Return a command that is held, whose samples are those of a multisine."""
    return multisine(np.floor(at + 1e-9), seed)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Fmu:
    folder = tmp_path_factory.mktemp("rig")
    (folder / "Rig.mo").write_text(MODEL)
    return load_fmu(build(folder / "Rig.mo", "Rig", folder, "2"))


def record(
    rig: Fmu, force: Callable[[np.ndarray, int], np.ndarray], true: Mapping[str, float], bend: float
) -> None:
    """Write three runs, simulated on a fine grid; the gauge of the real rig reads large travels too `bend`-fold."""
    for seed in range(3):
        task = Task(STEP * BETWEEN, {"F": force(BETWEEN, seed)}, ("x",), tolerance=1e-8, interpolation="linear")
        x = rig.simulate(task, true)[0, ::FINE]
        x = x * (1 + bend * (x / np.ptp(x)) ** 2)
        x += 0.01 * np.std(x) * np.random.default_rng(10 + seed).normal(size=COUNT)
        rows = np.column_stack([STEP * SAMPLES, force(SAMPLES.astype(float), seed), x])
        np.savetxt(f"run{seed}.csv", rows, delimiter=",", comments="", header="time [s],F [N],x [m]")


LOGS = ["run0.csv", "run1.csv", "run2.csv"]


@pytest.mark.parametrize(
    ("force", "bend", "timing"),
    [
        (multisine, 0.0, "band-limited"),
        (multisine, 0.5, "band-limited"),
        (lines, 0.5, "linear"),
        (held, 0.5, "held"),
        (held_levels, 0.0, "held"),
        (ramps, 0.5, "linear"),
    ],
)
def test_init_chooses_the_timing_of_the_recorder(force, bend, timing, rig, tmp_path, monkeypatch, fmuid) -> None:
    monkeypatch.chdir(tmp_path)
    record(rig, force, TRUE, bend)
    code, out, err = fmuid("init", *LOGS, "--fmu", rig.path, "--out", "found")
    assert (code, err) == (0, "")
    assert load_campaign("found").models["Rig"].timing == timing
    assert ("inputs are band-limited, as after an anti-aliasing filter" in out) == (timing == "band-limited")


def test_the_parameters_are_those_of_the_rig(rig, tmp_path, monkeypatch, fmuid) -> None:
    monkeypatch.chdir(tmp_path)
    record(rig, multisine, TRUE, 0.0)
    assert fmuid("init", *LOGS, "--fmu", rig.path, "--out", "found")[0] == 0
    assert fmuid("identify", "found", "--out", "result", "--no-report", "--quiet")[0] == 0
    assert Result.from_json("result").parameters == pytest.approx(TRUE, rel=2e-3)
    file = Path("found/campaign.toml")
    file.write_text(file.read_text().replace('timing = "band-limited"', 'timing = "linear"'))
    assert fmuid("identify", "found", "--out", "lines", "--no-report", "--quiet")[0] == 0
    assert Result.from_json("lines").parameters != pytest.approx(TRUE, rel=1e-2)
