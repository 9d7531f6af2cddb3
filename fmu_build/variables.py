"""The declared variables of a flat class, scalar by scalar, and the parameters' values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca

from fmu_build import algebra
from fmu_build.algebra import Array, Scalar, Value
from fmu_build.frontend import Flat, Node, references
from fmu_build.graph import SX, key
from fmu_build.model import Type

Kind = Literal["constant", "parameter", "input", "discrete", "continuous"]
_TYPES: dict[str, Type] = {"real": "Real", "integer": "Integer", "boolean": "Boolean"}


@dataclass
class Declared:
    """One scalar variable as declared.

    Attributes
    ----------
    name, position, node
        Scalar name, row-major position in its array, and rumoca's node of the (array) variable.
    symbol
        SX symbol; for constants and parameters known at translation, the number.
    literals
        Names of the enumeration's literals; empty for other types.
    """

    name: str
    position: int
    node: Node
    kind: Kind
    type: Type
    symbol: Scalar
    literals: tuple[str, ...] = ()

    @property
    def span(self) -> Any:
        """Source span of the declaration."""
        return self.node["source_span"]

    @property
    def fixed(self) -> bool | None:
        """The ``fixed`` attribute; None where not given."""
        fixed = self.node["fixed"]
        if not fixed:
            return None
        return bool(fixed[self.position] if len(fixed) > 1 else fixed[0])

    @property
    def has_start(self) -> bool:
        """Whether the source gives a start value (rumoca fills in defaults with the declaration's own span)."""
        start = self.node["start"]
        if start is None:
            return False
        ((_, content),) = start.items()
        return bool(content.get("span") != self.node["source_span"])


def names(name: str, dims: list[int]) -> list[str]:
    """Scalar names of an array variable in row-major order: ``a[1,2]``."""
    if not dims:
        return [name]
    return [f"{name}[{','.join(str(i + 1) for i in at)}]" for at in Array.fill(dims, 0).indices()]


def kind_word(node: Node) -> str:
    """Return rumoca's variability or causality as one word."""
    return next(iter(node)) if isinstance(node, Mapping) else str(node)


class Declarations:
    """All declared scalars by name, and the whole variables as values.

    Parameters
    ----------
    flat
        The flat class.
    discrete
        Names of Real variables that are assigned in when-clauses.
    structural
        Names of further parameters whose value is used up by the translation.
    """

    def __init__(self, flat: Flat, discrete: set[str], structural: set[str]) -> None:
        self.flat = flat
        self.scalars: dict[str, Declared] = {}
        self.by_symbol: dict[int, Declared] = {}
        self.values: dict[str, Value] = {}
        self._structural = _structural_parameters(flat, structural)
        for name, node in flat.parts["variables"].items():
            if not flat.is_outer(node):
                self._declare(name, node, discrete)

    def _declare(self, name: str, node: Node, discrete: set[str]) -> None:
        if not node["is_primitive"]:
            raise self.flat.error(f"'{name}' is not of a predefined type", node["source_span"])
        for flag in ("stream", "is_overconstrained"):
            if node[flag]:
                raise self.flat.error(f"'{name}': {flag.replace('is_', '')} variables", node["source_span"])
        type_name, literals = self._type(name, node)
        kind = self._kind(name, node, type_name, discrete)
        if type_name is None:
            if kind not in ("parameter", "constant"):
                what = f"'{name}': Strings and external objects that are no parameters are not supported"
                raise self.flat.error(what, node["source_span"])
            return  # a String or an external object matters only where an expression uses it
        items: list[Scalar] = []
        for position, scalar in enumerate(names(name, node["dims"])):
            symbol = SX.sym(scalar)
            declared = Declared(scalar, position, node, kind, type_name, symbol, literals)
            self.scalars[scalar] = declared
            self.by_symbol[key(symbol)] = declared
            items.append(symbol)
        self.values[name] = Array(tuple(node["dims"]), tuple(items)) if node["dims"] else items[0]

    def _type(self, name: str, node: Node) -> tuple[Type | None, tuple[str, ...]]:
        canonical = self.flat.parts["effective_types"][str(node["type_id"])]["canonical_type"]
        for word, identity in self.flat.parts["predefined_types"].items():
            if identity == canonical and word in _TYPES:
                return _TYPES[word], ()
            if identity == canonical and word == "string":
                return None, ()
        if canonical in [*self.flat["enumeration_types"], *self.flat["enumeration_type_roots"]]:
            prefix = self.flat.parts["variable_type_names"][name] + "."
            ordinals = self.flat.parts["enum_literal_ordinals"].items()
            found = {n: o for n, o in ordinals if n.startswith(prefix) and "'" not in n}
            ordered = sorted(found, key=lambda n: int(found[n]))
            return "Integer", tuple(n.removeprefix(prefix) for n in ordered)
        constructor = ((node["binding"] or {}).get("FunctionCall") or {}).get("name", {}).get("name")
        if (self.flat["functions"] or {}).get(constructor, {}).get("external"):
            return None, ()
        raise self.flat.error(f"'{name}' has a type that is not supported", node["source_span"])

    def _kind(self, name: str, node: Node, type_name: Type | None, discrete: set[str]) -> Kind:
        variability, causality = kind_word(node["variability"]), kind_word(node["causality"])
        if variability == "Constant" or name in self._structural:
            return "constant"
        if variability == "Parameter":
            return "parameter"
        if causality == "Input" and _root(name) in self.flat["top_level_input_components"]:
            return "input"
        if variability == "Discrete" or type_name != "Real" or name in discrete:
            return "discrete"
        if variability not in ("Empty", "Continuous"):
            raise self.flat.error(f"'{name}' is {variability.lower()}", node["source_span"])
        return "continuous"

    def is_output(self, declared: Declared) -> bool:
        """Whether a scalar is an output of the class itself."""
        name = declared.node["name"]
        top = "." not in name or _root(name) in self.flat["top_level_connectors"]
        return kind_word(declared.node["causality"]) == "Output" and top

    def attribute(self, declared: Declared, name: str, evaluate: Any) -> Scalar | None:
        """Value of ``start``, ``min``, ``max`` or ``nominal`` for one scalar; None if not given."""
        node = declared.node[name]
        if node is None:
            return None
        value = evaluate(node)
        if isinstance(value, Array):
            return value.items[declared.position]
        if not isinstance(value, bool | int | float | SX):
            raise self.flat.error(f"{name} of '{declared.name}' is {algebra.kind(value)}", declared.span)
        return value


def _root(name: str) -> str:
    return name.partition(".")[0].partition("[")[0]


def _structural_parameters(flat: Flat, more: set[str]) -> set[str]:
    """Parameters whose value the front end has used up: array sizes, loop ranges, branches, conditional parts.

    What such a parameter's value is made of is used up with it.
    """
    variables = flat.parts["variables"]
    out: set[str] = set()
    left = [".".join(r) for selection in flat["parameter_branch_selections"] for r in selection["references"]]
    left += [*sorted(more), *(name for name, node in variables.items() if node["evaluate"])]
    while left:
        name = left.pop()
        if name not in out:
            out.add(name)
            node = variables.get(name)
            left += [used for used, _ in references(node["binding"])] if node else []
    return out


class Parameters:
    """Values of constants and parameters: numbers, independent symbols ``p``, dependent expressions ``d``.

    The first look at a parameter evaluates its binding, so bindings are met in the order of their dependence.
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
        node = self._flat.parts["variables"][name]
        if name in self._open:
            circle = " -> ".join([*self._open[self._open.index(name) :], name])
            raise self._flat.error(f"parameters depend on each other: {circle}", node["source_span"])
        self._open.append(name)
        value = self._bound(name, node, evaluate)
        self._open.pop()
        self._values[name] = value
        return value

    def _bound(self, name: str, node: Node, evaluate: Any) -> Value:
        if kind_word(node["variability"]) == "Parameter" and node["fixed"] and not any(node["fixed"]):
            for scalar in names(name, node["dims"]):
                self.from_initial.append(self._declarations.scalars[scalar])
            return self._declarations.values[name]
        if node["binding"] is None:
            self.warnings.append(f"parameter '{name}' has no value, its start value is taken")
        bound = evaluate(node["binding"] if node["binding"] is not None else node["start"])
        if isinstance(bound, str | dict):
            return bound
        shape = tuple(node["dims"])
        if not isinstance(bound, Array) and shape:
            bound = Array.fill(shape, algebra.scalars(bound)[0])
        if isinstance(bound, Array) and bound.shape != shape:
            what = f"'{name}' has size {list(shape)}, its value has size {list(bound.shape)}"
            raise self._flat.error(what, node["source_span"])
        final = self._flat.parts["variable_final_flags"].get(name, False)
        items = [
            self._scalar(self._declarations.scalars[scalar], item, final)
            for scalar, item in zip(names(name, node["dims"]), algebra.scalars(bound), strict=True)
        ]
        return Array(shape, tuple(items)) if shape else items[0]

    def _scalar(self, declared: Declared, value: Scalar, final: bool) -> Scalar:
        if isinstance(value, SX):
            value = algebra.fold(value)
        if isinstance(value, SX):
            for symbol in ca.symvar(value):
                source = self._declarations.by_symbol.get(key(symbol))
                if source is None or source.kind != "parameter":
                    what = f"parameter '{declared.name}' depends on '{symbol.name()}', which is no parameter"
                    uses = dict(references(declared.node["binding"]))
                    raise self._flat.error(what, uses.get(symbol.name(), declared.span))
            if declared.kind == "constant":
                what = f"'{declared.name}' decides the structure and must not depend on settable parameters"
                raise self._flat.error(what, declared.span)
            if value.is_symbolic():
                self.aliases[declared.name] = value
                return value
            self.dependent.append((declared, value))
            return declared.symbol
        if math.isnan(value):
            raise self._flat.error(f"'{declared.name}' has no number for a value", declared.span)
        if declared.type == "Real":
            value = float(value)
        if declared.kind == "constant" or final:
            declared.kind = "constant"
            declared.symbol = value
            return value
        self.independent.append((declared, float(value)))
        return declared.symbol
