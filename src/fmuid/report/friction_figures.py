"""Bearing friction over speed (the paper's Fig. 10): from free rotation, and from the loss table.

Without load, the sliding law of Table 1 leaves tau_W = tau_bf1 / eta_mf1 in either direction; at constant speed,
the motor current balances exactly this torque.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from fmuid.core.campaign import Campaign
from fmuid.core.experiments import Experiment
from fmuid.core.immutable import FloatArray
from fmuid.report.plots.figure_data import Axis, LineFigure, Panel, Role, Series
from fmuid.simulation.simulator import Simulator

SETUP, REFERENCE, CURRENT, CONSTANT = "free_shaft", "w_ref", "i_motor", "K_m"
_SHORTEST = 0.3  # s: shorter stretches of constant speed are steps, not plateaus
_SETTLING = 0.5  # share of a plateau that is left out at its beginning


def bearing_friction(
    campaign: Campaign,
    simulators: Mapping[str, Simulator],
    start: Mapping[str, float],
    best: Mapping[str, float],
) -> LineFigure | None:
    """Return the figure for a campaign with free rotation and a loss table; None for any other.

    Parameters
    ----------
    campaign
        Has runs of the setup ``free_shaft`` with plateaus of constant ``w_ref``.
    simulators
        Models by setup; their start values are used where the campaign gives none.
    start, best
        Parameter values before and after the identification.
    """
    runs = [e for e in campaign.measurements if e.setup == SETUP and {REFERENCE, CURRENT} <= e.signals.keys()]
    if SETUP not in simulators:
        return None
    variables = simulators[SETUP].variables.values()
    known = {v.name: v.start for v in variables if v.start is not None and v.causality == "parameter"}
    known |= dict(campaign.settings) | {p.name: p.start for p in campaign.parameters.values()}
    tables = [loss_table(known | dict(values)) for values in (start, best)]
    if not runs or CONSTANT not in known or tables[0] is None or tables[1] is None:
        return None
    points = free_rotation(runs, known[CONSTANT])
    if points is None:
        return None
    top = float(np.max(np.abs(points.x)))
    speed = np.concatenate([-np.geomspace(top, 0.1, 200), [np.nan], np.geomspace(0.1, top, 200)])

    def line(label: str, role: Role, table: FloatArray) -> Series:
        return Series(f"loss table, {label}", speed, no_load_torque(table, speed), role)

    series = [points, line("start", "start", tables[0]), line("identified", "final", tables[1])]
    truth = {p.name: p.truth for p in campaign.parameters.values() if p.truth is not None}
    true_table = loss_table(known | truth) if any(n.startswith("lossTable[") for n in truth) else None
    if true_table is not None:
        series.append(line("truth", "reference", true_table))
    axes = Axis("speed of the input shaft", "rad/s"), Axis("friction torque", "N.m")
    panel = Panel("Bearing friction", *axes, tuple(series))
    caption = (
        "Points: motor torque that keeps the speed constant without load. "
        "Lines: the bearing part of the loss table."
    )
    return LineFigure("friction", "Bearing friction over speed", (panel,), caption, 1)


def loss_table(values: Mapping[str, float]) -> FloatArray | None:
    """Return ``lossTable[i,j]`` of `values` as (rows, 5), sorted by speed; None if a cell is missing."""
    rows = 0
    while f"lossTable[{rows + 1},1]" in values:
        rows += 1
    names = [[f"lossTable[{i},{j}]" for j in range(1, 6)] for i in range(1, rows + 1)]
    if not names or any(n not in values for row in names for n in row):
        return None
    table = np.array([[values[n] for n in row] for row in names])
    return table[np.argsort(table[:, 0])]


def no_load_torque(table: FloatArray, speed: FloatArray) -> FloatArray:
    """Return the motor torque (N,) in N.m that balances the loss table's friction without load at `speed`."""
    eta, bearing = (np.interp(np.abs(speed), table[:, 0], table[:, j]) for j in (1, 3))
    return np.asarray(np.sign(speed) * bearing / eta)


def free_rotation(runs: list[Experiment], motor_constant: float) -> Series | None:
    """Return motor torque at every plateau of constant speed, averaged over the repeats; None without any.

    The standard error is that of the mean over repeats; None for a plateau that was run once.
    """
    torques_at: dict[float, list[float]] = {}
    for run in runs:
        reference, current = run.signals[REFERENCE].values, run.signals[CURRENT].values
        for begin, end in plateaus(run.time, reference):
            settled = current[begin + int(_SETTLING * (end - begin)) : end]
            speed = float(reference[begin])
            torques_at.setdefault(speed, []).append(motor_constant * float(np.nanmean(settled)))
    torques_at = {speed: torques for speed, torques in torques_at.items() if speed != 0}
    if not torques_at:
        return None
    speeds = sorted(torques_at)
    errors = None
    if all(len(torques_at[s]) > 1 for s in speeds):
        errors = np.array([np.std(torques_at[s], ddof=1) / np.sqrt(len(torques_at[s])) for s in speeds])
    torques, label = np.array([np.mean(torques_at[s]) for s in speeds]), "K_m · mean(i_motor) at constant speed"
    return Series(label, np.array(speeds), torques, "measurement", errors, points=True)


def plateaus(time: FloatArray, reference: FloatArray) -> list[tuple[int, int]]:
    """Return (begin, end) of every stretch of constant samples that is long enough to settle in."""
    edges = np.flatnonzero(np.diff(reference) != 0) + 1
    borders = [0, *edges.tolist(), reference.size]
    return [(a, b) for a, b in pairwise(borders) if time[b - 1] - time[a] >= _SHORTEST]
