# ruff: noqa: ARG002  (a function's scope refuses what a model's scope offers)
"""Modelica functions by symbolic execution of their algorithms."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from itertools import product
from typing import Any, Protocol

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value, whole
from fmu_build.expressions import Evaluator, Scope, span_of
from fmu_build.frontend import Flat, Node
from fmu_build.graph import SX
from fmu_build.tables import EXTERNAL

_MAX_ROUNDS = 100_000  # of a while loop with a condition known at translation


class _Return(Exception):  # noqa: N818  (not an error)
    pass


class _Break(Exception):  # noqa: N818
    pass


class _Frame:
    """Scope of one call: inputs, outputs and local variables; no model variables, no events."""

    def __init__(self, flat: Flat, name: str) -> None:
        self.flat = flat
        self.name = name
        self.variables: dict[str, Value] = {}

    def lookup(self, name: str) -> Value:
        if name in self.variables:
            value = self.variables[name]
            if value is None:
                raise ValueError(f"'{name}' is used before it has a value")
            return value
        constant = self.flat["variables"].get(name)
        if constant is not None and _is_constant(constant):
            return self._constant(constant)
        head, _, field = name.partition(".")
        record = self.variables.get(head)
        if isinstance(record, dict) and field in record:
            return record[field]
        raise KeyError(name)

    def _constant(self, variable: Node) -> Value:
        return Evaluator(self.flat, self, Functions(self.flat))(variable["binding"])

    def derivative(self, value: Scalar) -> Scalar:
        raise ValueError("der() in a function")

    def previous(self, value: Scalar) -> Scalar:
        raise ValueError("pre() in a function")

    def relation(self, difference: SX, inclusive: bool) -> SX:
        raise AssertionError("functions are evaluated without events")

    def step(self, argument: SX) -> SX:
        raise AssertionError("functions are evaluated without events")

    def sample(self, start: Scalar, interval: Scalar) -> SX:
        raise ValueError("sample() in a function")

    def initial(self) -> SX:
        raise ValueError("initial() in a function")


def _is_constant(variable: Node) -> bool:
    variability = variable["variability"]
    return isinstance(variability, Mapping) and "Constant" in variability and variable["binding"] is not None


class Functions:
    """The functions of a flat class; calling it evaluates a call node with evaluated arguments."""

    def __init__(self, flat: Flat) -> None:
        self._flat = flat
        functions = flat.parts.get("functions") or {}
        self._by_name: dict[str, Node] = dict(functions)
        self._by_instance: dict[Any, Node] = {f["instance_id"]: f for f in functions.values()}
        self._depth = 0

    def __call__(self, call: Node, arguments: list[Value]) -> Value:
        """Return the result (a tuple if the function has several outputs) of a call."""
        resolved = call["name"].get("resolved_function") or {}
        function = self._by_instance.get(resolved.get("instance_id"))
        function = function or self._by_name.get(call["name"]["name"])
        if function is None:
            raise ValueError(f"function '{call['name']['name']}' is not supported")
        if not function.get("pure", True):
            raise ValueError(f"impure function '{function['name']}' is not supported")
        return self._vectorised(function, arguments)

    def _vectorised(self, function: Node, arguments: list[Value]) -> Value:
        for position, (formal, actual) in enumerate(zip(function["inputs"], arguments, strict=False)):
            scalar = not formal["shape_expr"] and not formal["effective_type"]["dimensions"]
            if scalar and isinstance(actual, Array):
                parts = []
                for item in actual.items:
                    row = [item if a is actual else a for a in arguments]
                    row[position] = item
                    parts.append(self._vectorised(function, row))
                return Array(actual.shape, tuple(algebra.scalars(p)[0] for p in parts))
        if self._depth > 50:
            raise ValueError(f"function '{function['name']}' calls itself without end")
        self._depth += 1
        try:
            return self._run(function, arguments)
        finally:
            self._depth -= 1

    def _run(self, function: Node, arguments: list[Value]) -> Value:
        frame = _Frame(self._flat, function["name"])
        evaluator = Evaluator(self._flat, frame, self)
        with evaluator.no_event():
            for position, formal in enumerate(function["inputs"]):
                if position < len(arguments):
                    frame.variables[formal["name"]] = arguments[position]
                elif formal["default"] is not None:
                    frame.variables[formal["name"]] = evaluator(formal["default"])
                else:
                    raise ValueError(f"function '{function['name']}' lacks its argument '{formal['name']}'")
            external = function.get("external")
            if external:
                if external["function_name"] not in EXTERNAL:
                    raise ValueError(f"external function '{function['name']}' is not supported")
                return EXTERNAL[external["function_name"]](*map(evaluator, external["args"]))
            for variable in [*function["outputs"], *function["locals"]]:
                frame.variables[variable["name"]] = self._initial(variable, evaluator)
            if function["is_constructor"]:
                return dict(frame.variables)
            body = Body(self._flat, frame, evaluator)
            with suppress(_Return):
                body.run(function["body"])
            results = tuple(frame.lookup(o["name"]) for o in function["outputs"])
        return results[0] if len(results) == 1 else results

    def _initial(self, variable: Node, evaluator: Evaluator) -> Value:
        if variable["default"] is not None:
            return evaluator(variable["default"])
        if variable["type_class"] == "Record":
            return {}
        if variable["type_class"] not in (None, "Type"):
            raise self._flat.error(f"'{variable['name']}' of type {variable['type_name']}", variable["span"])
        shape = []
        for size in variable["shape_expr"]:
            ((tag, content),) = size.items()
            if tag == "Index":
                shape.append(int(content["value"]))
            elif tag == "Expr":
                shape.append(whole(evaluator(content["expr"])))
            else:
                raise self._flat.error(f"'{variable['name']}' has an open size", variable["span"])
        if not shape:
            return None
        # Entries are assigned one by one; one that never is stays NaN and shows.
        return Array.fill(shape, float("nan"))


class Frame(Scope, Protocol):
    """A scope with variables that statements assign."""

    name: str
    variables: dict[str, Value]


class Body:
    """Runs statements on a frame."""

    def __init__(self, flat: Flat, frame: Frame, evaluator: Evaluator) -> None:
        self._flat = flat
        self._frame = frame
        self._evaluate = evaluator

    def run(self, statements: list[Any]) -> None:
        """Execute statements in order."""
        for statement in statements:
            if isinstance(statement, str):
                statement = {statement: {}}
            ((tag, content),) = statement.items()
            run = getattr(self, f"_run_{tag.lower()}", None)
            if run is None:
                raise self._flat.error(f"{tag} statements in a function are not supported", _span(content))
            run(content)

    def _run_empty(self, node: Node) -> None:
        pass

    def _run_assignment(self, node: Node) -> None:
        self._assign(node["comp"], self._evaluate(node["value"]))

    def _run_functioncall(self, node: Node) -> None:
        call = {"FunctionCall": {**node, "name": node.get("name") or node.get("comp")}}
        result = self._evaluate(call)
        outputs = node.get("outputs") or []
        results = result if isinstance(result, tuple) else (result,)
        for output, value in zip(outputs, results, strict=False):
            if output is not None:
                self._assign(output, value)

    def _run_if(self, node: Node) -> None:
        self._branch(list(node["cond_blocks"]), node["else_block"] or [])

    def _branch(self, blocks: list[Node], otherwise: list[Any]) -> None:
        if not blocks:
            self.run(otherwise)
            return
        first, *rest = blocks
        condition = self._evaluate.scalar(first["cond"])
        if not isinstance(condition, SX):
            if condition:
                self.run(first["stmts"])
            else:
                self._branch(rest, otherwise)
            return
        before = dict(self._frame.variables)
        try:
            self.run(first["stmts"])
            then = self._frame.variables
            self._frame.variables = dict(before)
            self._branch(rest, otherwise)
        except (_Return, _Break):
            raise self._flat.error(
                "return or break that depends on a condition not known at translation", span_of(first["cond"])
            ) from None
        after = self._frame.variables
        self._frame.variables = {name: algebra.choose(condition, then[name], after[name]) for name in after}

    def _run_for(self, node: Node) -> None:
        self._loop(list(node["indices"]), node["equations"])

    def _loop(self, indices: list[Node], statements: list[Any]) -> None:
        if not indices:
            self.run(statements)
            return
        first, *rest = indices
        for i in algebra.scalars(self._evaluate(first["range"])):
            with self._evaluate.iterator(first["ident"], i):
                try:
                    self._loop(rest, statements)
                except _Break:
                    break

    def _run_while(self, node: Node) -> None:
        block = node.get("block") or node
        condition_node = block["cond"] if "cond" in block else block["condition"]
        for _ in range(_MAX_ROUNDS):
            condition = self._evaluate.scalar(condition_node)
            if isinstance(condition, SX):
                raise self._flat.error(
                    "a while loop whose condition is not known at translation is not supported",
                    span_of(condition_node),
                    "write a for loop over all rows with an if inside",
                )
            if not condition:
                return
            try:
                self.run(block.get("stmts") or block.get("equations") or [])
            except _Break:
                return
        raise self._flat.error("a while loop that does not end", span_of(condition_node))

    def _run_return(self, node: Node) -> None:
        raise _Return

    def _run_break(self, node: Node) -> None:
        raise _Break

    def _run_assert(self, node: Node) -> None:
        condition = self._evaluate.scalar(node["condition"])
        if not isinstance(condition, SX) and not condition:
            message = self._evaluate(node["message"])
            raise self._flat.error(f"assertion in function '{self._frame.name}': {message}", _span(node))
        if isinstance(condition, SX):
            raise self._flat.error("assert in a function on values not known at translation", _span(node))

    def _assign(self, target: Node, value: Value) -> None:
        parts = target["parts"]
        if len(parts) == 2 and not parts[0]["subs"] and not parts[1]["subs"]:
            record = self._frame.variables.get(parts[0]["ident"])
            fields = dict(record) if isinstance(record, dict) else {}
            self._frame.variables[parts[0]["ident"]] = {**fields, parts[1]["ident"]: value}
            return
        if len(parts) != 1:
            raise self._flat.error("assignment to part of a record", target.get("span"))
        name, subscripts = parts[0]["ident"], parts[0]["subs"]
        if not subscripts:
            self._frame.variables[name] = value
            return
        array = self._frame.variables[name]
        if not isinstance(array, Array):
            raise self._flat.error(f"subscripts on {algebra.kind(array)}", target.get("span"))
        index = self._evaluate.subscripts(array, subscripts)
        self._frame.variables[name] = _replace(array, index, value)


def _replace(array: Array, index: list[list[int] | int | SX], value: Value) -> Array:
    new = list(array.items)
    source = iter(algebra.scalars(value))
    if any(isinstance(i, SX) for i in index):
        (item,) = algebra.scalars(value)
        for position, at in enumerate(array.indices()):
            hit: Scalar = True
            for i, k in zip(index, at, strict=True):
                hit = algebra.AND(hit, algebra.EQUAL(i, k) if isinstance(i, SX) else i == k)
            new[position] = algebra.scalars(algebra.choose(hit, item, new[position]))[0]
        return Array(array.shape, tuple(new))
    lists = [i if isinstance(i, list) else [i] for i in index if not isinstance(i, SX)]
    for at in product(*lists):
        new[array.offset(at)] = next(source)
    return Array(array.shape, tuple(new))


def _span(node: Any) -> Any:
    return node.get("span") if isinstance(node, Mapping) else None
