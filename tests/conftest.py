"""Fixtures shared by all tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

MODELICA = Path(__file__).parents[1] / "modelica"
WITH_EFFECTS = ("FixedShaftWithEffects", "FreeShaftWithEffects", "EccentricLoadWithEffects")
SETUPS = ("FixedShaft", "FreeShaft", "EccentricLoad", "LinearAxisOpenLoop", "LinearAxisClosedLoop")


def _build(names: tuple[str, ...], folder: Path) -> Mapping[str, Path]:
    fmu_build = pytest.importorskip("fmu_build")
    setups = MODELICA / "Drives" / "Setups"
    return {name: fmu_build.build(setups / f"{name}.mo", f"Drives.Setups.{name}", folder) for name in names}


@pytest.fixture(scope="session")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The FMUs of the shipped setups by name, built once from their Modelica sources."""
    return _build(SETUPS, tmp_path_factory.mktemp("fmus"))


@pytest.fixture(scope="session")
def effect_fmus(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The actuator's FMUs with the effects of the catalogue, by name."""
    return _build(WITH_EFFECTS, tmp_path_factory.mktemp("effect_fmus"))
