"""A point near the start values at which the equations between positions hold, for decisions on their rank."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from fmu_build.graph import SX, Graph, is_number

_ROUNDS = 50  # of Newton's method, which needs few if it converges
_SMALL = 1e-12  # residuals and, relatively, what is added to the diagonal where equations repeat each other


def consistent(graph: Graph, residuals: Sequence[SX], guesses: Mapping[int, tuple[SX, float]]) -> dict[int, float]:
    """Return values of unknowns at which equations hold, or nearly so if Newton's method does not converge.

    Unknowns are guessed until an equation gives another one. The equations that are left close loops: Newton's
    method solves all of them together, with the smallest steps.

    Parameters
    ----------
    residuals
        Expressions of the unknowns.
    guesses
        Symbol and guess of each unknown, in the order in which to guess.
    """
    equations = _Equations(residuals, [symbol for symbol, _ in guesses.values()])
    x = np.array([guess for _, guess in guesses.values()])
    place = {k: i for i, k in enumerate(guesses)}
    open_ = [{place[k] for k in graph.symbols(r)} for r in residuals]
    explicit = [{place[k] for k, slope in graph.gradient(r).items() if is_number(slope)} for r in residuals]
    waiting = set(range(len(residuals)))
    for guessed in range(len(x)):
        while ready := {min(open_[row]): row for row in sorted(waiting) if len(open_[row]) == 1}:
            first = {column: row for column, row in ready.items() if column in explicit[row]} or ready
            x = equations.solved(x, list(first.values()), list(first))
            _forget(open_, waiting, set(first))
        _forget(open_, waiting, {guessed})
    x = equations.solved(x, list(range(len(residuals))), list(range(len(x))))
    return dict(zip(guesses, x, strict=True))


def _forget(open_: list[set[int]], waiting: set[int], known: set[int]) -> None:
    for row in list(waiting):
        open_[row] -= known
        if not open_[row]:
            waiting.remove(row)


class _Equations:
    def __init__(self, residuals: Sequence[SX], symbols: Sequence[SX]) -> None:
        whole, unknowns = ca.vertcat(*residuals), ca.vertcat(*symbols)
        slopes = ca.jacobian(whole, unknowns)
        self._row, self._column = (np.array(place) for place in slopes.sparsity().get_triplet())
        self._evaluate = ca.Function("f", [unknowns], [ca.densify(whole), slopes.nz[:]])
        self._shape = slopes.shape

    def _at(
        self, x: np.ndarray[Any, Any], rows: list[int], columns: list[int]
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        f, slopes = (np.asarray(part).ravel() for part in self._evaluate(x))
        row, column = np.full(self._shape[0], -1), np.full(self._shape[1], -1)
        row[rows], column[columns] = np.arange(len(rows)), np.arange(len(columns))
        inside = (row[self._row] >= 0) & (column[self._column] >= 0)
        j = np.zeros((len(rows), len(columns)))
        j[row[self._row[inside]], column[self._column[inside]]] = slopes[inside]
        return f[rows], j

    def solved(self, x: np.ndarray[Any, Any], rows: list[int], columns: list[int]) -> np.ndarray[Any, Any]:
        """Solve equations for some of the unknowns by the smallest steps, halved where they do not help."""
        f, j = self._at(x, rows, columns)
        for _ in range(_ROUNDS):
            if not np.abs(f).max(initial=0.0) > _SMALL:
                break
            square = j @ j.T
            square[np.diag_indices_from(square)] += _SMALL * max(float(np.trace(square)), _SMALL)
            step = j.T @ np.linalg.solve(square, f)
            for part in 0.5 ** np.arange(10):
                near = x.copy()
                near[columns] -= part * step
                f_near, j_near = self._at(near, rows, columns)
                if np.linalg.norm(f_near) < np.linalg.norm(f):
                    x, f, j = near, f_near, j_near
                    break
            else:
                break
        return x
