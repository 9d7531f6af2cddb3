"""Instances of classes: inheritance, modifications, redeclarations, lookup of names (specification 5 and 7).

An `Instance` is a class in an environment: its modifications and the instance in which it is written. A component
that is not a variable is an instance with a path; a package in which names are looked up is one without. A class
that another extends is an instance too, which shares the elements of the other (its root), so that a name in it
finds redeclared elements.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from fmu_build.errors import ModelicaError
from fmu_build.front.classes import (
    Argument,
    ClassDef,
    ComponentDef,
    Constraint,
    Extends,
    Modification,
    Short,
)
from fmu_build.front.library import Library
from fmu_build.front.restrictions import check_base, check_class
from fmu_build.syntax import Expression, Literal, Node, Part, Place, Reference, Subscripted
from fmu_build.syntax import Field as FieldOf

_NOWHERE = Place("(predefined)", 1)
PREDEFINED = ("Real", "Integer", "Boolean", "String", "ExternalObject")


def _enumeration(name: str, *literals: str) -> ClassDef:
    return ClassDef(_NOWHERE, name, "type", enumeration=tuple((n, "") for n in literals), path=name)


_BUILTIN = {name: ClassDef(_NOWHERE, name, "builtin", path=name) for name in PREDEFINED} | {
    "StateSelect": _enumeration("StateSelect", "never", "avoid", "default", "prefer", "always"),
    "AssertionLevel": _enumeration("AssertionLevel", "warning", "error"),
}


@dataclass(frozen=True, slots=True)
class Foreign(Node):
    """An expression from a scope other than that of its context."""

    expression: Any
    scope: Any


@dataclass(frozen=True, slots=True)
class Mod:
    """A modification with the scope in which its expressions are looked up.

    Attributes
    ----------
    value, scope
        Binding, and the instance whose names it uses.
    subs
        Modifications of elements, by name.
    redeclare
        New declaration and its scope; `below` is then the modification of the old one, which the new one's
        overrides.
    """

    at: Place
    scope: Instance | None = None
    value: Expression | None = None
    subs: dict[str, Mod] = field(default_factory=dict)
    each: bool = False
    final: bool = False
    redeclare: tuple[ComponentDef | ClassDef, Instance] | None = None
    below: Mod | None = None
    weak: bool = False  # of a field, where the record as a whole has a value from further outside

    def indexed(self, index: tuple[int, ...]) -> Mod:
        """Return the modification of one element of an array of components."""
        if self.each:
            return replace(self, each=False)
        value = self.value
        if value is not None:
            value = Subscripted(value.at, value, tuple(Literal(value.at, i) for i in index))
        return replace(self, value=value, subs={n: m.indexed(index) for n, m in self.subs.items()})


NO_MOD = Mod(_NOWHERE)


def modifier(modification: Modification, scope: Instance, each: bool = False, final: bool = False) -> Mod:
    """Bind a modification to the scope in which it is written."""
    if modification.broken:
        raise ModelicaError("'break' in a modification is not supported", where=modification.at)
    if not modification.arguments and modification.value is None:
        return Mod(modification.at, scope, None, {}, each, final) if each or final else NO_MOD
    subs: dict[str, Mod] = {}
    for argument in modification.arguments:
        if isinstance(argument, Argument):
            new = modifier(argument.modification, scope, argument.each, argument.final)
            if new is NO_MOD:
                new = Mod(argument.at)
            new = replace(new, at=argument.at)
        else:
            new = Mod(argument.at, scope, None, {}, argument.each, argument.final, (argument.element, scope))
            if isinstance(argument.element, ComponentDef | ClassDef) and not argument.element.redeclare:
                # ``replaceable`` alone keeps the element and may give it another type
                new = replace(new, redeclare=(argument.element, scope))
        old = subs.get(argument.name)
        if old is not None:
            if (old.value is not None and new.value is not None) or (old.redeclare and new.redeclare):
                raise ModelicaError(f"'{argument.name}' is modified twice", where=argument.at)
            new = merge(new, old, "")
        subs[argument.name] = new
    return Mod(modification.at, scope, modification.value, subs, each, final)


def merge(outer: Mod, inner: Mod, name: str) -> Mod:
    """Return both modifications combined; `outer` takes precedence."""
    if inner is NO_MOD:
        return outer
    if outer is NO_MOD:
        return inner
    if inner.final and (outer.value is not None or outer.redeclare is not None or outer.subs):
        raise ModelicaError(f"'{name}' is final and cannot be modified", where=outer.at)
    if outer.redeclare is not None:
        below = replace(inner, redeclare=None, below=None)
        if outer.below is not None:
            below = merge(outer.below, below, name)
        return replace(outer, below=below, final=outer.final or inner.final)
    subs = dict(inner.subs)
    if outer.value is not None:  # the value of a record overrides modifications of its fields further inside
        subs = {n: replace(m, weak=True) for n, m in subs.items()}
    for sub, mod in outer.subs.items():
        subs[sub] = merge(mod, subs[sub], sub) if sub in subs else mod
    winner = outer if outer.value is not None else inner
    return Mod(
        outer.at if outer.value is not None or inner.value is None else inner.at,
        winner.scope,
        winner.value,
        subs,
        winner.each,
        outer.final or inner.final,
        inner.redeclare,
        inner.below,
    )


@dataclass(slots=True, eq=False)
class Slot:
    """An element of an instance: its declaration, the declaration's scope, and its modification."""

    name: str
    element: ComponentDef | ClassDef
    scope: Instance
    mod: Mod
    package: Instance | None = None
    resolved: Slot | None = None

    def effective(self) -> Slot:
        """Return the slot after a redeclaration, with its complete modification."""
        if self.resolved is None:
            self.resolved = _resolve(self)
        return self.resolved


