"""Logs of a servo on a pendulum bench (a Unitree Go1 joint) as a campaign's measurements.

The logs are JSON, one run a file, as the servo-identification project "Better Actuator Models" records them. They
carry no licence, so they are read from a folder that the user names and never copied. What their numbers are was
found from the runs themselves (`docs/tutorials/go1.md`): `position` and `goal_position` are angles of the joint,
`torque_demand` is on the motor's side of the gear, and `speed` is the joint's divided by the gear ratio once
too often. A row is what the joint answered before the goal in it was sent.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.study_command import convert, named_folder
from fmuid.core.errors import MeasurementsError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.core.immutable import FloatArray, read_only

DEFAULT_FOLDER = Path("../shared/data/go1")
FOLDER_VARIABLE = "FMUID_GO1"
GEAR_RATIO = 6.33
SETUP = "position_driven"
_JITTER = 0.01  # of the interval; here the clock that stamps the rows has up to 0.08 of 16 ms
_UNITS = {
    "m": "kg",
    "m_a": "kg",
    "l": "m",
    "kp": "N.m/rad",
    "kd": "N.m.s/rad",
    "q_start": "rad",
    "w_start": "rad/s",
}


class _Entry(msgspec.Struct):
    timestamp: float
    position: float
    speed: float
    torque_demand: float
    goal_position: float
    torque_enable: bool


class _Log(msgspec.Struct):
    mass: float
    arm_mass: float
    length: float
    kp: float
    damping: float
    trajectory: str
    entries: list[_Entry]


def folder_from_environment() -> Path:
    """Return the folder of the logs: `FMUID_GO1`, or `../shared/data/go1`."""
    return named_folder(FOLDER_VARIABLE, DEFAULT_FOLDER)


def read_go1(folder: str | Path | None = None) -> Measurements:
    """Return every log of a folder as one run, such as `m2_sin_sin` with a payload of 2 kg.

    Inputs are `q_ref` (rad) and `enable` (1: torque on), outputs `q` (rad), `w` (rad/s) and `tau_motor` (N.m);
    settings are payload, arm, gains of the controller and the state at the first sample. Nothing is resampled:
    times that leave an even grid by less than 1 % of its interval are that grid, others stay as they are. A row
    whose time is that of the row before is left out. The run's description says both.

    Parameters
    ----------
    folder
        Where the `*.json` are; None: see `folder_from_environment`.

    Raises
    ------
    MeasurementsError
        There is no log, a file is no such log, or its time goes back.
    """
    folder = folder_from_environment() if folder is None else Path(folder)
    files = sorted(folder.glob("*.json"))
    if not files:
        fix = f"give the folder of the logs in {FOLDER_VARIABLE}"
        raise MeasurementsError("no Go1 log (*.json) is there", where=folder, fix=fix)
    experiments: dict[str, Experiment] = {}
    for file in files:
        experiment = _experiment(file)
        if experiment.id in experiments:
            what = f"a second log of trajectory and payload '{experiment.id}'"
            raise MeasurementsError(what, where=file, fix="keep one of them in the folder")
        experiments[experiment.id] = experiment
    return Measurements(
        dict(sorted(experiments.items())),
        title="Go1 joint on a pendulum bench",
        rig="Unitree Go1 joint that turns an arm with a payload",
        source="Example logs of Better Actuator Models (Duclusaud, Passault and others)",
        licence="none stated: not to be redistributed",
    )


def _experiment(file: Path) -> Experiment:
    log = _read(file)
    rows, stamps = log.entries, np.array([e.timestamp for e in log.entries])
    kept = np.r_[True, np.diff(stamps) != 0.0]
    if len(rows) < 2 or not kept.sum() > 1:
        raise MeasurementsError("has fewer than two samples", where=file, fix="record it again")
    late = np.flatnonzero(np.diff(stamps) < 0.0)
    if len(late):
        what = f"its time goes back at entry {late[0] + 1}"
        raise MeasurementsError(what, where=file, fix="put the entries in order of time, or cut the log there")

    def column(name: str, factor: float = 1.0) -> FloatArray:
        values = factor * np.array([float(getattr(e, name)) for e in rows])[kept]
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            what = f"'{name}' is not finite in sample {bad[0]}"
            raise MeasurementsError(what, where=file, fix="take the entry out, or cut the log there")
        return read_only(values)

    speed = column("speed", GEAR_RATIO)
    signals = [
        Signal("q_ref", column("goal_position"), "rad", "input"),
        Signal("enable", column("torque_enable"), "1", "input"),
        Signal("q", column("position"), "rad", "output"),
        Signal("w", speed, "rad/s", "output"),
        Signal("tau_motor", column("torque_demand"), "N.m", "output"),
    ]
    start = (signals[2].values[0], speed[0])
    known = (log.mass, log.arm_mass, log.length, log.kp, log.damping, *start)
    time, remark = _even(column("timestamp"))
    if not kept.all():
        remark += f"; {np.sum(~kept)} rows without a new time left out"
    return Experiment(
        id=f"m{log.mass:g}_{log.trajectory}".replace(".", "p"),
        setup=SETUP,
        time=time,
        signals={s.name: s for s in signals},
        settings=dict(zip(_UNITS, map(float, known), strict=True)),
        setting_units=_UNITS,
        description=f"{log.trajectory} with {log.mass:g} kg ({file.name}); {remark}",
    )


def _even(stamps: FloatArray) -> tuple[FloatArray, str]:
    """Return the times from 0, on an even grid if they are that but for the clock's jitter, and what was done."""
    time = stamps - stamps[0]
    grid = np.linspace(0.0, time[-1], len(time))
    jitter = float(np.max(np.abs(time - grid)))
    if jitter < _JITTER * grid[1]:
        return read_only(grid), f"recorded times leave the even grid by up to {1e3 * jitter:.2g} ms"
    return read_only(time), "times as recorded"


def _read(file: Path) -> _Log:
    try:
        return msgspec.json.decode(file.read_bytes(), type=_Log)
    except OSError as error:
        raise MeasurementsError(f"cannot be read ({error.strerror})", where=file, fix="check its rights") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        fix = "keep nothing but logs of the bench in the folder"
        raise MeasurementsError(f"is no Go1 log: {error}", where=file, fix=fix) from None


def main(arguments: Sequence[str]) -> int:
    """Write the `measurements.h5` of the campaign that the arguments name; return the exit code."""
    return convert("campaigns.go1.convert CAMPAIGN [FOLDER]", arguments, read_go1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
