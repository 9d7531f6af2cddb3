"""Ports, and decoys: how much a free function of a regime (speed, angle, load, time) at a port could explain.

A port is an input of the model that is zero by default and acts where effects act, or an output that is misread.
Driving it with basis functions gives the responses that any unnamed effect of that form would leave. A decoy that
does about as well on held-out experiments as two laws at its port is evidence that it is one unnamed law.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray, read_only
from fmuid.data.filtering import first_order
from fmuid.diagnosis.cross_validation import HeldOut, leave_each_out
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Refit
from fmuid.effects.effect import Port, Regime, Unknown

OWN_PAST = "its own past"
_FASTEST, _SLOWEST = 3.0, 1 / 3  # samples, and share of the longest run: time constants that data can show
_FREE = 30.0  # magnitudes: prior of a coefficient, so that one which no signal shows stays near zero
_PASTS = 6  # number of time constants of a memory, from a few samples to part of the longest run
Basis = tuple[tuple[FloatArray, ...], ...]
"""Basis functions, each with (N,) samples for every experiment."""


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """Response of the signals to a family of free functions at a port.

    Attributes
    ----------
    over
        What the functions depend on.
    columns
        (M_e, B) per experiment: whitened change for each of the B functions, in units of the port's magnitude.
    """

    over: str
    columns: tuple[FloatArray, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Decoy:
    """A free function at a port, fitted together with a model's parameters.

    Attributes
    ----------
    over
        As in its `Response`.
    held_out
        Losses on held-out experiments.
    amounts
        (B,) coefficients of its functions, in units of the port's magnitude.
    """

    over: str
    held_out: HeldOut
    amounts: tuple[float, ...]


def hats(values: Sequence[FloatArray], knots: FloatArray) -> Basis:
    """Piecewise-linear functions that are 1 at one of the (K,) knots and 0 at the others."""
    basis = []
    for k in range(len(knots)):
        ordinates = np.zeros(len(knots))
        ordinates[k] = 1.0
        basis.append(tuple(read_only(np.interp(v, knots, ordinates)) for v in values))
    return tuple(basis)


def harmonics(values: Sequence[FloatArray], orders: Sequence[int]) -> Basis:
    """Cosine and sine of the multiples `orders` of an angle in rad."""
    functions: list[Callable[[FloatArray], FloatArray]] = [np.cos, np.sin]
    return tuple(tuple(read_only(f(k * v)) for v in values) for k in orders for f in functions)


def times(basis: Basis, factor: Sequence[FloatArray]) -> Basis:
    """Multiply every function by a factor with (N,) samples for every experiment."""
    return tuple(tuple(read_only(b * f) for b, f in zip(one, factor, strict=True)) for one in basis)


def pasts(values: Sequence[FloatArray], time: Sequence[FloatArray]) -> Basis:
    """Return a variable after first-order lags, divided by its largest absolute value.

    Time constants are spaced evenly on a logarithmic scale from three samples to a third of the longest run.
    """
    size = max(max(float(np.abs(v).max()) for v in values), 1e-300)
    shortest = _FASTEST * min(float(np.mean(np.diff(t))) for t in time)
    longest = max(float(t[-1] - t[0]) for t in time) * _SLOWEST
    functions = []
    for seconds in np.geomspace(shortest, max(longest, 2.0 * shortest), _PASTS):
        keeps = [float(np.exp(-np.mean(np.diff(t)) / seconds)) for t in time]
        # Settled before the first sample.
        slow = [
            first_order((1.0 - k) * v / size, k, before=v[0] / size) for k, v in zip(keeps, values, strict=True)
        ]
        functions.append(tuple(read_only(s) for s in slow))
    return tuple(functions)


def quantile_knots(values: Sequence[FloatArray], count: int) -> FloatArray:
    """Return knots at quantiles of all experiments, each experiment having equal weight."""
    resampled = [np.quantile(v, np.linspace(0, 1, 201)) for v in values]
    knots = np.unique(np.quantile(np.concatenate(resampled), np.linspace(0, 1, count)))
    spread = knots[-1] - knots[0]
    kept = [knots[0]]
    for k in knots[1:]:
        if k - kept[-1] > 1e-3 * spread:
            kept.append(k)
    return np.array(kept)


def moved_by(
    model: CampaignModel, observed: Observed, base: Refit, port: Port, basis: Basis
) -> list[tuple[FloatArray, ...] | None]:
    """Return by how much each function at a port moves the residuals of `base`, per experiment.

    Functions are in units of the port's magnitude. None for those that cannot be simulated, or not read.
    """
    if port.input is None:
        read = any(port.output in run.channels for run in observed.runs)
        return [_misread(observed, port, one) if read else None for one in basis]
    return [
        None if isinstance(moved, SimulationError) else observed.whiten(moved)
        for moved in model.moved_by(base.values, port.input, port.magnitude, basis)
    ]


def _misread(observed: Observed, port: Port, function: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
    return observed.whiten(
        [
            np.outer([float(name == port.output) for name in run.channels], port.magnitude * b)
            for run, b in zip(observed.runs, function, strict=True)
        ]
    )


def responses_of(
    model: CampaignModel, observed: Observed, base: Refit, port: Port, families: Mapping[str, Basis]
) -> tuple[Response, ...]:
    """Return the responses to every family of functions at a port, at the parameters of `base`.

    Families that cannot be simulated are left out. A sensor's error may also depend on other signals or on its own
    past.
    """
    if port.input is None:
        families = {**families, **_of_signals(model, base, port)}
    responses = []
    for over, basis in families.items():
        moved = [m for m in moved_by(model, observed, base, port, basis) if m is not None]
        if len(moved) == len(basis):
            columns = tuple(np.stack(parts, axis=1) for parts in zip(*moved, strict=True))
            responses.append(Response(over, columns))
    return tuple(responses)


def _of_signals(model: CampaignModel, base: Refit, port: Port) -> dict[str, Basis]:
    """Return functions that a sensor may add: other signals, and its own past."""
    (prediction,) = model.predict([base.values])
    if isinstance(prediction, SimulationError):
        return {}
    signals = [
        {n: u[case.lead :] for n, u in case.task.inputs.items()}
        | {c.signal: y for c, y in zip(case.channels, p, strict=True)}
        for case, p in zip(model.cases, prediction, strict=True)
    ]

    def course(name: str | None) -> list[FloatArray]:
        with_signals = zip(model.cases, signals, strict=True)
        return [known.get(name or "", np.zeros(len(case.time))) for case, known in with_signals]

    others = []
    for name in sorted({n for known in signals for n in known} - {port.output}):
        series = course(name)
        size = max(float(np.abs(s).max()) for s in series)
        others += [tuple(s / size for s in series)] if size > 0.0 else []
    past = pasts(course(port.output), [case.time for case in model.cases])
    return {"other signals": tuple(others), OWN_PAST: past} if others else {OWN_PAST: past}


def fit_decoys(responses: Sequence[Response], base: Refit, observed: Observed) -> tuple[Decoy, ...]:
    """Fit every family of functions, linearly, together with the parameters of `base`."""
    return tuple(_fit(response, base, observed) for response in responses)


def _fit(response: Response, base: Refit, observed: Observed) -> Decoy:
    jacobian = [np.hstack([j, c]) for j, c in zip(base.jacobian, response.columns, strict=True)]
    weight = np.sqrt(observed.repeats)
    count = response.columns[0].shape[1]
    names = [f"{response.over}[{k}]" for k in range(count)]
    unknowns = base.unknowns + tuple(Unknown(n, 0.0, -np.inf, np.inf, 1.0) for n in names)
    steps = np.array([u.step for u in unknowns])
    a = np.concatenate([w * j for w, j in zip(weight, jacobian, strict=True)]) * steps
    r = np.concatenate([w * x for w, x in zip(weight, base.residuals, strict=True)])
    prior = np.concatenate([np.full(len(base.unknowns), 1e-3), np.full(count, 1.0 / _FREE)])
    solution = np.linalg.solve(a.T @ a + np.diag(prior**2), -(a.T @ r))
    residuals = tuple(x + j @ (steps * solution) for x, j in zip(base.residuals, jacobian, strict=True))
    values = {
        u.name: base.values.get(u.name, 0.0) + s * h for u, s, h in zip(unknowns, solution, steps, strict=True)
    }
    cost = float(sum(n * (x @ x) for n, x in zip(observed.repeats, residuals, strict=True)))
    fit = Refit(_unbounded(unknowns), values, residuals, tuple(jacobian), cost, 0, True)
    amounts = tuple(map(float, solution[len(base.unknowns) :]))
    return Decoy(response.over, leave_each_out(fit, observed), amounts)


def _unbounded(unknowns: Sequence[Unknown]) -> tuple[Unknown, ...]:
    return tuple(Unknown(u.name, u.start, -np.inf, np.inf, u.step) for u in unknowns)


_REVERSAL = 1e-2  # share of the largest speed within which friction reverses: its sign is smooth for a linear step


def trajectories(
    model: CampaignModel, values: Mapping[str, float], regimes: Mapping[str, Regime]
) -> dict[str, tuple[FloatArray, ...]]:
    """Return, by regime and for ``time``, (N,) samples of every experiment along the model's own trajectory."""
    names = [r.name for r in regimes.values()]
    courses = model.trajectories(values, [r.variable for r in regimes.values()])
    paths = {name: tuple(rows[k] for rows in courses) for k, name in enumerate(names)}
    return {**paths, "time": tuple(case.time for case in model.cases)}


