"""Diagnoses of a plant that runs away open loop: its runs are predicted in segments, as the campaign's stage does."""

import json
import math
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from test_machines import SCHEMA

import fmu_build
import fmuid
from fmuid.cli.app import run
from fmuid.core.errors import CampaignError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.design.rivals import design_for_diagnosis
from fmuid.diagnosis.cross_validation import draw_noise
from fmuid.diagnosis.observed import Observed, excess
from fmuid.diagnosis.subject import subject_of
from fmuid.simulation.coupled.loading import load_simulator
from fmuid.simulation.segmented import Segmented
from tests.conftest import as_a_user_builds

STEP, J, MGL, D = 0.005, 0.02, 0.6, 0.01
MODEL = """\
model Held "A pendulum that a torque balances"
  parameter Real J(unit = "kg.m2") = 0.03, mgl(unit = "N.m") = 0.4, d(unit = "N.m.s/rad") = 0.005;
  parameter Real coulomb(unit = "N.m") = 0, drag(unit = "N.m.s2/rad2") = 0 "Off by default";
  input Real tau(unit = "N.m");
  input Real port_bearing(unit = "N.m", start = 0);
  output Real phi(start = 0, fixed = true, unit = "rad") "Angle from the upright";
  Real w(start = 0, fixed = true, unit = "rad/s");
equation
  der(phi) = w;
  J*der(w) = tau + mgl*sin(phi) - d*w - coulomb*tanh(w/0.02) - drag*w*abs(w) - port_bearing;
end Held;
"""
EFFECTS = """\
format = "fmuid-effects"
version = 1
[ports.bearing]
input = "port_bearing"
unit = "N.m"
magnitude = 0.002
[ports.angle]
output = "phi"
unit = "rad"
magnitude = 0.001
[regimes.speed]
variable = "w"
kind = "speed"
unit = "rad/s"
[effects.coulomb]
description = "Dry friction of the bearing"
port = "bearing"
trials = [{ coulomb = 0.002 }, { coulomb = 0.01 }]
[effects.coulomb.parameters]
coulomb = { neutral = 0.0, lower = 0.0, upper = 0.5, step = 1e-4, unit = "N.m" }
[effects.drag]
description = "Air drag"
port = "bearing"
trials = [{ drag = 0.001 }, { drag = 0.01 }]
[effects.drag.parameters]
drag = { neutral = 0.0, lower = 0.0, upper = 0.5, step = 1e-4, unit = "N.m.s2/rad2" }
[effects.scale]
description = "The angle is out of scale"
port = "angle"
two_sided = true
trials = [{ "phi.gain" = 1.03 }]
[effects.scale.parameters]
"phi.gain" = { neutral = 1.0, lower = 0.5, upper = 2.0, step = 1e-3, unit = "1" }
"""
CAMPAIGN = """\
[campaign]
name = "held"
[models.plant]
fmu = "Held.fmu"
[parameters]
J = { start = 0.03, lower = 0.002, upper = 0.2 }
mgl = { start = 0.4, lower = 0.05, upper = 5.0 }
d = { start = 0.005, lower = 1e-4, upper = 0.5 }
[roles]
validation = ["last"]
[stages.all]
segments = "auto"
[effects]
catalogue = "effects.toml"
"""


def balanced(seed, coulomb, duration=4.0, noise=1e-3):
    """Torque and measured angle of a pendulum under a sampled controller that follows a reference."""
    rng, h = np.random.default_rng(seed), STEP / 10
    time = np.arange(0.0, duration, STEP)
    reference = (0.25 * np.sin(2.1 * time + seed) + 0.15 * np.sin(5.3 * time)).tolist()
    phi, w, last, torque, angle = 0.05, 0.0, 0.05, [], []

    def bent(phi, w, tau):
        return (tau + MGL * math.sin(phi) - D * w - coulomb * math.tanh(w / 0.02)) / J

    for wanted, error in zip(reference, (noise * rng.standard_normal(time.size)).tolist(), strict=True):
        seen = phi + error
        tau = max(-2.0, min(2.0, -1.6 * (seen - wanted) - 0.12 * (seen - last) / STEP * bool(angle)))
        last = seen
        torque.append(tau)
        angle.append(seen)
        for _ in range(10):  # Runge-Kutta steps
            w1, a1 = w, bent(phi, w, tau)
            w2, a2 = w + h / 2 * a1, bent(phi + h / 2 * w1, w + h / 2 * a1, tau)
            w3, a3 = w + h / 2 * a2, bent(phi + h / 2 * w2, w + h / 2 * a2, tau)
            w4, a4 = w + h * a3, bent(phi + h * w3, w + h * a3, tau)
            phi, w = phi + h / 6 * (w1 + 2 * w2 + 2 * w3 + w4), w + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return time, np.array(torque), np.array(angle)


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    folder = tmp_path_factory.mktemp("held")
    (folder / "Held.mo").write_text(MODEL)
    with as_a_user_builds():
        fmu_build.build(folder / "Held.mo", "Held", folder)
    return folder


