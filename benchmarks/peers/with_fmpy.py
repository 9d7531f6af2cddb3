"""The race by hand: SciPy's least squares over `fmpy.simulate_fmu`, everything reused, a relative step of 1e-3."""

from __future__ import annotations

import numpy as np
from by_fmpy import residuals_of
from race import Race
from scipy.optimize import least_squares

race = Race()


def tool() -> None:
    start, lower, upper = np.array(list(race.parameters.values())).T
    bounds = (lower / start, upper / start)
    least_squares(residuals_of(race, start), np.ones(len(start)), bounds=bounds, diff_step=1e-3)


race.run(tool)
