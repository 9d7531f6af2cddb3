"""Tables that are learned where no law holds, and tables that refine a law of another shape."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from plants import plant

import fmuid
from fmu_build.build import build
from fmu_build.errors import ModelicaError
from fmu_build.modelica_text import modelica_text
from fmuid.core.campaign import ModelSource
from fmuid.diagnosis.diagnose import diagnose_subject
from fmuid.diagnosis.scores import stack
from fmuid.diagnosis.verdict import Closure
from fmuid.diagnosis_pipeline import nearly_explained
from fmuid.discovery import learned_table
from fmuid.discovery.learned_table import _Search, tabulate
from fmuid.discovery.terms import Quantity, ramps, table
from fmuid.effects.table_blocks import with_table_blocks
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.model_source import flat_model
from tests.diagnosis.test_varying import ROOM, SAMPLES, STEP

STANDARD = Path(__file__).parents[1] / "fmu_build" / "standard"
SCHEMA = json.loads((files("fmuid.diagnosis") / "diagnosis.schema.json").read_text())


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def window(temperature):
    """Heat that leaves through a window, which opens in the middle of the range of temperatures, in W."""
    return 80.0 * np.exp(-(((temperature - 305.0) / 3.0) ** 2))


def diagnosed(folder, loss, *, model=None, repeats=1, runs=4, late=0, shape=lambda wind: 1.0):
    """Diagnose a room that loses more heat than its model, and is read so many samples late.

    Its coefficient of heat transfer has a `shape` over wind.
    """
    rng = np.random.default_rng(1)
    time = STEP * np.arange(SAMPLES)
    paths = []
    for run in range(runs):
        power = 300.0 + 300.0 * np.repeat(rng.integers(0, 3, SAMPLES // 40), 40)
        outdoors = 278.0 + 4.0 * np.sin(time / 1500.0 + run)
        wind = np.abs(6.0 * np.sin(time / 900.0 + 2.0 * run) + 2.0)
        temperature, value = np.empty(SAMPLES), 293.0
        for k in range(SAMPLES):
            temperature[k] = value
            for _ in range(10):
                heat = power[k] - 21.0 * shape(wind[k]) * (value - outdoors[k]) - loss(value, wind[k])
                value += STEP / 10 * heat / 2e4
        for repeat in range(repeats):
            read = temperature[np.maximum(np.arange(SAMPLES) - late, 0)]
            seen = read + 0.01 * rng.standard_normal(SAMPLES)
            rows = np.column_stack([time, power, outdoors, wind, seen])
            paths.append(folder / f"day_{run}_{repeat}.csv")
            header = "time,P [W],T_out [K],wind [m/s],T [K]"
            np.savetxt(paths[-1], rows, "%.6f", ",", header=header, comments="")
    source, out = model or folder / "Room.mo", folder / "out"
    if model is None:
        source.write_text(ROOM)
    fmuid.diagnose(fmuid.start(paths, model=source, out=folder / "room"), out=out)
    answer = json.loads((out / "diagnosis.json").read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(answer)
    return answer, out


def test_a_table_is_the_line_between_its_knots_and_constant_beyond():
    x = Quantity("p", "p", "K", 3.0, -2.0, 3.0)
    knots, values = np.array([-2.0, -0.5, 1.0, 3.0]), np.array([1.0, -1.0, 2.0, 0.5])
    at = np.linspace(-3.0, 4.0, 29)
    steps = np.diff(values, prepend=0.0)
    for sizes, terms in ((values, table(x, knots)), (steps, ramps(x, knots))):
        courses = [term.course({"p": at}, at) for term in terms]
        np.testing.assert_allclose(sizes @ courses, np.interp(at, knots, values), atol=1e-12)


TABLED = """
model Tabled "A store that loses what a table says"
  parameter Real loss_size_1 = -1.5;
  parameter Real loss_size_2 = 0.25;
  parameter Real loss_size_3 = 2;
  input Real P(start = 1);
  output Real T(start = -3, fixed = true);
