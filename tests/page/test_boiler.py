"""An espresso boiler logged by a PLC: from raw logs to what the model misses, by the page alone."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="needs the extra [page]")
expect = pytest.importorskip("playwright.sync_api", reason="needs the package playwright").expect
pytestmark = pytest.mark.browser

Opened = Callable[..., str]
MODEL = """\
model Boiler "Espresso machine: element, boiler, brew group; the pump brings cold water"
  parameter Real C_boiler(unit = "J/K") = 2000 "heat capacity of the boiler";
  parameter Real C_group(unit = "J/K") = 900 "heat capacity of the group";
  parameter Real G_neck(unit = "W/K") = 4 "conductance between boiler and group";
  parameter Real G_air(unit = "W/K") = 0.8 "losses of the group";
  parameter Real T_room(unit = "K") = 294.15 "kitchen";
  parameter Real k_p(unit = "m3/(s.V)") = 3e-8 "flow of the pump per volt";
  parameter Real R_p(unit = "Ohm") = 400 "pump coil, including back-emf";
  input Real P(unit = "W") "heating power";
  input Real U(unit = "V") "pump voltage";
  output Real T_boiler(unit = "K", start = 294.15, fixed = true) "thermocouple at the boiler";
  output Real T_group(unit = "K", start = 294.15, fixed = true) "thermocouple at the group head";
  output Real i_pump(unit = "A") "pump current";
equation
  C_boiler*der(T_boiler) = P - G_neck*(T_boiler - T_group) - 4186*998*k_p*U*(T_boiler - 293.15);
  C_group*der(T_group) = G_neck*(T_boiler - T_group) - G_air*(T_group - T_room);
  i_pump = U/R_p;
