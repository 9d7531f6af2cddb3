"""Modelica source to a flat model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fmu_build import type_check
from fmu_build.algebra import Array
from fmu_build.errors import ModelicaError
from fmu_build.flat_model import Algorithm, Component, Connector, Equation, FlatModel, Origin, Variable
from fmu_build.front.classes import Argument, ClassDef, ComponentDef
from fmu_build.front.connections import Connections, Written, connector
from fmu_build.front.connector_checks import check_causal, check_connector
from fmu_build.front.instances import NO_MOD, ClassRef, Instance, Mod, Slot, World
from fmu_build.front.library import Library
from fmu_build.front.parser import annotation
from fmu_build.front.resolve import Env, Item, Many, Resolver, Var
from fmu_build.model import Experiment
from fmu_build.syntax import (
    ArrayOf,
    Assert,
    Assign,
    AssignMany,
    Binary,
    Call,
    Connect,
    Expression,
    ForStatement,
    If,
    IfStatement,
    Literal,
    Part,
    Place,
    Reference,
    Reinit,
    SourceEquation,
    Terminate,
    TupleOf,
    Unary,
    WhenStatement,
    references,
    walk,
)


def load(file: Path, class_name: str, roots: Sequence[Path] = ()) -> FlatModel:
    """Flatten a Modelica class.

    Parameters
    ----------
    file
        Source file that has the class, or the ``package.mo`` (or any file) of its package.
    class_name
        Qualified name of the class.
    roots
        Directories of further libraries.

    Raises
    ------
    ModelicaError
        A file is missing, or the source is wrong or outside the supported subset; the message names file and line.
    """
    file = Path(file)
    if file.is_dir():
        file /= "package.mo"
    if not file.is_file():
        raise ModelicaError("no such Modelica file", where=file)
    for folder in roots:
        if not Path(folder).is_dir():
            raise ModelicaError("no such library directory", where=folder)
    library = Library(file, roots)
    world = World(library)
    return _Flattener(world, _class(world, class_name, file)).run(class_name)


def _class(world: World, class_name: str, file: Path) -> ClassRef:
    first, *rest = class_name.split(".")
    top = world.library.top(first)
    ref: ClassRef | None = None if top is None else ClassRef(top, None)
    for part in rest:
        if ref is not None:
            slot = world.package(ref, ref.definition.at).slot(part)
            ref = None if slot is None else world.class_ref(slot)
    if ref is None:
        known = world.library.names()
        same = [k for k in known if k.rpartition(".")[2] == class_name.rpartition(".")[2]]
        fix = f"did you mean '{same[0]}'?" if same else World.suggest(class_name, known)
        if fix is None:
            fix = f"known: {', '.join(known[:12])}" if known else None
        raise ModelicaError(f"there is no model '{class_name}'", where=file.name, fix=fix)
    if ref.definition.kind not in ("model", "block", "class", "connector", "record", "operator record"):
        raise ModelicaError(f"'{class_name}' is a {ref.definition.kind}, not a model", where=ref.definition.at)
    if ref.definition.partial:
        raise ModelicaError(
            "the class is partial", where=ref.definition.at, fix="translate a class that extends it"
        )
    return ref


class _Sink:
    """Collects the translated equations of the source."""

    def __init__(self) -> None:
        self.equations: list[Equation] = []
        self.asserts: list[Assert] = []
        self.whens: list[WhenStatement] = []


class _Flattener:
    def __init__(self, world: World, ref: ClassRef) -> None:
        self.world = world
        self.ref = ref
        self.resolver = Resolver(world)
        self.order: list[Var] = []
        self.tree: list[Instance] = []
        self.connects: list[Written] = []
        self.declared: list[Written] = []  # roots and branches of overconstrained connectors
        self.sink = _Sink()
        self.initial = _Sink()
        self.algorithms: list[Algorithm] = []
        self.initial_algorithms: list[Algorithm] = []

    def run(self, class_name: str) -> FlatModel:
        definition = self.ref.definition
        root = self.world.instantiate(self.ref, NO_MOD, "", None)
        self.resolver.instances[""] = root
        known = -1
        while known != len(root.slots):  # it may get inner components that are missing
            known = len(root.slots)
            self.order.clear()
            self.tree.clear()
            self._visit(root)
        for instance in list(self.tree):
            for base in instance.all_bases():
                for section in base.definition.sections:
                    if section.kind == "equation":
                        self._gather_connects(section.items, base, {})
        connections = Connections(self.resolver)
        connections.run(self.connects, self.declared)
        self.order.clear()
        self.tree.clear()
        self._visit(root)  # again, because buses have grown
        for instance in self.tree:
            for base in instance.all_bases():
                self._sections(base)
        connections.forget_unused(self._referenced())
        self._drop_unused(connections.touched)
        flows = [v for v in self.order if v.flow and (v.connector or _in_connector(v.owner))]
        equations = [*self.sink.equations, *connections.equations, *connections.balances(flows)]
        equations += self.resolver.streams.equations({v.name: v.at for v in self.order})
        variables = {v.name: self._variable(v) for v in self.order}
        equations = _settle_strings(variables, equations)
        components = {i.path or "": self._component(i) for i in self.tree}
        connectors = self._connectors()
        flat = FlatModel(
            class_name=class_name,
            description=definition.description,
            variables=MappingProxyType(variables),
            equations=tuple(equations),
            components=MappingProxyType(components),
            connectors=MappingProxyType(connectors),
            functions=MappingProxyType(dict(self.resolver.functions)),
            initial_equations=tuple(self.initial.equations),
            algorithms=tuple(self.algorithms),
            initial_algorithms=tuple(self.initial_algorithms),
            whens=(*self.sink.whens, *map(_at_start, self.initial.asserts)),
            asserts=(*connections.asserts, *self.sink.asserts),
            experiment=_experiment(definition),
            structural=frozenset(self.resolver.structural),
            files=tuple(sorted(self.world.library.used)),
            libraries=tuple(self.world.library.versions().items()),
            warnings=(*self.world.library.warnings, *self.resolver.warnings),
        )
        type_check.check(flat)
        return flat

    # ---- the instance tree

    def _visit(self, item: Item) -> None:
        if isinstance(item, Var):
            _check_variable(item)
            self.order.append(item)
        elif isinstance(item, Many):
            for inner in item.items:
                self._visit(inner)
        elif isinstance(item, Instance):
            self.tree.append(item)
            for name, slot in list(item.slots.items()):
                self._visit_element(item, name, slot)
            if item.kind == "connector":
                check_connector(item, self.resolver)

    def _visit_element(self, item: Instance, name: str, slot: Slot) -> None:
        element = slot.element
        if not isinstance(element, ComponentDef):
            if slot.mod.redeclare is not None:
                self.world.package(slot, element.at)  # is checked, although it may not be used
            return
        if self._is_reference(slot):
            return
        inner = self.resolver.item(item, name, element.at)
        if item.kind == "block" and not slot.protected:
            check_causal(inner, self.resolver)
        self._visit(inner)

    def _is_reference(self, slot: Slot) -> bool:
        """Whether a component is an outer one that refers to an inner one elsewhere."""
        element = slot.effective().element
        if not isinstance(element, ComponentDef) or not element.outer or element.inner:
            return False
        item = self.resolver.item(slot.scope.root, slot.name)
        path = slot.scope.root.path
        plain_name = f"{path}.{slot.name}" if path else slot.name
        name = (
            item.name if isinstance(item, Var | Many) else item.path if isinstance(item, Instance) else plain_name
        )
        return name != plain_name

    def _component(self, instance: Instance) -> Component:
        bases = dict.fromkeys(b.class_name for b in instance.all_bases() if b is not instance)
        owner = instance.owner.root.path if instance.owner is not None else ""
        return Component(
            instance.path or "", owner or "", instance.class_name, instance.definition.kind, tuple(bases),
            instance.description if instance.path else instance.definition.description,
            instance.declared_at or instance.definition.at,
        )  # fmt: skip

    def _connectors(self) -> dict[str, Connector]:
        out: dict[str, Connector] = {}
        for instance in self.tree:
            if instance.path and instance.is_kind("connector", "expandable connector"):
                out[instance.path] = connector(instance, self.resolver)
        for var in self.order:
            if var.connector is not None:
                out[var.name] = connector(var, self.resolver)
        return out

    def _referenced(self) -> set[str]:
        """Names of the variables to which equations, algorithms and declarations refer."""
        equations = (*self.sink.equations, *self.initial.equations)
        sides = [side for e in equations for side in (e.left, e.right)]
        trees = (*sides, *self.sink.whens, *self.sink.asserts, *map(self.resolver.binding, self.order))
        bodies = [a.statements for a in (*self.algorithms, *self.initial_algorithms)]
        return {r.name for r in references((*trees, *bodies))}

    def _drop_unused(self, connected: set[str]) -> None:
        """Remove unconnected variables of expandable connectors."""
        self.order = [
            v
            for v in self.order
            if v.name in connected
            or v.variability in ("constant", "parameter")
            or v.owner.definition.kind != "expandable connector"
        ]

    # ---- variables

    def _variable(self, var: Var) -> Variable:
        resolver = self.resolver
        attributes: dict[str, Any] = {}
        for name in ("start", "min", "max", "nominal"):
            attributes[name] = resolver.attribute(var, name)
        binding = resolver.binding(var)
        if var.variability == "constant" and binding is None and attributes["start"] is None:
            raise ModelicaError(f"constant '{var.name}' has no value", where=var.at)
        if "discrete" in var.element.prefixes and var.type == "Real" and binding is not None:
            what = f"'{var.name}' is discrete and cannot have an equation here"
            raise ModelicaError(what, where=var.at, fix="assign it in a when-equation, or leave out discrete")
        attributes["start_level"] = _level(var.attributes.subs.get("start"))
        for name, key in (("unit", "unit"), ("displayUnit", "display_unit"), ("quantity", "quantity")):
            attributes[key] = resolver.text(var, name)
        fixed = resolver.attribute(var, "fixed")
        if fixed is not None:
            value = resolver.known(fixed, fixed.at)
            items = value.items if isinstance(value, Array) else (value,)
            attributes["fixed"] = tuple(bool(i) for i in items)
        select = resolver.attribute(var, "stateSelect")
        if select is not None:
            chosen = resolver.known(select, select.at)
            ordinal = int(chosen.items[0] if isinstance(chosen, Array) else chosen)  # type: ignore[arg-type]
            attributes["state_select"] = ("never", "avoid", "default", "prefer", "always")[ordinal - 1]
        causality = None
        if var.direction is not None and not var.protected and self._at_top(var):
            causality = var.direction
        return Variable(
            name=var.name, at=var.at, type=var.type, variability=var.variability,  # type: ignore[arg-type]
            component=var.owner.path or "", type_name=var.type_name, literals=var.literals, shape=var.dims,
            direction=var.direction, causality=causality, flow=var.flow,  # type: ignore[arg-type]
            binding=binding, description=var.element.description, final=var.final,
            evaluate=var.evaluate, protected=var.protected, **attributes,
        )  # fmt: skip

    def _at_top(self, var: Var) -> bool:
        owner: Instance | None = var.owner
        while owner is not None and owner.path:
            if not owner.is_kind("connector", "expandable connector", "record"):
                return False
            owner = owner.owner.root if owner.owner is not None else None
        return True

    # ---- equations

    def _gather_connects(self, items: Sequence[Any], scope: Instance, env: Env) -> None:
        for item in items:
            if isinstance(item, Connect):
                self.connects.append(Written(item, scope, dict(env)))
            elif _is_operator(item):
                self.declared.append(Written(item, scope, dict(env)))
            elif isinstance(item, ForStatement):
                if _has_connect(item.body):
                    for inner in self._unrolled(item, scope, env):
                        self._gather_connects(item.body, scope, inner)
            elif isinstance(item, IfStatement) and _has_connect(item.branches):
                self._gather_connects(self._selected(item, scope, env), scope, env)

    def _unrolled(self, loop: ForStatement, scope: Instance, env: Env) -> list[Env]:
        envs = [dict(env)]
        for name, bounds in loop.iterators:
            envs = [
                {**inner, name: point}
                for inner in envs
                for point in self.resolver.points(name, bounds, loop.body, scope, inner)
            ]
        return envs

    def _selected(self, item: IfStatement, scope: Instance, env: Env) -> tuple[Any, ...]:
        """Branch of an if-equation with known conditions."""
        for condition, body in item.branches:
            if condition is None:
                return body
            if self.resolver.truth(self.resolver.expr(condition, scope, env), condition.at):
                return body
        return ()

    def _sections(self, scope: Instance) -> None:
        origin = Origin("class", scope.root.path or "", scope.class_name)
        for section in scope.definition.sections:
            if section.kind == "equation":
                sink = self.initial if section.initial else self.sink
                self._equations(section.items, scope, {}, origin, sink)
            else:
                statements = self.resolver.statements(section.items, scope, {})
                target = self.initial_algorithms if section.initial else self.algorithms
                target.append(Algorithm(statements, origin, section.at))

    def _equations(self, items: Sequence[Any], scope: Instance, env: Env, origin: Origin, sink: _Sink) -> None:
        """Add equations, except connections, which are done already."""
        for item in items:
            if not isinstance(item, Connect) and not _is_operator(item):
                self._equation(item, scope, env, origin, sink)

    def _equation(self, item: Any, scope: Instance, env: Env, origin: Origin, sink: _Sink) -> None:
        expr = self.resolver.expr
        match item:
            case SourceEquation():
                sink.equations.append(
                    Equation(expr(item.left, scope, env), expr(item.right, scope, env), origin, item.at)
                )
            case ForStatement():
                for inner in self._unrolled(item, scope, env):
                    self._equations(item.body, scope, inner, origin, sink)
            case IfStatement():
                self._if(item, scope, env, origin, sink)
            case WhenStatement() | Terminate():
                if sink is self.initial:
                    raise ModelicaError("when is not allowed in an initial equation", where=item.at)
                if isinstance(item, Terminate):
                    item = WhenStatement(item.at, ((Call(item.at, "initial", ()), (item,)),))
                sink.whens.append(self._when(item, scope, env))
            case Assert():
                sink.asserts.append(self._assert(item, scope, env))
            case AssignMany():
                self._called(item, scope, env, origin, sink)
            case _:
                raise ModelicaError(_no_equation(item), where=item.at)

    def _called(self, item: AssignMany, scope: Instance, env: Env, origin: Origin, sink: _Sink) -> None:
        """Add a call without results: for the assertions of the function, or for what it prints."""
        called = self.resolver.statements((item,), scope, env)
        if isinstance(called[0], Assert):
            sink.asserts.append(called[0])
        elif sink is self.sink or sink is self.initial:
            target = self.algorithms if sink is self.sink else self.initial_algorithms
            target.append(Algorithm(called, origin, item.at))
        else:
            raise ModelicaError(_no_equation(item), where=item.at)

    def _assert(self, item: Assert, scope: Instance, env: Env) -> Assert:
        expr = self.resolver.expr
        return Assert(item.at, expr(item.condition, scope, env), expr(item.message, scope, env), item.warning)

    def _if(self, item: IfStatement, scope: Instance, env: Env, origin: Origin, sink: _Sink) -> None:
        def take(body: tuple[Any, ...], into: _Sink) -> _Sink:
            self._equations(body, scope, env, origin, into)
            return into

        if _has_connect(item.branches):
            take(self._selected(item, scope, env), sink)
            return
        branches = self.resolver.open_branches(item, scope, env)
        if not branches or branches[0][0] is None:
            take(branches[0][1] if branches else (), sink)
            return
        conditions = [condition for condition, _ in branches]
        try:
            sinks = [take(body, _Sink() if sink is not self.initial else _InitialSink()) for _, body in branches]
        except ModelicaError:  # an error in a branch that is not taken is not reported
            chosen = self._choose(conditions)
            if chosen is None:
                raise
            take(branches[chosen][1] if chosen < len(branches) else (), sink)
            return
        if conditions[-1] is not None:
            conditions.append(None)
            sinks.append(_Sink())
        self._add_branches(conditions, sinks, Equation(_NOTHING, _NOTHING, origin, item.at), sink)

    def _add_branches(
        self, conditions: list[Expression | None], sinks: list[_Sink], like: Equation, sink: _Sink
    ) -> None:
        """Add the equations and assertions of an if-equation's branches as one.

        Parameters
        ----------
        like
            An equation with the origin and the place of the if-equation.
        """
        if len({len(s.equations) for s in sinks}) > 1:
            for inner in sinks:
                inner.equations = [e for whole in inner.equations for e in self._elements(whole)]
        merged = _merge(conditions, sinks, like.at, like.origin)
        chosen = self._choose(conditions) if merged is None or not merged[1] else None
        if merged is None:
            if chosen is None:
                what = "the branches of this if-equation have different numbers of equations"
                if any(s.whens for s in sinks):
                    what = "a when-equation inside an if-equation whose condition is not known at translation"
                raise ModelicaError(what, where=like.at)
            sink.equations += sinks[chosen].equations
            sink.asserts += sinks[chosen].asserts
            sink.whens += sinks[chosen].whens
            return
        sink.equations += merged[0] if chosen is None else sinks[chosen].equations
        sink.asserts += _guarded(conditions, sinks)

    def _elements(self, equation: Equation) -> list[Equation]:
        """One equation per element if a whole array is on the left."""
        left = equation.left
        var = self.resolver.vars.get(left.name) if isinstance(left, Reference) else None
        if var is None or not var.dims or not isinstance(left, Reference) or left.subscripts:
            return [equation]
        out = []
        for index in product(*(range(1, n + 1) for n in var.dims)):
            subscripts = tuple(Literal(equation.at, i) for i in index)
            out.append(
                replace(
                    equation,
                    left=Reference(left.at, (Part(var.name, subscripts),)),
                    right=self.resolver.pick(equation.at, equation.right, subscripts),
                )
            )
        return out

    def _choose(self, conditions: Sequence[Expression | None]) -> int | None:
        """Branch chosen by known conditions, or the number of conditions if none holds; None if unknown."""
        for k, condition in enumerate(conditions):
            if condition is None:
                return k
            if self.resolver.maybe_known(condition) is None:
                return None
            if self.resolver.truth(condition, condition.at):
                return k
        return len(conditions)

    # ---- when-equations

    def _when(self, item: WhenStatement, scope: Instance, env: Env) -> WhenStatement:
        branches = []
        for condition, body in item.branches:
            test = self.resolver.expr(condition, scope, env)
            statements: list[Any] = []
            for part in body:
                statements += self._when_part(part, scope, env)
            branches.append((test, tuple(statements)))
        return WhenStatement(item.at, tuple(branches))

    def _when_part(self, item: Any, scope: Instance, env: Env) -> list[Any]:
        expr = self.resolver.expr
        match item:
            case SourceEquation():
                assigned = _assignment(expr(item.left, scope, env), expr(item.right, scope, env), item.at)
                for target in (assigned.target,) if isinstance(assigned, Assign) else assigned.targets:
                    self._check_assigned(target, scope)
                return [assigned]
            case ForStatement():
                return [
                    flat
                    for inner in self._unrolled(item, scope, env)
                    for part in item.body
                    for flat in self._when_part(part, scope, inner)
                ]
            case IfStatement():
                return self._when_if(item, scope, env)
            case Reinit():
                state = expr(item.state, scope, env)
                if not isinstance(state, Reference):
                    raise ModelicaError(f"reinit() of '{item.state.name}', which is not a state", where=item.at)
                return [Reinit(item.at, state, expr(item.value, scope, env))]
            case Assert() | Terminate() | AssignMany(targets=()):
                (statement,) = self.resolver.statements((item,), scope, env)
                if not isinstance(statement, AssignMany):
                    return [statement]
        raise ModelicaError("this is not supported in a when-equation", where=item.at)

    def _check_assigned(self, target: Reference | None, scope: Instance) -> None:
        """Refuse a when-equation for a variable of a component."""
        var = None if target is None else self.resolver.vars.get(target.name)
        owner = None if var is None else var.owner
        while owner is not None and owner.root is not scope.root:
            if owner.kind in ("model", "block", "class"):
                assert target is not None
                what = f"'{target.name}' belongs to a component and cannot be assigned in a when-equation here"
                raise ModelicaError(what, where=target.at)
            owner = owner.owner.root if owner.owner is not None else None

    def _when_if(self, item: IfStatement, scope: Instance, env: Env) -> list[Any]:
        branches = [
            (test, [s for part in body for s in self._when_part(part, scope, env)])
            for test, body in self.resolver.open_branches(item, scope, env)
        ]
        if not branches:
            return []
        if branches[0][0] is None:
            return branches[0][1]
        targets: dict[Any, Reference] = {}
        out: list[Any] = []
        for number, s in ((k, s) for k, (_, statements) in enumerate(branches) for s in statements):
            if isinstance(s, Assert):  # holds where another branch is taken
                true = Literal(s.at, True)
                holds = [s.condition if k == number else true for k in range(len(branches))]
                out.append(replace(s, condition=_chosen(item.at, branches, holds, true)))
                continue
            if not isinstance(s, Assign | Reinit):
                raise ModelicaError("this is not supported inside an if in a when-equation", where=s.at)
            targets.setdefault((type(s), _bare(_assigned(s))), _assigned(s))
        for (kind, bare), target in targets.items():
            kept: Expression = Call(item.at, "pre", (target,)) if kind is Assign else target
            values = [_value_in(statements, (kind, bare), kept) for _, statements in branches]
            out.append(kind(item.at, target, _chosen(item.at, branches, values, kept)))
        return out


def _chosen(at: Place, branches: Sequence[Any], values: Sequence[Expression], otherwise: Expression) -> If:
    """Value of the branch that is taken, or `otherwise` if none is."""
    chosen = tuple((c, v) for (c, _), v in zip(branches, values, strict=True) if c is not None)
    return If(at, chosen, values[-1] if branches[-1][0] is None else otherwise)


def _value_in(statements: list[Any], target: tuple[type, Any], otherwise: Expression) -> Expression:
    """Value that the first statement for a target assigns."""
    return next((s.value for s in statements if (type(s), _bare(_assigned(s))) == target), otherwise)


def _assignment(left: Any, right: Any, at: Place) -> Assign | AssignMany:
    """Return an equation in a when-clause as an assignment."""
    if isinstance(left, Reference):
        return Assign(at, left, right)
    if isinstance(right, Reference):
        return Assign(at, right, left)
    if isinstance(left, TupleOf) and isinstance(right, Call):
        targets = tuple(i for i in left.items if i is None or isinstance(i, Reference))
        if len(targets) == len(left.items):
            return AssignMany(at, targets, right)
    raise ModelicaError("an equation in a when-clause must have a variable alone on its left", where=at)


class _InitialSink(_Sink):
    pass


_NOTHING = Literal(Place("(no expression)", 1), 0)


def _no_equation(item: Any) -> str:
    """Return why something is not an equation."""
    if isinstance(item, Reinit):
        return "reinit() outside a when-equation"
    if not isinstance(item, AssignMany):
        return "this equation is not supported"
    name = item.call.function
    return f"a call of '{name}' as an equation is not supported"


def _at_start(item: Assert) -> WhenStatement:
    """Check an assertion of the initial equations at the start alone."""
    return WhenStatement(item.at, ((Call(item.at, "initial", ()), (item,)),))


def _guarded(conditions: Sequence[Expression | None], sinks: Sequence[_Sink]) -> Iterator[Assert]:
    """Yield the assertions of branches, each of which also holds if its branch is not taken."""
    before: list[Expression] = []
    for condition, inner in zip(conditions, sinks, strict=True):
        for one in inner.asserts:
            test = one.condition
            for other in [*before, *([] if condition is None else [Unary(one.at, "not", condition)])]:
                test = Binary(one.at, "or", other, test)
            yield replace(one, condition=test)
        if condition is not None:
            before.append(condition)


def _assigned(statement: Assign | Reinit) -> Reference:
    return statement.target if isinstance(statement, Assign) else statement.state


def _bare(reference: Reference) -> Any:
    return tuple((p.name, tuple(getattr(s, "value", None) for s in p.subscripts)) for p in reference.parts)


def _has_connect(tree: Any) -> bool:
    return any(isinstance(n, Connect) or _is_operator(n) for n in walk(tree))


def _is_operator(node: Any) -> bool:
    """Whether an equation is a call of an operator of ``Connections``."""
    return isinstance(node, AssignMany) and node.call.function.startswith("Connections.")


def _merge(
    conditions: Sequence[Expression | None], sinks: Sequence[_Sink], at: Place, origin: Origin
) -> tuple[list[Equation], bool] | None:
    """Combine the equations of all branches; None if their numbers differ.

    Second: whether corresponding equations are for the same variables.
    """
    first = sinks[0]
    if any(len(s.equations) != len(first.equations) or s.whens for s in sinks):
        return None
    columns: list[list[Equation]] = []
    lefts = [[_left(e) for e in s.equations] for s in sinks]
    names = lefts[0]
    alike = all(None not in row and len(set(row)) == len(row) and set(row) == set(names) for row in lefts)
    for k, equation in enumerate(first.equations):
        if alike:
            columns.append([s.equations[row.index(names[k])] for s, row in zip(sinks, lefts, strict=True)])
        else:
            columns.append([s.equations[k] for s in sinks])
        assert equation is columns[-1][0]
    tests = [c for c in conditions if c is not None]
    out = []
    for column in columns:
        place = column[0].at
        if alike:
            values: list[Expression] = [e.right for e in column]
            left: Expression = column[0].left
            right: Expression = If(place, tuple(zip(tests, values, strict=False)), values[-1], apart=True)
        else:
            values = [Binary(e.at, "-", e.left, e.right) for e in column]
            left = If(place, tuple(zip(tests, values, strict=False)), values[-1], apart=True)
            right = Literal(at, 0)
        out.append(Equation(left, right, origin, place))
    return out, alike


def _left(equation: Equation) -> Any:
    """Return the identity of the left side of an equation if it is a reference; None otherwise."""
    left = equation.left
    if isinstance(left, Call) and left.function == "der" and isinstance(left.arguments[0], Reference):
        return ("der", _bare(left.arguments[0]))
    if isinstance(left, Reference):
        return _bare(left)
    return None


def _in_connector(owner: Instance | None) -> bool:
    """Whether a component is a connector or a record in one."""
    while owner is not None and not owner.is_kind("connector"):
        if not owner.is_kind("record", "operator record"):
            return False
        owner = owner.owner.root if owner.owner is not None else None
    return owner is not None


def _settle_strings(variables: dict[str, Variable], equations: list[Equation]) -> list[Equation]:
    """Give String variables, which then are parameters, the values of their equations; return the others."""
    given: dict[str, dict[tuple[Any, ...], Expression]] = {}
    rest: list[Equation] = []
    for equation in equations:
        left = equation.left
        variable = variables.get(left.name) if isinstance(left, Reference) else None
        if variable is None or variable.type != "String" or variable.variability in ("constant", "parameter"):
            rest.append(equation)
            continue
        assert isinstance(left, Reference)
        given.setdefault(variable.name, {})[tuple(getattr(s, "value", None) for s in left.subscripts)] = (
            equation.right
        )
    for name, variable in variables.items():
        if variable.type != "String" or variable.variability in ("constant", "parameter"):
            continue
        values = given.get(name, {})
        value = values.get((), variable.binding)
        if len(variable.shape) == 1 and all((i + 1,) in values for i in range(variable.shape[0])):
            value = ArrayOf(variable.at, tuple(values[(i + 1,)] for i in range(variable.shape[0])))
        if value is not None:
            variables[name] = replace(variable, binding=value, variability="parameter", final=True)
    return rest


def _check_variable(var: Var) -> None:
    """Refuse prefixes and values that are only possible elsewhere."""
    inside = var.connector is not None or _in_connector(var.owner)
    if (var.flow or var.stream) and not inside:
        what = f"'{var.name}' has the prefix {'flow' if var.flow else 'stream'}, but is not in a connector"
        raise ModelicaError(what, where=var.at)
    fixed = var.variability in ("parameter", "constant")
    if var.owner.kind == "expandable connector" and var.attributes.value is not None and not fixed:
        raise ModelicaError(f"'{var.name}' is in an expandable connector and cannot have a value", where=var.at)


def _level(mod: Mod | None) -> int | None:
    """Level in the tree of components at which a modification is written: 0 is the model; None in a type."""
    path = mod.scope.root.path if mod is not None and mod.scope is not None else None
    return None if path is None else path.count(".") + bool(path)


def _experiment(definition: ClassDef) -> Experiment:
    values: dict[str, float] = {}
    for argument in annotation(definition.annotation):
        if isinstance(argument, Argument) and argument.name == "experiment":
            for inner in argument.modification.arguments:
                if isinstance(inner, Argument):
                    value: Any = inner.modification.value
                    sign = 1.0
                    if isinstance(value, Unary) and value.operator == "-":
                        sign, value = -1.0, value.operand
                    if isinstance(value, Literal) and not isinstance(value.value, str):
                        values[inner.name] = sign * float(value.value)
    return Experiment(
        values.get("StartTime"), values.get("StopTime"), values.get("Tolerance"), values.get("Interval")
    )
