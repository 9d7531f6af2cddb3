"""The search for a law at a port that explains an unknown or partly explained gap."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmu_build.errors import UserError
from fmu_build.flat_model import FlatModel
from fmuid.core.campaign import ModelSpec
from fmuid.core.errors import FmuidError, SimulationError
from fmuid.core.progress import Say, quiet
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.diagnosis import decide
from fmuid.diagnosis.candidates import (
    Fitted,
    approach,
    approached,
    drifts,
    estimates,
    fit_effects,
    promising,
    refitted_early,
    without,
)
from fmuid.diagnosis.cross_validation import NoiseDraws, advantage, closure, closure_interval, draw_noise
from fmuid.diagnosis.diagnose import Found, where_it_enters
from fmuid.diagnosis.localisation import likelier
from fmuid.diagnosis.observed import excess
from fmuid.diagnosis.scores import nominal_basis, score_effects
from fmuid.diagnosis.subject import Subject, tightened
from fmuid.diagnosis.verdict import Closure, Curve, LawFound, LawParameter
from fmuid.discovery.injected import Law, entry, free_name, of_second_order, with_laws
from fmuid.discovery.places import Spot, inside_of, names_of_places, spot
from fmuid.discovery.selection import Chosen, Proposal, choose, instead, responses_to
from fmuid.discovery.terms import HIDDEN, evaluated, names_in
from fmuid.effects.effect import Effect
from fmuid.simulation.fmu import Fmu
from fmuid.simulation.simulator import Simulator

CLOSURE_THAT_HOLDS = 0.8  # share of the held-out gap that a law must close to count as found
_LEFT = 1.0  # noise floors that a law may leave: beyond, its rest is seen in a single run, and it is not the law
_PLACES = 4  # number of places examined: those where a course over time is likeliest
_TRIED = (6, 4)  # laws per round that are refitted in the rebuilt model: with one further term, and with two
_LED_OUT = 2  # laws that are approached over growing horizons: those that fit best
_TERMS = 3  # largest number of terms in a law
_INTERVAL = 1.96  # standard errors: 95 %
_POINTS = 101  # number of points of a curve
_LATE = ("delay", "lag")  # effects of signals that a law may be mistaken for, and the reverse
_TRIED_LATE = 2  # number of them that are tried with a law, most promising first


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A law, refitted in the model that contains it; the law is the last of the model's effects."""

    law: Law
    effect: Effect
    subject: Subject
    fitted: Fitted

    @property
    def beside(self) -> tuple[str, ...]:
        """The other effects of the model."""
        return self.fitted.effects[:-1]

    @property
    def rank(self) -> int:
        """Complexity of the law and of the other effects."""
        return self.law.rank + 2 * len(self.beside)


@dataclass(frozen=True, slots=True, eq=False)
class Discovery:
    """Result of the search: a law and the model that contains it, or the reason why there is none."""

    law: LawFound
    best: Candidate | None = None


