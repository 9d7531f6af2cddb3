"""Order of elimination of a sparse matrix, and the nonzero pattern of its factors L and U.

The pivots are chosen before any numbers are known: by a matching where the diagonal may be empty, then by minimum
degree [A. George, J. W. H. Liu, The evolution of the minimum degree ordering algorithm, SIAM Rev. 31, 1989]. The C
runtime checks whether they suit the current numbers (``linear.c``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fmu_build.matching import augment


@dataclass(frozen=True)
class Elimination:
    """Plan of a factorisation without a search for pivots.

    Attributes
    ----------
    columns
        Column eliminated in each step.
    places
        For each row, the step in which it is the pivot row.
    start, diagonal, rows
        The factors by column, in steps: column k has the rows ``rows[start[k]:start[k + 1]]``, ascending, and its
        pivot at ``diagonal[k]``.
    updated
        For each entry of the factors, whether the elimination of an earlier column changes it.
    multiplications
        Number of multiplications in one factorisation.
    """

    columns: tuple[int, ...]
    places: tuple[int, ...]
    start: tuple[int, ...]
    diagonal: tuple[int, ...]
    rows: tuple[int, ...]
    updated: tuple[bool, ...]
    multiplications: int


def plan(columns: Sequence[Sequence[int]]) -> Elimination:
    """Plan the elimination of a square matrix.

    Parameters
    ----------
    columns
        Rows of each column in which the matrix may be nonzero.
    """
    n = len(columns)
    row_of: dict[int, int] = {}
    incidence: list[list[int]] = [[] for _ in range(n)]
    for column, rows in enumerate(columns):
        for row in rows:
            incidence[row].append(column)
    rest = []
    for row, columns_of_row in enumerate(incidence):  # the diagonal where present
        if row in columns_of_row:
            row_of[row] = row
        else:
            rest.append(row)
    for row in rest:
        augment(row, incidence.__getitem__, row_of, set())
    # A structurally singular matrix is also numerically singular, so the remaining columns may get any rows.
    left = sorted(set(range(n)) - set(row_of.values()))
    for column in range(n):
        if column not in row_of:
            row_of[column] = left.pop()
    order = _minimum_degree(columns, row_of)
    step_of_row = {row_of[column]: step for step, column in enumerate(order)}
    return _symbolic([sorted(step_of_row[row] for row in columns[column]) for column in order], order, step_of_row)


def _minimum_degree(columns: Sequence[Sequence[int]], row_of: dict[int, int]) -> list[int]:
    """Columns by their degree at the time of elimination, in the graph of the matrix and its transpose."""
    column_of = {row: column for column, row in row_of.items()}
    near: list[set[int]] = [set() for _ in columns]
    for column, rows in enumerate(columns):
        for other in map(column_of.__getitem__, rows):
            if other != column:
                near[column].add(other)
                near[other].add(column)
    buckets: list[set[int]] = [set() for _ in range(len(columns) + 1)]
    for column, neighbours in enumerate(near):
        buckets[len(neighbours)].add(column)
    order: list[int] = []
    least = 0
    while len(order) < len(columns):
        while not buckets[least]:
            least += 1
        column = min(buckets[least])
        buckets[least].remove(column)
        order.append(column)
        neighbours = near[column]
        for other in neighbours:
            buckets[len(near[other])].remove(other)
            near[other] |= neighbours
            near[other] -= {other, column}
            buckets[len(near[other])].add(other)
            least = min(least, len(near[other]))
    return order


def _symbolic(columns: list[list[int]], order: list[int], step_of_row: dict[int, int]) -> Elimination:
    """Fill-in: column k of the factors also has the rows of the columns of its entries above the diagonal."""
    n = len(columns)
    lower: list[list[int]] = []
    start, diagonal, rows, multiplications = [0], [], [], 0
    updated: list[bool] = []
    for k, below in enumerate(columns):
        inside = {*below, k}
        todo = [row for row in inside if row < k]
        while todo:
            for row in lower[todo.pop()]:
                if row not in inside:
                    inside.add(row)
                    if row < k:
                        todo.append(row)
        filled = sorted(inside)
        above = sum(row < k for row in filled)
        changed = {row for step in filled[:above] for row in lower[step]}
        updated += [row in changed for row in filled]
        diagonal.append(start[-1] + above)
        rows += filled
        start.append(len(rows))
        lower.append(filled[above + 1 :])
        multiplications += len(lower[k]) + sum(len(lower[row]) for row in filled[:above])
    places = tuple(step_of_row[row] for row in range(n))
    factors = tuple(start), tuple(diagonal), tuple(rows), tuple(updated)
    return Elimination(tuple(order), places, *factors, multiplications)
