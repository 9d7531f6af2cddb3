"""Stream connectors: what flows into a connector, and what leaves a model (specification 15.2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from fmu_build.errors import ModelicaError
from fmu_build.flat_model import Equation, Origin
from fmu_build.front.instances import Instance
from fmu_build.syntax import Binary, Call, Expression, Literal, Part, Place, Reference, Unary

Element = tuple[str, tuple[int, ...]]  # variable and index
End = tuple[Element, bool]  # seen from inside (False) or outside
_LEAST = 1e-10  # smallest weight of a flow in a mixture, so that it is defined without flow


class Streams:
    """Sets of connected stream variables.

    Attributes
    ----------
    flows
        Name of the flow variable of the connector of each stream variable.
    """

    def __init__(self) -> None:
        self._parent: dict[End, End] = {}
        self._sets: dict[End, list[End]] | None = None
        self.flows: dict[str, str] = {}

    def join(self, a: End, b: End) -> None:
        """Connect two stream variables."""
        one, other = self._find(a), self._find(b)
        if one != other:
            self._parent[other] = one

    def _find(self, end: End) -> End:
        while self._parent.setdefault(end, end) != end:
            end = self._parent[end]
        return end

    def _others(self, end: End) -> list[End]:
        if self._sets is None:
            self._sets = {}
            for one in self._parent:
                self._sets.setdefault(self._find(one), []).append(one)
        return [e for e in self._sets.get(self._find(end), []) if e != end] if end in self._parent else []

    def inside(self, element: Element, at: Place) -> Expression:
        """Return ``inStream`` of a stream variable of a connector, as seen from its component."""
        others = self._others((element, False))
        return self._mixture(others, at) if others else _reference(element, at)

    def _mixture(self, ends: list[End], at: Place) -> Expression:
        """Mean of what several ends supply, weighted with their flows."""
        values = [self.inside(element, at) if outside else _reference(element, at) for element, outside in ends]
        if len(values) == 1:
            return values[0]
        weights: list[Expression] = []
        for (name, _), outside in ends:
            flow: Expression = Reference(at, (Part(self.flows[name]),))
            supplied = flow if outside else Unary(at, "-", flow)
            weights.append(Call(at, "max", (supplied, Literal(at, _LEAST))))
        total, weight = Binary(at, "*", weights[0], values[0]), weights[0]
        for w, value in zip(weights[1:], values[1:], strict=True):
            total = Binary(at, "+", total, Binary(at, "*", w, value))
            weight = Binary(at, "+", weight, w)
        return Binary(at, "/", total, weight)

    def equations(self, places: Mapping[str, Place]) -> Iterator[Equation]:
        """Yield what leaves through each connector that is connected to the inside of its component."""
        for end in list(self._parent):
            element, outside = end
            if outside:
                at = places[element[0]]
                origin = Origin("potential", element[0].rpartition(".")[0].rpartition(".")[0])
                yield Equation(_reference(element, at), self._mixture(self._others(end), at), origin, at)


def flow_of(connector: Instance, at: Place | None) -> str:
    """Name of the only flow variable of a stream connector."""
    flows = [
        name for name, slot in connector.root.slots.items() if "flow" in getattr(slot.element, "prefixes", ())
    ]
    if len(flows) != 1:
        what = f"stream connector '{connector.path}' has {len(flows)} flow variables, not one"
        raise ModelicaError(what, where=at)
    return f"{connector.path}.{flows[0]}" if connector.path else flows[0]


def _reference(element: Element, at: Place) -> Reference:
    name, index = element
    return Reference(at, (Part(name, tuple(Literal(at, i) for i in index)),))
