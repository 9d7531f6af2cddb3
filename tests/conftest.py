"""Fixtures shared by all tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

MODELICA = Path(__file__).parents[1] / "modelica"
SETUPS = ("FixedShaft", "FreeShaft", "EccentricLoad", "LinearAxisOpenLoop", "LinearAxisClosedLoop")


@pytest.fixture(scope="session")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The FMUs of the shipped setups by name, built once from their Modelica sources."""
    fmu_build = pytest.importorskip("fmu_build")
    folder = tmp_path_factory.mktemp("fmus")
    return {
        name: fmu_build.build(MODELICA / "Drives" / "Setups" / f"{name}.mo", f"Drives.Setups.{name}", folder)
        for name in SETUPS
    }
