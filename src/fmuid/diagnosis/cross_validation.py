"""Judging models on experiments that were not used to fit them.

Each experiment is left out in turn. The parameters for the other experiments come from a Gauss-Newton step at the
full estimate, which a simulation of the experiment left out has to confirm; otherwise, they are refitted. A
parameter of a single experiment, or of a machine with no other experiment, is fitted to that experiment itself,
and the loss allows for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fmuid.core.campaign import SEPARATOR
from fmuid.core.immutable import FloatArray, read_only
from fmuid.diagnosis.null_distribution import Null
from fmuid.diagnosis.observed import GAP_THAT_MATTERS, Observed
from fmuid.diagnosis.projection import orthonormal, project_off
from fmuid.diagnosis.refit import Refit

_PRIOR_STEPS = 1e3  # a parameter that the remaining experiments cannot see moves by no more than about this
_CONFIRMED = 1.1  # energy of a simulated residual, relative to the predicted one, up to which a linear step holds
_CHORDS = 6  # steps of a refit without an experiment
_HALVINGS = 5  # of a step
_SETTLED = 0.5  # fall of the cost, in squared standard deviations, that ends a refit
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


def leave_each_out(
    fit: Refit,
    observed: Observed,
    *,
    within_errors: bool = False,
    predictions: Sequence[FloatArray] | None = None,
) -> HeldOut:
    """Compute the losses of `fit` with each experiment (or piece of one) predicted from the others.

    Parameters
    ----------
    within_errors
        A prediction may miss by as much as the other experiments leave its parameters uncertain: residuals are
        whitened with their predictive covariance. What only one experiment shows is then no evidence against a
        model that fits it; what the others contradict is.
    predictions
        Whitened residuals of each fold at the parameters of the other experiments (`predicted_left_out`); by
        default, those of a linear step.
    """
    steps = _Steps.of(fit, observed)
    seen = np.array([p.any(axis=0) for p in steps.parts])
    predicted, taken = [], []
    for k in range(len(observed.folds)):
        out = steps.out(k)
        others = steps.others(out)
        scaled = steps.parts[k]
        left = steps.residuals[k] + scaled @ _solved(others) if predictions is None else predictions[k]
        if within_errors:
            left = _standardised(left, np.sqrt(steps.repeats[k]) * scaled @ _spread(others))
        basis = orthonormal(scaled[:, steps.of_one & seen[k] & ~seen[~out].any(axis=0)])
        predicted.append(project_off(left, basis))
        taken.append(basis)
    return losses(predicted, observed, taken)


def predicted_left_out(fit: Refit, observed: Observed, model: _Predicts) -> LeftOutFit:
    """Simulate each fold at parameters that are refitted to the other experiments.

    One linear step gives the parameters, within their bounds. Where the simulation does not confirm what the step
    predicts, further steps follow, each shortened until it lowers the cost of the other experiments, until none
    does (chord method: the Jacobian of the full estimate is kept).

    """
    steps = _Steps.of(fit, observed)
    solved = {group: _solved(steps.others(steps.groups == group)) for group in dict.fromkeys(observed.groups)}
    points = {group: steps.moved(move) for group, move in solved.items()}
    wanted = [(e, points[group]) for (e, _), group in zip(observed.folds, observed.groups, strict=True)]
    found: list[FloatArray | None] = []
    for k, outcome in enumerate(model.residuals_of(wanted, observed)):
        linear = steps.residuals[k] + steps.parts[k] @ solved[observed.groups[k]]
        part = None if outcome is None else outcome[observed.folds[k][1]]
        found.append(part if part is not None and _confirmed(part, linear) else None)
    residuals: dict[int, tuple[FloatArray, ...]] = {}  # of all experiments, by the group that a refit left out
    for k, part in enumerate(found):
        group, (e, rows) = observed.groups[k], observed.folds[k]
        if part is None and group not in residuals:
            points[group], residuals[group] = _refitted_without(steps, steps.out(k), observed, model)
        if part is None:
            found[k] = residuals[group][e][rows]
    return LeftOutFit(
        tuple(points[group] for group in observed.groups), tuple(part for part in found if part is not None)
    )


@dataclass(frozen=True, slots=True, eq=False)
class LeftOutFit:
    """For each fold, the parameters refitted to the other experiments, and its whitened residual there."""

    values: tuple[Mapping[str, float], ...]
    residuals: tuple[FloatArray, ...]


def _confirmed(simulated: FloatArray, linear: FloatArray) -> bool:
    """Whether a simulation leaves no more than a linear step predicts, within a tenth of the energy."""
    return float(simulated @ simulated) <= _CONFIRMED * max(float(linear @ linear), linear.size)


def _refitted_without(
    steps: _Steps, out: NDArray[np.bool_], observed: Observed, model: _Predicts
) -> tuple[dict[str, float], tuple[FloatArray, ...]]:
    """Return the parameters refitted to the folds that are not `out`, and the residuals of every experiment."""
    inside = [k for k in range(len(out)) if not out[k]]

    def cost(residuals: Sequence[FloatArray]) -> float:
        return sum(
            float(steps.repeats[k] * (r @ r))
            for k in inside
            for r in [residuals[observed.folds[k][0]][observed.folds[k][1]]]
        )

    here, step = list(steps.fit.residuals), np.zeros(steps.parts[0].shape[1])
    for _ in range(_CHORDS):
        now = [here[e][rows] for e, rows in observed.folds]
        further = _solved(steps.others(out, now, step))
        lengths = [0.5**n for n in range(_HALVINGS)]
        points = [steps.moved(step + length * further) for length in lengths]
        better = next(
            (
                (length, r)
                for length, point in zip(lengths, points, strict=True)
                if (r := model.residuals_at(point, observed)) is not None and cost(r) < cost(here)
            ),
            None,
        )
        if better is None:
            break
        gained = cost(here) - cost(better[1])
        step, here = step + better[0] * further, list(better[1])
        if gained < _SETTLED:
            break
    return steps.moved(step), tuple(here)


class _Predicts(Protocol):
    """Simulates left-out experiments; None stands for a simulation that fails."""

    def residuals_of(
        self, wanted: Sequence[tuple[int, Mapping[str, float]]], observed: Observed
    ) -> list[FloatArray | None]:
        """Return the whitened residual of each wanted experiment, by its number, at some values."""
        ...

    def residuals_at(self, values: Mapping[str, float], observed: Observed) -> tuple[FloatArray, ...] | None:
        """Return the whitened residuals of all experiments."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """Linear steps of the parameters that are inside their bounds, in units of their steps.

    `parts` and `residuals` are the Jacobian's rows and the residuals of each fold; `factors` are the QR
    decompositions of the former, weighted by the root of the repeats. `of_one` marks parameters of a single
    experiment or machine.
    """

    fit: Refit
    inside: NDArray[np.bool_]
    steps: FloatArray
    parts: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    factors: tuple[tuple[FloatArray, FloatArray], ...]
    repeats: tuple[float, ...]
    groups: NDArray[np.intp]
    of_one: NDArray[np.bool_]

    @classmethod
    def of(cls, fit: Refit, observed: Observed) -> _Steps:
        """Return the steps around a fit."""
        steps = np.array([u.step for u in fit.unknowns])
        lower = np.array([u.lower for u in fit.unknowns])
        upper = np.array([u.upper for u in fit.unknowns])
        x = np.array([fit.values[u.name] for u in fit.unknowns])
        inside = np.asarray((x > lower + 1e-6 * steps) & (x < upper - 1e-6 * steps), dtype=bool)
        parts = tuple(fit.jacobian[e][rows][:, inside] * steps[inside] for e, rows in observed.folds)
        repeats = tuple(float(observed.repeats[e]) for e, _ in observed.folds)
        factors = (np.linalg.qr(np.sqrt(n) * part) for n, part in zip(repeats, parts, strict=True))
        return cls(
            fit,
            inside,
            steps[inside],
            parts,
            tuple(fit.residuals[e][rows] for e, rows in observed.folds),
            tuple((np.asarray(q), np.asarray(r)) for q, r in factors),
            repeats,
            np.array(observed.groups),
            np.array([SEPARATOR in u.name for u in fit.unknowns], dtype=bool)[inside],
        )

    def out(self, fold: int) -> NDArray[np.bool_]:
        """Return which folds are left out with a fold."""
        return np.asarray(self.groups == self.groups[fold])

    def others(
        self, out: NDArray[np.bool_], residuals: Sequence[FloatArray] | None = None, done: FloatArray | None = None
    ) -> FloatArray:
        """Return the equations for a step of the folds that are not `out`, after `done` of it."""
        left = self.residuals if residuals is None else residuals
        count = self.parts[0].shape[1]
        prior = np.eye(count, count + 1) / _PRIOR_STEPS
        if done is not None:
            prior[:, -1] = -done / _PRIOR_STEPS
        rows = [prior]
        for k, ((q, r), n, residual) in enumerate(zip(self.factors, self.repeats, left, strict=True)):
            if not out[k]:
                rows.append(np.column_stack([r, -np.sqrt(n) * (q.T @ residual)]))
        return np.vstack(rows)

    def moved(self, step: FloatArray) -> dict[str, float]:
        """Return the parameters after a step, within their bounds."""
        values = dict(self.fit.values)
        free = [u for u, k in zip(self.fit.unknowns, self.inside, strict=True) if k]
        for u, size, length in zip(free, self.steps, step, strict=True):
            values[u.name] = float(np.clip(values[u.name] + size * length, u.lower, u.upper))
        return values


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
    """Compute 1 - G1/G0, the share of a gap that is closed: 0 if there was no gap, and at least -1."""
    return max(-1.0, 1.0 - after / before) if before > 0.0 else 0.0


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
