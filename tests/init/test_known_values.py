"""Which parameters a first campaign frees, which it holds, and why."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.cli.app import run
from fmuid.core.campaign import ModelSource
from fmuid.identification.result import Result
from fmuid.init.known_values import (
    CONSTANT,
    DEFAULT,
    MEDIUM,
    REGULARISATION,
    TABLE,
    ModelText,
    guessed_bounds,
    is_drawn,
    table_entries,
    why_known,
)
from fmuid.simulation.simulator import Variable

CART = """
model Cart "A vehicle that coasts, on rubber, with an OCV table that nobody should identify from it"
  package Motors
    model Coil
      parameter Real k(unit = "N/V") = 30;
      parameter Real alpha = 2 "never set by a user";
    end Coil;
  end Motors;
  parameter Real m(unit = "kg") = 800 "Mass";
  parameter Real g(unit = "m/s2") = 9.81;
  parameter Real rho(unit = "kg/m3") = 1.2 "Air";
  parameter Real A(unit = "m2") = 2 "Front";
  parameter Real c_w(unit = "1") = 0.4 "Drag";
  parameter Real c_r(unit = "1") = 0.02 "Rolling resistance";
  parameter Real v_r(unit = "m/s") = 0.5 "Speed at which rolling resistance is fully there";
  parameter Real T_air(unit = "K") = 293.15;
  parameter Real table[4,2](each unit = "1") = {{0, 1}, {1, 1.1}, {2, 1.2}, {3, 1.3}};
  input Real u(unit = "V");
  output Real v(unit = "m/s", start = 0, fixed = true);
  output Real T(unit = "K", start = 300, fixed = true);
equation
  m*der(v) = 100*u*table[2,2] - 0.5*rho*c_w*A*v*abs(v) - c_r*m*g*tanh(v/v_r);
  100*der(T) = T_air - T;
