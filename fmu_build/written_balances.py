"""Balances that a model states as equations, without physical connectors: ``m*der(v) = F - d*v``.

A *balance* is the equation that determines the highest derivative of a variable with a unit of physics: a sum of
forces, torques, heat flows, currents, volume flows, or, around a coil, of voltages. A *coupling* is a difference
of the potentials of two balances that the model computes, such as the twist of a spring between two masses.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from operator import add
from typing import Literal as Choice

from fmu_build.domains import DOMAINS, MECHANICAL, Domain
from fmu_build.flat_model import ADDED, Equation, FlatModel, constant, differentiated, flat_name, number
from fmu_build.syntax import Binary, Call, Expression, If, Node, Reference, Unary, references, transform, walk
from fmu_build.unit_check import dimension, dimension_of_unit

Side = Choice["left", "right"]

# By the unit of what is differentiated: domain, unit of the potential if that is another variable, and the units
# that a balance may have. The one with the seconds is that of an equation solved for the derivative.
_DOMAINS: tuple[tuple[str, Domain, str, tuple[str, ...]], ...] = (
    *((f"{p}/s", domain, p, (*flows, f"{p}/s2")) for domain, p, flows in DOMAINS if domain in MECHANICAL),
    *((p, domain, "", flows if domain in MECHANICAL else (*flows, f"{p}/s")) for domain, p, flows in DOMAINS),
    ("A", "electrical", "", ("V", "A/s")),
)
_SAME_VALUE = {"noEvent", "smooth"}  # of their last argument


@dataclass(frozen=True)
class Share:
    """Contribution of a flow to an equation.

    Attributes
    ----------
    equation, side
        Number of the equation, and the side from which a flow out is subtracted.
    added
        Whether it is added to that side instead, because the derivative has a negative factor.
    factor
        Of the flow; None is 1.
    """

    equation: int
    side: Side
    added: bool = False
    factor: Expression | None = None

    @property
    def opposite(self) -> Share:
        """The same for a flow in."""
        return replace(self, added=not self.added)

    def times(self, factor: Expression | None) -> Share:
        """Return the same for a flow with a factor."""
        both = [f for f in (self.factor, factor) if f is not None]
        return replace(self, factor=Binary(ADDED, "*", *both) if len(both) == 2 else next(iter(both), None))


@dataclass(frozen=True)
class Balance:
    """An equation that determines a derivative.

    Attributes
    ----------
    name
        The variable that is differentiated.
    component
        The component that has the equation.
    potential, rate
        Variables; of a speed whose integral the model lacks, there is no potential. A rate of None is the
        derivative of the potential.
    units
        Units of the potential and of the balance; the latter is empty if it cannot be inferred.
    loop
        Whether the balance is one of voltages, around a coil whose current is the potential.
    terms
        The equation's summands.
    """

    name: str
    component: str
    domain: Domain
    potential: str | None
    rate: str | None
    units: tuple[str, str]
    share: Share
    loop: bool
    terms: tuple[Expression, ...]


@dataclass(frozen=True)
class Difference:
    """A difference as the model has it: of potentials or their rates; ``negative`` if the other way round."""

    node: Expression
    rates: bool
    negative: bool


@dataclass(frozen=True)
class Coupling:
    """A difference of two potentials, of which that of the first balance is subtracted.

    Attributes
    ----------
    domain, units
        Domain of the difference; its unit and the unit of the flow that it drives.
    factors
        Of the two potentials; None is 1.
    differences
        Where the model has it.
    """

    name: str
    domain: Domain
    units: tuple[str, str]
    first: Balance
    second: Balance
    factors: tuple[Expression | None, Expression | None]
    differences: tuple[Difference, ...]


@dataclass(frozen=True)
class _End:
    """An end of a coupling: a balance, and the factor of its potential."""

    balance: Balance
    factor: Expression | None


class WrittenBalances:
    """Finds balances and couplings.

    Parameters
    ----------
    find
        Gives the class of a variable: all that are equal have the same one.
    derived
        A variable that is the derivative of a class; an empty string if only ``der`` is.
    covered
        Classes that physical connectors already give ports to.
    """

    def __init__(
        self,
        flat: FlatModel,
        find: Callable[[str], str],
        derived: Mapping[str, str],
        covered: Collection[str],
    ) -> None:
        self._flat = flat
        self._find = find
        self._derived = derived
        self._covered = covered
        self._speeds = {find(speed): level for level, speed in derived.items() if speed}
        self._explicit = self._definitions()
        self._equations = self._with_derivatives()

    def balances(self) -> tuple[Balance, ...]:
        """Return the balances in the order of the declarations of what they differentiate."""
        taken: set[int] = set()
        balances = []
        for name in self._differentiated():
            for i, equation in self._candidates(name):
                if i not in taken and (balance := self._balance(name, i, equation)) is not None:
                    taken.add(i)
                    balances.append(balance)
                    break
        return tuple(balances)

    def couplings(
        self, balances: Sequence[Balance], equations: Sequence[Equation] | None = None
    ) -> tuple[Coupling, ...]:
        """Return the differences of potentials, or of their rates, of two balances, in some equations or in all.

        Both are of one domain, or of motion, such as that of a rack and its pinion: ``r*phi - s``.
        """
        both = (("potential", False), ("rate", True))
        of = {
            self._find(name): (b, rates)
            for b in balances
            for what, rates in both
            if not b.loop and (name := getattr(b, what)) is not None
        }
        together: dict[tuple[_End, _End], list[Difference]] = {}
        for node in self._written() if equations is None else walk(tuple((e.left, e.right) for e in equations)):
            if not (isinstance(node, Binary) and node.operator == "-"):
                continue
            plus, minus = (self._end(side, of) for side in (node.left, node.right))
            if plus is None or minus is None:
                continue
            (second, rates), (first, same) = plus, minus
            if rates == same and first.balance != second.balance and self._common(first, second) is not None:
                negative = (second, first) in together
                key = (second, first) if negative else (first, second)
                together.setdefault(key, []).append(Difference(node, rates, negative))
        couplings: dict[str, Coupling] = {}
        for (first, second), differences in together.items():
            name, kind = f"{first.balance.name}.{second.balance.name}", self._common(first, second)
            if kind is not None and name not in couplings:
                factors = (first.factor, second.factor)
                couplings[name] = Coupling(name, *kind, first.balance, second.balance, factors, tuple(differences))
        return tuple(couplings.values())

    def _common(self, first: _End, second: _End) -> tuple[Domain, tuple[str, str]] | None:
        """Return domain and units of the difference of two potentials; None if they are of different kinds."""
        kinds = {(end.balance.domain, end.balance.units) for end in (first, second)}
        same = next(iter(kinds)) if len(kinds) == 1 else None
        sizes = [self._size(end) for end in (first, second)]
        if first.factor is second.factor is None or sizes[0] != sizes[1] or sizes[0] is None:
            return same
        flows = {_exponents(flow) for domain, _, flows in DOMAINS if domain in MECHANICAL for flow in flows}
        if all(domain in MECHANICAL and _exponents(units[1]) in flows for domain, units in kinds):
            for domain, potential, (flow, *_) in DOMAINS:
                if domain in MECHANICAL and sizes[0] == _exponents(potential):
                    return domain, (potential, flow)
        return same

    def _size(self, end: _End) -> tuple[Fraction, ...] | None:
        """Return the exponents of the unit of a potential with its factor; None if they are unknown."""
        plain = _exponents(end.balance.units[0])
        if plain is None or end.factor is None:
            return plain
        factor = dimension(self._flat, end.factor)
        return None if factor is None else tuple(map(add, plain, factor.exponents))

    def held(self, balance: Balance, couplings: Sequence[Coupling]) -> bool:
        """Return whether a spring to the ground seems to act: the balance has the position itself in a term."""
        between = [difference.node for coupling in couplings for difference in coupling.differences]
        potential = self._find(balance.potential) if balance.potential is not None else ""
        waiting, seen = [*balance.terms], set[str]()
        while potential and waiting:
            for name in map(self._find, factors_of(waiting.pop())):
                if name == potential:
                    return True
                if name not in seen:
                    seen.add(name)
                    e = self._explicit.get(name)
                    waiting += [] if e is None or e in between else summands(e)
        return False

    def _written(self) -> Iterator[Node]:
        """Yield the nodes of all that is written, and of what an earlier diagnosis added."""
        added = (e for e in self._flat.equations if e.origin.kind == "added")
        for e in (*(e for _, e in self._own()), *added):
            yield from walk((e.left, e.right))
        for _, binding in self._flat.bindings():
            yield from walk((binding,))

    def _end(self, side: Expression, of: Mapping[str, tuple[Balance, bool]]) -> tuple[_End, bool] | None:
        """Return the balance whose potential a side is, with its factor, and whether it is the rate instead."""
        match side:
            case Binary(operator="*", left=one, right=other) if self._given(one):
                factor: Expression | None = one
            case Binary(operator="*", left=other, right=one) if self._given(one):
                factor = one
            case Binary(operator="/", left=other, right=one) if self._given(one):
                factor = Binary(ADDED, "/", number(1.0), one)
            case other:
                factor = None
        name = flat_name(other) if isinstance(other, Reference) else differentiated(other)
        known = None if name is None else of.get(self._find(name))
        if known is None:
            return None
        balance, rates = known
        if not isinstance(other, Reference):  # a derivative
            if rates:
                return None
            rates = True
        anywhere = None if factor is None else transform(factor, lambda node: replace(node, at=ADDED))
        return _End(balance, anywhere), rates

    def _given(self, e: Expression) -> bool:
        names = [flat_name(r) for r in references((e,))]
        declared = [self._flat.variables.get(n) for n in names]
        return all(v is not None and v.variability in ("constant", "parameter") for v in declared)

    def _own(self) -> Iterator[tuple[int, Equation]]:
        """Yield the equations that are written in a class that is no block, with their numbers."""
        kinds = {c.path: c.kind for c in self._flat.components.values()}
        for i, e in enumerate(self._flat.equations):
            if e.origin.kind in ("class", "binding") and kinds.get(e.origin.component) != "block":
                yield i, e

    def _definitions(self) -> dict[str, Expression]:
        """Return the explicit equals of a variable, by class."""
        definitions: dict[str, Expression] = {}
        for _, e in self._own():
            for one, other in ((e.left, e.right), (e.right, e.left)):
                if isinstance(one, Reference) and not isinstance(other, Reference):
                    definitions.setdefault(self._find(flat_name(one)), other)
        for name, binding in self._flat.bindings():
            definitions.setdefault(self._find(name), binding)
        return definitions

    def _differentiated(self) -> list[str]:
        """Return the variables whose derivative is differentiated no further, in the order of declarations."""
        of: dict[str, str] = {}
        written = {name for name in map(differentiated, self._written()) if name is not None}
        for v in self._flat.variables.values():
            if v.name in written and not v.shape:
                of.setdefault(self._find(v.name), v.name)
        lower = {c for c, d in self._derived.items() if d and self._find(d) in self._derived}
        return [n for c, n in of.items() if c not in lower and c not in self._covered]

    def _candidates(self, name: str) -> list[tuple[int, Equation]]:
        """Return equations that may be the balance of a variable; those that only define another one come last."""
        candidates = []
        for i, e in self._equations.get(self._find(name), ()):
            sides = (e.left, e.right)
            plain = [isinstance(side, Reference) or differentiated(side) is not None for side in sides]
            flows = (self._flat.variables.get(flat_name(r)) for r in references(sides))
            if all(plain) or any(v is not None and v.flow for v in flows):
                continue
            defines = any(isinstance(s, Reference) and not self._is_derivative(s, name) for s in sides)
            candidates.append((defines, i, e))
        return [(i, e) for _, i, e in sorted(candidates, key=lambda one: one[:2])]

    def _with_derivatives(self) -> dict[str, list[tuple[int, Equation]]]:
        """Return the equations that contain a derivative, by the class of what is differentiated."""
        equations: dict[str, list[tuple[int, Equation]]] = {}
        for i, e in self._own():
            inside = map(self._differentiated_by, walk((e.left, e.right)))
            for component in dict.fromkeys(c for c in inside if c is not None):
                equations.setdefault(component, []).append((i, e))
        return equations

    def _differentiated_by(self, node: object) -> str | None:
        """Return the class that a call of ``der``, or a variable that equals one, differentiates."""
        if (inner := differentiated(node)) is not None:
            return self._find(inner)
        return self._speeds.get(self._find(flat_name(node))) if isinstance(node, Reference) else None

    def _is_derivative(self, node: object, name: str) -> bool:
        return self._differentiated_by(node) == self._find(name)

    def _balance(self, name: str, i: int, e: Equation) -> Balance | None:
        left = self._sign(e.left, name)
        sign = left or self._sign(e.right, name)
        side, other = (e.left, e.right) if left else (e.right, e.left)
        # If the equation is solved for the derivative, the balance is the sum that is divided by an inertia.
        divided = _divided(other) if self._is_derivative(side, name) else None
        ways = [divided, (None, (side, other))] if divided is not None else [(None, (side, other))]
        readings = ((way, physics) for way in ways if (physics := self._physics(name, way[1])) is not None)
        (factor, sums), physics = next(readings, ((None, ()), None))
        if not sign or physics is None:
            return None
        domain, potential, rate, units = physics
        share = Share(i, "right" if left else "left", added=sign < 0, factor=factor)
        terms = tuple(term for one in sums for term in summands(one))
        loop = domain == "electrical" and units[0] == "A"
        return Balance(name, e.origin.component, domain, potential, rate, units, share, loop, terms)

    def _sign(self, e: Expression, name: str) -> int:
        """Return the sign of the factor of the derivative in an expression; 0 if there is none."""
        if self._is_derivative(e, name):
            return 1
        match e:
            case Unary():
                return -self._sign(e.operand, name) if e.operator == "-" else self._sign(e.operand, name)
            case Binary(operator="+" | "-"):
                second = self._sign(e.right, name)
                return self._sign(e.left, name) or (-second if e.operator == "-" else second)
            case Binary(operator="*"):
                pairs = ((e.left, e.right), (e.right, e.left))
                return next((s * self._sign_of(other) for one, other in pairs if (s := self._sign(one, name))), 0)
            case Binary(operator="/"):
                return self._sign(e.left, name) * self._sign_of(e.right)
            case If():
                parts = (*(branch for _, branch in e.branches), e.otherwise)
                return next((s for part in parts if (s := self._sign(part, name))), 0)
            case Call(arguments=(*_, value)) if e.function in _SAME_VALUE and value is not None:
                return self._sign(value, name)
        return 0

    def _sign_of(self, e: Expression) -> int:
        """Return the sign of a factor: of a number or a parameter; anything else counts as positive."""
        match e:
            case Unary(operator="-"):
                return -self._sign_of(e.operand)
            case Binary(operator="*" | "/"):
                return self._sign_of(e.left) * self._sign_of(e.right)
            case Reference():
                declared = self._flat.variables.get(flat_name(e))
                value = None if declared is None else constant(declared.binding)
            case _:
                value = constant(e)
        return -1 if value is not None and value < 0.0 else 1

    def _physics(
        self, name: str, sums: Sequence[Expression]
    ) -> tuple[Domain, str | None, str | None, tuple[str, str]] | None:
        """Return domain, potential, rate and units of a balance; None if its units are of no domain.

        Without units, what is differentiated twice counts as a position.
        """
        stated = self._flat.variables[name].unit
        if stated is None:
            integral = self._integral(name)
            return None if integral is None else ("translational", integral, name, ("1", "1"))
        flow = next((size for e in sums if (size := dimension(self._flat, e)) is not None), None)
        for unit, domain, potential, flows in _DOMAINS:
            fitting = [f for f in flows if flow is None or flow.exponents == _exponents(f)]
            if not fitting or _exponents(stated) != _exponents(unit):
                continue
            if "rad" in unit and "rad" not in stated and "N.m" not in fitting:  # a frequency
                continue
            if fitting == ["m/s"] and not self._has_area(sums):  # kinematics
                continue
            if flow is None and unit in ("m", "rad"):  # of a level, of a position, or kinematics
                continue
            units = (potential or stated, "" if flow is None else fitting[0])
            if potential:
                return domain, self._integral(name), name, units
            return domain, name, self._derived.get(self._find(name)) or None, units
        return None

    def _has_area(self, sums: Sequence[Expression]) -> bool:
        """Return whether a balance depends on an area or a flow of volume, as that of a level does."""
        near, waiting = set[str](), [*sums]
        while waiting:
            for name_of in map(self._find, map(flat_name, references((waiting.pop(),)))):
                if name_of not in near:
                    near.add(name_of)
                    waiting += [self._explicit[name_of]] if name_of in self._explicit else []
        units = {v.unit for v in self._flat.variables.values() if v.unit and self._find(v.name) in near}
        return not {_exponents(unit) for unit in units}.isdisjoint({_exponents("m2"), _exponents("m3/s")})

    def _integral(self, name: str) -> str | None:
        """Return the variable whose derivative a speed is."""
        state = self._speeds.get(self._find(name))
        return next((v.name for v in self._flat.variables.values() if self._find(v.name) == state), None)


def _divided(e: Expression) -> tuple[Expression | None, tuple[Expression, ...]] | None:
    """Return the factor of a sum that is divided by an inertia or a capacity, and the sum; None for others."""
    match e:
        case Binary(operator="/"):
            return Binary(ADDED, "/", number(1.0), e.right), (e.left,)
        case Binary(operator="*", right=Binary(operator="+" | "-")):
            return e.left, (e.right,)
        case Binary(operator="*", left=Binary(operator="+" | "-")):
            return e.right, (e.left,)
    return None


def summands(e: Expression) -> list[Expression]:
    """Return the terms of a sum."""
    if isinstance(e, Binary) and e.operator in ("+", "-"):
        return [*summands(e.left), *summands(e.right)]
    return summands(e.operand) if isinstance(e, Unary) else [e]


def _exponents(unit: str) -> tuple[Fraction, ...] | None:
    dimension = dimension_of_unit(unit)
    return None if dimension is None else dimension.exponents


def factors_of(e: Expression) -> Iterator[str]:
    """Yield the factors of a product that are names, but not those in its differences and functions."""
    match e:
        case Reference():
            yield flat_name(e)
        case Binary(operator="*" | "/" | "^"):
            yield from factors_of(e.left)
            yield from factors_of(e.right)
        case Unary():
            yield from factors_of(e.operand)
