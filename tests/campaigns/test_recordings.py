"""Recorded runs in other files than our own: what is read, on which time bases, and what is refused."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from pathlib import Path

import asammdf
import h5py
import numpy as np
import pyarrow as pa
import pytest
from fmpy.util import write_csv
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet
from scipy.io import savemat

from fmuid.core.errors import MeasurementsError
from fmuid.data import isolated_reader as apart
from fmuid.data.crosscheck_csv import read_csv
from fmuid.data.recordings import Recording, read_recording
from fmuid.data.recordings.conversion import read_run
from fmuid.data.table_layout import TableLayout

FAST, SLOW = np.arange(0.0, 1.0, 0.001), np.arange(0.0, 1.0, 0.01)


def mf4(path: Path) -> Path:
    """Two groups with two rates; a text, an invalid sample and a name that both have."""
    invalid = np.zeros(SLOW.size, bool)
    invalid[3] = True
    with asammdf.MDF() as file:
        file.append(
            [
                asammdf.Signal(np.sin(FAST), FAST, name="i_cmd", unit="A"),
                asammdf.Signal(np.cos(FAST), FAST, name="w", unit="rad/s"),
                asammdf.Signal(FAST, FAST, name="U", unit="V"),
            ]
        )
        file.append(
            [
                asammdf.Signal(20 + SLOW, SLOW, name="oil", unit="degC", invalidation_bits=invalid),
                asammdf.Signal(np.arange(100, dtype="u1"), SLOW, name="mode"),
                asammdf.Signal(np.array([b"on"] * 100), SLOW, name="state", encoding="utf-8"),
                asammdf.Signal(SLOW, SLOW, name="U", unit="V"),
            ]
        )
        file.save(path, overwrite=True)
    return path


def test_mf4(tmp_path: Path) -> None:
    recording = read_recording(mf4(tmp_path / "run.mf4"))
    assert [list(t.columns) for t in recording.tables] == [["i_cmd", "w", "U#0"], ["oil", "mode", "U#1"]]
    fast, slow = recording.tables
    np.testing.assert_array_equal(fast.time, FAST)
    np.testing.assert_array_equal(fast.columns["w"], np.cos(FAST))
    assert (dict(fast.units), dict(slow.units)) == (
        {"i_cmd": "A", "w": "rad/s", "U#0": "V"},
        {"oil": "degC", "U#1": "V"},
    )
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(slow.columns["oil"])), [3])
    assert recording.notes == ("not used (not numeric): state",)
    assert [list(t.columns) for t in recording.only(["w", "mode"]).tables] == [["w"], ["mode"]]


def test_parquet(tmp_path: Path) -> None:
    fields = [
        pa.field("time [ms]", pa.float64()),
        pa.field("i_cmd [A]", pa.float32()),
        pa.field("w", pa.float64(), metadata={"unit": "rad/s"}),
        pa.field("note", pa.string()),
    ]
    columns = [[0.0, 1.0, 2.0], [0.5, 1.5, 2.5], [1.0, None, 3.0], ["a", "b", "c"]]
    parquet.write_table(pa.table([pa.array(c, f.type) for c, f in zip(columns, fields, strict=True)], schema=pa.schema(fields)), tmp_path / "run.parquet")  # fmt: skip
    recording = read_recording(tmp_path / "run.parquet")
    (table,) = recording.tables
    np.testing.assert_allclose(table.time, [0, 1e-3, 2e-3])
    np.testing.assert_array_equal(table.columns["w"], [1.0, np.nan, 3.0])
    assert dict(table.units) == {"i_cmd": "A", "w": "rad/s"}
    assert recording.notes == ("not used (not numeric): note",)


def test_lists_in_parquet_become_one_column_per_element(tmp_path: Path) -> None:
    parquet.write_table(pa.table({"t": [0.0, 0.1], "q [rad]": [[1.0, 2.0], [3.0, 4.0]]}), tmp_path / "run.parquet")
    (table,) = read_recording(tmp_path / "run.parquet").tables
    assert {name: values.tolist() for name, values in table.columns.items()} == {
        "q[1]": [1.0, 3.0],
        "q[2]": [2.0, 4.0],
    }
    assert table.units == {"q[1]": "rad", "q[2]": "rad"}


def test_parquet_with_dates(tmp_path: Path) -> None:
    first = datetime(2026, 5, 1, 12)
    stamps = [first + timedelta(microseconds=100 * k) for k in range(4)]
    parquet.write_table(pa.table({"timestamp": stamps, "x [m]": [0.0, 1.0, 2.0, 3.0]}), tmp_path / "run.parquet")
    recording = read_recording(tmp_path / "run.parquet")
    np.testing.assert_allclose(recording.tables[0].time, [0, 1e-4, 2e-4, 3e-4], rtol=1e-12)
    assert recording.notes == ("time starts at the first date",)


def test_hdf5_with_two_time_bases(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for group, time in (("drive", FAST), ("oil", SLOW)):
            file[f"{group}/time"] = time * 1e3
            file[f"{group}/time"].attrs["units"] = "ms"
            file[f"{group}/x"] = np.sin(time).reshape(1, -1)
            file[f"{group}/x"].attrs["unit"] = "m"
        file["drive/motor/w"] = FAST
        file["drive/table"] = np.zeros((3, 4))
        file["drive/elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
    recording = read_recording(tmp_path / "run.h5")
    assert [list(t.columns) for t in recording.tables] == [["drive.motor.w", "drive.x"], ["oil.x"]]
    np.testing.assert_allclose(recording.tables[1].time, SLOW)
    np.testing.assert_allclose(recording.tables[1].columns["oil.x"], np.sin(SLOW))
    assert recording.tables[0].units["drive.x"] == "m"
    assert recording.notes == ("not used (not vectors as long as a time axis): drive.elsewhere, drive.table",)


def test_matlab_7_3_is_hdf5(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        file["t"], file["x"], file["kp"] = SLOW[None], SLOW[None] ** 2, np.array([[160.0]])
        file["#refs#/a"] = np.zeros((1, 100))
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    with (tmp_path / "run.mat").open("r+b") as raw:
        raw.write(head)
    recording = read_recording(tmp_path / "run.mat")
    assert recording.columns == ("x",)
    np.testing.assert_array_equal(recording.tables[0].columns["x"], SLOW**2)


def result_file(path: Path, storage: str, dtype: str = "f8") -> Path:
    """A result file as Modelica tools write it: constants, trajectories with an event, an alias of opposite sign."""
    time = np.array([0.0, 0.1, 0.1, 0.2, 0.3])
    names = ["time", "load.w", "load.J", "flange.w", "closed"]
    descriptions = ["Time in [s]", "Speed [rad/s|rpm]", "Inertia [kg.m2]", "Speed of the flange, μ [rad/s]", "[:#(type=Boolean)]"]  # fmt: skip
    info = [[0, 1, 0, -1], [2, 2, 0, -1], [1, 2, 0, 0], [2, -2, 0, -1], [2, 3, 0, -1]]
    constants = np.array([[0.0, 2e-3], [0.3, 2e-3]])
    data = np.column_stack([time, [0.0, 1.5, -1.5, 2.0, 2.5], [0, 0, 1, 1, 1]])

    def characters(texts: list[str]) -> np.ndarray:
        coded = [text.encode() for text in texts]
        padded = [text.ljust(max(map(len, coded)), b" ") for text in coded]
        return np.array([[chr(byte) for byte in row] for row in padded])

    def rows(matrix: np.ndarray) -> np.ndarray:
        return np.array(["".join(row) for row in matrix]) if matrix.dtype.kind == "U" else matrix

    matrices = {
        "name": characters(names),
        "description": characters(descriptions),
        "dataInfo": np.array(info, dtype="i4"),
        "data_1": constants.astype(dtype),
        "data_2": data.astype(dtype),
    }
    turned = {n: rows(m.T if storage == "binTrans" else m) for n, m in matrices.items()}
    savemat(path, {"Aclass": rows(characters(["Atrajectory", "1.1", "", storage])), **turned}, format="4")
    return path


@pytest.mark.parametrize(("storage", "dtype"), [("binTrans", "f8"), ("binTrans", "f4"), ("binNormal", "f8")])
def test_result_files_of_modelica_tools(storage: str, dtype: str, tmp_path: Path) -> None:
    recording = read_recording(result_file(tmp_path / "run.mat", storage, dtype))
    (table,) = recording.tables
    np.testing.assert_allclose(table.time, [0.0, 0.1, 0.1, 0.2, 0.3], rtol=1e-6)
    assert {n: v.tolist() for n, v in table.columns.items()} == {
        "load.w": [0.0, 1.5, -1.5, 2.0, 2.5],
        "flange.w": [0.0, -1.5, 1.5, -2.0, -2.5],
        "closed": [0.0, 0.0, 1.0, 1.0, 1.0],
    }
    assert table.units == {"load.w": "rad/s", "flange.w": "rad/s"}
    assert recording.notes == ("not used (constant in this run): load.J",)
    chosen = TableLayout(("time=time", "J [g.m2]=load.J", "w=load.w"))
    (table,) = read_recording(tmp_path / "run.mat", layout=chosen).tables
    assert table.columns["J"] == pytest.approx(np.full(5, 2e-3))
    assert table.units == {"J": "g.m2", "w": "rad/s"}


def test_an_event_in_a_result_file_is_a_step(tmp_path: Path) -> None:
    run = read_run(result_file(tmp_path / "run.mat", "binTrans"))
    np.testing.assert_allclose(run.table.time, [0.0, 0.1, 0.1001, 0.2, 0.3])
    assert run.table.columns["load.w"].tolist() == [0.0, 1.5, -1.5, 2.0, 2.5]
    assert "1 time with two rows: the second row is a step right after the first" in run.notes


def test_the_csv_of_fmpy_with_an_event_is_a_run(tmp_path: Path) -> None:
    rows = np.array(
        [(0.0, 1.0), (0.5, -0.2), (0.5, 0.1), (1.0, 0.4), (1.5, 0.3)], dtype=[("time", "f8"), ("h", "f8")]
    )
    write_csv(str(tmp_path / "run.csv"), rows)
    run = read_run(tmp_path / "run.csv")
    np.testing.assert_allclose(run.table.time, [0.0, 0.5, 0.5005, 1.0, 1.5])
    assert run.table.columns["h"].tolist() == [1.0, -0.2, 0.1, 0.4, 0.3]


def test_a_damaged_result_file_is_one_line(tmp_path: Path) -> None:
    savemat(
        tmp_path / "run.mat", {"Aclass": ["a", "1.1", "", "binTrans"], "name": ["a"], "dataInfo": [[3, 1, 0, 0]]}
    )
    with pytest.raises(MeasurementsError, match="is a damaged result file of a Modelica tool; write it again"):
        read_recording(tmp_path / "run.mat")


@pytest.mark.parametrize(
    ("content", "notes"),
    [
        ("time;u;x\n0,0;1,5;2\n0,1;2,5;\n", ("cells are separated by semicolons", "decimal commas")),
        (",Time,u,x\n0,0.0,1.5,2\n1,0.1,2.5,\n", ("the first column has no name, so it is taken for row numbers and left out",)),
        ("time,u,x\ns,N,mm\n0,1.5,2\n0.1,2.5,\n", ("units are on line 2",)),
        ("Time (ms)\tu [N]\tx [mm]\n0\t1.5\t2\n100\t2.5\t\n", ("cells are separated by tabs", "time converted from ms to s")),
        ('"time";"u [N]";"x [mm]"\r\n0;1.5;2\r\n0.1;2.5;\r\n', ("cells are separated by semicolons",)),
        ("timestamp,u,x\n2026-05-01 12:00:00,1.5,2\n2026-05-01 12:00:00.100,2.5,\n", ("time starts at the first date",)),
        ("Date,u,x\ns,N,mm\n2026-05-01T12:00:00Z,1.5,2\n2026-05-01T12:00:00.1Z,2.5,\n", ("'Date' contains dates and is taken as time", "units are on line 2", "time starts at the first date")),
        ("datetime;u;x\r\n2026-05-01T12:00:00Z;1,5;2\r\n2026-05-01T14:00:00.1+02:00;2,5;\r\n", ("cells are separated by semicolons", "time starts at the first date", "decimal commas")),
        ("time;u;x\n[ms];[N];[mm]\n0;1,5;2\n1e2;2,5;\n", ("cells are separated by semicolons", "units are on line 2", "decimal commas", "time converted from ms to s")),
    ],
)  # fmt: skip
def test_csv_as_loggers_write_it(content: str, notes: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text(content, newline="")
    table = read_csv(tmp_path / "run.csv")
    assert table.notes == notes
    np.testing.assert_allclose(table.time, [0, 0.1])
    np.testing.assert_array_equal(table.columns["u"], [1.5, 2.5])
    np.testing.assert_array_equal(table.columns["x"], [2, np.nan])
    assert table.units in ({}, {"u": "N", "x": "mm"})


@pytest.mark.parametrize("second", ["2026-05-01 12:00:00+02:00", "yesterday", "1.5"])
def test_dates_that_are_none_are_refused(second: str, tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text(f"time,x\n2026-05-01 12:00:00,1\n{second},2\n")
    with pytest.raises(MeasurementsError, match=r"line 2: '2026-05-01 12:00:00' in column 'time' is not a number"):
        read_csv(tmp_path / "run.csv")


def test_mixed_decimal_signs_are_refused(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("time;x\n0;1.234,5\n1;2\n")
    with pytest.raises(MeasurementsError) as error:
        read_csv(tmp_path / "run.csv")
    assert str(error.value).endswith("run.csv line 2: '1.234,5' in column 'x' is not a number; write a number")


Make = Callable[[Path], object]
WRONG: dict[str, tuple[Make, str]] = {
    "no.mf4": (lambda p: None, "no such file; check the path"),
    "folder.mf4": (lambda p: p.mkdir(), "is a folder, not a file; check the path"),
    "text.mf4": (lambda p: p.write_text("time,x\n"), "is not an MDF file; check the file"),
    "text.parquet": (lambda p: p.write_text("time,x\n0,1\n"), "cannot be read as Parquet (Parquet magic bytes not found in footer. Either the file is corrupted or this is not a parquet file.); write it again"),
    "no_time.parquet": (lambda p: parquet.write_table(pa.table({"x": [1.0]}), p), "has no column 'time' or 't'; save one, choose one (columns='time=NAME,...') or give rate=HZ; known: x"),
    "words.parquet": (lambda p: parquet.write_table(pa.table({"t": ["a"], "x": [1.0]}), p), "column 't' does not contain times; write it in s"),
    "no_time.h5": (lambda p: h5py.File(p, "w").close(), "has no signal over time; save a vector 'time' or 't', in s, and signals as long as it"),
    "text.h5": (lambda p: p.write_text("time,x\n"), "cannot be read as HDF5 (Unable to synchronously open file (file signature not found)); write it again"),
    "metres.h5": (lambda p: hdf5_in(p, "m"), "time is in 'm', which is not a unit of time ('m' cannot be converted to 's'); correct its unit"),
    "scalar.mat": (lambda p: savemat(p, {"t": 1.0, "x": 2.0}), "'t' is not a vector of times; save it N by 1, in s"),
}  # fmt: skip


def hdf5_in(path: Path, unit: str) -> None:
    with h5py.File(path, "w") as file:
        file["t"], file["x"] = SLOW, SLOW
        file["t"].attrs["unit"] = unit


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_recording_is_one_line(name: str, tmp_path: Path) -> None:
    make, line = WRONG[name]
    make(tmp_path / name)
    with pytest.raises(MeasurementsError) as error:
        read_recording(tmp_path / name)
    assert str(error.value) == f"{tmp_path / name}: {line}"


def test_our_own_measurements_need_no_import(folder: Path) -> None:
    with pytest.raises(MeasurementsError, match=r"is already a measurement file; name it in campaign\.toml"):
        read_recording(folder / "measurements.h5")


@pytest.mark.parametrize(
    ("module", "file", "line"),
    [
        ("asammdf", "run.mf4", "run.mf4: needs asammdf; pip install 'fmuid[mf4]'"),
        ("pyarrow", "run.parquet", "run.parquet: needs pyarrow; pip install 'fmuid[parquet]'"),
    ],
)
def test_without_the_library_of_a_format(module: str, file: str, line: str, tmp_path: Path) -> None:
    (tmp_path / f"{module}.py").write_text("raise ImportError")  # stands in the way of the one that is installed
    (tmp_path / file).write_bytes(b"MDF")
    command = ["-c", "from fmuid.cli import main; main()", "import", file, "--setup", "s", "--input", "u"]
    ran = subprocess.run(
        [sys.executable, *command],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert (ran.returncode, ran.stderr) == (2, f"fmuid: {line}\n")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("recordings")
    mf4(folder / "a.mf4")
    parquet.write_table(pa.table({"time [s]": SLOW, "x [m]": SLOW}), folder / "a.parquet")
    savemat(folder / "a.mat", {"t": SLOW, "x": SLOW})
    result_file(folder / "b.mat", "binTrans")
    hdf5_in(folder / "a.h5", "s")
    (folder / "a.csv").write_text("time [ms];x\n0;1,5\n1;2,5\n")
    return {p.suffix if p.stem == "a" else p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.fixture(scope="module")
def impatient() -> Iterator[None]:
    """Some damage makes a library hang: do not wait a minute for it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(apart, "TIME_LIMIT", 5.0)
        yield


