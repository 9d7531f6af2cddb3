"""Parameter combinations that the experiments determine, and their names."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.estimation_problem import Problem

_PIVOT = 0.05  # smaller entries of a reduced basis count as zero
_SNAP = 0.02  # an exponent this close to a small fraction is that fraction
_LARGEST_DENOMINATOR = 4


@dataclass(frozen=True, slots=True)
class Identifiability:
    """Outcome of the singular value decomposition of a Jacobian with columns of equal error.

    Parameters
    ----------
    rank
        Number of independent combinations that the experiments determine.
    singular_values
        (n,) singular values of that Jacobian, largest first; at most the root of the number of parameters.
    undetermined
        Parameters that are not determined individually.
    combinations
        Combinations of them that are determined, such as ``c/J``.
    """

    rank: int
    singular_values: tuple[float, ...]
    undetermined: tuple[str, ...] = ()
    combinations: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every parameter is determined."""
        return not self.undetermined

    def __str__(self) -> str:
        """Return the finding in one sentence."""
        if self.complete:
            return "every parameter is determined"
        names = ", ".join(self.undetermined)
        if not self.combinations:
            return f"{names}: no effect on any measured output"
        verb = "is not determined" if len(self.undetermined) == 1 else "are not separately identifiable"
        return f"{names} {verb}; only {' and '.join(self.combinations)}"


def identifiability(
    problem: Problem,
    x: FloatArray,
    jacobian: FloatArray,
    scale: FloatArray,
    *,
    tolerance: float = 1e-6,
    covariance: FloatArray | None = None,
) -> Identifiability:
    """Return the combinations of free parameters that the residuals determine at the search point `x`.

    Parameters
    ----------
    jacobian
        (m, n) derivative of the residuals in search space.
    scale
        (n,) divisors of its columns after which each has an error of `tolerance` (`Differences.column_scale`).
    tolerance
        Singular values below this count as zero.
    covariance
        (n, n) in search space, if known: a direction with an uncertainty above 100 % also counts as undetermined.
    """
    names = problem.space.names
    relative = _relative_scale(problem, x)
    triangle = np.linalg.qr(jacobian / scale, mode="r")  # has the same singular values and axes
    _, singular, axes = np.linalg.svd(triangle, full_matrices=len(triangle) < len(x))
    singular = np.pad(singular, (0, len(x) - len(singular)))
    undetermined_axes = axes[singular <= tolerance * math.sqrt(len(x))] / scale
    if covariance is not None and len(undetermined_axes) == 0:
        # In practice: where the spread exceeds both the value and its start.
        size = np.maximum(np.abs(relative), 1.0)
        spread, axes = np.linalg.eigh(covariance / np.outer(size, size))
        undetermined_axes = axes.T[spread > 1.0] * size
    values = tuple(float(s) for s in singular)
    rank = len(x) - len(undetermined_axes)
    if rank == len(x):
        return Identifiability(rank, values)
    # Orthonormal in relative changes: first the undetermined directions, then the row space.
    moves = undetermined_axes / relative
    moves /= np.linalg.norm(moves, axis=1, keepdims=True)
    directions = np.linalg.qr(moves.T, mode="complete")[0].T
    null, row_space = directions[: len(moves)], directions[len(moves) :]
    undetermined = [i for i in range(len(x)) if np.max(np.abs(null[:, i])) > _PIVOT]
    if rank == 0:
        return Identifiability(0, values, tuple(names[i] for i in undetermined))
    products = _reduced(row_space)
    slope = problem.space.slope(x)
    # The same row space in model space itself, for sums: d r / d p = (d r / d relative) / (p change).
    sums = _reduced(row_space / (relative * slope))
    rows, write = _simplest(problem, x, names, products, sums)
    combinations = [write(names, row) for row in rows if np.sum(np.abs(row) > _PIVOT) > 1]
    return Identifiability(rank, values, tuple(names[i] for i in undetermined), tuple(combinations))


