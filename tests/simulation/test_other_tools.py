"""FMUs that other people's tools export."""

from __future__ import annotations

import importlib
import math
import sys
import textwrap

import numpy as np
import pytest

from fmuid.fmu import load_fmu
from fmuid.runners import in_process
from fmuid.simulation import Task
from fmuid.workers import WorkerPool

TIME = np.arange(101) * 0.01
TASK = Task(TIME, {"u": np.sin(5 * TIME)}, ("y",))

MODEL = """
    import math
    from {package} import {fmi}Causality, {fmi}Slave, {fmi}Variability, {real}

    class Lag(Base):
        def __init__(self, **keywords):
            super().__init__(**keywords)
            self.time, self.tau, self.u, self.y = 0.0, 0.1, 0.0, 0.0
            tunable = {fmi}Variability.tunable
            {independent}
            self.register_variable({real}("tau", causality={fmi}Causality.parameter, variability=tunable))
            self.register_variable({real}("u", causality={fmi}Causality.input))
            self.register_variable({real}("y", causality={fmi}Causality.output))

        def do_step(self, t, h):
            self.y += (self.u - self.y) * (1 - math.exp(-h / self.tau))
            return True
"""
INDEPENDENT = """self.register_variable(
                Float64("time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous))"""


@pytest.mark.parametrize(
    ("package", "fmi", "real"), [("pythonfmu", "Fmi2", "Real"), ("pythonfmu3", "Fmi3", "Float64")]
)
def test_python_fmu(tmp_path, package, fmi, real):
    pytest.importorskip(package)
    builder = importlib.import_module(f"{package}.builder").FmuBuilder
    independent = INDEPENDENT if fmi == "Fmi3" else ""
    source = MODEL.format(package=package, fmi=fmi, real=real, independent=independent)
    script = tmp_path / "lag.py"
    script.write_text(textwrap.dedent(source).replace("(Base)", f"({fmi}Slave)"))
    fmu = load_fmu(builder.build_FMU(script, dest=tmp_path))
    sys.modules.pop("lag", None)

    def lag(tau: float) -> np.ndarray:
        y = [0.0]
        for k in range(100):
            y.append(y[-1] + (math.sin(5 * TIME[k]) - y[-1]) * (1 - math.exp(-(TIME[k + 1] - TIME[k]) / tau)))
        return np.array(y)

    jobs = [(fmu, TASK, {"tau": tau}) for tau in (0.2, 0.05)] + [(fmu, TASK, {})]
    with WorkerPool(1) as pool:
        for run in (in_process, pool.run):
            for outcome, tau in zip(run(jobs), (0.2, 0.05, 0.1), strict=True):
                np.testing.assert_allclose(outcome[0], lag(tau), atol=1e-12)
