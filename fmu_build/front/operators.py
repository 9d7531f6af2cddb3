"""Operators on operator records (specification 14): which function an operator or a constructor stands for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from fmu_build.errors import ModelicaError
from fmu_build.front.classes import ClassDef, ComponentDef
from fmu_build.front.instances import ClassRef, Instance, Slot, World
from fmu_build.syntax import (
    All,
    ArrayOf,
    Binary,
    Call,
    Comprehension,
    Expression,
    Field,
    If,
    Matrix,
    Place,
    Range,
    Reference,
    Subscripted,
    Unary,
)


class Kind(NamedTuple):
    """What an expression is: the operator record of its elements (None for anything else), and its rank.

    `at` is the class in which the names of its fields are looked up, for records of any kind.
    """

    record: ClassDef | None
    rank: int = 0
    at: Instance | None = None


class Signature(NamedTuple):
    """Kinds of a function's inputs, of how many a call needs at least, and of its first result."""

    inputs: tuple[Kind, ...]
    names: tuple[str, ...]
    needed: int
    result: Kind


NUMBER = Kind(None)


def record_of(instance: Instance) -> Instance | None:
    """Return the operator record that a class is or is short for."""
    for base in instance.all_bases():
        if base.definition.kind == "operator record" and base.definition.short is None:
            return base
    return None


