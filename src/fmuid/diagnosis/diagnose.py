"""The pipeline of a diagnosis: noise floor, refit, place, scores, refits, held-out data, combinations, verdict."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.formatting import html_lines, html_table, text_table
from fmuid.core.immutable import FloatArray
from fmuid.core.plottable import Plottable
from fmuid.core.progress import Say, quiet
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.diagnosis import decide
from fmuid.diagnosis.calibration import Calibration, Trial, says, shipped
from fmuid.diagnosis.candidates import (
    Fitted,
    better_nominal,
    escaped,
    estimates,
    fit_effects,
    leaving_out,
    over_horizons,
    refit_only,
    refitted,
    score_further,
    twins,
    without,
)
from fmuid.diagnosis.cross_validation import (
    NoiseDraws,
    Null,
    advantage,
    closure,
    closure_interval,
    draw_noise,
    in_sample,
)
from fmuid.diagnosis.decide import tolerated
from fmuid.diagnosis.effect_search import aliases, finished, holds, search, singles_of
from fmuid.diagnosis.extended_model import Prediction
from fmuid.diagnosis.free_functions import Decoy, bases, fit_decoys, folded, own_bases, responses_of, trajectories
from fmuid.diagnosis.localisation import Beyond, Entry, ExcessMap, entries, excess_map, likelier, places
from fmuid.diagnosis.next_experiment import sensor_to_add, suggest
from fmuid.diagnosis.observed import excess, excesses, gap
from fmuid.diagnosis.scores import Score, hidden, largest_drop, nominal_basis, smallest_seen
from fmuid.diagnosis.subject import Subject, tightened, with_states, without_spikes
from fmuid.diagnosis.summary import likeliest, regime_text, summary
from fmuid.diagnosis.varying import Course, course_of
from fmuid.diagnosis.verdict import (
    NONE,
    UNKNOWN,
    Answer,
    Best,
    Candidate,
    Closure,
    Diagnosis,
    Estimate,
    Gap,
    Kind,
    PhysicalGap,
    Rest,
    Verdict,
)

_RESTARTS = 3  # of the search, from a better optimum of the nominal parameters that it found
_UNSETTLED = 0.01  # share of the cost that refits of the search may leave: ten of the iterations that ended them
_TO_THE_END = 1e-9  # share of the cost: a gain of half a squared standard deviation ends a refit before that


@dataclass(frozen=True, slots=True, eq=False)
class Found(Plottable):
    """A diagnosis with the data for its figures.

    Parameters
    ----------
    diagnosis
        The answer.
    subject
        What was diagnosed: models, runs and effects.
    nominal
        The nominal model, refitted.
    best
        The best explanation of the gap, named or not; None if nothing closes a part of it.
    surviving
        The named answers, the likeliest first.
    candidates
        All refitted models.
    scores
        Scores of the effects, refitted or not.
    entered
        What courses over time explain at the ports, if that was asked.
    excess
        Where the residual exceeds the noise.
    paths
        Trajectories of the regime variables, by name.
    rehearsal
        The simulated plants that were diagnosed before.
    """

    diagnosis: Diagnosis
    subject: Subject
    nominal: Fitted
    best: Fitted | None
    surviving: tuple[Fitted, ...]
    candidates: tuple[Fitted, ...]
    scores: tuple[Score, ...]
    entered: Mapping[str, Entry]
    excess: ExcessMap
    paths: Mapping[str, tuple[FloatArray, ...]]
    rehearsal: tuple[Trial, ...] = ()

    @property
    def corrected(self) -> Fitted:
        """The best explanation of the gap; the nominal model if there is none."""
        return self.nominal if self.best is None else self.best

    @property
    def courses(self) -> dict[str, Course]:
        """Coefficients that vary in the named answers over what they depend on, by effect."""
        best, known = self.diagnosis.best, self.diagnosis.model
        tables = () if best is None else best.refinements
        refined = {table.effect for table in tables}
        courses: dict[str, Course] = {}
        for effect, fitted in ((e, f) for f in self.surviving for e in self.subject.effects if e.id in f.effects):
            values = fitted.fit.values
            values = {n: known.get(n, v) for n, v in values.items()} if effect.id in refined else values
            course = None if effect.id in courses else course_of(self.subject, effect, values, tables)
            courses |= {} if course is None else {effect.id: course}
        return courses

    def __str__(self) -> str:
        """Return verdict, place and size of the gap, and the likeliest effects."""
        answer = self.diagnosis.to_dict()
        return "\n".join([*summary(answer), "", text_table(likeliest(answer))])

    def _repr_html_(self) -> str:
        answer = self.diagnosis.to_dict()
        return html_lines(summary(answer)) + html_table(likeliest(answer))


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Evidence for a gap.

    Attributes
    ----------
    present
        Whether the gap exceeds the noise and is large enough to matter.
    p_value
        p-value of the refitted nominal model under noise alone.
    null
        Null distribution under noise alone.
    power
        For each effect, the smallest parameter values at which it would have been detected.
    """

    present: bool
    p_value: float
    null: Null
    power: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, slots=True, eq=False)
