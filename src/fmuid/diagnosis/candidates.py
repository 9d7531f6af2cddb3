"""Refits of effects: each with all nominal parameters free, from its best trial, then combined with others.

Growing horizons. Without feedback, a model drifts away from its plant, and where it is far off, the slopes of the
cost mislead: over a whole run the cost has many minima, over its beginning only few. Where a plant forgets, so
that responses to parameters do not grow over a run, its beginning tells nothing that the whole run hides.
(Ribeiro, Tiels, Umenberger, Schon and Aguirre: On the smoothness of nonlinear system identification. Automatica
121, 2020.)

Standard errors. The refit minimises residuals e of the mean runs whitened by W, so the error of its estimate is
``(J'W'WJ)^-1 J'W'W e``. Whitening knows the noise only from the differences of a few repeats, in bands of
frequency and as if a run were periodic. So the covariance of ``J'W'W e`` is taken from the residuals over time, as
in an identification (`fmuid.identification.uncertainty.coloured_residuals`).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fmuid.campaigns.signal_catalogue import OF_VALUE
from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.data.noise.spectrum import PiecewiseWhitener, Whitener
from fmuid.data.noise.transform import from_real_spectrum
from fmuid.diagnosis.cross_validation import CHORDS, HeldOut, leave_each_out, predicted_left_out
from fmuid.diagnosis.extended_model import Prediction, linear_at
from fmuid.diagnosis.observed import Observed, excesses, gap, project_off
from fmuid.diagnosis.refit import ITERATIONS, Refit, about, descend, refit
from fmuid.diagnosis.scores import Score, nominal_basis, score_effects, stack, without_aliases
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.verdict import Estimate
from fmuid.effects.effect import Effect, Unknown
from fmuid.effects.laws import laws
from fmuid.identification.problem.cases import Case
from fmuid.identification.uncertainty.coloured_residuals import Record, coloured_covariance

_OTHERS = 100  # effects that stand for all that a model may lack
_DETERMINED = 1e-6  # smallest singular value of unit columns, relative to the largest


def standard_errors(fit: Refit, observed: Observed, prediction: Sequence[FloatArray]) -> FloatArray:
    """Return the (P,) standard errors of a refit, all NaN if the data do not determine its parameters.

    They are not below those of the noise floor. A parameter that moves nothing has none either.

    Parameters
    ----------
    fit
        The refit, with its Jacobian of whitened residuals.
    observed
        The measurements that it was fitted to.
    prediction
        (C, N) per experiment, at the estimate.
    """
    seen, scale, bread = _curvature(fit, observed)
    errors: FloatArray = np.full(len(seen), np.nan)
    if bread is None:
        return errors
    records: dict[str, list[Record]] = {}
    for run, whiten, jacobian, y in zip(observed.runs, observed.whiteners, fit.jacobian, prediction, strict=True):
        columns = (jacobian[:, seen] * scale).T.reshape(int(seen.sum()), len(run.channels), -1)
        slopes = run.n_repeats * _transposed(whiten, columns)
        left = (y - run.mean) * run.mask
        records[run.id] = [
            Record(name, left[c], slopes[:, c].T.copy(), run.mask[c]) for c, name in enumerate(run.channels)
        ]
    meat, _ = coloured_covariance(records, int(seen.sum()))
    variance = np.maximum(np.diag(bread @ meat @ bread), np.diag(bread))
    errors[seen] = np.sqrt(variance) * scale
    return errors


def errors_of_the_cost(fit: Refit, observed: Observed) -> dict[str, float]:
    """Return the standard errors of a refit if the noise floor were all that it leaves; inf if undetermined."""
    seen, scale, bread = _curvature(fit, observed)
    errors: FloatArray = np.full(len(seen), np.inf)
    if bread is not None:
        errors[seen] = np.sqrt(np.diag(bread)) * scale
    return dict(zip((u.name for u in fit.unknowns), map(float, errors), strict=True))


def _curvature(fit: Refit, observed: Observed) -> tuple[NDArray[np.bool_], FloatArray, FloatArray | None]:
    """Return which parameters move anything, and for these their units and the inverse of the cost's curvature.

    The units make columns of whitened residuals of length 1. Without an inverse, the data do not determine them.
    """
    whitened = stack(fit.jacobian, observed)
    norms = np.linalg.norm(whitened, axis=0)
    seen = norms > 0.0
    scale = 1.0 / norms[seen]
    _, s, axes = np.linalg.svd(whitened[:, seen] * scale, full_matrices=False)
    determined = len(s) > 0 and s[-1] > _DETERMINED * s[0]
    return seen, scale, (axes.T / s**2) @ axes if determined else None


def _transposed(whiten: Whitener | PiecewiseWhitener, whitened: FloatArray) -> FloatArray:
    """Return W'y, (..., C, N), for whitened y (..., C, K)."""
    if isinstance(whiten, PiecewiseWhitener):
        return np.concatenate([_transposed(w, whitened[..., a:b]) for a, b, w in whiten.pieces], axis=-1)
    spectrum = np.zeros((*whitened.shape[:-1], whiten.mask.shape[1]))
    spectrum[..., 0] = whitened[..., 0] * whiten.mean_scale
    for band, factor in zip(whiten.bands, whiten.factors, strict=True):
        spectrum[..., band] = factor.T @ whitened[..., band]
    return from_real_spectrum(spectrum) * whiten.mask


