"""Every output of every shipped FMU against the reference, point by point."""

from __future__ import annotations

from dataclasses import replace

import fmpy
import numpy as np
import pytest

from fmuid.reference import reference_fmu
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


@pytest.mark.parametrize("case", CASES)
def test_outputs_agree(fmus, case):
    name, task, parameters = CASES[case]
    task = replace(task, interpolation="hold")
    expected = reference_fmu(name).simulate(task, parameters)
    outputs = simulate_fmu(fmus[name], task, parameters)

    for variable, y, reference in zip(task.outputs, outputs, expected, strict=True):
        nrmse = np.sqrt(np.mean((y - reference) ** 2)) / np.ptp(reference)
        assert nrmse <= LIMIT, f"{variable}: NRMSE {nrmse:.2e}"


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