end Cart;
"""


def variable(name: str, start: float, unit: str | None = None, description: str = "") -> Variable:
    return Variable(name, "parameter", unit=unit, start=start, description=description)


@pytest.mark.parametrize(
    ("parameter", "reason"),
    [
        (variable("world.g", 9.81, "m/s2"), CONSTANT),
        (variable("g", 9.81), CONSTANT),
        (variable("a_max", 9.0, "m/s2"), None),
        (variable("R", 8.314, "J/(mol.K)"), CONSTANT),
        (variable("rho", 1.2, "kg/m3"), MEDIUM),
        (variable("rho", 7800.0, "kg/m3"), None),
        (variable("cp", 4186.0, "J/(kg.K)"), MEDIUM),
        (variable("v_small", 0.01, "m/s"), REGULARISATION),
        (variable("w0", 0.1, "rad/s", "Speed of the regularisation"), REGULARISATION),
        (variable("gear.J", 0.1, "kg.m2", "Small gear"), None),
        (variable("c_w", 0.4, "1", "Drag"), None),
    ],
)
def test_values_that_are_known_without_measuring(parameter: Variable, reason: str | None) -> None:
    assert why_known(parameter, ModelText()) == reason


def test_tables_and_numbered_values_are_held() -> None:
    cells = [variable(f"ocv[{i},{j}]", 1.0) for i in (1, 2) for j in (1, 2)]
    breakpoints = [variable(f"v{k}", 3.0 + k, "V") for k in range(8)]
    tables = table_entries([*cells, *breakpoints, variable("R1", 1.0), variable("R2", 1.0)])
    assert tables == {v.name for v in (*cells, *breakpoints)}
    assert why_known(cells[0], ModelText(), tables) == TABLE


def test_coefficients_are_not_known_from_a_drawing() -> None:
    assert not is_drawn(variable("c_w", 0.4, "1", "Drag"))
    assert not is_drawn(variable("k1", 0.05))
    assert not is_drawn(variable("h_0", 0.1, "m", "Level at the start"))
    assert is_drawn(variable("gear.ratio", 9.0, "1"))
    assert is_drawn(variable("A", 2.0, "m2"))


def test_absolute_temperatures_may_be_30_kelvins_off() -> None:
    assert guessed_bounds(variable("T_room", 293.15, "K")) == pytest.approx((263.15, 323.15))
    assert guessed_bounds(variable("T_room", 20.0, "degC")) == pytest.approx((-10.0, 50.0))
    assert guessed_bounds(variable("T_room", 68.0, "degF")) == pytest.approx((14.0, 122.0))
    assert guessed_bounds(variable("E_over_R", 6000.0, "K")) == pytest.approx((600.0, 60000.0))  # no temperature
    assert guessed_bounds(variable("dT", 5.0, "K")) == pytest.approx((0.5, 50.0))
    assert guessed_bounds(variable("x", -2.0, "m")) == pytest.approx((-20.0, 20.0))


def test_defaults_of_a_library_are_those_that_the_source_does_not_mention(tmp_path: Path) -> None:
    (tmp_path / "M.mo").write_text('model M\n  Coil coil(k = 3) "T_ref";\n  // alpha\nend M;\n')
    text = ModelText(ModelSource.at(tmp_path / "M.mo"))
    assert why_known(variable("coil.k", 3.0), text) is None
    assert why_known(variable("coil.T_ref", 300.0, "K"), text) == DEFAULT
    assert why_known(variable("coil.alpha", 1.0), text) == DEFAULT
    assert why_known(variable("coil.alpha", 1.0), ModelText()) is None


def test_init_frees_what_an_engineer_would(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("Cart.mo").write_text(CART)
    time = np.arange(0.0, 120.0, 0.5)
    u = np.where(time % 40 < 20, 12.0, 0.0)
    v, T = np.zeros_like(time), 294 + 6 * np.exp(-time / 100)
    for k in range(len(time) - 1):
        for _ in range(20):
            rate = (110 * u[k] - 0.5 * 1.2 * 0.9 * v[k + 1] * abs(v[k + 1])) / 900 - 0.15 * np.tanh(2 * v[k + 1])
            v[k + 1] += 0.025 * rate
        if k + 2 < len(time):
            v[k + 2] = v[k + 1]
    rows = np.column_stack([time, u, v * 3.6, T - 273.15])
    np.savetxt("run.csv", rows, delimiter=",", header="time,u [V],v [km/h],T [degC]", comments="")
    assert run(["init", "run.csv", "--model", "Cart.mo", "--workers", "0"]) == 0
    campaign = load_campaign("campaign")
    assert {n for n, p in campaign.parameters.items() if p.free} == {"c_w", "c_r", "m", "T_air"}
    assert {n for n, p in campaign.parameters.items() if p.known} == {"g", "v_r"}
    assert campaign.parameters["T_air"].lower == pytest.approx(263.15)
    assert campaign.parameters["T_air"].scale == "linear"
    assert campaign.parameters["c_w"].depends_on == ("A",)
    out = capsys.readouterr().out
    assert (
        "fixed: A (redundant with the free parameters; a dimension or ratio, which is known from a drawing)" in out
    )
    assert f"fixed: g ({CONSTANT})" in out
    assert f"fixed: rho ({MEDIUM})" in out
    assert f"fixed: v_r ({REGULARISATION})" in out
    assert f"fixed: table (8 entries) ({TABLE})" in out


RUNAWAY = """
model Ball "on a beam that tilts away under it"
  parameter Real b(unit = "1/s2") = 12;
  parameter Real k(unit = "1") = 2;
  parameter Real x_start(unit = "m") = 0.05;
  input Real u(unit = "m/s2");
  output Real x(start = x_start, fixed = true, unit = "m");
  Real v(start = 0, fixed = true, unit = "m/s");
equation
  der(x) = v;
  der(v) = b*x + k*u;
end Ball;
"""


def test_a_runaway_plant_is_recognised_although_a_parameter_gives_its_start_value(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("Ball.mo").write_text(RUNAWAY)
    random, rows, x, v, u = np.random.default_rng(1), [], 0.02, 0.0, 0.0
    for k in range(800):  # a controller holds it
        u = u if k % 2 else -9.0 * x - 2.5 * v + 0.6 * np.sign(np.sin(0.05 * k)) + 0.1 * random.normal()
        rows.append((0.01 * k, u, x + 1e-4 * random.normal()))
        for _ in range(10):
            v += 0.001 * (15.0 * x + 2.4 * u)
            x += 0.001 * v
    np.savetxt("run.csv", rows, delimiter=",", header="time,u [m/s2],x [m]", comments="")
    assert run(["init", "run.csv", "--model", "Ball.mo", "--workers", "0"]) == 0
    out = capsys.readouterr().out
    assert "runs are cut into segments, because the simulation diverges in open loop" in out
    assert "fixed: x_start (does not affect any measured output)" in out
    assert load_campaign("campaign").stages["all"].segments == "auto"
    assert run(["identify", "campaign", "--no-report", "--quiet", "--workers", "0"]) == 0
    result = Result.from_json("runs/campaign")
    assert result["b"].value == pytest.approx(15.0, rel=0.05)
    assert result["k"].value == pytest.approx(2.4, rel=0.05)
