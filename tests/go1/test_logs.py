"""Go1 logs as measurements; what needs the measured ones is skipped where they are not."""

from __future__ import annotations

import json

import numpy as np
import pytest

from campaigns.go1.convert import DEFAULT_FOLDER, GEAR_RATIO, folder_from_environment, main, read_go1
from fmuid.core.errors import MeasurementsError
from fmuid.data.measurements import read_measurements
from tests.conftest import ROOT
from tests.go1.logs import INTERVAL, plain_log, write


def test_a_log_becomes_a_run(tmp_path):
    folder = write(tmp_path / "logs", plain_log(2.0), plain_log(0.5, "up_and_down"))
    assert main([str(tmp_path), str(folder)]) == 0

    measured = read_measurements(tmp_path / "measurements.h5")
    assert list(measured.experiments) == ["m0p5_up_and_down", "m2_sin_sin"]
    run = measured["m2_sin_sin"]
    assert run.time == pytest.approx(INTERVAL * np.arange(5))
    assert {n: s.unit for n, s in run.signals.items()} == {
        **{"q_ref": "rad", "enable": "1", "q": "rad", "w": "rad/s", "tau_motor": "N.m"},
    }
    assert set(run.inputs) == {"q_ref", "enable"}
    assert run.signals["q"].values == pytest.approx(0.1 * np.arange(5))
    assert run.signals["w"].values == pytest.approx(GEAR_RATIO * (0.1 * np.arange(5) + 1))
    assert dict(run.settings) == pytest.approx(
        {"m": 2, "m_a": 0.078, "l": 0.15, "kp": 10, "kd": 0.3, "q_start": 0, "w_start": GEAR_RATIO}
    )


def with_stamps(stamps: list[float]) -> dict:
    log = plain_log(count=len(stamps))
    return {**log, "entries": [{**e, "timestamp": t} for e, t in zip(log["entries"], stamps, strict=True)]}


def test_jitter_of_the_clock_is_taken_out_and_said(tmp_path):
    stamps = INTERVAL * np.arange(6) + np.array([0, 3e-5, -2e-5, 1e-5, 0, 0])
    run = read_go1(write(tmp_path, with_stamps(stamps.tolist())))["m1_sin_sin"]

    assert np.ptp(np.diff(run.time)) < 1e-12
    assert "0.03 ms" in run.description


def test_uneven_times_stay_as_they_are(tmp_path):
    stamps = [0.0, 0.016, 0.032, 0.060, 0.064]
    run = read_go1(write(tmp_path, with_stamps(stamps)))["m1_sin_sin"]

    assert run.time == pytest.approx(stamps, abs=0)
    assert "as recorded" in run.description


def test_a_row_without_a_new_time_is_left_out_and_counted(tmp_path):
    run = read_go1(write(tmp_path, with_stamps([0.0, 0.016, 0.016, 0.032, 0.048])))["m1_sin_sin"]

    assert run.time == pytest.approx(INTERVAL * np.arange(4))
    assert run.signals["q"].values == pytest.approx([0.0, 0.1, 0.3, 0.4])
    assert "1 rows without a new time left out" in run.description


