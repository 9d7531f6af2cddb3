"""Terms added to a flat model at its ports, all of them off at the neutral values of their parameters."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal as Choice
from typing import cast

from fmu_build.errors import ModelicaError
from fmu_build.flat_model import ADDED, Equation, FlatModel, Variable, flat_name, number, variable
from fmu_build.front.parser import expression as parse_expression
from fmu_build.model_ports import Port, coefficients, equations_with, fed_inputs, find_ports, followers
from fmu_build.suggest import suggestion
from fmu_build.syntax import Binary, Call, Expression, Part, Reference, Unary, references, transform
from fmu_build.written_balances import Share

Acts = Choice["flow", "potential", "signal", "cut", "parameter"]
VALUE = "varying"  # of a coefficient: `R.varying` is the value that takes the place of the parameter `R`


@dataclass(frozen=True)
class State:
    """A state of a term: its derivative and its start value, as Modelica expressions."""

    name: str
    derivative: str
    start: str = "0"
    unit: str = ""


@dataclass(frozen=True)
class Term:
    """A Modelica expression that acts at a port.

    Attributes
    ----------
    port
        Name of the port, or of the parameter.
    acts
        ``flow``: a flow out of a node, or out of a branch's second node and into its first; ``potential``: a drop
        of the potential at a branch's first connector; ``signal``: replaces the signal; ``cut``: separates the
        first connector from its node, and is a flow between the two, driven by their difference ``p``;
        ``parameter``: replaces the parameter, whose own value is ``p``, in all equations.
    expression
        An expression of the port's quantities, `states`, parameters, ``time`` and any variable by its full name.
    where
        Place for error messages.
    states
        Its own states. They affect the choice of steps, so a model with such a term gives the plain model's
        results only within the tolerance.
    reaction
        Of a drop that depends on ``position``: a flow out of the node at the branch's first connector. Without
        loss of power, it is minus the flow through the branch times the derivative of the drop by the position.
    """

    port: str
    acts: Acts
    expression: str
    where: str = ""
    states: tuple[State, ...] = ()
    reaction: str = ""


@dataclass(frozen=True)
class Added:
    """A parameter or an input that terms use: name, neutral value and unit."""

    name: str
    value: float = 0.0
    unit: str = ""
    description: str = ""
    input: bool = False


def instrument(flat: FlatModel, terms: Sequence[Term], added: Iterable[Added]) -> FlatModel:
    """Return the model with terms at its ports and the parameters and inputs that they use.

    Where every term is zero (or the signal itself) and has no states, results are bit for bit those of the plain
    model. A ``cut`` always changes the model: it does not include a rigid connection as a special case.

    Raises
    ------
    ModelicaError
        A term names a port or a variable that does not exist, or is not a Modelica expression.
    """
    ports = {port.name: port for port in find_ports(flat)}
    for one in dict.fromkeys(added):  # terms may share an input
        flat = flat.with_variable(
            Variable(
                one.name, ADDED, variability="continuous" if one.input else "parameter",
                direction="input" if one.input else None, causality="input" if one.input else None,
                start=number(one.value) if one.input else None, binding=None if one.input else number(one.value),
                unit=one.unit or None, description=one.description,
            )
        )  # fmt: skip
    for state in (state for term in terms for state in term.states):
        flat = flat.with_variable(Variable(state.name, ADDED, unit=state.unit or None))
    at: dict[tuple[str, Acts], list[Term]] = defaultdict(list)
    for term in terms:
        if term.port not in ports and term.acts != "parameter":
            raise ModelicaError(
                f"the model has no port '{term.port}'", where=term.where, fix=suggestion(term.port, ports)
            )
        at[term.port, term.acts].append(term)
    # Equations keep their numbers, so those of a connection are replaced one by one.
    # What acts on written equations, which are known by their numbers, comes before a cut makes two of one.
    varied = {name: added_terms for (name, acts), added_terms in at.items() if acts == "parameter"}
    elsewhere = {place: added_terms for place, added_terms in at.items() if place[1] != "parameter"}
    for (name, acts), added_terms in sorted(elsewhere.items(), key=lambda one: not ports[one[0][0]].shares):
        port = ports[name]
        if acts == "flow" or port.kind == "loop":
            flat = _with_flow(flat, port, added_terms)
        elif acts == "potential":
            flat = (_with_written_drop if port.shares else _with_drop)(flat, port, added_terms)
        elif acts == "cut":
            flat = _with_cut(flat, port, added_terms)
        else:
            flat = _with_signal(flat, port, added_terms)
    # Those in a single equation first, so that what replaces the parameter elsewhere acts in them as well.
    for name, added_terms in sorted(varied.items(), key=lambda one: ":" not in one[0]):
        flat = _with_coefficient(flat, name, added_terms)
    return flat


def _new(flat: FlatModel, name: str) -> str:
    """Return a name that the model does not have; an earlier diagnosis may have added the same."""
    while name in flat.variables:
        name += "_"
    return name


def _with_states(flat: FlatModel, terms: Sequence[Term], quantities: Mapping[str, Expression]) -> FlatModel:
    for term in terms:
        for state in term.states:
            derivative, start = (
                _expression(flat, replace(term, expression=text), quantities)
                for text in (state.derivative, state.start)
            )
            flat = flat.with_state(state.name, derivative, start)
    return flat


def _total(flat: FlatModel, terms: Sequence[Term], quantities: Mapping[str, Expression]) -> Expression:
    parts = [_expression(flat, term, quantities) for term in terms]
    total = parts[0]
    for part in parts[1:]:
        total = Binary(ADDED, "+", total, part)
    return total


def _expression(flat: FlatModel, term: Term, quantities: Mapping[str, Expression]) -> Expression:
    """Parse a term and substitute the meaning of its names."""
    from fmu_build.builtin_functions import SUPPORTED, UNSUPPORTED  # needs CasADi, and the types here do not

    def resolve(node: Expression) -> Expression:
        if isinstance(node, Call) and not (node.function in SUPPORTED or node.function in flat.functions):
            if node.function in UNSUPPORTED:
                raise ModelicaError(f"'{node.function}' is not supported", where=term.where)
            raise ModelicaError(f"there is no function '{node.function}'", where=term.where,
                                fix=suggestion(node.function, SUPPORTED))  # fmt: skip
        if not isinstance(node, Reference):
            return node
        name = flat_name(node)
        if name in quantities:
            return quantities[name]
        if name in flat.variables:
            return Reference(ADDED, (Part(name),))
        if name.rpartition("[")[0] in flat.variables:
            return variable(name)
        if name == "time":
            return node
        known = [*quantities, *flat.variables]
        raise ModelicaError(f"'{name}' is unknown at port '{term.port}'", where=term.where,
                            fix=suggestion(name, known))  # fmt: skip

    return cast(Expression, transform(parse_expression(term.expression, term.where or "(expression)"), resolve))


def _with_flow(flat: FlatModel, port: Port, terms: Sequence[Term]) -> FlatModel:
    if port.kind == "signal":
        raise ModelicaError(f"'{port.name}' is a signal and has no flow", where=terms[0].where)
    total = _total(flat, terms, port.quantities)
    for share in port.shares or _shares(flat, port):
        flow = total if share.factor is None else Binary(ADDED, "*", share.factor, total)
        flat = flat.with_term(share.equation, flow if share.added else Unary(ADDED, "-", flow), share.side)
    return _with_states(flat, terms, port.quantities)


def _shares(flat: FlatModel, port: Port) -> Iterator[Share]:
    """Yield what a flow out of a node, or from a branch's second node to its first, adds to flow balances."""
    signs = (True,) if port.kind == "node" else (False, True)
    for connector, added in zip(port.connectors, signs, strict=True):
        i = next(i for i, e in flat.flow_balances() if connector in e.origin.connectors)
        yield Share(i, "left", added)


