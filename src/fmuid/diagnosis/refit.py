"""Bounded least squares in units of noise, from several starts; the best end point counts."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from scipy.optimize import lsq_linear

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.observed import Observed, squares_finite
from fmuid.effects.effect import Unknown
from fmuid.identification.solvers.trust_region import SettledError, trust_region

Outcomes = Sequence[Sequence[FloatArray] | SimulationError]


class Predict(Protocol):
    """Points in parameter space -> predictions (C, N) of every experiment, or the error for a point without one.

    Points `near` another one may share what was estimated there for each run.
    """

    def __call__(self, points: Sequence[Mapping[str, float]], near: Mapping[str, float] | None = None) -> Outcomes:
        """Return one outcome per point."""


Tangents = Callable[[Mapping[str, float], Sequence[str]], Mapping[str, Sequence[FloatArray]]]
"""A point, names of parameters -> d prediction / d parameter of every experiment, by name, where it is known."""

_End = tuple[float, FloatArray, bool]
"""Where a search ends: cost and point, and whether it ended by its tolerance."""

_WORTH = 4  # exact columns cost three runs plus a third of a run each, differences one run each
_ENOUGH = 0.5  # fall of the cost, in squared standard deviations, that justifies another iteration
_ABOUT = (
    1.05,
    20.0,
)  # times the cost, plus squared standard deviations: then another model fits about equally well
_COARSE = 0.02  # share of the cost that an iteration of a quick search has to gain
_ACROSS = 50.0  # times the tolerance, of the cost beyond the noise: promises of a twentieth lead across ripples
_WIDE = 8.0  # steps to either side, so that the slope follows the cost and not its ripples
ITERATIONS = 25  # Jacobians of a search; nearly all end by their tolerance before
_RECENT = 3  # iterations of a search whose largest gain those to come are taken to have
_PATIENCE = 10  # consecutive trial points without improvement; each is four times as near

Slopes = Literal["exact", "near", "wide"]
"""Source of derivatives: the model, differences over a plausible step, or over many steps to either side."""


@dataclass(frozen=True, slots=True, eq=False)
class Refit:
    """Result of a refit.

    Attributes
    ----------
    values
        Parameter -> estimate.
    residuals
        Whitened residual of the mean run, (M_e,) per experiment.
    jacobian
        d residual / d parameter, (M_e, P) per experiment, at the estimate, by finite steps.
    cost
        Sum over runs of squared whitened residuals of the mean run, and of priors.
    evaluations
        Number of simulations of the whole campaign.
    converged
        Whether the search that led to this result ended by its tolerance, not by its budget.
    """

    unknowns: tuple[Unknown, ...]
    values: Mapping[str, float]
    residuals: tuple[FloatArray, ...]
    jacobian: tuple[FloatArray, ...]
    cost: float
    evaluations: int
    converged: bool


def refit(
    predict: Predict,
    observed: Observed,
    unknowns: Sequence[Unknown],
    *,
    starts: Sequence[Mapping[str, float]] = ({},),
    tangents: Tangents | None = None,
    max_iterations: int = ITERATIONS,
    tolerance: float = 1e-3,
    rival: float = np.inf,
    most: float = np.inf,
) -> Refit:
    """Minimise the whitened squared residual of the mean runs.

    Where bodies collide and stick, the cost has ripples, and a search by local slopes ends early. If the slopes at
    its end promise a fall of the cost that no step achieves, the search continues with slopes across the ripples
    (implicit filtering, Kelley 2011). What these promise has to matter next to the errors of the model itself: two
    models fit about equally well if a twentieth of these is between them.

    Parameters
    ----------
    predict
        Simulates the campaign at several points.
    observed
        The measurements and their noise.
    unknowns
        The parameters to search for.
    starts
        Points to search from; a parameter that a point does not name starts from its own start. The result is at
        least as good as every start that can be simulated.
    tangents
        Gives exact derivatives. Columns are finite differences without it, where it knows none, and within a step
        of a bound (where an effect may just begin).
    max_iterations
        Largest number of Jacobians from each start.
    tolerance
        The search ends when an iteration lowers the cost by less than this share of it, or by less than 0.5.
    rival
        Cost of another model. A search that has ended goes on only if slopes promise to fit about as well as it.
    most
        Cost above which the result is of no use. A search ends if it would end above that although every iteration
        to come gained as much as the best of the last three.

    Raises
    ------
    SimulationError
        No start can be simulated.
    """
    campaign = _Campaign(predict, observed, tuple(unknowns), tangents)
    points = [campaign.point(start) for start in starts]
    ends: list[_End] = []
    for x, outcome in zip(points, campaign.evaluate(points), strict=True):
        if isinstance(outcome, SimulationError):
            failure = outcome
        else:
            campaign.known[x.tobytes()] = outcome
            ends.append(_search(campaign, x, max_iterations, tolerance, most=most))
    if not ends:
        raise failure
    ends.sort(key=lambda end: end[0])
    least = ends[0][0]

    def promising(end: _End, slopes: Slopes = "near", across: float = 0.0) -> bool:
        fall = campaign.promised(end[1], slopes) if len(unknowns) else 0.0
        relevant = max(_ENOUGH, tolerance * end[0], tolerance * across * (end[0] - campaign.size))
        return fall > relevant and end[0] - fall < min(least, about(rival), most)

    if tangents is not None:  # at a kink, where exact slopes end, those of a plausible step may continue
        for end in campaign.apart([end for end in ends if end[0] <= about(least)]):
            if promising(end, across=_ACROSS):
                ends.append(_search(campaign, end[1], max_iterations, tolerance, "near"))
    end = min(ends, key=lambda end: end[0])
    if promising(end) and promising(end, "wide", _ACROSS):
        across = _search(campaign, end[1], max_iterations, tolerance, "wide")
        end = min(end, across, _search(campaign, across[1], max_iterations, tolerance, "near"), key=lambda e: e[0])
    cost, x, converged = end
    residuals = campaign.parts(x)
    # The search follows the exact slope. Predictions from the result reach as far as a plausible step, where the
    # slope of an effect with a threshold (such as backlash) differs.
    jacobian = campaign.jacobian(x, "near")
    return Refit(tuple(unknowns), campaign.values(x), residuals, jacobian, cost, campaign.evaluations, converged)


def descend(
    predict: Predict,
    observed: Observed,
    unknowns: Sequence[Unknown],
    start: Mapping[str, float],
    *,
    tangents: Tangents,
    max_iterations: int,
    most: float = np.inf,
) -> tuple[float, dict[str, float]]:
    """Return the cost and the values that local slopes lead to from a start: a quick `refit`, without its care.

    Raises
    ------
    SimulationError
        The start cannot be simulated.
    """
    campaign = _Campaign(predict, observed, tuple(unknowns), tangents)
    cost, x, _ = _search(campaign, campaign.point(start), max_iterations, _COARSE, most=most)
    return cost, campaign.values(x)


def about(cost: float) -> float:
    """Return the cost up to which another model fits about equally well."""
    return _ABOUT[0] * cost + _ABOUT[1]


def _search(
    campaign: _Campaign,
    start: FloatArray,
    max_iterations: int,
    tolerance: float,
    slopes: Slopes = "exact",
    *,
    most: float = np.inf,
) -> _End:
    """Return where a search from `start` ends."""
    best, cost, iterations, vain = start, campaign.cost(start), 0, 0
    costs: list[float] = []  # at the beginning of every iteration

    def residuals(z: FloatArray) -> FloatArray:
        nonlocal best, cost, vain
        x = campaign.unscaled(z, start)
        try:
            r = campaign.vector(x)
        except SimulationError:  # the solver then shortens its step
            return np.full(campaign.size, np.nan)
        gained = cost - float(r @ r)
        if np.array_equal(x, best):
            return r
        vain = 0 if gained > 0.0 else vain + 1
        if gained > 0.0:
            best, cost = x, cost - gained
        if 0.0 < gained < _ENOUGH or vain == _PATIENCE:
            raise SettledError
        return r

    def jacobian(z: FloatArray) -> FloatArray:
        nonlocal iterations
        costs.append(cost)
        gains = -np.diff(costs[-_RECENT - 1 :])
        hopeless = len(gains) == _RECENT and cost - (max_iterations - iterations) * gains.max() > most
        if iterations == max_iterations or hopeless:
            raise _ExhaustedError
        iterations += 1
        j = np.vstack([campaign.stacked(campaign.jacobian(campaign.unscaled(z, start), slopes)), campaign.prior])
        return np.asarray(j * campaign.steps)

    if not len(start):
        return cost, start, True
    lower, upper = campaign.lower / campaign.steps, campaign.upper / campaign.steps
    try:
        trust_region(
            residuals,
            jacobian,
            start / campaign.steps,
            lower,
            upper,
            method="dogbox",
            cost_tolerance=tolerance,
            step_tolerance=1e-8,
        )
    except (SettledError, _ExhaustedError, SimulationError, np.linalg.LinAlgError) as ended:
        return cost, best, isinstance(ended, SettledError)
    return cost, best, True


def _with_squares(parts: tuple[FloatArray, ...]) -> tuple[FloatArray, ...] | SimulationError:
    """Return residuals, or the error that their squares are no numbers: a model may grow without limit."""
    return parts if squares_finite(parts) else SimulationError("predictions grow beyond all numbers")


def _all_simulated(outcomes: Iterable[tuple[FloatArray, ...] | SimulationError]) -> list[tuple[FloatArray, ...]]:
    """Return the outcomes, or raise the first failure."""
    simulated = []
    for outcome in outcomes:
        if isinstance(outcome, SimulationError):
            raise outcome
        simulated.append(outcome)
    return simulated


class _ExhaustedError(Exception):
    """The budget of Jacobians is used up."""


class _Campaign:
    """Residuals and Jacobians of the whole campaign; remembers the last points."""

    def __init__(
        self, predict: Predict, observed: Observed, unknowns: tuple[Unknown, ...], tangents: Tangents | None
    ) -> None:
        self._predict, self._observed, self._tangents = predict, observed, tangents
        self._unknowns, self._names = unknowns, [u.name for u in unknowns]
        self.steps = np.array([u.step for u in unknowns])
        self.lower = np.array([u.lower for u in unknowns])
        self.upper = np.array([u.upper for u in unknowns])
        self.weight = np.sqrt(observed.repeats)
        self.evaluations = 0
        self._start = np.array([u.start for u in unknowns])
        self.prior = np.diag([1.0 / u.sd for u in unknowns])[[np.isfinite(u.sd) for u in unknowns]]
        self.size = sum(w.size for w in observed.whiteners) + len(self.prior)
        self.known: OrderedDict[bytes, tuple[FloatArray, ...]] = OrderedDict()
        self._slopes: dict[Slopes, OrderedDict[bytes, tuple[FloatArray, ...]]] = {}

    def point(self, start: Mapping[str, float]) -> FloatArray:
        return self.clipped(np.array([start.get(u.name, u.start) for u in self._unknowns]))

    def clipped(self, x: FloatArray) -> FloatArray:
        return np.asarray(np.clip(x, self.lower, self.upper))

    def unscaled(self, z: FloatArray, start: FloatArray) -> FloatArray:
        """Return the point with scaled values `z`; exactly `start` for its own, which rounding would move."""
        return start if np.array_equal(z, start / self.steps) else self.clipped(z * self.steps)

    def values(self, x: FloatArray) -> dict[str, float]:
        return {name: float(v) for name, v in zip(self._names, x, strict=True)}

    def evaluate(
        self, points: Sequence[FloatArray], near: FloatArray | None = None
    ) -> list[tuple[FloatArray, ...] | SimulationError]:
        """Return the residuals of every experiment at each point, or the error for a point without them."""
        self.evaluations += len(points)
        return [
            outcome if isinstance(outcome, SimulationError) else _with_squares(self._observed.residuals(outcome))
            for outcome in self._predict(
                [self.values(p) for p in points], near=None if near is None else self.values(near)
            )
        ]

    def _simulated(
        self, points: Sequence[FloatArray], near: FloatArray | None = None
    ) -> list[tuple[FloatArray, ...]]:
        """Return the residuals of every experiment at each point, or raise the first failure."""
        return _all_simulated(self.evaluate(points, near))

    def parts(self, x: FloatArray) -> tuple[FloatArray, ...]:
        """Return the residuals of every experiment; those of the last points are remembered."""
        return _remembered(self.known, x, lambda: self._simulated([x])[0])

    def cost(self, x: FloatArray) -> float:
        r = self.vector(x)
        return float(r @ r)

    def vector(self, x: FloatArray) -> FloatArray:
        """Return the residuals, followed by those of the priors."""
        return np.concatenate([self.stacked(self.parts(x)), self.prior @ (x - self._start)])

    def stacked(self, parts: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate([w * p for w, p in zip(self.weight, parts, strict=True)])

    def apart(self, ends: Sequence[_End]) -> list[_End]:
        """Return the ends that differ from every earlier one by more than a plausible step of some parameter."""
        distinct: list[_End] = []
        for end in ends:
            if all(np.any(np.abs(end[1] - other[1]) > self.steps) for other in distinct):
                distinct.append(end)
        return distinct

    def promised(self, x: FloatArray, along: Slopes) -> float:
        """Return the fall of the cost that slopes promise, within bounds."""
        try:
            slopes = np.vstack([self.stacked(self.jacobian(x, along)), self.prior]) * self.steps
        except SimulationError:  # slopes beyond all numbers promise nothing
            return 0.0
        room = np.stack([self.lower - x, self.upper - x]) / self.steps
        free = room[0] < room[1]
        r = self.vector(x)
        with np.errstate(over="ignore", invalid="ignore"):  # the model may grow without limit
            bounded = lsq_linear(slopes[:, free], -r, bounds=room[:, free])
        return float(r @ r) - 2.0 * float(bounded.cost)

    def jacobian(self, x: FloatArray, slopes: Slopes = "exact") -> tuple[FloatArray, ...]:
        """Return d residual / d unknown, (M_e, P) per experiment; differences where it cannot be exact."""
        # Shared by the search, its promise and the result at one point.
        known = self._slopes.setdefault(slopes, OrderedDict())
        wide = _WIDE if slopes == "wide" else 0.0
        return _remembered(
            known, x, lambda: self._differences(x, self._exactly(x) if slopes == "exact" else {}, wide)
        )

    def _differences(
        self, x: FloatArray, columns: dict[int, tuple[FloatArray, ...]], wide: float = 0.0
    ) -> tuple[FloatArray, ...]:
        """Add the missing columns, from one step away or from `wide` steps to either side."""
        base = self.parts(x)
        left = [k for k in range(len(x)) if k not in columns]
        up = self.upper - x >= np.minimum(self.steps, x - self.lower)  # a range may be narrower than a step
        away = np.diag(np.where(up, self.steps, -self.steps))[left]
        if wide:
            points = [self.clipped(x + sign * wide * step) for sign in (1.0, -1.0) for step in away]
            evaluated = list(zip(points, self._simulated(points, x), strict=True))
            ends, begins = evaluated[: len(left)], evaluated[len(left) :]
        else:
            ends, begins = self._beside(x, away), [(x, base)] * len(left)
        for k, (end, p), (begin, q) in zip(left, ends, begins, strict=True):
            columns[k] = tuple((a - b) / (end[k] - begin[k]) for a, b in zip(p, q, strict=True))
        if any(isinstance(_with_squares(parts), SimulationError) for parts in columns.values()):
            raise SimulationError("predictions change beyond all numbers with a parameter")
        return tuple(
            np.stack([columns[k][e] for k in range(len(x))], axis=1) if len(x) else np.zeros((b.size, 0))
            for e, b in enumerate(base)
        )

    def _beside(self, x: FloatArray, steps: FloatArray) -> list[tuple[FloatArray, tuple[FloatArray, ...]]]:
        """Return the point after each step, with its residuals; on the other side of `x` where it has none."""
        points = [self.clipped(x + step) for step in steps]
        outcomes = self.evaluate(points, x)
        failed = [n for n, outcome in enumerate(outcomes) if isinstance(outcome, SimulationError)]
        others = [self.clipped(x - steps[n]) for n in failed]
        for n, other, outcome in zip(failed, others, self.evaluate(others, x) if others else (), strict=True):
            if np.array_equal(other, x) or isinstance(outcome, SimulationError):
                continue
            points[n], outcomes[n] = other, outcome
        return list(zip(points, _all_simulated(outcomes), strict=True))

    def _exactly(self, x: FloatArray) -> dict[int, tuple[FloatArray, ...]]:
        inside = [k for k in range(len(x)) if self.lower[k] + self.steps[k] < x[k] < self.upper[k] - self.steps[k]]
        if self._tangents is None or len(inside) < _WORTH:
            return {}
        tangents = self._tangents(self.values(x), [self._names[k] for k in inside])
        self.evaluations += 1
        columns = {
            k: self._observed.whiten(tangents[self._names[k]]) for k in inside if self._names[k] in tangents
        }
        # A parameter without any local response may still have one after a step, as a backlash that is not
        # reached.
        return {k: parts for k, parts in columns.items() if any(np.any(p) for p in parts)}


def _remembered(
    known: OrderedDict[bytes, tuple[FloatArray, ...]], x: FloatArray, compute: Callable[[], tuple[FloatArray, ...]]
) -> tuple[FloatArray, ...]:
    """Return the known entry of a point, or a newly computed one; the last two points are remembered."""
    key = x.tobytes()
    if key not in known:
        known[key] = compute()
        while len(known) > 2:
            known.popitem(last=False)
    known.move_to_end(key)
    return known[key]
