"""Models that state their balances as equations, without connectors: ports, laws there, diagnoses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fmu_build import load
from fmu_build.instrument import Added, Term, instrument
from fmu_build.model_ports import across_branches, find_ports
from fmuid.cli.app import run
from fmuid.core.campaign import ModelSource
from fmuid.diagnosis.made_catalogue import possible_laws
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.model_source import built_model, built_with_terms
from fmuid.simulation.simulator import Task
from tests.every_law import every_law

MODELS = Path(__file__).parents[1] / "fmu_build" / "models" / "Written.mo"
TIME = np.linspace(0.0, 2.0, 401)
INPUTS = {
    "Shaft": {"tau": 0.5 * np.sin(9 * TIME)},
    "SlackShaft": {"tau": 0.5 * np.sin(9 * TIME)},
    "Loudspeaker": {"u": 5 * np.sin(70 * TIME)},
    "Tanks": {"q": 2e-5 * (1 + np.sign(np.sin(8 * TIME)))},
    "Oven": {"P": 500 + 400 * np.sign(np.sin(8 * TIME))},
    "Cart": {"F": 6 * np.sin(4 * TIME)},
    "Plain": {"F": 3 * np.sin(4 * TIME)},
    "Filtered": {"F": 2000 * np.sin(4 * TIME)},
    "Motor": {"u": 5 * np.sin(9 * TIME)},
    "Screw": {"tau": 0.3 * np.sin(30 * TIME)},
    "SlackScrew": {"tau": 0.3 * np.sin(30 * TIME)},
    "Carriage": {"tau": 0.3 * np.sin(30 * TIME)},
}


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "written"))


def source(name):
    return ModelSource(MODELS, f"Written.{name}")


def flat(name):
    return load(MODELS, f"Written.{name}")


def simulated(fmu, name, **parameters):
    model = load_fmu(fmu)
    outputs = tuple(v.name for v in model.variables.values() if v.causality == "output")
    return model.simulate(Task(TIME, INPUTS[name], outputs), parameters)


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("Shaft", {"w.balance": "node", "wl.balance": "node", "wl.w": "branch"}),
        ("Loudspeaker", {"i.balance": "loop", "v.balance": "node", "x.ground": "branch"}),
        ("Tanks", {"h1.balance": "node", "h2.balance": "node", "h2.h1": "branch"}),
        ("Oven", {"T.balance": "node", "Tw.balance": "node", "T.Tw": "branch"}),
        ("Cart", {"v.balance": "node", "w.balance": "node"}),
        ("Plain", {"v.balance": "node", "x.ground": "branch"}),
        ("Filtered", {"v.balance": "node", "lag.u": "signal"}),
        ("Motor", {"motor": "loop", "rotor": "node"}),
        ("Screw", {"rotor": "node", "table": "node", "screw": "branch"}),
        ("Carriage", {"w.balance": "node", "v.balance": "node", "v.w": "branch"}),
    ],
)
def test_balances_loops_and_differences_are_ports(name, kinds):
    assert {port.name: port.kind for port in find_ports(flat(name))} == kinds


@pytest.mark.parametrize(
    ("name", "across"),
    [
        ("Shaft", {"twist": "wl.w"}),
        ("Loudspeaker", {"x": "x.ground"}),
        ("Screw", {"screw.rel": "screw"}),
        ("Tanks", {}),
    ],
)
def test_variables_that_are_a_difference_belong_to_its_branch(name, across):
    assert across_branches(flat(name)) == across


def test_the_laws_there_are_those_of_their_domains():
    laws = {name: possible_laws(flat(name)) for name in INPUTS}
    assert {"coulomb", "cogging", "imbalance", "inertia"} <= {*laws["Shaft"]["wl.balance"]}
    assert {"backlash", "hardening", "hysteresis"} <= {*laws["Shaft"]["wl.w"]}
    assert {*laws["Loudspeaker"]["i.balance"]} == {"resistance", "voltage_drop", "eddy"}
    assert laws["Motor"]["motor"] == laws["Loudspeaker"]["i.balance"]
    assert {*laws["Loudspeaker"]["x.ground"]} == {"hardening", "hysteresis"}
    assert {*laws["Tanks"]["h1.balance"]} == {"leakage", "outflow", "overflow", "capacity"}
    assert {*laws["Oven"]["T.balance"]} == {"loss", "radiation", "capacity"}
    assert {*laws["Oven"]["T.Tw"]} == {"heat_bridge"}
    assert {"coulomb", "quadratic", "weight"} <= {*laws["Plain"]["v.balance"]}
    without_position = {*laws["Filtered"]["v.balance"]}
    assert {"coulomb", "weight", "inertia"} <= without_position
    assert "hardening" not in without_position


def test_laws_of_a_loop_have_the_units_of_drops_and_currents(tmp_path):
    catalogue = every_law(flat("Loudspeaker"), tmp_path)
    units = {name: unit for e in catalogue.effects.values() for name, unit in e.units.items()}
    loop = {n.removeprefix("i.balance."): u for n, u in units.items() if n.startswith("i.balance.")}
    assert loop == {
        "resistance": "V/(A)", "voltage_drop": "V", "voltage_drop_width": "A", "eddy": "V/(A)", "eddy_lag": "s",
    }  # fmt: skip
    assert catalogue.ports["i.balance"].unit == "V"


def test_an_unknown_unit_is_left_out(tmp_path):
    """The voltages of this coil have no units."""
    file = tmp_path / "Coil.mo"
    file.write_text(
        'model Coil input Real u; output Real i(unit = "A", start = 0, fixed = true); '
        "parameter Real L = 0.01; parameter Real R = 2; equation L*der(i) = u - R*i; end Coil;"
    )
    units = every_law(load(file, "Coil"), tmp_path).effects["resistance@i.balance"].units
    assert units == {"i.balance.resistance": ""}


@pytest.mark.parametrize(
    ("name", "port", "acts", "law", "parameter", "more"),
    [
        ("Shaft", "w.balance", "flow", "0.01*rate", "dm", 0.01),
        ("Shaft", "wl.balance", "flow", "0.01*rate", "dl", 0.01),
        ("Shaft", "wl.w", "flow", "3*p", "k", 3.0),
        ("Shaft", "wl.w", "flow", "0.01*rate", "c", 0.01),
        ("Loudspeaker", "i.balance", "potential", "2*through", "Re", 2.0),
        ("Loudspeaker", "i.balance", "flow", "2*through", "Re", 2.0),
        ("Loudspeaker", "v.balance", "flow", "0.5*rate", "R", 0.5),
        ("Loudspeaker", "x.ground", "flow", "700*p", "K", 700.0),
        ("Cart", "v.balance", "flow", "0.7*rate", "d", 0.7),
        ("Cart", "w.balance", "flow", "0.02*rate", "b", 0.02),
        ("Plain", "v.balance", "flow", "0.5*rate", "d", 0.5),
        ("Filtered", "v.balance", "flow", "30*rate", "d", 30.0),
        ("Motor", "motor", "potential", "2*through", "motor.R", 2.0),
        ("Screw", "screw", "flow", "9e3*p", "screw.c", 9e3),
        ("Screw", "screw", "flow", "9*rate", "screw.d", 9.0),
        ("Carriage", "v.w", "flow", "9e3*p", "c", 9e3),
        ("Carriage", "v.w", "flow", "9*rate", "d", 9.0),
    ],
)
def test_a_law_does_what_a_larger_parameter_does(name, port, acts, law, parameter, more):
    plain = built_model(source(name))
    value = load_fmu(plain).variables[parameter].start
    with_law = built_with_terms(source(name), flat(name), [Term(port, acts, law)], [])
    wanted = simulated(plain, name, **{parameter: value + more})
    assert np.ptp(wanted - simulated(plain, name), axis=1).max() > 1e-3 * np.ptp(wanted, axis=1).max()
    np.testing.assert_allclose(simulated(with_law, name), wanted, rtol=1e-5, atol=1e-5 * np.ptp(wanted))


@pytest.mark.parametrize(("port", "row"), [("h1.balance", 0), ("h2.balance", 1)])
def test_what_leaks_out_lowers_the_level(port, row):
    plain = simulated(built_model(source("Tanks")), "Tanks")
    leaking = built_with_terms(source("Tanks"), flat("Tanks"), [Term(port, "flow", "1e-4*p")], [])
    assert (simulated(leaking, "Tanks")[row, 1:] < plain[row, 1:]).all()


def test_heat_through_a_bridge_leaves_the_second_store_and_enters_the_first():
    plain = simulated(built_model(source("Oven")), "Oven")
    terms = [Term("T.Tw", "flow", "1.5*p")]
    bridged = simulated(built_with_terms(source("Oven"), flat("Oven"), terms, []), "Oven")
    (port,) = (p for p in find_ports(flat("Oven")) if p.name == "T.Tw")
    assert port.units == ("K", "W")
    assert (np.abs(bridged[0] - bridged[1])[1:] < np.abs(plain[0] - plain[1])[1:]).all()
    stored = 800 * plain[0] + 1600 * plain[1]  # what is in both does not change at once
    assert np.abs(800 * bridged[0] + 1600 * bridged[1] - stored).max() < 1e-2 * np.ptp(stored)


@pytest.mark.parametrize(
    ("name", "place", "slack", "gap"),
    [
        ("Shaft", "wl.w", "SlackShaft", 0.02),
        ("Screw", "screw", "SlackScrew", 1e-4),
        ("Carriage", "v.w", "SlackScrew", 1e-4),
    ],
)
def test_backlash_in_a_written_difference_is_backlash(name, place, slack, gap):
    term = Term(place, "potential", "-max(min(p, gap), -gap)")
    ours = simulated(built_with_terms(source(name), flat(name), [term], [Added("gap", gap)]), name)
    wanted, plain = (simulated(built_model(source(n)), n) for n in (slack, name))
    for row, of_plain, of_slack in zip(ours, plain, wanted, strict=True):
        assert np.abs(of_slack - of_plain).max() > 0.01 * np.ptp(of_slack)
        np.testing.assert_allclose(row, of_slack, atol=1e-4 * np.ptp(of_slack))


@pytest.mark.parametrize(("name", "place", "gap"), [("Shaft", "wl.w", 0.02), ("Screw", "screw", 1e-4)])
def test_a_twist_that_has_backlash_already_can_have_more(name, place, gap):
    drop = "-max(min(p, {gap}), -{gap})"
    once = instrument(flat(name), [Term(place, "potential", drop.format(gap="gap"))], [Added("gap", gap)])
    assert place in {port.name for port in find_ports(once)}
    more = [Term(place, "potential", drop.format(gap="more"))], [Added("more", 1.5 * gap)]
    wider = [Term(place, "potential", drop.format(gap="wide"))], [Added("wide", 2.5 * gap)]
    twice = simulated(built_with_terms(source(name), once, *more), name)
    wanted = simulated(built_with_terms(source(name), flat(name), *wider), name)
    for row, of_wider in zip(twice, wanted, strict=True):
        np.testing.assert_allclose(row, of_wider, atol=1e-4 * np.ptp(of_wider))


@pytest.mark.parametrize("name", [n for n in INPUTS if not n.startswith("Slack") and n != "Motor"])
def test_all_off_the_outputs_are_bit_for_bit_the_plain_ones(name, tmp_path):
    catalogue = every_law(flat(name), tmp_path)
    effects = [e for e in catalogue.effects.values() if not e.variant and not e.states]
    assert effects
    terms = [term for e in effects for term in e.terms]
    added = [Added(u.name, e.neutral[u.name]) for e in effects for u in e.unknowns]
    changed = built_with_terms(source(name), flat(name), terms, added)
    assert np.array_equal(simulated(built_model(source(name)), name), simulated(changed, name))


def shaft(law, tau, step, fine=20):
    """Speeds of the shaft by Runge and Kutta, in units of the motor's side of the gear; `law` adds torques."""
    Jm, Jl, k, c, dm, dl, n = 0.0027, 0.0041, 13.1, 0.0135, 0.0109, 0.0068, 2.0

    def slope(x, u):
        phi, phil, w, wl = x
        twist, rate = phi / n - phil, w / n - wl
        inner, at_load = law(twist, rate, wl)
        torque = k * twist + c * rate + inner
        return np.array([w, wl, (u - dm * w - torque / n) / Jm, (torque - dl * wl + at_load) / Jl])

    x, states, h = np.zeros(4), [np.zeros(4)], step / fine
    for u in tau[:-1]:
        for _ in range(fine):
            a = slope(x, u)
            b = slope(x + h / 2 * a, u)
            d = slope(x + h / 2 * b, u)
            x = x + h / 6 * (a + 2 * b + 2 * d + slope(x + h * d, u))
        states.append(x)
    return np.array(states)[:, 2:]


