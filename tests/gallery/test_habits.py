"""Habits of FMUs and result files by other tools, as a user of the commands meets them."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid.cli.app import run
from fmuid.data.crosscheck_csv import Table, read_csv, write_csv
from tests.foreign_fmus.plants import PLANTS, Gap, plant_fmu, write_logs
from tests.simulation.fmus import FAULTS, make_oscillator

TEXT = '<ScalarVariable name="file" valueReference="99" causality="parameter" variability="fixed"><String start="a.csv"/></ScalarVariable>'  # fmt: skip


def simulated(fmu: Path, *options: str) -> tuple[Table, list[str]]:
    """Run `fmuid simulate`, and return its table and its notes."""
    out, summary = fmu.with_suffix(".csv"), fmu.with_suffix(".json")
    assert run(["simulate", str(fmu), *options, "--out", str(out), "--json", str(summary), "--quiet"]) == 0
    return read_csv(out), json.loads(summary.read_text())["notes"]


def edited(fmu: Path, old: str, new: str) -> Path:
    """Return a copy of an FMU whose description has `new` in place of `old`."""
    copy = fmu.with_name(f"{fmu.stem}Edited.fmu")
    with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(copy, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                assert old in content.decode()
                content = content.decode().replace(old, new, 1).encode()
            target.writestr(name, content)
    return copy


@pytest.mark.parametrize("fmi", [2, 3])
def test_results_up_to_the_end_of_a_simulation_by_the_fmu_are_kept(tmp_path, fmi):
    fmu = make_oscillator(tmp_path, fmi)
    whole, _ = simulated(fmu, "--stop", "0.1", "--step", "0.01")
    part, notes = simulated(fmu, "--stop", "1", "--step", "0.01", "--set", f"fault={FAULTS['ends']}")
    assert part.time[-1] == pytest.approx(0.1)
    assert part.columns["y"] == pytest.approx(whole.columns["y"])
    assert any("the FMU ended the simulation at t = 0.1 s" in note for note in notes)


def test_repeated_times_of_inputs_are_steps(tmp_path):
    """An input that jumps at an event, as tools write it: two rows at one time."""
    fmu = plant_fmu("CIRCUIT", tmp_path)
    time = np.array([0.0, 0.01, 0.01, 0.02, 0.03, 0.04])
    rows = Table(time, {"v_in": np.array([0.0, 0.0, 5.0, 5.0, 5.0, 5.0])}, {"v_in": "V"})
    write_csv(rows, tmp_path / "in.csv")
    outputs, notes = simulated(fmu, "--input", str(tmp_path / "in.csv"))
    assert outputs.columns["i"][:2].tolist() == [0.0, 0.0]
    assert outputs.columns["i"][3] > 0.3
    assert any("the second row is a step right after the first" in note for note in notes)


def test_values_without_an_effect_are_reported(tmp_path):
    fmu = plant_fmu("TANK", tmp_path)
    _, notes = simulated(fmu, "--set", "k2=2e-3", "--set", "A1=0.03", "--output", "h1")
    assert notes == ["no recorded variable depends on k2"]
    _, notes = simulated(fmu, "--set", "k2=2e-3")
    assert notes == []


def test_texts_cannot_be_set(tmp_path, capfd):
    fmu = edited(plant_fmu("TANK", tmp_path), "</ModelVariables>", f"{TEXT}</ModelVariables>")
    assert run(["simulate", str(fmu), "--set", "file=b.csv", "--out", str(tmp_path / "o.csv"), "--quiet"]) == 2
    error = capfd.readouterr().err
    assert "'file' is a String, and only numbers can be set; export the FMU with the value that you want" in error


def test_a_tool_that_an_fmu_needs_is_reported(tmp_path, capfd):
    fmu = edited(plant_fmu("CIRCUIT", tmp_path), "<ModelExchange ", '<ModelExchange needsExecutionTool="true" ')
    fmu = edited(fmu, 'guid="CIRCUIT"', 'guid="CIRCUIT" generationTool="Plant Works"')
    message = "needs Plant Works to be installed (needsExecutionTool)"
    _, notes = simulated(fmu)
    assert notes == [f"{fmu.name} {message}"]
    logs = write_logs("CIRCUIT", Gap(), tmp_path / "logs", runs=1, repeats=1, samples=60)
    assert run(["init", str(logs[0]), "--fmu", str(fmu), "--out", str(tmp_path / "campaign")]) == 0
    assert message in capfd.readouterr().out
    assert run(["check", str(tmp_path / "campaign"), "--no-simulate"]) == 0
    assert message in capfd.readouterr().out


def test_states_and_outputs_may_be_arrays(tmp_path, monkeypatch):
    """A warm rod of three parts with one array of temperatures; its first part radiates, which its model lacks."""
    fmu = plant_fmu("ROD", tmp_path, 3)
    monkeypatch.setitem(PLANTS, "ROD", replace(PLANTS["ROD"], start=(298.0, 295.0, 294.0)))

    def lacking(x: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.array([-4e-11 * (x[0] ** 4 - 293.0**4), 0, 0])

    logs = write_logs("ROD", Gap(lacking), tmp_path / "logs", runs=3, samples=150)
    assert run(["init", *map(str, logs), "--fmu", str(fmu), "--out", str(tmp_path / "campaign"), "--quiet"]) == 0
    assert run(["diagnose", str(tmp_path / "campaign"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    diagnosis = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert diagnosis["verdict"]["effects"][0].endswith("@der(T[1])")
    fitted = "start from values of T[1], T[2], T[3] that are fitted to each run"
    assert any(fitted in note for note in diagnosis["notes"])


def test_runs_may_begin_at_any_time(tmp_path):
    """A run and a suggested experiment that begin at 5000 s, with a law that depends on time."""
    fmu = plant_fmu("TANK", tmp_path)
    late = edited(
        fmu, '<DefaultExperiment stopTime="600.0"/>', '<DefaultExperiment startTime="5000.0" stopTime="5600"/>'
    )
    whole, _ = simulated(fmu, "--step", "1")
    outputs, _ = simulated(late, "--step", "1")
    assert outputs.time[[0, -1]].tolist() == [5000.0, 5600.0]
    assert outputs.columns["h2"] == pytest.approx(whole.columns["h2"], rel=1e-5)
    tables = {}
    for shift in (0.0, 5000.0):
        logs = write_logs(
            "TANK", Gap(lambda x, z: np.array([0, -6e-3 * x[1]])), tmp_path / f"logs{shift:g}", samples=150
        )
        for log in logs:
            table = read_csv(log)
            write_csv(Table(table.time + shift, table.columns, table.units), log)
        folder = tmp_path / f"campaign{shift:g}"
        assert run(["init", *map(str, logs), "--fmu", str(fmu), "--out", str(folder), "--quiet"]) == 0
        assert run(["diagnose", str(folder), "--out", str(folder / "out"), "--quiet"]) == 0
        tables[shift] = json.loads((folder / "out" / "diagnosis.json").read_text())
    assert tables[0.0]["verdict"]["effects"] == tables[5000.0]["verdict"]["effects"] == ["leakage@der(h2)"]
