"""Every wrong input of `cases.py` ends with exit code 2 and the line that `docs/errors.md` has for it.

`FMUID_WRITE_ERRORS=1 pytest tests/errors` writes the page anew; read it before you commit it.
"""

from __future__ import annotations

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

PAGE = Path(__file__).parents[2] / "docs" / "errors.md"
HEAD = """\
# Errors

Search this page for the line you got: it shows which input leads to it, and the line says what to do. Every error is one line
on stderr (where, what, and what to do) with exit code 2, and nothing has been written. A test runs every command and makes
and checks this page (`tests/errors`). An error that is more than one line, or a traceback, is a bug of fmuid's.
"""
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


def row(case: Case, line: str) -> str:
    mark = "``" if "`" in line else "`"
    cells = (case.what, f"`fmuid {case.command}`", f"{mark}{line}{mark}")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.what)
def test_a_wrong_input_is_one_line(
    case: Case, template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    found = row(case, seen(case, template, tmp_path, capfd))
    if "FMUID_WRITE_ERRORS" in os.environ:
        write_page(case, found)
    assert found in PAGE.read_text().splitlines()


def write_page(case: Case, found: str) -> None:
    if case is CASES[0]:
        PAGE.write_text(HEAD)
    if case is next(c for c in CASES if c.group == case.group):
        heading = f"\n## {case.group}\n\n| what is wrong | seen by | the line |\n|---|---|---|\n"
        PAGE.write_text(PAGE.read_text() + heading)
    PAGE.write_text(f"{PAGE.read_text()}{found}\n")


def test_the_page_has_nothing_else() -> None:
    text, _, _ = PAGE.read_text().partition("\n## Runs that are stopped")  # test_endings.py has those
    assert text.startswith(HEAD)
    assert sum(line.startswith("| ") and "`fmuid " in line for line in text.splitlines()) == len(CASES)
    assert len({case.what for case in CASES}) == len(CASES) >= 40
