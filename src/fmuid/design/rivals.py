"""The excitation that best distinguishes the answers of a diagnosis (T-optimal: Atkinson and Fedorov 1975).

A run decides between answers if, in nine cases out of ten, a diagnosis will prefer the right answer by
`decide.SAME` standard deviations. That is far beyond the odds that name one alone, and by noise alone, the wrong
one would fit better in fewer than one case in a million. The margin allows for model error and for the
linearisation of rivals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr, logsumexp

from fmuid.core.campaign import Campaign
from fmuid.core.errors import CampaignError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.core.progress import Say, quiet
from fmuid.design.excitation import shapes
from fmuid.design.excitation_search import Excitation, Judged, search
from fmuid.design.planned import Planned, planned_run
from fmuid.design.rehearsal import rehearsed
from fmuid.diagnosis.candidates import Fitted, fit_effects
from fmuid.diagnosis.decide import SAME
from fmuid.diagnosis.extended_model import CampaignModel, Prediction, linear_at, predicted
from fmuid.diagnosis.next_experiment import (
    Rival,
    chances,
    distance_matrix,
    distances,
    rival_of,
    separations,
    with_sensors,
)
from fmuid.diagnosis.subject import Subject
from fmuid.effects.effect import Sensor
from fmuid.identification.problem.cases import Case

SETTLED = SAME
HOPELESS = 0.1  # probability that an answer alone is left
_DRAWS = 3  # draws of every rival's parameters, including the estimate
_MOST = 6  # largest number of rivals
_WIDER = 2.0  # factor by which limits are widened to show the effect
_SENSORS = (1e-6, 1.0)  # range, relative to a sensor's own, in which the noise of an added one is searched for


@dataclass(frozen=True, slots=True)
class Beyond:
    """A change beyond the limits that would help, and the separation (sigma) with it.

    `kind` is ``sensor``, ``setting`` or ``limits``.
    """

    kind: str
    what: str
    separation: float


@dataclass(frozen=True, eq=False)
class DiagnosisDesign:
    """A designed run, and the separation of the rivals in it.

    Attributes
    ----------
    apart
        (R, draws, R) distances of the rivals when they are refitted.
    beyond
        Other changes that would help.
    """

    planned: Planned
    excitation: Excitation
    rivals: tuple[Rival, ...]
    apart: FloatArray
    beyond: tuple[Beyond, ...] = ()

    @cached_property
    def separations(self) -> FloatArray:
        """(R, R) standard deviations by which a diagnosis will prefer the first, if right, to the second."""
        return separations(self.apart, self.rivals)

    @cached_property
    def chances(self) -> FloatArray:
        """(R,) probability that each rival alone is left, if it is right."""
        return chances(self.apart, self.rivals)

    @property
    def pairs(self) -> list[tuple[Rival, Rival, float]]:
        """Every pair of rivals with its separation, the smaller of both directions."""
        return [
            (self.rivals[i], self.rivals[j], float(min(self.separations[i, j], self.separations[j, i])))
            for i in range(len(self.rivals))
            for j in range(i + 1, len(self.rivals))
        ]

    @property
    def least(self) -> float:
        """Separation of the two closest rivals."""
        return _least(self.separations)

    @property
    def settled_for(self) -> list[Rival]:
        """The rivals that would remain alone after the run if they were right."""
        from_others = np.where(np.eye(len(self.rivals), dtype=bool), np.inf, self.separations)
        return [rival for rival, row in zip(self.rivals, from_others, strict=True) if row.min() >= SETTLED]

    @property
    def hopeless(self) -> bool:
        """Whether several answers will be left whichever is right, in nine cases out of ten."""
        return bool(np.max(self.chances) < HOPELESS)


def rivals_of(subject: Subject, answer: Mapping[str, object]) -> list[Fitted]:
    """Refit the answers that a diagnosis (as JSON) left open, at most six, starting from its values.

    If there are fewer than two, the likeliest effects are added, and *none* if the diagnosis doubts that there is
    a gap.

    Raises
    ------
    CampaignError
        Fewer than two answers can be simulated.
    """
    effects, answers, verdict = (answer[key] for key in ("effects", "answers", "verdict"))
    assert isinstance(effects, list) and isinstance(answers, list) and isinstance(verdict, dict)  # noqa: PT018
    estimated = {
        name: entry["value"]
        for effect in effects
        for name, entry in effect.get("parameters", {}).items()
        if entry["value"] is not None
    }
    nominal = answer["nominal"]
    assert isinstance(nominal, dict)
    by_id = subject.by_id
    wanted = [tuple(a["effects"]) for a in answers if set(a["effects"]) <= by_id.keys()]
    if verdict["kind"] in ("complete", "insufficient"):
        wanted = [(), *wanted]
    scored = sorted((e for e in effects if e["id"] in by_id and "closure" in e), key=_promise)
    for effect in scored:
        if len(wanted) >= (2 if verdict["kind"] in ("effect", "ambiguous") else 3):
            break
        if not any(effect["id"] in names for names in wanted):
            wanted.append((effect["id"],))
    rivals = []
    for names in wanted[:_MOST]:
        trials = {k: v for n in names for k, v in by_id[n].trials[0].items()}
        starts = [{**nominal["parameters"], **guesses} for guesses in (estimated, trials)]
        fitted = fit_effects(subject, [by_id[n] for n in names], starts)
        if fitted is not None:
            rivals.append(fitted)
    if len(rivals) < 2:
        raise CampaignError(
            "the diagnosis leaves no answers open that a run could distinguish",
            where="--for diagnosis",
            fix="design for parameters: --for parameters",
        )
    return rivals


def _promise(effect: Mapping[str, object]) -> float:
    closure = effect["closure"]
    assert isinstance(closure, dict)
    return -float(closure["held_out"])


def design_for_diagnosis(
    campaign: Campaign,
    subject: Subject,
    answers: Sequence[Fitted],
    *,
    evaluations: int = 200,
    seed: int = 0,
    say: Say = quiet,
) -> DiagnosisDesign:
    """Design the run that best distinguishes refitted answers.

    Raises
    ------
    CampaignError, FmuError
        The campaign's limits do not fit its model.
    FmuidError
        No excitation stays within every limit.
    """
    setups = list(dict.fromkeys(case.setup for case in subject.model.cases))
    setup = campaign.design.setup or setups[0]
    if setup not in setups:
        raise CampaignError(
            f"the diagnosis has no run of setup '{setup}'",
            where="[design] setup",
            fix=f"it has: {', '.join(setups)}",
        )
    if subject.observed.nuisances:
        raise CampaignError(
            "runs are cut into segments, so the model cannot predict a run that nobody has measured",
            where="--for diagnosis",
            fix="design for parameters: --for parameters, of stages without segments and observer",
        )
    template = next(case for case in subject.model.cases if case.setup == setup)
    planned = planned_run(campaign, subject.model, template, subject.observed.noise[setup])
    rivals = tuple(rival_of(f, subject.observed, draws=_DRAWS, seed=seed + k) for k, f in enumerate(answers))
    families = shapes(campaign.design, [d.bounds for d in planned.driven], seed=seed)
    planned = planned.solved_well_enough(families, [r.values for r in rivals])
    excitations = search(
        families,
        planned.time,
        Apart(planned, rivals),
        evaluations=evaluations,
        seed=seed,
        say=lambda share: say("trying excitations", 0.1 + 0.7 * share),
    )
    say("refitting the answers to the best excitations", 0.82)
    designed = _best(
        Apart(planned, rivals, subject), excitations[:1] if excitations[0].interrupted else excitations
    )
    if designed.excitation.interrupted or designed.least >= SETTLED:
        return designed
    say("looking for other changes that would help", 0.92)
    return replace(designed, beyond=tuple(_beyond(designed, subject, campaign)))


def _best(criterion: Apart, excitations: Sequence[Excitation]) -> DiagnosisDesign:
    """Return the design with the excitation that separates the rivals best.

    Raises
    ------
    SimulationError
        A run failed under each of them.
    """
    designs, failure = [], None
    for excitation in excitations:
        try:
            apart = criterion.distances(excitation.samples)
        except SimulationError as error:
            failure = error
            continue
        designs.append(DiagnosisDesign(criterion.planned, excitation, criterion.rivals, apart))
    if not designs and failure is not None:
        raise failure
    return min(designs, key=lambda d: _misjudged(d.apart))


@dataclass(frozen=True, eq=False)
class Apart:
    """Separation of rivals by an excitation, as the cost of a search: how often a wrong one fits better.

    The search takes rivals for linear in their parameters; with a `subject`, distances count what refits find.
    """

    planned: Planned
    rivals: tuple[Rival, ...]
    subject: Subject | None = None

    def __call__(self, samples: FloatArray) -> Judged:
        """Return the cost and the violation of limits of (inputs, N) samples."""
        model = self.planned.under(samples)
        points = [values for r in self.rivals for values in r.draws]
        try:
            violation, worst = self.planned.violation(model, points, predicted(model, points))
            if violation > 0.0:
                return Judged(np.inf, violation, worst)
            apart = self._linear(model)
        except SimulationError:
            return Judged(np.inf, np.inf)
        return Judged(_misjudged(apart))

    def distances(self, samples: FloatArray) -> FloatArray:
        """Return the (R, draws, R) distances of the rivals under (inputs, N) samples.

        Raises
        ------
        SimulationError
            A run failed.
        """
        apart = self._linear(self.planned.under(samples))
        if self.subject is None:
            return apart
        return np.minimum(apart, rehearsed(self.planned, samples, self.rivals, self.subject)[:, None, :])

    def _linear(self, model: CampaignModel) -> FloatArray:
        return distances(model, self.rivals, lambda d: self.planned.whiten(d[0]))[0]


def _misjudged(apart: FloatArray) -> float:
    """Return the log of the probability that the wrong one of two rivals fits better, averaged over all pairs."""
    pairs = apart.min(axis=1)[~np.eye(len(apart), dtype=bool)]
    return float(logsumexp(log_ndtr(-0.5 * pairs)) - np.log(len(pairs)))


def _least(separations: FloatArray) -> float:
    return float(np.min(separations[~np.eye(len(separations), dtype=bool)]))


def _beyond(designed: DiagnosisDesign, subject: Subject, campaign: Campaign) -> list[Beyond]:
    """Return changes that separate rivals which no excitation within the limits separates, best first."""
    planned, samples, rivals = designed.planned, designed.excitation.samples, designed.rivals
    criterion = Apart(planned, rivals, subject)
    options = _sensors(designed, subject, campaign)
    for s in planned.settable:
        for value in (s.lower, s.upper):
            if np.isfinite(value):
                task = replace(
                    planned.case.task, start_values={**planned.case.task.start_values, s.variable: value}
                )
                setting = {n: to for n, to in planned.case.setting.items() if to[0] != s.variable}
                case = replace(planned.case, task=task, setting=setting)
                moved = replace(planned, model=replace(planned.model, cases=(case,)))
                options += _tried("setting", f"{s.name} = {value:g}", Apart(moved, rivals, subject), samples)
    rest = np.array([[d.bounds.rest] for d in planned.driven])
    names = " and ".join(d.name for d in planned.driven)
    options += _tried(
        "limits", f"{_WIDER:g} times the range of {names}", criterion, rest + _WIDER * (samples - rest)
    )
    better = [b for b in options if b.separation > designed.least + 1.0]
    return sorted(better, key=lambda b: -b.separation)


def _tried(kind: str, what: str, criterion: Apart, samples: FloatArray) -> list[Beyond]:
    try:
        return [Beyond(kind, what, _least(separations(criterion.distances(samples), criterion.rivals)))]
    except SimulationError:
        return []


def _not_read(case: Case, subject: Subject, campaign: Campaign) -> list[Sensor]:
    """Return the catalogue's sensors and the model's outputs that the case does not read."""
    sensors = [s for s in subject.catalogue.sensors.values() if s.variable in case.simulator.variables]
    known = {s.variable for s in sensors}
    model = campaign.models[case.setup]
    given = {model.variable(name): sigma for name, sigma in campaign.design.sigma.items()}
    for v in case.simulator.variables.values():
        if v.causality == "output" and v.name not in known:
            sensors.append(Sensor(v.name, v.name, given.get(v.name, 0.0), v.unit or ""))
    read = {c.variable for c in case.channels}
    return [s for s in sensors if s.variable not in read]


def _sensors(designed: DiagnosisDesign, subject: Subject, campaign: Campaign) -> list[Beyond]:
    """Return the outputs without a sensor, with the noise that the user gives or the noise that would suffice."""
    planned, rivals = designed.planned, designed.rivals
    case = planned.driven_case(designed.excitation.samples)
    sensors = _not_read(case, subject, campaign)
    if not sensors:
        return []
    further = replace(planned.model, cases=(with_sensors(case, sensors),))
    try:
        linear = linear_at(further, [r.values for r in rivals], [r.unknowns for r in rivals])
    except SimulationError:
        return []
    drawn = [
        p for p in further.predict([v for r in rivals for v in r.draws]) if not isinstance(p, SimulationError)
    ]
    if len(drawn) < sum(len(r.draws) for r in rivals):
        return []
    n, weight, options = len(case.channels), np.sqrt(planned.repeats), []
    far = distance_matrix(linear, drawn, rivals, lambda d: planned.whiten(d[0][:n]))
    closer = far**2 - designed.apart**2  # what refits take from the separation by the sensors that there are

    def least(row: int, sigma: float) -> float:
        def whiten(d: Prediction) -> FloatArray:
            return np.concatenate([planned.whiten(d[0][:n]), weight * d[0][row] / sigma])

        apart = distance_matrix(linear, drawn, rivals, whiten) ** 2 - closer
        return _least(separations(np.sqrt(np.maximum(apart, 0.0)), rivals))

    for row, sensor in enumerate(sensors, n):
        what = f"a sensor of {sensor.description or sensor.name}"
        unit = f" {sensor.unit}" if sensor.unit else ""
        if sensor.noise > 0.0:
            options.append(Beyond("sensor", f"{what} (noise {sensor.noise:.3g}{unit})", least(row, sensor.noise)))
            continue
        span = float(np.ptp([p[0][row] for p in drawn])) or 1.0
        low, high = (share * span for share in _SENSORS)
        if least(row, low) < SETTLED:
            continue
        for _ in range(20):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if least(row, middle) >= SETTLED else (low, middle)
        options.append(Beyond("sensor", f"{what} with a noise below {low:.2g}{unit}", SETTLED))
    return options
