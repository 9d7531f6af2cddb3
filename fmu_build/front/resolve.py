# ruff: noqa: ARG002  (methods of one table share a signature)
"""Names to flat expressions: components, constants, functions; and the values needed for flattening."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from fmu_build import algebra
from fmu_build.algebra import Array, UnknownSizeError, Value
from fmu_build.builtin_functions import CLOCKED, CLOCKS, NAMED, NO_CLOCKS, SUPPORTED, UNSUPPORTED
from fmu_build.errors import ModelicaError, counted
from fmu_build.expressions import Evaluator
from fmu_build.flat_model import Formal, Function
from fmu_build.front.classes import ClassDef, ComponentDef
from fmu_build.front.instances import (
    NO_MOD,
    ClassRef,
    Foreign,
    Instance,
    Mod,
    Slot,
    World,
    field_mod,
    merge,
)
from fmu_build.front.operators import Kind, Operators, Signature, record_of
from fmu_build.front.overconstrained import Tree
from fmu_build.front.parser import annotation
from fmu_build.front.streams import Streams, flow_of
from fmu_build.functions import Functions
from fmu_build.graph import SX
from fmu_build.syntax import (
    All,
    ArrayOf,
    Assert,
    Assign,
    AssignMany,
    Binary,
    Break,
    Call,
    Comprehension,
    End,
    Expression,
    Field,
    ForStatement,
    If,
    IfStatement,
    Literal,
    Matrix,
    Part,
    PartialCall,
    Place,
    Range,
    Reference,
    Reinit,
    Return,
    Subscripted,
    Terminate,
    TupleOf,
    Unary,
    WhenStatement,
    WhileStatement,
    transform,
    walk,
)

Env = dict[str, Literal | None]  # loop variables: their value, or None if they remain
_RANK = {"constant": 0, "parameter": 1, "discrete": 2}
_ANIMATION = "Modelica.Utilities.Internal.PartialModelicaServices.Animation."
_LOCATES = ("Modelica.Utilities.Files.loadResource", "ModelicaServices.ExternalReferences.loadResource")
_MOST_NESTED = 20  # components of one class inside each other
_MOST_ELEMENTS = 20_000  # of an array of components


class Absent:
    """A conditional component whose condition is false, or a shape of an animation, which an FMU does not show."""


ABSENT = Absent()


@dataclass(eq=False)
class Var:
    """A component of a predefined type."""

    name: str
    slot: Slot
    owner: Instance
    type: str
    type_name: str
    literals: tuple[str, ...]
    dims: tuple[int, ...]
    attributes: Mod
    variability: str
    direction: str | None
    flow: bool
    stream: bool
    final: bool
    protected: bool
    connector: str | None  # class of a connector that is a single variable
    evaluate: bool = False
    binding_memo: list[Expression | None] = field(default_factory=list)

    @property
    def at(self) -> Place:
        """Place of its declaration."""
        return self.slot.element.at

    @property
    def element(self) -> ComponentDef:
        """Its declaration."""
        assert isinstance(self.slot.element, ComponentDef)
        return self.slot.element


@dataclass(eq=False)
class Many:
    """An array of components that are not variables, row-major."""

    name: str
    dims: tuple[int, ...]
    items: list[Any]

    def at(self, index: Sequence[int]) -> Any:
        """Element at subscripts that count from 1."""
        offset = 0
        for i, n in zip(index, self.dims, strict=True):
            offset = offset * n + i - 1
        return self.items[offset]


Item = Var | Instance | Many | Absent


class Resolver:
    """Resolves the names of one model.

    Parameters
    ----------
    world
        Its classes.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.vars: dict[str, Var] = {}
        self.instances: dict[str, Instance] = {}
        self.functions: dict[str, Function] = {}
        self.structural: set[str] = set()
        self.shown_constants: dict[str, Var] = {}
        self.warnings: list[str] = []
        self.files: tuple[Path, ...] = ()
        self.streams = Streams()
        self.operators = Operators(self)
        self.tree: Tree | None = None  # of overconstrained connectors, once it is known
        self.connected: Counter[str] = Counter()  # number of connections of each connector, once it is known
        self._function_keys: dict[tuple[int, int, int], str] = {}
        self._open: set[tuple[int, str]] = set()
        self._values: dict[str, Value] = {}
        self._constants: dict[str, Expression] = {}
        self._shape_only = 0
        self._knowing = _Known(self)
        self.evaluator = Evaluator(self, self._knowing, Functions(self))

    # ---- for the evaluator

    def error(self, what: str, at: Place | None, fix: str | None = None) -> ModelicaError:
        """Make an error."""
        return ModelicaError(what, where=at, fix=fix)

    # ---- items

    def item(self, instance: Instance, name: str, at: Place | None = None) -> Item:
        """Component of an instance by name."""
        root = instance.root
        if name in root.items:
            return root.items[name]  # type: ignore[no-any-return]
        memo = (id(root), name)
        slot = root.slots[name].effective()
        if memo in self._open:
            raise ModelicaError(f"'{name}' depends on itself", where=slot.element.at)
        self._open.add(memo)
        try:
            item = self._item(root, name, slot)
        finally:
            self._open.discard(memo)
        root.items[name] = item
        return item

    def referred(self, root: Instance, name: str) -> Item:
        """Return the item that a name in a class means: of a component that is inner and outer, the outer one."""
        slot = root.slots[name].effective()
        component = slot.element
        if isinstance(component, ComponentDef) and component.inner and component.outer:
            return self._inner(root, name, component, slot.scope) or self.item(root, name)
        return self.item(root, name)

    def _item(self, root: Instance, name: str, slot: Slot) -> Item:
        component = slot.element
        assert isinstance(component, ComponentDef)
        if component.outer and not component.inner:
            outer = self._inner(root, name, component, slot.scope)
            if outer is not None:
                if slot.mod.value is not None or slot.mod.subs:
                    raise ModelicaError(f"'{name}' is outer and cannot be modified", where=component.at,
                                        fix="modify the inner one")  # fmt: skip
                self._check_outer(slot, outer)
                return outer
        test = component.condition
        if test is not None and not self.truth(self.expr(test, slot.scope, {}), test.at):
            return ABSENT
        prefix = root.class_name if root.path is None else root.path
        path = f"{prefix}.{name}" if prefix else name
        ref = self.world.find_class(slot.scope, component.type)
        _check_type(path, component, self.world.plain(ref) if ref.definition.kind != "package" else ref, root)
        single = self.world.instantiate(ref, NO_MOD if component.subscripts else slot.mod, path, root)
        for declared in (slot, *([] if ref.slot is None else [ref.slot.effective()])):
            self.world.check_bounds(declared, single, path)
        self._check_component(path, component, single, root)
        if single.builtin or single.enumeration:
            if component.subscripts:
                single = self.world.instantiate(ref, slot.mod, path, root)
            return self._var(root, path, slot, single, ref)
        if any(base.class_name.startswith(_ANIMATION) for base in single.all_bases()):
            return ABSENT
        if component.subscripts:
            return self._array(root, path, slot, ref)
        self._settle(root, single, slot, path)
        return single

    def _check_component(self, path: str, component: ComponentDef, instance: Instance, root: Instance) -> None:
        """Refuse prefixes that only variables, records and connectors can have, and a class inside itself."""
        kind = instance.kind
        for prefix in sorted(component.prefixes | instance.short_prefixes):
            fits = kind not in ("model", "block", "class") or instance.builtin is not None
            if prefix in ("parameter", "constant"):
                fits = fits and not kind.endswith("connector")
            if not fits:
                raise ModelicaError(f"'{path}' has the prefix {prefix}, but is a {kind}", where=component.at)
        if "flow" in component.prefixes:
            self.operators.check_flow(path, instance, component.at)
        around: Instance | None = root
        count = 0
        while around is not None:
            count += around.definition is instance.definition
            around = around.owner.root if around.owner is not None else None
        if count > _MOST_NESTED:
            raise ModelicaError(f"'{instance.class_name}' contains itself", where=component.at)

    def _check_outer(self, slot: Slot, item: Item) -> None:
        """Refuse an outer variable whose type or size is not that of the inner one."""
        component = slot.element
        assert isinstance(component, ComponentDef)
        ref = self.world.find_class(slot.scope, component.type)
        outer = self.world.package(ref if ref.slot is None else ref.slot, component.at)
        if not isinstance(item, Var) or not (outer.builtin or outer.enumeration):
            return
        if (outer.builtin or "Integer") != item.type:
            raise ModelicaError(
                f"'{slot.name}' is outer and of {outer.builtin or 'an enumeration'}, "
                f"but the inner one is {item.type}", where=component.at,
            )  # fmt: skip
        subscripts = [(s, slot.scope) for s in component.subscripts] + outer.subscripts
        dims = [None if isinstance(s, All) else self._dimension(s, c, 0, tuple) for s, c in subscripts]
        if len(dims) != len(item.dims) or any(n not in (None, m) for n, m in zip(dims, item.dims, strict=True)):
            raise ModelicaError(f"'{slot.name}' is outer, and the inner one has size {list(item.dims)}",
                                where=component.at)  # fmt: skip

    def _array(self, root: Instance, path: str, slot: Slot, ref: ClassRef) -> Many:
        """Make an array of components that are not variables."""
        component = slot.element
        assert isinstance(component, ComponentDef)
        dims = tuple(
            self._dimension(s, slot.scope, k, lambda: self._bound_shape(slot.mod, component.at))
            for k, s in enumerate(component.subscripts)
        )
        if math.prod(dims) > _MOST_ELEMENTS:
            raise ModelicaError(f"'{path}' has {math.prod(dims)} elements", where=component.at)
        items = []
        for index in product(*(range(1, n + 1) for n in dims)):
            element_path = f"{path}[{','.join(map(str, index))}]"
            one = self.world.instantiate(ref, slot.mod.indexed(index), element_path, root)
            self._settle(root, one, slot, element_path)
            items.append(one)
        return Many(path, dims, items)

    def _settle(self, root: Instance, instance: Instance, slot: Slot, path: str) -> None:
        component = slot.element
        assert isinstance(component, ComponentDef)
        instance.prefixes = root.prefixes | component.prefixes | instance.short_prefixes
        instance.final = root.final or component.final or slot.mod.final
        instance.protected = root.protected or slot.protected
        instance.declared_at = component.at
        instance.description = component.description
        self.instances[path] = instance
        value = instance.mod
        if value.value is not None:
            if not instance.is_kind("record", "operator record"):
                raise ModelicaError(f"'{path}' is not a variable and cannot have a value", where=value.at)
            for name, sub in instance.slots.items():
                if isinstance(sub.element, ComponentDef) and not sub.element.final:
                    of_field = field_mod(value, name)
                    if sub.mod.weak:
                        sub.mod = replace(
                            sub.mod, value=of_field.value, scope=of_field.scope, final=of_field.final
                        )
                    else:
                        merged = merge(sub.mod, replace(of_field, final=False), name)
                        sub.mod = replace(merged, final=sub.mod.final or of_field.final)
                    sub.resolved = None

    def _inner(self, root: Instance, name: str, component: ComponentDef, scope: Instance) -> Item | None:
        above: Instance | None = root.owner
        while above is not None:
            slot = above.root.slots.get(name)
            if slot is not None:
                declared = slot.effective().element
                if isinstance(declared, ComponentDef) and declared.inner:
                    return self.item(above, name)
            above = above.root.owner
        if root.path == "":
            return None
        if self.world.find_class(scope, component.type).definition.kind in ("model", "block", "class"):
            model = self.instances[""].root
            model.slots[name] = Slot(name, replace(component, inner=True, outer=False), scope, NO_MOD)
            model.visible.add(name)
            what = f"nothing has an inner '{name}'; the model gets 'inner {component.type.name} {name}'"
            self.warnings.append(f"{component.at}: {what}")
            return self.item(model, name)
        raise ModelicaError(
            f"'{root.path}.{name}' is outer, and nothing around it has an inner '{name}'", where=component.at,
            fix=f"declare 'inner {component.type.name} {name}' in the model",
        )  # fmt: skip

    def _var(self, root: Instance, path: str, slot: Slot, instance: Instance, ref: ClassRef) -> Var:
        component = slot.element
        assert isinstance(component, ComponentDef)
        attributes = instance.attributes
        subscripts = [(s, slot.scope) for s in component.subscripts] + instance.subscripts
        prefixes = root.prefixes | component.prefixes | instance.short_prefixes
        known = [p for p in ("constant", "parameter", "discrete") if p in prefixes]
        direction = next(
            (p for p in ("input", "output") if p in component.prefixes | instance.short_prefixes), None
        )
        around = next((p for p in ("input", "output") if p in root.prefixes), None)
        if direction is not None and around is not None:
            what = f"'{path}' has the prefix {direction}, and what it is part of has the prefix {around}"
            raise ModelicaError(what, where=component.at)
        direction = direction or around
        literals: tuple[str, ...] = ()
        if instance.enumeration is not None:
            type_name, literals = "Integer", literal_names(instance.enumeration)
        else:
            type_name = instance.builtin or "Real"
        if type_name != "Real" or literals:
            for prefix in sorted(prefixes & {"flow", "stream"}):
                raise ModelicaError(f"'{path}' has the prefix {prefix}, but is not Real", where=component.at)
        for name, mod in attributes.subs.items():
            if name not in _ATTRIBUTES:
                raise ModelicaError(
                    f"'{path}' has no attribute '{name}'", where=mod.at, fix=World.suggest(name, _ATTRIBUTES)
                )
        protected = root.protected or slot.protected
        is_connector = ref.definition.kind.endswith("connector")
        evaluated = _says(component, "Evaluate") or _says(component, "__Dymola_Evaluate")
        # a constant of a package is a number wherever it is used
        variable = Var(
            path, slot, root, type_name, ref.definition.path, literals, (), attributes,
            known[0] if known else "continuous", direction, "flow" in prefixes,
            "stream" in prefixes, root.final or component.final or attributes.final,
            protected, ref.definition.path if is_connector else None, evaluated,
        )  # fmt: skip
        if root.path is not None:
            self.vars[path] = variable
        if subscripts:
            variable.dims = tuple(
                self._dimension(s, scope, k, lambda: self._bound_shape(attributes, component.at))
                for k, (s, scope) in enumerate(subscripts)
            )
        return variable

    def _dimension(self, subscript: Expression, scope: Instance, position: int, shape: Any) -> int:
        if isinstance(subscript, All):
            dims = shape()
            if len(dims) <= position:
                raise ModelicaError("the value has fewer dimensions than the declaration", where=subscript.at)
            return int(dims[position])
        if isinstance(subscript, Reference):
            literals = self._enumeration_type(subscript, scope)
            if literals is not None:
                return len(literals)
        value = self.known(self.expr(subscript, scope, {}), subscript.at)
        if isinstance(value, Array | str | dict | tuple) or value is None:
            raise ModelicaError(f"a size is {algebra.kind(value)}", where=subscript.at)
        size = algebra.whole(value)
        if size < 0:
            raise ModelicaError(f"a size is {size}; it cannot be negative", where=subscript.at)
        return size

    def _enumeration_type(self, name: Reference, scope: Instance) -> tuple[tuple[str, str], ...] | None:
        boolean = (("false", ""), ("true", ""))
        if name.name == "Boolean":
            return boolean
        target = self.world.find(scope, name.parts[0].name, name.rooted)
        if isinstance(target, Slot) and isinstance(target.element, ComponentDef):
            return None
        ref = self.world.lookup_class(scope, name)
        if ref is None:
            return None
        instance = self.world.package(ref, name.at)
        if instance.builtin == "Boolean":
            return boolean
        return instance.enumeration.enumeration if instance.enumeration is not None else None

    def _bound_shape(self, mod: Mod, at: Place) -> tuple[int, ...]:
        if mod.value is None:
            raise ModelicaError("a size is left open (:), and there is no value to take it from", where=at)
        assert mod.scope is not None
        self._shape_only += 1
        try:
            value = self.evaluator(self.expr(mod.value, mod.scope, {}))
        except UnknownSizeError as error:
            raise ModelicaError(str(error), where=error.span or at) from None
        finally:
            self._shape_only -= 1
        return value.shape if isinstance(value, Array) else ()

    # ---- values that must be known

    def known(self, expression: Expression, at: Place) -> Value:
        """Value of an expression that determines the structure.

        Raises
        ------
        ModelicaError
            It depends on more than parameters and constants.
        """
        if isinstance(expression, Literal):
            return expression.value
        try:
            with self.evaluator.no_event():
                value = self.evaluator(expression)
        except UnknownSizeError as error:
            raise ModelicaError(str(error), where=error.span or at) from None
        if any(isinstance(s, SX) for s in _scalars(value)):
            raise ModelicaError("this determines the structure, so it must be known at translation", where=at)
        return value

    def truth(self, condition: Expression, at: Place) -> bool:
        """Value of a condition that determines the structure."""
        value = self.known(condition, at)
        if not isinstance(value, bool):
            what = "a scalar number" if isinstance(value, int | float) else algebra.kind(value)
            raise ModelicaError(f"a condition must be a Boolean scalar, not {what}", where=at)
        return value

    def maybe_known(self, expression: Expression) -> Value | None:
        """Value of an expression if it is known; parameters are not used up if it is not."""
        before = set(self.structural)
        try:
            return self.known(expression, expression.at)
        except ModelicaError:
            self.structural = before
            return None

    def binding(self, var: Var) -> Expression | None:
        """Flat binding of a variable."""
        if not var.binding_memo:
            value, scope = var.attributes.value, var.attributes.scope
            if value is None:
                var.binding_memo.append(None)
            else:
                assert scope is not None
                var.binding_memo.append(self.expr(value, scope, {}))
        return var.binding_memo[0]

    def attribute(self, var: Var, name: str) -> Expression | None:
        """Flat attribute of a variable."""
        mod = var.attributes.subs.get(name)
        if mod is None or mod.value is None:
            return None
        assert mod.scope is not None
        return self.expr(mod.value, mod.scope, {})  # type: ignore[no-any-return]

    def value(self, var: Var) -> Value:
        """Value of a variable during flattening: known, or a symbol for each element."""
        if var.name in self._values:
            return self._values[var.name]
        symbols = tuple(SX.sym(var.name) for _ in range(math.prod(var.dims)))
        unknown: Value = Array(var.dims, symbols) if var.dims else symbols[0]
        only_shape = self._shape_only and var.type == "Real" and var.variability == "parameter"
        if only_shape or var.variability not in ("constant", "parameter"):
            return unknown
        memo = (id(var), "value")
        if memo in self._open:
            raise ModelicaError(f"'{var.name}' depends on itself", where=var.at)
        self._open.add(memo)
        try:
            expression = self._given(var)
            if expression is None:
                return unknown
            shape_only, self._shape_only = self._shape_only, 0
            try:
                with self.evaluator.no_event():
                    value = self.evaluator(expression)
            finally:
                self._shape_only = shape_only
        finally:
            self._open.discard(memo)
        if var.dims and not isinstance(value, Array):
            value = Array.fill(var.dims, algebra.scalars(value)[0])
        if var.type == "Real" and isinstance(value, bool | int):
            value = float(value)
        if var.variability == "parameter":
            self.structural.add(var.name)
        if not any(isinstance(s, SX) for s in _scalars(value)):
            self._values[var.name] = value
        return value

    def _given(self, var: Var) -> Expression | None:
        """Return the source of a constant's or parameter's value: binding, start or default; None if missing."""
        expression = self.binding(var)
        fixed = self.attribute(var, "fixed")
        if var.variability == "parameter" and isinstance(fixed, Literal) and fixed.value is False:
            return None
        if expression is None:
            expression = self.attribute(var, "start")
        if expression is not None or var.type == "ExternalObject":
            return expression
        if var.variability == "constant":
            raise ModelicaError(f"constant '{var.name}' has no value", where=var.at)
        defaults: dict[str, bool | float | str] = {"String": "", "Boolean": False, "Real": 0.0}
        return Literal(var.at, defaults.get(var.type, 0))

    # ---- expressions

    def expr(self, e: Any, scope: Instance, env: Env) -> Any:
        """Flatten an expression that is written in `scope`."""
        if isinstance(e, Literal):
            return e
        return getattr(self, f"_expr_{type(e).__name__.lower()}")(e, scope, env)

    def _all(self, items: Sequence[Any], scope: Instance, env: Env) -> tuple[Any, ...]:
        return tuple(None if i is None else self.expr(i, scope, env) for i in items)

    def _expr_foreign(self, e: Foreign, scope: Instance, env: Env) -> Any:
        return self.expr(e.expression, e.scope, {})

    def _expr_unary(self, e: Unary, scope: Instance, env: Env) -> Any:
        operand = self.expr(e.operand, scope, env)
        if e.operator in ("-", "+") and isinstance(operand, Literal) and not isinstance(operand.value, bool | str):
            return Literal(e.at, -operand.value if e.operator == "-" else operand.value)
        overloaded = self.operators.apply(e.operator, (operand,), scope, e.at)
        return Unary(e.at, e.operator, operand) if overloaded is None else overloaded

    def _expr_binary(self, e: Binary, scope: Instance, env: Env) -> Any:
        sides = self.expr(e.left, scope, env), self.expr(e.right, scope, env)
        overloaded = self.operators.apply(e.operator, sides, scope, e.at)
        return Binary(e.at, e.operator, *sides) if overloaded is None else overloaded

    def _expr_if(self, e: If, scope: Instance, env: Env) -> Any:
        branches: list[tuple[Expression, Expression]] = []
        for condition, value in e.branches:
            test = self.expr(condition, scope, env)
            if isinstance(test, Literal):  # branches that are never chosen may be invalid
                if self.truth(test, e.at):
                    if not branches:
                        return self.expr(value, scope, env)
                    return If(e.at, tuple(branches), self.expr(value, scope, env))
                continue
            try:
                branches.append((test, self.expr(value, scope, env)))
            except ModelicaError:
                if not self._never(test, False):
                    raise
        try:
            otherwise = self.expr(e.otherwise, scope, env)
        except ModelicaError:
            if len(branches) == 1 and self._never(branches[0][0], True):
                return branches[0][1]
            raise
        return If(e.at, tuple(branches), otherwise) if branches else otherwise

    def _never(self, test: Expression, unless: bool) -> bool:
        """Whether an invalid branch is never chosen."""
        value = self.maybe_known(test)
        return value is not None and bool(value) is unless

    def _expr_arrayof(self, e: ArrayOf, scope: Instance, env: Env) -> Any:
        return ArrayOf(e.at, self._all(e.items, scope, env))

    def _expr_matrix(self, e: Matrix, scope: Instance, env: Env) -> Any:
        return Matrix(e.at, tuple(self._all(row, scope, env) for row in e.rows))

    def _expr_range(self, e: Range, scope: Instance, env: Env) -> Any:
        return Range(e.at, *self._all((e.start, e.step, e.stop), scope, env))

    def _expr_tupleof(self, e: TupleOf, scope: Instance, env: Env) -> Any:
        return TupleOf(e.at, self._all(e.items, scope, env))

    def _expr_end(self, e: End, scope: Instance, env: Env) -> Any:
        return e

    def _expr_all(self, e: All, scope: Instance, env: Env) -> Any:
        return e

    def _expr_partialcall(self, e: PartialCall, scope: Instance, env: Env) -> Any:
        raise ModelicaError("functions as arguments are not supported", where=e.at)

    def _expr_subscripted(self, e: Subscripted, scope: Instance, env: Env) -> Any:
        if isinstance(e.base, Reference) and not e.base.subscripts:
            return self._expr_reference(self._distributed(e.base, e.subscripts, scope, env), scope, env)
        if isinstance(e.base, Foreign):
            inner = Subscripted(e.at, e.base.expression, e.subscripts)
            return self.expr(inner, e.base.scope, {})
        base = self.expr(e.base, scope, env)
        subscripts = self._all(e.subscripts, scope, env)
        return self.pick(e.at, base, subscripts)

    def _distributed(
        self, e: Reference, subscripts: tuple[Expression, ...], scope: Instance, env: Env
    ) -> Reference:
        """Write subscripts of a whole reference at those of its parts that are arrays."""
        *before, last = e.parts
        plain = Reference(e.at, (*before, Part(last.name, subscripts)), e.rooted)
        slot = None if e.parts[0].name in env else self.world.find(scope, e.parts[0].name, e.rooted)
        if not before or not isinstance(slot, Slot) or not isinstance(slot.element, ComponentDef):
            return plain
        if slot.scope.root.function:
            return plain
        item = self.item(slot.scope.root, slot.name)
        parts: list[Part] = []
        left = subscripts
        for k, part in enumerate(e.parts):
            here = len(item.dims) if isinstance(item, Many | Var) and not part.subscripts else 0
            parts.append(Part(part.name, part.subscripts or left[:here]))
            left = left[here:]
            inner = item.items[0] if isinstance(item, Many) and item.items else item
            if k + 1 < len(e.parts):
                if not isinstance(inner, Instance) or inner.slot(e.parts[k + 1].name) is None:
                    return plain
                item = self.item(inner, e.parts[k + 1].name)
        return plain if left else Reference(e.at, tuple(parts), e.rooted)

    def pick(self, at: Place, base: Expression, subscripts: tuple[Expression, ...]) -> Expression:
        """Select from an expression, immediately if the selected element is known."""
        while subscripts:
            first, *rest = subscripts
            if not isinstance(base, ArrayOf) or not isinstance(first, Literal) or isinstance(first.value, str):
                break
            index = int(first.value)
            if not 1 <= index <= len(base.items):
                raise ModelicaError(f"subscript {index} is outside 1..{len(base.items)}", where=at)
            base, subscripts = base.items[index - 1], tuple(rest)
        if not subscripts:
            return base
        if isinstance(base, Call) and base.function == "fill" and len(base.arguments) == 1 + len(subscripts):
            assert base.arguments[0] is not None
            return base.arguments[0]
        return Subscripted(at, base, subscripts)

    def _expr_field(self, e: Field, scope: Instance, env: Env) -> Any:
        base = e.base
        if isinstance(base, Subscripted) and isinstance(base.base, Reference) and not base.base.subscripts:
            base = self._distributed(base.base, base.subscripts, scope, env)
        if isinstance(base, Reference) and base.parts[0].name not in env:
            return self._expr_reference(Reference(base.at, (*base.parts, Part(e.name)), base.rooted), scope, env)
        if isinstance(base, If):
            branches = tuple((c, Field(e.at, v, e.name)) for c, v in base.branches)
            return self.expr(If(e.at, branches, Field(e.at, base.otherwise, e.name)), scope, env)
        if isinstance(base, Subscripted) and isinstance(base.base, ArrayOf):
            flat = [s for s in base.subscripts if isinstance(s, Literal)]
            if len(flat) == len(base.subscripts) == 1 and not isinstance(flat[0].value, str):
                return self._expr_field(Field(e.at, base.base.items[int(flat[0].value) - 1], e.name), scope, env)
        if isinstance(base, Foreign):
            return self.expr(Field(e.at, base.expression, e.name), base.scope, {})
        value = self.expr(base, scope, env)
        given = self._constructed(value, e.name)
        return Field(e.at, value, e.name) if given is None else given

    def _constructed(self, value: Any, name: str) -> Expression | None:
        """Argument of a record constructor for a field."""
        function = self.functions.get(value.function) if isinstance(value, Call) else None
        if function is None or not function.constructor:
            return None
        names = [f.name for f in function.inputs[: len(value.arguments)]]
        return value.arguments[names.index(name)] if name in names else None

    def _expr_comprehension(self, e: Comprehension, scope: Instance, env: Env) -> Any:
        if scope.root.function or any(value is None for value in env.values()):
            inner = dict(env)
            iterators = []
            for name, bounds in e.iterators:
                values = self._implied(name, e.element, scope, env) if bounds is None else bounds
                iterators.append((name, self.expr(values, scope, inner)))
                inner[name] = None
            return Comprehension(e.at, self.expr(e.element, scope, inner), tuple(iterators))

        def build(level: int, inner: Env) -> Any:
            # the first iterator runs fastest, so it is the last dimension of the others' result
            if level < 0:
                return self.expr(e.element, scope, inner)
            name, bounds = e.iterators[level]
            points = self.points(name, bounds, e.element, scope, inner)
            return ArrayOf(e.at, tuple(build(level - 1, {**inner, name: p}) for p in points))

        return build(len(e.iterators) - 1, dict(env))

    def points(self, name: str, bounds: Expression | None, body: Any, scope: Instance, env: Env) -> list[Literal]:
        """Values that a loop variable takes."""
        if bounds is None:
            bounds = self._implied(name, body, scope, env)
        if isinstance(bounds, Reference) and bounds.parts[0].name not in env:
            bounds = self._type_range(bounds, scope) or bounds
        flat = self.expr(bounds, scope, env)
        value = self.known(flat, bounds.at)
        if not isinstance(value, Array):
            raise ModelicaError(f"the range of '{name}' is {algebra.kind(value)}, not an array", where=bounds.at)
        literals = next((n.literals for n in walk(flat) if isinstance(n, Literal) and n.literals), ())
        return [self.literal(i, bounds.at, literals) for i in value.items]  # type: ignore[misc]

    def _implied(self, name: str, body: Any, scope: Instance, env: Env) -> Expression:
        """Range of a loop without one: the size of the dimension that its variable indexes directly."""
        span: Expression | None = None
        for array, position in _indexed(name, body):
            implied = self._dimension_range(array, position, scope, env)
            size = Call(array.at, "size", (array, Literal(array.at, position + 1)))
            if implied is None:
                implied = Range(array.at, Literal(array.at, 1), None, size)
            if span is None:
                span, first = implied, self._size_of(size, scope, env)
            elif isinstance(first, Literal):
                other = self._size_of(size, scope, env)
                if isinstance(other, Literal) and other.value != first.value:
                    what = f"loop variable '{name}' indexes dimensions of {first.value} and {other.value} elements"
                    raise ModelicaError(what, where=array.at)
        if span is not None:
            return span
        at = body.at if hasattr(body, "at") else body[0].at
        raise ModelicaError(f"loop variable '{name}' has no range, and does not index an array directly", where=at)

    def _dimension_range(self, array: Reference, position: int, scope: Instance, env: Env) -> Range | None:
        """Range of a dimension that Booleans or an enumeration count; None if numbers do."""
        slot = None if array.parts[0].name in env else self.world.find(scope, array.parts[0].name, array.rooted)
        if len(array.parts) > 1 or not isinstance(slot, Slot) or not isinstance(slot.element, ComponentDef):
            return None
        subscripts = slot.effective().element.subscripts
        subscript = subscripts[position] if position < len(subscripts) else None
        return self._type_range(subscript, slot.scope) if isinstance(subscript, Reference) else None

    def _type_range(self, name: Reference, scope: Instance) -> Range | None:
        """Range of all values of Boolean or of an enumeration; None for the name of anything else."""
        literals = self._enumeration_type(name, scope)
        if literals is None:
            return None
        if name.name == "Boolean":
            return Range(name.at, Literal(name.at, False), None, Literal(name.at, True))
        names = tuple(n for n, _ in literals)
        first, last = (Literal(name.at, i, names[i - 1], names) for i in (1, len(names)))
        return Range(name.at, first, None, last)

    # ---- references

    def _expr_reference(self, e: Reference, scope: Instance, env: Env) -> Any:
        first = e.parts[0]
        if first.name in env and not e.rooted:
            value = env[first.name]
            if value is None or len(e.parts) > 1:
                return self._local(e, scope, env)
            return value
        if first.name == "time" and len(e.parts) == 1:
            return e
        target = self.world.find_value(scope, first.name, e.rooted)
        if isinstance(target, Literal):
            return replace(target, at=e.at)
        if target is None:
            raise ModelicaError(
                f"there is no '{e.name}'" if len(e.parts) > 1 else f"there is no variable '{e.name}'", where=e.at,
                fix=self.world.absent(e.name) if len(e.parts) > 1 else World.suggest(first.name, scope.root.slots),
            )  # fmt: skip
        position = 0
        if isinstance(target, Slot) and isinstance(target.element, ComponentDef):
            if target.scope.root.function:
                return self._local(e, scope, env)
            self._check_use(target, e, scope)
        while isinstance(target, ClassRef) or not isinstance(target.element, ComponentDef):
            position += 1
            member = self._member(target, e, position)
            if isinstance(member, Literal):
                return member
            target = member
        root = target.scope.root
        self._check_outer_has(target, e, position + 1)
        return _Path(self, e, scope, env).walk(self.referred(root, target.name), position)

    def _check_outer_has(self, slot: Slot, e: Reference, position: int) -> None:
        """Refuse an element that the class of an outer component lacks, whatever the inner one has."""
        effective = slot.effective()
        element = effective.element
        if not isinstance(element, ComponentDef) or not element.outer or element.inner or position >= len(e.parts):
            return
        ref = self.world.find_class(effective.scope, element.type)
        declared = self.world.package(ref if ref.slot is None else ref.slot, e.at)
        name = e.parts[position].name
        if declared.slot(name) is None and declared.definition.kind != "expandable connector":
            what = f"'{declared.class_name}', the class of '{slot.name}', has no '{name}'"
            raise ModelicaError(what, where=e.at)

    def _check_use(self, slot: Slot, e: Reference, scope: Instance) -> None:
        """Refuse variables of a class around that of the expression, and conditional components."""
        declared = slot.effective().element
        assert isinstance(declared, ComponentDef)
        around = slot.scope.root is not scope.root and slot.scope.root.path is not None
        if around and not (declared.outer or "constant" in declared.prefixes):
            raise ModelicaError(
                f"'{slot.name}' belongs to the class around this one and is not constant", where=e.at,
                fix="pass it as a parameter, or declare it inner and outer",
            )  # fmt: skip
        if declared.condition is not None and slot.scope.root is scope.root:
            raise ModelicaError(f"'{slot.name}' is conditional, so it may only be used in connections", where=e.at)

    def _member(self, target: Slot | ClassRef, e: Reference, position: int) -> Slot | Literal:
        """Element of a package, or literal of an enumeration, that a part of a reference names."""
        if position >= len(e.parts):
            raise ModelicaError(f"'{e.name}' is a class, not a variable", where=e.at)
        package = self.world.package(target, e.at)
        name = e.parts[position].name
        if package.enumeration is not None:
            names = [n for n, _ in package.enumeration.enumeration or ()]
            if name not in names:
                raise ModelicaError(f"'{package.class_name}' has no literal '{name}'", where=e.at,
                                    fix=World.suggest(name, names))  # fmt: skip
            return Literal(e.at, names.index(name) + 1, name, tuple(names))
        member = package.slot(name)
        if member is None:
            raise ModelicaError(
                f"'{'.'.join(p.name for p in e.parts[:position])}' has no '{name}'", where=e.at,
                fix=World.suggest(name, package.slots),
            )  # fmt: skip
        self.world.check_inside(package, member, e.at)
        return member

    def _local(self, e: Reference, scope: Instance, env: Env) -> Reference:
        parts = tuple(Part(p.name, self._all(p.subscripts, scope, env)) for p in e.parts)
        return Reference(e.at, parts)

    def constant(self, var: Var) -> Expression:
        """Value of a constant of a package, as literals."""
        if var.name not in self._constants:
            value = self.value(var)
            unit = self.text(var, "unit") or ""
            self._constants[var.name] = self.literal(value, var.at, var.literals, unit)
        return self._constants[var.name]

    def text(self, var: Var, attribute: str) -> str | None:
        """Value of an attribute that is a String; None if it is empty or not stated."""
        stated = self.attribute(var, attribute)
        value = "" if stated is None else self.known(stated, stated.at)
        if isinstance(value, Array):
            value = value.items[0] if value.items else ""
        return str(value) or None

    def literal(
        self, value: Value, at: Place, literals: tuple[str, ...] = (), unit: str | None = None
    ) -> Expression:
        """Make literals of a value, which are of an enumeration if there are names of `literals`."""
        if isinstance(value, Array):
            if not value.shape:
                return self.literal(value.items[0], at, literals, unit)
            inner = value.shape[1:]
            n = math.prod(inner)
            rows = [value.items[i * n : (i + 1) * n] for i in range(value.shape[0])]
            items = (Array(inner, row) if inner else row[0] for row in rows)
            return ArrayOf(at, tuple(self.literal(item, at, literals, unit) for item in items))
        if literals and isinstance(value, int) and 1 <= value <= len(literals):
            return Literal(at, value, literals[value - 1], literals)
        if isinstance(value, bool | int | float | str):
            return Literal(at, value, unit=unit)
        raise ModelicaError("the value of this constant is not known", where=at)

    def _record_value(self, item: Instance, at: Place) -> Expression:
        ref = ClassRef(item.definition, item.parent)
        key = self.function_key(ref, at)
        arguments = []
        for formal in self.functions[key].inputs:
            inner = self.item(item, formal.name)
            if isinstance(inner, Var):
                arguments.append(self.constant(inner))
            elif isinstance(inner, Instance):
                arguments.append(self._record_value(inner, at))
            else:
                raise ModelicaError("a constant record with an array of records is not supported", where=at)
        return Call(at, key, tuple(arguments))

    def _subscript(self, subscript: Expression, size: int) -> int | list[int] | None:
        if any(isinstance(node, End) for node in walk(subscript)):
            subscript = transform(subscript, lambda n: Literal(n.at, size) if isinstance(n, End) else n)
        value = self.maybe_known(subscript)
        if isinstance(value, Array):
            return [algebra.whole(i) for i in value.items]
        if isinstance(value, bool):
            return int(value) + 1
        return None if value is None else int(value)  # type: ignore[arg-type]

    # ---- calls

    def _expr_call(self, e: Call, scope: Instance, env: Env) -> Any:
        name = e.function
        parts = name.split(".")
        if name in ("size", "ndims", "cardinality", "getInstanceName", "terminal"):
            special = self._special(e, scope, env)
            if special is not None:
                return special
        if name in SUPPORTED and len(parts) == 1:
            shadow = self.world.find(scope, name)
            if shadow is None or (isinstance(shadow, ClassRef) and shadow.definition.kind == "builtin"):
                return self._builtin(e, scope, env)
        if name in UNSUPPORTED or parts[0] == "Connections":
            return self._in_tree(e, scope, env)
        reference = Reference(e.at, tuple(Part(p) for p in parts), e.rooted)
        called = self._function_class(reference, scope)
        if called is None:
            if name in SUPPORTED:
                return self._builtin(e, scope, env)
            raise ModelicaError(
                f"there is no function '{name}'", where=e.at,
                fix=self.world.absent(name) if len(parts) > 1 else World.suggest(name, SUPPORTED),
            )  # fmt: skip
        ref = called
        converts = ref.definition.kind in ("type", "builtin") and ref.definition.member("constructor") is None
        if ref.definition.enumeration is not None or converts:
            return self._builtin(replace(e, function="Integer"), scope, env)
        key = self._constructor_key(ref, e, scope, env) or self.function_key(ref, e.at)
        function = self.functions[key]
        arguments = self._positional(e, [f.name for f in function.inputs], name, scope, env)
        arguments = _with_outside(function, arguments)
        call = Call(e.at, key, arguments)
        return self._located(call) if ref.definition.path in _LOCATES else _built_in(function, call)

    def _located(self, call: Call) -> Expression:
        """Return the path of a resource, which is known when the model is built."""
        (uri,) = call.arguments
        name = None if uri is None else self.maybe_known(uri)
        return Literal(call.at, self.world.library.resource(name)) if isinstance(name, str) else call

    def _constructor_key(self, ref: ClassRef, e: Call, scope: Instance, env: Env) -> str | None:
        """Key of the constructor of an operator record that fits a call."""
        if ref.definition.kind != "operator record":
            return None
        record = record_of(self.world.package(ref if ref.slot is None else ref.slot, e.at))
        assert record is not None
        given = [*self._all(e.arguments, scope, env), *(self.expr(v, scope, env) for _, v in e.named)]
        return self.operators.construct(record, given, [name for name, _ in e.named], scope)

    def _stream(self, e: Call, node: Any) -> Expression:
        """``inStream`` or ``actualStream`` of a stream variable, or of the elements of an array of them."""
        if isinstance(node, ArrayOf):
            return ArrayOf(e.at, tuple(self._stream(e, item) for item in node.items))
        var = self.vars.get(node.name) if isinstance(node, Reference) else None
        if self.tree is None or var is None or not var.stream:
            raise ModelicaError(f"{e.function}() of something that is not a stream variable", where=e.at)
        indices = tuple(int(s.value) for s in node.subscripts if isinstance(s, Literal))
        if len(indices) < len(var.dims):
            items = (replace(node, parts=(Part(node.name, (Literal(e.at, i + 1),)),)) for i in range(var.dims[0]))
            return ArrayOf(e.at, tuple(self._stream(e, item) for item in items))
        inside = self.streams.inside((var.name, indices), e.at)
        if e.function == "inStream":
            return inside
        flow = Reference(e.at, (Part(flow_of(var.owner, e.at)),))
        chosen = If(e.at, ((Binary(e.at, ">", flow, Literal(e.at, 0)), inside),), node)
        return Call(e.at, "noEvent", (chosen,))  # it is multiplied by the flow, and that product has no jump

    def _in_tree(self, e: Call, scope: Instance, env: Env) -> Any:
        """Truth of ``Connections.isRoot(R)`` or ``Connections.rooted(R)``; nothing similar is supported."""
        if e.function in ("inStream", "actualStream"):
            return self._stream(e, self.expr(e.arguments[0], scope, env))
        if e.function in CLOCKED:
            raise ModelicaError(CLOCKS, where=e.at, fix=NO_CLOCKS)
        if e.function not in ("Connections.isRoot", "Connections.rooted", "rooted"):
            raise ModelicaError(f"'{e.function}' is not supported", where=e.at)
        node = self.expr(e.arguments[0], scope, env) if len(e.arguments) == 1 else None
        if self.tree is None or not isinstance(node, Reference):
            raise ModelicaError(f"{e.function}() is not allowed here", where=e.at)
        return Literal(e.at, node.name in (self.tree.roots if e.function.endswith("isRoot") else self.tree.rooted))

    def constraint(self, item: Item) -> ClassRef | None:
        """Return the function ``equalityConstraint`` of the class of a component; None if it has none."""
        if isinstance(item, Instance):
            owner = item
        elif isinstance(item, Var) and isinstance(item.slot.element, ComponentDef):
            ref = self.world.find_class(item.slot.scope, item.slot.element.type)
            if ref.definition.kind == "builtin":
                return None
            owner = self.world.package(ref, item.at) if ref.slot is None else self.world.package(ref.slot, item.at)
        else:
            return None
        slot = owner.slot("equalityConstraint")
        return None if slot is None else self.world.class_ref(slot)

    def _function_class(self, reference: Reference, scope: Instance) -> ClassRef | None:
        """Class of a function by name; the name may begin with a component (``medium.f``)."""
        target = self.world.find(scope, reference.parts[0].name, reference.rooted)
        position = 0
        while isinstance(target, Slot) and isinstance(target.element, ComponentDef):
            position += 1
            if position >= len(reference.parts):
                raise ModelicaError(f"'{reference.name}' is a component, not a function", where=reference.at)
            item = self.item(target.scope.root, target.name)
            if not isinstance(item, Instance):
                raise ModelicaError(f"'{reference.name}' is not a function", where=reference.at)
            component = target.effective().element
            if isinstance(component, ComponentDef) and component.condition is not None:
                raise ModelicaError(f"'{target.name}' is conditional, so it may only be used in connections",
                                    where=reference.at)  # fmt: skip
            target = item.slot(reference.parts[position].name)
            if target is not None:
                check_visible(target, item.path or "", reference.at)
        if target is None:
            return None
        if position:
            for part in reference.parts[position + 1 :]:
                member = self.world.member(target, part.name, reference.at)
                if member is None:
                    return None
                target = member
            return self.world.class_ref(target)
        return self.world.lookup_class(scope, reference)

    def _positional(
        self, e: Call, names: list[str], shown: str, scope: Instance, env: Env
    ) -> tuple[Expression | None, ...]:
        given: list[Expression | None] = list(self._all(e.arguments, scope, env))
        if len(given) > len(names):
            raise ModelicaError(f"{shown}() has {counted(len(names), 'argument')}, not {len(given)}", where=e.at)
        given += [None] * (len(names) - len(given))
        for key, value in e.named:
            if key not in names:
                raise ModelicaError(
                    f"{shown}() has no argument '{key}'", where=e.at, fix=World.suggest(key, names)
                )
            if given[names.index(key)] is not None:
                raise ModelicaError(f"{shown}() has its argument '{key}' twice", where=e.at)
            given[names.index(key)] = self.expr(value, scope, env)
        while given and given[-1] is None:
            given.pop()
        return tuple(given)

    def _builtin(self, e: Call, scope: Instance, env: Env) -> Any:
        name = e.function
        if e.named:
            arguments = self._positional(e, NAMED.get(name, []), name, scope, env)
        else:
            arguments = self._all(e.arguments, scope, env)
        first = arguments[0] if arguments else None
        if name == "String" and e.named:
            defaults = [Literal(e.at, value) for value in ("", 6, 0, True, "")]
            arguments += (None,) * (len(defaults) - len(arguments))
            arguments = tuple(d if a is None else a for a, d in zip(arguments, defaults, strict=True))
        if name == "array":
            return ArrayOf(e.at, tuple(a for a in arguments if a is not None))
        if name == "String" and isinstance(first, Literal) and first.name:
            return Literal(e.at, first.name)
        if name == "String":
            overloaded = self.operators.apply("String", [a for a in arguments if a is not None], scope, e.at)
            if overloaded is not None:
                return overloaded
        return Call(e.at, name, arguments)

    def _special(self, e: Call, scope: Instance, env: Env) -> Any:
        if e.function == "getInstanceName":
            model = self.instances[""].definition.name if "" in self.instances else ""
            path = scope.root.path
            return Literal(e.at, f"{model}.{path}" if path else model)
        if e.function == "terminal":
            what = "terminal() is never true, because an FMU does not know where its simulation ends"
            self.warnings.append(f"{e.at}: {what}")
            return Literal(e.at, False)
        if e.function == "cardinality":
            return self._cardinality(e, scope, env)
        return self._size_of(e, scope, env)

    def _size_of(self, e: Call, scope: Instance, env: Env) -> Any:
        """Size of a component; None if the evaluation is to determine it."""
        first = e.arguments[0] if e.arguments else None
        if not isinstance(first, Reference) or first.parts[0].name in env:
            return None
        literals = self._enumeration_type(first, scope) if e.function == "size" else None
        dims: tuple[int, ...] | None = None if literals is None else (len(literals),)
        if dims is None:
            dims = self._dims(first, scope, env)
        if dims is None:
            return None
        if e.function == "ndims":
            return Literal(e.at, len(dims))
        if len(e.arguments) == 1:
            return ArrayOf(e.at, tuple(Literal(e.at, n) for n in dims))
        assert e.arguments[1] is not None
        position = self.maybe_known(self.expr(e.arguments[1], scope, env))
        if not isinstance(position, int):
            return None
        if not 1 <= position <= len(dims):
            raise ModelicaError(f"'{first.name}' has {counted(len(dims), 'dimension')}", where=e.at)
        return Literal(e.at, dims[position - 1])

    def _cardinality(self, e: Call, scope: Instance, env: Env) -> Literal:
        """Return the number of connections of a connector."""
        node = self.expr(e.arguments[0], scope, env) if len(e.arguments) == 1 else None
        if self.tree is None or not isinstance(node, Reference):
            raise ModelicaError("cardinality() is not allowed here", where=e.at)
        if node.name in self.vars and self.vars[node.name].connector is None:
            raise ModelicaError(f"cardinality() of '{node.name}', which is not a connector", where=e.at)
        return Literal(e.at, self.connected.get(node.name, 0))

    def _dims(self, e: Reference, scope: Instance, env: Env) -> tuple[int, ...] | None:
        """Sizes of a component without subscripts; None if that is not enough to know them."""
        target = self.world.find(scope, e.parts[0].name, e.rooted)
        if (
            not isinstance(target, Slot)
            or not isinstance(target.element, ComponentDef)
            or target.scope.root.function
        ):
            return None
        item = self.item(target.scope.root, target.name)
        out: tuple[int, ...] = ()
        for k, part in enumerate(e.parts):
            if part.subscripts:
                return None
            if isinstance(item, Many):
                out += item.dims
                if k + 1 < len(e.parts):
                    return None
            elif isinstance(item, Var):
                return out + item.dims
            elif isinstance(item, Instance) and k + 1 < len(e.parts):
                slot = item.slot(e.parts[k + 1].name)
                if slot is None or not isinstance(slot.element, ComponentDef):
                    return None
                item = self.item(item, slot.name)
        return out if isinstance(item, Many) else None

    # ---- functions

    def function_key(self, ref: ClassRef, at: Place) -> str:
        """Name of a flat function, which is made if necessary."""
        if ref.definition.kind == "class" and ref.definition.short is not None:
            raise ModelicaError(f"'{ref.definition.path}' is a class, not a function", where=at)
        ref = self.world.plain(ref)
        memo = (id(ref.definition), id(ref.parent), id(ref.slot) if ref.mod.subs else 0)
        if memo in self._function_keys:
            return self._function_keys[memo]
        path = ref.definition.path or ref.definition.name
        key, count = path, 1
        while key in self.functions:
            count += 1
            key = f"{path} ({count})"
        self._function_keys[memo] = key
        self.functions[key] = Function(key, ref.definition.at, (), (), (), ())
        # independent of the package instance: its components stay local names
        instance = Instance(self.world, ref.definition, ref.parent, ref.mod)
        if instance.builtin == "ExternalObject":
            slot = instance.slot("constructor")
            if slot is None:
                raise ModelicaError(f"'{path}' has no constructor", where=at)
            inner = self.world.class_ref(slot)
            assert inner is not None
            instance = Instance(self.world, inner.definition, inner.parent, inner.mod)
            self.functions[key] = self._function(key, instance)
        elif instance.is_kind("record", "operator record"):
            self.functions[key] = self._constructor(key, instance)
        elif instance.function or any(b.function for b in instance.all_bases()):
            if ref.definition.partial:
                raise ModelicaError(f"function '{path}' is partial", where=at)
            self.functions[key] = self._function(key, instance)
        else:
            del self.functions[key]
            raise ModelicaError(f"'{path}' is a {instance.definition.kind}, not a function", where=at)
        return key

    def _formals(self, instance: Instance) -> Iterator[tuple[ComponentDef, Slot, Formal]]:
        for name, raw in list(instance.slots.items()):
            if isinstance(raw.element, ComponentDef):
                slot = raw.effective()
                assert isinstance(slot.element, ComponentDef)
                yield slot.element, slot, self._formal(name, slot)

    def _formal(self, name: str, slot: Slot) -> Formal:
        component = slot.element
        assert isinstance(component, ComponentDef)
        ref = self.world.find_class(slot.scope, component.type)
        kind = ref.definition.kind
        if kind.endswith("function"):
            raise ModelicaError(f"'{name}': functions as arguments are not supported", where=component.at)
        instance = Instance(self.world, ref.definition, ref.parent, merge(slot.mod, ref.mod, name))
        subscripts = [(s, slot.scope) for s in component.subscripts] + instance.subscripts
        shape = tuple(None if isinstance(s, All) else self._size(s, scope) for s, scope in subscripts)
        default, outside = None, False
        value = instance.attributes if instance.builtin or instance.enumeration else instance.mod
        if value.value is not None:
            assert value.scope is not None
            default = self.expr(value.value, value.scope, {})
            outside = value.scope.root.path is not None
        fields = None
        if instance.builtin:
            type_name = instance.builtin
        elif instance.enumeration is not None:
            type_name = "Integer"
        elif instance.is_kind("record", "operator record"):
            type_name = "record"
            instance.function = True
            fields = tuple(formal for _, _, formal in self._formals(instance))
        else:
            raise ModelicaError(
                f"'{name}' of '{ref.definition.path}' is not supported in a function", where=component.at
            )
        literals = literal_names(instance.enumeration)
        return Formal(name, component.at, type_name, shape, default, fields, literals, outside)

    def _size(self, subscript: Expression, scope: Instance) -> Expression:
        if isinstance(subscript, Reference):
            literals = self._enumeration_type(subscript, scope)
            if literals is not None:
                return Literal(subscript.at, len(literals))
        return self.expr(subscript, scope, {})  # type: ignore[no-any-return]

    def _function(self, key: str, instance: Instance) -> Function:
        for base in instance.all_bases():
            base.function = True
        instance.function = True
        inputs: list[Formal] = []
        outputs: list[Formal] = []
        inner: list[Formal] = []
        for component, slot, formal in self._formals(instance):
            prefixes = component.prefixes | self._prefixes_of_type(slot)
            target = inputs if "input" in prefixes else outputs if "output" in prefixes else inner
            if target is inner and not component.protected and not prefixes & {"constant", "parameter"}:
                what = f"'{formal.name}' in a function must be an input, an output or protected"
                raise ModelicaError(what, where=component.at)
            target.append(formal)
        self.operators.signatures[key] = self._signature(instance, inputs, outputs)
        # a function that calls itself needs its own arguments
        self.functions[key] = Function(key, instance.definition.at, tuple(inputs), tuple(outputs), (), ())
        external = None
        body: tuple[Any, ...] = ()
        for base in instance.all_bases():
            written = base.definition.external
            if written is not None:
                name = written.name or base.definition.name
                prefix = "builtin:" if written.language == "builtin" else ""
                if written.arguments is None:
                    arguments: tuple[Expression, ...] = tuple(
                        Reference(written.at, (Part(f.name),)) for f in inputs
                    )
                else:
                    arguments = self._all(written.arguments, base, {})
                target_name = written.output.name if written.output else (outputs[0].name if outputs else None)
                external = (f"{prefix}{name}", arguments, target_name)
            for section in base.definition.sections:
                if section.kind != "algorithm":
                    raise ModelicaError("a function has no equations", where=section.at)
                body = self.statements(section.items, base, {})
        pure = not any(b.definition.impure for b in instance.all_bases())
        return Function(
            key, instance.definition.at, tuple(inputs), tuple(outputs), tuple(inner), body, external, False, pure
        )

    def _signature(self, instance: Instance, inputs: Sequence[Formal], outputs: Sequence[Formal]) -> Signature:
        kinds = [self.operators.formal(instance.slots[f.name]) for f in (*inputs, *outputs[:1])]
        needed = sum(f.default is None for f in inputs)
        result = kinds.pop() if outputs else Kind(None)
        return Signature(tuple(kinds), tuple(f.name for f in inputs), needed, result)

    def _prefixes_of_type(self, slot: Slot) -> frozenset[str]:
        """Prefixes in the definition of a component's type, as in ``type T = input Real``."""
        assert isinstance(slot.element, ComponentDef)
        short = self.world.find_class(slot.scope, slot.element.type).definition.short
        return short.prefixes if short is not None else frozenset()

    def _constructor(self, key: str, instance: Instance) -> Function:
        instance.function = True
        inputs: list[Formal] = []
        fixed: list[Formal] = []
        for component, slot, formal in self._formals(instance):
            constant = "constant" in component.prefixes and formal.default is not None
            closed = component.final or slot.mod.final or component.protected or constant
            (fixed if closed else inputs).append(formal)
        result = self.operators.kind_of_class(instance)
        self.operators.signatures[key] = self._signature(instance, inputs, ())._replace(result=result)
        return Function(key, instance.definition.at, tuple(inputs), (), tuple(fixed), (), None, True)

    # ---- statements

    def statements(self, items: Sequence[Any], scope: Instance, env: Env) -> tuple[Any, ...]:
        """Flatten the statements of a function or an algorithm section."""
        return tuple(self._statement(s, scope, env) for s in items)

    def _statement(self, s: Any, scope: Instance, env: Env) -> Any:
        match s:
            case Assign():
                return Assign(s.at, self._target(s.target, scope, env), self.expr(s.value, scope, env))
            case AssignMany():
                targets = tuple(None if t is None else self._target(t, scope, env) for t in s.targets)
                call = self.expr(s.call, scope, env)
                if not isinstance(call, Call):
                    raise ModelicaError("a function call is expected here", where=s.at)
                return self._printed(call) or AssignMany(s.at, targets, call)
            case Reinit():
                return Reinit(s.at, self._target(s.state, scope, env), self.expr(s.value, scope, env))
            case Assert():
                condition, message = self._all((s.condition, s.message), scope, env)
                return Assert(s.at, condition, message, s.warning)
            case Terminate():
                return Terminate(s.at, self.expr(s.message, scope, env))
            case Return() | Break():
                return s
            case _:
                return self._compound(s, scope, env)

    def _printed(self, call: Call) -> Assert | None:
        """Make a warning of what ``Streams.print`` prints to the terminal."""
        function = self.functions.get(call.function)
        if function is None or function.external is None or function.external[0] != "ModelicaInternal_print":
            return None
        text, *file = call.arguments
        return None if text is None or any(file) else Assert(call.at, Literal(call.at, False), text, True)

    def _compound(self, s: Any, scope: Instance, env: Env) -> Any:
        """Flatten a statement that contains statements."""
        match s:
            case IfStatement():
                return self._if_statement(s, scope, env)
            case ForStatement():
                return self._for_statement(s, scope, env)
            case WhileStatement():
                return WhileStatement(
                    s.at, self.expr(s.condition, scope, env), self.statements(s.body, scope, env)
                )
            case WhenStatement():
                return WhenStatement(
                    s.at,
                    tuple((self.expr(c, scope, env), self.statements(b, scope, env)) for c, b in s.branches),
                )
        raise ModelicaError("this statement is not supported", where=s.at)

    def _if_statement(self, s: IfStatement, scope: Instance, env: Env) -> IfStatement:
        branches = [(test, self.statements(body, scope, env)) for test, body in self.open_branches(s, scope, env)]
        return IfStatement(s.at, tuple(branches))

    def open_branches(
        self, s: IfStatement, scope: Instance, env: Env
    ) -> list[tuple[Expression | None, tuple[Any, ...]]]:
        """Conditions and bodies of the branches that may be taken; the condition of a certain branch is None."""
        branches: list[tuple[Expression | None, tuple[Any, ...]]] = []
        for condition, body in s.branches:
            test = None if condition is None else self.expr(condition, scope, env)
            if isinstance(test, Literal):
                if not self.truth(test, s.at):
                    continue
                test = None
            branches.append((test, body))
            if test is None:
                break
        return branches

    def _for_statement(self, s: ForStatement, scope: Instance, env: Env) -> ForStatement:
        inner = dict(env)
        iterators = []
        for name, bounds in s.iterators:
            values = self._implied(name, s.body, scope, env) if bounds is None else bounds
            if isinstance(values, Reference) and values.parts[0].name not in inner:
                values = self._type_range(values, scope) or values
            flat = self.expr(values, scope, inner)
            if isinstance(flat, Literal):
                raise ModelicaError(f"the range of '{name}' is a scalar, not an array", where=flat.at)
            iterators.append((name, flat))
            inner[name] = None
        return ForStatement(s.at, tuple(iterators), self.statements(s.body, scope, inner))

    def _target(self, e: Reference, scope: Instance, env: Env) -> Reference:
        out = self.expr(e, scope, env)
        if not isinstance(out, Reference):
            raise ModelicaError(f"'{e.name}' cannot be assigned", where=e.at)
        return out


