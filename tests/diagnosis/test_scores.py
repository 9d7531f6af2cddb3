"""Scores of effects, and which of them the data tell apart, on vectors worked out by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from fmuid.core.errors import SimulationError
from fmuid.diagnosis import scores
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import Score, nominal_basis, score_effects, stack, without_aliases
from fmuid.effects.effect import Effect, Unknown


def recorded(*deviations):
    """Experiments with the given (R, N) deviations of their runs from the mean; predictions are residuals."""
    runs = [SimpleNamespace(n_repeats=len(d), deviations=np.array(d, dtype=float)[:, None]) for d in deviations]
    return SimpleNamespace(
        runs=runs,
        scatter=[r.deviations[:, 0] for r in runs],
        repeats=np.array([float(r.n_repeats) for r in runs]),
        residuals=tuple,
    )


def fitted(residuals, jacobian, values=()):
    arrays = (tuple(np.array(x, dtype=float) for x in xs) for xs in (residuals, jacobian))
    return Refit((), dict(values), *arrays, 0.0, 0, True)


def effect(name, *trials, two_sided=False, usual=True, more=(), bound=1e9):
    unknowns = tuple(Unknown(n, 0.0, -bound, bound, 0.01) for n in (name, *more))
    neutral = dict.fromkeys((name, *more), 0.0)
    trials = tuple({name: size} for size in trials)
    law = "value" if name.startswith("value@") else "law"
    return Effect(name, "", "port", unknowns, neutral, trials, law=law, two_sided=two_sided, usual=usual)


# Four runs of one experiment and nine of another: components count twice and three times. What the parameter of the
# model does is the first component.
RUNS = ([[0.0, 1.0], [0.0, -1.0], [0.0, 1.0], [0.0, -1.0]], [[3.0, 7.0], [-3.0, -7.0], *[[0.0, 0.0]] * 7])
OBSERVED = recorded(*RUNS)
BASE = fitted([[5.0, 1.0], [-2.0, 0.0]], [[[1.0], [0.0]], [[0.0], [0.0]]], {"k": 2.0})


def moved(size, direction=((7.0, -1.5), (4 / 3, 0.0)), base=BASE.residuals):
    """The residuals of the base, moved by `size` along a direction: (14, -3, 4, 0) as stacked."""
    return [r + size * np.array(d) for r, d in zip(base, direction, strict=True)]


def test_experiments_are_stacked_by_the_roots_of_their_repeats():
    assert list(stack([np.array([5.0, 1.0]), np.array([-2.0])], OBSERVED)) == [10.0, 2.0, -6.0]


def test_a_score_is_what_the_part_of_a_signature_that_refitting_cannot_imitate_explains():
    asked = []

    def predict(points, near=None):
        asked.extend(points)
        return [moved(p["e"]) for p in points]

    (score,) = score_effects(predict, OBSERVED, BASE, [effect("e", 1.0)])
    assert asked == [{"k": 2.0, "e": 1.0}]
    assert score.signature == pytest.approx([0.0, -0.6, 0.8, 0.0])
    assert (score.moved, score.length) == pytest.approx((np.sqrt(14**2 + 3**2 + 4**2), 5.0))
    # The residual, (10, 2, -6, 0), has -1.2 - 4.8 along it.
    assert (score.drop, score.scale) == pytest.approx((36.0, 6.0 / 5.0))
    # Runs scatter by 4 * 0.6^2 and 2 * 2.4^2 about the means of two experiments, which have 3 + 8 degrees of
    # freedom; the floor's variance, 1, counts as if it had been seen in four more.
    variance = (4 * 0.6**2 + 2 * 2.4**2 + 4.0) / (11 / 2 + 4.0)
    assert score.per_run == pytest.approx(6.0 / np.sqrt(variance))


def test_runs_that_were_not_repeated_tell_nothing_of_their_scatter():
    base = fitted([[2.0], [2.0]], [[[0.0]], [[0.0]]])
    along = lambda points, near=None: [[r - p["e"] for r in base.residuals] for p in points]  # noqa: E731
    (score,) = score_effects(along, recorded([[0.0]], [[0.0]]), base, [effect("e", 1.0)])
    assert score.per_run == pytest.approx(np.sqrt(8.0))
    observed = recorded([[0.0]], [[3.0], [-3.0]])
    (score,) = score_effects(along, observed, base, [effect("e", 1.0)])
    amount, part = 2.0 * np.sqrt(3.0), np.sqrt(2 / 3)
    variance = (2 * (3.0 * part) ** 2 + 4.0) / (1 / 2 + 4.0)
    assert score.per_run == pytest.approx(amount / np.sqrt(variance))
    (score,) = score_effects(along, recorded([[0.0]], [[0.0], [0.0]]), base, [effect("e", 1.0)])  # runs that agree
    assert score.per_run == pytest.approx(amount / np.sqrt(4.0 / (1 / 2 + 4.0)))


def test_an_effect_of_one_sign_explains_nothing_the_other_way_round():
    predict = lambda points, near=None: [moved(-p.get("one", p.get("two", 0.0))) for p in points]  # noqa: E731
    both = [effect("one", 1.0), effect("two", 1.0, two_sided=True)]
    first, second = score_effects(predict, OBSERVED, BASE, both)
    assert (first.effect, second.effect) == ("two", "one")
    assert (first.drop, second.drop) == pytest.approx((36.0, 0.0))
    assert (first.scale, second.scale) == pytest.approx((-1.2, -1.2))
    for sign, drop in ((1.0, 0.25), (-1.0, 0.0)):  # a twelfth of that residual
        less = fitted([r / 12.0 for r in BASE.residuals], BASE.jacobian)
        shifted = [[r + sign * d for r, d in zip(less.residuals, moved(1.0, base=(0.0, 0.0)), strict=True)]]
        (score,) = score_effects(lambda points, near=None, to=shifted: to, OBSERVED, less, both[:1])
        assert score.drop == pytest.approx(drop)


def test_an_effect_is_scored_by_its_best_trial_that_can_be_simulated():
    def predict(points, near=None):
        predictions = []
        for p in points:
            if "still" in p:
                predictions.append(moved(0.0))
            elif p.get("broken") or p.get("e") == 3.0:
                predictions.append(SimulationError("the integrator gave up"))
            elif "e" in p:
                predictions.append(moved(1.0, ((0.0, -1.5), (4 / 3 * min(p["e"], 1.0), 0.0))))
            else:
                predictions.append(moved(0.1))
        return predictions

    effects = [
        effect("still", 1.0),
        effect("broken", 1.0),
        effect("e", 0.0, 1.0, 2.0, 3.0),
        effect("small", 1.0),
    ]
    scores = score_effects(predict, OBSERVED, BASE, effects)
    assert [s.effect for s in scores] == ["e", "small", "still", "broken"]
    assert scores[2].trial == {"still": 1.0}
    assert scores[0].trial == {"e": 1.0}  # as good as the one after it
    assert scores[0].drop == pytest.approx(36.0)
    assert (scores[3].drop, scores[3].scale, scores[3].per_run, scores[3].signature) == (0.0, 0.0, 0.0, None)
    assert (scores[3].moved, scores[3].length, scores[3].trial, scores[3].same) == (0.0, 0.0, {}, ())


def test_a_trial_far_larger_than_the_gap_is_scaled_down_until_it_says_something():
    """The plant runs away: at a hundredth of the trial its response is along the residual, and beyond it is not."""

    def predict(points, near=None):
        return [moved(40.0 * p["e"]) if p["e"] <= 0.01 else moved(1e4 * p["e"], ((0, 1), (3, 5))) for p in points]

    (score,) = score_effects(predict, OBSERVED, BASE, [effect("e", 1.0)])
    assert score.drop == pytest.approx(36.0)
    assert score.trial["e"] < 0.01
    assert score.trials == (score.trial,)
    # One that does too little to be seen stays as it is.
    (small,) = score_effects(predict, OBSERVED, BASE, [effect("e", 1e-5)])
    assert small.trials == ({"e": 1e-5},)


@pytest.mark.parametrize(
    ("along_parameter", "across", "seen"),
    [
        (0.0, 1.5e-6, True),
        (0.0, 0.9e-6, False),  # of a standard deviation
        (1e4, 1.1e-2, True),
        (1e4, 0.9e-2, False),  # a millionth of what a parameter of the model does as well
    ],
)
def test_what_moves_nothing_of_its_own_has_no_signature(along_parameter, across, seen):
    direction = ((along_parameter / 2.0, across / 2.0), (0.0, 0.0))
    (score,) = score_effects(
        lambda points, near=None: [moved(-1.0, direction)], OBSERVED, BASE, [effect("e", 1.0)]
    )
    assert (score.signature is not None) is seen
    assert score.length == pytest.approx(across, rel=1e-3)
    assert score.moved == pytest.approx(np.hypot(along_parameter, across))
    if not seen:
        assert (score.drop, score.scale, score.per_run, score.trial) == (0.0, 0.0, 0.0, {"e": 1.0})


def test_a_basis_is_orthonormal_whatever_the_units_of_the_parameters():
    def of(*columns):
        columns = np.array(columns, dtype=float).T
        return nominal_basis(fitted([[0, 0], [0]], [columns[:2], columns[2:]]), recorded([[0.0]] * 4, [[0.0]] * 9))

    (line,) = of([1.0, 0.0, 1.0]).T
    assert line * np.sign(line[0]) == pytest.approx(np.array([2.0, 0.0, 3.0]) / np.sqrt(13.0))
    assert of([1e-9, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0]).shape == (3, 2)
    assert of([0.0, 0.0, 0.0]).shape == (3, 0)
    for apart, rank in (
        (1e-5, 2),
        (1.5e-6, 1),
        (1e-7, 1),
    ):  # columns that differ by less than the accuracy of differences
        basis = of([1.0, 0.0, 0.0], [1.0, apart, 0.0])
        assert basis.shape == (3, rank)
        assert basis.T @ basis == pytest.approx(np.eye(rank))


def score(name, angle, drop=1.0, size=1.0, length=1.0):
    signature = np.array([np.cos(angle), np.sin(angle), 0.0])
    return Score(name, {name: size}, drop, 1.0, 1.0, signature, length, length)


PLAIN = recorded([[0.0, 0.0, 0.0]])
ZERO = fitted([[0.0, 0.0, 0.0]], [np.zeros((3, 1))])


def grouped(effects, scores, predict=None):
    """Return the effects that are listed, each with those that it stands for."""
    linear = {s.effect: s.length * s.signature / s.trial[s.effect] for s in scores if s.signature is not None}

    def straight(points, near=None):
        return [[sum((size * linear[n] for n, size in p.items() if n in linear), np.zeros(3))] for p in points]

    kept = without_aliases(predict or straight, PLAIN, ZERO, effects, scores)
    return {s.effect: [t.effect for t in s.same] for s in kept}


@pytest.mark.parametrize(
    ("drops", "most"),
    [((1.0, 4.0), 5.0), ((100.0, 4.0), 10.0), ((4.0, 100.0), 10.0), ((25.0, 25.0), 5.0)],
)
def test_effects_are_the_same_if_what_they_explain_does_not_tell_them_apart_by_a_deviation(drops, most):
    """The sine of the angle times what the larger explains, at least five standard deviations."""
    for sine, same in ((0.99 / most, True), (1.01 / most, False)):
        scores = [score("a", 0.3, drops[0]), score("b", 0.3 + np.arcsin(sine), drops[1])]
        groups = grouped([effect("a", 1.0), effect("b", 1.0)], scores)
        assert groups == ({"a": ["b"]} if same else {"a": [], "b": []})


@pytest.mark.parametrize(
    ("first", "second", "named"),
    [
        (effect("a", 1.0, usual=False), effect("b", 1.0, more=("c", "d")), "b"),  # the usual one
        (effect("a", 1.0, more=("c",)), effect("b", 1.0), "b"),  # the simpler one
        (effect("a", 1.0), effect("value@b", 1.0), "value@b"),  # a value that is off
        (effect("value@a", 1.0, more=("c",)), effect("b", 1.0), "b"),  # but not before the simpler one
        (effect("a", 1.0), effect("b", 1.0), "a"),
    ],
)
def test_of_effects_that_are_the_same_the_more_usual_and_simpler_one_is_said(first, second, named):
    scores = [score(e.id, 0.0, drop) for e, drop in ((first, 1.0), (second, 2.0))]
    other = first.id if named == second.id else second.id
    assert grouped([first, second], scores) == {named: [other]}


def test_scores_keep_their_order_and_those_that_move_nothing_stay():
    nothing = Score("still", {}, 0.0, 0.0, 0.0, None)
    scores = [score("b", 1.0, 9.0), score("a", 0.0, 4.0), score("c", 0.0, 2.0), score("d", 1.0, 1.0), nothing]
    effects = [effect(n, 1.0) for n in ("not scored", "a", "b", "c", "d", "still")]
    assert list(grouped(effects, scores).items()) == [("b", ["d"]), ("a", ["c"]), ("still", [])]


def test_laws_that_bend_are_compared_once_more_where_both_move_as_much():
    """The trial of one is ten times as large as the other's: there it has bent away by a few degrees."""
    asked = []

    def predict(points, near=None):
        asked.extend(points)
        return [[np.array([p["bent"], 0.01 * p["bent"] ** 2, 0.0])] for p in points]

    def bent(size):
        y = np.array([size, 0.01 * size**2, 0.0])
        return Score("bent", {"bent": size}, 400.0, 1.0, 1.0, y / np.linalg.norm(y), 0.0, float(np.linalg.norm(y)))

    ahead, back = score("a", 0.0, 400.0), score("a", np.pi, 400.0)
    for two_sided in (True, False):
        asked.clear()
        effects = [effect("a", 1.0), effect("bent", 10.0, two_sided=two_sided)]
        assert grouped(effects, [ahead, bent(10.0)], predict) == {"a": ["bent"]}
        (point,) = asked
        assert point["bent"] == pytest.approx(10.0 / np.hypot(10.0, 1.0))
    # The other way round, only what has both signs can be compared.
    asked.clear()
    assert grouped(effects, [back, bent(10.0)], predict) == {"a": [], "bent": []}
    assert asked == []
    both = [effect("a", 1.0), effect("bent", 10.0, two_sided=True)]
    assert grouped(both, [back, bent(10.0)], predict) == {"a": ["bent"]}
    assert asked[0]["bent"] == pytest.approx(-10.0 / np.hypot(10.0, 1.0))
    # An effect that moves nothing at that size, or cannot be simulated there, is kept apart.
    for outcome in ([np.zeros(3)], SimulationError("the integrator gave up")):
        groups = grouped(
            both, [ahead, bent(10.0)], lambda points, near=None, outcome=outcome: [outcome for _ in points]
        )
        assert groups == {"a": [], "bent": []}


