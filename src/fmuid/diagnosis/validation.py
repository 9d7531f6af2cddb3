"""Validation of a diagnosed model on other data: errors and gaps compared with the refitted nominal model."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.campaign import SEPARATOR, Campaign, without_owner
from fmuid.core.errors import FmuidError, SimulationError
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.core.one_thread import in_one_thread
from fmuid.diagnosis.cross_validation import closure_interval, losses, share_closed
from fmuid.diagnosis.extended_model import CampaignModel, Prediction
from fmuid.diagnosis.made_catalogue import with_catalogue, with_effect
from fmuid.diagnosis.observed import Observed, gap
from fmuid.diagnosis.segment_states import with_states
from fmuid.diagnosis.subject import model_of
from fmuid.identification.problem.cases import experiments_of
from fmuid.identification.problem.segments import in_segments
from fmuid.simulation.runners import Runner, in_process


@dataclass(frozen=True, slots=True)
class Comparison:
    """One signal of one run: root mean square errors in `unit`, and relative to the signal's spread (NRMSE).

    `noise` is the standard deviation of the sensor's noise; None where no run was repeated.
    """

    experiment: str
    signal: str
    unit: str | None
    noise: float | None
    rmse_nominal: float
    rmse_corrected: float
    nrmse_nominal: float
    nrmse_corrected: float


@dataclass(frozen=True, slots=True)
class DiagnosisValidation:
    """Benefit of the correction on data that the diagnosis has not seen.

    `runs` are the recordings used for validation. `used` are those of them that the diagnosis was made from, which
    only happens to runs asked for by name; None means that the diagnosis does not say. `gaps` gives, by experiment
    and for ``all`` together, the gap in noise floors of the refitted nominal model and of the corrected one.
    `interval` is the 90 % interval of the overall closure: a bootstrap over runs, and over pieces of runs that
    were not repeated.
    """

    comparisons: tuple[Comparison, ...]
    gaps: Mapping[str, tuple[float, float]]
    interval: tuple[float, float] | None = None
    runs: tuple[str, ...] = ()
    used: tuple[str, ...] | None = ()
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "runs": list(self.runs),
            "used_for_the_diagnosis": None if self.used is None else list(self.used),
            "comparisons": [asdict(c) for c in self.comparisons],
            "gaps": {
                n: {"nominal": a, "corrected": b, "closure": share_closed(a, b)} for n, (a, b) in self.gaps.items()
            },
            "closure_interval": None if self.interval is None else list(self.interval),
            "notes": list(self.notes),
        }


def read_diagnosis(path: Path) -> dict[str, Any]:
    """Return the JSON value of a diagnosis; the verdict of a version 1 file is converted to version 2.

    Raises
    ------
    FmuidError
        The file is missing, is not a diagnosis, or lacks its verdict or a model's values.
    """
    try:
        answer = json.loads(path.read_text())
    except OSError as error:
        raise FmuidError(f"cannot be read ({error.strerror})", where=path, fix="check the path") from None
    except ValueError:
        raise FmuidError("is not JSON", where=path, fix="give a file written by fmuid diagnose") from None
    if (
        not isinstance(answer, dict)
        or answer.get("format") != "fmuid-diagnosis"
        or answer.get("version") not in (1, 2, 3)
    ):
        raise FmuidError(
            "is not a diagnosis, version 1 to 3", where=path, fix="give a file written by fmuid diagnose"
        )
    verdict = answer.get("verdict")
    if not isinstance(verdict, dict) or not {"kind", "effects"} <= verdict.keys():
        raise FmuidError("no verdict", where=path, fix="diagnose again")
    if answer["version"] == 1:  # it lists indistinguishable effects in one list
        apart = [[name] for name in verdict["effects"]] if verdict["kind"] == "ambiguous" else []
        verdict |= {"one_of": apart, "effects": [] if apart else verdict["effects"]}
    verdict.setdefault("one_of", [])
    _check_models(answer, path)
    recordings = answer.get("experiments", [])
    if not isinstance(recordings, list) or not all(isinstance(r, dict) and "sha256" in r for r in recordings):
        raise FmuidError("'experiments' has no hashes of recordings", where=path, fix="diagnose again")
    return answer


def _check_models(answer: Mapping[str, Any], path: Path) -> None:
    """Refuse a diagnosis whose models lack their values."""
    parts = {part: answer.get(part) for part in ("nominal", "model")}
    law = law_of(answer)
    if law is not None:
        parts["law_found"] = law.get("model")
        if not isinstance(law.get("id"), str) or not isinstance(law.get("effect"), dict):
            raise FmuidError("'law_found' has no effect", where=path, fix="diagnose again")
    for part, model in parts.items():
        values = model.get("parameters") if isinstance(model, dict) else None
        if not isinstance(values, dict) or not all(type(v) in (int, float) for v in values.values()):
            raise FmuidError(f"no parameter values in '{part}'", where=path, fix="diagnose again")


@in_one_thread
def validate_diagnosis(
    answer: Mapping[str, Any],
    campaign: Campaign,
    *,
    others: Campaign | None = None,
    corrected: Campaign | None = None,
    experiments: Sequence[str] = (),
    runner: Runner = in_process,
) -> DiagnosisValidation:
    """Simulate other runs with the diagnosed model and with the refitted nominal model.

    Parameters
    ----------
    answer
        The JSON value of a diagnosis.
    campaign
        The diagnosed campaign, or one with an ``[effects]`` table that names the same catalogue.
    others
        The same campaign with other recordings, on which to validate.
    corrected
        The corrected campaign that the diagnosis wrote: its own models and values are simulated. By default, the
        models are built again from the values in `answer`.
    experiments
        Ids or globs. By default, the campaign's validation set, or all of its runs if it has none, without those
        that the diagnosis was made from. Repeats of named runs are included if they were not used.

    Raises
    ------
    FmuidError
        No run is left by default, or the diagnosis does not say which runs it was made from.
        Or the diagnosis is of another model: it has parameters unknown to campaign, catalogue and FMUs.
    SimulationError
        A run cannot be simulated.
    """
    from fmuid.simulation.coupled.loading import load_simulator

    diagnosed = with_catalogue(campaign, load_simulator, runner=runner)  # its runs give the effects their sizes
    law = law_of(answer)
    added = [*([] if law is None else [law]), *answer.get("refinements", ())]
    for one in added:
        diagnosed = with_effect(diagnosed, one["id"], one["effect"])
    if added:
        diagnosed = with_catalogue(diagnosed, load_simulator, runner=runner)
    campaign = replace(others or campaign, effects=diagnosed.effects, models=diagnosed.models)
    chosen, used = _chosen(answer, campaign, experiments)
    model, catalogue, known, _ = model_of(campaign, load_simulator, chosen, runner=runner)
    points = [answer["nominal"]["parameters"], (law or answer)["model"]["parameters"]]
    known |= {*campaign.parameters, *(u.name for e in catalogue.effects.values() for u in e.unknowns)}
    foreign = sorted({name for point in points for name in point if without_owner(name) not in known})
    if foreign:
        raise FmuidError(
            f"neither the campaign nor its catalogue or FMUs know '{foreign[0]}', which the diagnosis has",
            where=campaign.name,
            fix="validate on runs of the model that was diagnosed",
        )
    outcomes = model.predict(points[: 1 if corrected is not None else 2])
    if corrected is not None:
        outcomes += _of_corrected(corrected, campaign, chosen, runner)
    predictions = []
    for outcome in outcomes:
        if isinstance(outcome, SimulationError):
            raise outcome
        predictions.append(outcome)
    runs = model.runs
    channels = {(case.id, c.signal): c for case in model.cases for c in case.channels}
    floor = with_states(Observed.from_runs(runs), model, points[0])
    comparisons = []
    for e, run in enumerate(runs):
        sigma = floor.noise[run.setup].sigma
        for c, signal in enumerate(run.channels):
            before, after = (_rmse(p[e][c], run.values[:, c]) for p in predictions)
            spread = float(np.nanstd(run.values[:, c])) or float("nan")
            channel = channels[run.id, signal]
            factor = abs(channel.to_shown.factor)
            noise = None if sigma.get(signal) is None else factor * sigma[signal]
            own = (factor * before, factor * after, before / spread, after / spread)
            comparisons.append(Comparison(run.id, signal, channel.shown_unit or None, noise, *own))
    gaps, interval = _gaps(floor, predictions), _interval(floor, predictions)
    notes = _of_others(points[0], model)
    return DiagnosisValidation(tuple(comparisons), gaps, interval, tuple(e.id for e in chosen), used, notes)


def _of_corrected(
    corrected: Campaign, campaign: Campaign, chosen: Sequence[Experiment], runner: Runner
) -> list[Prediction | SimulationError]:
    """Return the prediction of the chosen runs by the models and values of a corrected campaign."""
    from fmuid.simulation.coupled.loading import load_simulator

    setups = dict.fromkeys(e.setup for e in chosen)
    simulators = {s: load_simulator(corrected.models[s]) for s in setups}
    there = replace(corrected, measurements=campaign.measurements)
    cases = in_segments(there, chosen, simulators, corrected.start_values)
    return CampaignModel(cases, runner, corrected.start_values).predict([{}])


def _of_others(values: Mapping[str, float], model: CampaignModel) -> tuple[str, ...]:
    """Return notes on the parameters per machine or run that have no value in the diagnosis."""
    names = dict.fromkeys(without_owner(n) for n in values if SEPARATOR in n)
    unseen = {
        name: dict.fromkeys(c.id for c in model.cases if name in c.setting and name not in c.values(values))
        for name in names
    }
    return tuple(
        f"{n} has its start value in {', '.join(ids)}: the diagnosis has none for it"
        for n, ids in unseen.items()
        if ids
    )


def law_of(answer: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the law found by a diagnosis, if any; the corrected model then contains it."""
    law = answer.get("law_found")
    return law if isinstance(law, dict) and law.get("formula") else None


