"""What the specification asks of connectors and of connected signals (sections 4.7 and 9.3)."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

from fmu_build import algebra
from fmu_build.errors import ModelicaError, counted
from fmu_build.front.classes import ComponentDef
from fmu_build.front.instances import Instance
from fmu_build.front.resolve import Item, Many, Resolver, Var
from fmu_build.syntax import Place

Element = tuple[str, tuple[int, ...]]  # variable and index


@dataclass(frozen=True)
class Leaf:
    """One side of a connection: a connector or an element of a variable, seen from inside or outside.

    `outer` connectors are elsewhere: what is connected to one is seen from there.
    """

    item: Instance | Var
    index: tuple[int, ...]
    outside: bool
    outer: bool = False

    def towards(self, other: Leaf) -> Leaf:
        """Return this side as it is seen from another: a component's own connector from around the component."""
        return replace(self, outside=False) if other.outer and not self.outer else self

    @property
    def path(self) -> str:
        """Path of the connector."""
        if isinstance(self.item, Instance):
            return self.item.path or ""
        return self.item.name if self.item.connector is not None else (self.item.owner.path or "")


class Sets:
    """Disjoint sets of what is joined."""

    def __init__(self) -> None:
        self._parent: dict[Any, Any] = {}

    def find(self, x: Any) -> Any:
        """Return the representative of the set of an element."""
        while self._parent.setdefault(x, x) != x:
            x = self._parent[x]
        return x

    def union(self, a: Any, b: Any) -> bool:
        """Join the sets of two elements; False if they are one already."""
        root_a, root_b = self.find(a), self.find(b)
        self._parent[root_b] = root_a
        return bool(root_a != root_b)

    def members(self) -> dict[Any, list[Any]]:
        """Return the elements of each set by its representative."""
        sets: dict[Any, list[Any]] = {}
        for x in self._parent:
            sets.setdefault(self.find(x), []).append(x)
        return sets

    def __contains__(self, x: Any) -> bool:
        return x in self._parent


class Signals:
    """Connected variables with a direction: those of one connection in one class have one source."""

    def __init__(self) -> None:
        self._sets = Sets()
        self._sources: dict[tuple[str, Element], tuple[str, Place]] = {}

    def join(self, a: Leaf, b: Leaf, level: str, at: Place) -> None:
        """Connect two variables in the component of a path."""
        one, other = a.item, b.item
        assert isinstance(one, Var)
        assert isinstance(other, Var)
        in_bus = any(v.owner.is_kind("expandable connector") for v in (one, other))
        if (one.direction is None) != (other.direction is None) and not in_bus:
            name = other.name if one.direction is None else one.name
            what = f"'{one.name}' and '{other.name}': only '{name}' is an input or an output"
            raise ModelicaError(what, where=at)
        self._sets.union((level, (one.name, a.index)), (level, (other.name, b.index)))
        for leaf, var in ((a, one), (b, other)):
            is_source = var.direction == ("input" if leaf.outside else "output")
            if is_source and not (leaf.outside and var.protected):
                self._sources.setdefault((level, (var.name, leaf.index)), (var.name, at))

    def check(self) -> None:
        """Refuse connected signals of which several determine the others."""
        first: dict[Any, str] = {}
        for key, (name, at) in self._sources.items():
            other = first.setdefault(self._sets.find(key), name)
            if other != name:
                what = f"'{other}' and '{name}' are connected, and both determine the signal"
                raise ModelicaError(what, where=at)


def _parts(item: Item, resolver: Resolver) -> list[Item]:
    """Components of a component, or elements of an array of components."""
    if isinstance(item, Many):
        return list(item.items)
    if not isinstance(item, Instance):
        return []
    names = [name for name, slot in item.slots.items() if isinstance(slot.element, ComponentDef)]
    return [resolver.item(item, name) for name in names]


def is_connector(item: Item) -> bool:
    """Whether a component, or each element of an array, is a connector."""
    if isinstance(item, Many):
        return bool(item.items) and is_connector(item.items[0])
    if isinstance(item, Var):
        return item.connector is not None
    return isinstance(item, Instance) and item.is_kind("connector", "expandable connector")


def check_causal(item: Item, resolver: Resolver) -> None:
    """Refuse a connector of a block that is neither input nor output."""
    if not is_connector(item) or (isinstance(item, Instance) and item.kind == "expandable connector"):
        return
    parts = [item]
    while parts:
        part = parts.pop()
        if isinstance(part, Var) and part.variability not in ("constant", "parameter") and part.direction is None:
            what = f"'{part.name}' is in a connector of a block, but is neither input nor output"
            raise ModelicaError(what, where=part.at)
        parts += _parts(part, resolver)


def check_connector(connector: Instance, resolver: Resolver) -> None:
    """Refuse a connector with another number of flows than of potentials (specification 9.3.1)."""
    at, name = connector.definition.at, connector.class_name
    count: Counter[str] = Counter()
    parts: list[Item] = [connector]
    while parts:
        item = parts.pop()
        function = resolver.constraint(item)
        if function is not None:  # counts as the residue of its constraint
            shape = resolver.functions[resolver.function_key(function, at)].outputs[0].shape
            sizes = [resolver.known(n, n.at) for n in shape if n is not None]
            count["potential"] += math.prod(algebra.whole(n) for n in sizes)
        elif isinstance(item, Var):
            if item.variability not in ("constant", "parameter") and (item.flow or item.direction is None):
                kind = "flow" if item.flow else "stream" if item.stream else "potential"
                count[kind] += math.prod(item.dims)
        else:
            parts += _parts(item, resolver)
    if count["stream"] and count["flow"] != 1:
        what = (
            f"connector '{name}' has stream variables and {counted(count['flow'], 'flow variable')}; it needs one"
        )
        raise ModelicaError(what, where=at)
    if count["flow"] != count["potential"]:
        flows, potentials = (
            counted(count["flow"], "flow variable"),
            counted(count["potential"], "potential variable"),
        )
        what = f"connector '{name}' has {flows}, but {potentials}; their numbers must be equal"
        raise ModelicaError(what, where=at)
