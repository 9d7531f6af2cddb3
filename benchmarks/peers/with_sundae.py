"""The chain of masses by scikit-SUNDAE: CVODE with SuperLU_MT, equations in NumPy. ``with_sundae.py JOB``."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
from scipy.sparse import bmat, diags, identity
from sksundae.cvode import CVODE

job = json.loads(Path(sys.argv[1]).read_text())
n, u = job["n"], np.array(job["force"])
grid = 0.01 * np.arange(len(u))


def rates(t: float, y: np.ndarray, yp: np.ndarray) -> None:
    x, v = y[:n], y[n:]
    stretch, rate = np.append(np.diff(x), -x[-1]), np.append(np.diff(v), -v[-1])
    spring = 100.0 * stretch + 1000.0 * stretch**3 + 0.5 * rate
    yp[:n] = v
    yp[n:] = spring
    yp[n + 1 :] -= spring[:-1]
    yp[n] += u[min(int(100.0 * t + 1e-9), len(u) - 1)]


band = diags([1.0, 1.0, 1.0], [-1, 0, 1], shape=(n, n))
sparsity = bmat([[None, identity(n)], [band, band]])
runs = []
for tolerance in job["tolerances"]:
    options = {"rtol": tolerance, "atol": 1e-3 * tolerance, "max_step": 0.01, "max_num_steps": 10**6}
    solver = CVODE(rates, linsolver="sparse", sparsity=sparsity, **options)
    begun = time.process_time()
    solution = solver.solve(grid, np.zeros(2 * n))
    seconds = time.process_time() - begun
    if solution.success:
        runs.append({"tolerance": tolerance, "seconds": seconds, "y": solution.y[:, 0].tolist()})
    if seconds > job["limit"]:
        break
print(json.dumps(runs))