def _check_type(path: str, component: ComponentDef, ref: ClassRef, root: Instance) -> None:
    """Refuse a component whose class cannot be instantiated."""
    kind, name = ref.definition.kind, ref.definition.path
    if ref.definition.partial and not component.outer and kind != "type":
        raise ModelicaError(
            f"'{path}' is of the partial class '{name}'",
            where=component.at,
            fix="redeclare it" if component.replaceable else "give it a class that extends it",
        )
    if kind.endswith("function") and root.function:
        raise ModelicaError(f"'{component.name}': functions as arguments are not supported", where=component.at)
    if kind == "package" or kind.endswith("function"):
        raise ModelicaError(f"'{name}' is a {kind}, not a type", where=component.at)


class _Path:
    """Follows the parts of a reference from item to item."""

    def __init__(self, resolver: Resolver, e: Reference, scope: Instance, env: Env) -> None:
        self._resolver = resolver
        self._e = e
        self._scope = scope
        self._env = env

    def walk(self, item: Item, position: int, element: bool = False) -> Any:
        """Return the object of the reference, starting from the item that its part at a position names.

        Parameters
        ----------
        element
            Whether the part's subscripts are used up, so that the item is an element of an array.
        """
        e, part = self._e, self._e.parts[position]
        if isinstance(item, Absent):
            what = f"'{e.name}' is a conditional component that does not exist, or an animation"
            raise ModelicaError(what, where=e.at)
        if isinstance(item, Many):
            return self._slice(item, position)
        if isinstance(item, Instance):
            if part.subscripts and not element:
                raise ModelicaError(f"'{part.name}' is not an array", where=e.at)
            return self._instance(item, position)
        if position + 1 < len(e.parts):
            raise ModelicaError(f"'{item.name}' has no '{e.parts[position + 1].name}'", where=e.at)
        return self._variable(item, part)

    def _variable(self, item: Var, part: Part) -> Any:
        e, resolver = self._e, self._resolver
        subscripts = resolver._all(part.subscripts, self._scope, self._env)
        if len(subscripts) > len(item.dims):
            raise ModelicaError(f"'{item.name}' has {counted(len(item.dims), 'dimension')}", where=e.at)
        for subscript, size in zip(subscripts, item.element.subscripts, strict=False):
            number = isinstance(subscript, Literal) and isinstance(subscript.value, int) and not subscript.literals
            if number and isinstance(size, Reference) and resolver._type_range(size, item.slot.scope) is not None:
                if isinstance(subscript.value, bool):
                    continue
                raise ModelicaError(f"'{item.name}' has a dimension of {size.name}, not of numbers", where=e.at)
        if item.variability == "constant" and (self._scope.root.function or _in_package(item.owner)):
            return resolver.pick(e.at, resolver.constant(item), subscripts)
        if item.owner.path is None:
            raise ModelicaError(f"'{item.name}' is not a constant", where=e.at)
        return Reference(e.at, (Part(item.name, subscripts),))

    def _instance(self, item: Instance, position: int) -> Any:
        e, resolver = self._e, self._resolver
        if position + 1 == len(e.parts):
            if self._scope.root.function or _in_package(item):
                return resolver._record_value(item, e.at)
            return Reference(e.at, (Part(item.path or ""),))
        name = e.parts[position + 1].name
        slot = item.slot(name)
        if slot is None and item.definition.kind == "expandable connector":
            raise _NotInBusError(item, name, e.at)
        if slot is None:
            raise ModelicaError(f"'{item.path}' has no '{name}'", where=e.at, fix=World.suggest(name, item.slots))
        if isinstance(slot.element, ClassDef):
            raise ModelicaError(f"'{e.name}' is a class, not a variable", where=e.at)
        check_visible(slot, item.path or "", e.at)
        return self.walk(resolver.item(item, name), position + 1)

    def _slice(self, many: Many, position: int) -> Any:
        e = self._e
        subscripts = self._resolver._all(e.parts[position].subscripts, self._scope, self._env)
        if len(subscripts) > len(many.dims):
            raise ModelicaError(f"'{many.name}' has {counted(len(many.dims), 'dimension')}", where=e.at)
        chosen: list[list[int] | int] = []
        open_at: list[tuple[int, Expression]] = []
        for k, n in enumerate(many.dims):
            value = self._chosen(subscripts[k] if k < len(subscripts) else All(e.at), n)
            if value is None:
                open_at.append((sum(isinstance(c, list) for c in chosen), subscripts[k]))
                value = list(range(1, n + 1))
            chosen.append(value)
            outside = [i for i in (value if isinstance(value, list) else [value]) if not 1 <= i <= n]
            if outside:
                raise ModelicaError(f"subscript {outside[0]} of '{many.name}' is outside 1..{n}", where=e.at)
        if len(open_at) > 1:
            raise ModelicaError("only one subscript may be unknown at translation", where=e.at)

        out = self._build(many, chosen, position, [])
        for place, subscript in open_at:
            out = Subscripted(e.at, out, (*(All(e.at),) * place, subscript))
        return out

    def _build(self, many: Many, chosen: list[list[int] | int], position: int, index: list[int]) -> Any:
        """Arrange the values of the chosen elements as an array."""
        if len(index) == len(chosen):
            return self.walk(many.at(index), position, True)
        c = chosen[len(index)]
        if isinstance(c, int):
            return self._build(many, chosen, position, [*index, c])
        return ArrayOf(self._e.at, tuple(self._build(many, chosen, position, [*index, i]) for i in c))

    def _chosen(self, subscript: Expression, size: int) -> int | list[int] | None:
        """Elements that a subscript selects; None if they are only known later."""
        if isinstance(subscript, All):
            return list(range(1, size + 1))
        if _has_local(subscript, self._env) or self._scope.root.function:
            return None
        return self._resolver._subscript(subscript, size)


