"""Every output of every shipped FMU against the reference, point by point."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import fmpy
import numpy as np
import pytest

from fmuid.reference import reference_fmu
from fmuid.simulation.simulator import Task
from tests.conftest import build_setups
from tests.reference import experiments as e
from tests.reference.plain_fmpy import simulate_fmu

CASES = {
    "step": ("FixedShaft", e.fixed_shaft("step"), {}),
    "sine": ("FixedShaft", e.fixed_shaft("sine"), e.CONSTANT_FRICTION),
    "prbs": ("FixedShaft", e.fixed_shaft("prbs"), e.LOSSY),
    "free": ("FreeShaft", e.free_shaft(), e.LOSSY),
    "eccentric": ("EccentricLoad", e.eccentric_load(), e.LOSSY),
    "open_loop": ("LinearAxisOpenLoop", e.axis_open_loop(), {"offset": -3.165}),
    "closed_loop": ("LinearAxisClosedLoop", e.axis_closed_loop(), {"offset": -3.165}),
}
LIMIT = 1e-5


@cache
def expected(case: str):
    name, task, parameters = CASES[case]
    return reference_fmu(name).simulate(replace(task, interpolation="hold"), parameters)


def check(fmu, case: str) -> None:
    _, task, parameters = CASES[case]
    outputs = simulate_fmu(fmu, task, parameters)
    for variable, y, reference in zip(task.outputs, outputs, expected(case), strict=True):
        nrmse = np.sqrt(np.mean((y - reference) ** 2)) / np.ptp(reference)
        assert nrmse <= LIMIT, f"{variable}: NRMSE {nrmse:.2e}"


@pytest.mark.parametrize("case", CASES)
def test_outputs_agree(fmus, case):
    check(fmus[CASES[case][0]], case)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["eccentric", "closed_loop"])
def test_outputs_agree_in_fmi_3(fmi3_fmus, case):
    check(fmi3_fmus[CASES[case][0]], case)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_outputs_of_every_setup_agree_in_fmi_3(case):
    name = CASES[case][0]
    check(build_setups((name,), "3")[name], case)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["step", "free", "closed_loop"])
@pytest.mark.parametrize("fmi", ["2", "3"])
def test_model_exchange_agrees(case, fmi):
    """Integrated by FMPy's CVODE, which smooth inputs let run; against the same FMU in co-simulation."""
    name, task, parameters = CASES[case]
    fmu = build_setups((name,), fmi)[name]
    held = {n: np.full(201, u.max() / 4) for n, u in task.inputs.items()}
    task = Task(np.linspace(0.0, 0.2, 201), held, task.outputs)
    ours = simulate_fmu(fmu, task, parameters, 1e-9)
    theirs = simulate_fmu(fmu, task, parameters, 1e-8, kind="ModelExchange")
    for variable, y, reference in zip(task.outputs, theirs, ours, strict=True):
        assert np.abs(y - reference).max() <= 1e-3 * np.ptp(reference), variable


@pytest.mark.parametrize(
    "name", ["FixedShaft", "FreeShaft", "EccentricLoad", "LinearAxisOpenLoop", "LinearAxisClosedLoop"]
)
def test_same_variables(fmus, name):
    description = fmpy.read_model_description(str(fmus[name]))
    of_fmu = {v.name: v for v in description.modelVariables}

    for variable in reference_fmu(name).variables.values():
        twin = of_fmu[variable.name]
        unit = twin.unit or (twin.declaredType.unit if twin.declaredType else None)
        assert (twin.causality, unit) == (variable.causality, variable.unit), variable.name
        if variable.causality in ("parameter", "input"):
            assert float(twin.start) == variable.start, variable.name
