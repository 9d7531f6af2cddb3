"""A diagnosed model on other data: errors and gaps of every run, beside those of the nominal model refitted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.errors import FmuidError, SimulationError
from fmuid.core.immutable import FloatArray
from fmuid.data.noise_spectrum import RepeatedRuns
from fmuid.diagnosis.observed import Observed, gap
from fmuid.diagnosis.subject import model_of
from fmuid.simulation.runners import Runner, in_process


@dataclass(frozen=True, slots=True)
class Comparison:
    """One signal of one run: root mean square errors in `unit`, and the same over the signal's spread (NRMSE).

    `noise` is the standard deviation of the sensor's noise, None where no run was repeated.
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
    """What the correction is worth on data that the diagnosis has not seen.

    `gaps` gives, by experiment and for ``all`` together, the gap in noise floors of the nominal model refitted
    and of the corrected one; empty where a setup has no repeats to take a noise floor from.
    """

    comparisons: tuple[Comparison, ...]
    gaps: Mapping[str, tuple[float, float]]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "comparisons": [asdict(c) for c in self.comparisons],
            "gaps": {
                n: {"nominal": a, "corrected": b, "closure": closure(a, b)} for n, (a, b) in self.gaps.items()
            },
        }


def closure(before: float, after: float) -> float:
    """Return 1 - G1/G0, 0 where there was no gap."""
    return 1.0 - after / before if before > 0.0 else 0.0


def read_diagnosis(path: Path) -> dict[str, Any]:
    """Return the JSON value of a diagnosis.

    Raises
    ------
    FmuidError
        The file is missing or holds something else, or lacks its verdict or a model's values.
    """
    try:
        answer = json.loads(path.read_text())
    except OSError as error:
        raise FmuidError(f"cannot be read ({error.strerror})", where=path, fix="check the path") from None
    except ValueError:
        raise FmuidError("is no JSON", where=path, fix="name a file that fmuid diagnose wrote") from None
    if not isinstance(answer, dict) or answer.get("format") != "fmuid-diagnosis" or answer.get("version") != 1:
        raise FmuidError("is no diagnosis, version 1", where=path, fix="name a file that fmuid diagnose wrote")
    verdict = answer.get("verdict")
    if not isinstance(verdict, dict) or not {"kind", "effects"} <= verdict.keys():
        raise FmuidError("no verdict", where=path, fix="diagnose again")
    for part in ("nominal", "model"):
        model = answer.get(part)
        values = model.get("parameters") if isinstance(model, dict) else None
        if not isinstance(values, dict) or not all(type(v) in (int, float) for v in values.values()):
            raise FmuidError(f"no parameter values in '{part}'", where=path, fix="diagnose again")
    return answer


def validate_diagnosis(
    answer: Mapping[str, Any],
    campaign: Campaign,
    *,
    experiments: Sequence[str] = (),
    runner: Runner = in_process,
) -> DiagnosisValidation:
    """Simulate other runs with the diagnosed model and with the nominal model refitted.

    Parameters
    ----------
    answer
        The JSON value of a diagnosis.
    campaign
        With an ``[effects]`` table that names the same catalogue.
    experiments
        Ids or globs; by default the campaign's validation set, or all of its runs if it has none.

    Raises
    ------
    FmuidError
        The diagnosis is of another model: it has parameters that neither campaign nor catalogue nor FMUs know.
    SimulationError
        A run cannot be simulated.
    """
    from fmuid.simulation.coupled.loading import load_model

    chosen = experiments or campaign.validation or tuple(campaign.measurements.experiments)
    model, catalogue, known = model_of(campaign, load_model, runner=runner, experiments=chosen)
    points = [answer["nominal"]["parameters"], answer["model"]["parameters"]]
    known |= {*campaign.parameters, *(u.name for e in catalogue.effects.values() for u in e.unknowns)}
    foreign = sorted({name for point in points for name in point} - known)
    if foreign:
        raise FmuidError(
            f"neither the campaign nor its catalogue or FMUs know '{foreign[0]}', which the diagnosis has",
            where=campaign.name,
            fix="validate on runs of the model that was diagnosed",
        )
    outcomes = model.predict(points)
    predictions = []
    for outcome in outcomes:
        if isinstance(outcome, SimulationError):
            raise outcome
        predictions.append(outcome)
    runs = model.runs
    units = {(case.id, c.signal): c.unit for case in model.cases for c in case.channels}
    floor = _floor(runs)
    comparisons = []
    for e, run in enumerate(runs):
        sigma = {} if floor is None else floor.noise[run.setup].sigma
        for c, signal in enumerate(run.channels):
            before, after = (_rmse(p[e][c], run.values[:, c]) for p in predictions)
            spread = float(np.nanstd(run.values[:, c])) or float("nan")
            unit = units[run.id, signal]
            comparisons.append(
                Comparison(run.id, signal, unit, sigma.get(signal), before, after, before / spread, after / spread)
            )
    return DiagnosisValidation(tuple(comparisons), {} if floor is None else _gaps(floor, predictions))


def _rmse(prediction: FloatArray, measured: FloatArray) -> float:
    return float(np.sqrt(np.nanmean((prediction - measured) ** 2)))


def _floor(runs: Sequence[RepeatedRuns]) -> Observed | None:
    repeated = {r.setup for r in runs if r.n_repeats > 1}
    return Observed.from_runs(runs) if all(r.setup in repeated for r in runs) else None


def _gaps(observed: Observed, predictions: Sequence[Sequence[FloatArray]]) -> dict[str, tuple[float, float]]:
    before, after = (observed.residuals(p) for p in predictions)
    gaps = {"all": (gap(before, observed), gap(after, observed))}
    for k, run in enumerate(observed.runs):
        alone = observed.select([run.id])
        gaps[run.id] = (gap(before[k : k + 1], alone), gap(after[k : k + 1], alone))
    return gaps
