"""Tables that are learned where no law holds, and tables that refine a law of another shape."""

from __future__ import annotations

import json
from importlib.resources import files

import jsonschema
import numpy as np
import pytest

import fmuid
from fmuid.discovery.terms import Quantity, table
from tests.diagnosis.test_varying import ROOM, SAMPLES, STEP

SCHEMA = json.loads((files("fmuid.diagnosis") / "diagnosis.schema.json").read_text())


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def window(temperature):
    """Heat that leaves through a window, which opens in the middle of the range of temperatures, in W."""
    return 80.0 * np.exp(-(((temperature - 305.0) / 3.0) ** 2))


def diagnosed(folder, loss, *, repeats=1, runs=4):
    """Diagnose a room that loses more heat than its model; the last run is kept for validation."""
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
                heat = power[k] - 21.0 * (value - outdoors[k]) - loss(value, wind[k])
                value += STEP / 10 * heat / 2e4
        for repeat in range(repeats):
            seen = temperature + 0.01 * rng.standard_normal(SAMPLES)
            rows = np.column_stack([time, power, outdoors, wind, seen])
            paths.append(folder / f"day_{run}_{repeat}.csv")
            header = "time,P [W],T_out [K],wind [m/s],T [K]"
            np.savetxt(paths[-1], rows, "%.6f", ",", header=header, comments="")
    source, out = folder / "Room.mo", folder / "out"
    source.write_text(ROOM)
    fmuid.diagnose(fmuid.start(paths, model=source, out=folder / "room"), out=out)
    answer = json.loads((out / "diagnosis.json").read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(answer)
    return answer, out


def test_a_table_is_the_line_between_its_knots_and_constant_beyond():
    x = Quantity("p", "p", "K", 3.0, -2.0, 3.0)
    knots, values = np.array([-2.0, -0.5, 1.0, 3.0]), np.array([1.0, -1.0, 2.0, 0.5])
    at = np.linspace(-3.0, 4.0, 29)
    courses = [term.course({"p": at}, at) for term in table(x, knots)]
    np.testing.assert_allclose(values @ courses, np.interp(at, knots, values), atol=1e-12)


def test_a_loss_of_another_shape_gets_a_table_over_temperature_from_single_runs(tmp_path):
    """Without repeats, a loss is named provisionally, and the table refines it."""
    answer, out = diagnosed(tmp_path, lambda value, wind: window(value))
    (found,) = answer["refinements"]
    assert found["id"].endswith("@T.balance(temperature)")
    assert answer["verdict"]["provisional"]
    assert answer["best"]["closure"]["held_out"] > 0.7
    assert answer["best"]["closure"]["interval"][0] > 0.0
    assert answer["corrected_differs"] < 0.05
    assert (out / "figures" / "tables.png").is_file()


@pytest.mark.slow
def test_a_loss_that_no_law_describes_is_learned_as_a_table(tmp_path):
    answer, out = diagnosed(tmp_path, lambda value, wind: window(value), repeats=2)
    (learned,) = answer["refinements"]
    assert learned["learned"]
    assert learned["id"] == "learned_table@T.balance(temperature)"
    assert answer["best"]["effects"] == answer["corrected"] == [learned["id"]]
    assert answer["best"]["closure"]["held_out"] > 0.7
    assert answer["best"]["closure"]["interval"][0] > 0.0
    assert answer["corrected_differs"] < 0.05
    (axis,) = learned["table"]["axes"]
    at = np.linspace(296.0, 316.0, 21)
    found = np.interp(at, axis["knots"], learned["table"]["values"])
    assert np.abs(found - window(at)).max() < 12.0
    assert (
        "A table learned at T.balance over temperature predicts it, which is no law" in answer["verdict"]["text"]
    )
    assert (out / "figures" / "tables.png").is_file()
    assert "max(0, min(" in (out / "corrected" / "RoomCorrected.mo").read_text()


def test_a_model_without_a_gap_gets_no_table(tmp_path):
    answer, out = diagnosed(tmp_path, lambda value, wind: 0.0)
    assert answer["refinements"] == []
    assert not (out / "corrected").exists()
