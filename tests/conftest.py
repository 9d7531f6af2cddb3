"""Fixtures shared by all tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FMUS = ROOT / "build" / "fmus"  # where `make fmus` puts them too
MODELICA = ROOT / "modelica"
SETUPS = ("FixedShaft", "FreeShaft", "EccentricLoad", "LinearAxisOpenLoop", "LinearAxisClosedLoop")


def _build(names: tuple[str, ...]) -> Mapping[str, Path]:
    fmu_build = pytest.importorskip("fmu_build")
    setups = MODELICA / "Drives" / "Setups"
    return {name: fmu_build.build(setups / f"{name}.mo", f"Drives.Setups.{name}", FMUS) for name in names}


@pytest.fixture(scope="session")
def fmus() -> Mapping[str, Path]:
    """The FMUs of the shipped setups by name, built from their Modelica sources unless they are up to date."""
    return _build(SETUPS)


@pytest.fixture(scope="session")
def effect_fmus() -> Mapping[str, Path]:
    """The FMUs of the shipped setups with the effects of their catalogues, by name."""
    return _build(tuple(f"{name}WithEffects" for name in SETUPS))
