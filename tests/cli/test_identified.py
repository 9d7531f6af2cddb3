"""What an identification writes back: FMUs that start with the values found, and a parameter set."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from lxml import etree

from fmu_build import build
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.errors import FmuError, FmuidError, ProblemError
from fmuid.identification.identified_models import write_identified
from fmuid.identification.result import Result
from fmuid.identification.solvers import Status
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.fmu_copy import copy_with_starts, takes_effect
from fmuid.simulation.simulator import Task

SCHEMA = Path(fmpy.__file__).parent / "ssp" / "schema" / "SystemStructureParameterValues.xsd"
VALUES = {"m": 1.25, "d": 0.8, "mode": 2.0, "x": -0.3, "wind": 4.5}
TASK = Task(np.linspace(0.0, 1.0, 51), {}, ("x", "y", "mode"))


def plain(path: Path, folder: Path, kind: str, **start_values: float) -> np.ndarray:
    """FMPy on its own, in a folder whose name has to be escaped in a URI."""
    unpacked = fmpy.extract(str(path), str(folder.absolute() / "ä b%20"))
    simulated = fmpy.simulate_fmu(
        unpacked, output=["x", "y"], fmi_type=kind, start_values=start_values, output_interval=0.02, stop_time=1.0
    )
    return np.array([simulated["x"], simulated["y"]])


@pytest.fixture(scope="session", params=["2", "3"])
def original(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp(f"fmi{request.param}")
    return build(Path(__file__).with_name("Oscillator.mo"), "Oscillator", folder, fmi=request.param)


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_a_copy_starts_with_its_values_in_any_importer(original: Path, tmp_path: Path, kind: str) -> None:
    copy = tmp_path / "copy.fmu"
    copy_with_starts(load_fmu(original), VALUES, copy)
    assert validate_fmu(str(copy)) == []
    expected = plain(original, tmp_path / "original", kind, **VALUES)
    np.testing.assert_array_equal(plain(copy, tmp_path / "copy", kind), expected)
    assert not np.array_equal(plain(original, tmp_path / "untouched", kind), expected)
    again = plain(copy, tmp_path / "again", kind, x=0.2)
    np.testing.assert_array_equal(again, plain(original, tmp_path / "too", kind, **VALUES | {"x": 0.2}))


def test_a_copy_keeps_its_values_after_reset_and_in_a_copy(original: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first.fmu", tmp_path / "second.fmu"
    copy_with_starts(load_fmu(original), VALUES | {"d": 3.0}, first)
    copy_with_starts(load_fmu(first), {"d": 0.8}, second)
    fmu = load_fmu(second)
    expected = load_fmu(original).simulate(TASK, VALUES)
    for _ in range(3):
        np.testing.assert_array_equal(fmu.simulate(TASK, {}), expected)
    assert fmu.renewal == "reset"
    assert {n: fmu.variables[n].start for n in VALUES} == VALUES
    assert takes_effect(load_fmu(original), VALUES, second)
    bytes_before = second.read_bytes()
    copy_with_starts(load_fmu(first), {"d": 0.8}, second)
    assert second.read_bytes() == bytes_before


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"dd": 1.0}, "no variable 'dd'"),
        ({"y": 1.0}, "'y' is an output that the FMU calculates"),
        ({"mode": 1.5}, "'mode' takes whole numbers only"),
    ],
)
def test_what_cannot_be_a_start_value_is_refused(original, tmp_path, values, message) -> None:
    with pytest.raises(FmuError, match=message):
        copy_with_starts(load_fmu(original), values, tmp_path / "copy.fmu")
    assert not (tmp_path / "copy.fmu").exists()


def test_a_damaged_file_of_start_values_is_said(original: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.fmu"
    damaged.write_bytes(original.read_bytes())
    with zipfile.ZipFile(damaged, "a") as archive:
        archive.writestr("resources/start_values.txt", "0 0 3ff\nnonsense\n")
    with pytest.raises(FmuidError, match=r"start_values\.txt is damaged"):
        Fmu(damaged).simulate(TASK, {})


def test_an_identification_is_written_back(folder: Path, fmuid) -> None:
    Path("arm.urdf").write_text('<robot name="arm"><joint name="slide" type="prismatic"/></robot>')
    with (folder / "campaign.toml").open("a") as file:
        file.write('\n[robot]\nfile = "../arm.urdf"\njoints.slide = { damping = "2*d" }\n')
    code, out, err = fmuid("identify", folder, "--out", "run", "--no-report")
    assert code == 0, err
    assert "parameters.ssv" in out
    campaign, result = load_campaign(folder), Result.from_json("run")
    original = campaign.models["oscillator"].fmu
    values = dict(result.parameters) | {"c": 90.0}
    copy = Path("run/identified/Oscillator.fmu")
    expected = plain(original, Path("original"), "CoSimulation", **values)
    np.testing.assert_array_equal(plain(copy, Path("copy"), "CoSimulation"), expected)
    document = etree.parse("run/identified/parameters.ssv")
    etree.XMLSchema(etree.parse(SCHEMA)).assertValid(document)
    listed = {p.get("name"): float(p[0].get("value")) for p in document.getroot()[0]}
    assert listed == values
    assert {p.get("name"): p[0].get("unit") for p in document.getroot()[0]}["m"] == "kg"
    assert [u.get("name") for u in document.getroot().iterfind("{*}Units/{*}Unit")] == ["N.s/m", "N/m", "kg"]
    dynamics = etree.parse("run/identified/arm.urdf").find("joint/dynamics")
    assert float(dynamics.get("damping")) == pytest.approx(2 * values["d"])


def test_a_run_killed_before_its_models_were_written_gets_them_on_resume(folder: Path, fmuid) -> None:
    assert fmuid("identify", folder, "--out", "run", "--no-report")[0] == 0
    result, written = Path("run/result.json").read_bytes(), Path("run/identified/parameters.ssv")
    contents = written.read_bytes()
    written.unlink()
    code, out, err = fmuid("identify", folder, "--out", "run", "--no-report", "--resume")
    assert (code, err) == (0, "")
    assert "identified: run/identified" in out
    assert (written.read_bytes(), Path("run/result.json").read_bytes()) == (contents, result)
    assert fmuid("identify", folder, "--out", "run", "--resume")[0] == 2  # it is complete


def test_a_run_is_found_from_another_folder_and_after_a_move_with_its_campaign(
    folder: Path, fmuid, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fmuid("identify", folder.name, "--out", "project/run", "--no-report")[0] == 0
    written = Result.from_json("project/run")
    assert Path(written.source) == folder.resolve()
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert Result.from_json("../project/run") == written
    assert fmuid("validate", "../project/run")[::2] == (0, "")
    monkeypatch.chdir(folder.parent)
    Path("project").rename("elsewhere/project")
    folder.rename(Path("elsewhere") / folder.name)
    assert Path(Result.from_json("elsewhere/project/run").source) == (Path("elsewhere") / folder.name).resolve()


@pytest.mark.parametrize("status", [Status.FAILED, Status.INTERRUPTED])
def test_only_a_success_is_written_back(folder: Path, fmuid, status: Status) -> None:
    assert fmuid("identify", folder, "--out", "run", "--no-report", "--evaluations", 3)[0] == 0
    result = Result.from_json("run")
    failed = replace(result, stages=(replace(result.stages[0], status=status),))
    with pytest.raises(ProblemError, match=status.value):
        write_identified(failed, load_campaign(folder), "elsewhere")
    assert not Path("elsewhere").exists()
