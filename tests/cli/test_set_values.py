"""Values that `fmuid simulate --set` takes: names of enumerations and Booleans, within the declared bounds."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from fmuid.cli.app import run
from tests.foreign_fmus.plants import plant_fmu
from tests.simulation.fmus import make_oscillator


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_oscillator(tmp_path_factory.mktemp("fmu"))


@pytest.fixture
def simulate(fmu: Path, tmp_path: Path) -> Callable[..., int]:
    out = tmp_path / "out.csv"
    command = ["simulate", str(fmu), "--stop", "0.1", "--step", "0.1", "--out", str(out), "--quiet"]
    return lambda *texts: run([*command, *(word for text in texts for word in ("--set", text))])


def columns(folder: Path) -> dict[str, str]:
    with (folder / "out.csv").open() as file:
        return next(csv.DictReader(file))


@pytest.mark.parametrize(
    ("by_name", "by_number"), [("mode=b", "mode=2"), ("flip=true", "flip=1"), ("flip=False", "flip=0")]
)
def test_enumerations_and_booleans_are_set_by_name_or_number(simulate, tmp_path, by_name, by_number):
    assert simulate(by_name) == 0
    first = columns(tmp_path)
    assert simulate(by_number) == 0
    assert columns(tmp_path) == first


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mode=7", "'mode' cannot be 7; choose one of a (1), b (2)"),
        ("mode=c", "'mode' cannot be c; choose one of a (1), b (2)"),
        ("flip=2", "'flip' cannot be 2; choose true or false"),
        ("m=heavy", "'heavy' of 'm' is not a number; write a number"),
        ("m=nan", "'m' is nan; write a finite number"),
    ],
)
def test_other_values_are_refused(simulate, capfd, text, message):
    assert simulate(text) == 2
    assert message in capfd.readouterr().err


def test_declared_bounds_hold(tmp_path, capfd):
    fmu = plant_fmu("DRIVE", tmp_path)
    bounded = tmp_path / "Bounded.fmu"
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(bounded, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            new.writestr(name, content.replace(b'start="0.002"', b'start="0.002" min="0.001" max="0.1"'))
    assert run(["simulate", str(bounded), "--set", "J1=-1", "--quiet", "--out", str(tmp_path / "o.csv")]) == 2
    assert "'J1' cannot be -1: it is declared from 0.001 to 0.1" in capfd.readouterr().err
    assert run(["simulate", str(bounded), "--set", "J1=0.01", "--quiet", "--out", str(tmp_path / "o.csv")]) == 0
