"""Scores, aliases, decoys and refits, each on what has a known answer."""

from dataclasses import replace

import numpy as np
import pytest
from plants import EFFECTS, NOMINAL, PORTS, REGIMES, TWIN, plant

from fmuid.core.errors import SimulationError
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.diagnosis.candidates import fit_effects, score_further
from fmuid.diagnosis.cross_validation import closure
from fmuid.diagnosis.free_functions import (
    bases,
    fit_decoys,
    harmonics,
    hats,
    own_bases,
    quantile_knots,
    responses_of,
    trajectories,
)
from fmuid.diagnosis.observed import Observed, project_off
from fmuid.diagnosis.refit import descend, refit
from fmuid.diagnosis.scores import alias_classes, nominal_basis, score_effects, stack, without_aliases
from fmuid.effects.effect import Effect, Regime, Unknown
from fmuid.simulation.runners import in_process

TIME = np.linspace(0.0, 1.0, 501)


@pytest.fixture(scope="module")
def asymmetric():
    """A rig whose friction depends on direction, its model refitted, and the scores of the effects."""
    subject = plant({"a": 0.05}, effects={**EFFECTS, "cable": TWIN})
    nominal = fit_effects(subject, (), [{}])
    return subject, nominal, score_further(subject, nominal)


def test_the_nominal_parameters_are_found_without_an_effect():
    fit = fit_effects(plant({}), (), [{}]).fit
    assert fit.converged
    assert fit.values == pytest.approx({"m": 1.0, "d": 0.8, "Fc": 0.5}, rel=5e-3)


def test_nothing_is_simulated_twice():
    model, jobs = plant({}).model, []

    def count(asked):
        jobs.extend(asked)
        return in_process(asked)

    model = replace(model, runner=count)
    n = len(model.cases)
    (first,) = model.predict([{"m": 0.8}])
    again, neutral, other, shown = model.predict(
        [{"m": 0.8}, {"m": 0.8, "a": 0.0}, {"m": 0.9}, {"m": 0.8, "v.gain": 1.03}]
    )
    assert len(jobs) == 2 * n
    assert all(np.array_equal(a, b) for f in (again, neutral) for a, b in zip(f, first, strict=True))
    assert not np.array_equal(other[0], first[0])
    assert np.allclose(shown[0][1], 1.03 * first[0][1])
    drive = [np.full(400, 0.1) if k == 1 else np.zeros(400) for k in range(n)]
    (driven,) = model.predict_driven({"m": 0.8}, [{"port": drive}])
    assert [not np.array_equal(a, b) for a, b in zip(driven, first, strict=True)] == [k == 1 for k in range(n)]


def test_scores_credit_nothing_that_refitting_could_imitate(asymmetric):
    subject, nominal, scores = asymmetric
    basis = nominal_basis(nominal.fit, subject.observed)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-9)
    for score in scores:
        if score.signature is not None:
            assert np.linalg.norm(score.signature) == pytest.approx(1.0)
            assert np.abs(basis.T @ score.signature).max() < 1e-9
    # What a nominal parameter does is gone entirely.
    moved = stack([j[:, 1] for j in nominal.fit.jacobian], subject.observed)
    assert np.linalg.norm(project_off(moved, basis)) < 1e-9 * np.linalg.norm(moved)


def test_the_true_effect_scores_best_and_knows_its_size(asymmetric):
    _, _, scores = asymmetric
    assert scores[0].effect in ("asymmetry", "tilt", "cable")
    assert scores[0].drop > 2 * next(s for s in scores if s.effect == "quadratic").drop
    best = next(s for s in scores if s.effect == "asymmetry")
    assert best.scale * best.trial["a"] == pytest.approx(0.05, rel=0.1)


