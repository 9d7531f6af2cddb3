"""A catalogue that the model makes itself: ports, laws, terms that are off bit for bit, sizes from the runs."""

from __future__ import annotations

import json
import os
import shutil
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from fmu_build import compile_flat, load
from fmu_build.codegen import PARAMETERS
from fmu_build.domains import domain_of
from fmu_build.errors import ModelicaError
from fmu_build.idle import without_branches
from fmu_build.instrument import Added, Term, instrument
from fmu_build.model_ports import Port, find_ports, held_parameters
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.cli.app import run
from fmuid.core.campaign import ModelSource, ModelSpec
from fmuid.core.errors import SimulationError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements
from fmuid.diagnosis.made_catalogue import (
    Held,
    catalogue_text,
    possible_laws,
    sized,
    with_catalogue,
)
from fmuid.diagnosis.subject import subject_of
from fmuid.diagnosis.variants import Variants, carrier, left_out
from fmuid.effects.effect import Unknown
from fmuid.effects.effects_file import load_catalogue
from fmuid.effects.laws import laws
from fmuid.identification.problem.cases import LOGGED
from fmuid.simulation import model_source
from fmuid.simulation.coupled.loading import load_simulator
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.model_source import built_model, built_with_terms
from fmuid.simulation.signal_effects import disturbed_readings
from fmuid.simulation.simulator import Task
from tests.every_law import HEAD, every_law

RIGS = Path(__file__).parents[1] / "fmu_build" / "models" / "Rigs.mo"
NAMES = ("TwoMass", "Circuit", "Block", "Tanks")


def flat(name):
    return load(RIGS, f"Rigs.{name}")


def everything(model, folder):
    """Every law at every port that makes no variant, as terms and the parameters that they use."""
    catalogue = every_law(model, folder)
    terms = [t for e in catalogue.effects.values() if not e.variant for t in e.terms]
    added = [Added(u.name, e.neutral[u.name]) for e in catalogue.effects.values() for u in e.unknowns]
    for port in catalogue.ports.values():
        if port.input is not None:
            signal = port.input.endswith("signal")
            terms.append(Term(port.name, "signal" if signal else "flow", "p + " * signal + port.input))
            added.append(Added(port.input, input=True))
    return terms, added


def test_the_ports_of_a_drive_are_found_and_named_after_its_components():
    ports = {port.name: port for port in find_ports(flat("TwoMass"))}
    assert {name: port.kind for name, port in ports.items()} == {
        "rotor": "node",
        "load": "node",
        "shaft": "branch",
        "motor.tau": "signal",
    }
    assert [name for name, port in ports.items() if port.passed] == ["motor.tau"]
    assert set(ports["rotor"].same) == {"motor.shaft", "rotor.b", "shaft.a"}
    assert ports["shaft"].compliant
    assert {v.name for v in held_parameters(flat("TwoMass"))} == {"rotor.J", "load.J", "shaft.c", "shaft.d"}


def test_a_gear_is_no_compliant_branch_and_a_measured_flow_tells_the_ends_of_a_node_apart():
    ports = {port.name: port for port in find_ports(flat("Geared"))}
    assert not ports["gear"].compliant
    assert "backlash" not in possible_laws(flat("Geared"))["gear"]
    # The torque into the table is read: its free end is another place than its connection to the gear.
    assert not any({"gear.b", "table.b"} <= {*p.connectors, *p.same} for p in ports.values())


LIKE_THE_STANDARD_LIBRARY = """
model Like "Components written as the Modelica Standard Library writes them"
  import Modelica.Mechanics.{Rotational, Translational};
  import Modelica.Thermal.HeatTransfer.Interfaces.HeatPort;
  model Mass
    Translational.Interfaces.Flange_a a;
    Translational.Interfaces.Flange_b b;
    parameter Real L(unit = "m") = 0.1;
    parameter Real m(unit = "kg") = 1;
    Real s(unit = "m", start = 0, fixed = true);
    Real v(unit = "m/s", start = 0, fixed = true);
  equation
    a.s = s - L/2;
    b.s = s + L/2;
    v = der(s);
    m*der(v) = a.f + b.f;
  end Mass;
  model Capacity
    HeatPort port;
    Real T(unit = "K", start = 300, fixed = true);
    Real der_T(unit = "K/s");
  equation
    T = port.T;
    der_T = der(T);
    100*der(T) = port.Q_flow;
  end Capacity;
  model Support "Takes a torque that is given"
    Rotational.Interfaces.Flange_a flange;
    input Real tau(unit = "N.m");
  equation
    flange.tau = tau;
  end Support;
  model Motor
    Rotational.Interfaces.Flange_b flange;
    input Real i(unit = "A");
    Real tau(unit = "N.m") = 0.1*i;
    Support support(tau = -tau);
  equation
    flange.tau = -tau;
    support.flange.phi = 0;
  end Motor;
  model Rotor
    Rotational.Interfaces.Flange_a flange;
    Real w(unit = "rad/s", start = 0, fixed = true);
  equation
    w = der(flange.phi);
    1e-3*der(w) = flange.tau;
  end Rotor;
  input Real i(unit = "A");
  input Real f(unit = "N");
  Motor motor;
  Rotor rotor;
  Mass first, second;
  HeatPort air;
  Capacity oven;
equation
  motor.i = i;
  connect(motor.flange, rotor.flange);
  first.a.f = f;
  connect(first.b, second.a);
  connect(air, oven.port);
end Like;
"""


def test_ports_are_found_in_components_written_as_in_the_standard_library(tmp_path):
    (tmp_path / "Like.mo").write_text(LIKE_THE_STANDARD_LIBRARY)
    like = load(tmp_path / "Like.mo", "Like")
    ports = {port.name: port for port in find_ports(like)}
    # The ends of a rod are one body and have its name. An oven that computes how fast it warms is also a store.
    assert {name: port.kind for name, port in ports.items()} == {
        "rotor": "node",
        "first": "node",
        "oven": "node",
        "first.b": "joint",
        "motor.i": "signal",
    }
    assert {"viscous", "weight", "inertia"} <= set(possible_laws(like)["first"])


WINCH = """
model Hydraulic "A motor whose torque depends on the pressure alone"
  Rigs.Flange a;
  Rigs.Flange b;
  input Real pressure(unit = "Pa");
  Real twist(unit = "rad") = b.phi - a.phi;
  Real speed(unit = "rad/s");
equation
  speed = der(twist);
  b.tau = -1e-6*pressure + 0.01*speed;
  a.tau + b.tau = 0;
end Hydraulic;
model Differential "Of three shafts, one turns with the sum of the others"
  Rigs.Flange a;
  Rigs.Flange b;
  Rigs.Flange c;
equation
  a.phi = 50*b.phi + c.phi;
  b.tau = -50*a.tau;
  c.tau = -a.tau;
end Differential;
model Frame
  Rigs.Flange a;
equation
  a.phi = 0;
end Frame;
model Winch
  input Real pressure(unit = "Pa");
  Frame frame;
  Rigs.Shaft mounting;
  Rigs.Inertia housing(J = 1);
  Hydraulic motor;
  Rigs.Inertia rotor(J = 0.01);
  Differential gear;
  Rigs.Shaft rope;
  Rigs.Inertia drum(J = 2);
equation
  motor.pressure = pressure;
  connect(frame.a, mounting.a);
  connect(mounting.b, housing.a);
  connect(housing.b, motor.a);
  connect(motor.b, rotor.a);
  connect(rotor.b, gear.a);
  connect(gear.c, housing.b);
  connect(gear.b, rope.a);
  connect(rope.b, drum.a);
end Winch;
"""


