"""A flat model as Modelica source: one self-contained class, for any tool.

A variable with a path gets a quoted name (``'load.w'``); connections are written as their equations.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence

from fmu_build.errors import ModelicaError
from fmu_build.flat_model import Equation, FlatModel, Formal, Function, Variable
from fmu_build.syntax import (
    All,
    ArrayOf,
    Assert,
    Assign,
    AssignMany,
    Binary,
    Break,
    Call,
    Comprehension,
    End,
    Expression,
    ForStatement,
    If,
    IfStatement,
    Literal,
    Matrix,
    Node,
    Range,
    Reference,
    Reinit,
    Return,
    Statement,
    Subscripted,
    Terminate,
    TupleOf,
    Unary,
    WhenStatement,
    WhileStatement,
)

_INDENT = "  "
_BINDING = {"or": 1, "and": 2, "not": 3} | dict.fromkeys(("<", "<=", ">", ">=", "==", "<>"), 4)
_BINDING |= dict.fromkeys(("+", "-", ".+", ".-"), 5) | dict.fromkeys(("*", "/", ".*", "./"), 6)
_BINDING |= dict.fromkeys(("^", ".^"), 7)
_ATOM = 8


def modelica_text(
    flat: FlatModel,
    name: str,
    comment: Sequence[str] = (),
    *,
    components: Sequence[str] = (),
    connections: Sequence[str] = (),
) -> str:
    """Return a flat model as the source of the model `name`, with lines of comment on top.

    Parameters
    ----------
    components, connections
        Declarations of components and their equations, as Modelica, in addition to those of the model.

    Raises
    ------
    ModelicaError
        The model has elements that only its own source can declare: external functions and objects, records of
        functions.
    """
    lines = [f"// {line}".rstrip() for line in comment]
    lines.append(f"model {name}{_description(flat.description)}")
    for function in flat.functions.values():
        lines += _indented(_function(flat, function))
    for variable in flat.variables.values():
        lines.append(f"{_INDENT}{_declaration(flat, variable)}")
    lines += _indented(components)
    lines += _section("initial equation", (_equation(e) for e in flat.initial_equations))
    for algorithm in flat.initial_algorithms:
        lines += _section("initial algorithm", _statements(algorithm.statements, ":="))
    equations = [*connections, *map(_equation, flat.equations)]
    equations += [line for when in flat.whens for line in _statement(when, "=")]
    equations += [line for one in flat.asserts for line in _statement(one, "=")]
    lines += _section("equation", equations)
    for algorithm in flat.algorithms:
        lines += _section("algorithm", _statements(algorithm.statements, ":="))
    return "\n".join([*lines, f"end {name};", ""])


def _indented(lines: Iterator[str] | Sequence[str]) -> list[str]:
    return [f"{_INDENT}{line}" for line in lines]


def _section(keyword: str, lines: Iterator[str] | Sequence[str]) -> list[str]:
    inside = _indented(lines)
    return [keyword, *inside] if inside else []


def name_text(name: str) -> str:
    """Return the name of a flat variable as Modelica, in quotes if it has a path."""
    if name.isidentifier() and name.isascii():
        return name
    escaped = name.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def _function_name(name: str) -> str:
    """Return the name of a function, which is now next to the variables: its path becomes part of the name."""
    return re.sub(r"\W", "_", name)


def _description(text: str) -> str:
    return f" {_string(text)}" if text else ""


def _string(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _declaration(flat: FlatModel, v: Variable) -> str:
    if v.type == "ExternalObject":
        raise flat.error(f"'{v.name}' is an external object, which only its own source declares", v.at)
    words = []
    if v.final:
        words.append("final")
    if v.variability in ("parameter", "constant") or (v.variability == "discrete" and v.type == "Real"):
        words.append(v.variability)
    if v.causality is not None:
        words.append(v.causality)
    shape = f"[{', '.join(map(str, v.shape))}]" if v.shape else ""
    changes = {"unit": v.unit, "displayUnit": v.display_unit, "quantity": v.quantity}
    modifiers = [
        f"{key} = {_string(text)}" for key, text in changes.items() if text is not None and v.type == "Real"
    ]
    values = {"start": None if _is_zero_anyway(v) else v.start, "min": v.min, "max": v.max, "nominal": v.nominal}
    modifiers += [f"{_each(v, e)}{key} = {expression_text(e)}" for key, e in values.items() if e is not None]
    if v.fixed is not None:
        same = len(set(v.fixed)) == 1
        value = _truth(v.fixed[0]) if same else f"{{{', '.join(map(_truth, v.fixed))}}}"
        modifiers.append(f"{'each ' if v.shape and same else ''}fixed = {value}")
    if v.state_select != "default" and v.type == "Real":
        modifiers.append(f"stateSelect = StateSelect.{v.state_select}")
    inside = f"({', '.join(modifiers)})" if modifiers else ""
    value = "" if v.binding is None else f" = {expression_text(v.binding)}"
    return f"{' '.join([*words, v.type, name_text(v.name)])}{shape}{inside}{value}{_description(v.description)};"


def _is_zero_anyway(v: Variable) -> bool:
    """Return whether only the class of its component gives a start value, that of every number.

    Written at the top, it would contradict start values of the model.
    """
    zero = isinstance(v.start, Literal) and v.start.value == 0 and v.type == "Real" and not v.fixed
    return zero and v.variability == "continuous" and v.start_level in (None, v.name.count(".") or None)


def _each(v: Variable, e: Expression) -> str:
    return "each " if v.shape and isinstance(e, Literal) else ""


def _truth(value: bool) -> str:
    return "true" if value else "false"


def _function(flat: FlatModel, function: Function) -> Iterator[str]:
    if function.external is not None or function.constructor:
        raise flat.error(f"function '{function.name}' is written in another language", function.at)
    yield f"function {_function_name(function.name)}"
    for prefix, formals in (
        ("input", function.inputs),
        ("output", function.outputs),
        ("protected", function.locals),
    ):
        for formal in formals:
            yield f"{_INDENT}{_formal(flat, prefix, formal)}"
    yield "algorithm"
    yield from _indented(_statements(function.body, ":="))
    yield f"end {_function_name(function.name)};"


def _formal(flat: FlatModel, prefix: str, formal: Formal) -> str:
    if formal.fields is not None:
        raise flat.error(f"'{formal.name}' is a record of a function", formal.at)
    shape = ", ".join(":" if size is None else expression_text(size) for size in formal.shape)
    value = "" if formal.default is None else f" := {expression_text(formal.default)}"
    return f"{prefix} {formal.type} {name_text(formal.name)}{f'[{shape}]' if shape else ''}{value};"


def _equation(equation: Equation) -> str:
    return f"{expression_text(equation.left)} = {expression_text(equation.right)};"


def _statements(statements: Sequence[Statement], sign: str) -> list[str]:
    return [line for one in statements for line in _statement(one, sign)]


def _statement(one: Statement, sign: str) -> list[str]:
    match one:
        case Assign():
            return [f"{expression_text(one.target)} {sign} {expression_text(one.value)};"]
        case AssignMany(targets=targets, call=call):
            names = ", ".join("" if t is None else expression_text(t) for t in targets)
            return [f"({names}) {sign} {expression_text(call)};" if targets else f"{expression_text(call)};"]
        case Reinit(state=state, value=value):
            return [f"reinit({expression_text(state)}, {expression_text(value)});"]
        case Assert(condition=condition, message=message, warning=warning):
            level = ", AssertionLevel.warning" if warning else ""
            return [f"assert({expression_text(condition)}, {expression_text(message)}{level});"]
        case Terminate(message=message):
            return [f"terminate({expression_text(message)});"]
        case Return() | Break():
            return [f"{type(one).__name__.lower()};"]
        case _:
            return _compound(one, sign)


def _compound(one: IfStatement | WhenStatement | ForStatement | WhileStatement, sign: str) -> list[str]:
    """Write a statement that contains statements."""
    if isinstance(one, IfStatement | WhenStatement):
        return _branches("if" if isinstance(one, IfStatement) else "when", one.branches, sign)
    if isinstance(one, ForStatement):
        keyword, inside = "for", ", ".join(_iterator(i) for i in one.iterators)
    else:
        keyword, inside = "while", expression_text(one.condition)
    return [f"{keyword} {inside} loop", *_indented(_statements(one.body, sign)), f"end {keyword};"]


def _branches(
    keyword: str, branches: Sequence[tuple[Expression | None, tuple[Statement, ...]]], sign: str
) -> list[str]:
    lines = []
    for k, (condition, body) in enumerate(branches):
        word = keyword if k == 0 else f"else{keyword}"
        lines.append("else" if condition is None else f"{word} {expression_text(condition)} then")
        lines += _indented(_statements(body, sign))
    return [*lines, f"end {keyword};"]


def _iterator(iterator: tuple[str, Expression | None]) -> str:
    name, values = iterator
    return name if values is None else f"{name} in {expression_text(values)}"


def expression_text(e: Expression) -> str:
    """Return an expression of a flat model as Modelica."""
    return _bound(e)[0]


def _inside(e: Expression, least: int) -> str:
    text, binding = _bound(e)
    return text if binding >= least else f"({text})"


def _bound(e: Expression) -> tuple[str, int]:
    """Return an expression as text, and its binding strength."""
    match e:
        case Literal(value=value):
            return _literal(value)
        case Reference(parts=parts):
            return ".".join(f"{name_text(p.name)}{_subscripts(p.subscripts)}" for p in parts), _ATOM
        case Subscripted(base=base, subscripts=subscripts):
            return f"{_inside(base, _ATOM)}{_subscripts(subscripts)}", _ATOM
        case Unary() | Binary() | If() | Range():
            return _operation(e)
        case End():
            return "end", _ATOM
        case All():
            return ":", _ATOM
        case _:
            return _collection(e)


def _literal(value: bool | int | float | str) -> tuple[str, int]:
    if isinstance(value, bool):
        return _truth(value), _ATOM
    if isinstance(value, str):
        return _string(value), _ATOM
    return repr(value), 5 if repr(value).startswith("-") else _ATOM


def _operation(e: Unary | Binary | If | Range) -> tuple[str, int]:
    match e:
        case Unary(operator=operator, operand=operand):
            binding = _BINDING.get(operator, 5)
            space = " " if operator == "not" else ""
            return f"{operator}{space}{_inside(operand, binding + 1)}", binding
        case Binary(operator=operator, left=left, right=right):
            binding = _BINDING[operator]
            sides = _inside(left, binding + (binding in (4, 7))), _inside(right, binding + 1)
            return f"{sides[0]} {operator} {sides[1]}", binding
        case If(branches=branches, otherwise=otherwise):
            first, *others = (f"if {expression_text(c)} then {expression_text(v)}" for c, v in branches)
            return " ".join([first, *(f"else{o}" for o in others), f"else {expression_text(otherwise)}"]), 0
        case Range(start=start, step=step, stop=stop):
            return ":".join(_inside(part, 5) for part in (start, step, stop) if part is not None), 0


def _collection(e: Expression) -> tuple[str, int]:
    match e:
        case Call(function=function, arguments=arguments):
            given = ", ".join(expression_text(a) for a in arguments if a is not None)
            return f"{_function_name(function)}({given})", _ATOM
        case ArrayOf(items=items):
            return f"{{{', '.join(expression_text(i) for i in items)}}}", _ATOM
        case Matrix(rows=rows):
            return f"[{'; '.join(', '.join(expression_text(i) for i in row) for row in rows)}]", _ATOM
        case TupleOf(items=items):
            return f"({', '.join('' if i is None else expression_text(i) for i in items)})", _ATOM
        case Comprehension(element=element, iterators=iterators):
            return f"{expression_text(element)} for {', '.join(_iterator(i) for i in iterators)}", 0
        case _:
            raise ModelicaError(f"{type(e).__name__} cannot be written as source", where=_place(e))


def _place(e: Node) -> str:
    return str(e.at)


def _subscripts(subscripts: Sequence[Expression]) -> str:
    return f"[{', '.join(expression_text(s) for s in subscripts)}]" if subscripts else ""
