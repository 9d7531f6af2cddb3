"""Problems: cases with parameters, and the evaluation of candidates."""

from __future__ import annotations

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from fmuid.core.campaign import SEPARATOR, Campaign, ParameterSpec, StageSpec, without_owner
from fmuid.core.errors import ProblemError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.identification.problem import cases as case_building
from fmuid.identification.problem.cases import Case
from fmuid.identification.problem.combination import Combination, Constraint
from fmuid.identification.problem.criteria import value
from fmuid.identification.problem.evaluation import Evaluation
from fmuid.identification.problem.exact_derivatives import ExactDerivatives
from fmuid.identification.problem.search_space import SearchSpace, expanded
from fmuid.identification.problem.segments import observed, segmented
from fmuid.identification.problem.solver_error import SolverAccuracy, check_repeatable, solver_accuracy
from fmuid.simulation.predictor import Predictor
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.simulator import Simulator

_REMEMBERED = 1_500_000  # samples of cached predictions, 12 MB: enough for the columns of a Jacobian


class Problem:
    """Any number of cases with shared parameters and one cost.

    Parameters
    ----------
    cases
        The simulations and their measurements.
    parameters
        Free and fixed parameters, or a complete search space.
    combination
        How the criteria are combined into one cost.
    constraints
        Constraints on parameters and criteria.
    runner
        Runner of the simulations.
    name
        Name in progress reports and results.

    Raises
    ------
    ProblemError
        A free parameter affects no model.
    """

    def __init__(
        self,
        cases: Sequence[Case],
        parameters: Sequence[ParameterSpec] | SearchSpace,
        *,
        combination: Combination | None = None,
        constraints: Sequence[Constraint] = (),
        runner: Runner = in_process,
        name: str = "identification",
    ) -> None:
        self.cases = tuple(cases)
        if not self.cases:
            raise ProblemError("the problem has no case", where=name, fix="add one or more")
        self.space = parameters if isinstance(parameters, SearchSpace) else _space(parameters, self.cases)
        self.combination = combination or Combination()
        self.constraints = tuple(constraints)
        self.runner = runner
        self.name = name
        self.findings: tuple[str, ...] = ()  # messages for the user about how the problem is posed
        self.criteria = tuple((case, criterion) for case in self.cases for criterion in case.criteria)
        self.labels = tuple(f"{case.id}: {criterion.label}" for case, criterion in self.criteria)
        self.root_weights = np.sqrt([criterion.weight for _, criterion in self.criteria])
        self._predictor: Predictor[tuple[int, tuple[float, ...]]] = Predictor(_REMEMBERED)
        if self.space.priors and self.combination.kind != "weighted_sum":
            raise ProblemError(
                f"a prior is a residual, but {self.combination.kind} is not a sum of residuals",
                where=name,
                fix='remove the priors, or use combine = "weighted_sum"',
            )
        self._check_reach()

    @classmethod
    def of_stage(
        cls,
        campaign: Campaign,
        stage: StageSpec,
        simulators: Mapping[str, Simulator],
        *,
        best: Mapping[str, float] | None = None,
        runner: Runner = in_process,
        settled: bool = True,
    ) -> Problem:
        """Return the problem of a stage of a campaign, starting from the `best` values so far.

        Unless `settled` is True, nothing is simulated and models keep their default tolerances.
        """
        where = f"stage '{stage.name}'"
        experiments = case_building.experiments_of(campaign, stage.experiments, where=where)
        cases = case_building.from_campaign(campaign, experiments, stage.criteria, simulators, apart=stage.apart)
        values = dict(best or {}) | dict(stage.start)
        specs = campaign.parameters.values()
        space = expanded(
            specs, stage.free, values, stage.tie, [case.id for case in cases], machines=[c.machine for c in cases]
        )
        here, nowhere = space.tried(space.start)
        accuracy = SolverAccuracy()
        # Segments and observers keep predictions close to the measurements.
        if settled and nowhere is None:
            starts = [case.start_values(here) for case in cases]
            if stage.segments is None and not stage.observer:
                accuracy = solver_accuracy(cases, here, starts, runner)
            else:
                check_repeatable(cases, starts, runner)
        if accuracy.until:
            cases = case_building.from_campaign(
                campaign, experiments, stage.criteria, simulators, until=accuracy.until
            )
        cases = accuracy.applied(cases)
        if stage.segments is not None:
            cases = tuple(segmented(case, stage.segments, here, stage.free) for case in cases)
        if stage.observer:
            cases, gains = observed(cases, stage.observer, here)
            gains |= {name: values[name] for name in gains.keys() & values.keys()}
            if stage.observer is True:
                specs_of_gains = tuple(ParameterSpec(name, gain) for name, gain in gains.items())
                space = replace(space, free=space.free + specs_of_gains)
            else:
                space = replace(space, fixed=dict(space.fixed) | gains)
        problem = cls(
            cases,
            space,
            combination=Combination.named(stage.combine, where=where),
            constraints=[Constraint.from_mapping(c, where=where) for c in stage.constraints],
            runner=runner,
            name=stage.name,
        )
        problem.findings = accuracy.findings
        for constraint in problem.constraints:
            constraint.check(problem.labels, problem.space.tried(problem.space.start)[0], where=where)
        return problem

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Slice of each criterion in the residual vector; needs no simulation."""
        slices, begin = [], 0
        for case, criterion in self.criteria:
            channel = next(c for c in case.channels if c.signal == criterion.signal)
            # The length of a residual function is the same for any prediction, so the measurement itself is used.
            n = criterion.length(np.nan_to_num(channel.mean))
            slices.append(slice(begin, begin + n))
            begin += n
        return tuple(slices)

    @cached_property
    def exact(self) -> ExactDerivatives:
        """Exact Jacobians of the problem."""
        return ExactDerivatives(self)

    @property
    def smooth(self) -> bool:
        """Whether the cost is a sum of squares of smooth residuals without constraints."""
        return (
            all(criterion.smooth for _, criterion in self.criteria)
            and self.combination.kind == "weighted_sum"
            and not self.constraints
        )

    def evaluate(self, x: FloatArray) -> Evaluation:
        """Return the evaluation of the (n,) search point `x`, a failed one if a simulation fails."""
        return self.evaluate_many([x])[0]

    def evaluate_many(
        self, points: Sequence[FloatArray], *, differentiated: Sequence[bool] = ()
    ) -> list[Evaluation]:
        """Evaluate several candidates; simulations that they share run once.

        A candidate fails if it cannot be simulated or if a tie, a criterion or a constraint is undefined for it.
        For `differentiated` candidates the same runs also compute Jacobians if the models support it (`exact` then
        contains them).
        """
        begin = clock.perf_counter()
        points = [np.array(x, dtype=np.float64) for x in points]
        values, failures = zip(*map(self.space.tried, points), strict=True)
        if any(differentiated):
            tried = zip(points, values, failures, differentiated, strict=True)
            found_at_once = self.exact.simulate([(x, v) for x, v, failure, d in tried if d and failure is None])
            self._predictor.remember(found_at_once)
        starts = [
            [case.start_values(v) for case in self.cases] if failure is None else []
            for v, failure in zip(values, failures, strict=True)
        ]
        keys = [[(i, tuple(s.values())) for i, s in enumerate(row)] for row in starts]
        jobs = {
            key: (self.cases[key[0]].simulator, self.cases[key[0]].task, start)
            for ks, row in zip(keys, starts, strict=True)
            for key, start in zip(ks, row, strict=True)
        }
        outcomes = self._predictor(jobs, self.runner)
        seconds = (clock.perf_counter() - begin) / len(points)
        return [
            self._judge(x, v, [outcomes[k] for k in ks], seconds)
            if why is None
            else self._failed(x, v, why, seconds)
            for x, v, why, ks in zip(points, values, failures, keys, strict=True)
        ]

    def _judge(
        self,
        x: FloatArray,
        values: Mapping[str, float],
        outcomes: Sequence[FloatArray | SimulationError],
        seconds: float,
    ) -> Evaluation:
        try:
            return self._judged(x, values, outcomes, seconds)
        except (ProblemError, SimulationError) as error:  # an expression or a user's criterion
            return self._failed(x, values, str(error), seconds)

    def _judged(
        self,
        x: FloatArray,
        values: Mapping[str, float],
        outcomes: Sequence[FloatArray | SimulationError],
        seconds: float,
    ) -> Evaluation:
        predictions: list[FloatArray] = []
        for case, outcome in zip(self.cases, outcomes, strict=True):
            if isinstance(outcome, SimulationError):
                return self._failed(x, values, f"{case.id}: {outcome}", seconds)
            if not np.isfinite(outcome).all():
                return self._failed(x, values, f"{case.id}: the prediction is not finite", seconds)
            predictions.append(case.sensed(outcome, values))
        vectors = [r for c, p in zip(self.cases, predictions, strict=True) for r in c.residuals(p)]
        for label, place, vector in zip(self.labels, self.slices, vectors, strict=True):
            if len(vector) != place.stop - place.start:
                what = f"{label}: {len(vector)} residuals, but {place.stop - place.start} on the measurement"
                return self._failed(x, values, what, seconds)
        criteria = np.array([value(r) for r in vectors])
        if not np.isfinite(criteria).all():
            label = self.labels[int(np.argmin(np.isfinite(criteria)))]
            return self._failed(x, values, f"{label}: the prediction does not show this feature", seconds)
        prior = np.array([(values[self.space.names[i]] - p.mean) / p.sd for i, p in self.space.priors])
        residuals = np.concatenate([*(w * r for w, r in zip(self.root_weights, vectors, strict=True)), prior])
        return Evaluation(
            x=x,
            parameters=values,
            criteria=criteria,
            residuals=residuals,
            cost=self.combination.cost(criteria, residuals, self.root_weights**2),
            constraints=np.array([c.violation(self.labels, criteria, values) for c in self.constraints]),
            seconds=seconds,
            predictions=tuple(predictions),
        )

    def _failed(self, x: FloatArray, values: Mapping[str, float], why: str, seconds: float) -> Evaluation:
        nothing = np.full(len(self.criteria), np.nan)
        constraints = np.full(len(self.constraints), np.nan)
        return Evaluation(x, values, nothing, np.full(0, np.nan), float("nan"), constraints, why, seconds)

    def over(self, space: SearchSpace) -> Problem:
        """Return the same problem with other free parameters."""
        return self._like(self.cases, space)

    def with_cases(self, cases: Sequence[Case]) -> Problem:
        """Return the same problem with other measurements or inputs."""
        return self._like(cases, self.space)

    def _like(self, cases: Sequence[Case], space: SearchSpace) -> Problem:
        kept: dict[str, Any] = {"combination": self.combination, "constraints": self.constraints}
        return Problem(cases, space, **kept, runner=self.runner, name=self.name)

    @property
    def nuisances(self) -> int:
        """Number of unknowns fitted in addition to the free parameters: initial states of segments."""
        return sum(case.simulator.nuisances for case in self.cases)

    @property
    def segments(self) -> int:
        """Number of segments that runs are cut into, 0 without."""
        return sum(case.simulator.segments for case in self.cases)

    def sees(self, name: str) -> bool:
        """Return whether a parameter affects a model, a sensor or a tie of this problem."""
        plain, _, run = name.partition(SEPARATOR)
        return plain in self._used and (not run or any(run in (case.id, case.machine) for case in self.cases))

    @cached_property
    def _used(self) -> frozenset[str]:
        used = {name for case in self.cases for name in case.setting}
        for case in self.cases:
            for channel in case.channels:
                used |= {name for expression in channel.sensor.values() for name in expression.names}
        for expression in self.space.ties.values():
            used |= {without_owner(name) for name in expression.names}
        return frozenset(used)

    def _check_reach(self) -> None:
        for name in self.space.names:
            if without_owner(name) not in self._used:
                raise ProblemError(
                    f"no model of {self.name} has the parameter '{name}'",
                    fix="correct its name, map it in [models], or remove it from 'free'",
                )


def _space(specs: Sequence[ParameterSpec], cases: Sequence[Case]) -> SearchSpace:
    free = [spec.name for spec in specs if spec.free]
    return expanded(specs, free, {}, {}, [case.id for case in cases], machines=[c.machine for c in cases])
