"""The pipeline of a diagnosis, in order: floor, refit, where, scores, refits, held-out data, company, verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.campaign import FloatArray
from fmuid.diagnosis import decide
from fmuid.diagnosis.candidates import Fitted, add_effect, estimates, fit_effects, polish, score_further
from fmuid.diagnosis.held_out import closure, closure_interval
from fmuid.diagnosis.next_experiment import suggest
from fmuid.diagnosis.null import draw_null
from fmuid.diagnosis.observed import excess, gap
from fmuid.diagnosis.ports import Decoy, fit_decoys
from fmuid.diagnosis.regimes import bases, trajectories
from fmuid.diagnosis.result import Candidate, Diagnosis, Gap, Verdict
from fmuid.diagnosis.scores import Score, alias_classes, nominal_basis, project_off, stack
from fmuid.diagnosis.setting_up import Subject
from fmuid.diagnosis.where import ExcessMap, excess_map
from fmuid.errors import SimulationError

Say = Callable[[str, float], None]
"""Hears what is being done, and the share of the work that is behind."""

_SINGLES = 7  # effects refitted on their own
_PAIRS = 4  # second effects tried beside the best
_MOST = 3  # effects together


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A diagnosis with what its pictures need."""

    diagnosis: Diagnosis
    subject: Subject
    nominal: Fitted
    best: Fitted | None
    candidates: tuple[Fitted, ...]
    scores: tuple[Score, ...]
    decoys: tuple[Decoy, ...]
    excess: ExcessMap
    paths: Mapping[str, tuple[FloatArray, ...]]


def _quiet(_: str, __: float) -> None:
    return None


def diagnose_subject(subject: Subject, *, say: Say = _quiet, seed: int = 0) -> Found:
    """Diagnose the gap between a model and measurements.

    Parameters
    ----------
    subject
        The model, the measurements with their noise floor, the nominal parameters and the effects.
    say
        Hears about progress.
    seed
        Of the null distribution and the bootstrap.

    Raises
    ------
    SimulationError
        The nominal model cannot be simulated at its start values.
    """
    model, observed = subject.model, subject.observed
    say("nominal model at its start values", 0.0)
    (begin,) = model.predict([{u.name: u.start for u in subject.nominal}])
    if isinstance(begin, SimulationError):
        raise begin
    say("refitting the nominal parameters", 0.02)
    nominal = fit_effects(subject, (), {u.name: u.start for u in subject.nominal})
    if nominal is None:
        raise SimulationError("the nominal model cannot be refitted", fix="check its start values")
    say("where the gap lies", 0.08)
    paths = trajectories(model, nominal.fit.values, subject.catalogue.regimes)
    (prediction,) = model.predict([nominal.fit.values])
    if isinstance(prediction, SimulationError):
        raise prediction
    energy = excess_map(observed, prediction, paths)
    say("scoring every effect", 0.1)
    scores = score_further(subject, nominal)
    basis = nominal_basis(nominal.fit, observed)
    signatures = {s.effect: s.signature for s in scores if s.signature is not None}
    null = draw_null(observed, basis, list(signatures.values()), seed=seed)
    surplus = excess(nominal.fit.residuals, observed)
    p_value = null.p_value(surplus)
    by_experiment = max(
        float(np.sqrt(max(0.0, r @ r / r.size - 1.0 / n)))
        for r, n in zip(nominal.fit.residuals, observed.repeats, strict=True)
    )
    matters = nominal.gap > decide.GAP_THAT_MATTERS or by_experiment > 3 * decide.GAP_THAT_MATTERS
    largest = max((s.drop for s in scores), default=0.0)
    present = matters and (p_value < decide.SIGNIFICANCE or largest > decide.SCORE_MARGIN * null.threshold())
    candidates, best = _search(subject, nominal, scores, say, present=present)
    decoys: tuple[Decoy, ...] = ()
    if present and (best is None or closure(nominal.held_out, best.held_out) < decide.CLOSURE_BEYOND_DECOYS):
        say("free functions at every port", 0.75)
        families = bases(paths, subject.catalogue.regimes)
        decoys = fit_decoys(model, observed, nominal.fit, tuple(subject.catalogue.ports.values()), families)
    say("deciding", 0.95)
    return _conclude(
        subject, begin, nominal, best, candidates, scores, decoys, energy, paths, present, p_value, signatures
    )


def _search(
    subject: Subject, nominal: Fitted, scores: Sequence[Score], say: Say, *, present: bool
) -> tuple[list[Fitted], Fitted | None]:
    """Refit the best-scored effects on their own, then in company as long as it is worth it."""
    singles = [s for s in scores if s.signature is not None and s.drop > 0.0][: _SINGLES if present else 2]
    candidates: list[Fitted] = []
    for k, score in enumerate(singles):
        say(f"refitting with {score.effect}", 0.15 + 0.35 * k / len(singles))
        fitted = add_effect(subject, nominal, score)
        if fitted is not None and fitted.fit.cost < nominal.fit.cost:
            candidates.append(fitted)
    if not candidates:
        return [], None
    best = _polished(subject, candidates)
    while present and len(best.names) < _MOST and best.gap > decide.GAP_THAT_MATTERS:
        say(f"what is missing beside {best.id}", 0.5 + 0.1 * len(best.names))
        further = [s for s in score_further(subject, best) if s.signature is not None and s.drop > 0.0]
        pairs = [f for f in (add_effect(subject, best, s) for s in further[:_PAIRS]) if f is not None]
        pairs = [f for f in pairs if f.fit.cost < best.fit.cost]
        if not pairs:
            break
        better = _polished(subject, pairs)
        if not decide.worth_adding(best, better):
            break
        candidates += pairs
        best = better
    return candidates, best


