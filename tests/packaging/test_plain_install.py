"""fmuid without its extras: everything but the compilation of Modelica works without CasADi, FMPy and a compiler."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

WITHOUT = ("casadi", "fmpy", "plotly", "pandas", "pyarrow", "polars", "emcee", "dfols", "SALib")
PLAIN = f"""
import sys
for name in {WITHOUT}:
    sys.modules[name] = None  # importing it is an error
from fmuid.cli import main
main()
"""


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command where no extra is installed, and there is no compiler."""
    environment = {**os.environ, "PATH": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}
    environment.pop("CC", None)
    return subprocess.run(
        [sys.executable, "-c", PLAIN, *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip


def fmuid(folder: Path, *arguments: str) -> str:
    ran = run(folder, *arguments)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_an_fmu_is_identified_and_diagnosed_without_extras(tmp_path: Path) -> None:
    fmuid(tmp_path, "demo")  # makes the FMU and logs, then runs init and diagnose
    diagnosis = json.loads((tmp_path / "fmuid-demo" / "diagnosis" / "diagnosis.json").read_text())
    assert diagnosis["verdict"]["effects"] == ["delay@tau"]
    assert diagnosis["model"]["standard_errors"].keys() == diagnosis["model"]["parameters"].keys()
    assert all(0.0 < error < 0.1 for error in diagnosis["model"]["standard_errors"].values())
    assert (tmp_path / "fmuid-demo" / "diagnosis" / "corrected" / "campaign.toml").is_file()
    identified = fmuid(tmp_path, "identify", "fmuid-demo/campaign", "--out", "run")
    assert "shaft.c" in identified
    assert (tmp_path / "run" / "report" / "index.html").is_file()


@pytest.mark.parametrize(
    "command", [["build", "M.mo", "M"], ["effects", "M.mo"], ["init", "M.csv", "--model", "M.mo"]]
)
def test_what_needs_modelica_names_the_extra_to_install(tmp_path: Path, command: list[str]) -> None:
    (tmp_path / "M.mo").write_text("model M output Real x(start = 1, fixed = true); equation der(x) = -x; end M;")
    (tmp_path / "M.csv").write_text("time,x\n0,1\n0.1,0.9\n0.2,0.8\n")
    ran = run(tmp_path, *command)
    assert ran.returncode == 2
    assert "needs casadi; pip install 'fmuid[build]'" in ran.stderr
