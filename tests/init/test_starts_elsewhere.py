"""Runs that start in motion, or warm, while the model starts from its own values."""

import json
from pathlib import Path

import numpy as np
import pytest

import fmuid
from fmuid.campaigns.campaign_toml import load_campaign
from fmuid.cli.app import run
from fmuid.diagnosis.made_catalogue import with_catalogue
from fmuid.diagnosis.subject import subject_of
from fmuid.simulation.coupled.loading import load_simulator

MODEL = """
model Room
  parameter Real G(unit="W/K") = 20;
  parameter Real C(unit="J/K") = 2e4;
  input Real P(unit="W");
  output Real T(unit="K");
  Real wall(unit="K", start=293, fixed=true);
  Real air(unit="K"{start});
equation
  T = air;
  C*der(wall) = G*(air - wall) - 0.3*G*(wall - 293);
  0.2*C*der(air) = P - G*(air - wall);
end Room;
"""


def course(power, air, wall, conductance):
    """Temperatures of the air of a room, which starts at `air` and `wall`."""

    def slope(x, p, g):
        flow = g * (x[0] - x[1])
        return np.array([(p - flow) / 4e3, (flow - 0.3 * g * (x[1] - 293.0)) / 2e4])

    x, states = np.array([air, wall]), []
    for p, g in zip(power, conductance, strict=True):
        states.append(x[0])
        for _ in range(8):
            a = slope(x, p, g)
            x = x + 2.5 * slope(x + 1.25 * a, p, g)
    return np.array(states)


def logs(
    folder: Path,
    warm: float,
    repeats: int = 2,
    wall: float = 0.0,
    samples: int = 200,
    late: int = 0,
    windy: float = 0.0,
    offset: float = 0.0,
) -> list[Path]:
    """Logs of the room, which starts `warm` kelvin above the model or more, its wall by half of that and `wall`.

    The heater follows its command `late` samples later. The conductances of 24 W/K change by a share `windy` with a
    wind. The sensor shows an `offset` more.
    """
    rng, paths, time = np.random.default_rng(2), [], 20.0 * np.arange(samples)
    (folder / "Room.mo").write_text(MODEL.replace("{start}", ", start=293, fixed=true"))
    for which in range(3):
        power = 300.0 * (np.sin((1 + which) * 2e-3 * time) > 0.0)
        wind = np.sin((2.3 + which) * 1.3e-3 * time + which)
        true = course(
            np.concatenate([np.zeros(late), power[: samples - late]]),
            293.0 + warm * (1.0 + which),
            293.0 + 0.5 * warm + wall * (1.0 + which),
            24.0 * (1.0 + windy * wind),
        )
        for k in range(repeats):
            columns = [100.0 * k + time, power, true + offset + 0.02 * rng.standard_normal(samples)]
            rows = np.column_stack([*columns, wind] if windy else columns)
            paths.append(folder / f"run{which}_{k}.csv")
            header = "time,P [W],T [K]" + ",wind [m/s]" * bool(windy)
            np.savetxt(paths[-1], rows, "%.5f", ",", header=header, comments="")
    return paths


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_start_states_are_estimated_where_runs_start_elsewhere(tmp_path):
    campaign = fmuid.start(logs(tmp_path, 4.0), model=tmp_path / "Room.mo", out=tmp_path / "room")
    text = (tmp_path / "room" / "campaign.toml").read_text()
    assert "# The states at the start are estimated: 'run0_0' starts at T = 297 K, the model at 293." in text
    assert 'segments = "run"' in text
    result = fmuid.identify(campaign)
    assert result.parameters["G"] == pytest.approx(24.0, rel=0.02)
    subject = subject_of(with_catalogue(load_campaign(tmp_path / "room"), load_simulator), load_simulator)
    assert all(run.n_repeats == 2 for run in subject.observed.runs)
    diagnosis = fmuid.diagnose(campaign, law=False).diagnosis
    assert not diagnosis.gap.present
    assert any("fitted to each run" in note for note in diagnosis.notes)


@pytest.mark.parametrize("wall", [6.0, 0.0])
def test_walls_that_were_warm_before_the_log_began_are_no_effect(tmp_path, wall):
    """The air starts as in the model; only what follows shows where the wall started."""
    campaign = fmuid.start(logs(tmp_path, 0.0, wall=wall), model=tmp_path / "Room.mo", out=tmp_path / "room")
    diagnosis = fmuid.diagnose(campaign, law=False).diagnosis
    assert diagnosis.verdict.kind == "complete"
    assert any("start elsewhere than the model" in note for note in diagnosis.notes) is bool(wall)
    assert diagnosis.model["G"] == pytest.approx(24.0, rel=0.02)


