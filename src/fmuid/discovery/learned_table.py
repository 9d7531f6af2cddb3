"""Learned tables: a smooth table at a place, for what no law explains or where a law has another shape.

A table is piecewise linear, with few knots at quantiles of what the runs reached. Its variable, or two of them,
and the number of knots are those that predict left-out experiments. A table over one variable is monotone if a
monotone one predicts them as well. Where its place and variable are those of a law in the model, it refines the
shape of that law.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import TypeVar

import numpy as np
from scipy.optimize import isotonic_regression

from fmu_build.errors import UserError
from fmu_build.flat_model import FlatModel
from fmu_build.model_ports import parameter_port
from fmuid.core.campaign import ModelSpec
from fmuid.core.errors import ProblemError
from fmuid.core.formulas import parse_modelica
from fmuid.core.immutable import FloatArray
from fmuid.core.progress import Say, quiet
from fmuid.diagnosis import decide
from fmuid.diagnosis.candidates import Fitted, errors_of_the_cost, estimates, fit_effects, leaving_out, without
from fmuid.diagnosis.cross_validation import HeldOut, Null, advantage, closure, closure_interval
from fmuid.diagnosis.diagnose import Closing, Found, where_it_enters
from fmuid.diagnosis.free_functions import Response, fit_decoys, hats, moved_by, quantile_knots
from fmuid.diagnosis.scores import nominal_basis, stack
from fmuid.diagnosis.subject import Subject, tightened
from fmuid.diagnosis.varying import source_of
from fmuid.diagnosis.verdict import Best, Estimate, Refinement
from fmuid.discovery.find_law import noise_draws, pruned
from fmuid.discovery.injected import Law, entry, free_name, with_laws
from fmuid.discovery.places import Spot, inside_of, spot
from fmuid.discovery.selection import DRIVEN, Chosen
from fmuid.discovery.terms import Quantity, Term, ramps, table
from fmuid.effects.effect import Effect, Unknown
from fmuid.effects.quantities import quantity_words
from fmuid.identification.problem.cases import LOGGED
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Simulator

_KNOTS = (3, 5, 9)  # of a table over one variable; each set halves the distances of the one before
_FINER = (*_KNOTS, 17)  # the same along the trajectories of a model that has a table
_EVEN = 0.25  # least distance of knots, as a share of that of even ones: steeper tables make a model stiff
_KNOTS_OF_TWO = ((3, 3), (5, 3), (3, 5), (5, 5))  # of a table over two: no more values than a fine one over one
_PLACES = 2  # places examined: those where a course over time is likeliest
_PAIRED = 3  # variables at a place from which pairs are made: those that predict best alone
_BUILT = 2  # variables whose tables are built into the model: those that predict best as driven inputs
_GAIN = 0.1  # share of what is left that the best table has to close before other sizes of it are tried
_LOOSE = 3.0  # standard errors: data that determine a parameter then move it by nine-tenths of what they would
_STEPS = 1  # of refits without an experiment, after the linear one: tables are linear in their values
_COARSE = 0.01  # share of the cost that an iteration of a refit has to gain
_INTERVAL = 1.645  # standard errors: 90 %


@dataclass(frozen=True, slots=True, eq=False)
class Tabulated:
    """A table in the model.

    Attributes
    ----------
    effect
        The table as an effect.
    subject, fitted
        The model that contains it, and its refit.
    best
        The model as the best explanation, with the table as a refinement.
    among
        Number of tables from which it was chosen.
    """

    effect: Effect
    subject: Subject
    fitted: Fitted
    best: Best
    among: int = 1


def tabulate(
    outcome: Found,
    models: Mapping[str, ModelSpec],
    load: Callable[[ModelSpec], Simulator],
    *,
    say: Say = quiet,
    seed: int = 0,
) -> Tabulated | None:
    """Look for a table where the verdict leaves a gap; None if none predicts left-out experiments better.

    A table over the own variable of a law of the best explanation, at its own port, may refine that law, and then
    make another effect needless. Unless its effects are all that is missing, a table may also take their place, or
    be in addition to them.

    Parameters
    ----------
    models
        Models by setup; those with Modelica source, and FMUs for model exchange, can contain a table.
    load
        Loads a model.
    say
        Called with progress.
    seed
        Seed of the null distribution.
    """
    verdict, subject, before = outcome.diagnosis.verdict, outcome.subject, outcome.diagnosis.best
    least = 0.0 if before is None else before.closure.validated
    named = () if outcome.best is None else (outcome.best,)
    finished = verdict.kind == "complete" or (bool(outcome.surviving) and verdict.rest is None)
    if not outcome.diagnosis.gap.present or len(set(subject.observed.groups)) < 2:
        return None
    inside = _inside(subject, models)
    if inside is None:
        return None
    needless = [*_fewer(outcome)]
    if finished and not needless:
        return None
    null = noise_draws(subject, outcome.nominal, seed).null(
        nominal_basis(outcome.nominal.fit, subject.observed), ()
    )

    def search(base: Fitted) -> _Search:
        return _Search(outcome, base, models, load, inside, null)

    tried = partial(_tried, say)
    shaped = [tried(partial(search(base).refined, outcome.best)) for base in needless]
    if any(shaped) or finished:
        return min(filter(None, shaped), key=lambda t: t.fitted.held_out.mean, default=None)
    open_ = verdict.kind != "effect" or verdict.provisional
    beside = [search(base) for base in named]
    searches = [*(s.refined for s in beside), *([search(outcome.nominal).learned] if open_ else [])]
    searches += [s.learned for s in beside] if open_ else []
    tables: list[Tabulated] = []
    for built in map(tried, searches):
        if built is None or built.best.closure.validated <= least:
            continue
        if all(_better(b, built.fitted) for b in named):
            tables.append(built)
            if _settles(built, outcome):
                break
    return min(tables, key=lambda t: t.fitted.held_out.mean, default=None)


def _tried(say: Say, build: Callable[[], Tabulated | None]) -> Tabulated | None:
    """Return a table; None if a model with it cannot be built or simulated."""
    say("looking for a table", 0.962)
    try:
        return build()
    except UserError:
        return None


def _settles(built: Tabulated, outcome: Found) -> bool:
    """Return whether a table, learned or for a law of the verdict, closes the gap beyond doubt."""
    closed = closure(outcome.nominal.held_out, built.fitted.held_out)
    (refinement,) = built.best.refinements
    of_answer = refinement.learned or refinement.effect in outcome.diagnosis.verdict.effects
    return of_answer and closed >= decide.CLOSURE_BEYOND_DOUBT


def _inside(subject: Subject, models: Mapping[str, ModelSpec]) -> FlatModel | Fmu | None:
    """Return the first model's source, or its FMU for model exchange; None unless all models have one of them."""
    setups = dict.fromkeys(case.setup for case in subject.model.cases)
    insides = [inside_of(models[s]) if s in models else None for s in setups]
    return None if None in insides else insides[0]


