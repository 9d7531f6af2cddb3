"""The chain of ``Chain.mo`` in NumPy, and its translation for any number of masses."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.integrate import solve_ivp

from fmu_build import compile_modelica
from fmu_build.model import CompiledModel

SOURCE = Path(__file__).with_name("Chain.mo")
PARAMETERS = {"m": 1.0, "k": 400.0, "k3": 4000.0, "c": 0.5}


@cache
def compiled(n: int) -> CompiledModel:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "Chain.mo"
        file.write_text(SOURCE.read_text().replace("n = 40", f"n = {n}"))
        return compile_modelica(file, "Chain")


def rates(both: np.ndarray, force: float, m: float, k: float, k3: float, c: float) -> np.ndarray:
    x, v = np.split(both, 2)
    stretch, speed = np.diff(x, prepend=0.0), np.diff(v, prepend=0.0)
    f = k * stretch + k3 * stretch**3 + c * speed
    return np.concatenate([v, np.diff(f, append=force) / m])


def by_scipy(n: int, times: np.ndarray, force: np.ndarray, **changed: float) -> np.ndarray:
    """Position of the last mass with the force held between the times."""
    p = PARAMETERS | changed
    both, out = np.zeros(2 * n), [0.0]
    edges = [0, *(np.flatnonzero(np.diff(force[:-1])) + 1), len(times) - 1]
    for begin, end in pairwise(edges):
        solved = solve_ivp(
            lambda _, s, u=force[begin]: rates(s, u, **p),
            (times[begin], times[end]),
            both,
            "DOP853",
            t_eval=times[begin + 1 : end + 1],
            rtol=1e-11,
            atol=1e-14,
        )
        out += list(solved.y[n - 1])
        both = solved.y[:, -1]
    return np.array(out)