def test_friction_acts_in_a_motor_and_grows_with_the_load_behind_its_gear(tmp_path):
    (tmp_path / "Winch.mo").write_text(RIGS.read_text() + WINCH)
    winch = load(tmp_path / "Winch.mo", "Winch")
    ports = {port.name: port for port in find_ports(winch)}
    assert [name for name, port in ports.items() if port.slides] == ["motor"]
    for name in ("motor", "rotor", "housing"):  # the mounting carries the reaction, the rope the load
        assert ".".join(part.name for part in ports[name].quantities["load"].parts) == "rope.a.tau", name
    held = WINCH.replace("Rigs.Inertia drum(J = 2)", "Frame drum")
    (tmp_path / "Winch.mo").write_text(RIGS.read_text() + held)
    ports = {port.name: port for port in find_ports(load(tmp_path / "Winch.mo", "Winch"))}
    for name in ("motor", "rotor", "housing"):  # also where the rope is held as the mounting is
        assert ".".join(part.name for part in ports[name].quantities["load"].parts) == "rope.a.tau", name
    laws_at = possible_laws(winch)
    assert {"viscous", "load_friction", "presliding", "cogging"} <= set(laws_at["motor"])
    assert not {"hardening", "backlash"} & set(laws_at["motor"])
    assert "hardening" in laws_at["rope"]
    assert "load_friction" not in laws_at["rope"]


@pytest.mark.parametrize("load", [-20.0, -0.5, 0.5, 20.0])
@pytest.mark.parametrize("rate", [-5.0, 5.0])
def test_friction_under_load_is_that_of_a_gear_with_two_efficiencies(load, rate):
    eta1, eta2, bearing = 0.9, 0.8, 1.0  # table 1 of the paper, less the bearing friction without load
    driving, driven = 1 / eta1 - 1, 1 - eta2
    forward = load * np.sign(rate)
    lost = driving * (forward + bearing) if forward > -bearing else -driven * (forward + bearing)
    shape = {"size": (driving + driven) / 2, "skew": (driving - driven) / (driving + driven), "preload": bearing}
    expression = laws()["load_friction"].of("rotational")
    torque = eval(expression, {"tanh": np.tanh, "abs": abs}, {**shape, "V": 10.0, "load": load, "rate": rate})
    assert torque == pytest.approx(lost * np.sign(rate))


def law_at(name, domain="rotational", **values):
    functions = {"tanh": np.tanh, "exp": np.exp, "abs": abs, "max": max, "min": min}
    return eval(laws()[name].of(domain).replace("^", "**"), functions, values)


@pytest.mark.parametrize("deflection", [-0.8, -0.1, 0.1, 0.8])
def test_a_spring_hardens_as_a_cube_or_from_contact_to_contact(deflection):
    p = deflection
    cubic = law_at("hardening", p=p, P=1.0, size=5.0, onset=0.0, power=3.0)
    assert cubic == pytest.approx(5 * p**3)
    second = law_at("hardening", p=p, P=2.0, size=5.0, onset=0.3, power=1.0)
    assert second == pytest.approx(5 * np.sign(p) * max(abs(p) - 0.3, 0.0))


def test_friction_falls_with_the_warmth_until_none_is_left():
    at = {"size": -2.0, "dry": 1.0, "rate": 5.0, "V": 10.0}
    assert law_at("thermal_friction", warmth=0.3, drop=0.01, **at) == pytest.approx(-0.6, rel=1e-2)
    strong = law_at("thermal_friction", warmth=0.9, drop=4.0, **{**at, "size": -4.0})
    assert 1.0 + strong == pytest.approx(np.exp(-4.0 * 0.9))  # of a friction of 1


@pytest.mark.parametrize("value", [-2.0, 0.0, 0.7, 3.0])
@pytest.mark.parametrize("hardness", [1.5, 4.0, 100.0])
def test_a_signal_inside_the_model_saturates_as_a_measured_one_does(value, hardness):
    inside = law_at("saturation", "signal", p=value, size=0.8, hardness=hardness)
    outside = disturbed_readings(
        np.full((1, 3), value), ("a",), {"a": {"compression": 0.8, "hardness": hardness}}, np.arange(3.0), {}
    )
    assert inside == pytest.approx(outside[0, 1], rel=1e-4, abs=1e-6)


def test_the_turns_of_a_shaft_are_counted_through_gears_alone():
    def node(name):
        return Port(name, "node", "rotational", (name,), ("rad", "N.m"), {}, {"p": (name,), "flow": ("f",)})

    spring = Port(
        "spring", "branch", "rotational", ("slow", "end"), ("rad", "N.m"), {}, {"p": ("slow", "end"), "flow": ("f",)},
        compliant=True,
    )  # fmt: skip
    time = np.linspace(0.0, 1.0, 400)
    turn = time + 0.1 * np.sin(9 * time)
    runs = [
        {"slow": k * turn, "fast": 30.0 * k * turn, "free": 500 * time**3, "end": 0 * time, "f": 1 + time}
        for k in (0.01, 1.0)
    ]
    places = sized([node("slow"), node("fast"), node("free"), spring], [time, time], runs)
    (sizes,) = (place.sizes for place in places if place.port.name == "spring")
    assert sizes["N"] == pytest.approx(30.0)
    assert sizes["W"] == pytest.approx(np.ptp(turn))


def test_laws_follow_the_domain():
    assert domain_of("rad", "N.m") == "rotational"
    assert domain_of("K", "W") == "thermal"
    assert domain_of("m", "N") == "translational"
    assert domain_of("m", "m3/s") == "fluid"
    assert domain_of("V", None) is None
    passed = ["leakage", "resistance", "voltage_drop", "voltage_hysteresis"]
    assert possible_laws(flat("Circuit"))["capacitor"] == passed
    assert "iron_hysteresis" in possible_laws(flat("Circuit"))["inductor"]
    assert "threshold" in possible_laws(flat("Tanks"))["pipe"]
    assert "hysteresis" in possible_laws(flat("TwoMass"))["shaft"]
    assert "eddy" in possible_laws(flat("Circuit"))["inductor"]
    assert "eddy" not in possible_laws(flat("Circuit"))["resistor"]
    assert {"capacity", "loss", "radiation"} <= set(possible_laws(flat("Block"))["body"])
    assert "outflow" in possible_laws(flat("Tanks"))["upper"]


def test_only_what_has_a_mass_has_a_weight():
    models = Path(__file__).parents[2] / "tests" / "known_rigs" / "models"
    belt = load(models / "BeltAxis.mo", "BeltAxis")
    laws_at = possible_laws(belt)
    assert "weight" in laws_at["carriage"]
    assert "pulley.rim" in {port.name for port in find_ports(belt)}
    assert "weight" not in laws_at.get("pulley.rim", ())


def test_speeds_that_two_components_compute_for_themselves_are_one():
    """The servo's friction differentiates the angle of the arm that it holds; so does the arm."""
    modelica = Path(__file__).parents[2] / "modelica"
    servo = load(modelica / "Pendulum" / "Setups" / "TorqueDriven.mo", "Pendulum.Setups.TorqueDriven")
    laws_at = possible_laws(servo)
    assert {"inertia", "imbalance"} <= set(laws_at["arm"])
    assert "compliance" in laws_at["gear"]


