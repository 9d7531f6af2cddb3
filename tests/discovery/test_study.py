"""The study's own ruler: a true law is right, another one is not, and one at another place is not."""

from __future__ import annotations

import pytest

from benchmarks.discovery.case import cases
from benchmarks.discovery.score import difference, true_course


def law(port, expression, states=None, **values):
    parameters = {f"x.{n}": {"value": v} for n, v in values.items()}
    return {"port": port, "parameters": parameters, "effect": {"expression": expression, "states": states or {}}}


@pytest.fixture(scope="module")
def quadratic():
    case = cases()[0]
    return case, *true_course(case, "pulses", dict.fromkeys(case.rig.parameters, 1.0))


def test_the_list_is_frozen_as_it_says():
    assert [c.expressible for c in cases()].count(True) == 72
    assert [c.expressible for c in cases()].count(False) == 24 + 25
    assert len(cases(20)) == 27
    assert {c.rig.name for c in cases(4)} == {"thermal block", "tanks", "RLC circuit", "belt axis"}


def test_the_true_law_is_right_and_another_shape_is_not(quadratic):
    case, course, flow = quadratic
    right = law("body", "x.size*((p - 293.15)/100)^2", size=6.0)
    assert difference(case, right, course, flow) == pytest.approx((0.0, 0.0), abs=1e-3)
    cubic = law("body", "x.size*((p - 293.15)/100)^3", size=6.0)
    assert min(difference(case, cubic, course, flow)) > 0.05
    smaller = law("body", "x.size*((p - 293.15)/100)^2", size=5.0)
    assert difference(case, smaller, course, flow) == pytest.approx((1 / 6, 0.0), abs=1e-3)


def test_a_law_at_another_place_is_not_right(quadratic):
    case, course, flow = quadratic
    assert difference(case, law("casing", "x.size*((p - 293.15)/100)^2", size=6.0), course, flow) == (None, None)


def test_a_hidden_state_is_followed(quadratic):
    case = next(c for c in cases() if "hidden" in c.table and c.rig.name == "thermal block")
    course, flow = true_course(case, "pulses", dict.fromkeys(case.rig.parameters, 1.0))
    rate = {"z": {"derivative": "(((p - 293.15)/50) - z)/x.lag"}}
    right = law("casing", "x.size*((p - 293.15)/50)*z", rate, size=6.0, lag=3600.0)
    assert difference(case, right, course, flow)[0] < 0.01
    faster = law("casing", "x.size*((p - 293.15)/50)*z", rate, size=6.0, lag=600.0)
    assert difference(case, faster, course, flow)[0] > 0.05
