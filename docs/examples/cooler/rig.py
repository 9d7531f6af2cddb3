import numpy as np
from scipy.integrate import solve_ivp

TIME = np.arange(0.0, 1800.0, 5.0)
RUNS = {
    "step": np.where(TIME < 900, 120.0, 40.0),
    "pulses": np.where(np.sin(TIME / 80) > 0, 160.0, 0.0),
    "wave": 90 + 70 * np.sin(TIME / 130),
}


def record(
    folder, extra, runs=RUNS, repeats=3, late=0, heated=0.0, samples=360, noise=0.2, rng=np.random.default_rng(4)
):
    folder.mkdir()
    for name, P in runs.items():

        def slope(t, T):
            given = P[max(min(int(t / 5.0 + 1e-9), TIME.size - 1) - late, 0)]
            return (given - 0.8 * (T[0] - 293) - extra(T[0])) / 240

        T = solve_ivp(slope, (0, TIME[-1]), [293.0], t_eval=TIME, max_step=2.5, rtol=1e-8).y[0]
        for k in range(repeats):
            table = np.column_stack([TIME, P, T + heated * P + rng.normal(0, noise, TIME.size)])
            header = "time,P [W],T [K]"
            np.savetxt(folder / f"{name}_{k + 1}.csv", table[:samples], "%.5g", ",", header=header, comments="")
