"""The double pendulum of the gallery: its import, its model, its campaign, on logs of a pendulum that is known."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

from benchmarks.beside_published import main as beside_published
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.cli.app import run
from fmuid.identification.result import Result
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Task
from tests.conftest import ROOT, build_once

CAMPAIGN = ROOT / "campaigns" / "double_pendulum"
HEADER = "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,tau_con1,tau_con2,tau_meas1,tau_meas2"


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the campaign, its measurements imported from simulated logs as the make target does."""
    folder = tmp_path_factory.mktemp("double_pendulum")
    fmu = load_fmu(build_once(CAMPAIGN / "DoublePendulum.mo", "DoublePendulum", folder))
    for name in ("campaign.toml", "DoublePendulum.mo"):
        shutil.copy(CAMPAIGN / name, folder)
    published = of_the_model(folder)
    rng = np.random.default_rng(1)
    time = 0.002 * np.arange(1001)
    for k in range(8):
        first, second = (0.0 if k in (3, 4) else 0.7), (0.0 if k in (5, 6, 7) else 0.5)
        torques = {
            "tau1": first * np.sin((4.0 + 0.5 * k) * time),
            "tau2": second * np.cos((7.0 - 0.5 * k) * time),
        }
        q = fmu.simulate(Task(time, torques, ("q1", "q2")), published)
        q = q + 1.1e-4 * rng.standard_normal(q.shape)
        table = np.column_stack([time, *q, *np.zeros((4, time.size)), *torques.values()])
        np.savetxt(folder / f"sys_id_{k}.csv", table, delimiter=",", header=HEADER, comments="")
    target = "campaigns/double_pendulum/measurements.h5"
    make = ["make", "--dry-run", "--always-make", target, f"DOUBLE_PENDULUM={folder}"]
    told = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, check=True).stdout.replace("\\\n", " ")
    (words,) = re.findall(r"fmuid (import .*)", told)
    arguments = shlex.split(words.replace(target, str(folder / "measurements.h5")))
    assert (
        run([f for a in arguments for f in (map(str, sorted(folder.glob(Path(a).name))) if "*" in a else [a])])
        == 0
    )
    return folder


def of_the_model(folder: Path) -> dict[str, float]:
    """Return the model's parameters as the authors of the rig published them."""
    table = tomllib.loads((folder / "campaign.toml").read_text())
    names = table["models"]["double_pendulum"]["map"]
    return {**table["settings"], **{names[n]: v for n, v in table["published"]["authors"].items()}}


@pytest.mark.slow
def test_the_published_pendulum_comes_back_from_logs_of_it(campaign, tmp_path, capsys):
    assert run(["identify", str(campaign), "--out", str(tmp_path), "--workers", "0", "--quiet"]) == 0
    result, published = Result.from_json(tmp_path), load_campaign(campaign).published["authors"]
    for name in ("m1", "r2", "I1", "I2", "cf1", "cf2"):
        assert result[name].value == pytest.approx(published[name], rel=0.02)

    capsys.readouterr()
    assert beside_published([str(tmp_path), "authors", "sys_id_1"]) == 0
    told = capsys.readouterr().out
    assert re.search(r"^r2 +m +0\.2557 +0\.25\d+ ", told, re.MULTILINE)
    (ratio,) = re.findall(r"^sys_id_7 +pos_meas2 +rad +\S+ +\S+ +(\S+)$", told, re.MULTILINE)
    assert (
        0.5 < float(ratio) < 1.1
    )  # averaged to 100 Hz, inputs and outputs fit a little better than the truth does
    assert (tmp_path / "beside-authors.png").is_file()
    assert beside_published([str(tmp_path), "nobody"]) == 2
    assert "no table [published.nobody]" in capsys.readouterr().err