def _fewer(outcome: Found) -> Iterator[Fitted]:
    """Yield the best explanation without an effect that another one's shape may make needless.

    All others have to be certain. Two laws at one port may be one function, and remain.
    """
    subject, best, verdict = outcome.subject, outcome.best, outcome.diagnosis.verdict
    if best is None or best not in outcome.surviving or len(best.effects) < 2:
        return
    for name in best.effects:
        others = {n for n in best.effects if n != name}
        if others <= {*verdict.effects} and subject.by_id[name].port not in {
            subject.by_id[n].port for n in others
        }:
            searched = (c for c in outcome.candidates if {*c.effects} == others)
            fewer = min(searched, key=lambda c: c.fit.cost, default=None) or without(subject, best, name)
            if fewer is not None:
                yield fewer


@dataclass(frozen=True, slots=True, eq=False)
class _Built:
    """A table in the model, refitted."""

    law: Law
    over: tuple[Quantity, ...]
    knots: tuple[FloatArray, ...]
    effect: Effect
    subject: Subject
    fitted: Fitted
    trend: int

    @property
    def held_out(self) -> HeldOut:
        return self.fitted.held_out

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.law.terms


@dataclass(frozen=True, slots=True, eq=False)
class _Proposed(Chosen):
    """A table that has been judged as a driven input.

    `trend` is 1 or -1 if it may only rise or only fall: its sizes are then the first value and the increments.
    """

    over: tuple[Quantity, ...]
    knots: tuple[FloatArray, ...]
    trend: int = 0