equation
  der(T) = P - noEvent(if abs(loss_size_1) > 0 or abs(loss_size_2) > 0 or abs(loss_size_3) > 0 then
    LAW else 0);
end Tabled;
"""
VALUES = """loss_size_1*max(0, min(1, (0.5 - T)/2.5)) + loss_size_2*max(0, min((T - (-2))/2.5, (1.25 - T)/0.75))
    + loss_size_3*max(0, min((T - 0.5)/0.75, 1))"""
INCREMENTS = """loss_size_1*1 + loss_size_2*max(0, min(1, (T - (-2))/(0.5 - (-2))))
    + loss_size_3*max(0, min(1, (T - 0.5)/(1.25 - 0.5)))"""


@pytest.mark.parametrize(
    ("law", "second", "third"),
    [
        (VALUES, "loss_size_2", "loss_size_3"),
        (INCREMENTS, "loss_size_1 + loss_size_2", "loss_size_1 + loss_size_2 + loss_size_3"),
    ],
)
def test_the_source_of_a_corrected_model_has_tables_as_blocks_of_the_standard_library(
    law, second, third, tmp_path
):
    (tmp_path / "Tabled.mo").write_text(TABLED.replace("LAW", law))
    flat = flat_model(ModelSource(tmp_path / "Tabled.mo", "Tabled"))
    sizes = ("loss_size_1", "loss_size_2", "loss_size_3")
    changed, (block,) = with_table_blocks(flat, [("other",), sizes])
    rows = f"CombiTable1Ds loss(table = [-2, loss_size_1; 0.5, {second}; 1.25, {third}], "
    assert rows in block.declaration
    text = modelica_text(changed, "Blocks", components=[block.declaration], connections=[block.equation])
    assert "min(" not in text
    (tmp_path / "Blocks.mo").write_text(text)
    files = (
        build(tmp_path / "Tabled.mo", "Tabled", tmp_path),
        build(tmp_path / "Blocks.mo", "Blocks", tmp_path, roots=[STANDARD]),
    )
    time = np.linspace(0.0, 6.0, 121)
    task = fmuid.Task(time, {"P": 2.0 * np.cos(time)}, ("T",))
    for values in ({}, dict(zip(sizes, (3.0, -1.0, 0.5), strict=True))):
        plain, tabled = (fmuid.load_fmu(file).simulate(task, values) for file in files)
        np.testing.assert_allclose(tabled, plain, atol=1e-6)
    assert with_table_blocks(flat, [sizes[1:]]) == (flat, ())


def test_a_loss_of_another_shape_gets_a_table_over_temperature_from_single_runs(tmp_path):
    """Without repeats, it is named provisionally, as a coefficient that varies, and the table refines it."""
    answer, out = diagnosed(tmp_path, lambda value, wind: window(value))
    (table,) = answer["refinements"]
    assert (table["law"], table["variable"]) == ("varies@G(T)", "T")
    assert answer["verdict"]["effects"] == answer["best"]["effects"] == ["varies@G(T)"]
    assert answer["verdict"]["provisional"]
    assert answer["best"]["closure"]["held_out"] > 0.7
    assert answer["best"]["closure"]["interval"][0] > 0.0
    assert answer["corrected_differs"] < 0.05
    assert (out / "figures" / "tables.png").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    "width",
    [
        1.6,
        pytest.param(
            0.8, marks=pytest.mark.xfail(strict=True, reason="another table predicts left-out runs better")
        ),
    ],
)
def test_a_table_rises_only_where_a_monotone_one_predicts_as_well(tmp_path, width):
    """Two fans that start at 299 K and 309 K."""
    answer, out = diagnosed(
        tmp_path,
        lambda value, wind: 30.0 * (np.tanh((value - 299.0) / width) + np.tanh((value - 309.0) / width)),
        repeats=2,
    )
    (learned,) = answer["refinements"]
    values = learned["table"]["values"]
    assert learned["table"]["monotone"] == "rising"
    assert values == sorted(values)
    assert answer["corrected_differs"] < 0.05
    assert "rising table" in answer["verdict"]["text"]
    corrected = (out / "corrected" / "RoomCorrected.mo").read_text()
    assert "Modelica.Blocks.Tables.CombiTable1Ds" in corrected
    assert "max(0, min(" not in corrected


@pytest.mark.slow
def test_a_loss_that_no_law_describes_is_learned_as_a_table(tmp_path):
    answer, out = diagnosed(tmp_path, lambda value, wind: window(value), repeats=2)
    (learned,) = answer["refinements"]
    assert learned["learned"]
    assert learned["id"] == "learned_table@T.balance(temperature)"
    assert learned["table"]["monotone"] is None
    assert answer["best"]["effects"] == answer["corrected"] == [learned["id"]]
    assert answer["best"]["closure"]["held_out"] > 0.7
    assert answer["best"]["closure"]["interval"][0] > 0.0
    assert answer["corrected_differs"] < 0.05
    (axis,) = learned["table"]["axes"]
    at = np.linspace(296.0, 316.0, 21)
    learned_values = np.interp(at, axis["knots"], learned["table"]["values"])
    assert np.abs(learned_values - window(at)).max() < 12.0
    assert (
        "A table learned at T.balance over temperature predicts it, which is no law" in answer["verdict"]["text"]
    )
    assert (out / "figures" / "tables.png").is_file()
    corrected = (out / "corrected" / "RoomCorrected.mo").read_text()
    assert "Modelica.Blocks.Tables.CombiTable1Ds 'T.balance.learned_table'(table = [" in corrected
    assert "max(0, min(" not in corrected


@pytest.mark.slow
def test_a_coefficient_of_another_shape_is_refined_over_what_it_depends_on(tmp_path):
    """It rises at two speeds of the wind."""

    def shape(wind):
        return 1.0 + 0.15 * (np.tanh((wind - 2.0) / 0.4) + np.tanh((wind - 6.0) / 0.4))

    answer, out = diagnosed(tmp_path, lambda value, wind: 0.0, repeats=2, shape=shape)
    (refinement,) = answer["refinements"]
    assert answer["verdict"]["effects"] == ["varies@G(wind)"] == answer["best"]["effects"]
    assert (refinement["law"], refinement["variable"]) == ("varies@G(wind)", "wind")
    assert answer["corrected"] == ["varies@G(wind)", refinement["id"]]
    assert answer["corrected_differs"] < 0.05
    corrected = (out / "corrected" / "RoomCorrected.mo").read_text()
    assert "CombiTable1Ds 'G.refinement'(table = [" in corrected


def test_beside_a_table_the_law_that_it_refines_is_known_and_other_parameters_loosely():
    """Errors are those that the cost knows: data then move a parameter by nine-tenths of what they would."""
    diagnosed = diagnose_subject(plant({"a": 0.3}))
    search = _Search(diagnosed, diagnosed.best, {}, load_fmu, None, None)
    subject, fit = diagnosed.subject, diagnosed.best.fit
    (law,) = (subject.by_id[id] for id in diagnosed.best.effects)
    slopes = stack(fit.jacobian, subject.observed)
    errors = dict(zip(fit.values, np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))), strict=True))
    near = search._near_plain(law).outcome.subject
    for unknowns, loose in ((near.by_id[law.id].unknowns, 1.0), (near.nominal, 3.0)):
        for u in unknowns:
            assert (u.start, u.sd) == pytest.approx((fit.values[u.name], loose * errors[u.name]))
    others = [e for e in subject.effects if e is not law]
    assert all(near.by_id[e.id].unknowns == e.unknowns for e in others)


def test_a_table_that_cannot_be_built_in_place_of_an_effect_is_no_error(monkeypatch):
    tried = []

    def refined(search, rival=None):
        tried.append((search.base.effects, rival))
        raise ModelicaError("the model cannot be built")

    monkeypatch.setattr(learned_table, "inside_of", lambda model: model)
    monkeypatch.setattr(_Search, "refined", refined)
    diagnosed = diagnose_subject(plant({"a": 0.3}, delay=0.03))
    assert tabulate(diagnosed, {"bench": object()}, load_fmu) is None
    assert (("asymmetry",), diagnosed.best) in tried


SHAFT = """
model Shaft "A shaft that a motor turns"
  parameter Real J(unit = "kg.m2") = 0.01 "Inertia";
  parameter Real d(unit = "N.m.s/rad") = 0.002 "Friction of the oil";
  input Real tau(unit = "N.m") "Motor";
  output Real w(unit = "rad/s", start = 0, fixed = true) "Speed";
