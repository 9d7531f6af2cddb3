"""What the sensors make of a run, and what becomes of a measurement plan."""

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.virtual_rig import Channel, Rig, Sensors, record
from benchmarks.virtual_rig.__main__ import main
from benchmarks.virtual_rig.inputs import binary_sequence
from benchmarks.virtual_rig.rig_plan import carry_out, load_plan
from fmuid.core.errors import CampaignError
from tests.rig.rigs import constant, held, ramped

CAMPAIGN = Path(__file__).parents[2] / "campaigns" / "force_feedback"
PLAN = """
[rig]
seed = 1
repeats = 3
loss_table = [[0, 1, 1, 0.09, 0.09]]
[rig.sensors]
torque_offset = 0.05
[experiments.turning]
setup = "eccentric_load"
duration = 2.0
interval = 0.01
settings = { mgr = 25.0, J_L = 0.5 }
input = { kind = "polyline", times = [0, 0.5], values = [0, 10] }
"""
STEP = """
[experiments.step]
setup = "fixed_shaft"
duration = 0.1
interval = 1e-3
input = { kind = "step", amplitude = 0.5, at = 0.01 }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(PLAN)
    return tmp_path


def test_noise_is_as_large_as_the_file_says() -> None:
    rig = constant().changed(J_L=0.5, mgr=25.0)
    run = rig.run("eccentric_load", ramped(10, 3000, 0.01), 0.01)
    signals = record(run, Sensors(torque_drift=0.05, torque_offset=0.0), np.random.default_rng(0))
    exact = {
        "tau_sensor": run[Channel.TAU_SENSOR],
        "i_motor": run[Channel.I_MOTOR],
        "phi_load": run[Channel.PHI_LOAD],
        "w_motor": np.gradient(run[Channel.THETA], 0.01),
    }
    for name, values in exact.items():
        error = signals[name].values - values
        assert np.std(error) == pytest.approx(signals[name].sigma, rel=0.15), name
    assert signals["w_ref"].causality == "input"


def test_speed_comes_in_half_counts_of_the_encoder() -> None:
    run = constant().run("fixed_shaft", held(0.5, 100), 1e-3)
    speed = record(run, Sensors(), np.random.default_rng(0))["w_motor"].values
    counts = speed / (2 * np.pi / 16384 / 2e-3)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)


def test_repeats_share_the_motion_but_not_the_noise(folder: Path) -> None:
    measured = carry_out(load_plan(folder))
    assert list(measured.experiments) == ["turning", "turning_r1", "turning_r2"]
    assert measured["turning_r2"].repeat_of == "turning"
    assert measured["turning"].settings == {"mgr": 25.0, "J_L": 0.5}
    torques = np.array([e.signals["tau_sensor"].values for e in measured])
    offsets = torques.mean(axis=1) - torques.mean()
    assert 0.005 < np.ptp(offsets) < 0.3
    assert np.std(torques[0] - torques[1]) == pytest.approx(0.1 * np.sqrt(2), rel=0.2)


def test_another_experiment_leaves_the_recorded_ones_as_they_were(folder: Path) -> None:
    before = carry_out(load_plan(folder))
    (folder / "rig.toml").write_text(PLAN.replace("[experiments.turning]", STEP + "\n[experiments.turning]"))
    after = carry_out(load_plan(folder))
    for name in before.experiments:
        for signal, value in before[name].signals.items():
            assert np.array_equal(value.values, after[name].signals[signal].values)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("torque_offset", "torque_ofset", "torque_offset"),
        ("polyline", "polylin", "polyline"),
        ("eccentric_load", "excentric_load", "eccentric_load"),
        ("mgr = 25.0", "mgrr = 25.0", "no parameter 'mgrr'"),
        ("[[0, 1, 1, 0.09, 0.09]]", "[[0, 1, 1, 0.09]]", "rows of five"),
    ],
)
def test_a_mistake_in_the_plan_is_one_line_and_leaves_no_file(folder, capsys, old, new, says) -> None:
    (folder / "rig.toml").write_text(PLAN.replace(old, new))
    assert main([str(folder)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not (folder / "measurements.h5").exists()


def test_an_unknown_parameter_is_refused() -> None:
    with pytest.raises(CampaignError, match="no parameter 'd_s'"):
        Rig(np.array([[0.0, 1, 1, 0, 0]]), {"d_s": 1.0})


def test_the_binary_sequence_has_maximal_length() -> None:
    bits = binary_sequence(9)
    assert len(bits) == 511
    assert abs(bits.sum()) == 1
    correlation = np.fft.ifft(np.abs(np.fft.fft(bits)) ** 2).real
    np.testing.assert_allclose(correlation[1:], -1.0, atol=1e-9)


def test_the_campaign_names_the_rig_s_own_values_as_its_truth() -> None:
    campaign = tomllib.loads((CAMPAIGN / "campaign.toml").read_text())
    rig = tomllib.loads((CAMPAIGN / "rig.toml").read_text())["rig"]
    truths = {name: table["truth"] for name, table in campaign["parameters"].items()}
    expected = {k: rig["parameters"][k] for k in ("d_S", "J_S", "d_G")}
    for i, row in enumerate(rig["loss_table"], 1):
        expected |= {f"lossTable[{i},{j}]": row[j - 1] for j in (2, 3, 4, 5)}
    assert truths == expected


def test_the_campaign_s_measurements_are_made_by_one_command(tmp_path: Path) -> None:
    text = (CAMPAIGN / "rig.toml").read_text()
    for long, short in (("duration = 50", "duration = 1"), ("duration = 30", "duration = 1")):
        text = text.replace(long, short)
    (tmp_path / "rig.toml").write_text(text)
    shutil.copy(CAMPAIGN / "campaign.toml", tmp_path)
    assert main([str(tmp_path)]) == 0
    first = (tmp_path / "measurements.h5").read_bytes()
    assert main([str(tmp_path)]) == 0
    assert (tmp_path / "measurements.h5").read_bytes() == first
