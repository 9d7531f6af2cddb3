"""What the runtime needs of ``spatialDistribution()``: places, initial contents and what leaves near a place."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from fmu_build.graph import SX, Substitution, key
from fmu_build.scope import Transport
from fmu_build.system import System


@dataclass(frozen=True)
class Transports:
    """All transports of a model.

    Attributes
    ----------
    symbols
        What the runtime gives: values at the outlets, their slopes, the places of these, and those of the next
        jumps.
    remembered
        What enters at both ends, and how far the contents have moved, for each transport.
    moved
        The last of these.
    points
        Where the initial contents have bends or jumps.
    profile
        Values of the contents at both ends of each interval between these, for each transport.
    at_outlets
        Replaces the values at the outlets by what leaves near the present place: derivatives follow from that.
    """

    symbols: list[SX]
    remembered: list[SX]
    moved: list[SX]
    points: list[float]
    profile: list[SX]
    at_outlets: Substitution


def transports_of(system: System) -> Transports:
    """Return the transports of a model whose equations are solved.

    Raises
    ------
    ModelicaError
        How far the contents have moved depends on an algebraic loop or on other contents.
    """
    scope = system.scope
    outlets = scope.outlets()
    unknown = {key(s) for s in system.solution.iterates} | {key(o.value) for o in outlets}
    moved = [system.rewrite(t.moved) for t in scope.transports]
    at_outlets: dict[int, SX] = {}
    for transport, place in zip(scope.transports, moved, strict=True):
        if scope.graph.symbols(place) & unknown:
            declared = scope.declared(transport.moved)
            raise scope.flat.error(
                "the x of spatialDistribution() depends on an algebraic loop or on what leaves",
                declared.at if declared else None,
                "make it a state: der(x) = velocity",
            )
        for o in transport.outlets:
            at_outlets[key(o.value)] = o.value + o.slope * (place - o.place)
    points = sorted({p for t in scope.transports for p in t.points})
    return Transports(
        [getattr(o, what) for what in ("value", "slope", "place", "jump") for o in outlets],
        [system.rewrite(e) for t in scope.transports for e in (*t.inlets, t.moved)],
        moved,
        points,
        [v for a, b in pairwise(points) for t in scope.transports for v in (_after(t, a), _before(t, b))],
        Substitution(at_outlets),
    )


def _between(transport: Transport, i: int, point: float) -> SX:
    """Value of the initial contents on the line through given points i and i + 1."""
    (a, b), (low, high) = transport.points[i : i + 2], transport.profile[i : i + 2]
    return low if point == a else high if point == b else low + (high - low) * ((point - a) / (b - a))


def _after(transport: Transport, point: float) -> SX:
    """Value just behind a point."""
    return _between(transport, max(i for i, p in enumerate(transport.points[:-1]) if p <= point), point)


def _before(transport: Transport, point: float) -> SX:
    """Value just in front of a point."""
    return _between(transport, min(i for i, p in enumerate(transport.points[1:]) if p >= point), point)