def test_effects_of_the_same_signature_are_one_class(asymmetric):
    _, _, scores = asymmetric
    signatures = {s.effect: s.signature for s in scores if s.signature is not None}
    (alike,) = alias_classes(signatures, threshold=0.95)
    assert "tilt" in alike
    assert [t.effect for s in scores for t in s.same] == ["cable"]
    assert "quadratic" not in alike
    e = np.eye(3)
    assert alias_classes({"a": e[0], "b": e[1]}, threshold=0.95) == ()
    assert alias_classes({"c": e[0], "b": -e[0], "a": e[2]}, threshold=0.95) == (("b", "c"),)
    # Classes are chained: a ~ b and b ~ c puts a and c together.
    chain = {n: np.array([np.cos(x), np.sin(x), 0.0]) for n, x in (("a", 0.0), ("b", 0.3), ("c", 0.6))}
    assert alias_classes(chain, threshold=0.95) == (("a", "b", "c"),)


def test_runs_that_agree_by_chance_make_no_score_certain():
    """Their scatter counts as if the floor's had been seen in four more experiments."""
    subject = plant({"a": 0.05})
    nominal = fit_effects(subject, (), [{}])
    runs = tuple(replace(r, values=np.broadcast_to(r.mean, r.values.shape)) for r in subject.observed.runs)
    observed = replace(subject.observed, runs=runs)
    scores = score_effects(subject.model.predict, observed, nominal.fit, subject.effects)
    best, repeats = scores[0], runs[0].n_repeats
    assert best.per_run == pytest.approx(np.sqrt(best.drop * (repeats - 1 + 4) / 4))


def test_basis_functions_are_what_they_are_named():
    values = [np.linspace(-1.0, 1.0, 101)]
    knots = quantile_knots(values, 5)
    basis = hats(values, knots)
    np.testing.assert_allclose(sum(b[0] for b in basis), 1.0)
    np.testing.assert_allclose(sum(k * b[0] for k, b in zip(knots, basis, strict=True)), values[0])
    assert len(harmonics(values, (1, 2))) == 4
    at_rest = quantile_knots([np.zeros(50)], 5)
    assert len(at_rest) == 1


def decoys_of(subject, observed, fit, port, families):
    return fit_decoys(responses_of(subject.model, observed, fit, PORTS[port], families), fit, observed)


def test_a_free_function_of_position_finds_what_no_effect_explains():
    subject = plant({"grip": 0.4})
    nominal = fit_effects(subject, (), [{}])
    paths = trajectories(subject.model, nominal.fit.values, REGIMES)
    families = {**bases(paths, REGIMES), "position, fine": hats(paths["position"], np.linspace(-1.0, 1.0, 60))}
    by_name = {d.over: d for d in decoys_of(subject, subject.observed, nominal.fit, "friction", families)}
    assert by_name["position, fine"].held_out.gap < nominal.held_out.gap
    assert closure(nominal.held_out, by_name["speed"].held_out) < 0.3


def test_a_sensor_that_also_shows_another_signal_is_found_out():
    subject = plant({})
    cases = []
    for case in subject.model.cases:
        x, v = case.channels
        cases.append(replace(case, channels=(x, replace(v, repeats=v.repeats + 0.05 * x.repeats))))
    model = replace(subject.model, cases=tuple(cases))
    subject = replace(subject, model=model, observed=Observed.from_runs(model.runs))
    nominal = fit_effects(subject, (), [{}])
    paths = trajectories(subject.model, nominal.fit.values, REGIMES)
    families = {"speed": hats(paths["speed"], np.linspace(-2.0, 2.0, 5))}
    decoys = decoys_of(subject, subject.observed, nominal.fit, "reading", families)
    best = min(decoys, key=lambda d: d.held_out.gap)
    assert best.over == "other signals"
    assert closure(nominal.held_out, best.held_out) > 0.8


