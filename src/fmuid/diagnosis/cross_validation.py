"""Judging models on experiments that were not used to fit them, and what noise alone would do there.

Each experiment is left out in turn. The parameters for the other experiments come from a Gauss-Newton step at the
full estimate, which a simulation of the experiment left out has to confirm; otherwise, they are refitted. A
parameter of a single experiment, or of a machine with no other experiment, is fitted to that experiment itself,
and the loss allows for it.

Null distributions. The R runs of an experiment have R - 1 independent differences, each a draw of the error of one
run. Random mixtures of them, scaled to the mean of R runs, are residuals of a complete model: their energy and
their largest score, after the nominal parameters are refitted, show when a gap is more than noise. Unlike white
noise, they contain variations from run to run that affect many signals at once. Rounding errors that all runs
share are added: those of the signals that the model predicts, since it is complete.

Mixtures of whole runs have one multiplier for each difference. With two or three runs, their energy varies far
more than that of noise: a single multiplier may be near 0 or 3. Energies are therefore drawn with a multiplier for
every few frequencies (a wild bootstrap). What varies from run to run as a whole shows in how much the energies of
the differences vary (`_coherence`); that share of a drawn energy has one multiplier more. Where this gives a wider
distribution than mixtures of whole runs, as with two runs of one experiment, those are used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from fmuid.core.campaign import SEPARATOR
from fmuid.core.immutable import FloatArray, read_only
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.data.noise.spectrum import rounding_draws
from fmuid.diagnosis.extended_model import Prediction
from fmuid.diagnosis.observed import Observed, orthonormal, project_off
from fmuid.diagnosis.refit import Refit

_TOGETHER = 32  # signatures whose scores are computed at once: the draws are read once, and memory stays bounded
_BLOCK = 8  # neighbouring frequencies with one multiplier: drift and smooth changes join a few of them


@dataclass(frozen=True, slots=True, eq=False)
class Null:
    """Draws under a complete model: excess energy of the residual, and the largest drop of any score.

    The excess is that of so many `experiments` together.
    """

    excess: FloatArray
    largest_drop: FloatArray
    experiments: int = 1

    @property
    def of_experiment(self) -> FloatArray:
        """Draws of the excess energy of a single experiment."""
        return np.asarray(np.sqrt(self.experiments) * self.excess)

    def p_value(self, excess: float, drop: float = 0.0) -> float:
        """Return how likely noise alone leaves this excess energy, or a score as large as `drop`.

        For the excess, this is the share of draws with at least as much, continued by a fitted normal beyond the
        last draw. With a drop, it is twice the smaller of the two shares (Bonferroni).
        """
        energy = self._of_excess(excess)
        if drop <= 0.0:
            return energy
        reached = float(np.sum(self.largest_drop >= drop) + 1) / (len(self.largest_drop) + 1)
        return min(1.0, 2.0 * min(energy, reached))

    def _of_excess(self, excess: float) -> float:
        above = float(np.mean(self.excess >= excess))
        tail = float(ndtr((self.excess.mean() - excess) / max(self.excess.std(), 1e-12)))
        return max(above, tail) if above > 0 else min(tail, 1.0 / (len(self.excess) + 1))

    def threshold(self, quantile: float = 0.99) -> float:
        """Return the drop that noise alone exceeds in a share 1 - `quantile` of all diagnoses."""
        return float(np.quantile(self.largest_drop, quantile))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseDraws:
    """(M, D) draws of the residual that noise alone would leave, with all experiments concatenated.

    They are mixtures of whole runs, of so many `experiments`. `weight` is (M,): 1 / (number of repeats) within the
    signals' bandwidth, 0 beyond it. `free` is (M,): the share of each component that nuisances leave.
    `energy` is (D,), the weighted one of draws that mix a few frequencies at a time.
    """

    noise: FloatArray
    weight: FloatArray
    free: FloatArray
    energy: FloatArray
    experiments: int

    def null(self, basis: FloatArray, signatures: Sequence[FloatArray]) -> Null:
        """Return the null distributions of a model whose refitted parameters span `basis`.

        Parameters
        ----------
        basis
            Orthonormal (M, P) basis of the refitted parameters, weighted by the root of the repeats.
        signatures
            Signatures of unit length, projected off that basis.
        """
        # What the basis leaves of the draws is as large as the draws: its sums follow from a few products.
        taken, weighted = basis.T @ self.noise, self.weight[:, None] * basis
        less = np.sum(taken * (basis.T @ weighted @ taken - 2.0 * (weighted.T @ self.noise)), axis=0)
        excess = (self.energy + less - self.weight @ self.free) / self.free[self.weight > 0.0].sum()
        largest = np.zeros(len(less))
        for i in range(0, len(signatures), _TOGETHER):
            block = np.array(signatures[i : i + _TOGETHER])
            scores = block @ self.noise - (block @ basis) @ taken
            largest = np.maximum(largest, (scores**2).max(axis=0))
        return Null(read_only(excess), read_only(largest), self.experiments)


def draw_noise(
    observed: Observed, predicted: Prediction | None = None, *, draws: int = 400, seed: int = 0
) -> NoiseDraws:
    """Draw residuals of a complete model, whose signals are `predicted`, before any refit."""
    rng = np.random.default_rng(seed)
    noise = np.empty((sum(w.size for w in observed.whiteners), draws))
    energy, of_runs = np.zeros(draws), np.zeros(draws)
    weights = [band / n for band, n in zip(observed.in_band, observed.repeats, strict=True)]
    contrasts = [_contrasts(r.deviations, w) for r, w in zip(observed.runs, observed.whiteners, strict=True)]
    coherent = _coherence([c[:, w > 0.0] for c, w in zip(contrasts, weights, strict=True) if len(c)])
    begin = 0
    for e, (run, w, c) in enumerate(zip(observed.runs, observed.whiteners, contrasts, strict=True)):
        of_run = noise[begin : begin + w.size]
        if len(c):
            of_run[:] = c.T @ (rng.standard_normal((len(c), draws)) / np.sqrt(len(c)))
            mixed = _by_blocks(c, len(run.channels), draws, rng)
        else:
            of_run[:] = rng.standard_normal((w.size, draws))
            mixed = of_run.copy()
        if np.any(observed.noise[run.setup].repeating):  # absent from every contrast
            course = None if predicted is None else predicted[e]
            shared = rounding_draws(
                run, observed.noise[run.setup], course=course, draws=draws, seed=seed + e * len(run.channels)
            )
            both = np.sqrt(len(run.values)) * w(shared).reshape(draws, -1).T
            if not len(c):  # of unit variance with the rounding
                white = np.sqrt(np.maximum(1.0 - np.mean(both**2, axis=1, keepdims=True), 0.0))
                of_run *= white
                mixed *= white
            of_run += both
            mixed += both
        if observed.nuisances:
            of_run[:], mixed = (project_off(x, observed.nuisances[e]) for x in (of_run, mixed))
        of_runs += _energy(weights[e], of_run)
        # The noise level is of the same differences: a factor that was small in all of them makes it too low.
        factor = rng.f(1.0, sum(map(len, contrasts)), draws) if len(c) else 1.0
        energy += (1.0 + coherent * (factor - 1.0)) * _energy(weights[e], mixed)
        begin += w.size
    if energy.std() > of_runs.std():  # both are upper bounds of what noise does
        energy = of_runs
    weight, free = np.concatenate(weights), 1.0 - np.concatenate(observed.taken)
    noise, weight, free, energy = map(read_only, (noise, weight, free, energy))
    return NoiseDraws(noise, weight, free, energy, len(observed.runs))


def _energy(weight: FloatArray, noise: FloatArray) -> FloatArray:
    """Return (D,) weighted sums of squares of (M, D) draws, without a copy of them: they may be large."""
    return np.asarray(np.einsum("m,md,md->d", weight, noise, noise))


def _by_blocks(contrasts: FloatArray, channels: int, draws: int, rng: np.random.Generator) -> FloatArray:
    """Return (M, draws) mixtures of (R - 1, M) contrasts, each with a multiplier for every few frequencies.

    The multipliers of the C channels are the same: what varies in several signals at once varies in the mixtures.
    """
    mixed = np.zeros((contrasts.shape[1], draws))
    n = contrasts.shape[1] // channels
    for c in contrasts:
        each = rng.standard_normal((-(-n // _BLOCK), draws)) / np.sqrt(len(contrasts))
        mixed += c[:, None] * np.tile(np.repeat(each, _BLOCK, axis=0)[:n], (channels, 1))
    return mixed


def _coherence(contrasts: Sequence[FloatArray]) -> float:
    """Return the share of the noise, between 0 and 1, that varies from run to run as a whole.

    If a share s of its energy is due to one random factor, noise has contrasts whose energies have a variance of
    2 s^2, relative to their mean: within experiments where there are three or more runs, else from one experiment
    to another.
    """
    energies = [np.mean(c**2, axis=1) for c in contrasts]
    within = [e for e in energies if len(e) > 1]
    groups = within or ([np.concatenate(energies)] if energies else [])
    freedom = sum(len(e) - 1 for e in groups)
    if freedom < 1:
        return 1.0
    seen = sum(float(np.sum((e / e.mean() - 1.0) ** 2)) for e in groups) / freedom
    return min(1.0, float(np.sqrt(0.5 * seen)))


def _contrasts(deviation: FloatArray, whiten: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the (R - 1, M) orthonormal contrasts of R whitened runs: each distributed as the noise of one run."""
    r = len(deviation)
    if r < 2:
        return np.zeros((0, 0))
    rows = whiten(deviation).reshape(r, -1)
    centred = np.eye(r) - 1.0 / r
    u, s, _ = np.linalg.svd(centred)
    return np.asarray(u[:, s > 0.5].T @ rows)


