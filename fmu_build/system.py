"""A model whose equations are sorted and solved: the input of the later steps."""

from __future__ import annotations

from dataclasses import dataclass

from fmu_build import loops
from fmu_build.aliases import Aliases, eliminate, start_of
from fmu_build.equations import Equations
from fmu_build.graph import SX, key
from fmu_build.index_reduction import Reduced, reduce
from fmu_build.point import Point
from fmu_build.scope import ModelScope
from fmu_build.sorting import Solution, solve


@dataclass(frozen=True)
class System:
    """A reduced and solved model.

    Attributes
    ----------
    point
        Numbers at the default parameters.
    """

    scope: ModelScope
    aliases: Aliases
    reduced: Reduced
    solution: Solution
    point: Point

    def rewrite(self, expression: SX) -> SX:
        """Rewrite an expression to values known when derivatives are computed: t, x, u, p, d, z, pz, m and y."""
        return self.solution.expression(self.aliases.substitute(expression))

    def representative(self, variable: SX) -> tuple[SX, int]:
        """Symbol that represents a variable's alias group, and the variable's sign relative to it."""
        kept = self.aliases.substitute(variable)
        return (kept, 1) if kept.is_symbolic() else (-kept, -1)

    def is_state(self, symbol: SX) -> bool:
        """Whether a symbol is a state."""
        return any(key(s.symbol) == key(symbol) for s in self.reduced.states)


def solved(scope: ModelScope, equations: Equations) -> System:
    """Eliminate aliases, reduce the index, sort and solve.

    Raises
    ------
    SwitchedLoopError
        An algebraic loop has conditions that are not events, although ``smooth(0, ...)`` allows that.
    """
    aliases = eliminate(scope, equations.continuous)
    point = Point(scope)
    reduced = reduce(scope, aliases, point)

    def start(symbol: SX) -> SX | None:
        given = start_of(scope, aliases, symbol)
        return given.value if given.given else None

    solution = solve(scope, reduced, start, point, aliases.substitute)
    for loop in solution.loops:
        loops.check(scope, loop, point)
    return System(scope, aliases, reduced, solution, point)
