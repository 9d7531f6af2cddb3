"""Terms that do what a flow does along the trajectories of a model."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fmu_build import load
from fmu_build.model_ports import find_ports
from fmuid.discovery import places
from fmuid.discovery.injected import Law
from fmuid.discovery.places import Spot
from fmuid.discovery.selection import instead, spanning
from fmuid.discovery.terms import Quantity, library, names_in
from tests.diagnosis.test_made_catalogue import RIGS

TIME = np.linspace(0.0, 10.0, 2001)
RATES = [5.0 * np.sin(TIME), 4.0 * np.sin(0.7 * TIME) * np.cos(3.0 * TIME)]


@pytest.fixture(scope="module")
def spot():
    port = next(p for p in find_ports(load(RIGS, "Rigs.TwoMass")) if p.name == "rotor")
    speed = Quantity("rate", "rate", "rad/s", 5.0, -5.0, 5.0, "speed")
    return Spot(port, 2.0, tuple({"rate": r} for r in RATES), (TIME, TIME), tuple(library([speed], [], [TIME])))


@pytest.mark.parametrize(
    ("flow", "text", "size"),
    [
        (lambda r: 3.0 * (r / 5.0) ** 3, "(rate/5)^3", 3.0),
        (lambda r: 0.7 * (r / 5.0) * np.abs(r / 5.0), "(rate/5)*abs((rate/5))", 0.7),
        # What the model's own linear part may do as well makes no difference.
        (lambda r: 3.0 * (r / 5.0) ** 3 - 0.4 * r + 1.0, "(rate/5)^3", 3.0),
    ],
)
def test_the_term_that_is_the_flow_comes_first_with_its_size(spot, flow, text, size):
    first, second, *_ = instead(spot, [flow(r) for r in RATES])
    assert [t.text for t in first.terms] == [text]
    assert first.sizes == pytest.approx([size], rel=1e-6)
    assert second.terms[0].family != first.terms[0].family


def test_a_law_depends_only_on_what_every_run_has():
    """A free shaft has no input for the load's speed, which a controlled one has."""
    flat = load(RIGS, "Rigs.TwoMass")
    port = next(p for p in find_ports(flat) if p.name == "rotor")
    probed = dict.fromkeys(n for names in port.probes.values() for n in names)

    def case(**inputs):
        variables = dict.fromkeys([*probed, *inputs], SimpleNamespace(unit="1"))
        return SimpleNamespace(
            time=TIME,
            lead=0,
            task=SimpleNamespace(inputs=inputs),
            simulator=SimpleNamespace(variables=variables),
            channels=(),
            columns={},
        )

    cases = case(tau=RATES[0]), case(tau=RATES[1], w_ref=RATES[1])
    rows = [np.stack([np.roll(rate, 50 * k) for k in range(len(probed))]) for rate in RATES]
    model = SimpleNamespace(cases=cases, trajectories=lambda _, names: [r[: len(names)] for r in rows])
    for order in (slice(None), slice(None, None, -1)):
        model.cases = cases[order]
        rotor = places.spot("rotor", flat, model, {})
        assert {*rotor.nearby} == {"p", "rate", "load", "tau"}
        assert all(rotor.courses[0].keys() == c.keys() >= {*rotor.nearby, "time"} for c in rotor.courses)
        assert "w_ref" not in rotor.courses[0]
        assert len(instead(rotor, [np.abs(c["rate"]) for c in rotor.courses])) > 1


def test_a_law_may_depend_on_neighbours_outputs_columns_and_time():
    flat = load(RIGS, "Rigs.TwoMass")
    names = [n for p in find_ports(flat) for probed in p.probes.values() for n in probed]
    wind = 5.0 + np.sin(3.0 * TIME)
    courses = {n: np.sin((k + 1.3) * TIME) for k, n in enumerate(dict.fromkeys([*names, "w_load"]))}
    case = SimpleNamespace(
        time=TIME + 100.0,
        lead=0,
        task=SimpleNamespace(inputs={"tau": RATES[0]}),
        simulator=SimpleNamespace(variables=dict.fromkeys([*courses, "tau"], SimpleNamespace(unit="1"))),
        channels=(SimpleNamespace(variable="w_load", signal="w_load"),),
        columns={"logged.wind": ("m/s", wind)},
    )
    model = SimpleNamespace(cases=(case,), trajectories=lambda _, wanted: [np.stack([courses[n] for n in wanted])])
    rotor = places.spot("rotor", flat, model, {})
    used = {name for term in rotor.terms for name in names_in(term.text) if "rate" in names_in(term.text)}
    assert {"time", "logged.wind", "w_load"} < used
    assert any(
        "time" in t.text and "100" in t.text for t in rotor.terms
    )  # since the first sample of the first run
    wind_law = Law(rotor, tuple(t for t in rotor.terms if "logged.wind" in t.text)[:1], "rotor.law")
    assert wind_law.effect("law@rotor", "").inputs == {"logged.wind": "m/s"}
    squares = [t.text for t in rotor.terms if "^2*" in t.text or "*abs(" in t.text]
    assert any("logged.wind" in text for text in squares)


def test_few_courses_span_the_library(spot):
    """Responses are linear, so that those to the other terms need no simulation."""
    courses = np.array([t.whole_course(spot.courses, spot.time) for t in spot.terms])
    linear = np.array([np.ones(courses.shape[1]), np.concatenate(RATES)])
    chosen, sums = spanning(courses, linear)
    assert len(chosen) < 0.6 * len(courses)
    left = courses - sums @ np.vstack([linear, courses[chosen]])
    beyond = courses - np.linalg.lstsq(linear.T, courses.T, rcond=None)[0].T @ linear
    assert np.all(np.linalg.norm(left, axis=1) <= 0.1 * np.linalg.norm(beyond, axis=1) + 1e-9)
