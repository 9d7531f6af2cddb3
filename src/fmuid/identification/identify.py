"""The one entry point: from a campaign (or a problem) to its result."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fmuid.core.campaign import SEPARATOR, AnalysisSpec, Campaign, ParameterSpec, StageSpec, without_owner
from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.folder_lock import claim
from fmuid.core.formatting import shortened
from fmuid.core.one_thread import in_one_thread
from fmuid.identification.analyses import Findings, analyse, bounds_reached
from fmuid.identification.history import History
from fmuid.identification.misfit import misfit, unexplained
from fmuid.identification.observer import Observer, Progress
from fmuid.identification.problem.cases import experiments_of
from fmuid.identification.problem.estimation_problem import Problem
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.problem.solver_error import UNSEEN, check_repeatable
from fmuid.identification.problem.zero_starts import sized
from fmuid.identification.provenance import fingerprint, hashes_of, versions
from fmuid.identification.result import FILE, CriterionValue, Estimate, Result, StageResult, finite
from fmuid.identification.solvers import Outcome, Search, Solver, Status, StopRules, StopSearch, make
from fmuid.identification.solvers.pareto import Objectives
from fmuid.identification.uncertainty.between_machines import MachineSpread, machine_spread
from fmuid.identification.uncertainty.confidence import Uncertainty
from fmuid.identification.uncertainty.earlier_stages import Known
from fmuid.simulation.pool.choice import runner_on
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator

_ALIKE = 0.99
_REASONS = 3  # why candidates failed: the most frequent ones
_INTERRUPTED = Outcome(Status.INTERRUPTED, "stopped by the user")
_LIBRARIES = ("fmuid", "numpy", "scipy", "nlopt")


@dataclass(frozen=True, slots=True)
class _Run:
    """State shared by the stages of one identification."""

    history: History
    observer: Observer
    seed: int
    specs: Mapping[str, ParameterSpec]
    identified: set[str] = field(default_factory=set)  # by the stages so far
    later: Mapping[str, None] = field(default_factory=dict)  # free in a stage of the campaign


@dataclass(frozen=True, slots=True)
class _Posed:
    """One stage, ready to be solved."""

    problem: Problem
    solver: str = "auto"
    options: Mapping[str, Any] = field(default_factory=dict)
    stop: StopRules = field(default_factory=StopRules)
    analyses: AnalysisSpec = field(default_factory=AnalysisSpec)


@in_one_thread
def identify(
    what: Campaign | Problem | str | Path,
    *,
    out: str | Path | None = None,
    stages: Iterable[str] | None = None,
    solver: str | None = None,
    options: Mapping[str, Any] | None = None,
    stop: StopRules | None = None,
    resume: bool = False,
    executor: Executor | None = None,
    workers: int | None = 0,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    observer: Observer | None = None,
    simulators: Mapping[str, Simulator] | None = None,
    seed: int = 0,
    with_uncertainty: bool = True,
    analyses: AnalysisSpec | None = None,
    trust: bool = False,
) -> Result:
    """Estimate the free parameters of a campaign, stage by stage, or of a single problem.

    Parameters
    ----------
    what
        A campaign, the path of one, or a problem.
    out
        Run folder for result and history; None keeps both in memory. An interrupted run there is never replaced.
    stages
        Names of the stages to run, in the campaign's order; all by default.
    solver, options
        Override the stages' solver (see `fmuid.identification.solvers`) and its options.
    stop
        Override the stages' budgets.
    resume
        Continue the interrupted run in `out` without repeating its simulations.
    executor
        Any `concurrent.futures` executor to simulate on, such as a Dask client's; results do not depend on it.
    workers
        Number of supervised worker processes to simulate in instead (`fmuid.simulation.pool.workers`); 0 for none,
        None for one per processor.
    time_limit, memory_limit
        Seconds and resident bytes that one simulation may take in a worker process; by default those of a
        `WorkerPool`.
    observer
        Receives progress reports.
    simulators
        Models by setup; the campaign's FMUs by default.
    seed
        Seed for random solvers and start points.
    with_uncertainty
        Whether each stage ends with its uncertainty analysis.
    analyses
        Analyses after every stage, instead of those in the campaign.
    trust
        Whether functions that the campaign names may be called, if `what` is a path; see `load_campaign`.

    Returns
    -------
    Result
        Also after Ctrl-C: the status says so, and the result contains the best values so far.

    Raises
    ------
    FmuidError
        The campaign, a model or a stage cannot be used as given; another process is writing to `out`; or `out`
        contains an interrupted run and `resume` is False.

    Examples
    --------
    >>> result = fmuid.identify("tank")  # a folder with campaign.toml
    >>> round(result.parameters["G"], 1)
    8.0
    >>> low, high = result.stages[0]["G"].interval
    >>> low < 8.0 < high
    True
    """
    begin = clock.perf_counter()
    campaign = _campaign(what, trust) if not isinstance(what, Problem) else None
    folder = None if out is None else Path(out)
    if isinstance(what, Problem):
        plan: list[StageSpec | Problem] = [what]
        specs = {spec.name: spec for spec in what.space.free}
    else:
        assert campaign is not None
        plan = list(_chosen(campaign, stages))
        specs = dict(campaign.parameters)
        simulators = simulators or _models(campaign)

    def posed(step: StageSpec | Problem, best: Mapping[str, float], runner: Runner | None) -> _Posed:
        original = _posed(step, campaign, simulators or {}, best, runner)
        if solver is not None:
            original = replace(original, solver=solver, options={})
        wanted = analyses or original.analyses
        return replace(
            original,
            options=dict(original.options if options is None else options),
            stop=stop or original.stop,
            analyses=replace(wanted, uncertainty=wanted.uncertainty and with_uncertainty),
        )

    for step in plan:  # ill-posed or unsolvable stages are reported before anything is written
        _check(posed(step, {}, None))
    results: list[StageResult] = []
    best: dict[str, float] = {}
    known = Known()
    summary = Result(
        campaign=campaign.name if campaign else plan[0].name,
        title=campaign.title if campaign else "",
        source=str(campaign.folder.resolve()) if campaign else "",
        stages=(),
        parameters={},
        versions=versions(_LIBRARIES),
        inputs=hashes_of(campaign) if campaign else {},
        recordings=_recordings(campaign, plan) if campaign else (),
        folder=None if folder is None else str(folder),
    )
    with (
        runner_on(workers, executor=executor, time_limit=time_limit, memory_limit=memory_limit) as runner,
        nullcontext() if folder is None else claim(folder),
        History(folder, resume=resume, begun=summary.encoded(folder)) as history,
    ):
        free = (n for stage in (campaign.stages.values() if campaign else ()) for n in stage.free)
        run = _Run(history, observer or Observer(), seed, specs, later=dict.fromkeys(free))
        for step in plan:
            asked = posed(step, best, runner)
            asked = replace(asked, problem=sized(asked.problem))
            here, nowhere = asked.problem.space.tried(asked.problem.space.start)
            if isinstance(step, Problem) and nowhere is None and not history.stages:  # others were when posed
                check_repeatable(step.cases, [case.start_values(here) for case in step.cases], step.runner)
            result = _stage(run, asked, known)
            results.append(result)
            run.identified.update(map(without_owner, asked.problem.space.names), asked.problem.space.ties)
            best = dict(result.parameters)
            if asked.analyses.uncertainty:
                known = known.after(asked.problem, result.uncertainty, best)
            if result.status is Status.INTERRUPTED:
                break
        summary = replace(summary, stages=tuple(results), parameters=best, seconds=clock.perf_counter() - begin)
        # A kill between any two of these steps leaves enough to read the result from.
        history.conclude(summary.encoded(folder))
        if folder is not None:
            summary.to_json(folder / FILE)
        history.close(complete=summary.status is not Status.INTERRUPTED)
    return summary


def _recordings(campaign: Campaign, stages: Iterable[StageSpec | Problem]) -> tuple[str, ...]:
    runs = (
        run.digest
        for stage in stages
        if isinstance(stage, StageSpec)
        for run in experiments_of(campaign, stage.experiments, where=f"stage '{stage.name}'")
    )
    return tuple(sorted(set(runs)))


def check_stages(campaign: Campaign, simulators: Mapping[str, Simulator]) -> None:
    """Raise the errors that `identify` would raise before its first simulation.

    Raises
    ------
    FmuidError
        A stage is ill-posed, or cannot be solved with the requested solver.
    """
    for stage in campaign.stages.values():
        _check(_posed(stage, campaign, simulators, {}, None))


def _check(asked: _Posed) -> None:
    try:
        make(asked.solver, asked.options, asked.problem)
        if asked.analyses.pareto is not None:
            Objectives.of(asked.problem, asked.analyses.pareto.objectives)
    except ProblemError as error:
        where = error.where or f"stage '{asked.problem.name}'"
        raise ProblemError(error.what, where=where, fix=error.fix) from None


def _stage(run: _Run, asked: _Posed, known: Known) -> StageResult:
    """Run one stage, or take its result from the history; `known` are the errors of earlier estimates."""
    problem, stop = asked.problem, asked.stop
    solver, why = make(asked.solver, asked.options, problem)
    seed = int(asked.options.get("seed", run.seed))
    begun = _begun(run, problem, solver, why)
    recorded = run.history.begin(
        problem, fingerprint(problem, solver, asked.options, seed), msgspec.json.encode(begun)
    )
    if recorded.result is not None and recorded.asked == repr(asked.analyses):
        result = msgspec.json.decode(recorded.result, type=StageResult)
        run.observer.finished(result)
        return result
    run.observer.started(problem, solver.name, why, stop)
    begin = clock.perf_counter()
    start_cost: list[float] = []
    search = Search(
        problem,
        stop,
        record=lambda evaluation, purpose, improved: record(evaluation, purpose, improved),
        recall=lambda x, residuals: run.history.recall(problem.name, x, residuals),
        seed=seed,
        needs_residuals=solver.needs_residuals,
    )

    def record(evaluation: Evaluation, purpose: str, improved: bool) -> None:
        run.history.record(problem.name, evaluation, purpose, improved, residuals=search.needs_residuals)
        reached = search.best
        if evaluation.ok and not start_cost:
            start_cost.append(evaluation.cost)
        run.observer.evaluated(
            Progress(
                problem.name,
                search.evaluations,
                search.failures,
                clock.perf_counter() - begin,
                None if reached is None else reached.cost,
                start_cost[0] if start_cost else None,
                None if reached is None else {n: reached.parameters[n] for n in problem.space.names},
                stop,
            )
        )

    first: Evaluation | None = None
    try:
        first = search.evaluate(problem.space.start, differentiated=solver.name in ("trf", "lm"))
        outcome = solver.solve(search, problem.space.start)
    except StopSearch as stopped:
        outcome = stopped.outcome
    except KeyboardInterrupt:
        outcome = _INTERRUPTED
    except SimulationError as error:
        outcome = Outcome(Status.FAILED, str(error))
    findings = Findings()
    if outcome is not _INTERRUPTED:
        try:
            findings = _findings(run, asked, known, search)
        except KeyboardInterrupt:
            outcome = _INTERRUPTED
    result = _result(
        run,
        problem,
        search=search,
        first=first,
        outcome=outcome,
        solver=solver,
        why=why,
        findings=findings,
        seconds=clock.perf_counter() - begin,
    )
    if outcome is not _INTERRUPTED:
        run.history.finish(problem.name, msgspec.json.encode(result), repr(asked.analyses))
    run.observer.finished(result)
    return result


def _findings(run: _Run, asked: _Posed, known: Known, search: Search) -> Findings:
    """Return the analyses of the stage's estimate; the runs for them are also recorded."""
    problem = asked.problem
    findings = analyse(
        search,
        asked.analyses,
        lambda e, why, kept: run.history.record(problem.name, e, why, False, residuals=kept),
        known.held_in(problem, run.specs) if asked.analyses.uncertainty else None,
    )
    if unsure := sorted(n for n in known.unsure if n in problem.space.fixed and problem.sees(n)):
        findings.warnings.append(
            f"treated as exactly known, because they have no standard error: {', '.join(unsure)}"
        )
    return findings


