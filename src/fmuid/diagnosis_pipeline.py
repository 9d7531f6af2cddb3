"""Diagnosing a campaign: load, run in worker processes, and write the results."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fmuid.core.campaign import Campaign, without_owner
from fmuid.core.errors import CampaignError, FmuidError, SimulationError
from fmuid.core.files import write_atomically
from fmuid.core.folder_lock import claim
from fmuid.core.one_thread import in_one_thread
from fmuid.core.progress import Say, quiet
from fmuid.data.averaging import averaged
from fmuid.data.noise.level import GAP_THAT_MATTERS
from fmuid.diagnosis import calibration, decide
from fmuid.diagnosis.calibration import Calibration, Trial
from fmuid.diagnosis.candidates import Fitted, estimates, refit_only
from fmuid.diagnosis.corrected import FOLDER, Corrected, checked, write_corrected
from fmuid.diagnosis.cross_validation import share_closed
from fmuid.diagnosis.decide import GAIN_OF_A_SECOND, odds_of_starts, starts_matter, tolerances
from fmuid.diagnosis.diagnose import Found, diagnose_subject, where_left
from fmuid.diagnosis.effect_search import exact_enough, holds, promise_more_than_starts
from fmuid.diagnosis.extended_model import Prediction, predicted
from fmuid.diagnosis.localisation import between_machines
from fmuid.diagnosis.made_catalogue import keep_catalogue, with_catalogue, with_effect
from fmuid.diagnosis.observed import Observed, gap
from fmuid.diagnosis.refit import Refit
from fmuid.diagnosis.scores import SEEN
from fmuid.diagnosis.subject import Subject, carrier, subject_of, with_states
from fmuid.diagnosis.summary import sentences
from fmuid.diagnosis.verdict import (
    Answer,
    Best,
    BetweenMachines,
    Diagnosis,
    Estimate,
    Kind,
    LawFound,
    Rest,
    Verdict,
)
from fmuid.discovery.find_law import Candidate, find_law
from fmuid.discovery.injected import entry
from fmuid.discovery.learned_table import Tabulated, tabulate
from fmuid.effects.effect import THRESHOLD
from fmuid.identification.continued import continued, is_run
from fmuid.identification.problem.cases import Case
from fmuid.identification.result import Result
from fmuid.init.timing import Convention, chosen, conventions_of
from fmuid.simulation.model_source import flat_model
from fmuid.simulation.pool.choice import runner_on
from fmuid.simulation.recorded import RecordedSimulations
from fmuid.simulation.runners import Runner, in_process
from fmuid.simulation.segmented import Segmented
from fmuid.simulation.signal_effects import signal_and_property

if TYPE_CHECKING:
    from fmuid.report.document import Drawing


def with_timing_of_log(
    campaign: Campaign, outcome: Found, runner: Runner, written: Campaign | None = None
) -> tuple[Campaign, str] | None:
    """Return the campaign with the timing that explains what a diagnosis leaves or blames on signals, and a note.

    Blamed are lags and delays of less than a sample, and crosstalk of an input: one that acts otherwise between
    its samples looks like it, and it undoes a time of reading that a missing law imitates. More than noise may be
    left because the timing was judged without the laws of the answer. So timings are judged with its laws and its
    other effects. None if the diagnosis has neither, or if no other timing explains it. The note compares with the
    timing that is `written` in the campaign, by default the one of this diagnosis.
    """
    setups, model = {}, outcome.subject.model
    left = outcome.diagnosis.verdict.kind != "complete" and outcome.corrected.gap > GAP_THAT_MATTERS
    names = {without_owner(u.name) for u in (*outcome.subject.nominal, *outcome.corrected.fit.unknowns)}
    for setup in dict.fromkeys(case.setup for case in model.cases):
        blamed = _imitating_timing(outcome, [case for case in model.cases if case.setup == setup])
        if not blamed and not left:
            continue
        cases = [(c, v) for c, v in _shown_but_for(outcome, blamed) if c.setup == setup]
        spec = campaign.models[setup]
        known = Convention(spec.timing, read_after=spec.read_after)
        conventions = conventions_of(cases, names, runner, known)
        convention = chosen(conventions)
        now = [c for c in conventions if (c.timing, c.read_after) == (known.timing, known.read_after)]
        if convention in now or not (convention.explains or (blamed and known.read_after)):
            continue
        if blamed or not any(c.explains and not convention.surpasses(c) for c in now):
            setups[setup] = convention
    if not setups:
        return None
    models, written = dict(campaign.models), written or campaign
    for s, c in setups.items():
        models[s] = replace(models[s], timing=c.timing, read_after=c.read_after)
    timings = dict(campaign.timings)
    for setup, convention in setups.items():
        names_of = {campaign.models[setup].variable(n): n for e in campaign.measurements for n in e.outputs}
        timings |= {names_of.get(variable, variable): t for variable, t in convention.signals.items()}
    note = "; ".join(
        f"'{setup}' was diagnosed with {c.entries} instead of \"{written.models[setup].timing}\", which explains"
        f" the runs {c.worse:.2g} times better than held signals; write it in campaign.toml"
        if c.explains
        else f"'{setup}' was diagnosed without read_after: laws explain what it did; remove it in campaign.toml"
        for setup, c in setups.items()
    )
    return replace(campaign, models=models, timings=timings), note


def with_starts_of_runs(
    campaign: Campaign, outcome: Found, subject_with: Callable[[Campaign], Subject]
) -> tuple[Campaign, str] | None:
    """Return the campaign with start states that are estimated for each run, and a note.

    None unless these are likelier than the best explanation, or improve an answer that is left open, and
    explain as much as a second effect has to. An explanation that holds beyond doubt, or is as exact as it has
    to be, stays. One that is named has to become likelier: start states take up whatever the shape of a law
    leaves. A log that begins in motion may start at the model's outputs and depart from them in what follows,
    unless every state is measured.
    """
    verdict, explained, nominal = outcome.diagnosis.verdict, outcome.corrected, outcome.nominal
    sure = verdict.kind in ("effect", "ambiguous") and not verdict.provisional
    firm = verdict.kind == "complete" or (verdict.kind == "effect" and sure)
    stages = {
        name: stage if stage.segments is not None or stage.observer else replace(stage, segments=math.inf)
        for name, stage in campaign.stages.items()
    }
    if firm or not outcome.diagnosis.gap.present or outcome.subject.observed.nuisances or not stages:
        return None
    if not all(channel.plain for case in outcome.subject.model.cases for channel in case.channels):
        return None  # sensors with a model of their own follow no segment
    if explained.effects and (
        holds(outcome.subject, nominal, explained) or exact_enough(outcome.subject, nominal, explained)
    ):
        return None
    freed = replace(campaign, stages=stages)
    subject = _started(subject_with(freed), outcome.subject.observed, nominal.fit)
    observed = subject.observed
    if not observed.nuisances or _begin_as_modelled(outcome, subject):
        return None  # a model that cannot be restarted, or has no reason to
    others = () if sure else outcome.surviving or ((explained,) if explained.effects else ())
    for base in (nominal, *others):
        fit = refit_only(subject, [subject.by_id[id] for id in base.effects], [base.fit.values])
        if fit is None:
            continue
        left = gap(fit.residuals, observed)
        if base.effects and not outcome.surviving:
            needed = starts_matter(fit, base, observed)
        else:
            needed = odds_of_starts(fit, base, explained, observed) > 0.0
        if needed and share_closed(base.gap, left) >= GAIN_OF_A_SECOND:
            break
    else:
        return None
    together = f" with {' and '.join(base.effects)}" if base.effects else ""
    note = (
        f"The runs start elsewhere than the model: estimated start states of each run leave {left:.3g} of"
        f' {base.gap:.3g} noise floors{together}, so they were used; write segments = "run" in the'
        " stages of campaign.toml"
    )
    return freed, note


def starting_as_modelled(
    campaign: Campaign,
    subject: Subject,
    subject_with: Callable[[Campaign], Subject],
    made: Callable[[Campaign], tuple[Campaign, Subject]],
) -> tuple[Campaign, Subject]:
    """Return campaign and subject without estimated start states, if effects promise to be likelier.

    A log that begins elsewhere than the model may be that of a sensor with an offset, which estimated start states
    hide, if they explain as much as a second effect has to. They are estimated after all if the effects do not
    keep their promise (`with_starts_of_runs`).
    """
    stages = {
        name: replace(stage, segments=None) if stage.segments == math.inf else stage
        for name, stage in campaign.stages.items()
    }
    if not subject.observed.nuisances or stages == campaign.stages:
        return campaign, subject
    plain = replace(campaign, stages=stages)
    whole = subject_with(plain)
    fit = None if whole.observed.nuisances else refit_only(whole, (), [whole.fitted])
    if fit is None or len(whole.observed.runs) != len(subject.observed.runs):
        return campaign, subject
    with suppress(SimulationError):
        started = _started(subject, whole.observed, fit)
        freed = refit_only(started, (), [fit.values])
        if freed is None:
            return campaign, subject
        subject = replace(subject, fitted=freed.values)
        closed = share_closed(gap(fit.residuals, whole.observed), gap(freed.residuals, started.observed))
        if closed >= GAIN_OF_A_SECOND and promise_more_than_starts(whole, fit, started, freed):
            plain, whole = made(plain)
            return plain, replace(whole, findings=(*whole.findings, _AS_MODELLED))
    return campaign, subject


def _started(freed: Subject, observed: Observed, fit: Refit) -> Subject:
    """Return a subject whose start states are estimated, linearised at a refit, with the noise of the other one.

    What two models leave is compared in the same noise, unless that one joined runs as repeats.
    """
    same = observed if len(observed.runs) == len(freed.observed.runs) else freed.observed
    return replace(freed, observed=with_states(same, freed.model, fit.values))


def _begin_as_modelled(outcome: Found, freed: Subject) -> bool:
    """Return whether the runs show every state that could be freed, each beginning where the model says."""
    states = {c.setup: c.simulator.states for c in freed.model.cases if isinstance(c.simulator, Segmented)}
    model, observed = outcome.subject.model, outcome.subject.observed
    (prediction,) = predicted(model, [outcome.nominal.fit.values])
    for case, run, rows in zip(model.cases, observed.runs, prediction, strict=True):
        sigma = observed.noise[run.setup].of_mean(run.n_repeats)
        seen = np.abs(rows[:, 0] - run.mean[:, 0]) <= SEEN * sigma
        shown = {channel.variable for channel, there in zip(case.channels, seen, strict=True) if there}
        if not shown.issuperset(states.get(case.setup, ())):
            return False
    return True


def _looked_again(
    campaign: Campaign,
    outcome: Found,
    looks: Sequence[Callable[[Campaign, Found], tuple[Campaign, str] | None]],
    diagnosed: Callable[[Campaign], tuple[Campaign, Found]],
) -> tuple[Campaign, Found]:
    """Return the campaign that explains the runs better without an effect, if there is one, and its diagnosis.

    What explains them is looked for again with the laws of each new answer.
    """
    notes: dict[int, str] = {}
    for k, look in enumerate(looks):
        for _ in range(_LOOKS):
            if (changed := look(campaign, outcome)) is None:
                break
            campaign, notes[k] = changed
            campaign, outcome = diagnosed(campaign)
    diagnosis = replace(outcome.diagnosis, notes=(*notes.values(), *outcome.diagnosis.notes))
    return campaign, replace(outcome, diagnosis=diagnosis)


def _imitating_timing(outcome: Found, cases: Sequence[Case]) -> set[str]:
    """Return the lags and delays below a sample of the best answer, and crosstalk of inputs to outputs."""
    step = min(float(np.median(np.diff(case.time))) for case in cases)
    shown, blamed = {channel.signal for case in cases for channel in case.channels}, set()
    for name, value in outcome.corrected.fit.values.items():
        signal, prop = signal_and_property(name) or ("", "")
        of_input = prop.startswith("crosstalk[") and prop[len("crosstalk[") : -1] not in shown
        if (prop in ("lag", "delay") and 0.0 < value < step) or (of_input and value and signal in shown):
            blamed.add(name)
    return blamed


def _shown_but_for(outcome: Found, blamed: Collection[str]) -> list[tuple[Case, dict[str, float]]]:
    """Return the cases with the laws of the best answer, and measurements without its effects on signals.

    What is `blamed` stays in them. If the model cannot be simulated without its effects on signals, all stay.
    """
    model, values = outcome.subject.model, outcome.corrected.fit.values
    cases = model.with_laws(values)
    laws = {name: value for name, value in values.items() if signal_and_property(name) is None}
    others = {name: value for name, value in values.items() if name not in blamed}
    predictions = model.predict([others, laws]) if others.keys() != laws.keys() else []
    simulated = [one for one in predictions if not isinstance(one, SimulationError)]
    if len(simulated) < 2:
        return cases
    without = [
        tuple(
            replace(c, repeats=c.repeats - more + less) for c, more, less in zip(case.channels, *rows, strict=True)
        )
        for (case, _), *rows in zip(cases, *simulated, strict=True)
    ]
    return [(replace(case, channels=c), starts) for (case, starts), c in zip(cases, without, strict=True)]


FILE_NAME, JOURNAL = "diagnosis.json", "diagnosis.journal"
_DIFFERS = 0.05  # standard deviations: far below what any measurement shows, far above errors of solvers
_LITTLE = 0.05  # of the gap: an equation or a table for the rest would improve predictions by no more than that
_LOOKS = 3  # diagnoses with other timings of the log: the laws of each answer tell the next one
_MUCH_LESS = 0.65  # of the gap without the closest effect, that separate values for it have to leave
_FAR = 2.0  # times a start value: what is known of a rig is seldom worse than that
_AS_MODELLED = (
    "Runs are predicted from the model's start values, because effects are more likely than start states that are"
    " estimated."
)
_BOUNDED = (
    "Runs were not repeated, so their noise was not measured: its bound is what no smooth motion explains. "
    "Slow noise and drift cannot be separated from a slow effect: repeat the runs, or give each signal's sigma."
)


@in_one_thread
def diagnose(
    campaign: Campaign | Result | str | Path,
    *,
    start: Result | str | Path | None = None,
    out: str | Path | None = None,
    experiments: Sequence[str] = (),
    resume: bool = False,
    executor: Executor | None = None,
    workers: int | None = 0,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    say: Say = quiet,
    seed: int = 0,
    rehearse: int = 0,
    law: bool = True,
    tolerance: Mapping[str, float | str] | None = None,
) -> Found:
    """Locate the gap between model and measurements, and name the unmodelled effect that causes it.

    The gap is whitened by the noise between repeats; effects of the campaign's catalogue are scored, refitted with
    the nominal parameters and judged on held-out experiments (``docs/diagnosis.md``).

    Parameters
    ----------
    campaign
        A campaign, its folder, or an identification's result or run folder, whose values are then the start.
        Without an ``[effects]`` table, the catalogue is made from its models.
    start
        An identification of the campaign, whose values are the parameters' start values.
    out
        Folder for ``diagnosis.json``, the report ``index.html``, and ``corrected``: the model with the named
        effects, and a campaign to continue with. If None, nothing is written. While the diagnosis runs, every
        simulation is recorded there. The records of an interrupted diagnosis are never overwritten.
    experiments
        Ids or globs, instead of the campaign's choice, which are the runs that ``[effects]`` names, or every run
        that is not kept for validation. Repeats are included.
    resume
        Continue the interrupted diagnosis in `out` without repeating its simulations.
    executor
        Any `concurrent.futures` executor to simulate on, such as a Dask client's; results do not depend on it.
    workers
        Number of supervised worker processes to simulate in instead; 0 for none, None for one per processor.
    time_limit, memory_limit
        Seconds and resident bytes that one simulation may take in a worker process; those of a `WorkerPool` by
        default.
    say
        Called with the current task and the fraction done (0 to 1).
    seed
        Seed of the null distribution and the bootstrap.
    rehearse
        Number of plants with known effects to simulate from the fitted model, with inputs, repeats and noise of
        the measurements and a background of small effects, and to diagnose first. The result lists which were
        found, and the probabilities are calibrated on them. The calibration is kept in the user's cache for later
        diagnoses. Without one there, the calibration shipped with fmuid is used.
    law
        Whether to look for an equation where the verdict leaves more than noise.
    tolerance
        By signal, the largest error (RMS) that is tolerated: a number in the log's unit, a text with a unit, or
        ``"5%"`` of the signal's range. If the error on left-out data is within it, the verdict is *complete*.

    Returns
    -------
    Found
        Its ``diagnosis`` is the answer.

    Raises
    ------
    CampaignError
        The catalogue does not fit the campaign, or a rehearsal is requested of runs that are cut into segments.
    JournalError
        `out` contains an interrupted diagnosis and `resume` is False, or a complete one and `resume` is True.
    SimulationError
        The nominal model cannot be simulated at its start values, or no plant for the calibration can.

    Examples
    --------
    >>> fmuid.diagnose("tank").diagnosis.verdict.kind
    'complete'
    """
    if rehearse < 0:
        raise ValueError(f"rehearse must not be negative, but is {rehearse}")
    campaign = campaign_from(campaign, start)
    from fmuid.simulation.coupled.loading import load_simulator

    folder = None if out is None else Path(out)
    if folder is not None and (folder / FOLDER).resolve() == campaign.folder.resolve():
        what = "is the campaign's folder, which the corrected model would replace"
        raise FmuidError(what, where=folder / FOLDER, fix="name another --out")
    with (
        nullcontext() if folder is None else claim(folder),
        nullcontext() if folder is None else recorded_in(folder, resume=resume) as recorded,
        runner_on(
            workers,
            executor=executor,
            time_limit=time_limit,
            memory_limit=memory_limit,
            heard=None if recorded is None else recorded.keep,
        ) as runner,
    ):
        if recorded is not None:
            runner = recorded.over(runner)
        say("noise floor", 0.0)
        recorded_runs = campaign.measurements
        campaign, notes = averaged(campaign)
        given = campaign.effects
        subject_with = partial(_subject, runner=runner, experiments=experiments, tolerance=tolerance or {})

        def made(changed: Campaign) -> tuple[Campaign, Subject]:  # its runs give the effects other sizes
            changed = with_catalogue(replace(changed, effects=given), load_simulator, runner=runner)
            return changed, subject_with(changed)

        campaign, subject = made(campaign)
        first = campaign.effects
        campaign, subject = starting_as_modelled(campaign, subject, subject_with, made)
        key = calibration.key_of(_files(campaign, subject), subject)
        rehearsal = _rehearsed(subject, rehearse, seed, say) if rehearse else []
        if rehearse:
            calibration.keep(key, calibration.fit_curves(rehearsal, "of this model, noise and set-up"))
        curves = calibration.kept(key)

        def diagnosed(changed: Campaign) -> tuple[Campaign, Found]:
            changed, subject = made(changed)
            return changed, diagnose_subject(subject, seed=seed, calibration=curves)

        outcome = diagnose_subject(subject, say=say, seed=seed, calibration=curves)
        timing = partial(with_timing_of_log, runner=runner, written=campaign)  # that of averaged samples is known
        campaign, outcome = _looked_again(
            campaign,
            outcome,
            (*(() if notes else (timing,)), partial(with_starts_of_runs, subject_with=subject_with)),
            diagnosed,
        )
        law = law and not nearly_explained(outcome.diagnosis)
        discovery = find_law(outcome, campaign.models, load_simulator, say=say, seed=seed) if law else None
        added: Candidate | Tabulated | None = None
        if discovery is not None:
            outcome, added = _with_law(outcome, discovery.law), discovery.best
        if law and added is None:
            added = tabulate(outcome, campaign.models, load_simulator, say=say, seed=seed)
            outcome = outcome if added is None else _with_table(outcome, added)
        say("comparing machines", 0.968)
        recordings = {id: recorded_runs[id].digest for id in outcome.subject.recordings}
        outcome = replace(
            outcome,
            subject=replace(outcome.subject, recordings=recordings),
            diagnosis=replace(
                outcome.diagnosis, machines=_machines(outcome), notes=(*notes, *outcome.diagnosis.notes)
            ),
            rehearsal=tuple(rehearsal),
        )
        if folder is not None:
            say("drawing", 0.97)
            keep_catalogue(folder, campaign, first)
            _write(outcome, campaign, folder, seed, added)
    # The workers have ended, so any further simulation runs in this process.
    model = replace(outcome.subject.model, runner=in_process)
    return replace(outcome, subject=replace(outcome.subject, model=model))


def nearly_explained(diagnosis: Diagnosis) -> bool:
    """Return whether the effects of the verdict leave too little of the gap for an equation or a table."""
    named, best = diagnosis.verdict.kind in ("effect", "ambiguous"), diagnosis.best
    return named and best is not None and best.closure.validated >= 1.0 - _LITTLE


def _subject(
    campaign: Campaign, runner: Runner, experiments: Sequence[str], tolerance: Mapping[str, float | str]
) -> Subject:
    from fmuid.simulation.coupled.loading import load_simulator

    subject = subject_of(campaign, load_simulator, runner=runner, experiments=experiments)
    return replace(subject, tolerances=tolerances(tolerance, subject.model.cases))


def campaign_from(
    what: Campaign | Result | str | Path,
    start: Result | str | Path | None = None,
    *,
    measurements: Path | None = None,
    trust: bool = False,
    planned: bool = False,
) -> Campaign:
    """Return the campaign, with the values of an identification if one is named; see `diagnose`.

    Raises
    ------
    CampaignError, ResultError
        One of them cannot be read, or they do not belong together.
    """
    from fmuid.campaigns.campaign_toml import load_campaign

    if isinstance(what, Result) or (not isinstance(what, Campaign) and is_run(Path(what))):
        result = what if isinstance(what, Result) else Result.from_json(what)
        what, start = result.source, start or result
    campaign = (
        what
        if isinstance(what, Campaign)
        else load_campaign(what, measurements=measurements, trust=trust, planned=planned)
    )
    if start is None:
        return campaign
    return continued(campaign, start if isinstance(start, Result) else Result.from_json(start))


def recorded_in(folder: Path, *, resume: bool) -> RecordedSimulations:
    """Return the record of a diagnosis in its folder; it is removed after the result has been written."""
    return RecordedSimulations(folder / JOURNAL, resume=resume, complete=(folder / FILE_NAME).exists())


def _rehearsed(subject: Subject, count: int, seed: int, say: Say) -> list[Trial]:
    """Diagnose plants simulated from the fitted model, with inputs, repeats and noise of the measurements."""
    if subject.observed.nuisances:
        raise CampaignError(
            "runs are cut into segments, which start from measurements, and simulated plants have none",
            where="rehearse",
            fix="omit rehearse",
        )
    unmapped, subject = Calibration(), replace(subject, tolerances={})
    first = diagnose_subject(subject, seed=seed, calibration=unmapped)

    def weights(plant: Subject) -> tuple[Verdict, dict[tuple[str, ...], float]]:
        diagnosis = diagnose_subject(plant, seed=seed, calibration=unmapped).diagnosis
        return diagnosis.verdict, {a.effects: a.probability for a in diagnosis.answers}

    return calibration.calibrate(subject, first.nominal.fit, first.paths, weights, count=count, seed=seed, say=say)


def _files(campaign: Campaign, subject: Subject) -> list[Path]:
    """Return the files that a diagnosis depends on: models, those that carry the effects, and the catalogue."""
    models = {file for model in campaign.models.values() for file in model.files}
    models |= {carrier(file, subject.catalogue) for file in models}
    return [*sorted(models), *([] if campaign.effects is None else [campaign.effects.file])]


def answer_of(outcome: Found, campaign: Campaign | None = None) -> dict[str, Any]:
    """Return the JSON object of a campaign's diagnosis, with the catalogue's words and the nominal refit."""
    catalogue = outcome.subject.catalogue
    described = {e.id: e.description for e in outcome.subject.effects}
    described |= {id: str(course) for id, course in outcome.courses.items()}
    described |= _thresholds(outcome)
    units = {name: regime.unit for name, regime in catalogue.regimes.items()} | {"time": "s"}
    answer = outcome.diagnosis.to_dict()
    for effect in answer["effects"]:
        if described.get(effect["id"]):
            effect["description"] = described[effect["id"]]
    for regime in (place["regime"] for place in answer["where"] if "regime" in place):
        if units.get(regime["variable"]):
            regime["unit"] = units[regime["variable"]]
    recordings = outcome.subject.recordings
    if campaign is not None and campaign.file is not None:
        answer["campaign"] = str(campaign.file)
        best = outcome.diagnosis.best
        ids = () if best is None else (*best.effects, *(r.id for r in best.refinements))
        answer["corrected"] = list(dict.fromkeys(ids))
    if outcome.rehearsal:
        answer["rehearsal"] = [trial.to_dict() for trial in outcome.rehearsal]
    answer["experiments"] = [{"id": name, "sha256": digest} for name, digest in recordings.items()]
    answer["model"]["standard_errors"] = _errors(outcome)
    answer["nominal"] = {"parameters": outcome.subject.model.expanded(outcome.nominal.fit.values)}
    answer["verdict"]["text"] = " ".join(sentences(answer))
    answer["notes"] += [*_at_bounds(outcome), *_far_values(outcome)]
    for effect, value in outcome.subject.modelled.items():
        answer["notes"].append(f"Not looked for, because the campaign has it in the model: {effect} ({value}).")
    if outcome.subject.observed.bounded:
        answer["notes"].append(_BOUNDED)
    return answer


def _thresholds(outcome: Found) -> dict[str, str]:
    """Return the named laws that act beyond a threshold, by effect, described with its value."""
    return {
        effect.id: effect.description.replace(
            THRESHOLD, f"beyond {fitted.fit.values[effect.threshold]:.3g} {effect.units[effect.threshold]}"
        )
        for fitted in reversed(outcome.surviving)
        for effect in outcome.subject.effects
        if effect.id in fitted.effects and effect.threshold
    }


def _errors(outcome: Found) -> dict[str, float | None]:
    """Return standard errors of the corrected model; `best` has those of a law found or a table."""
    if outcome.diagnosis.model != outcome.subject.model.expanded(outcome.corrected.fit.values):
        return {}
    known = estimates(outcome.corrected, outcome.subject, outcome.nominal, outcome.scores)
    return {name: e.standard_error for name, e in known.items()}


def _at_bounds(outcome: Found) -> Iterator[str]:
    """Yield notes on the nominal parameters of the corrected model that ended at a bound, with their values."""
    fitted, nominal = outcome.corrected, outcome.subject.nominal
    back = decide.held_back(fitted, nominal, outcome.subject.observed)
    values = {u.name: v for u in nominal if decide.at_bound(v := fitted.fit.values[u.name], u)}
    for names, what in (
        (back, "Held back by a bound of the campaign, so the model lacks something else, or the bound is wrong"),
        (values.keys() - set(back), "At a bound of the campaign, so hardly determined by these experiments"),
    ):
        if names:
            yield f"{what}: {', '.join(f'{n} = {v:.4g}' for n, v in values.items() if n in names)}."


def _far_values(outcome: Found) -> Iterator[str]:
    """Yield a note on the parameters of a complete model that are far from where they started.

    Someone who knows the rig can tell whether they are plausible; the runs cannot.
    """
    if outcome.diagnosis.verdict.kind != "complete":
        return
    known, far = estimates(outcome.nominal, outcome.subject), []
    for name, start in outcome.subject.starts.items():
        value, error = known[name].value, known[name].standard_error
        if error is not None and start != 0.0:
            least, most = sorted((value + sign * 2.0 * error) / start for sign in (-1.0, 1.0))
            if least > _FAR or most < 1.0 / _FAR:
                far.append(f"{name} = {value:.4g} (start {start:.4g})")
    if far:
        yield (
            "The model is complete with values that are more than twice or less than half of where they started:"
            f" {', '.join(far)}. If they are implausible, they stand in for something that the model lacks."
        )


def _machines(outcome: Found) -> BetweenMachines | None:
    """Return the differences between machines.

    If no effect is named, for instance because its size differs between machines, the effect that comes closest is
    included, provided that separate values per machine then leave much less of the gap than without it.
    """
    named = outcome.surviving[0] if outcome.surviving else outcome.nominal
    machines = between_machines(outcome.subject, named)
    if machines is None or outcome.surviving or outcome.best is None:
        return machines
    other = between_machines(outcome.subject, outcome.best)
    if other is None or other.gap is None or (machines.gap is not None and other.gap >= _MUCH_LESS * machines.gap):
        return machines
    return other


def _with_law(outcome: Found, law: LawFound) -> Found:
    """Return a diagnosis whose best explanation is the law found, if there is one."""
    diagnosis = replace(outcome.diagnosis, law_found=law)
    if law.id and law.closure is not None and law.gap is not None:
        parameters = {n: Estimate(p.value, p.standard_error) for n, p in law.parameters.items()}
        best = Best((*law.beside, law.id), law.closure, law.gap, parameters=parameters)
        size = replace(diagnosis.gap, corrected=law.gap)
        diagnosis = replace(diagnosis, best=best, gap=size, model=dict(law.values))
    return replace(outcome, diagnosis=diagnosis)


def _with_table(outcome: Found, table: Tabulated) -> Found:
    """Return a diagnosis whose best explanation has a table; a law that it refines has its refined parameters.

    The verdict no longer has effects that are unnecessary once the shape of another one is right.
    """
    best, diagnosis = table.best, outcome.diagnosis
    verdict, refines = diagnosis.verdict, not any(r.learned for r in best.refinements)
    rest, answers = verdict.rest, diagnosis.answers
    needless = [a for a in answers if set(best.effects) < set(a.effects)]
    if refines and needless and set(best.effects) <= set(verdict.effects):
        kind: Kind = "effect" if verdict.kind == "ambiguous" else verdict.kind
        ports = tuple(dict.fromkeys(outcome.subject.by_id[id].port for id in best.effects))
        verdict = replace(verdict, kind=kind, effects=best.effects, one_of=(), ports=ports)
        together = Answer(best.effects, sum(a.probability for a in needless), best.closure)
        others = (a for a in answers if a not in needless and a.effects != best.effects)
        diagnosis = replace(diagnosis, next_experiment=None, added_sensor=None)
        answers = tuple(sorted((together, *others), key=lambda a: -a.probability))
    if refines:
        left = best.gap > GAP_THAT_MATTERS
        rest = Rest(best.gap, where_left(table.subject, table.fitted, outcome.paths)) if left else None
    known = best.parameters if refines else {}
    effects = tuple(
        replace(
            e,
            probability=sum(a.probability for a in answers if e.id in a.effects),
            parameters={n: known.get(n, p) for n, p in e.parameters.items()},
        )
        for e in diagnosis.effects
    )
    diagnosis = replace(
        diagnosis,
        verdict=replace(verdict, rest=rest),
        answers=answers,
        best=best,
        gap=replace(diagnosis.gap, corrected=best.gap),
        model={**table.subject.model.expanded(table.fitted.fit.values)},
        effects=effects,
    )
    return replace(outcome, diagnosis=_beyond_noise(diagnosis, outcome.nominal, table))


def _beyond_noise(diagnosis: Diagnosis, nominal: Fitted, table: Tabulated) -> Diagnosis:
    """Return an undecided diagnosis as *unknown* if a table predicts left-out runs, as no slow noise would."""
    odds = decide.by_chance(nominal, table.fitted, table.among)
    by_noise = odds / (1.0 + odds)
    if diagnosis.verdict.kind != "insufficient" or by_noise > 1.0 - decide.SURE:
        return diagnosis
    ports = dict.fromkeys((*(r.port for r in table.best.refinements), *diagnosis.verdict.ports))
    weights = decide.with_none({a.effects: a.probability for a in diagnosis.answers}, by_noise)
    answers = (replace(a, probability=weights[a.effects]) for a in diagnosis.answers)
    return replace(
        diagnosis,
        verdict=replace(diagnosis.verdict, kind="unknown", ports=tuple(ports)),
        answers=tuple(sorted(answers, key=lambda a: -a.probability)),
    )


def _drawing(campaign: Campaign, outcome: Found) -> Drawing | None:
    """Return the picture of the first model that contains the verdict's place, or of the first if none does."""
    from fmuid.report.model_graph import drawing, graph_of

    used = dict.fromkeys(run.setup for run in outcome.subject.observed.runs)
    sources = [m.source for name in used if (m := campaign.models[name]).source is not None]
    graphs = [graph_of(flat_model(source)) for source in sources if source is not None]
    ports = outcome.diagnosis.verdict.ports
    graphs.sort(key=lambda g: not any(p in g.ports or p in g.parts for p in ports))
    return drawing(graphs[0], ports) if graphs else None


