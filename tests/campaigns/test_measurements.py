"""measurements.h5: what is written reads back the same; what breaks a rule is refused in one line."""

from __future__ import annotations

import signal as signals
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from fmuid.core.errors import FmuidError, MeasurementsError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import read_measurements, write_measurements
from fmuid.data.recordings.conversion import with_repeats

SEALED = Path(__file__).parents[3] / "shared" / "data" / "sealed"
Edit = Callable[[Any], None]


def assert_same(a: Measurements, b: Measurements) -> None:
    assert (a.title, a.rig, a.source, a.licence) == (b.title, b.rig, b.source, b.licence)
    assert list(a.experiments) == list(b.experiments)
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x.time, y.time)
        for name in ("id", "setup", "settings", "setting_units", "repeat_of", "description"):
            assert getattr(x, name) == getattr(y, name), name
        assert list(x.signals) == list(y.signals)
        for s, t in zip(x.signals.values(), y.signals.values(), strict=True):
            np.testing.assert_array_equal(s.values, t.values)
            assert (s.name, s.unit, s.causality, s.sigma) == (t.name, t.unit, t.causality, t.sigma)


def test_round_trip(measurements: Measurements, tmp_path: Path) -> None:
    write_measurements(measurements, tmp_path / "new folder" / "m.h5")
    assert_same(read_measurements(tmp_path / "new folder" / "m.h5"), measurements)


def test_the_file_is_as_the_format_says(folder: Path) -> None:
    with h5py.File(folder / "measurements.h5") as file:
        assert file.attrs["format"] == "fmuid-campaign"
        assert file.attrs["version"] == 1
        run = file["experiments/free"]
        assert run.attrs["setup"] == "free_shaft"
        assert run["time"].dtype == np.float64
        assert run["settings"].attrs["mgr"] == 3.5
        assert run["settings"].attrs["mgr.unit"] == "N.m"
        tau = run["signals/tau"]
        assert (tau.attrs["unit"], tau.attrs["causality"], tau.attrs["sigma"]) == ("N.m", "output", 0.1)
        assert file["experiments/step_1_r1"].attrs["repeat_of"] == "step_1"


@pytest.mark.skipif(
    not SEALED.is_dir(), reason="the sealed campaigns are not in the folder next to this repository"
)
def test_other_peoples_files_read() -> None:
    files = sorted(SEALED.glob("*/measurements.h5"))
    assert len(files) == 16
    for file in files:
        assert len(read_measurements(file)) == 45


def test_attributes_of_one_element_and_bytes_are_taken(folder: Path) -> None:
    path = folder / "measurements.h5"
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = np.array([1.0])  # as MATLAB writes it
        file["experiments/free"].attrs["setup"] = np.bytes_("free_shaft")
    assert read_measurements(path)["free"].setup == "free_shaft"


def in_run(name: str, edit: Edit) -> Edit:
    return lambda file: edit(file["experiments"][name])


def set_attribute(name: str, value: object) -> Edit:
    return lambda item: item.attrs.__setitem__(name, value)


def drop(name: str) -> Edit:
    return lambda item: item.__delitem__(name)


def on_signal(name: str, edit: Edit) -> Edit:
    return in_run("step_1", lambda run: edit(run["signals"][name]))


def replaced(name: str, **how: Any) -> Edit:
    """Replace a dataset of step_1 by another, its attributes kept."""

    def edit(run: Any) -> None:
        attributes = dict(run[name].attrs)
        del run[name]
        run.create_dataset(name, **how).attrs.update(attributes)

    return in_run("step_1", edit)


def change(dataset: str, index: int, value: float) -> Edit:
    return in_run("step_1", lambda run: run[dataset].__setitem__(index, value))


def linked(link: object) -> Edit:
    def edit(run: Any) -> None:
        del run["signals/tau"]
        run["signals/tau"] = link

    return in_run("step_1", edit)


def virtual(run: Any) -> None:
    layout = h5py.VirtualLayout(shape=(11,), dtype="f8")
    layout[:] = h5py.VirtualSource("other.h5", "x", shape=(11,))
    attributes = dict(run["signals/tau"].attrs)
    del run["signals/tau"]
    run["signals"].create_virtual_dataset("tau", layout).attrs.update(attributes)


