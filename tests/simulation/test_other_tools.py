"""FMUs that other people's tools export."""

from __future__ import annotations

import importlib
import math
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmuid.simulation.fmu import load_fmu
from fmuid.simulation.pool.workers import WorkerPool
from fmuid.simulation.runners import in_process
from fmuid.simulation.simulator import Task

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


BALL = """
    from pythonfmu3 import Fmi3Causality, Fmi3Initial, Fmi3SlaveBase, Fmi3Variability, Float64, ModelExchange
    from pythonfmu3.modelexchange import Fmi3UpdateDiscreteStatesResult

    class Ball(Fmi3SlaveBase, ModelExchange):
        def __init__(self, **keywords):
            super().__init__(**keywords)
            self.time, self.h, self.v, self.dh, self.dv, self.e, self.bounces = 0.0, 1.0, 0.0, 0.0, 0.0, 0.8, 0.0
            continuous, exact = Fmi3Variability.continuous, Fmi3Initial.exact
            add, local = self.register_variable, Fmi3Causality.local
            add(Float64("time", causality=Fmi3Causality.independent, variability=continuous))
            add(Float64("h", causality=Fmi3Causality.output, start=1, variability=continuous, initial=exact))
            add(Float64("dh", causality=local, variability=continuous, derivative=1))
            add(Float64("v", causality=Fmi3Causality.output, start=0, variability=continuous, initial=exact))
            add(Float64("dv", causality=local, variability=continuous, derivative=3))
            add(Float64("z", causality=local, variability=continuous), has_event_indicator=True)
            add(Float64("e", causality=Fmi3Causality.parameter, variability=Fmi3Variability.fixed))
            add(Float64("bounces", causality=Fmi3Causality.output, variability=Fmi3Variability.discrete))

        @property
        def z(self):
            return self.h if self.h != 0.0 or self.v > 0.0 else -1e-300

        def get_continuous_state_derivatives(self):
            self.dh, self.dv = self.v, -9.81
            return [self.dh, self.dv]

        def get_event_indicators(self):
            return [self.z]

        def update_discrete_states(self):
            hit = self.h <= 0.0 and self.v < 0.0
            if hit:
                self.h, self.v, self.bounces = 1e-12, -self.e * self.v, self.bounces + 1
            return Fmi3UpdateDiscreteStatesResult(valuesOfContinuousStatesChanged=hit)
"""


def built(builder: Any, name: str, source: str, folder: Path) -> Path:
    script = folder / f"{name}.py"
    script.write_text(textwrap.dedent(source))
    sys.modules.pop(name, None)  # another test may have one of this name
    path = builder.build_FMU(script, dest=folder)
    sys.modules.pop(name, None)
    return Path(path)


def test_model_exchange_with_events_by_pythonfmu3(tmp_path):
    """A ball from 1 m that keeps 0.7 of its speed at each of its impacts."""
    builder = pytest.importorskip("pythonfmu3.builder").FmuBuilder
    fmu = load_fmu(built(builder, "ball", BALL, tmp_path))
    assert fmu.interface == "model exchange"
    time = np.linspace(0.0, 1.2, 61)
    h, bounces = fmu.simulate(Task(time, {}, ("h", "bounces"), tolerance=1e-8), {"e": 0.7})
    first = math.sqrt(2 / 9.81)
    second = first * (1 + 2 * 0.7)
    since, speed = time - first, 0.7 * 9.81 * first
    exact = np.where(time < first, 1 - 9.81 * time**2 / 2, speed * since - 9.81 * since**2 / 2)
    late = time >= second
    since, speed = (time - second)[late], 0.7 * speed
    exact[late] = speed * since - 9.81 * since**2 / 2
    np.testing.assert_allclose(h, exact, atol=1e-6)
    assert bounces.tolist() == (1.0 * (time >= first) + late).tolist()


@pytest.mark.parametrize(
    ("package", "fmi", "real"), [("pythonfmu", "Fmi2", "Real"), ("pythonfmu3", "Fmi3", "Float64")]
)
def test_python_fmu(tmp_path, package, fmi, real):
    pytest.importorskip(package)
    builder = importlib.import_module(f"{package}.builder").FmuBuilder
    independent = INDEPENDENT if fmi == "Fmi3" else ""
    source = MODEL.format(package=package, fmi=fmi, real=real, independent=independent)
    fmu = load_fmu(built(builder, "lag", source.replace("(Base)", f"({fmi}Slave)"), tmp_path))

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
