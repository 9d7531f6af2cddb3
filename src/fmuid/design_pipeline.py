"""Designing an experiment: load, search in worker processes, and write the input for the rig."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fmu_build.errors import counted
from fmuid.core.campaign import Campaign
from fmuid.core.errors import FmuidError, SimulationError
from fmuid.core.files import write_atomically
from fmuid.core.folder_lock import claim
from fmuid.core.immutable import FloatArray
from fmuid.core.one_thread import in_one_thread
from fmuid.core.progress import Say, quiet
from fmuid.data.crosscheck_csv import Table, write_csv
from fmuid.design.excitation_search import Excitation
from fmuid.design.parameters import Optimality, ParameterDesign, design_for_parameters
from fmuid.design.planned import Planned
from fmuid.design.rivals import SETTLED, DiagnosisDesign, design_for_diagnosis, rivals_of
from fmuid.diagnosis.corrected import read_diagnosis
from fmuid.diagnosis.made_catalogue import with_catalogue
from fmuid.diagnosis.subject import subject_of
from fmuid.diagnosis_pipeline import FILE_NAME as DIAGNOSIS
from fmuid.diagnosis_pipeline import campaign_from
from fmuid.identification.result import FILE as RESULT
from fmuid.identification.result import Result
from fmuid.simulation.pool.choice import runner_on

FILE_NAME, INPUT = "design.json", "input.csv"
Purpose = Literal["diagnosis", "parameters"]
_SETTLES = "Does it settle the question"
_DRAWN = 4  # answers shown in the figures
_SHOWN = 6  # pairs of answers shown, the closest ones
_SAID = 3  # changes listed that would help beyond an excitation
_FURTHER = {"sensor": "It takes", "setting": "Or set", "limits": "Or allow"}


@dataclass(frozen=True, slots=True, eq=False)
class Designed:
    """A designed experiment.

    Parameters
    ----------
    answer
        The value of ``design.json``.
    time, inputs, units
        (N,) times, (N,) samples of each input for the rig, and their units.
    interrupted
        Whether the search was interrupted; this is then the best experiment so far.
    """

    answer: Mapping[str, Any]
    time: FloatArray
    inputs: Mapping[str, FloatArray]
    units: Mapping[str, str]
    interrupted: bool

    def __str__(self) -> str:
        """Return the design in words."""
        return "\n".join(f"{label}: {value}" for label, value, *_ in self.answer["facts"])


@in_one_thread
def design_experiment(
    campaign: Campaign | Result | str | Path,
    purpose: Purpose,
    *,
    start: Result | str | Path | None = None,
    out: str | Path | None = None,
    stage: str | None = None,
    optimality: Optimality = "D",
    evaluations: int = 200,
    seed: int = 0,
    workers: int | None = 0,
    time_limit: float | None = None,
    memory_limit: int | None = None,
    say: Say = quiet,
    trust: bool = False,
) -> Designed:
    """Design the next experiment within the limits of a campaign.

    Parameters
    ----------
    campaign
        A campaign or its folder, even without measurements; or an identification's result or run folder.
    purpose
        ``parameters``: the most informative run for the free parameters. ``diagnosis``: the run that best
        distinguishes the answers of a diagnosis.
    start
        An identification of the campaign, whose values the parameters take, or a diagnosis of it: the folder or
        ``diagnosis.json``. The latter may also be given as `campaign`.
    out
        Folder for ``input.csv``, ``design.json`` and the page ``index.html``. If None, nothing is written.
    stage, optimality
        For a design for parameters: the stage that names them, and whether to minimise the volume (``D``) of their
        confidence region or the sum of squares (``A``) of their standard errors.
    evaluations
        Number of excitations to try.
    seed
        Seed of the search and of drawn phases and parameter values.
    workers, time_limit, memory_limit
        As in `fmuid.diagnose`.
    say
        Called with the current task and the fraction done (0 to 1).
    trust
        Whether functions that the campaign names may be imported and called.

    Returns
    -------
    Designed
        Its ``answer`` is the value of ``design.json``.

    Raises
    ------
    CampaignError, FmuError
        The campaign's limits do not fit its model.
    FmuidError
        No excitation stays within every limit.

    Examples
    --------
    >>> designed = fmuid.design_experiment("tank", "parameters", evaluations=5)
    >>> list(designed.inputs), designed.units["P"]
    (['P'], 'W')
    """
    from fmuid.simulation.coupled.loading import load_simulator

    loaded, left_open = campaign_and_diagnosis(campaign, start, trust=trust)
    if purpose == "diagnosis" and left_open is None:
        raise FmuidError(
            "there is no diagnosis to continue from",
            where="--for diagnosis",
            fix="give the folder written by `fmuid diagnose`, as CAMPAIGN or with --from",
        )
    made: ParameterDesign | DiagnosisDesign
    with runner_on(workers, time_limit=time_limit, memory_limit=memory_limit) as runner:
        if purpose == "diagnosis" and left_open is not None:
            say("refitting the open answers", 0.0)
            loaded = with_catalogue(loaded, load_simulator, runner=runner)
            runs = [e["id"] for e in left_open["experiments"]]
            subject = subject_of(loaded, load_simulator, runner=runner, experiments=runs)
            answers = rivals_of(subject, left_open)
            made = design_for_diagnosis(loaded, subject, answers, evaluations=evaluations, seed=seed, say=say)
            details = _of_diagnosis(made)
            drawn = made.rivals[:_DRAWN]
            predicted = {_words(r.names): _predicted(made.planned, made.excitation, r.values) for r in drawn}
        else:
            made = design_for_parameters(
                loaded,
                load_simulator,
                runner,
                stage=stage,
                optimality=optimality,
                evaluations=evaluations,
                seed=seed,
                say=say,
            )
            details = {"optimality": optimality, **_of_parameters(made)}
            predicted = {"at these parameter values": _predicted(made.planned, made.excitation, made.values)}
    answer = {**_head(loaded, purpose, made.planned, made.excitation), **details}
    designed = _designed(answer, made.planned, made.excitation)
    if out is not None:
        say("drawing", 0.97)
        _write(designed, made.planned, predicted, loaded, Path(out), seed=seed)
    return designed


def campaign_and_diagnosis(
    what: Campaign | Result | str | Path, start: Result | str | Path | None = None, *, trust: bool = False
) -> tuple[Campaign, dict[str, Any] | None]:
    """Return the campaign, and the JSON of its diagnosis if one is named; see `design_experiment`.

    Raises
    ------
    CampaignError, ResultError, FmuidError
        One of them cannot be read, or they do not belong together.
    """
    file = _diagnosis_file(what) or _diagnosis_file(start)
    if file is None:
        return campaign_from(what, start, trust=trust, planned=True), None
    answer = read_diagnosis(file)
    if _diagnosis_file(what) is None:
        return campaign_from(what, trust=trust), answer
    if not answer.get("campaign"):
        raise FmuidError("names no campaign", where=file, fix="give the campaign, and this with --from")
    folder = start if start is not None and _diagnosis_file(start) is None else None
    return campaign_from(answer["campaign"], folder, trust=trust), answer


def _diagnosis_file(what: object) -> Path | None:
    """Return the JSON file written by a diagnosis, if `what` names one."""
    if not isinstance(what, str | Path):
        return None
    path = Path(what)
    if path.suffix == ".json" and path.is_file() and path.name != RESULT:
        return path
    return path / DIAGNOSIS if (path / DIAGNOSIS).is_file() else None


def _head(campaign: Campaign, purpose: Purpose, planned: Planned, excitation: Excitation) -> dict[str, Any]:
    time, case = planned.time, planned.case
    inputs = {
        d.name: {
            "unit": d.unit,
            "min": float(np.min(d.written(u))),
            "max": float(np.max(d.written(u))),
            "rate": float(np.max(np.abs(np.diff(d.written(u)) / np.diff(time)))),
        }
        for d, u in zip(planned.driven, excitation.samples, strict=True)
    }
    return {
        "format": "fmuid-design",
        "version": 1,
        "purpose": purpose,
        "campaign": None if campaign.file is None else str(campaign.file),
        "setup": case.setup,
        "description": excitation.description,
        "duration": float(time[-1] - time[0]),
        "sample_time": float(time[1] - time[0]),
        "repeats": planned.repeats,
        "tried": excitation.evaluations,
        "interrupted": excitation.interrupted,
        "inputs": inputs,
        "sigma": {c.signal: float(s) for c, s in zip(case.channels, planned.sigma, strict=True)},
        "assumed_limits": list(planned.assumed),
    }


def _of_parameters(made: ParameterDesign) -> dict[str, Any]:
    entries = {n: {"value": made.values[n], "before": made.before[n], "after": made.after[n]} for n in made.values}
    facts = _run_facts(made.planned, made.excitation)
    errors = ", ".join(f"{name} {100 * error:.2g} %" for name, error in made.after.items())
    facts.append(("Standard errors with it", errors))
    answer: dict[str, Any] = {"parameters": entries, "gain": None, "repeated_run": None}
    if made.repeated is not None:
        name, again = made.repeated
        squares = [sum(e**2 for e in es.values()) for es in (again, made.after)]
        answer["gain"] = made.gain
        answer["repeated_run"] = {"experiment": name, "parameters": dict(again), "gain": squares[0] / squares[1]}
        share = squares[0] / squares[1]
        less = f"{made.gain:.3g} times smaller than without it, {share:.3g} times than with {name}"
        facts.append(("Sum of their squares", less))
    return {**answer, "facts": facts, "text": _text(facts)}


def _of_diagnosis(made: DiagnosisDesign) -> dict[str, Any]:
    facts = _run_facts(made.planned, made.excitation)
    settled = made.settled_for
    if len(settled) == len(made.rivals):
        facts.append((_SETTLES, "yes, whichever answer is right", "good"))
    elif made.hopeless:
        facts.append((_SETTLES, "no run within these limits settles it", "warn"))
    else:
        chances = [
            f"{'yes' if rival in settled else f'with a probability of {100 * chance:.0f} %'}"
            f" if the right answer is {_words(rival.names)}"
            for rival, chance in zip(made.rivals, made.chances, strict=True)
        ]
        facts.append((_SETTLES, "; ".join(chances)))
    closest = sorted(made.pairs, key=lambda pair: pair[2])
    for a, b, s in closest[:_SHOWN]:
        facts.append((f"{_words(a.names)} or {_words(b.names)}", f"{s:.3g} sigma"))
    if len(closest) > _SHOWN:
        others = f"{counted(len(closest) - _SHOWN, 'pair')}, {closest[_SHOWN][2]:.3g} sigma or more"
        facts.append(("Farther apart", others))
    for further in made.beyond[:_SAID]:
        facts.append((_FURTHER[further.kind], f"{further.what}: {further.separation:.3g} sigma"))
    return {
        "settled": len(settled) == len(made.rivals),
        "settled_for": [list(rival.names) for rival in settled],
        "hopeless": made.hopeless,
        "chances": [
            {"right": list(rival.names), "alone": float(chance)}
            for rival, chance in zip(made.rivals, made.chances, strict=True)
        ],
        "separation_sigma": made.least,
        "needed_sigma": SETTLED,
        "pairs": [{"between": [list(a.names), list(b.names)], "separation_sigma": s} for a, b, s in made.pairs],
        "beyond": [{"kind": b.kind, "what": b.what, "separation_sigma": b.separation} for b in made.beyond],
        "facts": facts,
        "text": _text(facts),
    }


def _words(names: Sequence[str]) -> str:
    return " and ".join(names) or "nothing missing"


def _text(facts: Sequence[tuple[str, ...]]) -> str:
    return " ".join(f"{label}: {value}." for label, value, *_ in facts)


def _run_facts(planned: Planned, excitation: Excitation) -> list[tuple[str, ...]]:
    time = planned.time
    made = "" if planned.repeats == 1 else f", made {planned.repeats} times"
    facts: list[tuple[str, ...]] = [
        ("Run", f"{excitation.description}, {time[-1] - time[0]:.4g} s, setup {planned.case.setup}{made}"),
        *(
            ("Input", f"{d.name} from {np.min(d.written(u)):.4g} to {np.max(d.written(u)):.4g} {d.unit}")
            for d, u in zip(planned.driven, excitation.samples, strict=True)
        ),
    ]
    if planned.assumed:
        facts.append(("Limits, taken from the recorded runs as none are given", "; ".join(planned.assumed)))
    if excitation.interrupted:
        facts.append(("Interrupted", f"the best of {counted(excitation.evaluations, 'excitation')}", "warn"))
    return facts


def _predicted(planned: Planned, excitation: Excitation, values: Mapping[str, float]) -> FloatArray:
    (outcome,) = planned.under(excitation.samples).predict([values])
    if isinstance(outcome, SimulationError):
        raise outcome
    return outcome[0]


def _designed(answer: Mapping[str, Any], planned: Planned, excitation: Excitation) -> Designed:
    inputs = {d.name: d.written(u) for d, u in zip(planned.driven, excitation.samples, strict=True)}
    return Designed(answer, planned.time, inputs, {d.name: d.unit for d in planned.driven}, excitation.interrupted)


def _write(
    designed: Designed,
    planned: Planned,
    predicted: Mapping[str, FloatArray],
    campaign: Campaign,
    out: Path,
    *,
    seed: int,
) -> None:
    from fmuid.report.design_page import PlannedSignal, write_design_page
    from fmuid.report.provenance_table import provenance_of

    with claim(out):
        write_csv(Table(designed.time, designed.inputs, designed.units), out / INPUT)
        write_atomically(out / FILE_NAME, json.dumps(designed.answer, indent=2) + "\n")
        limit = {w.channel: w for w in planned.watched}
        inputs = [
            PlannedSignal(
                d.name,
                d.unit,
                designed.time,
                {d.name: designed.inputs[d.name]},
                None,
                *(float(d.written(np.array(b))) for b in (d.bounds.lower, d.bounds.upper)),
            )
            for d in planned.driven
        ]
        outputs = [
            PlannedSignal(
                c.signal,
                c.unit or "",
                designed.time,
                {label: rows[k] for label, rows in predicted.items()},
                float(planned.sigma[k]),
                *((limit[k].lower, limit[k].upper) if k in limit else ()),
            )
            for k, c in enumerate(planned.case.channels)
        ]
        write_design_page(
            designed.answer,
            out,
            campaign=campaign.title,
            inputs=inputs,
            outputs=outputs,
            provenance=provenance_of(campaign, seed),
        )
