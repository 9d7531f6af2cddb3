"""Which numbers an expression can be, where conditions choose among numbers."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import casadi as ca

from fmu_build.graph import SX, is_number, key

Facts = Mapping[int, bool]
"""Which conditions hold, by their keys."""
_MOST = 100  # numbers of one expression
_ARITHMETIC = {ca.OP_ADD: operator.add, ca.OP_SUB: operator.sub, ca.OP_MUL: operator.mul}


class Possible(NamedTuple):
    """A number, and the conditions under which an expression is that number."""

    value: float
    facts: Facts


def possible(node: SX) -> list[Possible]:
    """Return the numbers that an expression can be; none if it is not a choice among a few numbers."""
    if is_number(node):
        return [Possible(float(node), {})]
    op = node.op() if node.n_dep() else None
    if op == ca.OP_IF_ELSE_ZERO:
        truth, fact = _plain(node.dep(0))
        chosen = _under(fact, truth, possible(node.dep(1)))
        return [*chosen, Possible(0.0, {fact: not truth})] if chosen else []
    if op == ca.OP_NEG:
        return [p._replace(value=-p.value) for p in possible(node.dep(0))]
    if op not in _ARITHMETIC:
        return []
    pairs = ((a, b) for a in possible(node.dep(0)) for b in possible(node.dep(1)) if _agree(a.facts, b.facts))
    found = [Possible(_ARITHMETIC[op](a.value, b.value), {**a.facts, **b.facts}) for a, b in pairs]
    return found if len(found) <= _MOST else []


def settled(node: SX, facts: Facts) -> float | None:
    """Return the number that an expression is where conditions hold; None if it may be several."""
    values = {p.value for p in possible(node) if _agree(p.facts, facts)}
    return values.pop() if len(values) == 1 else None


def common(left: Iterable[Possible]) -> Facts:
    """Return the facts on which all of some possibilities agree."""
    every = [p.facts.items() for p in left]
    return dict(set(every[0]).intersection(*every[1:])) if every else {}


def _plain(condition: SX) -> tuple[bool, int]:
    """Return whether a condition is one, or the opposite of one, and the key of that one."""
    truth = True
    while condition.n_dep() and condition.op() == ca.OP_NOT:
        condition, truth = condition.dep(0), not truth
    return truth, key(condition)


def _under(fact: int, truth: bool, found: Iterable[Possible]) -> list[Possible]:
    return [Possible(p.value, {**p.facts, fact: truth}) for p in found if p.facts.get(fact, truth) == truth]


def _agree(a: Facts, b: Facts) -> bool:
    return all(b.get(fact, truth) == truth for fact, truth in a.items())
