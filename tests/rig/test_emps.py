"""The EMPS files as measurements; the tests that need them are skipped where they are not."""

from pathlib import Path

import numpy as np
import pytest

from campaigns.emps.convert import DEFAULT_FOLDER, SHA256, folder_from_environment, main, read_emps
from fmuid.core.errors import MeasurementsError

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def folder() -> Path:
    path = (REPOSITORY / folder_from_environment()).resolve()
    if not all((path / name).exists() for name in SHA256):
        pytest.skip("the EMPS data are not there")
    return path


def test_both_sets_come_as_open_and_closed_loop(folder: Path) -> None:
    measured = read_emps(folder)
    assert list(measured.experiments) == [
        "identification_open",
        "identification_closed",
        "test_open",
        "test_closed",
    ]
    for experiment in measured:
        assert len(experiment.time) == 24841
        assert experiment.time[-1] == pytest.approx(24.84)
        assert experiment.settings["q_start"] == experiment.signals["qm"].values[0]
    assert set(measured["test_open"].inputs) == {"vir"}
    assert set(measured["test_closed"].inputs) == {"qg", "pulses"}
    assert np.ptp(measured["identification_closed"].signals["pulses"].values) == 0
    assert measured["test_closed"].signals["pulses"].values.max() == 5


def test_the_recorded_control_signal_is_the_controller_s_plus_the_pulses(folder: Path) -> None:
    run = read_emps(folder)["test_closed"]
    qg, qm = run.signals["qg"].values, run.signals["qm"].values
    speed = np.diff(qm, prepend=qm[0]) / 1e-3
    command = run.settings["kv"] * (run.settings["kp"] * (qg - qm) - speed) + run.signals["pulses"].values
    error = (command - run.signals["vir"].values)[10:]
    assert np.sqrt(np.mean(error**2)) < 0.08  # V; without the pulses 3.5


def test_a_missing_file_is_one_line_that_says_what_to_do(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("FMUID_EMPS", str(tmp_path))
    assert main([str(tmp_path / "campaign")]) == 2
    error = capsys.readouterr().err
    assert "DATA_EMPS.mat" in error
    assert "FMUID_EMPS" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "campaign").exists()


def test_an_altered_file_is_refused(folder: Path, tmp_path: Path) -> None:
    for name in SHA256:
        (tmp_path / name).write_bytes((folder / name).read_bytes() + b" ")
    with pytest.raises(MeasurementsError, match="SHA-256"):
        read_emps(tmp_path)


def test_the_default_folder_is_beside_the_repository(monkeypatch) -> None:
    monkeypatch.delenv("FMUID_EMPS", raising=False)
    assert folder_from_environment() == DEFAULT_FOLDER
