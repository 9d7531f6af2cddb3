"""Numbers at the default parameters and start values, for decisions that depend on them (ranks, consistency)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from fmu_build import algebra
from fmu_build.graph import SX, key
from fmu_build.near_start import consistent
from fmu_build.scope import ModelScope

_OFF = 1e-2  # relative distance of a generic point from the start values


class Point:
    """Evaluates expressions with default parameters.

    Parameters
    ----------
    scope
        The model; all its parameters must have been looked up.
    """

    def __init__(self, scope: ModelScope) -> None:
        self._scope = scope
        self._relations: dict[int, float] = {}
        self._number: dict[int, float] = {
            key(algebra.sx(declared.symbol)): value for declared, value in scope.parameters.independent
        }
        for declared, expression in scope.parameters.dependent:
            self._number[key(algebra.sx(declared.symbol))] = self.number(expression)

        # variables that depend on time alone have their values at the start
        for relation in scope.relations:
            symbols = scope.graph.symbols(relation.difference)
            if all(k == key(scope.time) or scope.is_parameter(k) for k in symbols):
                value = self.number(relation.difference)
                self._relations[key(relation.symbol)] = float(value > 0.0 or (relation.inclusive and value == 0.0))

    def number(self, expression: SX) -> float:
        """Return one expression's value."""
        return float(self.at_start([expression], {})[0])

    def generic(self, expressions: list[SX], known: Mapping[int, float] | None = None) -> np.ndarray[Any, Any]:
        """Return values at known ones of symbols, the others slightly off the start: none vanishes by chance."""
        return self._evaluate(expressions, known or {}, _OFF)

    def consistent(self, residuals: Sequence[SX], unknowns: Sequence[SX]) -> dict[int, float]:
        """Return values of unknowns slightly off the start at which equations hold; the best known ones first."""
        guesses = {key(s): (s, self._value(s, _OFF * math.sin(1.0 + i))) for i, s in enumerate(unknowns)}
        whole = ca.vertcat(*residuals)
        others = [s for s in ca.symvar(whole) if key(s) not in guesses]
        numbers = ca.vertcat(*(self._value(s, _OFF * math.sin(1.0 + i)) for i, s in enumerate(others)))
        whole = ca.substitute(whole, ca.vertcat(*others), numbers)
        return consistent(self._scope.graph, whole.elements(), guesses)

    def pieces(self, expressions: list[SX], switches: list[SX], values: Any) -> np.ndarray[Any, Any]:
        """Return values at the generic point for each row of values of some symbols, shape (rows, expressions)."""
        known = {key(s) for s in switches}
        whole = ca.vertcat(*expressions)
        others = [s for s in ca.symvar(whole) if key(s) not in known]
        numbers = [self._value(s, _OFF * math.sin(1.0 + i)) for i, s in enumerate(others)]
        function = ca.Function("f", [ca.vertcat(*switches), ca.vertcat(*others) if others else SX(0, 1)], [whole])
        return np.array([np.asarray(function(np.array(row), np.array(numbers))).ravel() for row in values])

    def at_start(self, expressions: list[SX], states: Mapping[int, SX]) -> np.ndarray[Any, Any]:
        """Return values at the start values, and at given values (expressions of parameters) of states."""
        known = {k: float(self._evaluate([v], {}, 0.0)[0]) for k, v in states.items()}
        return self._evaluate(expressions, known, 0.0)

    def _evaluate(self, expressions: list[SX], known: Mapping[int, float], off: float) -> np.ndarray[Any, Any]:
        if not expressions:
            return np.zeros(0)
        whole = ca.vertcat(*expressions)
        symbols = ca.symvar(whole)
        values = [known.get(key(s), self._value(s, off * math.sin(1.0 + i))) for i, s in enumerate(symbols)]
        function = ca.Function("f", [ca.vertcat(*symbols) if symbols else SX(0, 1)], [whole])
        return np.asarray(function(np.array(values)), dtype=float).ravel()

    def _value(self, symbol: SX, off: float) -> float:
        k = key(symbol)
        if k in self._number:
            return self._number[k]
        declared = self._scope.declared(symbol)
        if self._scope.is_starting({k}):
            return 0.0
        if k in self._relations:
            return self._relations[k]
        if declared is None or declared.kind in ("parameter", "constant"):
            return off
        start = self._scope.start_of(declared)
        value = float(start) if start.is_constant() else self.number(start)
        return value if declared.kind == "discrete" else value + off * max(1.0, abs(value))