class _Searched:
    """What was found at one refit of the nominal parameters."""

    nominal: Fitted
    paths: Mapping[str, tuple[FloatArray, ...]]
    energy: ExcessMap
    scores: tuple[Score, ...]
    noise: NoiseDraws
    evidence: Evidence
    candidates: list[Fitted]
    best: Fitted | None


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """The verdict, the surviving answers, and what courses at the ports explain, if that was asked."""

    verdict: Verdict
    surviving: tuple[Fitted, ...] = ()
    entered: Mapping[str, Entry] = field(default_factory=dict)

    @property
    def named(self) -> tuple[Fitted, ...]:
        """The surviving answers, if the verdict names any."""
        return self.surviving if self.verdict.kind in ("effect", "partial", "ambiguous") else ()


def diagnose_subject(
    subject: Subject, *, say: Say = quiet, seed: int = 0, calibration: Calibration | None = None
) -> Found:
    """Diagnose the gap between a model and measurements.

    Parameters
    ----------
    subject
        The model, the measurements with their noise floor, the nominal parameters and the effects.
    say
        Called with the current task and the fraction done.
    seed
        Seed of the null distribution and the bootstrap.
    calibration
        Conversion of weights to probabilities; by default, the one shipped with the package.

    Raises
    ------
    SimulationError
        The nominal model cannot be simulated at its start values.
    """
    say = _onward(say)
    say("nominal model at its start values", 0.0)
    begin = _prediction(subject, subject.starts)
    subject = replace(subject, observed=replace(subject.observed, predicted=begin))
    model, observed = subject.model, subject.observed
    say("refitting the nominal parameters", 0.02)
    fit = refit_only(subject, (), [subject.fitted])
    if fit is None:
        raise SimulationError("the nominal model cannot be refitted", fix="check its start values")
    clean = without_spikes(subject, _prediction(subject, fit.values), fit.values)
    if clean is not subject:
        subject, observed = clean, clean.observed
        fit = refit_only(subject, (), [fit.values]) or fit
    bounded = observed.bounded_by(_prediction(subject, fit.values), len(fit.unknowns))
    if bounded is not observed:
        subject, observed = replace(subject, observed=bounded), bounded
        fit = refit_only(subject, (), [fit.values]) or fit
    if observed.nuisances:  # linearised at the start values so far
        observed = with_states(observed, model, fit.values)
        subject = replace(subject, observed=observed)
        fit = refit_only(subject, (), [fit.values]) or fit
    nominal = leaving_out(subject, (), fit)
    subject, searched = _search_settled(subject, nominal, say, seed=seed)
    if searched.evidence.present and not holds(subject, searched.nominal, searched.best):
        say("searching again, with weights for a model that has errors of its own", 0.4)
        subject, searched = _beside_errors(subject, searched, say, seed=seed)
    observed = subject.observed
    model = subject.model
    nominal, scores, evidence, paths = searched.nominal, searched.scores, searched.evidence, searched.paths
    if searched.best is not None and evidence.present:
        others = _look_alikes(subject, searched, searched.best)
        as_good = decide.best_of([searched.best, *others], observed)
        searched = replace(searched, candidates=[*searched.candidates, *others], best=as_good)
    classes = decide.merge_equivalent(searched.candidates, nominal, subject.by_id, observed)
    firsts = {id(fitted): group[0] for group in classes for fitted in group}
    candidates = [fitted for fitted in searched.candidates if firsts[id(fitted)] is fitted]
    best = None if searched.best is None else firsts.get(id(searched.best), searched.best)
    searched = replace(searched, candidates=candidates, best=best)
    closing = Closing(subject, nominal, evidence.null, scores)
    judgement = _judge(subject, searched, closing, say)
    errors = tolerated(subject, nominal)
    if enough := decide.small_enough(errors):
        judgement = Judgement(Verdict("complete", within_tolerance=True), judgement.surviving[:1])
    say("deciding", 0.95)
    weights = decide.weigh(
        nominal,
        judgement.surviving,
        observed,
        judgement.verdict.kind,
        candidates,
        seen=evidence.present,
        provisional=judgement.verdict.provisional,
    )
    calibrated = shipped() if calibration is None else calibration
    probability = calibrated.apply(judgement.verdict, weights)
    if enough:
        probability = decide.with_none(weights, min(e.probability for e in errors))
    judgement = _ranked(judgement, probability, calibrated=calibrated.trials > 0)
    verdict = judgement.verdict
    if judgement.named:
        at = (subject.by_id[id].port for same in _equivalents(classes, judgement.named) for id in same.effects)
        verdict = replace(verdict, ports=tuple(dict.fromkeys((*verdict.ports, *at))))
    explained = judgement.named[0] if judgement.named else _explaining(searched, closing)
    corrected = nominal if explained is None else explained
    ambiguous = verdict.kind == "ambiguous"
    following = suggest(subject, judgement.surviving) if ambiguous else None
    alternatives = (*judgement.surviving, *_equivalents(classes, judgement.named))
    beyond = decide.SAME if following is None else following.separation_sigma
    answers = [
        Answer(s.effects, probability[s.effects], closing(s))
        for s in judgement.surviving
        if s.effects in probability
    ]
    equal = tuple(tuple(fitted.effects for fitted in group) for group in classes if len(group) > 1)
    answers += [Answer(name, probability[name]) for name in (NONE, UNKNOWN)]
    diagnosis = Diagnosis(
        verdict=verdict,
        gap=Gap(
            present=evidence.present,
            p_value=evidence.p_value,
            nominal=gap(observed.residuals(begin), observed),
            nominal_refit=nominal.gap,
            corrected=corrected.gap,
            floor_units={c: s for noise in observed.noise.values() for c, s in noise.sigma.items()},
            calibrated=all(n.calibrated for n in observed.noise.values()),
            bounded=observed.bounded,
        ),
        where=searched.energy.shares(beyond=None if explained is None else _acts_beyond(subject, explained)),
        answers=tuple(sorted(answers, key=lambda a: -a.probability)),
        effects=_candidates(
            subject,
            candidates,
            surviving=judgement.surviving,
            scores=scores,
            probability=probability,
            closing=closing,
        ),
        alias_classes=aliases(
            subject, nominal, candidates, scores, seen=decide.SCORE_MARGIN * evidence.null.threshold()
        ),
        model={**model.expanded(corrected.fit.values)},
        next_experiment=following,
        added_sensor=sensor_to_add(subject, alternatives, beyond=beyond) if len(alternatives) > 1 else None,
        port_closures={port: entry.closure for port, entry in judgement.entered.items()},
        power=evidence.power,
        hidden=hidden(scores),
        notes=(
            *subject.findings,
            *_failed(scores),
            *_shown_once(nominal, judgement.named),
            *_equal_notes(classes, judgement.named),
            *((calibrated.note,) if calibrated.trials else ()),
        ),
        outliers=subject.outliers,
        best=None if explained is None else closing.best(explained),
        equal=equal,
        tolerated=errors,
    )
    return Found(
        diagnosis,
        tightened(subject, [corrected.fit.values]),  # what was merged or came last may need a tighter one
        nominal,
        explained,
        judgement.named,
        tuple(candidates),
        tuple(scores),
        judgement.entered,
        searched.energy,
        paths,
    )


