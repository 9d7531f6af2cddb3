"""Arithmetic expressions of parameters, such as ``0.5*lossTable[2,4] + 0.01`` in a stage's `tie`."""

from __future__ import annotations

import ast
import copy
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import CodeType
from typing import Any

import numpy as np

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray

_BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_BINARY_SLOPES: Mapping[type[ast.operator], Callable[[float, float, float, float], float]] = {
    ast.Add: lambda _a, da, _b, db: da + db,
    ast.Sub: lambda _a, da, _b, db: da - db,
    ast.Mult: lambda a, da, b, db: da * b + a * db,
    ast.Div: lambda a, da, b, db: (da - a / b * db) / b,
    ast.Pow: lambda a, da, b, db: (
        (b * a ** (b - 1) * da if da else 0.0) + (a**b * math.log(a) * db if db else 0.0)
    ),
}
_FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "abs": abs,
    "cos": math.cos,
    "exp": math.exp,
    "log": math.log,
    "max": max,
    "min": min,
    "sin": math.sin,
    "sqrt": math.sqrt,
    "tan": math.tan,
    "tanh": math.tanh,
}
_REMEMBERED = 10_000  # number of formulas: a library of terms is evaluated many times
_SHOWN = 100  # characters of a formula in a message
_OTHERWISE = {"max": "maximum", "min": "minimum"}  # NumPy's function names
# All functions that a compiled formula can call.
_OF_ARRAYS: dict[str, Any] = {"__builtins__": {}, **{n: getattr(np, _OTHERWISE.get(n, n)) for n in _FUNCTIONS}}
_SLOPES: Mapping[str, Callable[[float], float]] = {
    "abs": lambda x: math.copysign(1.0, x),
    "cos": lambda x: -math.sin(x),
    "exp": math.exp,
    "log": lambda x: 1.0 / x,
    "sin": math.cos,
    "sqrt": lambda x: 0.5 / math.sqrt(x),
    "tan": lambda x: 1.0 + math.tan(x) ** 2,
    "tanh": lambda x: 1.0 - math.tanh(x) ** 2,
}


@dataclass(frozen=True, slots=True)
class Expression:
    """A parsed expression: its text and the parameter names it needs."""

    text: str
    names: frozenset[str]
    _tree: ast.expr

    def __call__(self, values: Mapping[str, float]) -> float:
        """Return the value at the parameter `values`.

        Raises
        ------
        ProblemError
            The value is not a finite real number there (a division by zero, a root of a negative number).
        """
        try:
            result = _value(self._tree, values)
        except (ArithmeticError, ValueError, TypeError) as error:
            raise ProblemError(f"{_shown(self.text)} has no value ({error})", fix="change the bounds") from None
        if isinstance(result, complex):
            raise ProblemError(f"{_shown(self.text)} has no real value", fix="change the bounds")
        if not math.isfinite(result):
            raise ProblemError(f"{_shown(self.text)} is {result}", fix="change the bounds")
        return float(result)

    def of_samples(self, columns: Mapping[str, FloatArray]) -> FloatArray:
        """Return the value at every sample of (N,) `columns`; NaN or infinite where it is undefined."""
        with np.errstate(all="ignore"):
            # A tree accepted by `parse` contains only arithmetic, names and these functions.
            values = eval(_compiled(self), _OF_ARRAYS, {n: columns[n] for n in self.names})
        return np.asarray(values, dtype=np.float64)

    def slope(self, values: Mapping[str, float], slopes: Mapping[str, float]) -> float:
        """Return the derivative at the parameter `values`, given the `slopes` of some of them.

        Raises
        ------
        ProblemError
            The expression is not differentiable there.
        """
        try:
            return float(_dual(self._tree, values, slopes)[1])
        except (ArithmeticError, ValueError, TypeError) as error:
            raise ProblemError(
                f"{_shown(self.text)} has no derivative ({error})", fix="change the bounds"
            ) from None

    def renamed(self, names: Mapping[str, str]) -> Expression:
        """Return the expression with parameters renamed; `names` maps old names to new ones."""
        tree = _with_names(copy.deepcopy(self._tree), names)
        return Expression(ast.unparse(tree), frozenset(names.get(n, n) for n in self.names), tree)


def parse(text: str, *, where: object = None) -> Expression:
    """Parse numbers, names, ``+ - * / **``, parentheses and a few functions; nothing else is evaluated.

    Names may be FMU names with dots and indices: ``load.J``, ``lossTable[2,4]``.

    Raises
    ------
    ProblemError
        The text is not an expression of this kind.
    """
    try:
        return _parsed(text.strip())
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        functions = ", ".join(_FUNCTIONS)
        raise ProblemError(
            f"{_shown(text)} is not an arithmetic expression",
            where=where,
            fix=f"use numbers, parameters, + - * / ** and {functions}",
        ) from None


