from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.ports import Port
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.regimes import Regime
from fmuid.diagnosis.result import Verdict
from fmuid.diagnosis.where import excess_map
from fmuid.noise_spectrum import RepeatedRuns
from fmuid.report.diagnosis_pictures import pictures_of

TIME = np.arange(2000) * 0.01
SPEED = 10 * np.sin(TIME)
FRICTION = 0.3 * np.abs(SPEED) / 10  # what the model below lacks, N.m


class Model:
    """Predicts nothing at all, or with the effect just what it adds; a drive at the port comes straight through."""

    cases = (SimpleNamespace(id="run", channels=(SimpleNamespace(unit="N.m"),)),)

    def predict(self, points):
        return [(np.atleast_2d(0.9 * FRICTION if "effect" in p else 0 * FRICTION),) for p in points]

    def predict_driven(self, values, drives):
        return [(np.atleast_2d(d["port_torque"][0]),) for d in drives]


@pytest.fixture(scope="module")
def pictures():
    rng = np.random.default_rng(0)
    values = FRICTION + rng.normal(0, 0.02, (5, 1, TIME.size))
    observed = Observed.from_runs([RepeatedRuns("run", "bench", TIME, ("tau",), values)])
    residuals = observed.residuals([np.zeros((1, TIME.size))])
    nominal = Refit((), {}, residuals, (np.zeros((residuals[0].size, 0)),), 0.0, 1, True)
    paths = {"speed": (SPEED,), "time": (TIME,)}
    subject = SimpleNamespace(
        model=Model(),
        observed=observed,
        catalogue=SimpleNamespace(
            ports={"torque": Port("torque", "port_torque", None, 0.01, "N.m")},
            regimes={"speed": Regime("speed", "w", "speed", "rad/s")},
        ),
    )
    return pictures_of(
        SimpleNamespace(
            subject=subject,
            nominal=SimpleNamespace(fit=nominal),
            best=SimpleNamespace(
                names=("viscous",), effects=("viscous",), fit=SimpleNamespace(values={"effect": 1.0})
            ),
            diagnosis=SimpleNamespace(verdict=Verdict("effect", ("viscous",), "torque")),
            excess=excess_map(observed, [np.zeros((1, TIME.size))], paths),
            paths=paths,
        )
    )


def test_residuals_are_in_units_before_and_after(pictures):
    (pair,) = pictures.residuals
    assert (pair.setup, pair.experiment, pair.signal, pair.unit) == ("bench", "run", "tau", "N.m")
    np.testing.assert_allclose(pair.before, -FRICTION, atol=0.05)
    np.testing.assert_allclose(pair.after, -0.1 * FRICTION, atol=0.05)
    assert pair.floor == pytest.approx(0.02 / np.sqrt(5), rel=0.1)


def test_shares_of_every_variable_add_up_to_the_whole(pictures):
    edges = np.cumsum([0, *(len(r.labels) for r in pictures.excess.regimes)])
    for a, b in pairwise(edges):
        assert pictures.excess.share[:, a:b].sum() == pytest.approx(1.0)


def test_missing_torque_is_found_with_the_law_over_it(pictures):
    (missing,) = pictures.missing
    assert missing.quantity.label == "missing at torque / (N·m)"
    assert missing.explained > 0.95
    expected = 0.3 * np.abs(missing.x) / 10
    assert missing.x.min() == pytest.approx(-10, abs=0.01)
    inner = np.abs(missing.x) > 0.5  # a piecewise-linear function cannot follow the corner at zero
    np.testing.assert_allclose(missing.y[inner], expected[inner], atol=0.02)
    label, _, law = missing.laws[0]
    assert label == "viscous"
    np.testing.assert_allclose(law[inner], 0.9 * expected[inner], atol=0.02)
    assert np.all(missing.standard_error < 0.01)
