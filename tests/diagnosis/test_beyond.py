"""Laws that act beyond a threshold only: a bearing that rubs at speed, a valve that opens at a pressure."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

import fmuid
from fmuid.diagnosis.made_catalogue import made_catalogue
from fmuid.simulation.coupled.loading import load_simulator

SHAFT = """
model Shaft "A shaft in bearings"
  parameter Real J(unit = "kg.m2") = 0.02 "Rotor";
  parameter Real d(unit = "N.m.s/rad") = 0.05 "Bearings";
  input Real tau(unit = "N.m") "Motor";
  output Real w(unit = "rad/s", start = 0, fixed = true) "Speed";
equation
  J*der(w) = tau - d*w;
end Shaft;
"""
VESSEL = """
model Vessel "A vessel that is filled and emptied by a valve"
  parameter Real A(unit = "m2") = 0.1 "Area";
  parameter Real k(unit = "m2/s") = 0.004 "Valve";
  input Real q(unit = "m3/s") "Pump";
  output Real h(unit = "m", start = 0.3, fixed = true) "Level";
equation
  A*der(h) = q - k*h;
end Vessel;
"""
AMPLIFIED = """
model Amplified "A shaft that is driven through blocks"
  connector In = input Real;
  connector Out = output Real;
  block Amplifier
    In u;
    Out y;
    parameter Real k(unit = "1") = 1 "Gain";
  equation
    y = k*u;
  end Amplifier;
  parameter Real J(unit = "kg.m2") = 0.02 "Rotor";
  parameter Real d(unit = "N.m.s/rad") = 0.05 "Bearings";
  input Real tau(unit = "N.m") "Motor";
  output Real w(unit = "rad/s", start = 0, fixed = true) "Speed";
  Amplifier first;
  Amplifier second;
equation
  first.u = tau;
  connect(first.y, second.u);
  J*der(w) = second.y - d*w;
end Amplified;
"""
SHAFT_STEP, VESSEL_STEP, SAMPLES = 0.01, 1.0, 400


def shaft(torque):
    return lambda value, drive: (drive - 0.05 * value - torque(value)) / 0.02


def campaign(folder, model, step, rate, begin, drives, noise, columns):
    """A campaign with logs of a plant whose state changes at a `rate`, one log for each drive."""
    source = folder / f"{model.split()[1]}.mo"
    source.write_text(model)
    rng, files = np.random.default_rng(5), []
    time = step * np.arange(SAMPLES)
    for run, drive in enumerate(drives):
        given, seen, value = drive(time), np.empty(SAMPLES), begin
        for k in range(SAMPLES):
            seen[k] = value
            for _ in range(20):
                middle = value + step / 40 * rate(value, given[k])
                value += step / 20 * rate(middle, given[k])
        rows = np.column_stack([time, given, seen + noise * rng.standard_normal(SAMPLES)])
        files.append(folder / f"run_{run}.csv")
        np.savetxt(files[-1], rows, "%.8g", ",", header=f"time,{','.join(columns)}", comments="")
    return fmuid.start(files, model=source, out=folder / "campaign")


def of_shaft(folder, torque, model=SHAFT):
    drives = [
        lambda t: 0.4 * np.sin(2.0 * t),
        lambda t: 0.3 * np.sign(np.sin(3.0 * t)),
        lambda t: 0.25 * np.sin(5.0 * t) + 0.15,
    ]
    return campaign(folder, model, SHAFT_STEP, shaft(torque), 0.0, drives, 0.01, ("tau [N.m]", "w [rad/s]"))


def rubbing(speed):
    return 0.06 * np.tanh(speed / 1e-3) * (abs(speed) > 3.0)


def test_friction_that_acts_beyond_a_speed(tmp_path):
    diagnosed = fmuid.diagnose(of_shaft(tmp_path, rubbing), out=tmp_path / "out")
    assert diagnosed.corrected.effects == ("coulomb@w.balance",)
    values = diagnosed.corrected.fit.values
    assert values["w.balance.coulomb"] == pytest.approx(0.06, rel=0.05)
    assert values["w.balance.coulomb_threshold"] == pytest.approx(3.0, abs=0.1)
    answer = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    described = next(e["description"] for e in answer["effects"] if e["id"] == "coulomb@w.balance")
    assert described == f"w.balance: dry friction beyond {values['w.balance.coulomb_threshold']:.3g} rad/s"
    assert f"Coulomb at w.balance acts only{described[described.index(' beyond') :]}." in answer["verdict"]["text"]
    assert answer["corrected_differs"] < 0.05


def test_a_law_that_always_acts_has_no_threshold(tmp_path):
    text = made_catalogue(of_shaft(tmp_path, lambda speed: 0.01 * speed * abs(speed)), load_simulator)
    effects = tomllib.loads(text)["effects"]
    assert effects["quadratic@w.balance"]["expression"] == "w.balance.quadratic*rate*abs(rate)"


def test_a_model_may_have_signals_inside(tmp_path):
    text = made_catalogue(of_shaft(tmp_path, rubbing, AMPLIFIED), load_simulator)
    effects = tomllib.loads(text)["effects"]
    assert "gain@second.u" in effects
    assert "threshold" in effects["coulomb@w.balance"]["expression"]


def of_vessel(folder, begin):
    def rate(level, pumped):
        return (pumped - 0.004 * level - 0.002 * level * (level > 0.6)) / 0.1

    drives = [
        lambda t: 0.003 + 0.002 * np.sin(t / 30.0),
        lambda t: 0.005 * (np.sin(t / 40.0) > -0.3),
        lambda t: 0.002 + 0.004 * (t > 150.0),
    ]
    model = VESSEL.replace("start = 0.3", f"start = {begin}")
    return campaign(folder, model, VESSEL_STEP, rate, begin, drives, 2e-3, ("q [m3/s]", "h [m]"))


def test_a_law_that_sets_in_is_no_lost_row(tmp_path, capsys):
    of_vessel(tmp_path, 0.5)
    assert "a row seems to be missing" not in capsys.readouterr().out


def test_a_leak_above_a_level(tmp_path):
    rig = of_vessel(tmp_path, 0.3)
    diagnosed = fmuid.diagnose(rig, law=False)
    assert diagnosed.corrected.effects == ("leakage@h.balance",)
    same = ("leakage@h.balance",), ("varies@k(h)",)
    assert same in diagnosed.diagnosis.equal
    values = diagnosed.corrected.fit.values
    assert values["h.balance.leakage"] == pytest.approx(0.002, rel=0.1)
    assert values["h.balance.leakage_threshold"] == pytest.approx(0.6, abs=0.02)