def _onward(say: Say) -> Say:
    """Return `say` without steps back, which a search that starts anew would make."""
    done = 0.0

    def tell(task: str, fraction: float) -> None:
        nonlocal done
        done = max(done, fraction)
        say(task, done)

    return tell


def _search_settled(
    subject: Subject, nominal: Fitted, say: Say, *, seed: int, last: bool = False
) -> tuple[Subject, _Searched]:
    """Search for effects from a nominal model, again from any better optimum of it that the search finds."""
    subject, nominal = _settled(subject, nominal)
    subject, searched = _refined(*_searched(subject, nominal, say, seed=seed, last=last))
    for _ in range(_RESTARTS if searched.evidence.present else 0):
        better = better_nominal(subject, searched.nominal, searched.candidates)
        if better is None:
            break
        subject, nominal = _settled(subject, better)
        subject, searched = _refined(*_searched(subject, nominal, say, seed=seed, last=last))
    return subject, searched


def _beside_errors(subject: Subject, searched: _Searched, say: Say, *, seed: int) -> tuple[Subject, _Searched]:
    """Search again, with the errors of the nominal model added to the noise; return the better of both searches.

    Weights by the noise suit a model that is complete. Where a model's own errors are far larger, whatever these
    weights stress, such as high frequencies, decides between effects, and the fit is poor in the signals' units.
    """
    observed = subject.observed.beside_errors(_prediction(subject, searched.nominal.fit.values))
    if observed is subject.observed:
        return subject, searched
    again = replace(subject, observed=with_states(observed, subject.model, searched.nominal.fit.values))
    again, second = _search_settled(again, refitted(again, searched.nominal), say, seed=seed, last=True)
    if searched.best is not None and second.best is not None:  # it may have missed what the first search found
        open_ = decide.survivors(searched.best, searched.candidates, subject.observed)
        also = [refitted(again, one) for one in open_ if len(one.effects) == len(second.best.effects)]
        best = decide.best_of([second.best, *also], again.observed)
        second = replace(second, candidates=[*second.candidates, *also], best=best)
    closed = [0.0 if one.best is None else decide.validated(one.nominal, one.best) for one in (searched, second)]
    return (again, second) if second.evidence.present and closed[1] > closed[0] else (subject, searched)


