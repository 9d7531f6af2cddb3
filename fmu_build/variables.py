"""The declared variables of a flat class, scalar by scalar, and the parameters' values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value
from fmu_build.flat_model import FlatModel, Variable
from fmu_build.graph import SX, key
from fmu_build.model import Type
from fmu_build.syntax import Place, references

_MOST = 2**31  # absolute value of an Integer
_OF_TYPE, _NO_START = 1_000_000, 2_000_000  # ranks of start values
Kind = Literal["constant", "parameter", "input", "discrete", "continuous"]


@dataclass
class Declared:
    """One scalar variable as declared.

    Attributes
    ----------
    name, position, variable
        Scalar name, row-major position in its array, and the flat (array) variable.
    symbol
        SX symbol; for constants and parameters known at translation, the number.
    literals
        Names of the enumeration's literals; empty for other types.
    """

    name: str
    position: int
    variable: Variable
    kind: Kind
    type: Type
    symbol: Scalar
    literals: tuple[str, ...] = ()

    @property
    def at(self) -> Place:
        """Place of its declaration."""
        return self.variable.at

    @property
    def fixed(self) -> bool | None:
        """The ``fixed`` attribute; None where not given."""
        fixed = self.variable.fixed
        if not fixed:
            return None
        return fixed[self.position] if len(fixed) > 1 else fixed[0]

    @property
    def start_rank(self) -> int:
        """Rank of its start value, the lowest first: level at which it is written, that of a type, none."""
        if self.variable.start is None:
            return _NO_START
        level = self.variable.start_level
        return _OF_TYPE if level is None else level

    @property
    def is_start_written(self) -> bool:
        """Whether the model or one of its components, not only the type, gives a start value."""
        return self.start_rank < _OF_TYPE

    @property
    def has_start(self) -> bool:
        """Whether the source gives a start value."""
        return self.variable.start is not None


def names(name: str, dims: tuple[int, ...]) -> list[str]:
    """Scalar names of an array variable in row-major order: ``a[1,2]``."""
    if not dims:
        return [name]
    return [f"{name}[{','.join(str(i + 1) for i in at)}]" for at in Array.fill(dims, 0).indices()]


class Declarations:
    """All declared scalars by name, and the whole variables as values.

    Parameters
    ----------
    flat
        The flat model.
    discrete
        Names of Real variables that are assigned in when-clauses.
    structural
        Names of further parameters whose value is used up by the translation.
    """

    def __init__(self, flat: FlatModel, discrete: set[str], structural: set[str]) -> None:
        self.flat = flat
        self.scalars: dict[str, Declared] = {}
        self.by_symbol: dict[int, Declared] = {}
        self.values: dict[str, Value] = {}
        self._structural = _structural_parameters(flat, structural)
        for variable in flat.variables.values():
            self._declare(variable, discrete)

    def _declare(self, variable: Variable, discrete: set[str]) -> None:
        kind = self._kind(variable, discrete)
        if variable.type == "String" or variable.type == "ExternalObject":
            if kind not in ("parameter", "constant") and variable.type == "String":
                what = f"'{variable.name}': Strings that are not parameters are not supported"
                raise self.flat.error(what, variable.at)
            return  # a String or an external object only matters where an expression uses it
        items: list[Scalar] = []
        for position, scalar in enumerate(names(variable.name, variable.shape)):
            symbol = SX.sym(scalar)
            declared = Declared(scalar, position, variable, kind, variable.type, symbol, variable.literals)
            self.scalars[scalar] = declared
            self.by_symbol[key(symbol)] = declared
            items.append(symbol)
        self.values[variable.name] = Array(variable.shape, tuple(items)) if variable.shape else items[0]

    def _kind(self, variable: Variable, discrete: set[str]) -> Kind:
        if variable.variability == "constant" or variable.name in self._structural:
            return "constant"
        if variable.variability == "parameter":
            return "parameter"
        if variable.causality == "input":
            return "input"
        if variable.variability == "discrete" or variable.type != "Real" or variable.name in discrete:
            return "discrete"
        return "continuous"

    def attribute(self, declared: Declared, name: str, evaluate: Any) -> Scalar | None:
        """Value of ``start``, ``min``, ``max`` or ``nominal`` for one scalar; None if not given."""
        node = getattr(declared.variable, name)
        if node is None:
            return None
        value = evaluate(node)
        if isinstance(value, Array):
            return value.items[declared.position]
        if not isinstance(value, bool | int | float | SX):
            raise self.flat.error(f"{name} of '{declared.name}' is {algebra.kind(value)}", declared.at)
        return value


def _structural_parameters(flat: FlatModel, more: set[str]) -> set[str]:
    """Parameters whose value is used up: array sizes, loop ranges, branches, conditional parts.

    The parameters on which such a parameter depends are used up with it.
    """
    out: set[str] = set()
    for name in (*flat.structural, *more):
        out |= _with_used(flat, name)
    for variable in flat.variables.values():
        if variable.evaluate and variable.variability == "parameter":
            used = _with_used(flat, variable.name)
            # ``Evaluate = true`` is a wish, which initial equations do not grant.
            if not any(_is_open(flat.variables[n]) for n in used):
                out |= used
    return out


def _is_open(variable: Variable) -> bool:
    """Whether initial equations determine a parameter."""
    return True not in (variable.fixed or (True,))


def _with_used(flat: FlatModel, name: str) -> set[str]:
    """Return a parameter and all on which it depends."""
    out: set[str] = set()
    left = [name]
    while left:
        name = left.pop()
        variable = flat.variables.get(name)
        if name not in out and variable is not None:
            out.add(name)
            left += [used.name for used in references(variable.binding)]
    return out


class Parameters:
    """Values of constants and parameters: numbers, independent symbols ``p``, dependent expressions ``d``.

    The first look-up of a parameter evaluates its binding, so bindings are met in the order of their dependence.
    """

    def __init__(self, declarations: Declarations) -> None:
        self._declarations = declarations
        self._flat = declarations.flat
        self._values: dict[str, Value] = {}
        self._open: list[str] = []
        self.independent: list[tuple[Declared, float]] = []
        self.dependent: list[tuple[Declared, SX]] = []
        self.aliases: dict[str, SX] = {}
        self.from_initial: list[Declared] = []
        self.warnings: list[str] = []

    def lookup(self, name: str, evaluate: Any) -> Value:
        """Value of a constant or parameter; `evaluate` evaluates its binding."""
        if name in self._values:
            return self._values[name]
        variable = self._flat.variables[name]
        if name in self._open:
            circle = " -> ".join([*self._open[self._open.index(name) :], name])
            raise self._flat.error(f"parameters depend on each other: {circle}", variable.at)
        self._open.append(name)
        value = self._bound(name, variable, evaluate)
        self._open.pop()
        self._values[name] = value
        return value

    def _bound(self, name: str, variable: Variable, evaluate: Any) -> Value:
        if variable.variability == "parameter" and _is_open(variable):
            for scalar in names(name, variable.shape):
                self.from_initial.append(self._declarations.scalars[scalar])
            return self._declarations.values[name]
        source = variable.binding if variable.binding is not None else variable.start
        if variable.binding is None and 0 not in variable.shape:
            self.warnings.append(f"parameter '{name}' has no value, so its start value is used")
        defaults: dict[str, Value] = {"String": "", "Boolean": False, "Real": 0.0}
        bound: Value = evaluate(source) if source is not None else defaults.get(variable.type, 0)
        if variable.type in ("String", "ExternalObject") or isinstance(bound, str | dict):
            return bound
        shape = variable.shape
        if not isinstance(bound, Array) and shape:
            bound = Array.fill(shape, algebra.scalars(bound)[0])
        if isinstance(bound, Array) and bound.shape != shape:
            what = f"'{name}' has size {list(shape)}, its value has size {list(bound.shape)}"
            raise self._flat.error(what, variable.at)
        # Nobody could set a protected parameter that follows from constants: it is one.
        fixed = variable.final or (variable.protected and any(references(variable.binding)))
        items = [
            self._scalar(self._declarations.scalars[scalar], item, fixed)
            for scalar, item in zip(names(name, shape), algebra.scalars(bound), strict=True)
        ]
        return Array(shape, tuple(items)) if shape else items[0]

    def _checked(self, declared: Declared, value: float) -> float:
        """Return a number as one of a declared type."""
        if math.isnan(value):
            raise self._flat.error(f"the value of '{declared.name}' is not a number", declared.at)
        if declared.type == "Integer" and abs(value) > _MOST:
            raise self._flat.error(f"integer overflow: '{declared.name}' would be {value}", declared.at)
        return float(value) if declared.type == "Real" else value

    def _scalar(self, declared: Declared, value: Scalar, fixed: bool) -> Scalar:
        if isinstance(value, SX):
            value = algebra.fold(value)
        if isinstance(value, SX):
            for symbol in ca.symvar(value):
                source = self._declarations.by_symbol.get(key(symbol))
                if source is None or source.kind != "parameter":
                    what = f"parameter '{declared.name}' depends on '{symbol.name()}', which is not a parameter"
                    uses = {r.name: r.at for r in references(declared.variable.binding)}
                    raise self._flat.error(what, uses.get(symbol.name(), declared.at))
            if declared.kind == "constant":
                what = f"'{declared.name}' determines the structure and must not depend on settable parameters"
                raise self._flat.error(what, declared.at)
            if value.is_symbolic():
                self.aliases[declared.name] = value
                return value
            self.dependent.append((declared, value))
            return declared.symbol
        value = self._checked(declared, value)
        if declared.kind == "constant" or fixed:
            declared.kind = "constant"
            declared.symbol = value
            return value
        self.independent.append((declared, float(value)))
        return declared.symbol
