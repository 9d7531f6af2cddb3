"""The rig as a value: its parameters, its loss table, and how it runs an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.virtual_rig import library
from benchmarks.virtual_rig.library import SETUPS, WORKS, Channel, parameter_table
from fmuid.core.errors import CampaignError
from fmuid.core.immutable import FloatArray, frozen_mapping, read_only

STEPS = {"fixed_shaft": 1e-5, "free_shaft": 2e-5, "eccentric_load": 2e-5}
"""Longest time step in s by setup, and at least 50 to a sample: halving it moves no signal by a tenth of its
noise (RMS), see tests/rig."""


def usual_step(setup: str, interval: float) -> float:
    """Return the time step, in s, for samples every `interval` s."""
    return min(STEPS[setup], interval / 50)


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What happened on the rig, free of noise.

    Parameters
    ----------
    time
        (N,) s.
    inputs
        (N,) the current command or speed reference; sample k acts on [t_k, t_{k+1}).
    channels
        (N, 8), columns as in `Channel`; row k is taken just before input k is set (row 0: after).
    works
        Work in J since the start: of the motor, lost in friction, lost in the dampers, of the load torque.
    """

    setup: str
    time: FloatArray
    inputs: FloatArray
    channels: FloatArray
    works: Mapping[str, float]

    def __getitem__(self, channel: Channel) -> FloatArray:
        return self.channels[:, channel]


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """One actuator on the rig.

    Parameters
    ----------
    loss_table
        (rows, 5): abs(w) in rad/s, eta1, eta2, tau_bf1, tau_bf2 in N.m; linear between the rows, constant
        outside them.
    parameters
        Values by name; the rest are neutral (see `parameter_table`).

    Raises
    ------
    CampaignError
        A parameter the rig does not have, or a loss table that is none.
    """

    loss_table: FloatArray
    parameters: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        table = read_only(self.loss_table)
        if table.ndim != 2 or table.shape[1] != 5 or len(table) == 0 or np.any(np.diff(table[:, 0]) <= 0):
            raise CampaignError("a loss table needs rows of five values with rising speed", where="virtual rig")
        unknown = self.parameters.keys() - parameter_table().keys()
        if unknown:
            known = ", ".join(parameter_table())
            raise CampaignError(f"the rig has no parameter '{min(unknown)}'", fix=f"it has: {known}")
        object.__setattr__(self, "loss_table", table)
        object.__setattr__(self, "parameters", frozen_mapping(self.parameters))

    def changed(self, **parameters: float) -> Rig:
        """Return the same rig with some parameters changed."""
        return replace(self, parameters={**self.parameters, **parameters})

    def run(self, setup: str, inputs: FloatArray, interval: float, *, step: float | None = None) -> Run:
        """Run one experiment from rest.

        Parameters
        ----------
        setup
            `fixed_shaft` (driven by current, A), `free_shaft` or `eccentric_load` (by speed, rad/s).
        inputs, interval
            (N,) samples held for `interval` s each.
        step
            Length of a time step in s; None: as in `STEPS`.
        """
        if setup not in SETUPS:
            raise CampaignError(f"the rig has no setup '{setup}'", fix=f"it has: {', '.join(SETUPS)}")
        step = usual_step(setup, interval) if step is None else step
        values = np.array([self.parameters.get(k, info.neutral) for k, info in parameter_table().items()])
        substeps = max(1, round(interval / step))
        channels, works = library.run(values, self.loss_table, setup, inputs, interval, substeps)
        time = interval * np.arange(len(inputs))
        return Run(
            setup,
            read_only(time),
            read_only(inputs),
            read_only(channels),
            frozen_mapping(dict(zip(WORKS, works.tolist(), strict=True))),
        )
