"""Judging models on experiments that were not used to fit them.

Each experiment is left out in turn. The parameters for the other experiments come from one Gauss-Newton step at
the full estimate (exact for a linear model, and sufficient to distinguish an effect from chance), so a round of
cross-validation costs linear algebra, not simulations. A parameter of a single experiment, or of a machine with no
other experiment, is fitted to that experiment itself, and the loss allows for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fmuid.core.campaign import SEPARATOR
from fmuid.core.immutable import FloatArray, read_only
from fmuid.diagnosis.null_distribution import Null
from fmuid.diagnosis.observed import GAP_THAT_MATTERS, Observed
from fmuid.diagnosis.projection import orthonormal, project_off
from fmuid.diagnosis.refit import Refit

_PRIOR_STEPS = 1e3  # a parameter that the remaining experiments cannot see moves by no more than about this
_ALIKE = 3e-7  # of columns that differ only by rounding; a ridge is lost beside large columns


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Losses of one model on held-out experiments.

    Attributes
    ----------
    loss
        (E,) mean squared whitened residual of a single run of the experiment, beyond the noise floor's 1, over the
        components in its signals' bandwidth.
    per_run
        The same for every single run: one array per experiment.
    size
        (E,) number of components, less the number of parameters fitted to the experiment itself.
    """

    loss: FloatArray
    per_run: tuple[FloatArray, ...]
    size: FloatArray

    @property
    def mean(self) -> float:
        """Mean loss over all components."""
        return float(np.average(self.loss, weights=self.size))

    @property
    def gap(self) -> float:
        """Gap in floors over all experiments."""
        return float(np.sqrt(max(0.0, self.mean)))


def leave_each_out(fit: Refit, observed: Observed, *, within_errors: bool = False) -> HeldOut:
    """Return the losses of `fit` with each experiment (or piece of one) predicted from the others.

    With `within_errors`, a prediction may miss by as much as the other experiments leave its parameters uncertain:
    residuals are whitened with their predictive covariance. What only one experiment shows is then no evidence
    against a model that fits it; what the others contradict is.
    """
    steps = np.array([u.step for u in fit.unknowns])
    lower = np.array([u.lower for u in fit.unknowns])
    upper = np.array([u.upper for u in fit.unknowns])
    x = np.array([fit.values[u.name] for u in fit.unknowns])
    inside = (x > lower + 1e-6 * steps) & (x < upper - 1e-6 * steps)
    parts = [fit.jacobian[e][rows][:, inside] * steps[inside] for e, rows in observed.folds]
    residuals = [fit.residuals[e][rows] for e, rows in observed.folds]
    repeats = [observed.repeats[e] for e, _ in observed.folds]
    # What an experiment says about the parameters, as few rows of equations, and the residuals they should cancel.
    equations = [
        np.linalg.qr(np.sqrt(n) * np.column_stack([p, -r]), mode="r")
        for n, p, r in zip(repeats, parts, residuals, strict=True)
    ]
    prior = np.eye(int(inside.sum()), int(inside.sum()) + 1) / _PRIOR_STEPS
    of_one = np.array([SEPARATOR in u.name for u in fit.unknowns], dtype=bool)[inside]
    seen = np.array([p.any(axis=0) for p in parts])
    predicted, taken = [], []
    for k, group in enumerate(observed.groups):
        out = np.array(observed.groups) == group
        others = np.vstack([prior, *(equations[i] for i in np.flatnonzero(~out))])
        left = residuals[k] + parts[k] @ _solved(others)
        if within_errors:
            left = _standardised(left, np.sqrt(repeats[k]) * parts[k] @ _spread(others))
        basis = orthonormal(parts[k][:, of_one & seen[k] & ~seen[~out].any(axis=0)])
        predicted.append(project_off(left, basis))
        taken.append(basis)
    return losses(predicted, observed, taken)


def _solved(equations: FloatArray) -> FloatArray:
    """Return the least-squares solution of equations, zero along directions that they do not determine."""
    rows, right = equations[:, :-1], equations[:, -1]
    scale = np.linalg.norm(rows, axis=0)
    return np.asarray(np.linalg.lstsq(rows / scale, right, rcond=_ALIKE)[0] / scale)


def _spread(equations: FloatArray) -> FloatArray:
    """Return a square root of the covariance of the solution of equations whose errors have variance 1."""
    rows = equations[:, :-1]
    scale = np.linalg.norm(rows, axis=0)
    _, s, v = np.linalg.svd(rows / scale, full_matrices=False)
    known = s > _ALIKE * s.max(initial=0.0)
    return np.asarray(v[known].T / s[known] / scale[:, None])


def _standardised(residual: FloatArray, spread: FloatArray) -> FloatArray:
    """Return a residual of covariance (I + S S') v as one of covariance v; `spread` is S, (M, P)."""
    u, s, _ = np.linalg.svd(spread, full_matrices=False)
    return np.asarray(residual - u @ ((1.0 - 1.0 / np.sqrt(1.0 + s**2)) * (u.T @ residual)))


