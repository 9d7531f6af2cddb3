"""`fmuid.start`: from logs and a model in one call, files or data frames; frames of results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest

import fmuid
from fmuid.core.experiments import Measurements
from fmuid.core.frames import to_frame


def test_from_data_frames_to_estimates_and_back(
    folder: Path, oscillator: Path, measurements: Measurements
) -> None:
    runs = list(measurements)
    index = pd.to_timedelta(runs[0].time, unit="s") + pd.Timestamp("2026-01-01")
    step = runs[0].to_frame().drop(columns="time [s]").set_index(index.rename("time"))
    frames = {"step": step, "sine": runs[1].to_frame("polars"), "pulse": runs[2].to_frame("pyarrow")}
    notes: list[str] = []
    campaign = fmuid.start(frames, model=oscillator, out="drive", say=notes.append)
    assert list(campaign.measurements.experiments) == ["step", "sine", "pulse"]
    for made, given in zip(campaign.measurements, runs, strict=True):
        np.testing.assert_allclose(made.time, given.time - given.time[0], atol=1e-9)
        for name, signal in given.signals.items():
            np.testing.assert_array_equal(made.signals[name].values, signal.values)
            assert made.signals[name].unit == signal.unit
    assert any(line.startswith("free parameters: ") for line in notes)
    result = fmuid.identify(campaign)
    frame = result.to_frame("polars")
    assert isinstance(frame, pl.DataFrame)
    assert dict(zip(frame["name"], frame["value"], strict=True)) == {e.name: e.value for e in result.estimates}
    scores = fmuid.validate(result, campaign).to_frame()
    assert scores.loc[scores["experiment"] == "pulse", "nrmse"].max() < 0.1


def test_a_campaign_is_replaced_only_if_asked_for(
    folder: Path, oscillator: Path, measurements: Measurements
) -> None:
    frame = next(iter(measurements)).to_frame()
    fmuid.start(frame, oscillator, say=lambda _: None)
    with pytest.raises(fmuid.FmuidError, match=r"already exists; replace it with replace=True"):
        fmuid.start(frame, oscillator)
    fmuid.start(frame, oscillator, replace=True, say=lambda _: None)


def test_a_run_is_not_kept_for_validation_if_another_would_be_alone_in_its_direction(
    folder: Path, oscillator: Path, measurements: Measurements
) -> None:
    frame = next(iter(measurements)).to_frame()
    column = next(c for c in frame.columns if c.startswith("u "))
    for sizes, kept in (
        ((1.0, -1.0, 0.8, -0.8), ()),
        ((1.0, 0.9, -1.0, 0.8), ("e3",)),
        ((1.0, 0.9, 0.8), ("e2",)),
    ):
        frames = {f"e{k}": frame.assign(**{column: size * frame[column]}) for k, size in enumerate(sizes)}
        assert fmuid.start(frames, oscillator, replace=True, say=lambda _: None).validation == kept


def test_what_is_no_log_is_one_line(folder: Path, oscillator: Path) -> None:
    with pytest.raises(fmuid.FmuidError, match="'int' is not a data frame"):
        fmuid.start({"a": 3}, oscillator)
    with pytest.raises(fmuid.FmuidError, match="has a 'DataFrame', which has no name; give files"):
        fmuid.start([pd.DataFrame({"x [m]": [1.0, 2.0]})], oscillator)
    before = folder / "campaign.toml"
    text = before.read_text()
    with pytest.raises(fmuid.FmuidError, match="has no column 'time' or 't'"):
        fmuid.start(pd.DataFrame({"x [m]": [1.0, 2.0]}), oscillator, out=folder, replace=True)
    assert before.read_text() == text
    mute = folder / "Mute.mo"
    mute.write_text("model Mute input Real u; Real x(start = 0, fixed = true); equation der(x) = u - x; end Mute;")
    with pytest.raises(fmuid.FmuidError, match="the model has no outputs; declare what the log shows as output"):
        fmuid.start(pd.DataFrame({"time": [0.0, 0.1, 0.2], "u": [1.0, 2.0, 3.0]}), mute)
    for nothing in ([], {}):
        with pytest.raises(fmuid.FmuidError, match="there are no logs"):
            fmuid.start(nothing, oscillator)
    with pytest.raises(fmuid.FmuidError, match="has no column 'time' or 't'"):
        fmuid.start(pd.DataFrame({"x [m]": [1.0, 2.0]}), oscillator)
    with pytest.raises(fmuid.FmuidError, match="data frames of 'excel' are not supported"):
        to_frame({}, "excel")  # type: ignore[arg-type]


def test_messages_name_arguments_in_python_and_options_at_a_shell(
    folder: Path, oscillator: Path, measurements: Measurements, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = next(iter(measurements)).to_frame()
    with pytest.raises(fmuid.FmuidError, match=r"no signal 'nothing' is used") as refused:
        fmuid.start(frame, oscillator, sigmas={"nothing": 1.0}, say=lambda _: None)
    assert str(refused.value).startswith("sigmas=: ")
    assert refused.value.where == "--sigma"
