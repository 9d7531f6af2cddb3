"""Plants as networks of stores and branches, simulated in C. Imports nothing of the tool that is checked."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.shared_library import compiled

Floats = np.ndarray
KINDS = ("cond", "spring", "coil", "valve", "motor", "gear", "piston", "heater", "stream", "in", "drag", "dry")
TARGETS = ("node", "beside", "drop", "varies")
LAWS = (
    "viscous", "coulomb", "stribeck", "asymmetry", "quadratic", "presliding", "cogging", "weight", "hardening",
    "hysteresis", "backlash", "leakage", "capacity", "loss", "radiation", "outflow", "overflow", "voltage_drop",
    "eddy", "coefficient", "resonator", "wear", "pulsation", "relay", "chaos", "slip",
)  # fmt: skip
READINGS = ("potential", "position", "state", "force")
_HIDDEN = 4
_DOUBLES = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
_STEP = 0.25  # of the fastest time constant
_MOST_STEPS = 400


class DivergedError(Exception):
    """A plant's states are not finite."""


@dataclass(frozen=True)
class Node:
    """A store with a potential, or a potential that an input drives (`driven`: its number)."""

    name: str
    domain: str
    capacity: float = 1.0
    start: float = 0.0
    driven: int = -1

    @property
    def mechanical(self) -> bool:
        """Whether it has a position."""
        return self.domain in ("rotational", "translational")


@dataclass(frozen=True)
class Element:
    """A branch from node `a` to `b` (-1: ground); `c`: a third node; `u`: an input; `p`: its parameters."""

    kind: str
    name: str
    a: int
    b: int = -1
    c: int = -1
    u: int = -1
    p: tuple[float, ...] = ()


@dataclass(frozen=True)
class Effect:
    """What a plant has beyond its model; see ``network.c``.

    Attributes
    ----------
    where
        Node or element.
    zero, scale, rate
        Of its variable: where it is absent, its usual size, that of its rate.
    gate, threshold
        One regime only: 1 over, -1 under a threshold of the potential; 2, -2 of the absolute rate.
    source, index
        Of a coefficient: what it varies with (node, column, time, state, memory) and which one.
    """

    law: str
    shape: int
    target: str
    where: int
    size: float
    s1: float = 0.0
    s2: float = 0.0
    scale: float = 1.0
    rate: float = 1.0
    zero: float = 0.0
    gate: float = 0.0
    threshold: float = 0.0
    source: int = 0
    index: int = 0

    def row(self) -> list[float]:
        """Return it as numbers, in the order of the C code."""
        return [
            LAWS.index(self.law), self.shape, TARGETS.index(self.target), self.where, self.size, self.s1, self.s2,
            self.scale, self.rate, self.zero, self.gate, self.threshold, self.source, self.index,
        ]  # fmt: skip


@dataclass(frozen=True)
class Controller:
    """Proportional and integral, at the rate of the log, from a reading with noise to an input within limits."""

    input: int
    output: int
    kp: float
    ki: float
    low: float
    high: float


