"""Logs of the gallery's machines as measurements; what needs the measured ones is skipped where they are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.io import savemat

from campaigns.credibility.convert import TABLE, read_credibility
from campaigns.credibility.convert import main as read_table
from campaigns.robot.convert import folder_from_environment, read_robot
from campaigns.robot.convert import main as read_logs
from campaigns.robot.encoders import delay
from fmuid.data.measurements import read_measurements
from tests.conftest import ROOT


def recording(count: int = 250, axes: int = 6) -> dict[str, dict[str, np.ndarray]]:
    """Return the columns of a robot's file, all axes in one motion, the links 3 mrad ahead."""
    time = 0.004 * np.arange(count)
    angle = np.tile(np.degrees(0.2 * np.maximum(time - 0.5, 0.0) ** 2), (axes, 1))
    columns = {
        "act_pos_mot_deg": angle,
        "act_pos_se_deg": angle + np.degrees(3e-3),
        "act_torque_abs_nm": 0 * angle,
    }
    return {"rec": {"time_cont": time, **columns}}


def test_a_recording_of_the_robot_becomes_a_run_for_each_axis(tmp_path):
    savemat(tmp_path / "ff_A.mat", recording())
    assert read_logs([str(tmp_path), str(tmp_path)]) == 0
    measured = read_measurements(tmp_path / "measurements.h5")
    assert list(measured.experiments) == ["axis1_A", "axis2_A", "axis3_A"]
    run = measured["axis2_A"]
    assert run.setup == "axis2"
    assert set(run.inputs) == {"q"}
    assert run.signals["q_link"].values == pytest.approx(run.signals["q"].values, abs=1e-12)
    assert run.signals["q"].values[-1] == pytest.approx(0.2 * (0.996 - 0.5) ** 2)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no log"),
        (recording(axes=5), "not of six axes"),
        ({"rec": {"time_cont": [0.0, 1.0]}}, "is no recording of the robot"),
        ({"other": 1.0}, "is no recording of the robot"),
        (b"position,speed", "is no recording of the robot"),
    ],
)
def test_what_is_no_recording_of_the_robot_is_one_line(content, message, tmp_path, capsys):
    if isinstance(content, bytes):
        (tmp_path / "ff_A.mat").write_bytes(content)
    elif content is not None:
        savemat(tmp_path / "ff_A.mat", content)
    assert read_logs([str(tmp_path / "campaign"), str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_robot_s_link_encoders_are_read_3_ms_late():
    """What the links lag behind the motors is in proportion to the speed, on every axis and in every run."""
    folder = (ROOT / folder_from_environment()).resolve()
    if not list(folder.glob("ff_*.mat")):
        pytest.skip("the logs of the robot are not there")
    assert np.array([delay(run) for run in read_robot(folder)]) == pytest.approx(np.full(9, 3.0e-3), abs=0.15e-3)


def table(rows: str, head: str = "#1\ndouble motor_load_speed(8001,3)\n") -> str:
    return head + rows


def test_of_two_rows_of_one_time_the_second_one_counts(tmp_path):
    file = tmp_path / TABLE
    file.parent.mkdir(parents=True)
    file.write_text(table("0,1,2\n0.001,3,4\n0.001,5,6\n0.002,7,8\n"))
    run = read_credibility(tmp_path)["sweep"]
    assert run.time == pytest.approx([0, 0.001, 0.002])
    assert run.signals["w_motor"].values == pytest.approx([1, 5, 7])
    assert run.signals["w_load"].values == pytest.approx([2, 6, 8])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "is not there"),
        (table("0,1\n1,2\n"), "is another table"),
        (table("0,1,2\n", head=""), "is another table"),
        (table("a,b,c\n"), "is another table"),
    ],
)
def test_what_is_no_table_of_the_library_is_one_line(text, message, tmp_path, capsys):
    if text is not None:
        file = tmp_path / TABLE
        file.parent.mkdir(parents=True)
        file.write_text(text)
    assert read_table([str(tmp_path / "campaign"), str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
