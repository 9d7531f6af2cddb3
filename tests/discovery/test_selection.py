"""Terms that do what a flow does along the trajectories of a model."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fmu_build import load
from fmu_build.model_ports import find_ports
from fmuid.discovery import places
from fmuid.discovery.places import Spot
from fmuid.discovery.selection import instead
from fmuid.discovery.terms import Quantity, library
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
    own = dict.fromkeys(n for names in port.probes.values() for n in names)

    def case(**inputs):
        variables = dict.fromkeys([*own, *inputs], SimpleNamespace(unit="1"))
        return SimpleNamespace(
            time=TIME,
            lead=0,
            task=SimpleNamespace(inputs=inputs),
            simulator=SimpleNamespace(variables=variables),
            channels=(),
            columns={},
        )

    cases = case(tau=RATES[0]), case(tau=RATES[1], w_ref=RATES[1])
    rows = [np.stack([np.roll(rate, 50 * k) for k in range(len(own))]) for rate in RATES]
    model = SimpleNamespace(cases=cases, trajectories=lambda _, names: [r[: len(names)] for r in rows])
    for order in (slice(None), slice(None, None, -1)):
        model.cases = cases[order]
        found = places.spot("rotor", flat, model, {})
        assert [set(c) for c in found.courses] == [{"p", "rate", "load", "tau"}] * 2
        assert len(instead(found, [np.abs(c["rate"]) for c in found.courses])) > 1