def test_a_law_of_a_confined_variable_is_sought_at_its_port_alone():
    """A command that is weaker at some positions is a law of the command, and no friction."""
    subject = plant({})
    nominal = fit_effects(subject, (), [{}])
    regimes = {**REGIMES, "turn": Regime("turn", "x", "angle", orders=(40,))}
    paths = trajectories(subject.model, nominal.fit.values, regimes)
    paths["drive"] = tuple(case.task.inputs["u"] for case in subject.model.cases)
    regimes["drive"] = Regime("drive", "u", ports=("friction",))
    free, confined = bases(paths, regimes), own_bases(paths, regimes, "friction")
    assert not any("drive" in over for over in free)
    assert confined.keys() == {"drive", "drive and turn"}
    assert own_bases(paths, regimes, "reading") == {}
    swing = confined["drive and turn"][0]
    (pushed,) = subject.model.predict_driven(nominal.fit.values, [{"port": [0.1 * s for s in swing]}])
    runs = [
        replace(r, values=r.values + (p - q))
        for r, p, q in zip(
            subject.observed.runs, pushed, subject.model.predict([nominal.fit.values])[0], strict=True
        )
    ]
    observed = Observed(tuple(runs), subject.observed.noise)
    again = fit_effects(replace(subject, observed=observed), (), [{}])
    decoys = decoys_of(subject, observed, again.fit, "friction", {**free, **confined})
    at_port = sorted(decoys, key=lambda d: d.held_out.gap)
    assert at_port[0].over == "drive and turn"
    assert closure(again.held_out, at_port[0].held_out) > 0.7
    assert at_port[1].held_out.gap > 2.0 * at_port[0].held_out.gap


def test_a_parameter_never_leaves_its_bounds():
    subject = plant({"d": 0.0})
    fit = refit(subject.model.predict, subject.observed, NOMINAL)
    assert fit.values["d"] >= 0.0
    assert fit.converged


def one_run(time, course, noise=0.01):
    """Three repeats of a run."""
    values = course + noise * np.random.default_rng(0).standard_normal((3, 1, len(time)))
    return Observed.from_runs([RepeatedRuns("run", "bench", time, ("y",), values)])


def test_a_refit_is_at_least_as_good_as_every_start():
    """A frequency has many local minima: from near the truth it is found, from afar it is not."""
    time = np.linspace(0.0, 3.0, 200)
    observed = one_run(time, np.sin(7.0 * time))

    def predict(points, near=None):
        return [(np.sin(p["w"] * time)[None],) for p in points]

    unknown = [Unknown("w", 2.0, 0.0, 20.0, 0.01)]
    stuck = refit(predict, observed, unknown)
    assert abs(stuck.values["w"] - 7.0) > 1.0
    both = refit(predict, observed, unknown, starts=[{}, {"w": 6.8}])
    assert both.values["w"] == pytest.approx(7.0, rel=1e-3)
    assert both.cost <= min(
        refit(predict, observed, unknown, starts=[s], max_iterations=0).cost for s in ({}, {"w": 6.8})
    )


def test_a_refit_goes_around_values_with_which_the_model_grows_without_limit():
    time = np.linspace(0.0, 1.0, 200)
    observed = one_run(time, np.exp(2.0 * time))

    def predict(points, near=None):
        return [(np.exp(p["k"] * time)[None],) for p in points]

    # Where the squares of the predictions are no longer numbers, a refit cannot begin, but others go on.
    unknown = [Unknown("k", 400.0, -9.0, 700.0, 0.01)]
    with pytest.raises(SimulationError, match="grow beyond all numbers"):
        refit(predict, observed, unknown)
    assert refit(predict, observed, unknown, starts=[{}, {"k": 1.0}]).values["k"] == pytest.approx(2.0, rel=1e-2)


def test_a_refit_ends_beside_values_with_which_nothing_can_be_simulated():
    """A controller is stable up to a gain that the true one nearly has: a step beyond it is taken back."""
    time = np.linspace(0.0, 1.0, 200)
    observed = one_run(time, 2.0 * time)

    def predict(points, near=None):
        failed = SimulationError("unstable")
        return [failed if p["k"] > 2.02 else (p["k"] * time[None],) for p in points]

    fit = refit(predict, observed, [Unknown("k", 1.5, -9.0, 9.0, 0.05)])
    assert fit.values["k"] == pytest.approx(2.0, abs=0.01)
    slope = observed.whiten((time[None],))[0]
    assert np.allclose(fit.jacobian[0][:, 0], slope)