_Table = TypeVar("_Table", _Built, _Proposed)


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    outcome: Found
    base: Fitted
    models: Mapping[str, ModelSpec]
    load: Callable[[ModelSpec], Simulator]
    inside: FlatModel | Fmu
    null: Null

    def refined(self, rival: Fitted | None = None) -> Tabulated | None:
        """Return the model with a table over the own variable of one of its laws, if that law's shape is wrong.

        With a `rival`, which has another effect, that would then have to be no longer worth adding.
        """
        by_id = self.outcome.subject.by_id
        tried = []
        for effect in (by_id[id] for id in self.base.effects):
            best = self._built_over_own(effect) if effect.expression else None
            if best is not None and self._mends(best.fitted, rival):
                tried.append((best, effect.id))
        best, of = min(tried, key=lambda pair: pair[0].fitted.held_out.mean, default=(None, ""))
        return None if best is None else self._told(best, of)

    def _mends(self, fitted: Fitted, rival: Fitted | None) -> bool:
        if rival is None:
            return _better(self.base, fitted)
        return fitted.held_out.mean < self.base.held_out.mean and not decide.worth_adding(fitted, rival)

    def _built_over_own(self, effect: Effect) -> _Built | None:
        """Build tables over the own variable of a law, at its port, and return the best one."""
        if effect.acts == "parameter" and not effect.states:
            return self._near_plain(effect)._best(self._of_coefficient(effect))
        place = self._spot(effect.port) if effect.acts == "flow" else None
        if place is None:
            return None
        variables = [q for q in place.quantities if q.name in _names(effect)]
        return self._near_plain(effect)._built(self._over_one(place, variables))

    def _near_plain(self, effect: Effect) -> _Search:
        """Return the search with prior knowledge of all parameters from the model without a table.

        A table imitates its law at any size, so the law keeps the size that it has without one, within its error.
        Other parameters, such as viscous friction, are known loosely: they move with what the data say. Errors are
        those that the cost of a refit knows of. A wrong shape makes larger ones, which would bind nothing.
        """
        subject, fit = self.outcome.subject, self.base.fit
        errors = errors_of_the_cost(fit, subject.observed)

        def known(u: Unknown) -> Unknown:
            error = errors.get(u.name, np.inf) * (1.0 if u.name in effect.neutral else _LOOSE)
            return u if np.isinf(error) or np.isfinite(u.sd) else replace(u, start=fit.values[u.name], sd=error)

        effects = {id: replace(e, unknowns=tuple(map(known, e.unknowns))) for id, e in subject.by_id.items()}
        catalogue = replace(subject.catalogue, effects={**subject.catalogue.effects, **effects})
        nominal, every = tuple(map(known, subject.nominal)), tuple(effects[e.id] for e in subject.effects)
        subject = replace(subject, nominal=nominal, catalogue=catalogue, effects=every)
        return replace(self, outcome=replace(self.outcome, subject=subject))

    def _plain(self) -> dict[str, Estimate]:
        """Return the estimates of the model without a table."""
        return estimates(self.base, self.outcome.subject, self.outcome.nominal, self.outcome.scores)

    def _of_coefficient(self, effect: Effect) -> list[_Proposed]:
        """Return tables of relative changes of a coefficient over what it depends on, with more and more knots."""
        subject = self.outcome.subject
        source, unit, courses = source_of(subject, effect, {**subject.model.fixed, **self.base.fit.values})
        every = np.concatenate(courses)
        low, high = float(every.min()), float(every.max())
        x = Quantity(source, source, unit, max(abs(low), abs(high)), low, high)
        port = parameter_port(effect.port, unit, "1")
        time = tuple(case.time for case in subject.model.cases)
        place = Spot(port, 1.0, tuple({source: course} for course in courses), time, (), (x,))
        fine = _knots(place, x, _KNOTS[-1])
        every_size = (fine[list(knots)] for knots in dict.fromkeys(_some(fine, n) for n in _KNOTS))
        return [
            _Proposed(place, _terms((x,), (at,)), (0.0,) * len(at), self.base.held_out, 0.0, (x,), (at,))
            for at in every_size
        ]

    def learned(self) -> Tabulated | None:
        """Return the model with a table where the rest enters."""
        entered = self.outcome.entered if not self.base.effects else {}
        entered = entered or where_it_enters(self.outcome.subject, self.base)
        proposed: list[_Proposed] = []
        likely = (self._spot(name) for name in sorted(entered, key=lambda name: -entered[name].evidence))
        for place in islice((one for one in likely if one is not None), _PLACES):
            ones = list(self._over_one(place, place.quantities))
            best = dict.fromkeys(p.over[0] for p in sorted(ones, key=lambda p: p.held_out.mean))
            proposed += [*ones, *self._over_two(place, [*best][:_PAIRED])]
        built = self._built(proposed)
        table = None if built is None else self._told(built)
        return None if table is None else replace(table, among=len(proposed))

    def _spot(self, name: str) -> Spot | None:
        """Return a place with all that a table there may be over; None if it has no input."""
        port = self.outcome.subject.catalogue.ports.get(name)
        if port is None or not port.added or port.input is None:
            return None
        return self._along(name, self.outcome.subject, self.base.fit.values)

    def _along(self, name: str, subject: Subject, values: Mapping[str, float]) -> Spot | None:
        """Return a place with all quantities along the trajectories of a model."""
        return spot(name, self.inside, subject.model, values)

    def _over_one(self, place: Spot, over: Sequence[Quantity]) -> Iterator[_Proposed]:
        """Yield tables over one variable, with more and more knots."""
        for x in over:
            fine = _knots(place, x, _KNOTS[-1])
            columns = self._moved(place, hats(_courses(place, x), fine))
            for knots in dict.fromkeys(_some(fine, n) for n in _KNOTS):
                at = fine[list(knots)]
                yield from self._judged(place, (x,), (at,), columns, np.array(hats([fine], at))[:, 0].T)

    def _over_two(self, place: Spot, over: Sequence[Quantity]) -> Iterator[_Proposed]:
        """Yield tables over two variables."""
        for k, x in enumerate(over):
            for y in over[k + 1 :]:
                fine = [_knots(place, q, max(map(max, _KNOTS_OF_TWO))) for q in (x, y)]
                one, two = (hats(_courses(place, q), at) for q, at in zip((x, y), fine, strict=True))
                both = tuple(tuple(a * b for a, b in zip(f, g, strict=True)) for f in one for g in two)
                columns = self._moved(place, both)
                for counts in _KNOTS_OF_TWO:
                    at = tuple(f[list(_some(f, n))] for f, n in zip(fine, counts, strict=True))
                    weights = [np.array(hats([f], a))[:, 0].T for f, a in zip(fine, at, strict=True)]
                    yield from self._judged(place, (x, y), at, columns, np.kron(*weights))

    def _moved(self, place: Spot, basis: Sequence[tuple[FloatArray, ...]]) -> tuple[FloatArray, ...] | None:
        """Return by how much functions at a place move the residuals, (M_e, B) per experiment."""
        subject = self.outcome.subject
        port = replace(subject.catalogue.ports[place.port.name], magnitude=DRIVEN * place.flow)
        moved = [m for m in moved_by(subject.model, subject.observed, self.base.fit, port, tuple(basis)) if m]
        if len(moved) < len(basis):
            return None
        return tuple(np.stack(parts, axis=1) for parts in zip(*moved, strict=True))

    def _judged(
        self,
        place: Spot,
        over: tuple[Quantity, ...],
        knots: tuple[FloatArray, ...],
        columns: tuple[FloatArray, ...] | None,
        weights: FloatArray,
    ) -> Iterator[_Proposed]:
        """Yield a table, (B, K) `weights` of whose functions make it of those that move the residuals."""
        if columns is None:
            return
        response = Response("", tuple(c @ weights for c in columns))
        (decoy,) = fit_decoys([response], self.base.fit, self.outcome.subject.observed)
        sizes = tuple(DRIVEN * place.flow * a for a in decoy.amounts)
        yield _Proposed(place, _terms(over, knots), sizes, decoy.held_out, 0.0, over, knots)

    def _built(self, proposed: Iterable[_Proposed]) -> _Built | None:
        """Build the most promising tables into the model, one size of each, and return the best one."""
        sizes: dict[tuple[str, ...], list[_Proposed]] = {}
        for p in proposed:
            sizes.setdefault((p.spot.port.name, *(q.name for q in p.over)), []).append(p)
        best = sorted(map(_simplest, sizes.values()), key=lambda p: p.held_out.mean)[:_BUILT]
        better = [p for p in best if advantage(p.held_out, self.base.held_out)[0] > 0.0]
        return self._best(better)

    def _best(self, proposed: Sequence[_Proposed]) -> _Built | None:
        """Build tables into the model and return the best one; None if it closes next to nothing.

        A table over one variable is refitted in all sizes, and the size that predicts best remains. Linear steps
        compare tables, which are linear in their values. The best table is refitted without each experiment.
        """
        built = self._fitted(proposed, self.base.fit.values)
        if not built or closure(self.base, (first := _simplest(built)).fitted) < _GAIN:
            return None
        last = _simplest([first, *self._fitted(self._resized(first), first.fitted.fit.values)])
        acting = [last.subject.by_id[id] for id in last.fitted.effects]
        return replace(last, fitted=leaving_out(last.subject, acting, last.fitted.fit, chords=_STEPS))

    def _resized(self, before: _Built) -> list[_Proposed]:
        """Return tables of all sizes over the same variable, along the trajectories of the model that has one.

        Each size comes with any values and with monotone ones, in the direction that changes the table less.
        """
        if len(before.over) > 1:
            return []
        (x,), values, held_out = before.over, before.fitted.fit.values, before.held_out
        at_knots = np.array([values[n] for n in before.law.sizes])
        trend, monotone = self._monotone(before, at_knots)
        place = self._along(before.law.spot.port.name, before.subject, values) or before.law.spot
        fine = _knots(place, x, _FINER[-1])
        proposals = []
        for knots in dict.fromkeys(_some(fine, n) for n in _FINER):
            at = fine[list(knots)]
            sizes = np.interp(at, before.knots[0], at_knots)
            steps = np.diff(np.interp(at, before.knots[0], monotone), prepend=0.0)
            for terms, of_terms, way in ((table(x, at), sizes, 0), (ramps(x, at), steps, trend)):
                start = tuple(map(float, of_terms))
                proposals.append(_Proposed(place, tuple(terms), start, held_out, 0.0, (x,), (at,), way))
        return proposals

    def _monotone(self, built: _Built, values: FloatArray) -> tuple[int, FloatArray]:
        """Return the direction of the monotone table that is nearest to a table, and its values at the same knots.

        Values count as much as the measurements determine them.
        """
        names = [u.name for u in built.fitted.fit.unknowns]
        columns = stack(built.fitted.fit.jacobian, self.outcome.subject.observed)
        seen = np.sum(columns[:, [names.index(n) for n in built.law.sizes]] ** 2, axis=0)
        seen = np.maximum(seen, 1e-12 * seen.max())
        ways = {way: isotonic_regression(values, weights=seen, increasing=way > 0).x for way in (1, -1)}
        return min(ways.items(), key=lambda item: float(seen @ (item[1] - values) ** 2))

    def _fitted(self, proposed: Sequence[_Proposed], begin: Mapping[str, float]) -> list[_Built]:
        """Put tables into the model, each while the others are off, and refit each with all parameters.

        These begin at the values `begin`, which may be those of the model with another table in their place.
        """
        if not proposed:
            return []
        subject = self.outcome.subject
        beside = [subject.by_id[id] for id in self.base.effects]
        laws = [Law(p.spot, p.terms, f"{_owner(p.spot)}.tried{k}") for k, p in enumerate(proposed)]
        effects = [
            _effect(law, f"tried{k}@{law.spot.port.name}", "a table", p.trend)
            for k, (law, p) in enumerate(zip(laws, proposed, strict=True))
        ]
        subject = with_laws(subject, self.models, self.load, effects, self.base.effects)
        begin = {n: v for n, v in begin.items() if n in self.base.fit.values}
        starts = [
            {**begin, **dict(zip(law.sizes, p.sizes, strict=True))} for law, p in zip(laws, proposed, strict=True)
        ]
        subject = tightened(subject, starts)
        built = []
        for law, effect, start, p in zip(laws, effects, starts, proposed, strict=True):
            acting = [*beside, effect]
            fitted = fit_effects(subject, acting, [start], tolerance=_COARSE, chords=0)
            fitted = fitted or fit_effects(subject, acting, [begin], tolerance=_COARSE, chords=0)
            if fitted is not None:
                built.append(_Built(law, p.over, p.knots, effect, subject, fitted, p.trend))
        return built

    def _told(self, built: _Built, of: str = "") -> Tabulated | None:
        """Return a table with its final names, if it closes enough of the gap, and beyond chance."""
        nominal, fitted = self.outcome.nominal, pruned(built.subject, built.fitted, of)
        lows = [
            closure_interval(nominal.held_out, fitted.held_out, null=self.null)[0],
            closure_interval(self.base.held_out, fitted.held_out)[0],
        ]
        if closure(nominal.held_out, fitted.held_out) < decide.CLOSURE_THAT_NAMES or min(lows) <= 0.0:
            return None
        place, port = built.law.spot, built.law.spot.port
        words = " and ".join(self._in_words(q, place) for q in built.over)
        word = "refinement" if of else "learned_table"
        owner = _owner(place)
        name = free_name([self.inside], owner, word)
        law = replace(built.law, base=f"{owner}.{name}")
        what = f"table over {words} that refines the shape of {of}" if of else f"learned table over {words}"
        effect = _effect(law, f"{name}@{port.name}({words})", f"{port.name}: {what}", built.trend)
        renamed = dict(zip(built.law.sizes, law.sizes, strict=True))
        values = {renamed.get(n, n): v for n, v in fitted.fit.values.items()}
        unknowns = tuple(replace(u, name=renamed.get(u.name, u.name)) for u in fitted.fit.unknowns)
        fit = replace(fitted.fit, unknowns=unknowns, values=values)
        left_out = tuple({renamed.get(n, n): v for n, v in at_fold.items()} for at_fold in fitted.left_out)
        fitted = replace(fitted, effects=(*fitted.effects[:-1], effect.id), fit=fit, left_out=left_out)
        subject = with_laws(self.outcome.subject, self.models, self.load, [effect], fitted.effects[:-1])
        subject = tightened(subject, [values])
        best = Closing(subject, self.outcome.nominal, self.null, self.outcome.scores).best(fitted)
        if of:
            best = replace(best, effects=best.effects[:-1], parameters=self._covering(best.parameters))
        sizes = np.array([values[n] for n in law.sizes]).reshape([len(k) for k in built.knots])
        sizes = np.cumsum(sizes) if built.trend else sizes
        refinement = Refinement(
            effect=of or effect.id,
            id=effect.id,
            port=port.name,
            variables=tuple(self._in_words(q, place) for q in built.over),
            units=tuple(q.unit for q in built.over),
            knots=tuple(tuple(map(float, k)) for k in built.knots),
            values=sizes.tolist(),
            unit=built.law.spot.port.added_unit,
            trend=built.trend,
            entry=entry(effect),
        )
        return Tabulated(effect, subject, fitted, replace(best, refinements=(refinement,)))

    def _covering(self, refined: Mapping[str, Estimate]) -> dict[str, Estimate]:
        """Return parameters of a refined law with errors whose 90 % intervals cover those of the plain law."""
        plain = self._plain()

        def both(one: Estimate, other: Estimate) -> Estimate:
            moved = abs(one.value - other.value) / _INTERVAL
            error = None if other.standard_error is None else other.standard_error + moved
            return replace(other, value=one.value, standard_error=error)

        return {n: both(e, plain[n]) for n, e in refined.items() if n in plain}

    def _in_words(self, x: Quantity, place: Spot) -> str:
        """Return a variable in words: a quantity of the place in its domain, or a signal or variable by name."""
        words = quantity_words(place.port.domain, place.port.units[0]) if place.port.kind != "parameter" else {}
        signals = {c.variable: c.signal for case in self.outcome.subject.model.cases for c in case.channels}
        return words.get(x.name) or signals.get(x.name, x.name.removeprefix(LOGGED))


