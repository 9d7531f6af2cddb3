"""Where an unknown effect enters: an arbitrary course over time at each port, in each experiment for itself.

Whatever a hidden effect depends on, to the model it is a flow that acts somewhere over time, or a sensor's error.
A Gaussian process is put on that course at one port after the other. The port whose responses explain what the
model leaves with the smallest and smoothest course has the largest marginal likelihood (latent force models:
Alvarez, Luengo and Lawrence 2009).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.decide import OPEN, log_evidence, spread
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.ports import hats, moved_by
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import nominal_basis
from fmuid.effects.effect import Port

_KNOTS = (24, 70)  # of a course in each experiment; the finer ones if the coarser ones leave too much
_ENOUGH = 0.75  # share of the excess energy that a course has to explain for its port to be judged by it
_ALL = 0.95  # of that energy: a single place accounts for nearly all
_LENGTHS = (0.0, 1.0, 3.0)  # knots over which a course may be smooth
_SIZES = np.geomspace(1e-4, 1e4, 33)  # standard deviation of a course, in units of the port's magnitude


@dataclass(frozen=True, slots=True)
class Entry:
    """What a course over time at a port explains.

    Attributes
    ----------
    evidence
        Logarithm of the marginal likelihood ratio of a course at its best size and smoothness to none.
    step
        Logarithm of the likelihood ratio that a linear step of the nominal parameters gains without a course:
        above 0 if they are at bounds, or not quite at the optimum.
    left
        Remaining energy beyond that of the noise, relative to it.
    explained
        Share of that energy which the course explains.
    """

    evidence: float
    step: float
    left: float
    explained: float

    @property
    def closure(self) -> float:
        """Share of the gap that the course closes."""
        return 1.0 - float(np.sqrt(1.0 - self.explained))


def places(found: Mapping[str, Entry]) -> tuple[str, ...]:
    """Return the ports at which a course explains what a model leaves, the likeliest first.

    Named are those that the data cannot tell from the likeliest one, because the odds against them are short. None
    is named if no course explains anything.
    """
    order = sorted(found, key=lambda name: -found[name].evidence)
    if not order or found[order[0]].evidence <= np.log(OPEN):
        return ()
    best = found[order[0]]
    return tuple(name for name in order if not _beaten(found[name].evidence, best))


def likelier(found: Mapping[str, Entry], nominal: Fitted, named: Fitted) -> bool:
    """Return whether a course at one port explains what `nominal` leaves far better than `named` does.

    It has to account for nearly all of it: a course at the place of one cause imitates a part of another one.
    """
    best = max(found.values(), key=lambda e: e.evidence, default=None)
    if best is None or best.explained < _ALL:
        return False
    return _beaten(log_evidence(nominal, named) - best.step, best)  # both with the nominal parameters fitted


def _beaten(evidence: float, best: Entry) -> bool:
    """Return whether the odds of `best` against something with this evidence are long."""
    return best.evidence - evidence >= float(np.log(OPEN)) * spread(best.left) ** 2


def entries(model: CampaignModel, observed: Observed, base: Refit, ports: Sequence[Port]) -> dict[str, Entry]:
    """Return the part of the residuals of `base` that a course over time explains, at every simulated port."""
    coarse, fine = (np.linspace(0.0, 1.0, knots) for knots in _KNOTS)
    found = with_knots(model, observed, base, ports, coarse)
    if any(e.explained >= _ENOUGH for e in found.values()):
        return found
    return with_knots(model, observed, base, ports, fine, among=coarse)


def with_knots(
    model: CampaignModel,
    observed: Observed,
    base: Refit,
    ports: Sequence[Port],
    at: FloatArray,
    *,
    among: FloatArray | None = None,
) -> dict[str, Entry]:
    """Return the explanation by a course with knots `at` shares of a run, at every simulated port.

    If responses to a course with only the knots `among` these are known, they are used again: with those to the
    other knots, they span the same responses (hierarchical basis).
    """
    since = [case.time - case.time[0] for case in model.cases]
    knots, shares = len(at), [t / float(t[-1]) for t in since]
    courses, nodal = hats(shares, at), np.eye(knots)
    if among is not None:
        known = np.abs(at[:, None] - among).min(axis=1) < 1e-9
        courses = (*hats(shares, among), *(c for c, old in zip(courses, known, strict=True) if not old))
        nodal = np.linalg.inv(np.vstack([[h for (h,) in hats([at], among)], nodal[~known]]).T)
    weights = np.sqrt(observed.repeats)
    residuals = [w * r for w, r in zip(weights, base.residuals, strict=True)]
    basis = nominal_basis(base, observed)
    parts = np.split(basis, np.cumsum([len(r) for r in residuals])[:-1])
    fitted = sum((q.T @ r for q, r in zip(parts, residuals, strict=True)), np.zeros(basis.shape[1]))
    step = float(fitted @ fitted)
    energy = float(sum(r @ r for r in residuals)) - step
    count = sum(len(r) for r in residuals) - basis.shape[1]
    found = {}
    for port in ports:
        moved = [m for m in moved_by(model, observed, base, port, courses) if m is not None]
        if len(moved) < knots:
            continue
        columns = [w * np.stack(m, axis=1) for w, m in zip(weights, zip(*moved, strict=True), strict=True)]
        shared = np.hstack([q.T @ c @ nodal for q, c in zip(parts, columns, strict=True)])
        gram = block_diag(*(nodal.T @ (c.T @ c) @ nodal for c in columns)) - shared.T @ shared
        own = [nodal.T @ (c.T @ r) for c, r in zip(columns, residuals, strict=True)]
        slope = np.concatenate(own) - shared.T @ fitted
        evidence, explained = max(_evidence(gram, slope, knots, length) for length in _LENGTHS)
        left = max(0.0, (energy - explained) / count - 1.0)
        found[port.name] = Entry(evidence, 0.5 * step, left, 1.0 - left / max(energy / count - 1.0, left, 1e-12))
    return found


def _evidence(gram: FloatArray, slope: FloatArray, knots: int, length: float) -> tuple[float, float]:
    """Return the log evidence of courses of one smoothness, at their best size, and the energy they explain."""
    apart = np.subtract.outer(np.arange(knots), np.arange(knots))
    prior = np.exp(-0.5 * (apart / length) ** 2) + 1e-6 * np.eye(knots) if length else np.eye(knots)
    root = block_diag(*[np.linalg.cholesky(prior)] * (len(slope) // knots))
    values, vectors = np.linalg.eigh(root.T @ gram @ root)
    values, along = np.maximum(values, 0.0), (vectors.T @ (root.T @ slope)) ** 2
    gained = _SIZES[:, None] ** 2 / (1.0 + _SIZES[:, None] ** 2 * values)
    evidence = 0.5 * np.sum(gained * along - np.log1p(_SIZES[:, None] ** 2 * values), axis=1)
    best = int(np.argmax(evidence))
    return float(evidence[best]), float(np.sum(along * gained[best] * (2.0 - gained[best] * values)))
