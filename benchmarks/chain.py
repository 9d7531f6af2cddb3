"""How building and simulation grow with a model: a chain of masses with cubic springs, beside other integrators.

2n states, a force that is held from sample to sample, 1000 samples in 10 s. The FMU runs through fmuid's step
loop. CVODES is CasADi's with a sparse factorisation, equations and Jacobian compiled; it restarts at every sample,
as the FMU does. CVODE of scikit-SUNDAE (SuperLU_MT) and SciPy's Radau and BDF get the pattern of the Jacobian, and
equations in NumPy; no step of theirs is longer than a sample. The error is the root mean square of the position of
the first mass, relative to its largest value, against SciPy's DOP853 at 1e-12, restarted at every sample.

scikit-SUNDAE runs if ``make build/peers/sundae/.ready`` has made its environment.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from identification_speed import ENVIRONMENTS
from integrator import time_for
from scipy.integrate import solve_ivp
from scipy.sparse import bmat, diags, identity
from timing import say, table

from fmu_build import compile_modelica
from fmu_build.packaging import package
from fmuid.simulation.fmu import Fmu, load_fmu
from fmuid.simulation.simulator import Task

MODEL = """
model Chain "Masses, linked by stiffening springs and dampers, the last one to a wall"
  parameter Integer n = {n};
  parameter Real m = 1, c = 100, hardening = 1000, d = 0.5;
  input Real u;
  Real x[n](each start = 0, each fixed = true), v[n](each start = 0, each fixed = true);
  Real f[n];
  output Real y;
equation
  for i in 1:n - 1 loop
    f[i] = c*(x[i + 1] - x[i]) + hardening*(x[i + 1] - x[i])^3 + d*(v[i + 1] - v[i]);
  end for;
  f[n] = -c*x[n] - hardening*x[n]^3 - d*v[n];
  m*der(v[1]) = u + f[1];
  for i in 2:n loop
    m*der(v[i]) = f[i] - f[i - 1];
  end for;
  for i in 1:n loop
    der(x[i]) = v[i];
  end for;
  y = x[1];
