"""Instances of classes: inheritance, modifications, redeclarations, lookup of names (specification 5 and 7).

An `Instance` is a class in an environment: its modifications and the instance in which it is written. A component
that is not a variable is an instance with a path; a package in which names are looked up is one without. A class
that another extends is an instance too, which shares the elements of the other (its root), so that a name in it
finds redeclared elements.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from fmu_build.builtin_functions import CLOCKS, NO_CLOCKS
from fmu_build.errors import ModelicaError
from fmu_build.front.classes import (
    Argument,
    ClassDef,
    ComponentDef,
    Constraint,
    Extends,
    Import,
    Modification,
    Short,
    Source,
)
from fmu_build.front.library import Library
from fmu_build.front.restrictions import check_base, check_class, is_package_like
from fmu_build.syntax import Expression, Literal, Node, Part, Place, Reference, Subscripted
from fmu_build.syntax import Field as FieldOf

_NOWHERE = Place("(predefined)", 1)
_INHERITED = " (inherited)"  # after the name of a class that ``redeclare model extends`` extends
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
        overrides, and `passed` are the redeclarations that it overrides.
    """

    at: Place
    scope: Instance | None = None
    value: Expression | None = None
    subs: dict[str, Mod] = field(default_factory=dict)
    each: bool = False
    final: bool = False
    redeclare: tuple[ComponentDef | ClassDef, Instance] | None = None
    below: Mod | None = None
    passed: tuple[tuple[ComponentDef | ClassDef, Instance], ...] = ()
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
        below = replace(inner, redeclare=None, below=None, passed=())
        passed = outer.passed
        if inner.redeclare is not None:
            if not inner.redeclare[0].replaceable:
                raise ModelicaError(f"'{name}' is redeclared and not replaceable any more", where=outer.at)
            passed += (inner.redeclare, *inner.passed)
        if outer.below is not None:
            below = merge(outer.below, below, name)
        return replace(outer, below=below, final=outer.final or inner.final, passed=passed)
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
        inner.passed,
    )


@dataclass(slots=True, eq=False)
class Slot:
    """An element of an instance: its declaration, the declaration's scope, and its modification.

    Attributes
    ----------
    protected
        Whether the element, or an extends clause through which it is inherited, is protected.
    bounds
        Declarations, with their scopes, whose type or constraining type the element has to fit.
    """

    name: str
    element: ComponentDef | ClassDef
    scope: Instance
    mod: Mod
    protected: bool = False
    bounds: tuple[tuple[ComponentDef | ClassDef, Instance], ...] = ()
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
        mod = merge(mod, _constraint_mod(old.constraint, slot.scope), name)
        bound = ((old, slot.scope),) if old.constraint is not None else ()
        return Slot(name, old, slot.scope, mod, slot.protected, bound)
    new, scope = mod.redeclare
    _check_redeclared(slot, new, mod)
    bounds = (mod.redeclare, *mod.passed, (old, slot.scope))
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
        merged = merge(outer, merge(redeclared, carried, name), name)
        return Slot(name, declared, scope, merged, slot.protected, bounds)
    return Slot(name, new, scope, _with_carried(outer, new, scope, carried, name), slot.protected, bounds)


