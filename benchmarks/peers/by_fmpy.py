"""The race's residuals by `fmpy.simulate_fmu` with everything reused, for tools that bring a search alone."""

from __future__ import annotations

from collections.abc import Callable

import fmpy
import numpy as np
from race import Race


def residuals_of(race: Race, start: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the (N,) residuals as a function of the parameters over their start values."""
    job = race.job
    description, folder = fmpy.read_model_description(job["fmu"]), fmpy.extract(job["fmu"])
    instance = fmpy.instantiate_fmu(folder, description, "CoSimulation")
    names = ["time", *job["inputs"]]
    signals = np.rec.fromarrays([race.time, *map(np.array, job["inputs"].values())], names=names)

    def residuals(x: np.ndarray) -> np.ndarray:
        instance.reset()
        y = fmpy.simulate_fmu(
            folder,
            stop_time=race.time[-1],
            output_interval=race.time[1] - race.time[0],
            start_values=dict(zip(race.parameters, x * start, strict=True)),
            input=signals,
            output=[job["output"]],
            fmi_type="CoSimulation",
            model_description=description,
            fmu_instance=instance,
        )[job["output"]]
        race.take(y)
        return y - race.measured

    return residuals
