"""Whole diagnoses of a driven mass whose truth is known: every kind of verdict, and the JSON form."""

import json
from dataclasses import replace
from importlib.resources import files
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from plants import EFFECTS, PORTS, TWIN, N, _effect, misread, plant

from fmuid.core.errors import SimulationError
from fmuid.diagnosis import decide
from fmuid.diagnosis.candidates import fit_effects
from fmuid.diagnosis.diagnose import Found, diagnose_subject
from fmuid.diagnosis.subject import without_spikes
from fmuid.diagnosis.verdict import Answer, Verdict
from fmuid.diagnosis_pipeline import _beyond_noise, _with_table

SCHEMA = json.loads((files("fmuid.diagnosis") / "diagnosis.schema.json").read_text())


def says(answer: dict) -> tuple:
    """Return a verdict's kind, effects and ports."""
    verdict = answer["verdict"]
    return verdict["kind"], verdict["effects"], verdict["one_of"], verdict["ports"]


def check(diagnosed: Found) -> dict:
    """Hold what every diagnosis must keep; return its JSON value."""
    answer = diagnosed.diagnosis.to_dict()
    text = json.dumps(answer, allow_nan=False)
    jsonschema.Draft202012Validator(SCHEMA).validate(json.loads(text))
    assert sum(a["probability"] for a in answer["answers"]) == pytest.approx(1.0)
    assert {e["id"] for e in answer["effects"]} == {e.id for e in diagnosed.subject.effects}
    for effect in answer["effects"]:
        inclusion = sum(a["probability"] for a in answer["answers"] if effect["id"] in a["effects"])
        assert effect["probability"] == pytest.approx(inclusion)
    verdict = answer["verdict"]
    assert set(verdict["ports"]) <= PORTS.keys()
    assert verdict["port"] == next(iter(verdict["ports"]), None)
    for effect in answer["effects"]:
        if "closure" in effect and answer["gap"]["present"]:
            low, high = effect["closure"]["interval"]
            assert low <= effect["closure"]["held_out"] + 0.05
            assert effect["closure"]["held_out"] - 0.05 <= high
    return answer


def test_a_complete_model_is_called_complete():
    answer = check(diagnose_subject(plant({})))
    assert says(answer) == ("complete", [], [], [])
    assert not answer["gap"]["present"]
    assert answer["gap"]["p_value"] > 0.01
    # Refitting the nominal parameters closed the gap of the start values; that is no effect's credit.
    assert answer["gap"]["nominal"] > 10 * answer["gap"]["nominal_refit"]
    assert answer["answers"][0]["effects"] == ["none"]
    assert answer["model"]["parameters"] == pytest.approx({"m": 1.0, "d": 0.8, "Fc": 0.5}, rel=5e-3)


def test_spikes_that_a_signal_s_motion_hides_are_left_out_of_runs_without_repeats():
    spikes = np.zeros(N)
    spikes[np.random.default_rng(1).choice(np.arange(2, N - 2, 3), 6, replace=False)] = 0.04
    subject = misread(plant({}, repeats=1), lambda v, t: spikes)
    answer = check(diagnose_subject(subject))
    assert says(answer) == ("complete", [], [], [])
    assert {o["samples"] for o in answer["outliers"]} == {6}
    assert len(answer["outliers"]) == len(subject.observed.runs)
    assert "6 spiked samples" in answer["notes"][0]


def test_what_follows_a_jump_of_an_input_or_lasts_longer_is_no_spike():
    for late in (
        plant({}, repeats=1, delay=5e-3),
        misread(plant({}, repeats=1), lambda v, t: 0.04 * (t % 0.7 < 0.01)),
    ):
        (predicted,) = late.model.predict([{"m": 1.0, "d": 0.8, "Fc": 0.5}])
        assert without_spikes(late, predicted, {}) is late


@pytest.mark.parametrize("repeats", [2, 5])
def test_a_counted_speed_that_repeats_exactly_is_no_gap(repeats):
    diagnosis = diagnose_subject(plant({}, repeats=repeats, step=0.02)).diagnosis
    assert diagnosis.verdict.kind == "complete"
    assert diagnosis.gap.floor_units["v"] == pytest.approx(0.02 / np.sqrt(12), rel=0.01)


