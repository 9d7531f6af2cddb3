"""Algorithm sections of a model by symbolic execution: the final value of each of their variables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value
from fmu_build.equations import Equation
from fmu_build.expressions import Evaluator
from fmu_build.flat_model import Algorithm
from fmu_build.functions import Body
from fmu_build.graph import SX
from fmu_build.scope import ModelScope
from fmu_build.syntax import Assign, AssignMany, Reinit, Terminate, walk


class _Section:
    """Scope of a section: its own variables as assigned so far, everything else as in equations."""

    def __init__(self, scope: ModelScope) -> None:
        self.name = "algorithm"
        self.variables: dict[str, Value] = {}
        self._scope = scope
        self._outside = False

    def lookup(self, name: str) -> Value:
        if name in self.variables and not self._outside:
            value = self.variables[name]
            if value is None:
                raise algebra.UnsetError(name)
            return value
        return self._scope.lookup(name)

    @contextmanager
    def outside(self) -> Iterator[None]:
        """Look up variables as equations see them."""
        before, self._outside = self._outside, True
        try:
            yield
        finally:
            self._outside = before

    def fires(self, conditions: Iterable[SX]) -> SX:
        return self._scope.fires(conditions)

    def held_since(self, fires: SX, condition: SX) -> SX:
        return self._scope.held_since(fires, condition)

    def derivative(self, value: Scalar) -> Scalar:
        return self._scope.derivative(value)

    def previous(self, value: Scalar) -> Scalar:
        return self._scope.previous(value)

    def relation(self, difference: SX, inclusive: bool) -> SX:
        return self._scope.relation(difference, inclusive)

    def step(self, argument: SX) -> SX:
        return self._scope.step(argument)

    def sample(self, start: Scalar, interval: Scalar) -> SX:
        return self._scope.sample(start, interval)

    def delay(self, value: Scalar, time: Scalar) -> Scalar:
        return self._scope.delay(value, time)

    def transport(
        self, inlets: tuple[SX, SX], moved: SX, points: Sequence[float], profile: Sequence[SX]
    ) -> tuple[SX, SX]:
        return self._scope.transport(inlets, moved, points, profile)

    def is_fixed(self, value: SX) -> bool:
        return self._scope.is_fixed(value)

    def initial(self) -> SX:
        return self._scope.initial()

    def starting(self) -> SX:
        return self._scope.starting()


def run(scope: ModelScope, section: Algorithm, initial: bool) -> list[Equation]:
    """Execute a section; return one equation for each scalar that it assigns.

    Parameters
    ----------
    initial
        An ``initial algorithm``: no events, and its variables start from their start values.
    """
    frame = _Section(scope)
    evaluator = Evaluator(scope.flat, frame, scope.functions)
    names: dict[str, None] = {}
    for node in walk(section.statements):
        if isinstance(node, Assign):
            names[node.target.name] = None
        elif isinstance(node, AssignMany):
            names.update({t.name: None for t in node.targets if t is not None})
        elif isinstance(node, Terminate | Reinit):
            raise scope.flat.error(f"{type(node).__name__.lower()}() in an algorithm is not supported", node.at)
    for name in names:
        try:
            frame.variables[name] = _before(scope, name, initial)
        except ValueError as error:
            raise scope.flat.error(str(error), section.at) from None
    body = Body(scope.flat, frame, evaluator, scope.functions)
    if initial:
        with evaluator.no_event():
            body.run(section.statements)
    else:
        body.run(section.statements)
    out = []
    for name in names:
        whole = _whole(scope, name)
        for target, value in zip(algebra.scalars(whole), _items(frame.variables[name], whole), strict=True):
            sides = (algebra.sx(target), algebra.sx(value))
            out.append(Equation(sides[0] - sides[1], section.at, sides, target=sides[0]))
    return out


def _items(value: Value, like: Value) -> tuple[Scalar, ...]:
    items = algebra.scalars(value)
    return items * len(algebra.scalars(like)) if len(items) == 1 else items


def _whole(scope: ModelScope, name: str) -> Value:
    value = scope.declarations.values.get(name)
    return scope.lookup(name) if value is None else value


def _before(scope: ModelScope, name: str, initial: bool) -> Value:
    """Value of a variable when its section starts: pre(v) if discrete, otherwise its start value."""
    if name not in scope.flat.variables and not any(n.startswith(f"{name}.") for n in scope.flat.variables):
        raise ValueError(f"'{name}' cannot be assigned")

    def one(symbol: Scalar) -> Scalar:
        declared = scope.declared(algebra.sx(symbol))
        if declared is not None and initial and any(declared is d for d in scope.parameters.from_initial):
            return scope.start_of(declared)
        if declared is None or declared.kind not in ("continuous", "discrete"):
            raise ValueError(f"'{name}' cannot be assigned")
        if declared.kind == "discrete" and not initial:
            return scope.previous_symbol(algebra.sx(symbol))
        return scope.start_of(declared)

    def each(value: Value) -> Value:
        if isinstance(value, dict):
            return {n: each(v) for n, v in value.items()}
        if isinstance(value, Array):
            return Array(value.shape, tuple(one(s) for s in value.items))
        return one(algebra.sx(value))

    return each(_whole(scope, name))
