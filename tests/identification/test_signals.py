"""Options of a signal in campaign.toml: derivatives of measured ones, and filters on both sides of a comparison."""

from pathlib import Path

import numpy as np
import pytest

import fmu_build
import fmuid
from fmuid.core.errors import CampaignError, MeasurementsError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.filtering import LowPass, derivative
from fmuid.data.measurements import write_measurements

MODELS = Path(__file__).parent / "models"
TRUTH = {"J": 0.8, "d": 2.0, "f": 3.0}
TOML = """
[signals.w]
derivative_of = "q"
filter = 12

[signals.a]
derivative_of = "q"
order = 2
filter = 12

[signals.tau]
filter = 12

[models.joint]
fmu = "{fmu}"
interpolation = "linear"

[parameters]
J = {{ start = 0.3, lower = 0.01, upper = 10 }}
d = {{ start = 1, lower = 0, upper = 10 }}
f = {{ start = 1, lower = 0, upper = 10 }}

[stages.all]
experiments = ["*"]
"""


@pytest.fixture(scope="module")
def inverse(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inverse")
    fmu = fmu_build.build(MODELS / "InverseJoint.mo", "InverseJoint", folder)
    generator, time = np.random.default_rng(3), np.arange(0.0, 10.0, 0.004)
    q = 40.0 * np.sin(2.0 * time) + 11.0 * np.sin(7.3 * time)  # deg
    w, a = (np.deg2rad(derivative(time, q, order)) for order in (1, 2))
    tau = TRUTH["J"] * a + TRUTH["d"] * w + TRUTH["f"] * np.tanh(w / 0.05)
    tau += 0.5 * generator.standard_normal(time.size) + 4.0 * np.sin(2 * np.pi * 50 * time)  # hum above the filter
    q += 0.01 * generator.standard_normal(time.size)
    signals = {"q": Signal("q", q, "deg", "output"), "tau": Signal("tau", tau, "N.m", "output", 0.5)}
    write_measurements(
        Measurements({"run": Experiment("run", "joint", time, signals)}), folder / "measurements.h5"
    )
    (folder / "campaign.toml").write_text(TOML.format(fmu=fmu.name))
    return folder


def test_an_inverse_model_is_identified_from_a_measured_motion(inverse):
    result = fmuid.identify(inverse)
    for name, truth in TRUTH.items():
        assert result[name].value == pytest.approx(truth, rel=0.02)
        assert abs(result[name].value - truth) < 4 * result[name].standard_error
    plain = inverse / "campaign.toml"
    without = inverse / "unfiltered.toml"
    without.write_text(plain.read_text().replace("filter = 12", ""))
    unfiltered = fmuid.identify(without)
    assert abs(unfiltered["J"].value / TRUTH["J"] - 1) > 0.2  # a noisy acceleration is nearly none


def test_what_is_filtered_is_the_prediction_as_well(inverse):
    campaign = fmuid.load_campaign(inverse)
    validation = fmuid.validate(TRUTH, campaign, experiments=["run"])
    score = validation["run", "tau"]
    assert score.rmse < 0.2  # the hum is gone on both sides; unfiltered it were 2.9
    time = campaign.measurements["run"].time
    assert score.noise_floor == pytest.approx(0.5 * LowPass(12.0).noise_gain(time))


def test_a_filter_halves_at_its_cutoff_without_phase():
    time = np.arange(0.0, 4.0, 1e-3)
    wave = np.sin(2 * np.pi * 20.0 * time)
    middle = slice(1000, 3000)
    np.testing.assert_allclose(LowPass(20.0)(time, wave)[middle], 0.5 * wave[middle], atol=1e-3)
    np.testing.assert_allclose(LowPass(200.0)(time, wave)[middle], wave[middle], atol=1e-3)
    noise = np.random.default_rng(0).standard_normal(200_000)
    filtered = LowPass(20.0)(np.arange(noise.size) * 1e-3, noise)
    assert np.std(filtered) == pytest.approx(LowPass(20.0).noise_gain(time), rel=0.03)


def test_missing_samples_stay_missing():
    time = np.arange(0.0, 1.0, 1e-3)
    wave = np.sin(7 * time)
    wave[300:305] = np.nan
    filtered = LowPass(50.0)(time, wave)
    assert np.flatnonzero(np.isnan(filtered)).tolist() == [300, 301, 302, 303, 304]
    np.testing.assert_allclose(filtered[310:900], np.sin(7 * time[310:900]), atol=1e-3)


def test_uneven_times_are_not_filtered():
    with pytest.raises(MeasurementsError, match="cannot be filtered"):
        LowPass(1.0)(np.array([0.0, 0.1, 0.2, 0.5]), np.ones(4))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('derivative_of = "q"\nfilter', 'derivative_of = "p"\nfilter', "'p' is not measured"),
        ("[signals.w]", "[signals.q]", "is measured already"),
        ("order = 2", "order = 3", "order is 3"),
        ("filter = 12", "filter = 0", "filter is 0"),
        ("filter = 12", "filter = 400", "does not fit samples"),
    ],
)
def test_options_that_make_no_sense_are_refused(inverse, old, new, message):
    wrong = inverse / "wrong.toml"
    wrong.write_text((inverse / "campaign.toml").read_text().replace(old, new, 1))
    with pytest.raises(CampaignError, match=message):
        fmuid.load_campaign(wrong)
