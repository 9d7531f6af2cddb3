"""A function without the branches that depend on parameters alone: the cost of a model whose laws are all off.

Added laws are ``noEvent(if abs(size) > 0 then ... else 0)``. A few dozen of them would cost a small model more
than its own equations. So its functions have a second version, called if every such condition is false.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

_FEWEST = 3  # branches that justify a second version


def without_branches(function: Any, parameters: int | None) -> tuple[Any, Any] | None:
    """Return a function for whether any branch is on, and the function without the branches.

    Parameters
    ----------
    function
        An SX function.
    parameters
        Index of the argument that does not change over a simulation.

    Returns
    -------
    tuple or None
        Two functions, the first of that argument alone; None if too few branches depend on nothing else.
    """
    if parameters is None or function.n_in() <= parameters:
        return None
    branches = _branches(function, parameters)
    if len(branches) < _FEWEST:
        return None
    arguments = function.sx_in()
    given: list[Any] = [a.nonzeros() for a in arguments]
    results: list[list[Any]] = [[ca.SX(0.0)] * function.nnz_out(k) for k in range(function.n_out())]
    as_it_is: dict[int, Any] = {}  # by register
    idle: dict[int, Any] = {}
    conditions: dict[int, Any] = {}
    for k in range(function.n_instructions()):
        op: Any = function.instruction_id(k)
        out: Any = function.instruction_output(k)
        inputs: Any = function.instruction_input(k)
        if op == ca.OP_OUTPUT:
            results[out[0]][out[1]] = idle[inputs[0]]
            continue
        if op == ca.OP_INPUT:
            value = other = given[inputs[0]][inputs[1]]
        elif op == ca.OP_CONST:
            value = other = ca.SX(function.instruction_constant(k))
        else:
            value, other = (_applied(op, [known[i] for i in inputs]) for known in (as_it_is, idle))
            condition = as_it_is[inputs[0]]
            # A value taken unless a condition holds has the negated condition.
            if k in branches and condition.op() != ca.OP_NOT:
                conditions.setdefault(condition.element_hash(), condition)
                other = ca.SX(0.0)
        as_it_is[out[0]], idle[out[0]] = value, other
    if len(conditions) < _FEWEST:
        return None
    on = ca.SX(0.0)
    for condition in conditions.values():
        on = ca.logic_or(on, condition)
    patterns = [function.sparsity_out(k) for k in range(function.n_out())]
    without = [ca.SX(p, ca.vertcat(*r)) if r else ca.SX(p) for p, r in zip(patterns, results, strict=True)]
    name = function.name()
    asked = ca.Function(f"{name}_on", [arguments[parameters]], [on])
    return asked, ca.Function(f"{name}_idle", arguments, ca.cse(without))


def _branches(function: Any, parameters: int) -> frozenset[int]:
    """Return the instructions that are branches whose condition depends on parameters alone."""
    moves: dict[int, bool] = {}  # by register
    branches: set[int] = set()
    for k in range(function.n_instructions()):
        op, inputs = function.instruction_id(k), function.instruction_input(k)
        if op == ca.OP_OUTPUT:
            continue
        if op == ca.OP_INPUT:
            moved = inputs[0] != parameters
        else:
            moved = any(moves[i] for i in inputs)
            if op == ca.OP_IF_ELSE_ZERO and not moves[inputs[0]]:
                branches.add(k)
        moves[function.instruction_output(k)[0]] = moved
    return frozenset(branches)


_BINARY = {
    ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_POW, ca.OP_CONSTPOW, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE,
    ca.OP_AND, ca.OP_OR, ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_COPYSIGN, ca.OP_IF_ELSE_ZERO, ca.OP_FMIN, ca.OP_FMAX,
    ca.OP_ATAN2, ca.OP_HYPOT,
}  # fmt: skip


def _applied(op: Any, operands: list[Any]) -> Any:
    # CasADi names the single operand of a unary operation twice.
    return ca.SX.binary(op, *operands) if op in _BINARY else ca.SX.unary(op, operands[0])