def _settled(subject: Subject, nominal: Fitted) -> tuple[Subject, Fitted]:
    """Refit the nominal parameters until the solver's errors stay below the noise there."""
    for _ in range(_RESTARTS):
        tighter = tightened(subject, [nominal.fit.values])
        if tighter is subject:
            break
        subject, before = tighter, nominal.fit.values
        nominal = fit_effects(subject, (), [before]) or nominal
        if all(abs(nominal.fit.values[u.name] - before[u.name]) <= u.step for u in subject.nominal):
            break  # errors there are those here
    return subject, escaped(subject, (), over_horizons(subject, (), nominal, subject.starts))


def _searched(subject: Subject, nominal: Fitted, say: Say, *, seed: int, last: bool) -> tuple[Subject, _Searched]:
    """Locate the gap that a refit of the nominal parameters leaves, and search for effects that close it.

    The solver's errors also stay below the noise with the effects that promise most. A score needs less: what is
    wrong with a signature does not look like the gap.
    """
    say("locating the gap", 0.08)
    paths = trajectories(subject.model, nominal.fit.values, subject.catalogue.regimes)
    prediction = _prediction(subject, nominal.fit.values)
    energy = excess_map(subject.observed, prediction, folded(paths, subject.catalogue.regimes))
    say("scoring every effect", 0.1)
    scores = score_further(subject, nominal)
    noise = draw_noise(subject.observed, prediction, seed=seed)
    evidence = _evidence(subject, nominal, scores, noise)
    again = not last and subject.observed.beside_errors(prediction) is not subject.observed
    trials = [{**nominal.fit.values, **subject.by_id[s.effect].neutral, **s.trial} for s in singles_of(scores)]
    subject = tightened(subject, trials)
    candidates, best = search(subject, nominal, scores, noise, say, present=evidence.present, again=again)
    return subject, _Searched(nominal, paths, energy, scores, noise, evidence, candidates, best)


def _look_alikes(subject: Subject, searched: _Searched, best: Fitted) -> list[Fitted]:
    """Refit what was left out in favour of effects that are open; of those that come near, what has shapes."""
    open_ = decide.survivors(best, searched.candidates, subject.observed)
    near = {frozenset(c.effects): c for c in searched.candidates if decide.comparable(best, c)}
    nominal, scores = searched.nominal, searched.scores
    known = {frozenset(c.effects) for c in searched.candidates}
    others = [twin for one in open_ for twin in twins(subject, nominal, one, scores, known)]
    of_open = {frozenset(one.effects) for one in open_}
    for one in (c for effects, c in near.items() if effects not in of_open):
        others += twins(subject, nominal, one, scores, known, shaped=True)
    return others


def _refined(subject: Subject, searched: _Searched) -> tuple[Subject, _Searched]:
    """Refit the best model and its rivals to the end, with solver tolerances that are tight enough there.

    The search ends refits where an iteration gains little of the cost. In long records, that may be much evidence.
    All that may be left open is simulated well enough.
    """
    best = searched.best
    if best is None:
        return subject, searched
    most = (1.0 + _UNSETTLED) * best.fit.cost
    refined: dict[int, Fitted] = {}
    for k, fitted in enumerate(searched.candidates):
        if fitted is best or decide.comparable(best, fitted):
            before, subject = subject, tightened(subject, [fitted.fit.values])
            if fitted.fit.cost <= most or subject is not before:
                refined[k] = refitted(subject, fitted, tolerance=_TO_THE_END)
    subject = tightened(subject, [fitted.fit.values for fitted in refined.values()])
    candidates = [refined.get(k, fitted) for k, fitted in enumerate(searched.candidates)]
    return subject, replace(
        searched, candidates=candidates, best=decide.best_of([*refined.values()], subject.observed)
    )


def _failed(scores: Sequence[Score]) -> Iterator[str]:
    """Yield a note on the effects with which no simulation succeeds."""
    names = [s.effect for s in scores if s.largest is None]
    if names:
        yield f"Not looked for, because no simulation succeeds with it: {', '.join(names)}."


