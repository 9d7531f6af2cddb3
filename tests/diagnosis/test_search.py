"""The search among effects: a wrong first pick is mended, a law of another shape is no further cause."""

from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from plants import EFFECTS, Mass, misread, plant
from tones import SIGMA, STRENGTHS, TIME, Reading, heard

from fmuid.core.progress import quiet
from fmuid.diagnosis import candidates, decide
from fmuid.diagnosis.calibration import Calibration
from fmuid.diagnosis.candidates import (
    _best_start,
    add_effect,
    approach,
    approach_effect,
    better_nominal,
    escaped,
    fit_effects,
    score_further,
    without,
)
from fmuid.diagnosis.cross_validation import CHORDS, draw_noise
from fmuid.diagnosis.diagnose import diagnose_subject
from fmuid.diagnosis.effect_search import _added, _crossed, _moved, _pruned, exact_enough, search
from fmuid.diagnosis.next_experiment import suggest
from fmuid.diagnosis.refit import about, refit
from fmuid.diagnosis.scores import nominal_basis, stack
from fmuid.diagnosis.subject import tightened
from fmuid.effects.effect import Effect, Unknown


def test_an_exchange_mends_a_first_pick_that_was_wrong(monkeypatch):
    """`mixture` explains more than either cause does, and is none of them."""
    laws = {"first": {1: 1.0}, "second": {2: 1.0}, "mixture": {1: 0.35, 2: 0.85, 3: 0.394}}
    subject = heard(laws, {1: 1.0, 2: 1.0})
    diagnosed = diagnose_subject(subject)
    singles = {c.effects[0]: c for c in diagnosed.candidates if len(c.effects) == 1}
    assert min(singles, key=lambda n: singles[n].fit.cost) == "mixture"
    assert diagnosed.diagnosis.verdict.kind == "effect"
    assert set(diagnosed.diagnosis.verdict.effects) == {"first", "second"}
    assert diagnosed.diagnosis.model == pytest.approx({"k": 1.0, "first": 1.0, "second": 1.0}, abs=0.01)
    # Without exchanges and without leaving out what has become needless, the mixture stays, and something with it.
    monkeypatch.setattr("fmuid.diagnosis.effect_search._replaced", lambda *_: [])
    monkeypatch.setattr("fmuid.diagnosis.effect_search._pruned", lambda subject, nominal, best, *_: best)
    assert "mixture" in diagnose_subject(subject).diagnosis.verdict.effects


def test_an_effect_that_only_closes_what_is_tolerated_is_left_out():
    subject = plant({"a": 0.3, "tilt": 0.05})
    effects = [subject.by_id[name] for name in ("asymmetry", "tilt")]
    nominal, both = (fit_effects(subject, names, [{}]) for names in ((), effects))
    assert set(_pruned(subject, nominal, both, [], partial(without, subject)).effects) == {"asymmetry", "tilt"}
    tolerant = replace(subject, tolerances={"x": 0.05, "v": 0.05})
    assert _pruned(tolerant, nominal, both, [], partial(without, tolerant)).effects == ("asymmetry",)


def test_a_model_within_the_tolerance_is_exact_enough_only_if_it_holds_on_other_experiments():
    subject = plant({"a": 0.3}, repeats=1)
    tolerant = replace(subject, tolerances={"x": 0.5, "v": 0.5})
    nominal, fitted = (fit_effects(tolerant, names, [{}]) for names in ((), (tolerant.by_id["quadratic"],)))
    assert fitted.gap > 0.25
    assert decide.within_tolerance(tolerant, fitted)
    elsewhere = replace(nominal.held_out, loss=0.1 * nominal.held_out.loss)
    for held_out, enough in ((fitted.held_out, False), (elsewhere, True)):
        judged = replace(fitted, held_out=held_out, judged=held_out, gap=0.3 if enough else fitted.gap)
        assert exact_enough(tolerant, nominal, judged) is enough


def test_an_effect_that_promises_nothing_at_the_estimate_is_found_from_the_start_values():
    """Without the cause, `k` is estimated as -1, where the cause would do nothing."""

    class Switched(Reading):
        def simulate(self, task, parameters):
            values = {**task.start_values, **parameters}
            return super().simulate(task, {**values, "cause": values.get("cause", 0.0) * max(values["k"], 0.0)})

    laws = {"cause": {0: -2.0, 2: 0.3}, "other": {3: 1.0}}
    subject = heard(laws, laws["cause"])
    cases = tuple(replace(case, simulator=Switched(laws)) for case in subject.model.cases)
    subject = replace(subject, model=replace(subject.model, cases=cases))
    nominal = fit_effects(subject, (), [{}])
    assert nominal.fit.values["k"] == pytest.approx(-1.0, abs=0.01)
    assert max(s.drop for s in score_further(subject, nominal) if s.effect == "cause") < 1.0
    diagnosis = diagnose_subject(subject).diagnosis
    assert diagnosis.verdict.effects == ("cause",)
    assert diagnosis.model == pytest.approx({"k": 1.0, "cause": 1.0}, abs=0.05)


