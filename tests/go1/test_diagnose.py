"""From law M1 to what a servo with more friction has."""

from __future__ import annotations

import json

import pytest

from fmuid.cli.app import run
from fmuid.diagnosis.summary import named
from tests.go1.test_identify import CAMPAIGN, campaign_of


@pytest.mark.slow
def test_friction_under_load_is_named(tmp_path, pendulum_fmus):
    campaign = campaign_of(tmp_path, pendulum_fmus["PositionDriven"], "M3")
    file = campaign / "campaign.toml"
    catalogue = (CAMPAIGN.parent / "../../modelica/Pendulum/effects.toml").resolve()
    file.write_text(file.read_text().replace("../../modelica/Pendulum/effects.toml", str(catalogue)))
    assert run(["diagnose", str(campaign), "--out", str(tmp_path), "--workers", "0", "--quiet"]) == 0

    answer = json.loads((tmp_path / "diagnosis.json").read_text())
    names = {e["id"] for e in answer["effects"]}
    assert names & {"torque_gain", "encoder_offset"} == set()  # nominal in this campaign
    assert answer["verdict"]["port"] == "friction"
    assert {"load_friction", "directional_friction"} & set(named(answer["verdict"]))
    assert not answer["gap"]["calibrated"]
