"""Direct feedthrough between outputs: algebraic loops, and the stepping order of components."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from fmuid.core.coupling import Connection, Place

Feedthrough = Mapping[str, Mapping[str, frozenset[str]]]
"""By component and output, the inputs that the output depends on without delay."""


def find_loop(connections: Iterable[Connection], feedthrough: Feedthrough) -> tuple[Place, ...]:
    """Return an algebraic loop, each variable followed by one that depends on it; empty if there is none."""
    sorter: TopologicalSorter[Place] = TopologicalSorter()
    for connection in connections:
        sorter.add(connection.target, connection.source)
    for component, outputs in feedthrough.items():
        for output, inputs in outputs.items():
            sorter.add(Place(component, output), *(Place(component, name) for name in inputs))
    try:
        sorter.prepare()
    except CycleError as error:
        cycle: list[Place] = error.args[1][:-1]
        first = cycle.index(min(p for p in cycle if p.variable in feedthrough[p.component]))
        return (*cycle[first:], *cycle[:first], cycle[first])
    return ()


def loop_text(loop: Sequence[Place]) -> str:
    """Return a loop as text."""
    return " -> ".join(map(str, loop))


def stepping_order(
    components: Sequence[str], connections: Sequence[Connection], feedthrough: Feedthrough
) -> list[tuple[tuple[str, ...], bool]]:
    """Return the stepping order as groups of components, and whether each group is an algebraic loop.

    A component comes after the components that its outputs depend on without delay; otherwise the given order is
    kept.
    """
    needs = _dependencies(components, connections, feedthrough)
    loops = _loops(connections, feedthrough)
    groups = [next((g for g in loops if c in g), {c}) for c in components]
    left = list(dict.fromkeys(tuple(c for c in components if c in g) for g in groups))
    order: list[tuple[tuple[str, ...], bool]] = []
    while left:
        waiting = {c for group in left for c in group}
        ready = (g for g in left if not any(needs[c] & (waiting - set(g)) for c in g))
        group = next(ready, left[0])  # a cycle through different variables: use the given order
        order.append((group, set(group) in loops))
        left.remove(group)
    return order


def _dependencies(
    components: Sequence[str], connections: Sequence[Connection], feedthrough: Feedthrough
) -> dict[str, set[str]]:
    felt = {c: frozenset[str]().union(*feedthrough[c].values()) for c in components}
    return {
        c: {k.source.component for k in connections if k.target.component == c and k.target.variable in felt[c]}
        for c in components
    }


def _loops(connections: Sequence[Connection], feedthrough: Feedthrough) -> list[set[str]]:
    """Return the components of each algebraic loop; loops that share a component are one."""
    arrows = [(k.source, k.target) for k in connections]
    arrows += [
        (Place(c, u), Place(c, y)) for c, outputs in feedthrough.items() for y, us in outputs.items() for u in us
    ]
    number = {place: i for i, place in enumerate(dict.fromkeys(p for arrow in arrows for p in arrow))}
    loops: list[set[str]] = []
    if not arrows:
        return loops
    ends = np.array([[number[a], number[b]] for a, b in arrows]).T
    graph = csr_array((np.ones(len(arrows)), ends), shape=(len(number), len(number)))
    _, label = connected_components(graph, directed=True, connection="strong")
    for strong in range(max(label) + 1):
        places = [p for p, i in number.items() if label[i] == strong]
        if len(places) > 1:
            joined = {p.component for p in places}
            for other in [g for g in loops if g & joined]:
                loops.remove(other)
                joined |= other
            loops.append(joined)
    return loops
