"""The numbers that an expression can be, where conditions choose among numbers."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import casadi as ca

from fmu_build.graph import SX, fold, is_number, key

Facts = Mapping[int, bool]
"""Conditions that hold or do not, by their keys."""
_MOST = 100  # largest number of values of one expression
_ARITHMETIC = {ca.OP_ADD: operator.add, ca.OP_SUB: operator.sub, ca.OP_MUL: operator.mul}


class Possible(NamedTuple):
    """A number, and the conditions under which an expression is that number."""

    value: float
    facts: Facts


class Possibilities:
    """The possible values of expressions; each expression is examined once."""

    def __init__(self) -> None:
        self._memory: dict[int, tuple[SX, list[Possible]]] = {}

    def __call__(self, node: SX) -> list[Possible]:
        """Return the numbers that an expression can be; none if it is not a choice among a few numbers."""
        return fold(node, self._memory, _visit)

    def settled(self, node: SX, facts: Facts) -> float | None:
        """Return the number that an expression has where conditions hold; None if there may be several."""
        values = {p.value for p in self(node) if _agree(p.facts, facts)}
        return values.pop() if len(values) == 1 else None


def common(possible: Iterable[Possible]) -> Facts:
    """Return the facts on which all of some possibilities agree."""
    every = [p.facts.items() for p in possible]
    return dict(set(every[0]).intersection(*every[1:])) if every else {}


def _visit(node: SX, parts: list[list[Possible]]) -> list[Possible]:
    if is_number(node):
        return [Possible(float(node), {})]
    op = node.op() if parts else None
    if op == ca.OP_IF_ELSE_ZERO:
        truth, fact = _plain(node.dep(0))
        chosen = [Possible(p.value, {**p.facts, fact: truth}) for p in parts[1] if _agree(p.facts, {fact: truth})]
        return [*chosen, Possible(0.0, {fact: not truth})] if chosen else []
    if op == ca.OP_NEG:
        return [p._replace(value=-p.value) for p in parts[0]]
    if op not in _ARITHMETIC or len(parts[0]) * len(parts[1]) > _MOST**2:
        return []
    pairs = [(a, b) for a in parts[0] for b in parts[1] if _agree(a.facts, b.facts)]
    results = [Possible(_ARITHMETIC[op](a.value, b.value), {**a.facts, **b.facts}) for a, b in pairs]
    return results if len(results) <= _MOST else []


def _plain(condition: SX) -> tuple[bool, int]:
    """Return whether a condition is not negated, and the key of the condition without negation."""
    truth = True
    while condition.n_dep() and condition.op() == ca.OP_NOT:
        condition, truth = condition.dep(0), not truth
    return truth, key(condition)


def _agree(a: Facts, b: Facts) -> bool:
    return all(b.get(fact, truth) == truth for fact, truth in a.items())
