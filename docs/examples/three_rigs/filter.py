from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

Path("filter").mkdir()
rng = np.random.default_rng(2)
time = np.arange(0.0, 0.06, 1e-4)
runs = {
    "square": 10 * np.sign(np.sin(2 * np.pi * 60 * time)),
    "slow": 6 * np.sin(2 * np.pi * 25 * time),
    "chirp": 8 * np.sin(2 * np.pi * (20 + 1500 * time) * time),
    "steps": 3.0 * (np.floor(time / 0.012) % 4) - 4,
}
for name, volts in runs.items():

    def slope(t, x):
        u = volts[min(int(t / 1e-4 + 1e-9), time.size - 1)]
        i, v = x
        return [(u - v - 1.5 * i - 0.6 * np.tanh(i / 0.004)) / 0.012, (i - v / 33) / 0.8e-4]

    x = solve_ivp(slope, (0, time[-1]), [0, 0], t_eval=time, max_step=2e-5, rtol=1e-8).y
    for k in (1, 2):
        seen = x.T + rng.normal(0, [0.005, 0.02], (time.size, 2))
        table = np.column_stack([time, volts, seen])
        np.savetxt(f"filter/{name}_{k}.csv", table, "%.6g", ",", header="time,u [V],i [A],v [V]", comments="")
