"""Logs of an industrial robot with encoders on motors and links (Weigand and others, 2021) as a campaign.

The logs are MATLAB files, one run each. They have the MIT licence, and are read from a folder that the user names,
never copied. Of axes 1 to 3, each is a run of its own, of a setup of its own: `axis1_A` is axis 1 in `ff_A.mat`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from benchmarks.study_command import convert, named_folder
from fmuid.core.errors import MeasurementsError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.core.immutable import FloatArray, read_only

DEFAULT_FOLDER = Path("../shared/data/robot_identification")
FOLDER_VARIABLE = "FMUID_ROBOT"
AXES = (1, 2, 3)  # those with an encoder on the link
STANDSTILL = 0.4  # s at the start of every run, in which the encoders are compared


def folder_from_environment() -> Path:
    """Return the folder of the logs: `FMUID_ROBOT`, or `../shared/data/robot_identification`."""
    return named_folder(FOLDER_VARIABLE, DEFAULT_FOLDER)


def read_robot(folder: str | Path | None = None) -> Measurements:
    """Return axes 1 to 3 of every `ff_*.mat`, 10 s at 250 Hz each.

    Input is `q`, the angle of the motor over the gear ratio (rad); outputs are `tau`, the torque of the motor
    (N.m), and `q_link`, the angle of the link (rad). The two encoders' zeros differ from run to run, so `q_link`
    is set to `q` at the standstill that every run begins with.

    Parameters
    ----------
    folder
        Where the `ff_*.mat` are; None: see `folder_from_environment`.

    Raises
    ------
    MeasurementsError
        There is no log, or a file is no such log.
    """
    folder = folder_from_environment() if folder is None else Path(folder)
    files = sorted(folder.glob("ff_*.mat"))
    if not files:
        fix = f"give the folder of the logs in {FOLDER_VARIABLE}"
        raise MeasurementsError("no log (ff_*.mat) of the robot is there", where=folder, fix=fix)
    runs = [run for file in files for run in _runs(file)]
    return Measurements(
        {run.id: run for run in runs},
        title="Industrial robot with two encoders an axis",
        rig="KUKA Quantec Ultra, all axes moving",
        source="github.com/JonasWeigand/Robot_Identification",
        licence="MIT",
    )


def _runs(file: Path) -> list[Experiment]:
    rec = _recording(file)
    try:
        time = np.asarray(rec.time_cont, dtype=float)
        motor, link = np.radians(rec.act_pos_mot_deg), np.radians(rec.act_pos_se_deg)
        torque = np.asarray(rec.act_torque_abs_nm, dtype=float)
    except (AttributeError, TypeError, ValueError) as error:
        raise _no_log(file, str(error)) from None
    if time.ndim != 1 or any(a.shape != (6, len(time)) for a in (motor, link, torque)):
        raise _no_log(file, "its recordings are not of six axes and one length")
    still = time - time[0] < STANDSTILL
    return [
        _run(
            f"axis{axis}_{file.stem.removeprefix('ff_')}",
            f"axis{axis}",
            time,
            {"q": motor[k], "tau": torque[k], "q_link": link[k] - np.mean((link - motor)[k, still])},
            f"axis {axis} of {file.name}",
        )
        for k, axis in enumerate(AXES)
    ]


def _run(name: str, setup: str, time: FloatArray, values: dict[str, FloatArray], text: str) -> Experiment:
    kinds = {"q": ("rad", "input"), "tau": ("N.m", "output"), "q_link": ("rad", "output")}
    signals = {n: Signal(n, read_only(v), *kinds[n]) for n, v in values.items()}
    settings = {"link.phi": float(values["q"][0])}
    return Experiment(name, setup, read_only(time), signals, settings, {"link.phi": "rad"}, description=text)


def _recording(file: Path) -> Any:
    try:
        return loadmat(file, squeeze_me=True, struct_as_record=False)["rec"]
    except OSError as error:
        raise MeasurementsError(f"cannot be read ({error})", where=file, fix="check its rights") from None
    except (KeyError, ValueError, TypeError, NotImplementedError, MatReadError) as error:
        raise _no_log(file, str(error)) from None


def _no_log(file: Path, why: str) -> MeasurementsError:
    fix = "keep nothing but recordings of the robot in the folder"
    return MeasurementsError(f"is no recording of the robot: {why}", where=file, fix=fix)


def main(arguments: Sequence[str]) -> int:
    """Write the `measurements.h5` of the campaign that the arguments name; return the exit code."""
    return convert("campaigns.robot.convert CAMPAIGN [FOLDER]", arguments, read_robot)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
