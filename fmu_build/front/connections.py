"""Connections: expanding of connectors, equalities of potentials, balances of flows (specification 9)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from fmu_build.errors import ModelicaError, counted
from fmu_build.flat_model import Connector, Equation, Origin
from fmu_build.front.classes import ClassDef, ComponentDef, Modification
from fmu_build.front.connector_checks import Element, Leaf, Sets, Signals, is_connector
from fmu_build.front.instances import NO_MOD, ClassRef, Instance, Slot, World
from fmu_build.front.overconstrained import Tree, VirtualGraph
from fmu_build.front.resolve import Absent, Env, Item, Many, NotInBusError, Resolver, Var, check_visible
from fmu_build.front.streams import flow_of
from fmu_build.syntax import All, Assert, Binary, Call, Expression, Literal, Part, Place, Reference, Unary


@dataclass(frozen=True)
class Written:
    """A connect equation with its scope."""

    connect: Any  # Connect, or a call of one of the operators of Connections
    scope: Instance
    env: Env


class Connections:
    """Connection sets of a model."""

    def __init__(self, resolver: Resolver) -> None:
        self._resolver = resolver
        self._flows = Sets()  # of elements, each seen from inside or outside
        self._potentials = Sets()  # of elements
        self._signals = Signals()
        self._owner: dict[str, str] = {}  # variable -> connector
        self._flow_origin: dict[tuple[Element, bool], tuple[Origin, Place]] = {}
        self.equations: list[Equation] = []
        self.asserts: list[Assert] = []
        self.touched: set[str] = set()  # names of connected variables
        self._tree = Tree()

    def run(self, connects: list[Written], declared: Sequence[Written]) -> None:
        """Process all connect equations of the model, and its calls of ``Connections.root`` and the like."""
        pairs = self._fill_buses(connects)
        self._tree = self._resolver.tree = self._virtual_graph(pairs, declared).tree()
        for written, left, right in pairs:
            at = written.connect.at
            if len(left) != len(right):
                names = f"'{written.connect.a.name}' and '{written.connect.b.name}'"
                raise ModelicaError(
                    f"{names} have {len(left)} and {len(right)} elements and cannot be connected", where=at
                )
            self._resolver.connected.update([*{leaf.path for leaf in left}, *{leaf.path for leaf in right}])
            for a, b in zip(left, right, strict=True):
                self._join(a.towards(b), b.towards(a), written, (a.path, b.path))
        self._signals.check()

    def forget_unused(self, referenced: Set[str]) -> None:
        """Leave out what only buses have: no component is connected to it, and no equation refers to it."""
        sets = self._potentials.members().values()
        owners = {name: self._resolver.vars[name].owner for members in sets for name, _ in members}
        used = {
            name
            for members in sets
            if any(n in referenced or not owners[n].is_kind("expandable connector") for n, _ in members)
            for name, _ in members
        }
        self.touched -= owners.keys() - used
        self.equations = [
            e
            for e in self.equations
            if not (isinstance(e.left, Reference) and e.left.name in owners and e.left.name not in used)
        ]

    # ---- resolving

    def leaves(self, e: Reference, scope: Instance, env: Env) -> list[Leaf] | None:
        """Connectors that a reference denotes; None if one is a conditional component that does not exist."""
        slot = self._resolver.world.find(scope, e.parts[0].name, e.rooted)
        if not isinstance(slot, Slot) or not isinstance(slot.element, ComponentDef):
            raise ModelicaError(f"there is no connector '{e.name}'", where=e.at,
                                fix=World.suggest(e.parts[0].name, scope.root.slots))  # fmt: skip
        root = slot.scope.root
        item = self._resolver.referred(root, slot.name)
        path = _Path(self._resolver, e, scope, env, is_connector(item) and root is scope.root)
        if not path.walk(item, 0):
            return None
        return [replace(leaf, outer=True) for leaf in path.found] if slot.element.outer else path.found

    # ---- expandable connectors

    def _fill_buses(self, connects: list[Written]) -> list[tuple[Written, list[Leaf], list[Leaf]]]:
        done: dict[int, tuple[Written, list[Leaf], list[Leaf]]] = {}
        left = list(range(len(connects)))
        while left:
            waiting: list[int] = []
            grown = False
            for k in left:
                written = connects[k]
                a, b = (self._side(e, written) for e in (written.connect.a, written.connect.b))
                if a is None or b is None:
                    continue
                if isinstance(a, list) and isinstance(b, list):
                    done[k] = (written, a, b)
                    continue
                waiting.append(k)
                for missing, like in ((a, b), (b, a)):
                    if isinstance(missing, NotInBusError) and isinstance(like, list):
                        self._grow(missing, like, written)
                        grown = True
            grown = self._share(list(done.values())) or grown
            if waiting and not grown:
                at = connects[waiting[0]].connect
                raise ModelicaError(f"neither '{at.a.name}' nor '{at.b.name}' is declared anywhere", where=at.at)
            left = waiting
        while self._share(list(done.values())):
            pass
        return [done[k] for k in sorted(done)]

    def _side(self, e: Reference, written: Written) -> list[Leaf] | NotInBusError | None:
        """Connectors of one side of a connection, or the missing member of a bus."""
        try:
            return self.leaves(e, written.scope, written.env)
        except NotInBusError as missing:
            return missing

    def _grow(self, missing: NotInBusError, like: list[Leaf], written: Written) -> None:
        """Add a member to a bus, like the one that is connected to its name."""
        e = (
            written.connect.a
            if any(p.name == missing.name for p in written.connect.a.parts[1:])
            else written.connect.b
        )
        part = next(p for p in e.parts[1:] if p.name == missing.name)
        if part.subscripts or len(like) == 0 or e.parts[-1].name != missing.name:
            raise ModelicaError(f"'{e.name}' in an expandable connector is not supported", where=e.at)
        dims = () if len(like) == 1 and like[0].index == () else (len(like),)
        dims = () if len(like) == 1 else dims
        self._copy(missing.instance, missing.name, like[0].item, dims)

    def _copy(self, bus: Instance, name: str, like: Instance | Var, dims: tuple[int, ...]) -> None:
        path = f"{bus.path}.{name}" if bus.path else name
        at = like.at if isinstance(like, Var) else like.declared_at or like.definition.at
        if isinstance(like, Var):
            item: Item = replace(
                like, name=path, owner=bus.root, dims=dims, attributes=replace(like.attributes, value=None, subs={
                    n: m for n, m in like.attributes.subs.items() if n in ("unit", "quantity", "displayUnit")
                }), direction=None, connector=None, protected=bus.protected, binding_memo=[],
                variability="discrete" if like.variability == "discrete" else "continuous", final=False,
            )  # fmt: skip
            self._resolver.vars[path] = item  # type: ignore[assignment]
            slot = like.slot
        else:
            if dims:
                raise ModelicaError("arrays of connectors in an expandable connector are not supported", where=at)
            ref = ClassRef(like.definition, like.parent)
            made = self._resolver.world.instantiate(ref, replace(like.mod, value=None), path, bus.root)
            slot = Slot(
                name,
                ComponentDef(at, name, Reference(at, (Part(like.definition.name),)), frozenset(), (),
                             Modification(at), None, "", None),
                bus, NO_MOD,
            )  # fmt: skip
            self._resolver._settle(bus.root, made, slot, path)
            item = made
        bus.root.slots[name] = slot
        bus.root.visible.add(name)
        bus.visible.add(name)
        bus.root.items[name] = item

    def _share(self, pairs: list[tuple[Written, list[Leaf], list[Leaf]]]) -> bool:
        """Give connected buses the same members."""
        grown = False
        for _, left, right in pairs:
            for a, b in zip(left, right, strict=False):
                if isinstance(a.item, Instance) and isinstance(b.item, Instance):
                    for one, other in ((a.item, b.item), (b.item, a.item)):
                        if other.definition.kind != "expandable connector":
                            continue
                        for name in list(one.root.slots):
                            if name in other.root.slots:
                                continue
                            item = self._resolver.item(one, name)
                            if isinstance(item, Var):
                                self._copy(other, name, item, item.dims)
                                grown = True
                            elif isinstance(item, Instance):
                                self._copy(other, name, item, ())
                                grown = True
        return grown

    # ---- overconstrained connectors

    def _virtual_graph(
        self, pairs: list[tuple[Written, list[Leaf], list[Leaf]]], declared: Sequence[Written]
    ) -> VirtualGraph:
        graph = VirtualGraph()
        for written in declared:
            self._declare(graph, written)
        for written, left, right in pairs:
            for a, b in zip(left, right, strict=False):
                for edge in self._records(a.item, b.item):
                    graph.connections.setdefault(edge, written.connect.at)
        return graph

    def _declare(self, graph: VirtualGraph, written: Written) -> None:
        call = written.connect.call
        name = call.function.removeprefix("Connections.")
        if name not in ("branch", "root", "potentialRoot"):
            raise ModelicaError(f"'{call.function}' is not supported", where=call.at)
        nodes = [self._node(a, written) for a in call.arguments[: 2 if name == "branch" else 1]]
        if name == "branch":
            graph.branches[(nodes[0], nodes[1])] = call.at
        elif name == "root":
            graph.definite[nodes[0]] = call.at
        else:
            given = [*call.arguments[1:], *(value for _, value in call.named)]
            priority: Any = 0
            if given:
                resolver = self._resolver
                priority = resolver.known(resolver.expr(given[0], written.scope, written.env), call.at)
            graph.potential[nodes[0]] = int(priority)

    def _node(self, e: Any, written: Written) -> str:
        resolved = self._resolver.expr(e, written.scope, written.env)
        if not isinstance(resolved, Reference) or resolved.subscripts:
            raise ModelicaError("an overconstrained record or variable is expected here", where=written.connect.at)
        return resolved.name

    def _records(self, a: Item, b: Item) -> Iterator[tuple[str, str]]:
        """Yield the pairs of overconstrained records or variables inside two connected connectors."""
        if self._resolver.constraint(a) is not None:
            yield _path(a), _path(b)
        elif isinstance(a, Instance) and isinstance(b, Instance):
            for name, slot in list(a.slots.items()):
                if isinstance(slot.element, ComponentDef) and name in b.slots:
                    yield from self._records(self._resolver.item(a, name), self._resolver.item(b, name))
        elif isinstance(a, Many) and isinstance(b, Many):
            for one, other in zip(a.items, b.items, strict=False):
                yield from self._records(one, other)

    def _cut(self, a: Leaf, b: Leaf, written: Written) -> bool:
        """Whether a connection is broken; then the function ``equalityConstraint`` makes its equations."""
        edge = (_path(a.item), _path(b.item))
        if edge not in self._tree.broken:
            return False
        function = self._resolver.constraint(a.item)
        if function is None:
            return False
        at = written.connect.at
        key = self._resolver.function_key(function, at)
        call = Call(at, key, tuple(Reference(at, (Part(name),)) for name in edge))
        origin = Origin("potential", written.scope.root.path or "", written.scope.class_name, edge)
        if a.index in ((), tuple(1 for _ in a.index)):  # once for all elements of a variable
            self.equations.append(Equation(call, Literal(at, 0), origin, at))
        return True

    # ---- sets

    def _join(self, a: Leaf, b: Leaf, written: Written, connectors: tuple[str, str]) -> None:
        at = written.connect.at
        if self._tree.broken and self._cut(a, b, written):
            self.touched |= {_path(a.item), _path(b.item)}
            return
        if isinstance(a.item, Instance) and isinstance(b.item, Instance):
            names = _common_names(a.item, b.item, connectors, at)
            for name in names:
                left = self._elements(self._resolver.item(a.item, name), a.outside)
                right = self._elements(self._resolver.item(b.item, name), b.outside)
                if len(left) != len(right):
                    raise ModelicaError(f"'{name}' has another size on each side of this connection", where=at)
                for c, d in zip(left, right, strict=True):
                    self._join(c, d, written, connectors)
            return
        if isinstance(a.item, Instance) or isinstance(b.item, Instance):
            raise ModelicaError(f"'{connectors[0]}' and '{connectors[1]}' are of different kinds", where=at)
        self._join_variables(a, b, written, connectors)

    def _join_variables(self, a: Leaf, b: Leaf, written: Written, connectors: tuple[str, str]) -> None:
        one, other, at = a.item, b.item, written.connect.at
        assert isinstance(one, Var)
        assert isinstance(other, Var)
        if one.flow != other.flow:
            raise ModelicaError(f"'{one.name}' and '{other.name}': only one of them is a flow", where=at)
        if one.stream != other.stream:
            raise ModelicaError(f"'{one.name}' and '{other.name}': only one of them is a stream", where=at)
        if (one.type == "Real") != (other.type == "Real") or (one.type == "Boolean") != (other.type == "Boolean"):
            raise ModelicaError(f"'{one.name}' is {one.type}, '{other.name}' is {other.type}", where=at)
        self.touched |= {one.name, other.name}
        self._owner[one.name] = connectors[0]
        self._owner[other.name] = connectors[1]
        origin = Origin("potential", written.scope.root.path or "", written.scope.class_name, connectors)
        left, right = (one.name, a.index), (other.name, b.index)
        if one.stream:
            streams = self._resolver.streams
            streams.flows |= {v.name: flow_of(v.owner, at) for v in (one, other)}
            streams.join((left, a.outside), (right, b.outside))
            return
        if one.flow:
            self._flow_origin.setdefault((left, a.outside), (origin, at))
            self._flows.union((left, a.outside), (right, b.outside))
            return
        if one.variability in ("constant", "parameter") or other.variability in ("constant", "parameter"):
            self._equal(one, other, left, right, at)
            return
        self._signals.join(a, b, written.scope.root.path or "", at)
        if self._potentials.union(left, right):
            # the side with an output is written first, as it determines the other
            self.equations.append(Equation(_reference(left, at), _reference(right, at), origin, at))

    def _equal(self, one: Var, other: Var, left: Element, right: Element, at: Place) -> None:
        """Require connected parameters or constants to be equal."""
        if one.variability != other.variability:
            what = f"'{one.name}' is {one.variability}, but '{other.name}' is {other.variability}"
            raise ModelicaError(what, where=at)
        a, b = _reference(left, at), _reference(right, at)
        if one.variability == "constant":
            values = [self._resolver.known(e, at) for e in (a, b)]
            if values[0] != values[1]:
                what = f"'{one.name}' is {values[0]}, but '{other.name}', which is connected to it, is {values[1]}"
                raise ModelicaError(what, where=at)
            return
        message = Literal(at, f"{one.name} and {other.name} are connected and must be equal")
        if one.type == "Real":
            size = Binary(at, "+", Call(at, "abs", (a,)), Call(at, "abs", (b,)))
            apart = Call(at, "abs", (Binary(at, "-", a, b),))
            condition: Expression = Binary(at, "<=", apart, Binary(at, "*", Literal(at, 1e-12), size))
            condition = Call(at, "noEvent", (condition,))
        else:
            condition = Binary(at, "==", a, b)
        self.asserts.append(Assert(at, condition, message, False))

    def _elements(self, item: Item, outside: bool) -> list[Leaf]:
        if isinstance(item, Var):
            return [Leaf(item, i, outside) for i in product(*(range(1, n + 1) for n in item.dims))]
        if isinstance(item, Many):
            return [leaf for inner in item.items for leaf in self._elements(inner, outside)]
        if isinstance(item, Instance):
            return [Leaf(item, (), outside)]
        return []

    # ---- equations

    def balances(self, flows: list[Var]) -> list[Equation]:
        """One balance for each set of connected flows, and zero for each unconnected flow."""
        out = []
        for root, members in self._flows.members().items():
            origin, at = self._flow_origin.get(root) or next(
                self._flow_origin[m] for m in members if m in self._flow_origin
            )
            total: Expression | None = None
            for element, outside in members:
                term: Expression = _reference(element, at)
                if total is None:
                    total = Unary(at, "-", term) if outside else term
                else:
                    total = Binary(at, "-" if outside else "+", total, term)
            assert total is not None
            connectors = tuple(dict.fromkeys(self._owner[e[0]] for e, _ in members))
            flow = Origin("flow", origin.component, origin.class_name, connectors)
            out.append(Equation(total, Literal(at, 0), flow, at))
        for var in flows:
            for index in product(*(range(1, n + 1) for n in var.dims)):
                if ((var.name, index), False) not in self._flows:
                    owner = var.name if var.connector is not None else var.owner.path or ""
                    origin = Origin("unconnected", owner.rpartition(".")[0], "", (owner,))
                    out.append(Equation(_reference((var.name, index), var.at), Literal(var.at, 0), origin, var.at))
        return out


class _Path:
    """Follows the parts of a reference in a connection to the connectors that it denotes."""

    def __init__(self, resolver: Resolver, e: Reference, scope: Instance, env: Env, outside: bool) -> None:
        self._resolver = resolver
        self._e = e
        self._scope = scope
        self._env = env
        self._outside = outside
        self.found: list[Leaf] = []

    def walk(self, item: Item, position: int, element: bool = False) -> bool:
        """Continue from the item that a part names; False if it is a conditional component that does not exist.

        Parameters
        ----------
        element
            Whether the part's subscripts are used up, so that the item is an element of an array.
        """
        part = self._e.parts[position]
        if isinstance(item, Absent):
            return False
        if isinstance(item, Many):
            there = [self.walk(item.at(i), position, True) for i in self._indices(item.dims, part)]
            return all(there)
        if isinstance(item, Instance):
            if part.subscripts and not element:
                raise ModelicaError(f"'{part.name}' is not an array", where=self._e.at)
            if position and not is_connector(item):
                what = f"'{self._e.name}' is inside a component of a component and cannot be connected here"
                raise ModelicaError(what, where=self._e.at)
            return self._instance(item, position)
        if position + 1 < len(self._e.parts) or (item.connector is None and not is_connector(item.owner)):
            raise self._no_connector()
        self.found.extend(Leaf(item, index, self._outside) for index in self._indices(item.dims, part))
        return True

    def _instance(self, item: Instance, position: int) -> bool:
        e = self._e
        if position + 1 == len(e.parts):
            if not is_connector(item):
                raise self._no_connector()
            self.found.append(Leaf(item, (), self._outside))
            return True
        name = e.parts[position + 1].name
        slot = item.slot(name)
        if slot is None and item.definition.kind == "expandable connector":
            raise NotInBusError(item, name, e.at)
        if slot is None:
            raise ModelicaError(f"'{item.path or e.name}' has no '{name}'", where=e.at,
                                fix=World.suggest(name, item.slots))  # fmt: skip
        if isinstance(slot.element, ClassDef):
            raise self._no_connector()
        check_visible(slot, item.path or "", e.at)
        return self.walk(self._resolver.item(item, name), position + 1)

    def _no_connector(self) -> ModelicaError:
        return ModelicaError(f"'{self._e.name}' is not a connector", where=self._e.at)

    def _indices(self, dims: tuple[int, ...], part: Part) -> Iterator[tuple[int, ...]]:
        e = self._e
        if len(part.subscripts) > len(dims):
            raise ModelicaError(f"'{part.name}' has {counted(len(dims), 'dimension')}", where=e.at)
        choices = []
        for k, n in enumerate(dims):
            subscript = part.subscripts[k] if k < len(part.subscripts) else All(e.at)
            if isinstance(subscript, All):
                choices.append(range(1, n + 1))
                continue
            index = self._resolver._subscript(self._resolver.expr(subscript, self._scope, self._env), n)
            if index is None:
                raise ModelicaError("a subscript in a connection must be known at translation", where=e.at)
            chosen = index if isinstance(index, list) else [index]
            for i in chosen:
                if not 1 <= i <= n:
                    raise ModelicaError(f"subscript {i} of '{part.name}' is outside 1..{n}", where=e.at)
            choices.append(chosen)  # type: ignore[arg-type]
        return product(*choices)


def connector(item: Instance | Var, resolver: Resolver) -> Connector:
    """Describe a connector."""
    if isinstance(item, Var):
        names = [_name((item.name, i)) for i in product(*(range(1, n + 1) for n in item.dims))]
        flows = tuple(names) if item.flow else ()
        return Connector(
            item.name, item.owner.path or "", item.connector or "", () if item.flow else tuple(names), flows,
            item.direction,  # type: ignore[arg-type]
        )  # fmt: skip
    flows_: list[str] = []
    potentials: list[str] = []

    def visit(part: Item) -> None:
        if isinstance(part, Var):
            target = flows_ if part.flow else potentials
            if part.variability not in ("constant", "parameter"):
                target.extend(_name((part.name, i)) for i in product(*(range(1, n + 1) for n in part.dims)))
        elif isinstance(part, Many):
            for inner in part.items:
                visit(inner)
        elif isinstance(part, Instance):
            for name, slot in list(part.slots.items()):
                if isinstance(slot.element, ComponentDef):
                    visit(resolver.item(part, name))

    visit(item)
    owner = item.owner.path if item.owner is not None else ""
    return Connector(item.path or "", owner or "", item.class_name, tuple(potentials), tuple(flows_))


def _common_names(a: Instance, b: Instance, connectors: tuple[str, str], at: Place) -> list[str]:
    """Names of the elements that two connected connectors, or records in them, have in common: all."""
    for one, other, (name, other_name) in ((a, b, connectors), (b, a, connectors[::-1])):
        if one.is_kind("expandable connector") and not other.is_kind("expandable connector"):
            fix = "connect to an element of the expandable connector"
            raise ModelicaError(f"'{name}' is expandable, but not '{other_name}'", where=at, fix=fix)
        for element, slot in one.slots.items():
            if isinstance(slot.element, ComponentDef) and element not in other.slots:
                raise ModelicaError(f"'{name}' has '{element}', but '{other_name}' does not", where=at)
    return [name for name, slot in a.slots.items() if isinstance(slot.element, ComponentDef)]


def _path(item: Item) -> str:
    return item.path or "" if isinstance(item, Instance) else getattr(item, "name", "")


def _name(element: Element) -> str:
    name, index = element
    return f"{name}[{','.join(map(str, index))}]" if index else name


def _reference(element: Element, at: Place) -> Reference:
    name, index = element
    return Reference(at, (Part(name, tuple(Literal(at, i) for i in index)),))
