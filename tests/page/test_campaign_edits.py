"""Edits of campaign.toml from the page: comments stay, and every edit can be undone."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("tomlkit", reason="needs the extra [page]")

from fmuid.core.errors import CampaignError
from fmuid.page.campaign_edits import CampaignFile

TEXT = """\
# A campaign
[campaign]
name = "bench" # short

[models.rig]
fmu = "rig.fmu"
map = { "x [mm]" = "x" } # names
interpolation = "hold"

[parameters."arm.m"] # from the scale
start = 1.0 # kg
lower = 0.5

[parameters."arm.g"]
start = 9.81
free = false # a constant of nature
known = true

# Fixed at the FMU's start value; uncomment to identify it as well.

# Fixed: redundant with the free parameters.

# [parameters."arm.c"] # stiffness
# start = 100.0
# lower = 10.0

# Runs
[roles]
identification = ["a", "b"]
"""


@pytest.fixture
def file(tmp_path: Path) -> CampaignFile:
    (tmp_path / "campaign.toml").write_text(TEXT)
    return CampaignFile(tmp_path / "campaign.toml")


def test_an_edit_changes_its_value_and_no_comment(file: CampaignFile) -> None:
    file.set(("parameters", "arm.m", "start"), 2.5)
    file.set(("models", "rig", "map", "y"), "v")
    file.set(("models", "rig", "interpolation"), "linear")
    text = file.path.read_text()
    assert "start = 2.5 # kg" in text
    assert text.count("#") == TEXT.count("#")
    assert file.tables["models"]["rig"] == {
        "fmu": "rig.fmu",
        "map": {"x [mm]": "x", "y": "v"},
        "interpolation": "linear",
    }


def test_undo_and_redo_go_through_all_edits(file: CampaignFile) -> None:
    file.set(("parameters", "arm.m", "start"), 2.5)
    file.set(("parameters", "arm.m", "upper"), 9.0)
    edited = file.text
    assert file.undo()
    assert file.undo()
    assert not file.undo()
    assert file.path.read_text() == TEXT
    assert file.redo()
    assert file.redo()
    assert file.path.read_text() == edited


def test_a_fixed_parameter_is_freed_by_uncommenting_its_table(file: CampaignFile) -> None:
    assert file.reasons() == {"arm.c": "redundant with the free parameters", "arm.g": "a constant of nature"}
    file.free("arm.c", "")
    assert file.tables["parameters"]["arm.c"] == {"start": 100.0, "lower": 10.0}
    assert "# stiffness" in file.text
    file.free("load.J", '[parameters."load.J"]\nstart = 1.0')
    assert file.tables["parameters"]["load.J"] == {"start": 1.0}


def test_a_missing_table_is_made(file: CampaignFile) -> None:
    file.set(("signals", "x [mm]", "filter"), 20.0)
    assert file.tables["signals"] == {"x [mm]": {"filter": 20.0}}
    assert file.tables["roles"] == {"identification": ["a", "b"]}
    file.set(("signals", "x [mm]", "filter"), None)
    assert file.tables["signals"]["x [mm]"] == {}


def test_text_that_is_not_toml_is_refused_and_the_file_stays(file: CampaignFile) -> None:
    with pytest.raises(CampaignError, match="is not TOML"):
        file.replace("[campaign\n")
    assert file.path.read_text() == TEXT


def test_what_another_program_wrote_is_taken_over_and_can_be_undone(file: CampaignFile) -> None:
    assert not file.reload()
    file.path.write_text(TEXT.replace('"hold"', '"linear"'))
    assert file.reload()
    assert file.tables["models"]["rig"]["interpolation"] == "linear"
    file.undo()
    assert file.path.read_text() == TEXT


def test_an_edit_keeps_what_another_program_has_just_written(file: CampaignFile) -> None:
    file.path.write_text(TEXT.replace('"hold"', '"linear"'))
    file.set(("parameters", "arm.m", "start"), 2.5)
    assert 'interpolation = "linear"' in file.path.read_text()
    file.undo()
    assert file.path.read_text() == TEXT.replace('"hold"', '"linear"')
