from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

Path("oven").mkdir()
rng = np.random.default_rng(1)
time = np.arange(0.0, 3600.0, 10.0)
runs = {
    "step": np.where(time < 1800, 300.0, 80.0),
    "pulses": np.where(np.sin(time / 150) > 0.3, 450.0, 0.0),
    "stairs": 100.0 * (1 + np.floor(time / 720) % 4),
    "wave": 220 + 180 * np.sin(time / 260),
}
for name, power in runs.items():

    def slope(t, T):
        P = power[min(int(t / 10.0), time.size - 1)]
        through, lost = 1.1 * (T[0] - T[1]), 0.35 * (T[1] - 293)
        radiated = 1.5e-9 * (T[0] ** 4 - 293**4)
        return [(P - through - radiated) / 85, (through - lost) / 420]

    T = solve_ivp(slope, (0, time[-1]), [293, 293], t_eval=time, max_step=5, rtol=1e-8).y
    for k in (1, 2):
        seen = T + rng.normal(0, 0.3, T.shape)
        table = np.column_stack([time, power, seen.T])
        np.savetxt(
            f"oven/{name}_{k}.csv",
            table,
            "%.5g",
            ",",
            header="time,P [W],T_element [K],T_chamber [K]",
            comments="",
        )