def test_an_effect_is_found_from_start_values_that_are_far_away():
    """A step from there promises to leave more with the cause than the estimate, -1, leaves without it."""

    class Bent(Reading):
        def simulate(self, task, parameters):
            values = {**task.start_values, **parameters}
            k = max(values["k"], 0.0)
            more = {"cause": k * values.get("cause", 0.0), "square": k * (k - 1.0), "cube": k**2 * (k - 1.0)}
            return super().simulate(task, {**values, **more})

    laws = {"cause": {0: -2.0, 2: 0.3}, "other": {3: 1.0}}
    subject = heard(laws, laws["cause"])
    bent = Bent({**laws, "square": {1: 0.5}, "cube": {4: 0.5}})
    cases = tuple(replace(case, simulator=bent) for case in subject.model.cases)
    nominal = (replace(subject.nominal[0], start=3.0),)
    subject = replace(subject, model=replace(subject.model, cases=cases), nominal=nominal)
    diagnosis = diagnose_subject(subject).diagnosis
    assert diagnosis.verdict.effects == ("cause",)
    assert diagnosis.model == pytest.approx({"k": 1.0, "cause": 1.0}, abs=0.05)


def test_an_effect_that_promises_nothing_at_the_estimate_is_found_from_where_another_one_leads(monkeypatch):
    """Without the cause, `k` is estimated as 2, where the cause does what `k` does; `other` leaves little."""

    class Turned(Reading):
        def simulate(self, task, parameters):
            values = {**task.start_values, **parameters}
            turned = values.get("cause", 0.0) * min(values["k"] - 1.5, 0.0)
            return super().simulate(task, {**values, "turned": turned})

    laws = {"cause": {0: 1.0}, "other": {0: 1.0, 2: -0.1, 3: 0.002}}
    subject = heard(laws, {0: 1.0, 2: -0.1})
    cases = tuple(replace(c, simulator=Turned({**laws, "turned": {2: 0.2}})) for c in subject.model.cases)
    nominal = (replace(subject.nominal[0], start=2.0),)
    subject = replace(subject, model=replace(subject.model, cases=cases), nominal=nominal)
    diagnosis = diagnose_subject(subject).diagnosis
    assert diagnosis.verdict.effects == ("cause",)
    assert diagnosis.model == pytest.approx({"k": 1.0, "cause": 1.0}, abs=0.1)
    monkeypatch.setattr("fmuid.diagnosis.effect_search._instead", lambda *_: [])
    assert diagnose_subject(subject).diagnosis.verdict.effects == ("other",)


@pytest.mark.parametrize(
    ("tolerances", "named"), [({}, {"large", "small"}), ({"y": 0.2}, {"large"}), ({"y": 0.02}, {"large", "small"})]
)
def test_no_effect_is_added_to_a_model_within_the_tolerance(tolerances, named):
    laws = {"large": {1: 1.0}, "small": {2: 1.0}}
    subject = replace(heard(laws, {1: 1.0, 2: 0.1}), tolerances=tolerances)
    verdict = diagnose_subject(subject).diagnosis.verdict
    assert (verdict.kind, set(verdict.effects), verdict.rest) == ("effect", named, None)


@pytest.mark.parametrize(
    "laws", [{}, {"a": {-1: 1.0}, "b": {-2: 1.0}}], ids=["no effects", "none that sensors show"]
)
@pytest.mark.parametrize("truth", [{}, {3: 0.5}], ids=["without a gap", "with a gap"])
def test_a_single_run_says_little_without_an_effect_to_look_for(laws, truth):
    assert diagnose_subject(heard(laws, truth, repeats=1)).diagnosis.verdict.kind == "insufficient"


def test_a_needless_law_is_dropped():
    laws = {"first": {1: 1.0}, "second": {2: 1.0}, "mixture": {1: 0.35, 2: 0.85, 3: 0.394}}
    subject = heard(laws, {1: 1.0, 2: 1.0})
    by_id = {e.id: e for e in subject.effects}
    whole = fit_effects(subject, [by_id[name] for name in ("mixture", "first", "second")], [{}])
    nominal = fit_effects(subject, (), [{}])
    pruned = _pruned(subject, nominal, whole, [], partial(without, subject))
    assert pruned.effects == ("first", "second")


def test_a_law_found_at_one_port_is_tried_at_the_others_from_where_the_fit_is():
    """The reading of `law@b` is almost that of `law@a`; a fit with the latter is near the one that is wanted."""
    laws = {"first": {1: 1.0}, "a": {2: 1.0}, "b": {2: 0.95, 3: 0.31}}
    subject = heard(laws, {1: 1.0, 2: 0.95, 3: 0.31})
    effects = tuple(e if e.id == "first" else replace(e, id=f"law@{e.id}", law="law") for e in subject.effects)
    subject = replace(subject, effects=effects)
    nominal = fit_effects(subject, (), [{}])
    by_id = {e.id: e for e in subject.effects}
    pair = fit_effects(subject, [by_id["first"], by_id["law@a"]], [{}])
    scores = score_further(subject, nominal)
    (moved,) = _moved(subject, pair, [pair], scores)
    assert moved.effects == ("first", "law@b")
    assert moved.fit.values == pytest.approx({"k": 1.0, "first": 1.0, "b": 1.0}, abs=0.01)
    assert list(_moved(subject, pair, [pair, replace(moved, fit=pair.fit)], scores)) == []  # known to be as good


