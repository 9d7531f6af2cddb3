"""The race with AixCaliBuHA: `with_aixcalibuha.py JOB METHOD`, one of scipy.minimize or differential_evolution."""

from __future__ import annotations

import sys
import tempfile

import pandas as pd
from aixcalibuha import CalibrationClass, Calibrator, Goals, TunerParas
from ebcpy import FMU_API
from race import Race

race = Race()
job, method = race.job, sys.argv[2]
folder = tempfile.mkdtemp()
simulate = FMU_API.simulate


def counted(self: FMU_API, *arguments: object, **options: object) -> object:
    simulated = simulate(self, *arguments, **options)
    race.take(simulated[job["output"]].to_numpy().ravel()[: len(race.time)])
    return simulated


def tool() -> None:
    api = FMU_API(working_directory=folder, model_name=job["fmu"])
    step = float(race.time[1] - race.time[0])
    api.set_sim_setup({"start_time": 0.0, "stop_time": float(race.time[-1]), "output_interval": step})
    inputs = pd.DataFrame(job["inputs"], index=race.time)
    api.result_names = [job["output"]]
    index = api.simulate(parameters={}, inputs=inputs).index[: len(race.time)]  # it insists on its own rounding
    FMU_API.simulate = counted
    measured = pd.DataFrame({job["output"]: race.measured}, index=index)
    names = {"y": {"meas": job["output"], "sim": job["output"]}}
    values = list(race.parameters.values())
    tuners = TunerParas(list(race.parameters), [v[0] for v in values], bounds=[(v[1], v[2]) for v in values])
    goals = Goals(meas_target_data=measured, variable_names=names, statistical_measure="RMSE", weightings=[1.0])
    phase = CalibrationClass("run", 0.0, float(race.time[-1]), goals=goals, tuner_paras=tuners, inputs=inputs)
    calibrator = Calibrator(folder, api, phase, verbose_logging=False, fail_on_error=True)
    if method == "differential_evolution":
        calibrator.calibrate(framework="scipy_differential_evolution", method="best1bin", seed=0)
    else:
        start = tuners.scale(tuners.get_initial_values())
        calibrator.calibrate(framework="scipy_minimize", method=method, x0=start)


race.run(tool)
