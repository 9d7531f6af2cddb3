"""Overconstrained connectors: roots, and the connections to break (specification 9.4)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from fmu_build.errors import ModelicaError
from fmu_build.syntax import Place

Edge = tuple[str, str]


class _Parts:
    """Connected parts of a graph, and their roots."""

    def __init__(self, nodes: list[str]) -> None:
        self.parent = {n: n for n in nodes}
        self.root_of: dict[str, str] = {}

    def find(self, n: str) -> str:
        """Return the representative of the part of a node."""
        while self.parent[n] != n:
            self.parent[n] = self.parent[self.parent[n]]
            n = self.parent[n]
        return n

    def join(self, a: str, b: str) -> bool:
        """Join two parts; False if they are one already, or both have a root."""
        one, other = self.find(a), self.find(b)
        if one == other or (one in self.root_of and other in self.root_of):
            return False
        self.parent[other] = one
        if other in self.root_of:
            self.root_of[one] = self.root_of.pop(other)
        return True


@dataclass
class VirtualGraph:
    """Graph of the overconstrained records (or types) of a model, by their paths.

    Attributes
    ----------
    branches, connections
        Edges that ``Connections.branch`` and ``connect`` make. Only connections may be broken.
    definite, potential
        Roots, and the priorities of potential roots.
    """

    branches: dict[Edge, Place] = field(default_factory=dict)
    connections: dict[Edge, Place] = field(default_factory=dict)
    definite: dict[str, Place] = field(default_factory=dict)
    potential: dict[str, int] = field(default_factory=dict)

    def tree(self) -> Tree:
        """Break connections until a spanning tree with one root remains of each connected part.

        Raises
        ------
        ModelicaError
            Branches form a loop, a part has several definite roots that branches connect, or it has no root.
        """
        ends = (n for edge in (*self.branches, *self.connections) for n in edge)
        parts = _Parts([*self.definite, *self.potential, *ends])
        for (a, b), at in self.branches.items():
            if not parts.join(a, b):
                raise ModelicaError(f"the branches between '{a}' and '{b}' form a loop", where=at)
        for n, at in self.definite.items():
            if parts.root_of.setdefault(parts.find(n), n) != n:
                other = parts.root_of[parts.find(n)]
                raise ModelicaError(f"'{n}' and '{other}' are both roots of the same branches", where=at)
        broken = {edge for edge in self.connections if not parts.join(*edge)}
        for n in sorted(self.potential, key=self.potential.__getitem__):
            parts.root_of.setdefault(parts.find(n), n)
        without = next((n for n in parts.parent if parts.find(n) not in parts.root_of), None)
        if without is not None:
            places = {n: at for edges in (self.connections, self.branches) for e, at in edges.items() for n in e}
            raise ModelicaError(
                f"nothing that '{without}' is connected to is a root", where=places.get(without),
                fix="connect it to a root, such as world.frame_b",
            )  # fmt: skip
        roots = frozenset(parts.root_of[parts.find(n)] for n in parts.parent)
        return Tree(roots, frozenset(broken), self._nearer(roots, broken))

    def _nearer(self, roots: frozenset[str], broken: set[Edge]) -> frozenset[str]:
        """Return the ends of branches that are nearer to their root than the other end."""
        neighbours: dict[str, list[str]] = {}
        for a, b in (*self.branches, *(e for e in self.connections if e not in broken)):
            neighbours.setdefault(a, []).append(b)
            neighbours.setdefault(b, []).append(a)
        distance = dict.fromkeys(roots, 0)
        queue = deque(sorted(roots))
        while queue:
            n = queue.popleft()
            for other in neighbours.get(n, ()):
                if other not in distance:
                    distance[other] = distance[n] + 1
                    queue.append(other)
        return frozenset(a if distance[a] < distance[b] else b for a, b in self.branches)


@dataclass(frozen=True)
class Tree:
    """What remains of a virtual graph: the roots, the broken connections, and for which ``rooted()`` is true."""

    roots: frozenset[str] = frozenset()
    broken: frozenset[Edge] = frozenset()
    rooted: frozenset[str] = frozenset()
