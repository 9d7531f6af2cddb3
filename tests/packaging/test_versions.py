"""A user's environment may have other versions; the set-up of `make` has one of each."""

from __future__ import annotations

import tomllib
from pathlib import Path

import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]


def test_ranges_for_users_and_one_version_of_each_for_the_set_up() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = [Requirement(line) for line in (ROOT / "constraints.txt").read_text().splitlines() if line[:1] != "#"]
    versions = {canonicalize_name(pin.name): str(pin.specifier).removeprefix("==") for pin in pins}
    required = [Requirement(r) for r in project["dependencies"]]
    extras = [Requirement(r) for extra in project["optional-dependencies"].values() for r in extra]
    for requirement in [*required, *extras]:
        name = canonicalize_name(requirement.name)
        if name != "fmuid":
            assert versions[name] in requirement.specifier, name
        assert "==" not in str(requirement.specifier), name


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])


def test_the_workflow_runs_what_a_change_must_pass() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text())["jobs"]
    job = jobs["test"]
    assert job["steps"][-1] == {"run": ".ci/run"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert all(
        version in SpecifierSet(project["requires-python"]) for version in job["strategy"]["matrix"]["python"]
    )
