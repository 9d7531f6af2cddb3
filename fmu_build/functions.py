# ruff: noqa: ARG002  (a function's scope refuses what a model's scope offers)
"""Modelica functions by symbolic execution of their algorithms.

If a condition is only known at run time, both branches are executed and merged; a ``return`` or ``break`` under
such a condition is a flag that later statements check.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
from typing import Any, Protocol

import casadi as ca

from fmu_build import algebra, random_numbers, tables
from fmu_build.algebra import Array, Scalar, Value, whole
from fmu_build.errors import IndexOutsideError, ModelicaError
from fmu_build.expressions import Evaluator, Scope
from fmu_build.flat_model import Formal, Function
from fmu_build.graph import SX
from fmu_build.messages import Message, message
from fmu_build.possible import Possibilities, common
from fmu_build.syntax import (
    Assert,
    Assign,
    AssignMany,
    Break,
    Call,
    Expression,
    ForStatement,
    IfStatement,
    Literal,
    Part,
    Place,
    Reference,
    Return,
    Statement,
    WhenStatement,
    WhileStatement,
    references,
    walk,
)

_EXTERNAL = tables.EXTERNAL | random_numbers.EXTERNAL
# The same where outputs have values before: places of the arguments that count. Results are those of the function.
_IN_PLACE: dict[str, tuple[tuple[int, ...], Callable[..., Value]]] = {
    "dgesv": ((2, 5), lambda a, b: (algebra.solve(a, b), 0)),  # LAPACK
}
_MAX_ROUNDS = 100_000  # of a while loop with a condition known at translation
_MAX_UNKNOWN_ROUNDS = 100  # of one whose condition is unknown
_MOST_UNKNOWN_ROUNDS = 3000  # of all of them, because nested loops multiply
_DONE, _LEFT = "(returned)", "(left the loop)"


class Library(Protocol):
    """Source of a model's functions and of its errors."""

    @property
    def functions(self) -> Mapping[str, Function]:
        """By name."""

    def error(self, what: str, at: Place | None, fix: str | None = None) -> ModelicaError:
        """Make the error for a construct at a place."""


