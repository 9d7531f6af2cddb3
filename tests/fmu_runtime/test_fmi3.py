"""The FMI 3.0 side: the same core behind other names."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import fmpy
import handmade
import numpy as np
import pytest
from fmpy.fmi3 import FMU3Model, FMU3Slave
from fmpy.validation import validate_fmu

from fmu_build.packaging import package


@pytest.mark.parametrize("name", ["pendulum", "bouncing_ball", "sampled_counter", "relay"])
def test_valid(built, name):
    assert validate_fmu(str(built(name, 3)[0])) == []


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_same_results_as_fmi2(built, kind):
    def run(fmi):
        return fmpy.simulate_fmu(
            str(built("pendulum", fmi)[0]),
            fmi_type=kind,
            stop_time=1.0,
            output_interval=0.1,
            start_values={"phi": 0.5, "m": 2.0},
            relative_tolerance=1e-8,
            output=["phi", "J", "through"],
        )

    two, three = run(2), run(3)
    for name in ("phi", "J", "through"):
        np.testing.assert_array_equal(two[name], three[name])


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_whole_number_that_rounding_left_just_below_is_itself(tmp_path, fmi):
    model = handmade.compile_by_hand(
        "Whole", states={"x": 0.0}, rhs=lambda e: [ca.SX(1)], discrete={"count": 3 - 1e-12}
    )
    whole = [replace(v, type="Integer") if v.name == "count" else v for v in model.variables]
    path = package(replace(model, variables=tuple(whole)), tmp_path, fmi=fmi)
    result = fmpy.simulate_fmu(str(path), stop_time=1.0, output_interval=1.0, output=["count"])
    assert result["count"].tolist() == [3, 3]


def test_bouncing_ball_in_model_exchange(built):
    result = fmpy.simulate_fmu(
        str(built("bouncing_ball", 3)[0]),
        fmi_type="ModelExchange",
        stop_time=3.0,
        output_interval=0.02,
        relative_tolerance=1e-8,
        output=["h", "bounces"],
    )
    assert result["bounces"][-1] == 6
    assert result["h"][-1] == pytest.approx(0.0687073, abs=1e-6)


def test_state_and_directional_derivative(built):
    path, folder = built("pendulum", 3)
    description = fmpy.read_model_description(str(path))
    vr = {v.name: v.valueReference for v in description.modelVariables}

    def instance(kind):
        one = kind(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier="Pendulum",
            instanceName="one",
        )
        one.instantiate()
        one.enterInitializationMode(startTime=0.0)
        one.exitInitializationMode()
        return one

    one = instance(FMU3Slave)
    one.doStep(0.0, 0.1)
    state = one.getFMUState()
    data = one.serializeFMUState(state)
    one.doStep(0.1, 0.1)
    first = one.getFloat64([vr["phi"], vr["energy"]])
    one.setFMUState(one.deserializeFMUState(data))
    one.doStep(0.1, 0.1)
    assert one.getFloat64([vr["phi"], vr["energy"]]) == first
    one.freeFMUState(state)
    one.freeInstance()

    model = instance(FMU3Model)
    derivative = model.getDirectionalDerivative([vr["der(w)"]], [vr["tau"]], [1.0])
    assert derivative[0] == pytest.approx(1 / 0.25)
    model.freeInstance()


@pytest.mark.parametrize("fmi", [2, 3])
def test_assertions_hold_in_model_exchange(built, fmi):
    """x' = x^2 reaches 2 at t = 0.5; the importer has to complete its steps."""
    with pytest.raises(Exception, match=r"(?i)CompletedIntegratorStep.*failed|assertion violated"):
        fmpy.simulate_fmu(
            str(built("failing", fmi)[0]),
            fmi_type="ModelExchange",
            stop_time=0.7,
            output_interval=0.1,
            start_values={"limit": 2.0},
        )