def recorded(held, folder, *, coulomb=0.0, seed=0, stage='segments = "auto"'):
    """A campaign of two runs to identify with and one for validation."""
    runs = {}
    for k, name in enumerate(("first", "second", "last")):
        time, torque, angle = balanced(100 * seed + k, coulomb)
        signals = {
            "tau": Signal("tau", torque, "N.m", "input"),
            "phi": Signal("phi", angle, "rad", "output", sigma=1e-3),
        }
        runs[name] = Experiment(name, "plant", time, signals)
    write_measurements(Measurements(runs), folder / "measurements.h5")
    (folder / "effects.toml").write_text(EFFECTS)
    (folder / "Held.fmu").write_bytes((held / "Held.fmu").read_bytes())
    (folder / "campaign.toml").write_text(CAMPAIGN.replace('segments = "auto"', stage))
    return folder


def test_a_complete_model_of_a_plant_that_runs_away_is_called_complete(held, tmp_path):
    diagnosed = fmuid.diagnose(recorded(held, tmp_path))
    answer = diagnosed.diagnosis
    assert answer.verdict.kind == "complete"
    assert answer.gap.p_value > 0.01
    assert answer.model == pytest.approx({"J": J, "mgl": MGL, "d": D}, rel=0.05)
    assert "Runs of setup 'plant' are predicted in 20 segments, whose 40 initial states are fitted as well." in (
        answer.notes
    )
    # The rest is that of noise after a fit of parameters and states.
    fit, observed = diagnosed.nominal.fit, diagnosed.subject.observed
    free = sum(float(np.sum(1.0 - t)) for t in observed.taken)
    assert free == pytest.approx(2 * 800 - 40, abs=1e-6)
    assert sum(float(r @ r) for r in fit.residuals) / free == pytest.approx(1.0, abs=0.1)
    campaign = fmuid.load_campaign(tmp_path)
    with pytest.raises(CampaignError, match="cut into segments"):
        design_for_diagnosis(campaign, diagnosed.subject, [])
    with pytest.raises(CampaignError, match="cut into segments"):
        fmuid.diagnose(campaign, rehearse=1)


def test_friction_that_the_model_lacks_is_named_and_the_corrected_model_predicts_other_runs(
    held, tmp_path, capsys
):
    folder, out = recorded(held, tmp_path, coulomb=0.006), tmp_path / "out"
    assert run(["diagnose", str(folder), "--out", str(out), "--workers", "0"]) == 0
    assert "Verdict: Coulomb is missing at bearing" in capsys.readouterr().out
    answer = json.loads((out / "diagnosis.json").read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(answer)
    assert (answer["verdict"]["kind"], answer["verdict"]["effects"]) == ("effect", ["coulomb"])
    best = answer["effects"][0]["parameters"]["coulomb"]
    assert abs(best["value"] - 0.006) < 4 * best["from_noise"] < 0.003
    assert run(["validate", str(out / "diagnosis.json"), "--json", str(tmp_path / "v.json")]) == 0
    gaps = json.loads((tmp_path / "v.json").read_text())["gaps"]["last"]
    assert gaps["corrected"] < 0.3 < 0.5 < gaps["nominal"]
    assert 'segments = "auto"' in (out / "corrected" / "campaign.toml").read_text()


def test_runs_of_a_stage_with_an_observer_are_cut_into_segments_and_that_is_said(held, tmp_path):
    campaign = fmuid.load_campaign(recorded(held, tmp_path, stage="observer = true"))
    subject = subject_of(campaign, load_simulator)
    assert all(isinstance(case.simulator, Segmented) for case in subject.model.cases)
    (finding,) = subject.findings
    assert finding.endswith("fitted as well; stage 'all' has an observer instead.")


def test_a_model_that_cannot_be_started_anew_is_predicted_whole_and_that_is_said(held, tmp_path):
    folder = recorded(held, tmp_path)
    calculated = MODEL.replace("phi(start = 0, fixed = true,", "phi(")
    (folder / "Held.mo").write_text(calculated.replace("equation\n", "initial equation\n  phi = 0;\nequation\n"))
    fmu_build.build(folder / "Held.mo", "Held", folder)
    subject = subject_of(fmuid.load_campaign(folder), load_simulator)
    assert not any(isinstance(case.simulator, Segmented) for case in subject.model.cases)
    assert any("predicted whole, not as stage 'all' does" in finding for finding in subject.findings)


def test_noise_beside_nuisances_is_expected_to_be_less_by_their_number():
    rng = np.random.default_rng(0)
    time = 0.01 * np.arange(200)
    runs = [
        RepeatedRuns(f"e{k}", "bench", time, ("y",), rng.standard_normal((1, 1, 200)), np.ones(1))
        for k in range(20)
    ]
    plain = Observed.from_runs(runs)
    bases = tuple(np.linalg.qr(rng.standard_normal((200, 60)))[0] for _ in runs)
    observed = replace(plain, nuisances=bases)
    residuals = observed.residuals([np.zeros((1, 200))] * 20)
    null = draw_noise(observed).null(np.zeros((4000, 0)), ())
    assert abs(np.mean(null.excess)) < 0.2 * np.std(null.excess)
    assert abs(excess(residuals, observed)) < 3.0 * np.std(null.excess)
    assert excess(residuals, plain) < -0.2