def _check_redeclared(slot: Slot, new: ComponentDef | ClassDef, mod: Mod) -> None:
    old = slot.element
    if isinstance(new, ClassDef) != isinstance(old, ClassDef):
        raise ModelicaError(f"'{old.name}' is redeclared as an element of another kind", where=mod.at)
    extends = isinstance(new, ClassDef) and new.extended is not None
    if (new.redeclare or extends) and not old.replaceable:
        raise ModelicaError(f"'{old.name}' is not replaceable", where=mod.at)
    if new.redeclare and old.final:
        raise ModelicaError(f"'{old.name}' is final and cannot be redeclared", where=mod.at)
    if isinstance(old, ComponentDef) and "constant" in old.prefixes:
        raise ModelicaError(f"'{old.name}' is constant and cannot be redeclared", where=mod.at)
    in_body = mod.redeclare is not None and any(e is new for e in mod.redeclare[1].definition.elements)
    if in_body and slot.protected != new.protected:
        was, now = ("protected", "public") if slot.protected else ("public", "protected")
        raise ModelicaError(f"'{old.name}' is {was} and cannot be redeclared as {now}", where=mod.at)


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
        hidden: bool = False,
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
        self.hidden = hidden  # inherited through a protected extends clause
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
                if base.definition.replaceable and not element.of_redeclared:
                    what = f"'{element.type.name}' is replaceable and cannot be a base class"
                    raise ModelicaError(what, where=element.at)
                written = modifier(element.modification, self)
                mod = merge(self.mod, merge(body, written, definition.name), definition.name)
                self._inherit(base, mod, element.protected)
                self._check_lonely(element)
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

    def _check_lonely(self, clause: Extends) -> None:
        """Refuse an array type, or one with the prefix input or output, as one of several parts."""
        inherited = self.bases[-1]
        others = [e for e in self.definition.elements if isinstance(e, ComponentDef | Extends) and e is not clause]
        if others and (inherited.subscripts or inherited.short_prefixes):
            what = "an array" if inherited.subscripts else f"an {min(inherited.short_prefixes)}"
            raise ModelicaError(
                f"'{clause.type.name}' is {what}; a class that extends it cannot have other elements",
                where=clause.at,
            )

    def _inherit(self, base: ClassRef, mod: Mod, hidden: bool = False) -> None:
        inherited = Instance(
            self.world,
            base.definition,
            base.parent,
            merge(mod, base.mod, base.definition.name),
            path=self.path,
            owner=self.owner,
            root=self.root,
            hidden=self.hidden or hidden,
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
            if not _alike(old.element, element):
                raise ModelicaError(f"'{name}' is inherited, but declared differently here", where=element.at)
        if old is None:
            hidden = self.hidden or element.protected
            old = self.slots[name] = Slot(name, element, self, self.mod.subs.get(name, NO_MOD), hidden)
        self.visible.add(name)
        return old

    def _check_modified(self) -> None:
        for name, mod in self.mod.subs.items():
            if self.path and name in self.slots and self.slots[name].protected:
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
    def kind(self) -> str:
        """Kind of the class; of what it stands for if it is a short one of the kind "class"."""
        definition = self.definition
        return self.bases[0].kind if definition.kind == "class" and definition.short else definition.kind

    @property
    def class_name(self) -> str:
        """Qualified name of the class; for a short class without modifiers, of the class that it renames."""
        return self.definition.path or self.definition.name


def _misfit(instance: Instance, bound: Instance) -> str | None:
    """Return why a class does not fit a constraining type; None if it does."""
    if any(b.definition is bound.definition for b in instance.all_bases()):
        return None
    lacks = next((n for n, s in bound.slots.items() if not s.protected and n not in instance.slots), None)
    if lacks is not None:
        return f"it has no '{lacks}'"
    if bound.builtin != instance.builtin:
        return "the types differ"
    if len(bound.subscripts) != len(instance.subscripts):
        return "the numbers of dimensions differ"
    return None


_WITHOUT_MEANING = ("description", "annotation", "outside", "path", "loader", "folder", "_parse")


def _same(a: Any, b: Any) -> bool:
    """Whether two parts of the source say the same, wherever they are."""
    if type(a) is not type(b):
        return False
    if isinstance(a, Place | Source):
        return True
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(_same, a, b))
    if is_dataclass(a):
        names = [f.name for f in fields(a) if f.name not in _WITHOUT_MEANING]
        return all(_same(getattr(a, name), getattr(b, name)) for name in names)
    return bool(a == b)