_End = TypeVar("_End", bound=tuple[Any, ...])
_SHARES = (1 / 8, 1 / 4, 1 / 2)  # of every run
_EARLY = _SHARES[1]  # of a run, over which effects are first compared
_GROWTH = 2.0  # of a response, second half over first half: steady is 1, in proportion to time 2.6
_SHORTEST = 64  # samples in a beginning: a spectrum needs as many
_ITERATIONS = 6  # of a quick search: on a longer horizon, or with care, another one continues
_KEPT = 3  # starts that go on to the next horizon


def approached(
    subject: Subject,
    unknowns: Sequence[Unknown],
    start: Mapping[str, float],
    trials: Sequence[Mapping[str, float]],
) -> Mapping[str, float] | None:
    """Return the point that refits of the runs' beginnings lead to from a start with the best of several trials.

    A short beginning determines little, so trials are made again from where it leads to.

    None where runs are predicted in segments, which do not drift away, or are too short to be divided, or where no
    start can be simulated.
    """
    shares = _shares(subject)
    starts: list[Mapping[str, float]] = [start]
    for share in shares:
        part = beginning(subject, share)
        starts = [*starts, *({**starts[0], **trial} for trial in trials)]
        ends = sorted(_ends(part, unknowns, starts), key=lambda end: end[0])
        starts = [values for cost, values in ends if cost <= about(ends[0][0])][:_KEPT]
        if not starts:
            return None
    return starts[0] if shares else None


def early(subject: Subject) -> Subject | None:
    """Return the subject with only an early part of every run; None if runs cannot be shortened."""
    return beginning(subject, _EARLY) if _EARLY in _shares(subject) else None


def _shares(subject: Subject) -> tuple[float, ...]:
    """Return the shares of every run that are beginnings of it: none where runs are predicted in segments."""
    shortest = min(len(case.time) for case in subject.model.cases)
    return () if subject.observed.nuisances else tuple(s for s in _SHARES if shortest * s >= _SHORTEST)


def drifts(subject: Subject, fitted: Fitted) -> bool:
    """Return whether a model drifts away from its plant: the response to some parameter grows over the runs.

    Responses are those at the estimate and, of nominal parameters, at the start values. Where they are unknown, it
    is assumed to drift.
    """
    begin = {**fitted.fit.values, **subject.starts}
    begin |= {name: value for id in fitted.effects for name, value in subject.by_id[id].neutral.items()}
    with suppress(SimulationError):
        points = linear_at(subject.model, [fitted.fit.values, begin], [fitted.fit.unknowns, subject.nominal])
        return any(_growth(slopes, subject.observed) > _GROWTH for at in points for slopes in at.slopes.values())
    return True


def _growth(slopes: Prediction, observed: Observed) -> float:
    """Return how many times as large a response is in the second half of the runs, in units of noise."""
    halves = np.zeros(2)
    for run, slope in zip(observed.runs, slopes, strict=True):
        sigma = observed.noise[run.setup].sigma
        scaled = slope * run.mask / np.array([[sigma[channel]] for channel in run.channels])
        halves += [np.sum(half**2) for half in np.array_split(scaled, 2, axis=1)]
    if halves[0] == 0.0:
        return np.inf if halves[1] > 0.0 else 0.0
    return float(np.sqrt(halves[1] / halves[0]))