def _write(
    outcome: Found, campaign: Campaign, out: Path, seed: int, law: Candidate | Tabulated | None = None
) -> Corrected | None:
    from fmuid.report import write_diagnosis_report
    from fmuid.report.diagnosis_arrays import pictures_of
    from fmuid.report.provenance_table import provenance_of

    answer = answer_of(outcome, campaign)
    corrected = _write_corrected(outcome, campaign, out, law)
    if corrected is not None:
        answer["notes"] += corrected.notes
        answer["corrected_differs"] = corrected.differs
        if corrected.differs > _DIFFERS:
            answer["notes"].append(
                f"Error of fmuid: the model in {FOLDER}/ differs from the fitted one by {corrected.differs:.3g}"
                " standard deviations of the noise. Please report it; 'model' has the fitted values."
            )
    write_atomically(out / FILE_NAME, json.dumps(answer, indent=2, allow_nan=False) + "\n")
    write_diagnosis_report(
        answer,
        out,
        campaign=campaign.title,
        pictures=pictures_of(outcome, _predicted(law)),
        model=_drawing(campaign, outcome),
        units={n: u for e in outcome.subject.effects for n, u in e.units.items() if u != "1"}
        | {n: p.unit for n, p in campaign.parameters.items() if p.unit},
        provenance=provenance_of(campaign, seed, files=_files(campaign, outcome.subject)),
    )
    return corrected


def _predicted(added: Candidate | Tabulated | None) -> Prediction | None:
    """Return the prediction of a model with a law or a table that was added."""
    outcome = None if added is None else added.subject.model.predict([added.fitted.fit.values])[0]
    return None if isinstance(outcome, SimulationError) else outcome


def _write_corrected(
    outcome: Found, campaign: Campaign, out: Path, law: Candidate | Tabulated | None
) -> Corrected | None:
    """Write the model with the best explanation, simulate it, and compare it with the fitted prediction."""
    fitted, subject = outcome.corrected, outcome.subject
    if law is not None:
        fitted, campaign = law.fitted, with_effect(campaign, law.effect.id, entry(law.effect))
        subject = replace(subject, effects=(*subject.effects, law.effect))
    runner = outcome.subject.model.runner
    written = write_corrected(
        campaign, subject, fitted.effects, fitted.fit.values, folder=out / FOLDER, runner=runner
    )
    if written is None:
        return None
    fit_to = subject if law is None else law.subject
    return checked(written, fit_to, fitted, runner=runner)