def _shown_once(nominal: Fitted, named: Sequence[Fitted]) -> Iterator[str]:
    """Yield a note if an effect is named although left-out experiments are predicted badly with it."""
    enough = decide.CLOSURE_THAT_NAMES
    for best in named[:1]:
        if closure(nominal.held_out, best.held_out) < enough <= decide.closed_by(nominal, best):
            yield (
                "Part of what is missing shows in one experiment only, which the others therefore do not predict: "
                "the closure on held-out runs is a lower limit. Another run of its kind would settle it."
            )


def _equivalents(classes: Sequence[Sequence[Fitted]], named: Sequence[Fitted]) -> list[Fitted]:
    """Return the models that are the same as those named."""
    return [one for first, *others in classes if any(first is fitted for fitted in named) for one in others]


def _equal_notes(classes: Sequence[Sequence[Fitted]], named: Sequence[Fitted]) -> Iterator[str]:
    """Yield a note for each answer that is the same model under other names."""
    for answer, *others in classes:
        if others and any(answer is one for one in named):
            same = " or ".join(dict.fromkeys(" and ".join(o.effects) for o in others))
            yield f"In these runs, {same} would be the same as {' and '.join(answer.effects)}."


def _ranked(judgement: Judgement, probability: Mapping[tuple[str, ...], float], *, calibrated: bool) -> Judgement:
    """Put the likeliest answer first, and mark a verdict that is less than nine-tenths sure as provisional."""
    verdict = judgement.verdict
    if not judgement.named:
        return judgement
    surviving = tuple(sorted(judgement.surviving, key=lambda s: -probability.get(s.effects, 0.0)))
    unsure = calibrated and says(verdict, probability) < decide.SURE
    alternatives = {frozenset((*verdict.effects, *others)): others for others in verdict.one_of}
    one_of = tuple(alternatives[frozenset(s.effects)] for s in surviving) if verdict.one_of else ()
    verdict = replace(verdict, one_of=one_of, provisional=verdict.provisional or unsure)
    return replace(judgement, verdict=verdict, surviving=surviving)


def _acts_beyond(subject: Subject, fitted: Fitted) -> Beyond | None:
    """Return where the first effect acts that does so beyond a threshold only; None if all of them always act."""
    for effect in (subject.by_id[id] for id in fitted.effects):
        for regime in subject.catalogue.regimes.values() if effect.threshold else ():
            if regime.name.startswith(f"{effect.port} ") and regime.unit == effect.units[effect.threshold]:
                return Beyond(regime.name, fitted.fit.values[effect.threshold], regime.kind == "speed")
    return None


def _explaining(searched: _Searched, closing: Closing) -> Fitted | None:
    """Return the best explanation; None if no model closes a part of the gap.

    Of the models that predict left-out data as well as the best one, the plausible ones come first, then those
    with the fewest parameters. A model counts as equally good if its loss is within one standard error of the
    least (Breiman et al. 1984) and its gap is hardly larger. Effects at implausible bounds may imitate others.
    """
    if not searched.evidence.present:
        return None
    explaining = [
        c for c in searched.candidates if c.effects and decide.closes_something(searched.nominal, c, closing(c))
    ]
    ranked = sorted(explaining, key=lambda c: -closing(c).validated)
    gains = ((c, *advantage(ranked[0].held_out, c.held_out, elsewhere=True)) for c in ranked)
    least = decide.ABOUT_AS_WELL * (1.0 - closing(ranked[0]).validated) if ranked else 0.0
    as_well = [c for c, gained, error in gains if gained <= error and 1.0 - closing(c).validated <= least]
    effects = closing.subject.effects
    return min(as_well, key=lambda c: (decide.strained(c, effects), len(c.fit.unknowns)), default=None)


def _prediction(subject: Subject, values: Mapping[str, float]) -> Prediction:
    (outcome,) = subject.model.predict([values])
    if isinstance(outcome, SimulationError):
        raise outcome
    return outcome


def _evidence(subject: Subject, nominal: Fitted, scores: Sequence[Score], noise: NoiseDraws) -> Evidence:
    observed = subject.observed
    signatures = [s.signature for s in scores if s.signature is not None]
    null = noise.null(nominal_basis(nominal.fit, observed), signatures)
    beyond, count = excesses(nominal.fit.residuals, observed)
    by_experiment = float(np.sqrt(max(0.0, beyond.max())))
    matters = nominal.gap > GAP_THAT_MATTERS or by_experiment > 3 * GAP_THAT_MATTERS
    largest = largest_drop(scores, subject.by_id)
    p_value = null.p_value(excess(nominal.fit.residuals, observed), largest / decide.SCORE_MARGIN)
    needed = GAP_THAT_MATTERS**2 * float(observed.repeats @ count)
    threshold = max(decide.SCORE_MARGIN * null.threshold(), needed)
    present = matters and p_value < decide.SIGNIFICANCE
    power = smallest_seen(
        subject.model.predict,
        observed,
        nominal.fit,
        scores,
        subject.effects,
        threshold=threshold,
        simulated=not present,  # what would have been seen matters where nothing was
    )
    return Evidence(present, p_value, null, power)


