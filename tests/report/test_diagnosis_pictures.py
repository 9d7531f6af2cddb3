from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from fmuid.core.units import Conversion
from fmuid.data.noise.runs import RepeatedRuns
from fmuid.diagnosis.localisation import excess_map
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.verdict import Verdict
from fmuid.effects.effect import Effect, Port, Regime, Unknown
from fmuid.report.diagnosis_arrays import pictures_of

TIME = np.arange(2000) * 0.01
SPEED = 10 * np.sin(TIME)
LOAD = 5 * np.cos(0.3 * TIME)
FRICTION = 0.3 * np.abs(SPEED) / 10  # what the model below lacks, N.m


class Model:
    """Predicts nothing at all, or with an effect a share of what is lacking; a port's drive comes straight through."""

    cases = (
        SimpleNamespace(id="run", time=TIME, channels=(SimpleNamespace(shown_unit="N.m", to_shown=Conversion()),)),
    )

    def __init__(self, lacking):
        self.lacking = lacking

    def predict(self, points):
        return [(np.atleast_2d(p.get("effect", 0.0) * self.lacking),) for p in points]

    def trajectories(self, values, names):
        return [tuple({"w": SPEED, "tau": LOAD}[name] for name in names)]

    def moved_by(self, values, name, size, courses):
        assert name == "port_torque"
        return [(np.atleast_2d(size * course[0]),) for course in courses]


def fitted(name, share):
    return SimpleNamespace(names=(name,), effects=(name,), fit=SimpleNamespace(values={"effect": share}))


def draw(lacking, verdict, *candidates, effects=()):
    rng = np.random.default_rng(0)
    values = lacking + rng.normal(0, 0.02, (5, 1, TIME.size))
    observed = Observed.from_runs([RepeatedRuns("run", "bench", TIME, ("tau",), values)])
    residuals = observed.residuals([np.zeros((1, TIME.size))])
    nominal = Refit((), {}, residuals, (np.zeros((residuals[0].size, 0)),), 0.0, 1, True)
    paths = {"speed": (SPEED,), "load": (LOAD,), "load behind a rigid coupling": (LOAD,), "time": (TIME,)}
    subject = SimpleNamespace(
        model=Model(lacking),
        observed=observed,
        nominal=(),
        effects=effects,
        catalogue=SimpleNamespace(
            ports={"torque": Port("torque", "port_torque", None, 0.01, "N.m")},
            regimes={
                "load": Regime("load", "tau", "value", "N.m"),
                "speed": Regime("speed", "w", "speed", "rad/s"),
                "load behind a rigid coupling": Regime("load behind a rigid coupling", "tau", "value", "N.m"),
                "torque speed": Regime("torque speed", "w", "speed", "rad/s", ports=("another",)),
                "elsewhere": Regime("elsewhere", "x", ports=("another",)),
            },
        ),
    )
    return pictures_of(
        SimpleNamespace(
            subject=subject,
            nominal=SimpleNamespace(fit=nominal),
            best=candidates[0],
            surviving=candidates,
            candidates=candidates,
            diagnosis=SimpleNamespace(verdict=verdict, best=None),
            courses={},
            excess=excess_map(observed, [np.zeros((1, TIME.size))], paths),
            paths=paths,
        )
    )


@pytest.fixture(scope="module")
def pictures():
    return draw(FRICTION, Verdict("effect", ("viscous",), (), ("torque",)), fitted("viscous", 0.9))


def test_residuals_are_in_units_before_and_after(pictures):
    (overlay,) = pictures.overlays
    assert (overlay.experiment, overlay.signal, overlay.unit) == ("run", "tau", "N.m")
    (_, _, before), (_, _, after) = overlay.predictions
    np.testing.assert_allclose(before - overlay.measurement, -FRICTION, atol=0.05)
    np.testing.assert_allclose(after - overlay.measurement, -0.1 * FRICTION, atol=0.05)
    assert overlay.sigma == pytest.approx(0.02 / np.sqrt(5), rel=0.1)


def test_shares_of_every_variable_add_up_to_the_whole(pictures):
    edges = np.cumsum([0, *(len(r.labels) for r in pictures.excess.regimes)])
    for a, b in pairwise(edges):
        assert pictures.excess.share[:, a:b].sum() == pytest.approx(1.0)


def test_missing_torque_is_found_with_the_law_over_it_and_what_explains_most_comes_first(pictures):
    missing, other = pictures.missing
    assert (missing.variable.name, other.variable.name) == ("speed", "load")
    assert missing.quantity.label == "missing at torque / (N·m)"
    assert missing.explained > 0.95
    assert 0.5 < other.explained < 0.95  # a constant explains much of a friction without sign
    (branch,) = missing.branches
    expected = 0.3 * np.abs(branch.x) / 10
    assert branch.x.min() == pytest.approx(-10, abs=0.01)
    inner = np.abs(branch.x) > 0.5  # a piecewise-linear function cannot follow the corner at zero
    np.testing.assert_allclose(branch.y[inner], expected[inner], atol=0.02)
    label, _, law = branch.laws[0]
    assert label == "viscous"
    np.testing.assert_allclose(law[inner], 0.9 * expected[inner], atol=0.02)
    assert np.all(branch.standard_error < 0.01)


def test_a_torque_that_changes_sign_with_the_direction_is_shown_for_each_of_them():
    pictures = draw(
        0.05 * LOAD * np.sign(SPEED), Verdict("effect", ("mesh",), (), ("torque",)), fitted("mesh", 1.0)
    )
    missing = pictures.missing[0]
    assert missing.variable.name == "load"
    assert missing.explained > 0.95
    for branch, sign in zip(missing.branches, (1, -1), strict=True):
        assert branch.direction == ("forward" if sign > 0 else "backward")
        np.testing.assert_allclose(branch.y[:-1], sign * 0.05 * branch.x[:-1], atol=0.02)


def test_every_law_of_an_a_or_b_is_drawn():
    verdict = Verdict("ambiguous", (), (("viscous",), ("drag",)), ("torque",))
    (branch,) = draw(FRICTION, verdict, fitted("viscous", 0.9), fitted("drag", 0.7)).missing[0].branches
    assert [name for name, _, _ in branch.laws] == ["viscous", "drag"]
    assert branch.laws[1][2].max() == pytest.approx(0.7 / 0.9 * branch.laws[0][2].max(), rel=1e-3)


def test_a_law_is_a_curve_over_its_variable_and_the_points_are_what_the_measurements_say():
    law = Effect(
        "viscous", "", "torque", (Unknown("k", 0.0, 0.0, 1.0, 1e-3),), {"k": 0.0}, (), expression="k*abs(rate)"
    )
    weak = SimpleNamespace(**vars(fitted("viscous", 0.9)))
    no_parameters = (np.zeros((TIME.size, 0)),)
    weak.fit = SimpleNamespace(values={"effect": 0.9, "k": 0.027}, unknowns=(), jacobian=no_parameters)
    (missing,) = draw(FRICTION, Verdict("effect", ("viscous",), (), ("torque",)), weak, effects=(law,)).missing
    assert missing.variable.name == "torque speed"
    (branch,) = missing.branches
    ((name, x, y),) = branch.laws
    assert name == "viscous"
    np.testing.assert_allclose(y, 0.027 * np.abs(x))
    inner = np.abs(branch.x) > 1.0  # hats cannot follow the corner at zero
    np.testing.assert_allclose(branch.y[inner], 0.03 * np.abs(branch.x[inner]), atol=0.01)
    assert np.mean(np.abs(branch.y[inner]) > 0.0285 * np.abs(branch.x[inner])) > 0.9  # a tenth above the curve