class _Frame:
    """Scope of one call: inputs, outputs and local variables; no model variables, no events."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.variables: dict[str, Value] = {}

    def lookup(self, name: str) -> Value:
        value = self.variables[name]
        if value is None:
            raise algebra.UnsetError(name)
        return value

    def derivative(self, value: Scalar) -> Scalar:
        raise ValueError("der() is not allowed in a function")

    def previous(self, value: Scalar) -> Scalar:
        raise ValueError("pre() is not allowed in a function")

    def relation(self, difference: SX, inclusive: bool) -> SX:
        raise AssertionError("functions are evaluated without events")

    def step(self, argument: SX) -> SX:
        raise AssertionError("functions are evaluated without events")

    def sample(self, start: Scalar, interval: Scalar) -> SX:
        raise ValueError("sample() is not allowed in a function")

    def delay(self, value: Scalar, time: Scalar) -> Scalar:
        raise ValueError("delay() is not allowed in a function")

    def transport(self, *_: object) -> tuple[SX, SX]:
        raise ValueError("spatialDistribution() is not allowed in a function")

    def is_fixed(self, value: SX) -> bool:
        raise AssertionError("functions are evaluated without events")

    def initial(self) -> SX:
        raise ValueError("initial() is not allowed in a function")

    def starting(self) -> SX:
        raise ValueError("homotopy() is not allowed in a function")


class Functions:
    """The functions of a model; calling it evaluates a call with evaluated arguments.

    Attributes
    ----------
    asserts
        Assertions of functions at run time: condition, message, whether it is a warning, place.
    guards
        Conditions under which the current evaluation matters.
    by_parameters
        Returns the parameters that determine a condition, if nothing else does, because they can become constants
        of the translation. A loop of unknown length that depends on other variables is followed for a number of
        rounds, and its end is asserted at run time.
    unknown_rounds
        Number of rounds of such loops so far.
    possible
        Which numbers expressions can be.
    """

    def __init__(self, library: Library) -> None:
        self._library = library
        self._depth = 0
        self.by_parameters: Callable[[SX], Collection[str]] = lambda _: ()
        self.unknown_rounds = 0
        self.possible = Possibilities()
        self.guards: list[SX] = []
        self.asserts: list[tuple[SX, Message, bool, Place]] = []

    def __call__(self, name: str, arguments: Sequence[Value]) -> Value:
        """Return the result (a tuple if the function has several outputs) of a call."""
        function = self._library.functions.get(name)
        if function is None:
            raise ValueError(f"function '{name}' is not supported")
        if not function.pure and not (function.external and function.external[0] in _EXTERNAL):
            for guard in self.guards:  # if only parameters decide on the call, they become constants
                raise algebra.UnknownSizeError(guard, f"impure function '{function.name}' is not supported")
            raise ValueError(f"impure function '{function.name}' is not supported")
        return self._vectorised(function, list(arguments))

    def _vectorised(self, function: Function, arguments: list[Value]) -> Value:
        pairs = list(zip(function.inputs, arguments, strict=False))
        shapes = [_outer_shape(formal, actual) for formal, actual in pairs]
        outer = next((shape for shape in shapes if shape is not None), None)
        if outer is not None:
            parts = []
            for number in range(math.prod(outer)):
                row = list(arguments)
                for k, shape in enumerate(shapes):
                    if shape == outer:
                        row[k] = _element(arguments[k], number, outer)
                parts.append(self._vectorised(function, row))
            return _stacked(outer, parts)
        if self._depth > 50:
            raise ValueError(f"function '{function.name}' calls itself endlessly")
        self._depth += 1
        try:
            return self._run(function, arguments)
        finally:
            self._depth -= 1

    def _run(self, function: Function, arguments: list[Value]) -> Value:
        frame = _Frame(function.name)
        evaluator = Evaluator(self._library, frame, self)
        with evaluator.no_event():
            if function.constructor:
                self._constants(function, frame, evaluator)
            for position, formal in enumerate(function.inputs):
                given = arguments[position] if position < len(arguments) else None
                if given is not None:
                    frame.variables[formal.name] = None if given is algebra.UNSET else given
                elif formal.default is not None:
                    frame.variables[formal.name] = evaluator(formal.default)
                elif formal.fields is not None:
                    frame.variables[formal.name] = self._initial(formal, evaluator)
                elif function.constructor:
                    frame.variables[formal.name] = 0.0
                else:
                    raise ValueError(f"function '{function.name}' lacks its argument '{formal.name}'")
            if function.external is not None:
                return self._external(function, frame, evaluator)
            self._begin(function, frame, evaluator)
            if function.constructor:
                return dict(frame.variables)
            body = Body(self._library, frame, evaluator, self)
            frame.variables[_DONE] = False
            body.run(function.body)
            results = tuple(frame.lookup(o.name) for o in function.outputs)
        return results[0] if len(results) == 1 else results

    @staticmethod
    def _constants(function: Function, frame: _Frame, evaluator: Evaluator) -> None:
        """Evaluate the constants of a record, which the defaults of its other fields may use."""
        for formal in function.locals:
            if formal.default is not None and not any(references(formal.default)):
                frame.variables[formal.name] = evaluator(formal.default)

    def _begin(self, function: Function, frame: _Frame, evaluator: Evaluator) -> None:
        for formal in (*function.outputs, *function.locals):
            frame.variables[formal.name] = self._initial(formal, evaluator)

    def _external(self, function: Function, frame: _Frame, evaluator: Evaluator) -> Value:
        """Call the substitute of a C function; arguments of it that are outputs take its results in order."""
        assert function.external is not None
        name, arguments, _ = function.external
        if name in _IN_PLACE:
            self._begin(function, frame, evaluator)
            places, substitute = _IN_PLACE[name]
            return substitute(*(evaluator(arguments[k]) for k in places))
        if name not in _EXTERNAL:
            raise ValueError(f"external function '{function.name}' is not supported")
        outputs = [o.name for o in function.outputs]
        given = [a for a in arguments if not (isinstance(a, Reference) and a.name in outputs)]
        result = _EXTERNAL[name](*map(evaluator, given))
        if len(given) == len(arguments):
            return result
        taking = [a.name for a in arguments if isinstance(a, Reference) and a.name in outputs]
        by_name = dict(zip(taking, result if isinstance(result, tuple) else (result,), strict=True))
        results = tuple(by_name[output] for output in outputs)
        return results[0] if len(results) == 1 else results

    def _initial(self, formal: Formal, evaluator: Evaluator) -> Value:
        if formal.default is not None:
            return evaluator(formal.default)
        shape = [0 if size is None else whole(evaluator(size)) for size in formal.shape]  # it may grow
        if formal.fields is not None:
            record: dict[str, Value] = {}
            for field in formal.fields:
                record[field.name] = self._initial(field, evaluator)
            if shape:
                return _stacked(tuple(shape), [_with_gaps(record)] * math.prod(shape))
            return record
        if not shape:
            return None
        # Entries are assigned one by one; one that never is stays NaN, so that it shows.
        return Array.fill(shape, float("nan"))


class Frame(Scope, Protocol):
    """A scope with variables that statements assign."""

    name: str
    variables: dict[str, Value]


class Body:
    """Runs statements on a frame."""

    def __init__(self, library: Library, frame: Frame, evaluator: Evaluator, functions: Functions) -> None:
        self._library = library
        self._frame = frame
        self._evaluate = evaluator
        self._functions = functions

    def run(self, statements: Sequence[Statement]) -> None:
        """Execute statements in order."""
        for statement in statements:
            stopped = self._stopped()
            if not isinstance(stopped, SX):
                if stopped:
                    return
                self._execute(statement)
                continue
            before = dict(self._frame.variables)
            with self._evaluate.guard(ca.logic_not(stopped)):
                self._execute(statement)
            after = self._frame.variables
            self._frame.variables = self._chosen(stopped, before, after)

    def _stopped(self) -> Scalar:
        variables = self._frame.variables
        done, left = variables.get(_DONE, False), variables.get(_LEFT, False)
        assert isinstance(done, bool | int | float | SX)
        assert isinstance(left, bool | int | float | SX)
        if not isinstance(done, SX) and not isinstance(left, SX):
            return bool(done) or bool(left)
        return algebra.OR(done, left)

    @staticmethod
    def _chosen(condition: Scalar, then: dict[str, Value], otherwise: dict[str, Value]) -> dict[str, Value]:
        return {
            name: algebra.choose(condition, then.get(name), value) if then.get(name) is not value else value
            for name, value in otherwise.items()
        }

    def _execute(self, statement: Statement) -> None:
        match statement:
            case Assign():
                self._assign(statement.target, self._evaluate(statement.value))
            case AssignMany():
                self._assign_many(statement)
            case IfStatement():
                self._branch(list(statement.branches))
            case ForStatement():
                self._for(statement)
            case WhileStatement():
                self._while(statement)
            case WhenStatement():
                self._when(statement)
            case Return() | Break():
                self._frame.variables[_DONE if isinstance(statement, Return) else _LEFT] = True
            case Assert():
                self._assert(statement)
            case _:
                raise self._library.error(
                    f"{type(statement).__name__.lower()} is not supported here", statement.at
                )

    def _assign_many(self, statement: AssignMany) -> None:
        result = self._evaluate(statement.call)
        results = result if isinstance(result, tuple) else (result,)
        for target, value in zip(statement.targets, results, strict=False):
            if target is not None:
                self._assign(target, value)

    def _branch(self, branches: list[tuple[Expression | None, tuple[Any, ...]]]) -> None:
        if not branches:
            return
        (test, statements), *rest = branches
        condition: Scalar = True if test is None else self._evaluate.scalar(test)
        if not isinstance(condition, SX):
            if condition:
                self.run(statements)
            else:
                self._branch(rest)
            return
        before = dict(self._frame.variables)
        error = self._error_of(statements)
        if error is not None:  # what the branch prepares is only for the message
            self._never(condition, message(self._evaluate, error), statements[-1].at)
            statements = ()
        with self._evaluate.guard(condition):
            self.run(statements)
        then = self._frame.variables
        self._frame.variables = before
        with self._evaluate.guard(ca.logic_not(condition)):
            self._branch(rest)
        after = self._frame.variables
        for name in then.keys() - after.keys():
            after[name] = None
        self._frame.variables = self._chosen(condition, then, after)

    def _for(self, statement: ForStatement) -> None:
        outer = self._frame.variables.get(_LEFT, False)
        self._frame.variables[_LEFT] = False
        self._loop(list(statement.iterators), statement.body)
        self._frame.variables[_LEFT] = outer

    def _loop(self, iterators: list[tuple[str, Expression | None]], statements: Sequence[Any]) -> None:
        if not iterators:
            self.run(statements)
            return
        (name, bounds), *rest = iterators
        assert bounds is not None
        for i in algebra.scalars(self._evaluate(bounds)):
            stopped = self._stopped()
            if not isinstance(stopped, SX) and stopped:
                return
            with self._evaluate.iterator(name, i):
                self._loop(rest, statements)

    def _while(self, statement: WhileStatement) -> None:
        """Follow the path on which the loop continues, and merge the states in which it may have ended.

        On that path a counter keeps its number, so that a bound on it ends the loop.
        """
        outer = self._frame.variables.get(_LEFT, False)
        self._frame.variables[_LEFT] = False
        ends: list[tuple[SX, dict[str, Value]]] = []
        changed = {a.target.parts[0].name for a in walk(statement.body) if isinstance(a, Assign)}
        counters = changed & {r.parts[0].name for r in references(statement.condition)}
        lost = False  # whether the rounds are no longer counted
        with ExitStack() as path:
            for _ in range(_MAX_ROUNDS):
                stopped = self._stopped()
                if not isinstance(stopped, SX) and stopped:
                    break
                condition = self._condition(statement, ends)
                if not isinstance(condition, SX) and not condition:
                    break
                if isinstance(condition, SX) or isinstance(stopped, SX):
                    goes_on = algebra.sx(algebra.AND(condition, algebra.NOT(stopped)))
                    ends.append((goes_on, dict(self._frame.variables)))
                    if (lost and self._functions.by_parameters(goes_on)) or len(ends) > _MAX_UNKNOWN_ROUNDS:
                        self._bound(goes_on, statement.at)
                        break
                    path.enter_context(self._evaluate.guard(goes_on))
                    lost = self._narrow(statement, counters)
                    self._frame.variables[_LEFT] = False
                    if isinstance(self._frame.variables.get(_DONE), SX):
                        self._frame.variables[_DONE] = False
                self.run(statement.body)
            else:
                raise self._library.error("a while loop that does not end", statement.at)
        for goes_on, state in reversed(ends):
            self._frame.variables = self._chosen(goes_on, self._frame.variables, state)
        self._frame.variables[_LEFT] = outer

    def _condition(self, statement: WhileStatement, ends: Sequence[Any]) -> Scalar:
        """Evaluate the condition of a loop; where an index leaves its array, the loop must have ended earlier."""
        try:
            return self._evaluate.scalar(statement.condition)
        except IndexOutsideError as error:
            if not ends:
                raise
            self._never(algebra.sx(True), (f"a while loop goes on where {error.what}",), statement.at)
            return False

    def _narrow(self, statement: WhileStatement, counters: Collection[str]) -> bool:
        """Give variables the numbers that they must have where a loop continues.

        `counters` are the variables that the loop changes and its condition reads; returns whether none is a
        number.
        """
        variables, possible = self._frame.variables, self._functions.possible
        facts: dict[int, bool] = {}
        for name in counters:
            value = variables.get(name)
            if isinstance(value, SX):
                held = [p for p in possible(value) if self._may_go_on(statement, name, p.value)]
                facts |= common(held)
                if len({p.value for p in held}) == 1:
                    variables[name] = _number(held[0].value)
        for name, value in variables.items() if facts else ():
            if isinstance(value, SX) and (number := possible.settled(value, facts)) is not None:
                variables[name] = _number(number)
        return bool(counters) and all(isinstance(variables.get(name), SX) for name in counters)

    def _may_go_on(self, statement: WhileStatement, name: str, value: float) -> bool:
        before = self._frame.variables
        self._frame.variables = {**before, name: _number(value)}
        try:
            condition = self._evaluate.scalar(statement.condition)
        except IndexOutsideError:
            return False
        finally:
            self._frame.variables = before
        return isinstance(condition, SX) or bool(condition)

    def _bound(self, goes_on: SX, at: Place) -> None:
        """Stop following a loop; if it continues, the simulation ends."""
        functions = self._functions
        functions.unknown_rounds += _MAX_UNKNOWN_ROUNDS
        if functions.by_parameters(goes_on):
            raise algebra.UnknownSizeError(goes_on, "a while loop whose condition is not known at translation")
        if functions.unknown_rounds > _MOST_UNKNOWN_ROUNDS:
            raise self._library.error(
                "while loops of unknown length inside each other", at,
                "bound them by counters, or write for loops with an if inside",
            )  # fmt: skip
        self._never(goes_on, (f"a while loop goes on for more than {_MAX_UNKNOWN_ROUNDS} rounds",), at)

    def _error_of(self, statements: Sequence[Statement]) -> Expression | None:
        """Message of ``assert(false, ...)`` if that ends the statements, also in a function; otherwise None."""
        last = statements[-1] if statements else None
        if isinstance(last, Assert):
            never = isinstance(last.condition, Literal) and last.condition.value is False and not last.warning
            return last.message if never else None
        call = last.call if isinstance(last, AssignMany) and not last.targets else None
        function = self._library.functions.get(call.function) if isinstance(call, Call) else None
        if not isinstance(call, Call) or function is None or len(call.arguments) != 1:
            return None
        return call.arguments[0] if self._error_of(function.body) is not None else None

    def _never(self, condition: SX, what: Message, at: Place) -> None:
        """Assert that a condition does not hold where this evaluation matters."""
        holds = ca.logic_not(condition)
        for guard in self._functions.guards:
            holds = ca.logic_or(holds, ca.logic_not(guard))
        self._functions.asserts.append((holds, what, False, at))

    def _when(self, statement: WhenStatement) -> None:
        fires, held_since = (getattr(self._frame, name, None) for name in ("fires", "held_since"))
        if fires is None or held_since is None:
            raise self._library.error("when is not allowed in a function", statement.at)
        branches: list[tuple[SX, tuple[Any, ...]]] = []
        earlier = SX(0.0)
        for test, statements in statement.branches:
            conditions = [algebra.sx(c) for c in algebra.scalars(self._evaluate(test))]
            now = ca.logic_and(fires(conditions), ca.logic_not(earlier))
            earlier = ca.logic_or(earlier, now)
            branches.append((now, statements))
        for now, statements in branches:
            before = dict(self._frame.variables)
            asserts, self._functions.asserts = self._functions.asserts, []
            with self._evaluate.guard(now), self._evaluate.no_event():
                self.run(statements)
            held = [(held_since(now, holds), *rest) for holds, *rest in self._functions.asserts]
            self._functions.asserts = [*asserts, *held]
            self._frame.variables = self._chosen(now, self._frame.variables, before)

    def _assert(self, statement: Assert) -> None:
        condition = self._evaluate.scalar(statement.condition)
        guards = self._functions.guards
        if not isinstance(condition, SX):
            if condition:
                return
            if not guards:
                shown = self._evaluate(statement.message)
                if statement.warning:
                    return
                raise self._library.error(f"assertion in function '{self._frame.name}': {shown}", statement.at)
        holds = algebra.sx(condition)
        for guard in guards:
            holds = ca.logic_or(ca.logic_not(guard), holds)
        text = message(self._evaluate, statement.message)
        self._functions.asserts.append((holds, text, statement.warning, statement.at))

    def _assign(self, target: Reference, value: Value) -> None:
        name = target.parts[0].name
        if name not in self._frame.variables:
            raise self._library.error(f"'{target.name}' cannot be assigned here", target.at)
        self._frame.variables[name] = self._put(self._frame.variables[name], target.parts, value, target)

    def _put(self, old: Value, parts: tuple[Part, ...], value: Value, target: Reference) -> Value:
        """Return a variable with a part of it replaced."""
        first, *rest = parts
        if first.subscripts:
            if isinstance(old, dict):  # an array of records is a record of arrays
                if rest:
                    name = rest[0].name
                    inner = (Part(name, first.subscripts), *rest[1:])
                    return {**old, name: self._put(old.get(name), inner, value, target)}
                assert isinstance(value, dict)
                return {n: self._put(old[n], (Part(n, first.subscripts),), value[n], target) for n in old}
            if not isinstance(old, Array) or rest:
                raise self._library.error(f"subscripts on {algebra.kind(old)}", target.at)
            return _replace(old, self._evaluate.subscripts(old, first.subscripts), value)
        if rest:
            fields = dict(old) if isinstance(old, dict) else {}
            name = rest[0].name
            return {**fields, name: self._put(fields.get(name), tuple(rest), value, target)}
        if isinstance(old, Array) and not isinstance(value, Array) and isinstance(value, bool | int | float | SX):
            raise self._library.error(f"a scalar is assigned to '{target.name}', which is an array", target.at)
        return value


def _with_gaps(value: Value) -> Value:
    """Value with NaN where there is none yet, so that an entry that is never assigned shows."""
    if isinstance(value, dict):
        return {name: _with_gaps(part) for name, part in value.items()}
    return float("nan") if value is None else value


def _outer_shape(formal: Formal, actual: Value) -> tuple[int, ...] | None:
    """Shape of an argument for whose elements a function is called one by one; None for a plain argument."""
    if formal.shape:
        return None
    if formal.fields is None:
        return actual.shape if isinstance(actual, Array) else None
    if not formal.fields or not isinstance(actual, dict):
        return None
    field = formal.fields[0]
    value = actual.get(field.name)
    if isinstance(value, Array):
        return value.shape[: len(value.shape) - len(field.shape)] or None
    return _outer_shape(replace(field, shape=()), value)


def _element(value: Value, number: int, outer: tuple[int, ...]) -> Value:
    """One element of an array, or of an array of records, which is a record of arrays."""
    if isinstance(value, dict):
        return {name: _element(part, number, outer) for name, part in value.items()}
    if not isinstance(value, Array):
        return value
    shape = value.shape[len(outer) :]
    size = math.prod(shape)
    items = value.items[number * size : (number + 1) * size]
    return Array(shape, items) if shape else items[0]


def _stacked(outer: tuple[int, ...], parts: Sequence[Value]) -> Value:
    """Results for the elements of an array, as an array or a record of arrays."""
    if parts and isinstance(parts[0], dict):
        return {name: _stacked(outer, [p[name] for p in parts]) for name in parts[0]}  # type: ignore[index]
    if parts and isinstance(parts[0], tuple):
        return _stacked(outer, [p[0] for p in parts])  # type: ignore[index]
    inner = parts[0].shape if parts and isinstance(parts[0], Array) else ()
    return Array((*outer, *inner), tuple(i for p in parts for i in algebra.scalars(p)))


def _number(value: float) -> int | float:
    return int(value) if value.is_integer() else value


def _replace(array: Array, index: list[list[int] | int | SX], value: Value) -> Array:
    new = list(array.items)
    if any(isinstance(i, SX) for i in index):
        (item,) = algebra.scalars(value)
        for position, at in enumerate(array.indices()):
            hit: Scalar = True
            for i, k in zip(index, at, strict=True):
                inside = algebra.EQUAL(i, k) if isinstance(i, SX) else (k in i if isinstance(i, list) else i == k)
                hit = algebra.AND(hit, inside)
            new[position] = algebra.scalars(algebra.choose(hit, item, new[position]))[0]
        return Array(array.shape, tuple(new))
    lists = [i if isinstance(i, list) else [i] for i in index if not isinstance(i, SX)]
    places = list(product(*lists))
    items = algebra.scalars(value)
    if len(items) == 1:
        items = items * len(places)
    for at, item in zip(places, items, strict=True):
        new[array.offset(at)] = item
    return Array(array.shape, tuple(new))
