"""The FMU as a file: repeatable, self-contained, compiles elsewhere, C code without warnings."""

from __future__ import annotations

import os
import shutil
import subprocess
import zipfile
from xml.etree import ElementTree

import fmpy
import handmade
import numpy as np
import pytest
from fmpy.build import build_platform_binary

from fmu_build import packaging
from fmu_build.errors import BuildError
from fmu_build.packaging import package
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.fmu_copy import copy_with_starts
from fmuid.simulation.simulator import Task


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


def test_flags_of_the_users_own_prevail_and_belong_to_what_an_fmu_is_made_of(tmp_path, monkeypatch):
    monkeypatch.setenv("FMU_BUILD_CFLAGS", "-O0")
    path = package(handmade.pendulum(), tmp_path)
    quick = path.read_bytes()
    monkeypatch.setenv("FMU_BUILD_CFLAGS", "-O1 -DNDEBUG")
    assert package(handmade.pendulum(), tmp_path).read_bytes() != quick
    monkeypatch.setenv("FMU_BUILD_CFLAGS", "--no-such-flag")
    with pytest.raises(BuildError, match="no-such-flag"):
        package(handmade.pendulum(), tmp_path)


@pytest.mark.parametrize("compiler", [c for c in ("gcc", "clang") if shutil.which(c)])
@pytest.mark.parametrize(
    ("name", "fmi"),
    [
        *(pytest.param(name, 2, marks=pytest.mark.slow) for name in ("train", "bouncing_ball", "algebraic_loop")),
        ("relay", 3),
    ],
)
def test_sources_compile_elsewhere_without_warnings(built, tmp_path, name, fmi, compiler):
    """With nothing but the archive: the files it names, in its order, C99, no extensions."""
    folder = built(name, fmi)[1]
    if fmi == 3:
        listed = ElementTree.parse(folder / "sources" / "buildDescription.xml").iter("SourceFile")
    else:
        listed = ElementTree.parse(folder / "modelDescription.xml").find("CoSimulation").iter("File")
    sources = [e.get("name") for e in listed]
    assert set(sources) == {f.name for f in (folder / "sources").glob("*.c")}
    strict = [compiler, "-std=c99", "-O1", "-fPIC", "-Wall", "-Wextra", "-pedantic", "-Wshadow", "-Werror"]
    command = [*strict, f"-I{folder / 'sources'}", "-c", *(str(folder / "sources" / n) for n in sources)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    objects = sorted(f.name for f in tmp_path.glob("*.o"))
    subprocess.run(
        [compiler, "-shared", "-o", "x.so", *objects, "-lm", "-Wl,--no-undefined"], cwd=tmp_path, check=True
    )


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
        "fmuidSetInputDirections",
        "fmuidSetPatience",
        "fmuidSetSensitivityDirections",
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


def test_the_runtime_is_compiled_once(tmp_path, monkeypatch):
    """For two models, and with the bytes that a build without any cache gives."""
    compiled = []
    run = packaging._run_together

    def count(folder, class_name, *commands):
        compiled.extend(c[-1] for c in commands if "-c" in c)
        run(folder, class_name, *commands)

    monkeypatch.setattr(packaging, "_run_together", count)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    package(handmade.pendulum(), tmp_path)
    assert any(source.startswith("sensitivity") for source in compiled)
    compiled.clear()
    built = package(handmade.relay(), tmp_path)
    assert {source.partition("_")[0] for source in compiled} == {"model", "equations"}
    (tmp_path / "no_folder").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no_folder"))
    assert package(handmade.relay(), tmp_path / "again").read_bytes() == built.read_bytes()


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


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_copy_starts_with_the_values_written_into_it(built, tmp_path, fmi):
    """In both interfaces, bit by bit what the original does when they are set."""
    path, values = built("pendulum", fmi)[0], {"m": 1.7, "phi": 0.3, "tau": 0.1}
    copy = tmp_path / "copy.fmu"
    copy_with_starts(load_fmu(path), values, copy)
    task = Task(np.linspace(0.0, 1.0, 11), {}, ("phi", "J", "energy"))
    for kind in ("co-simulation", "model exchange"):
        expected = load_fmu(path, kind).simulate(task, values)
        np.testing.assert_array_equal(load_fmu(copy, kind).simulate(task, {}), expected)
        assert expected[0, 0] == 0.3
