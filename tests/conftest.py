"""Fixtures shared by all tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FMUS = ROOT / "build" / "fmus"  # where `make fmus` puts them too
MODELICA = ROOT / "modelica"
SETUPS = ("FixedShaft", "FreeShaft", "EccentricLoad", "LinearAxisOpenLoop", "LinearAxisClosedLoop")


def build_setups(names: tuple[str, ...], fmi: str = "2") -> Mapping[str, Path]:
    """FMUs of shipped setups by name, built from their Modelica sources unless they are up to date."""
    fmu_build = pytest.importorskip("fmu_build")
    setups, out = MODELICA / "Drives" / "Setups", FMUS if fmi == "2" else FMUS / "fmi3"
    return {name: fmu_build.build(setups / f"{name}.mo", f"Drives.Setups.{name}", out, fmi) for name in names}


@pytest.fixture(scope="session")
def fmus() -> Mapping[str, Path]:
    """The FMUs of the shipped setups by name, built from their Modelica sources unless they are up to date."""
    return build_setups(SETUPS)


@pytest.fixture(scope="session")
def effect_fmus() -> Mapping[str, Path]:
    """The FMUs of the shipped setups with the effects of their catalogues, by name."""
    return build_setups(tuple(f"{name}WithEffects" for name in SETUPS))


@pytest.fixture(scope="session")
def fmi3_fmus() -> Mapping[str, Path]:
    """One setup of each family for FMI 3.0."""
    return build_setups(("EccentricLoad", "LinearAxisClosedLoop"), "3")
