"""The most informative excitation for the parameters: D- or A-optimal, averaged over plausible values.

The information of a run is ``J' J``, where J are the whitened derivatives of its predictions by the parameters,
each relative to its value. The information of recorded runs and bounds is added (Fedorov 1972; Pronzato and Pazman
2013).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fmuid.core.campaign import Campaign, ModelSpec, StageSpec
from fmuid.core.errors import CampaignError, SimulationError
from fmuid.core.formulas import parse
from fmuid.core.immutable import FloatArray
from fmuid.core.progress import Say, quiet
from fmuid.data.noise.spectrum import SetupNoise, estimate_noise
from fmuid.design.binary import Response, binary_sequence
from fmuid.design.excitation import Signals, shapes
from fmuid.design.excitation_search import Excitation, Judged, search
from fmuid.design.planned import Planned, planned_run, template_of
from fmuid.diagnosis.extended_model import CampaignModel, linear_at, predicted
from fmuid.diagnosis.observed import Observed
from fmuid.diagnosis.subject import unknown_of
from fmuid.effects.effect import Unknown
from fmuid.identification.problem.cases import Case, from_campaign
from fmuid.identification.problem.solver_error import solver_accuracy
from fmuid.simulation.runners import Runner
from fmuid.simulation.simulator import Simulator

Optimality = Literal["D", "A"]
_DRAWS = 3  # draws of the parameters, including the start values
_SPREAD = 0.3  # relative spread of parameters that no run has determined any better
_UNBOUNDED = 10.0  # relative standard deviation of an entirely unknown parameter


@dataclass(frozen=True, eq=False)
class ParameterDesign:
    """A designed run, and its information about the parameters.

    Attributes
    ----------
    planned, excitation
        The designed run.
    criterion
        The optimality criterion.
    values
        Parameter values for which it was designed.
    before, after
        Relative standard error of each parameter, by name, from the recorded runs and with the designed one;
        infinite if nothing is known.
    repeated
        The same if the best recorded run is repeated instead, and the name of that run; None without one.
    """

    planned: Planned
    excitation: Excitation
    criterion: Information
    values: Mapping[str, float]
    before: Mapping[str, float]
    after: Mapping[str, float]
    repeated: tuple[str, Mapping[str, float]] | None = None

    @property
    def gain(self) -> float:
        """Factor by which the sum of squared relative standard errors decreases."""
        return _sum_of_squares(self.before) / _sum_of_squares(self.after)


def _sum_of_squares(errors: Mapping[str, float]) -> float:
    return float(np.sum(np.square(list(errors.values()))))


def design_for_parameters(
    campaign: Campaign,
    load: Callable[[ModelSpec], Simulator],
    runner: Runner,
    *,
    stage: str | None = None,
    optimality: Optimality = "D",
    evaluations: int = 200,
    seed: int = 0,
    say: Say = quiet,
) -> ParameterDesign:
    """Design the run that adds most information about a campaign's free parameters to the recorded runs.

    Parameters
    ----------
    load
        Loads the model of a setup.
    stage
        Stage with the parameters, ties and signals to use; all free parameters by default.
    optimality
        ``D`` minimises the volume of the confidence region; ``A`` minimises the sum of squared relative standard
        errors.
    evaluations
        Number of excitations to try.

    Raises
    ------
    CampaignError, FmuError
        The campaign has no limits, or they do not fit its model.
    FmuidError
        No excitation stays within every limit.
    """
    posed = posed_stage(campaign, stage)
    setup = campaign.design.setup or next(iter(_setups(campaign, posed)), None)
    if setup is None:
        raise CampaignError(
            "has no model", where=campaign.file or campaign.folder, fix='write [models.<setup>] fmu = "..."'
        )
    say("recorded runs", 0.0)
    runs = [e for e in campaign.measurements if e.id in posed.experiments]
    simulators = {s: load(campaign.models[s]) for s in dict.fromkeys([setup, *(e.setup for e in runs)])}
    cases = from_campaign(campaign, runs, posed.criteria, simulators) if runs else ()
    template = next((c for c in cases if c.setup == setup), None) or template_of(
        campaign, simulators[setup], setup
    )
    fixed = {**campaign.start_values, **posed.start}
    model = CampaignModel(cases, runner, fixed, {n: parse(text) for n, text in posed.tie.items()})
    unknowns = _unknowns(campaign, posed, template, cases, fixed)
    values = {u.name: u.start for u in unknowns}
    if cases:
        starts = [model.start_values(case, fixed) for case in cases]
        cases = solver_accuracy(cases, fixed, starts, runner).applied(cases)
        model = replace(model, cases=cases)
        template = next((c for c in cases if c.setup == setup), template)
    information, noise = _recorded(model, unknowns, values)
    known = sum(information.values(), _beforehand(campaign, unknowns))
    planned = planned_run(campaign, model, template, noise.get(_kind(template)))
    bounds = tuple(d.bounds for d in planned.driven)
    families: tuple[Signals, ...] = shapes(campaign.design, bounds, seed=seed)
    planned = planned.solved_well_enough(families, [values])
    criterion = Information(planned, unknowns, _draws(unknowns, known, seed), known, optimality)
    if "binary" in campaign.design.families:
        say("the best binary sequence", 0.03)
        sequence = binary_sequence(criterion.response(values), bounds, planned.time, seed=seed)
        families += () if sequence is None else (sequence,)
    excitation, *_ = search(
        families,
        planned.time,
        criterion,
        evaluations=evaluations,
        seed=seed,
        say=lambda share: say("trying excitations", 0.05 + 0.9 * share),
    )
    names, sizes = [u.name for u in unknowns], _sizes(unknowns)
    errors = [
        dict(zip(names, _errors(m, sizes), strict=True))
        for m in (known, known + criterion.information(excitation.samples, values))
    ]
    # One more run like a recorded one, made as often as the designed one will be.
    again = {
        c.id: known + campaign.design.repeats * information[c.id] / len(c.channels[0].repeats)
        for c in cases
        if c.setup == setup
    }
    best = min(again, key=lambda id: criterion.cost_of(again[id]), default=None)
    repeated = None if best is None else (best, dict(zip(names, _errors(again[best], sizes), strict=True)))
    return ParameterDesign(planned, excitation, criterion, values, errors[0], errors[1], repeated)


@dataclass(frozen=True, eq=False)
class Information:
    """Information from an excitation, as the cost of a search.

    Attributes
    ----------
    draws
        Draws of the parameters; the cost is the mean over them.
    known
        (P, P) existing information, in the parameters' units.
    """

    planned: Planned
    unknowns: tuple[Unknown, ...]
    draws: Sequence[Mapping[str, float]]
    known: FloatArray
    optimality: Optimality = "D"

    def __call__(self, samples: FloatArray) -> Judged:
        """Return the cost and the violation of limits of (inputs, N) samples."""
        model = self.planned.under(samples)
        try:
            violation, worst = self.planned.violation(model, self.draws, predicted(model, self.draws))
            if violation > 0.0:
                return Judged(np.inf, violation, worst)
            information = self._information(model, self.draws)
        except SimulationError:
            return Judged(np.inf, np.inf)
        return Judged(float(np.mean([self.cost_of(self.known + m) for m in information])))

    def information(self, samples: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the (P, P) information of the run at some values, in the parameters' units."""
        return self._information(self.planned.under(samples), [values])[0]

    def _information(self, model: CampaignModel, points: Sequence[Mapping[str, float]]) -> list[FloatArray]:
        information = []
        for here in linear_at(model, points, [self.unknowns] * len(points)):
            jacobian = np.stack([self.planned.whiten(here.slopes[u.name][0]) for u in self.unknowns], axis=1)
            information.append(np.asarray(jacobian.T @ jacobian))
        return information

    def response(self, values: Mapping[str, float]) -> Response:
        """Return the information of the response at these values about the parameters, relative to their sizes."""
        sizes = _sizes(self.unknowns)

        def slopes(samples: FloatArray) -> FloatArray:
            (here,) = linear_at(self.planned.under(samples), [values], [self.unknowns])
            return np.stack([s * here.slopes[u.name][0] for s, u in zip(sizes, self.unknowns, strict=True)])

        cost = _volume if self.optimality == "D" else _squares
        return Response(slopes, self.planned.whiten, self.known * np.outer(sizes, sizes), cost)

    def cost_of(self, information: FloatArray) -> float:
        """Return the cost of the total information, (P, P) in the parameters' units."""
        sizes = _sizes(self.unknowns)
        relative = information * np.outer(sizes, sizes)
        if self.optimality == "D":
            return float(-0.5 * np.linalg.slogdet(relative)[1] / len(sizes))
        return float(0.5 * np.log(np.trace(np.linalg.pinv(relative, hermitian=True)) / len(sizes)))


