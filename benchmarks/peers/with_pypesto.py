"""The race with pyPESTO: least squares (SciPy's trf) with its finite differences, over `fmpy.simulate_fmu`."""

from __future__ import annotations

import fmpy
import numpy as np
import pypesto
import pypesto.optimize
from race import Race

race = Race()
job = race.job


def tool() -> None:
    description, folder = fmpy.read_model_description(job["fmu"]), fmpy.extract(job["fmu"])
    instance = fmpy.instantiate_fmu(folder, description, "CoSimulation")
    names = ["time", *job["inputs"]]
    signals = np.rec.fromarrays([race.time, *map(np.array, job["inputs"].values())], names=names)
    start, lower, upper = np.array(list(race.parameters.values())).T

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

    objective = pypesto.FD(pypesto.Objective(res=residuals), sres=True, delta_res=1e-3, method="forward")
    problem = pypesto.Problem(objective, lower / start, upper / start, x_guesses=[np.ones(len(start))])
    optimizer = pypesto.optimize.ScipyOptimizer(method="ls_trf")
    pypesto.optimize.minimize(problem, optimizer=optimizer, n_starts=1, progress_bar=False)


race.run(tool)