def _judge(subject: Subject, searched: _Searched, closing: Closing, say: Say) -> Judgement:
    """Return the verdict: the surviving answers, the evidence of free functions against them, and the rest."""
    observed, nominal, paths = subject.observed, searched.nominal, searched.paths
    evidence = searched.evidence
    powerless = len(set(observed.groups)) < 2 or not (evidence.present or evidence.power)
    surviving, plausible = _surviving(subject, searched, closing)
    best = surviving[0] if surviving else None
    if powerless or not evidence.present:
        return Judgement(Verdict("insufficient" if powerless else "complete"), surviving[:1])
    done = best is not None and finished(subject, nominal, best, searched.scores, searched.noise)
    at = {e.id: e.port for e in subject.effects}
    named = tuple(dict.fromkeys(at[n] for s in surviving for n in s.effects))
    ports_named = [at[n] for n in best.effects] if best is not None else []
    named_at_all = (
        best is not None and plausible and decide.names(nominal, best, finished=done, bounded=observed.bounded)
    )
    sure = (
        best is not None
        and named_at_all
        and decide.beyond_doubt(nominal, best, finished=done, bounded=observed.bounded)
    )
    entered: Mapping[str, Entry] = {}
    imitated, part = False, None
    if not sure:
        say("where it enters", 0.7)
        entered = where_it_enters(subject, nominal)
        # Each run has a course of its own, so machines that differ would be mistaken for something unknown.
        alike = len({case.machine for case in subject.model.cases}) == 1
        imitated = alike and not done and best is not None and likelier(entered, nominal, best)
        if best is not None and named_at_all and not (imitated or done):
            part = _sure_part(subject, nominal, best, alike=alike)
            imitated = part is None
    if best is not None and named_at_all and not imitated and len(ports_named) > len(set(ports_named)) == 1:
        say(
            f"free functions at {ports_named[0]}", 0.8
        )  # one unnamed law of one variable may take the place of two
        imitated = decide.lumped(best, _decoys(subject, searched, ports_named[0]))
        if imitated and sure:
            entered = where_it_enters(subject, nominal)
    # Without repeats, a gap that no effect explains may be slow noise, unless a law fitted to some runs predicts
    # it in others.
    doubted = best is None or not named_at_all or imitated
    provisional = (
        doubted
        and observed.bounded
        and best is not None
        and plausible
        and closing(best).validated >= decide.GAIN_OF_A_SECOND
        and decide.closes_something(nominal, best, closing(best))
        and decide.by_chance(nominal, best, len(searched.candidates)) < 1.0
    )
    if best is None or (doubted and not provisional):
        kind: Kind = "insufficient" if observed.bounded else "unknown"
        return Judgement(Verdict(kind, ports=places(entered)), surviving, entered)
    stable = decide.stable(surviving, [nominal, *searched.candidates], observed)
    # With repeats, what predicts left-out runs is sure. Without them, the rest may be noise, and odds are short.
    if part is not None and (part.fitted is not best or not observed.bounded):
        best, surviving = part.fitted, (part.fitted,)
        named = tuple(dict.fromkeys(at[n] for n in best.effects))
    alone = len(observed.runs) == 1  # another law may do the same with this input
    strange = bool(decide.held_back(best, subject.nominal, observed))
    provisional = provisional or alone or strange or len(best.effects) > decide.MOST_CALIBRATED
    beside = () if part is None else part.entered
    rest = None if done else Rest(best.gap, where_left(subject, best, paths, beside))
    if len(surviving) == 1:
        partly = part is not None or (provisional and rest is not None and not named_at_all)
        kind = "partial" if partly else "effect"
        verdict = Verdict(kind, best.effects, (), named, stable, rest, provisional)
        return Judgement(verdict, surviving, entered)
    common = set.intersection(*(set(s.effects) for s in surviving))
    one_of = tuple(tuple(n for n in s.effects if n not in common) for s in surviving)
    shared = tuple(n for n in best.effects if n in common)
    verdict = Verdict("ambiguous", shared, one_of, named, stable, rest, provisional)
    return Judgement(verdict, surviving, entered)