@pytest.mark.parametrize(
    ("best", "crossed"),
    [
        (("drag@wheel", "spring@drum"), {"drag@drum", "spring@wheel"}),
        (("drag@wheel", "spring@drum", "spring@wheel"), None),
    ],
    ids=["with each other", "no law twice at one port"],
)
def test_laws_are_tried_at_the_ports_of_each_other(best, crossed):
    pairs = list(product(("drag", "spring"), ("wheel", "drum")))
    subject = heard({law + port: {k: 1.0} for k, (law, port) in enumerate(pairs, 1)}, {1: 1.0, 4: 1.0})
    effects = zip(subject.effects, pairs, strict=True)
    subject = replace(subject, effects=tuple(replace(e, id=f"{a}@{b}", law=a, port=b) for e, (a, b) in effects))
    fit = fit_effects(subject, [subject.by_id[name] for name in best], [{}])
    exchanged = [
        set(c.effects)
        for c in _crossed(subject, fit, [fit], score_further(subject, fit_effects(subject, (), [{}])))
    ]
    assert exchanged == ([] if crossed is None else [crossed])


def test_a_law_is_compared_with_a_similar_one_of_its_port():
    laws = {"loss": {1: 1.0}, "radiation": {1: 0.95, 3: 0.31}}
    subject = heard(laws, laws["radiation"])
    subject = replace(subject, effects=tuple(replace(e, law=e.id, port="room") for e in subject.effects))
    by_id = {e.id: e for e in subject.effects}
    loss, radiation = (fit_effects(subject, [by_id[name]], [{}]) for name in laws)
    scores = score_further(subject, fit_effects(subject, (), [{}]))
    assert [c.effects for c in _moved(subject, loss, [loss], scores)] == [("radiation",)]
    assert [c.effects for c in _moved(subject, radiation, [radiation], scores)] == [("loss",)]  # it leaves no gap


def test_a_law_that_no_trial_leads_to_is_found_from_the_same_law_at_another_port(monkeypatch):
    subject = heard({"a": {2: 1.0}, "b": {2: 0.95, 3: 0.31}}, {2: 0.95, 3: 0.31})
    effects = tuple(replace(e, id=f"law@{e.id}", law="law") for e in subject.effects)
    subject = replace(subject, effects=effects)
    starts = []

    def added(subject, fitted, score, *begun):
        return None if score.effect == "law@b" else add_effect(subject, fitted, score, *begun)

    def best_start(subject, points, *basis):
        starts.append(points)
        return _best_start(subject, points, *basis)

    monkeypatch.setattr("fmuid.diagnosis.effect_search.add_effect", added)
    monkeypatch.setattr("fmuid.diagnosis.candidates._best_start", best_start)
    verdict = diagnose_subject(subject).diagnosis.verdict
    assert (verdict.kind, verdict.effects) == ("effect", ("law@b",))
    # One of the starts has the values of the fit at the other port.
    assert any(
        p.get("b") == pytest.approx(0.95, abs=0.02) and p.get("a") == 0.0 for trials in starts for p in trials
    )


def test_answers_are_refitted_to_the_end(monkeypatch):
    subject = plant({"square": 0.3})
    effects = [e for e in subject.effects if e.id == "quadratic"]
    good = fit_effects(subject, effects, [{}], tolerance=1e-9)

    def ended_early(share):
        values = {name: share * value for name, value in good.fit.values.items()}
        (predicted,) = subject.model.predict([values])
        residual = stack(subject.observed.residuals(predicted), subject.observed)
        return replace(good, fit=replace(good.fit, values=values, cost=float(residual @ residual)))

    near, nearer, far = map(ended_early, (1.00015, 1.0001, 1.01))
    assert near.fit.cost - good.fit.cost > 5.0
    monkeypatch.setattr("fmuid.diagnosis.diagnose.search", lambda *_, **__: ([far, near, nearer], nearer))
    diagnosis = diagnose_subject(subject)
    costs = [c.fit.cost for c in diagnosis.candidates]
    assert sorted(costs)[:2] == pytest.approx([good.fit.cost] * 2, abs=0.5)
    assert max(costs) == far.fit.cost


def test_a_law_of_another_shape_is_no_third_cause():
    laws = {"first": {1: 1.0}, "second": {2: 1.0}, "like_first": {1: 0.95, 3: 0.31}, "other": {4: 1.0}}
    diagnosed = diagnose_subject(heard(laws, {1: 1.0, 2: 1.0, 3: 0.1}))
    assert set(diagnosed.best.effects) == set(diagnosed.diagnosis.verdict.effects) == {"first", "second"}
    assert diagnosed.diagnosis.verdict.rest is not None  # what the shape of the first law leaves


