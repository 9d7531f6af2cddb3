"""Constraints between states: attraction by the derivatives, so that integration errors do not accumulate.

For constraints h(x) = 0 with the Jacobian H, ``x' = f(x) - g H' (H H')^-1 h(x)`` has the same solutions as ``x' =
f(x)`` among those that fulfil them, and others approach these like exp(-g t) [U. M. Ascher, H. Chin, S. Reich,
Stabilization of DAEs and invariant manifolds, Numer. Math. 67:131-149, 1994].
"""

from __future__ import annotations

from fmu_build.algebra import sx
from fmu_build.equations import Equation
from fmu_build.graph import SX, Gradient, key
from fmu_build.scope import ModelScope
from fmu_build.sorting import MOST_SYMBOLIC, linear_solution
from fmu_build.system import System

_ATTRACTION = 10.0  # 1/s; stiff in a slow model, which the integrator can handle


def state_derivatives(system: System) -> list[SX]:
    """Return the states' derivatives, with the attraction by the invariants.

    Raises
    ------
    ModelicaError
        An invariant does not depend on states, time and parameters alone.
    """
    scope, invariants = system.scope, system.reduced.invariants
    out = {key(s.symbol): system.rewrite(s.derivative) for s in system.reduced.states}
    known = {*out, key(scope.time)}
    rows: list[tuple[SX, Gradient]] = []
    for invariant in invariants:
        value = system.rewrite(invariant.residual)
        others = [k for k in scope.graph.symbols(value) if k not in known and not scope.is_parameter(k)]
        if others:
            raise _unsupported(scope, invariant)
        rows.append((value, {k: g for k, g in scope.graph.gradient(value).items() if k in out}))
    for group in _groups([set(gradient) for _, gradient in rows]):
        if len(group) > MOST_SYMBOLIC:
            raise _unsupported(scope, invariants[group[0]])
        gradients = [rows[i] for i in group]
        products = [[sum((a[k] * b[k] for k in a if k in b), SX(0.0)) for _, b in gradients] for _, a in gradients]
        weights = linear_solution(products, [value for value, _ in gradients])
        for k in dict.fromkeys(k for _, gradient in gradients for k in gradient):
            pull = sum((g[k] * sx(w) for (_, g), w in zip(gradients, weights, strict=True) if k in g), SX(0.0))
            out[k] = out[k] - _ATTRACTION * pull
    return list(out.values())


def _unsupported(scope: ModelScope, invariant: Equation) -> Exception:
    return scope.flat.error(
        "this constraint ties states together in a way that changes while the model moves",
        invariant.at,
        "give stateSelect = StateSelect.always to those of its variables that can stay states",
    )


def _groups(sets: list[set[int]]) -> list[list[int]]:
    """Numbers of the sets that overlap, directly or through others."""
    groups: list[tuple[list[int], set[int]]] = []
    for number, touched in enumerate(sets):
        joined = [g for g in groups if g[1] & touched]
        groups = [g for g in groups if not g[1] & touched]
        groups.append(([*(i for g in joined for i in g[0]), number], touched.union(*(g[1] for g in joined))))
    return [sorted(members) for members, _ in groups]
