"""The pipeline of a diagnosis, in order: floor, refit, where, scores, refits, held-out data, company, verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.formatting import html_lines, html_table, text_table
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis import decide
from fmuid.diagnosis.calibration import Calibration, shipped
from fmuid.diagnosis.candidates import Fitted, estimates, fit_effects, score_further
from fmuid.diagnosis.cross_validation import closure, closure_interval, in_sample
from fmuid.diagnosis.effect_search import Say, aliases, finished, search
from fmuid.diagnosis.localisation import ExcessMap, excess_map
from fmuid.diagnosis.next_experiment import sensor_to_add, suggest
from fmuid.diagnosis.null_distribution import Null, draw_noise
from fmuid.diagnosis.observed import excess, gap
from fmuid.diagnosis.ports import Decoy, fit_decoys
from fmuid.diagnosis.power import smallest_seen
from fmuid.diagnosis.regimes import bases, folded, own_bases, trajectories
from fmuid.diagnosis.scores import Score, nominal_basis
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.summary import likeliest, summary
from fmuid.diagnosis.verdict import Candidate, Diagnosis, Gap, Kind, Verdict


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

    def __str__(self) -> str:
        """Return verdict, place and size of the gap, and the likeliest effects."""
        answer = self.diagnosis.to_dict()
        return "\n".join([*summary(answer), "", text_table(likeliest(answer))])

    def _repr_html_(self) -> str:
        answer = self.diagnosis.to_dict()
        return html_lines(summary(answer)) + html_table(likeliest(answer))


def _quiet(_: str, __: float) -> None:
    return None


def diagnose_subject(
    subject: Subject, *, say: Say = _quiet, seed: int = 0, calibration: Calibration | None = None
) -> Found:
    """Diagnose the gap between a model and measurements.

    Parameters
    ----------
    subject
        The model, the measurements with their noise floor, the nominal parameters and the effects.
    say
        Hears about progress.
    seed
        Of the null distribution and the bootstrap.
    calibration
        What turns weights into probabilities; that which comes with the package by default.

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
    nominal = fit_effects(subject, (), [{}])
    if nominal is None:
        raise SimulationError("the nominal model cannot be refitted", fix="check its start values")
    say("where the gap lies", 0.08)
    paths = trajectories(model, nominal.fit.values, subject.catalogue.regimes)
    (prediction,) = model.predict([nominal.fit.values])
    if isinstance(prediction, SimulationError):
        raise prediction
    energy = excess_map(observed, prediction, folded(paths, subject.catalogue.regimes))
    say("scoring every effect", 0.1)
    scores = score_further(subject, nominal)
    basis = nominal_basis(nominal.fit, observed)
    signatures = {s.effect: s.signature for s in scores if s.signature is not None}
    noise = draw_noise(observed, seed=seed)
    null = noise.null(basis, list(signatures.values()))
    surplus = excess(nominal.fit.residuals, observed)
    by_experiment = max(
        float(np.sqrt(max(0.0, r @ r / r.size - 1.0 / n)))
        for r, n in zip(nominal.fit.residuals, observed.repeats, strict=True)
    )
    matters = nominal.gap > decide.GAP_THAT_MATTERS or by_experiment > 3 * decide.GAP_THAT_MATTERS
    largest = max((s.drop for s in scores), default=0.0)
    p_value = null.p_value(surplus, largest / decide.SCORE_MARGIN)
    present = matters and p_value < decide.SIGNIFICANCE
    needed = decide.GAP_THAT_MATTERS**2 * sum(
        n * r.size for n, r in zip(observed.repeats, nominal.fit.residuals, strict=True)
    )
    threshold = max(decide.SCORE_MARGIN * null.threshold(), needed)
    seen = smallest_seen(scores, subject.effects, nominal.fit, observed, threshold=threshold)
    powerless = len(observed.folds) < 2 or not (present or seen)
    candidates, best = search(subject, nominal, scores, noise, say, present=present)
    done = present and best is not None and finished(subject, best, scores, noise)
    decoys: tuple[Decoy, ...] = ()
    places = {e.port for e in subject.effects if best is not None and e.id in best.names}
    doubtful = best is None or not decide.beyond_doubt(nominal, best, finished=done)
    if (
        present
        and best is not None
        and (decide.strained(best, subject.effects) or len(best.names) > len(places) == 1)
    ):
        doubtful = True  # a law beyond its shape, or two where one may do
    if present and doubtful:
        say("free functions at every port", 0.75)
        regimes, ports = subject.catalogue.regimes, subject.catalogue.ports
        own = {name: own_bases(paths, regimes, name) for name in ports}
        decoys = fit_decoys(
            model, observed, nominal.fit, ports=tuple(ports.values()), bases=bases(paths, regimes), own=own
        )
    say("deciding", 0.95)
    return _conclude(
        subject,
        begin=begin,
        nominal=nominal,
        best=best,
        candidates=candidates,
        scores=scores,
        decoys=decoys,
        energy=energy,
        paths=paths,
        present=present,
        p_value=p_value,
        seen=seen,
        powerless=powerless,
        done=done,
        calibration=shipped() if calibration is None else calibration,
        null=null,
    )


