"""What a property is tested on: the hand-written reference and the FMU built from Modelica."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from fmuid.reference import reference_fmu
from fmuid.simulation.simulator import Simulator
from tests.conftest import reference_models


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "model" in metafunc.fixturenames:
        kinds = ["reference"] if reference_models(metafunc.config) else ["reference", "fmu"]
        metafunc.parametrize("model", kinds, indirect=True)


@pytest.fixture
def model(request: pytest.FixtureRequest, shipped: Callable[[str], Simulator]) -> Callable[[str], Simulator]:
    """A shipped setup by name."""
    return reference_fmu if request.param == "reference" else shipped
