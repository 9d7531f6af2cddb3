# ruff: noqa: ARG005  (rules of one table share a signature)
"""Walks over CasADi SX expression graphs: symbols, exact sparse gradients, substitution.

CasADi differentiates ``if c then f else g`` into products such as ``c * f'``, which is NaN where the branch not
taken is singular. The rules here keep every branch guarded: the derivative of a conditional is the conditional of
the derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

import casadi as ca
from casadi import SX as SX

T = TypeVar("T")
Gradient = dict[int, SX]  # symbol -> partial derivative, by SX.element_hash()


def key(node: SX) -> int:
    """Identity of a scalar node; valid while the node is alive."""
    return int(node.element_hash())


# CasADi's operators look for a method ten times as long as these take.
def plus(a: SX, b: SX) -> SX:
    """Sum of two scalars."""
    return SX.binary(ca.OP_ADD, a, b)


def minus(a: SX, b: SX) -> SX:
    """Difference of two scalars."""
    return SX.binary(ca.OP_SUB, a, b)


def times(a: SX, b: SX) -> SX:
    """Product of two scalars."""
    return SX.binary(ca.OP_MUL, a, b)


def _not(condition: SX) -> SX:
    return SX.unary(ca.OP_NOT, condition)


def is_number(node: SX) -> bool:
    """Whether a scalar expression is a numeric constant."""
    return bool(node.is_constant())


def if_else_zero(condition: SX, value: SX) -> SX:
    """``condition ? value : 0``, not affected by a NaN of `value` where the condition is false."""
    if is_number(condition):
        return value if float(condition) != 0.0 else SX(0.0)
    if is_number(value) and float(value) == 0.0:
        return SX(0.0)
    return SX.binary(ca.OP_IF_ELSE_ZERO, condition, value)


def if_else(condition: SX, then: SX, otherwise: SX) -> SX:
    """``condition ? then : otherwise`` for scalars."""
    if is_number(condition):
        return then if float(condition) != 0.0 else otherwise
    if key(then) == key(otherwise):
        return then
    return plus(if_else_zero(condition, then), if_else_zero(_not(condition), otherwise))


def _guarded_min(a: SX, b: SX, da: SX | None, db: SX | None) -> list[SX]:
    takes_a = SX.binary(ca.OP_LE, a, b)
    parts = [] if da is None else [if_else_zero(takes_a, da)]
    return parts if db is None else [*parts, if_else_zero(_not(takes_a), db)]


_ONE, _MINUS = SX(1.0), SX(-1.0)
# Partial derivatives of the unary operations: f(argument, value).
_UNARY: dict[int, Callable[[SX, SX], SX]] = {
    ca.OP_NEG: lambda x, v: _MINUS,
    ca.OP_EXP: lambda x, v: v,
    ca.OP_EXPM1: lambda x, v: v + 1,
    ca.OP_LOG: lambda x, v: 1 / x,
    ca.OP_LOG1P: lambda x, v: 1 / (1 + x),
    ca.OP_SQRT: lambda x, v: 0.5 / v,
    ca.OP_SQ: lambda x, v: 2 * x,
    ca.OP_TWICE: lambda x, v: SX(2.0),
    ca.OP_INV: lambda x, v: -v * v,
    ca.OP_SIN: lambda x, v: ca.cos(x),
    ca.OP_COS: lambda x, v: -ca.sin(x),
    ca.OP_TAN: lambda x, v: 1 + v * v,
    ca.OP_ASIN: lambda x, v: 1 / ca.sqrt(1 - x * x),
    ca.OP_ACOS: lambda x, v: -1 / ca.sqrt(1 - x * x),
    ca.OP_ATAN: lambda x, v: 1 / (1 + x * x),
    ca.OP_SINH: lambda x, v: ca.cosh(x),
    ca.OP_COSH: lambda x, v: ca.sinh(x),
    ca.OP_TANH: lambda x, v: 1 - v * v,
    ca.OP_FABS: lambda x, v: ca.sign(x),
}
# The partial derivatives of the binary ones: f(first, second, value) -> (by first, by second).
_BINARY: dict[int, Callable[[SX, SX, SX], tuple[SX, SX]]] = {
    ca.OP_ADD: lambda a, b, v: (_ONE, _ONE),
    ca.OP_SUB: lambda a, b, v: (_ONE, _MINUS),
    ca.OP_MUL: lambda a, b, v: (b, a),
    ca.OP_DIV: lambda a, b, v: (1 / b, -v / b),
    ca.OP_POW: lambda a, b, v: (b * a ** (b - 1), if_else_zero(a > 0, ca.log(a) * v)),
    ca.OP_CONSTPOW: lambda a, b, v: (b * a ** (b - 1), SX(0.0)),
    ca.OP_ATAN2: lambda a, b, v: (b / (a * a + b * b), -a / (a * a + b * b)),
}
_STEPS = {ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_NOT}
_STEPS_BINARY = {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR}


class Graph:
    """Cache of the properties of the nodes in one model's expressions."""

    def __init__(self) -> None:
        self._symbols: dict[int, tuple[SX, frozenset[int]]] = {}
        self._stepped: dict[int, tuple[SX, frozenset[int]]] = {}
        self._gradients: dict[int, tuple[SX, Gradient]] = {}
        self._directions: dict[int, tuple[Mapping[int, SX], dict[int, tuple[SX, Gradient]]]] = {}
        self._structure: dict[tuple[object, ...], int] = {}
        self._structure_of: dict[int, tuple[SX, int]] = {}

    def symbols(self, node: SX) -> frozenset[int]:
        """Keys of the symbols a scalar expression depends on."""

        def visit(n: SX, parts: list[frozenset[int]]) -> frozenset[int]:
            if n.is_symbolic():
                return frozenset((key(n),))
            if len(parts) == 1:
                return parts[0]
            return frozenset().union(*parts)

        return fold(node, self._symbols, visit)

    def stepped(self, node: SX) -> frozenset[int]:
        """Keys of the symbols inside conditions and step functions, where a gradient does not show them."""

        def visit(n: SX, parts: list[frozenset[int]]) -> frozenset[int]:
            if not parts:
                return frozenset()
            op = int(n.op())
            if op in _STEPS or op in _STEPS_BINARY:
                return self.symbols(n)
            if op == ca.OP_IF_ELSE_ZERO:
                return self.symbols(n.dep(0)) | parts[1]
            return frozenset().union(*parts)

        return fold(node, self._stepped, visit)

    def same(self, node: SX) -> int:
        """Return a number that two expressions of the same structure share."""

        def visit(n: SX, parts: list[int]) -> int:
            what: tuple[object, ...]
            if n.is_symbolic():
                what = ("symbol", key(n))
            elif is_number(n):
                what = ("number", float(n))
            else:
                what = (int(n.op()), *parts)
            return self._structure.setdefault(what, len(self._structure))

        return fold(node, self._structure_of, visit)

    def gradient(self, node: SX) -> Gradient:
        """Exact partial derivatives of a scalar expression by every symbol it depends on."""

        def visit(n: SX, parts: list[Gradient]) -> Gradient:
            if n.is_symbolic():
                return {key(n): _ONE}
            if not any(parts):
                return {}
            return _chain(n, parts)

        return fold(node, self._gradients, visit)

    def directional(self, node: SX, seeds: Mapping[int, SX]) -> SX:
        """Exact derivative of a scalar expression along seeds of its symbols, with the others fixed.

        One cache is kept per seeds object, which must not change for symbols already met.
        """
        memory = self._directions.setdefault(id(seeds), (seeds, {}))[1]

        def visit(n: SX, parts: list[Gradient]) -> Gradient:
            if n.is_symbolic():
                return {0: seeds[key(n)]} if key(n) in seeds else {}
            return _chain(n, parts) if any(parts) else {}

        return fold(node, memory, visit).get(0, SX(0.0))


