"""Two resistors and a capacitor, from Modelica to the report: parameters that cannot be separated are reported with their combination."""

import json
from pathlib import Path

import numpy as np
import pytest

from fmuid import Experiment, Measurements, Signal, Task, load_fmu, write_measurements
from fmuid.cli.app import run

SOURCE = Path(__file__).parent / "models" / "TwoResistors.mo"
TRUTH = {"R1": 1e3, "R2": 2e3, "C": 1e-3}
FINDING = "R1, R2, C are not separately identifiable; only R1*C and R2*C"
TOML = """
[models.divider]
fmu = "TwoResistors.fmu"
[parameters]
R1 = {{ start = 800, lower = 10, upper = 1e5, unit = "Ohm" }}
R2 = {{ start = 2500, lower = 10, upper = 1e5, unit = "Ohm", scale = "log" }}
C = {{ start = 2e-3, lower = 1e-5, upper = 1, unit = "F", scale = "log"{more} }}
[stages.all]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("divider")
    assert run(["build", str(SOURCE), "TwoResistors", "--out", str(folder), "--quiet"]) == 0
    time = np.arange(401) * 0.02
    u = np.where(time < 4.0, 5.0, 1.0)
    (v,) = load_fmu(folder / "TwoResistors.fmu").simulate(Task(time, {"u": u}, ("v",)), TRUTH)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(v.size)
    signals = {"u": Signal("u", u, "V", "input"), "v": Signal("v", v + noise, "V", "output", 1e-3)}
    write_measurements(
        Measurements({"steps": Experiment("steps", "divider", time, signals)}), folder / "measurements.h5"
    )
    return folder


def test_the_combination_is_named_before_and_after_the_run(folder, capsys):
    (folder / "campaign.toml").write_text(TOML.format(more=""))
    assert run(["check", str(folder)]) == 0
    assert f"warning: [stages.all]: {FINDING}; fix one of them" in capsys.readouterr().out

    out = folder / "run"
    assert run(["identify", str(folder), "--out", str(out), "--workers", "0", "--quiet"]) == 0
    (stage,) = json.loads((out / "result.json").read_text())["stages"]
    assert FINDING in stage["warnings"]
    for estimate in stage["estimates"]:
        assert (estimate["standard_error"], estimate["interval"]) == (None, None)
    parameters = stage["parameters"]
    assert parameters["R1"] * parameters["C"] == pytest.approx(1.0, rel=5e-3)
    assert parameters["R2"] * parameters["C"] == pytest.approx(2.0, rel=5e-3)
    assert FINDING in (out / "report" / "index.html").read_text()


def test_with_one_of_them_known_the_others_are_determined(folder, capsys):
    (folder / "campaign.toml").write_text(TOML.format(more=", free = false").replace("2e-3", "1e-3"))
    assert run(["check", str(folder)]) == 0
    assert "identifiable" not in capsys.readouterr().out
    out = folder / "known"
    assert run(["identify", str(folder), "--out", str(out), "--workers", "0", "--quiet", "--no-report"]) == 0
    (stage,) = json.loads((out / "result.json").read_text())["stages"]
    for estimate in stage["estimates"]:
        low, high = estimate["interval"]
        assert low < TRUTH[estimate["name"]] < high
        assert high - low < 0.02 * low


def test_what_a_stage_is_asked_in_its_table_is_answered(folder):
    more = """criteria = [
      {{ signal = "v", to = 4.0, options = {{ name = "charging" }} }},
      {{ signal = "v", from = 4.0, options = {{ name = "discharging" }} }},
    ]
    profiles = true
    monte_carlo = 25
    pareto = {{ objectives = ["charging", "dis*"], points = 3 }}
    """
    text = TOML.replace("{more}", ", free = false").replace("2e-3", "1e-3") + more
    (folder / "campaign.toml").write_text(text.format())
    out = folder / "asked"
    assert run(["identify", str(folder), "--out", str(out), "--workers", "0", "--quiet"]) == 0
    (stage,) = json.loads((out / "result.json").read_text())["stages"]
    assert [p["name"] for p in stage["profiles"]] == ["R1", "R2"]
    assert [s["label"] for s in stage["spread"]] == ["steps: charging", "steps: discharging"]
    assert stage["front"]["objectives"] == ["charging", "dis*"]
    assert len(stage["front"]["points"]) >= 2  # the model is right: the objectives hardly compete
    page = (out / "report" / "index.html").read_text()
    for title in ("Pareto front: all", "Profiles: all", "Criteria over the uncertainty of the parameters"):
        assert title in page


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("monte_carlo = -1", "monte_carlo is -1; write a number of draws"),
        ("pareto = { points = 1 }", "pareto points is 1; write 2 to 1000"),
        ("pareto = { point = 3 }", "unknown key 'point'; did you mean 'points'?"),
    ],
)
def test_what_cannot_be_asked_is_one_line(folder, capsys, line, message):
    (folder / "campaign.toml").write_text(TOML.format(more="") + line + "\n")
    assert run(["check", str(folder)]) == 2
    assert message in capsys.readouterr().err