def _owner(place: Spot) -> str:
    """Return the beginning of names of parameters at a place; a coefficient may be that of one equation."""
    return place.port.name.replace(":", ".")


def _better(before: Fitted, after: Fitted) -> bool:
    """Return whether a model with a table closes enough of what another one leaves, and predicts better."""
    return decide.worth_adding(before, after) and after.held_out.mean < before.held_out.mean


def _effect(law: Law, id: str, description: str, trend: int) -> Effect:
    """Return a table as an effect, whose sizes are small where nothing determines them.

    With a `trend`, all sizes but the first are increments of its sign.
    """
    effect = law.effect(id, description)
    first, *others = (replace(u, sd=law.spot.flow) for u in effect.unknowns)
    others = [replace(u, lower=0.0 if trend > 0 else u.lower, upper=0.0 if trend < 0 else u.upper) for u in others]
    steps = frozenset(u.name for u in others) if trend else frozenset()
    trials = tuple({n: v * (trend if n in steps else 1) for n, v in trial.items()} for trial in effect.trials)
    return replace(
        effect,
        law=id.partition("@")[0],
        unknowns=(first, *others),
        natural=steps,
        trials=trials,
        source="learned from the measurements",
    )


def _names(effect: Effect) -> frozenset[str]:
    try:
        return parse_modelica(effect.expression).names
    except ProblemError:
        return frozenset()


