"""Binary sequences and their bound, compared with all sequences."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from fmuid.core.immutable import FloatArray
from fmuid.design.binary import BinarySequence, Levels, Response, binary_sequence, relaxed
from fmuid.design.excitation import Bounds

TIME = 0.1 * np.arange(13)
BOUNDS = (Bounds(-1.0, 2.0, np.inf, 0.0),)


def slopes(samples: FloatArray) -> FloatArray:
    """Gain and delay-free lag of a first-order system with a stored start, and a direct path: (3, 1, N)."""
    (u,) = samples
    x, by_lag, rows = 0.3, 0.0, []
    for value in u:
        rows.append((x, by_lag, value - x))
        by_lag = 0.6 * by_lag + 0.5 * (value - x)
        x = 0.6 * x + 0.4 * value
    return np.array(rows).T[:, None]


def volume(information: FloatArray) -> tuple[float, FloatArray]:
    return -float(np.linalg.slogdet(information)[1]), np.linalg.inv(information)


def squares(information: FloatArray) -> tuple[float, FloatArray]:
    covariance = np.linalg.inv(information)
    return float(np.trace(covariance)), covariance @ covariance


KNOWN = np.diag([0.1, 0.1, 0.1])
COSTS = {"volume": volume, "squares": squares}


def cost_of(response: Response, samples: FloatArray) -> float:
    rows = np.stack([response.whiten(row) for row in response.slopes(samples)])
    return response.cost(response.known + rows @ rows.T)[0]


@pytest.mark.parametrize("cost", COSTS)
def test_the_sequence_is_as_good_as_the_best_of_all_and_none_is_below_the_bound(cost: str) -> None:
    response = Response(slopes, lambda row: row.ravel() / 0.2, KNOWN, COSTS[cost])
    relaxation = relaxed(response, BOUNDS, TIME)
    assert relaxation is not None
    levels = Levels(BOUNDS, TIME, 1)
    every = [
        cost_of(response, levels(np.array([s]), np.ones(1))) for s in product((-1.0, 1.0), repeat=levels.count)
    ]
    rounded = cost_of(response, levels(relaxation.sequence(), np.ones(1)))
    assert relaxation.bound <= min(every) + 1e-9
    spread = np.median(every) - min(every)
    assert rounded <= min(every) + 0.02 * spread
    assert min(every) - relaxation.bound < 0.25 * spread  # a bound that says something
    inside = np.random.default_rng(0).uniform(-1.0, 1.0, (300, 1, levels.count))
    assert min(cost_of(response, levels(s, np.ones(1))) for s in inside) >= relaxation.bound


def test_whitening_that_mixes_samples_counts() -> None:
    rng = np.random.default_rng(1)
    mixing = rng.standard_normal((13, 13))
    response = Response(slopes, lambda row: mixing @ row.ravel(), KNOWN, squares)
    relaxation = relaxed(response, BOUNDS, TIME)
    assert relaxation is not None
    levels = Levels(BOUNDS, TIME, 1)
    signs = np.where(rng.random((1, levels.count)) > 0.5, 1.0, -1.0)
    s = np.append(1.0, signs.ravel())
    information = KNOWN + (relaxation.forms @ np.outer(s, s).ravel()).reshape(3, 3)
    rows = np.stack([response.whiten(row) for row in slopes(levels(signs, np.ones(1)))])
    assert information == pytest.approx(KNOWN + rows @ rows.T)


def test_a_model_that_is_not_linear_in_its_input_has_no_sequence() -> None:
    bent = Response(lambda samples: np.tanh(3.0 * slopes(samples)), lambda row: row.ravel(), KNOWN, squares)
    assert binary_sequence(bent, BOUNDS, TIME) is None


def test_samples_stay_within_range_and_slope_and_bits_last_as_long_as_a_ramp_takes() -> None:
    bounds = (Bounds(-1.0, 2.0, 75.0, 0.0),)
    time = 0.02 * np.arange(61)
    response = Response(slopes, lambda row: row.ravel(), KNOWN, squares)
    sequence = binary_sequence(response, bounds, time)
    assert sequence is not None
    assert sequence.levels.length == 2
    (u,) = sequence(np.ones(1), time)
    assert u[0] == u[-1] == 0.0
    assert np.all((u >= -1.0) & (u <= 2.0))
    assert np.max(np.abs(np.diff(u)) / np.diff(time)) <= 75.0 * (1.0 + 1e-9)
    assert np.max(np.abs(sequence(np.array([0.5]), time))) <= 1.0
    assert not sequence(np.zeros(1), time).any()


def test_each_input_has_a_sequence_of_its_own() -> None:
    both = (*BOUNDS, Bounds(0.0, 1.0, np.inf, 0.5))

    def of_two(samples: FloatArray) -> FloatArray:
        return slopes(samples[:1]) + 0.5 * slopes(samples[1:])[::-1]

    sequences = binary_sequence(Response(of_two, lambda row: row.ravel(), KNOWN, squares), both, TIME)
    assert isinstance(sequences, BinarySequence)
    first, second = sequences(np.array([1.0, 1.0]), TIME)
    assert set(first[1:-1]) == {-1.0, 2.0}
    assert set(second[1:-1]) == {0.0, 1.0}
    assert sequences(np.array([1.0, 0.0]), TIME)[1] == pytest.approx(0.5)