WRONG = {
    "no log": ({}, "no Go1 log"),
    "not JSON": ({"a.json": "position,speed"}, "is no Go1 log"),
    "another JSON": ({"a.json": "[1, 2]"}, "is no Go1 log"),
    "no payload": ({"a.json": {**plain_log(), "mass": None}}, r"\$.mass"),
    "a text for a number": ({"a.json": plain_log(kp="ten")}, r"\$.kp"),
    "an entry without speed": (
        {"a.json": {**plain_log(), "entries": [{"timestamp": 0.0, "position": 0.0}]}},
        r"speed.*entries\[0\]|entries\[0\]",
    ),
    "one sample": ({"a.json": plain_log(count=1)}, "fewer than two samples"),
    "no sample": ({"a.json": plain_log(count=0)}, "fewer than two samples"),
    "standing time": ({"a.json": with_stamps([0.1, 0.1, 0.1])}, "fewer than two samples"),
    "time goes back": ({"a.json": with_stamps([0.0, 0.016, 0.01])}, "goes back at entry 2"),
    "not a number": ({"a.json": '{"mass": NaN}'}, "is no Go1 log"),
    "too large": ({"a.json": json.dumps(plain_log()).replace("0.2,", "1e999,", 1)}, "is no Go1 log|not finite"),
    "the same run twice": ({"a.json": plain_log(), "b.json": plain_log()}, "second log .* 'm1_sin_sin'"),
    "not text": ({"a.json": b"\xff\xfe\x00"}, "is no Go1 log"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_one_line(tmp_path, capsys, case):
    files, message = WRONG[case]
    folder = tmp_path / "logs"
    folder.mkdir()
    for name, content in files.items():
        if isinstance(content, bytes):
            (folder / name).write_bytes(content)
        else:
            (folder / name).write_text(content if isinstance(content, str) else json.dumps(content))

    with pytest.raises(MeasurementsError, match=message):
        read_go1(folder)
    assert main([str(tmp_path / "campaign"), str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(folder) in error
    assert not (tmp_path / "campaign").exists()


def test_where_the_logs_are(monkeypatch, tmp_path, capsys):
    monkeypatch.delenv("FMUID_GO1", raising=False)
    assert folder_from_environment() == DEFAULT_FOLDER
    monkeypatch.setenv("FMUID_GO1", str(tmp_path / "nowhere"))
    assert main([str(tmp_path)]) == 2
    assert "FMUID_GO1" in capsys.readouterr().err
    assert main([]) == 2


@pytest.fixture(scope="module")
def measured():
    folder = (ROOT / folder_from_environment()).resolve()
    if not list(folder.glob("*.json")):
        pytest.skip("the Go1 logs are not there")
    return read_go1(folder)


def test_the_measured_logs(measured):
    trajectories = ("lift_and_drop", "sin_sin", "sin_time_square", "up_and_down")
    assert list(measured.experiments) == [f"m{m}_{t}" for m in range(4) for t in trajectories]
    for run in measured:
        assert len(run.time) == 376
        assert np.diff(run.time) == pytest.approx(0.016, rel=1e-3)


def test_units_and_sides_are_what_the_reader_says(measured):
    for run in measured:
        if run.settings["m"] < 1.0 or not run.id.endswith("sin_sin"):
            continue
        q, w, tau = (run.signals[n].values for n in ("q", "w", "tau_motor"))
        derived = np.gradient(q, run.time)
        assert np.sum(w * derived) / np.sum(derived**2) == pytest.approx(1.0, abs=0.03), run.id
        demanded = 10.0 * (np.roll(run.signals["q_ref"].values, 1) - q) - 0.3 * w
        slope = np.sum(GEAR_RATIO * tau[1:] * demanded[1:]) / np.sum(demanded[1:] ** 2)
        assert slope == pytest.approx(1.03, abs=0.03), run.id


def test_the_motor_carries_the_load(measured):
    """With 3 kg: more than gravity when lifting, about gravity or less when lowering."""
    run = measured["m3_sin_sin"]
    q, tau = run.signals["q"].values, run.signals["tau_motor"].values
    w = np.gradient(q, run.time)
    a = np.gradient(w, run.time)
    load = 3.039 * 9.80665 * 0.15 * np.sin(q) + (3 + 0.026) * 0.15**2 * a
    side = np.sign(q)
    lifting, lowering = (np.abs(q) > 0.3) & (side * w > 0.2), (np.abs(q) > 0.3) & (side * w < -0.2)
    extra = side * (GEAR_RATIO * tau - load)
    assert extra[lifting].mean() > 0.25
    assert extra[lifting].mean() - extra[lowering].mean() > 0.3


@pytest.mark.parametrize("payload", [1, 2, 3])
def test_the_reading_jumps_back_when_the_torque_goes_off(measured, payload):
    """As far as a spring of 6.8 mrad/(N.m) had been bent: the compliance that the diagnosis finds."""
    run = measured[f"m{payload}_lift_and_drop"]
    off = int(np.argmin(run.signals["enable"].values))
    q, tau = run.signals["q"].values, run.signals["tau_motor"].values
    bent = (q[off + 1] - q[off]) / (-GEAR_RATIO * tau[off])
    assert bent == pytest.approx(6.8e-3, rel=0.03)
