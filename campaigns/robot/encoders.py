"""How far the links' encoders are behind those of the motors: python -m campaigns.robot.encoders OUT [FOLDER]."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.study_command import run_module
from campaigns.robot.convert import read_robot
from fmuid.core.experiments import Experiment
from fmuid.core.formatting import text_table
from fmuid.core.immutable import FloatArray
from fmuid.report.plots import save_figure
from fmuid.report.plots.figure_data import Axis, LineFigure, Panel, Series

_INSIDE = slice(20, -20)  # the ends, where a moving mean has too few samples
_MEAN = 9  # samples


def speed_and_lag(run: Experiment) -> tuple[FloatArray, FloatArray]:
    """Return the speed of an axis (rad/s) and how far its link is behind its motor (rad)."""
    q = run.signals["q"].values
    speed = np.gradient(np.convolve(q, np.full(_MEAN, 1 / _MEAN), "same"), run.time)
    return speed[_INSIDE], (q - run.signals["q_link"].values)[_INSIDE]


def delay(run: Experiment) -> float:
    """Return the time (s) by which the link is behind, by regression on speed, acceleration and a constant."""
    speed, lag = speed_and_lag(run)
    columns = np.stack([speed, np.gradient(speed, run.time[_INSIDE]), np.ones_like(speed)], axis=1)
    return float(np.linalg.lstsq(columns, lag, rcond=None)[0][0])


def _command(arguments: Sequence[str]) -> None:
    runs = list(read_robot(*arguments[1:]))
    axes = list(dict.fromkeys(run.setup for run in runs))
    rows = [[axis, *(f"{1e3 * delay(run):.2f}" for run in runs if run.setup == axis)] for axis in axes]
    names = [run.id.removeprefix(f"{axes[0]}_") for run in runs if run.setup == axes[0]]
    print(text_table([["link behind motor, ms", *names], *rows]))
    panels = [_panel(axis, [run for run in runs if run.setup == axis]) for axis in axes]
    title = "Link behind motor over the speed of the axis"
    print(*save_figure(LineFigure("encoders", title, tuple(panels), columns=3), Path(arguments[0])))


def _panel(axis: str, runs: Sequence[Experiment]) -> Panel:
    speed, lag = (np.concatenate(parts) for parts in zip(*map(speed_and_lag, runs), strict=True))
    ends = np.array([speed.min(), speed.max()])
    points = Series("measured", speed[::5], 1e3 * lag[::5], "measurement", points=True)
    line = Series("3 ms", ends, 3.0 * ends, "final")
    return Panel(axis, Axis("speed", "rad/s"), Axis("behind", "mrad"), (points, line))


def main(arguments: Sequence[str]) -> int:
    """Print the delays of every axis and run, and draw them into the folder that the arguments name."""
    return run_module("campaigns.robot.encoders OUT [FOLDER]", arguments, _command)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