def _with_drop(flat: FlatModel, port: Port, terms: Sequence[Term]) -> FlatModel:
    """Separate the first connector of a branch from its node, and connect the two by a drop of the potential."""
    if port.kind != "branch":
        raise ModelicaError(f"'{port.name}' is not a branch, so it has no potential drop", where=terms[0].where)
    inner, other = (flat.connectors[c].potentials[0] for c in port.connectors)
    node, changed = _parted(flat, port.connectors[0], terms[0].where)
    quantities = {**port.quantities, "p": Binary(ADDED, "-", variable(other), node), "position": node}
    first, equation = next(iter(changed.items()))
    drop = Binary(ADDED, "-", node, _total(flat, terms, quantities))
    changed[first] = (replace(equation[0], left=variable(inner), right=drop),)
    flat = flat.with_equations(changed).without_preference(port.preferred)
    reactions = [replace(term, expression=term.reaction) for term in terms if term.reaction]
    if reactions:
        i = next(i for i, e in flat.flow_balances() if port.connectors[0] in e.origin.connectors)
        flat = flat.with_term(i, _total(flat, reactions, quantities))
    return _with_states(flat, terms, quantities)


def _with_written_drop(flat: FlatModel, port: Port, terms: Sequence[Term]) -> FlatModel:
    """Put another difference of potentials in the place of the one that the model has written."""
    if not port.differences:
        what = f"'{port.name}' is not a difference of two potentials, so it has no potential drop"
        raise ModelicaError(what, where=terms[0].where)
    name = _new(flat, f"{port.name}.difference")
    flat = flat.with_variable(Variable(name, ADDED, unit=port.units[0] or None))
    new: dict[bool, Expression] = {False: variable(name), True: Call(ADDED, "der", (variable(name),))}

    def put_in(node: Expression) -> Expression:
        difference = next((d for d in port.differences if d.node == node), None)
        if difference is None:
            return node
        return Unary(ADDED, "-", new[difference.rates]) if difference.negative else new[difference.rates]

    sides = {i: [transform(side, put_in) for side in (e.left, e.right)] for i, e in enumerate(flat.equations)}
    changed = {i: (replace(flat.equations[i], left=left, right=right),) for i, (left, right) in sides.items()}
    bindings = {n: transform(v.binding, put_in) for n, v in flat.variables.items() if v.binding is not None}
    variables = {n: replace(v, binding=bindings.get(n)) for n, v in flat.variables.items()}
    total = Binary(ADDED, "+", port.quantities["p"], _total(flat, terms, port.quantities))
    flat = replace(flat.with_equations(changed), variables=MappingProxyType(variables))
    return _with_states(flat.with_equation(variable(name), total), terms, port.quantities)