end Chain;
"""
TIME = 0.01 * np.arange(1001)
ERRORS = (1e-4, 1e-6)
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
PEERS = ("CVODES, CasADi", "CVODE, scikit-SUNDAE", "Radau, SciPy", "BDF, SciPy")
_LIMIT = 20.0  # seconds of one run, beyond which no tighter tolerance is tried
Curve = list[tuple[float, float]]


@dataclass(frozen=True)
class Size:
    """Results for one number of masses.

    Attributes
    ----------
    build
        Processor time of the build in s, that of the compiler included.
    curves
        By tool, (error, s) for each tolerance; none where it failed or is missing.
    """

    n: int
    build: float
    curves: Mapping[str, Curve]

    def time(self, tool: str, error: float) -> float:
        """Return the time that a tool needs for an error; infinite where it does not reach it."""
        curve = self.curves.get(tool)
        return time_for(error, curve) if curve else float("inf")


def force() -> np.ndarray:
    """Return the held force on the first mass."""
    return np.repeat(np.random.default_rng(0).uniform(-5.0, 5.0, 51), 20)[: len(TIME)]


def slopes(n: int) -> Callable[[np.ndarray, float], np.ndarray]:
    """Return the right-hand side in NumPy: of the 2n states, positions first, and the force."""

    def f(y: np.ndarray, u: float) -> np.ndarray:
        x, v = y[:n], y[n:]
        stretch, rate = np.append(np.diff(x), -x[-1]), np.append(np.diff(v), -v[-1])
        spring = 100.0 * stretch + 1000.0 * stretch**3 + 0.5 * rate
        return np.concatenate([v, spring - np.concatenate([[-u], spring[:-1]])])

    return f


def pattern(n: int) -> np.ndarray:
    """Return the pattern of the Jacobian, (2n, 2n)."""
    band = diags([1.0, 1.0, 1.0], [-1, 0, 1], shape=(n, n))
    return np.asarray(bmat([[None, identity(n)], [band, band]]).toarray())


def build(n: int, folder: Path) -> tuple[Fmu, float]:
    """Build the FMU; return it and the processor time that it took."""
    source = folder / f"chain{n}" / "Chain.mo"
    source.parent.mkdir(parents=True)
    source.write_text(MODEL.format(n=n))
    begun = sum(os.times()[:4])
    file = package(compile_modelica(source, "Chain"), source.parent)
    return load_fmu(file), sum(os.times()[:4]) - begun


def measure(
    folder: Path, sizes: Sequence[int], *, repeats: int = 3, tolerances: Sequence[float] = TOLERANCES
) -> list[Size]:
    """Measure every size."""
    measured = []
    for n in sizes:
        say(f"  {n} masses")
        measured.append(_measured(folder, n, repeats, tolerances))
    return measured


def page(measured: Sequence[Size]) -> str:
    """Return the tables: builds, and times with those of others over them."""
    builds = table(
        ["masses", *(str(s.n) for s in measured)], [["build (s)", *(f"{s.build:.1f}" for s in measured)]]
    )
    rows = []
    for size in measured:
        for error in ERRORS:
            ours = size.time("fmuid", error)
            rows.append([str(size.n), f"{error:.0e}", f"{1e3 * ours:.3g}"])
            rows[-1] += [_beside(ours, size.time(tool, error), missing=tool not in size.curves) for tool in PEERS]
    return builds + "\n\n" + table(["masses", "error", "fmuid (ms)", *(f"fmuid / {tool}" for tool in PEERS)], rows)


def _beside(ours: float, other: float, *, missing: bool) -> str:
    if missing:
        return "missing"
    return f"{ours / other:.2g}" if np.isfinite(other) else "does not reach it"


def _measured(folder: Path, n: int, repeats: int, tolerances: Sequence[float]) -> Size:
    fmu, seconds = build(n, folder)
    u = force()
    task = Task(TIME, {"u": u}, ("y",))
    truth = _truth(n)

    def ours(tolerance: float) -> np.ndarray:
        return fmu.simulate(Task(task.time, task.inputs, task.outputs, tolerance=tolerance), {})[0]

    tools: dict[str, Callable[[float], np.ndarray]] = {"fmuid": ours, PEERS[0]: _cvodes(n)}
    tools |= {f"{method}, SciPy": _scipy(n, method) for method in ("Radau", "BDF")}
    curves = {name: _curve(run, truth, repeats, tolerances) for name, run in tools.items()}
    python = ENVIRONMENTS / "sundae" / "bin" / "python"
    if python.is_file():
        curves[PEERS[1]] = _sundae(python, folder, n, truth, tolerances)
    return Size(n, seconds, curves)


def _curve(
    run: Callable[[float], np.ndarray], truth: np.ndarray, repeats: int, tolerances: Sequence[float]
) -> Curve:
    curve: Curve = []
    for tolerance in tolerances:
        try:
            run(tolerance)  # compiled and loaded at the first time
            times = []
            for _ in range(repeats):
                begun = time.process_time()
                y = run(tolerance)
                times.append(time.process_time() - begun)
                if times[-1] > 1.0:
                    break
        except RuntimeError:
            continue
        curve.append((_error(y, truth), min(times)))
        if curve[-1][1] > _LIMIT:
            break
    return curve


def _error(y: np.ndarray, truth: np.ndarray) -> float:
    return max(float(np.sqrt(np.mean((y - truth) ** 2)) / np.abs(truth).max()), 1e-15)


def _truth(n: int) -> np.ndarray:
    f, y, truth = slopes(n), np.zeros(2 * n), [0.0]
    for u, begin, end in zip(force()[:-1], TIME[:-1], TIME[1:], strict=True):
        step = solve_ivp(lambda _, x, u=u: f(x, u), (begin, end), y, method="DOP853", rtol=1e-12, atol=1e-14)
        y = step.y[:, -1]
        truth.append(float(y[0]))
    return np.array(truth)


def _cvodes(n: int) -> Callable[[float], np.ndarray]:
    y, u = ca.SX.sym("y", 2 * n), ca.SX.sym("u")
    x, v = y[:n], y[n:]
    stretch, rate = ca.vertcat(x[1:] - x[:-1], -x[-1]), ca.vertcat(v[1:] - v[:-1], -v[-1])
    spring = 100.0 * stretch + 1000.0 * stretch**3 + 0.5 * rate
    dae = {"x": y, "u": u, "ode": ca.vertcat(v, spring - ca.vertcat(-u, spring[:-1]))}
    made: dict[float, ca.Function] = {}

    def run(tolerance: float) -> np.ndarray:
        if tolerance not in made:
            options = {"abstol": 1e-3 * tolerance, "reltol": tolerance, "max_num_steps": 10**6, "jit": True}
            options |= {"compiler": "shell", "jit_options": {"flags": ["-O2"], "verbose": False}}
            made[tolerance] = ca.integrator("chain", "cvodes", dae, 0.0, TIME[1:], options)
        ended = made[tolerance](x0=np.zeros(2 * n), u=force()[:-1].reshape(1, -1))["xf"]
        return np.concatenate([[0.0], np.array(ended[0, :]).ravel()])

    return run


def _scipy(n: int, method: str) -> Callable[[float], np.ndarray]:
    f, u, sparsity = slopes(n), force(), pattern(n)

    def run(tolerance: float) -> np.ndarray:
        solution = solve_ivp(
            lambda t, y: f(y, u[min(int(100.0 * t + 1e-9), len(u) - 1)]), (0.0, TIME[-1]), np.zeros(2 * n),
            method=method, t_eval=TIME, rtol=tolerance, atol=1e-3 * tolerance, max_step=0.01,
            jac_sparsity=sparsity,
        )  # fmt: skip
        if not solution.success:
            raise RuntimeError(solution.message)
        return np.asarray(solution.y[0])

    return run


def _sundae(python: Path, folder: Path, n: int, truth: np.ndarray, tolerances: Sequence[float]) -> Curve:
    """Run scikit-SUNDAE in an environment of its own."""
    job = folder / f"chain{n}.json"
    wanted = {"n": n, "force": force().tolist(), "tolerances": list(tolerances), "limit": _LIMIT}
    job.write_text(json.dumps(wanted))
    script = Path(__file__).parent / "peers" / "with_sundae.py"
    done = subprocess.run([str(python), str(script), str(job)], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return []
    return [(_error(np.array(run["y"]), truth), run["seconds"]) for run in json.loads(done.stdout)]