class _NotInBusError(ModelicaError):
    """A name that an expandable connector does not have (yet)."""

    def __init__(self, instance: Instance, name: str, at: Place) -> None:
        super().__init__(f"expandable connector '{instance.path}' has no '{name}'", where=at)
        self.instance = instance
        self.name = name


NotInBusError = _NotInBusError


class _Known:
    """Scope of evaluations during flattening."""

    def __init__(self, resolver: Resolver) -> None:
        self._resolver = resolver

    def lookup(self, name: str) -> Value:
        resolver = self._resolver
        if name == "time":
            return SX.sym("time")
        var = resolver.vars.get(name)
        if var is not None:
            return resolver.value(var)
        instance = resolver.instances.get(name)
        if instance is None:
            raise KeyError(name)
        out: dict[str, Value] = {}
        for field_name, slot in instance.slots.items():
            if isinstance(slot.element, ComponentDef):
                item = resolver.item(instance, field_name)
                if isinstance(item, Var):
                    out[field_name] = resolver.value(item)
                elif isinstance(item, Instance):
                    out[field_name] = self.lookup(item.path or "")
        return out

    def derivative(self, value: Any) -> Any:
        return SX.sym("der") if isinstance(value, SX) else 0.0

    def previous(self, value: Any) -> Any:
        return value

    def relation(self, difference: SX, inclusive: bool) -> SX:
        return SX.sym("relation")

    def step(self, argument: SX) -> SX:
        return SX.sym("step")

    def sample(self, start: Any, interval: Any) -> SX:
        return SX.sym("sample")

    def starting(self) -> SX:
        raise ValueError("this determines the structure, so it must be known at translation")

    def initial(self) -> SX:
        return SX.sym("initial")

    def terminal(self) -> SX:
        return SX.sym("terminal")

    def delay(self, value: Any, time: Any) -> Any:
        return SX.sym("delay")

    def transport(self, *_: object) -> tuple[SX, SX]:
        return SX.sym("outlet"), SX.sym("outlet")

    def is_fixed(self, value: SX) -> bool:
        return True


