"""Modelica to FMU in one step: caching, options, libraries, errors in one line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import fmpy
import numpy as np
import pytest

from fmu_build import build, compile_modelica
from fmu_build.errors import BuildError, ModelicaError
from fmu_build.front.flatten import load
from tests.fmu_build.simulate import Instance, states

MODELS = Path(__file__).parent / "models"
DRIVES = Path(__file__).parents[2] / "modelica" / "Drives"


def test_unchanged_sources_cost_nothing_and_changed_ones_rebuild(tmp_path, monkeypatch):
    source = tmp_path / "Structure.mo"
    shutil.copy(MODELS / "Structure.mo", source)
    fmu = build(source, "Structure.RC", tmp_path / "out")
    before = fmu.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr("fmu_build.compiler.compile_flat", None)  # it is not called
        assert build(source, "Structure.RC", tmp_path / "out") == fmu

    fmu.write_bytes(b"broken")
    assert build(source, "Structure.RC", tmp_path / "out").read_bytes() == before, "same input, same bytes"

    source.write_text(source.read_text().replace("r(R = 100)", "r(R = 200)"))
    assert build(source, "Structure.RC", tmp_path / "out").read_bytes() != before


def test_same_input_same_bytes_in_every_process(tmp_path):
    script = "import sys; from fmu_build import build; build(sys.argv[1], 'Structure.RC', sys.argv[2])"
    for seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": seed, "FMU_BUILD_CFLAGS": "-O0"}
        command = [sys.executable, "-c", script, str(MODELS / "Structure.mo"), str(tmp_path / seed)]
        subprocess.run(command, env=environment, check=True)
    first, second = ((tmp_path / seed / "RC.fmu").read_bytes() for seed in "12")
    assert first == second


def test_of_a_librarys_file_only_the_classes_that_are_used_are_parsed(tmp_path):
    (tmp_path / "Library.mo").write_text(
        "package Library\n"
        "  package Outer\n"
        "    package Outer constant Real k = 2; end Outer;\n"
        "    model Good Real x = Outer.k*time; end Good;\n"
        "  end Outer;\n"
        "  model Bad\n"
        "    Real x = ;\n"
        "  end Bad;\n"
        "end Library;\n"
    )
    model = tmp_path / "model" / "Use.mo"
    model.parent.mkdir()
    model.write_text("model Good Library.Outer.Good m; end Good;\nmodel Bad Library.Bad m; end Bad;\n")
    flat = load(model, "Good", [tmp_path])
    assert "m.x" in flat.variables
    with pytest.raises(ModelicaError, match=r"Library.mo:7: unexpected ';'"):
        load(model, "Bad", [tmp_path])


def test_only_files_that_were_read_count_and_new_ones_that_hide_them(tmp_path, monkeypatch):
    library = tmp_path / "library"
    (library / "Shapes" / "Far").mkdir(parents=True)
    (library / "Shapes" / "package.mo").write_text("package Shapes constant Real k = 1; end Shapes;")
    (library / "Shapes" / "Far" / "package.mo").write_text("within Shapes; package Far end Far;")
    file = tmp_path / "M.mo"
    file.write_text("model M Real x = Shapes.k + time; end M;")
    fmu = build(file, "M", tmp_path / "out", roots=[library])
    before = fmu.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr("fmu_build.compiler.compile_flat", None)
        (library / "Shapes" / "Far" / "Unread.mo").write_text("within Shapes.Far; model Unread end Unread;")
        assert build(file, "M", tmp_path / "out", roots=[library]) == fmu
    (tmp_path / "Shapes.mo").write_text("package Shapes constant Real k = 2; end Shapes;")
    assert build(file, "M", tmp_path / "out", roots=[library]).read_bytes() == before
    (library / "Shapes" / "package.mo").write_text("package Shapes constant Real k = 3; end Shapes;")
    assert build(file, "M", tmp_path / "out", roots=[library]).read_bytes() != before


def test_of_files_with_other_names_only_those_that_mention_a_class_are_parsed(tmp_path):
    (tmp_path / "Parts.mo").write_text("model Wheel Real x = 3; end Wheel;")
    (tmp_path / "Broken.mo").write_text("model Broken ((")
    source = tmp_path / "model" / "M.mo"
    source.parent.mkdir()
    source.write_text("model M Wheel wheel; end M;")
    flat = load(source, "M", [tmp_path])
    assert "wheel.x" in flat.variables
    assert {path.name for path in flat.files} == {"M.mo", "Parts.mo", "Broken.mo"}, "a new class in any counts"


@pytest.mark.parametrize("fmi", ["2", "3"])
def test_both_versions_of_fmi(tmp_path, fmi):
    fmu = build(MODELS / "Structure.mo", "Structure.RC", tmp_path, fmi=fmi)
    assert fmpy.read_model_description(str(fmu)).fmiVersion == f"{fmi}.0"
    result = fmpy.simulate_fmu(str(fmu), stop_time=0.2, output_interval=0.1, start_values={"u": 5.0}, output=["y"])
    np.testing.assert_allclose(result["y"], 5 * (1 - np.exp(-result["time"] / 0.1)), atol=1e-4)


def test_a_model_of_ones_own_uses_a_library(tmp_path):
    file = tmp_path / "Mine.mo"
    file.write_text(
        "model Mine\n"
        "  Drives.Components.Inertia a(J = 2, phi(start = 0, fixed = true), w(start = 3, fixed = true));\n"
        "  Drives.Components.Inertia b(J = 4);\n"
        "equation\n"
        "  connect(a.flange_b, b.flange_a);\n"
        "end Mine;\n"
    )
    (tmp_path / "Other.mo").write_text("this is not Modelica")  # a neighbour is none of its business
    instance = Instance.of(compile_modelica(file, "Mine", [DRIVES.parent]))
    assert states(instance.model) == ["a.phi", "a.w"]
    np.testing.assert_array_equal(instance.start(), [0.0, 3.0])


@pytest.mark.parametrize("name", ["FixedShaft", "EccentricLoad", "LinearAxisClosedLoop"])
def test_shipped_setups_have_no_events_and_explicit_starts(name):
    model = compile_modelica(DRIVES, f"Drives.Setups.{name}")
    assert not model.has_events
    assert not model.has_initial
    assert model.n_y == 0
    assert model.experiment.stop is not None
    assert model.description


def test_errors_say_what_to_do(tmp_path):
    with pytest.raises(BuildError, match="choose 2 or 3"):
        build(MODELS / "Structure.mo", "Structure.RC", tmp_path, fmi="4")
    with pytest.raises(BuildError, match="choose own or omc"):
        build(MODELS / "Structure.mo", "Structure.RC", tmp_path, compiler="gcc")
    with pytest.raises(ModelicaError, match="no such Modelica file"):
        build(tmp_path / "Nothing.mo", "Nothing", tmp_path)
    with pytest.raises(ModelicaError, match=r"Structure\.Nothing"):
        build(MODELS / "Structure.mo", "Structure.Nothing", tmp_path)
    with pytest.raises(ModelicaError, match="no such library"):
        compile_modelica(MODELS / "Structure.mo", "Structure.RC", [tmp_path / "nowhere"])
    assert not list(tmp_path.glob("*.fmu"))


OMC = """#!{python}
import pathlib, sys
script = pathlib.Path(sys.argv[1]).read_text()
pathlib.Path({log!r}).write_text(script)
if "Missing" in script:
    print('false\\n"[M.mo:1:1-2:2:writable] Error: Class Missing not found in scope <TOP>.\\nError: more"')
    sys.exit(0)
