"""Logs as they come: encodings, German names, no header; cut, shifted and masked on import; ROS bags and MCAP."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fmuid import read_measurements
from fmuid.cli.app import run
from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import read_csv
from fmuid.data.recordings import read_recording
from fmuid.data.table_layout import TableLayout

GERMAN = (
    "Messung vom Prüfstand\nBediener: Müller\n\nZeit / s;Drehmoment [Nm];Drehzahl in 1/min;Öltemperatur [°C]\n"
)
ROWS = "0,00;1,5;1500;21,0\n0,01;1,75;1510;21,0\n0,02;-2,0;1520;21,5\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16", "utf-16-le"])
def test_a_german_logger_is_understood(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "lauf.csv").write_bytes((GERMAN + ROWS).replace("\n", "\r\n").encode(encoding))
    table = read_csv(tmp_path / "lauf.csv")
    assert list(table.columns) == ["Drehmoment", "Drehzahl", "Öltemperatur"]
    assert dict(table.units) == {"Drehmoment": "Nm", "Drehzahl": "rpm", "Öltemperatur": "°C"}
    np.testing.assert_array_equal(table.time, [0.0, 0.01, 0.02])
    np.testing.assert_array_equal(table.columns["Drehmoment"], [1.5, 1.75, -2.0])
    assert "the header is on line 4" in table.notes
    assert any("rpm" in note for note in table.notes)
    assert ("read as Windows-1252" in table.notes) == (encoding == "cp1252")
    assert ("read as UTF-16" in table.notes) == encoding.startswith("utf-16")


def test_a_file_without_a_header(tmp_path: Path) -> None:
    (tmp_path / "raw.txt").write_text("0.0\t1.0\t2\n0.1\t1.5\t3\n")
    with pytest.raises(MeasurementsError, match=r"has no header .*; name its columns: columns="):
        read_csv(tmp_path / "raw.txt")
    table = read_csv(tmp_path / "raw.txt", TableLayout(("time", "tau [N.m]", "w [rad/s]")))
    np.testing.assert_array_equal(table.columns["w"], [2, 3])
    assert table.units == {"tau": "N.m", "w": "rad/s"}
    with pytest.raises(MeasurementsError, match="has 3 columns, 2 are named"):
        read_csv(tmp_path / "raw.txt", TableLayout(("time", "tau")))


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "image.csv").write_bytes(bytes(range(256)) * 5)
    with pytest.raises(MeasurementsError, match="is not text"):
        read_csv(tmp_path / "image.csv")


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    time = np.arange(0.0, 4.0, 0.01)
    for k in range(15):
        rows = np.column_stack([time + 100.0, np.sin(time + k), np.cos(time)])
        np.savetxt(f"run_{k:02}.csv", rows, delimiter=";", header="t;u [A];tau [N.m]", comments="")
    return tmp_path


def test_many_files_are_few_lines_and_can_be_imported_again(
    logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [f"run_{k:02}.csv" for k in range(15)]
    options = ["--setup", "rig", "-i", "u", "--cut", "101..103", "--cut", "run_03:100.5..102", "--from-zero"]
    options += ["--mask", "abs(tau) > 0.9", "--shift", "tau=0.02", "--setting", "load.m=1"]
    options += ["--setting", "run_1*:load.m=2", "--out", "m.h5"]
    assert run(["import", *files, *options]) == 0
    output = capsys.readouterr().out
    assert output.count("\n") < 12
    assert "run_00.csv and 14 more: cells are separated by semicolons" in output
    assert "... and 9 more" in output
    measurements = read_measurements("m.h5")
    assert measurements["run_00"].time[[0, -1]].tolist() == pytest.approx([0.0, 2.0])
    assert measurements["run_03"].time[-1] == pytest.approx(1.5)
    assert measurements["run_00"].settings["load.m"] == 1
    assert measurements["run_12"].settings["load.m"] == 2
    tau, u = measurements["run_05"].signals["tau"].values, measurements["run_05"].signals["u"].values
    moved = np.cos(np.arange(1.0, 3.0001, 0.01) - 0.02)
    np.testing.assert_allclose(tau[np.isfinite(tau)], moved[np.abs(moved) <= 0.9], atol=1e-9)
    assert np.isfinite(u).all()
    import shlex

    again = shlex.split(measurements.history)
    assert again[:2] == ["fmuid", "import"]
    again[again.index("--out") + 1] = "again.h5"
    assert run(again[1:]) == 0
    np.testing.assert_array_equal(read_measurements("again.h5")["run_05"].signals["tau"].values, tau)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (["--cut", "5"], "'5' is not a time span"),
        (["--cut", "200..300"], "fewer than two samples lie between 200 and 300 s"),
        (["--mask", "tau"], "'tau' is not a condition"),
        (["--mask", "force > 3"], "has no signal 'force'"),
        (["--mask", "__import__('os') > 3"], "is not an arithmetic expression"),
        (["--shift", "force=1"], "has no signal 'force'"),
    ],
)
def test_an_edit_that_makes_no_sense(
    logs: Path, capsys: pytest.CaptureFixture[str], option: list[str], message: str
) -> None:
    assert run(["import", "run_00.csv", "--setup", "rig", "-i", "u", *option]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_mcap_with_json_messages_keeps_jittered_times(tmp_path: Path) -> None:
    writer = pytest.importorskip("mcap.writer")
    stamps = np.cumsum(np.random.default_rng(0).integers(900_000, 1_100_000, 50))
    with (tmp_path / "log.mcap").open("wb") as file:
        out = writer.Writer(file)
        out.start()
        schema = out.register_schema("Drive", "jsonschema", b"{}")
        channel = out.register_channel("/drive", "json", schema)
        for k, stamp in enumerate(stamps.tolist()):
            message = {"tau": 0.1 * k, "joint": {"q": [k, -k]}, "state": "running"}
            out.add_message(channel, log_time=stamp, publish_time=stamp, data=json.dumps(message).encode())
        out.finish()
    (table,) = read_recording(tmp_path / "log.mcap").tables
    assert list(table.columns) == ["/drive.tau", "/drive.joint.q.0", "/drive.joint.q.1"]
    np.testing.assert_allclose(table.time, 1e-9 * (stamps - stamps[0]), atol=1e-12)
    np.testing.assert_array_equal(table.columns["/drive.joint.q.1"], -np.arange(50))


def test_a_ros_bag_names_joints(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    types = store.types
    state, header, stamp = (
        types[n] for n in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    for suffix, plugin in ((".db3", StoragePlugin.SQLITE3), (".mcap", StoragePlugin.MCAP)):
        bag = tmp_path / f"bag{suffix[1:]}"
        with Writer(bag, version=9, storage_plugin=plugin) as writer:
            connection = writer.add_connection("/joints", state.__msgtype__, typestore=store)
            for k in range(20):
                numbers = np.array([0.1 * k, -0.1 * k])
                message = state(
                    header=header(stamp=stamp(sec=7, nanosec=10_000_000 * k), frame_id=""),
                    name=["hip", "knee"], position=numbers, velocity=2 * numbers, effort=np.zeros(0),
                )  # fmt: skip
                raw = store.serialize_cdr(message, state.__msgtype__)
                writer.write(connection, 9_000_000_000 + 10_000_000 * k + 1234 * (k % 3), raw)
        (file,) = bag.glob(f"*{suffix}")
        (table,) = read_recording(file).tables
        assert "/joints.velocity.knee" in table.columns
        np.testing.assert_allclose(table.time, 0.01 * np.arange(20), atol=1e-6)
        np.testing.assert_allclose(table.columns["/joints.position.knee"], -0.1 * np.arange(20))


def test_a_damaged_bag_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_bytes(b"\x89MCAP0\r\n" + b"no more" * 20)
    with pytest.raises(MeasurementsError, match="cannot be read"):
        read_recording(tmp_path / "log.mcap")