def _volume(information: FloatArray) -> tuple[float, FloatArray]:
    return -float(np.linalg.slogdet(information)[1]), np.asarray(np.linalg.inv(information), dtype=np.float64)


def _squares(information: FloatArray) -> tuple[float, FloatArray]:
    covariance = np.linalg.inv(information)
    return float(np.trace(covariance)), np.asarray(covariance @ covariance, dtype=np.float64)


def posed_stage(campaign: Campaign, stage: str | None) -> StageSpec:
    """Return the stage whose parameters are to be determined.

    Raises
    ------
    CampaignError
        There is no such stage.
    """
    if stage is not None:
        if stage not in campaign.stages:
            known = ", ".join(campaign.stages) or "none"
            raise CampaignError(f"no stage '{stage}'", where="--stage", fix=f"the campaign has: {known}")
        return campaign.stages[stage]
    if len(campaign.stages) == 1:
        return next(iter(campaign.stages.values()))
    free = tuple(p.name for p in campaign.parameters.values() if p.free)
    return StageSpec("all", campaign.identification, free)


def _setups(campaign: Campaign, posed: StageSpec) -> list[str]:
    recorded = [campaign.measurements[id].setup for id in posed.experiments]
    return list(dict.fromkeys(recorded or campaign.models))


def _unknowns(
    campaign: Campaign, posed: StageSpec, template: Case, cases: Sequence[Case], fixed: Mapping[str, float]
) -> tuple[Unknown, ...]:
    helpers = {n for text in posed.tie.values() for n in parse(text).names}
    reached = helpers.union(*(c.setting for c in (template, *cases)))
    free = [replace(campaign.parameters[n], start=fixed[n]) for n in posed.free if n in reached]
    for spec in free:
        if spec.per != "campaign":
            raise CampaignError(
                f"has one value per {spec.per}, which is unknown for a future run",
                where=f"{campaign.file or campaign.folder} [parameters.{spec.name}] per",
                fix="fix it (free = false), or name a --stage without it",
            )
    if not free:
        raise CampaignError(
            "no free parameter affects the model",
            where=campaign.file or campaign.folder,
            fix="set free = true for one in [parameters]",
        )
    return tuple(unknown_of(spec) for spec in free)


