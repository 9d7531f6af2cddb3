"""Restrictions of the specification on classes (sections 4.5 to 4.8 and 7.1.3)."""

from __future__ import annotations

from fmu_build.errors import ModelicaError
from fmu_build.front.classes import ClassDef, ComponentDef, Extends
from fmu_build.syntax import Assign, AssignMany, Reference, walk

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
    if definition.enumeration is not None:
        names = [name for name, _ in definition.enumeration]
        for name in names:
            if name in _ATTRIBUTES:
                raise ModelicaError(f"an enumeration cannot have the literal '{name}'", where=definition.at)
            if names.count(name) > 1:
                raise ModelicaError(f"the literal '{name}' appears twice", where=definition.at)
    for element in definition.elements:
        if isinstance(element, ComponentDef | ClassDef) and element.name in _RESERVED:
            raise ModelicaError(f"'{element.name}' is the name of a predefined type", where=element.at)
        if kind in _STRUCTURES:
            _check_member(kind, element)
    if kind in _STRUCTURES and definition.sections:
        what = definition.sections[0].kind + "s"
        raise ModelicaError(f"a {kind} cannot have {what}", where=definition.sections[0].at)
    if kind.endswith("function"):
        _check_function(definition)


def _check_member(kind: str, element: ComponentDef | ClassDef | Extends) -> None:
    if element.protected:
        raise ModelicaError(f"a {kind} cannot have protected elements", where=element.at)
    if not isinstance(element, ComponentDef):
        return
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
    allowed = _BASES.get(definition.kind)
    if allowed is None or base.kind == "class" or base.kind in allowed:
        return
    if base.enumeration is not None or base.name == "ExternalObject":
        return
    raise ModelicaError(f"a {definition.kind} cannot extend the {base.kind} '{clause.type.name}'", where=clause.at)