def _alike(a: ComponentDef | ClassDef, b: ComponentDef | ClassDef) -> bool:
    """Whether two declarations are the same (an element that is inherited twice)."""
    if not isinstance(a, ComponentDef) or not isinstance(b, ComponentDef):
        return _same(a, b)
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
            single = next((c for c in definition.imports if c.alias == name), None)
            if single is not None:
                self._imports[memo] = self._import(single)
                return self._imports[memo]
            for clause in (c for c in definition.imports if c.alias == "*"):
                package = self._import(clause)
                assert not isinstance(package, Literal)
                imported = self.package(package, clause.at).slot(name)
                if imported is None or imported.protected:
                    continue
                before = self._imports[memo]
                if isinstance(before, Slot) and before.element is not imported.element:
                    what = f"two imports make '{name}' visible"
                    raise ModelicaError(what, where=clause.at, fix="import it by name")
                self._imports[memo] = imported
        return self._imports[memo]

    def _import(self, clause: Import) -> Slot | ClassRef | Literal:
        """Find what an import names; all that contains it must be packages."""
        imported: Slot | ClassRef | Literal | None = self._qualified(clause.name)
        if imported is None:
            imported = self._literal(clause.name)
        if imported is None:
            raise ModelicaError(
                f"there is no '{clause.name}' to import", where=clause.at, fix=self.absent(clause.name)
            )
        if isinstance(imported, Slot):
            if imported.protected:
                raise ModelicaError(f"'{clause.name}' is protected and cannot be imported", where=clause.at)
            ref = self.class_ref(imported)
            is_package = ref is not None and ref.definition.kind == "package"
            if not is_package and (clause.alias == "*" or imported.scope.root.definition.kind != "package"):
                what = f"'{clause.name}' is neither a package nor in one, so it cannot be imported"
                raise ModelicaError(what, where=clause.at)
        return imported

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
            raise ModelicaError(CLOCKS, where=name.at, fix=NO_CLOCKS)
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
                if target is None:
                    target = self.find(None, first)
                if target is None and first in scope.visible:
                    if not first.endswith(_INHERITED):
                        raise ModelicaError(f"the base class '{name.name}' is itself inherited", where=name.at)
                    target = scope.slots[first]
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
        package = self.package(target, at)
        slot = package.slot(name)
        if slot is not None:
            self.check_inside(package, slot, at)
        return slot

    @staticmethod
    def check_inside(package: Instance, slot: Slot, at: Place) -> None:
        """Refuse an element of a class that cannot be used by a dotted name."""
        name = package.class_name
        if slot.protected:
            raise ModelicaError(f"'{slot.name}' is protected in '{name}'", where=at)
        definition = package.definition
        if definition.partial and definition.kind == "package":
            raise ModelicaError(f"package '{name}' is partial, so '{slot.name}' in it cannot be used", where=at)
        encapsulated = isinstance(slot.element, ClassDef) and slot.element.encapsulated
        if not encapsulated and not is_package_like(definition):
            raise ModelicaError(
                f"'{name}' is not a package, and '{slot.name}' in it is not encapsulated", where=at,
                fix=f"declare '{slot.name}' outside, or make it encapsulated",
            )  # fmt: skip

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
        hidden = f"{inherited.name}{_INHERITED}"
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
            Extends(definition.at, Reference(definition.at, (Part(hidden),)), definition.extended, False, True),
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
            self.check_bounds(target.effective(), out, target.name)
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

    def check_bounds(self, slot: Slot, instance: Instance, path: str) -> None:
        """Refuse an element that does not fit the constraining types of its declarations."""
        inner = [instance]
        for element, scope in slot.bounds:
            if element.constraint is not None:
                ref = self.find_class(scope, element.constraint.type)
            elif isinstance(element, ComponentDef):
                ref = self.find_class(scope, element.type)
            elif element.extended is None:
                ref = ClassRef(element, scope)
            else:  # it extends what it has to fit
                continue
            bound = self.package(ref if ref.slot is None else ref.slot, element.at)
            for one in inner:
                misfit = _misfit(one, bound)
                if misfit is not None:
                    what = f"'{path}' is of '{one.class_name}', which does not fit '{bound.class_name}': {misfit}"
                    raise ModelicaError(what, where=slot.element.at)
            inner.append(bound)

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