def in_sample(fit: Refit, observed: Observed) -> HeldOut:
    """Return the losses of `fit` on the experiments that it was fitted to, fold by fold."""
    return losses([fit.residuals[e][rows] for e, rows in observed.folds], observed)


def losses(
    residuals: Sequence[FloatArray], observed: Observed, taken: Sequence[FloatArray] | None = None
) -> HeldOut:
    """Return the losses of whitened residuals of the mean runs, one per fold.

    `taken` are orthonormal bases of the parameters that were fitted to each fold itself.
    """
    per_run, loss, size = [], [], []
    for k, (whole, (e, rows)) in enumerate(zip(residuals, observed.folds, strict=True)):
        run, band = observed.runs[e], observed.in_band[e][rows]
        r = whole[band]
        deviation = observed.scatter[e][:, rows][:, band]
        # residual of run k = residual of the mean - its deviation from the mean
        per_run.append(read_only(np.mean((r - deviation) ** 2, axis=1) - 1.0))
        fitted = observed.taken[e][rows][band].sum() + (0.0 if taken is None else np.sum(taken[k][band] ** 2))
        left = r.size - float(fitted)
        loss.append(float(r @ r) / left - 1.0 / run.n_repeats)
        size.append(left)
    return HeldOut(read_only(np.array(loss)), tuple(per_run), read_only(np.array(size)))


class _WithGap(Protocol):
    @property
    def gap(self) -> float: ...


def closure(before: _WithGap, after: _WithGap) -> float:
    """Return the share of the gap that is closed: of models where they are fitted, or of losses."""
    return share_closed(before.gap, after.gap)


def share_closed(before: float, after: float) -> float:
    """Return 1 - G1/G0, the share of a gap that is closed; 0 if there was no gap."""
    return 1.0 - after / before if before > 0.0 else 0.0


def closure_interval(
    before: HeldOut,
    after: HeldOut,
    *,
    null: Null | None = None,
    level: float = 0.9,
    draws: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """Return a bootstrap interval of the closure: experiments are drawn, and runs within experiments.

    It is the shortest one that holds the share `level` of the draws: a closure ends at 1, where many of them are.

    With `null`, what noise alone would leave, the interval is for a single new experiment, whose remaining gap
    cannot be measured more precisely; otherwise for as many as were measured. Draws that show no gap that matters
    do not count, since there is nothing to close in them; the interval is (0, 0) if there are no others.
    """
    rng = np.random.default_rng(seed)
    n = len(before.loss)
    b, a = np.empty((n, draws)), np.empty((n, draws))  # loss of every fold for every draw of its runs
    for e, (own, other) in enumerate(zip(before.per_run, after.per_run, strict=True)):
        pick = rng.integers(0, len(own), (draws, len(own)))
        b[e] = before.loss[e] + own[pick].mean(axis=1) - own.mean()
        a[e] = after.loss[e] + other[pick].mean(axis=1) - other.mean()
    folds, further = n, np.zeros(1)
    if null is not None:  # an experiment may consist of several folds, if runs were cut
        folds, further = (
            round(n / null.experiments),
            rng.choice(null.of_experiment - null.of_experiment.mean(), draws),
        )
    times = rng.multinomial(folds, np.full(n, 1.0 / n), size=draws).T * before.size[:, None]
    was, left = (
        np.sqrt(np.maximum(0.0, np.sum(times * x, axis=0) / np.sum(times, axis=0) + further)) for x in (b, a)
    )
    shown = was > (0.0 if null is None else GAP_THAT_MATTERS)
    if not shown.any():
        return 0.0, 0.0
    drawn = np.sort(1.0 - left[shown] / was[shown])
    kept = max(round(level * len(drawn)), 1)
    first = int(np.argmin(drawn[kept - 1 :] - drawn[: len(drawn) - kept + 1]))
    return float(drawn[first]), float(drawn[first + kept - 1])


def advantage(better: HeldOut, worse: HeldOut) -> tuple[float, float]:
    """Return the mean difference of losses (worse - better) and its standard error over the runs.

    Experiments are not a sample from a population: an effect that only one of them shows is just as real. What is
    random is the recorded runs, or pieces of runs if none was repeated.
    """
    size = better.size / better.size.sum()
    difference = (worse.loss - better.loss) * size
    if all(len(a) < 2 for a in worse.per_run):
        n = len(difference)
        spread = n / max(n - 1, 1) * float(np.sum((difference - difference.mean()) ** 2))
        return float(difference.sum()), float(np.sqrt(spread))
    variance = 0.0
    for share, a, b in zip(size, worse.per_run, better.per_run, strict=True):
        if len(a) > 1:
            variance += float(share**2 * np.var(a - b, ddof=1) / len(a))
    return float(difference.sum()), float(np.sqrt(variance))
