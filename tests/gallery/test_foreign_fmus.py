"""FMUs that other hands wrote: init, and a diagnosis that finds the law which they lack, at one of their states."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid import Task, diagnose
from fmuid.cli.app import run
from fmuid.diagnosis.diagnose import Found
from fmuid.simulation.fmu import load_fmu
from tests.foreign_fmus.plants import PLANTS, Gap, plant_fmu, write_logs
from tests.gallery.test_habits import edited
from tests.reference.plain_fmpy import simulate_fmu

RIGS = {
    "DRIVE": (3, lambda x, z: np.array([0, 0, 0, -0.05 * x[3] * abs(x[3])]), "quadratic@der(w2)"),
    "HOUSE": (2, lambda x, z: np.array([-1.0e-4 * (x[0] - 293), 0]), "loss@der(T_room)"),
    "CIRCUIT": (2, lambda x, z: np.array([-60 * np.tanh(x[0] / 0.02), 0]), "voltage_drop@der(i)"),
    "TANK": (3, lambda x, z: np.array([0, -6e-3 * x[1]]), "leakage@der(h2)"),
}


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def campaign_of(name: str, folder: Path, **sizes: int) -> Path:
    fmi, lacking, _ = RIGS[name]
    fmu = plant_fmu(name, folder, fmi)
    logs = write_logs(name, Gap(lacking), folder / "logs", **sizes)
    assert run(["init", *map(str, logs), "--fmu", str(fmu), "--out", str(folder / "campaign"), "--quiet"]) == 0
    return folder / "campaign"


def assert_same_predictions(diagnosed: Found, fmu: Path) -> None:
    """The corrected FMU predicts in FMPy, and here, what was fitted."""
    corrected, values = load_fmu(fmu), diagnosed.corrected.fit.values
    assert corrected.interface == "co-simulation"
    for case in diagnosed.subject.model.cases:
        of_fmu = {n: v for n, v in values.items() if n in case.simulator.variables}
        fitted = case.simulator.simulate(case.task, of_fmu)
        assert np.ptp(fitted) > 0.1
        np.testing.assert_array_equal(corrected.simulate(case.task, {}), fitted)
        tolerance = case.task.tolerance or 1e-6
        np.testing.assert_allclose(simulate_fmu(fmu, case.task, {}, tolerance), fitted, atol=1e-9)


def test_a_law_at_a_state_is_found_and_its_fmu_predicts_what_was_fitted(tmp_path):
    campaign = campaign_of("CIRCUIT", tmp_path, runs=3, samples=150)
    assert run(["identify", str(campaign), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    identified = json.loads((tmp_path / "run" / "result.json").read_text())["parameters"]
    assert identified["C"] == pytest.approx(PLANTS["CIRCUIT"].values[2], rel=0.05)
    diagnosed = diagnose(campaign, out=tmp_path / "out")
    assert diagnosed.diagnosis.verdict.effects == ("voltage_drop@der(i)",)
    values = diagnosed.corrected.fit.values
    assert values["i.voltage_drop"] == pytest.approx(60, rel=0.02)
    corrected = load_fmu(tmp_path / "out" / "corrected" / "Circuit2.fmu")
    laws = [n for n in corrected.variables if n.startswith("i.")]
    assert laws == ["i.voltage_drop", "i.voltage_drop_width"]  # and no law that was only tried
    assert_same_predictions(diagnosed, corrected.path)
    assert run(["check", str(tmp_path / "out" / "corrected"), "--quiet"]) == 0


def test_runs_may_start_elsewhere_than_the_fmu_does(tmp_path, monkeypatch):
    """Their room starts 4 K warmer; the FMU calculates where its wall starts, so only the room's start is estimated."""
    monkeypatch.setitem(PLANTS, "HOUSE", replace(PLANTS["HOUSE"], start=(297.0, 290.0)))
    logs = write_logs("HOUSE", Gap(RIGS["HOUSE"][1]), tmp_path / "logs", runs=3, samples=150)
    monkeypatch.undo()
    wall = 'name="T_wall" valueReference="7" causality="output" variability="continuous"'
    fmu = edited(
        plant_fmu("HOUSE", tmp_path),
        f'{wall} initial="exact"><Real unit="K" start="290.0"/>',
        f'{wall} initial="calculated"><Real unit="K"/>',
    )
    assert run(["init", *map(str, logs), "--fmu", str(fmu), "--out", str(tmp_path / "campaign"), "--quiet"]) == 0
    assert 'segments = "run"' in (tmp_path / "campaign" / "campaign.toml").read_text()
    diagnosis = diagnose(tmp_path / "campaign", out=tmp_path / "out").diagnosis
    assert diagnosis.verdict.effects == (RIGS["HOUSE"][2],)
    assert any("start from values of T_room that are fitted to each run" in note for note in diagnosis.notes)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DRIVE", "HOUSE", "TANK"])
