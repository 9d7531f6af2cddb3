"""`fmuid check`: a campaign against its FMUs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements

Command = Callable[..., tuple[int, str, str]]


def edit(folder: Path, old: str, new: str) -> None:
    file = folder / "campaign.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_a_campaign_that_is_right(folder: Path, fmuid: Command) -> None:
    code, out, err = fmuid("check", folder, "--json", "found.json")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "bench: 3 runs (2 to identify, 1 to validate), 1 model, 2 parameters, 1 stage"
    assert [line.split()[:2] for line in lines[1:4]] == [["stage", "parameter"], ["all", "m"], ["all", "d"]]
    assert lines[4:6] == ["note: [models.oscillator]: input 'wind' is not driven; it stays at 0", "no errors"]
    assert lines[6:] == [f"next: fmuid identify {folder}  (values and standard errors)"]
    answer = json.loads(Path("found.json").read_text())
    assert answer["ok"] is True
    assert [f["level"] for f in answer["findings"]] == ["note"]
    mass = answer["effects"][0]
    assert (mass["stage"], mass["parameter"]) == ("all", "m")
    assert 5 < mass["change"] < 50  # 1 % of 1 kg moves the position by about 1 mm, ten times the noise
    assert 0 < mass["floor"] < 0.01 * mass["change"]
    assert 1e-7 < mass["step"] < 0.1


def test_quiet_prints_nothing(folder: Path, fmuid: Command) -> None:
    assert fmuid("check", folder, "--quiet") == (0, "", "")


def test_a_parameter_without_effect_is_an_error(folder: Path, fmuid: Command) -> None:
    edit(folder, "[settings]", "[parameters.spare]\nstart = 3.0\nlower = 1\nupper = 5\n[settings]")
    code, out, _ = fmuid("check", folder)
    assert code == 1
    assert (
        "error: [stages.all], parameter 'spare': does not affect any measured output; fix it, or add an experiment that excites it"
        in out
    )
    assert out.endswith("1 error\n")
    assert fmuid("check", folder, "--no-simulate")[0] == 0


def with_unit(measurements: Measurements, unit: str) -> Measurements:
    runs = {}
    for run in measurements:
        position = replace(run.signals["position"], unit=unit)
        runs[run.id] = replace(run, signals={**run.signals, "position": position})
    return Measurements(runs)


def test_parameters_that_only_count_together_are_named(
    folder: Path, measurements: Measurements, fmuid: Command
) -> None:
    write_measurements(with_unit(measurements, "mV"), folder / "measurements.h5")
    # y = gain x from rest: a gain as large again does what half of mass, damping and stiffness would.
    edit(folder, 'map = { position = "x" }', 'map = { position = "y" }\ninitial = { x = 0.0 }')
    edit(
        folder,
        "[settings]\nc = 90",
        "[parameters.c]\nstart = 90.0\nlower = 50\nupper = 200\n[parameters.gain]\nstart = 1.0\nlower = 0.1\nupper = 9",
    )
    code, out, _ = fmuid("check", folder)
    assert code == 0
    (warning,) = [line for line in out.splitlines() if line.startswith("warning: [stages.all]")]
    assert "m, d, c, gain are not separately identifiable; only " in warning


def test_what_the_recording_lacks(folder: Path, measurements: Measurements, fmuid: Command) -> None:
    step = measurements["step"]
    time = step.time.copy()
    time[100:] += 1.0
    nothing = Signal("y", np.full(time.size, np.nan), "V", "output")
    flat = Signal("v", np.full(time.size, 15.0), "m/s", "output")
    other = Signal("temperature", 20 + time, "degC", "output")
    signals = {**step.signals, "y": nothing, "v": flat, "temperature": other}
    runs: dict[str, Experiment] = {**measurements.experiments, "step": replace(step, time=time, signals=signals)}
    write_measurements(Measurements(runs), folder / "measurements.h5")
    code, out, _ = fmuid("check", folder, "--no-simulate")
    assert code == 1
    assert out.splitlines()[1:-1] == [
        "note: setup 'oscillator': output 'temperature' is not in Oscillator.fmu, so it is not compared; name its variable in [models.oscillator] map if it is",
        "note: [models.oscillator]: input 'wind' is not driven; it stays at 0",
        "warning: experiment 'step': a gap of 1 s at 0.495 s where 0.005 s is usual; cut the run there, or leave the gap if the input was constant",
        "error: experiment 'step', signal 'y': every sample is missing; remove the signal",
        "warning: experiment 'step', signal 'v': is constant at 15; check the sensor",
        "warning: experiment 'step': its noise is unknown: one run and no sigma; give it (--sigma of fmuid init and import), or repeat the run",
    ]


WRONG = {
    "no_fmu_file": ("Oscillator.fmu", "Oscilator.fmu", "{fmu}: no such file; build it (make fmus, or fmuid build) or correct [models.oscillator] fmu"),
    "no_fmu": ('fmu = "{fmu}"', 'fmu = "measurements.h5"', "{folder}/measurements.h5: is not a readable FMU (File is not a zip file); check the file"),
    "no_output": ('position = "x"', 'position = "xx"', "experiment 'step', signal 'position': Oscillator.fmu has no variable 'xx'; did you mean 'x'?"),
    "no_parameter": ("[parameters.d]", "[parameters.damping]", "[parameters.damping]: Oscillator.fmu has no variable 'damping'; known: m, d, c, gain, spare, mode"),
    "near_parameter": ("[parameters.d]", "[parameters.D]", "[parameters.D]: Oscillator.fmu has no variable 'D'; did you mean 'd'?"),
    "no_setting": ("c = 90", "cc = 90", "[settings]: no FMU has a variable 'cc'; did you mean 'c'?"),
    "no_initial": ("[parameters.m]", "[models.oscillator.initial]\nxx = 1\n[parameters.m]", "[models.oscillator] initial: Oscillator.fmu has no variable 'xx'; did you mean 'x'?"),
    "set_output": ("c = 90", "y = 90", "[settings] 'y': 'y' of Oscillator.fmu cannot be set (an output); known: m, d, c, gain, spare, mode, u, wind"),
    "input_is_output": ("map = {{ ", 'map = {{ u = "y", ', "experiment 'step', signal 'u': 'y' is an output of Oscillator.fmu, not an input; did you mean 'u'?"),
    "output_is_parameter": ('position = "x"', 'position = "m"', "experiment 'step', signal 'position': 'm' is a parameter of Oscillator.fmu, not a prediction; known: x, y"),
    "whole_number": ("[parameters.d]", "[parameters.mode]", "[parameters.mode]: 'mode' of Oscillator.fmu is Integer, not a real number; set it in [settings]"),
    "unit_of_parameter": ('unit = "kg"', 'unit = "N"', "[parameters.m]: 'N' cannot be converted to 'kg' of variable 'm'; they measure different things ([mass] * [length] / [time] ** 2 and [mass])"),
    "unknown_unit": ('unit = "kg"', 'unit = "kilo"', "[parameters.m]: unit 'kilo' is unknown; write it as in 'N.m' or 'kg.m2/s'"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("command", ["check", "simulate"])
def test_what_an_fmu_lacks_is_one_line(
    name: str, command: str, folder: Path, oscillator: Path, fmuid: Command
) -> None:
    old, new, line = WRONG[name]
    edit(folder, old.format(fmu=oscillator), new.format(fmu=oscillator))
    before = sorted(folder.parent.rglob("*"))
    code, out, err = fmuid(command, "bench")
    assert (code, out) == (2, "")
    missing = oscillator.with_name("Oscilator.fmu")
    assert err == f"fmuid: {line.format(fmu=missing, folder=folder)}\n"
    assert sorted(folder.parent.rglob("*")) == before


def test_a_wrong_unit_of_a_signal(folder: Path, measurements: Measurements, fmuid: Command) -> None:
    write_measurements(with_unit(measurements, "N.m"), folder / "measurements.h5")
    code, out, err = fmuid("check", folder)
    assert (code, out) == (2, "")
    assert (
        err
        == "fmuid: experiment 'step', signal 'position': 'N.m' cannot be converted to 'm' of variable 'x'; they measure different things ([mass] * [length] ** 2 / [time] ** 2 and [length])\n"
    )
