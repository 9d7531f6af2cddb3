"""Analyses after the search of a stage: uncertainty, profiles, posterior, Monte Carlo and Pareto front."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from fmuid.core.campaign import AnalysisSpec, ParetoSpec
from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem.derivatives import EvaluateMany
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.result import at_bound
from fmuid.identification.solvers import Search
from fmuid.identification.solvers.nlopt_solver import NloptSolver
from fmuid.identification.solvers.pareto import Front, trace
from fmuid.identification.uncertainty.confidence import Uncertainty, uncertainty_of, with_held, without_intervals
from fmuid.identification.uncertainty.inherited import Held
from fmuid.identification.uncertainty.posterior import Posterior, posterior_of
from fmuid.identification.uncertainty.profiles import Profile, profile_of
from fmuid.identification.uncertainty.propagation import CriterionSpread, criteria_spread
from fmuid.simulation.runners import in_process

_EVALUATIONS = 40  # evaluations per parameter for one point of a front

Record = Callable[[Evaluation, str, bool], None]
"""Called with every evaluation, its purpose, and whether a resumed run will need its residuals."""


@dataclass(slots=True)
class Findings:
    """Results of the analyses that succeeded."""

    uncertainty: Uncertainty | None = None
    profiles: tuple[Profile, ...] = ()
    spread: tuple[CriterionSpread, ...] = ()
    posterior: Posterior | None = None
    front: Front | None = None
    warnings: list[str] = field(default_factory=list)


def analyse(search: Search, spec: AnalysisSpec, record: Record, held: Held | None = None) -> Findings:
    """Return the analyses requested by `spec` for the final estimate of `search`.

    An analysis that fails becomes a warning; the estimate remains valid. `held` are the parameters that the search
    fixed at estimates of earlier stages.
    """
    findings = Findings()
    best, problem = search.best, search.problem
    if best is None:
        return findings

    def evaluated(problem: Problem, points: Sequence[FloatArray]) -> list[Evaluation]:
        evaluations = {k: old for k, x in enumerate(points) if (old := search.recall(x, True)) is not None}
        missing = [k for k in range(len(points)) if k not in evaluations]
        # In this process, nothing is gained by waiting for all: an interrupted run then keeps every one.
        for block in [[k] for k in missing] if problem.runner is in_process else [missing]:
            evaluations |= zip(
                block, problem.evaluate_many([points[k] for k in block]) if block else (), strict=True
            )
            for k in block:
                record(evaluations[k], "uncertainty", True)
        return [evaluations[k] for k in range(len(points))]

    evaluate = partial(evaluated, problem)
    evaluate_held = None if held is None else partial(evaluated, held.problem)
    floor = search.noise_floor
    if spec.uncertainty:
        with _noted(findings, "no uncertainty"):
            free = uncertainty_of(
                problem, best, evaluate=evaluate, floor=floor, held=held, evaluate_held=evaluate_held
            )
            findings.uncertainty = without_intervals(free, _without_errors(search, best, free, findings.warnings))
            findings.warnings += free.notes
    if findings.uncertainty is not None:
        _profile(findings, findings.uncertainty, spec, search, evaluate)
        _spread(findings, findings.uncertainty, spec, search, (held, evaluate_held or evaluate))
        _sample(findings, findings.uncertainty, spec, search)
    if spec.pareto is not None:
        findings.front = _front(search, spec.pareto, best, record)
        if findings.front.beats_chosen:
            findings.warnings.append(
                "a point of the front is better than the estimate: continue the search, or use several starts"
            )
    return findings


def bounds_reached(problem: Problem, best: Evaluation, uncertainty: Uncertainty | None) -> dict[str, str]:
    """Return which bound, by name, each parameter at a bound is at, judged against its standard error if known."""
    errors: list[float | None] = [None] * len(problem.space)
    if uncertainty is not None:
        variances = np.maximum(np.diag(np.array(uncertainty.covariance)), 0.0)
        errors = [
            None if name in uncertainty.identifiability.undetermined else float(error)
            for name, error in zip(
                uncertainty.names, problem.space.slope(best.x) * np.sqrt(variances), strict=True
            )
        ]
    sides = {
        spec.name: at_bound(best.parameters[spec.name], spec.lower, spec.upper, error=e, log=spec.scale == "log")
        for spec, e in zip(problem.space.free, errors, strict=True)
    }
    return {name: side for name, side in sides.items() if side}


def _without_errors(search: Search, best: Evaluation, free: Uncertainty, warnings: list[str]) -> list[str]:
    """Return the parameters whose standard errors would not be valid; warnings say why."""
    problem = search.problem
    if problem.combination.kind != "weighted_sum":
        warnings.append(f"no standard errors: {problem.combination.kind} is not a sum of squares")
        return list(problem.space.names)
    if search.at_edge:  # where the estimate would lie without the edge is unknown
        return list(problem.space.names)
    return list(bounds_reached(problem, best, free))


def _profile(
    findings: Findings, estimate: Uncertainty, spec: AnalysisSpec, search: Search, evaluate: EvaluateMany
) -> None:
    """Add the profiles of parameters that are determined and not at a bound; warnings name the others."""
    if not spec.profiles:
        return
    for name in [n for n, e in zip(estimate.names, estimate.standard_errors, strict=True) if e is not None]:
        with _noted(findings, f"no profile of {name}"):
            profile = profile_of(search.problem, estimate, name, evaluate=evaluate, floor=search.noise_floor)
            findings.profiles += (profile,)


def _sample(findings: Findings, estimate: Uncertainty, spec: AnalysisSpec, search: Search) -> None:
    """Add samples of the posterior."""
    if not spec.posterior:
        return
    with _noted(findings, "no posterior"):
        findings.posterior = posterior_of(search.problem, estimate, spec.posterior, seed=search.seed)
        if not findings.posterior.reliable:
            findings.warnings.append(
                "the posterior's chain is too short for its autocorrelation: use more samples"
            )


def _spread(
    findings: Findings,
    estimate: Uncertainty,
    spec: AnalysisSpec,
    search: Search,
    joint: tuple[Held | None, EvaluateMany],
) -> None:
    """Add the criteria's spread over the uncertainty, `joint` with that of values fixed at earlier estimates."""
    if not spec.monte_carlo or estimate.degrees_of_freedom == 0.0:
        return
    held, evaluate = joint
    with _noted(findings, "no Monte Carlo"):
        findings.spread = criteria_spread(
            search.problem if held is None else held.problem,
            estimate if held is None else with_held(estimate, held),
            draws=spec.monte_carlo,
            seed=search.seed,
            evaluate=evaluate,
            floor=search.noise_floor,
        )


@contextmanager
def _noted(findings: Findings, what: str) -> Iterator[None]:
    try:
        yield
    except (ProblemError, SimulationError) as error:
        findings.warnings.append(f"{what}: {error}")


def _front(search: Search, spec: ParetoSpec, best: Evaluation, record: Record) -> Front:
    """Trace the front in a separate search, to which the stage's stop rules apply anew."""
    traced = Search(
        search.problem,
        search.stop,
        record=lambda evaluation, _, __: record(evaluation, "pareto", False),
        recall=search.recall,
        seed=search.seed,
        needs_residuals=False,
    )
    each = {"tolerance": 1e-4, "cost_tolerance": 1e-4, "evaluations": _EVALUATIONS * (len(search) + 2)}
    return trace(traced, spec, NloptSolver("cobyla", each), best)