def _with_cut(flat: FlatModel, port: Port, terms: Sequence[Term]) -> FlatModel:
    """Separate a connector from its node, and let a flow pass between the two."""
    connector = port.connectors[0]
    if port.kind == "signal":
        raise ModelicaError(f"'{port.name}' is a signal and cannot be cut", where=terms[0].where)
    inner, flow = flat.connectors[connector].potentials[0], flat.connectors[connector].flows[0]
    node, changed = _parted(flat, connector, terms[0].where)
    rates = [Call(ADDED, "der", (side,)) for side in (variable(inner), node)]
    quantities = {
        **port.quantities,
        "p": Binary(ADDED, "-", variable(inner), node),
        "rate": Binary(ADDED, "-", rates[0], rates[1]),
    }
    passing = f"{terms[0].states[0].name if terms[0].states else port.name}.passing"
    flat = flat.with_variable(Variable(passing, ADDED, unit=port.units[1] or None))
    first, equation = next(iter(changed.items()))
    total = Unary(ADDED, "-", _total(flat, terms, quantities))
    changed[first] = (replace(equation[0], left=variable(passing), right=total),)
    i, balance = next((i, e) for i, e in flat.flow_balances() if connector in e.origin.connectors)

    def passed(side: Expression) -> Expression:
        return variable(passing) if isinstance(side, Reference) and flat_name(side) == flow else side

    left, right = (transform(side, passed) for side in (balance.left, balance.right))
    through = replace(balance, left=variable(flow), right=variable(passing))
    changed[i] = (
        replace(balance, left=left, right=right),
        replace(through, origin=replace(balance.origin, kind="added")),
    )
    return _with_states(flat.with_equations(changed), terms, quantities)


def _parted(flat: FlatModel, connector: str, where: str) -> tuple[Expression, dict[int, tuple[Equation, ...]]]:
    """Return the potential of the node from which a connector is separated, and the equalities that this changes.

    The first of them connected the two; the others tied other connectors to this one, and now tie them to the
    node.
    """
    inner = flat.connectors[connector].potentials[0]
    mine = [(i, e) for i, e in flat.equalities() if inner in [flat_name(r) for r in references((e.left, e.right))]]
    if not mine:
        raise ModelicaError(f"nothing is connected to '{connector}'", where=where)
    first, equation = next(((i, e) for i, e in mine if inner in _ends(e)), mine[0])
    node = _partner(equation, inner)
    changed: dict[int, tuple[Equation, ...]] = {first: (equation,)}

    def outside(side: Expression) -> Expression:
        return node if isinstance(side, Reference) and flat_name(side) == inner else side

    for i, e in mine:
        if i != first:
            left, right = (transform(side, outside) for side in (e.left, e.right))
            changed[i] = (replace(e, left=left, right=right),)
    return node, changed


