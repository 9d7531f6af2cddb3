"""Runs of a plant with its effects, and how large a gap they leave once a user's free parameters are refitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from benchmarks.blind.plants.effects import Candidate, Effect, SignalEffect, Usual, acting, parts_of
from benchmarks.blind.plants.grammar import Rig
from benchmarks.blind.plants.network import Controller, DivergedError, Floats, Network

MEMORY = 20.0  # samples, of coloured noise
_STEP = 1e-3  # of a parameter's logarithm, for derivatives
_REFITS = 12  # steps to the best size of a candidate
_RANGE = float(np.log(10.0))  # of a parameter's logarithm, as `fmuid init` sets it
_DIVERGED = 1e3  # standard deviations of every sample of a model that cannot be simulated
_APART = 3.0  # standard deviations, below which two effects are the same to the sensors
Any_ = Effect | SignalEffect
_SHARP = {"stribeck", "coulomb", "presliding", "hysteresis", "backlash", "asymmetry", "voltage_drop", "relay"}


@dataclass(frozen=True)
class Run:
    """One experiment as it is driven: inputs (inputs, N), where it starts, columns that something varies with."""

    u: Floats
    start: Floats
    columns: Floats | None = None


@dataclass(frozen=True)
class Way:
    """How runs are recorded: when outputs are read (share of a sample late), and whether inputs are linear."""

    read: float = 0.0
    linear: bool = False


def simulate(
    rig: Rig, network: Network, effects: Sequence[Any_], run: Run, way: Way, typical: Usual, *,
    controller: Controller | None = None, reference: Floats | None = None, noise: Floats | None = None,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return readings (outputs, N) without noise and the recorded inputs."""
    inner, outer = acting(effects)
    parts = parts_of(outer)
    network = network.with_effects(inner)
    steps = steps_of(rig, network)
    u = run.u
    if controller is not None:
        y, u = network.run(
            rig.dt, u, steps, start=run.start, read=way.read, columns=run.columns,
            controller=controller, reference=reference, noise=noise,
        )  # fmt: skip
        if not outer:
            return y, u
    samples = u.shape[1]
    fine = np.repeat(u, parts, axis=1)
    if way.linear and parts > 1:
        grid = np.arange(samples * parts) / parts
        fine = np.stack([np.interp(grid, np.arange(samples), one) for one in u])
    for effect in (e for e in outer if e.is_input):
        k = effect.index
        fine[k] = effect.applied(fine[k], fine, typical.inputs[k], 0.0)
    columns = None if run.columns is None else np.repeat(run.columns, parts, axis=1)
    fine_steps = max(-(-steps // parts), 1)
    y, _ = network.run(
        rig.dt / parts, fine, fine_steps, start=run.start, columns=columns, linear=way.linear,
        read=way.read if parts == 1 else 0.0,
    )  # fmt: skip
    raw = y.copy()
    for effect in (e for e in outer if not e.is_input):
        k = effect.index
        y[k] = effect.applied(y[k], raw, typical.outputs[k], typical.zeros[k])
    if parts > 1:
        at = np.minimum(np.arange(samples) * parts + round(way.read * parts), samples * parts - 1)
        y = y[:, at]
    return y, u


def steps_of(rig: Rig, network: Network) -> int:
    """Return the steps of a sample: more where an effect changes its sign fast."""
    sharp = {e.law for e in network.effects} & _SHARP
    return int(np.ceil(rig.steps * (2.5 if sharp else 1.0)))


def whitened(y: Floats, noise: str) -> Floats:
    """Return differences (outputs, N) in standard deviations, such that their noise would be white."""
    if noise == "coloured":
        keep = float(np.exp(-1.0 / MEMORY))
        return np.asarray(lfilter([1.0, -keep], [1.0], y, axis=-1) / np.sqrt(1.0 - keep**2))
    if noise == "drift":
        t = np.linspace(-1.0, 1.0, y.shape[-1])
        basis = np.linalg.qr(np.stack([np.ones_like(t), t], axis=1))[0]
        return np.asarray(y - (y @ basis) @ basis.T)
    return y


class Gaps:
    """A plant with its true parameters, its runs, and the gap that any effect leaves on them."""

    def __init__(
        self, rig: Rig, values: Mapping[str, float], runs: Sequence[Run], way: Way, typical: Usual, noise: str
    ) -> None:
        self.rig, self.values, self.runs, self.way = rig, values, runs, way
        self.typical, self.noise = typical, noise
        self._directions: dict[Candidate, Floats] = {}
        self._sigma = np.array(rig.noise)[:, None]
        self.plain = self.readings({})
        columns = [(self.readings({p.name: _STEP}) - self.plain) / _STEP for p in rig.parameters]
        self._jacobian = np.column_stack(columns)
        u, s, vt = np.linalg.svd(self._jacobian, full_matrices=False)
        keep = s > 1e-5 * s[0]
        self._basis = u[:, keep]
        self._inverse = (vt[keep].T / s[keep]) @ u[:, keep].T

    def determined(self) -> list[str]:
        """Return the parameters that the runs determine: they have no share in a direction that those do not."""
        names = [p.name for p in self.rig.parameters]
        both = ([self.readings({n: h}) for n in names] for h in (_STEP, -_STEP))
        columns = [(after - before) / (2 * _STEP) for after, before in zip(*both, strict=True)]
        _, s, vt = np.linalg.svd(np.column_stack(columns), full_matrices=False)
        free = vt[s <= 1e-5 * s[0]]  # differences are exact to the square of their step
        return [n for k, n in enumerate(names) if np.sum(free[:, k] ** 2) < 1e-6]

    def readings(self, moved: Mapping[str, float], effects: Sequence[Any_] = ()) -> Floats:
        """Return all readings in standard deviations, whitened, one behind the other."""
        network = self.rig.with_values({n: v * np.exp(moved.get(n, 0.0)) for n, v in self.values.items()})
        parts = []
        for run in self.runs:
            y, _ = simulate(self.rig, network, effects, run, self.way, self.typical)
            parts.append(whitened(y / self._sigma, self.noise).ravel())
        return np.concatenate(parts)

    def left(self, effects: Sequence[Any_], beside: Sequence[Any_] = ()) -> Floats:
        """Return the residuals of readings with effects after a refit of the parameters without them."""
        target = self.readings({}, [*effects, *beside])
        names = [p.name for p in self.rig.parameters]
        moved, best = np.zeros(len(names)), target - (self.plain if not beside else self.readings({}, beside))
        base = best
        for _ in range(3):
            step = self._inverse @ base
            if np.abs(step).max() < 1e-4:
                break
            moved = np.clip(moved + step, -1.0, 1.0)
            try:
                base = target - self.readings(dict(zip(names, moved.tolist(), strict=True)), beside)
            except DivergedError:
                break
            if np.linalg.norm(base) > np.linalg.norm(best):
                break
            best = base
        return best - self._basis @ (self._basis.T @ best)

    def gap(self, effects: Sequence[Any_], beside: Sequence[Any_] = ()) -> float:
        """Return the gap in floors; infinite where the plant cannot be simulated."""
        try:
            left = self.left(effects, beside)
        except DivergedError:
            return np.inf
        return float(np.sqrt(np.mean(left**2)))

    def refitted(self, effects: Sequence[Any_], beside: Sequence[Any_] = ()) -> float:
        """Return the gap that a refit of all parameters to the end leaves, over the whole range a user allows.

        `gap` is quicker, for drawing sizes: a few steps from the true values. Where parameters are hardly
        determined or take up most of an effect, it may be far from this one.
        """
        target = self.readings({}, [*effects, *beside])
        names = [p.name for p in self.rig.parameters]

        def left(x: Floats) -> Floats:
            try:
                return self.readings(dict(zip(names, x.tolist(), strict=True)), beside) - target
            except DivergedError:
                return np.full_like(target, _DIVERGED)

        fit = least_squares(left, np.zeros(len(names)), bounds=(-_RANGE, _RANGE), diff_step=1e-4, max_nfev=30)
        return float(np.sqrt(np.mean(fit.fun**2)))

    def sized(self, candidate: Candidate, target: float, sign: float = 1.0) -> tuple[Any_, float]:
        """Return a candidate at the size whose gap comes close to `target`, and that gap.

        Where no plausible size is large enough, the largest one.
        """
        size, low, high, gap = 0.1, 0.0, candidate.most, 0.0
        for _ in range(14):
            gap = self.gap([candidate.sized(sign * size)])
            if abs(gap / target - 1.0) < 0.07 or (gap < target and size >= candidate.most):
                break
            low, high = (size, high) if gap < target else (low, size)
            guess = size * float(np.clip(target / max(gap, 1e-9), 0.02, 20.0)) if np.isfinite(gap) else 0.1 * size
            size = (
                min(guess, candidate.most) if low < guess < high else float(np.sqrt(max(low, 1e-4 * high) * high))
            )
        return candidate.sized(sign * size), gap

    def twins_of(
        self, effect: Any_, others: Sequence[Candidate], repeats: int, catalogue_law: str = ""
    ) -> tuple[list[str], list[str]]:
        """Return the ids of candidates that these runs cannot tell from an effect, and of those that fit as well.

        A candidate, at its best size and with the parameters refitted, is the same if it differs by less than
        three standard deviations over all runs, and by less than half of what the effect leaves. It fits as well
        if it differs by no more than `catalogue_law`, whose shape the effect does not have.
        """
        try:
            target, left = self.readings({}, [effect]), self.left([effect])
        except DivergedError:
            return [], []
        half = 0.5 * float(np.linalg.norm(left)) * np.sqrt(repeats)
        limit, mine = min(_APART, half), 0.0
        for one in (c for c in others if c.id == catalogue_law):
            mine = min(self.fitted(target, c, np.inf)[0] for c in _of_other_widths(one)) * np.sqrt(repeats)
            mine = mine if mine < half else 0.0
        near = max(mine, 4.0 * limit) / np.sqrt(repeats)
        same, as_well = [], []
        for other in others:
            if other.id == catalogue_law:
                continue
            apart = self.fitted(target, other, near)[0] if catalogue_law else self._linear(left, other)
            apart *= np.sqrt(repeats)
            if apart < limit:
                same.append(other.id)
            elif apart <= mine:
                as_well.append(other.id)
        return sorted(set(same)), sorted(set(as_well) - set(same))

    def fitted(self, target: Floats, other: Candidate, near: float = np.inf) -> tuple[float, float]:
        """Return by how much a candidate, with the parameters refitted, differs from readings, and its size.

        The search is one of Gauss and Newton with shortened steps: of the size alone, then with the parameters and
        the derivatives of the plain plant, then, where that comes near, with those of the candidate's.
        """
        x, here = np.zeros(len(self.rig.parameters) + 1), self.plain
        far, lower, upper = float(np.linalg.norm(target - here)), np.full(len(x), -1.0), np.full(len(x), 1.0)
        lower[-1], upper[-1] = -other.most if other.two_sided else 0.0, other.most
        jacobian, stage = np.zeros_like(self._jacobian), 0
        for _ in range(_REFITS):
            try:
                if stage == 2:
                    jacobian = np.column_stack([self._slope(other, x, here, k) for k in range(len(x) - 1)])
                column = self._slope(other, x, here, -1)
            except DivergedError:
                break
            step = np.linalg.lstsq(np.column_stack([jacobian, column]), target - here, rcond=1e-6)[0]
            before = far
            for share in (1.0, 0.3, 0.1):
                trial = np.clip(x + share * step, lower, upper)
                try:
                    there = self._at(other, trial)
                except DivergedError:
                    continue
                if np.linalg.norm(target - there) < far:
                    x, here, far = trial, there, float(np.linalg.norm(target - there))
                    break
            if far > 0.9 * before:
                if stage == 2 or (stage == 1 and far > near):
                    break
                stage, jacobian = stage + 1, self._jacobian
        return far, float(x[-1])

    def _linear(self, left: Floats, other: Candidate) -> float:
        """Return the same for small effects: to first order, from residuals."""
        if other not in self._directions:
            try:
                column = self._slope(other, np.zeros(len(self.rig.parameters) + 1), self.plain, -1)
            except DivergedError:
                return np.inf
            self._directions[other] = column - self._basis @ (self._basis.T @ column)
        column = self._directions[other]
        along = float(column @ left) / max(float(column @ column), 1e-300)
        return float(np.linalg.norm(left - (along if other.two_sided else max(along, 0.0)) * column))

    def _at(self, other: Candidate, x: Floats) -> Floats:
        names = (p.name for p in self.rig.parameters)
        return self.readings(dict(zip(names, x[:-1].tolist(), strict=True)), [other.sized(float(x[-1]))])

    def _slope(self, other: Candidate, x: Floats, here: Floats, k: int) -> Floats:
        moved = x.copy()
        moved[k] += 0.02 * max(abs(x[k]), 0.5) if k < 0 else _STEP
        return (self._at(other, moved) - here) / (moved[k] - x[k])


def _of_other_widths(candidate: Candidate) -> list[Candidate]:
    """Return a candidate with several values of what its law has in addition to a size: a width, a time."""
    if candidate.law not in ("stribeck", "presliding", "hysteresis", "capacity", "eddy"):
        return [candidate]
    assert isinstance(candidate.effect, Effect)
    return [
        replace(candidate, effect=replace(candidate.effect, s1=by * candidate.effect.s1)) for by in (0.4, 1.0, 2.5)
    ]
