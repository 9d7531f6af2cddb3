"""Cases of plants that diverge in open loop: runs in segments, or with an observer.

See `fmuid.simulation.segmented` and `fmuid.simulation.observer_model`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fmuid.core.campaign import Campaign, StageSpec
from fmuid.core.errors import ProblemError
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.core.units import Conversion
from fmuid.identification.problem.cases import Case, experiments_of, from_campaign
from fmuid.simulation.observer_model import ObserverModel
from fmuid.simulation.segmented import Growth, Length, Segmented, open_loop, states_of
from fmuid.simulation.simulator import Simulator


def segmented(case: Case, length: Length, values: Mapping[str, float], free: Collection[str] = ()) -> Case:
    """Return a case whose run is cut into segments.

    Parameters
    ----------
    case
        The case.
    length
        Length of the segments.
    values
        Values of all parameters in model space, for choosing the segments.
    free
        Names of the parameters that are estimated.

    Raises
    ------
    ProblemError
        The model's states cannot be set, the signal has a sensor model, or a free parameter is an initial state.
    """
    where = f"segments of '{case.id}'"
    _require_plain(case, where)
    try:
        simulator = Segmented(case.simulator, case.task, length, *_judged(case), at=case.start_values(values))
    except ProblemError as error:
        raise ProblemError(error.what, where=where, fix=error.fix) from None
    for name in free:
        if name in case.setting and case.setting[name][0] in simulator.states:
            raise ProblemError(
                f"'{name}' is an initial state, which is estimated for each segment",
                where=where,
                fix="remove it from 'free'",
            )
    return replace(case, simulator=simulator)


def last_stages(campaign: Campaign) -> dict[str, StageSpec]:
    """Return by setup the last stage that uses its runs."""
    return {
        run.setup: stage
        for stage in campaign.stages.values()
        for run in experiments_of(campaign, stage.experiments, where=f"stage '{stage.name}'")
    }


def in_segments(
    campaign: Campaign,
    runs: Sequence[Experiment],
    simulators: Mapping[str, Simulator],
    values: Mapping[str, float],
) -> tuple[Case, ...]:
    """Return the cases of runs with all outputs, cut into segments as the last stage of their setup says.

    Runs of a stage with an observer are cut into segments of automatic length; those of a model that cannot be
    restarted stay whole (`why_whole`).
    """
    stages, cases = last_stages(campaign), list[Case]()
    for setup in dict.fromkeys(run.setup for run in runs):
        stage = stages.get(setup)
        length: Length | None = None
        if stage is not None and why_whole(stage, simulators[setup]) is None:
            length = "auto" if stage.observer else stage.segments
        recorded = [run for run in runs if run.setup == setup]
        apart = stage is not None and stage.apart and length is not None
        of_setup = from_campaign(campaign, recorded, (), simulators, apart=apart)
        cases += of_setup if length is None else [segmented(case, length, values) for case in of_setup]
    order = {run.id: k for k, run in enumerate(runs)}
    return tuple(sorted(cases, key=lambda case: order[case.experiments[0]]))


def why_whole(stage: StageSpec, simulator: Simulator) -> str | None:
    """Return why runs cannot be cut into the segments of a stage, for example because of an effect's state."""
    if stage.segments is not None or stage.observer:
        try:
            states_of(simulator, whole=stage.segments == math.inf)
        except ProblemError as error:
            return error.what
    return None


def observed(
    cases: Sequence[Case], observer: bool | Mapping[str, Mapping[str, float]], values: Mapping[str, float]
) -> tuple[tuple[Case, ...], dict[str, float]]:
    """Return cases predicted with output feedback, and the initial gains by name.

    Parameters
    ----------
    cases
        The cases.
    observer
        The gains, or True for those of a Kalman filter at the start of the first run of each setup.
    values
        Values of all parameters in model space.

    Raises
    ------
    ProblemError
        A model does not offer model exchange, or is not observable.
    """
    corrected: list[Case] = []
    gains: dict[str, float] = {}
    seen: set[str] = set()
    for case in cases:
        where = f"observer of '{case.id}'"
        _require_plain(case, where)
        try:
            model = ObserverModel(case.simulator, np.array(_judged(case)[0]))
            names = {(s, o): model.gain_name(s, o) for s in model.states for o in case.task.outputs}
            if observer is True and case.setup not in seen:
                sigma = np.array([c.noise.sigma for c in case.channels])
                gain = model.first_gain(case.task, case.start_values(values), sigma)
                gains |= dict(zip(names.values(), gain.ravel().tolist(), strict=True))
        except ProblemError as error:
            raise ProblemError(error.what, where=where, fix=error.fix) from None
        seen.add(case.setup)
        for state, row in observer.items() if isinstance(observer, Mapping) else ():
            for output, gain_value in row.items():
                if (state, output) not in names:
                    known = f"states: {', '.join(model.states)}; outputs: {', '.join(case.task.outputs)}"
                    raise ProblemError(f"no gain from '{output}' to '{state}'", where=where, fix=known)
                gains[names[state, output]] = gain_value
        setting = dict(case.setting) | {name: (name, Conversion()) for name in names.values() if name in gains}
        corrected.append(replace(case, simulator=model, setting=setting))
    return tuple(corrected), gains


def _require_plain(case: Case, where: str) -> None:
    for channel in case.channels:
        if not channel.plain:
            raise ProblemError(
                f"'{channel.signal}' has a sensor model (gradient, filter, offset, gain or delay)",
                where=where,
                fix="include the sensor in the model, or simulate whole runs",
            )


def growth_of(case: Case, values: Mapping[str, float]) -> Growth | None:
    """Return the growth of errors in a case simulated as a whole; None if its states cannot be set.

    Parameters
    ----------
    case
        The case, in one piece.
    values
        Values of all parameters in model space.
    """
    try:
        simulator = segmented(case, "auto", values).simulator
    except ProblemError:
        return None
    assert isinstance(simulator, Segmented)
    return open_loop(simulator)


def _judged(case: Case) -> tuple[FloatArray, FloatArray]:
    """Return the target of a case's outputs and the weights of their errors in its cost; (outputs, N)."""
    n = len(case.time)
    squares = np.zeros((len(case.channels), n))
    rows = {channel.signal: k for k, channel in enumerate(case.channels)}
    for criterion in case.criteria:
        if criterion.affine and criterion.rows is not None:
            unit = criterion.residuals(np.ones(n)) - criterion.residuals(np.zeros(n))
            squares[rows[criterion.signal], criterion.rows] += criterion.weight * unit**2
    if not np.any(squares):  # judged by features or whitened residuals: weights from the sensors' noise
        squares = np.array(
            [np.where(np.isfinite(c.mean), 1.0 / c.noise.of_mean(c.count) ** 2, 0.0) for c in case.channels]
        )
    target = np.array([c.mean for c in case.channels])
    weight = np.where(np.isfinite(target), np.sqrt(squares), 0.0)
    lead = ((0, 0), (case.lead, 0))
    return np.pad(target, lead), np.pad(weight, lead)
