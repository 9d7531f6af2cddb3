"""Raw logs as machines and public data sets have them: without times, headers or commas, with lists and steps."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas
import pytest
from scipy.io import savemat

from fmuid.cli.app import run
from fmuid.core.errors import FmuidError, MeasurementsError
from fmuid.core.experiments import Measurements
from fmuid.core.frames import to_frame
from fmuid.data.crosscheck_csv import read_csv
from fmuid.data.measurements import read_measurements
from fmuid.data.recordings import read_recording
from fmuid.data.recordings.conversion import read_run
from fmuid.data.table_layout import TableLayout


def imported(files: list[str], options: list[str]) -> Measurements:
    assert run(["import", *files, "--setup", "rig", "--out", "m.h5", "--quiet", *options]) == 0
    return read_measurements("m.h5")


def test_a_log_without_times_and_header_that_is_separated_by_blanks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = [f" {0.1 * k:.3f}  {k} {-k:d}   {k * k} " for k in range(50)]
    Path("raw.csv").write_text("\n".join(rows) + "\n")
    options = ["--rate", "1000", "-i", "tau", "--columns", "tau [N.m]=1,w [rad/s]=3"]
    run = imported(["raw.csv"], options)["raw"]
    np.testing.assert_allclose(run.time, np.arange(50) / 1000)
    np.testing.assert_allclose(run.signals["tau"].values, np.round(0.1 * np.arange(50), 3))
    np.testing.assert_array_equal(run.signals["w"].values, -np.arange(50))
    assert {n: s.unit for n, s in run.signals.items()} == {"tau": "N.m", "w": "rad/s"}
    with pytest.raises(MeasurementsError, match=r"has no header \(its first row has 4 cells: 0.000, 0, 0, 0\)"):
        read_csv("raw.csv", TableLayout(rate=1000))


def test_columns_of_a_matrix_are_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    data = np.column_stack([0.05 * np.arange(20), np.ones(20), np.arange(20), -np.arange(20)])
    savemat("a.mat", {"J": 1.2e-4, "data": data, "name": "servo"})
    options = ["-i", "tau", "--columns", "time=data[1],w [rad/s]=data[3],tau [N.m]=data[4]"]
    run = imported(["a.mat"], options)["a"]
    np.testing.assert_allclose(run.time, data[:, 0])
    np.testing.assert_allclose(run.signals["w"].values, data[:, 2])
    with pytest.raises(MeasurementsError, match=r"has no column 'data\[5\]'; did you mean"):
        read_recording("a.mat", layout=TableLayout(("time=data[5]", "w=data[1]")))


def test_vectors_without_times_need_a_rate(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"uEst": np.arange(8.0), "yEst": np.arange(8.0), "Ts": 4.0})
    with pytest.raises(MeasurementsError, match=r"give rate=HZ \(the file has Ts = 4\)"):
        read_recording(tmp_path / "a.mat")
    layout = TableLayout(("u [V]=uEst", "y [V]=yEst"), 0.25)
    (table,) = read_recording(tmp_path / "a.mat", layout=layout).tables
    np.testing.assert_array_equal(table.time, 4 * np.arange(8))
    assert table.units == {"u": "V", "y": "V"}


def test_a_file_that_has_times_takes_no_rate(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,x [m]\n0,1\n1,2\n")
    with pytest.raises(MeasurementsError, match="has times in 'time', and a rate is given; leave rate= out"):
        read_csv(tmp_path / "a.csv", TableLayout(rate=5.0))
    (tmp_path / "b.csv").write_text("x [m],y\n1,0.5\n2,0.25\n")
    table = read_csv(tmp_path / "b.csv", TableLayout(rate=5.0))
    np.testing.assert_allclose(table.time, [0, 0.2])
    assert (list(table.columns), table.units) == (["x", "y"], {"x": "m"})


def test_a_temperature_called_t_is_no_time(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("T [K],P [W]\n293,1\n294,2\n")
    assert list(read_csv(tmp_path / "a.csv", TableLayout(rate=5.0)).columns) == ["T", "P"]
    with pytest.raises(MeasurementsError, match="has no column of times; choose one"):
        read_csv(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("T,x,t\n293,1,0\n294,2,0.5\n")
    np.testing.assert_array_equal(read_csv(tmp_path / "b.csv").time, [0, 0.5])
    frame = pandas.DataFrame({"T [degC]": [20.0, 21.0], "P [W]": [1.0, 2.0]})
    assert list(read_run(frame, name="log", layout=TableLayout(rate=1.0)).table.columns) == ["T", "P"]


def test_units_after_an_underscore(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t_ms;u_V;i_A;phi_start;T_degC\n0;1;2;3;4\n10;1;2;3;5\n")
    table = read_csv(tmp_path / "a.csv")
    np.testing.assert_allclose(table.time, [0, 0.01])
    assert list(table.columns) == ["u", "i", "phi_start", "T"]
    assert table.units == {"u": "V", "i": "A", "T": "degC"}
    (tmp_path / "b.csv").write_text("time,u_V\n0,1\n1,1\n")  # another style: the name has an underscore
    assert list(read_csv(tmp_path / "b.csv").columns) == ["u_V"]


def test_the_time_may_be_any_column_and_a_comment_sign_may_precede_it(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("# x y t\n1 2 0\n3 4 0.5\n")
    table = read_csv(tmp_path / "a.csv")
    np.testing.assert_array_equal(table.time, [0, 0.5])
    assert list(table.columns) == ["x", "y"]


def test_cells_that_are_lists_become_columns(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('time,q [rad],name\n0,"[0.1, 0.2]",left\n1,"[0.3 0.4]",\n')
    table = read_csv(tmp_path / "a.csv")
    assert list(table.columns) == ["q[1]", "q[2]"]
    assert table.units == {"q[1]": "rad", "q[2]": "rad"}
    np.testing.assert_array_equal(table.columns["q[2]"], [0.2, 0.4])
    assert "not used (not numeric): name" in table.notes
    (tmp_path / "a.csv").write_text('time,q\n0,"[0.1, 0.2]"\n1,"[0.3]"\n')
    with pytest.raises(MeasurementsError, match="line 3: the list in column 'q' has 1 element, others have 2"):
        read_csv(tmp_path / "a.csv")


def test_what_a_logger_leaves_when_it_loses_power(tmp_path: Path) -> None:
    rows = [f"{k},{k}" for k in range(9)]
    rows[4] = "4,\0\0\0\0\0"
    (tmp_path / "a.csv").write_text("time,x\n" + "\n".join(rows) + "\n" + "\0" * 400)
    table = read_csv(tmp_path / "a.csv")
    np.testing.assert_array_equal(table.time, [0, 1, 2, 3, 5, 6, 7, 8])
    assert "NUL bytes: 2 lines left out (line 6 first)" in table.notes
    (tmp_path / "b.csv").write_text("time\0,x\0\0\n0\0,1\0\0\n1\0,2\0\0\n")  # cells filled up
    np.testing.assert_array_equal(read_csv(tmp_path / "b.csv").columns["x"], [1, 2])


def test_two_rows_at_one_time_are_a_step(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "time,u,x\n0,1,0\n1,1,1\n1,5,1\n1,5,2\n2,5,3\n2,5,3\n3,5,4\n" + "".join(f"{k},5,4\n" for k in range(4, 13))
    )
    table = read_run(tmp_path / "a.csv").table
    np.testing.assert_allclose(table.time, [0, 1, 1.001, *range(2, 13)])
    np.testing.assert_array_equal(table.columns["u"], [1, 1] + [5] * 12)
    np.testing.assert_array_equal(table.columns["x"], [0, 1, 2, 3] + [4] * 10)
    notes = read_run(tmp_path / "a.csv").notes
    assert notes == ("1 time with two rows: the second row is a step right after the first",)
    (tmp_path / "b.csv").write_text("time,x\n" + "".join(f"{k // 5},{k}\n" for k in range(50)))
    with pytest.raises(MeasurementsError, match="41 of 50 rows have the time of another row"):
        read_run(tmp_path / "b.csv")


def test_times_that_differ_by_rounding_are_one_time(tmp_path: Path) -> None:
    """As FMPy records events: two rows for each, and a row of the grid a rounding error later."""
    rows = ["0.1,0,0.1", "0.15,1,0.15", "0.15,1,-0.2", "0.2,2,-0.15", "0.20000000000000001,2,-0.15"]
    rows = [
        "0,0,0.2",
        *rows,
        "0.25,2,-0.1",
        "0.25000000000000006,2,-0.1",
        "0.25000000000000006,3,0.3",
        "0.3,3,0.25",
    ]
    rows += [f"{k / 20:g},3,0.2" for k in range(7, 30)]
    (tmp_path / "fmpy.csv").write_text("\n".join(["time,count,v", *rows]) + "\n")
    table = read_run(tmp_path / "fmpy.csv").table
    assert (np.diff(table.time) > 1e-6).all()
    np.testing.assert_array_equal(table.columns["v"][:8], [0.2, 0.1, 0.15, -0.2, -0.15, -0.1, 0.3, 0.25])


def test_data_frames_are_read_like_csv(tmp_path: Path) -> None:
    columns = {"n [1/min]": [60.0, 120.0], "q [rad]": [[0.1, 0.2], [0.3, 0.4]]}
    for library in ("pandas", "polars"):
        frame = to_frame({"t [ms]": [0.0, 1.0], **columns}, library)  # type: ignore[arg-type]
        run = read_run(frame, name="log")
        np.testing.assert_allclose(run.table.time, [0, 0.001])
        assert list(run.table.columns) == ["n", "q[1]", "q[2]"]
        assert run.table.units == {"n": "rpm", "q[1]": "rad", "q[2]": "rad"}
        assert "'n' in 1/min is read as revolutions per minute (rpm)" in run.notes
        without = read_run(to_frame(columns, library), layout=TableLayout(rate=10.0), name="log")  # type: ignore[arg-type]
        np.testing.assert_allclose(without.table.time, [0, 0.1])


@pytest.mark.parametrize("library", ["pandas", "polars", "pyarrow"])
def test_nulls_dates_and_booleans_of_data_frames(library: str) -> None:
    dates = [datetime(2026, 1, 1, 0, 0, k, 500, tzinfo=UTC) for k in range(4)]
    columns: dict[str, object] = {
        "time": dates,
        "since": [date - dates[1] for date in dates],
        "n": [1, None, 3, 4],
        "on": [True, None, False, True],
        "text": ["a", None, "b", "c"],
    }
    log = read_run(to_frame(columns, library), name="log")  # type: ignore[arg-type]
    np.testing.assert_array_equal(log.table.time, [0, 1, 2, 3])
    assert list(log.table.columns) == ["since", "n", "on"]
    np.testing.assert_array_equal(log.table.columns["since"], [0, 1, 2, 3])
    np.testing.assert_array_equal(log.table.columns["n"][[0, 2, 3]], [1, 3, 4])
    np.testing.assert_array_equal(log.table.columns["on"][[0, 2, 3]], [1, 0, 1])
    assert np.isnan(log.table.columns["n"][1])
    assert np.isnan(log.table.columns["on"][1])
    assert "time starts at the first date" in log.notes


def test_two_columns_of_one_name_in_a_data_frame_are_refused() -> None:
    frame = pandas.DataFrame([[0.0, 1.0, 2.0], [1.0, 1.0, 2.0]], columns=["time", "x", "x"])
    with pytest.raises(FmuidError, match="the data frame has two columns 'x'"):
        read_run(frame, name="log")
