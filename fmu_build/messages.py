"""Texts of assertions, with values that are only known when they are violated."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypeGuard

import casadi as ca

from fmu_build import algebra
from fmu_build.algebra import Scalar, Value
from fmu_build.errors import ModelicaError
from fmu_build.expressions import Evaluator
from fmu_build.graph import SX, key
from fmu_build.syntax import Binary, Call, Expression, Literal, Reference
from fmu_build.variables import Declarations

_FORMAT = re.compile(r"%?([-+ #0]*)(\d*)(\.\d+)?([eEfgGdi])")
_TRUTH = "=false|true"
_LOGICAL = {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR}
_MARK = "\001"  # around a form in a text with forms


@dataclass(frozen=True)
class Shown:
    """A value in a message.

    Attributes
    ----------
    form
        ``%`` conversion of a double, or ``=`` with the words for 0, 1, 2 ... between bars.
    """

    value: SX
    form: str


Message = tuple[str | Shown, ...]


def message(evaluate: Evaluator, node: Expression, declared: Declarations | None = None) -> Message:
    """Evaluate the text of a message, as far as it is known at translation.

    Parameters
    ----------
    declared
        Provides which symbols are Booleans, Integers or enumerations.
    """
    if isinstance(node, Binary) and node.operator == "+":
        return (*message(evaluate, node.left, declared), *message(evaluate, node.right, declared))
    if isinstance(node, Literal):
        return (str(node.value),)
    options: list[Value] = []
    try:
        value = evaluate(node.arguments[0] if _is_string(node) and node.arguments[0] is not None else node)
        if _is_string(node):
            options = [None if a is None else evaluate(a) for a in node.arguments[1:]]
    except (ModelicaError, algebra.UnknownSizeError):
        return (node.name if isinstance(node, Reference) else "(expression)",)
    if isinstance(value, str):
        return (value,)
    (item,) = algebra.scalars(value)
    try:
        form = _form(_words(item, declared), options)
    except (TypeError, ValueError) as error:
        raise evaluate.context.error(str(error), node.at) from None
    if isinstance(item, SX):
        return (Shown(item, form),)
    return (form[1:].split("|")[int(item)] if form.startswith("=") else form % item,)


def _is_string(node: Expression) -> TypeGuard[Call]:
    return isinstance(node, Call) and node.function == "String"


def _words(item: Scalar, declared: Declarations | None) -> str:
    """Words for the values of a Boolean or an enumeration, ``%d`` for an Integer, or nothing."""
    if not isinstance(item, SX):
        return _TRUTH if isinstance(item, bool) else "%d" if isinstance(item, int) else ""
    if not item.is_symbolic() and int(item.op()) in _LOGICAL:
        return _TRUTH
    of_symbol = declared.by_symbol.get(key(item)) if declared is not None else None
    if of_symbol is None or of_symbol.type == "Real":
        return ""
    if of_symbol.type == "Boolean":
        return _TRUTH
    return "=|" + "|".join(of_symbol.literals) if of_symbol.literals else "%d"


def _form(words: str, options: list[Value]) -> str:
    """Conversion for ``String(value, significantDigits, minimumLength, leftJustified, format)``."""
    digits, least, left, given = [*options, None, None, None, None][:4]
    if words.startswith("="):
        return words
    if isinstance(given, str) and given:
        match = _FORMAT.fullmatch(given)
        if match is None:
            raise ValueError(f"the format '{given}' is not one of printf's for a number")
        flags, width, precision, letter = match.groups()
        return f"%{flags}{width}.0f" if letter in "di" else f"%{flags}{width}{precision or ''}{letter}"
    width = "" if least is None else f"{'' if left is False else '-'}{algebra.whole(least)}"
    return f"%{width}.0f" if words else f"%{width}.{6 if digits is None else algebra.whole(digits)}g"


def text(parts: Message) -> str:
    """Text for the C runtime, with the forms of the values between marks."""
    return "".join(p if isinstance(p, str) else f"{_MARK}{p.form}{_MARK}" for p in parts)


def values(parts: Message) -> list[SX]:
    """Return the values that a text shows, in order."""
    return [p.value for p in parts if isinstance(p, Shown)]
