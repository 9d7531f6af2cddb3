"""The FMU against CasADi's CVODES on the same equations, at equal error, both in this process."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "integrator.py"


@pytest.mark.slow
def test_no_slower_than_cvodes_on_every_experiment(capfd):
    spec = importlib.util.spec_from_file_location("integrator_benchmark", SCRIPT)
    benchmark = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = benchmark  # its dataclasses look themselves up
    spec.loader.exec_module(benchmark)
    results = benchmark.measure(repeats=3)
    compared = 0
    for label, row in results.items():
        for error, (ours, cvodes) in row.items():
            assert np.isfinite(ours), (label, error)
            assert ours <= cvodes, (label, error)  # infinite where CVODES gives up
            compared += np.isfinite(cvodes)
    assert compared >= 10
