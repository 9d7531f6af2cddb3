"""Bipartite matching and strongly connected components of sparse incidences."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence


def augment(row: int, incidence: Callable[[int], Sequence[int]], row_of: dict[int, int], seen: set[int]) -> bool:
    """Find an augmenting path from `row` and flip it; `seen` collects the visited columns.

    Parameters
    ----------
    incidence
        Columns of a row.
    row_of
        Matched row of each column, changed in place.
    """
    # Depth first without recursion: (row, iterator over its columns, column by which the row was entered).
    path: list[tuple[int, int]] = []
    stack = [(row, iter(incidence(row)))]
    while stack:
        current, columns = stack[-1]
        for column in columns:
            if column in seen:
                continue
            seen.add(column)
            path.append((current, column))
            if column not in row_of:
                for r, c in path:
                    row_of[c] = r
                return True
            stack.append((row_of[column], iter(incidence(row_of[column]))))
            break
        else:
            stack.pop()
            if path:
                path.pop()
    return False


def components(successors: Sequence[Sequence[int]]) -> list[list[int]]:
    """Strongly connected components, each after all that it leads to (Tarjan's order), without recursion."""
    search = _Tarjan(successors)
    for root in range(len(successors)):
        if root not in search.index:
            search.visit(root)
    return search.found


class _Tarjan:
    def __init__(self, successors: Sequence[Sequence[int]]) -> None:
        self._successors = successors
        self._low: dict[int, int] = {}
        self._stack: list[int] = []
        self._on_stack: set[int] = set()
        self.index: dict[int, int] = {}
        self.found: list[list[int]] = []

    def visit(self, root: int) -> None:
        work = [self._enter(root)]
        while work:
            node, rest = work[-1]
            successor = next((s for s in rest if s not in self.index or s in self._on_stack), None)
            if successor is None:
                work.pop()
                if work:
                    parent = work[-1][0]
                    self._low[parent] = min(self._low[parent], self._low[node])
                if self._low[node] == self.index[node]:
                    self._leave(node)
            elif successor in self.index:
                self._low[node] = min(self._low[node], self.index[successor])
            else:
                work.append(self._enter(successor))

    def _enter(self, node: int) -> tuple[int, Iterator[int]]:
        self.index[node] = self._low[node] = len(self.index)
        self._stack.append(node)
        self._on_stack.add(node)
        return node, iter(self._successors[node])

    def _leave(self, node: int) -> None:
        component = [self._stack.pop()]
        while component[-1] != node:
            component.append(self._stack.pop())
        self._on_stack.difference_update(component)
        self.found.append(sorted(component))