def test_a_refit_gets_over_ripples_of_the_cost():
    """What hits and sticks makes ripples that local slopes see and no step keeps; the trend leads to the truth."""
    time = np.linspace(0.0, 1.0, 200)

    def model(k, d):
        ripple = 0.03 * np.sin(2 * np.pi * k / 0.023) * np.cos(40.0 * time)
        return k * time + d * time**2 + ripple * (abs(k - 2.0) > 0.03)

    observed = one_run(time, model(2.0, -0.5), noise=0.001)

    def predict(points, near=None):
        return [(model(p["k"], p["d"])[None],) for p in points]

    unknowns = [Unknown("k", 1.0, 0.0, 9.0, 0.01), Unknown("d", -1.0, -9.0, 9.0, 0.01)]
    fit = refit(predict, observed, unknowns)
    assert fit.values == pytest.approx({"k": 2.0, "d": -0.5}, rel=0.01)
    # There is no point in it if another model fits better than the trend promises.
    ended = refit(predict, observed, unknowns, rival=fit.cost)
    assert ended.cost > 2.0 * fit.cost
    assert ended.evaluations < 0.6 * fit.evaluations


def test_a_refit_ends_where_what_it_gains_would_not_make_it_of_use():
    time = np.linspace(0.0, 1.0, 200)
    observed = one_run(time, np.exp(-time))

    def predict(points, near=None):
        return [(np.exp(-((p["k"] - 1.0) ** 2) - time)[None] + 0.01 * p["d"] ** 4,) for p in points]

    unknowns = [Unknown("k", 1.0, 0.0, 9.0, 0.01), Unknown("d", 8.0, -9.0, 9.0, 0.01)]
    fit = refit(predict, observed, unknowns, tolerance=1e-9)
    assert fit.values["d"] == pytest.approx(0.0, abs=1.0)
    again = refit(predict, observed, unknowns, tolerance=1e-9, most=100.0 * max(fit.cost, 1.0))
    assert again.values == fit.values
    # The cost falls by a constant share: from some iteration on, those to come cannot gain what is left.
    ended = refit(predict, observed, unknowns, tolerance=1e-9, most=-1e6 * fit.cost - 1e6)
    assert ended.evaluations < fit.evaluations
    assert not ended.converged

    def searched(most):
        calls = []
        counted = lambda points, near=None: calls.extend(points) or predict(points)  # noqa: E731
        end = descend(counted, observed, unknowns, {}, tangents=lambda p, n: {}, max_iterations=6, most=most)
        return end, len(calls)

    end, simulated = searched(np.inf)
    assert searched(end[0]) == (end, simulated)
    assert searched(-1e6 * fit.cost - 1e6)[1] < simulated


def test_a_search_begins_whatever_the_rounding_of_its_scaled_start():
    """A start divided by the step of its parameter and multiplied again may be another number."""
    time, rng = np.linspace(0.0, 1.0, 200), np.random.default_rng(1)
    observed, points = one_run(time, 2.0 * time), []

    def predict(asked, near=None):
        points.extend(p["k"] for p in asked)
        return [(p["k"] * time[None],) for p in asked]

    for start, step in rng.uniform(0.01, 1.0, (50, 2)):
        points.clear()
        _, values = descend(
            predict, observed, [Unknown("k", start, 0.0, 9.0, step)], {}, tangents=None, max_iterations=6
        )
        assert values["k"] == pytest.approx(2.0, rel=1e-2)
        assert not any(p != start and p == pytest.approx(start, rel=1e-12) for p in points)