def folded(
    paths: Mapping[str, tuple[FloatArray, ...]], regimes: Mapping[str, Regime]
) -> dict[str, tuple[FloatArray, ...]]:
    """Return `paths` with angles folded into one turn, because laws repeat with it."""
    angles = {r.name for r in regimes.values() if r.kind == "angle"}
    return {n: tuple(p % (2 * np.pi) for p in path) if n in angles else path for n, path in paths.items()}


def _powers(path: Sequence[FloatArray]) -> Basis:
    """Return first to third power of a variable; even powers keep its sign."""
    size = max(float(np.abs(p).max()) for p in path) or 1.0
    return tuple(tuple(read_only(np.sign(p) * np.abs(p / size) ** k) for p in path) for k in (1, 2, 3))


def bases(
    paths: Mapping[str, tuple[FloatArray, ...]], regimes: Mapping[str, Regime], *, knots: int = 9
) -> dict[str, Basis]:
    """Return families of functions that an unnamed effect may be: of speed, acceleration, angle, load, past, time.

    Functions of angle and time also come multiplied by the sign of the speed, as in friction. Regimes confined to
    ports are in `own_bases`.
    """
    time = paths["time"]
    since = [t - t[0] for t in time]
    over_time = hats(since, np.linspace(0.0, max(float(t[-1]) for t in since), 5))
    speed = next((paths[r.name] for r in regimes.values() if r.kind == "speed"), None)
    direction = None if speed is None else [np.tanh(w / (_REVERSAL * max(np.abs(w).max(), 1e-9))) for w in speed]
    families: dict[str, Basis] = {}
    for regime in regimes.values():
        path = paths[regime.name]
        if regime.ports:
            continue
        if regime.kind == "angle":
            families[regime.name] = _of_angle(path, regime)
            if direction is not None:
                families[f"{regime.name} and direction"] = times(families[regime.name], direction)
        else:
            families[regime.name] = hats(path, quantile_knots(path, knots))
            families[f"{regime.name}, its past"] = pasts(path, time)
        if regime.kind == "speed":
            rate = [np.gradient(w, t) for w, t in zip(path, time, strict=True)]
            families[f"{regime.name}, its rate"] = hats(rate, quantile_knots(rate, knots))
            # Knots carry no information at speeds that only one experiment reaches.
            families[f"{regime.name}, smooth"] = _powers(path)
    families["time"] = over_time
    if direction is not None:
        families["time and direction"] = times(over_time, direction)
    return families


