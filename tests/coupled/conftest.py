"""FMUs to couple: the actuator in two parts, and small ones whose behaviour is known."""

from __future__ import annotations

import functools
import importlib
import sys
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

import fmu_build

sys.path.insert(0, str(Path(__file__).parent))

from systems import DRIVES

from tests.conftest import build_once

MODELS = Path(__file__).parent / "models"
PI = """
    from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

    class SpeedPI(Fmi2Slave):
        def __init__(self, **keywords):
            super().__init__(**keywords)
            self.kp, self.ki, self.w_ref, self.w, self.integral, self.i = 0.02, 0.4, 0.0, 0.0, 0.0, 0.0
            for name in ("kp", "ki"):
                self.register_variable(
                    Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
                )
            for name in ("w_ref", "w"):
                self.register_variable(Real(name, causality=Fmi2Causality.input))
            self.register_variable(Real("i", causality=Fmi2Causality.output))

        def exit_initialization_mode(self):
            self.i = self.kp * (self.w_ref - self.w) + self.integral

        def do_step(self, t, h):
            self.integral += self.ki * (self.w_ref - self.w) * h
            self.i = self.kp * (self.w_ref - self.w) + self.integral
            return True
"""


@pytest.fixture(scope="session")
def drive() -> Mapping[str, Path]:
    """The actuator with an eccentric load, whole and as plant and controller."""
    places = {
        "whole": "Setups/EccentricLoad",
        "plant": "Setups/EccentricLoadPlant",
        "controller": "Signals/SpeedController",
    }
    return {
        name: build_once(DRIVES / f"{place}.mo", f"Drives.{place.replace('/', '.')}")
        for name, place in places.items()
    }


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Build a model of `models`, each once."""
    folder = tmp_path_factory.mktemp("coupled")

    @functools.cache
    def make(name: str, fmi: int = 2) -> Path:
        return fmu_build.build(MODELS / f"{name}.mo", name, folder / str(fmi), fmi=str(fmi))

    return make


@pytest.fixture(scope="session")
def python_pi(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A speed controller that another tool exports, and that does not say what its output depends on."""
    pytest.importorskip("pythonfmu")
    folder = tmp_path_factory.mktemp("python")
    script = folder / "speed_pi.py"
    script.write_text(textwrap.dedent(PI))
    made = importlib.import_module("pythonfmu.builder").FmuBuilder.build_FMU(script, dest=folder)
    sys.modules.pop("speed_pi", None)
    return Path(made)
