"""Logs of a known servo, through the reader and the command line: the friction that made them comes back."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.rival_stages import main as compare_stages
from benchmarks.rival_stages import rivals_of
from campaigns.go1.convert import main as read_logs
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.cli.app import run
from fmuid.identification.result import Result
from tests.conftest import MODELICA, ROOT
from tests.go1.logs import TRAJECTORIES, simulated_log, write

CAMPAIGN = ROOT / "campaigns" / "go1" / "campaign.toml"
RIG = {"J_R": 1.5e-4, "r_g": 0.025, "torque_gain": 0.96, "q_offset": 0.006}
TRUTH = {
    "M1": {**RIG, "K_v": 0.03, "K_c": 0.13},
    "M3": {**RIG, "K_v": 0.03, "K_c": 0.12, "K_e": 0.04, "K_m": 0.04},
}


def campaign_of(folder: Path, fmu: Path, law: str) -> Path:
    """Write the campaign with logs of a servo that has the friction of `law`, 0 to 3 kg."""
    names = tomllib.loads(CAMPAIGN.read_text())["models"]["position_driven"]["map"]
    truth = {names.get(n, n): v for n, v in TRUTH[law].items()}
    logs = [simulated_log(fmu, mass, t, truth) for mass in (0.0, 1.0, 2.0, 3.0) for t in TRAJECTORIES]
    campaign = folder / "campaign"
    assert read_logs([str(campaign), str(write(folder / "logs", *logs))]) == 0
    text = CAMPAIGN.read_text().replace("../../build/fmus/PositionDriven.fmu", str(fmu))
    text = text.replace("../../modelica", str(MODELICA))
    (campaign / "campaign.toml").write_text(text.replace("starts = 3", "starts = 1"))
    return campaign


@pytest.mark.parametrize("law", TRUTH)
def test_the_friction_law_comes_back(tmp_path, pendulum_fmus, law):
    campaign = campaign_of(tmp_path, pendulum_fmus["PositionDriven"], law)
    stages = ["--stage", "M1", "--stage", "M3"]
    out = tmp_path / "run"
    assert run(["identify", str(campaign), *stages, "--out", str(out), "--no-report", "--quiet"]) == 0

    result = Result.from_json(out)
    stage = result.stage(law)
    for estimate in stage.estimates:
        truth = TRUTH[law][estimate.name]
        tolerance = {"q_offset": 3e-4, "r_g": 2e-3}.get(estimate.name, 0.03 * truth)
        assert estimate.value == pytest.approx(truth, abs=tolerance), estimate.name
    kept = {r.stage: r for r in rivals_of(result, load_campaign(campaign), "q")}
    assert kept[law].mean_kept < 1e-3
    assert list(kept["M1"].kept) == [f"m3_{t}" for t in sorted(TRAJECTORIES)]
    if law == "M1":  # the larger law finds nothing more
        assert result.stage("M3")["K_e"].value < 1e-3
        assert abs(kept["M3"].gain) < 1e-4
    else:
        assert kept["M3"].gain > 0.5 * kept["M1"].mean_kept
        assert kept["M3"].interval[0] > 0.0
        assert kept["M1"].interval == (0.0, 0.0)


def test_stages_are_compared_from_the_command_line(tmp_path, pendulum_fmus, capsys):
    campaign = campaign_of(tmp_path, pendulum_fmus["PositionDriven"], "M3")
    out = tmp_path / "run"
    quick = ["--evaluations", "5", "--no-report", "--quiet"]
    assert run(["identify", str(campaign), "--stage", "M1", "--stage", "M3", "--out", str(out), *quick]) == 0
    capsys.readouterr()

    assert compare_stages([str(out), "q"]) == 0
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines()[1:3]] == ["M1", "M3"]
    table = np.genfromtxt(
        out / "rivals-M1" / "rivals.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    assert table["parameters"].tolist() == [6, 7]
    assert (out / "rivals-M1" / "rivals.png").stat().st_size > 10_000
    assert compare_stages([str(out), "q", "M3"]) == 0
    assert len(capsys.readouterr().out.splitlines()[1].split()) == len(table.dtype.names)
    assert compare_stages([str(out), "q", "M9"]) == 2
    assert "no stage 'M9'; it has M1, M3" in capsys.readouterr().err
    assert compare_stages([str(out), "torque"]) == 2
    assert "does not measure 'torque'" in capsys.readouterr().err
    assert compare_stages([str(tmp_path / "nowhere"), "q"]) == 2


def test_each_stage_frees_the_parameters_of_its_law():
    stages = tomllib.loads(CAMPAIGN.read_text())["stages"]
    law_of = {name: set(stage["free"]) | set(stage.get("tie", {})) for name, stage in stages.items()}
    rig = {"J_R", "r_g", "torque_gain", "q_offset"}
    stribeck = {"K_cs", "w_s", "alpha"}
    m1 = rig | {"K_v", "K_c"}
    directional = {"K_m", "K_e", "K_ms", "K_es"}
    expected = {
        **{"M1": m1, "M2": m1 | stribeck, "M3": m1 | {"K_e", "K_m"}, "M4": m1 | stribeck | directional},
        **{"M5": m1 | stribeck | directional, "M6": m1 | stribeck | directional | {"K_mq", "K_eq"}},
    }
    for law, names in expected.items():
        assert law_of[law] == law_of[f"{law}_absolute"] == names, law
    assert stages["M3"]["tie"] == {"K_m": "K_e"}