def _own_modification(element: ComponentDef | ClassDef) -> Modification | None:
    if isinstance(element, ComponentDef):
        return element.modification
    return element.short.modification if element.short else None


def _constraint_mod(constraint: Constraint | None, scope: Instance) -> Mod:
    return NO_MOD if constraint is None else modifier(constraint.modification, scope)


def _resolve(slot: Slot) -> Slot:
    old, mod, name = slot.element, slot.mod, slot.name
    if mod.redeclare is None:
        mod = merge(mod, _own_mod(old, slot.scope), name) if isinstance(old, ComponentDef) else mod
        return Slot(name, old, slot.scope, merge(mod, _constraint_mod(old.constraint, slot.scope), name))
    new, scope = mod.redeclare
    _check_redeclared(old, new, mod)
    # Modifiers of the constraining clause apply to every redeclaration; without one, those of the declaration do.
    if old.constraint is not None:
        carried = _constraint_mod(old.constraint, slot.scope)
    else:
        carried = _own_mod(old, slot.scope)
    if new.constraint is not None:
        carried = merge(_constraint_mod(new.constraint, scope), carried, name)
    carried = replace(carried, value=None) if carried is not NO_MOD else carried
    outer = replace(mod, redeclare=None, below=None)
    if mod.below is not None:
        carried = merge(mod.below, carried, name)
    if isinstance(new, ComponentDef):
        assert isinstance(old, ComponentDef)
        redeclared = _own_mod(new, scope)
        declared = _redeclared(old, slot.scope, new, scope)
        return Slot(name, declared, scope, merge(outer, merge(redeclared, carried, name), name))
    return Slot(name, new, scope, _with_carried(outer, new, scope, carried, name))


def _check_redeclared(old: ComponentDef | ClassDef, new: ComponentDef | ClassDef, mod: Mod) -> None:
    if isinstance(new, ClassDef) != isinstance(old, ClassDef):
        raise ModelicaError(f"'{old.name}' is redeclared as an element of another kind", where=mod.at)
    if new.redeclare and not old.replaceable:
        raise ModelicaError(f"'{old.name}' is not replaceable", where=mod.at)
    if new.redeclare and old.final:
        raise ModelicaError(f"'{old.name}' is final and cannot be redeclared", where=mod.at)


