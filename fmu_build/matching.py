"""Bipartite matching and strongly connected components of sparse incidences."""

from __future__ import annotations

from collections.abc import Callable, Sequence


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
    """Strongly connected components, each after all it leads to (Tarjan's order), without recursion."""
    index: dict[int, int] = {}
    low: dict[int, int] = {}
    on_stack: set[int] = set()
    stack: list[int] = []
    out: list[list[int]] = []
    for root in range(len(successors)):
        if root in index:
            continue
        work = [(root, iter(successors[root]))]
        index[root] = low[root] = len(index)
        stack.append(root)
        on_stack.add(root)
        while work:
            node, rest = work[-1]
            for successor in rest:
                if successor not in index:
                    index[successor] = low[successor] = len(index)
                    stack.append(successor)
                    on_stack.add(successor)
                    work.append((successor, iter(successors[successor])))
                    break
                if successor in on_stack:
                    low[node] = min(low[node], index[successor])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[node])
                if low[node] == index[node]:
                    component = []
                    while True:
                        member = stack.pop()
                        on_stack.discard(member)
                        component.append(member)
                        if member == node:
                            break
                    out.append(sorted(component))
    return out