end Boiler;
"""
LOSS = 0.9  # W/K from the boiler to the kitchen, which the model does not have
TRUE = {"C_boiler": 1650.0, "C_group": 1150.0, "G_neck": 5.2, "G_air": 1.1, "k_p": 3.6e-8, "R_p": 470.0}


def step(state: np.ndarray, power: float, voltage: float, seconds: float) -> np.ndarray:
    """Advance the machine under constant inputs, by the exact solution of its linear equations."""
    from scipy.linalg import expm

    v = TRUE
    water = 4186 * 998 * v["k_p"] * voltage
    a = np.array(
        [
            [-(v["G_neck"] + water + LOSS) / v["C_boiler"], v["G_neck"] / v["C_boiler"], 0.0],
            [v["G_neck"] / v["C_group"], -(v["G_neck"] + v["G_air"]) / v["C_group"], 0.0],
            [0.0, 0.0, 0.0],
        ]
    )
    a[0, 2] = (power + water * -1.0) / v["C_boiler"]  # temperatures over that of the kitchen, which is 294.15 K
    return expm(a * seconds) @ state


@pytest.fixture
def boiler(tmp_path: Path) -> Path:
    """Logs of a PLC: a command is written with the temperature that is read just after it acts."""
    rng = np.random.default_rng(7)
    (tmp_path / "Boiler.mo").write_text(MODEL)
    time = np.arange(0, 900, 3)
    runs = {
        "heat_up_shots": (
            1000.0 * (time < 110) + 250.0 * (time >= 110),
            220.0 * (time % 200 > 170) * (time > 300),
        ),
        "cool_down": (1000.0 * (time < 120), 0.0 * time),
        "flush": (900.0 * (time < 100) + 300.0 * (time >= 400), 200.0 * ((time > 300) & (time < 340))),
    }
    for name, (power, voltage) in runs.items():
        for repeat in (1, 2):
            state, rows = np.array([0.0, 0.0, 1.0]), []
            for t, p, u in zip(time, power, voltage, strict=True):
                noise = 0.15 * rng.standard_normal(2)
                current = 1e3 * u / TRUE["R_p"] + 2.0 * rng.standard_normal()
                rows.append(
                    f"{1000 * t},{p:g},{u:g},{21 + state[0] + noise[0]:.2f},{21 + state[1] + noise[1]:.2f},{current:.1f}"
                )
                state = step(state, p, u, 3.0)
            head = "Time (ms),SSR power (W),Pump voltage (V),Boiler temp (°C),Group temp (°C),Pump current (mA)"
            (tmp_path / f"{name}_{repeat}.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return tmp_path


def test_from_raw_logs_to_the_missing_loss_and_the_next_run(boiler: Path, opened: Opened, browser: Any) -> None:
    page = browser.new_page()
    page.goto(opened(*sorted(boiler.glob("*.csv")), "--model", "Boiler.mo", cwd=boiler))

    # Prepare: every column is connected, in the units of the log; the repeats were recognised.
    page.get_by_role("status").get_by_text("Ready to run").wait_for()
    assert page.get_by_label("Variable for Boiler temp").input_value() == "T_boiler"
    assert page.get_by_role("row").filter(has_text="Boiler temp").first.inner_text().find("°C") >= 0
    assert page.get_by_role("row").filter(has_text="cool_down_2").count() == 1

    # The PLC reads the temperatures just after its commands act.
    page.get_by_label("Timing of inputs between samples").select_option("held-read-after")
    page.wait_for_function("document.querySelector('textarea.file').value.includes('held-read-after\"')")
    page.get_by_role("tab", name="Run").click()
    run = page.get_by_role("tabpanel", name="Run")
    run.get_by_role("button", name="Start").click()
    run.get_by_role("status").get_by_text(re.compile("Done: stage all")).wait_for()

    # Diagnose, with progress on the way.
    diagnosis = run.get_by_role("region", name="Diagnosis")
    diagnosis.get_by_role("status").evaluate(
        "(e) => { window.spoken = []; new MutationObserver(() => window.spoken.push(e.textContent))"
        ".observe(e, { childList: true, characterData: true, subtree: true }); }"
    )
    diagnosis.get_by_role("button", name="Diagnose").click()
    diagnosis.get_by_role("status").get_by_text(re.compile("^Done")).wait_for()
    assert [words for words in page.evaluate("window.spoken") if re.match(r"[1-9]\d? %: ", words)]
    verdict = json.loads((boiler / "runs" / "campaign-diagnosis" / "diagnosis.json").read_text())["verdict"]
    assert verdict["effects"] == ["loss@T_boiler.balance"]
    diagnosis.get_by_role("button", name="Look at the diagnosis").click()

    # Look: the sentence, and the effect's slider; without the effect, the residual grows.
    look = page.get_by_role("tabpanel", name="Look")
    look.get_by_role("status").get_by_text(re.compile("Loss at T_boiler")).wait_for()
    residual_rms = look.get_by_text(re.compile("RMS of the residual"))
    expect(residual_rms).to_have_text(re.compile("Boiler temp: [0-9.]+ °C"))

    def rms() -> float:
        match = re.search(r"Boiler temp: ([\d.e-]+) °C", residual_rms.inner_text())
        return float(match[1]) if match else 0.0

    corrected = rms()
    assert corrected == pytest.approx(0.15, abs=0.03)
    slider = look.get_by_role("slider", name=re.compile("loss$"))
    size = look.get_by_label(re.compile("^Value of .*loss$"))
    assert float(size.input_value()) == pytest.approx(LOSS, rel=0.1)
    slider.focus()
    page.keyboard.press("Home")
    page.wait_for_function(
        "(least) => [...document.querySelectorAll('[role=status]')].some("
        "(e) => +(/Boiler temp: ([\\d.e-]+) /.exec(e.textContent) || [0, 0])[1] > least)",
        arg=2 * corrected,
    )
    assert float(size.input_value()) < 0.5 * LOSS

    # The next run within a limit of the rig.
    look.get_by_text("Limits of the rig", exact=True).click()
    for label, value in {"Least": "0", "Largest": "800"}.items():
        field = look.get_by_label(f"{label} of SSR power", exact=True)
        field.fill(value)
        field.press("Enter")
    look.get_by_label("Duration of the run").fill("300")
    look.get_by_label("Duration of the run").press("Enter")
    look.get_by_label("Purpose of the next experiment").select_option("parameters")
    design = look.get_by_role("region", name="Next experiment")
    design.get_by_role("button", name="Design", exact=True).click()
    design.get_by_role("button", name="Show the design").click()
    look.get_by_role("img", name="Input").wait_for()
    answer = json.loads((boiler / "runs" / "campaign-design" / "design.json").read_text())
    assert answer["duration"] == pytest.approx(300.0)
    assert 0.0 <= answer["inputs"]["SSR power"]["min"] <= answer["inputs"]["SSR power"]["max"] <= 800.0