def _redeclared(old: ComponentDef, old_scope: Instance, new: ComponentDef, scope: Instance) -> ComponentDef:
    """Return a component's new declaration, with the parts inherited from the old one."""

    def carried(expression: Expression) -> Any:
        return expression if scope is old_scope else foreign(expression, old_scope)

    condition = new.condition
    if condition is None and old.condition is not None:
        condition = carried(old.condition)
    return replace(
        new,
        prefixes=_prefixes(new, old),
        subscripts=new.subscripts or tuple(map(carried, old.subscripts)),
        condition=condition,
        description=new.description or old.description,
        annotation=new.annotation or old.annotation,
        inner=new.inner or old.inner,
        outer=new.outer or old.outer,
        protected=old.protected,
    )


def _replaces(element: ComponentDef | ClassDef) -> bool:
    return element.redeclare or (isinstance(element, ClassDef) and element.extended is not None)


def foreign(expression: Expression, scope: Instance) -> Any:
    """Wrap an expression that is used outside its own scope."""
    return Foreign(expression.at, expression, scope)


def _prefixes(new: ComponentDef, old: ComponentDef) -> frozenset[str]:
    """Prefixes of a redeclared component: its own, and those of the old one that it does not replace."""
    out = set(new.prefixes)
    for group in ({"flow", "stream"}, {"parameter", "constant", "discrete"}, {"input", "output"}):
        if not group & out:
            out |= group & old.prefixes
    return frozenset(out)


def _own_mod(element: ComponentDef | ClassDef, scope: Instance) -> Mod:
    modification = _own_modification(element)
    return (
        NO_MOD
        if modification is None
        else modifier(modification, scope, final=isinstance(element, ComponentDef) and element.final)
    )


def _with_carried(outer: Mod, new: ClassDef, scope: Instance, carried: Mod, name: str) -> Mod:
    """Modification of a redeclared class, in which the new class's modifiers override the inherited ones."""
    if carried is NO_MOD or not carried.subs:
        return outer
    redeclared = _own_mod(new, scope)
    subs = {n: m for n, m in carried.subs.items() if n not in redeclared.subs}
    return merge(outer, replace(carried, subs=subs), name)


@dataclass(frozen=True, slots=True)
class ClassRef:
    """A class that a name refers to, before it is instantiated."""

    definition: ClassDef
    parent: Instance | None
    mod: Mod = NO_MOD
    slot: Slot | None = None