def beginning(subject: Subject, share: float) -> Subject:
    """Return the subject with no more than the first share of every run, and the same noise."""
    model = replace(subject.model, cases=tuple(_beginning(case, share) for case in subject.model.cases))
    noise = {setup: replace(n, pieces=1) for setup, n in subject.observed.noise.items()}
    return replace(subject, model=model, observed=Observed(model.runs, noise))


def _beginning(case: Case, share: float) -> Case:
    end = case.lead + round(share * len(case.time))
    task = replace(
        case.task, time=case.task.time[:end], inputs={name: u[:end] for name, u in case.task.inputs.items()}
    )
    samples = end - case.lead
    channels = tuple(replace(c, repeats=c.repeats[:, :samples]) for c in case.channels)
    columns = {name: (unit, values[:samples]) for name, (unit, values) in case.columns.items()}
    return replace(case, task=task, channels=channels, columns=columns, criteria=())


def _ends(
    part: Subject, unknowns: Sequence[Unknown], starts: Sequence[Mapping[str, float]], most: float = np.inf
) -> Iterator[tuple[float, Mapping[str, float]]]:
    """Yield the cost and the values where searches from the `starts` end, without those that cannot begin.

    Those that would not end about as well as the best before them, or above the cost `most`, need not end.
    """
    model = part.model
    for start in starts:
        with suppress(SimulationError):
            end = descend(
                model.predict,
                part.observed,
                unknowns,
                start,
                tangents=model.tangents,
                max_iterations=_ITERATIONS,
                most=most,
            )
            most = min(most, about(end[0]))
            yield end