def _chosen(
    answer: Mapping[str, Any], campaign: Campaign, experiments: Sequence[str]
) -> tuple[tuple[Experiment, ...], tuple[str, ...] | None]:
    """Return the runs to validate on, and which of them the diagnosis was made from; None if it does not say."""
    hashed = "experiments" in answer
    seen = {recording["sha256"] for recording in answer.get("experiments", ())}
    if experiments:
        named = {e.id: e.origin for e in experiments_of(campaign, experiments, where="--experiment")}
        chosen = tuple(
            e
            for e in campaign.measurements
            if e.id in named or (e.origin in named.values() and e.digest not in seen)
        )
        return chosen, tuple(e.id for e in chosen if e.digest in seen) if hashed else None
    fix = "record other runs, or name runs with --experiment"
    if not campaign.validation and not hashed:
        raise FmuidError(
            "the diagnosis does not say which runs it was made from",
            where=campaign.name,
            fix=f"diagnose again; {fix}",
        )
    ids = campaign.validation or tuple(campaign.measurements.experiments)
    chosen = tuple(e for e in campaign.measurements if e.id in ids and e.digest not in seen)
    if not chosen:
        kept = "run that is kept for validation" if campaign.validation else "run"
        raise FmuidError(f"every {kept} was used for the diagnosis", where=campaign.name, fix=fix)
    return chosen, () if hashed else None


def _rmse(prediction: FloatArray, measured: FloatArray) -> float:
    return float(np.sqrt(np.nanmean((prediction - measured) ** 2)))


def _interval(observed: Observed, predictions: Sequence[Sequence[FloatArray]]) -> tuple[float, float]:
    before, after = (
        losses([residuals[e][rows] for e, rows in observed.folds], observed)
        for residuals in map(observed.residuals, predictions)
    )
    return closure_interval(before, after)


def _gaps(observed: Observed, predictions: Sequence[Sequence[FloatArray]]) -> dict[str, tuple[float, float]]:
    before, after = (observed.residuals(p) for p in predictions)
    gaps = {"all": (gap(before, observed), gap(after, observed))}
    for k, run in enumerate(observed.runs):
        alone = observed.select([run.id])
        gaps[run.id] = (gap(before[k : k + 1], alone), gap(after[k : k + 1], alone))
    return gaps
