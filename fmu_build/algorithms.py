"""Algorithm sections of a model by symbolic execution: what each of their variables is at the end."""

from __future__ import annotations

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value
from fmu_build.equations import Equation
from fmu_build.expressions import Evaluator
from fmu_build.frontend import Node
from fmu_build.functions import Body, Functions
from fmu_build.graph import SX
from fmu_build.scope import ModelScope
from fmu_build.start import declared_start


class _Section:
    """Scope of a section: the section's own variables as assigned so far, everything else as in equations."""

    def __init__(self, scope: ModelScope) -> None:
        self.name = "algorithm"
        self.variables: dict[str, Value] = {}
        self._scope = scope

    def lookup(self, name: str) -> Value:
        if name in self.variables:
            return self.variables[name]
        return self._scope.lookup(name)

    def derivative(self, value: Scalar) -> Scalar:
        return self._scope.derivative(value)

    def previous(self, value: Scalar) -> Scalar:  # noqa: ARG002  (the scope's signature)
        raise ValueError("pre() in an algorithm section")

    def relation(self, difference: SX, inclusive: bool) -> SX:
        return self._scope.relation(difference, inclusive)

    def step(self, argument: SX) -> SX:
        return self._scope.step(argument)

    def sample(self, start: Scalar, interval: Scalar) -> SX:
        return self._scope.sample(start, interval)

    def initial(self) -> SX:
        return self._scope.initial()


def run(scope: ModelScope, section: Node, initial: bool) -> list[Equation]:
    """Execute a section; one equation for each scalar that it assigns.

    Parameters
    ----------
    initial
        An ``initial algorithm``: no events, and its variables start from their start values.
    """
    frame = _Section(scope)
    evaluator = Evaluator(scope.flat, frame, Functions(scope.flat))
    names = list(dict.fromkeys(output["name"] for output in section["outputs"]))
    for name in names:
        frame.variables[name] = _before(scope, name, initial)
    body = Body(scope.flat, frame, evaluator)
    if initial:
        with evaluator.no_event():
            body.run(section["statements"])
    else:
        body.run(section["statements"])
    out = []
    for name in names:
        targets = algebra.scalars(scope.declarations.values[name])
        span = scope.flat.parts["variables"][name]["source_span"]
        for target, value in zip(targets, algebra.scalars(frame.variables[name]), strict=True):
            sides = (algebra.sx(target), algebra.sx(value))
            out.append(Equation(sides[0] - sides[1], span, sides))
    return out


def _before(scope: ModelScope, name: str, initial: bool) -> Value:
    """Value of a variable when its section starts: pre(v) if discrete, else its start value."""
    whole = scope.declarations.values.get(name)
    if whole is None:
        raise ValueError(f"'{name}' cannot be assigned")

    def one(symbol: Scalar) -> Scalar:
        declared = scope.declared(algebra.sx(symbol))
        if declared is None or declared.kind not in ("continuous", "discrete"):
            raise ValueError(f"'{name}' cannot be assigned")
        if declared.kind == "discrete" and not initial:
            return scope.previous_symbol(algebra.sx(symbol))
        return declared_start(scope, declared)

    if isinstance(whole, Array):
        return Array(whole.shape, tuple(one(s) for s in whole.items))
    return one(algebra.sx(whole))
