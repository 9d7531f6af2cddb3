from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

Path("tanks").mkdir()
rng = np.random.default_rng(3)
time = np.arange(0.0, 1200.0, 2.0)
runs = {
    "stairs": 2 + 2.0 * (np.floor(time / 300) % 4),
    "pulses": np.where(np.sin(time / 60) > 0, 9.0, 1.5),
    "wave": 5 + 3.5 * np.sin(time / 90),
    "empty": np.where(time < 400, 8.0, 1.0),
}
for name, volts in runs.items():

    def slope(t, h):
        u = volts[min(int(t / 2.0 + 1e-9), time.size - 1)]
        jet = np.sqrt(2 * 9.81 * np.maximum(h, 1e-6))
        over = 4e-4 * max(h[0] - 0.30, 0.0)
        first = 0.9e-5 * jet[0]
        return [(4.5e-6 * u - first - over) / 1.7e-3, (first - 1.1e-5 * jet[1]) / 2.3e-3]

    h = solve_ivp(slope, (0, time[-1]), [0.1, 0.1], t_eval=time, max_step=1, rtol=1e-8).y
    for k in (1, 2):
        seen = h + rng.normal(0, 0.0005, h.shape)
        table = np.column_stack([time, volts, seen.T])
        np.savetxt(
            f"tanks/{name}_{k}.csv", table, "%.5g", ",", header="time,u [V],h_upper [m],h_lower [m]", comments=""
        )