def _kind(case: Case) -> tuple[object, ...]:
    """Return a key that is equal for runs whose noise can be pooled."""
    return (
        case.setup,
        tuple(c.signal for c in case.channels),
        round(float(np.log(np.median(np.diff(case.time)))), 3),
    )


def _recorded(
    model: CampaignModel, unknowns: Sequence[Unknown], values: Mapping[str, float]
) -> tuple[dict[str, FloatArray], dict[tuple[object, ...], SetupNoise]]:
    """Return the (P, P) information of every recorded run, by id, and the noise of every kind of run."""
    information, noise = dict[str, FloatArray](), dict[tuple[object, ...], SetupNoise]()
    for kind in dict.fromkeys(map(_kind, model.cases)):
        of_kind = replace(model, cases=tuple(c for c in model.cases if _kind(c) == kind))
        noise[kind] = estimate_noise(of_kind.runs)
        observed = Observed(of_kind.runs, {of_kind.cases[0].setup: noise[kind]})
        (here,) = linear_at(of_kind, [values], [unknowns])
        columns = [observed.whiten(here.slopes[u.name]) for u in unknowns]
        for e, case in enumerate(of_kind.cases):
            jacobian = np.stack([column[e] for column in columns], axis=1)
            information[case.id] = observed.repeats[e] * jacobian.T @ jacobian
    return information, noise


def _sizes(unknowns: Sequence[Unknown]) -> FloatArray:
    """(P,) the scale of a parameter's error: its value, or its range if the value is 0."""
    width = [u.upper - u.lower if np.isfinite(u.upper - u.lower) else 1.0 for u in unknowns]
    return np.array([abs(u.start) or w for u, w in zip(unknowns, width, strict=True)])


def _beforehand(campaign: Campaign, unknowns: Sequence[Unknown]) -> FloatArray:
    """Return the (P, P) information of bounds and priors."""
    spread = []
    for u, size in zip(unknowns, _sizes(unknowns).tolist(), strict=True):
        prior = campaign.parameters[u.name].prior
        width = (u.upper - u.lower) / np.sqrt(12.0)
        spread.append(prior.sd if prior is not None else min(width, _UNBOUNDED * size))
    return np.diag(1.0 / np.square(spread))


def _draws(unknowns: Sequence[Unknown], known: FloatArray, seed: int) -> list[dict[str, float]]:
    """Return plausible values of the parameters, with their start values first."""
    sizes, start = _sizes(unknowns), np.array([u.start for u in unknowns])
    lower, upper = np.array([u.lower for u in unknowns]), np.array([u.upper for u in unknowns])
    covariance = np.linalg.inv(known + np.diag(1.0 / np.square(_SPREAD * sizes)))
    rng = np.random.default_rng(seed)
    drawn = rng.multivariate_normal(start, covariance, size=_DRAWS - 1, method="cholesky")
    names = [u.name for u in unknowns]
    return [dict(zip(names, np.clip(x, lower, upper).tolist(), strict=True)) for x in (start, *drawn)]


def _errors(information: FloatArray, sizes: FloatArray) -> list[float]:
    """Return relative standard errors."""
    relative = information * np.outer(sizes, sizes)
    return [float(e) for e in np.sqrt(np.diag(np.linalg.inv(relative)))]