def _conclude(
    subject: Subject,
    *,
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
    seen: Mapping[str, Mapping[str, float]],
    powerless: bool,
    done: bool,
    calibration: Calibration,
    null: Null,
) -> Found:
    observed = subject.observed
    ports = {e.id: e.port for e in subject.effects}
    named = [ports[n] for n in best.names] if best is not None else []
    decoy = decide.unexplained(nominal, best or nominal, decoys, named) if present else None
    alike = decide.indistinguishable(best, candidates, observed) if best is not None else ()
    unknown = present and (
        decoy is not None
        or best is None
        or decide.strained(best, subject.effects)
        or not decide.names(nominal, best, finished=done)
    )
    place = _strongest(nominal, best, named, decoys) if unknown else None
    if powerless:
        verdict, chosen = Verdict("insufficient"), nominal
    elif not present:
        verdict, chosen = Verdict("complete"), nominal
    elif unknown or best is None:
        # Without repeats what no effect explains may be slow noise.
        kind: Kind = "insufficient" if observed.bounded else "unknown"
        verdict, chosen = Verdict(kind, (), place), nominal
    elif len(alike) > 1:
        names = tuple(dict.fromkeys(n for c in alike for n in c.names))
        places = {ports[n] for n in names}
        verdict, chosen = Verdict("ambiguous", names, places.pop() if len(places) == 1 else None), best
    else:
        verdict, chosen = Verdict("effect", best.names, ports[best.names[0]]), best
    weights = decide.probabilities(
        nominal,
        candidates,
        best,
        observed,
        present=present,
        unknown=unknown,
        effect_ids=[e.id for e in subject.effects],
    )
    probability = calibration.apply(verdict, weights)
    following = suggest(subject, alike) if verdict.kind == "ambiguous" else None
    beyond = 1.0 if following is None else following.separation_sigma
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
        effects=_candidates(
            subject,
            nominal=nominal,
            best=best,
            candidates=candidates,
            scores=scores,
            probability=probability,
            null=null,
        ),
        alias_classes=aliases(subject, nominal, candidates, scores),
        model={**subject.model.expanded(chosen.fit.values)},
        next_experiment=following,
        added_sensor=sensor_to_add(subject, alike, beyond=beyond) if verdict.kind == "ambiguous" else None,
        ports=_port_shares(nominal, decoys),
        smallest_seen=seen,
        notes=(*subject.findings, *((calibration.note,) if calibration.trials else ())),
    )
    return Found(diagnosis, subject, nominal, best, tuple(candidates), tuple(scores), tuple(decoys), energy, paths)


def _candidates(
    subject: Subject,
    *,
    nominal: Fitted,
    best: Fitted | None,
    candidates: Sequence[Fitted],
    scores: Sequence[Score],
    probability: Mapping[str, float],
    null: Null,
) -> tuple[Candidate, ...]:
    # An effect is credited with what it closes alone; those of the verdict with what they close together.
    best_with = {fitted.names[0]: fitted for fitted in candidates if len(fitted.effects) == 1}
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
                _interval(subject, nominal, fitted_with, null),
            )
            own = {u.name for e in subject.effects if e.id == name for u in e.unknowns}
            parameters = {n: e for n, e in estimates(fitted_with, subject).items() if n in own}
        found.append(Candidate(name, p, drops.get(name), closing, parameters))
    return tuple(sorted(found, key=lambda c: -c.probability))


def _interval(subject: Subject, nominal: Fitted, fitted: Fitted, null: Null) -> tuple[float, float]:
    """Return from where to where the closure on new runs is to be expected.

    Predicting an experiment from the others alone is harder than new runs are for a model that has seen all, and
    those are harder than the runs it was fitted to: the lower end is of the first, the upper of the last.
    """
    low, high = closure_interval(nominal.held_out, fitted.held_out, noise=null.excess)
    seen = [in_sample(model.fit, subject.observed) for model in (nominal, fitted)]
    return low, max(high, closure_interval(seen[0], seen[1], noise=null.excess)[1])


def _strongest(nominal: Fitted, best: Fitted | None, named: Sequence[str], decoys: Sequence[Decoy]) -> str | None:
    """Return the port where free functions, or effects, close most of the held-out gap; None if none do."""
    shares = _port_shares(nominal, decoys)
    if best is not None and len(set(named)) == 1:
        shares[named[0]] = max(shares.get(named[0], 0.0), closure(nominal.held_out, best.held_out))
    port = max(shares, key=lambda p: shares[p], default=None)
    return port if port is not None and shares[port] >= decide.CLOSURE_THAT_PLACES else None


def _port_shares(nominal: Fitted, decoys: Sequence[Decoy]) -> dict[str, float]:
    """Return by port the largest share of the gap that a free function there closes on held-out experiments."""
    shares: dict[str, float] = {}
    for decoy in decoys:
        shares[decoy.port] = max(shares.get(decoy.port, 0.0), closure(nominal.held_out, decoy.held_out))
    return shares