def _begun(run: _Run, problem: Problem, solver: Solver, why: str) -> StageResult:
    """Return the result of a stage without an evaluation; its criteria are to be filled in."""
    nothing = Search(problem)
    begun = _result(
        run,
        problem,
        search=nothing,
        first=None,
        outcome=_INTERRUPTED,
        solver=solver,
        why=why,
        findings=Findings(),
        seconds=0.0,
    )
    criteria = tuple(CriterionValue(case.id, criterion.label, None, 0.0) for case, criterion in problem.criteria)
    return replace(begun, criteria=criteria, warnings=())


def _result(
    run: _Run,
    problem: Problem,
    *,
    search: Search,
    first: Evaluation | None,
    outcome: Outcome,
    solver: Solver,
    why: str,
    findings: Findings,
    seconds: float,
) -> StageResult:
    best, uncertainty = search.best, findings.uncertainty
    values = problem.space.tried(problem.space.start)[0] if best is None else dict(best.parameters)
    values = {name: value for name, value in values.items() if math.isfinite(value)}  # no tie without a value
    held = _unidentified(run, problem, best) if best is not None and uncertainty is not None else ()
    bounds = {} if best is None else bounds_reached(problem, best, uncertainty)
    estimates = []
    for i, free in enumerate(problem.space.free):
        spec = run.specs.get(without_owner(free.name), free)
        estimates.append(
            Estimate(
                free.name,
                values[free.name],
                free.start,
                spec.unit,
                finite(free.lower),
                finite(free.upper),
                None if uncertainty is None else uncertainty.standard_errors[i],
                None if uncertainty is None else uncertainty.intervals[i],
                bounds.get(free.name),
                spec.truth,
                spec.description,
                None
                if uncertainty is None or uncertainty.standard_errors[i] is None
                else uncertainty.inherited_shares[i],
                free.scale,
                tuple(n for n in spec.depends_on if n not in values),
                _note(free.name, uncertainty, held),
            )
        )
    for name in problem.space.ties:
        if name in values and name in run.specs and run.specs[name].truth is not None:
            spec = run.specs[name]
            estimates.append(
                Estimate(name, values[name], spec.start, spec.unit, truth=spec.truth, description="tied")
            )
    started = first is not None and first.ok
    criteria = tuple(
        CriterionValue(
            case.id,
            criterion.label,
            float(first.criteria[k]) if first is not None and started else None,
            float(best.criteria[k]),
        )
        for k, (case, criterion) in enumerate(problem.criteria)
        if best is not None
    )
    return StageResult(
        name=problem.name,
        status=outcome.status if best is not None or outcome.status is Status.INTERRUPTED else Status.FAILED,
        message=outcome.message,
        solver=solver.name,
        why=why,
        estimates=tuple(estimates),
        experiments=tuple(e for case in problem.cases for e in case.experiments or (case.id,)),
        criteria=criteria,
        start_cost=finite(first.cost) if first is not None and started else None,
        cost=None if best is None else best.cost,
        evaluations=search.evaluations,
        failures=search.failures,
        seconds=seconds,
        starts=tuple(search.starts),
        links=tuple(search.links),
        uncertainty=uncertainty,
        warnings=(
            *problem.findings,
            *_misfit(problem, first, best, outcome),
            *_warnings(search, outcome, estimates, uncertainty),
            *(
                [f"conditional on values that only later stages identify: {shortened(', '.join(held))}"]
                if held
                else []
            ),
            *findings.warnings,
        ),
        ties={name: expression.text for name, expression in problem.space.ties.items()},
        parameters=values,
        profiles=findings.profiles,
        spread=findings.spread,
        front=findings.front,
        posterior=findings.posterior,
        machines=_machines(estimates, problem.space.free, uncertainty),
        unexplained=()
        if best is None or uncertainty is None
        else unexplained(problem, best, uncertainty.whiteness),
    )


