"""Restrictions of the specification on classes (sections 4.5 to 4.8 and 7.1.3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from fmu_build.errors import ModelicaError
from fmu_build.front.classes import Argument, ClassDef, ComponentDef, Extends, Modification
from fmu_build.syntax import (
    Assign,
    AssignMany,
    Break,
    Expression,
    ForStatement,
    IfStatement,
    Reference,
    Return,
    WhenStatement,
    WhileStatement,
    references,
    walk,
)

_RESERVED = ("Real", "Integer", "Boolean", "String")
_ATTRIBUTES = ("quantity", "min", "max", "start", "fixed")
_STRUCTURES = ("record", "operator record", "connector", "expandable connector")
# The kinds of classes that a class of some kind may extend; "class" may be extended by all, and extend all.
_BASES = {
    "package": {"package"},
    "operator": {"operator"},
    "function": {"function"},
    "operator function": {"function", "operator function"},
    "type": {"type", "builtin"},
    "record": {"record"},
    "operator record": {"operator record"},
    "expandable connector": {"expandable connector"},
    "connector": {"connector", "record", "operator record", "type", "builtin"},
    "block": {"record", "block"},
    "model": {"record", "block", "model"},
}


def check_class(definition: ClassDef) -> None:
    """Refuse what a class of its kind cannot have."""
    kind = definition.kind
    if definition.name in _RESERVED and kind != "builtin":
        raise ModelicaError(f"'{definition.name}' is the name of a predefined type", where=definition.at)
    _check_literals(definition)
    _check_imports(definition)
    for element in definition.elements:
        if isinstance(element, ComponentDef | ClassDef) and element.name in _RESERVED:
            raise ModelicaError(f"'{element.name}' is the name of a predefined type", where=element.at)
        if kind == "operator" and not isinstance(element, ClassDef):
            raise ModelicaError("an operator consists of functions alone", where=element.at)
        if kind in _STRUCTURES:
            _check_member(kind, element)
    if kind in _STRUCTURES and definition.sections:
        what = definition.sections[0].kind + "s"
        raise ModelicaError(f"a {kind} cannot have {what}", where=definition.sections[0].at)
    is_function = kind.endswith("function")
    if is_function:
        _check_function(definition)
    for section in definition.sections:
        if section.kind == "algorithm":
            _check_statements(section.items, is_function)


def _check_literals(definition: ClassDef) -> None:
    names = [name for name, _ in definition.enumeration or ()]
    for name in names:
        if name in _ATTRIBUTES:
            raise ModelicaError(f"an enumeration cannot have the literal '{name}'", where=definition.at)
        if names.count(name) > 1:
            raise ModelicaError(f"the literal '{name}' appears twice", where=definition.at)


def _check_imports(definition: ClassDef) -> None:
    aliases = [clause.alias for clause in definition.imports if clause.alias != "*"]
    for clause in definition.imports:
        if aliases.count(clause.alias) > 1:
            raise ModelicaError(f"'{clause.alias}' is imported twice", where=clause.at)


def _check_statements(
    items: Sequence[Any], is_function: bool, in_loop: bool = False, in_when: bool = False
) -> None:
    """Refuse statements in places where they have no meaning."""
    for s in items:
        match s:
            case Break() if not in_loop:
                raise ModelicaError("break outside a loop", where=s.at)
            case Return() if not is_function:
                raise ModelicaError("return outside a function", where=s.at)
            case WhenStatement() if in_when or is_function:
                where = "inside a when-statement" if in_when else "in a function"
                raise ModelicaError(f"a when-statement {where}", where=s.at)
            case IfStatement() | WhenStatement():
                for _, body in s.branches:
                    _check_statements(body, is_function, in_loop, in_when or isinstance(s, WhenStatement))
            case ForStatement() | WhileStatement():
                _check_statements(s.body, is_function, True, in_when)


def _values(modification: Modification) -> Iterator[Expression]:
    """Yield the values in a modification."""
    if modification.value is not None:
        yield modification.value
    for argument in modification.arguments:
        if isinstance(argument, Argument):
            yield from _values(argument.modification)


def _check_member(kind: str, element: ComponentDef | ClassDef | Extends) -> None:
    if element.protected:
        raise ModelicaError(f"a {kind} cannot have protected elements", where=element.at)
    if not isinstance(element, ComponentDef):
        return
    if any(r.name == "time" for value in _values(element.modification) for r in references(value)):
        raise ModelicaError(f"time in a {kind}", where=element.at, fix="use it in a model or a block")
    for name in ("inner", "outer"):
        if getattr(element, name):
            raise ModelicaError(f"an element of a {kind} cannot be {name}", where=element.at)
    if kind.endswith("record"):
        for prefix in sorted(element.prefixes & {"flow", "stream", "input", "output"}):
            raise ModelicaError(f"an element of a {kind} cannot have the prefix {prefix}", where=element.at)
    if kind == "expandable connector" and "flow" in element.prefixes:
        raise ModelicaError("an element of an expandable connector cannot have the prefix flow", where=element.at)


def _check_function(definition: ClassDef) -> None:
    components = [e for e in definition.elements if isinstance(e, ComponentDef)]
    for section in definition.sections:
        if section.initial:
            raise ModelicaError("a function has no initial algorithm", where=section.at)
    inputs = {c.name for c in components if "input" in c.prefixes}
    for node in (n for section in definition.sections for n in walk(section.items)):
        targets: tuple[Reference | None, ...] = ()
        if isinstance(node, Assign):
            targets = (node.target,)
        elif isinstance(node, AssignMany):
            targets = node.targets
        for target in targets:
            if target is not None and target.parts[0].name in inputs:
                raise ModelicaError(f"'{target.name}' is an input and cannot be assigned", where=node.at)


def check_base(definition: ClassDef, base: ClassDef, clause: Extends) -> None:
    """Refuse a base class of another kind."""
    if base.kind == "operator record":
        raise ModelicaError("an operator record cannot be extended", where=clause.at,
                            fix="write a short class: operator record A = B(...)")  # fmt: skip
    if any(isinstance(e, ClassDef) and e.kind == "operator record" for e in base.elements):
        raise ModelicaError(f"'{clause.type.name}' has an operator record and cannot be extended", where=clause.at)
    allowed = _BASES.get(definition.kind)
    if allowed is None or base.kind == "class" or base.kind in allowed:
        return
    if base.enumeration is not None or base.name == "ExternalObject":
        return
    raise ModelicaError(f"a {definition.kind} cannot extend the {base.kind} '{clause.type.name}'", where=clause.at)


def is_package_like(definition: ClassDef) -> bool:
    """Whether a class consists of classes and constants, so that all of them may be used from outside."""
    if definition.kind in ("package", "operator") or definition.short is not None:
        return True
    return not definition.sections and all(
        "constant" in e.prefixes for e in definition.elements if isinstance(e, ComponentDef)
    )