@pytest.mark.parametrize(
    ("truth", "effect", "port", "estimate"),
    [
        ({"truth": {"a": 0.05}}, "asymmetry", "friction", {"a": 0.05}),
        ({"truth": {"square": 0.3}}, "quadratic", "friction", {"square": 0.3}),
        ({"truth": {}, "gain": 1.03}, "reading_gain", "reading", {"v.gain": 1.03}),
        ({"truth": {}, "delay": 5e-3}, "dead_time", "command", {"u.delay": 5e-3}),
    ],
)
def test_one_effect_is_named_measured_and_closes_the_gap(truth, effect, port, estimate):
    answer = check(diagnose_subject(plant(**truth)))
    assert says(answer) == ("effect", [effect], [], [port])
    assert answer["verdict"]["stable"] is True
    assert answer["verdict"]["rest"] is None
    assert answer["gap"]["present"]
    assert answer["gap"]["corrected"] < 0.1 * answer["gap"]["nominal_refit"]
    assert not any(effect in names for names in answer["alias_classes"])  # so large a gap tells it from all others
    best = answer["effects"][0]
    assert (best["id"], best["probability"] > 0.9) == (effect, True)
    assert best["closure"]["held_out"] > 0.9
    for name, value in estimate.items():
        parameter = best["parameters"][name]
        assert parameter["value"] == pytest.approx(value, rel=0.05)
        assert abs(parameter["value"] - value) < 5 * parameter["standard_error"] + 1e-3 * abs(value)
        assert answer["model"]["parameters"][name] == parameter["value"]
    # Where: the shares are of the whole gap, the largest first.
    shares = [w["share"] for w in answer["where"]]
    assert shares == sorted(shares, reverse=True)
    assert 0.0 < sum(shares) <= 1.0 + 1e-9


def test_what_no_effect_explains_is_called_unknown_at_its_port():
    answer = check(diagnose_subject(plant({"hill": 0.05})))
    assert answer["verdict"]["kind"] == "unknown"
    assert answer["verdict"]["effects"] == []
    assert answer["answers"][0]["effects"] == ["unknown"]
    assert answer["verdict"]["ports"] == ["friction"]
    assert answer["port_closures"].keys() == {"friction", "reading"}
    assert answer["port_closures"]["friction"] > answer["port_closures"]["reading"]


def test_two_effects_that_are_one_model_are_one_answer_with_two_names():
    answer = check(
        diagnose_subject(plant({"tilt": 0.05}, effects={**EFFECTS, "cable": replace(TWIN, port="command")}))
    )
    assert (answer["verdict"]["kind"], answer["verdict"]["effects"]) == ("effect", ["tilt"])
    assert answer["equal"] == [[["tilt"], ["cable"]]]
    assert "command" in answer["verdict"]["ports"]
    assert any({"tilt", "cable"} <= set(names) for names in answer["alias_classes"])
    assert "In these runs, cable would be the same as tilt." in answer["notes"]


def test_nothing_repeated_still_gets_an_answer_that_says_so():
    """The noise is then no more than what smooth motion cannot be."""
    subject = plant({"a": 0.3}, repeats=1)
    assert subject.observed.bounded
    answer = check(diagnose_subject(subject))
    assert answer["gap"]["calibrated"] is False
    assert answer["verdict"]["kind"] == "effect"
    assert "asymmetry" in answer["verdict"]["effects"]
    complete = plant({}, repeats=1)
    assert check(diagnose_subject(complete))["verdict"]["kind"] == "complete"


def test_the_same_seed_gives_the_same_answer():
    first, second = (diagnose_subject(plant({"square": 0.3}), seed=3).diagnosis.to_dict() for _ in range(2))
    assert first == second


@pytest.mark.parametrize("again", [False, True])
def test_progress_is_told_and_never_goes_back(again, monkeypatch):
    """Not even if the search starts anew from a better optimum of the nominal parameters."""
    better = iter([lambda nominal: nominal] if again else [])
    monkeypatch.setattr(
        "fmuid.diagnosis.diagnose.better_nominal", lambda _, nominal, __: next(better, lambda _: None)(nominal)
    )
    shares = []
    diagnose_subject(plant({"a": 0.05}), say=lambda _, share: shares.append(share))
    assert shares == sorted(shares)
    assert 0.0 <= shares[0] < shares[-1] <= 1.0


def test_a_nominal_model_that_cannot_be_simulated_says_why(monkeypatch):
    subject = plant({})

    def fail(_self, _task, _parameters):
        raise SimulationError("stuck")

    monkeypatch.setattr("plants.Mass.simulate", fail)
    with pytest.raises(SimulationError, match="stuck"):
        diagnose_subject(subject)


def test_an_effect_in_one_experiment_alone_is_provisional():
    diagnosed = diagnose_subject(plant({"a": 0.3}, experiments=("sine",)))
    answer = check(diagnosed)
    assert says(answer) == ("effect", ["asymmetry"], [], ["friction"])
    assert answer["verdict"]["provisional"]
    assert "something that the catalogue does not contain may explain" in str(diagnosed)


def test_runs_in_which_no_plausible_effect_would_show_are_not_called_complete():
    answer = check(diagnose_subject(plant({}, noise=1e4)))
    assert answer["verdict"]["kind"] == "insufficient"
    assert answer["power"] == {}


