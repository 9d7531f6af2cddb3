"""Every wrong input of `cases.py` ends with exit code 2 and the line that `docs/errors.csv` has for it.

`FMUID_WRITE_ERRORS=1 pytest tests/errors` writes the catalogue again; read it before you commit it.
"""

from __future__ import annotations

import csv
import os
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from cases import CASES, Case

from fmuid.cli.app import run
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from tests.cli.conftest import TOML as CAMPAIGN

CATALOGUE = Path(__file__).parents[2] / "docs" / "errors.csv"
HEADER = ["group", "what is wrong", "fmuid command", "line"]
TOML = CAMPAIGN.format(fmu="../Oscillator.fmu").replace('"bench"\n', '"bench"\nmake = "make bench"\n')
TURNING = """\
model Turning
  input Real turns(unit = "rad/s");
  output Real w(unit = "rad/s") = turns;
end Turning;
"""


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a campaign that is right."""
    folder = tmp_path_factory.mktemp("template")
    for source in (Path(__file__).parents[1] / "cli" / "Oscillator.mo", folder / "Turning.mo"):
        if not source.exists():
            source.write_text(TURNING)
        assert run(["build", str(source), source.stem, "--out", str(folder), "--quiet"]) == 0
    time = np.linspace(0.0, 1.0, 201)
    runs = {}
    for name, u in (("step", 5.0 * (time > 0.2)), ("sine", 5 * np.sin(9 * time)), ("pulse", 9.0 * (time < 0.1))):
        x = Signal("position", np.sin(time), "mm", "output", sigma=0.1)
        runs[name] = Experiment(name, "oscillator", time, {"u": Signal("u", u, "N", "input"), "position": x})
    write_measurements(Measurements(runs), folder / "bench" / "measurements.h5")
    (folder / "bench" / "campaign.toml").write_text(TOML)
    return folder


def seen(case: Case, template: Path, folder: Path, capfd: pytest.CaptureFixture[str]) -> str:
    """Return the line that the user sees."""
    shutil.copytree(template, folder, dirs_exist_ok=True)
    case.make()
    before = sorted(folder.rglob("*"))
    capfd.readouterr()
    code = run(shlex.split(case.command))
    out, err = capfd.readouterr()
    assert (code, out) == (2, ""), err
    assert sorted(folder.rglob("*")) == before  # nothing has been written
    assert err.startswith("fmuid: ")
    assert err.count("\n") == 1
    return err.removeprefix("fmuid: ").rstrip("\n").replace(f"{folder}/", "")


def recorded() -> list[list[str]]:
    with CATALOGUE.open(newline="") as file:
        return list(csv.reader(file))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.what)
def test_a_wrong_input_is_one_line(
    case: Case, template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    row = [case.group, case.what, case.command, seen(case, template, tmp_path, capfd)]
    if "FMUID_WRITE_ERRORS" in os.environ:
        write(case, row)
    assert row in recorded()


def write(case: Case, row: list[str]) -> None:
    """Add a row to the catalogue; the first case starts it."""
    with CATALOGUE.open("w" if case is CASES[0] else "a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([HEADER, row] if case is CASES[0] else [row])


def test_the_catalogue_has_nothing_else() -> None:
    header, *rows = recorded()
    assert header == HEADER
    assert len(rows) == len(CASES)
    assert len({case.what for case in CASES}) == len(CASES) >= 40