_PRIOR_STEPS = 1e3  # a parameter that the remaining experiments cannot see moves by no more than about this
_CONFIRMED = 1.1  # energy of a simulated residual, relative to the predicted one, up to which a linear step holds
CHORDS = 6  # steps of a refit without an experiment
_HALVINGS = 5  # of a step
_SETTLED = 0.5  # fall of the cost, in squared standard deviations, that ends a refit
_SHARE = 1e-3  # the same, as a share of the cost, as in refits with all experiments
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


def predicted_left_out(fit: Refit, observed: Observed, model: _Predicts, chords: int = CHORDS) -> LeftOutFit:
    """Simulate each fold at parameters that are refitted to the other experiments.

    One linear step gives the parameters, within their bounds. Where the simulation does not confirm what the step
    predicts, further steps follow, each shortened until it lowers the cost of the other experiments, until none
    does (chord method: the Jacobian of the full estimate is kept). With no `chords`, nothing is simulated, and the
    linear step is the prediction.
    """
    steps = _Steps.of(fit, observed)
    solved = {group: _solved(steps.others(steps.groups == group)) for group in dict.fromkeys(observed.groups)}
    points = {group: steps.moved(move) for group, move in solved.items()}
    linear = [
        residual + part @ solved[group]
        for residual, part, group in zip(steps.residuals, steps.parts, observed.groups, strict=True)
    ]
    if not chords:
        return LeftOutFit(tuple(points[group] for group in observed.groups), tuple(linear))
    wanted = [(e, points[group]) for (e, _), group in zip(observed.folds, observed.groups, strict=True)]
    predicted: list[FloatArray | None] = []
    for k, outcome in enumerate(model.residuals_of(wanted, observed)):
        part = None if outcome is None else outcome[observed.folds[k][1]]
        predicted.append(part if part is not None and _confirmed(part, linear[k]) else None)
    residuals: dict[int, tuple[FloatArray, ...]] = {}  # of all experiments, by the group that a refit left out
    for k, part in enumerate(predicted):
        group, (e, rows) = observed.groups[k], observed.folds[k]
        if part is None and group not in residuals:
            points[group], residuals[group] = _refitted_without(steps, steps.out(k), observed, model, chords)
        if part is None:
            predicted[k] = residuals[group][e][rows]
    return LeftOutFit(
        tuple(points[group] for group in observed.groups), tuple(part for part in predicted if part is not None)
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
    steps: _Steps, out: NDArray[np.bool_], observed: Observed, model: _Predicts, chords: int
) -> tuple[dict[str, float], tuple[FloatArray, ...]]:
    """Return the parameters refitted to the folds that are not `out`, and the residuals of every experiment."""
    inside = [k for k in range(len(out)) if not out[k]]

    def cost(residuals: Sequence[FloatArray], step: FloatArray) -> float:
        return float(np.sum(steps.after(step)[:, -1] ** 2)) + sum(
            float(steps.repeats[k] * (r @ r))
            for k in inside
            for r in [residuals[observed.folds[k][0]][observed.folds[k][1]]]
        )

    here, step = list(steps.fit.residuals), np.zeros(steps.parts[0].shape[1])
    left = cost(here, step)
    for _ in range(chords):
        now = [here[e][rows] for e, rows in observed.folds]
        further = _solved(steps.others(out, now, step))
        before = left
        better = next(
            (
                (after, point, r)
                for point in (step + 0.5**n * further for n in range(_HALVINGS))
                if (r := model.residuals_at(steps.moved(point), observed)) is not None
                and (after := cost(r, point)) < before
            ),
            None,
        )
        if better is None:
            break
        left, step, here = better[0], better[1], list(better[2])
        if before - left < max(_SETTLED, _SHARE * left):
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
    decompositions of the former, weighted by the root of the repeats. `prior` are the equations of the refit's own
    priors and of a faint one on every step. `of_one` marks parameters of a single experiment or machine.
    """

    fit: Refit
    inside: NDArray[np.bool_]
    steps: FloatArray
    parts: tuple[FloatArray, ...]
    residuals: tuple[FloatArray, ...]
    factors: tuple[tuple[FloatArray, FloatArray], ...]
    repeats: tuple[float, ...]
    prior: FloatArray
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
        known = np.array([np.isfinite(u.sd) for u in fit.unknowns], dtype=bool)[inside]
        sd, start = (np.array([getattr(u, n) for u in fit.unknowns])[inside][known] for n in ("sd", "start"))
        of_refit = np.column_stack([np.diag(steps[inside])[known] / sd[:, None], (start - x[inside][known]) / sd])
        faint = np.eye(int(inside.sum()), int(inside.sum()) + 1) / _PRIOR_STEPS
        return cls(
            fit,
            inside,
            steps[inside],
            parts,
            tuple(fit.residuals[e][rows] for e, rows in observed.folds),
            tuple((np.asarray(q), np.asarray(r)) for q, r in factors),
            repeats,
            np.vstack([faint, of_refit]),
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
        rows = [self.prior if done is None else self.after(done)]
        for k, ((q, r), n, residual) in enumerate(zip(self.factors, self.repeats, left, strict=True)):
            if not out[k]:
                rows.append(np.column_stack([r, -np.sqrt(n) * (q.T @ residual)]))
        return np.vstack(rows)

    def after(self, done: FloatArray) -> FloatArray:
        """Return the equations of the priors after a step."""
        return np.column_stack([self.prior[:, :-1], self.prior[:, -1] - self.prior[:, :-1] @ done])

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
    for e, (runs_before, other) in enumerate(zip(before.per_run, after.per_run, strict=True)):
        pick = rng.integers(0, len(runs_before), (draws, len(runs_before)))
        b[e] = before.loss[e] + runs_before[pick].mean(axis=1) - runs_before.mean()
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


def advantage(better: HeldOut, worse: HeldOut, *, elsewhere: bool = False) -> tuple[float, float]:
    """Return the mean difference of losses (worse - better) and its standard error over the runs.

    Experiments are not a sample from a population: an effect that only one of them shows is just as real. What is
    random is the recorded runs, or pieces of runs if none was repeated. How models predict experiments `elsewhere`
    also scatters from experiment to experiment.
    """
    size = better.size / better.size.sum()
    difference = (worse.loss - better.loss) * size
    if elsewhere or all(len(a) < 2 for a in worse.per_run):
        n = len(difference)
        spread = n / max(n - 1, 1) * float(np.sum((difference - difference.mean()) ** 2))
        return float(difference.sum()), float(np.sqrt(spread))
    variance = 0.0
    for share, a, b in zip(size, worse.per_run, better.per_run, strict=True):
        if len(a) > 1:
            variance += float(share**2 * np.var(a - b, ddof=1) / len(a))
    return float(difference.sum()), float(np.sqrt(variance))