def test_friction_under_load_has_the_torque_of_a_rigid_gear_where_nothing_gives_way(tmp_path):
    """A servo lifts an arm: friction takes a share of what its gear transmits, which depends on what friction takes."""
    modelica = Path(__file__).parents[2] / "modelica"
    servo = load(modelica / "Pendulum" / "Setups" / "TorqueDriven.mo", "Pendulum.Setups.TorqueDriven")
    ports = {port.name: port for port in find_ports(servo)}
    assert ports["arm"].loops
    source = ModelSource(modelica / "Pendulum" / "Setups" / "TorqueDriven.mo", "Pendulum.Setups.TorqueDriven")
    catalogue = every_law(servo, tmp_path)
    assert catalogue.effects["load_friction@arm"].variant
    assert not catalogue.effects["viscous@arm"].variant
    model = ModelSpec("servo", carrier(source, catalogue), source=source)
    variants = Variants({"servo": model}, catalogue, lambda m: load_fmu(m.fmu))
    ratio, rotor, weight = 6.33, 1.25e-4, (1 + 0.078 / 2) * 9.80665 * 0.15
    arm = 0.15**2 + 0.078 * 0.15**2 / 3
    torque, viscous, share = 0.25, 0.6, 0.5

    def slope(_, x):
        def rest(a):  # of the torques at the arm, at an acceleration
            dry = share * abs(torque - rotor * ratio * a) * np.tanh(x[1] / 1e-3)
            return ratio * torque - weight * np.sin(x[0]) - viscous * x[1] - dry - (arm + ratio**2 * rotor) * a

        return [x[1], brentq(rest, -1e4, 1e4)]

    time = np.linspace(0.0, 1.0, 201)
    truth = solve_ivp(slope, (0.0, 1.0), [0.0, 0.0], t_eval=time, rtol=1e-8, atol=1e-10, method="Radau").y[1]
    values = {"friction.K_c": 0.0, "friction.K_v": viscous}
    task = Task(time, {"tau_ref": np.full(time.size, torque)}, ("w",), tolerance=1e-7)
    loaded = {**values, "arm.load_friction": share}
    loaded_speed, plain = (
        variants.simulator("servo", loaded).simulate(task, loaded)[0],
        load_fmu(model.fmu).simulate(task, values)[0],
    )
    assert np.abs(plain - truth).max() > 0.05 * np.ptp(truth)
    assert np.abs(loaded_speed - truth).max() < 2e-3 * np.ptp(truth)


def test_a_parameter_held_at_zero_has_the_scale_of_its_bounds(tmp_path):
    file = tmp_path / "effects.toml"
    held = {"k": Held(0.0, "1", bounds=(0.0, 0.3)), "d": Held(0.0, "N", bounds=(-2.0, 1.0))}
    file.write_text(catalogue_text([], held, HEAD))
    k, d = load_catalogue(file).effects.values()
    assert (k.id, k.neutral, k.two_sided) == ("value@k", {"k": 0.0}, False)
    assert (k.unknowns[0].lower, k.unknowns[0].upper) == (0.0, 0.3)
    assert [t["k"] for t in k.trials] == pytest.approx([0.003, 0.015, 0.06])
    assert d.two_sided
    assert {t["d"] for t in d.trials} == {0.01, -0.02, 0.05, -0.1, 0.2, -0.4}


@pytest.mark.parametrize("written", ['"lever"', '["lever"]'])
def test_a_catalogue_may_have_one_place_or_several_that_say_the_same(tmp_path, written):
    """Catalogues of earlier versions have one."""
    file = tmp_path / "effects.toml"
    text = catalogue_text([], {"k": Held(1.0, "1")}, HEAD)
    file.write_text(text.replace('port = "k"', f'port = "k"\nover = "lever.x"\nwithin = {written}'))
    (effect,) = load_catalogue(file).effects.values()
    assert effect.within == ("lever",)


@pytest.mark.parametrize("name", NAMES)
def test_a_trial_at_a_bound_is_the_bound(name, tmp_path):
    """Otherwise a fit that stays at such a trial would count as one that wants to go beyond all trials."""
    for effect in every_law(flat(name), tmp_path, size=1.2345678).effects.values():
        for unknown in effect.unknowns:
            for value in (trial[unknown.name] for trial in effect.trials if unknown.name in trial):
                near = [b for b in (unknown.lower, unknown.upper) if value == pytest.approx(b, rel=1e-3, abs=0.0)]
                assert not near or value in near, (effect.id, unknown.name)


def test_every_law_says_where_it_comes_from():
    for name, law in laws().items():
        assert all((law.words, law.origin, law.source)), name
        assert law.trials is not None or any(p.scale for p in law.parameters.values()), name


@pytest.mark.parametrize("name", NAMES)
def test_all_off_the_equations_are_bit_for_bit_the_plain_ones(name, tmp_path):
    model = flat(name)
    plain, changed = compile_flat(model), compile_flat(instrument(model, *everything(model, tmp_path)))
    assert (changed.n_x, changed.n_y, changed.has_events) == (plain.n_x, plain.n_y, plain.has_events)
    random = np.random.default_rng(1)
    for _ in range(10):
        x, u = random.normal(size=plain.n_x), random.normal(size=plain.n_u)
        results = []
        for one in (plain, changed):
            p = {v.location.index: v.start for v in one.variables if v.location.vector == "p"}
            inputs = np.append(u, np.zeros(one.n_u - plain.n_u))
            point = [0.3, x, inputs, [float(p[i]) for i in range(one.n_p)], [], [], [], [], []]
            results.append([np.array(part) for part in one.functions["jacobian"](*point)])
        for a, b in zip(*results, strict=True):
            assert np.array_equal(a, b)


def test_laws_that_are_off_take_none_of_the_time_of_a_simulation(tmp_path):
    model = flat("TwoMass")
    plain, changed = compile_flat(model), compile_flat(instrument(model, *everything(model, tmp_path)))
    for name in ("derivatives", "jacobian"):
        on, idle = without_branches(changed.functions[name], PARAMETERS)
        assert idle.n_instructions() < 1.3 * plain.functions[name].n_instructions() + 20
        assert idle.n_instructions() < 0.3 * changed.functions[name].n_instructions()
        assert f"model_{name}_idle(arg" in changed.c_source
        assert "_idle" not in plain.c_source
        p = {v.location.index: v.start for v in changed.variables if v.location.vector == "p"}
        values = np.array([float(p[i]) for i in range(changed.n_p)])
        x, u = np.arange(1.0, changed.n_x + 1), np.zeros(changed.n_u)
        index = next(v.location.index for v in changed.variables if v.name == "load.quadratic")
        for size, acts in ((0.0, 0.0), (0.1, 1.0)):
            values[index] = size
            point = [0.3, x, u, values, [], [], [], [], []]
            assert float(on(values)) == acts
            assert np.array_equal(
                np.array(idle(*point)[0] if name == "jacobian" else idle(*point)),
                np.array(
                    changed.functions[name](*point)[0] if name == "jacobian" else changed.functions[name](*point)
                ),
            ) == (acts == 0.0)


