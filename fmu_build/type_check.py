"""Types of a flat model: conditions are Boolean, values fit the variables, operands fit the operators.

An expression is of a predefined type, of an enumeration (equal literals make equal types: section 6.3), or unknown
(records, function results that depend on the call). Only known types are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from fmu_build.errors import ModelicaError
from fmu_build.flat_model import FlatModel, Formal, Function, Variable
from fmu_build.syntax import (
    ArrayOf,
    Assert,
    Assign,
    AssignMany,
    Binary,
    Call,
    Comprehension,
    ForStatement,
    If,
    IfStatement,
    Literal,
    Matrix,
    Place,
    Range,
    Reference,
    Reinit,
    Subscripted,
    TupleOf,
    Unary,
    WhenStatement,
    WhileStatement,
)

Kind = str | tuple[str, ...] | None
_NUMBERS = ("Real", "Integer")
_RESULTS: dict[str, Kind] = {
    **dict.fromkeys(("initial", "terminal", "sample", "edge", "change"), "Boolean"),
    **dict.fromkeys(
        ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "log"), "Real"
    ),
    **dict.fromkeys(("log10", "sqrt", "floor", "ceil", "linspace", "semiLinear", "der", "delay"), "Real"),
    **dict.fromkeys(("integer", "sign", "size", "ndims", "zeros", "ones", "identity", "cardinality"), "Integer"),
    "String": "String",
}
_SAME = ("abs", "pre", "noEvent", "fill", "sum", "product", "transpose", "symmetric", "diagonal", "scalar",
         "vector", "matrix", "homotopy", "skew")  # fmt: skip
_AS_ARGUMENT = dict.fromkeys(_SAME, 0) | {"smooth": 1, "cat": 1}  # functions of the type of an argument
_COMMON = ("min", "max", "div", "mod", "rem", "cross", "outerProduct")
_OF_NUMBERS = {name for name, kind in _RESULTS.items() if kind == "Real"} | {
    "abs", "sign", "integer", "div", "mod", "rem", "cross", "outerProduct", "skew", "sum", "product"
}  # fmt: skip


def check(flat: FlatModel) -> None:
    """Raise a `ModelicaError` at the first place where a type does not fit."""
    checker = _Checker(flat, {})
    for variable in flat.variables.values():
        checker.variable(variable)
    for equation in (*flat.equations, *flat.initial_equations):
        checker.alike(checker.kind(equation.left), checker.kind(equation.right), equation.at, "the sides are")
    for section in (*flat.algorithms, *flat.initial_algorithms):
        checker.statements(section.statements)
    checker.statements((*flat.whens, *flat.asserts))
    for function in flat.functions.values():
        _check_function(flat, function)


def shown(kind: Kind) -> str:
    """Name a type in a message."""
    if isinstance(kind, tuple):
        names = ", ".join(kind[:4]) + (", ..." if len(kind) > 4 else "")
        return f"enumeration({names})"
    return str(kind)


def kind_of(declared: Variable | Formal) -> Kind:
    """Return the type of a variable."""
    return declared.literals or (
        declared.type if declared.type in ("Real", "Integer", "Boolean", "String") else None
    )


def _check_function(flat: FlatModel, function: Function) -> None:
    formals = {f.name: f for f in (*function.inputs, *function.outputs, *function.locals)}
    checker = _Checker(flat, formals)
    for formal in formals.values():
        if formal.default is not None:
            checker.fits(checker.kind(formal.default), kind_of(formal), f"'{formal.name}'", formal.at)
    checker.statements(function.body)


class _Checker:
    """Checks the expressions of one scope: the model, or a function with its local variables."""

    def __init__(self, flat: FlatModel, local: Mapping[str, Formal]) -> None:
        self._flat = flat
        self._local = local
        self._iterators: dict[str, Kind] = {}
        common = self._common
        self._handlers: dict[type, Callable[[Any], Kind]] = {
            Literal: self._literal,
            Reference: self._reference,
            Subscripted: lambda n: self.kind(n.base),
            Unary: self._unary,
            Binary: self._binary,
            If: self._if,
            ArrayOf: lambda n: common(n.items, n.at, "the elements of this array are"),
            Matrix: lambda n: common([e for row in n.rows for e in row], n.at, "the elements of [] are"),
            Range: lambda n: common(
                [b for b in (n.start, n.step, n.stop) if b], n.at, "the bounds of a range are"
            ),
            Comprehension: self._comprehension,
            TupleOf: self._tuple,
            Call: self._call,
        }

    # ---- parts of a model

    def variable(self, variable: Variable) -> None:
        """Check the values of a declaration."""
        kind = kind_of(variable)
        what = f"'{variable.name}'"
        if variable.binding is not None:
            self.fits(self.kind(variable.binding), kind, what, variable.at)
        for name in ("start", "min", "max", "nominal"):
            value = getattr(variable, name)
            if value is not None:
                self.fits(self.kind(value), kind, f"{name} of {what}", variable.at)

    def statements(self, statements: Iterable[Any]) -> None:
        """Check statements and those inside them."""
        for s in statements:
            match s:
                case Assign():
                    self.fits(self.kind(s.value), self.kind(s.target), f"'{s.target.name}'", s.at)
                case Reinit():
                    self.fits(self.kind(s.value), self.kind(s.state), f"'{s.state.name}'", s.at)
                case AssignMany():
                    self._assign_many(s)
                case Assert():
                    self.condition(s.condition, s.at)
                    self.fits(self.kind(s.message), "String", "the message of assert", s.at)
                case _:
                    self._compound(s)

    def _compound(self, s: Any) -> None:
        """Check a statement that contains statements."""
        match s:
            case IfStatement() | WhenStatement():
                for condition, body in s.branches:
                    if condition is not None:
                        self.condition(condition, s.at)
                    self.statements(body)
            case WhileStatement():
                self.condition(s.condition, s.at)
                self.statements(s.body)
            case ForStatement():
                self._for(s)

    def _for(self, s: ForStatement) -> None:
        before = dict(self._iterators)
        for name, bounds in s.iterators:
            self._iterators[name] = None if bounds is None else self.kind(bounds)
        self.statements(s.body)
        self._iterators = before

    def _assign_many(self, s: AssignMany) -> None:
        self._call(s.call, alone=True)
        function = self._flat.functions.get(s.call.function)
        if function is None or function.constructor:
            return
        if len(s.targets) > len(function.outputs):
            raise ModelicaError(
                f"{s.call.function}() has {len(function.outputs)} results, not {len(s.targets)}", where=s.at
            )
        for target, output in zip(s.targets, function.outputs, strict=False):
            if target is not None:
                self.fits(kind_of(output), self.kind(target), f"'{target.name}'", s.at)

    # ---- rules

    def condition(self, node: Any, at: Place) -> None:
        """Check that a condition is Boolean."""
        kind = self.kind(node)
        if kind not in (None, "Boolean"):
            raise ModelicaError(f"a condition must be Boolean, not {shown(kind)}", where=at)

    @staticmethod
    def fits(kind: Kind, wanted: Kind, what: str, at: Place) -> None:
        """Check that a value can be given to something of a type: an Integer may be a Real."""
        if kind is None or wanted is None or kind == wanted or (kind == "Integer" and wanted == "Real"):
            return
        fix = "use integer()" if (kind, wanted) == ("Real", "Integer") else None
        raise ModelicaError(f"{what} is {shown(wanted)}, but its value is {shown(kind)}", where=at, fix=fix)

    @staticmethod
    def alike(a: Kind, b: Kind, at: Place, what: str) -> Kind:
        """Return the common type of two expressions that are combined."""
        if a is None or b is None or a == b:
            return a or b
        if a in _NUMBERS and b in _NUMBERS:
            return "Real"
        raise ModelicaError(f"{what} {shown(a)} and {shown(b)}", where=at)

    def _number(self, kind: Kind, what: str, at: Place) -> None:
        if kind is not None and kind not in _NUMBERS:
            raise ModelicaError(f"{what} must be a number, not {shown(kind)}", where=at)

    def _common(self, nodes: Sequence[Any], at: Place, what: str) -> Kind:
        out: Kind = None
        for node in nodes:
            out = self.alike(out, self.kind(node), at, what)
        return out

    # ---- expressions

    def kind(self, node: Any) -> Kind:
        """Return the type of an expression; check its parts."""
        handler = self._handlers.get(type(node))
        return None if handler is None else handler(node)

    @staticmethod
    def _literal(node: Literal) -> Kind:
        value = node.value
        if isinstance(value, bool | str):
            return "Boolean" if isinstance(value, bool) else "String"
        return node.literals or ("Integer" if isinstance(value, int) else "Real")

    def _if(self, node: If) -> Kind:
        for condition, _ in node.branches:
            self.condition(condition, node.at)
        values = [*(v for _, v in node.branches), node.otherwise]
        return self._common(values, node.at, "the branches of this if are")

    def _tuple(self, node: TupleOf) -> Kind:
        for item in node.items:
            self.kind(item)
        return None

    def _reference(self, node: Reference) -> Kind:
        name = node.parts[0].name
        if name in self._iterators:
            return self._iterators[name]
        if name == "time" and not self._local:
            return "Real"
        declared: Variable | Formal | None = self._local.get(name) or self._flat.variables.get(name)
        for part in node.parts[1:]:
            fields = declared.fields if isinstance(declared, Formal) else None
            declared = next((f for f in fields or () if f.name == part.name), None)
        return None if declared is None else kind_of(declared)

    def _unary(self, node: Unary) -> Kind:
        kind = self.kind(node.operand)
        if node.operator == "not":
            if kind not in (None, "Boolean"):
                raise ModelicaError(f"the operand of 'not' must be Boolean, not {shown(kind)}", where=node.at)
            return "Boolean"
        self._number(kind, f"the operand of '{node.operator}'", node.at)
        return kind

    def _binary(self, node: Binary) -> Kind:
        op, a, b = node.operator, self.kind(node.left), self.kind(node.right)
        if op in ("and", "or"):
            for kind in (a, b):
                if kind not in (None, "Boolean"):
                    raise ModelicaError(f"an operand of '{op}' must be Boolean, not {shown(kind)}", where=node.at)
            return "Boolean"
        if op in ("<", "<=", ">", ">=", "==", "<>"):
            self.alike(a, b, node.at, f"the operands of '{op}' are")
            return "Boolean"
        if op == "+" and "String" in (a, b):
            return self.alike(a, b, node.at, "the operands of '+' are")
        for kind in (a, b):
            self._number(kind, f"an operand of '{op}'", node.at)
        if op in ("/", "./", "^", ".^"):
            return "Real" if a is not None and b is not None else None
        return None if a is None or b is None else self.alike(a, b, node.at, "")

    def _comprehension(self, node: Comprehension) -> Kind:
        before = dict(self._iterators)
        for name, bounds in node.iterators:
            self._iterators[name] = None if bounds is None else self.kind(bounds)
        kind = self.kind(node.element)
        self._iterators = before
        return kind

    def _derivative(self, node: Call) -> None:
        """Check that an argument of der() is Real and not discrete."""
        argument = node.arguments[0] if node.arguments else None
        kind = self.kind(argument)
        if kind not in (None, "Real"):
            raise ModelicaError(f"the argument of der() must be Real, not {shown(kind)}", where=node.at)
        variable = self._flat.variables.get(argument.name) if isinstance(argument, Reference) else None
        if variable is not None and variable.variability == "discrete":
            raise ModelicaError(f"'{variable.name}' is discrete and has no derivative", where=node.at)

    def _call(self, node: Call, alone: bool = False) -> Kind:
        name = node.function
        kinds = [None if a is None else self.kind(a) for a in node.arguments]
        function = self._flat.functions.get(name)
        if function is not None:
            for formal, kind in zip(function.inputs, kinds, strict=False):
                self.fits(kind, kind_of(formal), f"argument '{formal.name}' of {name}()", node.at)
            if function.constructor:
                return None
            if not function.outputs:
                if not alone:
                    raise ModelicaError(f"{name}() has no result", where=node.at)
                return None
            return kind_of(function.outputs[0])
        if name == "der":
            self._derivative(node)
        if name in _OF_NUMBERS:
            for kind in kinds:
                self._number(kind, f"the argument of {name}()", node.at)
        if name in _COMMON:
            return self._common(node.arguments, node.at, f"the arguments of {name}() are")
        position = _AS_ARGUMENT.get(name, len(kinds))
        return kinds[position] if position < len(kinds) else _RESULTS.get(name)
