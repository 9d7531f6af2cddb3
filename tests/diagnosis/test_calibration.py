"""Probabilities that come true: curves from trials with a known answer, plants of the size that was asked for."""

import json

import numpy as np
import pytest
from plants import EFFECTS, REGIMES, plant

from fmuid.core.errors import SimulationError
from fmuid.diagnosis.calibration import (
    Calibration,
    Trial,
    _Maker,
    calibrate,
    fit_curves,
    is_true,
    keep,
    kept,
    key_of,
    shipped,
    simulated_plants,
)
from fmuid.diagnosis.candidates import fit_effects
from fmuid.diagnosis.diagnose import diagnose_subject
from fmuid.diagnosis.free_functions import trajectories
from fmuid.diagnosis.verdict import Verdict

EFFECT = Verdict("effect", ("a",))
WEIGHTS = {"a": 0.9, "b": 0.06, "none": 0.02, "unknown": 0.02}


@pytest.fixture(scope="module")
def fitted():
    """A complete rig, its model refitted, and the regimes' paths."""
    subject = plant({})
    nominal = fit_effects(subject, (), [{}])
    return subject, nominal.fit, trajectories(subject.model, nominal.fit.values, REGIMES)


def test_weights_become_the_share_of_trials_that_were_right():
    half = [Trial("effect", 0.9, k % 2 == 0) for k in range(200)]
    probability = fit_curves(half, "").apply(EFFECT, WEIGHTS)
    assert probability["a"] == pytest.approx(0.5, abs=0.03)
    assert sum(probability.values()) == pytest.approx(1.0)
    assert probability["b"] / probability["none"] == pytest.approx(3.0)
    # More weight is more probable; what was never tried stays as it is.
    graded = [Trial("effect", w, r) for w, r in ((0.6, False), (0.95, True)) for _ in range(50)]
    curve = fit_curves(graded, "")
    low, high = (curve.apply(EFFECT, {"a": w, "b": 1 - w})["a"] for w in (0.6, 0.95))
    assert low < 0.5 < high
    assert curve.apply(Verdict("complete"), {"none": 0.9, "a": 0.1}) == {"none": 0.9, "a": 0.1}


def test_answers_with_several_effects_have_a_curve_of_their_own():
    trials = [Trial("effect", 0.9, k % 10 > 0, several=False) for k in range(100)]
    both = Verdict("effect", ("a", "b"))
    for several, share in (([], 0.9), ([Trial("effect", 0.9, k % 2 > 0, several=True) for k in range(200)], 0.5)):
        curves = fit_curves([*trials, *several], "")
        assert curves.apply(both, {("a", "b"): 0.9, "none": 0.1})["a", "b"] == pytest.approx(share, abs=0.03)
        assert curves.apply(Verdict("effect", ("a",)), {("a",): 0.9, "none": 0.1})["a",] == pytest.approx(
            0.9, abs=0.03
        )


def test_a_few_trials_change_little():
    probability = fit_curves([Trial("effect", 0.9, True)] * 3, "").apply(EFFECT, WEIGHTS)
    assert 0.9 < probability["a"] < 0.98


@pytest.mark.slow
def test_plants_are_as_far_off_as_asked_and_as_noisy_as_what_was_measured(fitted):
    subject, fit, paths = fitted
    truths = []
    for made, truth, size, _ in simulated_plants(subject, fit, paths, 20, seed=1):
        truths.append(truth)
        assert truth <= {*EFFECTS, "none", "unknown"}
        noise = made.observed.noise["bench"].sigma
        assert noise["v"] == pytest.approx(subject.observed.noise["bench"].sigma["v"], rel=0.25)
        assert fit_effects(made, (), [fit.values]).gap == pytest.approx(size, rel=0.4, abs=0.15)
    assert sum(t == {"none"} for t in truths) == 5
    assert any(len(t) == 2 for t in truths)


def test_plants_of_single_runs_are_as_noisy_as_the_diagnosis_assumes():
    subject = plant({}, repeats=1)
    nominal = fit_effects(subject, (), [{}])
    made = next(
        iter(simulated_plants(subject, nominal.fit, trajectories(subject.model, nominal.fit.values, REGIMES), 1))
    )
    assumed, simulated = (s.observed.noise["bench"].sigma["v"] for s in (subject, made.subject))
    assert simulated == pytest.approx(assumed, rel=0.35)


def test_plants_have_a_background_that_a_verdict_may_name(fitted):
    subject, fit, paths = fitted
    made = next(iter(simulated_plants(subject, fit, paths, 1)))
    assert made.truth == {"none"}
    assert made.background <= set(EFFECTS)
    assert len(made.background) >= 3
    assert 0.05 < made.gap < 0.8
    one, other = sorted(made.background)[:2]
    for effects, right in (((one,), True), ((one, other), True), (("none",), True), (("elsewhere",), False)):
        assert is_true(Verdict("effect", effects), made.truth, made.background) is right
    assert is_true(Verdict("effect", ("a", one)), frozenset({"a"}), made.background)
    assert is_true(Verdict("effect", ("a",)), frozenset({"a", "b"}))
    assert not is_true(Verdict("effect", ("a", "c")), frozenset({"a", "b"}), made.background)
    assert is_true(Verdict("ambiguous", ("a",), (("c",), ("b",))), frozenset({"a", "b"}))
    listed = [("unknown",), ("none",), ("a",)]
    for truth, right in (({"unknown"}, True), ({"a", "b"}, True), ({"a"}, False), ({"none"}, False)):
        assert is_true(Verdict("unknown"), frozenset(truth), listed=listed) is right


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_as_many_plants_are_made_as_asked_for_however_few(fitted, count):
    subject, fit, paths = fitted
    assert len(list(simulated_plants(subject, fit, paths, count))) == count


def test_a_plant_that_cannot_be_simulated_is_drawn_anew_but_not_for_ever(fitted, monkeypatch):
    subject, fit, paths = fitted
    real, calls = _Maker.plant, []

    def first_fails(maker, kind):
        calls.append(kind)
        return None if len(calls) == 1 else real(maker, kind)

    monkeypatch.setattr(_Maker, "plant", first_fails)
    assert len(list(simulated_plants(subject, fit, paths, 2))) == 2
    monkeypatch.setattr(_Maker, "plant", lambda *_: None)
    with pytest.raises(SimulationError, match="can be simulated"):
        list(simulated_plants(subject, fit, paths, 2))


@pytest.mark.slow
def test_calibrating_diagnoses_every_plant_and_is_kept_under_its_key(fitted, tmp_path, monkeypatch):
    subject, fit, paths = fitted

    def diagnose(made):
        diagnosis = diagnose_subject(made, calibration=Calibration()).diagnosis
        return diagnosis.verdict, {a.effects: a.probability for a in diagnosis.answers}

    trials = calibrate(subject, fit, paths, diagnose, count=4)
    assert len(trials) == 4
    assert np.mean([t.right for t in trials]) > 0.5
    assert all(0.0 < t.weight < 1.0 for t in trials)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    key = key_of([], subject)
    assert kept(key) is None
    curves = fit_curves(trials, "here")
    keep(key, curves)
    assert kept(key).curves == curves.curves
    assert key_of([], plant({}, repeats=4)) != key


def test_the_calibration_that_comes_with_the_package_is_monotone():
    calibration = shipped()
    json.dumps(calibration.to_dict(), allow_nan=False)
    for _, slope in calibration.curves.values():
        assert slope >= 0.0
