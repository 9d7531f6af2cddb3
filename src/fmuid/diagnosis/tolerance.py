"""Whether a model is as exact as its user needs: the error on left-out data against a stated tolerance.

A model need not be exact to the noise. The user states how large the error of each signal may be (RMS). The error
is that of the refitted nominal model on data that it was not fitted to, without what noise alone would leave. It
varies from fold to fold, which gives the probability that it is within the tolerance.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
from scipy.stats import t

from fmu_build.suggest import suggestion
from fmuid.core.errors import CampaignError, SimulationError, UnitError
from fmuid.core.units import conversion
from fmuid.diagnosis.candidates import Fitted
from fmuid.diagnosis.observed import GAP_THAT_MATTERS
from fmuid.diagnosis.subject import Subject
from fmuid.diagnosis.verdict import Tolerated
from fmuid.identification.problem.cases import Case, Channel

_VALUE = re.compile(r"^\s*(?P<number>[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?)\s*(?P<unit>.*?)\s*$")


def tolerances(stated: Mapping[str, float | str], cases: Sequence[Case]) -> dict[str, float]:
    """Return the largest errors (RMS) by signal, in the unit of the model's variable.

    Parameters
    ----------
    stated
        By signal, a number in the log's unit, or a text with a unit such as ``0.2 mm``, or ``5%`` of the signal's
        range in the runs.

    Raises
    ------
    CampaignError
        A signal is not an output of the runs, or a value is not a positive number with a suitable unit.
    """
    channels: dict[str, list[Channel]] = {}
    for channel in chain.from_iterable(case.channels for case in cases):
        channels.setdefault(channel.signal, []).append(channel)
    return {name: _tolerance(name, value, channels) for name, value in stated.items()}


def _tolerance(name: str, value: float | str, channels: Mapping[str, Sequence[Channel]]) -> float:
    where = f"tolerance of '{name}'"
    if name not in channels:
        raise CampaignError(f"the runs have no output '{name}'", where=where, fix=suggestion(name, channels))
    own = channels[name]
    match = _VALUE.match(str(value))
    size = float(match["number"]) if match else 0.0
    if match is None or not 0.0 < size < np.inf:
        raise CampaignError(
            f"'{value}' is not a positive number", where=where, fix="write it as in 0.2, '0.2 mm' or 5%"
        )
    if match["unit"] == "%":
        return 0.01 * size * max(float(np.nanmax(c.repeats) - np.nanmin(c.repeats)) for c in own)
    if not match["unit"]:
        return abs(size / own[0].to_shown.factor)
    try:
        return abs(size * conversion(match["unit"], own[0].unit).factor)
    except UnitError as error:
        raise CampaignError(error.what, where=where, fix=error.fix) from None


def tolerated(subject: Subject, nominal: Fitted) -> tuple[Tolerated, ...]:
    """Return the nominal model's errors on left-out data.

    A signal without a tolerance is in the list if its error exceeds the noise. Nothing is returned without a
    tolerance, or if a fold cannot be simulated or there is only one.
    """
    model, observed, folds = subject.model, subject.observed, subject.observed.folds
    if not subject.tolerances or len(folds) < 2:
        return ()
    predictions = model.predict_at([(e, v) for (e, _), v in zip(folds, nominal.left_out, strict=True)])
    excess: dict[str, list[float]] = {}  # of the mean square error over noise, by fold
    floors: dict[str, list[float]] = {}
    shown: dict[str, Channel] = {}
    for (e, _), (begin, end), predicted in zip(folds, observed.fold_times, predictions, strict=True):
        if isinstance(predicted, SimulationError):
            return ()
        run = observed.runs[e]
        floor = observed.noise[run.setup].of_mean(run.n_repeats) ** 2
        for c, channel in enumerate(model.cases[e].channels):
            there = run.mask[c, begin:end] > 0.0
            if not there.any():
                continue
            first = shown.setdefault(channel.signal, channel)
            factor = conversion(channel.unit, first.unit).factor if channel.unit else 1.0
            error = factor * (predicted[c] - run.mean[c])[begin:end][there]
            floors.setdefault(channel.signal, []).append(factor**2 * float(floor[c]))
            excess.setdefault(channel.signal, []).append(float(np.mean(error**2)) - floors[channel.signal][-1])
    found = []
    for name, own in excess.items():
        limit, mean = subject.tolerances.get(name), float(np.mean(own))
        small = GAP_THAT_MATTERS**2 * float(np.mean(floors[name]))
        if limit is None and mean <= small:
            continue
        factor = abs(shown[name].to_shown.factor)
        most = small if limit is None else limit**2
        found.append(
            Tolerated(
                name,
                shown[name].shown_unit,
                factor * float(np.sqrt(max(0.0, mean))),
                None if limit is None else factor * limit,
                _below(own, most) if len(own) > 1 else float(own[0] <= most),
            )
        )
    return tuple(found)


def _below(values: Sequence[float], most: float) -> float:
    """Return the probability that the mean behind a few values is at most `most`."""
    error = float(np.std(values, ddof=1) / np.sqrt(len(values)))
    apart = most - float(np.mean(values))
    return float(t.cdf(apart / error, float(len(values) - 1))) if error > 0.0 else float(apart >= 0.0)