@pytest.mark.parametrize(
    ("truth", "causes"),
    [
        pytest.param({"truth": {"a": 0.1}, "delay": 5e-3}, {"asymmetry", "dead_time"}, marks=pytest.mark.slow),
        ({"truth": {"square": 0.3}, "gain": 1.03}, {"quadratic", "reading_gain"}),
        pytest.param(
            {"truth": {"square": 0.3}, "gain": 1.03, "delay": 5e-3},
            {"quadratic", "reading_gain", "dead_time"},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_as_many_effects_are_named_as_are_true(truth, causes):
    verdict = diagnose_subject(plant(**truth)).diagnosis.verdict
    assert verdict.kind == "effect"
    assert set(verdict.effects) == causes


@pytest.mark.parametrize(("again", "third", "most"), [(False, 0.6, 3), (True, 0.6, 2), (False, 0.4, 2)])
def test_no_third_effect_is_added_if_another_search_follows_or_if_it_closes_too_little(again, third, most):
    laws = {"first": {1: 1.0}, "second": {2: 1.0}, "third": {3: 1.0}}
    subject = heard(laws, {1: 1.0, 2: 1.0, 3: third, 4: 0.62})
    nominal = fit_effects(subject, (), [{}])
    (prediction,) = subject.model.predict([nominal.fit.values])
    scores, noise = score_further(subject, nominal), draw_noise(subject.observed, prediction)
    models, best = search(subject, nominal, scores, noise, quiet, present=True, again=again)
    assert max(len(c.effects) for c in models) == len(best.effects) == most


@pytest.mark.parametrize(
    ("gains", "values"),
    [
        ({"law1": 0.5, "law2": 0.5, "law3": 0.7}, {"law1": 0.7, "law2": 0.7, "law3": 0.7}),
        ({"law1": 0.5, "law2": 0.8}, {"law1": 0.7}),
        ({}, {f"law{n}": 0.0 for n in range(1, 7)}),
    ],
)
def test_effects_are_refitted_with_care_that_gain_half_as_much_as_the_best_or_from_neutral_values(
    monkeypatch, gains, values
):
    laws = {f"law{n}": {n: 1.0} for n in range(1, 7)}
    subject = heard(laws, {1: 1.0, 2: 1.0})
    nominal = fit_effects(subject, (), [{}])
    scores = sorted(score_further(subject, nominal), key=lambda s: s.effect)
    begun, limits = {}, {}

    def approached(subject, fit, score, most, *, everywhere):
        assert not everywhere
        limits[score.effect] = most / fit.cost
        return fit.cost * gains.get(score.effect, 1.1), {**fit.values, score.effect: 0.7}

    def added(subject, fitted, score, starts, rival):
        begun[score.effect] = starts[0][score.effect]
        return add_effect(subject, fitted, score, starts)

    monkeypatch.setattr("fmuid.diagnosis.effect_search.approach_effect", approached)
    monkeypatch.setattr("fmuid.diagnosis.effect_search.add_effect", added)
    _added(subject, nominal, scores, ["law6"])
    assert begun == values
    # A search with a law that is refitted whatever it gains goes on to its end, others only if they may gain enough.
    least = [min(gains.get(f"law{n}", 1.1) for n in range(1, k)) if k > 1 else 1.0 for k in range(1, 6)]
    assert [limits[f"law{k}"] for k in range(1, 6)] == pytest.approx(
        [0.5 * (1.0 + cost) if cost < 0.95 else np.inf for cost in least]
    )
    assert limits["law6"] == np.inf


@pytest.mark.parametrize(
    ("promised", "searches"), [((0.5, 0.9), 2), ((0.5, 1.1), 1), ((1.1, 0.5), 1), ((1.2, 1.1), 1)]
)
def test_a_quick_search_begins_twice_only_if_both_starts_promise_something(monkeypatch, promised, searches):
    subject = heard({"law": {2: 1.0}}, {2: 1.0})
    nominal = fit_effects(subject, (), [{}])
    (score,) = score_further(subject, nominal)
    costs, begun = iter(promised), []
    best_start = lambda subject, points, *_: (points[0], next(costs) * nominal.fit.cost)  # noqa: E731
    monkeypatch.setattr(candidates, "_best_start", best_start)
    monkeypatch.setattr(candidates, "approach", lambda subject, unknowns, starts, most: begun.extend(starts))
    approach_effect(subject, nominal.fit, score)
    assert len(begun) == searches


def test_a_quick_search_ends_where_it_would_not_end_about_as_well_as_one_before(monkeypatch):
    subject, limits, costs = heard({}, {}), [], iter((10.0, 5.0, 7.0))

    def descended(*_, most, **__):
        limits.append(most)
        return next(costs), {}

    monkeypatch.setattr(candidates, "descend", descended)
    assert approach(subject, subject.nominal, [{}] * 3) == (5.0, {})
    assert limits == [np.inf, about(10.0), about(5.0)]


@pytest.mark.parametrize(("unknown", "classes"), [(0.0, ()), (5.0, (("first", "second"),))])
def test_what_no_model_explains_hides_small_differences_of_effects(unknown, classes):
    laws = {"first": {1: 1.0}, "second": {1: 1.0, 2: 0.05}}
    assert diagnose_subject(heard(laws, {1: 1.0, 5: unknown})).diagnosis.alias_classes == classes


def test_a_gap_that_shows_in_no_effect_is_unknown_without_a_port():
    answer = diagnose_subject(heard({"first": {1: 1.0}, "second": {2: 1.0}}, {5: 0.3})).diagnosis
    assert answer.gap.present
    assert (answer.verdict.kind, answer.verdict.ports) == ("unknown", ())
    assert answer.gap.p_value < 0.01


def test_a_sensor_is_proposed_that_tells_apart_what_no_further_run_does():
    difference = 0.02
    laws = {"one": {1: 1.0}, "other": {1: 1.0, 2: 2e-4, -1: difference}}
    diagnosed = diagnose_subject(heard(laws, {1: 1.0}))
    answer = diagnosed.diagnosis.to_dict()
    assert answer["verdict"]["kind"] == "ambiguous"
    assert answer["next_experiment"] is None
    sensor = answer["added_sensor"]
    assert (sensor["id"], set(sensor["between"])) == ("second reading", {"one", "other"})
    of_a_run = difference * np.array(STRENGTHS) * np.sqrt(TIME.size) / SIGMA
    distance = np.sqrt(5 * np.sum(of_a_run**2))
    assert sensor["separation_sigma"] == pytest.approx(distance / 2 - 1.2816, rel=0.01)  # in nine cases of ten
    assert "Or add a sensor: second reading" in str(diagnosed)
    # One that reads no better is none to add.
    assert diagnose_subject(heard({**laws, "other": {1: 1.0, -1: 1e-4}}, {1: 1.0})).diagnosis.added_sensor is None


@pytest.mark.parametrize("told", [{2: 0.0005}, {-1: 0.004}])
def test_nothing_is_proposed_that_would_not_settle_the_matter(told, monkeypatch):
    subject = heard({"one": {1: 1.0}, "other": {1: 1.0, **told}}, {1: 1.0})
    diagnosed = diagnose_subject(subject)
    assert diagnosed.diagnosis.verdict.kind == ("ambiguous" if 2 in told else "effect")
    assert diagnosed.diagnosis.equal == (() if 2 in told else ((("one",), ("other",)),))
    assert (diagnosed.diagnosis.next_experiment, diagnosed.diagnosis.added_sensor) == (None, None)
    assert ("fmuid design --for diagnosis searches for a run" in str(diagnosed)) is (2 in told)
    if -1 in told:
        monkeypatch.setattr("fmuid.diagnosis.decide.SAME", 2.0)
        monkeypatch.setattr("fmuid.diagnosis.next_experiment.SAME", 2.0)
        assert diagnose_subject(subject).diagnosis.added_sensor is not None


def test_only_what_fits_as_well_as_its_rival_is_refitted_without_each_run(monkeypatch):
    subject = heard({"law": {2: 1.0}}, {2: 1.0, 3: 0.5})
    cost = fit_effects(subject, subject.effects, [{}]).fit.cost
    monkeypatch.setattr(candidates, "leaving_out", lambda *_, chords: chords)
    chords = [fit_effects(subject, subject.effects, [{}], rival=rival) for rival in (np.inf, cost / 2, 0.0)]
    assert chords == [CHORDS, 1, 0]


def test_no_run_is_proposed_in_which_the_outputs_run_away():
    """The two laws differ in a run beyond the recorded ones, if the reading grows there; not without limit."""

    @dataclass(frozen=True)
    class Growing(Reading):
        growth: float

        def simulate(self, task, parameters):
            beyond = np.abs(task.inputs["u"]) > max(STRENGTHS)
            return super().simulate(task, parameters) * np.where(beyond, self.growth, 1.0)

    laws = {"one": {1: 1.0}, "other": {1: 1.0, 2: 0.004}}
    subject = heard(laws, {1: 1.0, 2: 0.002})

    def proposed(growth):
        cases = tuple(replace(case, simulator=Growing(laws, growth)) for case in subject.model.cases)
        growing = replace(subject, model=replace(subject.model, cases=cases))
        return suggest(growing, [fit_effects(growing, [effect], [{}]) for effect in growing.effects])

    assert proposed(1.9).description == "as e3, with its input times 1.5"
    assert proposed(1e12) is None


def test_a_known_effect_beside_an_unknown_one_is_a_part_of_the_answer(monkeypatch):
    """The reading goes wrong in a way that is no law of the catalogue: the asymmetry is named, and what is left."""
    subject = misread(plant({"a": 0.01}), lambda v, _: 0.004 * np.sin(40.0 * v))
    answer = diagnose_subject(subject).diagnosis
    assert answer.verdict.kind == "partial"
    assert answer.verdict.effects == ("asymmetry",)
    assert answer.verdict.rest is not None
    assert answer.verdict.rest.gap == pytest.approx(answer.gap.corrected)
    assert answer.verdict.rest.where.startswith("v in ")
    for most in (1, 0):  # effects that probabilities were calibrated on
        monkeypatch.setattr("fmuid.diagnosis.decide.MOST_CALIBRATED", most)
        verdict = diagnose_subject(subject, calibration=Calibration()).diagnosis.verdict
        assert (verdict.kind, verdict.provisional) == ("partial", most == 0)


@pytest.mark.parametrize(
    ("truth", "error", "verdict"),
    [
        ({}, (0.03, 0.004), ("unknown", (), ("reading",))),
        ({"a": 0.02}, (0.03, 0.015), ("partial", ("asymmetry",))),
    ],
)
def test_what_leaves_a_rest_at_its_own_place_is_not_named(truth, error, verdict):
    """A gain of the reading closes most of the gap, but one other error of the reading closes all of it."""
    gain, wave = error
    given = diagnose_subject(
        misread(plant(truth), lambda v, _: gain * v + wave * np.sin(40.0 * v))
    ).diagnosis.verdict
    assert (given.kind, given.effects, given.ports)[: len(verdict)] == verdict
    assert given.rest is None or given.rest.where.endswith("(it enters at reading)")


@pytest.mark.parametrize("repeats", [1, 5])
def test_what_is_not_true_nine_times_in_ten_is_provisional(repeats):
    subject = heard({"first": {1: 1.0}, "second": {2: 1.0}}, {1: 1.0}, repeats=repeats)
    for offset, provisional in ((6.0, False), (-4.0, True)):
        diagnosed = diagnose_subject(subject, calibration=Calibration({"effect": (offset, 1.0)}, 50, "of a test"))
        assert (diagnosed.diagnosis.verdict.kind, diagnosed.diagnosis.verdict.provisional) == (
            "effect",
            provisional,
        )
        likeliest = next(a for a in diagnosed.diagnosis.answers if a.effects == ("first",))
        assert (likeliest.probability > 0.9) is (offset > 0.0)
        assert diagnosed.diagnosis.gap.corrected < 0.5
        assert diagnosed.diagnosis.best.effects == diagnosed.diagnosis.verdict.effects == ("first",)
        assert ("Possibly," in str(diagnosed)) is provisional  # less likely than not


def test_laws_of_one_place_that_do_the_same_are_named_once():
    laws = {"plain": {1: 1.0}, "other": {1: 1.0}}
    answer = diagnose_subject(heard(laws, {1: 1.0}, ports=dict.fromkeys(laws, "here"))).diagnosis
    assert (answer.verdict.kind, answer.verdict.effects) == ("effect", ("plain",))
    assert answer.answers[0].probability > 0.9
    assert "In these runs, other would be the same as plain." in answer.notes
    apart = diagnose_subject(heard(laws, {1: 1.0})).diagnosis
    assert apart.verdict.effects == ("plain",)  # one model with two names, at two places
    assert apart.equal == ((("plain",), ("other",)),)
    assert set(apart.verdict.ports) == {"at plain", "at other"}


@pytest.mark.parametrize(
    ("port", "ports"), [("screw.shaft", {"screw.d", "screw.shaft"}), ("nut", {"screw.d", "nut"})]
)
def test_a_value_of_a_component_and_a_law_at_its_port_that_do_the_same_are_named_once(port, ports):
    laws = {"law": {1: 1.0}, "value": {1: 1.0}}
    subject = heard(laws, {1: 1.0}, ports={"law": port, "value": "screw.d"})
    law, value = subject.effects
    effects = (law, replace(value, id="value@screw.d", law="value"))
    catalogue = replace(subject.catalogue, effects={e.id: e for e in effects})
    verdict = diagnose_subject(replace(subject, effects=effects, catalogue=catalogue)).diagnosis.verdict
    assert (verdict.kind, verdict.effects, set(verdict.ports)) == ("effect", ("value@screw.d",), ports)


def test_an_effect_is_unknown_if_it_is_far_likelier_than_what_imitates_it():
    """A hilly track is no law of speed, though the laws of friction close three quarters of the gap together."""
    answer = diagnose_subject(plant({"hill": 0.1})).diagnosis
    assert (answer.verdict.kind, answer.verdict.ports) == ("unknown", ("friction",))


def test_what_a_further_law_at_the_same_place_adds_to_a_nearly_closed_gap_is_the_shape_of_the_first():
    """Where it acts elsewhere, it is a second cause, however small."""
    laws = {"first": {1: 1.0}, "second": {2: 1.0}}
    truth = {1: 3.0, 2: 0.1}
    for ports, named in (
        ({"first": "a", "second": "a"}, {"first"}),
        ({"first": "a", "second": "b"}, {"first", "second"}),
    ):
        verdict = diagnose_subject(heard(laws, truth, ports=ports)).diagnosis.verdict
        assert (verdict.kind, set(verdict.effects)) == ("effect", named)
    # A held value acts wherever its component does.
    subject = heard(laws, truth)
    first, second = subject.effects
    held = replace(subject, effects=(first, replace(second, id="value@second", law="value")))
    assert diagnose_subject(held).diagnosis.verdict.effects == ("first",)
    # A lag is no shape of a law of the same signal's value.
    late = heard({"first": {1: 1.0}, "y.lag": {2: 1.0}}, truth, ports={"first": "a", "y.lag": "a"})
    first, lag = late.effects
    late = replace(late, effects=(first, replace(lag, law="lag")))
    assert set(diagnose_subject(late).diagnosis.verdict.effects) == {"first", "y.lag"}
    # But it is one of the shapes of a delay.
    later = replace(late, effects=(replace(first, law="delay"), replace(lag, law="lag")))
    assert diagnose_subject(later).diagnosis.verdict.effects == ("first",)


def test_a_nominal_refit_gets_out_of_a_local_minimum_that_an_effect_got_out_of():
    subject = plant({})
    good = fit_effects(subject, (), [{}])
    narrow = [replace(u, lower=u.start - 1e-6, upper=u.start + 1e-6) for u in subject.nominal]
    stuck = replace(good, fit=refit(subject.model.predict, subject.observed, narrow))
    assert stuck.fit.cost > 10.0 * good.fit.cost
    candidate = fit_effects(subject, [subject.effects[0]], [{}])
    assert better_nominal(subject, stuck, [candidate]).fit.cost == pytest.approx(good.fit.cost, rel=1e-3)
    assert better_nominal(subject, good, [candidate]) is None
    assert better_nominal(subject, stuck, []) is None


def test_a_refit_gets_out_of_a_local_minimum_by_setting_a_parameter_back():
    subject = plant({"square": 0.3})
    effects = [e for e in subject.effects if e.id == "quadratic"]
    good = fit_effects(subject, effects, [{}])
    unknowns = subject.nominal + effects[0].unknowns
    narrow = [
        replace(u, start=2.0 * u.start, upper=2.0 * u.start, lower=2.0 * u.start - 1e-6) if u.name == "m" else u
        for u in unknowns
    ]
    stuck = replace(good, fit=refit(subject.model.predict, subject.observed, narrow))
    assert stuck.fit.cost > 10.0 * good.fit.cost
    assert escaped(subject, effects, stuck).fit.cost == pytest.approx(good.fit.cost, rel=1e-3)
    assert escaped(subject, effects, good) is good


class Coarse(Mass):
    """A solver with an error at loose tolerances: away from the start values, or with an effect."""

    default_tolerance = 1e-3

    def simulate(self, task, parameters):
        away = parameters.get("m", 0.8) - 0.8 + parameters.get("square", 0.0)
        error = 1e2 * (task.tolerance or self.default_tolerance) * away
        return super().simulate(task, parameters) + error


def test_a_law_with_a_shape_is_tried_where_one_fits_that_its_trials_do_not_tell_it_from(monkeypatch):
    quadratic = EFFECTS["quadratic"]
    shaped = replace(
        quadratic,
        id="shaped",
        unknowns=(*quadratic.unknowns, *EFFECTS["asymmetry"].unknowns),
        neutral={"square": 0.0, "a": 0.0},
        shapes=frozenset({"a"}),
    )
    subject = plant({"square": 0.2, "a": 0.0042}, effects={**EFFECTS, "shaped": shaped})
    best, other = (fit_effects(subject, [subject.by_id[id]], [{}]) for id in ("asymmetry", "quadratic"))
    monkeypatch.setattr("fmuid.diagnosis.diagnose.search", lambda *_, **__: ([best, other], best))
    outcome = diagnose_subject(subject)
    assert "shaped" in {twin.effect for s in outcome.scores if s.effect == "quadratic" for twin in s.same}
    assert outcome.diagnosis.verdict.effects == ("shaped",)


class CoarseWithEffect(Mass):
    """A solver with an error at loose tolerances where the quadratic effect is on."""

    default_tolerance = 1e-3

    def simulate(self, task, parameters):
        error = 1e2 * (task.tolerance or self.default_tolerance) * parameters.get("square", 0.0)
        return super().simulate(task, parameters) + error


def test_all_that_may_be_left_open_is_simulated_well_enough(monkeypatch):
    subject = plant({"tilt": 0.0007})
    cases = tuple(
        replace(c, simulator=CoarseWithEffect(), task=replace(c.task, tolerance=1e-3)) for c in subject.model.cases
    )
    subject = replace(subject, model=replace(subject.model, cases=cases))
    best, other = (fit_effects(subject, [subject.by_id[id]], [{}]) for id in ("tilt", "quadratic"))
    assert other.fit.cost > 1.02 * best.fit.cost
    assert other.fit.values["square"] != 0.0
    monkeypatch.setattr("fmuid.diagnosis.diagnose.search", lambda *_, **__: ([best, other], best))
    monkeypatch.setattr("fmuid.diagnosis.diagnose.singles_of", lambda _: [])  # trials that were looked at before
    model = diagnose_subject(subject).subject.model
    assert all(c.task.tolerance == 1e-3 for c in model.cases_at(best.fit.values))
    assert all(c.task.tolerance <= 1e-4 for c in model.cases_at(other.fit.values))


def test_a_tolerance_that_does_for_the_start_values_is_tightened_where_it_does_not():
    subject = plant({})
    cases = tuple(
        replace(c, simulator=Coarse(), task=replace(c.task, tolerance=1e-3)) for c in subject.model.cases
    )
    subject = replace(subject, model=replace(subject.model, cases=cases))
    assert tightened(subject, [{"m": 0.8}]) is subject
    tighter = tightened(subject, [{"m": 1.0}])
    assert all(c.task.tolerance <= 1e-5 for c in tighter.model.cases)
    assert tightened(tighter, [{"m": 0.8}]) is tighter
    # An effect's tolerance is that of points with this effect alone.
    effect = {"m": 0.8, "square": 0.2}
    with_effect = tightened(subject, [{"m": 0.8}, effect])
    for k in range(len(cases)):
        assert with_effect.model.cases_at(effect)[k].task.tolerance <= 1e-5
        assert with_effect.model.cases_at({"m": 0.8, "cube": 0.1})[k].task.tolerance == 1e-3
    (coarse,), (fine,) = subject.model.predict([effect]), with_effect.model.predict([effect])
    (exact,) = plant({}).model.predict([effect])
    assert all(np.abs(c - e).max() > 30 * np.abs(f - e).max() for c, f, e in zip(coarse, fine, exact, strict=True))
    assert tightened(with_effect, [effect]) is with_effect
    # A diagnosis sees to it by itself: the true mass is 1, and nothing is missing.
    assert diagnose_subject(subject).diagnosis.verdict.kind == "complete"


def test_a_start_is_judged_by_what_the_other_parameters_would_make_of_it():
    """They have shifted to imitate an effect, so that its true size fits worse than none until they return."""
    subject = plant({"square": 0.3})
    nominal = fit_effects(subject, (), [{}])
    tiny, true = ({**nominal.fit.values, "square": size} for size in (1e-4, 0.3))
    assert _best_start(subject, [tiny, true])[0] is tiny
    assert _best_start(subject, [tiny, true], nominal_basis(nominal.fit, subject.observed))[0] is true


def test_an_effect_at_implausible_bounds_does_not_take_another_one_with_it():
    subject = heard({"first": {1: 1.0}, "second": {2: 1.0}}, {1: 3.0, 2: 0.3})
    first, second = subject.effects
    short = replace(second, unknowns=(replace(second.unknowns[0], lower=-0.2, upper=0.2),))
    verdict = diagnose_subject(replace(subject, effects=(first, short))).diagnosis.verdict
    assert (verdict.kind, verdict.effects) == ("effect", ("first",))
    assert verdict.rest is not None
    # An equivalent effect also stays open.
    subject = heard({"first": {1: 1.0}, "twin": {1: 1.0, 2: 5e-3}, "second": {2: 1.0}}, {1: 3.0, 2: 0.3})
    verdict = diagnose_subject(replace(subject, effects=(*subject.effects[:2], short))).diagnosis.verdict
    assert (verdict.kind, set(verdict.one_of)) == ("ambiguous", {("first",), ("twin",)})


@pytest.mark.parametrize(
    ("strained", "kind", "effects"), [({"one"}, "effect", ("other",)), ({"one", "other"}, "unknown", ())]
)
def test_an_answer_at_implausible_bounds_is_none_while_another_is_open(strained, kind, effects, monkeypatch):
    monkeypatch.setattr("fmuid.diagnosis.decide.strained", lambda fitted, *_: bool(strained & set(fitted.effects)))
    answer = diagnose_subject(heard({"one": {1: 1.0}, "other": {1: 1.0, 2: 5e-4}}, {1: 1.0})).diagnosis
    assert (answer.verdict.kind, answer.verdict.effects) == (kind, effects)


def test_a_special_case_is_also_sought_where_the_general_one_ended(monkeypatch):
    """A search for dry friction that begins too far away finds nothing; with a threshold, it does."""
    plain, general = (
        Effect(n, "", "w", (Unknown(n, 0.0, 0.0, 9.0, 0.1),), {n: 0.0}, (), law=n) for n in ("plain", "general")
    )
    monkeypatch.setattr(
        candidates, "score_effects", lambda *_: [SimpleNamespace(effect=e.id) for e in (plain, general)]
    )
    ends = {"plain": (90.0, {"J": 1.0, "plain": 0.1}), "general": (20.0, {"J": 2.0, "general": 3.0})}
    monkeypatch.setattr(candidates, "approach_effect", lambda _, __, score, ___: ends[score.effect])
    at = {(2.0, 3.0): 25.0}
    monkeypatch.setattr(
        candidates, "approach", lambda _, __, starts, ___: (at[starts[0]["J"], starts[0]["plain"]], starts[0])
    )
    subject = SimpleNamespace(
        model=SimpleNamespace(predict=None), observed=None, effects=(), by_id={"plain": plain, "general": general}
    )
    fit = SimpleNamespace(cost=100.0, unknowns=())
    assert candidates.costs_with(subject, fit) == {"plain": 90.0, "general": 20.0}
    assert candidates.costs_with(subject, fit, {"plain": "general"}) == {"plain": 25.0, "general": 20.0}
