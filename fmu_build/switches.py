"""The kinks of an event-free right-hand side.

``abs``, ``min``, ``max`` and ``noEvent`` conditions make f only piecewise smooth. An integrator that knows their
switching functions ends a step at the kink instead of approaching it with ever smaller steps. They only affect the
choice of steps: f is evaluated as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from typing import Any

import casadi as ca

_CONSTANT = (3, 4)  # arguments that are parameters, which have no kinks over time
_MOST = 200  # with more kinks than this, they are ignored
_DIFFERENCE = (ca.OP_FMIN, ca.OP_FMAX, ca.OP_LT, ca.OP_LE)
_ARGUMENT = (ca.OP_FABS, ca.OP_SIGN)


def switching_functions(derivatives: Any) -> Any:
    """Return the switching functions of a right-hand side.

    Parameters
    ----------
    derivatives
        SX function of the arguments ENV (see `fmu_build.model`) that computes dx.

    Returns
    -------
    casadi.Function
        ``model_switches`` of the same arguments; f is smooth wherever no component changes its sign.
    """
    arguments = derivatives.sx_in()
    moving = ca.vertcat(*(argument for i, argument in enumerate(arguments) if i not in _CONSTANT))
    by_hash: dict[int, Any] = {}
    for node, gate in _gated([e for result in derivatives.call(arguments) for e in result.elements()], moving):
        if node.n_dep() and node.op() in (*_DIFFERENCE, *_ARGUMENT):
            switch = node.dep(0) - node.dep(1) if node.op() in _DIFFERENCE else node.dep(0)
            if not switch.is_constant() and ca.depends_on(switch, moving):
                by_hash.setdefault(
                    switch.element_hash(), switch if gate is None else ca.if_else(gate, switch, 0.0)
                )
    chosen = list(by_hash.values()) if len(by_hash) <= _MOST else []
    return ca.Function("model_switches", arguments, [ca.densify(ca.vertcat(*chosen)) if chosen else ca.SX(0, 1)])


def _gated(results: Sequence[Any], moving: Any) -> Iterator[tuple[Any, Any | None]]:
    """Yield every node that results depend on, and the condition under which they do; None if they always do.

    What only matters in branches that are off, such as that of a law whose size is zero, has no kinks. Users of a
    node come before it.
    """
    gates: dict[int, dict[int, Any] | None] = {result.element_hash(): None for result in results}
    for node in reversed(_in_order(results)):
        gate = gates[node.element_hash()]
        yield node, None if gate is None else reduce(ca.logic_or, gate.values())
        for i in range(node.n_dep()):
            through = gate
            if (
                gate is None
                and i == 1
                and node.op() == ca.OP_IF_ELSE_ZERO
                and not ca.depends_on(node.dep(0), moving)
            ):
                through = {node.dep(0).element_hash(): node.dep(0)}
            key = node.dep(i).element_hash()
            others = gates.get(key, {})
            gates[key] = None if through is None or others is None else others | through


def _in_order(results: Sequence[Any]) -> list[Any]:
    """Return the nodes that results depend on, each after its operands."""
    ordered: list[Any] = []
    seen: set[int] = set()
    stack = [(result, False) for result in results]
    while stack:
        node, complete = stack.pop()
        if complete:
            ordered.append(node)
        elif node.element_hash() not in seen:
            seen.add(node.element_hash())
            stack.append((node, True))
            stack.extend((node.dep(i), False) for i in range(node.n_dep()))
    return ordered