def test_an_effect_that_would_not_show_even_at_its_bound_is_none_that_would_have_been_seen():
    subject = plant({})
    seen = diagnose_subject(subject).diagnosis.power["quadratic"]["square"]
    (effect,) = (e for e in subject.effects if e.id == "quadratic")
    (unknown,) = effect.unknowns
    for upper, shown in ((1.5 * seen, True), (0.6 * seen, False)):
        narrow = replace(effect, unknowns=(replace(unknown, upper=upper),), trials=({"square": 0.5 * seen},))
        bounded = replace(subject, effects=tuple(narrow if e is effect else e for e in subject.effects))
        assert ("quadratic" in diagnose_subject(bounded).diagnosis.power) is shown


def test_a_complete_model_says_what_would_have_been_seen():
    seen = diagnose_subject(plant({})).diagnosis.power
    assert 0.0 < seen["quadratic"]["square"] < 0.1
    # Twice that is seen indeed, a fifth of it is not.
    for factor, kind in ((2.0, "effect"), (0.2, "complete")):
        answer = diagnose_subject(plant({"square": factor * seen["quadratic"]["square"]})).diagnosis
        assert answer.verdict.kind == kind


@pytest.mark.parametrize("open_", [False, True])
def test_the_verdict_lacks_effects_that_the_right_shape_of_another_makes_unnecessary(open_):
    diagnosed = diagnose_subject(plant({"a": 0.3}, delay=0.03))
    verdict, best = diagnosed.diagnosis.verdict, diagnosed.diagnosis.best
    pair = next(a for a in diagnosed.diagnosis.answers if set(a.effects) == {"asymmetry", "dead_time"})
    assert set(verdict.effects) == {*pair.effects}
    if open_:  # which of two others is missing, too
        verdict = Verdict("ambiguous", ("asymmetry",), (("dead_time",), ("gain",)), ("friction", "torque"))
        answers = (replace(pair, probability=0.5), Answer(("asymmetry", "gain"), 0.4), Answer(("gain",), 0.1))
        diagnosed = replace(diagnosed, diagnosis=replace(diagnosed.diagnosis, verdict=verdict, answers=answers))
    refined = replace(best, effects=("asymmetry",), refinements=(SimpleNamespace(learned=False),))
    table = SimpleNamespace(best=refined, fitted=diagnosed.best, subject=diagnosed.subject, among=1)
    after = _with_table(diagnosed, table).diagnosis
    assert (after.verdict.kind, after.verdict.one_of) == ("effect", ())
    assert (after.verdict.effects, after.verdict.ports) == (("asymmetry",), ("friction",))
    assert after.best is refined
    assert after.answers[0].effects == ("asymmetry",)
    assert after.answers[0].probability == pytest.approx(0.9 if open_ else pair.probability)
    assert all("dead_time" not in a.effects for a in after.answers)
    named = {e.id: e.probability for e in after.effects}
    assert (named["dead_time"], named["asymmetry"]) == (0.0, after.answers[0].probability)


def test_what_a_table_predicts_in_runs_without_repeats_is_unknown_and_no_noise():
    hill = {"hill": replace(_effect("hill", "hill", 0.05), id="hill")}
    subject = plant({"hill": 0.05}, repeats=1, effects={"dead_time": EFFECTS["dead_time"]})
    diagnosed = diagnose_subject(subject)
    assert diagnosed.diagnosis.verdict.kind == "insufficient"
    known = replace(subject, catalogue=replace(subject.catalogue, effects=hill), effects=tuple(hill.values()))
    fitted = fit_effects(known, known.effects, [diagnosed.nominal.fit.values])
    best = SimpleNamespace(refinements=[SimpleNamespace(port="friction")])
    # As large a gap in every run as slow noise may well leave.
    nominal = replace(
        diagnosed.nominal, gap=2.0, held_out=replace(diagnosed.nominal.held_out, loss=np.full(5, 4.0))
    )
    for table, kind in ((fitted, "unknown"), (nominal, "insufficient")):
        tabulated = SimpleNamespace(fitted=table, among=10, best=best)
        diagnosis = _beyond_noise(diagnosed.diagnosis, nominal, tabulated)
        assert (diagnosis.verdict.kind, diagnosis.verdict.ports[0]) == (kind, "friction")
        assert sum(a.probability for a in diagnosis.answers) == pytest.approx(1.0)


def test_a_verdict_is_provisional_if_the_runs_contradict_a_bound_of_the_model():
    subject = plant({"a": 0.3})
    mass, *others = subject.nominal
    for lower, back in ((0.1, ()), (1.02, ("m",))):
        bounded = replace(subject, nominal=(replace(mass, start=1.5, lower=lower), *others))
        outcome = diagnose_subject(bounded)
        assert says(check(outcome))[:2] == ("effect", ["asymmetry"])
        assert outcome.diagnosis.verdict.provisional == bool(back)
        assert decide.held_back(outcome.corrected, bounded.nominal, bounded.observed) == back