_SIZE = (0.03, 3.0)  # of a first guess, in trials: a response is linear only so far
_CAREFUL = 4  # quick searches from which careful ones continue, and those that end as well as the best
_HOPELESS = 2.5  # times the cost of a rival: a gap over 1.5 times as large, which no open answer leaves
_AS_MUCH = 0.5  # share of the best quick gain: one that gains less was never seen to overtake it with care
_ESCAPES = 2  # from local minima of one refit
_TWINS = 4  # number of effects, left out in favour of one that was found, that are refitted in its place


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A refitted model with effects added; no effects for the nominal model.

    Attributes
    ----------
    effects
        All effects in the model.
    held_out
        Losses on held-out experiments.
    judged
        The same, beyond the errors that the other experiments leave in the parameters.
    left_out
        Parameters refitted without each fold, one mapping per fold.
    log_prior
        Logarithm of their prior weight: the best of n candidates, compared with the same measurements before a
        model with them was built, pays ln n (Bonferroni).
    """

    effects: tuple[str, ...]
    fit: Refit
    held_out: HeldOut
    judged: HeldOut
    gap: float
    left_out: tuple[Mapping[str, float], ...] = ()
    log_prior: float = 0.0

    @property
    def id(self) -> str:
        """Ids of the effects, joined; ``none`` for the nominal model."""
        return "+".join(self.effects) or "none"


def fit_effects(
    subject: Subject,
    effects: Sequence[Effect],
    starts: Sequence[Mapping[str, float]],
    *,
    iterations: int = ITERATIONS,
    tolerance: float = 1e-3,
    chords: int = CHORDS,
    rival: float = np.inf,
    most: float = np.inf,
) -> Fitted | None:
    """Refit the nominal parameters together with those of `effects`; None if no start can be simulated.

    If it fits worse than its `rival`, its predictions of left-out experiments are those of one step. If its cost
    is above `most`, or too far above that of its rival for an answer, they are linear, and the refit need not end.
    """
    most = min(most, _HOPELESS * rival)
    fit = refit_only(subject, effects, starts, iterations=iterations, tolerance=tolerance, rival=rival, most=most)
    if fit is None:
        return None
    steps = chords if fit.cost <= about(rival) else 1
    return leaving_out(subject, effects, fit, chords=steps if fit.cost <= most else 0)


def leaving_out(subject: Subject, effects: Sequence[Effect], fit: Refit, *, chords: int = CHORDS) -> Fitted:
    """Judge a refitted model by predictions of left-out experiments, from refits of as many steps."""
    observed = subject.observed
    left_out = predicted_left_out(fit, observed, subject.model, chords)
    return Fitted(
        tuple(e.id for e in effects),
        fit,
        leave_each_out(fit, observed, predictions=left_out.residuals),
        leave_each_out(fit, observed, within_errors=True, predictions=left_out.residuals),
        gap(fit.residuals, observed),
        left_out.values,
        _log_prior(subject, effects),
    )


def _log_prior(subject: Subject, effects: Sequence[Effect]) -> float:
    """Return the logarithm of the prior probability of effects.

    Every law is equally probable, whether it is one of the catalogue or one by which coefficients vary, and so is
    every place where it may act. Laws of both kinds have as many places as their average.
    """
    catalogue = [e.law for e in subject.by_id.values() if e.among == 1]
    of_coefficients = sum("parameter" in law.domains for law in laws().values())
    others = max(1, len({*catalogue}))

    def places(effect: Effect) -> float:
        return len(catalogue) / others if effect.among == 1 else effect.among / of_coefficients

    return -float(sum(np.log((others + of_coefficients) * places(e)) for e in effects))


def refit_only(
    subject: Subject,
    effects: Sequence[Effect],
    starts: Sequence[Mapping[str, float]],
    *,
    iterations: int = ITERATIONS,
    tolerance: float = 1e-3,
    rival: float = np.inf,
    most: float = np.inf,
) -> Refit | None:
    """Refit as `fit_effects` does, without predictions of left-out experiments."""
    unknowns = subject.nominal + tuple(u for e in effects for u in e.unknowns)
    neutral = {name: value for e in effects for name, value in e.neutral.items()}
    with suppress(SimulationError):
        return refit(
            subject.model.predict,
            subject.observed,
            unknowns,
            starts=[{**neutral, **start} for start in starts],
            tangents=subject.model.tangents,
            max_iterations=iterations,
            tolerance=tolerance,
            rival=rival,
            most=most,
        )
    return None


def refitted(subject: Subject, fitted: Fitted, *, tolerance: float = 1e-3) -> Fitted:
    """Refit a model from where it is; return it as it was if it cannot be simulated."""
    effects = [subject.by_id[id] for id in fitted.effects]
    again = fit_effects(subject, effects, [fitted.fit.values], tolerance=tolerance)
    return fitted if again is None else again


def better_nominal(subject: Subject, nominal: Fitted, candidates: Sequence[Fitted]) -> Fitted | None:
    """Refit the nominal model from the values of a candidate if it fits better there without the effect.

    A refit with an effect may escape from a local minimum that the nominal refit ended in. None if it has not.
    """
    starts = [{u.name: c.fit.values[u.name] for u in subject.nominal} for c in candidates]
    start, cost = _best_start(subject, [nominal.fit.values, *starts])
    if not np.isfinite(cost) or start is nominal.fit.values:
        return None
    better = fit_effects(subject, (), [start], most=nominal.fit.cost)
    return better if better is not None and nominal.fit.cost > about(better.fit.cost) else None


def score_further(
    subject: Subject, fitted: Fitted, *, likely: Sequence[Score] = (), most: int | None = None
) -> tuple[Score, ...]:
    """Score the effects that `fitted` lacks, at its estimate; indistinguishable effects are scored once.

    Given the scores of a simpler model, score only the `most` effects whose signatures there promise most.
    """
    left_out = {twin.effect for s in likely for twin in s.same}
    others = [e for e in subject.effects if e.id not in fitted.effects and e.id not in left_out]
    if likely and most is not None:
        basis = nominal_basis(fitted.fit, subject.observed)
        residual = stack(fitted.fit.residuals, subject.observed)
        promised = {s.effect: _promise(s, basis, residual) for s in likely}
        others = sorted(others, key=lambda e: -promised.get(e.id, 0.0))[:most]
    scores = score_effects(subject.model.predict, subject.observed, fitted.fit, others)
    return (
        scores if likely else without_aliases(subject.model.predict, subject.observed, fitted.fit, others, scores)
    )


def score_early(
    subject: Subject, fitted: Fitted, *, likely: Sequence[Score] = (), most: int | None = None
) -> tuple[Score, ...]:
    """Score effects as `score_further` does in early parts of the runs, at a refit of these.

    Empty where runs cannot be shortened, or where the model does not drift.
    """
    part, again = refitted_early(subject, fitted)
    return () if again is None else score_further(part, again, likely=likely, most=most)


def score_at_start(
    subject: Subject, fitted: Fitted, *, likely: Sequence[Score] = (), most: int | None = None
) -> tuple[Score, ...]:
    """Score effects as `score_further` does at the model's start values.

    Without the effect that is missing, a refit may end far away, where that effect no longer promises anything.
    Effects that promise to leave more there than `fitted` leaves without them are left out, unless promises from
    there are too small: the plain parameters then promise to leave more than their refit left.
    """
    there = unfitted(subject, fitted, subject.starts)
    if there is None:
        return ()
    if _left_by_a_step(subject, there) > about(fitted.fit.cost):
        return score_further(subject, there, likely=likely, most=most)
    return score_there(subject, there, fitted.fit.cost, likely=likely, most=most)


def unfitted(subject: Subject, fitted: Fitted, values: Mapping[str, float]) -> Fitted | None:
    """Return a model at other values of its parameters, without a refit; None if it cannot be simulated there."""
    effects = [e for e in subject.effects if e.id in fitted.effects]
    there = refit_only(subject, effects, [{**fitted.fit.values, **values}], iterations=0)
    return None if there is None else replace(fitted, fit=there)


def score_there(
    subject: Subject, there: Fitted, worth: float, *, likely: Sequence[Score] = (), most: int | None = None
) -> tuple[Score, ...]:
    """Score effects as `score_further` does, and return those that promise to leave less than the cost `worth`."""
    scores, left = score_further(subject, there, likely=likely, most=most), _left_by_a_step(subject, there)
    return tuple(s for s in scores if left - s.drop < worth)


def _left_by_a_step(subject: Subject, there: Fitted) -> float:
    """Return the cost that a linear step of the fitted parameters promises to leave."""
    basis, residual = nominal_basis(there.fit, subject.observed), stack(there.fit.residuals, subject.observed)
    left = project_off(residual, basis)
    return float(left @ left)


def refitted_early(subject: Subject, fitted: Fitted) -> tuple[Subject, Fitted | None]:
    """Return the subject with only early parts of the runs, and `fitted` refitted to these.

    None if runs cannot be shortened, or if the model does not drift.
    """
    part = early(subject)
    if part is None or not drifts(subject, fitted):
        return subject, None
    effects = [e for e in subject.effects if e.id in fitted.effects]
    return part, fit_effects(part, effects, [fitted.fit.values, {**fitted.fit.values, **subject.starts}])


def _promise(score: Score, basis: FloatArray, residual: FloatArray) -> float:
    """Return the fall of the cost along the part of a signature that is orthogonal to `basis`."""
    if score.signature is None:
        return 0.0
    new = project_off(score.signature, basis)
    length = float(np.linalg.norm(new))
    return float(new @ residual / length) ** 2 if length > 1e-6 else 0.0


def without(subject: Subject, fitted: Fitted, name: str, *, compared: bool = False) -> Fitted | None:
    """Refit `fitted` without one of its effects, to the end unless it is only `compared` with `fitted`."""
    effects = [subject.by_id[n] for n in fitted.effects if n != name]
    most = _HOPELESS * fitted.fit.cost if compared else np.inf
    return fit_effects(subject, effects, [fitted.fit.values], most=most)


def add_effect(
    subject: Subject,
    fitted: Fitted,
    score: Score,
    starts: Sequence[Mapping[str, float]] = (),
    rival: float = np.inf,
) -> Fitted | None:
    """Refit `fitted` with the scored effect added, from `starts` or its best ones; see `refit` for the `rival`."""
    by_id = subject.by_id
    effect = by_id[score.effect]
    effects = [*(by_id[name] for name in fitted.effects), effect]
    begins = starts or _starts(subject, fitted.fit, score)
    added = fit_effects(subject, effects, begins, rival=rival) if begins else None
    if added is None or added.fit.cost > fitted.fit.cost:  # at neutral values it is no worse than without
        added = fit_effects(subject, effects, [{**fitted.fit.values, **effect.neutral}])
    return added


def approach_effect(
    subject: Subject, fit: Refit, score: Score, most: float = np.inf, *, everywhere: bool = False
) -> tuple[float, Mapping[str, float]] | None:
    """Return where a quick search with the scored effect added to a refit ends; see `approach`.

    It begins at the refit and at the start values: at the worse of them only if it promises enough, or if
    `everywhere` is set.
    """
    unknowns = (*fit.unknowns, *subject.by_id[score.effect].unknowns)
    return approach(subject, unknowns, _starts(subject, fit, score, everywhere=everywhere), most)


def costs_with(
    subject: Subject, fit: Refit, special: Mapping[str, str] = MappingProxyType({})
) -> dict[str, float]:
    """Return the cost that a quick search with each effect of the subject added to a refit leaves, by id.

    Effects that are `special` cases of others, with one size each, are also sought where these ended.
    """
    scores = score_effects(subject.model.predict, subject.observed, fit, subject.effects)
    ends = {s.effect: approach_effect(subject, fit, s, fit.cost) for s in scores}
    costs = {name: fit.cost if end is None else min(end[0], fit.cost) for name, end in ends.items()}
    for name, general in special.items():
        one, other, end = subject.by_id[name], subject.by_id[general], ends[general]
        if end is not None:
            start = {**end[1], **one.neutral, one.sizes[0]: end[1][other.sizes[0]]}
            again = approach(subject, (*fit.unknowns, *one.unknowns), [start], costs[name])
            costs[name] = costs[name] if again is None else min(again[0], costs[name])
    return costs


def approach(
    subject: Subject, unknowns: Sequence[Unknown], starts: Sequence[Mapping[str, float]], most: float = np.inf
) -> tuple[float, Mapping[str, float]] | None:
    """Return the cost and the values where the best of quick searches ends; None if none can begin.

    Those that would end above the cost `most` need not end (see `refit`).
    """
    return min(_ends(subject, unknowns, starts, most), key=lambda end: end[0], default=None)


def promising(ends: Iterable[_End], before: float = np.inf) -> list[_End]:
    """Return where the best quick searches ended, which start with their costs, the best one first.

    They began at the cost `before`. Where the best one gains more than searches leave open, those that gain far
    less are left out.
    """
    ordered = sorted(ends, key=lambda end: end[0])
    least = ordered[0][0] if ordered else before
    most = worth_care(least, before)
    return [e for k, e in enumerate(ordered) if e[0] <= about(least) or (k < _CAREFUL and e[0] <= most)]


def worth_care(least: float, before: float) -> float:
    """Return the cost above which no careful search continues a quick one, if another one ended at the `least`."""
    return max(before - _AS_MUCH * (before - least), about(least)) if about(least) < before else np.inf


def _starts(subject: Subject, fit: Refit, score: Score, *, everywhere: bool = False) -> list[Mapping[str, float]]:
    """Return where to begin with the scored effect added to `fit`.

    Parameters refitted without the effect may have shifted to imitate it, so the campaign's start values are tried
    as well. The worse of the two counts only if a step from there promises to leave less than `fit` does, or if
    both are asked for.
    """
    effect = subject.by_id[score.effect]
    # The signature says how large the effect should be, as far as the response is linear in its size.
    factor = float(np.clip(score.scale, -_SIZE[1] if effect.two_sided else _SIZE[0], _SIZE[1]))
    sizes = [effect.scaled(score.trial, factor), *({**effect.neutral, **trial} for trial in score.trials)]
    unbent = {**fit.values, **subject.starts}
    basis = nominal_basis(fit, subject.observed)
    starts = sorted(
        (_best_start(subject, [{**at, **size} for size in sizes], basis, at) for at in (fit.values, unbent)),
        key=lambda start: start[1],
    )
    enough = (np.inf, np.inf if everywhere else fit.cost)
    return [start for (start, cost), most in zip(starts, enough, strict=True) if cost < most]


def moved(subject: Subject, fitted: Fitted, exchanged: Mapping[str, Score]) -> Fitted | None:
    """Refit `fitted`, with some effects `exchanged` for laws elsewhere or similar ones, as its rival."""
    by_id = subject.by_id
    values = dict(fitted.fit.values)
    for name in exchanged:
        values |= by_id[name].neutral
    same: dict[str, float] = {}
    for name, score in exchanged.items():
        values |= by_id[score.effect].neutral
        pairs = zip(by_id[score.effect].unknowns, by_id[name].unknowns, strict=False)
        same |= {u.name: float(np.clip(fitted.fit.values[v.name], u.lower, u.upper)) for u, v in pairs}
    trials = [t for score in exchanged.values() for t in score.trials] if len(exchanged) == 1 else []
    sizes = [{**values, **trial} for trial in (same, *trials)]
    start, cost = _best_start(subject, sizes, nominal_basis(fitted.fit, subject.observed), fitted.fit.values)
    kept = [by_id[n] for n in fitted.effects if n not in exchanged]
    effects = [*kept, *(by_id[score.effect] for score in exchanged.values())]
    return fit_effects(subject, effects, [start], rival=fitted.fit.cost) if np.isfinite(cost) else None


def led_out(subject: Subject, added: Fitted, score: Score, rival: float = np.inf) -> Fitted:
    """Return a better fit than `added`, to which the scored effect was added, if it is in a local minimum.

    No refit is made that would end too far above the cost of its rival for an answer.
    """
    by_id = subject.by_id
    effect, effects = by_id[score.effect], [by_id[name] for name in added.effects]
    shapes = {tuple(trial[name] for name in effect.shapes if name in trial): trial for trial in score.trials}
    unbent = {**added.fit.values, **subject.starts, **effect.neutral}
    extended = over_horizons(subject, effects, added, unbent, list(shapes.values()), rival=rival)
    return escaped(subject, effects, extended, rival)


def over_horizons(
    subject: Subject,
    effects: Sequence[Effect],
    fitted: Fitted,
    start: Mapping[str, float],
    trials: Sequence[Mapping[str, float]] = (),
    *,
    rival: float = np.inf,
) -> Fitted:
    """Return a better fit than `fitted`, if that leaves a gap and drifts, and growing horizons lead to one.

    They begin at `start`, and at `trials` from there.
    """
    if fitted.gap <= GAP_THAT_MATTERS or not drifts(subject, fitted):
        return fitted
    near = approached(subject, fitted.fit.unknowns, start, trials)
    return fitted if near is None else _if_better(subject, effects, fitted, [near], rival)


def _if_better(
    subject: Subject,
    effects: Sequence[Effect],
    fitted: Fitted,
    starts: Sequence[Mapping[str, float]],
    rival: float,
) -> Fitted:
    """Refit from the best of the `starts` if a step of the nominal parameters from there promises a better fit."""
    start, promised = _best_start(subject, starts, nominal_basis(fitted.fit, subject.observed))
    most = min(fitted.fit.cost, _HOPELESS * rival)
    if most <= about(promised):
        return fitted
    again = fit_effects(subject, effects, [start], most=most)
    return fitted if again is None or fitted.fit.cost <= about(again.fit.cost) else again


def escaped(subject: Subject, effects: Sequence[Effect], fitted: Fitted, rival: float = np.inf) -> Fitted:
    """Return a better fit of the same `effects`, if a nominal parameter is in a local minimum; otherwise `fitted`.

    A refit that began far from its end may be in a local minimum. Each nominal parameter is set back to its start
    in turn; where a step of the others from there promises less, the refit is repeated.
    """
    for _ in range(_ESCAPES if subject.nominal else 0):
        back = [{**fitted.fit.values, u.name: u.start} for u in subject.nominal]
        before, fitted = fitted, _if_better(subject, effects, fitted, back, rival)
        if fitted is before:
            break
    return fitted


def twins(
    subject: Subject,
    nominal: Fitted,
    fitted: Fitted,
    scores: Sequence[Score],
    known: Collection[frozenset[str]] = (),
    *,
    shaped: bool = False,
) -> list[Fitted]:
    """Refit `fitted` with each of its effects replaced by those that were left out in its favour.

    Effects are indistinguishable as far as their trials say. With `shaped`, only those are taken that have shapes,
    which may fit better than those of their trials. Laws that say the same as a coefficient that varies give the
    name where they fit as well, so the best of them are refitted although their trials differ. What is `known`
    is not refitted.
    """
    refitted_twins = []
    every = [one for score in scores for one in (score, *score.same)]
    for name in fitted.effects:
        same = next((s.same for s in scores if s.effect == name), ())
        chosen = [s for s in same if not shaped or subject.by_id[s.effect].shapes][:_TWINS]
        chosen += [s for s in every if says_the_same(subject.by_id[s.effect], subject.by_id[name])][:_TWINS]
        others = {*fitted.effects} - {name}
        chosen = [s for s in dict.fromkeys(chosen) if s.effect not in fitted.effects]
        fresh = [s for s in chosen if frozenset({*others, s.effect}) not in known]
        if not fresh:
            continue
        rest = nominal if not others else without(subject, fitted, name)
        if rest is not None:
            added = [(add_effect(subject, rest, twin), twin) for twin in fresh]
            refitted_twins += [led_out(subject, fit, twin) for fit, twin in added if fit is not None]
    return refitted_twins


def says_the_same(law: Effect, varying: Effect) -> bool:
    """Return whether a law is how a coefficient of its place varies, or one that its input acts through."""
    return (
        law.port in varying.within
        and (law.over, law.states) == ("", ())
        and law.acts in ("flow", "potential")
        and (re.search(r"\b(p|rate|through)\b", law.expression) is not None or law.law in OF_VALUE)
    )


def _best_start(
    subject: Subject,
    starts: Sequence[Mapping[str, float]],
    basis: FloatArray | None = None,
    near: Mapping[str, float] | None = None,
) -> tuple[Mapping[str, float], float]:
    """Return the start with the least cost, and that cost, which is infinite if none can be simulated.

    With the `basis` of the responses to other parameters, the cost is what a step of these would leave: they may
    have shifted to imitate what the start adds. Runs begin in the states that fit at `near`, or else at the start.
    """
    costs = []
    for outcome in subject.model.predict(starts, near):
        if isinstance(outcome, SimulationError):
            costs.append(np.inf)
            continue
        residual = stack(subject.observed.residuals(outcome), subject.observed)
        residual = residual if basis is None else project_off(residual, basis)
        costs.append(float(residual @ residual))
    best = int(np.argmin(costs))
    return starts[best], costs[best]


def errors_of_the_rest(fitted: Fitted, observed: Observed, nominal: Fitted, scores: Sequence[Score]) -> FloatArray:
    """Return the (P,) errors of a refit's parameters by small effects that its model lacks.

    What a model leaves beyond the noise shows only the part of an unmodelled effect that its parameters cannot
    imitate; the other part is in their estimates. Each effect that was scored at the `nominal` model and is not in
    this one is taken at the size that leaves as much as this model does, with what noise may hide of that (a
    standard deviation of its energy), or at its trial's size if that is less. The variance is the mean over these
    effects.
    """
    jacobian = stack(fitted.fit.jacobian, observed)
    beyond, count = excesses(fitted.fit.residuals, observed)
    hidden = float(np.sqrt(2.0 * count.sum()))
    left = float(np.sqrt(max(float((beyond * count) @ observed.repeats), 0.0) + hidden))
    norms = np.linalg.norm(jacobian, axis=0)
    others = [(s.signature, s.within, s.length) for s in scores if s.effect not in fitted.effects]
    others = others[:: max(len(others) // _OTHERS, 1)]
    variance = np.zeros(len(norms))
    if not others or not norms.any():
        return variance
    seen = norms > 0.0
    columns = jacobian[:, seen] / norms[seen]
    inverse, basis = np.linalg.pinv(columns, rcond=_DETERMINED), nominal_basis(nominal.fit, observed)
    for signature, within, length in others:
        if signature is None or within is None:
            continue
        response = length * signature + basis @ within
        moved = inverse @ response
        shown = float(np.linalg.norm(response - columns @ moved))
        variance[seen] += (min(left / max(shown, 1e-300), 1.0) * moved / norms[seen]) ** 2
    return np.asarray(np.sqrt(variance / len(others)))


def estimates(
    fitted: Fitted, subject: Subject, nominal: Fitted | None = None, scores: Sequence[Score] = ()
) -> dict[str, Estimate]:
    """Return every parameter with its standard error, which is None if the data do not determine it.

    With the `scores` of effects at the `nominal` model, the error includes what the model still lacks.
    """
    (prediction,) = subject.model.predict([fitted.fit.values])  # remembered from the refit
    errors: FloatArray = np.full(len(fitted.fit.unknowns), np.nan)
    if not isinstance(prediction, SimulationError):
        errors = standard_errors(fitted.fit, subject.observed, prediction)
    rest = errors_of_the_rest(fitted, subject.observed, nominal, scores) if nominal is not None else 0.0 * errors
    return {
        u.name: Estimate(fitted.fit.values[u.name])
        if np.isnan(noise)
        else Estimate(fitted.fit.values[u.name], float(np.hypot(noise, lacking)), float(noise))
        for u, noise, lacking in zip(fitted.fit.unknowns, errors, rest, strict=True)
    }