def _in_package(instance: Instance) -> bool:
    """Whether a component is part of a constant of a package."""
    owner: Instance | None = instance
    while owner is not None:
        if owner.root.path is None:
            return True
        owner = owner.root.owner
    return False


def _built_in(function: Function, call: Call) -> Call:
    """Return the call of a built-in function that a function stands for, else the one given."""
    if function.external is None or not function.external[0].startswith("builtin:"):
        return call
    by_name = dict(zip([f.name for f in function.inputs], call.arguments, strict=False))
    used = [by_name[a.name] for a in function.external[1] if isinstance(a, Reference)]
    return Call(call.at, function.external[0].removeprefix("builtin:"), tuple(used))


def _with_outside(function: Function, arguments: tuple[Expression | None, ...]) -> tuple[Expression | None, ...]:
    """Give a function of a component the defaults that depend on the component."""
    if not any(formal.outside for formal in function.inputs):
        return arguments
    padded = [*arguments, *[None] * (len(function.inputs) - len(arguments))]
    return tuple(
        formal.default if given is None and formal.outside else given
        for formal, given in zip(function.inputs, padded, strict=True)
    )


def literal_names(enumeration: ClassDef | None) -> tuple[str, ...]:
    """Names of the literals of an enumeration."""
    return tuple(n for n, _ in (enumeration.enumeration if enumeration is not None else None) or ())