def test_walls_that_were_warm_do_not_hide_an_effect(tmp_path):
    """Neither the late heater nor the warm walls explain the gap without the other."""
    campaign = fmuid.start(
        logs(tmp_path, 0.0, repeats=1, wall=3.0, late=3), model=tmp_path / "Room.mo", out=tmp_path / "room"
    )
    diagnosis = fmuid.diagnose(campaign, law=False).diagnosis
    assert any("start elsewhere than the model" in note for note in diagnosis.notes)
    assert diagnosis.verdict.effects == ("delay@P",)


def test_walls_that_were_warm_do_not_hide_a_coefficient_that_varies(tmp_path):
    """Until the starts of the walls are free, the wind hardly shows; then dependences are compared again."""
    room, out = tmp_path / "room", tmp_path / "diagnosis"
    fmuid.start(logs(tmp_path, 0.0, wall=12.0, windy=0.02), model=tmp_path / "Room.mo", out=room)
    assert run(["diagnose", str(room), "--out", str(out), "--workers", "0", "--quiet"]) == 0
    answer = json.loads((out / "diagnosis.json").read_text())
    assert any("start elsewhere than the model" in note for note in answer["notes"])
    assert answer["verdict"]["effects"] == ["varies@G(wind)"]
    assert run(["validate", str(out), "--experiment", "run0_0", "--workers", "0"]) == 0


def test_a_sensor_with_an_offset_is_told_from_runs_that_start_elsewhere(tmp_path):
    """Its log begins elsewhere, too, but one offset explains all runs."""
    paths = logs(tmp_path, 0.0, repeats=1, offset=2.0)
    campaign = fmuid.start(paths, model=tmp_path / "Room.mo", out=tmp_path / "room")
    assert 'segments = "run"' in (tmp_path / "room" / "campaign.toml").read_text()
    diagnosis = fmuid.diagnose(campaign, law=False).diagnosis
    named = {*diagnosis.verdict.effects, *(name for one in diagnosis.verdict.one_of for name in one)}
    assert named
    assert named <= {"offset@T", "gain@T"}  # 2 K of 293 K
    assert diagnosis.gap.corrected < 0.25
    assert any("predicted from the model's start values" in note for note in diagnosis.notes)


def test_runs_that_start_as_the_model_does_start_from_its_values(tmp_path):
    fmuid.start(logs(tmp_path, 0.0, repeats=1), model=tmp_path / "Room.mo", out=tmp_path / "room")
    assert "segments" not in (tmp_path / "room" / "campaign.toml").read_text()


@pytest.mark.parametrize(("warm", "samples", "estimated"), [(4.0, 200, True), (0.22, 4000, False)])
def test_a_start_that_fades_soon_is_estimated_if_it_leaves_a_gap(tmp_path, warm, samples, estimated):
    """The model forgets its start within two samples: after 40 s of 4000 s, or of 80,000 s."""
    paths = logs(tmp_path, warm, repeats=1, samples=samples)
    file = tmp_path / "Room.mo"
    file.write_text(file.read_text().replace('C(unit="J/K") = 2e4', 'C(unit="J/K") = 2e2'))
    fmuid.start(paths, model=file, out=tmp_path / "room")
    assert ("segments" in (tmp_path / "room" / "campaign.toml").read_text()) is estimated


def given(folder: Path, equations: str) -> Path:
    """The room's model with initial equations."""
    text = MODEL.replace("{start}", "").replace("Room", "Given")
    if "wall =" in equations:
        text = text.replace(", start=293, fixed=true", "")
    (folder / "Given.mo").write_text(text.replace("equation\n", f"initial equation\n{equations}equation\n", 1))
    return folder / "Given.mo"


def test_states_that_the_model_calculates_are_left_out(tmp_path, capsys):
    paths = logs(tmp_path, 4.0, repeats=1)
    fmuid.start(paths, model=given(tmp_path, "  air = wall;\n"), out=tmp_path / "given")
    assert "at 293; T, which the FMU calculates, cannot be estimated" in capsys.readouterr().out
    assert 'segments = "run"' in (tmp_path / "given" / "campaign.toml").read_text()
    assert fmuid.identify(tmp_path / "given").parameters["G"] == pytest.approx(24.0, rel=0.5)


def test_a_model_that_calculates_its_start_says_so(tmp_path, capsys):
    paths = logs(tmp_path, 4.0, repeats=1)
    fmuid.start(paths, model=given(tmp_path, "  air = wall;\n  wall = 293;\n"), out=tmp_path / "given")
    told = "the model cannot start as the runs do: 'run0_0' starts at T = 297 K, the model at 293, but the state"
    assert told in capsys.readouterr().out
    assert "segments" not in (tmp_path / "given" / "campaign.toml").read_text()