@settings(derandomize=True, max_examples=60, deadline=None, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
@given(
    suffix=st.sampled_from([".csv", ".csv", ".mat", "b.mat", ".h5", ".parquet", ".mf4"]),
    damage=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8)), max_size=6),
    keep=st.one_of(st.just(1.0), st.floats(0, 1)),
)  # fmt: skip
def test_damaged_recordings_give_no_traceback(
    suffix: str,
    damage: list[tuple[float, bytes]],
    keep: float,
    files: dict[str, bytes],
    tmp_path: Path,
    impatient: None,
) -> None:
    content = bytearray(files[suffix])
    for place, new in damage:
        at = int(place * len(content))
        content[at : at + len(new)] = new
    broken = tmp_path / f"broken.{suffix.rpartition('.')[2]}"
    broken.write_bytes(content[: int(keep * len(content))])
    try:
        recording = read_recording(broken)
    except MeasurementsError as error:
        complaint = str(error)
    else:
        assert isinstance(recording, Recording)
        return
    assert complaint.startswith(str(broken))
    assert "\n" not in complaint


@settings(derandomize=True, max_examples=300, deadline=None, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
@given(
    text=st.one_of(
        st.text(max_size=60), st.text('time,;\t\n\r0123.5-e"[]()sN ', max_size=60).map(lambda t: "time" + t)
    )
)
def test_any_text_is_a_table_or_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "any.csv"
    path.write_text(text, newline="")
    try:
        read_csv(path)
    except MeasurementsError as error:
        complaint = str(error)
    else:
        return
    assert complaint.startswith(str(path))
    assert "\n" not in complaint
