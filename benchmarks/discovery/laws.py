"""What the plants have at one of their places, as functions of the quantities there; nothing of fmuid is used."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchmarks.rigs.plant import Extra

Values = Mapping[str, float]


def _signed(x: float, n: float) -> float:
    return math.copysign(abs(x) ** n, x)


def _bump(x: float) -> float:
    return math.tanh(x / 0.005)  # direction of a speed in m/s


# Of one variable x, reached at `at`: the flow is `size` there.
SHAPES: Mapping[str, Callable[[float, float, float], float]] = {
    "power": lambda x, at, n: _signed(x / at, n),
    "even power": lambda x, at, n: abs(x / at) ** n,
    "exponential": lambda x, at, width: math.expm1(x / width) / math.expm1(at / width),
    "sinh": lambda x, at, width: math.sinh(x / width) / math.sinh(at / width),
    "saturation": lambda x, at, width: math.tanh(x / width) / math.tanh(at / width),
    "above": lambda x, at, limit: max(x - limit, 0.0) / (at - limit),
    "beyond": lambda x, at, limit: math.copysign(max(abs(x) - limit, 0.0) / (at - limit), x),
    "weir": lambda x, at, limit: (max(x - limit, 0.0) / (at - limit)) ** 1.5,
    "wave": lambda x, _, pitch: math.sin(2.0 * math.pi * x / pitch),
    "direction": lambda x, *_: _bump(x),
}


def of(variable: str, shape: str, size: float, at: float, shaped: float = 1.0) -> Callable[[Values], float]:
    """Return a flow that is a function of one quantity."""
    f = SHAPES[shape]
    return lambda values: size * f(values[variable], at, shaped)


def law(place: str, terms: Sequence[Mapping[str, object]], hidden: Mapping[str, object] | None = None) -> Extra:
    """Return the law of a case: the sum of its terms, each a product, maybe with a state that lags a function."""
    factors = [
        [of(**one) for one in ([term["first"], term["second"]] if "first" in term else [term])]  # type: ignore[arg-type]
        for term in terms
    ]

    def flow(values: Values, state: Sequence[float], _: float) -> float:
        total = sum(math.prod(f(values) for f in term) for term in factors)
        return total * state[0] if hidden else total

    if hidden is None:
        return Extra(place, flow)
    inner = of(**{k: v for k, v in hidden.items() if k != "lag"})  # type: ignore[arg-type]
    lag = float(hidden["lag"])  # type: ignore[arg-type]
    return Extra(place, flow, lambda values, state, _: [(inner(values) - state[0]) / lag], [0.0])


def course(place: str, kind: str, size: float, step: float, duration: float, seed: int) -> Extra:
    """Return a flow that follows a course over time which nothing in the model knows: of one run."""
    rng = np.random.default_rng(seed)
    count = int(duration / step) + 2
    if kind == "random walk":
        values = np.cumsum(rng.normal(size=count)) / math.sqrt(count)
    elif kind == "telegraph":
        values = np.where(np.cumsum(rng.uniform(size=count) < 0.1) % 2 == 0, 1.0, -1.0)
    elif kind == "bursts":
        values = rng.normal(size=count) * (rng.uniform(size=count) < 0.2)
    else:  # chaotic: the Lorenz equations from a point that differs from run to run
        x, y, z = rng.normal(size=3) + np.array([1.0, 1.0, 20.0])
        rows = []
        for _ in range(count):
            for _ in range(10):
                x, y, z = (
                    x + 0.005 * 10.0 * (y - x),
                    y + 0.005 * (x * (28.0 - z) - y),
                    z + 0.005 * (x * y - 8.0 / 3.0 * z),
                )
            rows.append(x / 8.0)
        values = np.array(rows)
    return Extra(place, lambda _, __, t: size * float(values[min(int(t / step), count - 1)]))


def oscillator(place: str, variable: str, size: float, at: float, period: float, damping: float = 0.05) -> Extra:
    """Return a flow out of a hidden resonator that a quantity drives."""
    w = 2.0 * math.pi / period
    return Extra(
        place,
        lambda _, state, __: size * state[0],
        lambda values, state, _: [
            state[1],
            w**2 * (values[variable] / at - state[0]) - 2.0 * damping * w * state[1],
        ],
        [0.0, 0.0],
    )


def late(place: str, variable: str, size: float, at: float, cells: int, lag: float) -> Extra:
    """Return a flow that follows a quantity through a long line: a delay, as a chain of many lags."""
    each = lag / cells
    return Extra(
        place,
        lambda _, state, __: size * state[-1],
        lambda values, state, _: [
            (before - own) / each for before, own in zip([values[variable] / at, *state], state, strict=False)
        ],
        [0.0] * cells,
    )