def _ends(equation: Equation) -> list[str]:
    """Return the potentials that an equality connects, possibly with a drop between them."""
    right = equation.right.left if isinstance(equation.right, Binary) else equation.right
    return [flat_name(side) for side in (equation.left, right) if isinstance(side, Reference)]


def _partner(equation: Equation, inner: str) -> Expression:
    """Return the other side of an equality of the potential `inner`, possibly with a drop at its other end."""
    left, right = equation.left, equation.right
    if isinstance(left, Reference) and flat_name(left) == inner:
        return right
    if isinstance(right, Binary):  # left = inner - drop
        return Binary(ADDED, "+", left, right.right)
    return left


def _with_coefficient(flat: FlatModel, name: str, terms: Sequence[Term]) -> FlatModel:
    """Put a variable in the place of a parameter, with laws applied to the parameter's value one after the other.

    Parameters that are computed from it follow.
    """
    parameter, _, determined = name.partition(":")
    if all(c.name != name for c in coefficients(flat, parameter)):
        what = f"'{name}' is not a parameter that acts in the model's equations"
        fix = suggestion(name, {c.name for c in coefficients(flat)})
        raise ModelicaError(what, where=terms[0].where, fix=fix)
    varied_name = _new(flat, f"{name.replace(':', '.')}.{VALUE}")
    before = flat
    only = equations_with(flat, parameter)[determined] if determined else None
    flat = _replaced(
        flat, {parameter: variable(varied_name), **_followers(flat, parameter, variable(varied_name))}, only
    )
    flat = flat.with_variable(Variable(varied_name, ADDED, unit=before.variables[parameter].unit))
    flat, value = _in_turn(flat, terms, {"p": variable(parameter)}, varied_name)
    return flat.with_equation(variable(varied_name), value)


def _in_turn(
    flat: FlatModel, terms: Sequence[Term], quantities: Mapping[str, Expression], name: str
) -> tuple[FlatModel, Expression]:
    """Apply laws to the value ``p`` one after the other; also return the last one's expression.

    What a law makes of the value is a variable of its own, `name` with a number, for the next law to use: a law
    names its value several times, so expressions of expressions would grow exponentially.
    """
    value = quantities["p"]
    for k, term in enumerate(terms):
        if k:
            step = _new(flat, f"{name}_{k}")
            flat = flat.with_variable(Variable(step, ADDED)).with_equation(variable(step), value)
            value = variable(step)
        inside = {**quantities, "p": value}
        flat = _with_states(flat, [term], inside)
        value = _expression(flat, term, inside)
    return flat, value


def _followers(flat: FlatModel, name: str, value: Expression) -> dict[str, Expression]:
    """Return the parameters that are computed from a parameter, as expressions of what takes its place."""
    bindings: dict[str, Expression] = {}
    for follower in followers(flat, name):
        binding = flat.variables[follower].binding
        bindings[follower] = cast(Expression, transform(binding, _exchange({name: value, **bindings})))
    return bindings


def _exchange(new: Mapping[str, Expression]) -> Callable[[Expression], Expression]:
    return lambda node: new.get(flat_name(node), node) if isinstance(node, Reference) else node


def _replaced(flat: FlatModel, new: Mapping[str, Expression], only: int | None = None) -> FlatModel:
    """Exchange parameters in all that holds over time, or only in the equation of that number."""
    change = _exchange(new)

    def changed(e: Equation) -> Equation:
        return replace(e, left=transform(e.left, change), right=transform(e.right, change))

    if only is not None:
        return flat.with_equations({only: (changed(flat.equations[only]),)})
    variables = {
        n: replace(v, binding=transform(v.binding, change)) if v.variability == "continuous" else v
        for n, v in flat.variables.items()
    }
    algorithms = tuple(replace(a, statements=transform(a.statements, change)) for a in flat.algorithms)
    return replace(
        flat, variables=MappingProxyType(variables), equations=tuple(map(changed, flat.equations)),
        algorithms=algorithms, whens=transform(flat.whens, change),
    )  # fmt: skip


def _with_signal(flat: FlatModel, port: Port, terms: Sequence[Term]) -> FlatModel:
    """Insert laws into a causal connection, one after the other."""
    (name,) = port.connectors
    i = next(i for i, fed, _ in fed_inputs(flat) if fed == name)
    flat, value = _in_turn(flat, terms, port.quantities, f"{port.name}.{VALUE}")
    return flat.with_equations({i: (replace(flat.equations[i], left=variable(name), right=value),)})
