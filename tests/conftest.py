"""Fixtures shared by all tests."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from fmu_build.front.standard_folders import standard_folders
from fmuid.core.campaign import ModelSource
from fmuid.diagnosis.variants import carrier
from fmuid.simulation.model_source import flat_model
from tests.every_law import every_law

ROOT = Path(__file__).parents[1]
FMUS = ROOT / "build" / "fmus"  # where `make fmus` puts them too
MODELICA = ROOT / "modelica"
LIBRARY_FOLDERS = standard_folders()
os.environ["MODELICAPATH"] = ""  # tests ask for a tool's libraries explicitly
os.environ["FMU_BUILD_CFLAGS"] = "-O0"  # most FMUs of tests take longer to compile than to simulate
ACTUATOR = ("FixedShaft", "FreeShaft", "EccentricLoad")
SETUPS = (*ACTUATOR, "LinearAxisOpenLoop", "LinearAxisClosedLoop")


@contextmanager
def as_a_user_builds() -> Iterator[None]:
    """Optimise FMUs that are simulated more than they are compiled."""
    with mock.patch.dict(os.environ):
        os.environ.pop("FMU_BUILD_CFLAGS", None)
        yield


def build_once(file: Path, class_name: str, out: Path = FMUS, fmi: str = "2", roots: Sequence[Path] = ()) -> Path:
    """The FMU of a class; of two test processes that want the same one, only the first builds it."""
    fmu_build = pytest.importorskip("fmu_build")
    locks = out / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    with (locks / class_name).open("w") as lock, as_a_user_builds():  # `make` takes them as they are
        fcntl.flock(lock, fcntl.LOCK_EX)
        return fmu_build.build(file, class_name, out, fmi, roots=roots)


@pytest.fixture(scope="session", autouse=True)
def valid_fmus() -> Iterator[None]:
    """Validate every FMU that a test builds: against the XML schema and FMPy's further rules."""
    packaging = pytest.importorskip("fmu_build.packaging")
    write = packaging._zip

    def write_valid(path: Path, *rest: Any) -> None:
        from fmpy.validation import validate_fmu

        write(path, *rest)
        assert validate_fmu(str(path)) == []

    with mock.patch.object(packaging, "_zip", write_valid):
        yield


class _Setups(Mapping[str, Path]):
    """FMUs of shipped setups, each built when it is asked for: test processes do not wait for each other's."""

    def __init__(self, names: tuple[str, ...], fmi: str) -> None:
        self._built: dict[str, Path | None] = dict.fromkeys(names)
        self._fmi = fmi

    def __getitem__(self, name: str) -> Path:
        path = self._built[name]
        if path is None:
            file, out = MODELICA / "Drives" / "Setups" / f"{name}.mo", FMUS if self._fmi == "2" else FMUS / "fmi3"
            path = self._built[name] = build_once(file, f"Drives.Setups.{name}", out, self._fmi)
        return path

    def __iter__(self) -> Iterator[str]:
        return iter(self._built)

    def __len__(self) -> int:
        return len(self._built)


def build_setups(names: tuple[str, ...], fmi: str = "2") -> Mapping[str, Path]:
    """FMUs of shipped setups by name, built from their Modelica sources unless they are up to date."""
    return _Setups(names, fmi)


@pytest.fixture(scope="session")
def fmus() -> Mapping[str, Path]:
    """The FMUs of the shipped setups by name, built from their Modelica sources unless they are up to date."""
    return build_setups(SETUPS)


@pytest.fixture(scope="session")
def effect_fmus(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The FMUs of the actuator with every law at every port, as far as they are off at no cost, by name."""
    found = {}
    with mock.patch.dict(os.environ, XDG_CACHE_HOME=str(ROOT / "build" / "cache")):
        for name in ACTUATOR:
            source = ModelSource(MODELICA / "Drives" / "Setups" / f"{name}.mo", f"Drives.Setups.{name}")
            found[name] = carrier(source, every_law(flat_model(source), tmp_path_factory.mktemp(name)))
    return found


@pytest.fixture(scope="session")
def fmi3_fmus() -> Mapping[str, Path]:
    """One setup of each family for FMI 3.0."""
    return build_setups(("EccentricLoad", "LinearAxisClosedLoop"), "3")
