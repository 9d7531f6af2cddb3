"""The FMU as a file: repeatable, self-contained, compiles elsewhere, C code without warnings."""

from __future__ import annotations

import os
import subprocess
import zipfile

import fmpy
import handmade
import pytest
from fmpy.build import build_platform_binary

from fmu_build.packaging import package
from fmuid.errors import BuildError


def test_same_input_same_bytes(tmp_path):
    model = handmade.pendulum()
    first, second = package(model, tmp_path / "a"), package(model, tmp_path / "b")
    assert first.read_bytes() == second.read_bytes()


def test_unchanged_fmu_is_left_alone(tmp_path):
    path = package(handmade.pendulum(), tmp_path)
    os.utime(path, (0, 0))
    package(handmade.pendulum(), tmp_path)
    assert path.stat().st_mtime == 0
    package(handmade.compile_by_hand("Pendulum", states={"x": 1.0}, rhs=lambda e: [-e.x]), tmp_path)
    assert path.stat().st_mtime > 0


@pytest.mark.parametrize(
    ("name", "fmi"), [("train", 2), ("bouncing_ball", 2), ("algebraic_loop", 2), ("relay", 3)]
)
def test_runtime_compiles_without_warnings(built, tmp_path, name, fmi):
    folder = built(name, fmi)[1] / "sources"
    for source in sorted(folder.glob("*.c")):
        if source.name != "model.c":
            command = [
                "cc",
                "-std=c99",
                "-O2",
                "-Wall",
                "-Wextra",
                "-Wpedantic",
                "-Wshadow",
                "-Werror",
                "-c",
                str(source),
                "-o",
                str(tmp_path / "x.o"),
            ]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr


def test_links_only_libc_and_libm(built):
    library = next((built("train")[1] / "binaries").rglob("*.so"))
    listing = subprocess.run(
        ["readelf", "-d", "--wide", library], capture_output=True, text=True, check=True
    ).stdout
    needed = [line.split("[")[1].split("]")[0] for line in listing.splitlines() if "(NEEDED)" in line]
    assert set(needed) <= {"libc.so.6", "libm.so.6"}
    symbols = subprocess.run(
        ["nm", "-D", "--defined-only", library], capture_output=True, text=True, check=True
    ).stdout
    names = {line.split()[-1] for line in symbols.splitlines()}
    assert {n for n in names if not n.startswith("fmi2")} == {
        "fmuidGetSensitivities",
        "fmuidSetSensitivityParameters",
    }


@pytest.mark.slow
def test_sources_compile_with_fmpys_cmake(built, tmp_path):
    path, _ = built("pendulum")
    folder = tmp_path / "unpacked"
    fmpy.extract(str(path), str(folder))
    for library in (folder / "binaries").rglob("*.so"):
        library.unlink()
    build_platform_binary(folder, tmp_path)
    assert list((folder / "binaries").rglob("*.so"))
    assert fmpy.simulate_fmu(str(folder), stop_time=0.1)["through"][-1] == 0


def test_compiler_failure_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(BuildError, match="does not run"):
        package(handmade.pendulum(), tmp_path)


def test_the_model_description_has_no_date_and_the_sources_are_inside(built):
    with zipfile.ZipFile(built("pendulum")[0]) as archive:
        assert b"generationDateAndTime" not in archive.read("modelDescription.xml")
        names = set(archive.namelist())
        assert {"sources/model.c", "sources/fmi2.c", "sources/fmi2Functions.h"} <= names
        assert {i.date_time for i in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