def find_law(
    outcome: Found,
    models: Mapping[str, ModelSpec],
    load: Callable[[ModelSpec], Simulator],
    *,
    say: Say = quiet,
    seed: int = 0,
) -> Discovery | None:
    """Look for a law where a diagnosis is *unknown* or *partial*, or its effects leave more than noise.

    The search selects a few terms of a library that explain the residual of the nominal model. It adds the best
    laws to the model at the port, rebuilds the model and refits it with all parameters. A law is extended as long
    as it leaves more than noise and further terms close enough of the rest on held-out experiments. If effects
    explain a part, a law is first sought in their place, then in addition to them. Where they are the verdict, it
    must predict held-out experiments much better than they do. Returns None where no law is looked for.

    Parameters
    ----------
    models
        Models by setup; those with Modelica source, and FMUs for model exchange, can contain a law.
    load
        Loads a model.
    say
        Called with progress.
    seed
        Seed of the null distribution and the bootstrap.
    """
    verdict, subject = outcome.diagnosis.verdict, outcome.subject
    effect = verdict.kind == "effect"
    if verdict.kind not in ("unknown", "partial") and not (effect and verdict.rest is not None):
        return None
    insides = insides_of(subject, models)
    if insides is None:
        return _none(
            "a model has neither Modelica source nor an FMU for model exchange, so no law can be added to it"
        )
    noise = noise_draws(subject, outcome.nominal, seed)
    named = () if verdict.kind == "unknown" else outcome.surviving[:1]
    if named and not outcome.entered:  # the verdict did not need it
        outcome = replace(outcome, entered=where_it_enters(subject, named[0]))
    reasons = []
    for base in (outcome.nominal, *named):  # instead of the effects that explain a part, then in addition to them
        search = _Search(outcome, base, models, load, insides, noise, seed)
        try:
            best, reason = search.best(say)
            if effect and best is not None and not decide.worth_adding(named[0], best.fitted):
                reason = reason or "no law explains the gap much better than the effects of the verdict"
            if best is not None and not reason:
                best = search.named(replace(best, fitted=pruned(best.subject, best.fitted)))
                return Discovery(search.described(best, seed), best)
        except (FmuidError, UserError) as error:  # a model that cannot be built or simulated yields no law
            reason = str(error)
        reasons.append(reason if not base.effects else f"beside {base.id}, {reason}")
    return _none("; ".join(reasons))


def insides_of(subject: Subject, models: Mapping[str, ModelSpec]) -> dict[str, FlatModel | Fmu] | None:
    """Return the source of every setup, or its FMU for model exchange; None if one has neither."""
    setups = dict.fromkeys(case.setup for case in subject.model.cases)
    insides = {s: inside for s in setups if s in models and (inside := inside_of(models[s])) is not None}
    return insides if len(insides) == len(setups) else None


def noise_draws(subject: Subject, fitted: Fitted, seed: int) -> NoiseDraws:
    """Draw residuals that noise alone would leave, around the predictions of a model."""
    (predicted,) = subject.model.predict([fitted.fit.values])
    return draw_noise(subject.observed, None if isinstance(predicted, SimulationError) else predicted, seed=seed)


def pruned(subject: Subject, fitted: Fitted, kept: str = "") -> Fitted:
    """Drop the effects that the last one makes unnecessary, except the one named `kept`."""
    for name in (n for n in fitted.effects[:-1] if n != kept):
        simpler = without(subject, fitted, name)
        if simpler is not None and (simpler.gap <= GAP_THAT_MATTERS or not decide.worth_adding(simpler, fitted)):
            fitted = simpler
    return fitted