@pytest.mark.parametrize(
    ("law", "wanted"),
    [
        (
            lambda twist, rate, wl: (0.0, -0.06 * np.tanh(wl / 1e-2)),
            ("coulomb@wl.balance", "wl.balance.coulomb", 0.06),
        ),
        (lambda twist, rate, wl: (13.1 * twist**3 / 0.06**2, 0.0), ("hardening@wl.w", None, None)),
    ],
    ids=["friction at the load", "hardening of the shaft"],
)
def test_a_diagnosis_of_a_model_of_equations_names_law_and_place(law, wanted, tmp_path):
    step = 2e-3
    t = np.arange(751) * step
    random = np.random.default_rng(5)
    logs = []
    for name, tones in {"slow": (0.7, 2.3, 4.1), "fast": (1.3, 5.9, 9.7), "last": (1.1, 3.1, 7.3)}.items():
        tau = sum(0.35 * np.sin(2 * np.pi * f * t + f) for f in tones)
        speeds = shaft(law, tau, step)
        for repeat in range(3):
            rows = np.column_stack([t, tau, speeds + random.normal(scale=0.02, size=speeds.shape)])
            logs.append(str(tmp_path / f"{name}_{repeat}.csv"))
            np.savetxt(
                logs[-1], rows, delimiter=",", comments="", header="time [s],tau [N.m],w [rad/s],wl [rad/s]"
            )
    campaign, out = tmp_path / "campaign", tmp_path / "diagnosis"
    assert (
        run(["init", *logs, "--model", str(MODELS), "--class", "Written.Shaft", "--out", str(campaign), "--quiet"])
        == 0
    )
    assert run(["diagnose", str(campaign), "--out", str(out), "--workers", "0", "--quiet"]) == 0
    answer = json.loads((out / "diagnosis.json").read_text())
    name, parameter, value = wanted
    assert answer["verdict"]["kind"] == "effect"
    assert answer["verdict"]["effects"] == [name]
    if parameter is not None:
        assert answer["effects"][0]["parameters"][parameter]["value"] == pytest.approx(value, rel=0.05)
