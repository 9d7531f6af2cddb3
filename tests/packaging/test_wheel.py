"""The wheel: what is in it, and that its commands run where there is no clone."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
SOURCES = {"src/fmuid": "fmuid", "fmu_build": "fmu_build", "modelica": "modelica"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build it from a copy, for setuptools leaves its work in the folder."""
    copy, out = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("wheel")
    for folder in SOURCES:
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(out), str(copy)]
    made = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert made.returncode == 0, made.stderr
    return next(out.glob("*.whl"))


@pytest.mark.slow
def test_everything_is_in_the_wheel(wheel: Path) -> None:
    packed = set(zipfile.ZipFile(wheel).namelist())
    for folder, package in SOURCES.items():
        files = [p.relative_to(ROOT / folder) for p in (ROOT / folder).rglob("*") if p.is_file()]
        wanted = {f"{package}/{p.as_posix()}" for p in files if "__pycache__" not in p.parts}
        assert wanted <= packed
    assert {
        "fmuid/py.typed",
        "modelica/Drives/package.order",
        "fmuid/report/templates/report.html.jinja",
    } <= packed
    assert "fmuid/simulation/_stepper.abi3.so" in packed  # compiled, for every version of Python
    assert "-cp311-abi3-" in wheel.name
    assert [name for name in packed if re.search("blind|virtual_rig|emps|go1", name.lower())] == []
    packaged = {name for name in packed if not name.split("/")[0].endswith(".dist-info")}
    assert {name.split("/")[0] for name in packaged} == set(SOURCES.values())


@pytest.mark.slow
def test_from_a_model_to_estimates_without_a_clone(wheel: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "installed")}

    def fmuid(*arguments: str) -> str:
        command = [sys.executable, "-c", "from fmuid.cli import main; main()", *arguments]
        ran = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600, check=False
        )
        assert ran.returncode == 0, ran.stderr
        return ran.stdout

    where = [sys.executable, "-c", "import fmuid, fmu_build; print(fmuid.__file__, fmu_build.__file__)"]
    printed = subprocess.run(
        where, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert all(file.startswith(str(tmp_path / "installed")) for file in printed.split())
    assert "Start a campaign from recorded runs and an FMU" in fmuid("--help")

    fmuid("build", "Pendulum", "Pendulum.Setups.TorqueDriven", "--out", ".")
    time = np.arange(0, 2, 0.005)
    rows = [f"{t:g},{u:g}" for t, u in zip(time, 0.2 * np.sin(5 * time), strict=True)]
    (tmp_path / "input.csv").write_text("\n".join(['"time","tau_ref [N.m]"', *rows]) + "\n")
    fmuid("simulate", "TorqueDriven.fmu", "--input", "input.csv", "--set", "m=1.3", "--out", "run.csv")
    fmuid("init", "run.csv", "--fmu", "TorqueDriven.fmu")
    assert "m " in fmuid("identify", "campaign")
    assert (tmp_path / "runs" / "campaign" / "report" / "index.html").stat().st_size > 100_000
