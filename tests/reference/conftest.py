"""What a property is tested on: the hand-written reference and the FMU built from Modelica."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from benchmarks.reference import reference_fmu
from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.simulator import Simulator


@pytest.fixture(params=["reference", "fmu"])
def model(request) -> Callable[[str], Simulator]:
    """A shipped setup by name."""
    if request.param == "reference":
        return reference_fmu
    fmus = request.getfixturevalue("fmus")
    return lambda name: load_fmu(fmus[name])
