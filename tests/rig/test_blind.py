"""The blind check's generator: its grid, the size of its gaps, its form, and that nothing tells the labels."""

import hashlib
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from benchmarks.virtual_rig import Sensors, blind, blind_cases
from benchmarks.virtual_rig.blind import main, make_blind_campaigns
from benchmarks.virtual_rig.blind_cases import plain_actuator, plan_cases
from benchmarks.virtual_rig.blind_effects import BLIND_EFFECTS
from benchmarks.virtual_rig.blind_experiments import held_out_experiments, sealed_experiments
from benchmarks.virtual_rig.blind_gap import Gap, nominal_of, with_nominal
from benchmarks.virtual_rig.rig_plan import PlannedExperiment
from fmuid.data.measurements import read_measurements
from tests.rig.rigs import constant

SEALED = Path(__file__).parents[3] / "shared" / "data" / "sealed" / "s01" / "measurements.h5"
SHORT = tuple(e for e in sealed_experiments() if e.setup == "fixed_shaft")


def without_effects() -> object:
    return constant(0.07).changed(d_S=2.5, J_S=0.003, d_G=70.0, J_L=0.05)


@pytest.fixture
def short(monkeypatch) -> None:
    """Experiments of a second in all."""
    turning = PlannedExperiment("free_20", "free_shaft", 5e-3, np.full(100, 20.0))
    for module, name in ((blind, "sealed_experiments"), (blind_cases, "sealed_experiments")):
        monkeypatch.setattr(module, name, lambda: (*SHORT, turning))
    monkeypatch.setattr(blind, "held_out_experiments", lambda: SHORT[:1])


def test_the_grid_has_the_shares_of_the_specification() -> None:
    cases = plan_cases(200, seed=3)
    assert Counter(c.kind for c in cases) == {"none": 50, "one": 90, "two": 30, "outside": 30}
    known = Counter(e for c in cases if c.kind in ("one", "two") for e in c.effects)
    assert len(known) == 18
    assert max(known.values()) - min(known.values()) <= 2
    for aspect in ("noise", "repeats", "load_encoder"):
        counts = Counter(getattr(c, aspect) for c in cases)
        assert max(counts.values()) < 1.15 * min(counts.values())
    assert all(len(set(c.effects)) == 2 for c in cases if c.kind == "two")
    assert all(not BLIND_EFFECTS[c.effects[0]].in_catalogue for c in cases if c.kind == "outside")
    assert cases == plan_cases(200, seed=3)


def test_the_catalogue_s_effects_are_all_there() -> None:
    catalogue = {
        *("viscous", "stribeck", "coulomb_asymmetry", "mesh_loss", "presliding", "backlash", "hardening"),
        *("hysteresis", "kinematic_error", "cogging", "current_lag", "saturation", "sensor_offset"),
        *("sensor_gain", "sensor_lag", "imbalance", "thermal_friction", "delay"),
    }
    assert {e.id for e in BLIND_EFFECTS.values() if e.in_catalogue} == catalogue
    assert len(BLIND_EFFECTS) >= len(catalogue) + 8


def test_experiments_are_those_of_the_sealed_campaigns() -> None:
    if not SEALED.exists():
        pytest.skip("the sealed campaigns are not there")
    sealed = read_measurements(SEALED)
    assert [e.id for e in sealed if e.repeat_of is None] == [p.id for p in sealed_experiments()]
    for planned in sealed_experiments():
        theirs = sealed[planned.id]
        (given,) = theirs.inputs.values()
        np.testing.assert_allclose(planned.inputs, given.values, atol=1e-9)
        assert np.diff(theirs.time).mean() == pytest.approx(planned.interval)
        assert theirs.settings.get("mgr") == planned.settings.get("mgr")


