"""Places at the states of FMUs without source, and what laws there may use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmuid import Task, measured_case
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.discovery.places import Spot, spot
from fmuid.simulation.fmu import Fmu
from tests.foreign_fmus.plants import plant_fmu
from tests.simulation.fmus import make_oscillator

TIME = np.linspace(0.0, 0.4, 81)
COLUMN = "logged.heat"


def place(fmu: Fmu, name: str, inputs: Mapping[str, np.ndarray], output: str) -> Spot:
    task = Task(TIME, inputs, (output,))
    case = measured_case("run", fmu, task, {output: fmu.simulate(task, {})[0]}, sigma={output: 1e-3})
    case = replace(case, columns={COLUMN: ("W", np.cos(9 * TIME))})
    here = spot(name, fmu, CampaignModel((case,)), {})
    assert here is not None
    return here


def test_what_acts_at_the_derivative_of_a_current_is_a_voltage_over_the_inductance(tmp_path: Path) -> None:
    fmu, v_in = Fmu(plant_fmu("CIRCUIT", tmp_path), "model exchange"), 5 * np.sign(np.sin(40 * TIME))
    here = place(fmu, "der(i)", {"v_in": v_in}, "v")
    (slope,) = fmu.simulate(Task(TIME, {"v_in": v_in}, ("der(i)",)), {})
    assert here.port.added_unit == "A.s-1"
    assert here.flow == pytest.approx(np.abs(slope).max())
    assert [q.name for q in here.quantities] == ["i", "v_in", "v", COLUMN]


@pytest.mark.parametrize("fmi", [2, 3])
def test_laws_use_what_can_be_written_in_them(tmp_path: Path, fmi: int) -> None:
    """The derivatives are variables called der(x) and der(v)."""
    fmu = Fmu(make_oscillator(tmp_path, fmi, ("ModelExchange",)), "model exchange")
    here = place(fmu, "der(v)", {"u": 5 * np.sin(40 * TIME)}, "y")
    assert (here.port.added_unit, here.nearby) == ("m.s-2", ("v", "x", "u"))
    assert {q.name for q in here.quantities} == {"v", "x", "u", COLUMN}
    over = {term.over.name for term in here.terms}
    assert over == {"v", "x", "u", COLUMN, "time"}
    assert all(np.isfinite(term.whole_course(here.courses, here.time)).all() for term in here.terms)
