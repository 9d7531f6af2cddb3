"""Excitations keep range and slope, whatever numbers they are made of."""

from __future__ import annotations

import numpy as np
import pytest

from fmuid.design.excitation import Bounds, Shape

TIME = np.linspace(0.0, 2.0, 401)
FAMILIES = ("multisine", "chirp", "steps", "prbs")


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("rate", [np.inf, 8.0, 0.5])
@pytest.mark.parametrize("rest", [0.0, -1.0, 2.5])
def test_no_numbers_make_an_excitation_that_leaves_its_range_or_is_too_steep(
    family: str, rate: float, rest: float
) -> None:
    bounds = Bounds(-1.0, 3.0, rate, rest)
    rng = np.random.default_rng(0)
    shape = Shape(family, (bounds,), optimised=True)  # type: ignore[arg-type]
    corners = [np.zeros(shape.size), np.ones(shape.size)]
    for x in [*corners, *rng.random((50, shape.size)), *rng.integers(0, 2, (50, shape.size)).astype(float)]:
        (u,) = shape(x, TIME)
        assert u.min() >= -1.0 - 1e-12
        assert u.max() <= 3.0 + 1e-12
        assert np.max(np.abs(np.diff(u))) <= rate * 0.005 * (1 + 1e-9)
        assert u[0] == u[-1] == rest


@pytest.mark.parametrize("family", FAMILIES)
def test_the_first_number_is_the_size(family: str) -> None:
    shape = Shape(family, (Bounds(-1.0, 1.0, np.inf, 0.25),))  # type: ignore[arg-type]
    x = np.full(shape.size, 0.7)
    spans = [np.ptp(shape(np.concatenate([[size], x[1:]]), TIME)) for size in (0.0, 0.3, 1.0)]
    assert spans[0] == 0.0
    assert spans[0] < spans[1] < spans[2]


def test_two_inputs_move_on_their_own() -> None:
    shape = Shape("multisine", (Bounds(-1.0, 1.0, np.inf, 0.0), Bounds(0.0, 5.0, np.inf, 0.0)))
    x = np.full(shape.size, 0.5)
    first, second = shape(x, TIME)
    assert second.max() > 1.0
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.9  # or no run could tell them apart


def test_a_binary_sequence_has_two_levels_and_a_slow_one_ramps() -> None:
    x = np.array([1.0, 0.0, 0.4, 0.1])
    (fast,) = Shape("prbs", (Bounds(-1.0, 1.0, np.inf, 0.0),))(x, TIME)
    assert set(np.unique(fast[1:-1])) == {-1.0, 1.0}
    (slow,) = Shape("prbs", (Bounds(-1.0, 1.0, 20.0, 0.0),))(x, TIME)
    assert len(np.unique(slow)) > 10
