"""A user's environment may have other versions; the set-up of `make` has one of each."""

from __future__ import annotations

import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]


def test_ranges_for_users_and_one_version_of_each_for_the_set_up() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = [Requirement(line) for line in (ROOT / "constraints.txt").read_text().splitlines() if line[:1] != "#"]
    versions = {canonicalize_name(pin.name): str(pin.specifier).removeprefix("==") for pin in pins}
    required = [Requirement(r) for r in project["dependencies"]]
    extras = [Requirement(r) for own in project["optional-dependencies"].values() for r in own]
    for requirement in [*required, *extras]:
        name = canonicalize_name(requirement.name)
        if name != "fmuid":
            assert versions[name] in requirement.specifier, name
        assert "==" not in str(requirement.specifier), name
