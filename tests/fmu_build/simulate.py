"""Integrates a compiled model's CasADi functions with SciPy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from fmu_build.model import CompiledModel, Variable


def values(result: object) -> np.ndarray:
    return np.asarray(result, dtype=float).ravel()


@dataclass(frozen=True)
class Instance:
    """A compiled model with parameter values."""

    model: CompiledModel
    p: np.ndarray
    d: np.ndarray

    @staticmethod
    def of(model: CompiledModel, parameters: Mapping[str, float] | None = None) -> Instance:
        p = np.zeros(model.n_p)
        for v in model.variables:
            if v.location.vector == "p" and v.causality == "parameter":
                p[v.location.index] = (parameters or {}).get(v.name, v.start)
        return Instance(model, p, values(model.functions["dependent"](p)))

    def env(self, t: float, x: np.ndarray, u: Sequence[float] = (), y: np.ndarray | None = None) -> list[object]:
        m = self.model
        inputs = np.zeros(m.n_u) if len(u) == 0 else np.asarray(u, dtype=float)
        z = values(m.functions["start"](self.p, self.d)[1])
        return [
            t,
            x,
            inputs,
            self.p,
            self.d,
            z,
            z,
            np.zeros(m.n_m),
            self.iterate(t, x, inputs) if y is None else y,
        ]

    def iterate(self, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        m = self.model
        y = values(m.functions["start"](self.p, self.d)[2])
        for _ in range(50 if m.n_y else 0):
            r, slope, *_ = m.functions["loop"](*self.env(t, x, u, y))
            step = np.linalg.solve(np.asarray(slope, dtype=float), values(r))
            y = y - step
            if np.linalg.norm(step) < 1e-13:
                break
        return y

    def start(self) -> np.ndarray:
        m = self.model
        xs, _, y = map(values, m.functions["start"](self.p, self.d))
        both = np.concatenate([xs, y])
        for _ in range(50 if m.has_initial else 0):
            r, slope = m.functions["initial"](*self.env(0.0, both[: m.n_x], y=both[m.n_x :]), xs)
            both = both - np.linalg.solve(np.asarray(slope, dtype=float), values(r))
        return both[: m.n_x]

    def derivative(self, t: float, x: np.ndarray, u: Sequence[float] = ()) -> np.ndarray:
        return values(self.model.functions["derivatives"](*self.env(t, x, u)))

    def get(self, name: str, t: float, x: np.ndarray, u: Sequence[float] = ()) -> float:
        variable = find(self.model, name)
        where = variable.location
        vectors: dict[str, Callable[[], np.ndarray]] = {
            "x": lambda: x,
            "u": lambda: np.asarray(u, dtype=float),
            "p": lambda: self.p,
            "d": lambda: self.d,
            "y": lambda: self.iterate(t, x, np.asarray(u, dtype=float)),
            "dx": lambda: self.derivative(t, x, u),
            "v": lambda: values(self.model.functions["variables"](*self.env(t, x, u))),
            "z": lambda: values(self.model.functions["start"](self.p, self.d)[1]),
        }
        if where.vector == "constant":
            return float(variable.start)
        return where.sign * float(vectors[where.vector]()[where.index])

    def settle(self, env: list[object], init: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One event iteration as `fmu_build.model` describes it; (z, m, x) at its end."""
        f = self.model.functions
        t, x, u, p, d, z, pz, m, y = env
        for _ in range(100):
            for number in range(100):
                z_new, x_new, _, _, reinit = map(values, f["update"](t, x, u, p, d, z, pz, m, y, init))
                m_new = (values(f["indicators"](t, x, u, p, d, z_new, pz, m, y)) > 0).astype(float)
                differs = np.flatnonzero(m_new != m)
                changed = differs.size > 0 or np.any(z_new != z)
                if number >= 10 and differs.size:
                    off = differs[m_new[differs] == 0]
                    m = m.copy()
                    m[off if off.size else differs[:1]] = m_new[off if off.size else differs[:1]]
                else:
                    m = m_new
                z = z_new
                if not changed:
                    break
            else:
                raise AssertionError("no consistent discrete variables")
            again = np.any(z != pz) or reinit[0]
            pz = z
            if reinit[0]:
                x = x_new
            if not again:
                return z, m, x
        raise AssertionError("the event iteration does not end")

    def simulate(self, times: Sequence[float], u: Callable[[float], Sequence[float]] = lambda t: ()) -> np.ndarray:
        """States at `times`, shape (len(times), n_x)."""
        result = solve_ivp(
            lambda t, x: self.derivative(t, x, u(t)),
            (times[0], times[-1]),
            self.start(),
            method="LSODA",
            t_eval=times,
            rtol=1e-9,
            atol=1e-11,
            max_step=0.01,
        )
        return result.y.T


def find(model: CompiledModel, name: str) -> Variable:
    return next(v for v in model.variables if v.name == name)


def states(model: CompiledModel) -> list[str]:
    return [v.derivative_of for v in model.variables if v.derivative_of]
