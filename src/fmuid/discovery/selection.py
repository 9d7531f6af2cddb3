"""Sparse selection of a few library terms that explain the residual, by linear least squares.

The response of the signals to each term is simulated: the model's input at the port is driven by the term along
the model's own trajectory. A few terms are chosen by forward selection, fitted together with the parameters, and
judged on held-out experiments. Each must do more than noise alone would make any term of the library do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import qr

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis import decide
from fmuid.diagnosis.cross_validation import HeldOut, NoiseDraws
from fmuid.diagnosis.free_functions import Response, fit_decoys, moved_by
from fmuid.diagnosis.observed import project_off
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import nominal_basis, stack
from fmuid.diagnosis.subject import Subject
from fmuid.discovery.places import Spot
from fmuid.discovery.terms import Term
from fmuid.effects.effect import Effect

DRIVEN = 0.05  # size at which a term's response is taken, as a share of the flow at the port
_NEAR = 0.02  # of a course, beyond its linear terms: what a sum of others may leave of it
_JUDGED = 40  # terms per place that are judged on held-out experiments
_INSTEAD = 6  # terms that are tried in place of a law
_BEGUN, _PARTNERS = 6, 4  # terms from which pairs are made, and partners tried for each
_BESIDE = 6  # terms for each trial of an effect that are judged together with it


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """Terms at a place with their coefficients (flows), maybe together with an effect at its values."""

    spot: Spot
    terms: tuple[Term, ...]
    sizes: tuple[float, ...]
    beside: str = field(default="", kw_only=True)
    values: Mapping[str, float] = field(default_factory=dict, kw_only=True)

    @property
    def members(self) -> int:
        """Number of terms and effects."""
        return len(self.terms) + bool(self.beside)


@dataclass(frozen=True, slots=True, eq=False)
class Chosen(Proposal):
    """A proposal with its losses on held-out experiments.

    `drop` is the fall of the cost on the experiments that it was fitted to.
    """

    held_out: HeldOut
    drop: float


@dataclass(frozen=True, slots=True, eq=False)
class _Column:
    term: Term
    amounts: FloatArray  # (D,) of the driven responses that the response to the term is a sum of
    driven: tuple[FloatArray, ...]  # (D, M) in each experiment
    signature: FloatArray  # of unit length, with the response to the fitted parameters projected off
    drop: float

    @property
    def parts(self) -> tuple[FloatArray, ...]:
        """(M, 1) response in each experiment."""
        return tuple((self.amounts @ responses)[:, None] for responses in self.driven)


@dataclass(frozen=True, slots=True, eq=False)
class Beside:
    """The response to a trial of an effect: (M, 1) in each experiment, and its signature as of a term."""

    effect: Effect
    trial: Mapping[str, float]
    parts: tuple[FloatArray, ...]
    signature: FloatArray


def responses_to(subject: Subject, base: Refit, effects: Sequence[Effect]) -> list[Beside]:
    """Return the responses to all trials of effects that can be seen next to the fitted parameters."""
    observed, basis = subject.observed, nominal_basis(base, subject.observed)
    trials = [(e, trial) for e in effects for trial in e.trials]
    outcomes = subject.model.predict([{**base.values, **e.neutral, **trial} for e, trial in trials])
    seen = []
    for (effect, trial), outcome in zip(trials, outcomes, strict=True):
        if isinstance(outcome, SimulationError):
            continue
        after = observed.residuals(outcome)
        parts = tuple((a - b)[:, None] for a, b in zip(after, base.residuals, strict=True))
        signature = project_off(stack(parts, observed)[:, 0], basis)
        if (length := float(np.linalg.norm(signature))) > 1.0:
            seen.append(Beside(effect, trial, parts, signature / length))
    return seen


def choose(
    subject: Subject,
    base: Refit,
    spot: Spot,
    noise: NoiseDraws,
    *,
    pairs: bool = True,
    beside: Sequence[Beside] = (),
) -> list[Chosen]:
    """Return single terms and pairs of them that explain what `base` leaves, the best of each family.

    Terms are also paired with each of the effects `beside` them: neither needs to explain anything alone.
    """
    observed = subject.observed
    columns = _columns(subject, base, spot)
    if not columns:
        return []
    basis = nominal_basis(base, observed)
    residual = stack(base.residuals, observed)
    signatures = np.array([c.signature for c in columns])
    threshold = noise.null(basis, [*signatures, *(e.signature for e in beside)]).threshold()
    threshold *= decide.SCORE_MARGIN
    with_effects = []
    for effect in beside:
        alone = float(effect.signature @ residual)
        shared = signatures @ effect.signature
        new = (signatures @ residual - shared * alone) ** 2 / np.maximum(1.0 - shared**2, 1e-6)
        drops = new + alone**2
        useful = (new >= threshold) & (drops - [c.drop for c in columns] >= threshold)
        for k in [k for k in np.argsort(-drops) if useful[k]][:_BESIDE]:
            with_effects.append(_judged(subject, base, spot, [columns[k]], float(drops[k]), beside=effect))
    columns = sorted((c for c in columns if c.drop >= threshold), key=lambda c: -c.drop)
    chosen = _best_of_families([_judged(subject, base, spot, [c], c.drop) for c in columns[:_JUDGED]])
    by_term = {id(c.term): c for c in columns}
    for first in sorted(chosen, key=lambda f: f.held_out.mean)[: _BEGUN if pairs else 0]:
        column = by_term[id(first.terms[0])]
        left = project_off(residual, column.signature[:, None])
        partners = sorted(
            ((_drop_beside(column, c, left), c) for c in columns if c is not column), key=lambda pair: -pair[0]
        )
        families = {column.term.family}
        for drop, partner in partners:
            if drop < threshold or len(families) > _PARTNERS:
                break
            if partner.term.family not in families:
                families.add(partner.term.family)
                chosen.append(_judged(subject, base, spot, [column, partner], column.drop + drop))
    return _best_of_families([*chosen, *with_effects])


def instead(spot: Spot, flow: Sequence[FloatArray]) -> list[Proposal]:
    """Return single terms that come near a flow at a place, the nearest of each family, and its linear terms.

    Parameters
    ----------
    spot
        The place, along the trajectories of the model that has the flow.
    flow
        (N,) in every experiment.
    """
    target = np.concatenate(flow)
    basis = np.linalg.qr(np.stack([np.concatenate(one) for one in _linear(spot)], axis=1))[0]
    target = project_off(target, basis)
    nearest: dict[str, tuple[float, Proposal]] = {}
    for term in spot.terms:
        course = term.whole_course(spot.courses, spot.time)
        remaining = project_off(course, basis)
        length = float(np.linalg.norm(remaining))
        if length > 1e-3 * float(np.linalg.norm(course)):
            size = float(remaining @ target) / length**2
            left = float(np.linalg.norm(target - size * remaining))
            if left < nearest.get(term.family, (np.inf,))[0]:
                nearest[term.family] = left, Proposal(spot, (term,), (size,))
    return [proposal for _, proposal in sorted(nearest.values(), key=lambda pair: pair[0])[:_INSTEAD]]


def _columns(subject: Subject, base: Refit, spot: Spot) -> list[_Column]:
    observed, model = subject.observed, subject.model
    port = replace(subject.catalogue.ports[spot.port.name], magnitude=DRIVEN * spot.flow)
    assert port.input is not None
    time = [case.time for case in model.cases]
    courses = tuple(tuple(t.course(c, s) for c, s in zip(spot.courses, time, strict=True)) for t in spot.terms)
    basis, residual = nominal_basis(base, observed), stack(base.residuals, observed)
    linear = _linear(spot)
    chosen, sums = spanning(*(np.array([np.concatenate(c) for c in every]) for every in (courses, linear)))
    moved = moved_by(model, observed, base, port, (*linear, *(courses[k] for k in chosen)))
    works = [m for m in moved if m is not None]
    if not works:
        return []
    fails = np.array([m is None for m in moved])
    driven = tuple(map(np.stack, zip(*works, strict=True)))
    usable = np.all(sums[:, fails] == 0.0, axis=1)
    amounts = sums[usable][:, ~fails]
    whole = stack([(amounts @ responses).T for responses in driven], observed)
    signatures = np.ascontiguousarray(project_off(whole, basis).T)
    lengths = np.linalg.norm(signatures, axis=1)
    seen = (lengths > 1e-3 * np.linalg.norm(whole, axis=0)) & (lengths > 1.0)
    signatures /= np.where(seen, lengths, 1.0)[:, None]
    drops = (signatures @ residual) ** 2
    terms = [spot.terms[k] for k in np.flatnonzero(usable)]
    return [_Column(terms[k], amounts[k], driven, signatures[k], float(drops[k])) for k in np.flatnonzero(seen)]


def _linear(spot: Spot) -> list[tuple[FloatArray, ...]]:
    """Return the linear terms at a place: a constant and its quantities, of size 1."""
    names = spot.nearby or spot.courses[0]
    sizes = {n: max(float(np.abs(c[n]).max()) for c in spot.courses) or 1.0 for n in names}
    constant = tuple(np.ones(len(t)) for t in spot.time)
    return [constant, *(tuple(c[n] / size for c in spot.courses) for n, size in sizes.items())]


def spanning(courses: FloatArray, linear: FloatArray) -> tuple[list[int], FloatArray]:
    """Choose courses whose linear combinations, with those of `linear` ones, come near every course.

    The response to a course is linear in it, so the others need not be simulated (interpolative decomposition by
    QR with pivots; Cheng, Gimbutas, Martinsson and Rokhlin, SIAM J. Sci. Comput. 26, 2005).

    Parameters
    ----------
    courses, linear
        (T, N) and (L, N).

    Returns
    -------
    chosen
        Rows of `courses`.
    sums
        (T, L + chosen) coefficients of every course; those of a chosen one are 1 and 0.
    """
    rest = courses - np.linalg.lstsq(linear.T, courses.T, rcond=None)[0].T @ linear
    size = np.linalg.norm(rest, axis=1)
    kept = size > 1e-9 * np.linalg.norm(courses, axis=1)
    scale = np.where(kept, size, 1.0)
    triangle, order = qr((rest / scale[:, None] * kept[:, None]).T, mode="r", pivoting=True)
    chosen = [int(k) for k in order[: int(np.count_nonzero(np.abs(np.diag(triangle)) > _NEAR))]]
    every = np.vstack([linear, courses[chosen]])
    sums = np.asarray(np.linalg.lstsq(every.T, courses.T, rcond=None)[0].T, dtype=np.float64)
    sums[chosen] = np.eye(len(every))[len(linear) :]
    return chosen, sums


def _drop_beside(first: _Column, second: _Column, left: FloatArray) -> float:
    """Return the fall of the cost by a second term, beyond what the first one achieves."""
    new = second.signature - first.signature * float(first.signature @ second.signature)
    length = float(np.linalg.norm(new))
    return float(new @ left / length) ** 2 if length > 1e-3 else 0.0


def _judged(
    subject: Subject,
    base: Refit,
    spot: Spot,
    columns: Sequence[_Column],
    drop: float,
    *,
    beside: Beside | None = None,
) -> Chosen:
    every = [c.parts for c in columns] + ([beside.parts] if beside else [])
    joined = tuple(np.hstack(parts) for parts in zip(*every, strict=True))
    (decoy,) = fit_decoys([Response("law", joined)], base, subject.observed)
    sizes = tuple(DRIVEN * spot.flow * float(a) for a in decoy.amounts[: len(columns)])
    chosen = Chosen(spot, tuple(c.term for c in columns), sizes, decoy.held_out, drop)
    if beside is None:
        return chosen
    values = beside.effect.scaled(beside.trial, decoy.amounts[-1])
    return replace(chosen, beside=beside.effect.id, values=values)


def _best_of_families(candidates: Sequence[Chosen]) -> list[Chosen]:
    best: dict[frozenset[str], Chosen] = {}
    for one in candidates:
        family = frozenset((one.beside, *(t.family for t in one.terms)))
        if family not in best or one.held_out.mean < best[family].held_out.mean:
            best[family] = one
    return list(best.values())
