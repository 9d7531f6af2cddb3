"""The EMPS benchmark (Janot, Gautier, Brunot): its two MATLAB files as a campaign's measurements.

The files carry no licence, so they are read from a folder that the user names and never copied. A row of them
is what one cycle of the 1 kHz position controller saw and sent out: `vir` is held over the following period,
while in the closed loop `qg`, `qm` and `vir` belong to the same instant.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from benchmarks.study_command import convert, named_folder
from fmuid.core.errors import MeasurementsError
from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.core.immutable import FloatArray, read_only

DEFAULT_FOLDER = Path("../shared/data/emps")
FOLDER_VARIABLE = "FMUID_EMPS"
SHA256 = {
    "DATA_EMPS.mat": "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e",
    "DATA_EMPS_PULSES.mat": "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704",
}
_INTERVAL = 1e-3  # the files' own times leave this grid by less than 0.05 microseconds


def folder_from_environment() -> Path:
    """Return the folder of the EMPS files: `FMUID_EMPS`, or `../shared/data/emps`."""
    return named_folder(FOLDER_VARIABLE, DEFAULT_FOLDER)


def read_emps(folder: str | Path | None = None) -> Measurements:
    """Return both data sets, each once for the open loop and once for the closed one.

    Parameters
    ----------
    folder
        Where `DATA_EMPS.mat` and `DATA_EMPS_PULSES.mat` are; None: see `folder_from_environment`.

    Returns
    -------
    Measurements
        `identification_open`, `test_open` (setup `open_loop`: input `vir` in V, output `qm` in m) and
        `identification_closed`, `test_closed` (setup `closed_loop`: inputs `qg` in m and `pulses` in V,
        outputs `qm` and `vir`), 24841 samples at 1 kHz each. In the test set `vir` contains the pulses.

    Raises
    ------
    MeasurementsError
        A file is missing, or is not the published one (SHA-256).
    """
    folder = folder_from_environment() if folder is None else Path(folder)
    experiments: dict[str, Experiment] = {}
    for purpose, name in zip(("identification", "test"), SHA256, strict=True):
        columns = _columns(folder / name)
        for experiment in (_open_loop(purpose, columns), _closed_loop(purpose, columns)):
            experiments[experiment.id] = experiment
    return Measurements(
        experiments,
        title="Electro-mechanical positioning system",
        rig="EMPS: ball-screw axis with DC motor",
        source="Janot, Gautier, Brunot: Data set and reference models of EMPS (nonlinear benchmarks)",
        licence="none stated: not to be redistributed",
    )


def _columns(file: Path) -> dict[str, FloatArray]:
    """Return the file's variables, each as a vector, once its SHA-256 is found right."""
    try:
        content = file.read_bytes()
    except OSError:
        raise MeasurementsError(
            "EMPS data set is not there",
            where=file,
            fix=f"download EMPS from the nonlinear benchmark site and name its folder in {FOLDER_VARIABLE}",
        ) from None
    if hashlib.sha256(content).hexdigest() != SHA256[file.name]:
        raise MeasurementsError(
            "is not the published EMPS file (SHA-256 differs)", where=file, fix="download it again"
        )
    raw = loadmat(file)
    return {k: read_only(np.ravel(v)) for k, v in raw.items() if not k.startswith("_")}


def _settings(columns: dict[str, FloatArray], names: tuple[str, ...]) -> dict[str, float]:
    return {"q_start": float(columns["qm"][0])} | {n: float(columns[n][0]) for n in names}


_UNITS = {"q_start": "m", "gtau": "N/V", "kp": "1/s", "kv": "V.s/m"}


def _experiment(purpose: str, setup: str, settings: dict[str, float], signals: list[Signal]) -> Experiment:
    loop = setup.removesuffix("_loop")
    return Experiment(
        id=f"{purpose}_{loop}",
        setup=setup,
        time=read_only(_INTERVAL * np.arange(len(signals[0].values))),
        signals={s.name: s for s in signals},
        settings=settings,
        setting_units={n: _UNITS[n] for n in settings},
        description=f"EMPS {purpose} set, {loop} loop",
    )


def _open_loop(purpose: str, columns: dict[str, FloatArray]) -> Experiment:
    signals = [
        Signal("vir", columns["vir"], "V", "input"),
        Signal("qm", columns["qm"], "m", "output"),
    ]
    return _experiment(purpose, "open_loop", _settings(columns, ("gtau",)), signals)


def _closed_loop(purpose: str, columns: dict[str, FloatArray]) -> Experiment:
    pulses = columns.get("pulses_N", np.zeros_like(columns["qg"]))
    signals = [
        Signal("qg", columns["qg"], "m", "input"),
        Signal("pulses", pulses, "V", "input"),
        Signal("qm", columns["qm"], "m", "output"),
        Signal("vir", columns["vir"], "V", "output"),
    ]
    return _experiment(purpose, "closed_loop", _settings(columns, ("gtau", "kp", "kv")), signals)


def main(arguments: Sequence[str]) -> int:
    """Write the `measurements.h5` of the campaign that the arguments name; return the exit code."""
    return convert("campaigns.emps.convert CAMPAIGN [FOLDER]", arguments, read_emps)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
