"""What a run or a diagnosis found, as values to look at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fmuid.core.campaign import Campaign
from fmuid.core.errors import FmuidError, UnitError
from fmuid.core.units import conversion
from fmuid.diagnosis.corrected import FOLDER, read_diagnosis
from fmuid.effects.effects_file import load_catalogue
from fmuid.identification.result import Result
from fmuid.page.workspace import Workspace
from fmuid.report.figures import Overlay
from fmuid.report.identification_page import estimates_sentence
from fmuid.simulation.signal_effects import NEUTRAL, signal_and_property


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of an identification or of a diagnosis.

    Parameters
    ----------
    headline
        One sentence.
    values
        Sets of parameter values by the words for them, such as *identified* or *with the correction*; the first is
        shown first.
    effects
        Parameters of the corrected model that belong to an effect, with the value at which it vanishes.
    """

    headline: str
    values: Mapping[str, Mapping[str, float]]
    effects: Mapping[str, float] = field(default_factory=dict)


def of_result(result: Result, campaign: Campaign) -> Outcome:
    """Return the outcome of an identification."""
    start = campaign.start_values
    return Outcome(estimates_sentence(result), {"identified": start | result.parameters, "start": start})


def of_diagnosis(folder: Path, campaign: Campaign) -> Outcome:
    """Return the outcome of a diagnosis, whose corrected campaign is `campaign`.

    Raises
    ------
    FmuidError
        The diagnosis cannot be read.
    """
    answer: Mapping[str, Any] = read_diagnosis(folder / "diagnosis.json")
    corrected = campaign.start_values
    effects = neutral_values(campaign)
    nominal = {n: v for n, v in answer.get("nominal", {}).get("parameters", {}).items() if n in corrected}
    headline = answer["verdict"].get("text") or answer["verdict"]["kind"]
    if not effects:
        return Outcome(headline, {"nominal, refitted": corrected | nominal, "start": corrected})
    return Outcome(headline, {"corrected": corrected, "nominal, refitted": corrected | nominal | effects}, effects)


def of_corrected(folder: Path, workspace: Workspace) -> Workspace:
    """Return a workspace of the corrected model of a diagnosis, or `workspace` if it named no effect."""
    corrected = folder / FOLDER
    if not corrected.is_dir():
        return workspace
    return Workspace(corrected, runner=workspace.runner, trust=workspace.trust)


def neutral_values(campaign: Campaign) -> dict[str, float]:
    """Return the parameters of effects that the models include, at the values at which the effects vanish."""
    values: dict[str, float] = {}
    for model in campaign.models.values():
        if model.source is not None and model.source.effects is not None:
            for effect in load_catalogue(model.source.effects).effects.values():
                values |= {n: v for n, v in effect.neutral.items() if n in campaign.parameters}
        for name in campaign.parameters:
            signal = signal_and_property(name)
            if signal is not None and any(name in e for e in model.signal_effects):
                values[name] = NEUTRAL.get(signal[1], 0.0)
    return values


def in_log_units(overlay: Overlay, unit: str) -> Overlay:
    """Return an overlay in the unit of the log."""
    try:
        convert = conversion(overlay.unit or "1", unit)
    except UnitError:
        return overlay
    return replace(
        overlay,
        unit=unit,
        measurement=convert(overlay.measurement),
        predictions=tuple((label, role, convert(y)) for label, role, y in overlay.predictions),
        sigma=None if overlay.sigma is None else abs(convert.factor) * overlay.sigma,
    )


def outcome_at(path: Path | None, campaign: Campaign | None) -> Outcome | None:
    """Return the outcome in a run folder or a diagnosis folder; None if there is none yet."""
    if path is None or campaign is None:
        return None
    if (path / "diagnosis.json").is_file():
        return of_diagnosis(path, campaign)
    try:
        return of_result(Result.from_json(path), campaign)
    except FmuidError:
        return None
