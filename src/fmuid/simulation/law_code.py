"""Modelica expressions of laws as code for a stack machine in C (``laws.c``), so that no compiler is needed."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from fmu_build.errors import ModelicaError
from fmu_build.front.parser import expression as parse_expression
from fmu_build.suggest import suggestion
from fmu_build.syntax import Binary, Call, Expression, If, Literal, Reference, Unary

OPERATIONS = (
    "CONSTANT", "STATE", "DERIVATIVE", "INPUT", "PARAMETER", "TIME", "ADDED_STATE", "OWN",
    "ADD", "SUBTRACT", "MULTIPLY", "DIVIDE", "POWER", "LESS", "AT_MOST", "EQUAL", "AND", "OR",
    "MINIMUM", "MAXIMUM", "ATAN2", "NEGATE", "NOT", "ABS", "SIGN", "SQRT", "EXP", "LOG", "LOG10",
    "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "SINH", "COSH", "TANH", "JUMP", "UNLESS",
)  # fmt: skip
"""Operations by number, as in laws.h."""
_CODES = {name: code for code, name in enumerate(OPERATIONS)}
_FUNCTIONS = {
    **{name: name.upper() for name in ("abs", "sign", "sqrt", "exp", "log", "log10", "sin", "cos", "tan")},
    **{name: name.upper() for name in ("asin", "acos", "atan", "sinh", "cosh", "tanh", "atan2")},
    "min": "MINIMUM",
    "max": "MAXIMUM",
}
_TWO = ("MINIMUM", "MAXIMUM", "ATAN2")
_BINARY = {
    "+": "ADD", "-": "SUBTRACT", "*": "MULTIPLY", "/": "DIVIDE", "^": "POWER", "<": "LESS", "<=": "AT_MOST",
    "==": "EQUAL", "and": "AND", "or": "OR",
}  # fmt: skip
_SWAPPED = {">": "LESS", ">=": "AT_MOST"}
_DEEPEST = 64  # values on the stack, as in laws.h


@dataclass(frozen=True, slots=True)
class Operand:
    """What a name in an expression stands for: one of the first operations, and the number of the value."""

    operation: str
    index: int = 0


@dataclass(frozen=True, slots=True)
class _Instruction:
    operation: str
    index: int = 0
    value: float = 0.0


def code_of(text: str, names: Mapping[str, Operand], where: str = "") -> str:
    """Return the code of a Modelica expression, as text for ``laws.txt``.

    Parameters
    ----------
    text
        The expression; names need not be Modelica's (``der(w).viscous`` may be a parameter).
    names
        Meanings of names.
    where
        Place for error messages.

    Raises
    ------
    ModelicaError
        The expression is not Modelica, or uses a name or a function that is not known here.
    """
    plain = {f"name{i}": name for i, name in enumerate(sorted(names, key=len, reverse=True))}
    coded = {name: f" {key} " for key, name in plain.items()}
    pattern = "|".join(rf"(?<![\w.]){re.escape(name)}(?![\w.(])" for name in coded)
    tree = parse_expression(re.sub(pattern, lambda m: coded[m.group()], text) if coded else text, where)
    code = _Compiler({key: names[name] for key, name in plain.items()}, where).of(tree)
    return f"{len(code)} " + " ".join(f"{_CODES[c.operation]} {c.index} {bits(c.value)}" for c in code)


def bits(value: float) -> str:
    """Return the bits of a number in hexadecimal."""
    return struct.pack(">d", value).hex()


@dataclass(frozen=True, slots=True)
class _Compiler:
    names: Mapping[str, Operand]
    where: str

    def of(self, e: Expression | None, start: int = 0, depth: int = 1) -> list[_Instruction]:
        """Return the code of an expression that begins at instruction `start`."""
        if depth > _DEEPEST:
            raise ModelicaError("is nested too deeply", where=self.where, fix="write it with fewer parentheses")
        match e:
            case Literal(value=bool() | int() | float() as value):
                return [_Instruction("CONSTANT", value=float(value))]
            case Reference():
                return [self._value_of(e)]
            case Unary():
                inner = self.of(e.operand, start, depth)
                instruction = {"-": "NEGATE", "not": "NOT"}.get(e.operator)
                return [*inner, _Instruction(instruction)] if instruction else inner
            case Binary():
                return self._binary(e, start, depth)
            case Call():
                return self._call(e, start, depth)
            case If(branches=((condition, value), *rest)):
                otherwise = If(e.at, tuple(rest), e.otherwise) if rest else e.otherwise
                return self._choice((condition, value, otherwise), start, depth)
        raise ModelicaError("is not an expression of numbers", where=self.where, fix="write a real expression")

    def _value_of(self, e: Reference) -> _Instruction:
        name = ".".join(part.name for part in e.parts)
        if name == "time":
            return _Instruction("TIME")
        if name not in self.names:
            fix = "use states, derivatives, inputs and parameters of the law"
            raise ModelicaError(f"a law at a state cannot use '{name}'", where=self.where, fix=fix)
        return _Instruction(self.names[name].operation, self.names[name].index)

    def _binary(self, e: Binary, start: int, depth: int) -> list[_Instruction]:
        if e.operator in _SWAPPED:
            return self._both(e.right, e.left, _SWAPPED[e.operator], (start, depth))
        if e.operator == "<>":
            return [*self._both(e.left, e.right, "EQUAL", (start, depth)), _Instruction("NOT")]
        if e.operator not in _BINARY:
            raise ModelicaError(f"'{e.operator}' is not supported", where=self.where, fix="write it without")
        return self._both(e.left, e.right, _BINARY[e.operator], (start, depth))

    def _both(
        self, left: Expression | None, right: Expression | None, operation: str, place: tuple[int, int]
    ) -> list[_Instruction]:
        start, depth = place
        first = self.of(left, start, depth)
        return [*first, *self.of(right, start + len(first), depth + 1), _Instruction(operation)]

    def _call(self, e: Call, start: int, depth: int) -> list[_Instruction]:
        if e.function in ("noEvent", "smooth") and e.arguments:
            return self.of(e.arguments[-1], start, depth)
        operation = _FUNCTIONS.get(e.function)
        if operation is None:
            what = f"there is no function '{e.function}' for laws at states"
            raise ModelicaError(what, where=self.where, fix=suggestion(e.function, _FUNCTIONS))
        wanted = 2 if operation in _TWO else 1
        if len(e.arguments) != wanted or e.named:
            what = f"'{e.function}' takes {wanted} argument(s), not {len(e.arguments)}"
            raise ModelicaError(what, where=self.where, fix="correct it")
        if wanted == 2:
            return self._both(e.arguments[0], e.arguments[1], operation, (start, depth))
        return [*self.of(e.arguments[0], start, depth), _Instruction(operation)]

    def _choice(
        self, parts: tuple[Expression, Expression, Expression], start: int, depth: int
    ) -> list[_Instruction]:
        condition, value, otherwise = parts
        test = self.of(condition, start, depth)
        yes = self.of(value, start + len(test) + 1, depth)
        no_begins = start + len(test) + len(yes) + 2
        no = self.of(otherwise, no_begins, depth)
        jump = _Instruction("JUMP", no_begins + len(no))
        return [*test, _Instruction("UNLESS", no_begins), *yes, jump, *no]
