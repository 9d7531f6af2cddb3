"""The paper reproduced: its linear model, its rig, and what its searches find there."""

import runpy
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper_reproduced.recorded import CAMPAIGN, FIRST_ROW, measured, plans
from benchmarks.virtual_rig.rig_plan import carry_out
from fmuid import Task, identify, load_campaign, load_fmu, write_measurements
from tests.conftest import build_once

LINEAR = {"d_S": 2.66, "J_S": 0.003039, "d_G": 70.625}


def test_the_linear_model_is_the_actuator_without_losses(fmus: Mapping[str, Path], tmp_path: Path) -> None:
    linear = load_fmu(build_once(CAMPAIGN / "LinearActuator.mo", "LinearActuator", tmp_path))
    whole = load_fmu(fmus["FixedShaft"])
    time = 5e-4 * np.arange(401)
    current = np.where(time >= 0.01, 0.5, 0.0)
    task = Task(time, {"i_cmd": current}, ("tau_sensor", "phi_rel"), tolerance=1e-9)
    ours = linear.simulate(task, LINEAR)
    theirs = whole.simulate(replace(task, outputs=("tau_sensor", "encoder.phi_rel")), LINEAR)
    size = np.abs(theirs).max(axis=1, keepdims=True)
    np.testing.assert_allclose(ours / size, theirs / size, rtol=0.0, atol=1e-5)


def test_without_the_standard_library_the_rest_goes_on(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_module("benchmarks.multibody_load", run_name="__main__")
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("the variant with MultiBody is left out: EccentricLoadMultiBody.mo:8: ")
    assert "get it with `git clone https://github.com/modelica/ModelicaStandardLibrary`" in line


def test_the_rig_rings_with_its_shaft_fixed() -> None:
    fixed, turning, first = plans()
    (step,) = carry_out(
        replace(fixed, experiments=tuple(e for e in fixed.experiments if e.id == "step_0p5"), repeats=1)
    )
    torque = step.outputs["tau_sensor"].values
    assert np.max(torque) == pytest.approx(26.7, abs=0.5)
    assert np.min(torque[step.time > 0.03]) == pytest.approx(13.3, abs=0.5)
    assert np.mean(torque[step.time > 0.15]) == pytest.approx(17.5, abs=0.1)
    assert {e.setup for e in turning.experiments} == {"free_shaft", "eccentric_load"}
    assert [e.id for e in first.experiments] == ["first_10", "first_10_back"]
    assert tuple(first.rig.loss_table[1]) == FIRST_ROW


@pytest.mark.slow
def test_searches_without_derivatives_find_the_rig(fmus: Mapping[str, Path], tmp_path: Path) -> None:
    file = tmp_path / "measurements.h5"
    write_measurements(measured(), file)
    campaign = load_campaign(CAMPAIGN, measurements=file)
    linear, _, first = identify(campaign, stages=["linear", "bearing", "first_10"]).stages
    assert linear.solver == first.solver == "bobyqa"
    for name, truth in LINEAR.items():
        stage = linear[name]
        assert stage.standard_error is not None
        assert abs(stage.value - truth) < 3 * stage.standard_error
    assert linear["d_G"].value == pytest.approx(70.625, rel=1e-3)
    row = [first[f"lossTable[2,{column}]"].value for column in range(2, 6)]
    assert row[:2] == pytest.approx(FIRST_ROW[1:3], rel=2e-3)
    assert row[2:] == pytest.approx(FIRST_ROW[3:], rel=1e-2)