def _likeliest(chosen: Sequence[Chosen]) -> list[Chosen]:
    """Return the best choices with one member and with two: half by held-out loss, half by fit.

    With few experiments, leaving one out says little where the rest is far from linear.
    """
    kept: list[Chosen] = []
    for members, most in enumerate(_TRIED, 1):
        of_length = [c for c in chosen if c.members == members]
        first = sorted(of_length, key=lambda c: c.held_out.mean)[: most - most // 2]
        others = sorted((c for c in of_length if c not in first), key=lambda c: -c.drop)
        kept += [*first, *others[: most // 2]]
    return kept


def _none(reason: str) -> Discovery:
    return Discovery(LawFound(reason=reason))


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    outcome: Found
    base: Fitted
    models: Mapping[str, ModelSpec]
    load: Callable[[ModelSpec], Simulator]
    insides: Mapping[str, FlatModel | Fmu]
    noise: NoiseDraws
    seed: int

    def best(self, say: Say) -> tuple[Candidate | None, str]:
        """Return the best law, and the reason why it is refused, if it is."""
        spots = self.spots()
        if not spots:
            return None, "no flow can be added to the model where the gap enters"
        best: Candidate | None = None
        terms = 0
        while best is None or (terms < _TERMS and not self.finished(best)):
            say(f"looking for a law at {' or '.join(s.port.name for s in spots)}", 0.955 + 0.004 * terms)
            better = self.extended(best, spots)
            if better is None:
                break
            best, spots = better, [self.along(better)]
            terms = len(best.law.terms) + len(best.beside) - len(self.base.effects)
        if best is None:
            return None, "no term of the library explains more than noise would"
        best = self.simplified(best)
        return best, self.refused(best)

    def simplified(self, law: Candidate) -> Candidate:
        """Return the simplest law that does what a law does along the trajectories of the model that has it.

        The model without it was far off, so that the terms that explained its residuals need not be the simplest.
        """
        place = self.along(law)
        flow = replace(law.law, spot=place).courses(law.fitted.fit.values)
        others = self._refitted(None, instead(place, flow), law)
        return self._simplest([law, *others])

    def along(self, law: Candidate) -> Spot:
        """Return the place of a law with its quantities along the trajectories of the model with the law."""
        name, inside = law.law.spot.port.name, next(iter(self.insides.values()))
        return spot(name, inside, law.subject.model, law.fitted.fit.values) or law.law.spot

    def spots(self) -> list[Spot]:
        """Return the candidate places that can carry a law, the likeliest first."""
        outcome, subject = self.outcome, self.outcome.subject
        ports = subject.catalogue.ports
        asked = sorted(outcome.entered, key=lambda port: -outcome.entered[port].evidence)
        here = set.intersection(*map(names_of_places, self.insides.values()))
        names = [n for n in asked if n in here and n in ports and ports[n].added and ports[n].input is not None]
        inside = next(iter(self.insides.values()))
        values = self.base.fit.values
        return [s for n in names[:_PLACES] if (s := spot(n, inside, subject.model, values)) is not None]

    def extended(self, law: Candidate | None, spots: Sequence[Spot]) -> Candidate | None:
        """Return the best law with a further term (one or two, if there is no law yet), if it is worth it.

        A delay or lag of a signal may be added to a law instead of a term.
        """
        subject = self.outcome.subject if law is None else law.subject
        before = self.base if law is None else law.fitted
        late = responses_to(subject, before.fit, self._late_effects(self.base.effects)) if law is None else ()
        chosen = [
            c for s in spots for c in choose(subject, before.fit, s, self.noise, pairs=law is None, beside=late)
        ]
        candidates = [*self._refitted(law, _likeliest(chosen)), *(self._late(law) if law is not None else ())]
        if law is None and not any(self.finished(c) for c in candidates):
            candidates = sorted([*candidates, *self._from_beginnings(spots)], key=lambda c: c.fitted.fit.cost)
            candidates = [*map(self._led_out, candidates[:_LED_OUT]), *candidates[_LED_OUT:]]
        if not candidates:
            return None
        best = self._simplest(candidates)
        return best if decide.worth_adding(before, best.fitted) else None

    def _late(self, law: Candidate) -> list[Candidate]:
        """Return a law together with those delays and lags of signals that promise most, refitted."""
        subject, values = self.outcome.subject, law.fitted.fit.values
        known = self._late_effects(law.beside)
        scores = score_effects(law.subject.model.predict, subject.observed, law.fitted.fit, known)
        candidates = []
        for score in (s for s in scores[:_TRIED_LATE] if s.drop > 0.0):
            beside = (*law.beside, score.effect)
            changed = with_laws(subject, self.models, self.load, [law.effect], beside)
            effects = [changed.by_id[id] for id in (*beside, law.effect.id)]
            fitted = fit_effects(changed, effects, [{**values, **trial} for trial in score.trials])
            if fitted is not None and not decide.strained(fitted, effects[-2:]):
                candidates.append(replace(law, subject=changed, fitted=fitted))
        return candidates

    def _late_effects(self, beside: Sequence[str]) -> list[Effect]:
        """Return the delays and lags of signals that are not in a model yet, and that need no place in it."""
        every = self.outcome.subject.effects
        return [e for e in every if e.law in _LATE and not e.expression and e.id not in beside]

    def _from_beginnings(self, spots: Sequence[Spot]) -> list[Candidate]:
        """Return laws that explain early parts of the runs, where the model has not drifted away yet."""
        part, again = refitted_early(self.outcome.subject, self.base)
        if again is None:
            return []
        noise, inside = noise_draws(part, again, self.seed), next(iter(self.insides.values()))
        rebuilt = [spot(s.port.name, inside, part.model, again.fit.values) for s in spots]
        chosen = [c for s in rebuilt if s is not None for c in choose(part, again.fit, s, noise)]
        return self._refitted(None, _likeliest(chosen))

    def _led_out(self, law: Candidate) -> Candidate:
        """Return a law with a better fit, approached over growing horizons, if its fit is in a local minimum."""
        subject, fitted, starts = law.subject, law.fitted, self.outcome.subject.starts
        if not drifts(subject, fitted):
            return law
        sizes = {name: fitted.fit.values[name] for name in law.law.sizes}
        shapes = {u.name: u.start for u in law.effect.unknowns if u.name in law.effect.shapes}
        near = approached(subject, fitted.fit.unknowns, {**fitted.fit.values, **starts, **shapes}, [sizes])
        effects = [e for e in subject.effects if e.id in fitted.effects]
        again = fit_effects(subject, effects, [near]) if near is not None else None
        better = (
            again is not None and again.fit.cost < fitted.fit.cost and not decide.strained(again, [law.effect])
        )
        return replace(law, fitted=again) if again is not None and better else law

    def _refitted(
        self, law: Candidate | None, chosen: Sequence[Proposal], instead_of: Candidate | None = None
    ) -> list[Candidate]:
        """Put laws into the model, each added while the others are off, and refit each with all parameters.

        Each has the terms of `law` as well, or is refitted from the values of a model with another law.
        """
        laws, starts = [], []
        model = law or instead_of
        beside = self.base.effects if model is None else model.beside
        values = self.base.fit.values if model is None else model.fitted.fit.values
        around = {n: v for n, v in values.items() if model is None or n not in model.effect.units}
        for k, one in enumerate(chosen):
            port = one.spot.port.name
            terms = (*(law.law.terms if law is not None else ()), *one.terms)
            new = Law(one.spot, terms, f"{port}.tried{k + 1}")
            sizes, start = list(one.sizes), dict(around)
            if law is not None:
                sizes = [values[n] for n in law.law.sizes] + sizes
                for i in range(len(law.law.terms)):
                    new_shapes, theirs = new.shapes(i), law.law.shapes(i)
                    start |= {new_shapes[n]: values[theirs[n]] for n in new_shapes}
            laws.append(new)
            starts.append({**start, **dict(zip(new.sizes, sizes, strict=True)), **one.values})
        effects = [law.effect(f"tried{k + 1}@{law.spot.port.name}", "a law") for k, law in enumerate(laws)]
        subject = with_laws(
            self.outcome.subject, self.models, self.load, effects, [*beside, *(c.beside for c in chosen)]
        )
        subject = tightened(subject, starts)
        ends = []
        for one, new, effect, start in zip(chosen, laws, effects, starts, strict=True):
            acting = [subject.by_id[id] for id in (*beside, one.beside, effect.id) if id]
            unknowns = [*subject.nominal, *(u for e in acting for u in e.unknowns)]
            begins = [start, {**start, **subject.starts}] if law is None else [start]
            if (end := approach(subject, unknowns, begins)) is not None:
                ends.append((*end, new, acting))
        candidates: list[Candidate] = []
        for _, at, new, acting in promising(ends):
            rival = min((c.fitted.fit.cost for c in candidates), default=np.inf)
            fitted, effect = fit_effects(subject, acting, [at], rival=rival), acting[-1]
            if fitted is not None and not decide.strained(fitted, acting[len(beside) :]):
                candidates.append(Candidate(new, effect, subject, fitted))
        return candidates

    def _simplest(self, candidates: Sequence[Candidate]) -> Candidate:
        """Return the simplest of the laws that the data do not distinguish from the best one.

        A law that another one, no less simple, beats clearly on the experiments fitted is none of them. The others
        predict held-out experiments about as well as the best one, or fit all of them better.
        """
        observed = self.outcome.subject.observed

        def beyond(better: Candidate, worse: Candidate) -> bool:
            return decide.separation(better.fitted, worse.fitted, observed) >= decide.SAME

        left = [c for c in candidates if not any(d.rank <= c.rank and beyond(d, c) for d in candidates)]
        best = min(left, key=lambda c: c.fitted.held_out.mean)
        most = decide.ABOUT_AS_WELL * best.fitted.held_out.gap + GAP_THAT_MATTERS
        alike = [
            c
            for c in left
            if not beyond(best, c) and (c.fitted.held_out.gap <= most or c.fitted.fit.cost <= best.fitted.fit.cost)
        ]
        return min(alike, key=lambda c: (c.rank, c.fitted.held_out.mean))

    def p_value(self, law: Candidate) -> float:
        """Return how likely noise alone leaves as much as a law does."""
        observed = self.outcome.subject.observed
        null = self.noise.null(nominal_basis(law.fitted.fit, observed), ())
        return null.p_value(excess(law.fitted.fit.residuals, observed))

    def finished(self, law: Candidate) -> bool:
        """Return whether a law leaves nothing that matters, or no more than noise."""
        return law.fitted.gap <= GAP_THAT_MATTERS or self.p_value(law) >= decide.SIGNIFICANCE

    def refused(self, law: Candidate) -> str:
        """Return why the best law is refused, or nothing if it holds."""
        base = self.base
        closed = closure(base.held_out, law.fitted.held_out)
        gained, error = advantage(law.fitted.held_out, base.held_out)
        weak = self.finished(law) and closed >= decide.CLOSURE_THAT_NAMES
        formula = law.law.formula(law.fitted.fit.values)
        text = f"the best law, {formula}, closes {closed:.2f} of the gap on experiments left out"
        if gained <= error or (closed < CLOSURE_THAT_HOLDS and not weak):
            return f"{text}, too little (it takes {CLOSURE_THAT_HOLDS:g})"
        left = f"{text}, but leaves {law.fitted.gap:.2g} times the noise"
        if law.fitted.gap > _LEFT:
            return left
        if not self.finished(law) and likelier(self.outcome.entered, self.outcome.nominal, law.fitted):
            return f"{left}, and something else is far likelier"
        if not self.memory_known(law):
            return f"{text}, but the data do not tell its first-order memory from one of second order"
        return ""

    def memory_known(self, law: Candidate) -> bool:
        """Return whether the data prefer a law's first-order memory to one of second order with the same delay.

        Where they do not, any slow response does, a long delay among them, and the equation is not known.
        """
        slower = of_second_order(law.effect)
        if slower is None:
            return True
        subject = with_laws(self.outcome.subject, self.models, self.load, [slower], law.beside)
        fitted = fit_effects(
            subject, [subject.by_id[id] for id in (*law.beside, slower.id)], [law.fitted.fit.values]
        )
        return fitted is None or decide.log_odds(law.fitted, fitted, subject.observed) >= np.log(decide.OPEN)

    def named(self, law: Candidate) -> Candidate:
        """Return a law with its final names."""
        values, spot = law.fitted.fit.values, law.law.spot
        name = free_name(self.insides.values(), spot.port.name, "law")
        final = replace(law.law, spot=self.along(law), base=f"{spot.port.name}.{name}")
        before = {u.name: values[u.name] for u in law.effect.unknowns}
        after = final.effect("", "").unknowns
        new = {old: u.name for old, u in zip(before, after, strict=True)}
        renamed = {new.get(n, n): v for n, v in values.items()}
        text = f"law found at {spot.port.name}: a flow of {final.formula(renamed)}"
        effect = final.effect(f"{name}_found@{spot.port.name}", text, renamed)
        unknowns = tuple(replace(u, name=new.get(u.name, u.name)) for u in law.fitted.fit.unknowns)
        fit = replace(law.fitted.fit, unknowns=unknowns, values=renamed)
        fitted = replace(law.fitted, effects=(*law.beside, effect.id), fit=fit)
        subject = with_laws(self.outcome.subject, self.models, self.load, [effect], law.beside)
        return Candidate(final, effect, tightened(subject, [renamed]), fitted)

    def described(self, law: Candidate, seed: int) -> LawFound:
        """Return a law in words and numbers."""
        nominal, fitted, law_ = self.outcome.nominal, law.fitted, law.law
        null = self.noise.null(nominal_basis(nominal.fit, self.outcome.subject.observed), ())
        interval = closure_interval(nominal.held_out, fitted.held_out, null=null, seed=seed)
        units = {n: unit for id in fitted.effects for n, unit in law.subject.by_id[id].units.items()}
        parameters = {}
        for name, estimate in estimates(fitted, law.subject, nominal, self.outcome.scores).items():
            if name in units:
                half = None if estimate.standard_error is None else _INTERVAL * estimate.standard_error
                around = None if half is None else (estimate.value - half, estimate.value + half)
                parameters[name] = LawParameter(estimate.value, units[name], estimate.standard_error, around)
        return LawFound(
            id=law.effect.id,
            port=law_.spot.port.name,
            beside=law.beside,
            formula=law_.formula(fitted.fit.values),
            effect=entry(law.effect),
            parameters=parameters,
            values=dict(fitted.fit.values),
            closure=Closure(closure(nominal, fitted), closure(nominal.held_out, fitted.held_out), interval),
            gap=fitted.gap,
            p_value=self.p_value(law),
            curve=curve(law_, fitted.fit.values),
        )


def curve(law: Law, values: Mapping[str, float]) -> Curve:
    """Return a law over the quantity that it mainly depends on, with the others at their root mean square."""
    x, courses = law.terms[0].over, law.spot.courses
    grid = np.linspace(min(c[x.name].min() for c in courses), max(c[x.name].max() for c in courses), _POINTS)
    held = {n: float(np.sqrt(np.mean(np.concatenate([c[n] for c in courses]) ** 2))) for n in courses[0]}
    columns = {n: np.full(_POINTS, v) for n, v in held.items()} | {"time": np.zeros(_POINTS), x.name: grid}
    flow = np.zeros(_POINTS)
    used: dict[str, float] = {}
    for k, (size, term) in enumerate(zip(law.sizes, law.terms, strict=True)):
        shape_columns = {n: np.full(_POINTS, values[name]) for n, name in law.shapes(k).items()}
        used |= {n: held[n] for n in names_in(term.text) & held.keys() - {x.name}}
        if term.rate:
            shapes = {n: float(v[0]) for n, v in shape_columns.items()}
            course = [term.state(c, t, shapes) for c, t in zip(courses, law.spot.time, strict=True)]
            used[HIDDEN] = float(np.sqrt(np.mean(np.concatenate(course) ** 2)))
            shape_columns[HIDDEN] = np.full(_POINTS, used[HIDDEN])
        flow = flow + values[size] * evaluated(term.text, columns | shape_columns)
    words = ", ".join(f"{n} = {v:.3g}" for n, v in used.items())
    return Curve(x.name, x.unit, law.spot.port.added_unit, tuple(map(float, grid)), tuple(map(float, flow)), words)