class Instance:
    """A class in an environment (see the module's docstring)."""

    def __init__(
        self,
        world: World,
        definition: ClassDef,
        parent: Instance | None,
        mod: Mod,
        *,
        path: str | None = None,
        owner: Instance | None = None,
        root: Instance | None = None,
        elaborate: bool = True,
    ) -> None:
        self.world = world
        self.definition = definition
        self.parent = parent
        self.path = path
        self.owner = owner
        self.root = root or self
        self.mod = mod
        self.bases: list[Instance] = []
        self.visible: set[str] = set()
        self.slots: dict[str, Slot] = {} if root is None else root.slots
        self.items: dict[str, Any] = {} if root is None else root.items
        self.prefixes: frozenset[str] = frozenset()  # those of the component and of its parents
        self.final = False
        self.protected = False
        self.builtin: str | None = definition.name if definition.kind == "builtin" else None
        self.enumeration: ClassDef | None = definition if definition.enumeration is not None else None
        self.subscripts: list[tuple[Expression, Instance]] = []  # those of array types
        self.short_prefixes: frozenset[str] = frozenset()
        self.function = definition.kind.endswith("function")
        self.attributes = mod  # finally, those of a predefined type
        self.declared_at: Place | None = None
        self.description = ""
        if elaborate:
            self.elaborate()

    # ---- inheritance

    def elaborate(self) -> None:
        """Inherit, and list the elements."""
        definition, world = self.definition, self.world
        world.check(definition)
        if self.builtin or self.enumeration:
            return
        if world.depth > 200:
            raise ModelicaError(f"'{definition.path}' contains itself", where=definition.at)
        world.depth += 1
        try:
            if definition.short is not None:
                self._stand_for(definition.short)
            else:
                self._list_elements()
        finally:
            world.depth -= 1

    def _stand_for(self, short: Short) -> None:
        base = self.world.find_class(self.parent, short.type)
        self.subscripts = [(s, self._outside()) for s in short.subscripts]
        self.short_prefixes = short.prefixes
        written = modifier(short.modification, self._outside())
        self._inherit(base, merge(self.mod, written, self.definition.name))

    def _list_elements(self) -> None:
        definition = self.definition
        redeclared = {
            element.name: Mod(element.at, self, None, {}, False, element.final, (element, self))
            for element in definition.elements
            if isinstance(element, ComponentDef | ClassDef) and _replaces(element)
        }
        body = Mod(definition.at, self, None, redeclared) if redeclared else NO_MOD
        for element in definition.elements:  # a base class may be one of them
            if isinstance(element, ClassDef) and element.name not in redeclared:
                self._add(element)
        for element in definition.elements:
            if isinstance(element, Extends):
                base = self.world.find_class(self, element.type, extends=definition)
                check_base(definition, base.definition, element)
                written = modifier(element.modification, self)
                self._inherit(base, merge(self.mod, merge(body, written, definition.name), definition.name))
            elif isinstance(element, ComponentDef) and element.name not in redeclared:
                self._add(element)
        for name, mod in redeclared.items():
            if name not in self.visible:
                raise ModelicaError(f"'{name}' is redeclared, but not inherited", where=mod.at)
        if self.root is self:
            self._check_modified()

    def _outside(self) -> Instance:
        """Scope of a short class's own expressions: the instance in which it is written."""
        return self.parent or self

    def _inherit(self, base: ClassRef, mod: Mod) -> None:
        inherited = Instance(
            self.world,
            base.definition,
            base.parent,
            merge(mod, base.mod, base.definition.name),
            path=self.path,
            owner=self.owner,
            root=self.root,
        )
        self.bases.append(inherited)
        self.visible |= inherited.visible
        self.builtin = self.builtin or inherited.builtin
        self.enumeration = self.enumeration or inherited.enumeration
        self.subscripts = self.subscripts + inherited.subscripts
        self.short_prefixes |= inherited.short_prefixes
        self.attributes = inherited.attributes

    def _add(self, element: ComponentDef | ClassDef) -> Slot:
        name = element.name
        old = self.slots.get(name)
        if old is not None and old.element is not element:
            if old.scope is self:
                raise ModelicaError(f"'{name}' is declared twice", where=element.at)
            if isinstance(old.element, ComponentDef) != isinstance(element, ComponentDef) or (
                isinstance(old.element, ComponentDef)
                and isinstance(element, ComponentDef)
                and not _alike(old.element, element)
            ):
                raise ModelicaError(f"'{name}' is inherited, but declared differently here", where=element.at)
        if old is None:
            old = self.slots[name] = Slot(name, element, self, self.mod.subs.get(name, NO_MOD))
        self.visible.add(name)
        return old

    def _check_modified(self) -> None:
        for name, mod in self.mod.subs.items():
            if self.path and name in self.slots and self.slots[name].element.protected:
                raise ModelicaError(f"'{name}' is protected in '{self.path}' and cannot be modified", where=mod.at)
            if name not in self.slots and not (self.builtin or self.enumeration):
                if self.definition.loader is not None and self.definition.member(name):
                    continue
                where = mod.at
                raise ModelicaError(
                    f"'{self.definition.path}' has no element '{name}'",
                    where=where,
                    fix=self.world.suggest(name, self.slots),
                )

    # ---- names

    def slot(self, name: str) -> Slot | None:
        """Element of that name, including inherited ones."""
        if name in self.visible:
            return self.slots[name]
        if self.definition.loader is not None:
            member = self.definition.member(name)
            if isinstance(member, ClassDef):
                return self._add(member)
        for base in self.bases:
            inherited = base.slot(name)
            if inherited is not None:
                self.visible.add(name)
                return inherited
        return None

    def all_bases(self) -> Iterator[Instance]:
        """Yield every class that this one extends, directly or not, then this one: bases first."""
        for base in self.bases:
            yield from base.all_bases()
        yield self

    def is_kind(self, *kinds: str) -> bool:
        """Whether the class, or one that it extends by a short definition, is of one of these kinds."""
        if self.definition.kind in kinds:
            return True
        return any(base.is_kind(*kinds) for base in self.bases)

    @property
    def class_name(self) -> str:
        """Qualified name of the class; for a short class without modifiers, of the class that it renames."""
        return self.definition.path or self.definition.name


