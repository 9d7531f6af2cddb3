"""The race with ModestPy: `with_modestpy.py JOB METHOD+METHOD`, as GA_LEGACY+PS."""

from __future__ import annotations

import os
import sys
import tempfile

import pandas as pd
from modestpy import Estimation
from modestpy.fmi.model import Model
from race import Race

race = Race()
job, methods = race.job, tuple(sys.argv[2].split("+"))
folder = tempfile.mkdtemp()
os.chdir(folder)
simulate = Model.simulate


def counted(self: Model, *arguments: object, **options: object) -> object:
    simulated = simulate(self, *arguments, **options)
    race.take(simulated[job["output"]].to_numpy()[: len(race.time)])
    return simulated


def tool() -> None:
    Model.simulate = counted
    index = pd.Index(race.time, name="time")
    inputs, measured = (
        pd.DataFrame(job["inputs"], index=index),
        pd.DataFrame({job["output"]: race.measured}, index=index),
    )
    start = {name: tuple(values) for name, values in race.parameters.items()}
    Estimation(folder, job["fmu"], inputs, {}, start, measured, methods=methods, ftype="RMSE").estimate()


race.run(tool)
