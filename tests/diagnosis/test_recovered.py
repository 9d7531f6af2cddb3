"""Effects that small rigs have and their models lack are named from single runs, with their values."""

from __future__ import annotations

import re

import numpy as np
import pytest

import fmuid

VESSELS = """
model Vessels "Two vessels and a valve between them"
  connector Opening
    Real h(unit = "m");
    flow Real q(unit = "m3/s");
  end Opening;
  model Vessel
    Opening o;
    parameter Real A(unit = "m2") = 0.1;
    Real h(unit = "m", start = 0.5, fixed = true);
  equation
    o.h = h;
    A*der(h) = o.q;
  end Vessel;
  model Valve
    Opening a;
    Opening b;
    parameter Real k(unit = "m2/s") = 0.01;
  equation
    a.q = k*(a.h - b.h);
    a.q + b.q = 0;
  end Valve;
  model Pump
    Opening o;
    input Real q(unit = "m3/s");
  equation
    o.q = -q;
  end Pump;
  input Real q(unit = "m3/s", start = 0);
  output Real h1(unit = "m");
  output Real h2(unit = "m");
  Pump pump;
  Vessel first;
  Valve valve;
  Vessel second(A = 0.2);
equation
  pump.q = q;
  connect(pump.o, first.o);
  connect(first.o, valve.a);
  connect(valve.b, second.o);
  h1 = first.h;
  h2 = second.h;
end Vessels;
"""
PINS = """
  connector Pin
    Real v(unit = "V");
    flow Real i(unit = "A");
  end Pin;
  model Resistor
    Pin p;
    Pin n;
    parameter Real R(unit = "Ohm") = 1;
  equation
    p.v - n.v = R*p.i;
    p.i + n.i = 0;
  end Resistor;
  model Ground
    Pin p;
  equation
    p.v = 0;
  end Ground;
"""
CELL = f"""
model Cell "A cell that is charged and discharged"{PINS}
  model Source
    Pin p;
    Pin n;
    parameter Real E(unit = "V") = 3.3;
    parameter Real C(unit = "F") = 4000;
    Real q(unit = "V", start = 0, fixed = true);
  equation
    p.v - n.v = E + q;
    C*der(q) = p.i;
    p.i + n.i = 0;
  end Source;
  model Charger
    Pin p;
    Pin n;
    input Real i(unit = "A");
  equation
    p.i = -i;
    p.i + n.i = 0;
  end Charger;
  input Real i(unit = "A", start = 0);
  output Real v(unit = "V");
  Source source;
  Resistor resistor(R = 0.02);
  Charger charger;
  Ground ground;
equation
  charger.i = i;
  connect(charger.p, resistor.p);
  connect(resistor.n, source.p);
  connect(source.n, ground.p);
  connect(charger.n, ground.p);
  v = charger.p.v;
end Cell;
"""
CHOKE = f"""
model Choke "A choke and its resistance"{PINS}
  model Inductor
    Pin p;
    Pin n;
    parameter Real L(unit = "H") = 0.2;
    Real i(unit = "A", start = 0, fixed = true);
  equation
    i = p.i;
    L*der(i) = p.v - n.v;
    p.i + n.i = 0;
  end Inductor;
  model Source
    Pin p;
    Pin n;
    input Real v(unit = "V");
  equation
    p.v - n.v = v;
    p.i + n.i = 0;
  end Source;
  input Real v(unit = "V", start = 0);
  output Real i(unit = "A");
  Source source;
  Resistor resistor(R = 4);
  Inductor inductor;
  Ground ground;
equation
  source.v = v;
  connect(source.p, resistor.p);
  connect(resistor.n, inductor.p);
  connect(inductor.n, ground.p);
  connect(source.n, ground.p);
  i = resistor.p.i;
end Choke;
"""
HEATER = """
model Heater "Water behind a valve"
  parameter Real k = 2;
  parameter Real T(unit = "s") = 5;
  input Real u(start = 0);
  output Real y(start = 0, fixed = true);
equation
  T*der(y) = k*u - y;
end Heater;
"""
RUNS = 3


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def levels(rng, count, hold, size):
    """Return random levels of an input, each held for some samples."""
    return np.repeat(rng.uniform(-size, size, count // hold + 1), hold)[:count]


def diagnosed(folder, source, header, runs):
    """Diagnose single runs, each an array with the columns of the header."""
    paths = []
    for k, run in enumerate(runs):
        paths.append(folder / f"run_{k}.csv")
        np.savetxt(paths[-1], run, "%.7f", ",", header=header, comments="")
    model = folder / f"{source.split()[1]}.mo"
    model.write_text(source)
    fmuid.start(paths, model=model, out=folder / "campaign")
    text = (folder / "campaign" / "campaign.toml").read_text()  # a wrong model may explain the other timing better
    (folder / "campaign" / "campaign.toml").write_text(re.sub(r'timing = "[a-z-]*"', 'timing = "held"', text))
    return fmuid.diagnose(folder / "campaign", workers=0, law=False)


def integrated(step, inputs, start, rate, *, fine=20):
    """Return the states at every sample of an input that is held until the next."""
    state, states = np.array(start, dtype=float), []
    for u in inputs:
        states.append(state.copy())
        for _ in range(fine):
            state = state + step / fine * np.array(rate(state, u))
    return np.array(states)


def test_a_valve_that_opens_only_beyond_a_pressure(tmp_path):
    rng, step, runs = np.random.default_rng(3), 0.5, []
    time = step * np.arange(300)

    def rate(state, q):
        across = state[0] - state[1]
        flow = 0.0105 * (across - np.clip(across, -0.08, 0.08))
        return (q - flow) / 0.1, flow / 0.2

    for _ in range(RUNS):
        q = levels(rng, 300, 25, 0.006)
        q -= q.mean()
        h = integrated(step, q, (0.5, 0.5), rate) + 1e-3 * rng.standard_normal((300, 2))
        runs.append(np.column_stack([time, q, h]))
    diagnosis = diagnosed(tmp_path, VESSELS, "time,q [m3/s],h1 [m],h2 [m]", runs)
    assert diagnosis.corrected.effects == ("threshold@valve",)
    assert diagnosis.corrected.fit.values["valve.threshold"] == pytest.approx(0.08, rel=0.02)


@pytest.mark.slow
def test_a_cell_whose_voltage_at_rest_depends_on_the_current_before(tmp_path):
    rng, step, runs = np.random.default_rng(3), 5.0, []
    time = step * np.arange(300)

    def rate(state, i):
        return i / 4100.0, (i - abs(i) * state[1]) / 120.0

    for _ in range(RUNS):
        i = levels(rng, 300, 20, 2.0) * np.repeat(rng.random(16) > 0.25, 20)[:300]
        charge, ahead = integrated(step, i, (0.0, 0.0), rate).T
        v = 3.3 + charge + 0.021 * i + 0.03 * ahead + 5e-4 * rng.standard_normal(300)
        runs.append(np.column_stack([time, i, v]))
    diagnosis = diagnosed(tmp_path, CELL, "time,i [A],v [V]", runs)
    (effect,), values = diagnosis.corrected.effects, diagnosis.corrected.fit.values
    law, _, place = effect.partition("@")
    assert (law, place in ("source", "resistor")) == ("voltage_hysteresis", True)  # which are in series
    assert values[f"{place}.voltage_hysteresis"] == pytest.approx(0.03, rel=0.05)
    assert values[f"{place}.voltage_hysteresis_charge"] == pytest.approx(120.0, rel=0.1)


@pytest.mark.slow
def test_a_choke_whose_iron_remembers_the_flux(tmp_path):
    rng, step, runs = np.random.default_rng(3), 5e-3, []
    time = step * np.arange(400)

    def rate(state, v):
        across = v - 4.1 * (state[0] + 0.3 * state[1])
        return across / 0.21, (across - abs(across) * state[1]) / 0.05

    for run in range(RUNS):
        v = levels(rng, 400, 12 + 6 * run, 10.0)
        current, iron = integrated(step, v, (0.0, 0.0), rate, fine=100).T
        i = current + 0.3 * iron + 5e-3 * rng.standard_normal(400)
        runs.append(np.column_stack([time, v, i]))
    diagnosis = diagnosed(tmp_path, CHOKE, "time,v [V],i [A]", runs)
    assert diagnosis.corrected.effects == ("iron_hysteresis@inductor",)
    assert diagnosis.corrected.fit.values["inductor.iron_hysteresis"] == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize(
    ("effect", "name", "value"),
    [("play@u", "u.play", 0.15), ("rate_limit@u", "u.slowness", 2.5)],
)
def test_a_valve_with_play_or_a_limited_rate(tmp_path, effect, name, value):
    rng, step, runs = np.random.default_rng(3), 0.1, []
    time = step * np.arange(400)
    for run in range(RUNS):
        if name == "u.play":
            u = np.cumsum(levels(rng, 400, 15, 0.05))
            u = (u - u.mean()) / np.abs(u - u.mean()).max() + 0.3 * np.sin(time * (0.7 + 0.3 * run))
        else:
            u = levels(rng, 400, 40, 1.0)

        def rate(state, wanted):
            left = wanted - state[1]
            if name == "u.play":
                moved = (left - np.clip(left, -value, value)) / (step / 50)  # at once
            else:
                moved = np.clip(left / (step / 50), -1.0 / value, 1.0 / value)
            return (2.2 * (state[1] + moved * step / 50) - state[0]) / 5.5, moved

        y = integrated(step, u, (0.0, u[0]), rate, fine=50)[:, 0] + 3e-3 * rng.standard_normal(400)
        runs.append(np.column_stack([time, u, y]))
    diagnosis = diagnosed(tmp_path, HEATER, "time,u,y", runs)
    assert diagnosis.corrected.effects == (effect,)
    assert diagnosis.corrected.fit.values[name] == pytest.approx(value, rel=0.02)
