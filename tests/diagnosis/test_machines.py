"""Several units of one model: a heated block of which each unit, or each run, has parameters of its own."""

import json
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import fmuid
from fmuid.cli.app import run
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements

SCHEMA = json.loads((files("fmuid.diagnosis") / "diagnosis.schema.json").read_text())
TIME = 2.0 * np.arange(200)
HEATING = {
    "steps": np.repeat([40.0, 0.0, 80.0, 20.0], 50),
    "sine": 50.0 + 45.0 * np.sin(2 * np.pi * TIME / 150.0),
    "pulses": 90.0 * (np.arange(200) // 20 % 3 == 0),
}
STEPS = {"steps": HEATING["steps"]}
BLOCK = """\
model Block "A heated block; T is above the room"
  parameter Real C(unit = "J/K") = 100, G(unit = "W/K") = 2, T0(unit = "K") = 0;
  parameter Real square(unit = "W/K2") = 0 "Loss that grows with the square, off by default";
  parameter Real draught(unit = "W") = 0, slope(unit = "W/K") = 0;
  input Real P(unit = "W");
  input Real port_loss(unit = "W", start = 0);
  output Real T(unit = "K");
initial equation
  T = T0;
equation
  C*der(T) = P - (G + slope)*T - square*T*abs(T) - draught - port_loss;
end Block;
"""
EFFECTS = """\
format = "fmuid-effects"
version = 1

[ports.loss]
input = "port_loss"
unit = "W"
magnitude = 0.5

[ports.heater]

[regimes.temperature]
variable = "T"
kind = "value"
unit = "K"

[effects.convection]
description = "The loss grows with the square of the temperature"
port = "loss"
trials = [{ square = 0.005 }, { square = 0.03 }]
[effects.convection.parameters]
square = { neutral = 0.0, lower = 0.0, upper = 1.0, step = 1e-4, unit = "W/K2" }

[effects.lag]
description = "The heater lags"
port = "heater"
trials = [{ "P.lag" = 2.0 }]
[effects.lag.parameters]
"P.lag" = { neutral = 0.0, lower = 0.0, upper = 60.0, step = 0.05, unit = "s" }
"""
CAMPAIGN = """\
[campaign]
name = "block"

[models.bench]
fmu = "Block.fmu"

[parameters.C]
start = 80
lower = 10
upper = 1000

[parameters.G]
start = 1.5
lower = 0.1
upper = 20
per = "machine"

[effects]
catalogue = "effects.toml"
"""


@pytest.fixture(scope="module")
def block(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("block")
    for name, text in {"Block.mo": BLOCK, "effects.toml": EFFECTS}.items():
        (folder / name).write_text(text)
    assert run(["build", str(folder / "Block.mo"), "Block", "--out", str(folder), "--quiet"]) == 0
    return folder


def course(u, *, C=100.0, G=2.0, square=0.0, start=0.0):
    """The temperature at every sample, by Runge-Kutta steps of a tenth of a second."""
    temperature, rows = start, []
    for power in u:
        rows.append(temperature)
        for _ in range(20):
            slopes = [0.0]
            for share in (0.0, 0.05, 0.05, 0.1):
                x = temperature + share * slopes[-1]
                slopes.append((power - G * x - square * x * abs(x)) / C)
            temperature += 0.1 / 6 * (slopes[1] + 2 * slopes[2] + 2 * slopes[3] + slopes[4])
    return np.array(rows)


def record(folder, machines, *, campaign=CAMPAIGN, repeats=3, seed=0, starts=None, inputs=HEATING):
    """Write runs of some units, by name and what is true of each, and their campaign."""
    rng, runs = np.random.default_rng(seed), {}
    for machine, truth in machines.items():
        for name, u in inputs.items():
            first = f"{name}_{machine}"
            clean = course(u, **truth, start=(starts or {}).get(first, 0.0))
            for k in range(repeats):
                id_ = f"{first}_r{k}" if k else first
                seen = clean + 0.05 * rng.standard_normal(len(u))
                signals = {"P": Signal("P", u, "W", "input"), "T": Signal("T", seen, "K", "output")}
                runs[id_] = Experiment(
                    id_, "bench", TIME, signals, repeat_of=first if k else None, machine=machine
                )
    folder.mkdir(exist_ok=True)
    write_measurements(Measurements(runs), folder / "measurements.h5")
    (folder / "campaign.toml").write_text(campaign)
    return folder


def diagnosed(folder, out, *more):
    """The JSON value of a diagnosis made on the command line."""
    assert run(["diagnose", str(folder), "--out", str(out), "--workers", "0", "--quiet", *more]) == 0
    answer = json.loads((out / "diagnosis.json").read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(answer)
    return answer


def beside(block, tmp_path):
    """A folder with the model and the catalogue."""
    for name in ("Block.fmu", "effects.toml"):
        (tmp_path / name).write_bytes((block / name).read_bytes())
    return tmp_path


UNITS = {"A": 1.6, "B": 2.0, "C": 2.6}
TIED = CAMPAIGN + 'tie = { slope = "0.1*G" }\n'


def test_each_unit_has_its_own_parameter_in_a_diagnosis_and_all_that_follows_from_it(block, tmp_path, capsys):
    truth = {m: {"G": 1.1 * g, "square": 0.02} for m, g in UNITS.items()}
    folder = record(beside(block, tmp_path), truth, campaign=TIED)
    answer = diagnosed(folder, tmp_path / "first")
    assert (answer["verdict"]["kind"], answer["verdict"]["effects"]) == ("effect", ["convection"])
    per_unit = {f"G@{m}": g for m, g in UNITS.items()} | {f"slope@{m}": 0.1 * g for m, g in UNITS.items()}
    assert answer["model"]["parameters"] == pytest.approx({"C": 100.0, "square": 0.02, **per_unit}, rel=0.02)
    assert answer["gap"]["corrected"] < 0.25 < 1.0 < answer["gap"]["nominal_refit"]
    assert answer["effects"][0]["parameters"]["square"]["standard_error"] < 1e-3

    told = {p["name"] for p in answer["machines"]["parameters"] if p["differs"]}
    assert told == {"G"}
    assert "Parameters of each machine" in (tmp_path / "first" / "index.html").read_text()

    # The corrected campaign starts from what each unit has, and so does what comes after it.
    corrected = tmp_path / "first" / "corrected"
    campaign = fmuid.load_campaign(corrected)
    assert campaign.parameters["G"].starts == pytest.approx(UNITS, rel=0.02)
    assert campaign.parameters["slope"].per == "machine"
    assert run(["identify", str(corrected), "--out", str(tmp_path / "run"), "--quiet", "--no-report"]) == 0
    result = fmuid.Result.from_json(tmp_path / "run")
    assert {m: result[f"G@{m}"].value for m in UNITS} == pytest.approx(UNITS, rel=0.02)
    again = fmuid.diagnose(tmp_path / "run").diagnosis
    assert again.verdict.kind == "complete"
    assert again.gap.nominal == pytest.approx(again.gap.nominal_refit, abs=0.1)

    # Other runs of these units, and of one that was not diagnosed.
    other = tmp_path / "other"
    record(other, {m: {"G": 2.2, "square": 0.02} for m in "BD"}, inputs=STEPS, seed=1)
    told = str(tmp_path / "first" / "diagnosis.json")
    assert (
        run(
            [
                "validate",
                told,
                "--measurements",
                str(other / "measurements.h5"),
                "--json",
                str(tmp_path / "v.json"),
            ]
        )
        == 0
    )
    scored = json.loads((tmp_path / "v.json").read_text())
    assert scored["gaps"]["steps_B"]["corrected"] < 0.3
    (note,) = scored["notes"]
    assert note.startswith("G has its start value in steps_D:")
    assert note in capsys.readouterr().out


def test_start_values_of_each_run_are_estimated_and_prove_no_effect(block, tmp_path):
    per_run = CAMPAIGN.replace('per = "machine"', "") + '[parameters.T0]\nstart = 0\nper = "experiment"\n'
    begin = {"steps_A": 3.0, "sine_A": -2.0, "pulses_A": 8.0}
    folder = record(beside(block, tmp_path), {"A": {}}, campaign=per_run, starts=begin)
    answer = fmuid.diagnose(folder).diagnosis
    assert answer.verdict.kind == "complete"
    truth = {"C": 100.0, "G": 2.0, **{f"T0@{run}": value for run, value in begin.items()}}
    assert answer.model == pytest.approx(truth, rel=0.02, abs=0.05)
    record(folder, {"A": {"square": 0.02}}, campaign=per_run, starts=begin)
    answer = fmuid.diagnose(folder).diagnosis
    assert answer.verdict.effects == ("convection",)
    assert answer.effects[0].closure.held_out > 0.9


SHARED = CAMPAIGN.replace('per = "machine"', "")


def differing(block, tmp_path, machines):
    """What a diagnosis says of units that are taken to be alike: which parameters differ, and its lines."""
    diagnosed = fmuid.diagnose(record(beside(block, tmp_path), machines, campaign=SHARED))
    answer = diagnosed.diagnosis.to_dict()
    jsonschema.Draft202012Validator(SCHEMA).validate(json.loads(json.dumps(answer, allow_nan=False)))
    lines = [line for line in str(diagnosed).splitlines() if "etween machines" in line]
    return answer, {p["name"]: p for p in answer["machines"]["parameters"]}, lines


@pytest.mark.parametrize(
    ("name", "verdict", "machines"),
    [
        ("square", "partial", {"A": {"square": 0.018}, "B": {"square": 0.02}, "C": {"square": 0.022}}),
        ("square", "unknown", {"A": {"square": 0.01}, "B": {"square": 0.02}, "C": {"square": 0.03}}),
        ("C", "", {m: {"square": 0.02, "C": c} for m, c in {"A": 98.0, "B": 100.0, "C": 102.0}.items()}),
    ],
)
def test_what_differs_between_units_is_told_from_what_does_not(block, tmp_path, name, verdict, machines):
    answer, parameters, lines = differing(block, tmp_path, machines)
    assert answer["verdict"]["kind"] in (verdict or answer["verdict"]["kind"])
    assert answer["machines"]["effects"] == ["convection"]
    assert [n for n, p in parameters.items() if p["differs"]] == [name]
    for machine, truth in machines.items():
        estimate = parameters[name]["machines"][machine]
        assert abs(estimate["value"] - truth[name]) < 5 * estimate["standard_error"] < 0.02 * truth[name]
    low, high = parameters[name]["next_machine"]
    values = [truth[name] for truth in machines.values()]
    assert low < min(values) < max(values) < high
    assert parameters[name]["spread"] == pytest.approx(np.std(values, ddof=1), rel=0.1)
    assert answer["machines"]["gap"] < 0.25 < answer["gap"]["corrected"]
    beside = " with convection in the model" if verdict == "unknown" else ""
    (line,) = lines
    assert line.startswith(f"Differs between machines{beside}: {name} (p < 0.001): ")


def test_units_that_are_alike_are_said_to_be(block, tmp_path):
    answer, parameters, lines = differing(block, tmp_path, {m: {"square": 0.02} for m in "AB"})
    assert answer["verdict"]["effects"] == ["convection"]
    assert {n: p["next_machine"] for n, p in parameters.items()} == dict.fromkeys(("C", "G", "square"))
    (line,) = lines
    assert line.startswith("Between machines: none of ")
    assert line.endswith(" differs beyond its uncertainty")
    alone = fmuid.diagnose(record(tmp_path, {"A": {}}, campaign=SHARED)).diagnosis
    assert "machines" not in alone.to_dict()
