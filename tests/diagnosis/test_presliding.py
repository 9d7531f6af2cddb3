"""Friction that gives way over a distance far smaller than the one over which the speed is built up."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fmuid.cli.app import run

SLIDER = """
model Slider "A mass on a rail with dry friction"
  connector Flange
    Real s(unit = "m");
    flow Real f(unit = "N");
  end Flange;
  model Drive
    Flange flange;
    input Real force(unit = "N");
  equation
    flange.f = -force;
  end Drive;
  model Mass
    Flange flange;
    parameter Real m(unit = "kg") = 2;
    Real s(unit = "m", start = 0, fixed = true);
    Real v(unit = "m/s", start = 0, fixed = true);
  equation
    s = flange.s;
    v = der(s);
    m*der(v) = flange.f;
  end Mass;
  model Rail
    Flange flange;
    parameter Real c(unit = "N") = 3;
    parameter Real d(unit = "N.s/m") = 2;
  equation
    flange.f = c*tanh(der(flange.s)/1e-3) + d*der(flange.s);
  end Rail;
  input Real force(unit = "N");
  output Real s(unit = "m") = mass.s;
  output Real v(unit = "m/s") = mass.v;
  Drive drive;
  Mass mass;
  Rail rail;
equation
  drive.force = force;
  connect(drive.flange, mass.flange);
  connect(rail.flange, mass.flange);
end Slider;
"""
FRICTION, DISTANCE = 3.2, 2e-5


def write_logs(folder: Path) -> list[str]:
    """The slider's mass on bristles that give way by `DISTANCE`, pushed gently and hard; two runs of each."""
    time, random, files = np.arange(0.0, 1.2, 2e-3), np.random.default_rng(4), []
    for name, force in (("small", 2 * np.sin(6 * time)), ("large", 8 * np.sin(7 * time))):
        x, rows = np.zeros(3), []
        for k, f in enumerate(force):
            rows.append(x[:2])

            def slope(_: float, x: np.ndarray, f: float = f) -> list[float]:
                _, v, bristle = x
                return [v, (f - FRICTION * bristle - 2.1 * v) / 1.9, (v - abs(v) * bristle) / DISTANCE]

            x = solve_ivp(slope, (time[k], time[k] + 2e-3), x, method="LSODA", rtol=1e-8, atol=1e-10).y[:, -1]
        for repeat in range(2):
            measured = np.array(rows) + random.normal(size=(len(rows), 2)) * [2e-6, 2e-4]
            files.append(f"{name}{repeat}.csv")
            table = np.column_stack([time, force, measured])
            head = "time [s],force [N],s [m],v [m/s]"
            np.savetxt(folder / files[-1], table, delimiter=",", header=head, comments="")
    return files


def test_a_deflection_that_only_shows_at_reversals_is_found_and_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Path("Slider.mo").write_text(SLIDER)
    init = ["init", *write_logs(tmp_path), "--model", "Slider.mo", "--out", "slider", "--workers", "0"]
    assert run(init) == 0
    assert run(["effects", "slider", "--out", "slider/effects.toml", "--workers", "0"]) == 0
    # The plain model's friction may be too large, since it moves at once; and three candidates are enough here.
    campaign = Path("slider/campaign.toml")
    plain = campaign.read_text().replace("lower = 0.3\n", "lower = 0.0\n").replace('scale = "log"\n', "")
    campaign.write_text(f'{plain}\n[effects]\ncatalogue = "effects.toml"\n')
    catalogue = Path("slider/effects.toml")
    parts = re.split(r"(?m)^(?=\[(?:effects|ports|regimes)\.\"[^\"]+\"\]$)", catalogue.read_text())
    kept = ('[effects."presliding@mass"]', '[effects."coulomb@mass"]', '[effects."gain@force"]')
    catalogue.write_text("".join(p for p in parts if not p.startswith("[effects.") or p.startswith(kept)))

    assert run(["diagnose", "slider", "--out", "found", "--workers", "0"]) == 0
    diagnosis = json.loads(Path("found/diagnosis.json").read_text())
    assert (diagnosis["verdict"]["kind"], diagnosis["verdict"]["effects"]) == ("effect", ["presliding@mass"])
    values = diagnosis["model"]["parameters"]
    together = values["mass.presliding"] + values["rail.c"]  # which of the two brakes shows at reversals only
    assert together == pytest.approx(FRICTION, rel=0.002)
    assert values["mass.presliding"] == pytest.approx(FRICTION, rel=0.02)
    assert values["mass.presliding_distance"] == pytest.approx(DISTANCE, rel=0.02)