def _unidentified(run: _Run, problem: Problem, best: Evaluation) -> tuple[str, ...]:
    """Return the parameters that only a later stage identifies, if they affect this one: moved by a hundredth."""
    space = problem.space
    names = [n for n in run.later if n in space.fixed and n not in run.identified and problem.sees(n)]
    if not names:
        return ()
    moved = {n: space.fixed[n] * (1.01 if 1.01 * space.fixed[n] <= run.specs[n].upper else 0.99) for n in names}
    there = problem.over(replace(space, fixed={**space.fixed, **moved})).evaluate(best.x)
    here = best if best.residuals.size else problem.evaluate(best.x)
    unmoved = there.ok and float(np.linalg.norm(there.residuals - here.residuals)) < UNSEEN
    return () if unmoved else tuple(names)


def _note(name: str, uncertainty: Uncertainty | None, held: Sequence[str]) -> str:
    if uncertainty is None or uncertainty.standard_errors[uncertainty.names.index(name)] is None:
        return ""
    marks = ["robust"] * (name in uncertainty.robust)
    if name in uncertainty.few_runs:
        marks.append("one run" if uncertainty.few_runs[name] == 1 else "few runs")
    marks += ["biased"] * (name in uncertainty.biased) + ["conditional"] * bool(held)
    return ", ".join(marks)


