"""Posterior samples from an affine-invariant ensemble sampler; only this module imports emcee."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmuid.core.errors import ProblemError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import EvaluateMany
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.uncertainty.confidence import Uncertainty

_LEVELS = (0.025, 0.16, 0.5, 0.84, 0.975)
_LENGTHS = 30.0  # least length of a chain, in autocorrelation times


@dataclass(frozen=True, slots=True)
class Posterior:
    """Draws of the free parameters from their posterior.

    Parameters
    ----------
    names
        Names of the free parameters.
    samples
        (draws, n), in model space.
    quantiles
        (n, 5): 2.5, 16, 50, 84 and 97.5 %.
    acceptance
        Mean share of accepted proposals.
    autocorrelation
        Number of steps between independent draws; the chain should be at least 30 times as long (`reliable`).
    temperature
        Divisor of the squared residuals: their variance times the number of samples per independent sample.
    reliable
        Whether the chain was long enough.
    """

    names: tuple[str, ...]
    samples: tuple[tuple[float, ...], ...]
    quantiles: tuple[tuple[float, ...], ...]
    acceptance: float
    autocorrelation: float
    temperature: float
    reliable: bool


def posterior_of(
    problem: Problem, estimate: Uncertainty, draws: int, *, seed: int, evaluate: EvaluateMany | None = None
) -> Posterior:
    """Return `draws` samples of the posterior of a problem's free parameters.

    The likelihood uses the actual variance of the residuals and the effective number of independent ones; the
    prior is that of the parameters, flat within the bounds if none is stated. Goodman and Weare's ensemble sampler
    (emcee; Foreman-Mackey and others, 2013).

    Raises
    ------
    ProblemError
        emcee is not installed, or the cost is not a sum of squares.
    """
    try:
        import emcee
    except ImportError:
        raise ProblemError("needs emcee", where="posterior", fix="pip install 'fmuid[bayes]'") from None
    if problem.combination.kind != "weighted_sum":
        raise ProblemError(
            "the cost is not a sum of squares", where="posterior", fix='use combine = "weighted_sum"'
        )
    evaluate = evaluate or problem.evaluate_many
    n, count = len(problem.space), len(problem.space.priors)
    samples = sum(w.samples for w in estimate.whiteness)
    effective = sum(w.effective for w in estimate.whiteness)
    (best,) = evaluate([np.array(estimate.point)])
    data = best.residuals[: len(best.residuals) - count]
    variance = float(data @ data) / max(len(data) - n - problem.nuisances, 1)
    temperature = variance * (samples / effective if effective > 0.0 else 1.0)

    def log_probability(points: FloatArray) -> FloatArray:
        inside = np.all((points >= problem.space.lower) & (points <= problem.space.upper), axis=1)
        log_density = np.full(len(points), -np.inf)
        for k, e in zip(
            np.flatnonzero(inside), evaluate(list(points[inside])) if inside.any() else [], strict=True
        ):
            if e.ok:
                split = len(e.residuals) - count
                likely, prior = e.residuals[:split], e.residuals[split:]
                log_density[k] = -0.5 * (float(likely @ likely) / temperature + float(prior @ prior))
        # A flat prior of the value is exp(x) in a logarithmic coordinate.
        logarithmic = [s.scale == "log" for s in problem.space.free]
        return np.asarray(log_density + points[:, logarithmic].sum(axis=1))

    walkers = max(4 * n, 12)
    steps = max(-(-2 * draws // walkers), 40)
    generator = np.random.default_rng(seed)
    covariance = np.array(estimate.covariance) + 1e-16 * np.eye(n)
    begin = generator.multivariate_normal(best.x, covariance, walkers, method="eigh")
    width = np.minimum(problem.space.upper - problem.space.lower, 1e6)
    begin = np.clip(begin, problem.space.lower + 1e-6 * width, problem.space.upper - 1e-6 * width)
    sampler = emcee.EnsembleSampler(walkers, n, log_probability, vectorize=True)
    sampler.random_state = np.random.RandomState(seed).get_state()
    sampler.run_mcmc(begin, steps)
    time = float(np.max(sampler.get_autocorr_time(tol=0)))
    chain = sampler.get_chain(discard=steps // 2, flat=True)[-draws:]
    drawn = np.array([list(map(problem.space.to_model(x).__getitem__, problem.space.names)) for x in chain])
    return Posterior(
        names=problem.space.names,
        samples=tuple(tuple(map(float, row)) for row in drawn),
        quantiles=tuple(tuple(map(float, np.quantile(column, _LEVELS))) for column in drawn.T),
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        autocorrelation=time,
        temperature=temperature,
        reliable=bool(0.5 * steps * walkers > _LENGTHS * time * 2 and time < 0.1 * steps),
    )