def _surviving(subject: Subject, searched: _Searched, closing: Closing) -> tuple[tuple[Fitted, ...], bool]:
    """Return the answers that the data leave open, and whether they are plausible.

    An effect at implausible bounds, where a law may imitate another one, does not hide plausible ones that close
    about as much, or those next to it. What closes nothing of a gap is no answer. Beyond chance, one of the models
    that leave about as much has to close something: they are compared with each other, not each with nothing.
    """

    def plausible(answers: Iterable[Fitted]) -> tuple[Fitted, ...]:
        return tuple(a for a in answers if not decide.strained(a, subject.effects))

    nominal, best, candidates = searched.nominal, searched.best, searched.candidates
    if searched.evidence.present:
        bounded = subject.observed.bounded
        sure = [c for c in candidates if not bounded or decide.closes_something(nominal, c, closing(c))]
        candidates = [
            c
            for c in candidates
            if decide.closed_by(nominal, c) > 0.0
            and any(decide.comparable(s, c) and decide.comparable(c, s) for s in sure)
        ]
        if best not in candidates:  # what is left may be tolerated, and yet be most of the gap
            best = decide.best_of(candidates, subject.observed) if candidates else None
    if best is None:
        return (), False
    surviving = decide.survivors(best, candidates, subject.observed)
    kept = plausible(surviving)
    if not kept and (as_good := plausible(c for c in candidates if decide.comparable(best, c))):
        kept = decide.survivors(decide.best_of(as_good, subject.observed), as_good, subject.observed)
    if not kept and (
        fewer := plausible(c for c in candidates if c.effects and set(c.effects) < set(best.effects))
    ):
        kept = plausible(decide.survivors(decide.best_of(fewer, subject.observed), candidates, subject.observed))
    return kept or surviving, bool(kept)


def _decoys(subject: Subject, searched: _Searched, port: str) -> tuple[Decoy, ...]:
    """Return free functions of the model's variables at a port, fitted together with the nominal parameters."""
    regimes, fit = subject.catalogue.regimes, searched.nominal.fit
    families = {**bases(searched.paths, regimes), **own_bases(searched.paths, regimes, port)}
    at = subject.catalogue.ports.get(port)
    responses = responses_of(subject.model, subject.observed, fit, at, families) if at is not None else ()
    return fit_decoys(responses, fit, subject.observed)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """What of an answer is sure although it leaves something, and where that may enter."""

    fitted: Fitted
    entered: tuple[str, ...]


def where_it_enters(subject: Subject, fitted: Fitted) -> dict[str, Entry]:
    """Return the part of a model's residual that a course over time at each port explains."""
    return entries(subject.model, subject.observed, fitted.fit, tuple(subject.catalogue.ports.values()))


def _sure_part(subject: Subject, nominal: Fitted, best: Fitted, *, alike: bool) -> _Part | None:
    """Return the sure part of `best` although it leaves a rest; None if there is none.

    Only its predictions of other experiments speak for it. If they are poor, its effects that act where the rest
    enters need not be there: a single law that the catalogue does not have, at this place, may do what they do and
    what they leave. The value of a held parameter acts wherever its component does. If the machines are not all
    `alike`, the rest may also be how they differ.
    """
    entered = places(where_it_enters(subject, best))
    acting = {e.id: {e.port, e.port.rpartition(".")[0] * (e.law == "value")} for e in subject.effects}
    resembling = alike and closure(nominal.held_out, best.held_out) < decide.CLOSURE_OF_ITS_KIND
    doubtful = [n for n in best.effects if resembling and acting[n] & set(entered)]
    part: Fitted | None = best if len(doubtful) < len(best.effects) else None
    for name in doubtful:
        part = without(subject, part, name) if part is not None else None
    if part is None or closure(nominal.held_out, part.held_out) < decide.CLOSURE_THAT_NAMES:
        return None
    return _Part(part, places(where_it_enters(subject, part)) if doubtful else entered)


def where_left(
    subject: Subject, best: Fitted, paths: Mapping[str, tuple[FloatArray, ...]], entered: Sequence[str] = ()
) -> str:
    """Return in words where most of the rest after `best` lies, and where it has `entered`."""
    regimes = folded(paths, subject.catalogue.regimes)
    energy = excess_map(subject.observed, _prediction(subject, best.fit.values), regimes)
    shares = energy.shares(1)
    words = ""
    if shares:
        words = f"{shares[0].signal} in {shares[0].experiment}"
        if shares[0].regime is not None:
            variable, low, high = shares[0].regime
            words += f", {regime_text({'regime': {'variable': variable, 'from': low, 'to': high}})}"
    return words + (f" (it enters at {' or '.join(entered)})" if entered else "")