def _misfit(
    problem: Problem, first: Evaluation | None, best: Evaluation | None, outcome: Outcome
) -> tuple[str, ...]:
    if best is None or outcome is _INTERRUPTED:
        return ()
    return misfit(problem, first if first is not None and first.ok else None, best)


def _machines(
    estimates: Sequence[Estimate], free: Sequence[ParameterSpec], uncertainty: Uncertainty | None
) -> tuple[MachineSpread, ...]:
    """Return, for each parameter with one value per machine, its spread over the machines."""
    groups: dict[str, dict[str, Estimate]] = {}
    by_name = {e.name: e for e in estimates}
    degrees = {} if uncertainty is None else dict(zip(uncertainty.names, uncertainty.freedom, strict=True))
    for spec in free:
        name, separator, machine = spec.name.partition(SEPARATOR)
        if spec.per == "machine" and separator:
            groups.setdefault(name, {})[machine] = by_name[spec.name]
    spreads = []
    for name, of_owner in groups.items():
        errors = [e.standard_error for e in of_owner.values() if e.standard_error]
        if len(of_owner) > 1 and len(errors) == len(of_owner):
            of_errors = [degrees[e.name] for e in of_owner.values()]
            values = [e.value for e in of_owner.values()]
            spreads.append(machine_spread(name, list(of_owner), values, errors, of_errors))
    return tuple(spreads)