def check_visible(slot: Slot, owner: str, at: Place) -> None:
    """Refuse a protected element that is named from outside."""
    if slot.protected:
        raise ModelicaError(f"'{slot.name}' is protected in '{owner}'", where=at)


def _indexed(name: str, body: Any) -> Iterator[tuple[Reference, int]]:
    """Yield the arrays, and their dimensions, that a loop variable indexes directly."""
    for node in walk(body):
        if isinstance(node, Reference):
            for k, part in enumerate(node.parts):
                for position, subscript in enumerate(part.subscripts):
                    if isinstance(subscript, Reference) and subscript.name == name:
                        yield Reference(node.at, (*node.parts[:k], Part(part.name)), node.rooted), position


def _has_local(tree: Any, env: Env) -> bool:
    return any(isinstance(n, Reference) and n.parts[0].name in env for n in walk(tree))


def _scalars(value: Value) -> tuple[Any, ...]:
    if isinstance(value, str) or value is None:
        return (value,)
    if isinstance(value, dict):
        return tuple(s for v in value.values() for s in _scalars(v))
    if isinstance(value, tuple):
        return tuple(s for v in value for s in _scalars(v))
    return algebra.scalars(value)


def _says(component: ComponentDef, name: str) -> bool:
    """Whether an annotation of a component sets a flag."""
    source = component.annotation
    if source is None or name not in source.text[source.start : source.stop]:
        return False
    for argument in annotation(source):
        if argument.name == name and not hasattr(argument, "element"):
            value = argument.modification.value
            return isinstance(value, Literal) and value.value is True
    return False


_ATTRIBUTES = frozenset(
    ("quantity", "unit", "displayUnit", "min", "max", "start", "fixed", "nominal", "unbounded", "stateSelect",
     "uncertain")
)  # fmt: skip
