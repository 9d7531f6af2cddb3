"""Prior odds of effects: many candidates make each of them less likely."""

import math
from dataclasses import replace

import pytest

from fmuid.effects.effect import Effect
from fmuid.effects.law_prior import log_prior


def effect(id, **more):
    return Effect(id, "", id.partition("@")[2], (), {}, (), **more)


def test_the_best_of_many_pays_for_their_number():
    few = [effect("coulomb@a"), effect("lag@s")]
    many = [*few, *(effect(f"lag@s{k}") for k in range(9))]
    assert log_prior([], many) == 0.0
    assert log_prior(["lag@s"], few) == pytest.approx(math.log(1 / 2))
    assert log_prior(["lag@s"], many) == pytest.approx(math.log(1 / 20))
    assert log_prior(["coulomb@a"], many) == log_prior(["coulomb@a"], few)  # other kinds make it no less likely


def test_candidates_that_were_dropped_before_a_model_was_built_count():
    varying = effect("varies@R(T)", among=400)
    every = [effect("coulomb@a"), varying, effect("varies@R(i)", among=400)]
    assert log_prior(["varies@R(T)"], every) == pytest.approx(math.log(1 / 800))
    assert log_prior(["varies@R(T)"], [*every[:1], replace(varying, among=1)]) == pytest.approx(math.log(1 / 2))


def test_an_unusual_place_counts_half_and_the_order_does_not_matter():
    every = [effect("coulomb@a"), effect("coulomb@b", usual=False), effect("lag@s")]
    assert log_prior(["coulomb@a"], every) - log_prior(["coulomb@b"], every) == pytest.approx(math.log(2.0))
    pair = log_prior(["lag@s", "coulomb@a"], every)
    assert pair == log_prior(["coulomb@a", "lag@s"], every)
    assert pair == pytest.approx(sum(log_prior([n], every) for n in ("lag@s", "coulomb@a")) + math.log(2.0))