equation
  J*der(w) = tau - d*w;
end Shaft;
"""


@pytest.mark.slow
def test_a_friction_of_another_shape_is_refined_and_keeps_its_name(tmp_path):
    """Dry friction that is least at a speed of 12 rad/s, not near standstill."""
    rng, step, paths = np.random.default_rng(1), 0.01, []
    time = step * np.arange(250)
    for run in range(4):
        torque = (0.6 + 0.25 * run) * np.sin(2 * np.pi * time * (0.35 + 0.1 * run))
        torque += 0.3 * np.sin(2 * np.pi * time * (1.3 - 0.2 * run) + run)
        speed, value = np.empty(len(time)), 0.0
        for k in range(len(time)):
            speed[k] = value
            for _ in range(40):
                dip = 1.0 - 0.5 * np.exp(-(((abs(value) - 12.0) / 5.0) ** 2))
                value += step / 40 * (torque[k] - 0.0025 * value - 0.2 * np.tanh(value / 0.1) * dip) / 0.011
        for repeat in range(2):
            rows = np.column_stack([time, torque, speed + 0.02 * rng.standard_normal(len(time))])
            paths.append(tmp_path / f"run_{run}_{repeat}.csv")
            np.savetxt(paths[-1], rows, "%.6f", ",", header="time,tau [N.m],w [rad/s]", comments="")
    source, out = tmp_path / "Shaft.mo", tmp_path / "out"
    source.write_text(SHAFT)
    fmuid.diagnose(fmuid.start(paths, model=source, out=tmp_path / "shaft"), out=out)
    answer = json.loads((out / "diagnosis.json").read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(answer)
    (table_,) = answer["refinements"]
    assert not table_["learned"]
    assert table_["law"] in answer["best"]["effects"]
    assert table_["law"].endswith("@w.balance")
    assert table_["variable"] == "speed"
    assert table_["id"] not in answer["best"]["effects"]
    assert answer["corrected"] == [*answer["best"]["effects"], table_["id"]]
    assert answer["best"]["closure"]["held_out"] > 0.9
    assert answer["corrected_differs"] < 0.05
    assert "The plant's law has another shape than" in answer["verdict"]["text"]


@pytest.mark.slow
def test_the_state_of_an_fmu_without_source_gets_a_table(tmp_path):
    source = tmp_path / "Room.mo"
    source.write_text(ROOM)
    answer, out = diagnosed(
        tmp_path, lambda value, wind: window(value), model=build(source, "Room", tmp_path), repeats=2
    )
    (learned,) = answer["refinements"]
    assert learned["id"] == "learned_table@der(T)(T)"
    assert answer["best"]["closure"]["held_out"] > 0.7
    assert answer["corrected_differs"] < 0.05
    assert (out / "corrected" / "Room.fmu").is_file()


def test_a_model_without_a_gap_gets_no_table(tmp_path):
    answer, out = diagnosed(tmp_path, lambda value, wind: 0.0)
    assert answer["refinements"] == []
    assert not (out / "corrected").exists()


@pytest.mark.parametrize(
    ("kind", "closed", "enough"),
    [("effect", 0.96, True), ("ambiguous", 0.96, True), ("effect", 0.94, False), ("unknown", 0.96, False)],
)
def test_no_law_is_sought_where_effects_leave_a_twentieth_of_the_gap(kind, closed, enough):
    """A search for an equation takes minutes, and could improve predictions by no more than what is left."""
    best = SimpleNamespace(closure=Closure(1.0, closed, (0.9, 1.0)))
    assert nearly_explained(SimpleNamespace(verdict=SimpleNamespace(kind=kind), best=best)) is enough
