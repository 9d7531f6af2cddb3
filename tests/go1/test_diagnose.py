"""From law M1 to what a servo with more friction has."""

from __future__ import annotations

import json

import pytest

from fmuid.cli.app import run
from fmuid.diagnosis.summary import named
from tests.go1.test_identify import TRUTH, campaign_of


@pytest.mark.slow
def test_friction_under_load_is_named(tmp_path, pendulum_fmus):
    campaign = campaign_of(tmp_path, pendulum_fmus["PositionDriven"], "M3")
    assert run(["diagnose", str(campaign), "--out", str(tmp_path), "--workers", "0", "--quiet"]) == 0

    answer = json.loads((tmp_path / "diagnosis.json").read_text())
    names = {e["id"] for e in answer["effects"]}
    assert names & {"value@torque_gain", "value@q_offset"} == set()  # nominal in this campaign
    assert not answer["gap"]["calibrated"]
    # The campaign holds both shares at zero; the reading of the speed loses what is below its step.
    assert set(named(answer["verdict"])) == {"value@friction.K_e", "value@friction.K_m", "gain@w"}
    values = next(e for e in answer["effects"] if e["id"] == "value@friction.K_e")["parameters"]
    assert values["friction.K_e"]["value"] == pytest.approx(TRUTH["M3"]["K_e"], rel=0.01)
    assert answer["model"]["parameters"]["friction.K_m"] == pytest.approx(TRUTH["M3"]["K_m"], rel=0.01)