def _warnings(
    search: Search, outcome: Outcome, estimates: Sequence[Estimate], uncertainty: Uncertainty | None
) -> tuple[str, ...]:
    warnings = []
    if uncertainty is not None and not uncertainty.identifiability.complete:
        warnings.append(str(uncertainty.identifiability))
    if (
        uncertainty is not None and not uncertainty.constraints
    ):  # constraints join parameters that the experiments distinguish
        for i, a in enumerate(uncertainty.names):
            for k, b in enumerate(uncertainty.names[:i]):
                r = uncertainty.correlation[i][k]
                if abs(r) > _ALIKE and not {a, b} & set(uncertainty.identifiability.undetermined):
                    warnings.append(f"{b} and {a} are hard to distinguish (correlation {r:+.3f})")
    warnings += [f"{e.name} is at its {e.at_bound} bound" for e in estimates if e.at_bound]
    unfinished = search.best if outcome.status is Status.BUDGET else None
    if search.at_edge or (unfinished is not None and search.failure_near(unfinished.x)):
        warnings.append("the estimate lies at the edge of what can be simulated; the best fit may lie beyond it")
    if search.failures:
        reasons = [f"{shortened(why)} ({count})" for why, count in search.reasons.most_common(_REASONS)]
        warnings.append(
            f"{search.failures} of {search.evaluations} candidates could not be simulated: {'; '.join(reasons)}"
        )
    if search.best is not None and not search.feasible(search.best):
        warnings.append("no candidate satisfies every constraint")
    return tuple(warnings)


def _posed(
    step: StageSpec | Problem,
    campaign: Campaign | None,
    simulators: Mapping[str, Simulator],
    best: Mapping[str, float],
    runner: Runner | None,
) -> _Posed:
    """Return a stage, ready to be solved; without a runner, nothing is simulated for that."""
    if isinstance(step, Problem):
        if runner is not None and runner is not in_process:
            step.runner = runner
        return _Posed(step)
    assert campaign is not None
    problem = Problem.of_stage(
        campaign, step, simulators, best=best, runner=runner or in_process, settled=runner is not None
    )
    stop = StopRules(step.max_evaluations, step.max_seconds)
    return _Posed(problem, step.solver, step.solver_options, stop, step.analyses)


def _campaign(what: Campaign | str | Path, trust: bool) -> Campaign:
    if isinstance(what, Campaign):
        return what
    from fmuid.campaigns.campaign_toml import load_campaign

    return load_campaign(what, trust=trust)


def _models(campaign: Campaign) -> Mapping[str, Simulator]:
    from fmuid.identification.check import load_models, match_models

    models = load_models(campaign)
    match_models(campaign, models)
    return models


def _chosen(campaign: Campaign, names: Iterable[str] | None) -> list[StageSpec]:
    if not campaign.stages:
        raise ProblemError(f"campaign '{campaign.name}' has no stages", fix="write [stages.<name>]")
    wanted = list(campaign.stages) if names is None else list(names)
    for name in wanted:
        if name not in campaign.stages:
            raise ProblemError(f"no stage '{name}'", fix=f"the campaign has: {', '.join(campaign.stages)}")
    return [stage for name, stage in campaign.stages.items() if name in wanted]
