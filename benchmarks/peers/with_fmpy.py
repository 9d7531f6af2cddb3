"""The race by hand: SciPy's least squares over `fmpy.simulate_fmu`, everything reused, a relative step of 1e-3."""

from __future__ import annotations

import fmpy
import numpy as np
from race import Race
from scipy.optimize import least_squares

race = Race()
job = race.job


def tool() -> None:
    description, folder = fmpy.read_model_description(job["fmu"]), fmpy.extract(job["fmu"])
    instance = fmpy.instantiate_fmu(folder, description, "CoSimulation")
    signals = np.rec.fromarrays(
        [race.time, *map(np.array, job["inputs"].values())], names=["time", *job["inputs"]]
    )
    lower, upper = np.array(list(race.parameters.values()))[:, 1:].T
    start = np.array([v[0] for v in race.parameters.values()])

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

    least_squares(residuals, np.ones(len(start)), bounds=(lower / start, upper / start), diff_step=1e-3)


race.run(tool)
