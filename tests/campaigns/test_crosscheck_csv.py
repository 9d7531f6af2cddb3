"""Cross-Check CSV: what is written reads back the same; anything else is a table or one clear line."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import Table, read_csv, write_csv


def test_the_file_is_as_the_fmi_cross_check_has_it(tmp_path: Path) -> None:
    write_csv(
        Table(np.array([0, 0.1]), {"x": np.array([1, np.nan]), "y": np.array([2, 3e-20])}, {}), tmp_path / "a.csv"
    )
    assert (tmp_path / "a.csv").read_text() == '"time","x","y"\n0.0,1.0,2.0\n0.1,,3e-20\n'


def test_an_event_has_two_rows(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('"time","x"\n0,1\n1,1\n1,2\n2,2\n')
    np.testing.assert_array_equal(read_csv(tmp_path / "a.csv").time, [0, 1, 1, 2])


NAMES = st.text(min_size=1, max_size=8).filter(
    lambda n: n.isprintable() and n == n.strip() and not set(n) & set("[]()")
)
NAMES = NAMES.filter(lambda n: n not in ("time", "\ufeff"))


@settings(
    derandomize=True,
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    database=None,
)
@given(
    columns=st.dictionaries(
        NAMES, st.lists(st.floats(allow_infinity=False), min_size=3, max_size=3), min_size=1, max_size=3
    ),
    unit=st.sampled_from(["N.m", "1", "rad/s", ""]),
)
@example(columns={'a"b,c;d': [1.0, 2.0, 3.0]}, unit="A")
@example(columns={"der(x)": [1.0, 2.0, 3.0], "table[1,2]": [0.0, 0.0, 0.0]}, unit="A")
def test_round_trip(columns: dict[str, list[float]], unit: str, tmp_path: Path) -> None:
    table = Table(np.arange(3.0), {n: np.array(v) for n, v in columns.items()}, {next(iter(columns)): unit})
    write_csv(table, tmp_path / "a.csv")
    read = read_csv(tmp_path / "a.csv")
    assert list(read.columns) == list(columns)
    assert read.units == table.units
    for name, values in table.columns.items():
        np.testing.assert_array_equal(read.columns[name], values)


@settings(
    derandomize=True,
    max_examples=300,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    database=None,
)
@given(
    content=st.one_of(
        st.binary(max_size=60),
        st.lists(st.lists(st.sampled_from(["time", "0", "1", "-2.5e3", "nan", "inf", "", '"', "a", "x [m]", "\t", "1_0", "#"]), max_size=4).map(",".join), max_size=5)
        .map("\n".join)
        .map(lambda text: ("time,a,b\n" + text).encode()),
    )
)  # fmt: skip
def test_any_file_is_a_table_or_one_line(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "fuzz.csv"
    path.write_bytes(content)
    try:
        read = read_csv(path)
    except MeasurementsError as error:
        complaint = str(error)
    else:
        assert all(values.shape == read.time.shape for values in read.columns.values())
        return
    assert complaint.startswith(str(path))
    assert "\n" not in complaint


def test_a_missing_sample_is_no_reason_to_lose_the_column(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,x,y\n0,1,2\n1,,3\n")
    np.testing.assert_array_equal(read_csv(tmp_path / "a.csv").columns["x"], [1, np.nan])
    (tmp_path / "a.csv").write_text("time,x,y\n0,1,2\n,5,3\n")
    with pytest.raises(MeasurementsError, match=r"time is missing in sample 1; write every time, in s$"):
        read_csv(tmp_path / "a.csv")


@pytest.mark.parametrize("content", ['time,u\n0,"{}"\n1,2\n', "time,{}\n0,1\n", "time,u\n0,1\n1,{}"])
def test_an_endless_field_is_refused_before_it_takes_memory(tmp_path, content):
    file = tmp_path / "long.csv"
    file.write_text(content.format("9" * 20_000_000))
    with pytest.raises(
        MeasurementsError, match=r"long.csv line \d: is longer than 1 MB; write one row for each time"
    ):
        read_csv(file)
    tracemalloc.start()
    with pytest.raises(MeasurementsError):
        read_csv(file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * 20_000_000