def test_a_refit_begins_whatever_its_rival_since_slopes_promise_too_little_where_they_bend():
    time = np.linspace(0.0, 1.0, 200)
    observed = one_run(time, time + 0.1 * np.sin(40.0 * time))

    def predict(points, near=None):
        return [(p["k"] * time[None],) for p in points]

    unknown = [Unknown("k", 0.5, -9.0, 9.0, 0.01)]
    best = refit(predict, observed, unknown)
    assert refit(predict, observed, unknown, rival=0.5 * best.cost).values == best.values


def test_what_is_known_beforehand_of_an_effect_weighs_against_the_data():
    rng = np.random.default_rng(0)
    runs = [RepeatedRuns("e", "bench", TIME, ("y",), TIME + 0.1 * rng.standard_normal((5, 1, len(TIME))))]
    observed = Observed.from_runs(runs)

    def predict(points, near=None):
        return [[(p["k"] * TIME)[None]] for p in points]

    free, *bound = (
        refit(predict, observed, [Unknown("k", 0.5, -9.0, 9.0, 0.01, sd)]) for sd in (np.inf, 0.2, 1e-4)
    )
    (column,) = free.jacobian
    information = observed.repeats[0] * float(column[:, 0] @ column[:, 0])
    for fit, sd in zip(bound, (0.2, 1e-4), strict=True):
        expected = (information * free.values["k"] + 0.5 / sd**2) / (information + 1 / sd**2)
        assert fit.values["k"] == pytest.approx(expected, rel=1e-3)


def test_effects_that_no_data_tell_apart_are_said_once_by_the_more_usual_and_simpler_one():
    rng = np.random.default_rng(0)
    wave, other = np.sin(5 * TIME), np.cos(5 * TIME)
    runs = [RepeatedRuns("e", "bench", TIME, ("y",), TIME + wave + 0.1 * rng.standard_normal((5, 1, len(TIME))))]
    observed = Observed.from_runs(runs)

    def predict(points, near=None):
        predictions = []
        for p in points:
            bent = p.get("bent", 0.0) * wave + p.get("bent", 0.0) ** 2 * other
            sizes = p.get("plain", 0.0) + p.get("odd", 0.0) + p.get("two", 0.0)
            predictions.append(
                [(p["k"] * TIME + sizes * wave + bent + p.get("apart", 0.0) * (wave + 0.1 * other))[None]]
            )
        return predictions

    def effect(name, *more, usual=True, trial=1.0):
        unknowns = tuple(Unknown(n, 0.0, -9.0, 9.0, 0.01) for n in (name, *more))
        trials = ({name: trial},)
        neutral = dict.fromkeys((name, *more), 0.0)
        return Effect(name, "", "port", unknowns, neutral, trials, two_sided=True, usual=usual)

    effects = [
        effect("odd", usual=False),
        effect("two", "more"),
        effect("plain", trial=-0.5),
        effect("apart"),
        effect("bent"),
    ]
    fit = refit(predict, observed, [Unknown("k", 1.0, -9.0, 9.0, 0.01)])
    scores = without_aliases(predict, observed, fit, effects, score_effects(predict, observed, fit, effects))
    assert {s.effect: [t.effect for t in s.same] for s in scores} == {
        "plain": ["two", "odd"],
        "apart": [],
        "bent": [],
    }


def test_what_drives_a_port_in_few_steps_has_the_response_of_what_changes_at_every_sample():
    subject = plant({}, repeats=1, experiments=("sine",))
    values, case = {u.name: u.start for u in subject.nominal}, subject.model.cases[0]
    drive = 0.05 * np.sin(2 * np.pi * 0.7 * case.time)
    (plain,), (driven,) = (
        subject.model.predict([values])[0],
        subject.model.predict_driven(values, [{"port": [drive]}])[0],
    )
    every = case.simulator.simulate(replace(case.task, inputs={**case.task.inputs, "port": drive}), values)
    assert np.linalg.norm(driven - every) < 0.01 * np.linalg.norm(every - plain)
