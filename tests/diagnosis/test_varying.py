"""Coefficients that vary with a variable, with a logged column, or with a component's own warming."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest

import fmuid
from fmu_build import load
from fmuid.diagnosis.made_catalogue import made_catalogue
from fmuid.simulation.coupled.loading import load_simulator
from tests.diagnosis.test_made_catalogue import RIGS
from tests.every_law import every_law

ROOM = """
model Room "A heated room"
  parameter Real C(unit = "J/K") = 2e4 "Air and walls";
  parameter Real G(unit = "W/K") = 20 "Room to outdoors";
  input Real P(unit = "W") "Heater";
  input Real T_out(unit = "K") "Outdoor air";
  output Real T(unit = "K", start = 293, fixed = true) "Room";
equation
  C*der(T) = P - G*(T - T_out);
end Room;
"""
STEP, SAMPLES, RUNS = 20.0, 240, 4


def logs(folder, conductance, seed=1, begins=(0.0,) * RUNS, cold=lambda outdoors: 1.0):
    """CSV files of a room whose conductance is a function of its temperature, of the wind and of a run's time.

    It is `cold(T_out)` times that; logs count time from `begins`.
    """
    rng = np.random.default_rng(seed)
    paths = {}
    for run in range(RUNS):
        time = STEP * np.arange(SAMPLES)
        power = 300.0 + 300.0 * np.repeat(rng.integers(0, 3, SAMPLES // 40), 40)
        outdoors = 278.0 + 4.0 * np.sin(time / 1500.0 + run)
        wind = np.abs(6.0 * np.sin(time / 900.0 + 2.0 * run) + 2.0)
        temperature = np.empty(SAMPLES)
        value = 293.0
        for k in range(SAMPLES):
            temperature[k] = value
            for _ in range(10):
                loss = conductance(value, wind[k], time[k]) * cold(outdoors[k])
                value += STEP / 10 * (power[k] - loss * (value - outdoors[k])) / 2e4
        seen = temperature + 0.01 * rng.standard_normal(SAMPLES)
        gust = wind + 0.5 * rng.standard_normal(SAMPLES)  # a worse anemometer
        rows = np.column_stack([begins[run] + time, power, outdoors, wind, gust, seen])
        file = folder / f"day_{run}.csv"
        np.savetxt(file, rows, "%.6f", ",", header="time,P [W],T_out [K],wind [m/s],gust [m/s],T [K]", comments="")
        paths[file.stem] = file
    return paths


def campaign(tmp_path, conductance, model=ROOM, **how):
    source = tmp_path / "Room.mo"
    source.write_text(model)
    return fmuid.start([*logs(tmp_path, conductance, **how).values()], model=source, out=tmp_path / "room")


def test_a_conductance_that_depends_on_a_column_the_model_does_not_use(tmp_path):
    diagnosed = fmuid.diagnose(
        campaign(tmp_path, lambda value, wind, time: 20.0 * (1.0 + 0.05 * wind)), out=tmp_path / "out"
    )
    assert diagnosed.corrected.effects == ("varies@G(wind)",)
    size = diagnosed.corrected.fit.values["G.varies.wind"]
    assert size == pytest.approx(0.05, rel=0.1)
    page = (tmp_path / "out" / "diagnosis.json").read_text()
    assert "G grows with wind by " in page
    assert "% per m/s, from 20" in page
    assert (
        json.loads(page)["corrected_differs"] < 0.05
    )  # also of the Modelica file, which has the wind as an input
    again = fmuid.diagnose(tmp_path / "out" / "corrected")
    assert not again.diagnosis.gap.present


def test_a_sensor_may_be_late_by_a_parameter(tmp_path):
    folder = tmp_path / "room"
    campaign(tmp_path, lambda value, wind, time: 20.0 * (1.0 + 0.05 * wind))
    text = (folder / "campaign.toml").read_text()
    assert "[stages.all]\n" in text
    late = 'criteria = [{ signal = "T", options = { sensor = { delay = "late" } } }]'
    text = text.replace("[stages.all]\n", f"[stages.all]\n{late}\n")
    (folder / "campaign.toml").write_text(text + '\n[parameters.late]\nstart = 0.0\nunit = "s"\nfree = false\n')
    assert '"varies@G(wind)"' in made_catalogue(fmuid.load_campaign(folder), load_simulator)


def test_a_complete_model_has_no_coefficient_that_varies(tmp_path):
    text = made_catalogue(campaign(tmp_path, lambda value, wind, time: 21.0), load_simulator)
    assert "value@" in text or "effects" in text
    assert "varies" not in text


def test_a_diagnosis_begins_where_the_refit_that_sized_its_catalogue_ended(tmp_path):
    diagnosed = fmuid.diagnose(campaign(tmp_path, lambda value, wind, time: 21.0))
    begun, start = diagnosed.subject.fitted, diagnosed.subject.starts
    assert begun["G"] == pytest.approx(21.0, rel=0.01)
    assert diagnosed.nominal.fit.values == pytest.approx(dict(begun), rel=1e-3)
    assert start["G"] != pytest.approx(21.0, rel=0.01)  # what the gap before the refit is measured from


def test_a_coefficient_that_depends_on_the_temperature_of_its_component(tmp_path):
    text = made_catalogue(
        campaign(tmp_path, lambda value, wind, time: 20.0 * (1.0 + 0.03 * (value - 293.0))), load_simulator
    )
    assert text[text.index("varies@") :].startswith("varies@G(T)")
    assert "within" not in text  # no branch has both


def test_a_shape_that_another_size_would_change_is_judged_at_the_size_that_fits(tmp_path):
    def fouled(_value, _wind, time):
        return 21.0 / (1.0 + 0.15 * (1.0 - np.exp(-time / 1500.0)))

    text = made_catalogue(campaign(tmp_path, fouled), load_simulator)
    assert text[text.index("varies@") :].startswith("varies@G(time)")
    assert "exp(-abs(time - 0)/G.varies.time_width)" in text


def test_a_run_has_a_time_of_its_own_where_logs_count_from_elsewhere(tmp_path):
    """Every run opens the window anew, and the logs are cut out of a longer one."""
    begun = campaign(
        tmp_path, lambda _value, _wind, time: 20.0 * (1.0 + time / 6000.0), begins=(800.0, 9000.0, 3000.0, 700.0)
    )
    diagnosed = fmuid.diagnose(begun, out=tmp_path / "out", law=False)
    assert diagnosed.corrected.effects == ("varies@G(run_time)",)
    page = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert page["corrected_differs"] < 0.05
    assert "G grows in the course of a run by 0.0167 % per s, from 20 to " in json.dumps(page)


WALL = """
model Wall "A heated room behind a wall"
  parameter Real G(unit = "W/K") = 20 "Room to wall";
  input Real P(unit = "W") "Heater";
  output Real T(unit = "K", start = 293, fixed = true) "Room";
  output Real T_wall(unit = "K", start = 293, fixed = true) "Wall";
