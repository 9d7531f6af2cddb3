"""Where a gap lies: the ranges of variables in which a model is wrong more than elsewhere."""

import numpy as np
import pytest

from fmuid.data.noise.runs import RepeatedRuns
from fmuid.diagnosis.localisation import Beyond, excess_map
from fmuid.diagnosis.observed import Observed

TIME = 0.01 * np.arange(3000)
SPEED = 8.0 * np.sin(1.3 * TIME) + 4.0 * np.sin(0.31 * TIME)
REST = np.where(TIME < 20.0, 0.1 * TIME, 2.0) % (2 * np.pi)  # an angle at which the machine mostly stands


def shares(lacking, beyond=None):
    rng = np.random.default_rng(1)
    values = lacking + 0.01 * rng.standard_normal((4, 1, TIME.size))
    observed = Observed.from_runs([RepeatedRuns("run", "bench", TIME, ("tau",), values)])
    paths = {"angle": (REST,), "speed": (SPEED,), "time": (TIME,)}
    return excess_map(observed, [np.zeros((1, TIME.size))], paths).shares(beyond=beyond)


def test_a_regime_has_more_of_the_gap_than_of_the_samples():
    (share,) = shares(0.2 * (SPEED > 5.0))
    variable, low, high = share.regime
    assert variable == "speed"
    assert low == pytest.approx(5.0, abs=2.1)  # of bins 4 rad/s wide
    assert high == pytest.approx(SPEED.max())


def test_a_gap_in_all_samples_has_no_regime_where_the_machine_stands_most():
    (share,) = shares(np.full(TIME.size, 0.2))
    assert share.regime is None


@pytest.mark.parametrize(("either_side", "regime"), [(True, (SPEED.min(), -6.0)), (False, (6.0, SPEED.max()))])
def test_a_law_that_acts_beyond_a_threshold_has_its_own_regime(either_side, regime):
    (share,) = shares(0.2 * (SPEED < -6.0), Beyond("speed", 6.0, either_side))
    assert share.regime == ("speed", *map(pytest.approx, regime))
