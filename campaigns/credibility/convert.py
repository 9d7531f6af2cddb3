"""The virtual measurement in DLR's library Credibility as a campaign: speeds of a drive's motor and load over 4 s.

The library is BSD-3; its table is read from a clone of it (github.com/DLR-SR/Credibility), never copied. Where the
sampled noise changes, the table has two rows of one time, before and after: the second one is taken.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.study_command import convert, named_folder
from fmuid.core.errors import MeasurementsError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.core.immutable import read_only

DEFAULT_FOLDER = Path("../Credibility")
FOLDER_VARIABLE = "FMUID_CREDIBILITY"
TABLE = Path("Credibility/Resources/Tables/driveMeasurementsNonLin.txt")
NOISE = 5e-4  # rad/s: `sigma` of the blocks that made the table
_HEADER = "#1\ndouble motor_load_speed(8001,3)\n"


def folder_from_environment() -> Path:
    """Return the clone of the library: `FMUID_CREDIBILITY`, or `../Credibility`."""
    return named_folder(FOLDER_VARIABLE, DEFAULT_FOLDER)


def read_credibility(folder: str | Path | None = None) -> Measurements:
    """Return the run `sweep`: outputs `w_motor` and `w_load` (rad/s) at 1 kHz, no input.

    Parameters
    ----------
    folder
        The clone of the library; None: see `folder_from_environment`.

    Raises
    ------
    MeasurementsError
        The table is missing, or is another one.
    """
    file = (folder_from_environment() if folder is None else Path(folder)) / TABLE
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError):
        fix = f"clone github.com/DLR-SR/Credibility and name its folder in {FOLDER_VARIABLE}"
        raise MeasurementsError("the table of the library Credibility is not there", where=file, fix=fix) from None
    try:
        if not text.startswith(_HEADER):
            raise ValueError("its first lines differ")
        rows = np.loadtxt(text.splitlines()[2:], delimiter=",")
        if rows.ndim != 2 or rows.shape[1] != 3:
            raise ValueError("it has not three columns")
    except ValueError as error:
        fix = "take the one of the library's version 1"
        raise MeasurementsError(f"is another table: {error}", where=file, fix=fix) from None
    time, motor, load = rows[np.append(np.diff(rows[:, 0]) > 0.0, True)].T
    signals = {
        name: Signal(name, read_only(values), "rad/s", "output", NOISE)
        for name, values in (("w_motor", motor), ("w_load", load))
    }
    run = Experiment(
        "sweep", "drive", read_only(time), signals, description="sine sweep up to 30 Hz, speed controlled"
    )
    return Measurements(
        {run.id: run},
        title="Virtual measurement of a controlled drive",
        rig="SimpleControlledDrive_virtualMeasurement",
        source="github.com/DLR-SR/Credibility",
        licence="BSD-3-Clause",
    )


def main(arguments: Sequence[str]) -> int:
    """Write the `measurements.h5` of the campaign that the arguments name; return the exit code."""
    return convert("campaigns.credibility.convert CAMPAIGN [FOLDER]", arguments, read_credibility)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