@pytest.mark.parametrize("name", ["current_lag", "backlash", "cogging", "sensor_gain"])
def test_the_magnitude_found_leaves_the_gap_aimed_at(name: str) -> None:
    rig, effect = without_effects(), BLIND_EFFECTS[name]
    gap = Gap(rig, Sensors(), SHORT, load_encoder=True)
    shape = effect.shape(np.random.default_rng(0))
    for target in (0.5, 3.0):
        magnitude, reached = gap.magnitude(lambda m: effect.put(rig, m, shape), effect.low, effect.high, target)
        assert reached == pytest.approx(target, rel=0.06)
        assert effect.low < magnitude < effect.high


def test_what_the_nominal_parameters_can_close_is_no_gap() -> None:
    rig = without_effects()
    gap = Gap(rig, Sensors(), SHORT, load_encoder=True)
    moved = with_nominal(rig, [1.01 * v for v in nominal_of(rig)])
    assert np.sqrt(np.mean((gap.whitened(moved) - gap.whitened(rig)) ** 2)) > 0.5
    assert gap.of(moved) < 0.2
    assert gap.of(rig) == 0.0


def test_labels_are_hashed_kept_apart_and_found_again(tmp_path: Path, short) -> None:
    out, labels, said = tmp_path / "blind", tmp_path / "labels", []
    kinds = [c.kind for c in plan_cases(40, seed=5)]
    chosen = [kinds.index("none"), kinds.index("one"), kinds.index("outside")]
    digest = make_blind_campaigns(out, labels, count=40, seed=5, cases=chosen, say=said.append)
    text = (labels / "labels.json").read_bytes()
    assert hashlib.sha256(text).hexdigest() == digest == (out / "labels.sha256").read_text().split()[0]
    found = {label["case"]: label for label in json.loads(text)}
    assert [label["kind"] for label in found.values()] == ["none", "one", "outside"]
    published = {p.name for p in out.rglob("*") if p.is_file()}
    assert published == {"labels.sha256", "measurements.h5"}

    said.clear()
    before = {p: p.read_bytes() for p in out.rglob("*.h5")}
    removed = next(iter(before))
    removed.unlink()
    assert make_blind_campaigns(out, labels, count=40, seed=5, cases=chosen, say=said.append) == digest
    assert not any("label" in line for line in said)
    assert removed.read_bytes() == before[removed]

    name, label = next((n, x) for n, x in found.items() if x["kind"] == "one")
    measured = read_measurements(out / name / "measurements.h5")
    assert len(measured) == 4 * label["repeats"]
    assert measured.rig == "withheld"
    assert all(s.sigma is None for e in measured for s in e.signals.values())
    assert (labels / name / "held_out.h5").exists()


def test_a_row_is_written_after_the_step_that_its_input_drives(tmp_path: Path, short) -> None:
    index = [c.kind for c in plan_cases(40, seed=5)].index("none")
    make_blind_campaigns(tmp_path / "out", tmp_path / "labels", count=40, seed=5, cases=[index], say=list)
    measured = read_measurements(next((tmp_path / "out").rglob("*.h5")))
    first = [r.signals["w_motor"].values[0] for r in measured.repeats("prbs_0p8")]
    assert np.mean(first) > 2  # it has turned for a millisecond already


def test_friction_differs_from_run_to_run() -> None:
    case = next(c for c in plan_cases(20, seed=1) if c.kind == "none")
    truth = blind_cases.Truth(case, plain_actuator(case), (), (), 0.0)
    turning = PlannedExperiment("free_20", "free_shaft", 5e-3, np.full(400, 20.0))
    runs = blind_cases.record_case(truth, (turning,), "test").repeats("free_20")
    levels = [r.signals["i_motor"].values[200:].mean() for r in runs]
    assert 0.002 < np.std(levels, ddof=1) / np.mean(levels) < 0.05


def test_labels_among_the_campaigns_are_refused(tmp_path: Path, capsys) -> None:
    assert main([str(tmp_path), "--labels", str(tmp_path / "labels")]) == 2
    assert "another folder" in capsys.readouterr().err


def test_held_out_runs_are_others() -> None:
    assert not {e.id for e in held_out_experiments()} & {e.id for e in sealed_experiments()}