@dataclass(frozen=True, eq=False)
class Closing:
    """How far models close the gap that the refitted nominal one leaves."""

    subject: Subject
    nominal: Fitted
    null: Null
    scores: Sequence[Score] = ()
    _known: dict[int, tuple[Fitted, Closure]] = field(default_factory=dict, init=False, repr=False)

    def __call__(self, fitted: Fitted) -> Closure:
        """Return how far a model closes the gap."""
        if id(fitted) not in self._known:
            nominal = self.nominal
            closed = Closure(
                closure(nominal, fitted),
                closure(nominal.held_out, fitted.held_out),
                self._interval(fitted),
                self._errors(fitted)[""],
            )
            self._known[id(fitted)] = fitted, closed
        return self._known[id(fitted)][1]

    def best(self, fitted: Fitted) -> Best:
        """Return a model as the best explanation."""
        errors = {name: of_run for name, of_run in self._errors(fitted).items() if name}
        of_effects = {u.name for id in fitted.effects for u in self.subject.by_id[id].unknowns}
        parameters = {n: e for n, e in self.estimates(fitted).items() if n in of_effects}
        return Best(fitted.effects, self(fitted), fitted.gap, errors, parameters)

    def estimates(self, fitted: Fitted) -> dict[str, Estimate]:
        """Return a model's parameters; their errors include what it still lacks."""
        return estimates(fitted, self.subject, self.nominal, self.scores)

    def _interval(self, fitted: Fitted) -> tuple[float, float]:
        """Return the range in which the closure on a new experiment with a gap is expected to lie.

        The noise of one experiment counts, not that of the average of them all. New runs are easier to predict
        for a model fitted to all experiments than an experiment is from the others alone, and harder than the
        runs that the model was fitted to. The lower end is that of the held-out closure, the upper end that of
        the closure in sample.
        """
        low, high = closure_interval(self.nominal.held_out, fitted.held_out, null=self.null)
        seen = [in_sample(model.fit, self.subject.observed) for model in (self.nominal, fitted)]
        return low, max(high, closure_interval(seen[0], seen[1], null=self.null)[1])

    def _errors(self, fitted: Fitted) -> dict[str, dict[str, PhysicalGap]]:
        """Return errors by experiment and signal, and under an empty name those over all experiments.

        Each fold is predicted by the models without it.
        """
        subject, observed = self.subject, self.subject.observed
        sums: dict[tuple[str, str], FloatArray] = {}
        wanted = [[(e, values) for (e, _), values in zip(observed.folds, m.left_out, strict=True)]
                  for m in (self.nominal, fitted)]  # fmt: skip
        befores, afters = (subject.model.predict_at(points) for points in wanted)
        pieces = iter(observed.fold_times)
        for (e, _), (begin, end), before, after in zip(observed.folds, pieces, befores, afters, strict=True):
            if isinstance(before, SimulationError) or isinstance(after, SimulationError):
                continue
            case, run = subject.model.cases[e], observed.runs[e]
            sigma = observed.noise[run.setup].of_mean(run.n_repeats)
            for c, channel in enumerate(case.channels):
                mask = run.mask[c, begin:end]
                squares = [float(np.sum(((p[c] - run.mean[c])[begin:end] * mask) ** 2)) for p in (before, after)]
                factor = channel.to_shown.factor**2
                part = np.array([mask.sum(), *(factor * x for x in (*squares, mask.sum() * sigma[c] ** 2))])
                for name in ("", case.id):
                    sums[name, channel.signal] = sums.get((name, channel.signal), np.zeros(4)) + part
        units = {c.signal: c.shown_unit for case in subject.model.cases for c in case.channels}
        errors: dict[str, dict[str, PhysicalGap]] = {"": {}}
        for (name, signal), total in sums.items():
            rms = (float(np.sqrt(x / total[0])) if total[0] else 0.0 for x in total[1:])
            errors.setdefault(name, {})[signal] = PhysicalGap(units[signal], *rms)
        return errors


def _candidates(
    subject: Subject,
    candidates: Sequence[Fitted],
    *,
    surviving: Sequence[Fitted],
    scores: Sequence[Score],
    probability: Mapping[tuple[str, ...], float],
    closing: Closing,
) -> tuple[Candidate, ...]:
    # An effect is credited with its own closure; the effects of an answer, with their joint closure.
    best_with = {fitted.effects[0]: fitted for fitted in candidates if len(fitted.effects) == 1}
    for answer in reversed(surviving):
        best_with |= dict.fromkeys(answer.effects, answer)
    drops = {s.effect: s.drop for s in scores}
    known = {id(fitted): (closing(fitted), closing.estimates(fitted)) for fitted in best_with.values()}
    judged = []
    for effect in subject.effects:
        inclusion = sum(p for names, p in probability.items() if effect.id in names)
        fitted = best_with.get(effect.id)
        if fitted is None:
            judged.append(Candidate(effect.id, inclusion, drops.get(effect.id)))
            continue
        closed, values = known[id(fitted)]
        parameters = {u.name: values[u.name] for u in effect.unknowns if u.name in values}
        judged.append(Candidate(effect.id, inclusion, drops.get(effect.id), closed, parameters))
    return tuple(sorted(judged, key=lambda c: -c.probability))