def test_laws_of_every_domain_are_found(tmp_path, name):
    campaign = campaign_of(name, tmp_path)
    diagnosed = diagnose(campaign, out=tmp_path / "out")
    assert diagnosed.diagnosis.verdict.effects == (RIGS[name][2],)
    assert_same_predictions(diagnosed, tmp_path / "out" / "corrected" / f"{name.title()}{RIGS[name][0]}.fmu")


@pytest.mark.slow
def test_a_resistance_that_varies_is_found_and_its_fmu_predicts_what_was_fitted(tmp_path):
    """The windings warm up with the current, which the FMU lacks; its parameters are fixed during a run."""
    _, resistance, _, _ = PLANTS["CIRCUIT"].values
    inductance = PLANTS["CIRCUIT"].values[0]
    lacking = Gap(lambda x, z: np.array([-0.25 * resistance * abs(x[0]) * x[0] / inductance, 0]))
    fmu = plant_fmu("CIRCUIT", tmp_path, 3)
    logs = write_logs("CIRCUIT", lacking, tmp_path / "logs", runs=3, samples=200)
    assert run(["init", *map(str, logs), "--fmu", str(fmu), "--out", str(tmp_path / "campaign"), "--quiet"]) == 0
    diagnosed = diagnose(tmp_path / "campaign", out=tmp_path / "out")
    assert diagnosed.diagnosis.verdict.effects == ("varies@R(i)",)
    assert_same_predictions(diagnosed, tmp_path / "out" / "corrected" / "Circuit3.fmu")


@pytest.mark.slow
def test_an_equation_is_found_at_a_state_and_its_fmu_predicts_what_was_fitted(tmp_path):
    """What leaks at high pressure grows with its power of 1.5, which no law of the catalogue does."""
    fmu = plant_fmu("VESSEL", tmp_path, 3)
    lacking = Gap(lambda x, z: np.array([-0.8 * x[0] ** 1.5]))
    logs = write_logs("VESSEL", lacking, tmp_path / "logs", runs=3, samples=160)
    assert run(["init", *map(str, logs), "--fmu", str(fmu), "--out", str(tmp_path / "campaign"), "--quiet"]) == 0
    assert run(["diagnose", str(tmp_path / "campaign"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    diagnosis = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    law = diagnosis["law_found"]
    assert (diagnosis["verdict"]["kind"], diagnosis["verdict"]["port"], law["port"]) == (
        "unknown",
        "der(p)",
        "der(p)",
    )
    largest = float(re.match(r"[\d.]+ Pa.s-1 \* \(p/([\d.]+)\)\*sqrt\(abs", law["formula"])[1])
    assert float(law["formula"].split()[0]) == pytest.approx(0.8 * largest**1.5, rel=0.05)
    assert diagnosis["corrected_differs"] < 1e-4  # solver errors; the program reports more than 0.05
    fmu = load_fmu(tmp_path / "out" / "corrected" / "Vessel3.fmu")
    time = np.linspace(0.0, 8.0, 81)
    task = Task(time, {"q": 2.2 + 0 * time}, ("p",), tolerance=1e-8)
    np.testing.assert_allclose(simulate_fmu(fmu.path, task, {}, 1e-8), fmu.simulate(task, {}), atol=1e-9)