WRONG: dict[str, tuple[Edit, str]] = {
    "no_format": (
        lambda f: f.attrs.__delitem__("format"),
        "measurements.h5: is HDF5 but not a measurement file; the root attribute 'format' must be 'fmuid-campaign'",
    ),
    "other_format": (
        set_attribute("format", "hdf"),
        "measurements.h5: is HDF5 but not a measurement file; the root attribute 'format' must be 'fmuid-campaign'",
    ),
    "no_version": (
        lambda f: f.attrs.__delitem__("version"),
        'measurements.h5: has no version; this fmuid reads version 1',
    ),
    "version": (
        set_attribute("version", 2),
        'measurements.h5: has version 2; this fmuid reads version 1',
    ),
    "title_no_text": (
        set_attribute("title", 3),
        "measurements.h5: attribute 'title' is not a string; write it as a string",
    ),
    "no_experiments_group": (
        drop("experiments"),
        "measurements.h5: has no group 'experiments'; write the group",
    ),
    "no_experiments": (
        lambda f: f["experiments"].clear(),
        'measurements.h5: has no experiments; write at least one under /experiments',
    ),
    "no_setup": (
        in_run("prbs", lambda run: run.attrs.__delitem__("setup")),
        "measurements.h5: experiment 'prbs': has no attribute 'setup'; write the string attribute 'setup'",
    ),
    "setup_no_text": (
        in_run("prbs", set_attribute("setup", 1.5)),
        "measurements.h5: experiment 'prbs': attribute 'setup' is not a string; write it as a string",
    ),
    "no_time": (
        in_run("step_1", drop("time")),
        "measurements.h5: experiment 'step_1': has no dataset 'time'; write the dataset",
    ),
    "no_signals": (
        in_run("step_1", drop("signals")),
        "measurements.h5: experiment 'step_1': has no group 'signals'; write the group",
    ),
    "signals_empty": (
        in_run("step_1", lambda run: run["signals"].clear()),
        "measurements.h5: experiment 'step_1': has no signals; write at least one under 'signals'",
    ),
    "group_for_dataset": (
        in_run("step_1", lambda run: run["signals"].create_group("x")),
        "measurements.h5: experiment 'step_1': 'x' is not a dataset; write it as a dataset",
    ),
    "float32_time": (
        replaced("time", data=np.arange(11, dtype="f4")),
        "measurements.h5: experiment 'step_1', time: has type float32, not float64; write it as float64",
    ),
    "integer_signal": (
        replaced("signals/tau", data=np.arange(11)),
        "measurements.h5: experiment 'step_1', signal 'tau': has type int64, not float64; write it as float64",
    ),
    "text_signal": (
        replaced("signals/tau", data=["a"] * 11),
        "measurements.h5: experiment 'step_1', signal 'tau': has type object, not float64; write it as float64",
    ),
    "time_2d": (
        replaced("time", data=np.zeros((11, 2))),
        "measurements.h5: experiment 'step_1', time: has shape (11, 2), not (N,); write one value per sample",
    ),
    "one_sample": (
        replaced("time", data=np.zeros(1)),
        "measurements.h5: experiment 'step_1', time: has shape (1,); a run has at least 2 samples, shape (N,)",
    ),
    "huge": (
        replaced("signals/tau", shape=(10**12,), dtype="f8", chunks=(1000,)),
        "measurements.h5: experiment 'step_1', signal 'tau': has 1000000000000 samples, more than 50000000; split the run or sample slower",
    ),
    "nan_time": (
        change("time", 4, np.nan),
        "measurements.h5: experiment 'step_1', time: sample 4 is nan; every time must be a finite number, in s",
    ),
    "unsorted_time": (
        change("time", 4, 0.25),
        "measurements.h5: experiment 'step_1', time: sample 4 (0.25 s) is not after sample 3 (0.3 s); sort the samples by time and drop duplicates",
    ),
    "double_time": (
        change("time", 4, 0.3),
        "measurements.h5: experiment 'step_1', time: sample 4 (0.3 s) is not after sample 3 (0.3 s); sort the samples by time and drop duplicates",
    ),
    "nan_input": (
        change("signals/i_cmd", 7, np.nan),
        "measurements.h5: experiment 'step_1', signal 'i_cmd': sample 7 of an input is NaN (1 in total); an input needs every sample: cut the run or fill the gap",
    ),
    "infinite_output": (
        change("signals/tau", 2, -np.inf),
        "measurements.h5: experiment 'step_1', signal 'tau': sample 2 is infinite; write NaN where an output is missing",
    ),
    "length": (
        replaced("signals/tau", data=np.zeros(10)),
        "measurements.h5: experiment 'step_1', signal 'tau': has shape (10,) but time has 11 samples; write one value for each time",
    ),
    "causality": (
        on_signal("tau", set_attribute("causality", "ouput")),
        "measurements.h5: experiment 'step_1', signal 'tau': causality is 'ouput'; did you mean 'output'?",
    ),
    "no_causality": (
        on_signal("tau", lambda s: s.attrs.__delitem__("causality")),
        "measurements.h5: experiment 'step_1', signal 'tau': has no attribute 'causality'; write the string attribute 'causality'",
    ),
    "no_unit": (
        on_signal("tau", lambda s: s.attrs.__delitem__("unit")),
        "measurements.h5: experiment 'step_1', signal 'tau': has no attribute 'unit'; write the string attribute 'unit'",
    ),
    "unit_number": (
        on_signal("tau", set_attribute("unit", 1)),
        "measurements.h5: experiment 'step_1', signal 'tau': attribute 'unit' is not a string; write it as a string",
    ),
    "sigma_negative": (
        on_signal("tau", set_attribute("sigma", -1.0)),
        "measurements.h5: experiment 'step_1', signal 'tau': sigma is -1; write a positive number or leave it out",
    ),
    "sigma_text": (
        on_signal("tau", set_attribute("sigma", "small")),
        "measurements.h5: experiment 'step_1', signal 'tau': attribute 'sigma' is not a number; write it as one number",
    ),
    "setting_text": (
        in_run("free", lambda run: run["settings"].attrs.__setitem__("mgr", "3.5 N.m")),
        "measurements.h5: experiment 'free', settings: attribute 'mgr' is not a number; write it as one number",
    ),
    "setting_nan": (
        in_run("free", lambda run: run["settings"].attrs.__setitem__("mgr", np.nan)),
        "measurements.h5: experiment 'free': setting 'mgr' is nan; write a finite number",
    ),
    "setting_array": (
        in_run("free", lambda run: run["settings"].attrs.__setitem__("mgr", [1.0, 2.0])),
        "measurements.h5: experiment 'free', settings: attribute 'mgr' is not a number; write it as one number",
    ),
    "unit_alone": (
        in_run("free", lambda run: run["settings"].attrs.__setitem__("c.unit", "N")),
        "measurements.h5: experiment 'free', settings: 'c.unit' is the unit of a setting that is missing; write 'c'",
    ),
    "repeat_of_nothing": (
        in_run("step_1_r1", set_attribute("repeat_of", "step1")),
        "measurements.h5: experiment 'step_1_r1': repeats 'step1', which is not in the file; did you mean 'step_1'?",
    ),
    "repeat_of_repeat": (
        in_run("step_2", set_attribute("repeat_of", "step_1_r1")),
        "measurements.h5: experiment 'step_2': repeats 'step_1_r1', which is a repeat itself; name the first run in repeat_of",
    ),
    "repeat_of_other_setup": (
        in_run("free", set_attribute("repeat_of", "step_1")),
        "measurements.h5: experiment 'free': repeats 'step_1' but its setup is 'free_shaft', not 'fixed_shaft'; a repeat has the same inputs; if this is a different experiment, remove repeat_of",
    ),
    "repeat_with_other_input": (
        change("signals/i_cmd", 7, 0.0),
        "measurements.h5: experiment 'step_1_r1': repeats 'step_1' but its input 'i_cmd' differs at sample 7; a repeat has the same inputs; if this is a different experiment, remove repeat_of",
    ),
    "external_link": (
        linked(h5py.ExternalLink("/etc/passwd", "/")),
        "measurements.h5: experiment 'step_1': 'tau' is a link to another place or file; copy the data into this file itself",
    ),
    "soft_link": (
        linked(h5py.SoftLink("/experiments/step_2/signals/tau")),
        "measurements.h5: experiment 'step_1': 'tau' is a link to another place or file; copy the data into this file itself",
    ),
    "virtual": (
        in_run("step_1", virtual),
        "measurements.h5: experiment 'step_1': 'tau' stores its data in other files; copy the data into this file itself",
    ),
    "stored_outside": (
        replaced("signals/tau", shape=(11,), dtype="f8", external="/etc/passwd"),
        "measurements.h5: experiment 'step_1': 'tau' stores its data in other files; copy the data into this file itself",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_broken_rule_is_one_clear_line(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    edit, line = WRONG[name]
    with h5py.File("measurements.h5", "r+") as file:
        edit(file)
    with pytest.raises(MeasurementsError) as error:
        read_measurements("measurements.h5")
    assert str(error.value) == line


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "m.h5: no such file; check the path"),
        (b"", "m.h5: cannot be read as HDF5 (Unable to synchronously open file (file signature not found)); write it again"),
        (b"time,tau\n0,1\n", "m.h5: cannot be read as HDF5 (Unable to synchronously open file (file signature not found)); write it again"),
    ],
)  # fmt: skip
def test_no_hdf5(content: bytes | None, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    if content is not None:
        Path("m.h5").write_bytes(content)
    with pytest.raises(MeasurementsError) as error:
        read_measurements("m.h5")
    assert str(error.value) == line


@settings(
    derandomize=True,
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    database=None,
)
@given(damage=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8)), max_size=6),
       keep=st.one_of(st.just(1.0), st.floats(0, 1)))  # fmt: skip
