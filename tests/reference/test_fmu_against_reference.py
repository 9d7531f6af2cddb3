"""Every output of every shipped FMU against the reference, point by point."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import fmpy
import numpy as np
import pytest

from fmuid.campaign import FloatArray
from fmuid.reference import reference_fmu
from fmuid.simulation import Task
from tests.reference import experiments as e

CASES = {
    "step": ("FixedShaft", e.fixed_shaft("step"), {}),
    "sine": ("FixedShaft", e.fixed_shaft("sine"), e.CONSTANT_FRICTION),
    "prbs": ("FixedShaft", e.fixed_shaft("prbs"), e.LOSSY),
    "free": ("FreeShaft", e.free_shaft(), e.LOSSY),
    "eccentric": ("EccentricLoad", e.eccentric_load(), e.LOSSY),
    "open_loop": ("LinearAxisOpenLoop", e.axis_open_loop(), {"offset": -3.165}),
    "closed_loop": ("LinearAxisClosedLoop", e.axis_closed_loop(), {"offset": -3.165}),
}
LIMIT = 1e-4


def simulate_fmu(fmu: Path, task: Task, parameters: Mapping[str, float]) -> FloatArray:
    """Simulate in plain FMPy, as co-simulation with communication points at ``task.time``."""
    names = list(task.inputs)
    table = np.zeros(len(task.time), dtype=[("time", float), *((n, float) for n in names)])
    table["time"] = task.time
    for name in names:
        table[name] = task.inputs[name]
    if task.interpolation == "hold":
        # FMPy interpolates; a jump written as two samples at one time makes it hold.
        table = np.repeat(table, 2)[1:]
        for name in names:
            table[name][1::2] = table[name][0:-1:2]
    result = fmpy.simulate_fmu(
        str(fmu),
        stop_time=task.time[-1],
        step_size=task.time[1] - task.time[0],
        output_interval=task.time[1] - task.time[0],
        relative_tolerance=1e-7,
        fmi_type="CoSimulation",
        start_values={**task.start_values, **parameters},
        input=table,
        output=list(task.outputs),
    )
    return np.array([result[name] for name in task.outputs])


@pytest.mark.parametrize("case", CASES)
def test_outputs_agree(fmus, case):
    name, task, parameters = CASES[case]
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
