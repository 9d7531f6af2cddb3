"""What a diagnosis does not look for is reported before it starts, as lines and as data."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fmuid.cli.app import run

TANK = """
model Tank
  parameter Real k{m2} = 0.1;
  parameter Real A{m2} = 1;
  input Real u{m3s};
  Real q{m3s} = k*sqrt(2*9.81*max(h, 1e-4));
  output Real h(start = 1, fixed = true{m});
equation
  A*der(h) = u - q;
end Tank;
"""
SWING = """
model Swing
  parameter Real c(unit = "N/m") = 30;
  parameter Real m(unit = "kg") = 1;
  input Real u(unit = "N");
  output Real x(unit = "m", start = 0, fixed = true);
  Real v(unit = "m/s", start = 0, fixed = true);
equation
  der(x) = v;
  m*der(v) = u - c*x - 0.5*v;
end Swing;
"""
TIME = np.arange(0.0, 10.0, 0.05)


def init(
    model: str, text: str, y: np.ndarray, header: str, capsys: pytest.CaptureFixture[str]
) -> tuple[str, list]:
    Path(f"{model}.mo").write_text(text)
    rows = np.column_stack([TIME, 1 + np.sin(3 * TIME), y, TIME])
    np.savetxt("run.csv", rows, delimiter=",", comments="", header=header)
    command = ["init", "run.csv", "--model", f"{model}.mo", "--workers", "0", "--json", "said.json"]
    assert run(command) == 0
    return capsys.readouterr().out, json.loads(Path("said.json").read_text())["not_looked_for"]


def test_a_model_without_units_has_no_places_inside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    level = 1 + 0.1 * np.sin(TIME)
    out, findings = init("Tank", TANK.format(m="", m2="", m3s=""), level, "time,u,h,wind [m/s]", capsys)
    line = "not looked for: effects inside the model (h has no unit, so no balance of a quantity is recognised); "
    assert line + 'write units in the model, as in Real h(unit = "m")' in out
    assert "columns that nothing uses: wind (" in out
    assert [f["what"] for f in findings] == ["effects inside the model"]
    assert run(["effects", "Tank.mo"]) == 0
    assert line in capsys.readouterr().out
    assert run(["effects", "campaign", "--workers", "0"]) == 0
    assert line in capsys.readouterr().out
    units = TANK.format(m=', unit = "m"', m2='(unit = "m2")', m3s='(unit = "m3/s")')
    Path("Tank.mo").write_text(units)
    assert run(["effects", "Tank.mo"]) == 0
    assert "not looked for" not in capsys.readouterr().out


@pytest.mark.parametrize("absolute", [True, False])
def test_a_sensor_that_shows_no_sign(
    absolute: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    x = 0.1 * np.sin(5 * TIME)
    shown = np.abs(x) if absolute else x
    out, findings = init("Swing", SWING, shown, "time,u [N],x [m],spare [1]", capsys)
    assert (
        "not looked for: the sign of x (it never changes in the log, but does in the model)" in out
    ) == absolute
    assert [f["what"] for f in findings] == (["the sign of x"] if absolute else [])
