"""`fmuid sensitivity` on a campaign with runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fmuid.cli.app import run
from fmuid.core.experiments import Measurements
from fmuid.data.measurements import write_measurements
from tests.cli.conftest import TOML

pytest.importorskip("SALib")


def test_recorded_runs_lend_their_inputs(
    oscillator: Path,
    measurements: Measurements,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_measurements(measurements, Path("bench/measurements.h5"))
    Path("bench/campaign.toml").write_text(TOML.format(fmu=oscillator))
    command = ["sensitivity", "bench", "--method", "morris", "--workers", "0", "--samples", "8"]
    assert run([*command, "--json", "change.json"]) == 0
    output = capsys.readouterr().out
    assert "runs/bench-sensitivity/sensitivity.json" in output
    assert "next:" not in output
    change = json.loads(Path("change.json").read_text())
    assert [o["output"] for o in change["outputs"]] == ["step: position", "sine: position"]
    assert all(o["parameters"]["m"]["mu_star"]["value"] > 1.0 for o in change["outputs"])
    assert run([*command, "--of", "criterion", "-e", "step", "--json", "criterion.json"]) == 0
    (criterion,) = json.loads(Path("criterion.json").read_text())["outputs"]
    assert criterion["output"] == "step: position least_squares"
    assert run([*command, "-e", "stp"]) == 2
    assert "no experiment matches 'stp'" in capsys.readouterr().err
    assert run([*command, "--stage", "al"]) == 2
    assert "no stage 'al'; the campaign has: all" in capsys.readouterr().err
