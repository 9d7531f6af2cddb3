from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmuid.core.experiments import Experiment, Measurements, Signal
from fmuid.data.measurements import write_measurements

TOML = """\
[campaign]
name = "bench"
make = "make bench-data"

[models.fixed_shaft]
fmu = "FixedShaft.fmu"
map = { tau = "tau_sensor" }

[models.free_shaft]
fmu = "FreeShaft.fmu"
initial = { phi = 0.1 }

[parameters.d_S]
start = 0.6
lower = 0.1
upper = 10
unit = "N.m.s/rad"

[parameters.J_S]
start = 0.003
lower = 1e-4
upper = 1e-2
scale = "log"
truth = 0.00304

[parameters."lossTable[2,4]"]
start = 0.09
free = false

[parameters."lossTable[2,5]"]
start = 0.09
free = false

[settings]
c_S = 130000
load.J = 0.5

[roles]
identification = ["step_*", "free"]
validation = ["prbs"]

[stages.linear]
experiments = ["step_*"]
free = ["d_S", "J_S"]
start = { d_S = 0.7 }
criteria = [{ signal = "tau", from = 0.1, demand = 0.5 }]
solver = { name = "bobyqa", tolerance = 1e-6 }
budget = { evaluations = 400, seconds = 60 }

[stages.table]
experiments = ["free"]
free = ["lossTable[2,4]"]
tie = { "lossTable[2,5]" = "0.9*lossTable[2,4] + J_S" }

[published]
M = 95.1
"""


def run(
    id: str, setup: str, seed: int, repeat_of: str | None = None, settings: dict[str, float] | None = None
) -> Experiment:
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 1.0, 11)
    drive = "i_cmd" if setup == "fixed_shaft" else "w_ref"
    tau = rng.standard_normal(11)
    tau[3] = np.nan
    signals = {
        drive: Signal(drive, np.sin(time + len(repeat_of or id)), "A" if drive == "i_cmd" else "rad/s", "input"),
        "tau": Signal("tau", tau, "N.m", "output", sigma=0.1),
        "w_motor": Signal("w_motor", rng.standard_normal(11), "rad/s", "output"),
    }
    return Experiment(
        id, setup, time, signals, settings or {}, {"mgr": "N.m"} if settings else {}, repeat_of, f"run {id}"
    )


@pytest.fixture
def measurements() -> Measurements:
    runs = [
        run("step_1", "fixed_shaft", 1),
        run("step_1_r1", "fixed_shaft", 2, "step_1"),
        run("step_2", "fixed_shaft", 3),
        run("prbs", "fixed_shaft", 4),
        run("free", "free_shaft", 5, settings={"mgr": 3.5}),
    ]
    return Measurements({r.id: r for r in runs}, title="Bench", rig="A", source="lab", licence="CC0-1.0")


@pytest.fixture
def folder(tmp_path: Path, measurements: Measurements) -> Path:
    """A campaign's folder with a measurement file and a campaign.toml that are right."""
    folder = tmp_path / "bench"
    write_measurements(measurements, folder / "measurements.h5")
    (folder / "campaign.toml").write_text(TOML)
    return folder
