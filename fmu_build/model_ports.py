"""Places where something may be missing in a model: nodes, branches, internal signals and parameters.

A physical connector has one potential and one flow, whose units determine the domain. A *node* shares one
potential: a flow can be added to its balance. A *branch* is a component between two nodes: a flow can be taken
from one and given to the other, or a difference added to the potential at its first connector. A *joint* is a
rigid connection between stores: it may be separated. A *signal* is a causal connection inside the model.

Models written as equations have such places as well: a balance is a node, or a *loop* if it is one of voltages,
and a difference between two balances a branch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal as Choice

from fmu_build.domains import MECHANICAL, Domain, alike, domain_of
from fmu_build.flat_model import (
    ADDED,
    Connector,
    Equation,
    FlatModel,
    Variable,
    constant,
    differentiated,
    flat_name,
    number,
    variable,
)
from fmu_build.syntax import Binary, Call, Expression, Reference, Unary, references, walk
from fmu_build.written_balances import Balance, Coupling, Difference, Share, WrittenBalances, factors_of, summands

Kind = Choice["node", "branch", "joint", "signal", "loop", "parameter"]


@dataclass(frozen=True)
class Port:
    """A place where a law may act.

    Attributes
    ----------
    name
        The user's component, or the connector where that is more specific.
    kind, domain
        Kind of the port, and its domain of physics.
    connectors
        For a node: the connector whose flow balance is extended. For a branch: its two connectors. For a joint:
        the connector that is separated from its node. For a signal: the connector that receives it. For a
        parameter: none.
    units
        Units of the potential (or signal) and of the flow.
    quantities
        Quantities for laws, by name: ``p`` (potential; for a branch its difference, second minus first connector),
        ``rate`` (its derivative), ``acceleration``, ``through`` (flow into a branch's first connector), ``load``
        (flow through a compliant neighbour). Quantities that would need a new differentiation are not included.
    probes
        Variables whose time series in a nominal simulation give sizes: those of potential, rate, acceleration and
        flows, where the model has them.
    compliant, rigid
        Whether a branch leaves its two potentials independent; whether it binds them, with stores at both ends.
    slides
        Whether a compliant branch passes a flow, of force or torque, that does not depend on where its ends are: a
        motor, a bearing, a brake.
    coil
        Whether the flow through an electrical branch is differentiated.
    preferred
        Variables of a compliant branch that are preferred as states, such as its twist. If the potential drops
        between its connectors, they do not determine where the ends are.
    same
        Other names of the same place: connectors of the same rigid node.
    passed
        Whether a signal is an input of the model that is only passed on.
    loops
        Whether the load is that of a rigid gear, which depends on accelerations: laws of it make algebraic loops.
    shares
        Of a port without connectors: what its flow adds to equations.
    terms
        Of such a port: the summands of these equations, whose values give the size of the flow.
    differences
        Of a branch without connectors: where the model has the difference of its potentials.
    """

    name: str
    kind: Kind
    domain: Domain
    connectors: tuple[str, ...]
    units: tuple[str, str]
    quantities: Mapping[str, Expression] = field(repr=False)
    probes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    compliant: bool = False
    rigid: bool = False
    slides: bool = False
    coil: bool = False
    preferred: tuple[str, ...] = ()
    same: tuple[str, ...] = ()
    passed: bool = False
    loops: bool = False
    shares: tuple[Share, ...] = ()
    terms: tuple[Expression, ...] = field(default=(), repr=False)
    differences: tuple[Difference, ...] = field(default=(), repr=False)

    @property
    def added_unit(self) -> str:
        """Unit of what a law adds: a flow, or in a loop a drop of potential."""
        return self.units[0 if self.kind == "loop" else 1]


def find_ports(flat: FlatModel) -> tuple[Port, ...]:
    """Return the nodes, branches and internal signals of a flat model, in the order of its declarations."""
    return _Finder(flat).ports()


def held_parameters(flat: FlatModel) -> tuple[Variable, ...]:
    """Return the real scalar parameters that may differ between rig and model, and have a plain number.

    Those that determine the structure (final, evaluated, sizes and conditions) are left out.
    """
    return tuple(
        v
        for v in flat.variables.values()
        if v.type == "Real" and v.variability == "parameter" and not v.shape
        and not (v.final or v.evaluate or v.protected) and v.name not in flat.structural
        and constant(v.binding) is not None
    )  # fmt: skip


@dataclass(frozen=True)
class Coefficient:
    """A parameter that acts in equations, or one of the places where it does.

    Attributes
    ----------
    name
        The parameter; of one that acts in several equations, also ``parameter:variable``, where it acts in the
        equation that determines that variable.
    components
        Components in whose equations it, or a parameter computed from it, acts.
    variables
        The continuous variables in these equations.
    """

    name: str
    unit: str
    components: tuple[str, ...]
    variables: tuple[str, ...]

    @property
    def parameter(self) -> str:
        """The parameter."""
        return self.name.partition(":")[0]


def parameter_port(name: str, over: str, unit: str) -> Port:
    """Return a parameter as the place of a law over something, with the units of that and of what it adds."""
    return Port(name, "parameter", "parameter", (), (over, unit), {})


def coefficients(flat: FlatModel, parameter: str | None = None) -> tuple[Coefficient, ...]:
    """Return the real scalar parameters, or only one, that act in equations and may be replaced by a variable."""
    inside = [(e.origin.component, e.names) for e in flat.equations]
    inside += [
        (flat.variables[n].component, frozenset({n, *map(flat_name, references(binding))}))
        for n, binding in flat.bindings()
    ]
    coefficients = []
    for v in held_parameters(flat):
        if v.at == ADDED or parameter not in (None, v.name):  # of an effect, or another one
            continue
        names = {v.name, *followers(flat, v.name)}
        if any(flat.variables[n].shape or n in flat.structural or flat.variables[n].evaluate for n in names):
            continue
        uses = [(component, used) for component, used in inside if used & names]
        near = dict.fromkeys(n for _, used in uses for n in sorted(used) if _is_continuous(flat, n))
        if near:
            components = tuple(dict.fromkeys(component for component, _ in uses))
            coefficients.append(Coefficient(v.name, v.unit or "1", components, tuple(near)))
            apart = equations_with(flat, v.name)
            for determined, i in apart.items() if len(apart) > 1 or len(uses) > len(apart) else ():
                e = flat.equations[i]
                near = dict.fromkeys(n for n in sorted(inside[i][1]) if _is_continuous(flat, n))
                name = f"{v.name}:{determined}"
                coefficients.append(Coefficient(name, v.unit or "1", (e.origin.component,), tuple(near)))
    return tuple(coefficients)


def across_branches(flat: FlatModel) -> dict[str, str]:
    """Return the written branch across which each variable is the difference: of ``twist = phi - phil``, say.

    The position of a mass on a spring is the difference to the ground.
    """
    ports = find_ports(flat)
    grounded = [p for p in ports if p.kind == "branch" and len(p.shares) == 1]
    held = {flat_name(p.quantities["p"]): p.name for p in grounded if isinstance(p.quantities["p"], Reference)}
    nodes = [(d.node, port.name) for port in ports for d in port.differences if not d.rates]
    explicit = [(flat_name(e.left), e.right) for e in flat.equations if isinstance(e.left, Reference)]
    explicit += [(name, value) for name, value in flat.bindings()]
    return held | {name: branch for name, value in explicit for node, branch in nodes if node == value}


def in_products_with(flat: FlatModel, parameter: str) -> set[str]:
    """Return the names that multiply or divide a parameter in an equation: the voltage in ``u^2/R``."""
    names = {parameter, *followers(flat, parameter)}
    sides = [side for e in flat.equations for side in (e.left, e.right)] + [value for _, value in flat.bindings()]
    products = ({*factors_of(term)} for side in sides for term in summands(side))
    return set().union(*(product for product in products if product & names)) - names


def equations_with(flat: FlatModel, parameter: str) -> dict[str, int]:
    """Return the equations in which a parameter acts, by the variable that each determines."""
    names = {parameter, *followers(flat, parameter)}
    places: dict[str, list[int]] = {}
    for i, e in enumerate(flat.equations):
        if e.origin.kind == "class" and names & e.names:
            rates = [name for name in map(differentiated, walk((e.left, e.right))) if name is not None]
            sides = [flat_name(side) for side in (e.left, e.right) if isinstance(side, Reference)]
            for name in (*rates, *sides)[:1]:
                places.setdefault(name, []).append(i)
    return {name: numbers[0] for name, numbers in places.items() if len(numbers) == 1}


def places(flat: FlatModel) -> dict[str, str]:
    """Return the kind of each place where a term may act: a port, or a ``parameter``."""
    return {c.name: "parameter" for c in coefficients(flat)} | {port.name: port.kind for port in find_ports(flat)}


def _is_continuous(flat: FlatModel, name: str) -> bool:
    v = flat.variables.get(name)
    return v is not None and v.type == "Real" and v.variability == "continuous" and not v.shape


def followers(flat: FlatModel, name: str) -> tuple[str, ...]:
    """Return the parameters whose values are computed from a parameter's, each after those that it needs."""
    uses, reached, wider = flat.computed, {name}, {name}
    while wider:
        wider = {n for n, used in uses.items() if used & reached} - reached
        reached |= wider
    ordered = [name]
    while ready := [n for n in uses if n in reached and n not in ordered and uses[n] & reached <= {*ordered}]:
        ordered += ready
    return tuple(ordered[1:])


def fed_inputs(flat: FlatModel) -> Iterator[tuple[int, str, Reference]]:
    """Yield every component's input that a connection or an equation outside it sets equal to one other variable.

    As number of the equation, name of the input, and the other variable.
    """
    for i, equation in enumerate(flat.equations):
        sides = [side for side in (equation.left, equation.right) if isinstance(side, Reference)]
        if equation.origin.kind not in ("potential", "class") or len(sides) < 2:
            continue
        for end, other in (sides[::-1], sides):
            name = flat_name(end)
            v = flat.variables.get(name)
            if (
                v is not None
                and v.direction == "input"
                and v.causality is None
                and v.type == "Real"
                and not v.shape
                and (equation.origin.kind == "potential" or equation.origin.component != v.component)
            ):
                yield i, name, other
                break


class _Classes:
    """Names that equations set equal."""

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}

    def find(self, name: str) -> str:
        while (up := self._parent.setdefault(name, name)) != name:
            self._parent[name] = name = self._parent[up]
        return name

    def join(self, a: str, b: str) -> None:
        self._parent[self.find(b)] = self.find(a)