def fold(root: SX, memory: dict[int, tuple[SX, T]], visit: Callable[[SX, list[T]], T]) -> T:
    """Post-order walk without recursion; the memory keeps the nodes alive so that keys stay unique."""
    root_key = key(root)
    known = memory.get(root_key)
    if known is not None:
        return known[1]
    stack: list[tuple[int, SX, list[tuple[int, SX]] | None]] = [(root_key, root, None)]
    while stack:
        k, node, below = stack.pop()
        if k in memory:
            continue
        if below is None:
            deps = [node.dep(i) for i in range(node.n_dep())]
            below = [(key(d), d) for d in deps]
            missing = [(at, d) for at, d in below if at not in memory]
            if missing:
                stack.append((k, node, below))
                stack += [(at, d, None) for at, d in missing]
                continue
        memory[k] = (node, visit(node, [memory[at][1] for at, _ in below]))
    return memory[root_key][1]


def _chain(node: SX, parts: list[Gradient]) -> Gradient:
    op = int(node.op())
    deps = [node.dep(i) for i in range(node.n_dep())]
    if op in _UNARY:
        return _weighted([(_UNARY[op](deps[0], node), parts[0])])
    if op in _BINARY:
        by_a, by_b = _BINARY[op](deps[0], deps[1], node)
        return _weighted([(by_a, parts[0]), (by_b, parts[1])])
    if op in _STEPS or op in _STEPS_BINARY:
        return {}
    if op == ca.OP_IF_ELSE_ZERO:
        return {s: if_else_zero(deps[0], d) for s, d in parts[1].items()}
    if op in (ca.OP_FMIN, ca.OP_FMAX):
        a, b = deps if op == ca.OP_FMIN else (-deps[0], -deps[1])
        out: Gradient = {}
        for s in dict.fromkeys([*parts[0], *parts[1]]):
            terms = _guarded_min(a, b, parts[0].get(s), parts[1].get(s))
            out[s] = terms[0] if len(terms) == 1 else terms[0] + terms[1]
        return out
    raise NotImplementedError(f"derivative of CasADi operation {op}")