equation
  5e4*der(T) = P - G*(T - T_wall);
  2e5*der(T_wall) = G*(T - T_wall) - 30*(T_wall - 278);
end Wall;
"""


def test_what_leaves_one_store_enters_the_other(tmp_path):
    """A conductance in two balances varies in both of them alike."""
    rng, time = np.random.default_rng(1), STEP * np.arange(SAMPLES)
    for run in range(RUNS):
        power = 300.0 + 600.0 * np.repeat(rng.integers(0, 3, SAMPLES // 40), 40)
        temperatures = np.full((SAMPLES, 2), 293.0)
        room, wall = temperatures[0]
        for k in range(SAMPLES - 1):
            for _ in range(10):
                flow = 20.0 * (1.0 + time[k] / 6000.0) * (room - wall)
                room += STEP / 10 * (power[k] - flow) / 5e4
                wall += STEP / 10 * (flow - 30.0 * (wall - 278.0)) / 2e5
            temperatures[k + 1] = room, wall
        seen = temperatures + 0.01 * rng.standard_normal((SAMPLES, 2))
        header = "time,P [W],T [K],T_wall [K]"
        np.savetxt(
            tmp_path / f"r{run}.csv", np.column_stack([time, power, seen]), "%.6f", ",", header=header, comments=""
        )
    (tmp_path / "Wall.mo").write_text(WALL)
    begun = fmuid.start(sorted(tmp_path.glob("*.csv")), model=tmp_path / "Wall.mo", out=tmp_path / "wall")
    text = made_catalogue(begun, load_simulator)
    assert "varies@G(time)" in text
    assert "varies@G:" not in text


@pytest.mark.parametrize("law", ["loss", "radiation"])
def test_the_surroundings_of_a_loss_need_not_be_at_the_start_temperature(tmp_path, law):
    effects = every_law(load(RIGS, "Rigs.Block"), tmp_path).effects
    variants = [e for e in effects.values() if e.id.startswith(f"{law}@")]
    assert variants
    for effect in variants:
        (name,) = effect.shapes
        assert name.endswith("_surroundings")
        assert name in effect.expression


def test_a_law_is_judged_at_the_shape_that_fits(tmp_path):
    def switched(_value, wind, _time):  # beyond 6.9 m/s, between the trials of the library
        return 20.0 * (1.0 + 0.3 * (0.5 + 0.5 * np.tanh((wind - 6.9) / 0.3)))

    text = made_catalogue(campaign(tmp_path, switched), load_simulator)
    effect = next(e for e in tomllib.loads(text)["effects"].items() if e[0] == "varies@G(wind)")[1]
    assert "tanh" in effect["expression"]
    assert effect["trials"][0]["G.varies.wind_at"] == pytest.approx(6.9, abs=0.5)


def test_a_curved_line_is_no_other_law(tmp_path):
    def curved(_value, _wind, time):
        return 20.0 * (1.0 + 0.6 * np.sinh(time / 4800.0))

    text = made_catalogue(campaign(tmp_path, curved), load_simulator)
    effect = tomllib.loads(text)["effects"]["varies@G(time)"]
    assert "G.varies.time_bend" in effect["expression"]


@pytest.mark.parametrize(
    ("change", "shape", "law"),
    [
        (-0.56, lambda time: 0.5 + 0.5 * np.tanh((time - 2400.0) / 150.0), "tanh"),
        (-0.3, lambda time: time / 4780.0, "_bend"),
        (
            -0.4,
            lambda time: 1.0 - np.exp(-time / 1500.0),
            "exp",
        ),  # a line that bends as much as it may is no better
    ],
)
def test_laws_that_small_changes_do_not_tell_apart_are_refitted(tmp_path, change, shape, law):
    def changed(_value, _wind, time):
        return 20.0 * (1.0 + change * shape(time))

    effects = tomllib.loads(made_catalogue(campaign(tmp_path, changed), load_simulator))["effects"]
    assert law in effects["varies@G(time)"]["expression"]


def test_a_line_is_found_whether_the_model_has_a_conductance_or_a_resistance(tmp_path):
    def cold(outdoors):
        return 1.0 + 0.21 * (outdoors - 278.0)

    resistance = ROOM.replace('G(unit = "W/K") = 20', 'R(unit = "K/W") = 0.05')
    laws = {}
    for name, model in (("G", ROOM), ("R", resistance.replace("G*(T - T_out)", "(T - T_out)/R"))):
        (tmp_path / name).mkdir()
        rig = campaign(tmp_path / name, lambda *_: 20.0, model, cold=cold)
        effects = tomllib.loads(made_catalogue(rig, load_simulator))["effects"]
        laws[name] = effects[f"varies@{name}(T_out)"]["expression"]
    assert laws["G"].startswith("p*(1 + ")
    assert laws["R"].startswith("p/max(1 + ")


def test_a_coefficient_may_vanish_at_an_end_of_its_range(tmp_path):
    """Its law ends at a bound there, which is no sign of another cause."""

    def sheltered(_value, wind, _time):
        return 20.0 * max(0.0, 1.0 - wind / 7.5)

    outcome = fmuid.diagnose(campaign(tmp_path, sheltered), law=False)
    assert outcome.diagnosis.verdict.effects == ("varies@G(wind)",)
    assert outcome.corrected.fit.values["G.varies.wind"] < -0.11