def _shown(text: str) -> str:
    """Return the text as messages show it: quoted, and not at length."""
    return f"'{text}'" if len(text) <= _SHOWN else f"'{text[:_SHOWN]}...' ({len(text)} characters)"


def parse_modelica(text: str, *, where: object = None) -> Expression:
    """Parse arithmetic as Modelica writes it, with ``^`` for powers; see `parse`."""
    return parse(text.replace("^", "**"), where=where)


@lru_cache(maxsize=_REMEMBERED)
def _parsed(text: str) -> Expression:
    names: set[str] = set()
    tree = _checked(ast.parse(text, mode="eval").body, names)
    return Expression(text, frozenset(names), tree)


@lru_cache(maxsize=_REMEMBERED)
def _compiled(expression: Expression) -> CodeType:
    tree = ast.Expression(copy.deepcopy(expression._tree))
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            node.ctx = ast.Load()
    return compile(ast.fix_missing_locations(tree), "<formula>", "eval")


def _checked(node: ast.expr, names: set[str]) -> ast.expr:
    """Return the tree with each parameter as a single name, however it is spelt; collects the names."""
    name = _name(node)
    if name is not None:
        names.add(name)
        return ast.Name(id=name)
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            node.value = float(value)  # no unlimited integer powers
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            node.left, node.right = _checked(left, names), _checked(right, names)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            node.operand = _checked(operand, names)
        case ast.Call(func=ast.Name(id=function), args=[_, *_] as arguments, keywords=[]) if (
            function in _FUNCTIONS
        ):
            node.args = [_checked(argument, names) for argument in arguments]
        case _:
            raise ValueError
    return node


def _with_names(node: ast.expr, names: Mapping[str, str]) -> ast.expr:
    match node:
        case ast.Name(id=name):
            return ast.Name(id=names.get(name, name))
        case ast.BinOp(left=left, right=right):
            node.left, node.right = _with_names(left, names), _with_names(right, names)
        case ast.UnaryOp(operand=operand):
            node.operand = _with_names(operand, names)
        case ast.Call(args=arguments):
            node.args = [_with_names(a, names) for a in arguments]
    return node


def _name(node: ast.expr) -> str | None:
    """Return the FMU name that a Name, Attribute or Subscript node spells, or None."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=value, attr=attribute):
            head = _name(value)
            return None if head is None else f"{head}.{attribute}"
        case ast.Subscript(value=value, slice=index):
            head = _name(value)
            indices = index.elts if isinstance(index, ast.Tuple) else [index]
            if head is None or not all(isinstance(i, ast.Constant) and type(i.value) is int for i in indices):
                return None
            return f"{head}[{','.join(ast.unparse(i) for i in indices)}]"
    return None


def _value(node: ast.expr, values: Mapping[str, float]) -> float:
    match node:
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=float() as value):
            return value
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_value(left, values), _value(right, values))
        case ast.UnaryOp(op=op, operand=operand):
            value = _value(operand, values)
            return -value if isinstance(op, ast.USub) else value
        case ast.Call(func=ast.Name(id=function), args=arguments):
            return _FUNCTIONS[function](*(_value(a, values) for a in arguments))
    raise ValueError(ast.dump(node))  # `_checked` accepts nothing else


def _dual(node: ast.expr, values: Mapping[str, float], slopes: Mapping[str, float]) -> tuple[float, float]:
    """Return the value and the derivative, by forward differentiation; at a kink, a one-sided one."""
    match node:
        case ast.Name(id=name):
            return values[name], slopes.get(name, 0.0)
        case ast.UnaryOp(op=op, operand=operand):
            a, da = _dual(operand, values, slopes)
            return (-a, -da) if isinstance(op, ast.USub) else (a, da)
        case ast.BinOp(left=left, op=op, right=right):
            (a, da), (b, db) = _dual(left, values, slopes), _dual(right, values, slopes)
            return _BINARY[type(op)](a, b), _BINARY_SLOPES[type(op)](a, da, b, db)
        case ast.Call(func=ast.Name(id="max" | "min" as function), args=arguments):
            pick = max if function == "max" else min
            return pick((_dual(a, values, slopes) for a in arguments), key=operator.itemgetter(0))
        case ast.Call(func=ast.Name(id=function), args=[argument]):
            a, da = _dual(argument, values, slopes)
            return _FUNCTIONS[function](a), _SLOPES[function](a) * da if da else 0.0
    return _value(node, values), 0.0
