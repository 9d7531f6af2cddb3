"""Scores: how much of the residual each effect could explain that refitting the nominal parameters cannot.

One finite-step simulation a trial magnitude gives an effect's signature. What the nominal parameters can imitate
is projected off it, in units of noise; what remains is held against the residual. Finite steps matter: the
gradient of backlash or saturation at their neutral value is zero. (A score test, Rao 1948, with finite steps.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.catalogue import Effect
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Predict, Refit


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """What one effect could explain.

    Attributes
    ----------
    trial
        The plausible values that did best.
    drop
        By how much the cost would fall if the signature were scaled to fit.
    scale
        That factor on the trial's signature.
    per_run
        Drop over its own run-to-run standard error: how many of them the mean over runs is above zero.
    signature
        The trial's projected signature, of unit length; None if it does not move any signal.
    """

    effect: str
    trial: Mapping[str, float]
    drop: float
    scale: float
    per_run: float
    signature: FloatArray | None


def stack(parts: Sequence[FloatArray], observed: Observed) -> FloatArray:
    """Join whitened vectors (or matrices) of all experiments, each weighted by the root of its repeats."""
    return np.asarray(np.concatenate([np.sqrt(n) * p for n, p in zip(observed.repeats, parts, strict=True)]))


def nominal_basis(base: Refit, observed: Observed) -> FloatArray:
    """Return an orthonormal basis of what the refitted parameters can do to the predictions."""
    jacobian = stack(base.jacobian, observed)
    norms = np.linalg.norm(jacobian, axis=0)
    kept = jacobian[:, norms > 0] / norms[norms > 0]
    if kept.shape[1] == 0:
        return np.asarray(kept)
    u, s, _ = np.linalg.svd(kept, full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * s[0]])


def project_off(vector: FloatArray, basis: FloatArray) -> FloatArray:
    """Return `vector` less its part in the span of `basis`."""
    return np.asarray(vector - basis @ (basis.T @ vector))


def score_effects(
    predict: Predict, observed: Observed, base: Refit, effects: Sequence[Effect]
) -> tuple[Score, ...]:
    """Score every effect at the refitted model `base`, best first, without trials that fail to simulate."""
    trials = [(effect, trial) for effect in effects for trial in effect.trials]
    outcomes = predict([{**base.values, **trial} for _, trial in trials])
    basis = nominal_basis(base, observed)
    residual = stack(base.residuals, observed)
    best: dict[str, Score] = {}
    for (effect, trial), outcome in zip(trials, outcomes, strict=True):
        if isinstance(outcome, SimulationError):
            continue
        moved = stack(observed.residuals(outcome), observed) - residual
        signature = project_off(moved, basis)
        length = float(np.linalg.norm(signature))
        if length <= 1e-6 * max(1.0, float(np.linalg.norm(moved))):
            candidate = Score(effect.id, trial, 0.0, 0.0, 0.0, None)
        else:
            signature /= length
            amount = -float(signature @ residual)
            drop = amount**2 if amount > 0 or effect.two_sided else 0.0
            candidate = Score(
                effect.id, trial, drop, amount / length, _per_run(signature, amount, observed), signature
            )
        if effect.id not in best or candidate.drop > best[effect.id].drop:
            best[effect.id] = candidate
    for effect in effects:
        best.setdefault(effect.id, Score(effect.id, {}, 0.0, 0.0, 0.0, None))
    return tuple(sorted(best.values(), key=lambda s: -s.drop))


def _per_run(signature: FloatArray, amount: float, observed: Observed) -> float:
    """Return amount over its standard error from run to run, moderated towards that of the noise floor (1)."""
    total, dof, begin = 0.0, 0.0, 0
    for run, w in zip(observed.runs, observed.whiteners, strict=True):
        part = signature[begin : begin + w.size]
        begin += w.size
        if run.n_repeats < 2:
            continue
        each = w(run.deviations).reshape(run.n_repeats, -1) @ part
        total += float(each @ each)
        dof += run.n_repeats - 1
        # Each run's projection has variance |part|^2 under the floor; they sum to (R - 1) over the experiments.
    prior = 4.0
    n = len(observed.runs)
    variance = (total * n / max(dof, 1.0) * dof / n + prior) / (dof / n + prior) if dof else 1.0
    return amount / float(np.sqrt(max(variance, 1e-12)))


def similarity(a: FloatArray, b: FloatArray) -> float:
    """Return the canonical correlation of two signatures of unit length."""
    return float(abs(a @ b))


def alias_classes(signatures: Mapping[str, FloatArray], *, threshold: float = 0.95) -> tuple[tuple[str, ...], ...]:
    """Group effects whose projected signatures these sensors and experiments cannot tell apart.

    Effects are joined when their canonical correlation exceeds `threshold`; classes of one are left out.
    """
    names = list(signatures)
    group = {name: {name} for name in names}
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            if similarity(signatures[a], signatures[b]) > threshold:
                joined = group[a] | group[b]
                for name in joined:
                    group[name] = joined
    classes = {tuple(sorted(g)) for g in group.values() if len(g) > 1}
    return tuple(sorted(classes))
