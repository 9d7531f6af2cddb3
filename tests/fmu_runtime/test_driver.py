"""The FMU's sources in a C program: sanitizers and valgrind find nothing, every refusal has its message."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from fmu_build import build
from tests.conftest import MODELICA, c_compiler

DRIVER = Path(__file__).with_name("driver.c")
MODELS = ["pendulum", "train", "algebraic_loop", "dependent_start", "bouncing_ball", "stick_slip"]


def run(sources: Path, folder: Path, *flags: str, under: tuple[str, ...] = (), driver: str = "driver.c") -> None:
    program = folder / "driver"
    files = [DRIVER.with_name(driver), *(f for f in sorted(sources.glob("*.c")))]
    command = [c_compiler(), "-std=gnu11", "-g", "-pthread", *flags, f"-I{sources}", "-o", program, *files, "-lm"]
    compiled = subprocess.run(command, capture_output=True, text=True, check=False)
    assert compiled.returncode == 0, compiled.stderr
    done = subprocess.run([*under, program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr == "" or under, done.stderr


SANITIZERS = "-fsanitize=address,undefined,float-divide-by-zero"


def test_under_sanitizers(built, tmp_path):
    """Addresses, leaks, undefined behaviour; two threads with an instance each."""
    run(built("algebraic_loop")[1] / "sources", tmp_path, "-O0", SANITIZERS, "-fno-sanitize-recover=all")


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("flags", [SANITIZERS, "-fsanitize=thread"])
def test_every_model_under_sanitizers(built, tmp_path, name, flags):
    run(built(name)[1] / "sources", tmp_path, "-O1", flags, "-fno-sanitize-recover=all")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "bouncing_ball", "relay"])
def test_fmi_3_under_sanitizers(built, tmp_path, name):
    sources = built(name, 3)[1] / "sources"
    run(sources, tmp_path, "-O1", SANITIZERS, "-fno-sanitize-recover=all", driver="driver3.c")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["EccentricLoad", "LinearAxisClosedLoop"])
def test_shipped_models_under_sanitizers(tmp_path, name):
    path = build(MODELICA / "Drives" / "Setups" / f"{name}.mo", f"Drives.Setups.{name}", tmp_path)
    shutil.unpack_archive(path, tmp_path / "unpacked", "zip")
    run(tmp_path / "unpacked" / "sources", tmp_path, "-O1", SANITIZERS, "-fno-sanitize-recover=all")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("valgrind") is None, reason="valgrind is not installed")
def test_valgrind_finds_no_leak_and_nothing_uninitialised(built, tmp_path):
    valgrind = ("valgrind", "--error-exitcode=2", "--leak-check=full", "--quiet")
    run(built("dependent_start")[1] / "sources", tmp_path, "-O1", under=valgrind)