def _alike(a: ComponentDef, b: ComponentDef) -> bool:
    """Whether two declarations are the same (an element that is inherited twice)."""
    return (
        a.type.name.rpartition(".")[2] == b.type.name.rpartition(".")[2]
        and a.prefixes == b.prefixes
        and len(a.subscripts) == len(b.subscripts)
    )


class World:
    """All classes, and the lookup of names in them."""

    def __init__(self, library: Library) -> None:
        self.library = library
        self.depth = 0
        self._checked: set[ClassDef] = set()
        self._packages: dict[tuple[int, int], Instance] = {}
        self._imports: dict[tuple[int, str], ClassRef | Slot | Literal | None] = {}

    def check(self, definition: ClassDef) -> None:
        """Check a class, once, for what the specification forbids."""
        if definition not in self._checked:
            self._checked.add(definition)
            check_class(definition)

    # ---- lookup

    def find(self, scope: Instance | None, name: str, rooted: bool = False) -> Slot | ClassRef | None:
        """Find a simple name from a scope outwards (specification 5.3.1); None if missing or a literal."""
        value = self.find_value(scope, name, rooted)
        return None if isinstance(value, Literal) else value

    def find_value(
        self, scope: Instance | None, name: str, rooted: bool = False
    ) -> Slot | ClassRef | Literal | None:
        """Find a simple name, which may be that of an imported literal of an enumeration."""
        while scope is not None and not rooted:
            slot = scope.slot(name)
            if slot is not None:
                return slot
            imported = self._imported(scope, name)
            if imported is not None:
                return imported
            if scope.definition.encapsulated:
                break
            scope = scope.parent
        if name in _BUILTIN and not rooted:
            return ClassRef(_BUILTIN[name], None)
        top = self.library.top(name)
        return None if top is None else ClassRef(top, None)

    def _imported(self, scope: Instance, name: str) -> Slot | ClassRef | Literal | None:
        definition = scope.definition
        if not definition.imports:
            return None
        memo = (id(definition), name)
        if memo not in self._imports:
            self._imports[memo] = None  # an import does not look itself up
            for clause in definition.imports:
                if clause.alias == name:
                    imported: Slot | ClassRef | Literal | None = self._qualified(clause.name)
                    if imported is None:
                        imported = self._literal(clause.name)
                    if imported is None:
                        raise ModelicaError(
                            f"there is no '{clause.name}' to import", where=clause.at, fix=self.absent(clause.name)
                        )
                    self._imports[memo] = imported
                    break
                if clause.alias == "*":
                    package = self._qualified(clause.name)
                    if package is None:
                        raise ModelicaError(
                            f"there is no '{clause.name}' to import", where=clause.at, fix=self.absent(clause.name)
                        )
                    imported = self.package(package, clause.at).slot(name)
                    if imported is not None:
                        self._imports[memo] = imported
                        break
        return self._imports[memo]

    def absent(self, name: str) -> str | None:
        """Return advice for a name that does not exist."""
        first = name.partition(".")[0]
        top = self.library.top(first)
        fix = "with --root (roots= in Python), or as `roots` of the model in campaign.toml"
        if first in self.library.stand_ins:
            return (
                "this needs the Modelica Standard Library, which is not found: get it with `git clone "
                "https://github.com/modelica/ModelicaStandardLibrary` or as the zip of a release there, "
                f"and pass its folder {fix}"
            )
        if top is None:
            roots = [str(r) for r in self.library.roots]
            where = f"none of the library directories has '{first}'" if roots else f"'{first}' is in no library"
            return f"{where}; give its directory {fix}"
        return None

    def _qualified(self, name: str) -> Slot | ClassRef | None:
        first, *rest = name.split(".")
        top = self.library.top(first)
        target: Slot | ClassRef | None = None
        if top is not None:
            target = ClassRef(top, None)
        elif first in _BUILTIN:
            target = ClassRef(_BUILTIN[first], None)
        for part in rest:
            if target is None:
                return None
            if isinstance(target, Slot) and isinstance(target.element, ComponentDef):
                return None
            target = self.package(target, _NOWHERE).slot(part)
        return target

    def _literal(self, name: str) -> Literal | None:
        """Literal of an enumeration by its full name."""
        enumeration, _, literal = name.rpartition(".")
        enumerated = self._qualified(enumeration) if enumeration else None
        if enumerated is None or (isinstance(enumerated, Slot) and isinstance(enumerated.element, ComponentDef)):
            return None
        declared = self.package(enumerated, _NOWHERE).enumeration
        names = [n for n, _ in (declared.enumeration if declared is not None else None) or ()]
        if literal not in names:
            return None
        return Literal(_NOWHERE, names.index(literal) + 1, literal, tuple(names))

    def find_class(self, scope: Instance | None, name: Reference, extends: ClassDef | None = None) -> ClassRef:
        """Find a class by its name as written.

        Raises
        ------
        ModelicaError
            If there is none.
        """
        target = self.lookup_class(scope, name, extends)
        if target is None and name.name == "Clock":
            raise ModelicaError("clocks are not supported", where=name.at, fix="use sample() in a when-equation")
        if target is None:
            where = scope.definition.path if scope is not None else ""
            raise ModelicaError(
                f"there is no class '{name.name}'" + (f" (in {where})" if where else ""),
                where=name.at,
                fix=self.absent(name.name) if len(name.parts) > 1 else None,
            )
        return target

    def lookup_class(
        self, scope: Instance | None, name: Reference, extends: ClassDef | None = None
    ) -> ClassRef | None:
        """Find a class by its name as written; None if it does not exist."""
        first = name.parts[0].name
        target: Slot | ClassRef | None = None
        if extends is not None and scope is not None:
            # the base class is found without looking at inherited elements
            member = extends.member(first)
            if isinstance(member, ClassDef) and not member.redeclare and member.extended is None:
                slot = scope.slots.get(first)
                target = slot if slot is not None and slot.element is member else scope._add(member)
            else:
                imported = self._imported(scope, first)
                if imported is not None and not isinstance(imported, Literal):
                    target = imported
                elif not extends.encapsulated:
                    target = self.find(scope.parent, first)
                if target is None and first in scope.visible:
                    target = scope.slots[first]
                if target is None:
                    target = self.find(None, first)
        else:
            target = self.find(scope, first, name.rooted)
        for part in name.parts[1:]:
            if target is None:
                return None
            target = self.member(target, part.name, name.at)
        return None if target is None else self.class_ref(target)

    def member(self, target: Slot | ClassRef, name: str, at: Place) -> Slot | None:
        """Find a member of a package (or of the class of a component)."""
        if isinstance(target, Slot) and isinstance(target.element, ComponentDef):
            return None
        return self.package(target, at).slot(name)

    def class_ref(self, target: Slot | ClassRef) -> ClassRef | None:
        """Return the class that a lookup found; None if it found a component."""
        if isinstance(target, ClassRef):
            return target
        slot = target.effective()
        if isinstance(slot.element, ComponentDef):
            return None
        definition = slot.element
        if definition.extended is not None:
            return self._extended(target, slot)
        return ClassRef(definition, slot.scope, slot.mod, target)

    def _extended(self, inherited: Slot, slot: Slot) -> ClassRef:
        """Class of ``redeclare model extends X``: X as inherited, with additional elements."""
        old = inherited.element
        definition = slot.element
        assert isinstance(definition, ClassDef)
        assert isinstance(old, ClassDef)
        below = inherited.mod.below or NO_MOD
        base = Slot(inherited.name, old, inherited.scope, below)
        if definition.extended is None:
            raise AssertionError
        hidden = f"{inherited.name} (inherited)"
        holder = Instance(
            self,
            ClassDef(definition.at, definition.name, "package", path=slot.scope.definition.path),
            slot.scope,
            NO_MOD,
        )
        holder.slots[hidden] = base
        holder.visible.add(hidden)
        copy = ClassDef(
            definition.at, definition.name, definition.kind, definition.partial,
            description=definition.description, annotation=definition.annotation,
            imports=definition.imports, sections=definition.sections, external=definition.external,
            outside=definition.outside, path=definition.path,
        )  # fmt: skip
        copy.elements = [
            Extends(definition.at, Reference(definition.at, (Part(hidden),)), definition.extended),
            *definition.elements,
        ]
        return ClassRef(copy, holder, slot.mod, inherited)

    def package(self, target: Slot | ClassRef, at: Place) -> Instance:
        """Instance of a class in which names are looked up."""
        if isinstance(target, Slot) and target.package is not None:
            return target.package
        ref = self.class_ref(target)
        if ref is None:
            raise ModelicaError(f"'{target.name if isinstance(target, Slot) else ''}' is not a package", where=at)
        ref = self.plain(ref)
        out = self._instance(ref)
        if isinstance(target, Slot):
            target.package = out
        return out

    def plain(self, ref: ClassRef) -> ClassRef:
        """Follow short classes that change nothing."""
        for _ in range(100):
            definition = ref.definition
            short = definition.short
            if (
                short is None or ref.mod.subs or short.modification.arguments or short.subscripts or short.prefixes
                or definition.kind not in ("package", "function", "model", "block", "class", "record")
            ):  # fmt: skip
                return ref
            ref = self.find_class(ref.parent, short.type)
        return ref

    def _instance(self, ref: ClassRef) -> Instance:
        memo = (id(ref.definition), id(ref.parent))
        if ref.mod.subs:
            return Instance(self, ref.definition, ref.parent, ref.mod)
        if memo not in self._packages:
            # registered before its elaboration, because a package may extend a class that lies in it
            self._packages[memo] = Instance(self, ref.definition, ref.parent, NO_MOD, elaborate=False)
            self._packages[memo].elaborate()
        return self._packages[memo]

    def instantiate(self, ref: ClassRef, mod: Mod, path: str, owner: Instance | None) -> Instance:
        """Make an instance that is a component."""
        merged = merge(mod, ref.mod, ref.definition.name)
        return Instance(self, ref.definition, ref.parent, merged, path=path, owner=owner)

    @staticmethod
    def suggest(name: str, known: Any) -> str | None:
        """Return a suggestion with the known name nearest to an unknown one."""
        import difflib

        near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
        return f"did you mean '{near[0]}'?" if near else None


def field_mod(mod: Mod, name: str) -> Mod:
    """Return the part of a record's modification that concerns a field."""
    assert mod.value is not None
    return Mod(mod.at, mod.scope, FieldOf(mod.value.at, mod.value, name), {}, mod.each, mod.final)