def test_damaged_files_give_no_traceback(folder: Path, damage: list[tuple[float, bytes]], keep: float) -> None:
    content = bytearray((folder / "measurements.h5").read_bytes())
    for place, new in damage:
        at = int(place * len(content))
        content[at : at + len(new)] = new
    broken = folder / "broken.h5"
    broken.write_bytes(content[: int(keep * len(content))])
    try:
        read_measurements(broken)
    except MeasurementsError as error:
        complaint = str(error)
    else:
        return
    assert complaint.startswith(str(broken))
    assert "\n" not in complaint


@settings(
    derandomize=True,
    max_examples=50,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    database=None,
)
@given(
    values=st.lists(st.floats(), min_size=0, max_size=4),
    unit=st.text(max_size=4),
    name=st.text(max_size=6),
    sigma=st.one_of(st.none(), st.floats()),
)
def test_what_is_written_reads_back_or_is_refused(
    measurements: Measurements, tmp_path: Path, values: list[float], unit: str, name: str, sigma: float | None
) -> None:
    run = measurements["step_1"]
    signals = {name: Signal(name, np.array(values), unit, "output", sigma)}
    path = tmp_path / "fuzz.h5"
    path.unlink(missing_ok=True)
    try:
        changed = replace(run, time=np.arange(len(values), dtype=float), signals=signals)
        written = Measurements({run.id: changed})
        write_measurements(written, path)
    except MeasurementsError:
        assert not path.exists()
    else:
        assert_same(read_measurements(path), written)


