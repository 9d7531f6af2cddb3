"""Simulate an FMU in plain FMPy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import fmpy
import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.simulation.simulator import Task


def simulate_fmu(
    fmu: Path,
    task: Task,
    parameters: Mapping[str, float],
    tolerance: float = 1e-7,
    kind: str = "CoSimulation",
) -> FloatArray:
    """Return (n_outputs, N) predictions: inputs are set at ``task.time`` and, in co-simulation, held."""
    description = fmpy.read_model_description(str(fmu))
    # Every input gets samples: what is not driven stays zero.
    names = [v.name for v in description.modelVariables if v.causality == "input"]
    table = np.zeros(len(task.time), dtype=[("time", float), *((n, float) for n in names)])
    table["time"] = task.time
    for name in names:
        table[name] = task.inputs.get(name, 0.0)
    result = fmpy.simulate_fmu(
        str(fmu),
        model_description=description,
        stop_time=task.time[-1],
        step_size=task.time[1] - task.time[0],
        output_interval=task.time[1] - task.time[0],
        relative_tolerance=tolerance,
        fmi_type=kind,
        record_events=False,
        start_values={**task.start_values, **parameters},
        input=table,
        output=list(task.outputs),
    )
    return np.array([result[name] for name in task.outputs])