def _polished(subject: Subject, candidates: list[Fitted]) -> Fitted:
    """Return the best candidate, refitted exactly as long as that makes another one best; replaces in place."""
    done: set[str] = set()
    while True:
        best = decide.best_of(candidates)
        if best.id in done:
            return best
        done.add(best.id)
        candidates[candidates.index(best)] = polish(subject, best)


def _conclude(
    subject: Subject,
    begin: Sequence[FloatArray],
    nominal: Fitted,
    best: Fitted | None,
    candidates: Sequence[Fitted],
    scores: Sequence[Score],
    decoys: Sequence[Decoy],
    energy: ExcessMap,
    paths: Mapping[str, tuple[FloatArray, ...]],
    present: bool,
    p_value: float,
    signatures: Mapping[str, FloatArray],
) -> Found:
    observed = subject.observed
    ports = {e.id: e.port for e in subject.effects}
    decoy = decide.unexplained(nominal, best or nominal, decoys) if present else None
    alike = decide.indistinguishable(best, candidates, observed) if best is not None else ()
    closed = closure(nominal.held_out, best.held_out) if best is not None else 0.0
    unknown = present and (decoy is not None or closed < decide.CLOSURE_THAT_NAMES)
    aliases = _aliases(subject, nominal, candidates, signatures)
    if not present:
        verdict, chosen = Verdict("complete"), nominal
    elif unknown or best is None:
        port = _strongest(nominal, decoys)
        verdict, chosen = Verdict("unknown", (), port), nominal
    elif len(alike) > 1:
        names = tuple(dict.fromkeys(n for c in alike for n in c.names))
        places = {ports[n] for n in names}
        verdict, chosen = Verdict("ambiguous", names, places.pop() if len(places) == 1 else None), best
    else:
        verdict, chosen = Verdict("effect", best.names, ports[best.names[0]]), best
    probability = decide.probabilities(
        nominal,
        candidates,
        best,
        observed,
        present=present,
        unknown=unknown,
        effect_ids=[e.id for e in subject.effects],
    )
    diagnosis = Diagnosis(
        verdict=verdict,
        gap=Gap(
            present=present,
            p_value=p_value,
            nominal=gap(observed.residuals(begin), observed),
            nominal_refit=nominal.gap,
            corrected=chosen.gap,
            floor_units={c: s for noise in observed.noise.values() for c, s in noise.sigma.items()},
            calibrated=all(n.calibrated for n in observed.noise.values()),
        ),
        where=energy.shares(),
        effects=_candidates(subject, nominal, best, candidates, scores, probability),
        alias_classes=aliases,
        model={**subject.model.expanded(chosen.fit.values)},
        next_experiment=suggest(subject, alike) if verdict.kind == "ambiguous" else None,
        ports=_port_shares(nominal, decoys),
    )
    return Found(diagnosis, subject, nominal, best, tuple(candidates), tuple(scores), tuple(decoys), energy, paths)


def _candidates(
    subject: Subject,
    nominal: Fitted,
    best: Fitted | None,
    candidates: Sequence[Fitted],
    scores: Sequence[Score],
    probability: Mapping[str, float],
) -> tuple[Candidate, ...]:
    # An effect is credited with what it closes alone; those of the verdict with what they close together.
    best_with = {fitted.names[0]: fitted for fitted in candidates if len(fitted.names) == 1}
    if best is not None:
        best_with |= dict.fromkeys(best.names, best)
    drops = {s.effect: s.drop for s in scores}
    found = []
    for name, p in probability.items():
        fitted_with = best_with.get(name)
        closing = None
        parameters = {}
        if fitted_with is not None:
            train = 1.0 - fitted_with.gap / nominal.gap if nominal.gap > 0 else 0.0
            closing = (
                train,
                closure(nominal.held_out, fitted_with.held_out),
                closure_interval(nominal.held_out, fitted_with.held_out),
            )
            own = {u.name for e in subject.effects if e.id == name for u in e.unknowns}
            parameters = {n: e for n, e in estimates(fitted_with, subject).items() if n in own}
        found.append(Candidate(name, p, drops.get(name), closing, parameters))
    return tuple(sorted(found, key=lambda c: -c.probability))


def _aliases(
    subject: Subject, nominal: Fitted, candidates: Sequence[Fitted], signatures: Mapping[str, FloatArray]
) -> tuple[tuple[str, ...], ...]:
    """Alias classes from the refitted effects' signatures where there are some, from the trials' elsewhere."""
    basis = nominal_basis(nominal.fit, subject.observed)
    own = dict(signatures)
    base = stack(nominal.fit.residuals, subject.observed)
    for fitted in candidates:
        if len(fitted.names) == 1:
            moved = project_off(stack(fitted.fit.residuals, subject.observed) - base, basis)
            length = float(np.linalg.norm(moved))
            if length > 1.0:
                own[fitted.names[0]] = moved / length
    return alias_classes(own)


def _strongest(nominal: Fitted, decoys: Sequence[Decoy]) -> str | None:
    """Return the port whose free functions close most of the held-out gap; None if none closes much."""
    shares = _port_shares(nominal, decoys)
    port = max(shares, key=lambda p: shares[p], default=None)
    return port if port is not None and shares[port] >= decide.CLOSURE_THAT_PLACES else None


def _port_shares(nominal: Fitted, decoys: Sequence[Decoy]) -> dict[str, float]:
    """Return by port the largest share of the gap that a free function there closes on held-out experiments."""
    shares: dict[str, float] = {}
    for decoy in decoys:
        shares[decoy.port] = max(shares.get(decoy.port, 0.0), closure(nominal.held_out, decoy.held_out))
    return shares