def test_refused_values_leave_the_old_file(folder: Path, measurements: Measurements) -> None:
    path = folder / "measurements.h5"
    before = path.read_bytes()
    bad = replace(measurements["free"], time=np.zeros(11))
    with pytest.raises(MeasurementsError, match="is not after sample 0"):
        write_measurements(Measurements({"free": bad}), path)
    assert path.read_bytes() == before
    assert sorted(p.name for p in folder.iterdir()) == ["campaign.toml", "measurements.h5"]


def test_killed_while_writing_leaves_no_file(tmp_path: Path) -> None:
    script = (
        "import os, signal, h5py, numpy as np\n"
        "from fmuid.data import hdf5\n"
        "from pathlib import Path\n"
        "def fill(file):\n"
        "    file['x'] = np.zeros(1000)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "hdf5.write_file(Path('m.h5'), fill)\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, timeout=600, check=False)
    assert ended.returncode == -signals.SIGKILL
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written(measurements: Measurements, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FmuidError) as error:
        write_measurements(measurements, tmp_path / "file" / "m.h5")
    assert str(error.value) == (
        f"{tmp_path}/file/m.h5: cannot be written (File exists); choose a folder that can be written"
    )
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_runs_whose_inputs_differ_by_noise_repeat_a_reference(tmp_path):
    rng = np.random.default_rng(3)
    time = np.arange(200) * 0.01
    course = np.sin(5 * time)

    def run(id, u):
        signals = {n: Signal(n, v, "1", c) for n, v, c in (("u", u, "input"), ("y", course, "output"))}
        return Experiment(id, "bench", time, signals)

    noisy = course + 0.01 * rng.standard_normal(200)
    runs = {r.id: r for r in (run("a", course), run("b", course), run("c", noisy), run("d", 1.2 * course))}
    marked = with_repeats(runs)
    assert [r.repeat_of for r in marked.values()] == [None, "a", None, None]
    assert [r.repeat_of_reference for r in marked.values()] == [None, None, "a", None]
    write_measurements(Measurements(marked), tmp_path / "m.h5")
    assert read_measurements(tmp_path / "m.h5")["c"].repeat_of_reference == "a"
    both = replace(marked["c"], repeat_of="a")
    with pytest.raises(MeasurementsError, match="has repeat_of and repeat_of_reference; remove one of them"):
        write_measurements(Measurements({**marked, "c": both}), tmp_path / "n.h5")


