"""From what a diagnosis found to the arrays its report draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmuid.campaign import FloatArray
from fmuid.diagnosis.diagnose import Found
from fmuid.diagnosis.model import Prediction
from fmuid.diagnosis.ports import Port, hats, quantile_knots
from fmuid.diagnosis.regimes import Regime
from fmuid.diagnosis.scores import stack
from fmuid.errors import SimulationError
from fmuid.plots.data import Axis
from fmuid.report.diagnosis_figures import (
    DiagnosisPictures,
    ExcessEnergy,
    MissingQuantity,
    RegimeBins,
    ResidualPair,
)

_KNOTS = 11
_PRIOR = 1.0 / 30.0  # an ordinate that no signal shows stays within thirty magnitudes of zero


def pictures_of(found: Found) -> DiagnosisPictures:
    """Return the arrays behind the pictures of a diagnosis; simulates the campaign some thirty times.

    Raises
    ------
    SimulationError
        The refitted nominal model cannot be simulated.
    """
    named = found.best is not None and bool(found.diagnosis.verdict.effects)
    points = [found.nominal.fit.values] + ([found.best.fit.values] if named and found.best else [])
    nominal, *corrected = found.subject.model.predict(points)
    if isinstance(nominal, SimulationError):
        raise nominal
    after = corrected[0] if corrected and not isinstance(corrected[0], SimulationError) else None
    missing = sorted(_missing(found, nominal, after), key=lambda m: -(m.explained or 0.0))
    return DiagnosisPictures(_residuals(found, nominal, after), _excess(found), tuple(missing), _steps(found))


def _steps(found: Found) -> dict[str, float]:
    """Return the gaps that the first effects of the verdict leave without the later ones."""
    if found.best is None:
        return {}
    parts = [found.best.effects[:k] for k in range(1, len(found.best.effects))]
    return {" + ".join(c.effects): c.gap for part in parts for c in found.candidates if c.effects == part}


def _residuals(found: Found, before: Prediction, after: Prediction | None) -> tuple[ResidualPair, ...]:
    """Return the signal with the most excess energy of each setup."""
    cases = {case.id: case for case in found.subject.model.cases}
    runs = {run.id: k for k, run in enumerate(found.subject.observed.runs)}
    pairs: dict[str, ResidualPair] = {}
    for row in np.argsort(-found.excess.energy):
        experiment, signal = found.excess.rows[row]
        index = runs[experiment]
        run = found.subject.observed.runs[index]
        if run.setup in pairs:
            continue
        c = run.channels.index(signal)
        measured = np.where(run.mask[c] > 0, run.mean[c], np.nan)
        sigma = found.subject.observed.noise[run.setup].sigma[signal]
        pairs[run.setup] = ResidualPair(
            run.setup,
            experiment,
            signal,
            cases[experiment].channels[c].unit or "",
            run.time,
            before[index][c] - measured,
            None if after is None else after[index][c] - measured,
            float(sigma / np.sqrt(run.n_repeats)),
        )
    return tuple(pairs.values())


def _excess(found: Found) -> ExcessEnergy | None:
    energy = found.excess
    total = float(energy.energy.sum())
    if total <= 0.0:
        return None
    regimes = found.subject.catalogue.regimes
    axes = {r.name: Axis(r.name, r.unit) for r in regimes.values()} | {"time": Axis("time", "s")}
    bins = tuple(RegimeBins(axes.get(name, Axis(name)), edges) for name, edges in energy.edges.items())
    share = np.hstack([energy.binned[name] for name in energy.edges]) * energy.energy[:, None] / total
    return ExcessEnergy(energy.rows, bins, share)


def _missing(found: Found, nominal: Prediction, after: Prediction | None) -> tuple[MissingQuantity, ...]:
    """Return what a free function of each regime variable has to add at the verdict's port.

    The law of the verdict's effect is drawn as the free function that moves the nominal model as the effect does.
    """
    port = found.subject.catalogue.ports.get(found.diagnosis.verdict.port or "")
    if port is None or port.input is None:
        return ()
    quantity = Axis(f"missing at {port.name}", port.unit)
    label = "" if found.best is None else " + ".join(found.best.names)  # whose law it is, also in "A or B"
    missing = []
    for regime in found.subject.catalogue.regimes.values():
        turn = 2 * np.pi if regime.kind == "angle" else None
        path = [p if turn is None else p % turn for p in found.paths[regime.name]]
        knots = quantile_knots(path, _KNOTS)
        solved = _ordinates(found, port, path, knots, nominal, after)
        if solved is not None:
            values, errors, law, explained = solved
            laws = () if law is None else ((label, knots, law),)
            missing.append(MissingQuantity(_axis(regime), quantity, knots, values, errors, laws, explained))
    return tuple(missing)


def _axis(regime: Regime) -> Axis:
    return Axis(regime.name, regime.unit)


def _ordinates(
    found: Found,
    port: Port,
    path: Sequence[FloatArray],
    knots: FloatArray,
    nominal: Prediction,
    after: Prediction | None,
) -> tuple[FloatArray, FloatArray, FloatArray | None, float] | None:
    """Fit the (K,) ordinates of a piecewise-linear function beside the nominal parameters, linearly.

    Returns them with their standard errors, what the verdict's effects would have there, and the share of the
    residual's energy that is explained.
    """
    observed, fit = found.subject.observed, found.nominal.fit
    assert port.input is not None
    drives = [{port.input: [port.magnitude * b for b in one]} for one in hats(path, knots)]
    outcomes = found.subject.model.predict_driven(fit.values, drives)
    moved = [o for o in outcomes if not isinstance(o, SimulationError)]
    if len(moved) < len(outcomes):
        return None
    base = observed.residuals(nominal)
    columns = [stack([a - b for a, b in zip(observed.residuals(m), base, strict=True)], observed) for m in moved]
    steps = np.array([u.step for u in fit.unknowns])
    a = np.hstack([stack(fit.jacobian, observed) * steps, np.stack(columns, axis=1)])
    prior = np.concatenate([np.full(len(steps), 1e-3), np.full(len(knots), _PRIOR)])
    covariance = np.linalg.inv(a.T @ a + np.diag(prior**2))
    residual = stack(base, observed)
    solution = -covariance @ (a.T @ residual)
    left = float(np.mean((residual + a @ solution) ** 2))
    scale = max(1.0, left)
    own = slice(len(steps), None)
    errors = port.magnitude * np.sqrt(scale * np.diag(covariance)[own])
    law = None
    if after is not None:
        change = stack(observed.whiten([p - q for p, q in zip(after, nominal, strict=True)]), observed)
        law = port.magnitude * (covariance @ (a.T @ change))[own]
    return port.magnitude * solution[own], errors, law, 1.0 - left / float(np.mean(residual**2))