@dataclass(frozen=True)
class Network:
    """A plant: nodes, elements, and what its sensors read: (what, index) each, of `READINGS`."""

    nodes: tuple[Node, ...]
    elements: tuple[Element, ...]
    readings: tuple[tuple[str, int], ...]
    inputs: int
    effects: tuple[Effect, ...] = field(default=())

    def with_effects(self, effects: Sequence[Effect]) -> Network:
        """Return it with further effects."""
        return replace(self, effects=(*self.effects, *effects))

    def _arrays(self, columns: int) -> list[Floats]:
        rows = [[KINDS.index(e.kind), e.a, e.b, e.c, e.u, *e.p, *[0.0] * (4 - len(e.p))] for e in self.elements]
        sizes = [len(self.nodes), len(self.elements), len(self.effects), self.inputs, columns]
        arrays = (
            sizes,
            [n.capacity for n in self.nodes],
            [n.driven for n in self.nodes],
            [n.mechanical for n in self.nodes],
            rows,
            [e.row() for e in self.effects] or [[0.0]],
        )
        return [np.ascontiguousarray(a, dtype=np.float64) for a in arrays]

    @property
    def states(self) -> int:
        """How many states it has, those of effects left out."""
        return 2 * len(self.nodes) + len(self.elements)

    def start(self, moved: Mapping[int, float] | None = None) -> Floats:
        """Return the state at the start; potentials of nodes are `moved`."""
        x = np.zeros(self.states)
        x[: len(self.nodes)] = [n.start for n in self.nodes]
        for node, by in (moved or {}).items():
            x[node] += by
        return x

    def fastest(self, u: Floats) -> float:
        """Return the largest eigenvalue's size at the start, of the plain network."""
        plain = replace(self, effects=())
        arrays, total = plain._arrays(0), plain.states
        x0 = self.start()
        worst = 0.0
        for offset in (0.0, 0.3):
            matrix = np.empty((total, total))
            base = x0 + offset * np.maximum(np.abs(x0), 0.0)
            for j in range(total):
                step = 1e-6 * max(1.0, abs(base[j]))
                low, high = np.zeros(total), np.zeros(total)
                for sign, dx in ((-1.0, low), (1.0, high)):
                    x = base.copy()
                    x[j] += sign * step
                    _library().network_slopes(*arrays, 1.0, x, np.ascontiguousarray(u), np.zeros(1), dx)
                matrix[:, j] = (high - low) / (2 * step)
            worst = max(worst, float(np.abs(np.linalg.eigvals(matrix)).max()))
        return worst

    def steps(self, dt: float, u: Floats, finer: float = 1.0) -> int:
        """Return the steps within a sample that resolve its fastest motion."""
        return int(np.clip(np.ceil(finer * dt * self.fastest(u) / _STEP), 4, _MOST_STEPS))

    def run(
        self, dt: float, u: Floats, steps: int, *,
        start: Floats | None = None, read: float = 0.0, linear: bool = False, columns: Floats | None = None,
        controller: Controller | None = None, reference: Floats | None = None, noise: Floats | None = None,
    ) -> tuple[Floats, Floats]:  # fmt: skip
        """Return readings (readings, N) without noise, and the inputs (inputs, N) that acted.

        Raises
        ------
        DivergedError
            A state is not finite.
        """
        samples = u.shape[1]
        acting = np.ascontiguousarray(u.T.copy())
        given = np.zeros((samples, 1)) if columns is None else np.ascontiguousarray(columns.T)
        readings = np.array([[READINGS.index(w), k] for w, k in self.readings], dtype=np.float64)
        y = np.empty((samples, len(self.readings)))
        control = None if controller is None else np.array(astuple(controller), dtype=np.float64)
        wanted, added = (
            None if a is None else np.ascontiguousarray(a, dtype=np.float64) for a in (reference, noise)
        )
        failed = _library().network_run(
            *self._arrays(0 if columns is None else len(columns)),
            np.ascontiguousarray(self.start() if start is None else start),
            samples, steps, dt, read, int(linear), acting, given, readings, len(readings),
            *(None if a is None else a.ctypes.data for a in (control, wanted, added)), y,
        )  # fmt: skip
        if failed >= 0:
            raise DivergedError(f"not finite at sample {failed}")
        return y.T, acting.T


@cache
def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(str(compiled("network", Path(__file__).with_name("network.c"))))
    arrays = [_DOUBLES] * 6
    library.network_run.restype = ctypes.c_long
    library.network_run.argtypes = [
        *arrays, _DOUBLES, ctypes.c_long, ctypes.c_long, ctypes.c_double, ctypes.c_double, ctypes.c_long, _DOUBLES,
        _DOUBLES, _DOUBLES, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, _DOUBLES,
    ]  # fmt: skip
    library.network_slopes.restype = None
    library.network_slopes.argtypes = [*arrays, ctypes.c_double, _DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES]
    return library