class Operators:
    """The operators of the operator records that a model uses.

    Parameters
    ----------
    resolver
        Makes functions and knows the components of the model.
    """

    def __init__(self, resolver: Any) -> None:
        self._resolver = resolver
        self._world: World = resolver.world
        self._records: dict[int, Instance] = {}
        self._found: dict[tuple[int, str], list[str]] = {}
        self.signatures: dict[str, Signature] = {}  # of functions, by their keys

    # ---- kinds of expressions

    def kind_of_class(self, instance: Instance, rank: int = 0) -> Kind:
        """Kind of a component of a class."""
        record = record_of(instance)
        if record is not None:
            self._records[id(record.definition)] = record
        return Kind(None if record is None else record.definition, rank, instance)

    def kind(self, e: Any, scope: Instance) -> Kind:
        """Kind of a flat expression that was written in a scope."""
        match e:
            case Reference():
                return self._of_reference(e, scope)
            case Call():
                signature = self.signatures.get(e.function)
                if signature is not None:
                    return signature.result
                return self._of_builtin(e, scope)
            case ArrayOf():
                inner = self.kind(e.items[0], scope) if e.items else NUMBER
                return inner._replace(rank=inner.rank + 1)
            case Comprehension():
                inner = self.kind(e.element, scope)
                return inner._replace(rank=inner.rank + len(e.iterators))
            case If():
                return self.kind(e.otherwise, scope)
            case Subscripted():
                base = self.kind(e.base, scope)
                return base._replace(rank=base.rank - _used(e.subscripts))
            case Field():
                return self._field(self.kind(e.base, scope), e.name)
        return Kind(None, self._rank(e, scope))

    def _rank(self, e: Any, scope: Instance) -> int:
        """Rank of an expression of numbers."""
        if isinstance(e, Range | Matrix):
            return 1 if isinstance(e, Range) else 2
        sides = {Unary: ("operand",), Binary: ("left", "right")}.get(type(e), ())
        ranks = [self.kind(getattr(e, side), scope).rank for side in sides]
        return 0 if isinstance(e, Binary) and e.operator == "*" and ranks == [1, 1] else max(ranks, default=0)

    def _of_builtin(self, e: Call, scope: Instance) -> Kind:
        first = e.arguments[0] if e.arguments else None
        if e.function in ("noEvent", "pre", "homotopy", "der", "abs", "fill", "zeros", "ones", "transpose"):
            sizes = len(e.arguments) - (e.function == "fill") if e.function in ("fill", "zeros", "ones") else 0
            inner = NUMBER if e.function in ("zeros", "ones") else self.kind(first, scope)
            return inner._replace(rank=inner.rank + sizes)
        return NUMBER

    def _of_reference(self, e: Reference, scope: Instance) -> Kind:
        resolver = self._resolver
        name = e.parts[0].name
        if len(e.parts) == 1 and name in resolver.vars:
            return Kind(None, len(resolver.vars[name].dims) - _used(e.subscripts))
        if len(e.parts) == 1 and name in resolver.instances:
            return self.kind_of_class(resolver.instances[name])
        slot = self._world.find(scope, name)
        if not isinstance(slot, Slot) or not isinstance(slot.element, ComponentDef):
            return NUMBER  # a loop variable
        kind = self._of_slot(slot)
        kind = kind._replace(rank=kind.rank - _used(e.parts[0].subscripts))
        for part in e.parts[1:]:
            kind = self._field(kind, part.name)
            kind = kind._replace(rank=kind.rank - _used(part.subscripts))
        return kind

    def _of_slot(self, slot: Slot) -> Kind:
        effective = slot.effective()
        element = effective.element
        assert isinstance(element, ComponentDef)
        ref = self._world.find_class(effective.scope, element.type)
        if ref.definition.kind.endswith("function"):
            return NUMBER
        instance = self._world.package(ref if ref.slot is None else ref.slot, element.at)
        return self.kind_of_class(instance, len(element.subscripts) + len(instance.subscripts))

    def _field(self, kind: Kind, name: str) -> Kind:
        slot = None if kind.at is None else kind.at.slot(name)
        if slot is None or not isinstance(slot.element, ComponentDef):
            return Kind(None, kind.rank)
        inner = self._of_slot(slot)
        return inner._replace(rank=inner.rank + kind.rank)

    def formal(self, slot: Slot) -> Kind:
        """Kind of an input or output of a function."""
        return self._of_slot(slot)

    # ---- choice of a function

    def functions(self, record: ClassDef, operator: str) -> list[str]:
        """Keys of the functions of an operator of a record."""
        memo = (id(record), operator)
        if memo not in self._found:
            keys = self._found[memo] = []  # grows, because a function may use those before it
            owner = self._records[id(record)]
            package = self._world.package(ClassRef(owner.definition, owner.parent), record.at)
            slot = package.slot(f"'{operator}'")
            ref = None if slot is None else self._world.class_ref(slot)
            if ref is not None and ref.definition.kind.endswith("function"):
                keys.append(self._resolver.function_key(ref, record.at))
            elif ref is not None:
                for inner in self._world.package(ref, record.at).slots.values():
                    inside = self._world.class_ref(inner)
                    if inside is not None:
                        keys.append(self._resolver.function_key(inside, record.at))
        return self._found[memo]

    def check_flow(self, path: str, instance: Instance, at: Place) -> None:
        """Refuse a flow whose operator record cannot be added up (specification 9.2)."""
        record = self.kind_of_class(instance).record
        if record is None:
            return
        signs = [len(self.signatures[key].inputs) for key in self.functions(record, "-")]
        lacks = [op for op in ("+", "0") if not self.functions(record, op)] + ["-"] * (1 not in signs)
        if lacks:
            raise ModelicaError(f"'{path}' is a flow, but '{record.name}' has no operator '{lacks[0]}'", where=at)

    def apply(
        self, operator: str, operands: Sequence[Expression], scope: Instance, at: Place
    ) -> Expression | None:
        """Return the call that an operator on records stands for; None if no operand is one.

        Raises
        ------
        ModelicaError
            No function of the operator takes such operands.
        """
        kinds = [self.kind(o, scope) for o in operands]
        records = list(dict.fromkeys(k.record for k in kinds if k.record is not None))
        if not records:
            return None
        plain = operator.removeprefix(".")
        if plain == "+" and len(operands) == 1:
            return operands[0]
        keys = [key for record in records for key in self.functions(record, plain)]
        exact = [False] if operator.startswith(".") else [True, False]
        if operator in ("*", "/", "^") and all(k.rank for k in kinds):
            exact = [True]  # a product of matrices is not one of their elements
        for strictly in exact:
            fitting = [key for key in keys if self._fits(key, kinds, strictly)]
            if fitting:
                return Call(at, _only(fitting, at), tuple(operands))
        if operator == "*" and exact == [True] and all(isinstance(o, ArrayOf) for o in operands):
            return self._product(operands[0], operands[1], scope, at)
        for key in keys if False in exact else ():  # with an operand converted by a constructor
            converted = self._converted(key, operands, kinds, at)
            if converted is not None:
                return Call(at, key, converted)
        if plain == "<>":
            equal = self.apply("==", operands, scope, at)
            return None if equal is None else Unary(at, "not", equal)
        names = " and ".join(r.name for r in records)
        raise ModelicaError(f"'{names}' has no operator '{plain}' for such operands", where=at)

    def _product(self, a: Any, b: Any, scope: Instance, at: Place) -> Expression:
        """Product of two arrays, written out: of matrices and vectors, as sums of products."""
        if self.kind(a, scope).rank == 2:
            return ArrayOf(at, tuple(self._product(row, b, scope, at) for row in a.items))
        if self.kind(b, scope).rank == 2:
            columns = zip(*(row.items for row in b.items), strict=True)
            return ArrayOf(at, tuple(self._product(a, ArrayOf(at, c), scope, at) for c in columns))
        if len(a.items) != len(b.items) or not a.items:
            raise ModelicaError(f"product of arrays of {len(a.items)} and {len(b.items)} elements", where=at)
        total: Expression | None = None
        for x, y in zip(a.items, b.items, strict=True):
            term = self.apply("*", (x, y), scope, at) or Binary(at, "*", x, y)
            total = (
                term
                if total is None
                else self.apply("+", (total, term), scope, at) or Binary(at, "+", total, term)
            )
        assert total is not None
        return total

    def construct(
        self, record: Instance, given: Sequence[Expression | None], named: Sequence[str], scope: Instance
    ) -> str | None:
        """Return the key of the constructor that fits a call, or None for the default constructor."""
        self.kind_of_class(record)
        kinds = [NUMBER if e is None else self.kind(e, scope) for e in given]
        fitting = []
        for key in self.functions(record.definition, "constructor"):
            signature = self.signatures[key]
            if not set(named) <= set(signature.names) or len(given) > len(signature.names):
                continue
            positions = [*range(len(given) - len(named)), *(signature.names.index(n) for n in named)]
            wanted = [signature.inputs[p] for p in positions]
            if set(range(signature.needed)) <= set(positions) and all(
                w.record is k.record and k.rank == w.rank for w, k in zip(wanted, kinds, strict=True)
            ):
                fitting.append(key)
        return _only(fitting, record.definition.at) if fitting else None

    def _fits(self, key: str, kinds: Sequence[Kind], strictly: bool) -> bool:
        signature = self.signatures[key]
        if not signature.needed <= len(kinds) <= len(signature.inputs):
            return False
        for kind, wanted in zip(kinds, signature.inputs, strict=False):
            if kind.record is not wanted.record:
                return False
            if (kind.rank != wanted.rank) if strictly else wanted.rank:
                return False
        return True

    def _converted(
        self, key: str, operands: Sequence[Expression], kinds: Sequence[Kind], at: Place
    ) -> tuple[Expression, ...] | None:
        signature = self.signatures[key]
        if not signature.needed <= len(kinds) <= len(signature.inputs):
            return None
        out: list[Expression] = []
        for operand, kind, wanted in zip(operands, kinds, signature.inputs, strict=False):
            if kind.record is wanted.record:
                out.append(operand)
                continue
            made = None
            if wanted.record is not None and wanted.rank == 0:
                keys = self.functions(wanted.record, "constructor")
                made = next((k for k in keys if self._fits(k, [kind], False)), None)
            if made is None:
                return None
            out.append(Call(at, made, (operand,)))
        return tuple(out)


def _only(keys: Sequence[str], at: Place) -> str:
    if len(keys) > 1:
        raise ModelicaError(f"'{keys[0]}' and '{keys[1]}' fit equally well", where=at)
    return keys[0]


def _used(subscripts: Sequence[Expression]) -> int:
    """Return the number of dimensions that subscripts remove."""
    return sum(not isinstance(s, All | Range | ArrayOf) for s in subscripts)