def test_an_effect_is_the_same_as_itself_whatever_is_rounded():
    for angle in np.linspace(0.0, 3.0, 100):
        a, b = score("a", angle), score("b", angle)
        assert scores._equal(a, b, float(a.signature @ b.signature))


def test_classes_join_effects_wherever_they_stand():
    e = np.eye(3)
    for order in ("axby", "abxy", "axyb", "xaby", "xayb", "xyab"):
        signatures = {name: {"a": e[0], "b": e[0], "x": e[1], "y": e[2]}[name] for name in order}
        assert scores.alias_classes(signatures, threshold=0.95) == (("a", "b"),)


def test_only_what_is_nearly_alike_is_compared_again_and_that_with_the_three_most_alike():
    asked = []

    def predict(points, near=None):
        asked.extend(points)
        return [[np.array([0.0, 0.0, 1.0])] for _ in points]

    def cosine(c):
        return float(np.arccos(c))

    effects = [effect(n, 1.0) for n in "abcde"]
    near = [score(n, cosine(c), 1e4) for n, c in zip("abcd", (0.99, 0.997, 0.9985, 0.9995), strict=True)]
    near = [Score(s.effect, s.trial, s.drop, 1.0, 1.0, s.signature, k, k) for k, s in enumerate(near, start=1)]
    grouped(effects, [*near, score("e", 0.0, 1e4)], predict)
    sizes = sorted(p["e"] for p in asked if "e" in p)
    assert sizes == pytest.approx([2.0, 3.0, 4.0])  # as long as b, c and d
    for c, count in ((0.981, 1), (0.979, 0)):
        asked.clear()
        grouped(effects[:2], [score("a", 0.0, 1e4), score("b", cosine(c), 1e4)], predict)
        assert len(asked) == count
