"""Fixtures shared by all tests."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from fmu_build.front.standard_folders import standard_folders
from fmuid.core.campaign import ModelSource
from fmuid.diagnosis.variants import carrier
from fmuid.reference import reference_fmu
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.model_source import flat_model
from fmuid.simulation.simulator import Simulator
from tests.every_law import every_law

ROOT = Path(__file__).parents[1]
FMUS = ROOT / "build" / "fmus"  # where `make fmus` puts them too
MODELICA = ROOT / "modelica"
LIBRARY_FOLDERS = standard_folders()
ACTUATOR = ("FixedShaft", "FreeShaft", "EccentricLoad")
SETUPS = (*ACTUATOR, "LinearAxisOpenLoop", "LinearAxisClosedLoop")
COMPILER = shutil.which(os.environ.get("CC", "cc").split()[0]) or shutil.which("gcc") or shutil.which("clang")
_FALLBACK = pytest.StashKey[str]()


def needs_the_library() -> None:
    """Skip the test where no folder has the Modelica Standard Library."""
    if not any((folder / "Modelica" / "package.mo").is_file() for folder in LIBRARY_FOLDERS):
        pytest.skip("no Modelica Standard Library in MODELICAPATH or a tool's folder")


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "use the pure-Python reference models of the actuator, as where there is no C compiler"
    parser.addoption("--reference-models", action="store_true", help=text)


def pytest_configure(config: pytest.Config) -> None:
    reason = (
        "--reference-models" if config.getoption("--reference-models") else "" if COMPILER else "no C compiler"
    )
    config.stash[_FALLBACK] = reason
    os.environ["MODELICAPATH"] = ""  # tests ask for a tool's libraries explicitly
    os.environ["FMU_BUILD_CFLAGS"] = "-O0"  # most FMUs of tests take longer to compile than to simulate


def pytest_report_header(config: pytest.Config) -> str | None:
    reason = config.stash[_FALLBACK]
    return f"note: the actuator's tests run on its pure-Python reference models ({reason})" if reason else None


def c_compiler() -> str:
    """Return the C compiler, or skip the test where there is none."""
    if COMPILER is None:
        pytest.skip("needs a C compiler")
    return COMPILER


def reference_models(config: pytest.Config) -> bool:
    """Whether tests run without the actuator's FMUs."""
    return bool(config.stash[_FALLBACK])


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
    """Validate every FMU that a test builds: against the XML schema and FMPy's further rules.

    Without a C compiler, tests that build FMUs are skipped.
    """
    packaging = pytest.importorskip("fmu_build.packaging")
    write = packaging._zip

    def write_valid(path: Path, *rest: Any) -> None:
        from fmpy.validation import validate_fmu

        write(path, *rest)
        assert validate_fmu(str(path)) == []

    compiler = packaging._compiler if COMPILER else c_compiler
    with mock.patch.object(packaging, "_zip", write_valid), mock.patch.object(packaging, "_compiler", compiler):
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
def _compiled(request: pytest.FixtureRequest) -> None:
    """Skip a test for which a reference model is not enough."""
    if reference_models(request.config):
        pytest.skip("needs FMUs of the actuator, not only its reference models")


@pytest.fixture(scope="session")
def fmus(_compiled: None) -> Mapping[str, Path]:
    """The FMUs of the shipped setups by name, built from their Modelica sources unless they are up to date."""
    return build_setups(SETUPS)


@pytest.fixture(scope="session")
def shipped(request: pytest.FixtureRequest) -> Callable[[str], Simulator]:
    """A shipped setup by name: its FMU, or its reference model where FMUs cannot be built."""
    if reference_models(request.config):
        return reference_fmu
    fmus = request.getfixturevalue("fmus")
    return lambda name: load_fmu(fmus[name])


@pytest.fixture(scope="session")
def effect_fmus(_compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The FMUs of the actuator with every law at every port, as far as they are off at no cost, by name."""
    fmus = {}
    with mock.patch.dict(os.environ, XDG_CACHE_HOME=str(ROOT / "build" / "cache")):
        for name in ACTUATOR:
            source = ModelSource(MODELICA / "Drives" / "Setups" / f"{name}.mo", f"Drives.Setups.{name}")
            fmus[name] = carrier(source, every_law(flat_model(source), tmp_path_factory.mktemp(name)))
    return fmus


@pytest.fixture(scope="session")
def fmi3_fmus(_compiled: None) -> Mapping[str, Path]:
    """One setup of each family for FMI 3.0."""
    return build_setups(("EccentricLoad", "LinearAxisClosedLoop"), "3")
