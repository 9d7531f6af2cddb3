"""The same logs for fmuid and mujoco.sysid: a pendulum as modelled, and one with air drag that no model has.

``python benchmarks/same_logs.py FOLDER`` prints a table: estimates with 95 % intervals, wall time, and what each
tool reports about the air drag. The rig is simulated by SciPy; mujoco.sysid runs in ``build/peers/mujoco``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

HERE = Path(__file__).resolve().parent
TRUTH = {"m": 0.4, "J": 0.004, "d": 0.05}  # kg, kg.m2, N.m.s/rad
LENGTH, GRAVITY, NOISE = 0.3, 9.81, 1e-3
MODEL = """\
model Pendulum "An arm with a mass at its end"
  parameter Real m(unit = "kg", min = 0.1, max = 1) = 0.36 "Mass";
  parameter Real J(unit = "kg.m2", min = 1e-4, max = 0.05) = 0.006 "Inertia of the motor";
  parameter Real d(unit = "N.m.s/rad", min = 0, max = 0.2) = 0.03 "Damping";
  constant Real l(unit = "m") = 0.3;
  input Real tau(unit = "N.m") "Torque";
  output Real phi(unit = "rad", start = 0, fixed = true) "Angle";
  Real w(unit = "rad/s", start = 0, fixed = true);
equation
  der(phi) = w;
  (J + m*l^2)*der(w) = tau - d*w - m*9.81*l*sin(phi);
end Pendulum;
"""


def record(folder: Path, drag: float) -> None:
    """Write nine runs of 2 s at 200 Hz: three inputs, each three times."""
    folder.mkdir(parents=True, exist_ok=True)
    random, t = np.random.default_rng(1), 0.005 * np.arange(401)
    inputs = {
        "sines": 0.6 * np.sin(3 * t) + 0.4 * np.sin(7.1 * t),
        "steps": 0.7 * np.sign(np.sin(2.3 * t)),
        "chirp": 0.9 * np.sin((1.5 + 1.2 * t) * t),
    }
    inertia = TRUTH["J"] + TRUTH["m"] * LENGTH**2
    for name, tau in inputs.items():

        def slope(time: float, x: np.ndarray, tau: np.ndarray = tau) -> list[float]:
            phi, w = x
            held = tau[min(int(time / 0.005 + 1e-9), len(tau) - 1)]
            weight = TRUTH["m"] * GRAVITY * LENGTH * np.sin(phi)
            return [w, (held - TRUTH["d"] * w - drag * w * abs(w) - weight) / inertia]

        phi = solve_ivp(slope, (0.0, t[-1]), [0.0, 0.0], t_eval=t, max_step=0.005, rtol=1e-9, atol=1e-11).y[0]
        for k in range(3):
            log = np.column_stack([t, tau, phi + random.normal(0.0, NOISE, t.size)])
            header = "time,tau [N.m],phi [rad]"
            np.savetxt(folder / f"{name}_{k}.csv", log, "%.9g", ",", header=header, comments="")


def with_fmuid(folder: Path) -> tuple[dict[str, list[float]], float, str]:
    """Return values with half widths, the wall time of the identification, and the verdict of a diagnosis."""
    import fmuid

    (folder / "Pendulum.mo").write_text(MODEL)
    logs = [str(file) for file in sorted((folder / "logs").glob("*.csv"))]
    campaign = fmuid.start(logs, model=str(folder / "Pendulum.mo"), out=str(folder / "campaign"), replace=True)
    begun = time.perf_counter()
    result = fmuid.identify(campaign)
    seconds = time.perf_counter() - begun
    estimates = {e.name: e for e in result.estimates}
    values = {
        n: [e.value, (e.interval[1] - e.interval[0]) / 2 if e.interval else np.inf] for n, e in estimates.items()
    }
    verdict = fmuid.diagnose(result).diagnosis.verdict
    return values, seconds, f"{verdict.kind}: {', '.join(verdict.effects)}".removesuffix(": ")


def with_mujoco(folder: Path, python: Path) -> tuple[dict[str, list[float]], float, str]:
    """Return the same of mujoco.sysid, which has no diagnosis."""
    command = [str(python), str(HERE / "peers" / "with_mujoco.py"), str(folder / "logs")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    answer = json.loads(done.stdout.splitlines()[-1])
    return answer["values"], answer["seconds"], "–"


def main(out: Path, python: Path) -> None:
    """Print the rows of the table."""
    print(
        "| rig | tool | m (kg) | J (g.m2) | d (mN.m.s/rad) | time (s) | what is missing |",
        "|---" * 7 + "|",
        sep="\n",
    )
    for rig, drag in (("as modelled", 0.0), ("with air drag", 0.01)):
        folder = out / rig.replace(" ", "_")
        record(folder / "logs", drag)
        for tool, (values, seconds, verdict) in (
            ("fmuid", with_fmuid(folder)),
            ("mujoco.sysid", with_mujoco(folder, python)),
        ):
            cells = [
                f"{scale * values[n][0]:.4g} ± {scale * values[n][1]:.2g}{miss(values[n], t)}"
                for (n, t), scale in zip(TRUTH.items(), (1, 1e3, 1e3), strict=True)
            ]
            print(f"| {rig} | {tool} | {' | '.join(cells)} | {seconds:.2g} | {verdict} |", flush=True)


def miss(value: list[float], truth: float) -> str:
    """Return a note if the interval does not contain the truth."""
    return "" if abs(value[0] - truth) <= value[1] else " (misses)"


if __name__ == "__main__":
    peer = HERE.parent / "build" / "peers" / "mujoco" / "bin" / "python"
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else peer)