def test_a_term_acts_where_it_is_put():
    model = flat("TwoMass")
    changed = compile_flat(instrument(model, [Term("load", "flow", "drag*rate")], [Added("drag", 0.1)]))
    states = {v.location.index: v.name for v in changed.variables if v.location.vector == "x"}
    p = {v.location.index: v.start for v in changed.variables if v.location.vector == "p"}
    at = list(states.values()).index("load.w")
    index = list(states)[at]
    x = np.zeros(changed.n_x)
    x[index] = 2.0
    x[next(i for i, n in states.items() if n == "rotor.w")] = 2.0  # the shaft turns along
    dx = changed.functions["derivatives"](
        0, x, np.zeros(changed.n_u), [float(p[i]) for i in range(changed.n_p)], [], [], [], [], []
    )
    assert np.array(dx).ravel()[index] == pytest.approx(-0.1 * 2.0 / 5e-3)


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (Term("rotr", "flow", "0"), "no port 'rotr'; did you mean 'rotor'"),
        (Term("rotor", "flow", "2*speed"), "'speed' is unknown at port 'rotor'"),
        (Term("rotor", "flow", "2*tahn(rate)"), "there is no function 'tahn'; did you mean 'tan'"),
        (Term("rotor", "potential", "0"), "not a branch"),
    ],
)
def test_a_wrong_term_is_refused(term, message):
    with pytest.raises(ModelicaError, match=message):
        instrument(flat("TwoMass"), [term], [])