class _Finder:
    def __init__(self, flat: FlatModel) -> None:
        self.flat = flat
        self.classes = _Classes()
        self.derived: dict[str, str] = {}  # class of a variable -> a variable that is its derivative ("" if none)
        self.physical = {
            c.path: physics for c in flat.connectors.values() if (physics := self._physics(c)) is not None
        }
        fixed = self._join_equals()
        self._find_derivatives()
        variables = flat.variables.values()
        self.fixed = {self.classes.find(name) for name in fixed}
        self.fixed |= {self.classes.find(v.name) for v in variables if v.variability in ("constant", "parameter")}
        self.prescribed = self.fixed | {self.classes.find(v.name) for v in variables if v.causality == "input"}
        self.balances: dict[str, int] = {}
        for i, equation in flat.flow_balances():
            for path in equation.origin.connectors:
                self.balances.setdefault(path, i)

    def _join_equals(self) -> list[str]:
        """Merge variables that are equal into one class; return those that equal a constant.

        Positions that differ by a given length or angle are also equal: those of the ends of a rod.
        """
        fixed: list[str] = []
        positions = {potential for domain, potential, _ in self.physical.values() if domain in MECHANICAL}
        for left, right in self._equalities():
            if isinstance(left, Reference) and isinstance(right, Reference):
                self.classes.join(flat_name(left), flat_name(right))
            elif isinstance(left, Reference) and constant(right) is not None:
                fixed.append(flat_name(left))
            elif isinstance(left, Reference) and flat_name(left) in positions and (near := self._shifted(right)):
                self.classes.join(flat_name(left), near)
        return fixed

    def _shifted(self, total: Expression) -> str:
        """Return the term of a sum to which only parameters are added; an empty string if there is none."""
        if isinstance(total, Reference):
            return flat_name(total) if self._varies(total) else ""
        if not (isinstance(total, Binary) and total.operator in ("+", "-")):
            return ""
        given = [not any(self._varies(r) for r in references((side,))) for side in (total.left, total.right)]
        if given[1]:
            return self._shifted(total.left)
        return self._shifted(total.right) if given[0] and total.operator == "+" else ""

    def _varies(self, reference: Reference) -> bool:
        declared = self.flat.variables.get(flat_name(reference))
        return declared is None or declared.variability not in ("constant", "parameter")

    def _find_derivatives(self) -> None:
        """Find the derivative of each variable; variables that are derivatives of the same one are equal."""
        named = [
            (inner, flat_name(left))
            for left, right in self._equalities()
            if (inner := differentiated(right)) is not None and isinstance(left, Reference)
        ]
        joined = True
        while joined:
            joined, first = False, dict[str, str]()
            for inner, name in named:
                same = first.setdefault(self.classes.find(inner), name)
                if self.classes.find(same) != self.classes.find(name):
                    self.classes.join(same, name)
                    joined = True
        for equation in self.flat.equations:
            for name in filter(None, map(differentiated, walk((equation.left, equation.right)))):
                self.derived.setdefault(self.classes.find(name), "")
        self.derived |= first

    def _equalities(self) -> Iterator[tuple[Expression, Expression]]:
        for equation in self.flat.equations:
            yield equation.left, equation.right
            yield equation.right, equation.left
        for name, binding in self.flat.bindings():
            yield variable(name), binding

    def _physics(self, c: Connector) -> tuple[Domain, str, str] | None:
        """Return domain, potential and flow of a connector that has one of each."""
        if len(c.potentials) != 1 or len(c.flows) != 1:
            return None
        units = [self._unit(name) for name in (c.potentials[0], c.flows[0])]
        domain = domain_of(*units)
        return None if domain is None else (domain, c.potentials[0], c.flows[0])

    def _unit(self, name: str) -> str | None:
        declared = self.flat.variables.get(name) or self.flat.variables.get(name.rpartition("[")[0])
        return declared.unit if declared is not None else None

    def ports(self) -> tuple[Port, ...]:
        branches = [b for b in self._branches() if not self._is_a_node(b)]
        branches = [
            replace(b, quantities={**b.quantities, **load}, loops=loops) if b.slides else b
            for b in branches
            for load, loops in [self._load(b.connectors, branches)]
        ]
        connected = [*self._nodes(branches), *branches, *self._joints(branches)]
        return (*connected, *self._written({port.name for port in connected}), *self._signals())

    def _rates(self, potential: str) -> dict[str, Expression]:
        """Return rate and acceleration of a potential, where the model computes them anyway."""
        level = self.classes.find(potential)
        if level not in self.derived:
            return {}
        speed = self.derived[level]
        if not speed:
            return {"rate": Call(variable(potential).at, "der", (variable(potential),))}
        quantities: dict[str, Expression] = {"rate": variable(speed)}
        if self.classes.find(speed) in self.derived:
            quantities["acceleration"] = Call(variable(speed).at, "der", (variable(speed),))
        return quantities

    def _nodes(self, branches: list[Port]) -> Iterator[Port]:
        groups: dict[str, list[str]] = {}
        for path, (_, potential, _) in self.physical.items():
            if path in self.balances and self.classes.find(potential) not in self.prescribed:
                groups.setdefault(self.classes.find(potential), []).append(path)
        shown = {self.classes.find(v.name) for v in self.flat.variables.values() if v.causality == "output"}
        for group in groups.values():
            # A flow that is read somewhere in a rigid node distinguishes its ends.
            read = any(self.classes.find(self.physical[path][2]) in shown for path in group)
            first = dict.fromkeys(self.balances[path] for path in group)
            parts = [[p for p in group if self.balances[p] == b] for b in first] if read else [group]
            for part in parts:
                yield self._node(part, group, branches)

    def _node(self, part: list[str], group: list[str], branches: list[Port]) -> Port:
        chosen = next((p for p in part if self._stores(p)), part[0])
        component = self.flat.connectors[chosen].component
        connectors = [p for p in self.physical if self.flat.connectors[p].component == component]
        name = component if component and set(connectors) <= set(part) else chosen
        domain, potential, _ = self.physical[chosen]
        load, loops = self._load(group, branches)
        quantities = {"p": variable(potential), **self._rates(potential), **load}
        flows = tuple(self.physical[p][2] for p in group)
        return Port(
            name, "node", domain, (chosen,), self._units(chosen), quantities,
            self._probes(potential, flows), same=tuple(p for p in part if p != chosen), loops=loops,
        )  # fmt: skip

    def _load(self, group: Sequence[str], branches: list[Port]) -> tuple[dict[str, Expression], bool]:
        """Return the flow through the compliant branch next to connectors, or else that of a rigid gear, if any.

        Also whether it is that of a gear. The branch may be behind rigid components, where its flow differs by a
        ratio. A spring that is fixed at its other end carries a load only if nothing else does: a shaft that is
        held, or else the mounting of what a motor or bearing stands on.
        """
        domain = self.physical[group[0]][0]
        held, mounting = dict[str, Expression](), dict[str, Expression]()
        moving = {self._potential(path) for b in branches if b.slides for path in b.connectors}
        springs = [b for b in branches if b.compliant and not b.slides and b.domain in alike(domain)]
        joined = self._sharing(group)
        while True:
            for branch in springs:
                if joined & set(branch.connectors):
                    load = {"load": branch.quantities["through"]}
                    ends = {self._potential(path) for path in branch.connectors}
                    if not ends & self.fixed:
                        return load, False
                    if ends & moving:
                        mounting = mounting or load
                    else:
                        held = held or load
            near = {self.flat.connectors[path].component for path in joined} & self._binding.keys()
            wider = joined | self._sharing([p for p in self.physical if self.flat.connectors[p].component in near])
            if wider == joined:
                break
            joined = wider
        gears = [b for b in branches if b.rigid and b.domain == domain and joined & set(b.connectors)]
        if held or mounting or not gears:
            return held or mounting, False
        return {"load": gears[0].quantities["through"]}, True

    def _potential(self, path: str) -> str:
        """Return the class of a connector's potential."""
        return self.classes.find(self.physical[path][1])

    def _sharing(self, paths: Sequence[str]) -> set[str]:
        """Return the connectors that share a potential with one of these."""
        reached = {self._potential(path) for path in paths}
        return {path for path in self.physical if self._potential(path) in reached}

    def _units(self, path: str) -> tuple[str, str]:
        _, potential, flow = self.physical[path]
        return self._unit(potential) or "", self._unit(flow) or ""

    def _probes(self, potential: str, flows: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
        speed = self.derived.get(self.classes.find(potential), "")
        probes = {"p": (potential,), "flow": flows}
        return probes | ({"rate": (speed,)} if speed else {})

    def _stores(self, path: str) -> bool:
        """Return whether the component of a connector differentiates its potential itself, of a body twice."""
        component = self.flat.connectors[path].component
        potential = self._potential(path)
        near = {potential}
        if self.physical[path][0] in MECHANICAL:
            near.add(self.classes.find(self.derived.get(potential) or potential))
        inside = [
            node
            for _, e in self.flat.equations_of(component)
            for node in walk((e.left, e.right))
            if isinstance(node, Call) and node.function == "der" and isinstance(node.arguments[0], Reference)
        ]
        differentiated = {self.classes.find(flat_name(n.arguments[0])) for n in inside}  # type: ignore[arg-type]
        return bool(component) and near <= differentiated

    def _branches(self) -> Iterator[Port]:
        of: dict[str, list[str]] = {}
        for path in self.physical:
            component = self.flat.connectors[path].component
            if component and path in self.balances:
                of.setdefault(component, []).append(path)
        pairs = ((component, *paths) for component, paths in of.items() if len(paths) == 2)
        for component, first, second in pairs:
            port = self._geared(component, first, second) or self._branch(component, first, second)
            if port is not None:
                yield port

    def _branch(self, component: str, first: str, second: str) -> Port | None:
        domain, a, flow = self.physical[first]
        other, b, _ = self.physical[second]
        if domain != other or self.classes.find(a) == self.classes.find(b):
            return None
        quantities: dict[str, Expression] = {
            "p": _difference(variable(b), variable(a)),
            "through": variable(flow),
        }
        ends = self._rates(a), self._rates(b)
        if all("rate" in end for end in ends):
            quantities["rate"] = _difference(ends[1]["rate"], ends[0]["rate"])
        elif any("rate" in end for end in ends) and domain in MECHANICAL:
            rates = [
                end.get("rate", number(0.0) if self.classes.find(p) in self.fixed else None)
                for end, p in zip(ends, (a, b), strict=True)
            ]
            if rates[0] is not None and rates[1] is not None:
                quantities["rate"] = _difference(rates[1], rates[0])
        if "rate" not in quantities and (rate := self._relative_rate(component, a, b)) is not None:
            quantities["rate"] = rate
        return Port(
            component, "branch", domain, (first, second), self._units(first), quantities,
            {"p": (a, b), "flow": (flow, self.physical[second][2])}
            | ({"rate": tuple(self.derived.get(self.classes.find(p), "") for p in (a, b))}
               if all(self.derived.get(self.classes.find(p)) for p in (a, b)) else {}),
            compliant=(compliant := self._compliant(component, (a, b))),
            rigid=not compliant and all(self._reaches_store(path) for path in (first, second)),
            slides=domain in MECHANICAL and compliant and not self._elastic(component, (a, b)),
            coil=domain == "electrical" and self.classes.find(flow) in self.derived,
            preferred=self._preferred(component) if compliant else (),
        )  # fmt: skip

    def _geared(self, component: str, *paths: str) -> Port | None:
        """Return a component as a branch if the twist that it computes has a ratio, as that of an elastic rack."""
        moving = self.prescribed.isdisjoint(map(self._potential, paths))
        if not moving or not self._compliant(component, [self.physical[path][1] for path in paths]):
            return None
        earlier = [
            e for e in self.flat.equations
            if e.origin.kind == "added" and isinstance(e.left, Reference)
            and flat_name(e.left).startswith(f"{component}.")
        ]  # fmt: skip
        ends = [self._balance(path) for path in paths]
        for c in self._equations.couplings(ends, [*self._inside(component), *earlier]):
            (first, second), geared = c.factors, self._coupling(c)
            if (first is None) != (second is None) and not all(d.rates for d in c.differences):
                plain = c.first if first is None else c.second
                into = plain.terms[0] if first is None else Unary(ADDED, "-", plain.terms[0])
                connectors = (c.first.name, c.second.name)
                return replace(
                    geared, name=component, connectors=connectors, terms=plain.terms,
                    quantities={**geared.quantities, "through": into},
                    probes={
                        "p": tuple(self.physical[path][1] for path in connectors),
                        "flow": (self.physical[plain.name][2],),
                    },
                )  # fmt: skip
        return None

    def _balance(self, path: str) -> Balance:
        """Return the flow balance of the node of a connector, of whose terms only its own flow counts."""
        domain, potential, flow = self.physical[path]
        return Balance(
            path, self.flat.connectors[path].component, domain, potential,
            self.derived.get(self._potential(path)) or None, self._units(path),
            Share(self.balances[path], "left", added=True), loop=False, terms=(variable(flow),),
        )  # fmt: skip

    def _is_a_node(self, branch: Port) -> bool:
        """Whether a branch and one of its ends are one place, as in a joint that stands on the ground."""
        held = self.fixed & {self._potential(path) for path in branch.connectors}
        return branch.domain in MECHANICAL and bool(held) and not (branch.compliant or branch.rigid)

    def _preferred(self, component: str) -> tuple[str, ...]:
        variables = (v for v in self.flat.variables.values() if v.component == component and v.type == "Real")
        return tuple(v.name for v in variables if v.state_select in ("prefer", "always"))

    def _joints(self, branches: list[Port]) -> Iterator[Port]:
        """Yield the rigid connections with stores on both sides; a rigid branch includes those at its ends."""
        rigid = {b.name for b in branches if b.rigid}
        for paths in self._sets().values():
            inside = {path: self.flat.connectors[path].component for path in paths}
            if any(component in rigid for component in inside.values()):
                continue
            for path in paths:
                others = [p for p in paths if p != path and inside[p] != inside[path]]
                if self._stores(path) and any(self._reaches_store(p, inward=True) for p in others):
                    domain, potential, flow = self.physical[path]
                    probes = self._probes(potential, (flow,))
                    # Only the difference and its rate are useful quantities at a joint.
                    quantities = {"p": variable(potential), **self._rates(potential)}
                    yield Port(path, "joint", domain, (path,), self._units(path), quantities, probes)
                    break

    @cached_property
    def _binding(self) -> Mapping[str, int]:
        """Components that bind the potentials of their connectors to each other, with the number of these."""
        of: dict[str, list[str]] = {}
        for path, (_, potential, _) in self.physical.items():
            of.setdefault(self.flat.connectors[path].component, []).append(potential)
        return {
            component: len(potentials)
            for component, potentials in of.items()
            if component and len(potentials) > 1
            and (len({self.classes.find(p) for p in potentials}) == 1
                 or not self._compliant(component, potentials))
        }  # fmt: skip

    def _sets(self) -> dict[int, list[str]]:
        """Return the physical connectors of each flow balance."""
        paths: dict[int, list[str]] = {}
        for path, i in self.balances.items():
            if path in self.physical and self.flat.connectors[path].component:
                paths.setdefault(i, []).append(path)
        return paths

    def _reaches_store(self, path: str, *, inward: bool = False) -> bool:
        """Return whether a store is rigidly connected to a connector: outside its component, or `inward`."""
        sets, waiting, seen = self._sets(), [(path, inward)], set()
        while waiting:
            here, within = waiting.pop()
            if (here, within) in seen:
                continue
            seen.add((here, within))
            component = self.flat.connectors[here].component
            if not within:
                waiting += [(p, True) for p in sets.get(self.balances[here], ()) if p != here]
            elif self._stores(here):
                return True
            elif self._binding.get(component) == 2:  # of three shafts, none is tied to another one alone
                connectors = [p for p in self.physical if self.flat.connectors[p].component == component]
                waiting += [(p, False) for p in connectors if p != here and p in self.balances]
        return False

    def _relative_rate(self, component: str, a: str, b: str) -> Expression | None:
        """Return the derivative of a component's own difference of potentials, if it computes one."""
        for left, right in self._equalities():
            if not (isinstance(left, Reference) and isinstance(right, Binary) and right.operator == "-"):
                continue
            sides = (right.left, right.right)
            names = tuple(flat_name(side) for side in sides if isinstance(side, Reference))
            value = self.flat.variables.get(flat_name(left))
            if value is None or value.component != component or self.classes.find(value.name) not in self.derived:
                continue
            rate = Call(left.at, "der", (left,))
            if names == (b, a):
                return rate
            if names == (a, b):
                return Unary(left.at, "-", rate)
        return None

    def _compliant(self, component: str, potentials: Sequence[str]) -> bool:
        """Return whether no equation of a component binds its potentials alone."""
        known, waiting = set(potentials), self._inside(component)
        progress = True
        while progress:
            progress = False
            for equation in list(waiting):
                unknown, flows = set(), False
                for reference in references((equation.left, equation.right)):
                    name = flat_name(reference)
                    declared = self.flat.variables.get(name)
                    if declared is None or declared.variability != "continuous" or name in known:
                        continue
                    flows |= declared.flow
                    unknown.add(name)
                if flows or len(unknown) > 1:
                    continue
                if not unknown:
                    return False
                known |= unknown
                waiting.remove(equation)
                progress = True
        return True

    def _inside(self, component: str) -> list[Equation]:
        """Return the equations of a component, with those of its declarations."""
        equations = [e for _, e in self.flat.equations_of(component)]
        return equations + [
            Equation(variable(v.name), v.binding, equations[0].origin, v.at)
            for v in self.flat.variables.values()
            if equations and v.component == component and v.binding is not None and v.variability == "continuous"
        ]

    def _elastic(self, component: str, potentials: tuple[str, str]) -> bool:
        """Return whether a compliant component's flow depends on its potentials, not on their rates alone."""
        positions, waiting = set(potentials), self._inside(component)
        progress = True
        while progress:
            progress = False
            for equation in list(waiting):
                sides = (equation.left, equation.right)
                calls = [c for c in walk(sides) if isinstance(c, Call) and differentiated(c) is not None]
                inside = {id(c.arguments[0]) for c in calls}
                names = {flat_name(r) for r in references(sides) if id(r) not in inside}
                if not names & positions:
                    continue
                declared = {n: self.flat.variables[n] for n in names & self.flat.variables.keys()}
                others = {n for n, v in declared.items() if v.variability == "continuous"} - positions
                if len(others) > 1 or any(declared[n].flow for n in others):
                    return True
                positions |= others
                waiting.remove(equation)
                progress = True
        return False

    @cached_property
    def _grounded(self) -> set[str]:
        """Components with a single electrical connector, whose other end is the ground."""
        physical = ((self.flat.connectors[path].component, domain) for path, (domain, *_) in self.physical.items())
        count = Counter(component for component, domain in physical if domain == "electrical")
        return {component for component, connectors in count.items() if component and connectors == 1}

    @cached_property
    def _equations(self) -> WrittenBalances:
        """What is stated as equations."""
        through_coils = {
            flow
            for path, (domain, _, flow) in self.physical.items()
            if domain == "electrical" and self.flat.connectors[path].component in self._grounded
        }
        potentials = {self.classes.find(potential) for _, potential, _ in self.physical.values()}
        speeds = {self.classes.find(self.derived[p]) for p in potentials if self.derived.get(p)}
        flows = {
            self.classes.find(v.name)
            for v in self.flat.variables.values()
            if v.flow and v.name not in through_coils
        }
        return WrittenBalances(self.flat, self.classes.find, self.derived, potentials | speeds | flows)

    def _written(self, taken: Collection[str]) -> Iterator[Port]:
        """Yield the ports of what is stated as equations, in components without connectors of that domain.

        A coil in a component with a single connector, whose other end is the ground, is a loop with the name of
        the component, unless that is `taken`.
        """
        of = [(self.flat.connectors[path].component, domain) for path, (domain, *_) in self.physical.items()]
        has, grounded, written = Counter(of), self._grounded, self._equations
        balances = [
            b
            for b in written.balances()
            if (b.loop and b.component in grounded)
            or not any((b.component, domain) in has for domain in alike(b.domain))
        ]
        couplings = written.couplings(balances)
        for b in balances:
            quantities = self._of_balance(b)
            probes = {"p": (b.potential,)} if b.potential is not None else {}
            probes |= {"rate": (b.rate,)} if b.rate is not None else {}
            differentiated, added = b.units
            units = (added, differentiated) if b.loop else b.units
            alone = b.loop and b.component in grounded and b.component not in taken
            node = Port(
                b.component if alone else f"{b.name}.balance", "loop" if b.loop else "node", b.domain, (), units,
                quantities, probes, shares=(b.share,), terms=b.terms,
            )  # fmt: skip
            yield node
            if b.domain in MECHANICAL and written.held(b, couplings):
                yield replace(node, name=f"{b.potential}.ground", kind="branch", probes={}, compliant=True)
        yield from map(self._coupling, couplings)

    def _of_balance(self, b: Balance) -> dict[str, Expression]:
        if b.loop:
            return {"through": variable(b.name)}
        if b.potential is not None:
            return {"p": variable(b.potential), **self._rates(b.potential)}
        assert b.rate is not None
        further = self._rates(b.rate)
        return {"rate": variable(b.rate)} | ({"acceleration": further["rate"]} if "rate" in further else {})

    def _coupling(self, c: Coupling) -> Port:
        """Return the branch between two balances: its flow leaves the second one and enters the first."""
        of = [self._of_balance(b) for b in (c.first, c.second)]
        scaled = [
            {name: e if factor is None else Binary(e.at, "*", factor, e) for name, e in quantities.items()}
            for factor, quantities in zip(c.factors, of, strict=True)
        ]
        quantities = {
            n: _difference(scaled[1][n], scaled[0][n]) for n in ("p", "rate") if all(n in s for s in scaled)
        }
        shares = (c.first.share.opposite.times(c.factors[0]), c.second.share.times(c.factors[1]))
        return Port(
            c.name, "branch", c.domain, (), c.units, quantities, shares=shares,
            terms=(*c.first.terms, *c.second.terms), differences=c.differences, compliant=True,
        )  # fmt: skip

    def _signals(self) -> Iterator[Port]:
        given = {self.classes.find(v.name) for v in self.flat.variables.values() if v.causality == "input"}
        fed: dict[str, Reference] = {}
        for _, name, other in fed_inputs(self.flat):
            fed.setdefault(name, other)
        for name, other in fed.items():
            unit = self._unit(name) or self._unit(flat_name(other)) or "1"
            yield Port(
                name, "signal", "signal", (name,), (unit, unit), {"p": other}, {"p": (name,)},
                passed=self.classes.find(name) in given,
            )  # fmt: skip


def _difference(a: Expression, b: Expression) -> Expression:
    return Binary(a.at, "-", a, b)
