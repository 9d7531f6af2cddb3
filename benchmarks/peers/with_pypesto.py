"""The race with pyPESTO: least squares (SciPy's trf) with its finite differences, over `fmpy.simulate_fmu`."""

from __future__ import annotations

import numpy as np
import pypesto
import pypesto.optimize
from by_fmpy import residuals_of
from race import Race

race = Race()


def tool() -> None:
    start, lower, upper = np.array(list(race.parameters.values())).T
    plain = pypesto.Objective(res=residuals_of(race, start))
    objective = pypesto.FD(plain, sres=True, delta_res=1e-3, method="forward")
    problem = pypesto.Problem(objective, lower / start, upper / start, x_guesses=[np.ones(len(start))])
    optimizer = pypesto.optimize.ScipyOptimizer(method="ls_trf")
    pypesto.optimize.minimize(problem, optimizer=optimizer, n_starts=1, progress_bar=False)


race.run(tool)
