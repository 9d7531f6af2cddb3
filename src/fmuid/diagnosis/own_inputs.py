"""Repeats of a reference: runs of one experiment whose recorded inputs differ a little from run to run.

In a closed loop the controller reacts to the noise of every run, and an input that is measured has noise of its
own. Each run is simulated with its own input. What the model predicts to differ between the runs is subtracted
from their measurements, which then are repeats of one experiment with the mean input. Their differences contain
the noise that recorded inputs pass on to the outputs, so it is in the noise floor, and in its covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fmuid.core.errors import SimulationError
from fmuid.core.immutable import FloatArray, read_only
from fmuid.data.noise.level import noise_level
from fmuid.diagnosis.extended_model import CampaignModel
from fmuid.identification.problem.cases import Case, Channel
from fmuid.simulation.segmented import Segmented


def as_repeats(
    model: CampaignModel, values: Mapping[str, float], reference: Mapping[str, str]
) -> tuple[Case, ...]:
    """Return the cases of a model with repeats of a reference joined.

    Parameters
    ----------
    values
        Nominal parameters; the differences between such runs hardly depend on them.
    reference
        By run, the first run with the same reference.

    Runs that cannot be simulated, or that are predicted in segments, stay apart.
    """
    groups: dict[object, list[Case]] = {}
    for case in model.cases:
        first = reference.get(case.experiments[0], case.id)
        apart = case.id if isinstance(case.simulator, Segmented) else ""
        groups.setdefault((first, case.setup, case.machine, apart), []).append(case)
    return tuple(joined for group in groups.values() for joined in _joined(model, values, group))


def _joined(model: CampaignModel, values: Mapping[str, float], group: Sequence[Case]) -> Sequence[Case]:
    if len(group) == 1:
        return group
    weights = [len(case.experiments) for case in group]
    inputs = {
        name: read_only(np.average([case.task.inputs[name] for case in group], axis=0, weights=weights))
        for name in group[0].task.inputs
    }
    mean = replace(group[0], task=replace(group[0].task, inputs=inputs))
    (outcome,) = replace(model, cases=(mean, *group)).predict([values])
    if isinstance(outcome, SimulationError):
        return group
    moved = [prediction - outcome[0] for prediction in outcome[1:]]
    channels = []
    for k, channel in enumerate(mean.channels):
        rows = [case.channels[k].repeats - y[k] for case, y in zip(group, moved, strict=True)]
        channels.append(_channel(channel, np.concatenate(rows)))
    ids = tuple(id for case in group for id in case.experiments)
    return [replace(mean, channels=tuple(channels), experiments=ids)]


def _channel(channel: Channel, repeats: FloatArray) -> Channel:
    given = channel.noise.source == "given"
    noise = channel.noise if given else noise_level(repeats, [None] * len(repeats))
    return replace(channel, repeats=read_only(repeats), noise=noise)