def test_outputs_of_the_fmu_are_bit_for_bit_the_plain_ones(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = ModelSource(RIGS, "Rigs.TwoMass")
    model = flat("TwoMass")
    file = built_with_terms(source, model, *everything(model, tmp_path))
    assert built_with_terms(source, model, *everything(model, tmp_path)) == file
    time = np.linspace(0.0, 2.0, 201)
    task = Task(time, {"tau": 0.3 * np.sign(np.sin(3 * time))}, ("w_motor", "w_load"))
    plain, changed = (load_fmu(f).simulate(task, {}) for f in (built_model(source), file))
    assert np.array_equal(plain, changed)


def test_an_fmu_in_the_cache_that_was_compiled_otherwise_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source, model = ModelSource(RIGS, "Rigs.TwoMass"), flat("TwoMass")
    terms = [Term("rotor", "flow", "0.1*rate")], []
    monkeypatch.setenv("FMU_BUILD_CFLAGS", "-O1")
    fast = built_with_terms(source, model, *terms)
    monkeypatch.setenv("FMU_BUILD_CFLAGS", "-O0")
    slow = built_with_terms(source, model, *terms)
    assert fast.read_bytes() != slow.read_bytes()
    monkeypatch.setenv("FMU_BUILD_CFLAGS", "-O1")
    monkeypatch.setattr(
        model_source, "compile_flat", lambda flat: pytest.fail("compiled although it is in the cache")
    )
    assert built_with_terms(source, model, *terms) == fast


def test_fmus_with_laws_that_nobody_has_asked_for_lately_leave_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source, model = ModelSource(RIGS, "Rigs.TwoMass"), flat("TwoMass")

    def built(law):
        return built_with_terms(source, model, [Term("rotor", "flow", law)], [])

    plain, used, unused = built_model(source), built("0.1*rate"), built("0.2*rate")
    for file in (plain, used, unused):
        os.utime(file, times=(time.time() - 100 * 86_400,) * 2)
    assert built("0.1*rate") == used
    new = built("0.3*rate")
    assert {plain.name, used.name, new.name} == {p.name for p in plain.parent.glob("*.fmu")}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def geared(cache, tmp_path_factory):
    """A geared drive with its variants, and a task for it."""
    del cache
    source = ModelSource(RIGS, "Rigs.Geared")
    catalogue = every_law(flat("Geared"), tmp_path_factory.mktemp("laws"))
    model = ModelSpec("drive", carrier(source, catalogue), source=source)
    time = np.linspace(0.0, 2.0, 201)
    task = Task(time, {"tau": 0.3 * np.sign(np.sin(3 * time))}, ("w_motor", "w_load", "tau_table"))
    return catalogue, Variants({"drive": model}, catalogue, lambda m: load_fmu(m.fmu)), load_fmu(model.fmu), task


@pytest.mark.slow
def test_laws_with_states_are_built_when_they_are_tried_and_off_they_agree_within_the_tolerance(geared):
    catalogue, variants, plain, task = geared
    assert variants.simulator("drive", {}) is None
    off = {n: v for e in catalogue.effects.values() for n, v in e.neutral.items()}
    assert variants.simulator("drive", off) is None
    tried = variants.simulator("drive", {"load.presliding": 0.1})
    assert tried is variants.simulator("drive", {"shaft.hysteresis": 0.1})  # one model for all of them
    a, b = plain.simulate(task, {}), tried.simulate(task, {})
    assert np.abs(a - b).max() < 1e-4 * np.abs(a).max()


def test_an_effect_that_makes_other_states_shares_no_model_with_effects_that_are_tried_while_it_is_off(geared):
    catalogue, shared, plain, task = geared
    size = "gear.ratio.varies"
    given = catalogue.effects["inertia@load"]
    yielding = replace(  # the gear's ends turn apart under torque, so that both are states
        given,
        id="varies@gear.ratio(gear.a.tau)",
        port="gear.ratio",
        acts="parameter",
        expression=f"p*(1 + {size}*gear.a.tau)",
        unknowns=(Unknown(size, 0.0, -1.0, 1.0, 0.01),),
        neutral={size: 0.0},
    )
    variants = replace(shared, catalogue=replace(catalogue, effects={**catalogue.effects, yielding.id: yielding}))
    together, alone = (variants.simulator("drive", {name: 0.1}) for name in ("load.presliding", size))
    assert size not in together.variables
    assert np.isfinite(together.simulate(task, {"load.presliding": 0.1})).all()
    assert len(alone.states) > len(plain.states)


def test_of_the_coefficients_that_depend_on_a_column_only_one_that_needs_its_derivative_is_left_out(geared):
    catalogue, shared, *_ = geared
    given, column = catalogue.effects["inertia@load"], f"{LOGGED}T"

    def over_column(parameter):
        size = f"{parameter}.varies"
        return replace(
            given,
            id=f"varies@{parameter}(T)",
            port=parameter,
            acts="parameter",
            expression=f"p*(1 + {size}*{column})",
            unknowns=(Unknown(size, 0.0, -1.0, 1.0, 0.01),),
            neutral={size: 0.0},
            inputs={column: "K"},
            variant=False,
        )

    effects = {e.id: e for e in map(over_column, ("gear.ratio", "shaft.d", "load.J"))}
    built = load_fmu(carrier(shared.models["drive"].source, replace(catalogue, effects=effects))).variables
    assert "gear.ratio.varies" not in built  # the angles of its ends are in proportion, and their speeds as well
    assert {"shaft.d.varies", "load.J.varies", column} <= {*built}


def test_a_coefficient_varies_only_in_models_that_have_what_it_depends_on(geared):
    catalogue, shared, *_ = geared
    size = "shaft.c.varies"
    over_gear = replace(
        catalogue.effects["inertia@load"],
        id="varies@shaft.c(gear.a.tau)",
        port="shaft.c",
        acts="parameter",
        expression=f"p*(1 + {size}*gear.a.tau)",
        unknowns=(Unknown(size, 0.0, -1.0, 1.0, 0.01),),
        neutral={size: 0.0},
        over="gear.a.tau",
        variant=False,
    )
    both = replace(
        catalogue, effects={over_gear.id: over_gear, "quadratic@load": catalogue.effects["quadratic@load"]}
    )
    sources = (shared.models["drive"].source, ModelSource(RIGS, "Rigs.TwoMass"))
    having, lacking = (load_fmu(carrier(source, both)).variables for source in sources)
    assert size in having
    assert size not in lacking
    assert "load.quadratic" in lacking


def test_bristles_hold_against_a_small_torque_and_slide_under_a_larger_one(geared):
    _, variants, _, task = geared
    values = {"load.presliding": 0.1, "load.presliding_distance": 1e-3}
    simulator = variants.simulator("drive", values)
    time = np.linspace(0.0, 10.0, 501)
    for torque, speed in ((0.05, 0.0), (0.2, None)):
        held = Task(time, {"tau": np.full(time.size, torque)}, task.outputs)
        w = simulator.simulate(held, {**values, "shaft.d": 1.0, "load.viscous": 0.02, "rotor.viscous": 0.02})[1]
        assert abs(w[-1] - (speed if speed is not None else (torque - 0.1) / 0.04)) < 2e-2


def test_an_elasticity_at_a_rigid_connection_is_a_model_of_its_own(geared):
    _, variants, plain, task = geared
    compliance, lag = 0.2, 1e-2
    values = {"gear.compliance": compliance, "gear.compliance_lag": lag}
    simulator = variants.simulator("drive", values)
    assert simulator is variants.simulator("drive", {"gear.compliance": 1e-5})

    def slope(_, x):  # angles and speeds of rotor, load and table; a gear of 3, whose driven side gives way
        twists, rates = (np.array([a - b, b - 3 * c]) for a, b, c in (x[:3], x[3:]))
        shaft, gear = 50 * twists[0] + 0.01 * rates[0], (twists[1] + lag * rates[1]) / compliance
        return [*x[3:], (0.1 - shaft) / 2e-3, (shaft - gear) / 5e-3, 3 * gear / 1e-2]

    time = np.linspace(0.0, 1.0, 101)
    truth = solve_ivp(slope, (0.0, 1.0), np.zeros(6), t_eval=time, rtol=1e-9, atol=1e-9, method="Radau").y[4]
    step = Task(time, {"tau": np.full(time.size, 0.1)}, task.outputs, tolerance=1e-8)
    elastic, rigid = (s.simulate(step, v)[1] for s, v in ((simulator, values), (plain, {})))
    assert np.abs(elastic - truth).max() < 0.02 * np.abs(rigid - truth).max()


@pytest.mark.parametrize("pull", [0.0, 0.4, 1.0])
def test_play_parts_and_its_damping_pulls_only_as_much_as_is_said(geared, pull):
    """The drive of two masses, whose shaft has play, by explicit steps of its own."""
    _, _, simulator, _ = geared
    gap, damping, gain = 0.02, 1.0, 3.0
    step, every, stop = 1e-4, 50, 2.0

    def slope(t, x):
        twist, rate = x[1] - x[0], x[3] - x[2]
        wind = twist - max(min(twist, gap), -gap)
        torque = 50 * wind + damping * rate * (wind != 0)
        if torque * wind < 0:
            torque *= pull
        bound = 1e-2 / gain**2  # the table turns behind a rigid gear
        return np.array([x[2], x[3], (0.3 * np.sin(9 * t) + torque) / 2e-3, -torque / (5e-3 + bound)])

    x, rows = np.zeros(4), []
    for n in range(round(stop / step) + 1):
        if n % every == 0:
            rows.append(x.copy())
        k1 = slope(n * step, x)
        x = x + step * slope((n + 0.5) * step, x + 0.5 * step * k1)
    time = step * every * np.arange(len(rows))
    fine = np.linspace(0.0, stop, 20 * (len(rows) - 1) + 1)
    values = {"shaft.backlash_gap": gap, "shaft.backlash_pull": pull, "shaft.d": damping}
    task = Task(fine, {"tau": 0.3 * np.sin(9 * fine)}, ("w_motor", "w_load"), tolerance=1e-7)
    simulated = simulator.simulate(task, values)[:, ::20]
    truth = np.array(rows).T[2:]
    assert np.allclose(time, fine[::20])
    assert np.abs(simulated - truth).max() < 0.02 * np.ptp(truth)


def test_a_kinematic_error_turns_the_load_and_works_back_without_loss(geared):
    _, _, simulator, _ = geared
    cosine, sine, order, stiffness, damping = 0.03, 0.05, 3.0, 50.0, 0.01

    def slope(_, x):
        ahead = cosine * (np.cos(order * x[0]) - 1) + sine * np.sin(order * x[0])
        ratio = order * (sine * np.cos(order * x[0]) - cosine * np.sin(order * x[0]))
        torque = stiffness * (x[1] - x[0] + ahead) + damping * (x[3] - x[2] * (1 - ratio))
        driven = 0.05 + torque * (1 - ratio)  # what the spring takes, over the speed
        return [x[2], x[3], driven / 2e-3, -torque / (5e-3 + 1e-2 / 9)]

    time = np.linspace(0.0, 1.0, 501)
    truth = solve_ivp(slope, (0.0, 1.0), np.zeros(4), t_eval=time, rtol=1e-9, atol=1e-9, method="Radau").y[2:]
    base = "shaft.kinematic_error"
    values = {f"{base}_cosine": cosine, f"{base}_sine": sine, f"{base}_order": order}
    task = Task(time, {"tau": np.full(time.size, 0.05)}, ("w_motor", "w_load"), tolerance=1e-7)
    simulated, plain = simulator.simulate(task, values), simulator.simulate(task, {})
    assert np.abs(plain - truth).max() > 0.1
    assert np.abs(simulated - truth).max() < 0.02 * np.abs(plain - truth).max()


def test_a_twist_that_is_preferred_as_a_state_makes_room_for_backlash_and_kinematic_errors(cache, tmp_path):
    del cache
    time = np.linspace(0.0, 2.0, 401)
    task = Task(time, {"tau": 0.3 * np.sin(9 * time)}, ("w_motor", "w_load"), tolerance=1e-7)
    off, on = {}, {}
    for name in ("TwoMass", "Relative"):
        source, catalogue = ModelSource(RIGS, f"Rigs.{name}"), every_law(flat(name), tmp_path)
        model = ModelSpec(name, carrier(source, catalogue), source=source)
        variants = Variants({name: model}, catalogue, lambda m: load_fmu(m.fmu))
        plain = load_fmu(model.fmu)
        off[name] = plain.simulate(task, {})
        assert np.array_equal(off[name], load_fmu(built_model(source)).simulate(task, {}))
        for values in ({"shaft.backlash_gap": 0.02}, {"shaft.kinematic_error_sine": 0.02}):
            simulator = variants.simulator(name, values)
            assert (simulator is None) == (name == "TwoMass")
            on.setdefault(next(iter(values)), []).append((simulator or plain).simulate(task, values))
    for one, other in on.values():
        assert np.abs(one - off["TwoMass"]).max() > 0.1
        assert np.abs(one - other).max() < 1e-4 * np.abs(one).max()


def drive_log(file, *, coulomb, pace=4):
    """The two-mass drive by explicit Runge-Kutta steps of its own, with dry friction at the load."""
    step, every, stop = 1e-4, 50, 3.0

    def slope(x, u):
        shaft = 50 * (x[0] - x[1]) + 0.01 * (x[2] - x[3])
        return np.array([x[2], x[3], (u - shaft) / 2e-3, (shaft - coulomb * np.tanh(x[3] / 0.1)) / 5e-3])

    x, rows, random = np.zeros(4), [], np.random.default_rng(int(file.stem[-1]))
    for k in range(int(stop / step)):
        u = 0.1 * np.sign(np.sin(pace * step * (k // every) * every))
        if k % every == 0:
            rows.append([k * step, u, *(x[2:] + 0.02 * random.normal(size=2))])
        a = slope(x, u)
        b = slope(x + 0.5 * step * a, u)
        x = x + step * slope(x + 0.5 * step * b, u)
    np.savetxt(file, rows, delimiter=",", header="time,tau,w_motor,w_load", comments="", fmt="%.9g")


def test_a_campaign_from_a_model_lists_its_effects_without_a_line_edited(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for k in (1, 2):
        drive_log(tmp_path / f"run{k}.csv", coulomb=0.02)
    folder = tmp_path / "drive"
    logs = [str(tmp_path / f"run{k}.csv") for k in (1, 2)]
    model = ["--model", str(RIGS), "--class", "Rigs.TwoMass"]
    assert run(["init", *logs, *model, "--out", str(folder), "--workers", "0"]) == 0
    table = tomllib.loads((folder / "campaign.toml").read_text())
    assert table["models"]["TwoMass"]["class"] == "Rigs.TwoMass"
    assert "effects" not in table
    out, answer = folder / "effects.toml", tmp_path / "answer.json"
    assert run(["effects", str(folder), "--out", str(out), "--json", str(answer), "--workers", "0"]) == 0
    ports = json.loads(answer.read_text())["ports"]
    assert "coulomb" in ports["load"]
    assert "delay" in ports["tau"]
    effect = load_catalogue(out).effects["coulomb@load"]
    sizes = [trial["load.coulomb"] for trial in effect.trials]
    assert sizes[1] == pytest.approx(5 * sizes[0], rel=0.02)
    assert sizes[2] == pytest.approx(20 * sizes[0], rel=0.02)
    assert 0.02 < sizes[2] < 0.2  # of a torque of 0.1 N.m that resonates

    # A run that is neither for identification nor for validation plays no part: its setup needs no model.
    other = Path(shutil.copy(logs[1], tmp_path / "other.csv"))
    units = [f"--unit={name}" for name in ("tau=N.m", "w_motor=rad/s", "w_load=rad/s")]
    taken = ["--setup", "bench", "-i", "tau", *units, "--append", "--out", str(folder / "measurements.h5")]
    assert run(["import", str(other), *taken]) == 0
    assert "bench" not in (folder / "campaign.toml").read_text()
    assert run(["effects", str(folder), "--workers", "0"]) == 0


TANK = """
model Tank
  input Real u(unit = "m3/s");
  output Real h(unit = "m", start = 0, fixed = true) "Level";
  parameter Real A(unit = "m2") = 2;
  parameter Real k(unit = "m2/s") = 0.1;
equation
  A*der(h) = u - k*h;
end Tank;
"""
TANKS = """
[campaign]
name = "tanks"
[models.levels]
source = "Tank.mo"
[models.rates]
source = "Tank.mo"
map = { rise = "gradient(h)", inflow = "u" }
[parameters.A]
start = 2
lower = 1
upper = 4
[parameters.k]
start = 0.1
lower = 0.01
upper = 1
[effects]
nominal = ["A"]
"""


ONE_TANK = """
[campaign]
name = "tank"
[models.levels]
source = "Tank.mo"
[parameters.k]
start = 0.1
lower = 0.001
upper = 1
"""


def test_setups_with_other_signals_share_a_catalogue(tmp_path, monkeypatch):
    """One setup reads a level, another also how fast it rises; an effect couples signals that were read together."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "Tank.mo").write_text(TANK)
    (tmp_path / "campaign.toml").write_text(TANKS)
    time, random = np.linspace(0.0, 60.0, 121), np.random.default_rng(2)
    inflow = np.where(time > 5.0, 0.05, 0.0)
    level = 0.5 * (1 - np.exp(-0.05 * np.maximum(time - 5.0, 0.0))) + 1e-4 * random.standard_normal((3, 121))
    runs = {}
    for k, h in enumerate(level):
        signals = [Signal("u", inflow, "m3/s", "input"), Signal("h", h, "m", "output")]
        runs[f"l{k}"] = Experiment(f"l{k}", "levels", time, {s.name: s for s in signals})
        rise = Signal("rise", 1e3 * np.gradient(h, time), "mm/s", "output")
        signals = [Signal("inflow", 2 * inflow, "m3/s", "input"), rise, Signal("h", 2 * h, "m", "output")]
        runs[f"r{k}"] = Experiment(f"r{k}", "rates", time, {s.name: s for s in signals})
    write_measurements(Measurements(runs), tmp_path / "measurements.h5")
    campaign = with_catalogue(load_campaign(tmp_path), load_simulator)
    effects = load_catalogue(campaign.effects.file).effects
    assert {u.name for u in effects["crosstalk@rise"].unknowns} == {"rise.crosstalk[u]", "rise.crosstalk[h]"}
    assert {u.name for u in effects["crosstalk@h"].unknowns} == {"h.crosstalk[u]", "h.crosstalk[rise]"}
    assert effects["offset@u"].trials[1]["u.offset"] == pytest.approx(0.05 * 0.1)  # of the largest range
    assert 0.5 < effects["offset@rise"].trials[1]["rise.offset"] / (0.05 * np.ptp(level[0][10:22]) / 6.0) < 2.0
    assert effects["offset@rise"].units["rise.offset"] == "(m)/s"
    assert "value@k" in effects  # only A is refitted in any case
    assert "value@A" not in effects
    subject = subject_of(campaign, load_simulator, experiments=["l*"])
    assert [u.name for u in subject.nominal] == ["A"]
    assert {u.name for u in subject.by_id["crosstalk@h"].unknowns} == {"h.crosstalk[u]"}
    assert not [name for name in subject.by_id if name.endswith("@rise")]


def test_sizes_come_from_the_refitted_model(tmp_path, monkeypatch):
    """The plain model's start value of k says that the tank fills to 0.5 m; it fills to 2.5 m."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "Tank.mo").write_text(TANK)
    (tmp_path / "campaign.toml").write_text(ONE_TANK)
    time, random = np.linspace(0.0, 600.0, 301), np.random.default_rng(2)
    level = 2.5 * (1 - np.exp(-0.01 * time)) + 1e-3 * random.standard_normal((3, 301))
    runs = {}
    for k, h in enumerate(level):
        signals = [Signal("u", np.full(301, 0.05), "m3/s", "input"), Signal("h", h, "m", "output")]
        runs[f"l{k}"] = Experiment(f"l{k}", "levels", time, {s.name: s for s in signals})
    write_measurements(Measurements(runs), tmp_path / "measurements.h5")
    campaign = with_catalogue(load_campaign(tmp_path), load_simulator)
    (rim,) = (
        u for u in load_catalogue(campaign.effects.file).effects["overflow@h.balance"].unknowns if "rim" in u.name
    )
    assert rim.upper == pytest.approx(2.5, rel=0.02)


LOOPS = """
block Plant
  input Real u(unit = "V");
  output Real x(unit = "V", start = 0, fixed = true);
equation
  der(x) = u - x;
end Plant;
model Open
  input Real u(unit = "V");
  output Real y(unit = "V");
  Plant plant;
equation
  plant.u = u;
  y = plant.x;
end Open;
block Gain
  input Real e(unit = "V");
  output Real y(unit = "V");
equation
  y = 5*e;
end Gain;
model Closed
  input Real r(unit = "V");
  output Real y(unit = "V");
  Gain gain;
  Plant plant;
equation
  gain.e = r - y;
  plant.u = gain.y;
  y = plant.x;
end Closed;
"""
LOOPED = """
[campaign]
name = "loops"
[models.open]
source = "Loops.mo"
class = "Open"
[models.closed]
source = "Loops.mo"
class = "Closed"
"""


def test_what_one_setup_passes_on_and_another_computes_is_one_place(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "Loops.mo").write_text(LOOPS)
    (tmp_path / "campaign.toml").write_text(LOOPED)
    time = np.linspace(0.0, 10.0, 101)
    given, y = np.where(time > 1.0, 1.0, 0.0), 1 - np.exp(-np.maximum(time - 1.0, 0.0))

    def recorded(setup, name):
        signals = {name: Signal(name, given, "V", "input"), "y": Signal("y", y, "V", "output")}
        return Experiment(setup, setup, time, signals)

    write_measurements(
        Measurements({"open": recorded("open", "u"), "closed": recorded("closed", "r")}),
        tmp_path / "measurements.h5",
    )
    campaign = with_catalogue(load_campaign(tmp_path), load_simulator)
    effects = load_catalogue(campaign.effects.file).effects
    assert "saturation@plant.u" in effects
    task = Task(time, {"u": given}, ("y",))
    values = {"plant.u.saturation": 2.0, "plant.u.saturation_hardness": 100.0}
    model = replace(
        campaign.models["open"], fmu=carrier(campaign.models["open"].source, load_catalogue(campaign.effects.file))
    )
    plain, limited = (load_fmu(model.fmu).simulate(task, v)[0, -1] for v in ({}, values))
    assert plain == pytest.approx(1.0, rel=1e-3)
    assert limited == pytest.approx(0.5, rel=1e-2)
    # A course of its own may be added to the signal: half of the step from 6 s on.
    added = load_catalogue(campaign.effects.file).ports["plant.u"].input
    course = np.where(time > 6.0, 0.5, 0.0)
    y = load_fmu(model.fmu).simulate(Task(time, {"u": given, added: course}, ("y",)), {})[0]
    assert y[-1] - plain == pytest.approx(0.5 * (1 - np.exp(-4.0)), rel=2e-2)
    write_measurements(Measurements({"open": recorded("open", "u")}), tmp_path / "measurements.h5")
    alone = with_catalogue(load_campaign(tmp_path), load_simulator)
    assert not [name for name in load_catalogue(alone.effects.file).effects if name.endswith("@plant.u")]


ROOMS = """
model Room
  input Real P(unit = "W");
  output Real T(unit = "K");
  Rigs.Heater heater;
  Rigs.Mass body;
equation
  heater.P = P;
  connect(heater.port, body.port);
  T = body.T;
end Room;
model TwoRooms
  extends Room;
  Rigs.Wall wall;
  Rigs.Mass sink(C = 3000);
equation
  connect(body.port, wall.a);
  connect(wall.b, sink.port);
end TwoRooms;
"""
HEATED = """
[campaign]
name = "rooms"
[models.one]
source = "Rooms.mo"
class = "Room"
[models.two]
source = "Rooms.mo"
class = "TwoRooms"
"""


def test_setups_may_have_models_with_other_places(tmp_path, monkeypatch):
    """The second room, which only one setup has, loses heat: its model alone is corrected."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "Rooms.mo").write_text(RIGS.read_text() + ROOMS)
    (tmp_path / "campaign.toml").write_text(HEATED)
    time, random, runs = np.linspace(0.0, 600.0, 121), np.random.default_rng(2), {}
    for k in range(3):
        for setup, power, loss in (("one", 2.0, 0.0), ("two", 50.0, 5.0)):
            heat = np.where(time > 60.0, power * (1 + k), 0.0)
            warm = rooms(time, heat, sink=3000.0 if setup == "two" else 0.0, loss=loss)
            for again in range(2):
                noisy = Signal("T", warm + 0.1 * random.standard_normal(121), "K", "output")
                name = f"{setup}{k}{'r' * again}"
                signals = {"P": Signal("P", heat, "W", "input"), "T": noisy}
                runs[name] = Experiment(name, setup, time, signals, repeat_of=name[:-1] if again else None)
    write_measurements(Measurements(runs), tmp_path / "measurements.h5")
    campaign = with_catalogue(load_campaign(tmp_path), load_simulator)
    ports = load_catalogue(campaign.effects.file).ports
    assert ports["body"].magnitude == pytest.approx(1.5, rel=0.2)  # a hundredth of the largest flow in any setup
    both = subject_of(campaign, load_simulator)
    assert "body temperature" in both.catalogue.regimes
    assert "sink temperature" not in both.catalogue.regimes  # half of the runs have no such place
    assert "sink temperature" in subject_of(campaign, load_simulator, experiments=["two*"]).catalogue.regimes

    assert run(["diagnose", str(tmp_path), "--out", str(tmp_path / "run"), "--no-law", "--workers", "0"]) == 0
    answer = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    likeliest = [a["effects"] for a in answer["answers"][:2]]  # in three runs, radiation would be much the same
    assert sorted(likeliest) == [["loss@sink"], ["radiation@sink"]]
    (effect,) = (e for e in answer["effects"] if e["id"] == "loss@sink")
    assert effect["parameters"]["sink.loss"]["value"] == pytest.approx(5.0, rel=0.05)
    corrected = tomllib.loads((tmp_path / "run" / "corrected" / "campaign.toml").read_text())["models"]
    assert ["effects" in corrected[setup] for setup in ("one", "two")] == [False, True]


def rooms(time, heat, *, sink, loss):
    """Temperature of a heated body, which a wall may connect to a sink that loses heat."""
    steps, warm = 20, np.full((2, len(time)), 293.0)
    for i in range(1, len(time)):
        body, far = warm[:, i - 1]
        for _ in range(steps):
            through = 2.0 * (body - far) if sink else 0.0
            step = (time[i] - time[i - 1]) / steps
            body += step * (heat[i - 1] - through) / 500.0
            far += step * (through - loss * (far - 293.0)) / sink if sink else 0.0
        warm[:, i] = body, far
    return warm[0]


@pytest.mark.slow
def test_from_verdict_to_a_model_with_the_law_in_it_and_on_to_the_next(tmp_path, monkeypatch, capsys):
    """Dry friction at the load is found, added to the model's source, and identified; nothing else is missing.

    The model is in a file that uses a library elsewhere.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    for k in (1, 2, 3):
        drive_log(tmp_path / f"run{k}.csv", coulomb=0.02, pace=2 + 2 * k)
    logs = [f"run{k}.csv" for k in (1, 2, 3)]
    Path("TwoMass.mo").write_text("model TwoMass\n  extends Rigs.TwoMass;\nend TwoMass;\n")
    model = ["--model", "TwoMass.mo", "--root", str(RIGS.parent)]
    assert run(["init", *logs, *model, "--workers", "0"]) == 0
    assert run(["diagnose", "campaign", "--out", "first", "--workers", "0"]) == 0
    assert json.loads(Path("first/diagnosis.json").read_text())["verdict"]["effects"] == ["coulomb@load"]
    corrected = Path("first/corrected")
    names = {"TwoMass.fmu", "TwoMassCorrected.mo", "campaign.toml", "effects.toml", "parameters.ssv"}
    assert {path.name for path in corrected.iterdir()} == names
    fmu = load_fmu(corrected / "TwoMass.fmu")
    assert fmu.variables["load.coulomb"].start == pytest.approx(0.02, rel=0.02)

    # The source says what the FMU does.
    source = ModelSource(corrected / "TwoMassCorrected.mo", "TwoMassCorrected")
    task = Task(np.linspace(0.0, 1.0, 101), {"tau": 0.1 * np.ones(101)}, ("w_motor", "w_load"))
    written = load_fmu(built_model(source)).simulate(task, {})
    assert written == pytest.approx(fmu.simulate(task, {}), abs=1e-9)

    assert run(["identify", str(corrected), "--out", "found", "--no-report", "--workers", "0"]) == 0
    table = json.loads(Path("found/result.json").read_text())
    assert table["parameters"]["load.coulomb"] == pytest.approx(0.02, rel=0.02)
    assert run(["diagnose", "found", "--out", "second", "--workers", "0"]) == 0
    second = json.loads(Path("second/diagnosis.json").read_text())
    assert second["verdict"]["kind"] == "complete"
    assert "coulomb@load" not in {e["id"] for e in second["effects"]}


DIFFERENTIATED = """
model Held "A mass held by a controller that differentiates its position"
  model Controller
    input Real x(unit="m");
    input Real r(unit="m");
    output Real f(unit="N");
    parameter Real kp(unit="N/m") = 400, kd(unit="N.s/m") = 20;
  equation
    f = kp*(r - x) - kd*der(x);
  end Controller;
  model Mass
    input Real f(unit="N");
    output Real x(unit="m", start=0, fixed=true);
    parameter Real m(unit="kg", min=0) = 1;
    Real v(unit="m/s", start=0, fixed=true);
  equation
    v = der(x);
    m*der(v) = f;
  end Mass;
  input Real r(unit="m");
  output Real x(unit="m");
  Controller controller;
  Mass mass;
equation
  controller.r = r;
  controller.x = mass.x;
  mass.f = controller.f;
  x = mass.x;
end Held;
"""


def test_a_signal_that_is_differentiated_has_laws_but_no_input(cache, tmp_path):
    del cache
    file = tmp_path / "Held.mo"
    file.write_text(DIFFERENTIATED)
    source = ModelSource(file, "Held")
    catalogue = every_law(load(file, "Held"), tmp_path)
    variables = load_fmu(carrier(source, catalogue)).variables
    assert "controller.x.gain" in variables
    assert "controller.x.added_signal" not in variables
    assert "mass.f.added_signal" in variables


SPACED = """
model Coils "Two coils with a resistor between them"
  connector Pin
    Real v(unit="V");
    flow Real i(unit="A");
  end Pin;
  model Source
    Pin p;
    input Real u(unit="V");
  equation
    p.v = u;
  end Source;
  model Coil
    Pin p, n;
    parameter Real L(unit="H", min=0) = 1e-3;
    Real i(unit="A");
  equation
    i = p.i;
    p.i + n.i = 0;
    L*der(i) = p.v - n.v;
  end Coil;
  model Resistor
    Pin p, n;
    parameter Real R(unit="Ohm", min=0) = 2;
  equation
    p.i + n.i = 0;
    p.v - n.v = R*p.i;
  end Resistor;
  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;
  input Real u(unit="V");
  output Real i(unit="A");
  Source source; Coil first; Coil second; Resistor between; Resistor load; Ground ground;
equation
  source.u = u;
  connect(source.p, first.p);
  connect(first.n, between.p);
  connect(between.n, second.p);
  connect(second.n, load.p);
  connect(load.n, ground.p);
  i = load.p.i;
end Coils;
"""


def test_what_a_model_cannot_be_built_with_is_left_out_and_said(cache, tmp_path, monkeypatch):
    del cache
    file = tmp_path / "Coils.mo"
    file.write_text(SPACED)
    # Both coils have the same current, unless something between them has a share of it.
    source, catalogue = ModelSource(file, "Coils"), every_law(load(file, "Coils"), tmp_path)
    few = ("leakage@between", "leakage@load", "resistance@between")
    catalogue = replace(catalogue, effects={name: catalogue.effects[name] for name in few})
    model = ModelSpec("coils", carrier(source, catalogue), source=source)
    variables = load_fmu(model.fmu).variables
    assert "load.leakage" in variables
    assert "between.leakage" not in variables
    assert "first.n.added_flow" not in variables
    with monkeypatch.context() as patch:
        for name in ("diagnosis.variants.check_flat", "simulation.model_source.compile_flat"):
            patch.setattr(f"fmuid.{name}", lambda flat: pytest.fail("translated although what fits is known"))
        assert carrier(source, catalogue) == model.fmu
    [(why, left)] = left_out([model], catalogue, variables.keys()).items()
    assert left == ["leakage@between"]
    assert why == "singular: the equations do not determine between.p.i, first.n.v"

    late = replace(catalogue.effects["leakage@between"], variant=True)
    catalogue = replace(catalogue, effects={**catalogue.effects, late.id: late})
    model = replace(model, fmu=carrier(source, catalogue))
    assert left_out([model], catalogue, load_fmu(model.fmu).variables.keys()) == {}
    variants = Variants({"coils": model}, catalogue, lambda m: load_fmu(m.fmu))
    assert variants.simulator("coils", {"between.resistance": 0.1}) is not None
    with pytest.raises(SimulationError, match="cannot be built with 'leakage@between'"):
        variants.simulator("coils", {"between.leakage": 0.1})


LINKS = """model Arm
  connector Joint Real phi(unit = "rad"); flow Real tau(unit = "N.m"); end Joint;
  model Motor Joint joint; input Real tau(unit = "N.m"); equation joint.tau = -tau; end Motor;
  model Damper Joint joint; parameter Real d(unit = "N.m.s/rad") = 0.1; equation joint.tau = d*der(joint.phi); end Damper;
  model Links
    Joint shoulder;
    Joint elbow;
    parameter Real J(unit = "kg.m2") = 2;
    parameter Real mgr(unit = "N.m") = 3;
    Real q1(start = 0, fixed = true, unit = "rad");
    Real q2(start = 0, fixed = true, unit = "rad");
    Real w1(start = 0, fixed = true, unit = "rad/s");
    Real w2(start = 0, fixed = true, unit = "rad/s");
  equation
    q1 = shoulder.phi;
    q2 = elbow.phi;
    w1 = der(q1);
    w2 = der(q2);
    J*der(w1) = shoulder.tau;
    J*der(w2) = elbow.tau - mgr*sin(q1 + q2);
  end Links;
  input Real tau(unit = "N.m");
  output Real q(unit = "rad") = links.q2;
  Motor motor;
  Damper damper;
  Damper loose;
  Links links;
equation
  motor.tau = tau;
  connect(motor.joint, links.shoulder);
  connect(damper.joint, links.shoulder);
  connect(loose.joint, links.elbow);
end Arm;
"""


def test_a_model_with_effects_begins_in_the_states_of_the_plain_one(cache, tmp_path):
    """A drop of the angle between links and joint would make the joint's angle the state, which has no start."""
    del cache
    file = tmp_path / "Arm.mo"
    file.write_text(LINKS)
    source, flat = ModelSource(file, "Arm"), load(file, "Arm")
    plain, extended = load_fmu(built_model(source)), load_fmu(carrier(source, every_law(flat, tmp_path)))
    assert "links.kinematic_error_sine" in extended.variables
    assert set(extended.states) == set(plain.states) == {"links.q1", "links.q2", "links.w1", "links.w2"}
    assert not extended.unsettable
