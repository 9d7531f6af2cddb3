"""The first minute: a rig whose model lacks something, and the commands that find it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fmuid.cli.app import run
from fmuid.core.campaign import ModelSource
from fmuid.demo import drive
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.model_source import built_model
from fmuid.simulation.simulator import Task


def test_the_fmu_that_comes_with_fmuid_is_the_model_of_the_demo(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(drive, "_can_build", lambda: False)
    rig = drive.make_rig(tmp_path / "demo")
    assert rig.model == ("--fmu", str(tmp_path / "demo" / "Drive.fmu"))
    fmu = load_fmu(tmp_path / "demo" / "Drive.fmu")
    built = load_fmu(built_model(ModelSource(Path(drive.__file__).with_name("Bench.mo"), "Bench.Drive")))
    for name in ("tau", "w_motor", "w_load", "rotor.J", "shaft.c", "shaft.d", "load.J"):
        one, other = fmu.variables[name], built.variables[name]
        assert (one.unit, one.causality, one.description) == (other.unit, other.causality, other.description)
    time = np.linspace(0.0, 1.0, 201)
    task = Task(time, {"tau": 0.1 * np.sign(np.sin(7 * time))}, ("w_motor", "w_load"))
    for values in ({}, {"rotor.J": 2e-3, "shaft.c": 55.0, "shaft.d": 0.01, "load.J": 5e-3}):
        assert fmu.simulate(task, values) == pytest.approx(built.simulate(task, values), abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("built", "lacking"), [(True, "quadratic@load"), (False, "delay@tau")])
def test_the_demo_finds_what_it_does_not_tell(tmp_path, monkeypatch, capfd, built, lacking):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(drive, "_can_build", lambda: built)
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert run(["demo", "--open", "--json", "demo.json"]) == 0
    output = capfd.readouterr().out
    assert json.loads(Path("fmuid-demo/diagnosis/diagnosis.json").read_text())["verdict"]["effects"] == [lacking]
    assert output.count("\n$ fmuid ") == 3
    assert f"({lacking})." in output
    assert opened == [Path("fmuid-demo/diagnosis/index.html").resolve().as_uri()]
    assert lacking in json.loads(Path("demo.json").read_text())["lacking"]
