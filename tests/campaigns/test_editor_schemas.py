"""Editors complete and check TOML files with schemas that are generated from the types that read them."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import fmuid
from fmuid.campaigns.editor_schemas import FILES, schema
from fmuid.cli.app import run

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", FILES)
def test_the_published_schema_is_that_of_the_types(name: str) -> None:
    assert json.loads((ROOT / "docs" / "schemas" / name).read_text()) == schema(name)


def validator(name: str) -> Any:
    return jsonschema.Draft202012Validator(schema(name))


@pytest.mark.parametrize("file", sorted((ROOT / "campaigns").rglob("campaign.toml")), ids=str)
def test_shipped_campaigns_are_valid(file: Path) -> None:
    validator("campaign.schema.json").validate(tomllib.loads(file.read_text()))


@pytest.mark.parametrize(
    "text",
    [
        "[campaing]\nname = 'x'",
        "[parameters.m]\nstart = 'heavy'",
        "[parameters.m]\nlower = 1.0",
        "[parameters.m]\nstart = 1\nscale = 'cubic'",
        "[models.a]\ntiming = 'sometimes'",
        "[[stages.all.criteria]]\nsignal = 'x'\ndemnad = 1",
        "[limits]\nu = { least = 1 }",
    ],
)
def test_mistakes_are_found(text: str) -> None:
    assert not validator("campaign.schema.json").is_valid(tomllib.loads(text))


def test_fields_are_described() -> None:
    described = schema("campaign.schema.json")["$defs"]["_Parameter"]["properties"]
    assert "machine" in described["per"]["description"]


LAG = """
model Lag
  parameter Real T(unit = "s") = 0.5;
  input Real u(unit = "V");
  output Real y(unit = "V", start = 0, fixed = true);
equation
  T*der(y) = u - y;
end Lag;
"""


def test_written_files_name_their_schema_and_are_valid(tmp_path: Path) -> None:
    (tmp_path / "Lag.mo").write_text(LAG)
    time = np.arange(0.0, 4.0, 0.05)
    rows = np.column_stack([time, np.ones_like(time), 1.0 - np.exp(-time / 0.4)])
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", comments="", header="time,u,y")
    folder = tmp_path / "campaign"
    fmuid.start(tmp_path / "run.csv", model=tmp_path / "Lag.mo", out=folder)
    assert run(["effects", str(folder), "--out", str(folder / "effects.toml"), "--workers", "0"]) == 0
    for name in FILES:
        text = (folder / name.replace(".schema.json", ".toml")).read_text()
        assert text.startswith(f"#:schema {schema(name)['$id']}\n")
        validator(name).validate(tomllib.loads(text))
