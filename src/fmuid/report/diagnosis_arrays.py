"""Conversion of a diagnosis to the arrays that its report draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.formulas import parse_modelica
from fmuid.core.immutable import FloatArray
from fmuid.diagnosis.diagnose import Found
from fmuid.diagnosis.extended_model import Prediction
from fmuid.diagnosis.free_functions import Basis, folded, hats, quantile_knots, times, trajectories
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import stack
from fmuid.effects.effect import Effect, Port, Regime
from fmuid.effects.quantities import words_of
from fmuid.report.diagnosis_figures import (
    Branch,
    DiagnosisPictures,
    ExcessEnergy,
    MissingQuantity,
    RegimeBins,
)
from fmuid.report.figures import Overlay
from fmuid.report.plots.figure_data import Axis, Role

_KNOTS = 11
_CURVE_KNOTS = 25  # knots of the free function added to a law, enough to show standstill
_CURVE = 400  # points of a law's curve
_PANELS = 3  # number of variables shown, those that explain most
_ONE_WAY = 0.05  # share of samples in the rarer direction, below which directions are not separated
_SAME = 1e-6  # share of their range by which two variables differ that are one
_PRIOR = 1.0 / 30.0  # an ordinate that no signal shows stays within thirty magnitudes of zero


def pictures_of(outcome: Found, corrected: Prediction | None = None) -> DiagnosisPictures:
    """Return the arrays behind the figures of a diagnosis; simulates the campaign about sixty times.

    `corrected` is the prediction of a model with a law or a table that is in no answer.

    Raises
    ------
    SimulationError
        The refitted nominal model cannot be simulated.
    """
    models = outcome.surviving
    nominal, *with_effects = outcome.subject.model.predict(
        [outcome.nominal.fit.values, *(m.fit.values for m in models)]
    )
    if isinstance(nominal, SimulationError):
        raise nominal
    laws = {
        " + ".join(model.effects): prediction
        for model, prediction in zip(models, with_effects, strict=True)
        if not isinstance(prediction, SimulationError)
    }
    after = next(iter(laws.values()), None) if corrected is None else corrected
    missing = _coefficients(outcome) or _curves(outcome) or _missing(outcome, nominal, laws)
    return DiagnosisPictures(_overlays(outcome, nominal, after), _excess(outcome), missing, _steps(outcome))


def _steps(outcome: Found) -> dict[str, float]:
    """Return the gaps that the first effects of the verdict leave without the later ones."""
    if outcome.best is None:
        return {}
    parts = [outcome.best.effects[:k] for k in range(1, len(outcome.best.effects))]
    return {" + ".join(c.effects): c.gap for part in parts for c in outcome.candidates if c.effects == part}


def _overlays(outcome: Found, before: Prediction, after: Prediction | None) -> tuple[Overlay, ...]:
    """Return the signal with the most excess energy of each setup."""
    cases = {case.id: case for case in outcome.subject.model.cases}
    runs = {run.id: k for k, run in enumerate(outcome.subject.observed.runs)}
    overlays: dict[str, Overlay] = {}
    for row in np.argsort(-outcome.excess.energy):
        experiment, signal = outcome.excess.rows[row]
        index = runs[experiment]
        run = outcome.subject.observed.runs[index]
        if run.setup in overlays:
            continue
        c = run.channels.index(signal)
        measured = np.where(run.mask[c] > 0, run.mean[c], np.nan)
        sigma = outcome.subject.observed.noise[run.setup].sigma[signal]
        channel = cases[experiment].channels[c]
        convert = channel.to_shown
        lines: list[tuple[str, Role, FloatArray]] = [("nominal, refitted", "before", convert(before[index][c]))]
        if after is not None:
            lines.append(("corrected", "after", convert(after[index][c])))
        overlays[run.setup] = Overlay(
            experiment,
            signal,
            channel.shown_unit,
            run.time,
            convert(measured),
            tuple(lines),
            f"{experiment}: {signal}",
            float(abs(convert.factor) * sigma / np.sqrt(run.n_repeats)),
        )
    return tuple(overlays.values())


def _excess(outcome: Found) -> ExcessEnergy | None:
    energy = outcome.excess
    total = float(energy.energy.sum())
    if total <= 0.0:
        return None
    regimes = outcome.subject.catalogue.regimes
    axes = {r.name: Axis(r.name, r.unit) for r in regimes.values()} | {"time": Axis("time", "s")}
    bins = tuple(RegimeBins(axes.get(name, Axis(name)), edges) for name, edges in energy.edges.items())
    share = np.hstack([energy.binned[name] for name in energy.edges]) * energy.energy[:, None] / total
    return ExcessEnergy(energy.rows, bins, share)


def _coefficients(outcome: Found) -> tuple[MissingQuantity, ...]:
    """Return the coefficients that vary in the best answer, over what they depend on."""
    best = outcome.diagnosis.best
    courses = {id: c for id, c in outcome.courses.items() if best is not None and id in best.effects}
    return tuple(
        MissingQuantity(
            Axis(c.over, c.over_unit),
            Axis(c.name, c.unit),
            (Branch(np.empty(0), np.empty(0), np.empty(0), ((id, c.x, c.y),)),),
        )
        for id, c in courses.items()
    )


def _curves(outcome: Found) -> tuple[MissingQuantity, ...]:
    """Return the laws of the best answer as curves, with what the measurements say about them.

    A curve is the law plus a free function of its variable, fitted to the residual of the corrected model: a
    partial-residual
    plot (Larsen and McCleary 1972). Empty unless every law is a function of one variable.
    """
    best, catalogue = outcome.surviving[0] if outcome.surviving else None, outcome.subject.catalogue
    if best is None:
        return ()
    (after,) = outcome.subject.model.predict([best.fit.values])
    effects = [e for e in outcome.subject.effects if e.id in best.effects]
    laws = [_law(e, best.fit.values, catalogue.regimes) for e in effects]
    if isinstance(after, SimulationError):
        return ()
    curves = []
    for effect, law in zip(effects, laws, strict=True):
        port = catalogue.ports.get(effect.port)
        if law is None or port is None or port.input is None:
            return ()
        regime, value = law
        path = trajectories(outcome.subject.model, best.fit.values, {regime.name: regime})[regime.name]
        turns = np.linspace(0.0, 2 * np.pi, _CURVE)
        if regime.kind == "angle" and np.allclose(value(turns), value(turns + 2 * np.pi)):
            path = tuple(p % (2 * np.pi) for p in path)
        knots = quantile_knots(path, _CURVE_KNOTS)
        columns = [k for k, u in enumerate(best.fit.unknowns) if u in outcome.subject.nominal]
        solved = _ordinates(outcome, port, hats(path, knots), after, fit=best.fit, columns=columns)
        if solved is None:
            return ()
        values, errors, _, _ = solved
        x = np.linspace(knots[0], knots[-1], _CURVE)
        line = (effect.id, x, value(x))
        branch = Branch(knots, value(knots) + values, errors, (line,))
        quantity = Axis(f"missing at {port.name}", port.unit)
        curves.append(MissingQuantity(Axis(regime.name, regime.unit), quantity, (branch,)))
    return tuple(curves)


def _law(
    effect: Effect, values: Mapping[str, float], regimes: Mapping[str, Regime]
) -> tuple[Regime, Callable[[FloatArray], FloatArray]] | None:
    """Return the variable that a law depends on, and its function; None if there is no such variable."""
    if not effect.expression or effect.acts != "flow" or effect.states:
        return None
    try:
        formula = parse_modelica(effect.expression)
    except ProblemError:  # it has an `if`, or depends on a derivative
        return None
    sizes = {u.name: np.asarray(values[u.name]) for u in effect.unknowns}
    names = sorted(formula.names - sizes.keys())
    words = [f"{effect.port} {word}" for name in names for word in words_of(name)]
    at_state = (r.name for r in regimes.values() if r.variable in names)  # laws there use the FMU's names
    regime = next((regimes[name] for name in (*words, *at_state) if name in regimes), None)
    if len(names) != 1 or regime is None:
        return None
    return regime, lambda x: formula.of_samples({names[0]: x, **sizes}) * np.ones_like(x)


def _missing(outcome: Found, nominal: Prediction, laws: Mapping[str, Prediction]) -> tuple[MissingQuantity, ...]:
    """Return the contribution that a free function of each regime variable has to make at the verdict's port.

    A law is drawn as the free function that moves the nominal model in the same way as its effects.
    """
    place = outcome.diagnosis.verdict.ports[:1]
    port = outcome.subject.catalogue.ports.get("".join(place))
    if port is None or port.input is None:
        return ()
    quantity = Axis(f"missing at {port.name}", port.unit)
    missing = []
    of_port = [r for r in outcome.subject.catalogue.regimes.values() if not r.ports or port.name in r.ports]
    for k, regime in enumerate(of_port):
        if any(_alike(regime, other, outcome.paths) for other in of_port[:k]):
            continue
        parts = _parts(outcome, regime)
        basis = tuple(b for _, _, of_basis in parts for b in of_basis)
        columns = range(len(outcome.nominal.fit.unknowns))
        solved = _ordinates(
            outcome, port, basis, nominal, fit=outcome.nominal.fit, columns=columns, laws=list(laws.values())
        )
        if solved is None:
            continue
        values, errors, lines, explained = solved
        ends = np.cumsum([len(knots) for _, knots, _ in parts])
        branches = []
        for (direction, knots, _), end in zip(parts, ends, strict=True):
            of_basis = slice(end - len(knots), end)
            named = tuple((name, knots, line[of_basis]) for name, line in zip(laws, lines, strict=True))
            branches.append(Branch(knots, values[of_basis], errors[of_basis], named, direction))
        missing.append(MissingQuantity(Axis(regime.name, regime.unit), quantity, tuple(branches), explained))
    return tuple(sorted(missing, key=lambda m: -(m.explained or 0.0)))[:_PANELS]


def _alike(regime: Regime, other: Regime, paths: Mapping[str, Sequence[FloatArray]]) -> bool:
    """Return whether two variables are one, as the positions on both sides of a rigid connection are."""
    if regime.kind != other.kind:
        return False
    path_of, others = (path - path.mean() for path in (np.concatenate(paths[r.name]) for r in (regime, other)))
    size = max(np.abs(path_of).max(), np.abs(others).max())
    return bool(np.abs(path_of - others).max() <= _SAME * size)


def _parts(outcome: Found, regime: Regime) -> list[tuple[str, FloatArray, Basis]]:
    """Return piecewise-linear functions of a regime and their knots, for each direction if it goes both ways."""
    path = folded(outcome.paths, outcome.subject.catalogue.regimes)[regime.name]
    speed = next((r.name for r in outcome.subject.catalogue.regimes.values() if r.kind == "speed"), None)
    if regime.kind != "speed" and speed is not None:
        forward = [w > 0.0 for w in outcome.paths[speed]]
        share = np.mean(np.concatenate(forward))
        if _ONE_WAY <= share <= 1.0 - _ONE_WAY:
            ways = {"forward": forward, "backward": [~f for f in forward]}
            return [(name, *_functions(path, taken)) for name, taken in ways.items()]
    return [("", *_functions(path, [np.ones(len(p), dtype=bool) for p in path]))]


def _functions(path: Sequence[FloatArray], taken: Sequence[NDArray[np.bool_]]) -> tuple[FloatArray, Basis]:
    knots = quantile_knots([p[t] for p, t in zip(path, taken, strict=True) if t.any()], _KNOTS)
    return knots, times(hats(path, knots), [t.astype(float) for t in taken])


def _ordinates(
    outcome: Found,
    port: Port,
    basis: Basis,
    prediction: Prediction,
    *,
    fit: Refit,
    columns: Sequence[int],
    laws: Sequence[Prediction] = (),
) -> tuple[FloatArray, FloatArray, list[FloatArray], float] | None:
    """Fit the (K,) ordinates of functions at a port together with the nominal parameters of a model, linearly.

    `prediction` is the model's at its `fit`, whose Jacobian has the nominal parameters in `columns`. Returns the
    ordinates with their standard errors, the ordinates that the models with effects would have, and the explained
    share of the residual's energy; None if one cannot be simulated.
    """
    observed = outcome.subject.observed
    assert port.input is not None
    outcomes = outcome.subject.model.moved_by(fit.values, port.input, port.magnitude, basis)
    moved = [o for o in outcomes if not isinstance(o, SimulationError)]
    if len(moved) < len(outcomes):
        return None
    base = observed.residuals(prediction)
    shown = [stack(observed.whiten(m), observed) for m in moved]
    steps = np.array([fit.unknowns[k].step for k in columns])
    a = np.hstack([stack(fit.jacobian, observed)[:, columns] * steps, np.stack(shown, axis=1)])
    prior = np.concatenate([np.full(len(steps), 1e-3), np.full(len(basis), _PRIOR)])
    covariance = np.linalg.inv(a.T @ a + np.diag(prior**2))
    residual = stack(base, observed)
    solution = -covariance @ (a.T @ residual)
    left = float(np.mean((residual + a @ solution) ** 2))
    of_port = slice(len(steps), None)
    errors = port.magnitude * np.sqrt(max(1.0, left) * np.diag(covariance)[of_port])
    lines = []
    for law in laws:
        change = stack(observed.whiten([p - q for p, q in zip(law, prediction, strict=True)]), observed)
        lines.append(port.magnitude * (covariance @ (a.T @ change))[of_port])
    return port.magnitude * solution[of_port], errors, lines, 1.0 - left / float(np.mean(residual**2))