def _relative_scale(problem: Problem, x: FloatArray) -> FloatArray:
    """Return d x / d ln(p), (n,); a linear parameter near 0 is scaled by its search unit."""
    logarithmic = np.array([spec.scale == "log" for spec in problem.space.free])
    return np.where(logarithmic | (np.abs(x) < 0.02), 1.0, x)


def _reduced(rows: FloatArray) -> FloatArray:
    """Return the reduced row echelon form of a (rank, n) basis, small entries zeroed."""
    reduced = rows.copy()
    row = 0
    for column in range(reduced.shape[1]):
        if row == len(reduced):
            break
        scale = np.max(np.abs(rows[:, column]))
        pivot = row + int(np.argmax(np.abs(reduced[row:, column])))
        if scale == 0.0 or abs(reduced[pivot, column]) < _PIVOT * scale:
            continue
        reduced[[row, pivot]] = reduced[[pivot, row]]
        reduced[row] /= reduced[row, column]
        others = np.arange(len(reduced)) != row
        reduced[others] -= np.outer(reduced[others, column], reduced[row])
        row += 1
    return reduced


_Write = Callable[[tuple[str, ...], FloatArray], str]


def _simplest(
    problem: Problem, x: FloatArray, names: tuple[str, ...], products: FloatArray, sums: FloatArray
) -> tuple[FloatArray, _Write]:
    """Choose between products of powers and sums by moving far where neither changes."""
    candidates: list[tuple[float, FloatArray, _Write]] = []
    values = np.array([problem.space.to_model(x)[n] for n in names])
    for rows, write in ((products, _product), (sums, _sum)):
        if any(_fraction(v) is None for v in rows.flat):
            continue
        exact = np.vectorize(lambda v: float(_fraction(v) or 0.0))(rows)
        if write is _product and np.any(values <= 0.0):
            continue
        _, _, directions = np.linalg.svd(exact)
        moves = []
        for free in directions[len(exact) :]:
            free = free / np.max(np.abs(free))
            moved = values * np.exp(0.3 * free) if write is _product else values * 0 + values + 0.3 * free
            point = problem.space.to_search(dict(zip(names, moved, strict=True)))
            evaluations = problem.evaluate_many([x, np.clip(point, problem.space.lower, problem.space.upper)])
            if not all(e.ok for e in evaluations):
                break
            moves.append(float(np.linalg.norm(evaluations[1].residuals - evaluations[0].residuals)))
        else:
            candidates.append((max(moves, default=0.0), exact, write))
    if not candidates:
        return products, _product
    return min(candidates, key=lambda c: c[0])[1:]


def _fraction(value: float) -> Fraction | None:
    near = Fraction(value).limit_denominator(_LARGEST_DENOMINATOR)
    return near if abs(float(near) - value) < _SNAP and abs(near) <= _LARGEST_DENOMINATOR else None


def _product(names: tuple[str, ...], row: FloatArray) -> str:
    exponents = _whole(row)
    above = [_power(n, e) for n, e in zip(names, exponents, strict=True) if e > 0]
    below = [_power(n, -e) for n, e in zip(names, exponents, strict=True) if e < 0]
    text = "*".join(above) or "1"
    if not below:
        return text
    return f"{text}/{below[0]}" if len(below) == 1 else f"{text}/({'*'.join(below)})"


def _sum(names: tuple[str, ...], row: FloatArray) -> str:
    text = ""
    for name, factor in zip(names, _whole(row), strict=True):
        if factor == 0:
            continue
        size = "" if abs(factor) == 1 else f"{abs(factor):g} "
        text += (f" {'+' if factor > 0 else '-'} " if text else "-" if factor < 0 else "") + size + name
    return text


def _power(name: str, exponent: float) -> str:
    return name if exponent == 1 else f"{name}^{exponent:g}"


def _whole(row: FloatArray) -> list[float]:
    """Return a row with its fractions cleared, or rounded to two digits if it has none."""
    small = [0.0 if abs(v) < _PIVOT else float(v) for v in row]
    fractions = [_fraction(v) for v in small]
    if any(f is None for f in fractions):
        return [round(v, 2) for v in small]
    common = math.lcm(*(f.denominator for f in fractions if f is not None))
    return [float(f * common) for f in fractions if f is not None]
