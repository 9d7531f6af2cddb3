"""Signals with different time bases: refused, or brought onto one as the user says, on record."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from fmuid.cli.app import run
from fmuid.core.errors import MeasurementsError
from fmuid.data.crosscheck_csv import Table
from fmuid.data.measurements import read_measurements
from fmuid.data.recordings import Recording
from fmuid.data.recordings.resampling import TimeBase, one_time_base

FAST, SLOW = np.linspace(0.0, 1.0, 1001), np.linspace(0.05, 1.05, 101)
ON_CHANGE = np.array([0.0, 0.333, 0.71])
RECORDING = Recording(
    (
        Table(FAST, {"w": np.sin(6 * FAST), "ripple": np.cos(2 * np.pi * 100 * FAST)}, {"w": "rad/s"}),
        Table(SLOW, {"oil": 20 + SLOW}, {"oil": "degC"}),
        Table(ON_CHANGE, {"u": np.array([0.0, 1.0, 0.0])}, {"u": "V"}),
    )
)


def test_refused_until_told() -> None:
    with pytest.raises(MeasurementsError) as error:
        one_time_base(RECORDING, None, "run.mf4")
    assert str(error.value) == (
        "run.mf4: has signals with 3 time bases (w, ripple: 1000 Hz, 1001 samples, 0 to 1 s; oil: 100 Hz, 101 samples,"
        " 0.05 to 1.05 s; u: uneven steps of 0.333 to 0.377 s, 3 samples, 0 to 0.71 s); choose signals with signals=,"
        " or a common time base with base.rate=RATE or base.align=SIGNAL"
    )
    table, how = one_time_base(RECORDING.only(["w"]), None, "run.mf4")
    assert (table.time.size, how) == (1001, {})


def test_a_common_rate() -> None:
    table, how = one_time_base(RECORDING, TimeBase(rate=200, methods={"u": "hold", "ripple": "mean"}), "run")
    np.testing.assert_allclose(table.time, 0.05 + np.arange(191) / 200)  # where all are; what is held has no end
    np.testing.assert_allclose(table.columns["w"], np.sin(6 * table.time), atol=5e-6)
    np.testing.assert_allclose(table.columns["oil"], 20 + table.time)
    np.testing.assert_array_equal(table.columns["u"], (table.time >= 0.333) & (table.time < 0.71))
    assert (
        np.abs(table.columns["ripple"][1:-1]).max() < 0.7
    )  # five samples of ten in a period; linear would show 1
    assert table.units == {"w": "rad/s", "oil": "degC", "u": "V"}
    assert how == {
        "w": "linear from 1000 Hz, 1001 samples, 0 to 1 s",
        "ripple": "mean from 1000 Hz, 1001 samples, 0 to 1 s",
        "oil": "linear from 100 Hz, 101 samples, 0.05 to 1.05 s",
        "u": "hold from uneven steps of 0.333 to 0.377 s, 3 samples, 0 to 0.71 s",
    }


def test_the_times_of_one_signal() -> None:
    table, how = one_time_base(RECORDING.only(["w", "oil"]), TimeBase(align="w"), "run")
    assert table.time is not FAST
    np.testing.assert_array_equal(table.time, FAST)
    assert list(how) == ["oil"]  # w stays as it is
    assert how["oil"].endswith(", 50 samples missing")  # nothing is made up before its first
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(table.columns["oil"])), np.arange(50))


def test_a_long_pause_is_not_bridged() -> None:
    time = np.concatenate([SLOW[:50], SLOW[80:]])
    pause = Recording((Table(time, {"x": time}, {}), Table(FAST, {"y": FAST}, {})))
    x = one_time_base(pause, TimeBase(rate=100), "run")[0].columns["x"]
    assert 25 < np.isnan(x).sum() < 32
    held = one_time_base(pause, TimeBase(rate=100, method="hold"), "run")[0].columns["x"]
    assert np.isfinite(held).all()


def test_missing_samples_are_not_used() -> None:
    values = np.where(np.arange(1001) % 2, np.nan, FAST)
    x = one_time_base(Recording((Table(FAST, {"x": values}, {}),)), TimeBase(rate=250), "run")[0].columns["x"]
    np.testing.assert_allclose(x, np.arange(251) / 250)


def test_no_overlap() -> None:
    apart = Recording((Table(FAST, {"x": FAST}, {}), Table(FAST + 2, {"y": FAST}, {})))
    with pytest.raises(MeasurementsError) as error:
        one_time_base(apart, TimeBase(rate=10), "run")
    assert str(error.value) == (
        "run: signals do not overlap: one begins at 2 s, another ends at 1 s; choose other signals with signals="
    )


def test_import_says_and_records_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    savemat("run.mat", {"t": FAST, "u": FAST, "x": FAST**2})
    arguments = ["--setup", "s", "--input", "u", "--unit", "u=N", "--unit", "x=m"]
    assert run(["import", "run.mat", *arguments, "--resample", "100", "--method", "u=hold"]) == 0
    out, _ = capfd.readouterr()
    assert out.splitlines()[:3] == [
        "run.mat: 'u' resampled: hold from 1000 Hz, 1001 samples, 0 to 1 s",
        "run.mat: 'x' resampled: linear from 1000 Hz, 1001 samples, 0 to 1 s",
        "run.mat: u, x: sampled more slowly than recorded; if they contain frequencies above half the new rate, --method mean averages them out",
    ]
    # Recorded in the file, and still there when a run is added.
    savemat("more.mat", {"t": FAST, "u": FAST, "x": FAST})
    assert run(["import", "more.mat", *arguments, "--append"]) == 0
    measurements = read_measurements("measurements.h5")
    assert measurements["run"].time.size == 101
    assert measurements["run"].signals["u"].resampled == "hold from 1000 Hz, 1001 samples, 0 to 1 s"
    assert measurements["more"].signals["u"].resampled == ""