pathlib.Path("RC.fmu").write_bytes(b"made by omc")
"""


@pytest.fixture
def omc(tmp_path, monkeypatch):
    """Stand-in for OpenModelica's omc on the PATH; the script it was given is in `omc.mos`."""
    program = tmp_path / "bin" / "omc"
    program.parent.mkdir()
    program.write_text(OMC.format(python=sys.executable, log=str(tmp_path / "omc.mos")))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    return tmp_path / "omc.mos"


def test_omc_builds_the_same_model(tmp_path, omc):
    out = tmp_path / "out"
    fmu = build(MODELS / "Structure.mo", "Structure.RC", out, fmi="3", compiler="omc", roots=[DRIVES.parent])
    assert fmu == out / "RC.fmu"
    assert fmu.read_bytes() == b"made by omc"
    *loads, make, errors = omc.read_text().splitlines()
    assert f'loadFile("{MODELS / "Structure.mo"}");' in loads
    assert f'loadFile("{DRIVES / "package.mo"}");' in loads
    assert not [line for line in loads if "Components" in line], "a package is loaded as a whole"
    assert make == 'buildModelFMU(Structure.RC, version="3.0", fmuType="me_cs");'
    assert errors == "getErrorString();"
    omc.unlink()
    assert (
        build(MODELS / "Structure.mo", "Structure.RC", out, fmi="3", compiler="omc", roots=[DRIVES.parent]) == fmu
    )
    assert not omc.exists(), "unchanged: kept"


@pytest.mark.usefixtures("omc")
def test_what_omc_says_is_told_in_one_line(tmp_path):
    with pytest.raises(
        BuildError, match=r"Missing: omc built no FMU: Error: Class Missing not found in scope <TOP>\.$"
    ):
        build(MODELS / "Structure.mo", "Structure.Missing", tmp_path, compiler="omc")


def test_without_omc(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BuildError, match="omc is not on the PATH; install it or leave out --compiler omc"):
        build(MODELS / "Structure.mo", "Structure.RC", tmp_path, compiler="omc")