def own_bases(
    paths: Mapping[str, tuple[FloatArray, ...]], regimes: Mapping[str, Regime], port: str, *, knots: int = 9
) -> dict[str, Basis]:
    """Return families of functions that an unnamed effect may be at `port` alone: of the regimes confined to it.

    Each comes by itself and multiplied by the regime over every angle, like the torque of a motor current.
    """
    angles = [r for r in regimes.values() if r.kind == "angle" and not r.ports]
    families: dict[str, Basis] = {}
    for regime in (r for r in regimes.values() if port in r.ports):
        path = paths[regime.name]
        size = max(float(np.abs(p).max()) for p in path) or 1.0
        families[regime.name] = hats(path, quantile_knots(path, knots))
        for angle in angles:
            families[f"{regime.name} and {angle.name}"] = times(
                _of_angle(paths[angle.name], angle), [p / size for p in path]
            )
    return families


def _of_angle(path: Sequence[FloatArray], regime: Regime) -> Basis:
    """Return harmonics of an angle, in the experiments that turn far enough to separate them from a constant."""
    turning = [np.ptp(p) > np.pi / max(regime.orders) for p in path]
    return times(
        harmonics(path, regime.orders), [np.full(len(p), float(t)) for p, t in zip(path, turning, strict=True)]
    )
