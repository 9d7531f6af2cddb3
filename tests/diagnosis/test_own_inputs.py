"""Runs whose inputs were measured, with noise of their own, are repeats: from logs to a verdict, as a user does it."""

import json

import numpy as np
import pytest

from fmuid.cli.app import run

MODEL = """\
model Oven "A heated chamber"
  parameter Real C(unit = "J/K") = 120, G(unit = "W/K") = 1.2;
  input Real P(unit = "W");
  output Real T(start = 0, fixed = true, unit = "K") "Above the room";
equation
  C*der(T) = P - G*T;
end Oven;
"""
TIME = np.arange(0.0, 600.0, 2.0)
POWERS = {
    "step": np.where(TIME > 20, 60.0, 0.0),
    "pulses": np.where(TIME % 200 < 90, 80.0, 5.0),
    "stairs": 20.0 * (1 + np.floor(TIME / 150) % 3),
    "half": np.where(TIME > 300, 0.0, 35.0),
}


def logged(folder, offset, seed):
    """Logs of two repeats: the plant gets the true power, the log has it with noise."""
    rng = np.random.default_rng(seed)
    logs = []
    for name, power in POWERS.items():
        temperature = [0.0]
        for p in power[:-1].tolist():
            t = temperature[-1]
            for _ in range(20):
                t += 0.1 * (p + offset - 1.0 * t) / 100.0
            temperature.append(t)
        for k in range(2):
            read = power + 0.5 * rng.standard_normal(TIME.size)
            table = np.column_stack([TIME, read, temperature + 0.05 * rng.standard_normal(TIME.size)])
            logs.append(folder / f"{name}_{k}.csv")
            np.savetxt(logs[-1], table, delimiter=",", header="time [s],P [W],T [K]", comments="", fmt="%.9g")
    return logs


@pytest.mark.parametrize(("offset", "kind", "named"), [(0.0, "complete", []), (0.5, "effect", ["offset@P"])])
def test_a_measured_input_is_neither_a_gap_nor_hides_one(tmp_path, monkeypatch, offset, kind, named):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "Oven.mo").write_text(MODEL)
    logs = [str(f) for f in logged(tmp_path, offset, seed=1)]
    assert run(["init", *logs, "--model", "Oven.mo", "--class", "Oven", "--out", "c", "--workers", "0", "-q"]) == 0
    assert run(["diagnose", "c", "--out", "d", "--workers", "0", "-q"]) == 0
    answer = json.loads((tmp_path / "d" / "diagnosis.json").read_text())
    assert (answer["verdict"]["kind"], answer["verdict"]["effects"]) == (kind, named)
    noise = answer["gap"]["floor_units"]["T"]
    assert 0.05 < noise < 0.07  # of the sensor, and what the noise of the power adds
    if named:
        (effect,) = (e for e in answer["effects"] if e["id"] == "offset@P")
        parameter = effect["parameters"]["P.offset"]
        assert parameter["value"] == pytest.approx(offset, abs=3 * parameter["standard_error"])
