"""A model that is exact enough for its user, and noise that only seems to be a gap."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plants import plant

import fmuid
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.core.errors import CampaignError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.diagnosis.cross_validation import draw_noise
from fmuid.diagnosis.decide import tolerances, tolerated
from fmuid.diagnosis.diagnose import diagnose_subject
from fmuid.diagnosis.observed import Observed, excess
from fmuid.diagnosis_pipeline import answer_of
from fmuid.identification.problem.cases import from_campaign
from fmuid.simulation.coupled.loading import load_simulator
from fmuid.simulation.simulator import Task

RIGS = Path(__file__).parents[1] / "fmu_build" / "models" / "Rigs.mo"
CAMPAIGN = f"""
[campaign]
name = "rig"
[models.rig]
source = "{RIGS}"
class = "Rigs.Block"
[parameters."wall.G"]
start = 2.0
lower = 1.0
upper = 4.0
"""
TIME = np.arange(300) * 10.0
SIGMA = 0.05  # K


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A complete model with single runs in kelvin, whose slow noise looks like a gap."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        folder = tmp_path_factory.mktemp("rig")
        (folder / "campaign.toml").write_text(CAMPAIGN)
        rng, runs = np.random.default_rng(4), {}
        empty = Experiment("e", "rig", TIME, {"T": Signal("T", TIME, "K", "output")})
        write_measurements(Measurements({"e": empty}), folder / "measurements.h5")
        simulator = load_simulator(load_campaign(folder).models["rig"])
        keep = np.exp(-1.0 / 20.0)
        for k in range(4):
            power = 300.0 * (1.0 + k) * (np.sin((3.0 + k) * 1e-3 * TIME) > 0.0)
            (course,) = simulator.simulate(Task(TIME, {"P": power}, ("T",)), {"wall.G": 2.3})
            slow = np.zeros(TIME.size)
            for i in range(1, TIME.size):
                slow[i] = keep * slow[i - 1] + np.sqrt(1.0 - keep**2) * SIGMA * rng.standard_normal()
            signals = [Signal("P", power, "W", "input"), Signal("T", course + slow, "K", "output")]
            runs[f"e{k}"] = Experiment(f"e{k}", "rig", TIME, {s.name: s for s in signals})
        write_measurements(Measurements(runs), folder / "measurements.h5")
        yield load_campaign(folder)


def test_slow_noise_within_the_tolerance_is_a_complete_model(campaign):
    diagnosed = fmuid.diagnose(campaign, law=False, tolerance={"T": "60 mK"})
    answer = diagnosed.diagnosis.to_dict()
    assert (answer["verdict"]["kind"], answer["verdict"]["within_tolerance"]) == ("complete", True)
    (error,) = answer["tolerated"]
    assert (error["signal"], error["unit"], error["tolerance"]) == ("T", "K", pytest.approx(0.06))
    assert 0.5 * SIGMA < error["error"] < 0.06
    none = next(a for a in answer["answers"] if a["effects"] == ["none"])
    assert none["probability"] == pytest.approx(error["probability"])
    assert "Complete to within the tolerance" in str(diagnosed)
    assert "K beyond the noise (0.06 K tolerated)" in str(diagnosed)
    poorly_determined = tuple({"wall.G": 3.0} for _ in diagnosed.nominal.left_out)  # by the other runs alone
    judged = tolerated(diagnosed.subject, replace(diagnosed.nominal, left_out=poorly_determined))
    assert judged == diagnosed.diagnosis.tolerated


def test_values_far_from_where_they_started_are_told(campaign):
    """A conductance of twice the model's may stand in for a loss that the model lacks; 2.3 fits these runs."""
    diagnosed = fmuid.diagnose(campaign, law=False, tolerance={"T": "60 mK"})
    (wall,) = diagnosed.subject.nominal
    for start, told in ((1.0, True), (1.3, False), (4.4, False), (5.0, True), (0.0, False)):
        subject = replace(diagnosed.subject, nominal=(replace(wall, start=start),))
        notes = answer_of(replace(diagnosed, subject=subject))["notes"]
        assert any(f"where they started: wall.G = 2.3 (start {start:.4g})" in note for note in notes) is told


def test_a_smaller_tolerance_is_exceeded(campaign):
    answer = fmuid.diagnose(campaign, law=False, tolerance={"T": 0.02}).diagnosis.to_dict()
    assert answer["verdict"]["kind"] != "complete"
    assert answer["tolerated"][0]["probability"] < 0.5


def test_how_a_tolerance_is_stated(campaign):
    simulator = load_simulator(campaign.models["rig"])
    cases = from_campaign(campaign, list(campaign.measurements), (), {"rig": simulator})
    span = max(np.ptp(e.signals["T"].values) for e in campaign.measurements)
    stated = {"0.2": 0.2, "200 mK": 0.2, "0.2degC": 0.2, "5%": 0.05 * span}
    for text, value in stated.items():
        assert tolerances({"T": text}, cases)["T"] == pytest.approx(value)
    for name, text, told in (
        ("S", "1", "tolerance of 'S': the runs have no output 'S'"),
        ("T", "-1", "tolerance of 'T': '-1' is not a positive number"),
        ("T", "1 V", "tolerance of 'T': 'V' cannot be converted to 'K'"),
    ):
        with pytest.raises(CampaignError, match=told):
            tolerances({name: text}, cases)


def test_a_model_that_is_exact_enough_in_the_only_experiment_is_complete():
    subject = plant({"tilt": 0.05}, experiments=("sine",), repeats=3)
    verdict = diagnose_subject(subject).diagnosis.verdict
    assert (verdict.kind, verdict.provisional) == ("effect", True)
    verdict = diagnose_subject(replace(subject, tolerances={"x": 0.1, "v": 0.1})).diagnosis.verdict
    assert (verdict.kind, verdict.within_tolerance) == ("complete", True)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("size", [2.0, 20.0])
def test_rounding_of_single_runs_is_no_gap(noise, size):
    """A complete model, whose slow signal is rounded to whole numbers after the noise."""
    rng, time = np.random.default_rng(1), np.arange(300.0)
    courses = [size * (np.sin(time / (24 + 3 * k)) + 0.3 * np.sin(time / 6 + k))[None] for k in range(6)]
    rounded = [np.round(y + noise * rng.standard_normal(y.shape))[None] for y in courses]
    runs = [RepeatedRuns(f"e{k}", "s", time, ("y",), values) for k, values in enumerate(rounded)]
    observed = replace(Observed.from_runs(runs), predicted=tuple(courses))
    residuals = observed.residuals(courses)
    null = draw_noise(observed, tuple(courses)).null(np.zeros((1800, 0)), [])
    assert null.p_value(excess(residuals, observed)) > 0.05
    far = observed.residuals([y + 2.0 * np.sin(time / 15) for y in courses])
    assert null.p_value(excess(far, observed)) < 1e-3
