"""Regimes: the variables of the model along which a gap is examined, and free functions of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fmuid.core.immutable import FloatArray, read_only
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.diagnosis.ports import Basis, harmonics, hats, pasts, quantile_knots, times
from fmuid.effects.effect import Regime

_REVERSAL = 1e-2  # share of the largest speed within which friction reverses: its sign is smooth for a linear step


def trajectories(
    model: CampaignModel, values: Mapping[str, float], regimes: Mapping[str, Regime]
) -> dict[str, tuple[FloatArray, ...]]:
    """Return, by regime and for ``time``, (N,) samples of every experiment along the model's own trajectory."""
    names = [r.name for r in regimes.values()]
    found = model.trajectories(values, [r.variable for r in regimes.values()])
    paths = {name: tuple(rows[k] for rows in found) for k, name in enumerate(names)}
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
    found: dict[str, Basis] = {}
    for regime in regimes.values():
        path = paths[regime.name]
        if regime.ports:
            continue
        if regime.kind == "angle":
            found[regime.name] = _of_angle(path, regime)
            if direction is not None:
                found[f"{regime.name} and direction"] = times(found[regime.name], direction)
        else:
            found[regime.name] = hats(path, quantile_knots(path, knots))
            found[f"{regime.name}, its past"] = pasts(path, time)
        if regime.kind == "speed":
            rate = [np.gradient(w, t) for w, t in zip(path, time, strict=True)]
            found[f"{regime.name}, its rate"] = hats(rate, quantile_knots(rate, knots))
            # Knots carry no information at speeds that only one experiment reaches.
            found[f"{regime.name}, smooth"] = _powers(path)
    found["time"] = over_time
    if direction is not None:
        found["time and direction"] = times(over_time, direction)
    return found


def own_bases(
    paths: Mapping[str, tuple[FloatArray, ...]], regimes: Mapping[str, Regime], port: str, *, knots: int = 9
) -> dict[str, Basis]:
    """Return families of functions that an unnamed effect may be at `port` alone: of the regimes confined to it.

    Each comes by itself and multiplied by the regime over every angle, like the torque of a motor current.
    """
    angles = [r for r in regimes.values() if r.kind == "angle" and not r.ports]
    found: dict[str, Basis] = {}
    for regime in (r for r in regimes.values() if port in r.ports):
        path = paths[regime.name]
        size = max(float(np.abs(p).max()) for p in path) or 1.0
        found[regime.name] = hats(path, quantile_knots(path, knots))
        for angle in angles:
            found[f"{regime.name} and {angle.name}"] = times(
                _of_angle(paths[angle.name], angle), [p / size for p in path]
            )
    return found


def _of_angle(path: Sequence[FloatArray], regime: Regime) -> Basis:
    """Return harmonics of an angle, in the experiments that turn far enough to separate them from a constant."""
    turning = [np.ptp(p) > np.pi / max(regime.orders) for p in path]
    return times(
        harmonics(path, regime.orders), [np.full(len(p), float(t)) for p, t in zip(path, turning, strict=True)]
    )
