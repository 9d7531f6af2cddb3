"""A flat Modelica model as one immutable value.

This is all that the translation knows of a model. `fmu_build.load` makes it from source; `with_variable`,
`with_parameter`, `with_input`, `with_equation` and `with_term` make a changed copy, which `fmu_build.compile_flat`
translates like any other.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any
from typing import Literal as Choice

from fmu_build.errors import ModelicaError
from fmu_build.model import Experiment
from fmu_build.syntax import (
    ArrayOf,
    Assert,
    Binary,
    Call,
    Expression,
    Literal,
    Part,
    Place,
    Reference,
    Statement,
    WhenStatement,
    references,
)

Type = Choice["Real", "Integer", "Boolean", "String", "ExternalObject"]
Variability = Choice["constant", "parameter", "discrete", "continuous"]
Direction = Choice["input", "output"]
OriginKind = Choice["class", "binding", "flow", "potential", "unconnected", "added"]


@dataclass(frozen=True)
class Variable:
    """A variable of a predefined type, possibly an array.

    Attributes
    ----------
    name, component
        Flat name, and the path of the component it is declared in ("" for the class itself).
    type, type_name, literals
        Predefined type, the type's name as declared, and the literals of an enumeration (whose type is Integer).
    shape
        Sizes of its dimensions.
    direction
        ``input`` or ``output`` as declared, wherever the variable is.
    causality
        The same if the variable is part of the model's own interface, else None.
    flow
        Whether it has the prefix ``flow``.
    binding, start, min, max, nominal
        Flat expressions; None where the source gives none.
    fixed
        One truth value for each element; None where the source gives none.
    final, evaluate, protected
        Whether it cannot be changed, its value is used up by the translation, or it is declared protected.
    """

    name: str
    at: Place
    type: Type = "Real"
    variability: Variability = "continuous"
    component: str = ""
    type_name: str = "Real"
    literals: tuple[str, ...] = ()
    shape: tuple[int, ...] = ()
    direction: Direction | None = None
    causality: Direction | None = None
    flow: bool = False
    binding: Expression | None = None
    start: Expression | None = None
    start_level: int | None = None
    min: Expression | None = None
    max: Expression | None = None
    nominal: Expression | None = None
    fixed: tuple[bool, ...] | None = None
    unit: str | None = None
    display_unit: str | None = None
    quantity: str | None = None
    state_select: str = "default"
    description: str = ""
    final: bool = False
    evaluate: bool = False
    protected: bool = False


@dataclass(frozen=True)
class Origin:
    """Source of an equation.

    Attributes
    ----------
    kind
        ``class``: written in a class; ``binding``: value of a declaration; ``flow``: flow balance of a connection
        set; ``potential``: equality of two connectors of a connection; ``unconnected``: a flow that nothing is
        connected to; ``added``: by `FlatModel.with_equation`.
    component, class_name
        Component whose class has the equation or the connection, and the name of that class.
    connectors
        Paths of the connectors that a flow balance or an equality connects.
    """

    kind: OriginKind
    component: str = ""
    class_name: str = ""
    connectors: tuple[str, ...] = ()


@dataclass(frozen=True)
class Equation:
    """``left = right``; equal forms of an if-equation are one equation with if-expressions."""

    left: Expression
    right: Expression
    origin: Origin
    at: Place

    @cached_property
    def names(self) -> frozenset[str]:
        """The names in it."""
        return frozenset(map(flat_name, references((self.left, self.right))))


@dataclass(frozen=True)
class Algorithm:
    """An algorithm section."""

    statements: tuple[Statement, ...]
    origin: Origin
    at: Place


@dataclass(frozen=True)
class Connector:
    """A connector of the model or of a component.

    Attributes
    ----------
    component
        Path of the component that has it ("" for the model itself).
    potentials, flows
        Flat names of its variables without and with the prefix ``flow`` (elements of arrays with subscripts).
    direction
        ``input`` or ``output`` of a causal connector.
    """

    path: str
    component: str
    class_name: str
    potentials: tuple[str, ...]
    flows: tuple[str, ...]
    direction: Direction | None = None


@dataclass(frozen=True)
class Component:
    """A component that is not a variable: part of the instance tree.

    Attributes
    ----------
    path, parent
        Path of the component and of the one it is in ("" for the model itself).
    class_name, kind
        Qualified name of its class, and the class's kind (``model``, ``block``, ``record``, ``connector`` ...).
    bases
        Qualified names of all classes that its class extends, directly or not.
    """

    path: str
    parent: str
    class_name: str
    kind: str
    bases: tuple[str, ...]
    description: str
    at: Place


@dataclass(frozen=True)
class Formal:
    """An input, output or local variable of a function; a size of None is open (``:``).

    A default that is `outside` is an expression of the component to which the function belongs.
    """

    name: str
    at: Place
    type: str
    shape: tuple[Expression | None, ...] = ()
    default: Expression | None = None
    fields: tuple[Formal, ...] | None = None
    literals: tuple[str, ...] = ()
    outside: bool = False


@dataclass(frozen=True)
class Function:
    """A function.

    Attributes
    ----------
    body
        Its statements.
    external
        Name and arguments of the external function that does the work, and the output that takes its value.
    constructor
        Whether it constructs a record from its inputs and locals.
    """

    name: str
    at: Place
    inputs: tuple[Formal, ...]
    outputs: tuple[Formal, ...]
    locals: tuple[Formal, ...]
    body: tuple[Statement, ...]
    external: tuple[str, tuple[Expression, ...], str | None] | None = None
    constructor: bool = False
    pure: bool = True


def _no_mapping() -> Mapping[str, Function]:
    return MappingProxyType({})


@dataclass(frozen=True)
class FlatModel:
    """A flattened class.

    Attributes
    ----------
    variables
        Variables by flat name, in the order of declaration.
    components, connectors
        The instance tree by path; "" is the model itself.
    files
        Source files that were used.
    libraries
        Versions of the libraries that were used, by name.
    structural
        Names of parameters whose value was used up by flattening (sizes, conditions of components, branches).
    """

    class_name: str
    description: str
    variables: Mapping[str, Variable]
    equations: tuple[Equation, ...]
    components: Mapping[str, Component]
    connectors: Mapping[str, Connector]
    functions: Mapping[str, Function] = field(default_factory=_no_mapping)
    initial_equations: tuple[Equation, ...] = ()
    algorithms: tuple[Algorithm, ...] = ()
    initial_algorithms: tuple[Algorithm, ...] = ()
    whens: tuple[WhenStatement, ...] = ()
    asserts: tuple[Assert, ...] = ()
    experiment: Experiment = field(default_factory=lambda: Experiment(None, None, None, None))
    structural: frozenset[str] = frozenset()
    files: tuple[Path, ...] = ()
    libraries: tuple[tuple[str, str], ...] = ()
    warnings: tuple[str, ...] = ()

    def error(self, what: str, at: Place | None, fix: str | None = None) -> ModelicaError:
        """Make the error for a construct at a place, or for the class as a whole."""
        whole = self.components[""].at if "" in self.components else self.class_name
        return ModelicaError(what, where=at or whole, fix=fix)

    # ---- queries

    def flow_balances(self) -> Iterator[tuple[int, Equation]]:
        """Yield number and equation of each flow balance, including those of unconnected flows."""
        return ((i, e) for i, e in enumerate(self.equations) if e.origin.kind in ("flow", "unconnected"))

    def equalities(self) -> Iterator[tuple[int, Equation]]:
        """Yield number and equation of each equality of potentials that a connection made."""
        return ((i, e) for i, e in enumerate(self.equations) if e.origin.kind == "potential")

    def equations_of(self, component: str) -> Iterator[tuple[int, Equation]]:
        """Yield number and equation of each equation in the class of a component itself."""
        kinds = ("class", "binding")
        return (
            (i, e)
            for i, e in enumerate(self.equations)
            if e.origin.component == component and e.origin.kind in kinds
        )

    def bindings(self) -> Iterator[tuple[str, Expression]]:
        """Yield name and value of each continuous variable that is declared with one."""
        for v in self.variables.values():
            if v.binding is not None and v.variability == "continuous":
                yield v.name, v.binding

    @cached_property
    def computed(self) -> Mapping[str, frozenset[str]]:
        """Names in the value of each parameter that has one, by parameter."""
        return {
            v.name: frozenset(map(flat_name, references(v.binding)))
            for v in self.variables.values()
            if v.variability == "parameter" and v.binding is not None
        }

    # ---- changes

    def with_variable(self, variable: Variable) -> FlatModel:
        """Add a variable, a parameter or an input.

        Raises
        ------
        ModelicaError
            There is already one of that name.
        """
        if variable.name in self.variables:
            raise self.error(f"there is already a variable '{variable.name}'", variable.at)
        return replace(self, variables=MappingProxyType({**self.variables, variable.name: variable}))

    def without_preference(self, names: Iterable[str]) -> FlatModel:
        """Avoid variables as states."""
        avoided = {name: replace(self.variables[name], state_select="avoid") for name in names}
        return replace(self, variables=MappingProxyType({**self.variables, **avoided}))

    def with_preference(self, names: Iterable[str]) -> FlatModel:
        """Prefer variables, or the arrays of elements, as states where the model has no preference."""
        variables = {name: self.variables.get(name.partition("[")[0]) for name in names}
        preferred = {
            v.name: replace(v, state_select="prefer")
            for v in variables.values()
            if v is not None and v.state_select == "default"
        }
        return replace(self, variables=MappingProxyType({**self.variables, **preferred}))

    def with_equation(self, left: Expression, right: Expression) -> FlatModel:
        """Add the equation ``left = right``."""
        return replace(self, equations=(*self.equations, Equation(left, right, Origin("added"), left.at)))

    def with_state(self, name: str, derivative: Expression, start: Expression) -> FlatModel:
        """Make a variable a state: its derivative, and its value at the start."""
        state = variable(name)
        changed = self.with_equation(Call(ADDED, "der", (state,)), derivative)
        initial = Equation(state, start, Origin("added"), ADDED)
        return replace(changed, initial_equations=(*self.initial_equations, initial))

    def with_term(self, number: int, term: Expression, side: Choice["left", "right"] = "left") -> FlatModel:
        """Add a term to a side of the equation of that number."""
        old = self.equations[number]
        new = (
            replace(old, left=Binary(old.at, "+", old.left, term))
            if side == "left"
            else replace(old, right=Binary(old.at, "+", old.right, term))
        )
        return replace(self, equations=(*self.equations[:number], new, *self.equations[number + 1 :]))

    def with_equations(self, equations: Mapping[int, tuple[Equation, ...]]) -> FlatModel:
        """Replace equations, by number, by none or several others."""
        new = [e for i, old in enumerate(self.equations) for e in equations.get(i, (old,))]
        return replace(self, equations=tuple(new))


ADDED = Place("(added)", 0)


def variable(name: str) -> Reference:
    """Refer to a flat variable, or to an element of one (``x[2]``), by its name."""
    base, bracket, inside = name.rpartition("[")
    if not bracket or not name.endswith("]"):
        return Reference(ADDED, (Part(name),))
    subscripts = tuple(Literal(ADDED, int(i)) for i in inside[:-1].split(","))
    return Reference(ADDED, (Part(base, subscripts),))


def number(value: float) -> Literal:
    """Make a literal."""
    return Literal(ADDED, value)


def numbers(values: float | Sequence[Any]) -> Expression:
    """Make literals of a number, or of nested lists of numbers."""
    if isinstance(values, Sequence):
        return ArrayOf(ADDED, tuple(numbers(v) for v in values))
    return number(values)


def flat_name(reference: Reference) -> str:
    """Return the name of the flat variable, or of its element, that a reference denotes."""
    parts = []
    for part in reference.parts:
        inside = [str(s.value) if isinstance(s, Literal) else "?" for s in part.subscripts]
        parts.append(f"{part.name}[{','.join(inside)}]" if inside else part.name)
    return ".".join(parts)


def differentiated(node: object) -> str | None:
    """Return the name of the variable that a node is the derivative of; None for anything else."""
    if isinstance(node, Call) and node.function == "der" and isinstance(node.arguments[0], Reference):
        return flat_name(node.arguments[0])
    return None


def constant(e: Expression | None) -> float | None:
    """Return the value of a literal, possibly with a sign; None for anything else."""
    if isinstance(e, Literal) and isinstance(e.value, int | float) and not isinstance(e.value, bool):
        return float(e.value)
    operator, operand = getattr(e, "operator", None), getattr(e, "operand", None)
    inner = constant(operand) if operator in ("-", "+") else None
    return None if inner is None else -inner if operator == "-" else inner