def _terms(over: tuple[Quantity, ...], knots: tuple[FloatArray, ...]) -> tuple[Term, ...]:
    first, *others = (table(x, at) for x, at in zip(over, knots, strict=True))
    for other in others:
        first = [replace(a, text=f"{a.text}*{b.text}", rank=a.rank + b.rank) for a in first for b in other]
    return tuple(first)


def _courses(place: Spot, x: Quantity) -> list[FloatArray]:
    return [c[x.name] for c in place.courses]


def _knots(place: Spot, x: Quantity, count: int) -> FloatArray:
    """Return knots near quantiles of what two runs or more have reached, as numbers with few digits.

    Beyond that, no other run shows what a left-out one does.
    """
    courses = _courses(place, x)
    if len(courses) > 1:
        low, high = sorted(c.min() for c in courses)[1], sorted(c.max() for c in courses)[-2]
        shared = [c[(c >= low) & (c <= high)] for c in courses]
        courses = [c for c in shared if len(c) > 1 and np.ptp(c) > 0.0] if low < high else courses
    at = quantile_knots(courses, count)
    shares = np.linspace(0.0, 1.0, len(at))
    knots = (1.0 - _EVEN) * at + _EVEN * (at[0] + np.ptp(at) * shares)
    return np.unique(np.round(knots, 4 - int(np.floor(np.log10(np.ptp(knots))))))


def _some(knots: FloatArray, count: int) -> tuple[int, ...]:
    """Return the numbers of so many of the knots, among them the first and the last one."""
    return tuple(dict.fromkeys(np.linspace(0, len(knots) - 1, count).round().astype(int).tolist()))


def _simplest(tables: Sequence[_Table]) -> _Table:
    """Return the table with the fewest values of those that predict left-out experiments as well as the best.

    Monotone ones come first: they have less freedom, and do nothing unexpected where few measurements are.
    """
    best = min(tables, key=lambda t: t.held_out.mean)

    def as_good(other: _Table) -> bool:
        gained, error = advantage(best.held_out, other.held_out)
        return gained <= error

    alike = [t for t in tables if t is best or as_good(t)]
    return min(alike, key=lambda t: (not t.trend, len(t.terms), t.held_out.mean))
