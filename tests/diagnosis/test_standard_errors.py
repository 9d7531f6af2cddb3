"""Standard errors of a diagnosis cover the truth whatever the colour of the noise, on a plant linear in two sizes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fmuid.data.noise.runs import RepeatedRuns
from fmuid.diagnosis.candidates import Fitted, errors_of_the_rest, standard_errors
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import Score, nominal_basis, stack
from fmuid.effects.effect import Unknown

TIME = 5e-3 * np.arange(200)
TRUTH = np.array([1.0, 0.5])
SHAPES = [
    np.stack([np.sin(2 * np.pi * (0.5 + 0.4 * e) * TIME), np.sign(np.sin(2 * np.pi * (0.9 + 0.3 * e) * TIME))])
    for e in range(3)
]
UNKNOWNS = tuple(Unknown(name, 0.0, -10.0, 10.0, step) for name, step in (("a", 1e-2), ("b", 1e-3)))


def drawn(generator, colour, repeats, drift=0.0):
    """Return the errors of an estimate and its standard errors, from runs with autoregressive noise."""
    runs = []
    for e, shape in enumerate(SHAPES):
        white = 0.1 * np.sqrt(1 - colour**2) * generator.standard_normal((repeats, 1, TIME.size + 100))
        noise = lfilter([1.0], [1.0, -colour], white)[..., 100:]
        noise = noise + drift * generator.standard_normal((repeats, 1, 1))
        runs.append(RepeatedRuns(f"e{e}", "bench", TIME, ("y",), TRUTH @ shape + noise))
    observed = Observed.from_runs(runs)
    jacobian = tuple(
        np.stack([whiten(row[None]).ravel() for row in shape], axis=1)
        for shape, whiten in zip(SHAPES, observed.whiteners, strict=True)
    )
    nothing = observed.residuals([np.zeros((1, TIME.size))] * 3)
    values = -np.linalg.lstsq(stack(jacobian, observed), stack(nothing, observed))[0]
    prediction = [(values @ shape)[None] for shape in SHAPES]
    left = observed.residuals(prediction)
    cost = float(np.sum(stack(left, observed) ** 2))
    fit = Refit(UNKNOWNS, dict(zip("ab", values, strict=True)), left, jacobian, cost, 1, True)
    return values - TRUTH, standard_errors(fit, observed, prediction)


@pytest.mark.parametrize(("colour", "repeats"), [(0.0, 3), (0.95, 2), (0.95, 5)])
def test_two_standard_errors_cover_the_truth(colour, repeats):
    generator = np.random.default_rng(1)
    off, errors = (np.array(x) for x in zip(*(drawn(generator, colour, repeats) for _ in range(150)), strict=True))
    covered = np.mean(np.abs(off) < 1.96 * errors, axis=0)
    assert np.all(covered >= 0.90)
    # Nor are they wider than they need be.
    assert np.sqrt(np.mean(errors**2, axis=0)) == pytest.approx(np.std(off, axis=0), rel=0.5)


def test_sizes_that_no_run_tells_apart_or_that_move_nothing_have_none():
    generator = np.random.default_rng(2)
    _, errors = drawn(generator, 0.0, 3)
    assert np.all(errors > 0.0)
    noise = 0.1 * generator.standard_normal((3, 1, TIME.size))
    observed = Observed.from_runs([RepeatedRuns("e", "bench", TIME, ("y",), noise)])
    column = observed.whiten([SHAPES[0][:1]])[0]
    nothing = [np.zeros((1, TIME.size))]
    for other, known in ((column, (False, False)), (np.zeros_like(column), (True, False))):
        fit = Refit(UNKNOWNS, {}, observed.residuals(nothing), (np.stack([column, other], axis=1),), 0.0, 1, True)
        assert tuple(np.isfinite(standard_errors(fit, observed, nothing))) == known


def test_errors_cover_what_small_effects_that_the_model_lacks_do_to_an_estimate():
    generator = np.random.default_rng(3)
    others = [np.array([[np.cos(w * TIME + e)] for e in range(3)]) for w in (2.0, 4.0, 7.0, 9.0, 12.0)]
    covered, widened = [], []
    for _ in range(150):
        sizes = 0.02 * generator.standard_normal(len(others))
        runs = []
        for e, shape in enumerate(SHAPES):
            noise = 0.1 * generator.standard_normal((3, 1, TIME.size))
            lacking = sum(size * other[e] for size, other in zip(sizes, others, strict=True))
            runs.append(RepeatedRuns(f"e{e}", "bench", TIME, ("y",), TRUTH @ shape + lacking + noise))
        observed = Observed.from_runs(runs)
        jacobian = tuple(
            np.stack([whiten(row[None]).ravel() for row in shape], axis=1)
            for shape, whiten in zip(SHAPES, observed.whiteners, strict=True)
        )
        nothing = observed.residuals([np.zeros((1, TIME.size))] * 3)
        values = -np.linalg.lstsq(stack(jacobian, observed), stack(nothing, observed))[0]
        prediction = [(values @ shape)[None] for shape in SHAPES]
        fit = Refit(
            UNKNOWNS, dict(zip("ab", values, strict=True)), observed.residuals(prediction), jacobian, 0.0, 1, True
        )
        fitted = Fitted((), fit, None, None, 0.0)
        basis = nominal_basis(fit, observed)
        scores = []
        for k, other in enumerate(others):
            response = stack(observed.whiten(list(other)), observed)
            left = response - basis @ (basis.T @ response)
            length = float(np.linalg.norm(left))
            scores.append(
                Score(str(k), {}, 0.0, 0.0, 0.0, left / length, length=length, within=basis.T @ response)
            )
        noise = standard_errors(fit, observed, prediction)
        rest = errors_of_the_rest(fitted, observed, fitted, scores)
        off = np.abs(values - TRUTH)
        covered.append((off < 1.645 * noise, off < 1.645 * np.hypot(noise, rest)))
        widened.append(
            errors_of_the_rest(replace(fitted, effects=("0", "1", "2", "3", "4")), observed, fitted, scores)
        )
    alone, together = np.mean(covered, axis=0)
    assert np.all(alone < 0.75)
    assert np.all(np.abs(together - 0.9) <= 0.08)
    assert not np.any(widened)  # a model that has every effect lacks none
