"""`fmuid design`, as it is called."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fmuid.cli.app import run
from fmuid.core.experiments import Measurements
from fmuid.data.crosscheck_csv import read_csv
from fmuid.data.measurements import write_measurements
from tests.cli.conftest import TOML

LIMITS = """
[limits]
duration = 1.0
u = { min = -8, max = 8, rate = 400 }
position = { min = -200, max = 200, unit = "mm" }

[design]
sample_time = 0.005
"""


@pytest.fixture
def bench(oscillator: Path, measurements: Measurements, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "bench"
    write_measurements(measurements, folder / "measurements.h5")
    (folder / "campaign.toml").write_text(TOML.format(fmu=oscillator) + LIMITS)
    return folder


def design(*options: str) -> int:
    return run(["design", "bench", "--for", "parameters", "--evaluations", "16", "--workers", "0", *options])


def test_a_run_is_designed_for_the_rig_to_play(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert design("--json", "found.json") == 0
    output = capsys.readouterr().out
    assert "next: fmuid import RECORDED.csv --setup oscillator --input u --out" in output
    assert "--append" in output
    folder = Path("runs/bench-design")
    answer = json.loads((folder / "design.json").read_text())
    assert answer == json.loads(Path("found.json").read_text())
    assert (folder / "index.html").stat().st_size > 10_000
    assert (folder / "figures" / "prediction.png").is_file()
    table = read_csv(folder / "input.csv")
    (u,) = table.columns.values()
    assert table.units == {"u": "N"}
    assert len(table.time) == 201
    assert np.max(np.abs(u)) <= 8.0
    assert np.max(np.abs(np.diff(u))) <= 2.0 * (1 + 1e-9)
    for name in ("m", "d"):
        assert 0.0 < answer["parameters"][name]["after"] < answer["parameters"][name]["before"]
    assert answer["gain"] > 1.0
    assert answer["repeated_run"]["gain"] > 1.0  # better than repeating the best recorded run
    assert bench.is_dir()
    with (folder / "recorded.csv").open("w") as file:
        file.write("time,u [N],position [mm]\n")
        file.writelines(f"{t},{x},0.0\n" for t, x in zip(table.time, u, strict=True))
    words = ["import", str(folder / "recorded.csv"), "--setup", "oscillator", "--input", "u"]
    assert run([*words, "--out", "bench/measurements.h5", "--append"]) == 0


def test_nothing_need_be_measured(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (bench / "measurements.h5").unlink()
    text = (bench / "campaign.toml").read_text()
    (bench / "campaign.toml").write_text(text + "sigma = { position = 1e-4 }\n")
    assert design("--out", "next") == 0
    assert "Standard errors with it: m " in capsys.readouterr().out
    answer = json.loads(Path("next/design.json").read_text())
    assert answer["gain"] is None
    assert answer["sigma"] == {"position": 1e-4}
    assert all(0.0 < entry["after"] < 0.05 for entry in answer["parameters"].values())


def test_without_limits_the_rig_goes_no_farther_than_it_has(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (bench / "campaign.toml").read_text()
    (bench / "campaign.toml").write_text(text.replace(LIMITS, ""))
    assert design("--out", "next") == 0
    assert "taken from the recorded runs as none are given: u from" in capsys.readouterr().out
