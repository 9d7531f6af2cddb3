"""Binary sequences of any form, by a semidefinite relaxation: near the best that an input of their range can do.

If a model is linear in its inputs, so are the derivatives of its predictions, and the information of a run is a
quadratic form in the input's levels s, each from -1 to 1. Relaxed to a matrix U of unit diagonal in place of s s',
the design is convex (Goemans and Williamson 1995; Manchester 2010). It is solved in factors U = V V' of low rank
(Burer and Monteiro 2003), and signs of random projections of V are the sequences. A dual solution bounds what any
input could do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigvalsh
from scipy.optimize import minimize

from fmuid.core.immutable import FloatArray
from fmuid.design.excitation import Bounds, held

_RANK = 8  # of the factors; with it, the dual bound is reached to six digits
_MEMORY = 2e8  # bytes of the quadratic forms; bits are as short as that allows
_SUPERPOSED = 0.1  # largest relative error of superposed responses in a model that counts as linear
_ROUNDED = 64  # random projections
_ITERATIONS = 200  # within a few percent of the optimum, as rounding is

Cost = Callable[[FloatArray], tuple[float, FloatArray]]
"""From the (P, P) information to a convex cost and to minus its derivatives, (P, P)."""


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """The information that the model's response to an input has about its parameters.

    Attributes
    ----------
    slopes
        From (inputs, N) samples to (P, C, N) derivatives of the predictions by the parameters.
    whiten
        From (C, N) to (M,), linear: in standard deviations of the noise.
    known
        (P, P) information that is there already.
    cost
        What the design minimises.
    """

    slopes: Callable[[FloatArray], FloatArray]
    whiten: Callable[[FloatArray], FloatArray]
    known: FloatArray
    cost: Cost


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Levels of every input, each held for `length` samples, with ramps where steps would be too steep."""

    bounds: tuple[Bounds, ...]
    time: FloatArray
    length: int

    @property
    def count(self) -> int:
        """Levels of one input."""
        return -(-(len(self.time) - 1) // self.length)

    def __call__(self, levels: FloatArray, sizes: FloatArray) -> FloatArray:
        """Return the (inputs, N) samples of (inputs, count) levels in [-1, 1], shrunk towards rest to `sizes`."""
        time = self.time - self.time[0]
        edges = np.append(time[:: self.length][: self.count], time[-1])
        made = []
        for b, level, size in zip(self.bounds, levels, sizes.tolist(), strict=True):
            reached = 0.5 * (b.upper + b.lower + (b.upper - b.lower) * level)
            made.append(held(b.rest + size * (reached - b.rest), edges, time, b))
        return np.array(made)


@dataclass(frozen=True, slots=True, eq=False)
class BinarySequence:
    """A sequence as a family of excitations, of which only the size is searched for, to stay within limits."""

    levels: Levels
    signs: FloatArray

    @property
    def bounds(self) -> tuple[Bounds, ...]:
        """Bounds of each input."""
        return self.levels.bounds

    @property
    def size(self) -> int:
        """Number of values in [0, 1] that define one excitation: the size of each input."""
        return len(self.bounds)

    def __call__(self, x: FloatArray, time: FloatArray) -> FloatArray:
        """Return the (inputs, N) samples at these times; at a size of 0, an input stays at rest."""
        return replace(self.levels, time=time)(self.signs, np.clip(x, 0.0, 1.0))

    def words(self, _: FloatArray, time: FloatArray) -> str:
        """Return a description of the excitation."""
        return f"optimised binary sequence, a bit lasts {self.levels.length * (time[1] - time[0]):.3g} s"


@dataclass(frozen=True, slots=True, eq=False)
class Relaxed:
    """The relaxed design.

    Attributes
    ----------
    response
        What it was made for.
    forms
        (P * P, n * n): times the products of all pairs of levels, with 1 as the first, they are the information.
    factors
        (n, rank), rows of unit length.
    bound
        No input within its range that holds its levels as long has a smaller cost; if slopes are limited, no
        binary sequence has.
    """

    response: Response
    levels: Levels
    forms: FloatArray
    factors: FloatArray
    bound: float

    def sequence(self, seed: int = 0) -> FloatArray:
        """Return the best of some (inputs, count) sequences of -1 and 1."""
        rng = np.random.default_rng(seed)
        signs = np.where(rng.standard_normal((_ROUNDED, self.factors.shape[1])) @ self.factors.T > 0.0, 1.0, -1.0)
        signs *= signs[:, :1]
        costs = [self.response.cost(_informed(self.response, self.forms, s[:, None]))[0] for s in signs]
        best: FloatArray = signs[int(np.argmin(costs))]
        return best[1:].reshape(len(self.levels.bounds), -1)


def binary_sequence(
    response: Response, bounds: tuple[Bounds, ...], time: FloatArray, *, seed: int = 0
) -> BinarySequence | None:
    """Return a binary sequence that is near the best input; None if the model is not linear in its inputs."""
    optimum = relaxed(response, bounds, time, seed=seed)
    return None if optimum is None else BinarySequence(optimum.levels, optimum.sequence(seed))


def relaxed(
    response: Response,
    bounds: tuple[Bounds, ...],
    time: FloatArray,
    *,
    seed: int = 0,
    iterations: int = _ITERATIONS,
) -> Relaxed | None:
    """Solve the relaxed design; None if the model is not linear in its inputs.

    Raises
    ------
    SimulationError
        A run failed.
    """
    step = float(time[1] - time[0])
    ramp = max((b.upper - b.lower) / b.rate for b in bounds) / step
    held_for = len(time) * len(bounds) * len(response.known) * np.sqrt(8.0 / _MEMORY)
    levels = Levels(bounds, time, min(int(np.ceil(max(1.0, ramp - 1e-9, held_for))), (len(time) - 1) // 3))
    rows = _superposed(response, levels, seed)
    if rows is None:
        return None
    n = rows.shape[2]
    forms = np.einsum("jmn,kmo->jkno", rows, rows, optimize=True).reshape(-1, n * n)
    factors = _factors(response, forms, n, seed, iterations)
    return Relaxed(response, levels, forms, factors, _bound(response, forms, factors))


def _superposed(response: Response, levels: Levels, seed: int) -> FloatArray | None:
    """Return (P, M, 1 + levels) whitened derivatives, that without levels first; None if they do not add up.

    The response to a level between the first and the last one is that to the second one, later.
    """
    inputs, count, length = len(levels.bounds), levels.count, levels.length
    full, lowest = np.ones(inputs), -np.ones((inputs, count))

    def slopes(raised: tuple[int, int] | None) -> FloatArray:
        raised_levels = lowest.copy()
        if raised is not None:  # by the whole range: a ramp takes as long as between two levels of a sequence
            raised_levels[raised] = 1.0
        return response.slopes(levels(raised_levels, full))

    low = slopes(None)
    parts = []
    for k in range(inputs):
        # The first level and the last one are shorter, because the run begins and ends at rest.
        first, second, last = (0.5 * (slopes((k, j)) - low) for j in (0, 1, count - 1))
        parts.append(first)
        for j in range(count - 2):
            later = np.zeros_like(second)
            later[..., j * length :] = second[..., : second.shape[-1] - j * length]
            parts.append(later)
        parts.append(last)
    parts.insert(0, low + np.sum(parts, axis=0))
    rows = np.stack([[response.whiten(row) for row in part] for part in parts], axis=2)
    signs = np.sign(np.random.default_rng(seed).standard_normal(lowest.shape))
    really = np.stack([response.whiten(row) for row in response.slopes(levels(signs, full))])
    error = rows @ np.append(1.0, signs.ravel()) - really
    return rows if np.linalg.norm(error) <= _SUPERPOSED * np.linalg.norm(really) else None


def _informed(response: Response, forms: FloatArray, factors: FloatArray) -> FloatArray:
    """Return the (P, P) information of relaxed levels, with what is known."""
    added = forms @ (factors @ factors.T).ravel()
    return response.known + added.reshape(response.known.shape)


def _factors(response: Response, forms: FloatArray, n: int, seed: int, iterations: int) -> FloatArray:
    """Return the factors of least cost, by L-BFGS over rows that are scaled to unit length."""
    begin = np.random.default_rng(seed).standard_normal((n, _RANK))

    def unit(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = x.reshape(n, _RANK)
        lengths = np.linalg.norm(rows, axis=1, keepdims=True)
        return rows / lengths, lengths

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        rows, lengths = unit(x)
        value, weights = response.cost(_informed(response, forms, rows))
        slope = -2.0 * (weights.ravel() @ forms).reshape(n, n) @ rows
        along = np.sum(slope * rows, axis=1, keepdims=True)
        return value / scale, ((slope - along * rows) / lengths / scale).ravel()

    scale = 1.0
    scale = max(abs(cost(begin.ravel())[0]), 1e-300)
    options = {"maxiter": iterations, "maxfun": 2 * iterations, "ftol": 1e-12, "gtol": 1e-9}
    return unit(minimize(cost, begin.ravel(), jac=True, method="L-BFGS-B", options=options).x)[0]


def _bound(response: Response, forms: FloatArray, factors: FloatArray) -> float:
    """Return a lower bound of the cost of any levels, from multipliers of the rows' lengths (weak duality)."""
    n = len(factors)
    value, weights = response.cost(_informed(response, forms, factors))
    gain = (weights.ravel() @ forms).reshape(n, n)
    gain = 0.5 * (gain + gain.T)
    multipliers = np.sum((gain @ factors) * factors, axis=1)
    largest = eigvalsh(gain - np.diag(multipliers), subset_by_index=[n - 1, n - 1])[0]
    return float(value - n * max(0.0, float(largest)))
