"""Algebraic loops with limiters: a unique solution, several between which the history decides, or an error.

A piecewise linear system has a unique solution for every input if the determinants of its pieces have the same
sign. Otherwise (a limiter with positive feedback, as in a Schmitt trigger) it may have several. Then its pieces
must be modes that change at events, so that a solution persists as long as it exists.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, product

import casadi as ca
import numpy as np

from fmu_build.graph import SX, Graph, fold, key
from fmu_build.point import Point
from fmu_build.scope import ModelScope
from fmu_build.syntax import Place

_MOST = 256  # combinations of switches to try


@dataclass(frozen=True)
class Loop:
    """An algebraic loop: iteration variables, the residuals that determine them, and where they come from."""

    iterates: list[SX]
    residuals: list[SX]
    at: Place


class SwitchedLoopError(Exception):
    """A loop with conditions that may become (more) events."""


def check(scope: ModelScope, loop: Loop, point: Point) -> None:
    """Refuse a loop with several solutions if nothing determines which one applies.

    Raises
    ------
    SwitchedLoopError
        It may have conditions that may become (more) events.
    ModelicaError
        It may have none that may.
    """
    inside = {key(y) for y in loop.iterates}
    evaluate = scope.evaluate
    stepped = any(scope.graph.stepped(r) & inside for r in loop.residuals)
    if stepped and evaluate.smoothed and not evaluate.events_in_smooth:
        raise SwitchedLoopError
    switches = _Switches(scope.graph, inside)
    residuals = [switches.replaced(r) for r in loop.residuals]
    if not switches.odd and len(signs(scope.graph, residuals, loop.iterates, switches.symbols, point) - {0.0}) > 1:
        if evaluate.smoothed and evaluate.events_in_smooth != "all":
            raise SwitchedLoopError
        raise scope.flat.error(
            f"the loop of {', '.join(y.name() for y in loop.iterates)} has several solutions (positive feedback)",
            loop.at,
            "write its limits as if-expressions without noEvent, min and max: events choose between the solutions",
        )


def signs(
    graph: Graph, residuals: Sequence[SX], unknowns: Sequence[SX], switches: list[SX], point: Point
) -> set[float]:
    """Signs of the determinant of a piecewise linear system at the default parameters; none if not linear.

    Parameters
    ----------
    switches
        Symbols that are 0 or 1.
    """
    inside = {key(y) for y in unknowns}
    gradients = [graph.gradient(r) for r in residuals]
    rows = [[g.get(key(y), SX(0.0)) for y in unknowns] for g in gradients]
    if not switches or any(graph.symbols(entry) & inside for row in rows for entry in row):
        return set()
    values = list(islice(product((0.0, 1.0), repeat=len(switches)), _MOST))
    signs = set()
    for flat in point.pieces([entry for row in rows for entry in row], switches, values):
        matrix = flat.reshape(len(rows), len(rows))
        size = np.abs(matrix).max(axis=1, keepdims=True)
        sign, log = np.linalg.slogdet(matrix / np.where(size > 0.0, size, 1.0))
        signs.add(float(sign) if log > -30.0 else 0.0)
    return signs


class _Switches:
    """Replaces choices between pieces by symbols that are 0 or 1."""

    def __init__(self, graph: Graph, inside: set[int]) -> None:
        self._graph = graph
        self._inside = inside
        self._of: dict[int, SX] = {}
        self._done: dict[int, tuple[SX, SX]] = {}
        self.odd = False  # whether it contains a step

    @property
    def symbols(self) -> list[SX]:
        return list(self._of.values())

    def replaced(self, expression: SX) -> SX:
        return fold(expression, self._done, self._visit)

    def _visit(self, node: SX, parts: list[SX]) -> SX:
        if not parts or not self._graph.symbols(node) & self._inside:
            return node
        op = int(node.op())
        if op in _PIECES:
            condition = self._condition(node.dep(0)) if op == ca.OP_IF_ELSE_ZERO else self._symbol(node)
            return _PIECES[op](condition, parts)
        self.odd |= op in (ca.OP_FLOOR, ca.OP_CEIL, ca.OP_SIGN)
        return SX.unary(op, parts[0]) if len(parts) == 1 else SX.binary(op, parts[0], parts[1])

    def _symbol(self, node: SX) -> SX:
        return self._of.setdefault(self._graph.same(node), SX.sym("switch"))

    def _condition(self, condition: SX) -> SX:
        if not self._graph.symbols(condition) & self._inside:
            return condition
        if int(condition.op()) == ca.OP_NOT:
            return 1 - self._condition(condition.dep(0))
        return self._symbol(condition)


_PIECES: Mapping[int, Callable[[SX, list[SX]], SX]] = {
    ca.OP_IF_ELSE_ZERO: lambda c, parts: c * parts[1],
    ca.OP_FMIN: lambda c, parts: c * parts[0] + (1 - c) * parts[1],
    ca.OP_FMAX: lambda c, parts: c * parts[0] + (1 - c) * parts[1],
    ca.OP_FABS: lambda c, parts: (2 * c - 1) * parts[0],
}
