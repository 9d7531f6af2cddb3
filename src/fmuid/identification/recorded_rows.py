"""Recorded evaluations in columns: about a hundred bytes per evaluation, however many there are."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, chain
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.evaluation import Evaluation

_T = TypeVar("_T")

SEARCHED = ("search", "derivative")
"""Purposes of the evaluations of a search; other purposes belong to analyses of its result."""


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One recorded evaluation."""

    search: FloatArray
    parameters: Mapping[str, float]
    criteria: FloatArray
    constraints: FloatArray
    cost: float
    failure: str | None
    purpose: str
    seconds: float
    improved: bool
    residuals: FloatArray | None = None
    predictions: tuple[FloatArray, ...] = ()

    def evaluation(self) -> Evaluation:
        """Return the row as an evaluation."""
        residuals = np.zeros(0) if self.residuals is None else self.residuals
        return Evaluation(
            self.search,
            self.parameters,
            self.criteria,
            residuals,
            self.cost,
            self.constraints,
            self.failure,
            self.seconds,
            self.predictions,
        )


class Rows(Sequence[Row]):
    """The evaluations of one stage: numbers in one array, other contents by row number where there are any.

    All rows have the same parameters as the first, and the same number of everything else. A search point may have
    further coordinates (those of fixed parameters), which are kept outside the array.
    """

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        # Search, criteria, constraints, parameters, cost and seconds in one row.
        self._ends: tuple[int, ...] = ()
        self._numbers = array("d")
        self._further: dict[int, FloatArray] = {}
        self._purposes: list[str] = []
        self._improved = bytearray()
        self._failures: dict[int, str] = {}
        self._residuals: dict[int, FloatArray] = {}
        self._predictions: dict[int, tuple[FloatArray, ...]] = {}

    @classmethod
    def of_columns(
        cls,
        names: Sequence[str],
        blocks: Sequence[FloatArray],
        purposes: Iterable[str],
        *,
        improved: NDArray[np.bool_],
        failures: Mapping[int, str],
        predictions: Mapping[int, tuple[FloatArray, ...]],
    ) -> Rows:
        """Return rows of (n, columns) blocks: search, criteria, constraints, parameters, cost and seconds."""
        rows = cls()
        rows._names = tuple(names)
        rows._ends = tuple(np.cumsum([block.shape[1] for block in blocks]).tolist())
        rows._numbers.frombytes(np.hstack(blocks).tobytes())
        known: dict[str, str] = {}
        rows._purposes = [known.setdefault(purpose, purpose) for purpose in purposes]
        rows._improved = bytearray(improved.astype(np.uint8).tobytes())
        rows._failures, rows._predictions = dict(failures), dict(predictions)
        return rows

    def append(self, row: Row) -> None:
        """Add an evaluation.

        Raises
        ------
        ValueError
            Its parameters differ from those of the first, or the number of anything else does.
        """
        number = len(self)
        if not number:
            self._names = tuple(row.parameters)
        if row.parameters.keys() != set(self._names):
            raise ValueError(f"an evaluation with other parameters than the first: {tuple(row.parameters)}")
        free = self._ends[0] if number else len(row.search)
        parts: list[Any] = [
            row.search[:free],
            row.criteria,
            row.constraints,
            [row.parameters[name] for name in self._names],
            (row.cost, row.seconds),
        ]
        ends = tuple(accumulate(map(len, parts)))
        if not number:
            self._ends = ends
        if ends != self._ends:
            raise ValueError(f"an evaluation with {ends} columns after one with {self._ends}")
        # Ctrl-C may come between any two steps: a row exists once its purpose is there, and what an interrupted
        # one has left is replaced.
        _keep(self._further, number, row.search[free:] if len(row.search) > free else None)
        _keep(self._failures, number, row.failure)
        _keep(self._residuals, number, row.residuals)
        _keep(self._predictions, number, row.predictions or None)
        self._numbers[number * ends[-1] :] = array("d", chain.from_iterable(parts))
        self._improved[number:] = bytes((row.improved,))
        self._purposes.append(row.purpose)

    def __len__(self) -> int:
        return len(self._purposes)

    @overload
    def __getitem__(self, number: int) -> Row: ...
    @overload
    def __getitem__(self, number: slice) -> list[Row]: ...
    def __getitem__(self, number: int | slice) -> Row | list[Row]:
        if isinstance(number, slice):
            return [self[k] for k in range(*number.indices(len(self)))]
        number = range(len(self))[number]
        width = self._ends[-1]
        line = np.array(self._numbers[number * width : (number + 1) * width])
        search, criteria, constraints, parameters, (cost, seconds) = np.split(line, self._ends[:-1])
        return Row(
            self._point(number, search),
            dict(zip(self._names, parameters.tolist(), strict=True)),
            criteria,
            constraints,
            float(cost),
            self._failures.get(number),
            self._purposes[number],
            float(seconds),
            bool(self._improved[number]),
            self._residuals.get(number),
            self._predictions.get(number, ()),
        )

    @property
    def search(self) -> FloatArray:
        """(n, n_free) points of the search space."""
        return self._block(0)

    @property
    def numbers(self) -> dict[bytes, int]:
        """Complete search point, as bytes -> the number of its last row, if possible one with predictions."""
        row_of: dict[bytes, int] = {}
        for k, x in enumerate(self.search):
            self.prefer(row_of, self._point(k, x).tobytes(), k)
        return row_of

    def prefer(self, numbers: dict[bytes, int], point: bytes, number: int) -> None:
        """Enter the number of a point's row, unless that of one with more of its evaluation is known."""
        if number in self._predictions or numbers.get(point) not in self._predictions:
            numbers[point] = number

    @property
    def criteria(self) -> FloatArray:
        """(n, n_criteria), NaN if failed."""
        return self._block(1)

    @property
    def constraints(self) -> FloatArray:
        """(n, n_constraints)."""
        return self._block(2)

    def parameters(self, names: Sequence[str]) -> FloatArray:
        """(n, names) values of parameters."""
        return self._block(3)[:, [self._names.index(name) for name in names] if len(self) else []]

    @property
    def costs(self) -> FloatArray:
        """(n,) costs, NaN if failed."""
        return self._block(4)[:, 0] if len(self) else np.zeros(0)

    @property
    def seconds(self) -> FloatArray:
        """(n,) durations."""
        return self._block(4)[:, 1] if len(self) else np.zeros(0)

    @property
    def searched(self) -> NDArray[np.bool_]:
        """(n,) whether the evaluation belongs to the search, not to an analysis of its result."""
        return np.array([purpose in SEARCHED for purpose in self._purposes], dtype=bool)

    @property
    def failed(self) -> NDArray[np.bool_]:
        """(n,) whether it failed."""
        return np.array([number in self._failures for number in range(len(self))], dtype=bool)

    @property
    def improved(self) -> NDArray[np.bool_]:
        """(n,) whether it was the best so far."""
        return np.array(self._improved[: len(self)], dtype=bool)

    @property
    def failures(self) -> list[str]:
        """Reasons of failures, empty for successful evaluations."""
        return [self._failures.get(k, "") for k in range(len(self))]

    @property
    def purposes(self) -> Sequence[str]:
        """Purposes of the evaluations."""
        return self._purposes

    def forget_residuals(self) -> None:
        """Drop the residuals, which are only needed by a solver that resumes."""
        self._residuals.clear()

    def _point(self, number: int, search: FloatArray) -> FloatArray:
        """Return the complete search point of a row, whose part in the array is `search`."""
        return np.append(search, self._further[number]) if number in self._further else search

    def _block(self, part: int) -> FloatArray:
        if not len(self):
            return np.zeros((0, 0))
        begin = self._ends[part - 1] if part else 0
        shape = len(self), self._ends[-1]
        lines = np.frombuffer(self._numbers, count=math.prod(shape)).reshape(shape)
        return lines[:, begin : self._ends[part]].copy()  # the array cannot grow while a view of it exists


def _keep(kept: dict[int, _T], number: int, value: _T | None) -> None:
    """Enter the value of a row, or drop an old one."""
    kept.pop(number, None)
    if value is not None:
        kept[number] = value
