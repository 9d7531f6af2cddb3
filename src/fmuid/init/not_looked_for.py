"""What a diagnosis of a campaign does not look for, and why: data that commands and reports show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fmu_build.flat_model import FlatModel, differentiated
from fmu_build.model_ports import find_ports
from fmu_build.syntax import walk
from fmuid.core.campaign import Campaign, ModelSpec
from fmuid.core.errors import FmuidError
from fmuid.identification.problem.cases import Case, from_campaign
from fmuid.simulation.runners import Runner, in_process, simulated
from fmuid.simulation.simulator import Simulator

_ONE_SIDED = 0.05  # of the largest absolute value: how far noise may reach to the other side
_BOTH_SIDES = 0.2  # of it: how far a model's output goes to either side
_MAX_NAMES = 6


@dataclass(frozen=True, slots=True)
class NotLookedFor:
    """Something that a diagnosis does not look for.

    Attributes
    ----------
    what, why
        For example ``effects inside the model`` and ``h1, h2 have no unit``.
    fix
        What to do about it.
    """

    what: str
    why: str
    fix: str

    def __str__(self) -> str:
        """Return one line."""
        return f"not looked for: {self.what} ({self.why}); {self.fix}"


def not_looked_for(
    campaign: Campaign, load: Callable[[ModelSpec], Simulator], runner: Runner = in_process
) -> tuple[NotLookedFor, ...]:
    """Return the data of a campaign that a diagnosis does not examine.

    Parameters
    ----------
    load
        Loads the model of a setup.
    runner
        Runner of the simulations; this process by default.
    """
    notes: list[NotLookedFor] = []
    for setup, spec in campaign.models.items():
        runs = [run for run in campaign.measurements if run.setup == setup]
        if not runs:
            continue
        simulator = load(spec)
        if spec.source is not None:
            from fmuid.simulation.model_source import flat_model  # slow to import

            notes += inside(flat_model(spec.source))
        (case, *_) = from_campaign(campaign, runs[:1], (), {setup: simulator})
        notes += _signs(case, campaign, runner)
    return tuple(dict.fromkeys(notes))


def inside(flat: FlatModel) -> list[NotLookedFor]:
    """Return that nothing inside a model is looked for, if no balance in its equations is recognised."""
    nodes = (node for e in flat.equations for node in walk((e.left, e.right)))
    states = dict.fromkeys(n for node in nodes if (n := differentiated(node)) is not None)
    if not states or any(not port.passed for port in find_ports(flat)):
        return []
    bare = [name for name in states if name in flat.variables and not flat.variables[name].unit]
    shown = ", ".join((bare or list(states))[:_MAX_NAMES])
    if bare:
        why = f"{shown} {'has' if len(bare) == 1 else 'have'} no unit, so no balance of a quantity is recognised"
        fix = f'write units in the model, as in Real {bare[0]}(unit = "m")'
    else:
        why = f"the equations of {shown} balance no force, torque, heat, current or volume"
        fix = "write the model with physical quantities"
    return [NotLookedFor("effects inside the model", why, fix)]


def _signs(case: Case, campaign: Campaign, runner: Runner) -> list[NotLookedFor]:
    """Return outputs that never change sign although the model's do."""
    try:
        outcome = simulated(runner, case.simulator, case.task, case.start_values(campaign.start_values))
        predicted = case.sensed(outcome, campaign.start_values)
    except FmuidError:
        return []
    notes = []
    for channel, y in zip(case.channels, predicted, strict=True):
        measured = channel.mean[np.isfinite(channel.mean)]
        largest, range_ = float(np.max(np.abs(measured), initial=0.0)), float(np.max(np.abs(y), initial=0.0))
        one_sided = measured.size > 0 and float(np.min(measured)) >= -_ONE_SIDED * largest
        if one_sided and float(np.min(y)) < -_BOTH_SIDES * range_ and float(np.max(y)) > _BOTH_SIDES * range_:
            notes.append(
                NotLookedFor(
                    f"the sign of {channel.signal}",
                    "it never changes in the log, but does in the model",
                    f"if the sensor shows an absolute value, let the model's output be abs({channel.variable})",
                )
            )
    return notes