@pytest.mark.parametrize(
    ("output", "column", "repeats"),
    [
        ({}, {}, True),
        ({"begin": 1.0}, {}, False),  # it begins elsewhere
        ({"begin": 1.0, "rate": 20.0}, {}, False),  # and soon forgets it
        ({"begin": 1.0, "rate": 0.0}, {}, True),  # its sensor is shifted
        ({"slow": 0.3}, {}, True),  # nothing says why it differs
        ({"slow": 0.3}, {"T": 5.0}, False),  # it was warmer
        ({"slow": 0.3}, {"T": 0.1}, True),  # hardly warmer
        ({}, {"T": 5.0}, True),  # it was warmer, and did the same
        ({"slow": np.nan}, {"T": 5.0}, True),  # its output is missing
        ({"slow": 0.3}, {"clock": 100.0}, True),  # clocks always differ
    ],
)
def test_runs_with_equal_inputs_are_no_repeats_where_a_log_says_why_they_differ(output, column, repeats):
    time = np.arange(200) * 0.01
    rng = np.random.default_rng(3)

    def run(id, *, begin=0.0, rate=1.0, slow=0.0, T=0.0, clock=0.0):
        u = np.sin(5 * time)
        y = u + begin * np.exp(-rate * time) + slow * time + 0.01 * rng.standard_normal(200)
        unused = {"T": Signal("T", 20 + T + np.sin(time), "degC", "input")}
        unused |= {"clock": Signal("clock", clock + time, "s", "input")}
        signals = {n: Signal(n, v, "1", c) for n, v, c in (("u", u, "input"), ("y", y, "output"))}
        return Experiment(id, "bench", time, signals, unused=unused)

    marked = with_repeats({r.id: r for r in (run("a"), run("b", **output, **column))})
    assert (marked["b"].repeat_of == "a") is repeats


def test_slow_noise_is_neither_another_beginning_nor_another_condition():
    time, rng, runs = np.arange(200) * 0.01, np.random.default_rng(3), {}
    for pair in range(6):
        u = np.sin((5 + pair) * time)
        for k in "ab":
            slow = lfilter([0.1], [1.0, -0.95], rng.standard_normal(400))[200:]
            signals = {"u": Signal("u", u, "1", "input"), "y": Signal("y", u + slow, "1", "output")}
            T = Signal("T", 20.0 + 5.0 * rng.standard_normal() + np.sin(time), "degC", "input")
            runs[f"{pair}{k}"] = Experiment(f"{pair}{k}", "bench", time, signals, unused={"T": T})
    assert [r.repeat_of for r in with_repeats(runs).values() if r.id.endswith("b")] == [f"{k}a" for k in range(6)]


def test_runs_whose_clocks_differ_are_repeats(tmp_path):
    rng = np.random.default_rng(3)
    grid = np.arange(200) * 0.01
    course = np.sin(5 * grid)

    def run(id, time):
        y = course + 0.01 * rng.standard_normal(200)
        signals = {n: Signal(n, v, "1", c) for n, v, c in (("u", course, "input"), ("y", y, "output"))}
        return Experiment(id, "bench", time, signals)

    jitter = 0.01 * rng.uniform(-0.15, 0.15, 200)
    times = {
        "a": 0.3344 + grid,
        "later": np.round(1.4098 + grid, 4),
        "jitter": 7.0 + grid + jitter,
        "slower": 1.1 * grid,
        "longer": np.append(grid[:-1], 2.5),
    }
    marked = with_repeats({id: run(id, time) for id, time in times.items()})
    assert [r.repeat_of for r in marked.values()] == [None, "a", None, None, None]
    assert [r.repeat_of_reference for r in marked.values()] == [None, None, "a", None, None]
    write_measurements(Measurements(marked), tmp_path / "m.h5")
    assert read_measurements(tmp_path / "m.h5").repeats("a")[1].id == "later"
    both = replace(marked["slower"], repeat_of="a")
    with pytest.raises(MeasurementsError, match="repeats 'a' but its time axis differs"):
        write_measurements(Measurements({**marked, "slower": both}), tmp_path / "n.h5")
