from __future__ import annotations

import fcntl
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import fmpy
import fmpy.fmi2
import numpy as np
import pytest

from fmu_build.packaging import package

_spec = importlib.util.spec_from_file_location("handmade", Path(__file__).with_name("handmade.py"))
assert _spec is not None
assert _spec.loader is not None
handmade = importlib.util.module_from_spec(_spec)
sys.modules["handmade"] = handmade
_spec.loader.exec_module(handmade)


class Fmu:
    """One instance behind FMPy's thin binding of the C functions, variables by name."""

    def __init__(self, path: Path, folder: Path, co_simulation: bool = True) -> None:
        self.description = fmpy.read_model_description(str(path))
        self.vr = {v.name: v.valueReference for v in self.description.modelVariables}
        self.messages: list[str] = []
        kind = fmpy.fmi2.FMU2Slave if co_simulation else fmpy.fmi2.FMU2Model
        name = self.description.coSimulation.modelIdentifier
        self.c = kind(
            guid=self.description.guid, unzipDirectory=str(folder), modelIdentifier=name, instanceName=name
        )
        callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(
            lambda env, name, status, category, message: self.messages.append(message.decode())
        )
        callbacks.allocateMemory = fmpy.fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
        callbacks.freeMemory = fmpy.fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
        self._callbacks = callbacks
        self.c.instantiate(callbacks=callbacks)

    def start(
        self, tolerance: float | None = None, at: float = 0.0, stop: float | None = None, **values: float
    ) -> Fmu:
        self.c.setupExperiment(tolerance=tolerance, startTime=at, stopTime=stop)
        self.set(**values)
        self.c.enterInitializationMode()
        self.c.exitInitializationMode()
        return self

    def set(self, **values: float) -> None:
        if values:
            self.c.setReal([self.vr[n] for n in values], list(values.values()))

    def get(self, *names: str) -> Any:
        values = self.c.getReal([self.vr[n] for n in names])
        return values[0] if len(names) == 1 else np.array(values)

    def run(
        self, names: Sequence[str], steps: int, h: float, at: float = 0.0, inputs: dict | None = None
    ) -> np.ndarray:
        """Values at every communication point; inputs held from each point on."""
        rows = []
        for k in range(steps + 1):
            if k > 0:
                self.c.doStep(at + (k - 1) * h, h)
            rows.append(np.atleast_1d(self.get(*names)))
            if inputs and k < steps:
                self.set(**{n: u[k] for n, u in inputs.items()})
        return np.array(rows)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[Path, Path]]:
    """Builds (once, for all test processes) and unpacks the FMU of a handmade model."""
    shared = tmp_path_factory.getbasetemp()
    shared = shared.parent / "handmade" if "PYTEST_XDIST_WORKER" in os.environ else shared / "handmade"

    def build(name: str, fmi: int = 2) -> tuple[Path, Path]:
        folder = shared / f"{name}{fmi}"
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            path = package(getattr(handmade, name)(), folder, fmi=fmi)
            if not (folder / "unpacked").exists():
                fmpy.extract(str(path), str(folder / "unpacked"))
        return path, folder / "unpacked"

    return build


@pytest.fixture
def fmu(built: Callable[..., tuple[Path, Path]]) -> Iterator[Callable[..., Fmu]]:
    """Instances of a handmade model, freed at the end."""
    instances: list[Fmu] = []

    def instance(name: str, co_simulation: bool = True) -> Fmu:
        instances.append(Fmu(*built(name), co_simulation))
        return instances[-1]

    yield instance
    for one in instances:
        one.c.freeInstance()