def _weighted(terms: Iterable[tuple[SX, Gradient]]) -> Gradient:
    out: Gradient = {}
    for factor, gradient in terms:
        if is_number(factor) and float(factor) == 0.0:
            continue
        one = is_number(factor) and float(factor) == 1.0
        for symbol, derivative in gradient.items():
            if one:
                term = derivative
            elif is_number(derivative) and float(derivative) == 1.0:
                term = factor
            else:
                term = times(factor, derivative)
            out[symbol] = plus(out[symbol], term) if symbol in out else term
    return {s: d for s, d in out.items() if not (is_number(d) and float(d) == 0.0)}


class Substitution:
    """A growing map from symbols to expressions, applied to any number of expressions.

    A symbol must be defined before the first expression that contains it is rewritten; sorted equations keep that
    order.
    """

    def __init__(self, mapping: Mapping[int, SX] | None = None) -> None:
        self._mapping: dict[int, SX] = dict(mapping or {})
        self._done: dict[int, tuple[SX, SX]] = {}

    def define(self, symbol: SX, expression: SX) -> None:
        """Replace `symbol` by `expression` (not rewritten itself) from now on."""
        self._mapping[key(symbol)] = expression

    def __call__(self, expression: SX) -> SX:
        """Rewrite a scalar expression."""

        def visit(n: SX, parts: list[SX]) -> SX:
            if n.is_symbolic():
                return self._mapping.get(key(n), n)
            if not parts or all(key(p) == key(n.dep(i)) for i, p in enumerate(parts)):
                return n
            return _rebuild(n, parts)

        return fold(expression, self._done, visit)


def _rebuild(node: SX, parts: list[SX]) -> SX:
    op = int(node.op())
    if op == ca.OP_IF_ELSE_ZERO:
        return if_else_zero(parts[0], parts[1])
    if len(parts) == 1:
        return SX.unary(op, parts[0])
    return SX.binary(op, parts[0], parts[1])
